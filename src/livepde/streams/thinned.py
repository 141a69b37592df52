"""Thinning of a stream that preserves switches of held inputs and means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from livepde.linalg import Array, Mask
from livepde.stepping import Between


class Thinned:
    """Keep every n-th row of a stream without losing a switch or a part of a mean.

    If a held input (`between = "hold"`) changes in a row that would be left out, the row is kept
    with only its held inputs. The same applies to a row with a `"next"` reading that lacks a needed
    channel. A `"next"` reading becomes the time-weighted mean since the last kept row.

    `between`: behaviour of each column between two readings.

    `held`: columns that are not a "line", shape (columns,).

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
        """Return the stride at which rows are read: 1 if rows may contain a switch or a mean."""
        return 1 if self.held.any() else every

    def remember(self, row: Array) -> None:
        """Store the held values of a row, such as a row before the start."""
        for k in self._hold:
            if math.isfinite(row[k]):
                self._last[k] = row[k]

    def take(self, t: float, row: Array, *, chosen: bool, whole: bool) -> Array | None:
        """Return the kept part of a row, NaN in missing columns; None if the row is left out.

        `chosen`: whether the row is one of every n rows.
        `whole`: whether the row has all needed channels.
        """
        for k, mean in self._means.items():
            mean.add(t, float(row[k]))
        kept = chosen and whole
        # Before the first kept row, held values are only stored for it.
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
        """Return whether a row changes a held input, or is chosen and ends a mean."""
        changed = any(math.isfinite(row[k]) and row[k] != self._last[k] for k in self._hold)
        return changed or (chosen and any(math.isfinite(row[k]) for k in self._means))


class _Mean:
    """Mean of the readings since the last `taken`, weighted by the time since each last reading.

    The time of a missing reading is added to the weight of the next reading.
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
