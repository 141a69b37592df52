"""Solvers of sparse systems: factorisations, Krylov methods with multigrid, and their choice.

The choice depends on the half bandwidth after reverse Cuthill-McKee ordering: about sqrt(n) in 2D
and n^(2/3) in 3D, twice as large for quadratic elements. In any dimension, the dense blocks of a
sparse factor have about this size:

    band          2D P1       3D P1       engine
    to 48         2 000         300       banded LU
    to 500      200 000      11 000       CHOLMOD if installed, else SuperLU
    to 2500   5 000 000     120 000       CHOLMOD or Pardiso if installed, else multigrid
    beyond                                multigrid

CHOLMOD uses the simplicial factor up to 500 and the supernodal factor beyond. Times on one thread,
for 2D P1 and 10 201 nodes: CHOLMOD simplicial 12 ms for a factor, 0.3 ms to solve for one column
and 1.2 for five; supernodal 21, 0.8 and 4.2; SuperLU 40, 1.3 and 3.0; Pardiso 9, 6.4 and 13. For 3D
P1 and 13 824 nodes: 790, 6.9 and 17; 550, 9.5 and 28; 1220, 14 and 29; 110, 18 and 37. Pardiso has
the fastest factorisation and the slowest solve, so it pays if a factor costs many solves.

CHOLMOD and multigrid (PyAMG) require symmetric positive definite matrices. For other matrices, the
solver is SuperLU up to a band of 150, and Pardiso beyond if it is installed. SuperLU requires no
package and factorises all matrices; for large ones, it is slow and requires much memory.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.util import find_spec
from threading import Lock
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from livepde.errors import LinearAlgebraError, optional
from livepde.linalg.arrays import Array, IntArray, Pattern
from livepde.linalg.banded import BandedSolver


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, b: Array, /) -> Array:
        """Return x with K x = b; `b` has shape (n,) or, for several right-hand sides, (n, k)."""


@dataclass(frozen=True, eq=False)
class Inverse:
    """A `Factor` from a function, which raises `LinearAlgebraError` if there is no solution."""

    solve: Callable[[Array], Array]


class Solver(Protocol):
    """A solver bound to one sparsity pattern."""

    @property
    def name(self) -> str:
        """Name of the solver for messages."""

    @property
    def pattern(self) -> Pattern:
        """Sparsity pattern of its matrices."""

    @property
    def definite(self) -> bool:
        """Whether it rejects matrices that are not positive definite, at the latest in a solve."""

    @property
    def price(self) -> float:
        """Approximate cost of a factorisation in solves; 0 if reusing a factor does not pay.

        It is a constant instead of a measured time, because timings must not influence results.
        """

    def factorise(self, data: Array) -> Factor:
        """Factorise the matrix `pattern.matrix(data)`.

        Raises `LinearAlgebraError`: the matrix is singular to working precision, or a value is not
        finite.
        """


def check_finite(data: Array) -> None:
    """Raise `LinearAlgebraError` if data of a matrix are not finite."""
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

    `factor` is the factor of the larger matrix, shape (total, total).
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
# Bound on the backward error of a test solve. Without pivot growth, the error is far below it.
STABLE = 1e-10


@dataclass(frozen=True, eq=False)
class SuperLUFactor:
    """LU factors of the transpose, which is the CSR matrix read as CSC, without a copy."""

    lu: Any
    symmetric: bool = False

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        # SuperLU solves the transposed system column by column, and the system itself for all
        # columns at once. The latter is up to 1.5 times faster, but slower for a single column.
        several = b.ndim > 1 and b.shape[1] > 1
        return np.asarray(self.lu.solve(b, trans="N" if self.symmetric and several else "T"))


@dataclass(frozen=True, eq=False)
class SuperLUSolver:
    """Sparse LU of one pattern; `symmetric` for symmetric positive definite matrices.

    The symmetric mode orders A + A^T and does not pivot, which is 1.6 to 9 times cheaper. If the
    residual of a test solve is large, the matrix is not positive definite and is rejected.
    """

    pattern: Pattern
    symmetric: bool = False
    definite: bool = False  # the signs of pivots are not checked
    price: float = 30.0

    @property
    def name(self) -> str:
        return "SuperLU (SciPy)" + (", symmetric mode" if self.symmetric else "")

    def factorise(self, data: Array) -> SuperLUFactor:
        """Factorise; raise `LinearAlgebraError` for a singular or non-finite matrix.

        In symmetric mode, an indefinite matrix is also an error, unless its factor is accurate.
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
            # Without pivoting, the factor of an indefinite matrix can have large element growth,
            # which a test solve detects. SuperLU itself reports only exact zeros.
            b = np.cos(np.arange(n))  # without a symmetry that could hide an error
            x = factor.solve(b)
            size = np.abs(data).max() * np.abs(x).max() + 1.0
            if not np.abs(self.pattern.matrix(data) @ x - b).max() <= STABLE * size:
                raise refusal
        return factor


