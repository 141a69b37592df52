"""Inputs that switch: constant stretches with jumps, as a switch or a set point leaves them."""

from __future__ import annotations

import numpy as np

from livepde.linalg import Array
from livepde.streams.gaps import SHORT

FEWEST = 4  # known values that are judged
LEVELS = 3  # so many different values are states of a switch
STAYS = 0.75  # share of the values that repeat the one before
UNEVEN = 2.0  # largest over smallest jump: those of a coarse reading are all alike


def switches(t: Array, x: Array) -> bool:
    """Return whether a column has constant stretches with jumps that no two near rows write.

    Jumps of one size between many levels are the resolution of a measured value. A jump between
    two rows that are a moment apart is stated by the rows themselves.

    Parameters
    ----------
    t, x
        Times and values, NaN where missing, shape (rows,).

    Examples
    --------
    >>> t = np.arange(8.0)
    >>> switches(t, np.array([0.0, 0, 8, 8, 8, 8, 0, 0]))
    True
    >>> switches(t, np.array([20.0, 20.1, 20.3, 20.2, 20.5, 20.6, 20.9, 21.0]))
    False
    """
    known, rows = np.isfinite(x), len(x)
    t, x = t[known], x[known]
    if len(x) < FEWEST:
        return False
    steps, jumps = np.diff(t), np.abs(np.diff(x))
    jumped = jumps > 0.0
    if not jumped.any() or (steps[jumped] < SHORT * np.median(steps)).all():
        return False
    levels, sizes = len(np.unique(x)), jumps[jumped]
    repeats = float(np.mean(~jumped))
    # A log of changes has a value in few rows, and none that repeats the one before.
    changes = repeats == 0.0 and levels < len(x) <= (1.0 - STAYS) * rows
    few = levels <= LEVELS and (repeats >= STAYS or len(x) >= FEWEST * levels or changes)
    return few or (repeats >= STAYS and float(sizes.max()) > UNEVEN * float(sizes.min()))
