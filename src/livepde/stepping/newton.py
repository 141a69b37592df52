"""The nonlinear iteration of an implicit stage: Newton with a kept factor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor

__all__ = ["TINY", "Newton", "Parts", "Solution", "StepFailed"]


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
        The first update in the worst part of y, relative to it: how good `near` was; NaN if it was
        not where the iteration began in the end.
    rate
        From there, the second update over the first, with the same factor; NaN if there are none.
    """

    y: Array
    updates: int
    missed: float
    rate: float


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
        near: Array | None = None,
        kept: Factor | None = None,
        expected: float = math.inf,
        trusted: float = math.inf,
        shares: tuple[float, ...] | None = None,
        rough: bool = False,
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
            A start that is thought to be so good that Newton may begin there. Where its first
            update is large, or its own factor does not serve to the end, sweeps begin from y after
            all: where solutions meet, they and not Newton choose.
        kept
            With `near`: the factor of a Jacobian not far away, with which Newton may begin. It is
            replaced as one of this stage would be.
        expected, trusted
            With `near`: the ratio of the second update to the first that is expected, if the first
            is not larger than `trusted`, relative to y. It spares the second one where it is small.
        shares
            With `near`: how much of `share` counts in each part; by default all.
        rough
            The kept factor is that of an approximate Jacobian: an update by it that is larger than
            the one before does not mean that the neighbourhood was left.

        Raises
        ------
        StepFailed
            "not_converged", "not_finite" or "singular".
        """
        factor, given = kept, y
        y = begin = start = _evaluated(given) if near is None else near
        parts = parts or Parts.whole(len(y))
        last, basin, sweeps = math.inf, self.basin, lagged and near is None
        limit, stalled = math.inf if near is None else self.basin, 0
        strict, miss = max(self.tolerance, 1e-150) ** 2, [0.0] * len(parts.floors)
        missed = seen = math.nan
        expected = math.inf if near is None else expected
        for count in range(1, self.iterations + 1):
            residual = equation.residual(y)
            try:
                factor = factor or equation.factor(y, sweeps)
                update = factor.solve(residual)
            except LinearAlgebraError as error:
                raise StepFailed("singular", str(error)) from error
            new = y - update
            squares, scales = parts.squares(update), parts.squares(new)
            if not math.isfinite(sum(squares) + sum(scales)):
                raise StepFailed("not_finite", "the iteration left the range of finite numbers")
            if count == 1 and near is not None:
                each = [self.share * share for share in shares or (1.0,) * len(squares)]
                miss = parts.allowed(each, squares, scales)
            # Updates are relative to y, and compared with what may be left of the error.
            size = excess = 0.0
            for square, scale, floor, m in zip(squares, scales, parts.floors, miss, strict=True):
                if square > 0.0:
                    scale = max(scale, floor)
                    size = max(size, square / scale)
                    excess = max(excess, square / max(strict * scale, m))
            size, excess = math.sqrt(size), math.sqrt(excess)
            if count == 1 and near is not None:
                missed = size
            ratio = excess / last
            if ratio >= 0.5 and size <= ROUNDING:
                break  # updates that no longer shrink down there are rounding errors
            if count == 2 and near is not None:
                seen = ratio
            # What converges slowly may only show later.
            rate = max(ratio, SLOWEST) if lagged else ratio
            if math.isinf(last):
                rate = min(expected, 1.0) if size <= trusted else 1.0
            done = excess * rate <= 1.0 - rate  # the error is rate/(1 - rate) times the update
            # A kept factor that needs one or two more is not replaced now.
            ends = kept is not None and count <= 2 and excess * rate**3 <= 1.0 - rate
            slow = ratio > self.refresh and not (done or ends)
            if (
                lagged
                and not sweeps
                and (
                    (size >= limit and not (rough and kept is not None))
                    or (slow and near is not None and kept is None)
                )
            ):
                # Newton left the neighbourhood: sweep on from where it began, and come closer.
                if near is None:
                    basin *= 0.3
                else:
                    begin = start = _evaluated(given)
                y, factor, sweeps, near, last = begin, None, True, None, math.inf
                limit, stalled = math.inf, 0
                miss, missed = [0.0] * len(miss), math.nan
                seen, expected = math.nan, math.inf
                continue
            if not sweeps and math.isinf(last):
                limit = size
            y = new
            if done:
                break
            last = excess
            stalled = stalled + 1 if sweeps and size > 0.9 else 0
            if sweeps and stalled == STALLED:
                y = start  # sweeps that jump about lead nowhere: Newton from where they began
            if sweeps and (size <= basin or stalled == STALLED):
                # Newton's first update may be larger: sweeps creep, Newton goes all the way.
                begin, factor, sweeps, last = y, None, False, math.inf
                expected = math.inf
            elif kept is not None and slow:
                factor, kept, last = None, None, math.inf  # a factor of its own begins anew
                expected, trusted = math.inf if rough else SLOWEST, math.inf
            elif sweeps or slow:
                factor = None
        else:
            raise StepFailed(
                "not_converged",
                f"{self.iterations} iterations left a relative update of {size:.1e}",
            )
        return Solution(new, count, missed, seen)


def _evaluated(start: Array | Callable[[], Array]) -> Array:
    return start() if callable(start) else start
