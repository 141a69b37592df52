"""Distributed matrices solved by PETSc.

Symmetric positive definite matrices are solved by conjugate gradients and algebraic multigrid
(GAMG), others by sparse LU (MUMPS or SuperLU_DIST, as available in PETSc). Each rank owns a strip
of rows in Cuthill-McKee order, so that strips are coupled to their neighbours only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, BandedSolver, IntArray, Pattern
from livepde.parallel.team import Handle, Team

__all__ = ["PetscFactor", "PetscSolver", "direct", "krylov", "owned"]

# Residual relative to the right-hand side.
TOLERANCE = 1e-10
ITERATIONS = 200
DIRECT = ("mumps", "superlu_dist")
REMEDY = (
    "multigrid serves scalar second-order equations; without --engine petsc the matrix is "
    "factorised."
)


def direct() -> str | None:
    """Return the parallel sparse LU available in PETSc, or None."""
    from petsc4py import PETSc

    return next((name for name in DIRECT if PETSc.Sys.hasExternalPackage(name)), None)


def owned(comm: Any, size: int, csr: tuple[IntArray, IntArray, Array], columns: int) -> Any:
    """Return a PETSc matrix from the rows of this rank, with sorted global column numbers.

    Parameters
    ----------
    size, columns
        Number of rows and columns owned by this rank.
    """
    from petsc4py import PETSc

    indptr, indices, data = csr
    types = (np.asarray(indptr, PETSc.IntType), np.asarray(indices, PETSc.IntType), data)
    layout = ((size, PETSc.DETERMINE), (columns, PETSc.DETERMINE))
    matrix = PETSc.Mat().createAIJ(layout, csr=types, comm=comm)
    matrix.assemble()
    return matrix


def krylov(matrix: Any, symmetric: bool) -> Any:
    """Return PETSc's solver of a matrix, set up; raise `LinearAlgebraError` on every rank."""
    from petsc4py import PETSc

    ksp = PETSc.KSP().create(matrix.getComm())
    ksp.setOperators(matrix)
    ksp.setTolerances(rtol=TOLERANCE, atol=0.0, max_it=ITERATIONS)
    pc = ksp.getPC()
    if symmetric:
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        diagonal = matrix.getDiagonal()
        least = diagonal.min()[1]
        diagonal.destroy()
        if not least > 0.0:
            raise LinearAlgebraError(
                "The matrix is singular or not positive definite: its diagonal holds values that "
                "are not positive. Check the model's forms, or take a smaller time step."
            )
        ksp.setType(PETSc.KSP.Type.CG)
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        pc.setType(PETSc.PC.Type.GAMG)
    else:
        ksp.setType(PETSc.KSP.Type.PREONLY)
        pc.setType(PETSc.PC.Type.LU)
        pc.setFactorSolverType(direct())
    ksp.setUp()
    if not symmetric and not _serves(ksp, matrix):
        raise LinearAlgebraError(
            f"The {matrix.size[0]} by {matrix.size[1]} matrix is singular: check the model's "
            "forms, or take a smaller time step."
        )
    return ksp


def _serves(ksp: Any, matrix: Any) -> bool:
    """Return True if a test solve is finite: a zero pivot shows in a solve only."""
    x, b = matrix.createVecs()
    b.set(1.0)
    ksp.solve(b, x)
    good = ksp.getConvergedReason() > 0 and bool(np.isfinite(x.norm()))
    x.destroy()
    b.destroy()
    return good


class _Pattern:
    """Rows of a pattern owned by a rank."""

    def __init__(
        self,
        team: Team,
        rows: IntArray,
        counts: IntArray,
        symmetric: bool,
        indptr: list[IntArray] | None,
        indices: list[IntArray] | None,
    ) -> None:
        self.symmetric = symmetric
        self.rows = rows
        self.size = int(rows[team.rank])
        self.indptr = np.empty(self.size + 1, dtype=np.int32)
        self.indices = np.empty(int(counts[team.rank]), dtype=np.int32)
        team.scatter(indptr, self.indptr)
        team.scatter(indices, self.indices)

    def close(self) -> None:
        """Do nothing: no PETSc object is held."""


