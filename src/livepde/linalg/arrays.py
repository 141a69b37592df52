"""Array types, products with rows, sparse matrices with fixed patterns, and a bounded cache."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import cached_property, wraps
from typing import Any, ClassVar, Generic, ParamSpec, TypeAlias, TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.integer[Any]]
Mask: TypeAlias = NDArray[np.bool_]
Sparse: TypeAlias = Any  # any SciPy sparse array: the stubs have no common 2D class


P = ParamSpec("P")
R = TypeVar("R")


class nonfinite_allowed:
    """A context or decorator that suppresses warnings about numbers that are not finite.

    With NumPy 1, `np.errstate` as a decorator stores the old state for all threads in one place.
    `contextlib.contextmanager` would noticeably slow down a step of a small model.
    """

    def __enter__(self) -> None:
        self._state = np.errstate(over="ignore", invalid="ignore", divide="ignore")
        self._state.__enter__()

    def __exit__(self, *error: Any) -> None:
        self._state.__exit__(*error)

    def __call__(self, function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def inner(*args: P.args, **kwargs: P.kwargs) -> R:
            with nonfinite_allowed():
                return function(*args, **kwargs)

        return inner


Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Memo(Generic[Key, Value]):
    """A bounded cache, which is cleared before it would exceed `most` values.

    If two threads request the same key at the same time, both compute it and receive equal values.
    Values must be immutable.

    >>> squares = Memo(most=2)
    >>> sum(squares.get(k, lambda k=k: k**2) for k in (1, 2, 3))
    14
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # The dictionary is replaced as a whole and never mutated, so that threads can read it
        # without a lock.
        self._values: Mapping[Key, Value] = {}

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return the value of a key, computed on first use."""
        values = self._values
        if key in values:
            return values[key]
        value = make()
        values = self._values
        self._values = {**(values if len(values) < self._most else {}), key: value}
        return value

    def __len__(self) -> int:
        return len(self._values)


# Entries up to which a dense product is faster than one by diagonals, and than a sparse product.
DENSE, WIDE = 2_500, 10_000
# Number of entries up to which a dense product is faster than a sparse product of one pattern.
SMALL = 10_000
# Number of diagonals up to which a product by diagonals is faster than a sparse product.
MOST_DIAGONALS = 5


class RowProduct(ABC):
    """Product of a matrix M, (m, n), with rows.

    If `separate`, a row of the result does not depend on the other rows, including its rounding.
    """

    separate: ClassVar[bool] = False

    @abstractmethod
    def __call__(self, x: Array, out: Array | None = None) -> Array:
        """Return x M^T, (rows, m), for x of shape (rows, n), stored in `out` if given."""


class DenseRows(RowProduct):
    """Product with a dense matrix."""

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
    """Product with a square matrix with few diagonals."""

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


@dataclass(frozen=True, eq=False)
class Pattern:
    """Structural non-zeros of a matrix in CSR order, with sorted columns in each row."""

    shape: tuple[int, int]
    indptr: IntArray
    indices: IntArray

    def __post_init__(self) -> None:
        # Matrices share these arrays, so they are read-only: an in-place operation must fail
        # instead of corrupting all matrices of the pattern.
        self.indptr.setflags(write=False)
        self.indices.setflags(write=False)

    @classmethod
    def from_entries(cls, rows: IntArray, cols: IntArray, shape: tuple[int, int]) -> Pattern:
        """Return the pattern with the given entries (row, column); repeated ones are merged."""
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
        """Whether a product with the dense matrix is faster."""
        return self.shape[0] * self.shape[1] <= SMALL

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
        # No buffer is reused, because several threads may share a pattern.
        return self.compact(data) @ x

    def gather(self, rows: IntArray, cols: IntArray) -> sp.csr_array:
        """Return the 0/1 matrix that sums a list of entries into `data`, shape (nnz, entries)."""
        at = self.positions(rows, cols)
        each = np.arange(len(at), dtype=np.int32)
        return sp.csr_array((np.ones(len(at)), (at, each)), shape=(self.nnz, len(at)))


def compact(matrix: sp.csr_array) -> sp.csr_array | Array:
    """Return a matrix in the format of the fastest product: dense if small."""
    return matrix.toarray() if np.prod(matrix.shape) <= SMALL else matrix


def sandwich(
    left: Sparse, inner: Pattern, right: Sparse
) -> tuple[IntArray, IntArray, sp.csr_array]:
    """Return the linear dependence of `left @ inner @ right` on the data of `inner`.

    Returns rows and columns of the entries, which repeat if several terms contribute, and the
    sparse matrix, (entries, inner.nnz), that maps the data of `inner` to their values.
    """
    a, b = sp.csc_array(left), sp.csr_array(right)
    i, j = inner.rows, inner.indices
    # Entry (i, j) of `inner` is multiplied by all entries of column i of `left`, row j of `right`.
    count_a, count_b = np.diff(a.indptr)[i], np.diff(b.indptr)[j]
    counts = count_a * count_b
    item = np.repeat(np.arange(len(counts)), counts)
    rank = np.arange(len(item)) - (np.cumsum(counts) - counts)[item]
    at_a = a.indptr[i[item]] + rank // np.maximum(count_b[item], 1)
    at_b = b.indptr[j[item]] + rank % np.maximum(count_b[item], 1)
    values = a.data[at_a] * b.data[at_b]
    shape = (len(item), inner.nnz)
    weights = sp.csr_array((values, (np.arange(len(item)), item)), shape=shape)
    return a.indices[at_a], b.indices[at_b], weights


class Assembler:
    """Assembler of a square block matrix, with linear maps from block data to its data.

    Every block is `left @ K @ right` at an offset, where K has a fixed pattern. After `build`,
    `maps[name] @ data_of_K` is the contribution of a block to the data of the assembled matrix.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._blocks: dict[str, list[_MatrixBlock]] = {}

    def add(
        self,
        name: str,
        inner: Pattern,
        left: Sparse | None = None,
        right: Sparse | None = None,
        at: tuple[int, int] = (0, 0),
        transposed: bool = False,
    ) -> None:
        """Add a block, or left @ K^T @ right if transposed; a name may be used several times."""
        block = _MatrixBlock(inner, left, right, at, transposed)
        known = (other for group in self._blocks.values() for other in group)
        same = next((other for other in known if other.alike(block)), block)
        self._blocks.setdefault(name, []).append(same)

    def build(self) -> tuple[Pattern, dict[str, sp.csr_array]]:
        """Return the pattern of the assembled matrix and, for each name, the map of its data.

        Blocks with the same pattern and factors share one map.
        """
        blocks = {id(block): block for group in self._blocks.values() for block in group}
        entries = [block.entries for block in blocks.values()]
        # The diagonal is part of every pattern, so that rows of fixed coefficients can be units.
        diagonal = np.arange(self.size, dtype=np.int32)
        rows = np.concatenate([diagonal, *(rows for rows, _, _ in entries)])
        cols = np.concatenate([diagonal, *(cols for _, cols, _ in entries)])
        pattern = Pattern.from_entries(rows, cols, (self.size, self.size))
        parts = {key: block.mapped(pattern) for key, block in blocks.items()}
        maps = {}
        for name, group in self._blocks.items():
            total = parts[id(group[0])]
            for block in group[1:]:
                total = sp.csr_array(total + parts[id(block)])
            maps[name] = total
        return pattern, maps


