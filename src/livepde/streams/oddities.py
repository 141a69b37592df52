"""Oddities of a table: placeholders, switches, leaps of the clock, and wild first rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from livepde.linalg import Array, IntArray, Mask
from livepde.streams.gaps import SHORT

# Sentinels. DS18B20: 85 at power-on, -127 where nothing answers; databases: nines, ends of types.
NINES = (999.0, 9999.0, 99999.0, 99.9, 999.9, 9999.9, 6999.0, 7999.0)
KNOWN = {-127.0, 85.0, 32767.0, -32768.0, 65535.0, *NINES, *(-x for x in NINES)}
REPEATED = 3  # times that another constant occurs
NEAR_KNOWN = 0.5  # of the range of the rest: a known sentinel lies farther outside
FAR_OTHER = 1.0  # another constant lies farther outside than this
OTHERS = 8  # other values that show the range, and other levels of a constant
MOST_SENTINELS = 4  # sentinels of a column
# Switches:
SWITCHED = 4  # known values that are judged
LEVELS = 3  # so many different values are states of a switch
STAYS = 0.75  # share of the values that repeat the one before
UNEVEN = 2.0  # largest over smallest jump: those of a coarse reading are all alike
# Leaps of the clock:
FACTORS = {1000.0: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds", 60.0: "sixtieths"}
"""Factor of later times -> their likely unit, where those before are seconds."""
ALIKE = 3.0  # usual intervals between times before and after, once the unit is the same
SURE = 5.0  # logarithm of the odds that readings continue as after one usual interval
EACH = 0.7  # of it, at least, per channel
BEFORE = 20  # rows before a leap, and differences over its length
# First rows:
BEGINNING = 3  # rows at the start that may be wild
FOLLOWING = 20  # values that show how a channel usually changes
FEWEST_FOLLOWING = 3  # following values without which nothing is judged
STEEPER = 10.0  # times the largest rate of change of the values that follow


class Sentinel(NamedTuple):
    """A possible placeholder for missing readings: its frequency, and the range of the rest."""

    value: float
    times: int
    low: float
    high: float


def sentinels(values: Array, constants: bool = True) -> list[Sentinel]:
    """Return the values of a column that may be placeholders.

    Without `constants` only known ones count: a constant of a power or a flow is a state of it,
    such as off.

    >>> [found.value for found in sentinels(np.array([20.0, 21, 22, 21, 20, 22, 21, 23, -127]))]
    [-127.0]
    """
    rest, found = values[np.isfinite(values)], list[Sentinel]()
    while len(rest) and len(found) < MOST_SENTINELS:
        # The end of the range that lies farther from the median comes first.
        ends = np.array([rest.min(), rest.max()])
        ends = ends[np.argsort(-np.abs(ends - np.median(rest)), kind="stable")]
        one = next(filter(None, (_at(rest, end, constants) for end in ends.tolist())), None)
        if one is None:
            break
        found.append(one)
        rest = rest[rest != one.value]
    # Ranges are those of the values that remain in the end.
    return [one._replace(low=float(rest.min()), high=float(rest.max())) for one in found]


def _at(values: Array, end: float, constants: bool) -> Sentinel | None:
    """Return an end of the range as a sentinel; None if it is none."""
    rest = values[values != end]
    count = len(values) - len(rest)
    known = end in KNOWN
    if len(rest) < OTHERS or not (known or (constants and count >= REPEATED)):
        return None
    # Of a few levels, such as those of a pump, each is a constant.
    if not known and len(np.unique(rest)) < OTHERS:
        return None
    low, high = float(rest.min()), float(rest.max())
    beyond = max(low - end, end - high)
    # A constant rest has no range to compare with.
    if not 0.0 < (high - low) * (NEAR_KNOWN if known else FAR_OTHER) < beyond:
        return None
    return Sentinel(end, count, low, high)


def switches(t: Array, x: Array, off: bool = False) -> bool:
    """Return whether a column has constant stretches with jumps that no two near rows write.

    If the quantity can be `off`, one constant far from all others is enough: these may scatter.
    Jumps of one size between many levels are the resolution of a measured value. A jump between
    two rows that are a moment apart is stated by the rows themselves.

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
    """Return whether values switch between few levels; `repeats`: share that is the one before.

    `rows`: of the table, in some of which there may be no value.
    """
    levels = len(np.unique(x))
    # A log of changes has a value in few rows, and none that repeats the one before.
    changes = repeats == 0.0 and levels < len(x) <= (1.0 - STAYS) * rows
    return levels <= LEVELS and (repeats >= STAYS or len(x) >= SWITCHED * levels or changes)


def unit_factor(before: float, after: float, usual: float, later: float) -> float:
    """Return by which factor times count in another unit since a sample; 0: they do not.

    Divided by the factor, the later time follows the earlier one, and the later steps are as long
    as those before. A pause changes no later step. `usual` and `later` are the usual steps of time
    before and after the pause, NaN where none is known.

    >>> unit_factor(2990.0, 3.0e6, 10.0, 1e4), unit_factor(2990.0, 3.0e6, 10.0, 10.0)
    (1000.0, 0.0)
    """
    for factor in FACTORS:
        follows = 0.0 < after / factor - before <= ALIKE * usual
        if follows and usual / ALIKE <= later / factor <= ALIKE * usual:
            return factor
    return 0.0


def clock_leaps(t: Array, values: Array, rows: list[int]) -> list[float]:
    """Return the ends of pauses after which readings continue as if no time had passed.

    The clock leapt there. The change of each channel across the step is compared with changes over
    one usual step, and over as many usual steps as the time says. If it is much likelier as the
    former, no time passed.
    `rows` are the samples that end a pause, `values` have the shape (samples, channels).
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
    """Return the log odds of a change as one of a step to one of `lag` steps; NaN if unknown."""
    before = x[:k]
    if k < BEFORE or not np.isfinite(x[k] - x[k - 1]):
        return float("nan")
    lag = min(lag, k - BEFORE // 2)  # over a longer time the changes are no smaller
    changes = [np.square(before[m:] - before[:-m]) for m in (1, max(lag, 1))]
    if any(np.isnan(each).all() for each in changes):
        return float("nan")
    one, many = map(np.nanmean, changes)
    if not (one > 0.0 and many > one):
        return 0.0
    d = float(x[k] - x[k - 1]) ** 2
    return 0.5 * float(np.log(many / one) - d / one + d / many)


def wild_first_rows(t: Array, values: Array, groups: Sequence[Sequence[int]]) -> Mask:
    """Return which values of the first rows are wild, shape (rows, channels).

    A sensor may send a default before its first conversion, from which no initial state must be
    made. The first values of a channel are wild if the step to the next one is `STEEPER` times as
    steep as any in the `FOLLOWING` values, and if they lie outside the range of these and of the
    first values of the other channels of the group by more than that range.
    Each group has the channels of one quantity in one unit; others are not judged.
    """
    wild = np.zeros(values.shape, dtype=bool)
    # Wild values may be as large as numbers are: differences of them are infinite then, and
    # compare as they should.
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
    """Return the first rows of a channel that a leap separates from the rest; may be none."""
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
    """Return whether values lie outside what follows, and peers, by more than their range."""
    following = x[rows[-1] + 1 :]
    following = following[np.isfinite(following)][:FOLLOWING]
    around = np.concatenate([following, peers])
    low, high = around.min(), around.max()
    beyond = np.maximum(low - x[rows], x[rows] - high)
    return bool((beyond > high - low).all())