def positive_definite(matrix: sp.csr_array) -> bool:
    """Return whether a symmetric matrix is positive definite: all its pivots are positive.

    Sylvester's law of inertia applies if rows and columns have the same permutation.
    """
    try:
        lu = splu(sp.csc_array(matrix), **SYMMETRIC)
    except RuntimeError:
        return False
    return bool(np.array_equal(lu.perm_r, lu.perm_c) and np.all(lu.U.diagonal() > 0))


# Number of columns per call of CHOLMOD. It processes four columns together, so a multiple of four
# does not change the results. For 60 columns on 3249 nodes, 8 per call take 3.0 ms, all at once
# 4.6.
COLUMNS = 8


@dataclass(frozen=True, eq=False)
class CholmodSolver:
    """Sparse Cholesky of one pattern with a fixed fill-reducing order; needs scikit-sparse.

    A successful factorisation proves that the matrix is positive definite. With `blocks` the factor
    has dense blocks (supernodal, L L^T), otherwise none (simplicial, L D L^T). Blocks are faster to
    compute for wide bands, but the solve is slower at any size.
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
        # A symmetric matrix equals its transpose. scikit-sparse does not support sparse arrays.
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
        return Inverse(factor if self.blocks else partial(_by_blocks, factor))


def _by_blocks(factor: Any, b: Array) -> Array:
    """Return the solution, computed for `COLUMNS` columns at a time, which fit into the cache."""
    if b.ndim == 1 or b.shape[1] <= COLUMNS:
        x: Array = factor(b)
        return x
    x = np.empty(b.shape, order="F")
    for k in range(0, b.shape[1], COLUMNS):
        x[:, k : k + COLUMNS] = factor(np.asfortranarray(b[:, k : k + COLUMNS]))
    return x


POSITIVE_DEFINITE, GENERAL = 2, 11  # Pardiso's types of a matrix
FACTORISE, REFACTORISE, SOLVE = 12, 22, 33  # its phases
# MKL_CBWR_AUTO: results do not depend on the alignment of arrays in memory, so that runs are
# reproducible bit by bit.
REPRODUCIBLE = 2


@dataclass(frozen=True, eq=False)
class PardisoFactor:
    """Factors in a Pardiso handle, which returns to the solver when this object is deleted."""

    solver: PardisoSolver
    handle: Any
    matrix: sp.csr_array

    # A handle has its own work memory, and pypardiso releases the GIL during a call. Threads that
    # share a factor, such as the factor of X in a model, must use it one after the other.
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
    definiteness, and the fill-reducing order is computed once. For other matrices the order depends
    on the values. It is recomputed for each matrix, because a factor must not depend on earlier
    factorisations. pypardiso's `solve` does not support symmetric storage and compares the whole
    matrix in each call, so the phases are called separately.
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
        """Whether matrices have a Cholesky factor: they do if `symmetric`."""
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
            handle, known = self._idle.pop(), True  # no test first: other threads pop, too
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


Map = Callable[[Array], Array]


def conjugate_gradients(
    apply: Map, precondition: Map, b: Array, tolerance: float, limit: int, remedy: str
) -> tuple[Array, int]:
    """Solve with a symmetric positive definite matrix, for all right-hand sides at once.

    Parameters
    ----------
    apply, precondition
        Products with the matrix and with the approximate inverse, for arrays like b.
    b
        Shape (n,) or (n, k).
    tolerance, limit
        Bound on the residual, relative to each right-hand side; maximum number of iterations.
    remedy
        Advice for the error message if there is no convergence.

    Returns
    -------
    x, iterations
        The solution, and the number of iterations.

    Raises
    ------
    LinearAlgebraError
        The matrix or the preconditioner is not positive definite, or there is no convergence.
    """
    x, r = np.zeros_like(b), b.copy()
    goal = tolerance * np.linalg.norm(b, axis=0)
    p, rz = np.zeros_like(b), np.ones(b.shape[1:])
    for iteration in range(limit + 1):
        left = np.linalg.norm(r, axis=0)
        if np.all(left <= goal):
            return x, iteration
        z = precondition(r)
        new = np.einsum("i...,i...->...", r, z)
        # beta is (r, z) over its previous value; infinity makes it zero in the first iteration.
        p = z + _ratio(new, rz if iteration else np.full_like(rz, np.inf)) * p
        Kp = apply(p)
        curvature = np.einsum("i...,i...->...", p, Kp)
        active = left > goal
        if not (np.all(curvature[active] > 0) and np.all(new[active] > 0)):
            raise LinearAlgebraError(
                "The matrix is not positive definite to working precision: check the signs of the "
                "forms, or take a smaller time step."
            )
        # Converged right-hand sides are frozen, since their search directions may be zero.
        step = _ratio(new * active, curvature)
        x += step * p
        r -= step * Kp
        rz = new
    worst = float(np.max(_ratio(left, np.linalg.norm(b, axis=0))))
    raise LinearAlgebraError(
        f"{limit} iterations of conjugate gradients left a residual of {worst:.1e}, with "
        f"{tolerance:.0e} asked for: {remedy}"
    )


def _ratio(a: Array, b: Array) -> Array:
    """Return a/b, and zero if b is zero."""
    return np.asarray(np.divide(a, b, out=np.zeros_like(np.asarray(b, dtype=float)), where=b != 0))


def gmres(
    apply: Map, precondition: Map, b: Array, tolerance: float, limit: int, remedy: str
) -> tuple[Array, int]:
    """Solve with any nonsingular matrix by GMRES with a left preconditioner.

    Unlike SciPy's version, it applies the preconditioner only once to b and once per iteration. See
    `conjugate_gradients` for parameters and results. b has shape (n,), and `tolerance` bounds the
    preconditioned residual, an estimate of the error, relative to its value for x = 0.

    Raises `LinearAlgebraError`: a value is not finite, or there is no convergence.
    """
    first = precondition(b)
    size = float(np.linalg.norm(first))
    if size == 0.0:
        return first, 0
    basis = [first / size]
    H = np.zeros((limit + 1, limit))
    unit = np.zeros(limit + 1)
    unit[0] = 1.0
    left = 1.0
    for k in range(limit):
        new = precondition(apply(basis[k]))
        # Arnoldi's method by modified Gram-Schmidt: each product uses the current remainder.
        for j, vector in enumerate(basis):
            H[j, k] = new @ vector
            new -= H[j, k] * vector
        H[k + 1, k] = np.linalg.norm(new)
        if not np.isfinite(H[: k + 2, k]).all():
            raise LinearAlgebraError(f"An iteration of GMRES is not finite: {remedy}")
        part = H[: k + 2, : k + 1]
        weights = np.linalg.lstsq(part, unit[: k + 2], rcond=None)[0]
        left = float(np.linalg.norm(unit[: k + 2] - part @ weights))
        if left <= tolerance:
            x = sum(size * w * vector for w, vector in zip(weights, basis, strict=True))
            return np.asarray(x), k + 1
        # The Krylov space is exhausted, so the division below would not be defined.
        if H[k + 1, k] == 0.0:
            break
        basis.append(new / H[k + 1, k])
    raise LinearAlgebraError(
        f"{limit} iterations of GMRES left a residual of {left:.1e}, with {tolerance:.0e} asked "
        f"for: {remedy}"
    )


# Residual of a solve relative to the right-hand side.
TOLERANCE = 1e-10
ITERATIONS = 200
REMEDY = (
    "multigrid serves scalar second-order equations; install CHOLMOD or Pardiso (pip install "
    "'livepde[solvers]'), so that the matrix is factorised."
)


@dataclass(frozen=True, eq=False)
class MultigridFactor:
    """Multigrid hierarchy of a matrix, and the matrix itself."""

    matrix: sp.csr_array
    levels: Any

    def precondition(self, b: Array) -> Array:
        """Return one V-cycle for each right-hand side: an approximate solution."""
        if b.ndim == 1:
            cycle: Array = self.levels(b)
            return cycle
        return np.stack([self.levels(column) for column in b.T], axis=1)

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to a relative residual of 1e-10; raise `LinearAlgebraError`."""
        return conjugate_gradients(
            self.matrix.__matmul__, self.precondition, b, TOLERANCE, ITERATIONS, REMEDY
        )[0]


