"""The nonlinear iteration of an implicit stage: Newton with a kept factor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor

__all__ = ["TINY", "Near", "Newton", "Parts", "Solution", "StepFailed"]

ROUNDING = 1e-11  # relative updates below this are the end of what arithmetic can do
SLOWEST = 0.1  # rate at which a factor of a stage with sweeps is expected to go on
TINY = 1e-300  # what is zero counts as this large
STALLED = 10  # sweeps in a row that change everything: let Newton try from the start


class StepFailed(Exception):
    """A stage that did not converge; caught by the step control, never seen by users."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail


class StageEquation(Protocol):
    """One implicit stage."""

    def residual(self, y: Array) -> Array:
        """Return the residual at y, shape (n,)."""
        ...

    def factor(self, y: Array, sweep: bool) -> Factor:
        """Return the factorised Jacobian at the y of the last residual.

        With `sweep`, of the equation in which nonlinear coefficients are held at y (lagged).
        """
        ...


@dataclass(frozen=True, eq=False)
class Parts:
    """Parts of y whose errors are measured separately, since they have different units.

    Attributes
    ----------
    weights
        The squared norm of each part is the sum of weights times squares, shape (n, parts).
    floors
        Squared norm of each part below which it counts as this large, > 0: a part of nothing but
        rounding errors has no relative accuracy.
    """

    weights: Array
    floors: tuple[float, ...]

    @classmethod
    def whole(cls, size: int) -> Parts:
        """Return one part, measured in the Euclidean norm."""
        return cls(np.ones((size, 1)), (TINY,))

    def squares(self, x: Array) -> list[float]:
        """Return the squared norm of each part."""
        return self.products(x, x)

    def products(self, x: Array, y: Array) -> list[float]:
        """Return the inner product in each part."""
        products: list[float] = ((x * y) @ self.weights).tolist()
        return products

    def allowed(self, shares: list[float], missed: list[float], scales: list[float]) -> list[float]:
        """Return how much of each part may be left, from what was missed of it.

        All but the shares are squares; `scales` are those of y.
        """
        return [share**2 * square for share, square in zip(shares, missed, strict=True)]

    def relative(self, change: Array, y: Array) -> float:
        """Return the size of a change of y, relative to it, in its worst part."""
        pairs = zip(self.squares(change), self.squares(y), self.floors, strict=True)
        return math.sqrt(max(square / max(scale, floor) for square, scale, floor in pairs))


@dataclass(frozen=True, eq=False)
class Solution:
    """What the iteration found, and how it went.

    Attributes
    ----------
    y
        The solution.
    updates
        How many it took.
    missed
        The first update in the worst part of y, relative to it: how good a `Near` was; NaN if it
        was not where the iteration began in the end.
    rate
        From there, the second update over the first, with the same factor; NaN if there are none.
    """

    y: Array
    updates: int
    missed: float
    rate: float


@dataclass(frozen=True, eq=False)
class Near:
    """A start that is thought to be so good that Newton may begin there.

    Where its first update is large, or its own factor does not serve to the end, sweeps begin from
    the ordinary start after all: where solutions meet, they and not Newton choose.

    Attributes
    ----------
    y
        The start.
    kept
        The factor of a Jacobian not far away, with which Newton may begin. It is replaced as one of
        this stage would be.
    expected, trusted
        The ratio of the second update to the first that is expected, if the first is not larger
        than `trusted`, relative to y. It spares the second one where it is small.
    shares
        How much of `Newton.share` counts in each part; by default all.
    rough
        The kept factor is that of an approximate Jacobian: an update by it that is larger than the
        one before does not mean that the neighbourhood was left.
    """

    y: Array
    kept: Factor | None = None
    expected: float = math.inf
    trusted: float = math.inf
    shares: tuple[float, ...] | None = None
    rough: bool = False


