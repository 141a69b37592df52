"""Schur complement solves by the factor of a larger system."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.linalg.protocol import Factor
from livepde.linalg.types import Array


@dataclass(frozen=True, eq=False)
class Leading:
    """Factor of the Schur complement on the leading unknowns of a factorised matrix.

    Parameters
    ----------
    factor
        Factor of the larger matrix, shape (total, total).
    size, total
        Number of leading unknowns, and of all unknowns.
    """

    factor: Factor
    size: int
    total: int

    def solve(self, b: Array) -> Array:
        """Return the leading unknowns; the right-hand sides of the other equations are zero."""
        # [[E, F], [F^T, H]] (x, y) = (b, 0) gives (E - F H^-1 F^T) x = b.
        return self.factor.solve(self._padded(b))[: self.size]

    def _padded(self, b: Array) -> Array:
        padded = np.zeros((self.total, *b.shape[1:]))
        padded[: self.size] = b
        return padded
