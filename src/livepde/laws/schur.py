"""Large coupled stages: GMRES, preconditioned by factors of the state block and of a Schur block.

The Jacobian of a stage of `livepde.laws.coupled` is

    K = [[S, A], [-A^T R - ..., G]],    G = G_Q/(gain h) + ...

and its Schur complement G + (A^T R + ...) S^{-1} A is dense. With D, the lumped mass over h, in the
place of S it is sparse,

    C = G + A^T R D^{-1} R^T A,

and [[S, 0], [-A^T R - ..., C]] is the preconditioner: a solve with a factor of S and one with that
of C. D^{-1} is the better in the place of S^{-1} the smoother what it is applied to and the shorter
h; the larger the gain, the more this counts.

The factors are kept while that pays (`livepde.linalg.Costs`). That changes how many iterations it
takes, not to which tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.linalg import (
    Array,
    Costs,
    Factor,
    IntArray,
    Pattern,
    Solver,
    analyse,
    approximate_inverse,
    gmres,
)

__all__ = ["LARGE", "BlockSolver", "Blocks"]

LARGE = 4000  # unknowns u and q together, from which a matrix that is not banded goes by blocks
TOLERANCE = 1e-2  # of u and of q, relative to their first approximation: Newton goes on from there
ITERATIONS = 60  # each keeps a vector; with factors that need more, new ones are cheaper
REMEDY = "take a smaller gain or a smaller time step."


class BlockSolver:
    """Solves the coupled systems of a stage by blocks.

    Parameters
    ----------
    pattern
        Of the coupled matrix.
    n
        Number of coefficients of u, the leading unknowns.
    R
        Projection on the observed part of the state, shape (n, n).
    mass
        Mass matrix on the free coefficients, shape (n, n).
    symmetric
        Which of S and C are symmetric positive definite.

    Attributes
    ----------
    iterations
        Of each solve with the factors at hand.
    costs
        Of these factors.
    tolerance
        To which systems are solved.
    cycles
        C is not factorised where a cycle of multigrid is cheaper; false after one was not enough.
    """

    def __init__(
        self,
        pattern: Pattern,
        n: int,
        R: sp.csr_array,
        mass: sp.csr_array,
        symmetric: tuple[bool, bool],
    ) -> None:
        self.pattern = pattern
        self.n = n
        self.R = R
        self.observed = R.diagonal()
        self.symmetric = symmetric
        lumped = np.asarray(abs(mass).sum(axis=1)).ravel()
        self.lumped = np.where(lumped > 0.0, lumped, 1.0)  # fixed coefficients have no mass
        self.iterations: list[int] = []
        self._factors: tuple[Factor, Factor] | None = None
        self.costs = Costs(0.0, ITERATIONS)
        self.tolerance = TOLERANCE
        self.cycles = True
        self._schur: Solver | None = None

    @cached_property
    def _blocks(self) -> dict[str, tuple[IntArray, Pattern]]:
        """Which data of the whole are those of a block, and its pattern."""
        n, size = self.n, self.pattern.shape[0]
        rows, cols = self.pattern.rows, self.pattern.indices
        parts = {"u": (rows < n, cols < n, 0, n), "q": (rows >= n, cols >= n, n, size - n)}
        blocks: dict[str, tuple[IntArray, Pattern]] = {}
        for i, (mine, _, row, height) in parts.items():
            for j, (_, theirs, col, width) in parts.items():
                at = np.flatnonzero(mine & theirs)
                inner = Pattern.from_entries(rows[at] - row, cols[at] - col, (height, width))
                blocks[i + j] = (at, inner)
        return blocks

    def block(self, data: Array, name: str) -> sp.csr_array:
        """Return the block "uu", "uq", "qu" or "qq" of the matrix with these data."""
        at, pattern = self._blocks[name]
        return pattern.matrix(data[at])

    @cached_property
    def _state(self) -> Solver:
        return analyse(self._blocks["uu"][1], symmetric=self.symmetric[0])

    def factorise(self, data: Array, h: float, theta: float) -> Blocks:
        """Return what solves with the coupled matrix.

        Parameters
        ----------
        data
            In the order of `pattern`.
        h, theta
            The state follows its equation at about the rate 1/h, and theta more where observed.
        """
        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        return Blocks(self, data, 1.0 / h + theta * self.observed)

    def factors(self, data: Array, rate: Array, renew: bool) -> tuple[Factor, Factor]:
        """Return the factors of S and C: the kept ones, or new ones where they are due."""
        if self._factors is None or renew or self.costs.due:
            start = perf_counter()
            S = self._state.factorise(data[self._blocks["uu"][0]])
            A = sp.csr_array(self.R.T @ self.block(data, "uq"))
            D = sp.diags_array(1.0 / (self.lumped * rate))
            C = sp.csr_array(self.block(data, "qq") + A.T @ D @ A)
            C.sort_indices()
            self._factors = S, self._engine(Pattern.of(C)).factorise(C.data)
            self.costs, self.iterations = Costs(perf_counter() - start, ITERATIONS), []
        return self._factors

    def _engine(self, pattern: Pattern) -> Solver:
        """Return the engine of C; its pattern may change, since sums drop what is zero."""
        last = self._schur
        if last is None or not (
            np.array_equal(last.pattern.indptr, pattern.indptr)
            and np.array_equal(last.pattern.indices, pattern.indices)
        ):
            last = analyse(pattern, symmetric=self.symmetric[1], approximate=self.cycles)
        self._schur = last
        return last

    @property
    def engines(self) -> tuple[str, str]:
        """Names of the engines of S and C; the latter is known once it was needed."""
        return self._state.name, "" if self._schur is None else self._schur.name

    def without_cycles(self) -> None:
        """Factorise C from now on."""
        self.cycles, self._schur = False, None

    def account(self, iterations: int, seconds: float) -> None:
        """Take note of a solve."""
        self.iterations.append(iterations)
        self.costs.add(iterations, seconds)


@dataclass(frozen=True, eq=False)
class Blocks:
    """A coupled matrix, with the rate of each equation of the state; as a `Factor`.

    `border` = (b, a) adds b a^T to the state block.
    """

    solver: BlockSolver
    data: Array
    rate: Array
    border: tuple[Array, Array] | None = None

    def bordered(self, column: Array, row: Array) -> Blocks:
        """Return this matrix with column row^T, of shape (n, n), added to the state block."""
        return replace(self, border=(column, row))

    def _apply(self, x: Array) -> Array:
        product: Array = self.solver.pattern.matrix(self.data) @ x
        if self.border is not None:
            column, row = self.border
            n = self.solver.n
            product[:n] += column * float(row @ x[:n])
        return product

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`."""
        try:
            return self._solve(b, renew=False)
        except LinearAlgebraError:
            pass
        try:
            return self._solve(b, renew=True)
        except LinearAlgebraError:
            if not self.solver.cycles:
                raise
        self.solver.without_cycles()
        return self._solve(b, renew=True)

    def _solve(self, b: Array, renew: bool) -> Array:
        solver, n = self.solver, self.solver.n
        S, C = map(approximate_inverse, solver.factors(self.data, self.rate, renew))
        coupling = solver.block(self.data, "qu")

        def precondition(r: Array) -> Array:
            u = S(r[:n])
            return np.concatenate([u, C(r[n:] - coupling @ u)])

        scale: Array | None = None

        def scaled(r: Array) -> Array:
            nonlocal scale
            z = precondition(r)
            if scale is None:  # u and q count the same
                sizes = [float(np.linalg.norm(part)) or 1.0 for part in (z[:n], z[n:])]
                scale = np.repeat(1.0 / np.array(sizes), [n, len(b) - n])
            z *= scale
            return z

        start = perf_counter()
        x, iterations = gmres(self._apply, scaled, b, solver.tolerance, ITERATIONS, REMEDY)
        solver.account(iterations, perf_counter() - start)
        return x
