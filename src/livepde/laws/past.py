"""What a filter keeps of the past: samples to run through again, and where to go back to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from livepde.fem import Inputs
from livepde.laws.filter import Point
from livepde.linalg import Array
from livepde.stepping import Interval

__all__ = ["Past", "Samples"]


@dataclass(frozen=True, eq=False)
class Samples:
    """Stored samples since the start of the window, in time order.

    Attributes
    ----------
    t, z, inputs
        Shapes (count + 1,), (count + 1, sensors), (count + 1, channels); first row: the start,
        with what was assimilated there.
    """

    t: Array
    z: Array
    inputs: Array

    @classmethod
    def empty(cls, sensors: int, channels: int) -> Samples:
        """Return no samples."""
        return cls(np.zeros(0), np.zeros((0, sensors)), np.zeros((0, channels)))

    def add(self, interval: Interval, channels: tuple[str, ...]) -> Samples:
        """Return the samples with that at the end of an interval; the first brings the start."""
        samples = self
        if not len(self.t) and interval.t1 > interval.t0:
            nothing = np.full_like(interval.z1, np.nan)
            samples = samples._append(interval.t0, nothing, interval.inputs0, channels)
        return samples._append(interval.t1, interval.z1, interval.inputs1, channels)

    def _append(
        self, t: float, z: Array, inputs: Mapping[str, float], channels: tuple[str, ...]
    ) -> Samples:
        row = [[inputs[c] for c in channels]]
        return Samples(
            np.concatenate((self.t, [t])),
            np.concatenate((self.z, [z])),
            np.concatenate((self.inputs, row)),
        )

    def since(self, first: int) -> Samples:
        """Return the samples from one on, which is the start of them."""
        z = self.z[first:].copy()
        z[:1] = np.nan
        return Samples(self.t[first:], z, self.inputs[first:])

    def first(self, channels: tuple[str, ...]) -> Interval:
        """Return what was measured at the start, as an interval without length."""
        inputs = Inputs(dict(zip(channels, self.inputs[0].tolist(), strict=True)))
        return Interval(self.t[0], self.t[0], inputs, inputs, self.z[0], self.z[0])

    def intervals(self, channels: tuple[str, ...]) -> list[Interval]:
        """Return the intervals between them, in time order."""
        named = [Inputs(dict(zip(channels, row.tolist(), strict=True))) for row in self.inputs]
        return [
            Interval(self.t[k - 1], self.t[k], named[k - 1], named[k], self.z[k - 1], self.z[k])
            for k in range(1, len(self.t))
        ]


@dataclass(frozen=True, eq=False)
class Past:
    """Two filters of before, and the samples since: what a law can go back to.

    Attributes
    ----------
    older, newer
        The filter at the start of `samples`, and after `between` of them.
    """

    older: Point
    newer: Point
    between: int
    samples: Samples

    @classmethod
    def start(cls, point: Point, samples: Samples) -> Past:
        """Return a past that begins now; of `samples` none is kept."""
        return cls(point, point, 0, samples.since(len(samples.t)))

    @property
    def count(self) -> int:
        """Number of samples since the older filter."""
        return max(len(self.samples.t) - 1, 0)

    def add(self, point: Point, interval: Interval, channels: tuple[str, ...], length: int) -> Past:
        """Return the past after a sample: the older filter is `length` to 2 `length` - 1 ago."""
        samples = self.samples.add(interval, channels)
        past = replace(self, samples=samples)
        if past.count - self.between < length:
            return past
        return Past(self.newer, point, past.count - self.between, samples.since(self.between))
