"""Batched sample intervals: times, inputs and measurements of all members."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from livepde.fem import Inputs, Moment
from livepde.linalg import Array, Mask
from livepde.stepping.interval import Interval

NO_INPUTS = np.zeros((1, 0))

__all__ = ["Moments", "Span"]


@dataclass(frozen=True, eq=False)
class Moments:
    """One time, with the input channels of each member.

    Attributes
    ----------
    t
        The time.
    channels
        Names of the channels.
    inputs
        Their values, shape (members, channels), or (1, channels) if they are the same for all.
    """

    t: float
    channels: tuple[str, ...]
    inputs: Array
    moment: Moment | None = None

    def member(self, k: int) -> Moment:
        """Return the moment of one member."""
        if self.moment is not None:
            return self.moment
        row = self.inputs[k if len(self.inputs) > 1 else 0]
        return Moment(self.t, Inputs(dict(zip(self.channels, row.tolist(), strict=True))))


@dataclass(frozen=True, eq=False)
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
            last = np.array([[interval.inputs1[name] for name in channels]])
            first = last
            if interval.inputs0 is not interval.inputs1:
                first = np.array([[interval.inputs0[name] for name in channels]])
        t0, z0, z1 = np.array([interval.t0]), interval.z0[None], interval.z1[None]
        noise = None if interval.noise is None else interval.noise[None]
        gaps = None
        if interval.gaps:
            gaps = np.array([interval.gaps.get(name, (0.0, False)) for name in channels]).T[None]
        return cls(t0, interval.t1, channels, first, last, z0, z1, interval, noise, gaps)

    def __len__(self) -> int:
        return len(self.t0)

    @cached_property
    def start(self) -> float:
        """Most frequent start time of the members."""
        if len(self.t0) == 1:
            return float(self.t0[0])
        times, counts = np.unique(self.t0, return_counts=True)
        return float(times[np.argmax(counts)])

    @property
    def together(self) -> Mask:
        """Mask of the members that start at `start`, shape (members,)."""
        most: Mask = self.t0 == self.start
        return most

    @cached_property
    def present(self) -> Mask:
        """Mask of members with a measurement at the end, shape (members,) or (1,)."""
        some: Mask = np.asarray(np.isfinite(self.z1).any(axis=1))
        return some

    def at(self, t: float) -> Moments:
        """Return time and inputs at t of members with a common start."""
        if t == self.t1:
            return self.end
        moment = None if self.interval is None else self.interval.at(t)
        mixed = self.inputs1
        # The same object at both ends says that inputs are held: no interpolation.
        if self.inputs0 is not mixed:
            s = (t - self.start) / (self.t1 - self.start)
            mixed = (1 - s) * self.inputs0 + s * mixed
        return Moments(t, self.channels, mixed, moment)

    @cached_property
    def end(self) -> Moments:
        """Time and inputs at the end."""
        moment = None if self.interval is None else self.interval.end
        return Moments(self.t1, self.channels, self.inputs1, moment)

    def member(self, k: int) -> Interval:
        """Return the interval of one member."""
        if self.interval is not None:
            return self.interval
        first, last = (
            Inputs(dict(zip(self.channels, inputs[k].tolist(), strict=True)))
            for inputs in (self.inputs0, self.inputs1)
        )
        noise = None if self.noise is None else self.noise[k]
        gaps = {}
        if self.gaps is not None:
            each = zip(self.channels, *self.gaps[k].tolist(), strict=True)
            gaps = {name: (held, again > 0.0) for name, held, again in each if held or again}
        z0, z1 = self.z0[k], self.z1[k]
        return Interval(float(self.t0[k]), self.t1, first, last, z0, z1, noise, gaps)