@dataclass(frozen=True, eq=False)
class MultigridSolver:
    """Ruge–Stüben multigrid for symmetric positive definite matrices; needs PyAMG."""

    pattern: Pattern
    name: str = "multigrid (PyAMG), conjugate gradients"
    definite: bool = True
    price: float = 1.0

    def factorise(self, data: Array) -> MultigridFactor:
        """Build the hierarchy; raise `LinearAlgebraError` without a finite, positive diagonal."""
        with optional("solvers", "Multigrid needs PyAMG"):
            from pyamg import ruge_stuben_solver

        check_finite(data)
        matrix = self.pattern.matrix(data)
        if not np.all(matrix.diagonal() > 0):
            raise LinearAlgebraError(
                "The matrix is singular or not positive definite: its diagonal holds values that "
                "are not positive. Check the model's forms, or take a smaller time step."
            )
        levels = ruge_stuben_solver(sp.csr_matrix(matrix, copy=True))
        return MultigridFactor(matrix, levels.aspreconditioner(cycle="V").matvec)


def approximate_inverse(factor: Factor) -> Callable[[Array], Array]:
    """Return the preconditioner of a factor: a V-cycle of multigrid, or an exact solve."""
    cycle: Callable[[Array], Array] = getattr(factor, "precondition", factor.solve)
    return cycle


