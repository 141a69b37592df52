"""Wild readings: a value such as 9999 far outside all that has been measured.

For laws without a covariance, which cannot weigh an innovation. A wild value is not used, unless
the readings of its sensor stay there: then the process has moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import Interval

ABSURD = 10.0  # ranges outside of the past, as in the gate of `SensitivityLaw`
MOVED = 20.0  # standard deviations of the noise: a smaller range does not show the process's size
SETTLED = 20  # readings of a sensor before which its range is not known
PATIENCE = 3  # wild readings in a row, after which the process has moved


@dataclass(frozen=True, eq=False)
class ReadingRange:
    """Range of the readings of each sensor, shapes (sensors,)."""

    # Range of the readings that were used; NaN before any.
    low: Array
    high: Array
    count: IntArray  # number of readings that were used, at most `SETTLED`
    wild: IntArray  # wild readings in a row; of a sensor whose last reading was used 0

    @classmethod
    def start(cls, sensors: int) -> ReadingRange:
        """Return the value before any reading."""
        never, none = np.full(sensors, np.nan), np.zeros(sensors, dtype=np.int64)
        return cls(low=never, high=never, count=none, wild=none)

    def screened(self, interval: Interval, noise: Array | None) -> tuple[Interval, ReadingRange]:
        """Return an interval without wild readings at both ends, and the value after it."""
        z = interval.z1
        wild = self._wild(z, 0.0 if noise is None else MOVED * noise)
        before = self.wild > 0
        lasting = wild & (self.wild >= PATIENCE)
        wild &= ~lasting
        used = np.where(wild, np.nan, z)
        present = np.isfinite(used)
        after = ReadingRange(
            low=np.fmin(self.low, used),
            high=np.fmax(self.high, used),
            count=np.minimum(self.count + present, SETTLED),
            wild=np.where(wild, self.wild + 1, np.where(present, 0, self.wild)),
        )
        if not (wild.any() or before.any()):
            return interval, after
        z0 = np.where(before, np.nan, interval.z0)
        return replace(interval, z0=z0, z1=used), after

    def _wild(self, z: Array, least: float | Array) -> Mask:
        """Return which readings are far outside their past and that of the other sensors."""
        known = self.count >= SETTLED
        none: Mask = np.zeros(len(z), dtype=bool)
        if not known.any():
            return none
        # A process that begins to move is seen by one sensor first: the scale is that of all.
        scale = np.maximum(np.nanmax(self.high) - np.nanmin(self.low), least)
        with np.errstate(invalid="ignore"):
            far: Mask = (z > self.high + ABSURD * scale) | (z < self.low - ABSURD * scale)
        return known & far & (scale > 0.0)
