"""How inputs behave between two readings: a property of each channel."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from livepde.errors import ConfigurationError

Between: TypeAlias = Literal["line", "hold", "next"]
"""A straight line; the last reading until the next one; or the next reading since the last one."""


@dataclass(frozen=True)
class Held:
    """The channels that are constant between two readings; all others are straight lines.

    Parameters
    ----------
    last
        Names of channels whose value holds until the next reading (`between = "hold"`).
    next
        Names of channels whose reading is the mean since the last one (`between = "next"`).
    """

    last: tuple[str, ...] = ()
    next: tuple[str, ...] = ()

    @classmethod
    def of(cls, between: Mapping[str, Any], inputs: Collection[str]) -> Held:
        """Return the channels of a mapping from channel to behaviour, checked.

        Parameters
        ----------
        inputs
            Names of the channels that may be held.

        Raises
        ------
        ConfigurationError
            Another channel, or another behaviour.
        """
        if not isinstance(between, Mapping):
            raise ConfigurationError(
                f"between: got {between!r}; expected a mapping from input channel to behaviour, "
                'such as {"heater": "hold"}.'
            )
        for name, given in between.items():
            if name not in inputs:
                raise ConfigurationError(
                    f"between: '{name}' is not an input of this model; the inputs are "
                    f"{list(inputs)}."
                )
            if given not in get_args(Between):
                raise ConfigurationError(
                    f"between of '{name}': got {given!r}; expected 'line', 'hold' or 'next'."
                )
        kinds = {
            kind: [n for n, one in between.items() if one == kind] for kind in ("hold", "next")
        }
        return cls(tuple(sorted(kinds["hold"])), tuple(sorted(kinds["next"])))

    def __bool__(self) -> bool:
        return bool(self.last or self.next)

    def __contains__(self, name: object) -> bool:
        return name in self.last or name in self.next


LINES = Held()
