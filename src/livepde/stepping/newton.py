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
    """Failure of a stage, which the step control handles; internal."""

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
        """Whether the residual is small enough to resolve a small difference in the equation."""


Point = TypeVar("Point", bound=StagePoint)


class StageEquation(Protocol[Point]):
    """Nonlinear equation of one implicit stage: pure functions of the iterate."""

    def evaluate(self, y: Array) -> Point:
        """Return the evaluation at y."""

    def factor(self, at: Point) -> Factor:
        """Return the factorised Jacobian at an iterate."""

    def limited(self, at: Point, allowed: float) -> bool:
        """Return whether only rounding errors keep the residual above `allowed`."""


@dataclass(frozen=True, eq=False)
class Near:
    """Predictor of a stage: starting value y and cached Jacobian factor."""

    y: Array
    # Factor of a nearby Jacobian for the first updates; None to factorise the Jacobian at y.
    factor: Factor | None = None
    # Contraction factor of the residual above which `factor` is replaced by a new one.
    refresh: float = 0.2


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """Solution `at` of a stage, with the number of Newton updates.

    `made`: iterate of the last factorised Jacobian, and its factor; None without a factorisation.
    """

    at: Point
    updates: int
    made: tuple[Point, Factor] | None


@dataclass(frozen=True)
class Newton:
    """Simplified Newton method with cached factors and residual-based acceptance.

    A stage is solved when its residual, in the dual norm and relative to the largest term of the
    equation, is at most `tolerance` or at rounding level. From a prediction, a reduction to `share`
    of the initial residual, and at most `ceiling`, suffices: the error of a prediction is
    comparable to the truncation error of the time step. The size of an update is not a criterion,
    because an outdated factor can also make it small.

    An update that does not reduce the residual is damped by halving (line search).

    Parameters
    ----------
    tolerance
        Bound on the relative residual.
    share
        Accepted fraction of the residual of a prediction. 0: always solve to `tolerance`.
    ceiling
        Bound on the relative residual with `share`: the next stage corrects the rest. With the
        default, q and u differ from strict solves by at most 1e-2 of their largest values, with
        1e-4 by at most 1e-3 (study `exact` in experiments: one and two dimensions, vanishing
        diffusivity, 1 % noise; undivided steps). Large coupled stages, solved by blocks, use 5e-3.
    iterations
        Maximum number of updates.
    refresh
        If an update leaves more than this share of the residual, the Jacobian is factorised again.
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

        `start` is the initial iterate, or a function that returns it, which is called only if the
        iteration from the prediction `near` fails.

        Raises `StepFailed`: "not_converged", "not_finite" or "singular".
        """
        iteration = _Iteration(self, equation)
        if near is not None:
            at = equation.evaluate(near.y)
            allowed = max(self.tolerance, min(self.share * at.size, self.ceiling))
            with suppress(StepFailed):  # the prediction was poor
                return iteration.run(at, near, allowed, FACTORS)
        at = equation.evaluate(start() if callable(start) else start)
        # Without a prediction, the initial residual does not measure the truncation error, so the
        # strict tolerance applies.
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
            factorises = factor is None
            self._check_budget(at, spent=factorises and factors == 0)
            if factor is None:
                factor, factors = self._factor(at), factors - 1
            candidate, update = self._updated(at, factor)
            if factorises and not candidate.size < at.size:
                limited = self._limited(at, candidate, allowed)
                if limited is not None:
                    at = limited
                    break
                candidate = self._damped(at, update)
            # The factor of the prediction has a separate limit.
            refresh = near.refresh if factor is near.factor else newton.refresh
            slow = not candidate.size <= refresh * at.size
            # If an update with an old factor fails, the better iterate is kept and its Jacobian
            # factorised.
            at = candidate if candidate.size < at.size else at
            factor = None if slow else factor
        return Solution(at, self.updates, self.made)

    def _check_budget(self, at: Point, *, spent: bool) -> None:
        """Raise `StepFailed` if the updates are used up, or the factorisations (`spent`)."""
        if spent or self.updates >= self.newton.iterations:
            text = f"{self.updates} updates left a relative residual of {at.size:.1e}"
            raise StepFailed("not_converged", text)

    def _limited(self, at: Point, new: Point, allowed: float) -> Point | None:
        """Return the first iterate whose residual is limited by rounding, or None."""
        candidates = (iterate for iterate in (at, new) if self.equation.limited(iterate, allowed))
        return next(candidates, None)

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
        """Return the evaluation after a damped update that reduces the residual."""
        part = 1.0
        for _ in range(HALVINGS):
            part *= 0.5
            new = self.equation.evaluate(at.y - part * update)
            # Sufficient decrease proportional to the step (Armijo): an arbitrarily small decrease
            # would allow the iteration to stall.
            if new.size <= (1.0 - 0.1 * part) * at.size:
                return new
        raise StepFailed(
            "not_converged", f"no update reduces the relative residual of {at.size:.1e}"
        )


