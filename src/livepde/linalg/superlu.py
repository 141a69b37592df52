"""SciPy's SuperLU: the default engine for general sparse matrices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from livepde.errors import LinearAlgebraError
from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array

SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}
# Bound on the backward error of a test solve. A factor without pivot growth is far below it.
STABLE = 1e-10


@dataclass(frozen=True, eq=False)
class SuperLUFactor:
    """LU factors of the transpose: a CSR matrix read as CSC is its transpose, without a copy."""

    lu: Any
    symmetric: bool = False

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        # SuperLU solves the transposed system column by column; the other one takes all columns at
        # once, which is up to 1.5 times faster, but slower for a single column.
        several = b.ndim > 1 and b.shape[1] > 1
        x: Array = self.lu.solve(b, trans="N" if self.symmetric and several else "T")
        return x


@dataclass(frozen=True, eq=False)
class SuperLUSolver:
    """Sparse LU of one pattern; `symmetric` for symmetric positive definite matrices.

    The symmetric mode orders A + A^T and does not pivot, which is 1.6 to 9 times cheaper. If the
    residual of a test solve is large, the matrix is not positive definite, and is refused.
    """

    pattern: Pattern
    symmetric: bool = False
    price: float = 30.0

    @property
    def name(self) -> str:
        """Name of the solver for messages."""
        return "SuperLU (SciPy)" + (", symmetric mode" if self.symmetric else "")

    @property
    def definite(self) -> bool:
        """False: SuperLU does not check the signs of pivots."""
        return False

    def factorise(self, data: Array) -> SuperLUFactor:
        """Factorise; raise `LinearAlgebraError` for a singular or non-finite matrix.

        In symmetric mode it is also raised for an indefinite matrix, unless its factor is accurate.
        """
        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        transpose = sp.csc_array(self.pattern.transposed(data))
        options = SYMMETRIC if self.symmetric else {}
        n, or_so = transpose.shape[0], " or not positive definite" if self.symmetric else ""
        message = (
            f"The {n} by {n} matrix is singular{or_so}: check the model's forms, or take a smaller "
            "time step."
        )
        try:
            factor = SuperLUFactor(splu(transpose, **options), self.symmetric)
        except RuntimeError as error:
            raise LinearAlgebraError(message) from error
        if self.symmetric:
            # Without pivoting, an indefinite matrix can have a factor with large element growth. A
            # test solve detects that; SuperLU itself reports exact zeros only.
            b = np.cos(np.arange(n))  # of no symmetry that could hide an error
            x = factor.solve(b)
            size = np.abs(data).max() * np.abs(x).max() + 1.0
            if not np.abs(self.pattern.matrix(data) @ x - b).max() <= STABLE * size:
                raise LinearAlgebraError(message)
        return factor


def positive_definite(matrix: sp.csr_array) -> bool:
    """Return True if a symmetric matrix is positive definite: all its pivots are positive.

    By Sylvester's law of inertia, which applies if rows and columns are permuted together.
    """
    try:
        lu = splu(sp.csc_array(matrix), **SYMMETRIC)
    except RuntimeError:
        return False
    return bool(np.array_equal(lu.perm_r, lu.perm_c) and np.all(lu.U.diagonal() > 0))