@dataclass(frozen=True, eq=False)
class _MatrixBlock:
    """Block left @ K @ right or left @ K^T @ right, where K has a fixed pattern."""

    inner: Pattern
    left: Sparse | None
    right: Sparse | None
    at: tuple[int, int]
    transposed: bool

    def alike(self, other: _MatrixBlock) -> bool:
        pairs = zip(*((b.inner, b.left, b.right) for b in (self, other)), strict=True)
        same = (self.at, self.transposed) == (other.at, other.transposed)
        return same and all(mine is theirs for mine, theirs in pairs)

    @cached_property
    def entries(self) -> tuple[IntArray, IntArray, sp.csr_array]:
        """Rows and columns in the assembled matrix, and map from the data of K to the values."""
        shape = self.inner.shape[::-1] if self.transposed else self.inner.shape
        left = sp.eye_array(shape[0]) if self.left is None else self.left
        right = sp.eye_array(shape[1]) if self.right is None else self.right
        rows, cols, weights = self._scaled(left, right) or self._product(left, right)
        return rows + np.int32(self.at[0]), cols + np.int32(self.at[1]), weights

    def _scaled(
        self, left: Sparse, right: Sparse
    ) -> tuple[IntArray, IntArray, sp.csr_array] | None:
        """Return the entries if both factors are diagonal, in which case no entries are summed."""
        a, b = _diagonal(left), _diagonal(right)
        if a is None or b is None:
            return None
        rows, cols = self.inner.rows, self.inner.indices
        if self.transposed:
            rows, cols = cols, rows
        scale = a[rows] * b[cols]
        # Each entry of the block is a scaled entry of K, so the map has one value in each row.
        kept = np.flatnonzero(scale).astype(np.int32)
        starts = np.arange(len(kept) + 1, dtype=np.int32)
        shape = (len(kept), self.inner.nnz)
        return rows[kept], cols[kept], sp.csr_array((scale[kept], kept, starts), shape=shape)

    def _product(self, left: Sparse, right: Sparse) -> tuple[IntArray, IntArray, sp.csr_array]:
        if not self.transposed:
            return sandwich(left, self.inner, right)
        # left K^T right is the transpose of right^T K left^T.
        a, b = sp.csr_array(right).T, sp.csr_array(left).T
        cols, rows, weights = sandwich(a, self.inner, b)
        return rows, cols, weights

    def mapped(self, pattern: Pattern) -> sp.csr_array:
        """Return the map from the data of K to the data of the assembled matrix."""
        rows, cols, weights = self.entries
        return sp.csr_array(pattern.gather(rows, cols) @ weights)


def _diagonal(matrix: Sparse) -> Array | None:
    """Return the diagonal of a diagonal matrix, otherwise None."""
    if matrix.shape[0] != matrix.shape[1]:
        return None
    coo = sp.coo_array(matrix)
    if not np.array_equal(coo.row, coo.col):
        return None
    return np.asarray(matrix.diagonal())
