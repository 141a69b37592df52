"""Sparse factors of large matrices by MKL Pardiso (pypardiso)."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array, IntArray

POSITIVE_DEFINITE, GENERAL = 2, 11  # Pardiso's types of a matrix
FACTORISE, REFACTORISE, SOLVE = 12, 22, 33  # its phases
# The value of MKL_CBWR_AUTO: results do not depend on the alignment of arrays in memory, so that
# runs are reproducible to the last digit.
REPRODUCIBLE = 2


@dataclass(frozen=True, eq=False)
class PardisoFactor:
    """Factors held by a Pardiso handle, which returns to the solver with this object."""

    solver: PardisoSolver
    handle: Any
    matrix: sp.csr_array

    # A handle works in memory of its own, and pypardiso lets other threads run meanwhile. A factor
    # that a model keeps (of X, say) is asked by every thread: one after the other.
    turn: Lock = field(default_factory=Lock, repr=False)

    def solve(self, b: Array) -> Array:
        """Return x with K x = b."""
        with self.turn:
            self.handle.set_phase(SOLVE)
            x: Array = self.handle._call_pardiso(self.matrix, np.array(b, dtype=float, order="F"))
        return x


@dataclass(frozen=True, eq=False)
class PardisoSolver:
    """Sparse factors of one pattern by MKL Pardiso; needs pypardiso.

    `symmetric` is for symmetric positive definite matrices: a successful factorisation proves
    definiteness, and the fill-reducing order is computed once. The order of other matrices depends
    on their values and is recomputed for each, since the numbers of a factor must not depend on
    earlier factorisations. pypardiso's own `solve` takes no symmetric storage and compares the
    whole matrix each time; hence its phases are called one by one.
    """

    pattern: Pattern
    symmetric: bool = False
    _idle: list[Any] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        weakref.finalize(self, _release, self._idle).atexit = False

    @property
    def name(self) -> str:
        """Name of the solver for messages."""
        return "Pardiso (MKL)" + (", symmetric positive definite" if self.symmetric else "")

    @property
    def price(self) -> float:
        """Approximate cost of a factorisation in triangular solves."""
        return 4.0 if self.symmetric else 15.0

    @property
    def definite(self) -> bool:
        """True for symmetric matrices, which have a Cholesky factor."""
        return self.symmetric

    @cached_property
    def _stored(self) -> tuple[IntArray, Pattern]:
        """Data indices and pattern passed to Pardiso: the upper triangle if symmetric."""
        rows, cols = self.pattern.rows, self.pattern.indices
        kept = np.flatnonzero(cols >= rows) if self.symmetric else np.arange(len(cols))
        if len(np.unique(rows[cols == rows])) < self.pattern.shape[0] and self.symmetric:
            raise LinearAlgebraError(
                "The matrix is singular or not positive definite: a diagonal entry is missing."
            )
        return kept, Pattern.from_entries(rows[kept], cols[kept], self.pattern.shape)

    def factorise(self, data: Array) -> PardisoFactor:
        """Factorise; raise `LinearAlgebraError` for a singular or non-finite matrix."""
        from pypardiso import PyPardisoSolver
        from pypardiso.pardiso_wrapper import PyPardisoError

        if not np.isfinite(data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        kept, pattern = self._stored
        matrix = pattern.matrix(data[kept])
        kind = POSITIVE_DEFINITE if self.symmetric else GENERAL
        try:
            handle, known = self._idle.pop(), True  # at once: another thread may take the last one
        except IndexError:
            handle, known = PyPardisoSolver(mtype=kind), False
        handle.libmkl.MKL_CBWR_Set(REPRODUCIBLE)
        handle.set_phase(REFACTORISE if known and self.symmetric else FACTORISE)
        try:
            handle._call_pardiso(matrix, np.zeros(len(matrix.indptr) - 1))
        except PyPardisoError as error:
            _release([handle])
            n = pattern.shape[0]
            raise LinearAlgebraError(
                f"The {n} by {n} matrix is singular{' or not positive definite' * self.symmetric}: "
                "check the model's forms, or take a smaller time step."
            ) from error
        factor = PardisoFactor(self, handle, matrix)
        weakref.finalize(factor, self._idle.append, handle).atexit = False
        return factor


def _release(handles: list[Any]) -> None:
    for handle in handles:
        handle.free_memory(everything=True)
