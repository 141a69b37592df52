"""Newton's method for an implicit stage, and refinement with the factor of a nearby matrix."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor, nonfinite_allowed

# Lower bound of a divisor that may be zero.
TINY = 1e-300
# Maximum number of halvings of a Newton update that does not reduce the residual.
HALVINGS = 8
# Maximum number of factorisations from a prediction. A prediction that needs more was misleading,
# and the iteration restarts from the ordinary initial iterate.
FACTORS = 3


class StepFailed(Exception):
    """Failure of a stage; caught by the step control, never seen by users."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail


class StagePoint(Protocol):
    """Stage equation evaluated at an iterate."""

    @property
    def y(self) -> Array:
        """The iterate, shape (n,)."""

    @property
    def residual(self) -> Array:
        """The residual, shape (n,)."""

    @property
    def size(self) -> float:
        """Dual norm of the residual, relative to that of the largest term of the equation."""

    @property
    def resolved(self) -> bool:
        """False if the residual is too large to resolve a small difference in the equation."""


Point = TypeVar("Point", bound=StagePoint)


class StageEquation(Protocol[Point]):
    """Nonlinear equation of one implicit stage: pure functions of the iterate."""

    def evaluate(self, y: Array) -> Point:
        """Return the evaluation at y."""

    def factor(self, at: Point) -> Factor:
        """Return the factorised Jacobian at an iterate."""

    def limited(self, at: Point, allowed: float) -> bool:
        """Return True if rounding errors alone keep the residual above `allowed`."""


@dataclass(frozen=True, eq=False)
class Near:
    """Predictor of a stage: starting value y and cached Jacobian factor."""

    y: Array
    # Factor of a nearby Jacobian, for the first updates; None: the Jacobian at y is factorised.
    factor: Factor | None = None
    # Contraction factor of the residual above which `factor` is replaced by a new one.
    refresh: float = 0.2


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """Solution `at` of a stage, with the number of Newton updates.

    `made` is the iterate of the last factorised Jacobian, and its factor; None without one.
    """

    at: Point
    updates: int
    made: tuple[Point, Factor] | None


@dataclass(frozen=True)
class Newton:
    """Simplified Newton method with cached factors and residual-based acceptance.

    A stage is solved when its residual, in the dual norm and relative to the largest term of the
    equation, is at most `tolerance` or at rounding level. From a good prediction a reduction to
    `share` of the initial residual, and at most `ceiling`, is enough: the error of a prediction is
    about the truncation error of the time step. The size of an update is no criterion: an outdated
    factor can make it small, too.

    An update that does not reduce the residual is damped by halving (line search).

    Parameters
    ----------
    tolerance
        Bound on the relative residual.
    share
        Accepted fraction of the residual of a prediction. 0: always solve to `tolerance`.
    ceiling
        Bound on the relative residual with `share`: the next stage corrects what remains. The
        default keeps q and u within 1e-2 of those of strict solves, relative to their largest
        values, and 1e-4 within 1e-3 (study `exact` in experiments: one and two dimensions,
        vanishing diffusivity, 1 % noise; undivided steps). Large coupled stages, solved by blocks,
        raise it to 5e-3.
    iterations
        Maximum number of updates.
    refresh
        The Jacobian is factorised again when an update leaves more than this share of the residual.
    """

    tolerance: float = 1e-8
    share: float = 0.1
    ceiling: float = 1e-3
    iterations: int = 60
    refresh: float = 0.2

    @nonfinite_allowed()  # reported as a status
    def solve(
        self,
        equation: StageEquation[Point],
        start: Array | Callable[[], Array],
        near: Near | None = None,
    ) -> Solution[Point]:
        """Return the solution of a stage.

        `start` is the initial iterate, or a function that returns it: with `near`, the predicted
        solution, it may not be needed.

        Raises `StepFailed`: "not_converged", "not_finite" or "singular".
        """
        iteration = _Iteration(self, equation)
        if near is not None:
            at = equation.evaluate(near.y)
            allowed = max(self.tolerance, min(self.share * at.size, self.ceiling))
            with suppress(StepFailed):  # the prediction was no good one
                return iteration.run(at, near, allowed, FACTORS)
        at = equation.evaluate(start() if callable(start) else start)
        # Without a prediction the residual at the start does not measure the truncation error, so
        # the strict tolerance holds.
        return iteration.run(at, Near(at.y), self.tolerance, self.iterations)


