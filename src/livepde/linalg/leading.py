"""The leading unknowns of a larger system, whose other equations have no right-hand side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.linalg.protocol import Factor
from livepde.linalg.types import Array

__all__ = ["Leading"]


@dataclass(frozen=True, eq=False)
class Leading:
    """Solves with the Schur complement of a matrix, by the factor of the matrix itself.

    Parameters
    ----------
    factor
        Of the larger matrix, shape (total, total).
    size, total
        Number of leading unknowns, and of all.
    """

    factor: Factor
    size: int
    total: int

    def solve(self, b: Array) -> Array:
        """Return the leading unknowns for a right-hand side of the leading equations."""
        return self.factor.solve(self._padded(b))[: self.size]

    def _padded(self, b: Array) -> Array:
        padded = np.zeros((self.total, *b.shape[1:]))
        padded[: self.size] = b
        return padded
