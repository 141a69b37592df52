"""Wild values of the first rows, from which an initial state must not be made.

A sensor may send a default before its first conversion. Such a value is seen by the rows that
follow and by the other channels of the same quantity, before there is any history.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from livepde.linalg import Array, IntArray, Mask

MOST = 3  # rows at the start that may be wild
FOLLOWING = 20  # values that show how a channel usually changes
FEWEST = 3  # following values without which nothing is judged
LEAP = 10.0  # times the largest rate of change of the values that follow


def wild_first_rows(t: Array, values: Array, groups: Sequence[Sequence[int]]) -> Mask:
    """Return which values of the first rows are wild, shape (rows, channels).

    The first values of a channel are wild if the step to the next one is `LEAP` times as steep as
    any in the `FOLLOWING` values, and if they lie outside the range of these and of the first
    values of the other channels of the group by more than that range.

    Parameters
    ----------
    t, values
        Times, shape (rows,), and values, NaN where missing, shape (rows, channels).
    groups
        Channels that measure the same quantity in the same unit; others are not judged.
    """
    wild = np.zeros(values.shape, dtype=bool)
    # Wild values may be as large as numbers are: differences of them are infinite then, and
    # compare as they should.
    with np.errstate(over="ignore"):
        for group in groups:
            leaps = {k: _leap(t, values[:, k]) for k in group}
            first = [_first(values[:, k]) for k in group if not len(leaps[k])]
            peers = np.array(first, dtype=float)
            for k, rows in leaps.items():
                if len(rows) and _outside(values[:, k], rows, peers):
                    wild[rows, k] = True
    return wild


def _first(x: Array) -> float:
    known = x[np.isfinite(x)]
    return float(known[0]) if len(known) else np.nan


def _leap(t: Array, x: Array) -> IntArray:
    """Return the first rows of a channel that a leap separates from the rest; may be none."""
    (known,) = np.isfinite(x[: MOST + FOLLOWING + 1]).nonzero()
    for count in range(1, MOST + 1):
        tail = known[count:][:FOLLOWING]
        if len(tail) < FEWEST or known[0] >= MOST:
            break
        rates = np.abs(np.diff(x[tail]) / np.diff(t[tail])).max()
        last, then = known[count - 1], tail[0]
        step = abs(x[then] - x[last])
        if step > LEAP * rates * (t[then] - t[last]) and _outside(x, known[:count], np.zeros(0)):
            return known[:count]
    return known[:0]


def _outside(x: Array, rows: IntArray, peers: Array) -> bool:
    """Return whether values lie outside what follows, and peers, by more than their range."""
    following = x[rows[-1] + 1 :]
    following = following[np.isfinite(following)][:FOLLOWING]
    around = np.concatenate([following, peers[np.isfinite(peers)]])
    low, high = around.min(), around.max()
    beyond = np.maximum(low - x[rows], x[rows] - high)
    return bool((beyond > high - low).all())
