"""A stage solved by the factor of another, whose unknowns were nearby: iterative refinement."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor
from livepde.stepping.newton import StepFailed

__all__ = ["At", "Corrections", "Kept", "solved"]

SHARE = 1e-2  # of what a stage changes: the error is at most this, however slow the process
ROUNDING = 1e-11  # relative corrections below this are the end of what arithmetic can do
SLOW = 0.3  # a factor whose corrections leave more than this share of the error is made again


@dataclass(frozen=True, eq=False)
class Kept:
    """What a stage leaves to the next one: where its factor was made, and how the state moved.

    The factor itself is made again from this where it is gone, after a restart say: the numbers
    that follow are the same.

    Attributes
    ----------
    q, h
        Latent parameter, shape (m,), and step; q is empty if nothing is kept.
    spent
        Solves that stages have taken beyond those that a factor of a q nearby takes.
    trend
        Change of the state per unit of time, with which the next stage starts, shape (n,).
    """

    q: Array
    h: float
    spent: float
    trend: Array

    @classmethod
    def none(cls) -> Kept:
        """Return the value before any stage."""
        return cls(np.zeros(0), 0.0, 0.0, np.zeros(0))


class At(NamedTuple):
    """Where a matrix is taken."""

    q: Array
    h: float

    def same(self, q: Array, h: float) -> bool:
        """Return whether it is the one of (q, h)."""
        return self.h == h and (self.q is q or np.array_equal(self.q, q))


@dataclass(eq=False)
class Corrections:
    """Solves with the matrix of one stage by the factor of another.

    Attributes
    ----------
    matrix, at, free
        Of the stage, where it is taken, and one for each free coefficient, zero for fixed ones.
    factor
        (q, h) -> the factor there.
    price
        Solves that a factorisation costs.
    factor_at
        Where the factor was made that is used now.
    spent
        As for `Kept`.
    """

    matrix: sp.csr_array | Array
    at: At
    free: Array
    factor: Callable[[Array, float], Factor]
    price: float
    factor_at: At
    spent: float

    def once(self, start: Array, b: Array) -> Array:
        """Return x with matrix x = b, by one correction: a share of the change is left.

        At most `SLOW`, or the factor would have been made again; mostly less than a hundredth.
        """
        r = (b - self.matrix @ start) * self.free[:, None]
        return start + solved(self.factor(*self.factor_at), r)

    def solve(self, before: Array, start: Array, b: Array, tolerance: float, passes: int) -> Array:
        """Return x with matrix x = b on the free coefficients.

        Parameters
        ----------
        before
            What x was where the stage begins.
        start
            What x is on the fixed ones, and about elsewhere, shape (n,) or (n, r).
        tolerance
            Bound on the error relative to x, both in the Euclidean norm over all columns: that does
            not change where columns of a square root are rotated.
        passes
            Corrections that are as many as expected.
        """
        free = self.free.reshape(-1, *[1] * (b.ndim - 1))
        width = b[0].size
        exact = self.at.same(*self.factor_at)
        first = (b - self.matrix @ start) * free
        x, r, count = start, first, 0
        while True:
            update = solved(self.factor(*self.factor_at), r)
            x, count = x + update, count + 1
            moved, size = float(np.linalg.norm(update)), float(np.linalg.norm(x))
            if exact or moved <= ROUNDING * size:
                return x
            last, r = float(np.linalg.norm(r)), (b - self.matrix @ x) * free
            rate = float(np.linalg.norm(r)) / last if last else math.inf  # squares may underflow
            if rate <= SLOW:
                left = moved * rate / (1.0 - rate)
                change = float(np.linalg.norm(x - before))
                allowed = max(min(tolerance * size, SHARE * change), ROUNDING * size)
                done = left <= allowed
                more = 0.0 if done else math.log(allowed / left) / math.log(rate)
                spent = self.spent + width * max(count + more - passes, 0)
                if done:
                    self.spent = spent
                    return x
                if spent <= self.price:
                    continue
            # Keeping the factor has cost as much as a new one, or would.
            self.factor_at, self.spent, exact = self.at, 0.0, True
            x, r = start, first


def solved(factor: Factor, b: Array) -> Array:
    """Return the solution by a factor; raises `StepFailed`."""
    try:
        return factor.solve(b)
    except LinearAlgebraError as error:
        raise StepFailed("singular", str(error)) from error
