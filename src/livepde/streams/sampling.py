"""Leaps of time in a table: clocks that were set, units that changed, and pauses of a logger."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array

FACTORS = {1000.0: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds", 60.0: "sixtieths"}
"""Factor of later times -> their likely unit, where those before are seconds."""
NEAR = 3.0  # usual intervals between times before and after, once the unit is the same
SURE = 5.0  # logarithm of the odds that readings continue as after one usual interval
EACH = 0.7  # of it, at least, per channel
FEWEST = 20  # rows before a leap, and differences over its length


@dataclass(frozen=True)
class ClockLeap:
    """A step of time after which the readings continue as if almost no time had passed.

    Attributes
    ----------
    row
        Number of the first sample after it.
    t, length, usual
        Its time, the step, and the usual step before.
    """

    row: int
    t: float
    length: float
    usual: float


def unit_factor(before: float, after: float, usual: float, later: float) -> float:
    """Return by which factor times count in another unit since a sample; 0: they do not.

    Divided by the factor, the later time follows the earlier one, and the later steps are as long
    as those before. A pause changes no later step.

    Parameters
    ----------
    before, after
        Times before and after a pause.
    usual, later
        Usual steps of time before and after it; NaN where none is known.

    >>> unit_factor(2990.0, 3.0e6, 10.0, 1e4), unit_factor(2990.0, 3.0e6, 10.0, 10.0)
    (1000.0, 0.0)
    """
    for factor in FACTORS:
        follows = 0.0 < after / factor - before <= NEAR * usual
        if follows and usual / NEAR <= later / factor <= NEAR * usual:
            return factor
    return 0.0


def clock_leaps(t: Array, values: Array, rows: list[int]) -> list[ClockLeap]:
    """Return the pauses in which the readings did not go on: the clock leapt.

    The change of each channel across the step is compared with changes over one usual step, and
    over as many usual steps as the time says. If it is much likelier as the former, no time passed.

    Parameters
    ----------
    t, values
        Times, and values of the channels, shapes (samples,) and (samples, channels).
    rows
        Samples that end a pause: `livepde.laws.filter_state.pauses`.
    """
    found = []
    for k in rows:
        usual = float(np.median(np.diff(t[:k])))
        lag = round((t[k] - t[k - 1]) / usual)
        logs = [_odds(column, k, lag) for column in values.T]
        known = [log for log in logs if np.isfinite(log)]
        if known and sum(known) > SURE and sum(known) > EACH * len(known):
            found.append(ClockLeap(k, float(t[k]), float(t[k] - t[k - 1]), usual))
    return found


def _odds(x: Array, k: int, lag: int) -> float:
    """Return the log odds of a change as one of a step to one of `lag` steps; NaN if unknown."""
    before = x[:k]
    if k < FEWEST or not np.isfinite(x[k] - x[k - 1]):
        return float("nan")
    lag = min(lag, k - FEWEST // 2)  # over a longer time the changes are no smaller
    changes = [np.square(before[m:] - before[:-m]) for m in (1, max(lag, 1))]
    if any(np.isnan(each).all() for each in changes):
        return float("nan")
    one, many = map(np.nanmean, changes)
    if not (one > 0.0 and many > one):
        return 0.0
    d = float(x[k] - x[k - 1]) ** 2
    return 0.5 * float(np.log(many / one) - d / one + d / many)
