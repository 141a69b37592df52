"""Products of one matrix with vectors that are the rows of an array."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from livepde.linalg.types import Array

__all__ = ["RowProduct", "row_product"]

# Entries up to which a dense product costs less than one by diagonals, and than a sparse one.
DENSE, WIDE = 2_500, 10_000
# Diagonals up to which they cost less than a sparse product.
MOST_DIAGONALS = 5

RowProduct: TypeAlias = Callable[[Array], Array]
"""Function x, (rows, n), -> x M^T, (rows, m)."""


def row_product(matrix: sp.csr_array) -> RowProduct:
    """Return the product of a matrix with rows: dense if small, by diagonals, or sparse.

    Rows are in C order, and so is the result.
    """
    m, n = matrix.shape
    places = matrix.tocoo()
    offsets = np.unique(places.col - places.row).tolist()
    banded = m == n and 0 in offsets and len(offsets) <= MOST_DIAGONALS
    if m * n <= (DENSE if banded else WIDE):
        transposed = np.ascontiguousarray(matrix.toarray().T)
        return lambda x: np.asarray(x.dot(transposed))
    if banded:
        return _by_diagonals({k: matrix.diagonal(k) for k in offsets})
    return lambda x: np.ascontiguousarray(matrix.dot(x.T).T)


def _by_diagonals(diagonals: dict[int, Array]) -> RowProduct:
    """Return the product with a matrix of some diagonals, by their numbers."""
    main = diagonals.pop(0)

    def product(x: Array) -> Array:
        found: Array = x * main
        for k, diagonal in diagonals.items():
            if k > 0:
                found[:, :-k] += diagonal * x[:, k:]
            else:
                found[:, -k:] += diagonal * x[:, :k]
        return found

    return product
