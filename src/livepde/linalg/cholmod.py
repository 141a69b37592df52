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

    Parameters
    ----------
    blocks
        Whether the factor has dense blocks (supernodal, L L^T) or none (simplicial, L D L^T).
        Blocks are faster to compute for wide bands, and slower to solve with at any size.
    """

    pattern: Pattern
    blocks: bool = False
    definite: bool = True
    price: float = 35.0

    @property
    def name(self) -> str:
        """Name of the solver for messages."""
        return f"CHOLMOD (scikit-sparse), {'supernodal' if self.blocks else 'simplicial'}"

    @cached_property
    def _order(self) -> Any:
        from sksparse.cholmod import analyze

        mode = "supernodal" if self.blocks else "simplicial"
        return analyze(self._matrix(np.ones(self.pattern.nnz)), mode=mode)

    def _matrix(self, data: Array) -> sp.csc_matrix:
        # A symmetric matrix is its transpose; scikit-sparse knows no sparse arrays.
        return sp.csc_matrix((data, self.pattern.indices, self.pattern.indptr), self.pattern.shape)

    def factorise(self, data: Array) -> CholmodFactor:
        """Factorise; raise `LinearAlgebraError` unless positive definite and finite."""
        from sksparse.cholmod import CholmodNotPositiveDefiniteError

        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        n = self.pattern.shape[0]
        failure = LinearAlgebraError(
            f"The {n} by {n} matrix is singular or not positive definite: check the model's "
            "forms, or take a smaller time step."
        )
        try:
            factor = self._order.cholesky(self._matrix(data))
        except CholmodNotPositiveDefiniteError as error:
            raise failure from error
        # L D L^T also exists for indefinite matrices.
        if not (self.blocks or (factor.D() > 0.0).all()):
            raise failure
        return CholmodFactor(factor)
