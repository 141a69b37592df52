"""Finite volumes about nodes as systems y' = A y + B g: truths that share no code with livepde."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.honest.linear import Linear
from benchmarks.refit.elements import interpolation

Array = NDArray[Any]


def conduction(k: Callable[[Array], Array], cells: int, length: float, points: Array) -> Linear:
    """Return u_t = (k u_x)_x between two given values, the inputs.

    Parameters
    ----------
    k
        Conductivity at places, shape (cells,).
    cells, length
        Nodes are the ends of cells; those inside are y.
    points
        Of the sensors, inside.
    """
    h = length / cells
    between = k(h * (np.arange(cells) + 0.5)) / h**2
    A = np.diag(-between[1:] - between[:-1])
    A += np.diag(between[1:-1], 1) + np.diag(between[1:-1], -1)
    B = np.zeros((cells - 1, 2))
    B[0, 0], B[-1, 1] = between[0], between[-1]
    C = interpolation(points, cells, 0.0, length)
    return Linear(A, B, C[:, 1:-1], C[:, [0, -1]])
