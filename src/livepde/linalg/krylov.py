"""Krylov methods with a guaranteed residual, and algebraic multigrid (PyAMG) as preconditioner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError, optional
from livepde.linalg.arrays import Array
from livepde.linalg.direct import Factor, check_finite
from livepde.linalg.pattern import Pattern

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
        Advice for the message of the error if they do not suffice.

    Returns
    -------
    x, iterations
        The solution, and how many it took.

    Raises
    ------
    LinearAlgebraError
        The matrix or the preconditioner is not positive definite, or `limit` was reached.
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
        # beta is (r, z) over that of the iteration before: zero in the first one, by infinity.
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
    """Return a/b, zero where b is zero."""
    ratio: Array = np.divide(a, b, out=np.zeros_like(np.asarray(b, dtype=float)), where=b != 0)
    return ratio


def gmres(
    apply: Map, precondition: Map, b: Array, tolerance: float, limit: int, remedy: str
) -> tuple[Array, int]:
    """Solve with any nonsingular matrix by GMRES with a left preconditioner.

    In contrast to SciPy's, it applies the preconditioner only once for b and once per iteration.
    Parameters and results are those of `conjugate_gradients`, with b of shape (n,), but `tolerance`
    bounds the preconditioned residual, an estimate of the error, relative to that of x = 0.

    Raises
    ------
    LinearAlgebraError
        A value is not finite, or `limit` was reached.
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
        # Arnoldi's method by modified Gram-Schmidt: each product uses what is left.
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
        # The Krylov space is exhausted, and dividing would not be defined.
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
    """Return the preconditioner of a factor: one V-cycle of multigrid, else an exact solve."""
    cycle: Callable[[Array], Array] = getattr(factor, "precondition", factor.solve)
    return cycle
