"""Sparse matrices of fixed pattern and the engines that factorise them."""

from __future__ import annotations

from livepde.linalg.arrays import (
    Array,
    IntArray,
    Mask,
    Memo,
    RowProduct,
    Sparse,
    nonfinite_allowed,
    row_product,
)
from livepde.linalg.banded import BandedBlocks, BandedSolver, BlockFactor
from livepde.linalg.choice import Choice, analyse, choose
from livepde.linalg.direct import (
    CholmodSolver,
    Factor,
    Inverse,
    Leading,
    PardisoSolver,
    Solver,
    SuperLUSolver,
    positive_definite,
)
from livepde.linalg.krylov import MultigridSolver, approximate_inverse, conjugate_gradients, gmres
from livepde.linalg.pattern import Assembler, Pattern, compact, sandwich

__all__ = [
    "Array",
    "Assembler",
    "BandedBlocks",
    "BandedSolver",
    "BlockFactor",
    "Choice",
    "CholmodSolver",
    "Factor",
    "IntArray",
    "Inverse",
    "Leading",
    "Mask",
    "Memo",
    "MultigridSolver",
    "PardisoSolver",
    "Pattern",
    "RowProduct",
    "Solver",
    "Sparse",
    "SuperLUSolver",
    "analyse",
    "approximate_inverse",
    "choose",
    "compact",
    "conjugate_gradients",
    "gmres",
    "nonfinite_allowed",
    "positive_definite",
    "row_product",
    "sandwich",
]