# Bound on the error of a stage relative to the change of the state, so that the relative accuracy
# does not depend on the time scale of the process.
SHARE = 1e-2
# Relative size of a correction at the level of accumulated rounding errors: further corrections
# would not improve the solution.
ROUNDING = 1e-11
# Contraction rate above which a factor is replaced: five corrections would gain fewer than three
# digits.
SLOW = 0.3


@dataclass(frozen=True, eq=False)
class Kept:
    """Warm-start data of a stage: q, (m,), and step h of its cached factor, trend of u, (n,).

    The factor itself is not stored. If it is missing, as after a restart, it is recomputed from
    these data, with identical results. q is empty if there is no factor. `spent` is the number of
    solves since the factorisation beyond the number expected with a nearby q. The trend is the rate
    of change for the predictor of the next stage.
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
        """Return whether parameter and step equal (q, h)."""
        return self.h == h and (self.q is q or np.array_equal(self.q, q))


@dataclass(eq=False)
class Corrections:
    """Iterative refinement with the matrix of one stage and the factor of another.

    `matrix`, `at` and the mask `free` describe the stage. `factor` returns the factorised matrix
    for (q, h), at a `price` in triangular solves; it is used for `factor_at`. `spent`: see `Kept`.
    """

    matrix: sp.csr_array | Array
    at: At
    free: Array
    factor: Callable[[Array, float], Factor]
    price: float
    factor_at: At
    spent: float

    def correct(self, start: Array, b: Array) -> Array:
        """Return the solution of matrix x = b after a single correction.

        The remaining error is at most `SLOW` times the initial error; otherwise the factor would
        have been replaced.
        """
        r = (b - self.matrix @ start) * self.free[:, None]
        return start + solved(self.factor(*self.factor_at), r)

    def solve(self, before: Array, start: Array, b: Array, tolerance: float, passes: int) -> Array:
        """Return the solution of matrix x = b on the free coefficients, shape (n,) or (n, r).

        `before` is x at the beginning of the stage, and `start` an initial guess that is exact on
        the fixed coefficients. `tolerance` bounds the error relative to x in the Frobenius norm
        over all columns, which is invariant under rotations of the columns of a covariance square
        root. Only corrections beyond `passes` count as excess solves.
        """
        free = self.free.reshape(-1, *[1] * (b.ndim - 1))
        width = b[0].size
        exact = self.at.same(*self.factor_at)
        residual = (b - self.matrix @ start) * free
        x, r, count = start, residual, 0
        while True:
            update = solved(self.factor(*self.factor_at), r)
            x, count = x + update, count + 1
            if exact:  # the factor is that of the stage's matrix, so no iteration is needed
                return x
            correction, size = float(np.linalg.norm(update)), float(np.linalg.norm(x))
            if correction <= ROUNDING * size:  # further corrections are rounding errors
                return x
            last, r = float(np.linalg.norm(r)), (b - self.matrix @ x) * free
            # The contraction rate is estimated from residuals instead of updates, since the next
            # correction requires the residual of the new iterate in any case.
            rate = float(np.linalg.norm(r)) / last if last else math.inf  # squares may underflow
            if rate <= SLOW:
                # The remaining error is the geometric series of further corrections.
                remaining = correction * rate / (1.0 - rate)
                change = float(np.linalg.norm(x - before))
                allowed = max(min(tolerance * size, SHARE * change), ROUNDING * size)
                converged = remaining <= allowed
                passes_left = 0.0 if converged else math.log(allowed / remaining) / math.log(rate)
                spent = self.spent + width * max(count + passes_left - passes, 0)
                if converged:
                    self.spent = spent
                    return x
                if spent <= self.price:
                    continue
            # The refinement with the old factor costs more than a factorisation.
            self.factor_at, self.spent, exact = self.at, 0.0, True
            x, r = start, residual


def solved(factor: Factor, b: Array) -> Array:
    """Return the solution by a factor; raise `StepFailed` for a singular matrix."""
    try:
        return factor.solve(b)
    except LinearAlgebraError as error:
        raise StepFailed("singular", str(error)) from error
