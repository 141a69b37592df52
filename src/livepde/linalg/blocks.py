"""Many banded systems of one pattern, factorised and solved by one LAPACK call each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from livepde.linalg.banded import BandedSolver
from livepde.linalg.types import Array, IntArray, Mask

__all__ = ["BandedBlocks", "BlockFactor"]


@dataclass(frozen=True, eq=False)
class BlockFactor:
    """LU factors of the blocks of a block-diagonal matrix.

    Attributes
    ----------
    good
        Blocks that could be factorised, shape (blocks,).
    """

    solver: BandedSolver
    lu: Array
    pivots: IntArray
    good: Mask

    def solve(self, b: Array) -> Array:
        """Return x with K x = b for each block: shape (columns, blocks, n) as b has.

        NaN for blocks whose matrix is singular, or whose b is not finite. Where a solution
        overflows, other blocks may be NaN with it; what is finite is right.
        """
        columns, blocks, n = b.shape
        good: Mask = self.good & np.isfinite(b).all(axis=(0, 2))
        x = np.take(b, self.solver.order, axis=2)
        x[:, ~good] = 0.0
        lower, upper = self.solver.band
        flat = x.reshape(columns, blocks * n).T
        flat, _ = lapack.dgbtrs(self.lu, lower, upper, flat, self.pivots, overwrite_b=1)
        x = np.take(flat.T.reshape(b.shape), self.solver.inverse, axis=2)
        x[:, ~good] = np.nan
        return x


@dataclass(frozen=True, eq=False)
class BandedBlocks:
    """Banded LU of many matrices of one sparsity pattern, with partial pivoting.

    They are the blocks of one block-diagonal matrix, whose band is that of a block: no pivot is
    taken from another block, because what couples the blocks is zero.
    """

    solver: BandedSolver

    def factorise(self, data: Array) -> BlockFactor:
        """Factorise the matrices `pattern.matrix(data[k])`, data of shape (blocks, nnz)."""
        shape, position = self.solver.storage
        blocks, (n, height) = len(data), shape
        good: Mask = np.asarray(np.isfinite(data).all(axis=1))
        storage = np.zeros((blocks, n * height))
        storage[:, position] = data
        lower, upper = self.solver.band
        middle = lower + upper
        if not good.all():
            storage[~good] = 0.0
            storage.reshape(blocks, n, height)[~good, :, middle] = 1.0
        banded = storage.reshape(blocks * n, height).T
        lu, pivots, info = lapack.dgbtrf(banded, lower, upper, overwrite_ab=1)
        if info > 0:  # a pivot is zero: mark its block, and go on without dividing by it
            zero = lu[middle] == 0.0
            lu[middle, zero] = 1.0
            good &= ~zero.reshape(blocks, n).any(axis=1)
        return BlockFactor(self.solver, lu, pivots, good)
