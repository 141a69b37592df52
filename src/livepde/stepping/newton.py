"""The nonlinear iteration of an implicit stage: Newton, accepted by the residual."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor

__all__ = ["TINY", "Near", "Newton", "Solution", "StageEquation", "StagePoint", "StepFailed"]

TINY = 1e-300  # what is zero counts as this large
HALVINGS = 8  # of a Newton update that does not reduce the residual
FACTORS = 3  # made from a prediction before the iteration begins anew from the ordinary start


class StepFailed(Exception):
    """A stage that was not solved; caught by the step control, never seen by users."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail


class StagePoint(Protocol):
    """A stage evaluated at a point."""

    @property
    def y(self) -> Array:
        """The point, shape (n,)."""
        ...

    @property
    def residual(self) -> Array:
        """The residual, shape (n,)."""
        ...

    @property
    def size(self) -> float:
        """Dual norm of the residual, relative to that of the largest term of the equation."""
        ...

    @property
    def resolved(self) -> bool:
        """False while the residual is too large for a small difference that the equation needs."""
        ...


Point = TypeVar("Point", bound=StagePoint)


class StageEquation(Protocol[Point]):
    """One implicit stage: pure functions of the iterate."""

    def evaluate(self, y: Array) -> Point:
        """Return the stage at y."""
        ...

    def factor(self, at: Point) -> Factor:
        """Return the factorised Jacobian at a point."""
        ...

    def limited(self, at: Point, allowed: float) -> bool:
        """Return true if rounding errors are all that keeps a residual above the size allowed."""
        ...


@dataclass(frozen=True, eq=False)
class Near:
    """A predicted solution.

    Attributes
    ----------
    y
        The prediction.
    factor
        Of a Jacobian not far away, with which to begin; None: one is made at y.
    refresh
        Share of the residual beyond which an update by it makes a new factor worth its cost.
    """

    y: Array
    factor: Factor | None = None
    refresh: float = 0.2


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """A solved stage, and how the iteration went.

    Attributes
    ----------
    at
        The solution: its residual was evaluated and is below the tolerance.
    updates
        Number of updates.
    made
        Where the last Jacobian was factorised, and its factor; None: nowhere.
    """

    at: Point
    updates: int
    made: tuple[Point, Factor] | None


@dataclass(frozen=True)
class Newton:
    """Newton's iteration with kept factors, and when a stage counts as solved.

    A stage is solved when its residual, in the dual norm and relative to the largest term of the
    equation, is at most `tolerance`, or what rounding leaves; from a prediction that is good, at
    most `share` of what it had there and at most `ceiling`: what a prediction misses is about what
    the time step leaves out.
    The size of an update is no criterion: a factor of another point makes it small, too.

    An update that does not reduce the residual is shortened until it does.

    Parameters
    ----------
    tolerance
        Bound on the relative residual.
    share
        Of the residual of a prediction that may be left. 0: always to `tolerance`.
    ceiling
        Bound on the relative residual with `share`. The default keeps q and u within 1e-3 of those
        of strict solves (`livepde reproduce exact`): the next stage makes up for what one leaves.
        Large coupled stages, solved by blocks, raise it to 5e-3.
    iterations
        At most this many updates.
    refresh
        The Jacobian is factorised again when an update leaves more than this share of the residual.
    """

    tolerance: float = 1e-8
    share: float = 0.1
    ceiling: float = 1e-3
    iterations: int = 60
    refresh: float = 0.2

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # reported as a status
    def solve(
        self,
        equation: StageEquation[Point],
        start: Array | Callable[[], Array],
        near: Near | None = None,
    ) -> Solution[Point]:
        """Return the solution of a stage.

        Parameters
        ----------
        start
            Where to begin, or a function that returns it: with `near` it may not be needed.
        near
            A prediction.

        Raises
        ------
        StepFailed
            "not_converged", "not_finite" or "singular".
        """
        iteration = _Iteration(self, equation)
        if near is not None:
            at = equation.evaluate(near.y)
            allowed = max(self.tolerance, min(self.share * at.size, self.ceiling))
            with suppress(StepFailed):  # the prediction was no good one
                return iteration.run(at, near, allowed, FACTORS)
        at = equation.evaluate(start() if callable(start) else start)
        return iteration.run(at, Near(at.y), self.tolerance, self.iterations)


class _Iteration(Generic[Point]):
    """Newton's iteration for one stage; `updates` counts over all of its attempts."""

    def __init__(self, newton: Newton, equation: StageEquation[Point]) -> None:
        self.newton = newton
        self.equation = equation
        self.updates = 0
        self.made: tuple[Point, Factor] | None = None

    def run(self, at: Point, near: Near, allowed: float, factors: int) -> Solution[Point]:
        """Return the solution; raises `StepFailed`.

        Parameters
        ----------
        at, near
            Where to begin, and with which factor.
        allowed
            Relative size of the residual at which the stage is solved.
        factors
            At most this many are made.
        """
        newton, factor = self.newton, near.factor
        while not self._solved(at, allowed):
            fresh = factor is None
            if self.updates >= newton.iterations or (fresh and factors == 0):
                raise StepFailed(
                    "not_converged",
                    f"{self.updates} updates left a relative residual of {at.size:.1e}",
                )
            if factor is None:
                factor, factors = self._factor(at), factors - 1
            new, update = self._updated(at, factor)
            if fresh and not new.size < at.size:
                if self.equation.limited(at, allowed):
                    break
                if self.equation.limited(new, allowed):  # one line may be limited long before
                    at = new
                    break
                new = self._damped(at, update)
            refresh = near.refresh if factor is near.factor else newton.refresh
            slow = not new.size <= refresh * at.size
            at = new if new.size < at.size else at
            factor = None if slow else factor
        return Solution(at, self.updates, self.made)

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
        try:
            update = factor.solve(at.residual)
        except LinearAlgebraError as error:
            raise StepFailed("singular", str(error)) from error
        self.updates += 1
        new = self.equation.evaluate(at.y - update)
        if not math.isfinite(new.size):
            raise StepFailed("not_finite", "the iteration left the range of finite numbers")
        return new, update

    def _damped(self, at: Point, update: Array) -> Point:
        """Return the stage after a part of an update that reduces the residual."""
        part = 1.0
        for _ in range(HALVINGS):
            part *= 0.5
            new = self.equation.evaluate(at.y - part * update)
            if new.size <= (1.0 - 0.1 * part) * at.size:
                return new
        raise StepFailed(
            "not_converged", f"no update reduces the relative residual of {at.size:.1e}"
        )
