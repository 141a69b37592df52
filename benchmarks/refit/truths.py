"""Truths by vertex-centred finite volumes, y' = A y + B g, which share no code with livepde."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.honest.linear import Linear
from benchmarks.refit.elements import interpolation

Array = NDArray[Any]


def conduction(k: Callable[[Array], Array], cells: int, length: float, points: Array) -> Linear:
    """Return the system u_t = (k u_x)_x with the two boundary values as inputs.

    Parameters
    ----------
    k
        Points -> conductivity, evaluated at the cell centres.
    cells, length
        Number of cells, whose ends are the nodes, and total length; y are the inner nodes.
    points
        Positions of the sensors inside the interval.
    """
    h = length / cells
    between = k(h * (np.arange(cells) + 0.5)) / h**2
    A = np.diag(-between[1:] - between[:-1])
    A += np.diag(between[1:-1], 1) + np.diag(between[1:-1], -1)
    B = np.zeros((cells - 1, 2))
    B[0, 0], B[-1, 1] = between[0], between[-1]
    C = interpolation(points, cells, 0.0, length)
    return Linear(A, B, C[:, 1:-1], C[:, [0, -1]])
