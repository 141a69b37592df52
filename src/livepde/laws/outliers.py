"""Values of sensors that lie far from their neighbours in time, or from most others.

Values are in units of the noise, shape (samples, sensors), NaN where there is none. If a sensor has
at most `FEW` values, all of them count as near.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from livepde.linalg import Array, Mask

NEIGHBOURS = 3  # to each side
FEW = 2 * NEIGHBOURS
NORMAL = 1.4826  # standard deviation of normal values over the median of their sizes


def usual_size(values: Array) -> float:
    """Return the standard deviation by the median of the sizes of values, at least 1."""
    return max(1.0, NORMAL * float(np.median(np.abs(values)))) if len(values) else 1.0


def near_neighbours(values: Array, limit: float) -> Mask:
    """Return which values lie within `limit` usual distances from the median of their neighbours.

    A model error, which changes slowly, stays.
    """
    return _near(values, limit, _of_neighbours)


def near_most(values: Array, limit: float) -> Mask:
    """Return which values lie within `limit` usual distances from the median of all of a sensor.

    A sensor that shows a wrong constant for some time has neighbours that agree with it.
    """
    return _near(values, limit, np.median)


def _near(values: Array, limit: float, centre: Callable[[Array], Array]) -> Mask:
    """Return which values lie within `limit` usual distances from the centre of their sensor."""
    near = np.isfinite(values)
    for k, column in enumerate(values.T):
        (places,) = near[:, k].nonzero()
        if len(places) > FEW:
            away = column[places] - centre(column[places])
            near[places, k] = np.abs(away) <= limit * usual_size(away)
    return near


def _of_neighbours(values: Array) -> Array:
    """Return the median of the neighbours of each value, itself left out, shape (count,)."""
    count, reach = len(values), NEIGHBOURS
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * reach + 1)
    inner = np.median(np.delete(windows, reach, axis=1), axis=1)
    edges = {k: np.r_[0:k, k + 1 : 2 * reach + 1] for k in range(reach)}
    first = [np.median(values[which]) for which in edges.values()]
    last = [np.median(values[count - 1 - which]) for which in edges.values()]
    return np.concatenate([first, inner, last[::-1]])
