"""Solver protocol: analyse a pattern once, factorise data often, solve many times."""

from __future__ import annotations

from typing import Protocol

from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, b: Array) -> Array:
        """Return x with K x = b; `b` has shape (n,) or, for several right-hand sides, (n, k)."""
        ...


class Solver(Protocol):
    """A solver bound to one sparsity pattern."""

    @property
    def name(self) -> str:
        """Name of the solver for messages."""
        ...

    @property
    def pattern(self) -> Pattern:
        """Sparsity pattern of its matrices."""
        ...

    @property
    def definite(self) -> bool:
        """True if it refuses a matrix that is not positive definite, at the latest in a solve."""
        ...

    @property
    def price(self) -> float:
        """Approximate cost of a factorisation in solves; 0: reusing a factor does not pay.

        A constant, not a measured time: timings must not influence the numbers computed.
        """
        ...

    def factorise(self, data: Array) -> Factor:
        """Factorise the matrix `pattern.matrix(data)`.

        Raises
        ------
        LinearAlgebraError
            The matrix is singular to working precision or holds a value that is not finite.
        """
        ...
