"""Cholesky factors of large symmetric positive definite matrices by CHOLMOD (scikit-sparse)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array

__all__ = ["CholmodSolver"]


@dataclass(frozen=True, eq=False)
class CholmodFactor:
    """Cholesky factor of CHOLMOD."""

    inner: Any

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        x: Array = self.inner(b)
        return x


@dataclass(frozen=True, eq=False)
class CholmodSolver:
    """Sparse Cholesky of one pattern with a fixed fill-reducing order; needs scikit-sparse.

    A successful factorisation proves that the matrix is positive definite.
    """

    pattern: Pattern
    name: str = "CHOLMOD (scikit-sparse)"
    definite: bool = True
    price: float = 20.0

    @cached_property
    def _order(self) -> Any:
        from sksparse.cholmod import analyze

        # The other mode computes L D L^T, which also exists for indefinite matrices.
        return analyze(self._matrix(np.ones(self.pattern.nnz)), mode="supernodal")

    def _matrix(self, data: Array) -> sp.csc_matrix:
        # A symmetric matrix is its transpose; scikit-sparse knows no sparse arrays.
        return sp.csc_matrix((data, self.pattern.indices, self.pattern.indptr), self.pattern.shape)

    def factorise(self, data: Array) -> CholmodFactor:
        """Factorise; raise `LinearAlgebraError` unless positive definite and finite."""
        from sksparse.cholmod import CholmodNotPositiveDefiniteError

        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        try:
            return CholmodFactor(self._order.cholesky(self._matrix(data)))
        except CholmodNotPositiveDefiniteError as error:
            n = self.pattern.shape[0]
            raise LinearAlgebraError(
                f"The {n} by {n} matrix is singular or not positive definite: check the model's "
                "forms, or take a smaller time step."
            ) from error
