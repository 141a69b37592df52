"""Assembly of a sparse matrix from blocks L·K·R of which only the data of K change."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.linalg.pattern import Pattern, sandwich
from livepde.linalg.types import Array, IntArray, Sparse


class Assembler:
    """Assembler of a square block matrix, with linear maps from block data to its data.

    Every block is `left @ K @ right` at an offset, with K of a fixed pattern. After `build`,
    `maps[name] @ data_of_K` is the contribution of a block to the data of the assembled matrix.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._blocks: dict[str, list[_MatrixBlock]] = {}

    def add(
        self,
        name: str,
        inner: Pattern,
        left: Sparse | None = None,
        right: Sparse | None = None,
        at: tuple[int, int] = (0, 0),
        transposed: bool = False,
    ) -> None:
        """Add a block; one name may be added at several places, also as left @ K^T @ right."""
        block = _MatrixBlock(inner, left, right, at, transposed)
        known = (other for group in self._blocks.values() for other in group)
        same = next((other for other in known if other.alike(block)), block)
        self._blocks.setdefault(name, []).append(same)

    def build(self) -> tuple[Pattern, dict[str, sp.csr_array]]:
        """Return the pattern of the assembled matrix and, for each name, the map of its data.

        Blocks with the same pattern and factors share one map.
        """
        blocks = {id(block): block for group in self._blocks.values() for block in group}
        entries = [block.entries for block in blocks.values()]
        # The diagonal is part of every pattern, so that rows of fixed coefficients can hold ones.
        diagonal = np.arange(self.size, dtype=np.int32)
        rows = np.concatenate([diagonal, *(rows for rows, _, _ in entries)])
        cols = np.concatenate([diagonal, *(cols for _, cols, _ in entries)])
        pattern = Pattern.from_entries(rows, cols, (self.size, self.size))
        parts = {key: block.mapped(pattern) for key, block in blocks.items()}
        maps = {}
        for name, group in self._blocks.items():
            total = parts[id(group[0])]
            for block in group[1:]:
                total = sp.csr_array(total + parts[id(block)])
            maps[name] = total
        return pattern, maps


@dataclass(frozen=True, eq=False)
class _MatrixBlock:
    """Block left @ K @ right or left @ K^T @ right, with K of a fixed pattern."""

    inner: Pattern
    left: Sparse | None
    right: Sparse | None
    at: tuple[int, int]
    transposed: bool

    def alike(self, other: _MatrixBlock) -> bool:
        """Return True if the other block consists of the same objects."""
        pairs = zip(*((b.inner, b.left, b.right) for b in (self, other)), strict=True)
        same = (self.at, self.transposed) == (other.at, other.transposed)
        return same and all(mine is theirs for mine, theirs in pairs)

    @cached_property
    def entries(self) -> tuple[IntArray, IntArray, sp.csr_array]:
        """Rows and columns in the assembled matrix, and map from the data of K to the values."""
        shape = self.inner.shape[::-1] if self.transposed else self.inner.shape
        left = sp.eye_array(shape[0]) if self.left is None else self.left
        right = sp.eye_array(shape[1]) if self.right is None else self.right
        rows, cols, weights = self._scaled(left, right) or self._product(left, right)
        return rows + np.int32(self.at[0]), cols + np.int32(self.at[1]), weights

    def _scaled(
        self, left: Sparse, right: Sparse
    ) -> tuple[IntArray, IntArray, sp.csr_array] | None:
        """Return the entries if both factors are diagonal, when no entries are summed."""
        a, b = _diagonal(left), _diagonal(right)
        if a is None or b is None:
            return None
        rows, cols = self.inner.rows, self.inner.indices
        if self.transposed:
            rows, cols = cols, rows
        scale = a[rows] * b[cols]
        # Each entry of the block is one entry of K, scaled: a map with one value in each row.
        kept = np.flatnonzero(scale).astype(np.int32)
        starts = np.arange(len(kept) + 1, dtype=np.int32)
        shape = (len(kept), self.inner.nnz)
        return rows[kept], cols[kept], sp.csr_array((scale[kept], kept, starts), shape=shape)

    def _product(self, left: Sparse, right: Sparse) -> tuple[IntArray, IntArray, sp.csr_array]:
        if self.transposed:
            # left K^T right is the transpose of right^T K left^T.
            a, b = sp.csr_array(right).T, sp.csr_array(left).T
            cols, rows, weights = sandwich(a, self.inner, b)
        else:
            rows, cols, weights = sandwich(left, self.inner, right)
        return rows, cols, weights

    def mapped(self, pattern: Pattern) -> sp.csr_array:
        """Return the map from the data of K to the data of the assembled matrix."""
        rows, cols, weights = self.entries
        return sp.csr_array(pattern.gather(rows, cols) @ weights)


def _diagonal(matrix: Sparse) -> Array | None:
    """Return the diagonal of a matrix that has no other entries, else None."""
    if matrix.shape[0] != matrix.shape[1]:
        return None
    coo = sp.coo_array(matrix)
    if not np.array_equal(coo.row, coo.col):
        return None
    found: Array = matrix.diagonal()
    return found
