"""LAPACK's banded LU after a bandwidth-reducing permutation: the engine of 1D problems."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from livepde.errors import LinearAlgebraError
from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array, IntArray

__all__ = ["BandedSolver"]


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """LU factors in LAPACK's band storage."""

    lu: Array
    pivots: IntArray
    lower: int
    upper: int
    order: IntArray
    inverse: IntArray

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        x, info = lapack.dgbtrs(
            self.lu, self.lower, self.upper, b[self.order], self.pivots, overwrite_b=1
        )
        if info != 0:
            raise LinearAlgebraError(f"LAPACK dgbtrs refused argument {-info}.")
        solution: Array = x[self.inverse]
        return solution


@dataclass(frozen=True, eq=False)
class BandedSolver:
    """Banded LU of one sparsity pattern; cost n·b² to factorise, n·b to solve."""

    pattern: Pattern
    name: str = "banded LU (LAPACK)"
    definite: bool = False
    price: float = 0.0

    @cached_property
    def order(self) -> IntArray:
        """Reverse Cuthill–McKee order of the unknowns."""
        structure = self.pattern.matrix(np.ones(self.pattern.nnz))
        found: IntArray = reverse_cuthill_mckee(structure + structure.T, symmetric_mode=True)
        return found

    @cached_property
    def inverse(self) -> IntArray:
        """Position of each unknown in `order`."""
        return np.argsort(self.order)

    @cached_property
    def band(self) -> tuple[int, int]:
        """Numbers of lower and upper diagonals in the new order."""
        offset = self.inverse[self.pattern.rows] - self.inverse[self.pattern.indices]
        return max(int(offset.max(initial=0)), 0), max(int(-offset.min(initial=0)), 0)

    @cached_property
    def storage(self) -> tuple[tuple[int, int], IntArray]:
        """Shape of LAPACK's band storage, and where in it each entry of the pattern stands."""
        lower, upper = self.band
        row, col = self.inverse[self.pattern.rows], self.inverse[self.pattern.indices]
        # LAPACK's storage is column major: the flat position counts down the columns.
        height = 2 * lower + upper + 1
        return (self.pattern.shape[0], height), col * height + (lower + upper + row - col)

    def factorise(self, data: Array) -> BandedFactor:
        """Factorise; raises `LinearAlgebraError` for a singular or non-finite matrix."""
        shape, position = self.storage
        storage = np.zeros(shape)
        storage.ravel()[position] = data
        lower, upper = self.band
        lu, pivots, info = lapack.dgbtrf(storage.T, lower, upper, overwrite_ab=1)
        if info != 0 or not math.isfinite(lu[lower + upper].sum()):
            raise LinearAlgebraError(
                f"The {shape[0]} by {shape[0]} matrix is singular or not finite: check the "
                "model's forms, or take a smaller time step."
            )
        return BandedFactor(lu, pivots, lower, upper, self.order, self.inverse)
