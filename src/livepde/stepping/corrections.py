"""Iterative refinement of an implicit stage with the LU factor of a nearby matrix."""

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

# Bound on the error of a stage relative to the change of the state in it, so that the accuracy does
# not depend on how slow the process is.
SHARE = 1e-2
# Relative size of a correction at the level of accumulated rounding errors: further corrections
# would not improve the solution.
ROUNDING = 1e-11
# A factor with a contraction rate above this is replaced: five corrections would gain fewer than
# three digits.
SLOW = 0.3


@dataclass(frozen=True, eq=False)
class Kept:
    """Warm-start data of a stage: parameter and step of its cached factor, trend of the state.

    The factor itself is not stored: it is recomputed from these data if it is missing, as after a
    restart, and the subsequent numbers are the same.

    Attributes
    ----------
    q, h
        Latent parameter, shape (m,), and step of the cached factor; q is empty if there is none.
    spent
        Excess solves since the factor was computed, beyond those expected with a nearby q.
    trend
        Rate of change of the state, for the predictor of the next stage, shape (n,).
    """

    q: Array
    h: float
    spent: float
    trend: Array

    @classmethod
    def none(cls) -> Kept:
        """Return empty warm-start data, as before the first stage."""
        return cls(np.zeros(0), 0.0, 0.0, np.zeros(0))


class At(NamedTuple):
    """Parameter and step at which the matrix of a stage is evaluated."""

    q: Array
    h: float

    def same(self, q: Array, h: float) -> bool:
        """Return True if parameter and step equal (q, h)."""
        return self.h == h and (self.q is q or np.array_equal(self.q, q))


@dataclass(eq=False)
class Corrections:
    """Iterative refinement with the matrix of one stage and the factor of another.

    Attributes
    ----------
    matrix, at, free
        Matrix of the stage, its (q, h), and the mask of free coefficients: one if free, zero if
        fixed.
    factor
        Function (q, h) -> factorised matrix.
    price
        Cost of a factorisation in triangular solves.
    factor_at
        Parameter and step of the factor in use.
    spent
        Excess solves, as in `Kept`.
    """

    matrix: sp.csr_array | Array
    at: At
    free: Array
    factor: Callable[[Array, float], Factor]
    price: float
    factor_at: At
    spent: float

    def once(self, start: Array, b: Array) -> Array:
        """Return the solution of matrix x = b after a single correction.

        The remaining error is at most `SLOW` of the initial one, since the factor would have been
        replaced otherwise; usually less than a hundredth.
        """
        r = (b - self.matrix @ start) * self.free[:, None]
        return start + solved(self.factor(*self.factor_at), r)

    def solve(self, before: Array, start: Array, b: Array, tolerance: float, passes: int) -> Array:
        """Return the solution of matrix x = b on the free coefficients.

        Parameters
        ----------
        before
            Value of x at the beginning of the stage.
        start
            Initial guess of x, exact on the fixed coefficients, shape (n,) or (n, r).
        tolerance
            Bound on the error relative to x, both in the Frobenius norm over all columns, which is
            invariant under rotations of the columns of a covariance square root.
        passes
            Expected number of corrections; only those beyond it count as excess solves.
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
            # The factor of the stage's own matrix needs no iteration, and at rounding level
            # corrections only exchange rounding errors.
            if exact or moved <= ROUNDING * size:
                return x
            last, r = float(np.linalg.norm(r)), (b - self.matrix @ x) * free
            # The contraction rate is estimated from residuals, not from updates: the residual of
            # the new iterate is needed anyway for the next correction.
            rate = float(np.linalg.norm(r)) / last if last else math.inf  # squares may underflow
            if rate <= SLOW:
                # The remaining error is the geometric series of all further corrections.
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
            # The refinement with the old factor has cost, or would cost, as much as a
            # factorisation.
            self.factor_at, self.spent, exact = self.at, 0.0, True
            x, r = start, first


def solved(factor: Factor, b: Array) -> Array:
    """Return the solution by a factor; raise `StepFailed` for a singular matrix."""
    try:
        return factor.solve(b)
    except LinearAlgebraError as error:
        raise StepFailed("singular", str(error)) from error
