"""One sparse system from blocks L·K·R, where only the data of K change."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from livepde.linalg.pattern import Pattern, sandwich
from livepde.linalg.types import IntArray, Sparse

__all__ = ["Assembler"]


class Assembler:
    """Collects blocks of a square matrix; then maps the data of each into the whole.

    Every block is `left @ K @ right` at an offset, with K of a fixed pattern. After `build`,
    `maps[name] @ data_of_K` is its contribution to the data of the whole.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._blocks: dict[str, list[tuple[IntArray, IntArray, sp.csr_array]]] = {}

    def add(
        self,
        name: str,
        inner: Pattern,
        left: Sparse | None = None,
        right: Sparse | None = None,
        at: tuple[int, int] = (0, 0),
        transposed: bool = False,
    ) -> None:
        """Add a block; the same name may be added at several places, also as left @ K^T @ right."""
        shape = inner.shape[::-1] if transposed else inner.shape
        left = sp.eye_array(shape[0]) if left is None else left
        right = sp.eye_array(shape[1]) if right is None else right
        if transposed:
            cols, rows, weights = sandwich(sp.csr_array(right).T, inner, sp.csr_array(left).T)
        else:
            rows, cols, weights = sandwich(left, inner, right)
        self._blocks.setdefault(name, []).append((rows + at[0], cols + at[1], weights))

    def build(self) -> tuple[Pattern, dict[str, sp.csr_array]]:
        """Return the pattern of the whole and, for each name, the map of its data."""
        pieces = [piece for group in self._blocks.values() for piece in group]
        diagonal = np.arange(self.size)
        rows = np.concatenate([diagonal, *(rows for rows, _, _ in pieces)])
        cols = np.concatenate([diagonal, *(cols for _, cols, _ in pieces)])
        pattern = Pattern.from_entries(rows, cols, (self.size, self.size))
        maps = {}
        for name, group in self._blocks.items():
            parts = [pattern.gather(r, c) @ weights for r, c, weights in group]
            total = parts[0]
            for part in parts[1:]:
                total = total + part
            maps[name] = sp.csr_array(total)
        return pattern, maps