# Largest half bandwidth of banded LU; see the table above for all limits.
WIDEST_BAND = 48
# Largest half bandwidth for which Pardiso is not faster than SuperLU for general matrices.
SMALL = 150
WIDEST_SUPERLU = 500
WIDEST_FACTOR = 2500


@dataclass(frozen=True, eq=False)
class Choice:
    """A solver bound to a pattern, and the reason for its choice."""

    solver: Solver
    reason: str


def analyse(pattern: Pattern, *, symmetric: bool = False, approximate: bool = False) -> Solver:
    """Return the solver for a pattern, as chosen by `choose`."""
    return choose(pattern, symmetric=symmetric, approximate=approximate).solver


def choose(pattern: Pattern, *, symmetric: bool = False, approximate: bool = False) -> Choice:
    """Choose the solver for a pattern by its bandwidth and the installed packages.

    `symmetric`: whether all matrices are symmetric positive definite. `approximate`: whether only
    `approximate_inverse` is required; then multigrid is used from a bandwidth of 500.
    """
    banded = BandedSolver(pattern)
    band = max(banded.band)
    wide = f"a band of {band}"
    if band <= WIDEST_BAND:
        return Choice(banded, f"{wide}, at most {WIDEST_BAND}")
    if symmetric:
        return _choose_definite(pattern, band, wide, approximate)
    superlu = SuperLUSolver(pattern)
    if band <= SMALL:
        return Choice(superlu, f"{wide}, at most {SMALL}")
    if _installed("pypardiso"):
        return Choice(PardisoSolver(pattern), f"{wide}; pypardiso is installed")
    return _superlu(superlu, band, wide)


def _choose_definite(pattern: Pattern, band: int, wide: str, approximate: bool) -> Choice:
    """Return the solver for symmetric positive definite matrices."""
    superlu, cholmod = SuperLUSolver(pattern, True), _installed("sksparse")
    if band <= WIDEST_SUPERLU:
        if cholmod:
            return Choice(CholmodSolver(pattern), f"{wide}; scikit-sparse is installed")
        return Choice(superlu, f"{wide}, at most {WIDEST_SUPERLU}")
    # A V-cycle suffices as an approximate inverse, so multigrid pays for smaller matrices.
    most = WIDEST_SUPERLU if approximate else WIDEST_FACTOR
    multigrid = _installed("pyamg")
    if multigrid and band > most:
        return Choice(MultigridSolver(pattern), f"{wide}, more than {most}")
    if cholmod:
        return Choice(CholmodSolver(pattern, blocks=True), f"{wide}; scikit-sparse is installed")
    if _installed("pypardiso"):
        return Choice(PardisoSolver(pattern, True), f"{wide}; pypardiso is installed")
    if multigrid:
        return Choice(
            MultigridSolver(pattern),
            f"{wide}, more than {WIDEST_SUPERLU}; neither scikit-sparse nor pypardiso is installed",
        )
    return _superlu(superlu, band, wide)


def _superlu(solver: SuperLUSolver, band: int, wide: str) -> Choice:
    """Return SuperLU, which requires no package, if no faster solver is installed."""
    if band <= WIDEST_SUPERLU:
        return Choice(solver, f"{wide}, at most {WIDEST_SUPERLU}")
    return Choice(
        solver, f"{wide}; slow at this size, pip install 'livepde[solvers]' brings a faster one"
    )


def _installed(module: str) -> bool:
    return find_spec(module) is not None
