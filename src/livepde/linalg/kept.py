"""A factor that outlives its matrix: preconditioner of a Krylov method for the next ones."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import scipy.sparse as sp

from livepde.linalg.krylov import conjugate_gradients, gmres
from livepde.linalg.multigrid import approximate_inverse
from livepde.linalg.pattern import Pattern
from livepde.linalg.protocol import Factor, Solver
from livepde.linalg.types import Array

__all__ = ["Costs", "KeptSolver"]

TOLERANCE = 1e-10  # of the residual (conjugate gradients) or about of the error (GMRES)
ITERATIONS = 60
REMEDY = "the matrix has moved too far from the one that was factorised; take a smaller time step."


@dataclass
class Costs:
    """What the last factor and the solves with it have cost: the rule of when to factorise again.

    Attributes
    ----------
    factor
        Seconds of the last factorisation.
    iteration
        Seconds of an iteration: a solve with the factor, and a product.
    extra
        Iterations that a solve took beyond the first.
    solves
        Solves with the last matrix.
    """

    factor: float = 0.0
    iteration: float = 0.0
    extra: int = 0
    solves: int = 0

    @property
    def due(self) -> bool:
        """True if a matrix's solves with the old factor cost more than a new factor.

        >>> Costs(factor=1.0, iteration=0.05, extra=4, solves=2).due
        False
        >>> Costs(factor=1.0, iteration=0.05, extra=4, solves=10).due
        True
        """
        return self.solves * self.extra * self.iteration > self.factor


class KeptSolver:
    """An engine that keeps a factor while that is cheaper than a new one.

    `factorise` returns at once while iterations with the old factor cost less than the measured
    factorisation: conjugate gradients for symmetric positive definite matrices, otherwise GMRES,
    to a tolerance of 1e-10. With a factor 10 to 50 % off that takes 4 or 5 iterations. What is
    solved with a matrix before it is due to be factorised depends on measured times: results
    agree to the tolerance, not to the last digit.

    Parameters
    ----------
    inner
        The engine that factorises.
    symmetric
        Every matrix is symmetric positive definite.
    """

    def __init__(self, inner: Solver, *, symmetric: bool = False) -> None:
        self.inner = inner
        self.symmetric = symmetric
        self.costs = Costs()
        self._factor: Factor | None = None

    @property
    def name(self) -> str:
        """How the engine introduces itself."""
        method = "conjugate gradients" if self.symmetric else "GMRES"
        return f"{self.inner.name}, kept for {method}"

    @property
    def definite(self) -> bool:
        """As the inner engine."""
        return self.inner.definite

    @property
    def pattern(self) -> Pattern:
        """The sparsity pattern it is bound to."""
        return self.inner.pattern

    def factorise(self, data: Array) -> Factor:
        """Return what solves with this matrix; raises as the inner engine does."""
        if self._factor is None or self.costs.due or not np.isfinite(data).all():
            start = perf_counter()
            self._factor = self.inner.factorise(data)
            self.costs = Costs(perf_counter() - start)
            return self._factor
        self.costs.solves = 0
        matrix = self.pattern.matrix(data)
        return _Preconditioned(matrix, self._factor, self.costs, self.symmetric)


@dataclass(frozen=True, eq=False)
class _Preconditioned:
    matrix: sp.csr_array
    factor: Factor
    costs: Costs
    symmetric: bool

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance."""
        start = perf_counter()
        apply, precondition = self.matrix.__matmul__, approximate_inverse(self.factor)
        if self.symmetric:
            x, iterations = conjugate_gradients(
                apply, precondition, b, TOLERANCE, ITERATIONS, REMEDY
            )
        else:
            columns = b.reshape(len(b), -1).T
            found = [
                gmres(apply, precondition, column, TOLERANCE, ITERATIONS, REMEDY)
                for column in columns
            ]
            x = np.stack([column for column, _ in found], axis=1).reshape(b.shape)
            iterations = max((count for _, count in found), default=0)
        costs = self.costs
        costs.solves += 1
        costs.extra = max(iterations - 1, 0)
        costs.iteration = (perf_counter() - start) / max(iterations, 1)
        return x
