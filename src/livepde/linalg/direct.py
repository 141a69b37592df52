"""Engines that factorise: the protocol, SuperLU, CHOLMOD, and Pardiso."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from livepde.errors import LinearAlgebraError
from livepde.linalg.arrays import Array, IntArray
from livepde.linalg.pattern import Pattern


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, b: Array, /) -> Array:
        """Return x with K x = b; `b` has shape (n,) or, for several right-hand sides, (n, k)."""
        ...


@dataclass(frozen=True, eq=False)
class Inverse:
    """A `Factor` by a function, which raises `LinearAlgebraError` where it has no solution."""

    solve: Callable[[Array], Array]


class Solver(Protocol):
    """A solver bound to one sparsity pattern."""

    @property
    def name(self) -> str:
        """Name of the solver for messages."""
        ...

    @property
    def pattern(self) -> Pattern:
        """Sparsity pattern of its matrices."""
        ...

    @property
    def definite(self) -> bool:
        """True if it refuses a matrix that is not positive definite, at the latest in a solve."""
        ...

    @property
    def price(self) -> float:
        """Approximate cost of a factorisation in solves; 0: reusing a factor does not pay.

        A constant, not a measured time: timings must not influence the numbers computed.
        """
        ...

    def factorise(self, data: Array) -> Factor:
        """Factorise the matrix `pattern.matrix(data)`.

        Raises
        ------
        LinearAlgebraError
            The matrix is singular to working precision or holds a value that is not finite.
        """
        ...


def check_finite(data: Array) -> None:
    """Raise `LinearAlgebraError` for data of a matrix that are not finite."""
    if not np.isfinite(data).all():
        raise LinearAlgebraError("The matrix holds values that are not finite.")


def _refusal(pattern: Pattern, definite: bool) -> LinearAlgebraError:
    n, more = pattern.shape[0], " or not positive definite" if definite else ""
    return LinearAlgebraError(
        f"The {n} by {n} matrix is singular{more}: check the model's forms, or take a smaller "
        "time step."
    )


@dataclass(frozen=True, eq=False)
class Leading:
    """Factor of the Schur complement on the leading `size` unknowns of a factorised matrix.

    `factor` is of the larger matrix, shape (total, total).
    """

    factor: Factor
    size: int
    total: int

    def solve(self, b: Array) -> Array:
        """Return the leading unknowns; the right-hand sides of the other equations are zero."""
        # [[E, F], [F^T, H]] (x, y) = (b, 0) gives (E - F H^-1 F^T) x = b.
        padded = np.zeros((self.total, *b.shape[1:]))
        padded[: self.size] = b
        return self.factor.solve(padded)[: self.size]


SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}
# Bound on the backward error of a test solve. A factor without pivot growth is far below it.
STABLE = 1e-10


@dataclass(frozen=True, eq=False)
class SuperLUFactor:
    """LU factors of the transpose: a CSR matrix read as CSC is its transpose, without a copy."""

    lu: Any
    symmetric: bool = False

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        # SuperLU solves the transposed system column by column; the other one takes all columns at
        # once, which is up to 1.5 times faster, but slower for a single column.
        several = b.ndim > 1 and b.shape[1] > 1
        x: Array = self.lu.solve(b, trans="N" if self.symmetric and several else "T")
        return x


@dataclass(frozen=True, eq=False)
class SuperLUSolver:
    """Sparse LU of one pattern; `symmetric` for symmetric positive definite matrices.

    The symmetric mode orders A + A^T and does not pivot, which is 1.6 to 9 times cheaper. If the
    residual of a test solve is large, the matrix is not positive definite, and is refused.
    """

    pattern: Pattern
    symmetric: bool = False
    price: float = 30.0

    @property
    def name(self) -> str:
        return "SuperLU (SciPy)" + (", symmetric mode" if self.symmetric else "")

    @property
    def definite(self) -> bool:
        """False: SuperLU does not check the signs of pivots."""
        return False

    def factorise(self, data: Array) -> SuperLUFactor:
        """Factorise; raise `LinearAlgebraError` for a singular or non-finite matrix.

        In symmetric mode it is also raised for an indefinite matrix, unless its factor is accurate.
        """
        check_finite(data)
        transpose = sp.csc_array(self.pattern.transposed(data))
        options = SYMMETRIC if self.symmetric else {}
        n, refusal = transpose.shape[0], _refusal(self.pattern, self.symmetric)
        try:
            factor = SuperLUFactor(splu(transpose, **options), self.symmetric)
        except RuntimeError as error:
            raise refusal from error
        if self.symmetric:
            # Without pivoting, an indefinite matrix can have a factor with large element growth. A
            # test solve detects that; SuperLU itself reports exact zeros only.
            b = np.cos(np.arange(n))  # of no symmetry that could hide an error
            x = factor.solve(b)
            size = np.abs(data).max() * np.abs(x).max() + 1.0
            if not np.abs(self.pattern.matrix(data) @ x - b).max() <= STABLE * size:
                raise refusal
        return factor


def positive_definite(matrix: sp.csr_array) -> bool:
    """Return True if a symmetric matrix is positive definite: all its pivots are positive.

    By Sylvester's law of inertia, which applies if rows and columns are permuted together.
    """
    try:
        lu = splu(sp.csc_array(matrix), **SYMMETRIC)
    except RuntimeError:
        return False
    return bool(np.array_equal(lu.perm_r, lu.perm_c) and np.all(lu.U.diagonal() > 0))


@dataclass(frozen=True, eq=False)
class CholmodSolver:
    """Sparse Cholesky of one pattern with a fixed fill-reducing order; needs scikit-sparse.

    A successful factorisation proves that the matrix is positive definite. With `blocks` the factor
    has dense blocks (supernodal, L L^T), else none (simplicial, L D L^T): blocks are faster to
    compute for wide bands, and slower to solve with at any size.
    """

    pattern: Pattern
    blocks: bool = False
    definite: bool = True
    price: float = 35.0

    @property
    def name(self) -> str:
        return f"CHOLMOD (scikit-sparse), {'supernodal' if self.blocks else 'simplicial'}"

    @cached_property
    def _order(self) -> Any:
        from sksparse.cholmod import analyze

        mode = "supernodal" if self.blocks else "simplicial"
        return analyze(self._matrix(np.ones(self.pattern.nnz)), mode=mode)

    def _matrix(self, data: Array) -> sp.csc_matrix:
        # A symmetric matrix is its transpose; scikit-sparse knows no sparse arrays.
        return sp.csc_matrix((data, self.pattern.indices, self.pattern.indptr), self.pattern.shape)

    def factorise(self, data: Array) -> Inverse:
        """Factorise; raise `LinearAlgebraError` unless positive definite and finite."""
        from sksparse.cholmod import CholmodNotPositiveDefiniteError

        check_finite(data)
        failure = _refusal(self.pattern, True)
        try:
            factor = self._order.cholesky(self._matrix(data))
        except CholmodNotPositiveDefiniteError as error:
            raise failure from error
        # L D L^T also exists for indefinite matrices.
        if not (self.blocks or (factor.D() > 0.0).all()):
            raise failure
        return Inverse(factor)


POSITIVE_DEFINITE, GENERAL = 2, 11  # Pardiso's types of a matrix
FACTORISE, REFACTORISE, SOLVE = 12, 22, 33  # its phases
# The value of MKL_CBWR_AUTO: results do not depend on the alignment of arrays in memory, so that
# runs are reproducible to the last digit.
REPRODUCIBLE = 2


@dataclass(frozen=True, eq=False)
class PardisoFactor:
    """Factors held by a Pardiso handle, which returns to the solver with this object."""

    solver: PardisoSolver
    handle: Any
    matrix: sp.csr_array

    # A handle works in memory of its own, and pypardiso lets other threads run meanwhile. A factor
    # that a model keeps (of X, say) is asked by every thread: one after the other.
    turn: Lock = field(default_factory=Lock, repr=False)

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        with self.turn:
            self.handle.set_phase(SOLVE)
            x: Array = self.handle._call_pardiso(self.matrix, np.array(b, dtype=float, order="F"))
        return x


@dataclass(frozen=True, eq=False)
class PardisoSolver:
    """Sparse factors of one pattern by MKL Pardiso; needs pypardiso.

    `symmetric` is for symmetric positive definite matrices: a successful factorisation proves
    definiteness, and the fill-reducing order is computed once. The order of other matrices depends
    on their values and is recomputed for each, since the numbers of a factor must not depend on
    earlier factorisations. pypardiso's own `solve` takes no symmetric storage and compares the
    whole matrix each time; hence its phases are called one by one.
    """

    pattern: Pattern
    symmetric: bool = False
    _idle: list[Any] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        weakref.finalize(self, _release, self._idle).atexit = False

    @property
    def name(self) -> str:
        return "Pardiso (MKL)" + (", symmetric positive definite" if self.symmetric else "")

    @property
    def price(self) -> float:
        return 4.0 if self.symmetric else 15.0

    @property
    def definite(self) -> bool:
        """True for symmetric matrices, which have a Cholesky factor."""
        return self.symmetric

    @cached_property
    def _stored(self) -> tuple[IntArray, Pattern]:
        """Data indices and pattern passed to Pardiso: the upper triangle if symmetric."""
        rows, cols = self.pattern.rows, self.pattern.indices
        kept = np.flatnonzero(cols >= rows) if self.symmetric else np.arange(len(cols))
        if len(np.unique(rows[cols == rows])) < self.pattern.shape[0] and self.symmetric:
            raise LinearAlgebraError(
                "The matrix is singular or not positive definite: a diagonal entry is missing."
            )
        return kept, Pattern.from_entries(rows[kept], cols[kept], self.pattern.shape)

    def factorise(self, data: Array) -> PardisoFactor:
        """Factorise; raise `LinearAlgebraError` for a singular or non-finite matrix."""
        from pypardiso import PyPardisoSolver
        from pypardiso.pardiso_wrapper import PyPardisoError

        check_finite(data)
        kept, pattern = self._stored
        matrix = pattern.matrix(data[kept])
        kind = POSITIVE_DEFINITE if self.symmetric else GENERAL
        try:
            handle, known = self._idle.pop(), True  # at once: another thread may take the last one
        except IndexError:
            handle, known = PyPardisoSolver(mtype=kind), False
        handle.libmkl.MKL_CBWR_Set(REPRODUCIBLE)
        handle.set_phase(REFACTORISE if known and self.symmetric else FACTORISE)
        try:
            handle._call_pardiso(matrix, np.zeros(len(matrix.indptr) - 1))
        except PyPardisoError as error:
            _release([handle])
            raise _refusal(pattern, self.symmetric) from error
        factor = PardisoFactor(self, handle, matrix)
        weakref.finalize(factor, self._idle.append, handle).atexit = False
        return factor


def _release(handles: list[Any]) -> None:
    for handle in handles:
        handle.free_memory(everything=True)
