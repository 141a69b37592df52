"""Many banded systems of one pattern, factorised and solved by one LAPACK call each."""

from __future__ import annotations

import math
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
        columns, count, n = b.shape
        x = b.copy() if self.solver.natural else np.take(b, self.solver.order, axis=2)
        bad = None
        if not (math.isfinite(x.sum()) and self.good.all()):
            bad = ~(self.good & np.isfinite(b).all(axis=(0, 2)))
            x[:, bad] = 0.0
        lower, upper = self.solver.band
        flat = x.reshape(columns, count * n).T
        flat, _ = lapack.dgbtrs(self.lu, lower, upper, flat, self.pivots, overwrite_b=1)
        x = flat.T.reshape(b.shape)
        if not self.solver.natural:
            x = np.take(x, self.solver.inverse, axis=2)
        if bad is not None:
            x[:, bad] = np.nan
        return x


@dataclass(frozen=True, eq=False)
class BandedBlocks:
    """Banded LU of many matrices of one sparsity pattern, with partial pivoting.

    They are the blocks of one block-diagonal matrix, whose band is that of a block: no pivot is
    taken from another block, because what couples the blocks is zero.
    """

    solver: BandedSolver

    def band(self, data: Array) -> Array:
        """Return matrices of shape (..., nnz) in band storage, shape (..., size)."""
        shape, position = self.solver.storage
        storage = np.zeros((*data.shape[:-1], shape[0] * shape[1]))
        storage[..., position] = data
        return storage

    def factorise(self, storage: Array) -> BlockFactor:
        """Factorise matrices in band storage, shape (blocks, size), which is overwritten."""
        (n, height), blocks = self.solver.storage[0], len(storage)
        lower, upper = self.solver.band
        middle = lower + upper
        good: Mask = np.ones(blocks, dtype=bool)
        if not math.isfinite(storage.sum()):
            good = np.asarray(np.isfinite(storage).all(axis=1))
            storage[~good] = 0.0
            storage.reshape(blocks, n, height)[~good, :, middle] = 1.0
        banded = storage.reshape(blocks * n, height).T
        lu, pivots, info = lapack.dgbtrf(banded, lower, upper, overwrite_ab=1)
        if info > 0:  # a pivot is zero: mark its block, and go on without dividing by it
            zero = lu[middle] == 0.0
            lu[middle, zero] = 1.0
            good = good & ~zero.reshape(blocks, n).any(axis=1)
        return BlockFactor(self.solver, lu, pivots, good)
