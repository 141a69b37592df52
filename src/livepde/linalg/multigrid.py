"""Conjugate gradients preconditioned by algebraic multigrid (PyAMG)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError, optional
from livepde.linalg.krylov import conjugate_gradients
from livepde.linalg.pattern import Pattern
from livepde.linalg.protocol import Factor
from livepde.linalg.types import Array

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
        """Return x with K x = b to a relative residual of 1e-10; raises `LinearAlgebraError`."""
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
        """Build the hierarchy; raises `LinearAlgebraError` for a non-finite or zero diagonal."""
        with optional("solvers", "Multigrid needs PyAMG"):
            from pyamg import ruge_stuben_solver

        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        matrix = self.pattern.matrix(data)
        if not np.all(matrix.diagonal() > 0):
            raise LinearAlgebraError(
                "The matrix is singular or not positive definite: its diagonal holds values that "
                "are not positive. Check the model's forms, or take a smaller time step."
            )
        levels = ruge_stuben_solver(sp.csr_matrix(matrix, copy=True))
        return MultigridFactor(matrix, levels.aspreconditioner(cycle="V").matvec)


def approximate_inverse(factor: Factor) -> Callable[[Array], Array]:
    """Return the preconditioner of a factor: one V-cycle of multigrid, else an exact solve."""
    cycle: Callable[[Array], Array] = getattr(factor, "precondition", factor.solve)
    return cycle
