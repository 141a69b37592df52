"""Array types, products with rows, numbers that are not finite, and a bounded memo."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from functools import wraps
from typing import Any, ClassVar, Generic, ParamSpec, TypeAlias, TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.integer[Any]]
Mask: TypeAlias = NDArray[np.bool_]
Sparse: TypeAlias = Any  # any SciPy sparse array: the stubs know no common 2D class


P = ParamSpec("P")
R = TypeVar("R")


class nonfinite_allowed:
    """A context, or a decorator, without warnings of numbers that are not finite.

    Not `np.errstate` as a decorator, which with NumPy 1 keeps the old state of all threads in one
    place; nor `contextlib.contextmanager`, whose generator costs a step of a small model more.
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
    """A bounded memo of a function: cleared when it would grow beyond `most` values.

    Two threads that ask for the same key at once both compute it, and get equal values. Values must
    be immutable.

    >>> squares = Memo(most=2)
    >>> sum(squares.get(k, lambda k=k: k**2) for k in (1, 2, 3))
    14
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # The dictionary is replaced as a whole and never mutated, so that a thread may keep reading
        # the one it has: no lock is needed.
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


# Entries up to which a dense product costs less than one by diagonals, and than a sparse one.
DENSE, WIDE = 2_500, 10_000
# Diagonals up to which they cost less than a sparse product.
MOST_DIAGONALS = 5


class RowProduct(ABC):
    """The product of a matrix M, (m, n), with rows.

    If `separate`, the numbers of a row do not depend on the other rows, not even in their rounding.
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
