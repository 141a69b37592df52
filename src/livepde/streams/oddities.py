"""Detection of anomalies in a table: placeholders, switches, clock leaps, outlying first rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from livepde.linalg import Array, IntArray, Mask
from livepde.streams.gaps import SHORT

# Sentinels. DS18B20: 85 at power-on, -127 without an answer; databases: nines, limits of types.
NINES = (999.0, 9999.0, 99999.0, 99.9, 999.9, 9999.9, 6999.0, 7999.0)
KNOWN = {-127.0, 85.0, 32767.0, -32768.0, 65535.0, *NINES, *(-x for x in NINES)}
REPEATED = 3  # smallest number of occurrences of other constants
NEAR_KNOWN = 0.5  # smallest distance of a known sentinel from the range of the rest, in ranges
FAR_OTHER = 1.0  # smallest distance of other constants from this range, in ranges
OTHERS = 8  # smallest number of other values, and of their levels for other constants
MOST_SENTINELS = 4  # largest number of sentinels in a column
# Switches:
SWITCHED = 4  # smallest number of known values
LEVELS = 3  # largest number of distinct values of a switch with few levels
STAYS = 0.75  # smallest share of values that repeat the value before
UNEVEN = 2.0  # largest over smallest jump, which are almost equal for a coarse resolution
# Leaps of the clock:
FACTORS = {1000.0: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds", 60.0: "sixtieths"}
"""Factor of later times -> their likely unit if earlier times are in seconds."""
ALIKE = 3.0  # largest ratio of steps before and after a change of the unit, after conversion
SURE = 5.0  # smallest log odds, over all channels, that one usual interval has passed
EACH = 0.7  # smallest mean of these log odds per channel
BEFORE = 20  # smallest number of rows before a leap
# First rows:
BEGINNING = 3  # largest number of outlying rows at the start
FOLLOWING = 20  # number of following values that show how a channel usually changes
FEWEST_FOLLOWING = 3  # smallest number of following values
STEEPER = 10.0  # ratio of a leap's rate of change to the largest rate of the following values


class Sentinel(NamedTuple):
    """A possible placeholder for missing readings: value, occurrences, and range of the rest."""

    value: float
    times: int
    low: float
    high: float


def sentinels(values: Array, constants: bool = True) -> list[Sentinel]:
    """Return the values of a column that may be placeholders.

    Without `constants`, only known sentinels count. A constant of a power or a flow may be a state,
    such as off.

    >>> [found.value for found in sentinels(np.array([20.0, 21, 22, 21, 20, 22, 21, 23, -127]))]
    [-127.0]
    """
    rest, found = values[np.isfinite(values)], list[Sentinel]()
    while len(rest) and len(found) < MOST_SENTINELS:
        # The end of the range with the larger distance from the median comes first.
        ends = np.array([rest.min(), rest.max()])
        ends = ends[np.argsort(-np.abs(ends - np.median(rest)), kind="stable")]
        one = next(filter(None, (_at(rest, end, constants) for end in ends.tolist())), None)
        if one is None:
            break
        found.append(one)
        rest = rest[rest != one.value]
    # All sentinels have the range of the values that remain at the end.
    return [one._replace(low=float(rest.min()), high=float(rest.max())) for one in found]


def _at(values: Array, end: float, constants: bool) -> Sentinel | None:
    """Return the sentinel at an end of the range, or None if this value is not a sentinel."""
    rest = values[values != end]
    count = len(values) - len(rest)
    known = end in KNOWN
    if len(rest) < OTHERS or not (known or (constants and count >= REPEATED)):
        return None
    # A channel with few levels, such as a pump, consists of constants.
    if not known and len(np.unique(rest)) < OTHERS:
        return None
    low, high = float(rest.min()), float(rest.max())
    beyond = max(low - end, end - high)
    # If the rest is constant, there is no range to compare with.
    if not 0.0 < (high - low) * (NEAR_KNOWN if known else FAR_OTHER) < beyond:
        return None
    return Sentinel(end, count, low, high)


def switches(t: Array, x: Array, off: bool = False) -> bool:
    """Return whether a column is piecewise constant, with jumps that are not recorded as two rows.

    If the quantity can be `off`, one constant far from all other values is sufficient. Jumps of
    equal size between many levels are due to the resolution of a measured value. Jumps between two
    rows that are a moment apart are excluded, since both rows define such a jump.

    >>> t = np.arange(8.0)
    >>> switches(t, np.array([0.0, 0, 8, 8, 8, 8, 0, 0]))
    True
    >>> switches(t, np.array([20.0, 20.1, 20.3, 20.2, 20.5, 20.6, 20.9, 21.0]))
    False
    """
    known, rows = np.isfinite(x), len(x)
    t, x = t[known], x[known]
    if len(x) < SWITCHED:
        return False
    steps, jumps = np.diff(t), np.abs(np.diff(x))
    jumped = jumps > 0.0
    if not jumped.any() or (steps[jumped] < SHORT * np.median(steps)).all():
        return False
    if off and any(one.value not in KNOWN for one in sentinels(x)):
        return True
    sizes, repeats = jumps[jumped], float(np.mean(~jumped))
    uneven = float(sizes.max()) > UNEVEN * float(sizes.min())
    return (repeats >= STAYS and uneven) or _of_few_levels(x, rows, repeats)


def _of_few_levels(x: Array, rows: int, repeats: float) -> bool:
    """Return whether values switch between few levels.

    `rows`: number of rows of the table. `repeats`: share of values equal to the value before.
    """
    levels = len(np.unique(x))
    # In a log of changes, few rows have a value, and none repeats the value before.
    changes = repeats == 0.0 and levels < len(x) <= (1.0 - STAYS) * rows
    return levels <= LEVELS and (repeats >= STAYS or len(x) >= SWITCHED * levels or changes)


def unit_factor(before: float, after: float, usual: float, later: float) -> float:
    """Return the factor by which the unit of times has changed at a sample; 0 if it has not.

    After division by the factor, the later time follows the earlier one, and later steps have the
    length of earlier steps. A pause alone does not change later steps. `usual`, `later`: usual
    steps before and after the sample, NaN if unknown.

    >>> unit_factor(2990.0, 3.0e6, 10.0, 1e4), unit_factor(2990.0, 3.0e6, 10.0, 10.0)
    (1000.0, 0.0)
    """
    for factor in FACTORS:
        follows = 0.0 < after / factor - before <= ALIKE * usual
        if follows and usual / ALIKE <= later / factor <= ALIKE * usual:
            return factor
    return 0.0


def clock_leaps(t: Array, values: Array, rows: list[int]) -> list[float]:
    """Return the ends of pauses that are leaps of the clock: readings continue without a pause.

    The change of each channel across a pause is compared with its changes over one usual step, and
    over as many usual steps as the length of the pause. If the change is much more likely over one
    step, the clock has leapt.
    `rows` are the samples that end a pause; `values` have the shape (samples, channels).
    """
    found = []
    for k in rows:
        usual = float(np.median(np.diff(t[:k])))
        lag = round((t[k] - t[k - 1]) / usual)
        logs = [_odds(column, k, lag) for column in values.T]
        known = [log for log in logs if np.isfinite(log)]
        if known and sum(known) > SURE and sum(known) > EACH * len(known):
            found.append(float(t[k]))
    return found


def _odds(x: Array, k: int, lag: int) -> float:
    """Return the log odds that a change took one step instead of `lag` steps; NaN if unknown."""
    before = x[:k]
    if k < BEFORE or not np.isfinite(x[k] - x[k - 1]):
        return float("nan")
    lag = min(lag, k - BEFORE // 2)  # conservative: changes over longer lags are larger
    changes = [np.square(before[m:] - before[:-m]) for m in (1, max(lag, 1))]
    if any(np.isnan(each).all() for each in changes):
        return float("nan")
    one, many = map(np.nanmean, changes)
    if not (one > 0.0 and many > one):
        return 0.0
    d = float(x[k] - x[k - 1]) ** 2
    return 0.5 * float(np.log(many / one) - d / one + d / many)


def wild_first_rows(t: Array, values: Array, groups: Sequence[Sequence[int]]) -> Mask:
    """Return which values of the first rows are outliers, shape (rows, channels).

    A sensor may send a default before its first conversion, which must not affect the initial
    state. The first values of a channel are outliers if the step to the next value is more than
    `STEEPER` times as steep as any in the `FOLLOWING` values, and if they are outside the range of
    these and of the first values of the group's other channels by more than this range.
    Each group has the channels of one quantity in one unit; other channels are not judged.
    """
    wild = np.zeros(values.shape, dtype=bool)
    # Differences of very large outliers may overflow to infinity, which compares correctly.
    with np.errstate(over="ignore"):
        for group in groups:
            leaps = {k: _leap(t, values[:, k]) for k in group}
            calm = (values[:, k] for k in group if not len(leaps[k]))
            peers = np.concatenate([np.zeros(0), *(x[np.isfinite(x)][:1] for x in calm)])
            for k, rows in leaps.items():
                if len(rows) and _outside(values[:, k], rows, peers):
                    wild[rows, k] = True
    return wild


def _leap(t: Array, x: Array) -> IntArray:
    """Return the first rows of a channel that are separated from the rest by a leap, or none."""
    (known,) = np.isfinite(x[: BEGINNING + FOLLOWING + 1]).nonzero()
    for count in range(1, BEGINNING + 1):
        tail = known[count:][:FOLLOWING]
        if len(tail) < FEWEST_FOLLOWING or known[0] >= BEGINNING:
            break
        rates = np.abs(np.diff(x[tail]) / np.diff(t[tail])).max()
        last, then = known[count - 1], tail[0]
        step = abs(x[then] - x[last])
        if step > STEEPER * rates * (t[then] - t[last]) and _outside(x, known[:count], np.zeros(0)):
            return known[:count]
    return known[:0]


def _outside(x: Array, rows: IntArray, peers: Array) -> bool:
    """Return whether values are outside the range of later values and peers by more than it."""
    following = x[rows[-1] + 1 :]
    following = following[np.isfinite(following)][:FOLLOWING]
    around = np.concatenate([following, peers])
    low, high = around.min(), around.max()
    beyond = np.maximum(low - x[rows], x[rows] - high)
    return bool((beyond > high - low).all())