class _Factor:
    """Local part of a distributed matrix and its solver."""

    def __init__(self, team: Team, pattern: int, data: list[Array] | None) -> None:
        self.team = team
        self.pattern: _Pattern = team.part(pattern)
        size = self.pattern.size
        mine = np.empty(len(self.pattern.indices))
        team.scatter(data, mine)
        csr = (self.pattern.indptr, self.pattern.indices, mine)
        self.matrix = owned(team.comm, size, csr, size)
        self.ksp = krylov(self.matrix, self.pattern.symmetric)
        self.right, self.left = self.matrix.createVecs()

    def close(self) -> None:
        """Free the PETSc objects, collectively on all ranks."""
        for item in (self.ksp, self.matrix, self.right, self.left):
            item.destroy()

    def solve(self, many: int, once: bool, pieces: list[Array] | None) -> list[Array] | None:
        """Solve, or apply the preconditioner once if `once`, for each column."""
        b = np.empty((self.pattern.size, many))
        self.team.scatter(pieces, b)
        for k in range(many):
            self.right.setArray(b[:, k])
            if once:
                self.ksp.getPC().apply(self.right, self.left)
            else:
                self.ksp.solve(self.right, self.left)
                self._check()
            b[:, k] = self.left.getArray(readonly=True)
        return self.team.gather(b, self.pattern.rows)

    def _check(self) -> None:
        reason = self.ksp.getConvergedReason()
        if reason < 0:
            raise LinearAlgebraError(
                f"PETSc ended after {self.ksp.getIterationNumber()} iterations with reason "
                f"{reason} and a residual of {self.ksp.getResidualNorm():.1e}: {REMEDY}"
            )


@dataclass(frozen=True, eq=False)
class PetscFactor:
    """Factor of a matrix in PETSc."""

    solver: PetscSolver
    shared: Handle

    def solve(self, b: Array) -> Array:
        """Return x with K x = b, by iterations to a relative residual of 1e-10."""
        return self.solver.through(self.shared, b, once=False)

    def precondition(self, b: Array) -> Array:
        """Return an approximate solution: one multigrid cycle, or the solution by LU."""
        return self.solver.through(self.shared, b, once=True)


@dataclass(frozen=True, eq=False)
class PetscSolver:
    """PETSc solver on all ranks of a team for one pattern; a `livepde.linalg.Solver`."""

    team: Team
    pattern: Pattern
    symmetric: bool

    @property
    def name(self) -> str:
        """Name of the solver for messages."""
        what = "conjugate gradients, GAMG" if self.symmetric else f"LU ({direct()})"
        return f"PETSc: {what}"

    @property
    def definite(self) -> bool:
        """True if conjugate gradients are used."""
        return self.symmetric

    @property
    def price(self) -> float:
        """Approximate cost of a factorisation in solves."""
        return 1.0 if self.symmetric else 20.0

    @cached_property
    def _order(self) -> tuple[IntArray, IntArray]:
        """Order of the rows, and start of each rank's strip."""
        order = BandedSolver(self.pattern).order
        entries = np.cumsum(np.diff(self.pattern.indptr)[order])
        shares = entries[-1] * np.arange(1, self.team.size) / self.team.size
        return order, np.concatenate([[0], np.searchsorted(entries, shares), [len(order)]])

    @cached_property
    def _spread(self) -> tuple[Handle, IntArray, IntArray]:
        """Shared pattern, permutation of the data, and start of each rank's data."""
        order, bounds = self._order
        pattern = self.pattern
        numbers = np.arange(pattern.nnz)
        parts = (numbers, pattern.indices, pattern.indptr)
        moved = sp.csr_array(sp.csr_array(parts, shape=pattern.shape)[order][:, order])
        moved.sort_indices()
        starts = moved.indptr[bounds]
        indptr = [moved.indptr[a : b + 1] - moved.indptr[a] for a, b in pairwise(bounds)]
        indices = self._cut(moved.indices, starts)
        sent = (np.diff(bounds), np.diff(starts), self.symmetric)
        here = ([p.astype(np.int32) for p in indptr], [p.astype(np.int32) for p in indices])
        return self.team.share(_Pattern, *sent, here=here), moved.data, starts

    @staticmethod
    def _cut(values: Any, starts: IntArray) -> list[Any]:
        return [values[a:b] for a, b in pairwise(starts)]

    def factorise(self, data: Array) -> PetscFactor:
        """Factorise, or set up multigrid; raise `LinearAlgebraError` on failure."""
        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        pattern, where, starts = self._spread
        pieces = self._cut(data[where], starts)
        return PetscFactor(self, self.team.share(_Factor, pattern.key, here=(pieces,)))

    def through(self, factor: Handle, b: Array, once: bool) -> Array:
        """Apply a factor to right-hand sides of shape (n,) or (n, k)."""
        order, bounds = self._order
        columns = b.reshape(len(b), -1)
        pieces = self._cut(columns[order], bounds)
        found = factor("solve", columns.shape[1], once, here=(pieces,))
        x = np.empty_like(columns)
        x[order] = np.concatenate(found)
        return x.reshape(b.shape)