@dataclass(eq=False)
class _Iteration(Generic[Point]):
    """Newton's iteration for one stage; `updates` counts over all of its attempts."""

    newton: Newton
    equation: StageEquation[Point]
    updates: int = 0
    made: tuple[Point, Factor] | None = None

    def run(self, at: Point, near: Near, allowed: float, factors: int) -> Solution[Point]:
        """Return the solution; raise `StepFailed` without convergence.

        `allowed` is the accepted relative residual, `factors` the maximum number of factorisations.
        """
        newton, factor = self.newton, near.factor
        while not self._solved(at, allowed):
            fresh = factor is None
            self._check_budget(at, spent=fresh and factors == 0)
            if factor is None:
                factor, factors = self._factor(at), factors - 1
            new, update = self._updated(at, factor)
            if fresh and not new.size < at.size:
                limited = self._limited(at, new, allowed)
                if limited is not None:
                    at = limited
                    break
                new = self._damped(at, update)
            # A factor that came with the prediction has a limit of its own.
            refresh = near.refresh if factor is near.factor else newton.refresh
            slow = not new.size <= refresh * at.size
            # With an old factor an update may fail: the better iterate stays, and is factorised
            # next.
            at = new if new.size < at.size else at
            factor = None if slow else factor
        return Solution(at, self.updates, self.made)

    def _check_budget(self, at: Point, *, spent: bool) -> None:
        """Raise `StepFailed` without an update left; `spent`: it needs one factor too many."""
        if spent or self.updates >= self.newton.iterations:
            text = f"{self.updates} updates left a relative residual of {at.size:.1e}"
            raise StepFailed("not_converged", text)

    def _limited(self, at: Point, new: Point, allowed: float) -> Point | None:
        """Return the first iterate whose residual is limited by rounding, or None."""
        both = (one for one in (at, new) if self.equation.limited(one, allowed))
        return next(both, None)

    def _solved(self, at: Point, allowed: float) -> bool:
        if not math.isfinite(at.size):
            raise StepFailed("not_finite", "the iteration left the range of finite numbers")
        return at.size <= allowed and at.resolved

    def _factor(self, at: Point) -> Factor:
        try:
            factor = self.equation.factor(at)
        except LinearAlgebraError as error:
            raise StepFailed("singular", str(error)) from error
        self.made = (at, factor)
        return factor

    def _updated(self, at: Point, factor: Factor) -> tuple[Point, Array]:
        update = solved(factor, at.residual)
        self.updates += 1
        new = self.equation.evaluate(at.y - update)
        if not math.isfinite(new.size):
            raise StepFailed("not_finite", "the iteration left the range of finite numbers")
        return new, update

    def _damped(self, at: Point, update: Array) -> Point:
        """Return the stage after a damped update that reduces the residual."""
        part = 1.0
        for _ in range(HALVINGS):
            part *= 0.5
            new = self.equation.evaluate(at.y - part * update)
            # A sufficient decrease proportional to the step (Armijo): any decrease at all would let
            # the iteration stall.
            if new.size <= (1.0 - 0.1 * part) * at.size:
                return new
        raise StepFailed(
            "not_converged", f"no update reduces the relative residual of {at.size:.1e}"
        )


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
    """Warm-start data of a stage: q, (m,), and step h of its cached factor, trend of u, (n,).

    The factor itself is not stored: it is recomputed from these data if it is missing, as after a
    restart, and the subsequent numbers are the same. q is empty if there is no factor. `spent` are
    the excess solves since the factor was computed, beyond those expected with a nearby q; the
    trend is the rate of change for the predictor of the next stage.
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

    `matrix`, `at` and the mask `free` are of the stage; `factor` returns the factorised matrix of
    (q, h), at a `price` in triangular solves, and is used at `factor_at`. `spent` is as in `Kept`.
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

        The error left is at most `SLOW` of the initial one, since the factor would be replaced
        otherwise.
        """
        r = (b - self.matrix @ start) * self.free[:, None]
        return start + solved(self.factor(*self.factor_at), r)

    def solve(self, before: Array, start: Array, b: Array, tolerance: float, passes: int) -> Array:
        """Return the solution of matrix x = b on the free coefficients, shape (n,) or (n, r).

        `before` is x at the beginning of the stage, `start` an initial guess, exact on the fixed
        coefficients. `tolerance` bounds the error relative to x, both in the Frobenius norm over
        all columns, which is invariant under rotations of the columns of a covariance square root.
        Only corrections beyond `passes` count as excess solves.
        """
        free = self.free.reshape(-1, *[1] * (b.ndim - 1))
        width = b[0].size
        exact = self.at.same(*self.factor_at)
        first = (b - self.matrix @ start) * free
        x, r, count = start, first, 0
        while True:
            update = solved(self.factor(*self.factor_at), r)
            x, count = x + update, count + 1
            if exact:  # the factor of the stage's own matrix needs no iteration
                return x
            moved, size = float(np.linalg.norm(update)), float(np.linalg.norm(x))
            if moved <= ROUNDING * size:  # corrections only exchange rounding errors
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
