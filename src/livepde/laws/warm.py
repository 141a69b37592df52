"""What a coupled stage leaves to the next one: how good its start was, and its factor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from livepde.linalg import Array
from livepde.stepping import TINY, Parts

if TYPE_CHECKING:
    from livepde.laws.equation import Equation

__all__ = ["Kept", "LeanMisses", "Misses", "Warm"]


@dataclass(frozen=True, eq=False)
class Kept:
    """A factor that goes from stage to stage: where it was made, and how it serves.

    The factor itself is made again from this where it is gone, after a restart say: the numbers
    that follow are the same.

    Attributes
    ----------
    y, u_alpha, h
        Point, data and step of its Jacobian, shapes (n + m,) and (n,); empty if none is kept.
    age
        Stages since then.
    spent
        Updates that these took beyond one each.
    ageing, seen
        By how much more each stage of age makes the second update, relative to the first, and how
        large the first was when that was seen, relative to y. Of the factor before, until it is
        seen again.
    spread, information
        Of its metric: S, and data of J; 0 and empty without one.
    """

    y: Array
    u_alpha: Array
    h: float
    age: int
    spent: int
    ageing: float
    seen: float
    spread: float
    information: Array

    @classmethod
    def none(cls, ageing: float = math.inf, seen: float = 0.0) -> Kept:
        """Return the value without a factor."""
        return cls(np.zeros(0), np.zeros(0), 0.0, 0, 0, ageing, seen, 0.0, np.zeros(0))

    @classmethod
    def made(cls, y: Array, equation: Equation, ageing: float, seen: float) -> Kept:
        """Return the value for a factor made at y in a stage."""
        metric = equation.metric
        learned = (0.0, np.zeros(0)) if metric is None else (metric.spread, metric.data)
        return cls(y, equation.u_alpha, equation.h, 0, 0, ageing, seen, *learned)


@dataclass(frozen=True, eq=False)
class Warm:
    """What a stage leaves to the next one.

    Attributes
    ----------
    missed
        How far `near`, as it was used, was from the solution, relative to u and q.
    miss, trend
        By what `near`, as it was given, missed it, shape (n + m,); and how much of the miss before
        that is: in the unobserved and the observed part of u, and in q, shape (3,).
    h
        Step of that stage; 0 before any.
    kept
        The factor.
    """

    missed: float
    miss: Array
    trend: Array
    h: float
    kept: Kept

    @classmethod
    def none(cls) -> Warm:
        """Return the value before any stage."""
        return cls(math.inf, np.zeros(0), np.zeros(3), 0.0, Kept.none())


class Misses:
    """Compares by what the starts of two stages missed their solutions, in P u, R u and q.

    Parameters
    ----------
    mass
        Diagonal of the lumped mass of the state, shape (n,).
    observed
        Diagonal of R, shape (n,).
    floor
        Squared norm of q below which it counts as this large.
    size
        n + m.
    """

    def __init__(self, mass: Array, observed: Array, floor: float, size: int) -> None:
        self.observed = observed
        self.size = size
        self.parts = self._parts(np.stack([mass, mass * observed], axis=1), floor)

    def _parts(self, state: Array, floor: float) -> Parts:
        """Return the state and what is observed of it, in L2 with lumped mass, and q."""
        n = len(state)
        weights = np.zeros((self.size, 3))
        weights[:n, :2], weights[n:, 2] = state, 1.0
        return Parts(weights, (TINY, TINY, floor))

    @cached_property
    def members(self) -> Array:
        """How much each coefficient belongs to P u, R u and q, shape (3, n + m)."""
        n = len(self.observed)
        members = np.zeros((3, self.size))
        members[1, :n] = self.observed
        members[0, :n] = 1.0 - self.observed
        members[2, n:] = 1.0
        return members

    def trend(self, miss: Array, before: Array) -> Array:
        """Return by how much two misses that follow each other agree, shape (3,)."""
        state, observed, q = self.parts.products(miss, before)
        state0, observed0, q0 = self.parts.products(before, before)
        pairs = (state - observed, state0 - observed0), (observed, observed0), (q, q0)
        return np.array([min(max(a / b, -1.0), 1.0) if b > 0.0 else 0.0 for a, b in pairs])

    def spread(self, trend: Array) -> Array:
        """Return the number of its part for each coefficient: of P u, R u and q."""
        return np.asarray(trend @ self.members)

    def shares(self, trend: Array) -> tuple[float, ...] | None:
        """Return in which of `parts` misses are errors of the time step, and not noise."""
        unobserved, observed, q = trend.tolist()
        return max(unobserved, observed, 0.0), max(observed, 0.0), max(q, 0.0)


class LeanMisses(Misses):
    """The same of a large stage: no array of its size for each part, and no part is noise."""

    def _parts(self, state: Array, floor: float) -> Parts:
        return _LeanParts(state, (TINY, floor))

    def spread(self, trend: Array) -> Array:
        state = trend[0] + (trend[1] - trend[0]) * self.observed
        return np.concatenate([state, np.full(self.size - len(state), trend[2])])

    def shares(self, trend: Array) -> tuple[float, ...] | None:
        return None


@dataclass(frozen=True, eq=False)
class _LeanParts(Parts):
    """The state and the parameter, without an array for each part; weights of shape (n, 2).

    What may be left is a share of the larger of the relative misses, in both parts: q is not known
    better than the time step lets u be known.
    """

    def squares(self, x: Array) -> list[float]:
        state, _, q = self.products(x, x)
        return [state, q]

    def products(self, x: Array, y: Array) -> list[float]:
        n = len(self.weights)
        state, observed = ((x[:n] * y[:n]) @ self.weights).tolist()
        return [state, observed, float(x[n:] @ y[n:])]

    def allowed(self, shares: list[float], missed: list[float], scales: list[float]) -> list[float]:
        floored = [max(scale, floor) for scale, floor in zip(scales, self.floors, strict=True)]
        worst = max(square / scale for square, scale in zip(missed, floored, strict=True))
        return [share**2 * worst * scale for share, scale in zip(shares, floored, strict=True)]
