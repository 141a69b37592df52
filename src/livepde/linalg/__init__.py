"""Sparse matrices of fixed pattern and the engines that factorise them."""

from __future__ import annotations

from livepde.linalg.assembler import Assembler
from livepde.linalg.banded import BandedSolver
from livepde.linalg.blocks import BandedBlocks, BlockFactor
from livepde.linalg.leading import Leading
from livepde.linalg.pattern import Pattern, PatternOperator, sandwich
from livepde.linalg.protocol import Factor, Solver
from livepde.linalg.superlu import SuperLUSolver, positive_definite
from livepde.linalg.types import Array, IntArray, Mask, Sparse

__all__ = [
    "Array",
    "Assembler",
    "BandedBlocks",
    "BandedSolver",
    "BlockFactor",
    "Factor",
    "IntArray",
    "Leading",
    "Mask",
    "Pattern",
    "PatternOperator",
    "Solver",
    "Sparse",
    "SuperLUSolver",
    "analyse",
    "positive_definite",
    "sandwich",
]

WIDEST_BAND = 48


def analyse(pattern: Pattern, *, symmetric: bool = False) -> Solver:
    """Choose the engine for a pattern: the only place where this is decided.

    Banded LU up to `WIDEST_BAND` diagonals on each side (every 1D problem), SuperLU beyond it.
    `symmetric` promises that every matrix to come is symmetric positive definite.
    """
    banded = BandedSolver(pattern)
    if max(banded.band) <= WIDEST_BAND:
        return banded
    return SuperLUSolver(pattern, symmetric)
