"""Products of one matrix with vectors that are the rows of an array."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
import scipy.sparse as sp

from livepde.linalg.types import Array

# Entries up to which a dense product costs less than one by diagonals, and than a sparse one.
DENSE, WIDE = 2_500, 10_000
# Diagonals up to which they cost less than a sparse product.
MOST_DIAGONALS = 5


class RowProduct(ABC):
    """The product of a matrix M, (m, n), with rows.

    Attributes
    ----------
    separate
        True if the numbers of a row do not depend on the other rows, not even in their rounding.
    """

    separate: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, x: Array, out: Array | None = None) -> Array:
        """Return x M^T, (rows, m), for x of shape (rows, n); in `out` if it is given."""


class DenseRows(RowProduct):
    """Product with a matrix that is stored as a whole."""

    def __init__(self, matrix: sp.csr_array) -> None:
        self._transposed = np.ascontiguousarray(matrix.toarray().T)

    def __call__(self, x: Array, out: Array | None = None) -> Array:
        return np.asarray(x.dot(self._transposed, out))


class SparseRows(RowProduct):
    """Product with a sparse matrix."""

    def __init__(self, matrix: sp.csr_array) -> None:
        self._matrix = matrix

    def __call__(self, x: Array, out: Array | None = None) -> Array:
        found = self._matrix.dot(x[0])[None] if len(x) == 1 else self._matrix.dot(x.T).T
        if out is None:
            return np.ascontiguousarray(found)
        out[:] = found
        return out


class DiagonalRows(RowProduct):
    """Product with a square matrix of few diagonals."""

    separate = True

    def __init__(self, matrix: sp.csr_array, offsets: list[int]) -> None:
        self._main = matrix.diagonal()
        self._others = [(k, matrix.diagonal(k)) for k in offsets if k]

    def __call__(self, x: Array, out: Array | None = None) -> Array:
        found: Array = np.multiply(x, self._main, out=out)
        for k, diagonal in self._others:
            if k > 0:
                found[:, :-k] += diagonal * x[:, k:]
            else:
                found[:, -k:] += diagonal * x[:, :k]
        return found


def row_product(matrix: sp.csr_array) -> RowProduct:
    """Return the product of a matrix with rows: dense if small, by diagonals, or sparse."""
    m, n = matrix.shape
    places = matrix.tocoo()
    offsets = np.unique(places.col - places.row).tolist()
    banded = m == n and len(offsets) <= MOST_DIAGONALS
    if m * n <= (DENSE if banded else WIDE):
        return DenseRows(matrix)
    return DiagonalRows(matrix, offsets) if banded else SparseRows(matrix)
