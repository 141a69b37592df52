"""The nonlinear iteration of an implicit stage: Newton, accepted by the residual."""

from __future__ import annotations

import math
from collections.abc import Callable
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

    def rounding(self, at: Point) -> float:
        """Return the relative size that rounding errors give the residual at a point."""
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
    """

    y: Array
    factor: Factor | None = None


@dataclass(frozen=True, eq=False)
class Solution(Generic[Point]):
    """A solved stage, and how the iteration went.

    Attributes
    ----------
    at
        The solution: its residual was evaluated and is below the tolerance.
    updates
        Number of updates.
    predicted
        True if the iteration from the prediction led to it.
    made
        Where the last Jacobian was factorised, and its factor; None: nowhere.
    """

    at: Point
    updates: int
    predicted: bool
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
        Bound on the relative residual with `share`.
    iterations
        At most this many updates.
    refresh
        The Jacobian is factorised again when an update leaves more than this share of the residual.
    """

    tolerance: float = 1e-8
    share: float = 0.1
    ceiling: float = 3e-3
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
            found = iteration.from_prediction(near)
            if found is not None:
                return found
        return iteration.from_start(start() if callable(start) else start)


class _Iteration(Generic[Point]):
    """One solve; `updates` counts over all of its attempts."""

    def __init__(self, newton: Newton, equation: StageEquation[Point]) -> None:
        self.newton = newton
        self.equation = equation
        self.updates = 0
        self.made: tuple[Point, Factor] | None = None

    def from_prediction(self, near: Near) -> Solution[Point] | None:
        """Return the solution that a prediction leads to; None if it was no good one."""
        newton = self.newton
        at = self.equation.evaluate(near.y)
        if not math.isfinite(at.size):
            return None
        allowed = max(newton.tolerance, min(newton.share * at.size, newton.ceiling))
        factor, own = near.factor, False
        left = FACTORS
        while not self._solved(at, allowed):
            if self.updates >= newton.iterations:
                return None
            if factor is None:
                if left == 0:
                    return None
                left -= 1
                try:
                    factor, own = self._factor(at), True
                except StepFailed:
                    return None
            try:
                new, _ = self._updated(at, factor)
            except StepFailed:
                return None
            if new.size < at.size:
                if new.size > newton.refresh * at.size:
                    factor = None
                at = new
            elif not own:
                factor = None
            elif at.size <= self.equation.rounding(at):
                break
            else:
                return None
        return Solution(at, self.updates, True, self.made)

    def from_start(self, start: Array) -> Solution[Point]:
        """Return the solution; raises `StepFailed`."""
        newton, equation = self.newton, self.equation
        at = equation.evaluate(start)
        factor: Factor | None = None
        while not self._solved(at, newton.tolerance):
            if self.updates >= newton.iterations:
                raise StepFailed(
                    "not_converged",
                    f"{newton.iterations} iterations left a relative residual of {at.size:.1e}",
                )
            own = factor is None
            factor = self._factor(at) if factor is None else factor
            new, update = self._updated(at, factor)
            if new.size >= at.size and own:
                if at.size <= equation.rounding(at):
                    break
                new = self._damped(at, update)
                if new is at:
                    raise StepFailed(
                        "not_converged",
                        f"no update reduces the relative residual of {at.size:.1e}",
                    )
            slow = not new.size <= newton.refresh * at.size
            if new.size < at.size:
                at = new
            factor = None if slow else factor
        return Solution(at, self.updates, False, self.made)

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
        """Return the stage after a part of an update that reduces the residual, if there is one."""
        part = 1.0
        for _ in range(HALVINGS):
            part *= 0.5
            new = self.equation.evaluate(at.y - part * update)
            if new.size <= (1.0 - 0.1 * part) * at.size:
                return new
        return at
