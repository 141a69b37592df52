"""From one sample to the next, for all members at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.fem import Inputs, Moment
from livepde.linalg import Array, Mask
from livepde.stepping import Interval

__all__ = ["Span"]


@dataclass(frozen=True, eq=False)
class Span:
    """The interval of each member: they end together, and mostly begin together.

    Attributes
    ----------
    t0, t1
        Time of the last accepted sample of each member, shape (members,), and of this one.
    channels
        Names of the input channels.
    inputs0, inputs1
        Their values at both ends, shape (members, channels).
    z0, z1
        Measurements at both ends, shape (members, sensors), NaN where missing.
    """

    t0: Array
    t1: float
    channels: tuple[str, ...]
    inputs0: Array
    inputs1: Array
    z0: Array
    z1: Array

    def __len__(self) -> int:
        return len(self.t0)

    def inputs(self, values: Array) -> Inputs:
        """Return values of all channels, shape (channels,), by name."""
        return Inputs(dict(zip(self.channels, values.tolist(), strict=True)))

    def end(self, k: int) -> Moment:
        """Return time and inputs of a member at the end."""
        return Moment(self.t1, self.inputs(self.inputs1[k]))

    def member(self, k: int) -> Interval:
        """Return the interval of one member."""
        ends = self.inputs(self.inputs0[k]), self.inputs(self.inputs1[k])
        return Interval(float(self.t0[k]), self.t1, *ends, self.z0[k], self.z1[k])

    def at(self, t: float) -> Array:
        """Return the inputs at t of members that begin together, shape (members, channels)."""
        if t == self.t1:
            return self.inputs1
        s = (t - self.t0[:, None]) / (self.t1 - self.t0[:, None])
        mixed: Array = (1 - s) * self.inputs0 + s * self.inputs1
        return mixed

    @property
    def together(self) -> Mask:
        """Members that begin where most do, shape (members,)."""
        times, counts = np.unique(self.t0, return_counts=True)
        most: Mask = self.t0 == times[np.argmax(counts)]
        return most
