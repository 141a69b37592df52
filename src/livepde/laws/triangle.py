"""Factors of the state block of a large coupled stage, where sensors see coefficients.

See `livepde.laws.schur` for what they stand for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from livepde.linalg import Array, Factor, IntArray, approximate_inverse

__all__ = ["Seam", "Series", "Triangle", "is_symmetric", "masked"]

ROUNDING = 1e-12  # asymmetry of a symmetric matrix, relative to its largest entry
POWERS = 20  # of a matrix, to estimate an eigenvalue
MARGIN = 0.8  # of that estimate
SPREAD = 16.0  # eigenvalues of a matrix near its diagonal, largest over smallest
SERIES = 3e-2  # bound on the error that Chebyshev's iteration leaves


@dataclass(frozen=True, eq=False)
class Seam:
    """Where observed coefficients meet others: there S u + A q = b is solved once more."""

    at: IntArray
    factor: Factor
    S: sp.csr_array
    A: sp.csr_array

    def mend(self, b: Array, u: Array, q: Array) -> None:
        """Change u, in place."""
        u[self.at] += self.factor.solve(b[self.at] - self.S @ u - self.A @ q)


@dataclass(frozen=True, eq=False)
class Triangle:
    """S without M_uo/h: the unobserved part first."""

    parts: tuple[IntArray, IntArray]
    unseen: Factor
    seen: Factor
    link: sp.csr_array
    back: sp.csr_array

    def solve(self, b: Array) -> Array:
        """Return x with S x = b."""
        return self._solve(b, b[self.parts[0]])

    def again(self, b: Array, x: Array) -> Array:
        """Return the same with M_uo/h, from an x that approximates the solution."""
        unseen, seen = self.parts
        return self._solve(b, b[unseen] - self.back @ x[seen])

    def _solve(self, b: Array, above: Array) -> Array:
        unseen, seen = self.parts
        x = np.empty_like(b)
        first = approximate_inverse(self.unseen)(above)
        x[unseen] = first
        x[seen] = approximate_inverse(self.seen)(b[seen] - self.link @ first)
        return x


@dataclass(frozen=True, eq=False)
class Series:
    """Chebyshev's iteration for a matrix K near its diagonal D, as a mass matrix is.

    Attributes
    ----------
    matrix, inverse
        D^{-1} K and the diagonal of D^{-1}.
    low, high
        About its eigenvalues.
    degree
        Products with it, and one.
    """

    matrix: sp.csr_array
    inverse: Array
    low: float
    high: float
    degree: int

    @classmethod
    def of(cls, matrix: sp.csr_array) -> Series | None:
        """Return it for a symmetric matrix K; None where it would take long."""
        diagonal = matrix.diagonal()
        if not (diagonal > 0.0).all() or not is_symmetric(matrix):
            return None
        high = float((abs(matrix).sum(axis=1) / diagonal).max())  # Gershgorin's bound
        # The smallest eigenvalue of D^{-1} K, by the largest of high - D^{-1} K.
        x, size = np.random.default_rng(0).standard_normal(len(diagonal)), 1.0
        for _ in range(POWERS):
            x = high * x - (matrix @ x) / diagonal
            size = float(np.linalg.norm(x))
            x /= size
        low = (high - size) * MARGIN
        if not low * SPREAD >= high:
            return None
        root = np.sqrt(high / low)
        degree = math.ceil(math.log(2.0 / SERIES) / math.log((root + 1.0) / (root - 1.0)))
        scaled = masked(matrix, 1.0 / diagonal, np.ones(len(diagonal)))
        return cls(scaled, 1.0 / diagonal, low, high, degree)

    def solve(self, b: Array) -> Array:
        """Return x with K x = b, but for `SERIES`."""
        middle, half = 0.5 * (self.high + self.low), 0.5 * (self.high - self.low)
        ratio, scaled = half / middle, self.inverse * b
        step = scaled / middle
        x = step.copy()
        for _ in range(self.degree - 1):
            after = 1.0 / (2.0 * middle / half - ratio)
            left: Array = self.matrix @ x
            np.subtract(scaled, left, out=left)
            left *= 2.0 * after / half
            step *= after * ratio
            step += left
            x += step
            ratio = after
        return x


def masked(matrix: sp.csr_array, rows: Array, cols: Array) -> sp.csr_array:
    """Return diag(rows) matrix diag(cols), with the same pattern."""
    data = matrix.data * np.repeat(rows, np.diff(matrix.indptr)) * cols[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), matrix.shape)


def is_symmetric(matrix: sp.csr_array) -> bool:
    """Return whether a matrix is symmetric to rounding."""
    return bool(abs(matrix - matrix.T).max() <= ROUNDING * abs(matrix).max())