@dataclass(frozen=True)
class Newton:
    """Lagged sweeps into the neighbourhood of the solution, then Newton with a kept factor.

    The implicit stage of the paper's law can have several solutions, because theta(r) depends on
    the direction of r. Sweeps with lagged coefficients go to the same one from any start; Newton
    goes to the nearest. So sweeps come first, and Newton only polishes.

    Parameters
    ----------
    tolerance
        Bound on the estimated error of each part of y, relative to its norm.
    share
        A stage that begins at a good prediction is solved to this share of what the prediction
        missed, if that is more. A prediction follows the steps before: what it misses is about as
        much as the time step itself leaves out. 0: always to `tolerance`.
    iterations
        At most this many updates.
    refresh
        The Jacobian is factorised again when an update is more than this share of the last one.
    basin
        Relative update below which Newton takes over from sweeps.
    """

    tolerance: float = 1e-7
    share: float = 0.1
    iterations: int = 60
    refresh: float = 0.2
    basin: float = 3e-2

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # reported as a status
    def solve(
        self,
        equation: StageEquation,
        y: Array | Callable[[], Array],
        parts: Parts | None = None,
        *,
        lagged: bool = False,
        near: Near | None = None,
    ) -> Solution:
        """Return the solution, starting from y.

        Parameters
        ----------
        y
            The start, or a function that returns it: with `near` it may not be needed.
        parts
            What of y is measured separately; by default nothing.
        lagged
            Begin with lagged sweeps.
        near
            A better start.

        Raises
        ------
        StepFailed
            "not_converged", "not_finite" or "singular".
        """
        return _Iteration(self, equation, y, parts, lagged, near).run()


