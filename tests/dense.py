"""The coupled stage on a line in NumPy, with P1 elements, A(u) q = q u, B(u) = -u''.

Only the damping rules are from livepde, not its forms, spaces or stages. Loops over elements
assemble the matrices, with separate integrals over omega and over the rest.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

import livepde as lp

POINTS, WEIGHTS = np.polynomial.legendre.leggauss(4)
SHAPES = np.array([(1.0 - POINTS) / 2.0, (1.0 + POINTS) / 2.0])  # at the quadrature points


@dataclass(frozen=True, eq=False)
class DenseStage:
    """Residual of one stage with zero Dirichlet values at both ends.

    Attributes
    ----------
    x
        Nodes.
    inside
        Mask of the elements in omega.
    gain, rule, nu, sigma
        Parameters of the law, whose M and N of (MN1), (MN2) are u v + u' v'.
    """

    x: np.ndarray
    inside: np.ndarray
    gain: float
    rule: Any
    nu: float = 0.0
    sigma: float = 0.0

    def assembled(self, elements: np.ndarray, w: np.ndarray | None = None) -> tuple[Any, Any, Any]:
        """Return the matrices of mass, stiffness and A(w) over a subset of elements."""
        n = len(self.x)
        mass, stiff, A = np.zeros((3, n, n))
        for k in np.flatnonzero(elements):
            at, h = [k, k + 1], self.x[k + 1] - self.x[k]
            measure = WEIGHTS * h / 2.0
            mass[np.ix_(at, at)] += np.einsum("ip,jp,p->ij", SHAPES, SHAPES, measure)
            stiff[np.ix_(at, at)] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / h
            if w is not None:
                seen = w[at] @ SHAPES
                A[np.ix_(at, at)] += np.einsum("ip,jp,p->ij", SHAPES, SHAPES, measure * seen)
        return mass, stiff, A

    @cached_property
    def everywhere(self) -> np.ndarray:
        return np.ones(len(self.x) - 1, dtype=bool)

    @cached_property
    def free(self) -> np.ndarray:
        return np.arange(1, len(self.x) - 1)

    @cached_property
    def observed(self) -> np.ndarray:
        """Diagonal of R, which is 1 at the nodes of elements in omega, including its ends."""
        seen = np.zeros(len(self.x))
        seen[:-1][self.inside] = seen[1:][self.inside] = 1.0
        seen[[0, -1]] = 0.0
        return seen

    def dual(self, f: np.ndarray, gram: np.ndarray, among: np.ndarray) -> float:
        """Return the dual norm of a functional restricted to a subset of coefficients."""
        if not len(among):
            return 0.0
        part = f[among]
        return float(np.sqrt(part @ np.linalg.solve(gram[np.ix_(among, among)], part)))

    def lines(
        self, y: np.ndarray, c: np.ndarray, h: float, u_alpha: np.ndarray, F: np.ndarray
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the terms of the equations of u and of q, whose sums are the residuals."""
        n, R, outside = len(self.x), self.observed, ~self.inside
        u, q = y[:n], y[n:]
        r, w = R * u - u_alpha, u_alpha + (1.0 - R) * u
        mass, stiff, _ = self.assembled(self.everywhere)
        mass_in, stiff_in, A_in = self.assembled(self.inside, w)
        mass_out, stiff_out, A_out = self.assembled(outside, u)
        M_op = np.diag(R) @ (mass_in + stiff_in) @ np.diag(R)
        N_op = np.diag(1 - R) @ (mass_in + stiff_in) @ np.diag(1 - R) + mass_out + stiff_out
        reach = np.zeros(n, dtype=bool)
        reach[:-1][outside] = reach[1:][outside] = True
        tests = np.flatnonzero(~reach & (np.arange(n) > 0) & (np.arange(n) < n - 1))

        def norms(v: np.ndarray, *seen: Any) -> lp.laws.Residual:
            Mv = M_op @ v
            return lp.laws.Residual(
                v @ mass_in @ v, v @ Mv, lambda: self.dual(Mv, mass, tests) ** 2, *seen
            )

        weight = self.rule.theta(norms(r, lambda: norms(u_alpha)))
        gram = mass + stiff
        state = [
            mass @ (u - c[:n]) / h,
            stiff_in @ w + stiff_out @ u + self.nu * N_op @ u,
            A_in @ q + A_out @ q,
            weight * M_op @ r,
            -F,
        ]
        learned = [
            gram @ (q - c[n:]) / (self.gain * h) + self.sigma / self.gain * gram @ q,
            -A_in.T @ r,
        ]
        return state, learned

    def relative(self, *args: Any) -> float:
        """Return the larger residual of both equations over its largest term, in the dual norm."""
        mass, stiff, _ = self.assembled(self.everywhere)
        n = len(self.x)
        residuals = []
        for line, gram, among in zip(
            self.lines(*args), (mass, mass + stiff), (self.free, np.arange(n)), strict=True
        ):
            sizes = [self.dual(term, gram, among) for term in line]
            residuals.append(self.dual(sum(line), gram, among) / max(max(sizes), 1e-300))
        return max(residuals)
