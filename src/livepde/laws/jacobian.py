"""The Jacobian of a large coupled stage by blocks, and its approximate inverse.

See `livepde.laws.schur` for what they stand for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.laws.triangle import Seam, Triangle
from livepde.linalg import Array, Factor, approximate_inverse, gmres

if TYPE_CHECKING:
    from livepde.laws.schur import BlockSolver

__all__ = ["Approximate", "Jacobian"]

ITERATIONS = 60  # each keeps a vector
PATIENCE = 12  # iterations of GMRES beyond which factors of another point are made again
REMEDY = "take a smaller gain or a smaller time step."


@dataclass(frozen=True, eq=False)
class Jacobian:
    """K at a point, as a `Factor`.

    Attributes
    ----------
    at
        The point y, shape (n + m,).
    S, A, G
        Its blocks on free coefficients; G with its auxiliary unknowns behind.
    rates
        Lumped mass times the rate of each equation of the state, shape (n,).
    back, curved
        Derivatives of A(w)^T r in w and in q; None if they are held or zero.
    border
        (b, a): b a^T is added to S.
    """

    solver: BlockSolver
    at: Array
    S: sp.csr_array
    A: sp.csr_array
    G: sp.csr_array
    rates: Array
    back: sp.csr_array | None
    curved: sp.csr_array | None
    border: tuple[Array, Array] | None = None

    def bordered(self, column: Array, row: Array) -> Jacobian:
        """Return K with column row^T, of shape (n, n), added to S."""
        return replace(self, border=(column, row))

    def apply(self, x: Array) -> Array:
        """Return K x, auxiliary unknowns behind (u, q)."""
        stage = self.solver.stage
        n, size = stage.n, stage.size
        u, q = x[:n], x[n:size]
        out = np.empty_like(x)
        out[:n] = self.S @ u + self.A @ q
        if self.border is not None:
            column, row = self.border
            out[:n] += column * float(row @ u)
        out[n:] = self.G @ x[n:]
        coupling: Array = self.A.T @ (stage.split.R @ u)
        if self.back is not None:
            coupling += np.asarray(self.back @ (stage.W @ (stage.model.X.free * u)))
        if self.curved is not None:
            coupling += self.curved @ q
        out[n:size] -= coupling
        return out

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`.

        The factors at hand precondition, made at another point perhaps; where they do not serve,
        new ones.
        """
        solver = self.solver
        if solver.last is not None:
            try:
                return self._solve(b, solver.last, PATIENCE)
            except LinearAlgebraError:
                pass  # and let go of the factors that did not serve, before others are made
        return self._solve(b, solver.renew(self), ITERATIONS)

    def _solve(self, b: Array, approximate: Approximate, limit: int) -> Array:
        solver, stage = self.solver, self.solver.stage
        n, size = stage.n, stage.size
        padded = np.zeros(size + stage.auxiliary)
        padded[:size] = b
        scale: Array | None = None

        def scaled(r: Array) -> Array:
            nonlocal scale
            z = approximate.whole(r)
            if scale is None:  # u and q count the same
                sizes = [float(np.linalg.norm(part)) or 1.0 for part in (z[:n], z[n:size])]
                counts = [n, len(z) - n]
                scale = np.repeat(1.0 / np.array(sizes), counts)
            z *= scale
            return z

        x, iterations = gmres(self.apply, scaled, padded, solver.tolerance, limit, REMEDY)
        solver.iterations.append(iterations)
        return x[:size]


@dataclass(frozen=True, eq=False)
class Approximate:
    """The approximate inverse of K by factors of S and C, as a `Factor`."""

    blocks: BlockSolver
    at: Array
    state: Factor
    schur: Factor
    rates: Array
    seam: Seam | None

    def solve(self, b: Array) -> Array:
        """Return an approximate solution (u, q), shape (n + m,)."""
        stage = self.blocks.stage
        size = stage.size
        padded = np.zeros(size + stage.auxiliary)
        padded[:size] = b
        return self.whole(padded)[:size]

    def whole(self, b: Array) -> Array:
        """Return the same with auxiliary unknowns behind, of b and of the solution."""
        stage, A = self.blocks.stage, self.blocks.A
        n, size, split, free_q = stage.n, stage.size, stage.split, stage.free_q
        x = np.empty_like(b)
        u = approximate_inverse(self.state)(b[:n])
        right = b[n:].copy()
        right[: size - n] += free_q * np.asarray(A.T @ split.project(u))
        x[n:] = approximate_inverse(self.schur)(right)
        flux = np.asarray(A @ (free_q * x[n:size]))
        u -= split.project(split.project_transposed(flux) / self.rates)
        x[:n] = self.state.again(b[:n] - flux, u) if isinstance(self.state, Triangle) else u
        if self.seam is not None:
            self.seam.mend(b[:n], x[:n], x[n:size])
        for fixed in (stage.model.X.fixed, n + stage.model.Q.fixed):
            x[fixed] = b[fixed]  # which factors that iterate would leave to their tolerance
        return x