class _Iteration:
    """One solve: where it is, by which factor it goes on, and what it has seen.

    Attributes
    ----------
    y, start, begin
        Where it is, where it began, and where Newton did.
    factor, kept
        The factor at hand, and whether that of `Near.kept` was not yet given up.
    sweeps
        Lagged coefficients are held.
    last
        Size of the last update by the factor at hand or one like it, relative to what may be left
        of the error; infinite where there is none to compare with.
    limit
        Relative size of an update of Newton that leaves the neighbourhood.
    basin, stalled
        Where Newton takes over from sweeps; sweeps in a row that changed everything.
    miss
        Squares of what may be left of the error in each part, because `near` missed that much more.
    missed, rate
        As in `Solution`.
    """

    def __init__(
        self,
        newton: Newton,
        equation: StageEquation,
        given: Array | Callable[[], Array],
        parts: Parts | None,
        lagged: bool,
        near: Near | None,
    ) -> None:
        self.newton = newton
        self.equation = equation
        self.given = given
        self.lagged = lagged
        self.near = near
        self.y = self.begin = self.start = _evaluated(given) if near is None else near.y
        self.parts = parts or Parts.whole(len(self.y))
        self.factor = None if near is None else near.kept
        self.kept = self.factor is not None
        self.rough = near is not None and near.rough
        self.expected = math.inf if near is None else near.expected
        self.trusted = math.inf if near is None else near.trusted
        self.sweeps = lagged and near is None
        self.last, self.basin, self.stalled = math.inf, newton.basin, 0
        self.limit = math.inf if near is None else newton.basin
        self.miss = [0.0] * len(self.parts.floors)
        self.missed = self.rate = math.nan

    def run(self) -> Solution:
        """Return the solution."""
        newton = self.newton
        for count in range(1, newton.iterations + 1):
            new, size, excess = self._update(count)
            ratio = excess / self.last
            if ratio >= 0.5 and size <= ROUNDING:
                break  # updates that no longer shrink down there are rounding errors
            if count == 2 and self.near is not None:
                self.rate = ratio
            rate = self._believed(ratio, size)
            done = excess * rate <= 1.0 - rate  # the error is rate/(1 - rate) times the update
            # A kept factor that needs one or two more is not replaced now.
            ends = self.kept and count <= 2 and excess * rate**3 <= 1.0 - rate
            slow = ratio > newton.refresh and not (done or ends)
            if self._left(size, slow):
                self._return_to_sweeps()
                continue
            if not self.sweeps and math.isinf(self.last):
                self.limit = size
            self.y = new
            if done:
                break
            self.last = excess
            self._go_on(size, slow)
        else:
            raise StepFailed(
                "not_converged",
                f"{newton.iterations} iterations left a relative update of {size:.1e}",
            )
        return Solution(new, count, self.missed, self.rate)

    def _update(self, count: int) -> tuple[Array, float, float]:
        """Return the next y, and the size of the update in the worst part of y.

        First relative to y, then to what may be left of the error.
        """
        residual = self.equation.residual(self.y)
        try:
            self.factor = self.factor or self.equation.factor(self.y, self.sweeps)
            update = self.factor.solve(residual)
        except LinearAlgebraError as error:
            raise StepFailed("singular", str(error)) from error
        new, parts = self.y - update, self.parts
        squares, scales = parts.squares(update), parts.squares(new)
        if not math.isfinite(sum(squares) + sum(scales)):
            raise StepFailed("not_finite", "the iteration left the range of finite numbers")
        begins = count == 1 and self.near is not None
        if begins and self.near is not None:
            shares = self.near.shares or (1.0,) * len(squares)
            each = [self.newton.share * share for share in shares]
            self.miss = parts.allowed(each, squares, scales)
        strict = max(self.newton.tolerance, 1e-150) ** 2
        size = excess = 0.0
        for square, scale, floor, m in zip(squares, scales, parts.floors, self.miss, strict=True):
            if square > 0.0:
                scale = max(scale, floor)
                size = max(size, square / scale)
                excess = max(excess, square / max(strict * scale, m))
        size, excess = math.sqrt(size), math.sqrt(excess)
        if begins:
            self.missed = size
        return new, size, excess

    def _believed(self, ratio: float, size: float) -> float:
        """Return the ratio of the next update to this one, as far as it can be known."""
        if math.isinf(self.last):
            return min(self.expected, 1.0) if size <= self.trusted else 1.0
        # What converges slowly may only show later.
        return max(ratio, SLOWEST) if self.lagged else ratio

    def _left(self, size: float, slow: bool) -> bool:
        """Return whether Newton has left the neighbourhood of where it began."""
        if self.sweeps or not self.lagged:
            return False
        far = size >= self.limit and not (self.rough and self.kept)
        return far or (slow and self.near is not None and not self.kept)

    def _return_to_sweeps(self) -> None:
        """Sweep on from where Newton began, and come closer; from the ordinary start after `near`.

        Nothing that was seen from there counts.
        """
        if self.near is None:
            self.basin *= 0.3
        else:
            self.begin = self.start = _evaluated(self.given)
        self.y, self.factor, self.sweeps, self.near = self.begin, None, True, None
        self.last = self.limit = self.expected = math.inf
        self.stalled, self.miss = 0, [0.0] * len(self.miss)
        self.missed = self.rate = math.nan

    def _go_on(self, size: float, slow: bool) -> None:
        """Choose the factor of the next update."""
        self.stalled = self.stalled + 1 if self.sweeps and size > 0.9 else 0
        jumps = self.sweeps and self.stalled == STALLED
        if jumps:
            self.y = self.start  # sweeps that jump about lead nowhere: Newton from where they began
        if self.sweeps and (size <= self.basin or jumps):
            # Newton's first update may be larger: sweeps creep, Newton goes all the way.
            self.begin, self.factor, self.sweeps = self.y, None, False
            self.last = self.expected = math.inf
        elif self.kept and slow:
            self.factor, self.kept = None, False  # a factor of its own begins anew
            self.last = self.trusted = math.inf
            self.expected = math.inf if self.rough else SLOWEST
        elif self.sweeps or slow:
            self.factor = None


def _evaluated(start: Array | Callable[[], Array]) -> Array:
    return start() if callable(start) else start
