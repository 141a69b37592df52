"""Channels of an identifier: parsing and validation of samples, hold of missing inputs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError, MissingInputError, SampleError
from livepde.fem import Inputs
from livepde.linalg import Array
from livepde.observation import Observed
from livepde.samples import (
    Readings,
    Sample,
    check_noise,
    labelled,
    noise_channel,
    number,
    plan,
    readings,
)
from livepde.stepping import own_noise

# Values of the withheld sensors if there are none.
NOTHING = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Channels:
    """Names of all channels; conversion of samples to validated arrays.

    Parameters
    ----------
    forced
        Channels that the model reads.
    observed, withheld
        Assimilated sensors, and withheld sensors, which are only scored.

    Raises
    ------
    ConfigurationError
        A sensor is both.
    """

    forced: tuple[str, ...]
    observed: Observed
    withheld: Observed | None

    def __post_init__(self) -> None:
        both = [name for name in self.hidden if name in self.observed.names]
        if both:
            raise ConfigurationError(
                f"channels {both} are both assimilated and withheld: rename the "
                'sensors, as in Points({"T_30": 0.3}).'
            )
        if taken := [name for name in self.inputs if name in self.noise]:
            raise ConfigurationError(
                f"channel '{taken[0]}' has the name of the noise of a reading: rename it."
            )

    @cached_property
    def hidden(self) -> tuple[str, ...]:
        """Names of the withheld sensors."""
        return self.withheld.names if self.withheld else ()

    @cached_property
    def sensors(self) -> list[Observed]:
        """Observation operators: the assimilated, and the withheld one if present."""
        return [item for item in (self.observed, self.withheld) if item is not None]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names that a sample may contain."""
        return tuple(dict.fromkeys([*self.observed.names, *self.hidden, *self.inputs]))

    @cached_property
    def noise(self) -> dict[str, str]:
        """Mapping from the name of a reading's noise to its sensor."""
        return {noise_channel(name): name for name in (*self.observed.names, *self.hidden)}

    @cached_property
    def _known(self) -> frozenset[str]:
        return frozenset([*self.names, *self.noise])

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """Channels that the model and the sensors read."""
        read = [name for item in self.sensors for name in item.observation.inputs]
        return tuple(dict.fromkeys([*self.forced, *read]))

    @cached_property
    def optional(self) -> frozenset[str]:
        """Inputs that may be missing: positions of moving sensors."""
        sensors = [item.observation for item in self.sensors]
        needed = {name for item in sensors for name in set(item.inputs) - item.optional}
        found = frozenset().union(*(item.optional for item in sensors))
        return found - needed - set(self.forced)

    def parse(
        self, z: Readings, inputs: Mapping[str, float]
    ) -> tuple[Array, Array | None, Array, dict[str, float]]:
        """Return assimilated values and their noise, withheld values, and inputs, all checked.

        The noise is None if no value has one of its own, NaN where one has none. Among the inputs
        may be other channels.
        """
        z = z if isinstance(z, (np.ndarray, dict)) else labelled(z)
        if not isinstance(z, np.ndarray) and isinstance(z, Mapping):
            measured, noise, withheld, named = self._by_name(z, inputs)
        else:
            measured, noise = readings(z, self.observed)
            withheld, named = np.full(len(self.hidden), np.nan) if self.hidden else NOTHING, {}
        return measured, noise, withheld, named | self._named(inputs) if inputs else named

    def readings(self, samples: Sequence[Sample]) -> Array:
        """Return the readings of assimilated and withheld sensors, shape (samples, sensors)."""
        rows = [self.parse(sample.z, sample.inputs or {}) for sample in samples]
        shape = len(samples), self.observed.size + len(self.hidden)
        return np.reshape([[*measured, *hidden] for measured, _, hidden, _ in rows], shape)

    def _by_name(
        self, z: Mapping[str, Any], inputs: Mapping[str, float]
    ) -> tuple[Array, Array | None, Array, dict[str, float]]:
        """Return the values of `parse` for a mapping; it may contain inputs, too."""
        if not (self._known.issuperset(z) and self._known.issuperset(inputs)):
            unknown = next(name for name in (*z, *inputs) if name not in self._known)
            raise SampleError(
                f"unknown channel '{unknown}'; this identifier has {list(self.names)}."
            )
        values: dict[str, float] = {}
        stds: dict[str, float] = {}  # of the sensors that state one
        for name, value in z.items():  # words for a message cost more than the usual value
            if name in self.noise:
                stds[self.noise[name]] = check_noise(self.noise[name], value)
                continue
            if isinstance(value, tuple | list):
                value, stds[name] = self._pair(name, value)
            usual = type(value) is float and math.isfinite(value)
            values[name] = value if usual else number(value, f"channel '{name}'")
        noise = own_noise(_row(self.observed.names, stds)) if stds else None
        withheld = _row(self.hidden, values) if self.hidden else NOTHING
        return _row(self.observed.names, values), noise, withheld, values

    def _pair(self, name: str, given: Sequence[Any]) -> tuple[Any, float]:
        """Return value and noise of a reading given as a pair."""
        if len(given) != 2 or noise_channel(name) not in self.noise:
            raise SampleError(
                f"channel '{name}': got {given!r}; expected a number, or of a sensor a pair "
                "(value, standard deviation of its noise)."
            )
        value, std = given
        return value, check_noise(name, std)

    def _named(self, inputs: Mapping[str, float]) -> dict[str, float]:
        """Return validated inputs."""
        named = {}
        for name, value in inputs.items():
            if name not in self.inputs:
                raise SampleError(
                    f"unknown input '{name}'; model and sensors have {list(self.inputs)}."
                )
            named[name] = number(value, f"input '{name}'")
        return named

    def filled(self, named: Mapping[str, float], known: Inputs) -> tuple[Inputs, tuple[str, ...]]:
        """Return all inputs, and the names of missing ones that hold their last value.

        Raises
        ------
        MissingInputError
            An input has no value yet.
        """
        if not self.inputs:
            return known, ()
        values, held = {}, []
        for name in self.inputs:
            value = named.get(name, np.nan)
            if math.isnan(value) and name not in self.optional:
                if name not in set(known):
                    needed = [c for c in self.inputs if c not in self.optional]
                    raise MissingInputError(
                        f"input '{name}' has no value in the first sample, nor before; start where "
                        f"all of {needed} have one."
                    )
                value = known[name]
                held.append(name)
            values[name] = value
        return Inputs(values), tuple(held)

    def planned(
        self, inputs: Mapping[str, ArrayLike], times: Iterable[float], t: float, known: Inputs
    ) -> list[Inputs]:
        """Return all inputs at each of several future times.

        Parameters
        ----------
        inputs
            Mapping from channel to a value, or to one value for each time.
        t, known
            Time and inputs of the last sample.
        """
        times, planned, last = list(times), [], known
        plans = {name: plan(name, values, len(times)) for name, values in inputs.items()}
        for k, when in enumerate(times):
            named = self._named({name: float(values[k]) for name, values in plans.items()})
            if when == t:  # the last sample itself: where sensors are that move is known
                named = {**last, **{name: v for name, v in named.items() if not np.isnan(v)}}
            last, _ = self.filled(named, last)
            planned.append(last)
        return planned


def _row(names: Sequence[str], values: Mapping[str, float]) -> Array:
    """Return the values of some names as an array, NaN where there is none."""
    return np.array(list(map(values.get, names, repeat(math.nan))))
