"""Matrices of first-order elements on evenly spaced nodes in closed form.

Row i of a matrix has the test function of node i. A quadratic form is an array T of shape
(n, n, n), stored as a sparse matrix (n n, n). Its Jacobian in u is T u, its value (T u) u/2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[Any]


def _sum(local: Array, cells: int, scale: Array | float = 1.0) -> sp.csr_array:
    """Assemble the matrix (2, 2) of each cell, times a factor for each cell."""
    weights = np.broadcast_to(scale, cells)
    left = np.arange(cells)
    rows = np.concatenate([left + i for i in (0, 0, 1, 1)])
    columns = np.concatenate([left + j for j in (0, 1, 0, 1)])
    data = np.concatenate([entry * weights for entry in local.ravel()])
    return sp.csr_array((data, (rows, columns)), shape=(cells + 1, cells + 1))


def mass(cells: int, h: float) -> sp.csr_array:
    """Return the integrals of u v."""
    return _sum(np.array([[2.0, 1.0], [1.0, 2.0]]) * h / 6.0, cells)


def stiffness(cells: int, h: float, of: Array | float = 1.0) -> sp.csr_array:
    """Return the integrals of k u_x v_x for k = `of`, a constant or an array over cells."""
    return _sum(np.array([[1.0, -1.0], [-1.0, 1.0]]) / h, cells, of)


def cell_stiffness(cells: int, h: float) -> list[sp.csr_array]:
    """Return the integrals of u_x v_x over each cell."""
    return [stiffness(cells, h, row) for row in np.eye(cells)]


def advection(cells: int) -> sp.csr_array:
    """Return the integrals of -u v_x over the column and of u v at its right end."""
    matrix = _sum(np.array([[0.5, 0.5], [-0.5, -0.5]]), cells).tolil()
    matrix[cells, cells] += 1.0
    return sp.csr_array(matrix)


def _quadratic(entries: dict[tuple[int, int, int], float], cells: int) -> sp.csr_array:
    """Assemble T from an array (2, 2, 2) of each cell, (row, column, factor) -> entry."""
    n, left = cells + 1, np.arange(cells)
    rows, columns, data = [], [], []
    for (i, j, k), entry in entries.items():
        rows.append((left + i) * n + left + j)
        columns.append(left + k)
        data.append(np.full(cells, entry))
    places = (np.concatenate(rows), np.concatenate(columns))
    return sp.csr_array((np.concatenate(data), places), shape=(n * n, n))


def square(cells: int, h: float) -> sp.csr_array:
    """Return T of the integrals of u^2 v."""
    # The integral of three hat functions over a cell is h/4 if all are equal, else h/12; the
    # derivative of u^2 is 2 u.
    places = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return _quadratic({p: 2.0 * (h / 4 if len(set(p)) == 1 else h / 12) for p in places}, cells)


def self_advection(cells: int) -> sp.csr_array:
    """Return T of the integrals of u u_x v."""
    # The integral of test function i, hat j and the slope of hat k is the slope times 1/3 or 1/6.
    slope, entries = (-1.0, 1.0), dict[tuple[int, int, int], float]()
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                straight = (1 / 3 if i == j else 1 / 6) * slope[k]
                swapped = (1 / 3 if i == k else 1 / 6) * slope[j]
                entries[i, j, k] = straight + swapped
    return _quadratic(entries, cells)


def interpolation(points: Array, cells: int, left: float, right: float) -> Array:
    """Return the matrix that evaluates a function at points, shape (points, nodes)."""
    place = (np.asarray(points) - left) / (right - left) * cells
    cell = np.minimum(place.astype(int), cells - 1)
    rows = np.zeros((len(place), cells + 1))
    each = np.arange(len(place))
    rows[each, cell], rows[each, cell + 1] = 1.0 - (place - cell), place - cell
    return rows


def projected(f: Callable[[Array], Array], cells: int, right: float, points: int = 2) -> Array:
    """Return the L2 projection of f on (0, right), with `points` Gauss points in each cell."""
    place, weight = np.polynomial.legendre.leggauss(points)
    share, h = 0.5 * (1.0 + place), right / cells
    values = f(h * (np.arange(cells)[:, None] + share)) * (0.5 * h * weight)
    tested = np.append(values @ (1.0 - share), 0.0) + np.append(0.0, values @ share)
    return np.asarray(np.linalg.solve(mass(cells, h).toarray(), tested))
