"""Count of input values that were held because a sample had none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array, IntArray
from livepde.verdict.findings import Finding
from livepde.verdict.shifts import Shifts

__all__ = ["InputLedger"]

HELD = 0.02  # share of the samples in which the last value of an input was held


@dataclass(frozen=True, eq=False)
class InputLedger:
    """Gaps of the input channels so far.

    Attributes
    ----------
    counts
        Number of samples, and of those in which each channel was held, shape (1 + channels,).
    held
        Time for which each channel has been held by now, shape (channels,); 0 if it has a value.
    """

    counts: IntArray
    held: Array

    @classmethod
    def start(cls, channels: int) -> InputLedger:
        """Return the value before any sample."""
        return cls(np.zeros(1 + channels, dtype=np.int64), np.zeros(channels))

    def add(self, length: float, missing: Array) -> InputLedger:
        """Return the value after an interval; `missing`: 1 for channels that are held at its end.

        The interval in which a channel has a value again is no gap: there the value changes.
        """
        counts = self.counts.copy()
        counts[0] += 1  # of all samples
        counts[1:] += missing > 0.0
        return InputLedger(counts, (self.held + length) * missing)

    def gaps(self, names: Sequence[str], missing: Array) -> dict[str, tuple[float, bool]]:
        """Return for how long channels were held by now, and whether they are once more."""
        each = zip(names, self.held.tolist(), (missing > 0.0).tolist(), strict=True)
        return {name: (held, again) for name, held, again in each if held or again}

    def findings(self, names: Sequence[str], shifts: Shifts[float]) -> Iterator[Finding]:
        """Return which channels were held in more than 2 % of the samples.

        Parameters
        ----------
        shifts
            Of the estimate, with the shift of each unknown by its inputs.
        """
        samples = max(int(self.counts[0]), 1)
        each = shifts.by("input").items()
        by = ", ".join(f"{label} by {-shift:+.2g}" for label, shift in each)
        moved = (
            f" Straight lines across the gaps would move the estimates roughly so: {by}."
            if by
            else " By how much that moves the estimates is not known."
        )
        for name, count in zip(names, self.counts[1:].tolist(), strict=True):
            share = count / samples
            if share <= HELD:
                continue
            text = (
                f"Channel {name} had no value in {count} of {samples} samples, and its last one "
                f"was held.{moved}"
            )
            remedy = f"Interpolate {name} where the next value is known, or read it more often."
            yield Finding("input", "caution", text, name, share, remedy=remedy)
