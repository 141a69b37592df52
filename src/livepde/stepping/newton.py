"""The nonlinear iteration of an implicit stage: Newton with a kept factor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor

__all__ = ["Newton", "StepFailed", "relative"]


ROUNDING = 1e-11  # relative updates below this are the end of what arithmetic can do


SLOWEST = 0.1  # rate at which a kept factor of a stage with sweeps is expected to go on

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


@dataclass(frozen=True)
class Newton:
    """Lagged sweeps into the neighbourhood of the solution, then Newton with a kept factor.

    The implicit stage of the paper's law can have several solutions, because theta(r) depends on
    the direction of r. Sweeps with lagged coefficients go to the same one from any start; Newton
    goes to the nearest. So sweeps come first, and Newton only polishes.

    Parameters
    ----------
    tolerance
        Bound on the estimated error of each block, relative to the block's norm.
    iterations
        At most this many updates.
    refresh
        The Jacobian is factorised again when an update is more than this share of the last one.
    basin
        Relative update below which Newton takes over from sweeps.
    """

    tolerance: float = 1e-7
    iterations: int = 60
    refresh: float = 0.2
    basin: float = 3e-2

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # reported as a status
    def solve(
        self,
        equation: StageEquation,
        y: Array,
        blocks: tuple[slice, ...] = (slice(None),),
        *,
        floors: tuple[float, ...] = (),
        lagged: bool = False,
        near: Array | None = None,
        kept: Factor | None = None,
    ) -> Array:
        """Return the solution, starting from y.

        Parameters
        ----------
        blocks
            Parts of y measured separately (state and parameter have different units).
        floors
            Norm of each block below which it counts as this large: a block of nothing but rounding
            errors has no relative accuracy.
        lagged
            Begin with lagged sweeps.
        near
            A start that is thought to be so good that Newton may begin there. Where its first
            update is large, or its own factor does not serve to the end, sweeps begin from y after
            all: where solutions meet, they and not Newton choose.
        kept
            With `near`: the factor of a Jacobian not far away, with which Newton may begin. It is
            replaced as one of this stage would be.

        Raises
        ------
        StepFailed
            "not_converged", "not_finite" or "singular".
        """
        factor = kept
        begin = start = y
        y = start if near is None else near
        floors = floors or (0.0,) * len(blocks)
        last, basin, sweeps = np.inf, self.basin, lagged and near is None
        limit, stalled = np.inf if near is None else self.basin, 0
        for _ in range(self.iterations):
            residual = equation.residual(y)
            try:
                factor = factor or equation.factor(y, sweeps)
                update = factor.solve(residual)
            except LinearAlgebraError as error:
                raise StepFailed("singular", str(error)) from error
            new = y - update
            size = relative(update, new, blocks, floors)
            if not math.isfinite(size):
                raise StepFailed("not_finite", "the iteration left the range of finite numbers")
            ratio = size / last
            if ratio >= 0.5 and size <= ROUNDING:
                return new  # updates that no longer shrink down there are rounding errors
            # The error left behind is about rate/(1 - rate) times the update; what converges slowly
            # may only show later.
            rate = max(ratio, SLOWEST) if lagged else ratio
            left = size * rate / (1.0 - rate) if 0.0 < ratio < 1.0 else np.inf
            done = size == 0.0 or left <= self.tolerance
            slow = ratio > self.refresh and not done
            if (
                lagged
                and not sweeps
                and (size >= limit or (slow and near is not None and kept is None))
            ):
                # Newton left the neighbourhood: sweep on from where it began, and come closer.
                basin = 0.3 * basin if near is None else basin
                y, factor, sweeps, near, last = begin, None, True, None, np.inf
                limit, stalled = np.inf, 0
                continue
            if not sweeps and math.isinf(last):
                limit = size
            y = new
            if done:
                return y
            last = size
            stalled = stalled + 1 if sweeps and size > 0.9 else 0
            if sweeps and stalled == STALLED:
                y = start  # sweeps that jump about lead nowhere: Newton from where they began
            if sweeps and (size <= basin or stalled == STALLED):
                # Newton's first update may be larger: sweeps creep, Newton goes all the way.
                begin, factor, sweeps, last = y, None, False, np.inf
            elif kept is not None and slow:
                factor, kept, last = None, None, np.inf  # a factor of its own begins anew
            elif sweeps or slow:
                factor = None
        raise StepFailed(
            "not_converged",
            f"{self.iterations} iterations left a relative update of {size:.1e}",
        )


def relative(
    update: Array, y: Array, blocks: tuple[slice, ...], floors: tuple[float, ...]
) -> float:
    """Return the largest update of a block relative to the block, in Euclidean norms."""
    worst = 0.0
    for block, floor in zip(blocks, floors, strict=True):
        change, size = update[block], y[block]
        square = float(change @ change)
        if not math.isfinite(square):  # max() would pass over a value that is not a number
            return np.inf
        if square != 0.0:
            worst = max(worst, square / max(float(size @ size), floor**2, 1e-300))
    return math.sqrt(worst)
