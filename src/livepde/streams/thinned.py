"""Every n-th row of a stream, with the switches and the means that lie between."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from livepde.linalg import Array, Mask
from livepde.stepping import Between


class Thinned:
    """Every n-th row of a stream, without the loss of a switch or of a share of a mean.

    A row that would be left out stays as a row of its held inputs alone where one of them
    (`between = "hold"`) changes. So does a row with a `"next"` reading that lacks a channel that
    each sample needs. Such a reading becomes the mean, weighted by time, since the last row that
    stays.

    `between`: behaviour of each column between two readings.

    `held`: columns that are no "line", shape (columns,).

    >>> rows = Thinned(["line", "hold"])
    >>> rows.take(0.0, np.array([20.0, 1.0]), chosen=True, whole=True)
    array([20.,  1.])
    >>> rows.take(1.0, np.array([21.0, 0.0]), chosen=False, whole=True)
    array([nan,  0.])
    """

    def __init__(self, between: Sequence[Between]) -> None:
        self.held: Mask = np.array(between, dtype=str) != "line"
        self._hold = [k for k, one in enumerate(between) if one == "hold"]
        self._means = {k: _Mean() for k, one in enumerate(between) if one == "next"}
        self._last = np.full(len(between), math.nan)
        self._begun = False

    def stride(self, every: int) -> int:
        """Return the number of rows of which one is read: all where a row may hold a switch."""
        return 1 if self.held.any() else every

    def remember(self, row: Array) -> None:
        """Remember the values of a row before the start that hold until the next reading."""
        for k in self._hold:
            if math.isfinite(row[k]):
                self._last[k] = row[k]

    def take(self, t: float, row: Array, *, chosen: bool, whole: bool) -> Array | None:
        """Return the rest of a row, NaN where a column is missing; None if nothing is left.

        `chosen`: whether `every` leaves the row.
        `whole`: whether the row has all channels that a sample needs.
        """
        for k, mean in self._means.items():
            mean.add(t, float(row[k]))
        kept = chosen and whole
        # Before the first row that is kept, values are remembered for it.
        stays = kept or (self._begun and self._states(row, chosen))
        self.remember(row)
        if not stays:
            return None
        found: Array = row.copy() if kept else np.where(self.held, row, math.nan)
        if not self._begun:
            found[self._hold] = self._last[self._hold]
            self._begun = True
        for k, mean in self._means.items():
            found[k] = mean.taken() if math.isfinite(row[k]) else math.nan
        return found

    def _states(self, row: Array, chosen: bool) -> bool:
        """Return whether a row changes an input that holds, or has the end of a mean."""
        changed = any(math.isfinite(row[k]) and row[k] != self._last[k] for k in self._hold)
        return changed or (chosen and any(math.isfinite(row[k]) for k in self._means))


class _Mean:
    """Mean of the readings since it was last taken, each weighted by the time since the one before.

    A missing reading leaves its time to the next one.
    """

    def __init__(self) -> None:
        self._t = math.nan
        self._parts: list[tuple[float, float]] = []  # time and value

    def add(self, t: float, value: float) -> None:
        if math.isfinite(value):
            time = 0.0 if math.isnan(self._t) else t - self._t
            self._t = t
            self._parts.append((time, value))

    def taken(self) -> float:
        parts, self._parts = self._parts, []
        whole = sum(time for time, _ in parts)
        if len(parts) == 1 or whole == 0.0:
            return parts[-1][1]
        return sum(time * value for time, value in parts) / whole
