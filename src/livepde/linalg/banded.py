"""Banded LU by LAPACK after a bandwidth-reducing permutation, for one or many matrices."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import blas, lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from livepde.errors import LinearAlgebraError
from livepde.linalg.arrays import Array, IntArray, Pattern

# Number of entries of a triangle up to which its copy costs more than the faster solve saves.
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
        # With row exchanges, L includes permutations and is not a triangle in band storage.
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

    With `units`, powers of two of shape (n,), the scaled matrix units K units is factorised. If its
    diagonal is about one, few rows are exchanged, and a factorisation without row exchanges takes a
    third of the time.
    """

    pattern: Pattern
    name: str = "banded LU (LAPACK)"
    definite: bool = False
    price: float = 0.0
    units: Array | None = None

    @cached_property
    def order(self) -> IntArray:
        """Reverse Cuthill-McKee order, or the natural order if its band is not wider."""
        structure = self.pattern.matrix(np.ones(self.pattern.nnz))
        # The pattern is symmetrised, because the algorithm requires an undirected graph.
        found: IntArray = reverse_cuthill_mckee(structure + structure.T, symmetric_mode=True)
        rows, cols, place = self.pattern.rows, self.pattern.indices, np.argsort(found)
        natural = np.abs(rows - cols).max(initial=0)
        if natural <= np.abs(place[rows] - place[cols]).max(initial=0):
            return np.arange(len(found))
        return found

    @cached_property
    def natural(self) -> bool:
        """Whether unknowns are not reordered."""
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
        """Shape of LAPACK's band storage, and flat position of each entry of the pattern in it."""
        lower, upper = self.band
        row, col = self.inverse[self.pattern.rows], self.inverse[self.pattern.indices]
        # LAPACK's band storage is column-major: flat positions run down the columns.
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


NONE = np.zeros(0, dtype=np.intp)


class BlockFactor(NamedTuple):
    """Factors of the diagonal blocks of a block-diagonal matrix."""

    solver: BandedSolver  # order and width of the band
    bad: IntArray  # indices of the blocks that could not be factorised
    # lu, pivots: LAPACK's LU factors of the whole matrix, in the order of the band. They are None
    # if there is `symmetric`: the main diagonal of D and the lower diagonal of L in L D L^T.
    lu: Array | None
    pivots: IntArray | None
    symmetric: tuple[Array, Array] | None = None

    def solve(self, b: Array) -> Array:
        """Return x with K x = b for each block, of shape (columns, blocks, n); overwrites b.

        A block is NaN if its matrix is singular, or if its b is not finite. If a solution
        overflows, other blocks may also become NaN; finite values are correct.
        """
        columns, count, n = b.shape
        bad = self.bad
        if count > 1 and not math.isfinite(b.sum()):  # a single block cannot affect others
            bad = np.union1d(bad, np.flatnonzero(~np.isfinite(b).all(axis=(0, 2))))
        if len(bad):
            # In the band solve, NaN would spread to neighbouring blocks (0 * NaN = NaN). Therefore
            # bad blocks are solved with zeros and set to NaN afterwards.
            b[:, bad] = 0.0
        x = b if self.solver.natural else np.take(b, self.solver.order, axis=2)
        x = x.reshape(columns, count * n).T
        if self.symmetric is not None:
            x = lapack.dpttrs(*self.symmetric, x, overwrite_b=1)[0]
        else:
            x = lapack.dgbtrs(self.lu, *self.solver.band, x, self.pivots, overwrite_b=1)[0]
        x = x.T.reshape(b.shape)
        if not self.solver.natural:
            x = np.take(x, self.solver.inverse, axis=2)
        if len(bad):
            x[:, bad] = np.nan
        return x


@dataclass(frozen=True, eq=False)
class BandedBlocks:
    """Banded factorisation of many matrices with one sparsity pattern.

    The matrices are the blocks of one block-diagonal matrix with the bandwidth of a block, which is
    factorised by LU with partial pivoting. Pivots never cross blocks, because the coupling entries
    are zero. If all matrices are tridiagonal and `symmetric`, L D L^T takes a third of the time.
    Storage is then the main diagonal, and the lower diagonal with a zero at the end.
    """

    solver: BandedSolver
    symmetric: bool = False

    @classmethod
    def of(cls, solver: BandedSolver, *data: Array) -> BandedBlocks:
        """Return the factorisation of sums of matrices with given data, each of shape (nnz,)."""
        whole = cls(solver)
        tridiagonal = solver.band == (1, 1)
        return cls(solver, tridiagonal and all(whole._mirrored(part) for part in data))

    def _mirrored(self, data: Array) -> bool:
        """Return whether a tridiagonal matrix is exactly symmetric."""
        _, upper, _, lower = self.band(data).reshape(self.solver.storage[0]).T
        return np.array_equal(upper[1:], lower[:-1])

    def band(self, data: Array) -> Array:
        """Return matrices of shape (..., nnz) in band storage, shape (..., size)."""
        shape, position = self.solver.storage
        storage = np.zeros((*data.shape[:-1], shape[0] * shape[1]))
        storage[..., position] = data
        if not self.symmetric:
            return storage
        rows = storage.reshape(-1, *shape)
        return rows[:, :, 2:].swapaxes(1, 2).reshape(*data.shape[:-1], 2 * shape[0])

    def factorise(self, storage: Array) -> BlockFactor:
        """Factorise matrices in band storage, shape (blocks, size), which is overwritten."""
        (n, height), blocks, bad = self.solver.storage[0], len(storage), NONE
        if not math.isfinite(np.vdot(storage, storage)):  # a quick test: squares may also overflow
            bad = np.flatnonzero(~np.isfinite(storage).all(axis=1))
            # Replace blocks that are not finite by the identity, so that the others can be
            # factorised.
            storage[bad] = 0.0
            if self.symmetric:
                storage.reshape(blocks, 2, n)[bad, 0] = 1.0
            else:
                storage.reshape(blocks, n, height)[bad, :, sum(self.solver.band)] = 1.0
        if self.symmetric:
            diagonal, side = storage.reshape(blocks, 2, n).swapaxes(0, 1).reshape(2, -1)
            *factors, info = lapack.dpttrf(diagonal, side[:-1])
            if info == 0:
                return BlockFactor(self.solver, bad, None, None, tuple(factors))
            general = np.zeros((blocks * n, height))
            general[:, 2], general[:, 3], general[1:, 1] = diagonal, side, side[:-1]
            return self._lu(general, bad)
        return self._lu(storage.reshape(blocks * n, height), bad)

    def _lu(self, storage: Array, bad: IntArray) -> BlockFactor:
        """Return LU factors of a whole matrix in band storage, shape (blocks n, height)."""
        lower, upper = self.solver.band
        lu, pivots, info = lapack.dgbtrf(storage.T, lower, upper, overwrite_ab=1)
        if info > 0:  # a pivot is zero: mark its block, and replace the pivot by one
            middle = lower + upper
            zero = lu[middle] == 0.0
            lu[middle, zero] = 1.0
            bad = np.union1d(bad, np.flatnonzero(zero) // self.solver.storage[0][0])
        return BlockFactor(self.solver, bad, lu, pivots)
