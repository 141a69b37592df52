"""Sparsity patterns: sparse matrices with a fixed structure and changing data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.linalg.types import Array, IntArray, Sparse

# Number of entries up to which a dense product is faster than a sparse one.
DENSE = 10_000


@dataclass(frozen=True, eq=False)
class Pattern:
    """Positions of the structural non-zeros of a matrix, in CSR order.

    Parameters
    ----------
    shape
        Rows and columns.
    indptr, indices
        CSR structure; column indices sorted within each row.
    """

    shape: tuple[int, int]
    indptr: IntArray
    indices: IntArray

    def __post_init__(self) -> None:
        # Matrices share these arrays: they are read-only, so that an in-place operation fails
        # instead of corrupting all matrices of the pattern.
        self.indptr.setflags(write=False)
        self.indices.setflags(write=False)

    @classmethod
    def from_entries(cls, rows: IntArray, cols: IntArray, shape: tuple[int, int]) -> Pattern:
        """Return the pattern that holds every (row, column) given; repeated entries are merged."""
        entries = sp.coo_array((np.ones(len(rows), dtype=bool), (rows, cols)), shape=shape)
        return cls.of(entries)

    @classmethod
    def of(cls, matrix: Sparse) -> Pattern:
        """Return the pattern of the stored entries of a sparse matrix."""
        merged = sp.csr_array(matrix, copy=True)
        merged.sum_duplicates()
        indptr, indices = (part.astype(np.int32) for part in (merged.indptr, merged.indices))
        return cls(merged.shape, indptr, indices)

    @property
    def nnz(self) -> int:
        """Number of structural non-zeros."""
        return len(self.indices)

    @property
    def small(self) -> bool:
        """True if a dense matrix multiplies faster than a sparse one."""
        return self.shape[0] * self.shape[1] <= DENSE

    @cached_property
    def places(self) -> IntArray:
        """Row-major positions of the structural non-zeros in a dense matrix."""
        return self.rows.astype(np.intp) * self.shape[1] + self.indices

    @property
    def rows(self) -> IntArray:
        """Row index of each structural non-zero, shape (nnz,)."""
        return np.repeat(np.arange(self.shape[0], dtype=np.int32), np.diff(self.indptr))

    def positions(self, rows: IntArray, cols: IntArray) -> IntArray:
        """Return the positions of given entries in `data`; each must be in the pattern."""
        if not len(rows):
            return np.zeros(0, dtype=np.int32)
        numbers = np.arange(1, self.nnz + 1, dtype=np.int32)  # 0: not in the pattern
        places = sp.csr_matrix((numbers, self.indices, self.indptr), shape=self.shape, copy=False)
        inside = rows.max() < self.shape[0] and cols.max() < self.shape[1]
        found: IntArray = np.asarray(places[rows, cols]).ravel() if inside else np.zeros(1, int)
        if not found.all():
            raise IndexError("an entry lies outside the sparsity pattern")
        return found - 1

    def matrix(self, data: Array) -> sp.csr_array:
        """Return the CSR matrix with these values; `data` and the structure are shared."""
        return sp.csr_array((data, self.indices, self.indptr), shape=self.shape, copy=False)

    def compact(self, data: Array) -> sp.csr_array | Array:
        """Return the matrix in the format of the fastest product: dense if small."""
        if not self.small:
            return self.matrix(data)
        dense = np.zeros(self.shape)
        dense.put(self.places, data)
        return dense

    def transposed(self, data: Array) -> sp.csc_array:
        """Return the transpose of `matrix(data)` as CSC, sharing `data`."""
        shape = (self.shape[1], self.shape[0])
        return sp.csc_array((data, self.indices, self.indptr), shape=shape, copy=False)

    def product(self, data: Array, x: Array) -> Array:
        """Return `matrix(data) @ x`, for x of shape (columns,) or (columns, k)."""
        # No buffer is kept between two products: a pattern may be used by several threads at once.
        product: Array = self.compact(data) @ x
        return product

    def gather(self, rows: IntArray, cols: IntArray) -> sp.csr_array:
        """Return the 0/1 matrix that sums a list of entries into `data`, shape (nnz, entries)."""
        at = self.positions(rows, cols)
        each = np.arange(len(at), dtype=np.int32)
        return sp.csr_array((np.ones(len(at)), (at, each)), shape=(self.nnz, len(at)))


def compact(matrix: sp.csr_array) -> sp.csr_array | Array:
    """Return a matrix in the format of the fastest product: dense if small."""
    return matrix.toarray() if np.prod(matrix.shape) <= DENSE else matrix


def _expand(counts: IntArray) -> tuple[IntArray, IntArray]:
    """Return (owner, rank within owner) of `counts[i]` items of each owner i."""
    owner = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return owner, np.arange(len(owner)) - first[owner]


def sandwich(
    left: Sparse, inner: Pattern, right: Sparse
) -> tuple[IntArray, IntArray, sp.csr_array]:
    """Return the linear dependence of `left @ inner @ right` on the data of `inner`.

    Returns
    -------
    rows, cols
        Rows and columns of the entries of the product, repeated if several terms contribute.
    weights
        Sparse matrix of shape (len(rows), inner.nnz): values of those entries from `inner`'s data.
    """
    a, b = sp.csc_array(left), sp.csr_array(right)
    i, j = inner.rows, inner.indices
    # An entry (i, j) of `inner` meets every entry of column i of `left` and of row j of `right`.
    count_a, count_b = np.diff(a.indptr)[i], np.diff(b.indptr)[j]
    item, rank = _expand(count_a * count_b)
    at_a = a.indptr[i[item]] + rank // np.maximum(count_b[item], 1)
    at_b = b.indptr[j[item]] + rank % np.maximum(count_b[item], 1)
    values = a.data[at_a] * b.data[at_b]
    shape = (len(item), inner.nnz)
    weights = sp.csr_array((values, (np.arange(len(item)), item)), shape=shape)
    return a.indices[at_a], b.indices[at_b], weights
