"""Banded LU by LAPACK after a bandwidth-reducing permutation: the solver of 1D problems."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from livepde.errors import LinearAlgebraError
from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array, IntArray

# Number of entries of a triangle up to which copying it costs more than the faster solve saves.
FEW = 300


@dataclass(frozen=True, eq=False)
class BandedFactor:
    """LU factors in LAPACK's band storage."""

    lu: Array
    pivots: IntArray
    lower: int
    upper: int
    order: IntArray
    inverse: IntArray
    units: Array | None

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        units = self.units if self.units is None or b.ndim == 1 else self.units[:, None]
        x: Array = (b if units is None else b * units)[self.order]
        if b.ndim == 1 and self._triangles is not None:
            L, U = self._triangles
            x = blas.dtbsv(self.lower, L, x, lower=1, diag=1, overwrite_x=1)
            x = blas.dtbsv(self.upper, U, x, overwrite_x=1)
        else:
            x, info = lapack.dgbtrs(self.lu, self.lower, self.upper, x, self.pivots, overwrite_b=1)
            if info != 0:
                raise LinearAlgebraError(f"LAPACK dgbtrs refused argument {-info}.")
        return x[self.inverse] if units is None else x[self.inverse] * units

    @cached_property
    def _triangles(self) -> tuple[Array, Array] | None:
        """L and U in band storage, if no rows were exchanged and triangular solves are faster."""
        # With row exchanges L is a product with permutations, and no triangle in band storage.
        if self.lower * len(self.pivots) < FEW or not np.array_equal(
            self.pivots, np.arange(len(self.pivots))
        ):
            return None
        diagonal = self.lower + self.upper
        return np.asfortranarray(self.lu[diagonal:]), np.asfortranarray(
            self.lu[self.lower : diagonal + 1]
        )


@dataclass(frozen=True, eq=False)
class BandedSolver:
    """Banded LU of one sparsity pattern; n·b² operations to factorise, n·b to solve.

    With `units`, powers of two of shape (n,), the scaled matrix units K units is factorised: with a
    diagonal of about one it needs few row exchanges, and a factorisation without them takes a third
    of the time.
    """

    pattern: Pattern
    name: str = "banded LU (LAPACK)"
    definite: bool = False
    price: float = 0.0
    units: Array | None = None

    @cached_property
    def order(self) -> IntArray:
        """Reverse Cuthill-McKee order of the unknowns; the natural one if its band is no wider."""
        structure = self.pattern.matrix(np.ones(self.pattern.nnz))
        # The pattern is symmetrised, as the algorithm needs an undirected graph.
        found: IntArray = reverse_cuthill_mckee(structure + structure.T, symmetric_mode=True)
        rows, cols, place = self.pattern.rows, self.pattern.indices, np.argsort(found)
        natural = np.abs(rows - cols).max(initial=0)
        if natural <= np.abs(place[rows] - place[cols]).max(initial=0):
            return np.arange(len(found))
        return found

    @cached_property
    def natural(self) -> bool:
        """True if unknowns are not reordered."""
        return bool(np.array_equal(self.order, np.arange(len(self.order))))

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
        """Shape of LAPACK's band storage, and position in it of each entry of the pattern."""
        lower, upper = self.band
        row, col = self.inverse[self.pattern.rows], self.inverse[self.pattern.indices]
        # LAPACK's band storage is column major: flat positions count down the columns.
        height = 2 * lower + upper + 1
        return (self.pattern.shape[0], height), col * height + (lower + upper + row - col)

    @cached_property
    def _scale(self) -> Array | float:
        """Scaling factor of each entry of the pattern."""
        if self.units is None:
            return 1.0
        return self.units[self.pattern.rows] * self.units[self.pattern.indices]

    def factorise(self, data: Array) -> BandedFactor:
        """Factorise; raise `LinearAlgebraError` for a singular or non-finite matrix."""
        shape, position = self.storage
        storage = np.zeros(shape)
        storage.ravel()[position] = data * self._scale
        lower, upper = self.band
        lu, pivots, info = lapack.dgbtrf(storage.T, lower, upper, overwrite_ab=1)
        if info != 0 or not math.isfinite(lu[lower + upper].sum()):
            raise LinearAlgebraError(
                f"The {shape[0]} by {shape[0]} matrix is singular or not finite: check the "
                "model's forms, or take a smaller time step."
            )
        return BandedFactor(lu, pivots, lower, upper, self.order, self.inverse, self.units)
