"""Sparse matrices of fixed pattern and the engines that factorise them."""

from __future__ import annotations

from livepde.linalg.assembler import Assembler
from livepde.linalg.banded import BandedSolver
from livepde.linalg.banded_blocks import BandedBlocks, BlockFactor
from livepde.linalg.choice import Choice, analyse, choose
from livepde.linalg.cholmod import CholmodSolver
from livepde.linalg.krylov import conjugate_gradients, gmres
from livepde.linalg.leading import Leading
from livepde.linalg.memo import Memo
from livepde.linalg.multigrid import MultigridSolver, approximate_inverse
from livepde.linalg.nonfinite import nonfinite_allowed
from livepde.linalg.pardiso import PardisoSolver
from livepde.linalg.pattern import Pattern, compact, sandwich
from livepde.linalg.protocol import Factor, Solver
from livepde.linalg.rows import RowProduct, row_product
from livepde.linalg.superlu import SuperLUSolver, positive_definite
from livepde.linalg.types import Array, IntArray, Mask, Sparse

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
