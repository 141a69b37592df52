"""Scalar unknowns of an estimate as one row: value, standard deviation, interval, share left."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from livepde.fem import FunctionSpace, Normal
from livepde.laws import Belief
from livepde.linalg import Array

LEVEL = 0.95

Ends: TypeAlias = Callable[[float, float], tuple[float, ...]]


def unknown_of(space: FunctionSpace, label: str) -> Any:
    """Return the unknown of a scalar label."""
    return space.unknown_of(label)


class ScalarReadout:
    """Numbers of the scalar unknowns, in the order of `Layout.numbers`.

    The arithmetic equals that of `Belief` and of `Scalar.interval` to the last bit; quantities that
    do not change between samples are computed once.
    """

    def __init__(self, space: FunctionSpace) -> None:
        rows = list(space.labels.values())
        consecutive = bool(rows) and rows == list(range(rows[0], rows[0] + len(rows)))
        self._rows: Any = slice(rows[0], rows[-1] + 1) if consecutive else rows
        self._ends = [_ends(unknown_of(space, label)) for label in space.labels]
        self._prior: tuple[Array | None, list[float]] = (None, [])

    def __call__(self, belief: Belief) -> list[float]:
        """Return (value, standard deviation, interval ends, share left) of all, concatenated."""
        if not self._ends:
            return []
        values = belief.q[self._rows].tolist()
        deviations, shares = self._deviations(belief)
        found: list[float] = []
        for value, std, ends, share in zip(values, deviations, self._ends, shares, strict=True):
            found += (value, std, *ends(value, std), share)
        return found

    def _deviations(self, belief: Belief) -> tuple[list[float], list[float]]:
        """Return standard deviations, and their ratios to those of the prior."""
        factor, nothing = belief.q_factor, [math.nan] * len(self._ends)
        if factor is None:
            return nothing, nothing
        # Rows of a column-major matrix would be summed in another order, with other rounding.
        chosen = factor[self._rows]
        after = np.sqrt(np.add.reduce(chosen * chosen, axis=1))
        std = after
        if not factor.flags.c_contiguous:
            std = np.sqrt(np.add.reduce(factor * factor, axis=1))[self._rows]
        if belief.rest is not None:
            std = np.hypot(std, belief.rest[self._rows])
        if belief.prior_factor is None:
            return std.tolist(), nothing
        if self._prior[0] is not belief.prior_factor:
            self._prior = belief.prior_factor, self._before(belief.prior_factor)
        pairs = zip(after.tolist(), self._prior[1], strict=True)
        return std.tolist(), [share / before for share, before in pairs]

    def _before(self, prior: Array) -> list[float]:
        """Return prior standard deviations; NaN if there is none."""
        before = np.linalg.norm(prior[self._rows], axis=1)
        found: list[float] = np.where(before > 0.0, before, np.nan).tolist()
        return found


def _ends(unknown: Any) -> Ends:
    """Return the function from value and standard deviation to interval ends; () if symmetric."""
    if unknown.prior.symmetric:
        return lambda value, std: ()
    if not isinstance(unknown.prior, Normal):
        return lambda value, std: tuple(map(float, unknown.interval(value, std, LEVEL)))
    from statistics import NormalDist

    quantile = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)
    lower, upper = map(float, unknown.prior.bounds)

    def clipped(value: float, std: float) -> tuple[float, float]:
        if not math.isfinite(value + quantile * std):
            low, high = unknown.interval(value, std, LEVEL)
            return float(low), float(high)
        low, high = value - quantile * std, value + quantile * std
        return min(max(low, lower), upper), min(max(high, lower), upper)

    return clipped
