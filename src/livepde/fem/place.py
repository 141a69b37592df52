"""Arguments of a weak form: coordinates, time, input channels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, NoReturn

from livepde.errors import MissingInputError
from livepde.linalg import Array


class Inputs(dict[str, float]):
    """Values of the input channels at one moment, unchangeable; a missing name raises an error."""

    def __missing__(self, name: str) -> float:
        known = ", ".join(sorted(self)) or "none"
        raise MissingInputError(
            f"Input channel '{name}' has no value; channels with one: {known}. "
            "Name it in inputs= of the model and send it with every sample."
        )

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("Inputs of a moment never change: several states share them.")

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return Inputs, (dict(self),)  # a copy would set item by item


NO_INPUTS = Inputs({})


@dataclass(frozen=True)
class Moment:
    """A time and the values of the input channels at that time."""

    t: float = 0.0
    inputs: Mapping[str, float] = field(default_factory=lambda: NO_INPUTS)


START = Moment()


class Place:
    """The argument `x` of a weak form.

    `x[0], x[1], ...` are coordinates of the quadrature points; `x.t` the time; `x.inputs["Q"]` the
    value of an input channel; `x.normal` the outward normal (on boundaries); `x.h` the diameter of
    the cell, shape (elements, 1), on a boundary of the adjacent cell. Reads of time and inputs are
    recorded: a form that reads neither is constant in time and assembled once.
    """

    def __init__(
        self,
        x: Array,
        normal: Array | None,
        moment: Moment,
        diameter: Callable[[], Array] | None = None,
    ) -> None:
        self._x = x
        self._diameter = diameter
        self._normal = normal
        self._moment = moment
        self.used: set[str] = set()

    def __getitem__(self, axis: int) -> Array:
        coordinate: Array = self._x[axis]
        return coordinate

    @property
    def t(self) -> float:
        """Time."""
        self.used.add("t")
        return self._moment.t

    @property
    def inputs(self) -> Mapping[str, float]:
        """Values of the input channels."""
        self.used.add("inputs")
        return self._moment.inputs

    @property
    def h(self) -> Array:
        """Diameter of each cell, shape (elements, 1): for stabilisation and penalties."""
        if self._diameter is None:
            raise AttributeError("x.h exists where a form is integrated over cells or boundaries.")
        return self._diameter()

    @property
    def normal(self) -> Array:
        """Outward normal on a boundary, shape (d, facets, points)."""
        if self._normal is None:
            raise AttributeError("x.normal exists on boundaries only: wrap the form in lp.On(...).")
        return self._normal


class _Constants(Mapping[str, float]):
    """Inputs of a place of which some are constant; only the others are recorded as read."""

    def __init__(self, place: Place, constants: Mapping[str, float]) -> None:
        self._place = place
        self._constants = constants

    def __getitem__(self, name: str) -> float:
        # A form that reads constants alone stays constant in time: the place records no read.
        return self._constants[name] if name in self._constants else self._place.inputs[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._place.inputs, **self._constants})

    def __len__(self) -> int:
        return len({**self._place.inputs, **self._constants})


class _PlaceWithConstants:
    """A place x of which some inputs are constant."""

    def __init__(self, place: Place, constants: Mapping[str, float]) -> None:
        self._place = place
        self.inputs = _Constants(place, constants)

    def __getitem__(self, axis: int) -> Array:
        return self._place[axis]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._place, name)


def with_constants(form: Callable[..., Any], constants: Mapping[str, float]) -> Callable[..., Any]:
    """Return a function of a place that finds some inputs as constants there."""
    if not constants:
        return form

    @wraps(form)
    def bound(*given: Any) -> Any:
        places = (
            _PlaceWithConstants(item, constants) if isinstance(item, Place) else item
            for item in given
        )
        return form(*places)

    return bound
