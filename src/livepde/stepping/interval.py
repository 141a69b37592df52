"""Sample intervals of one process and of many: times, inputs and measurements at both ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from livepde.fem import Inputs, Moment
from livepde.linalg import Array, IntArray, Mask

__all__ = ["End", "Interval", "Moments", "Span", "own_noise"]

NO_INPUTS = np.zeros((1, 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class End:
    """What is known at one end of a sample interval.

    Attributes
    ----------
    t, inputs, z
        Time, input channels, and measurements, shape (sensors,), NaN where missing.
    noise, gaps
        As of an `Interval` that ends here.
    """

    t: float
    inputs: Mapping[str, float]
    z: Array
    noise: Array | None = None
    gaps: Mapping[str, tuple[float, bool]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Interval:
    """A sample interval, with inputs and measurements interpolated linearly.

    Attributes
    ----------
    t0, t1
        Times of the last accepted sample and of this one.
    inputs0, inputs1
        Input channels at both ends.
    z0, z1
        Measurements at both ends, shape (sensors,), NaN where missing.
    noise
        Standard deviation of each value of z1, shape (sensors,), NaN for the default of the sensor;
        None if all are defaults.
    gaps
        Channel held at either end -> duration of the gap before, and whether it lasts at the end.
    """

    t0: float
    t1: float
    inputs0: Mapping[str, float]
    inputs1: Mapping[str, float]
    z0: Array
    z1: Array
    noise: Array | None = None
    gaps: Mapping[str, tuple[float, bool]] = field(default_factory=dict)

    @classmethod
    def between(cls, start: End, stop: End) -> Interval:
        """Return the interval from one end to another; of no length if both are the same."""
        return cls(
            t0=start.t,
            t1=stop.t,
            inputs0=start.inputs,
            inputs1=stop.inputs,
            z0=start.z,
            z1=stop.z,
            noise=stop.noise,
            gaps=stop.gaps,
        )

    def _weight(self, t: float) -> float:
        return (t - self.t0) / (self.t1 - self.t0)

    def at(self, t: float) -> Moment:
        """Return time and inputs at t."""
        if t == self.t1:
            return self.end
        if self.inputs0 is self.inputs1:
            return Moment(t, self.end.inputs)
        s = self._weight(t)
        mixed = {k: (1 - s) * self.inputs0[k] + s * v for k, v in self.inputs1.items()}
        return Moment(t, Inputs(mixed))

    @cached_property
    def end(self) -> Moment:
        """Time and inputs at the end."""
        return Moment(self.t1, Inputs(self.inputs1))

    @property
    def silent(self) -> Interval:
        """Copy of the interval without a measurement at the end."""
        return replace(self, z1=np.full_like(self.z1, np.nan))

    @cached_property
    def present(self) -> Array:
        """Mask of the sensors with a value at the end, shape (sensors,)."""
        return np.isfinite(self.z1)

    def z(self, t: float) -> Array:
        """Return measurements interpolated at t; where the value at t0 is missing, those of t1."""
        if t == self.t1:
            return self.z1
        s = self._weight(t)
        start = np.where(np.isfinite(self.z0), self.z0, self.z1)
        return (1 - s) * start + s * self.z1

    def change(self, start: float, stop: float) -> Array:
        """Return the change of z between two times; zero where z is missing at t0."""
        share = (stop - start) / (self.t1 - self.t0)
        change: Array = share * (self.z1 - self.z0)
        change[np.isnan(change)] = 0.0
        return change


def own_noise(noise: ArrayLike) -> Array | None:
    """Return noise standard deviations of readings; None if all are sensor defaults (NaN)."""
    found: Array = np.asarray(noise, dtype=float)
    return None if np.isnan(found).all() else found


class Moments(NamedTuple):
    """One time, with the input channels of each member.

    Attributes
    ----------
    t
        The time.
    channels
        Names of the channels.
    inputs
        Their values, shape (members, channels), or (1, channels) if they are the same for all.
    interval
        Interval of a single process that holds the time; None for members of a fleet.
    """

    t: float
    channels: tuple[str, ...]
    inputs: Array
    interval: Interval | None = None

    def member(self, k: int) -> Moment:
        """Return the moment of one member."""
        if self.interval is not None:
            return self.interval.at(self.t)
        row = self.inputs[k if len(self.inputs) > 1 else 0]
        return Moment(self.t, Inputs(dict(zip(self.channels, row.tolist(), strict=True))))


@dataclass(frozen=True, eq=False, kw_only=True)
class Span:
    """Sample intervals of all members, with a common end.

    Attributes
    ----------
    t0, t1
        Time of the last accepted sample of each member, shape (members,), and of this one.
    channels
        Names of the input channels.
    inputs0, inputs1
        Their values at both ends, shape (members, channels), or (1, channels) if the same for all.
    z0, z1
        Measurements at both ends, shape (members, sensors), NaN where missing; or (1, sensors).
    interval
        Interval of a single process; None for members of a fleet.
    noise
        Standard deviation of each value of z1, of its shape, NaN for the default of the sensor;
        None if all are defaults.
    gaps
        Duration of the gap of each channel before this interval, and 1 if it lasts at its end,
        shape (members, 2, channels) or (1, 2, channels); None without a gap.
    """

    t0: Array
    t1: float
    channels: tuple[str, ...]
    inputs0: Array
    inputs1: Array
    z0: Array
    z1: Array
    interval: Interval | None = None
    noise: Array | None = None
    gaps: Array | None = None

    @classmethod
    def of(cls, interval: Interval, channels: tuple[str, ...]) -> Span:
        """Return the span of one interval, common to all members."""
        first = last = NO_INPUTS
        if channels:
            last = np.array([list(map(interval.inputs1.__getitem__, channels))])
            first = last
            if interval.inputs0 is not interval.inputs1:
                first = np.array([list(map(interval.inputs0.__getitem__, channels))])
        gaps = None
        if interval.gaps:
            gaps = np.array([interval.gaps.get(name, (0.0, False)) for name in channels]).T[None]
        return cls(
            t0=np.array([interval.t0]),
            t1=interval.t1,
            channels=channels,
            inputs0=first,
            inputs1=last,
            z0=interval.z0[None],
            z1=interval.z1[None],
            interval=interval,
            noise=None if interval.noise is None else interval.noise[None],
            gaps=gaps,
        )

    def __len__(self) -> int:
        return len(self.t0)

    @property
    def start(self) -> float:
        """Most frequent start time of the members."""
        first = float(self.t0[0])
        if len(self.t0) == 1 or (self.t0 == first).all():
            return first
        times, counts = np.unique(self.t0, return_counts=True)
        return float(times[np.argmax(counts)])

    @property
    def together(self) -> Mask:
        """Mask of the members that start at `start`, shape (members,)."""
        most: Mask = self.t0 == self.start
        return most

    @property
    def present(self) -> Mask:
        """Mask of members with a measurement at the end, shape (members,) or (1,)."""
        given = np.isfinite(self.z1)
        if np.count_nonzero(given) == given.size:
            return np.ones(len(given), dtype=bool)
        return np.asarray(given.any(axis=1))

    def at(self, t: float) -> Moments:
        """Return time and inputs at t of members with a common start."""
        mixed = self.inputs1
        # The same object at both ends says that inputs are held: no interpolation.
        if t != self.t1 and self.inputs0 is not mixed:
            s = (t - self.start) / (self.t1 - self.start)
            mixed = (1 - s) * self.inputs0 + s * mixed
        return Moments(t=t, channels=self.channels, inputs=mixed, interval=self.interval)

    @property
    def end(self) -> Moments:
        """Time and inputs at the end."""
        return Moments(
            t=self.t1, channels=self.channels, inputs=self.inputs1, interval=self.interval
        )

    def part(self, group: IntArray) -> Span:
        """Return the span of some members."""

        def some(values: Array) -> Array:
            return values[group] if len(values) > 1 else values

        parts = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays = {name: some(part) for name, part in parts.items() if isinstance(part, np.ndarray)}
        if self.inputs0 is self.inputs1:  # the same object says that inputs are held
            arrays["inputs0"] = arrays["inputs1"]
        return Span(**(parts | arrays))

    def member(self, k: int) -> Interval:
        """Return the interval of one member."""
        if self.interval is not None:
            return self.interval
        first, last = (
            Inputs(dict(zip(self.channels, inputs[k].tolist(), strict=True)))
            for inputs in (self.inputs0, self.inputs1)
        )
        gaps = {}
        if self.gaps is not None:
            each = zip(self.channels, *self.gaps[k].tolist(), strict=True)
            gaps = {name: (held, again > 0.0) for name, held, again in each if held or again}
        return Interval(
            t0=float(self.t0[k]),
            t1=self.t1,
            inputs0=first,
            inputs1=last,
            z0=self.z0[k],
            z1=self.z1[k],
            noise=None if self.noise is None else self.noise[k],
            gaps=gaps,
        )
