"""Factors that outlive their matrix: preconditioners of a Krylov method for the next ones."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from livepde.errors import LinearAlgebraError
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
    """The rule of when a kept factor is made again.

    Iterations beyond those with a new factor take time. Once it adds up to that of the
    factorisation, a new one is due: all in all that costs at most twice as much as if one had known
    what would come.

    Attributes
    ----------
    factor
        Measured seconds of the factorisation.
    least
        Fewest iterations of a solve so far; at first, what it takes with a new factor, or more.
    extra
        Seconds of what iterations there were beyond `least`.

    >>> costs = Costs(factor=1.0, least=1)
    >>> for _ in range(3):
    ...     costs.add(iterations=5, seconds=0.5)
    >>> round(costs.extra, 3), costs.due
    (1.2, True)
    """

    factor: float
    least: int
    extra: float = 0.0

    @property
    def due(self) -> bool:
        """True if keeping the factor has cost more than a new one."""
        return self.extra > self.factor

    def add(self, iterations: int, seconds: float) -> None:
        """Account for a solve."""
        if iterations:
            self.least = min(self.least, iterations)
            self.extra += seconds * (1.0 - self.least / iterations)


class KeptSolver:
    """An engine that keeps a factor while that is cheaper than a new one (`Costs`).

    Other matrices than the one factorised are solved by iterations that the factor preconditions:
    conjugate gradients if they are symmetric positive definite, otherwise GMRES, to a tolerance of
    1e-10. When the matrix has moved by 10 to 50 % that takes 4 or 5. How often it is factorised
    goes by measured times: results are the same to the tolerance, not to the last digit.

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
        self.costs = Costs(0.0, 1)
        self._kept: tuple[Array, Factor] | None = None

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
        if self._kept is None or self.costs.due or not np.isfinite(data).all():
            self._renew(data)
        return _KeptFactor(self, data)

    def _renew(self, data: Array) -> Factor:
        start = perf_counter()
        factor = self.inner.factorise(data)
        self._kept, self.costs = (data, factor), Costs(perf_counter() - start, 1)
        return factor

    def solve(self, data: Array, b: Array) -> Array:
        """Return x with `pattern.matrix(data)` x = b, by the factor at hand or by a new one."""
        if self._kept is None:
            return self._renew(data).solve(b)
        known, factor = self._kept
        if known is data:
            return factor.solve(b)
        if not self.costs.due:
            try:
                return self._iterated(data, factor, b)
            except LinearAlgebraError:  # too far from the matrix that was factorised
                pass
        return self._renew(data).solve(b)

    def _iterated(self, data: Array, factor: Factor, b: Array) -> Array:
        start = perf_counter()
        apply, precondition = self.pattern.matrix(data).__matmul__, approximate_inverse(factor)
        if self.symmetric:
            x, iterations = conjugate_gradients(
                apply, precondition, b, TOLERANCE, ITERATIONS, REMEDY
            )
        else:
            found = [
                gmres(apply, precondition, column, TOLERANCE, ITERATIONS, REMEDY)
                for column in b.reshape(len(b), -1).T
            ]
            x = np.stack([column for column, _ in found], axis=1).reshape(b.shape)
            iterations = max(count for _, count in found)
        self.costs.add(iterations, perf_counter() - start)
        return x


@dataclass(frozen=True, eq=False)
class _KeptFactor:
    """A matrix of a `KeptSolver`."""

    solver: KeptSolver
    data: Array

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        return self.solver.solve(self.data, b)
