"""Running sums over channels outside the filter: inputs in gaps, and validation sensors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from livepde.linalg import Array, IntArray
from livepde.verdict.evidence import chance
from livepde.verdict.findings import FEWEST, Cause, Finding, Severity, channel_setting
from livepde.verdict.model_errors import FAILED, OF_SIGNAL
from livepde.verdict.sentences import FINDINGS, LIKELY, table_of
from livepde.verdict.shifts import Shifts

HELD = 0.02  # share of the samples in which the last value of an input was held
CHANCE = 5e-4  # probability of a false alarm of all withheld sensors of a run
SIMILAR = 0.05  # relative difference of a slope to that of a unit
UNITS = (
    ("degF", "degC", 1.8, 32.0),
    ("degC", "degF", 1.0 / 1.8, -32.0 / 1.8),
    ("K", "degC", 1.0, 273.15),
    ("degC", "K", 1.0, -273.15),
)
"""Unit that a sensor may have, the one that it is taken for, slope and intercept of that."""


@dataclass(frozen=True, eq=False)
class InputLedger:
    """Gaps of the input channels so far.

    Attributes
    ----------
    counts
        Number of samples, and of those in which each channel was held, shape (1 + channels,).
    held
        Time for which each channel has been held by now, shape (channels,); 0 if it has a value.
    unstated
        1 for each channel without a value at the initial time, whose first one was held over the
        first interval, shape (channels,).
    """

    counts: IntArray
    held: Array
    unstated: Array

    @classmethod
    def start(cls, channels: int) -> InputLedger:
        """Return the value before any sample."""
        none = np.zeros(channels)
        return cls(counts=np.zeros(1 + channels, dtype=np.int64), held=none, unstated=none)

    def add(self, length: float, missing: Array) -> InputLedger:
        """Return the value after an interval; `missing`: 1 for channels that are held at its end.

        The interval in which a channel has a value again is no gap: there the value changes.
        """
        counts = self.counts.copy()
        counts[0] += 1  # of all samples
        held = self.held
        if np.count_nonzero(missing) or np.count_nonzero(held):
            counts[1:] += missing > 0.0
            held = (held + length) * missing
        return InputLedger(counts, held, self.unstated)

    @property
    def silent(self) -> bool:
        """True if no channel was ever held."""
        return not (any(self.counts.tolist()[1:]) or any(self.unstated.tolist()))

    def gaps(self, names: Sequence[str], missing: Array) -> dict[str, tuple[float, bool]]:
        """Return for how long channels were held by now, and whether they are once more."""
        each = zip(names, self.held.tolist(), (missing > 0.0).tolist(), strict=True)
        return {name: (held, again) for name, held, again in each if held or again}

    def findings(self, names: Sequence[str], shifts: Shifts[float]) -> Iterator[Finding]:
        """Return which channels were held in more than 2 % of the samples, and which at the start.

        Parameters
        ----------
        shifts
            Of the estimate, with the shift of each unknown by its inputs.
        """
        samples = max(int(self.counts[0]), 1)
        each = shifts.by("input").items()
        by = ", ".join(f"{label} by {-shift:+.2g}" for label, shift in each)
        for name in itertools.compress(names, self.unstated.tolist()):
            text, remedy = FINDINGS["input, start"].filled(name=name)
            yield Finding("input", "note", text, name, remedy=remedy)
        for name, count in zip(names, self.counts[1:].tolist(), strict=True):
            share = count / samples
            if share <= HELD:
                continue
            sentence = FINDINGS["input, gaps" if by else "input, gaps, unknown shift"]
            text, remedy = sentence.filled(name=name, count=count, samples=samples, shifts=by)
            yield Finding("input", "caution", text, name, share, remedy=remedy)


@dataclass(frozen=True, eq=False)
class WithheldLedger:
    """Sums over the values of each withheld sensor, in constant memory.

    Attributes
    ----------
    sums
        Shape (9, sensors): number of values and of successive pairs; sums of half the squared
        difference of those, of squared errors, errors, predictions p, p p, p z, and of the variance
        that is predicted.
    last
        Last error of each sensor, shape (sensors,); NaN before.
    """

    sums: Array
    last: Array

    @classmethod
    def start(cls, sensors: int) -> WithheldLedger:
        """Return the value before any sample."""
        return cls(np.zeros((9, sensors)), np.full(sensors, np.nan))

    def add(self, z: Array, predicted: Array, variance: Array) -> WithheldLedger:
        """Return the value after a sample; z is NaN where missing.

        Parameters
        ----------
        variance
            Of the prediction, without noise, shape (sensors,).
        """
        error = z - predicted
        seen = np.isfinite(error)
        if not seen.any():
            return replace(self, last=np.full_like(self.last, np.nan))
        step = error - self.last
        pair = np.isfinite(step)
        rows = np.array(
            [
                np.ones_like(z),
                pair,
                np.where(pair, 0.5 * step**2, 0.0),
                error**2,
                error,
                predicted,
                predicted**2,
                predicted * z,
                variance,
            ],
            dtype=float,
        )
        return WithheldLedger(self.sums + np.where(seen, rows, 0.0), np.where(seen, error, np.nan))

    def findings(self, names: Sequence[str], ignored: Collection[str] = ()) -> Iterator[Finding]:
        """Return which sensors, but ignored ones, are missed by more than is allowed.

        That is prediction and noise.

        The errors of one sensor are correlated as far as they come from the unknowns: so their mean
        square over its expected value counts as one draw of chi-square. The noise is estimated from
        successive differences.
        """
        scored = len(names) - len(ignored)
        for k, name in enumerate(names):
            if name in ignored:
                continue
            count, pairs, differences, squares, errors, *_, variance = self.sums[:, k]
            if count < FEWEST:
                continue
            noise = differences / max(pairs, 1.0)
            expected = noise + variance / count
            ratio = squares / count / max(expected, 1e-300)
            p = min(1.0, chance(ratio, 1) * scored)
            if p > CHANCE:
                continue
            size, mean = math.sqrt(squares / count), errors / count
            text, _ = FINDINGS["withheld"].filled(
                name=name, size=size, mean=mean, ratio=math.sqrt(ratio)
            )
            likely, remedy = LIKELY["withheld"].filled(name=name)
            cause = self._unit(k, name) or Cause("withheld", name, likely, remedy=remedy)
            # A small error shows that the model is not exact, a gross one that it is wrong.
            gross = size > FAILED * math.sqrt(noise) and size > OF_SIGNAL * self._scatter(k)
            severity: Severity = "do not trust" if gross or cause.kind == "unit" else "caution"
            yield Finding("withheld", severity, text, name, p, "p-value", (cause,))

    def _scatter(self, k: int) -> float:
        """Return the standard deviation of the readings of a sensor."""
        count, _, _, squares, errors, p, pp, pz, _ = self.sums[:, k]
        mean = (errors + p) / count
        return math.sqrt(max((squares + 2.0 * pz - pp) / count - mean**2, 0.0))

    def _unit(self, k: int, name: str) -> Cause | None:
        """Return the cause that a sensor has another unit, if its values indicate that."""
        count, _, _, _, errors, p, pp, pz, _ = self.sums[:, k]
        mean_p, mean_z = p / count, (errors + p) / count
        spread = pp / count - mean_p**2
        if not spread > 0.0:
            return None
        slope = (pz / count - mean_p * mean_z) / spread
        rest = max(math.sqrt(spread), 1e-300)
        for unit, taken, scale, origin in UNITS:
            off = abs(mean_z - (scale * mean_p + origin))
            if abs(slope / scale - 1.0) < 4.0 * SIMILAR and off < rest:
                text, remedy = LIKELY["unit"].filled(
                    name=name, unit=unit, expected=taken, table=table_of(name)
                )
                setting = channel_setting(name, "unit", f'"{unit}"')
                return Cause("unit", name, text, remedy=remedy, setting=setting)
        return None
