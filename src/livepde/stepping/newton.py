"""The nonlinear iteration of an implicit stage: Newton with a kept factor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from livepde.errors import LinearAlgebraError
from livepde.linalg import Array, Factor

__all__ = ["Newton", "StepFailed"]


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

    def factor(self, y: Array) -> Factor:
        """Return the factorised Jacobian at y."""
        ...


@dataclass(frozen=True)
class Newton:
    """Simplified Newton: the factor is kept while the updates shrink fast enough.

    Parameters
    ----------
    tolerance
        Bound on the estimated error of each block, relative to the block's norm.
    iterations
        At most this many updates.
    refresh
        The Jacobian is factorised again when an update is more than this share of the last one.
    """

    tolerance: float = 1e-9
    iterations: int = 40
    refresh: float = 0.2

    def solve(
        self, equation: StageEquation, y: Array, blocks: tuple[slice, ...], affine: bool = False
    ) -> Array:
        """Return the solution, starting from y.

        Parameters
        ----------
        blocks
            Parts of y measured separately (state and parameter have different units).
        affine
            The equation is affine: one update solves it.

        Raises
        ------
        StepFailed
            "not_converged", "not_finite" or "singular".
        """
        factor: Factor | None = None
        last = np.inf
        for _ in range(self.iterations):
            residual = equation.residual(y)
            try:
                factor = factor or equation.factor(y)
                update = factor.solve(residual)
            except LinearAlgebraError as error:
                raise StepFailed("singular", str(error)) from error
            y = y - update
            size = _relative(update, y, blocks)
            if not np.isfinite(size):
                raise StepFailed("not_finite", "the iteration left the range of finite numbers")
            if affine:
                return y
            ratio = size / last
            if size <= self.tolerance and (
                size == 0.0 or (ratio < 1.0 and size * ratio <= self.tolerance * (1 - ratio))
            ):
                return y
            if np.isfinite(last) and ratio > self.refresh:
                factor = None
            last = size
        raise StepFailed(
            "not_converged",
            f"{self.iterations} iterations left a relative update of {size:.1e}",
        )


def _relative(update: Array, y: Array, blocks: tuple[slice, ...]) -> float:
    """Return the largest update of a block relative to the block."""
    worst = 0.0
    for block in blocks:
        change = float(np.abs(update[block]).max(initial=0.0))
        if change != 0.0:
            worst = max(worst, change / max(float(np.abs(y[block]).max()), 1e-300))
    return worst
