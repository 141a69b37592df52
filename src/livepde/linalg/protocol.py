"""What an engine offers: analyse a pattern once, factorise data often, solve many times."""

from __future__ import annotations

from typing import Protocol

from livepde.linalg.pattern import Pattern
from livepde.linalg.types import Array

__all__ = ["Factor", "Solver"]


class Factor(Protocol):
    """A factorised matrix."""

    def solve(self, b: Array) -> Array:
        """Return x with K x = b; `b` has shape (n,) or, for several right-hand sides, (n, k)."""
        ...


class Solver(Protocol):
    """An engine bound to one sparsity pattern."""

    @property
    def name(self) -> str:
        """How the engine introduces itself."""
        ...

    @property
    def pattern(self) -> Pattern:
        """The sparsity pattern it is bound to."""
        ...

    @property
    def definite(self) -> bool:
        """True if it refuses a matrix that is not positive definite, at the latest in a solve."""
        ...

    @property
    def price(self) -> float:
        """About how many solves a factorisation costs; 0: a factor is not worth keeping.

        A stated number, not a measured one: nothing that is timed steers what is computed.
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
