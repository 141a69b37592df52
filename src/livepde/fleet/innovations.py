"""`Consistency` of many members: its leaves are arrays over members."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from livepde.laws.consistency import LARGEST_CORRELATION, SIGNIFICANT, SLOW, WINDOW
from livepde.linalg import Array

__all__ = ["added", "correlation", "inflation", "ratio"]

Leaves = Mapping[str, Array]
"""Attribute of `Consistency` -> its values, shape (members,) or (members, sensors)."""


def added(old: Leaves, e: Array) -> dict[str, Array]:
    """Return the statistics after normalised innovations, (members, sensors), NaN where missing."""
    seen = np.isfinite(e)
    count = seen.sum(axis=1)
    known = np.where(seen, e, 0.0)
    both = seen & np.isfinite(old["last"])
    before = np.where(both, old["last"], 0.0)
    slow = old["slow"] + np.where(seen, (known - old["slow"]) / SLOW, 0.0)
    kept = (1.0 - 1.0 / SLOW) ** 2 * old["slow_variance"] + 1.0 / SLOW**2
    slow_variance = np.where(seen, kept, old["slow_variance"])
    fade = 1.0 - 1.0 / WINDOW
    return {
        "count": fade * old["count"] + count,
        "weight": fade**2 * old["weight"] + count,
        "square": fade * old["square"] + (known * known).sum(axis=1),
        "pairs": fade * old["pairs"] + both.sum(axis=1),
        "product": fade * old["product"] + (known * before).sum(axis=1),
        "slow_expected": fade * old["slow_expected"] + (slow_variance * seen).sum(axis=1),
        "slow_square": fade * old["slow_square"] + (slow * slow * seen).sum(axis=1),
        "last": np.where(seen, e, old["last"]),
        "newest": e,
        "slow": slow,
        "slow_variance": slow_variance,
    }


def ratio(now: Leaves) -> Array:
    """Return `Consistency.ratio` of each member."""
    return _quotient(now["square"], now["count"], 1.0)


def correlation(now: Leaves) -> Array:
    """Return `Consistency.correlation` of each member."""
    value = _quotient(_quotient(now["product"], now["pairs"], 0.0), ratio(now), 0.0)
    return np.clip(value, -LARGEST_CORRELATION, LARGEST_CORRELATION)


def inflation(now: Leaves) -> Array:
    """Return `Consistency.inflation` of each member."""
    sensors = np.isfinite(now["last"]).sum(axis=1)
    averages = sensors + _quotient(now["count"] ** 2, now["weight"], 0.0) / SLOW
    persistence = _quotient(now["slow_square"], now["slow_expected"], 1.0)
    slow = _beyond_chance(persistence, np.sqrt(_quotient(np.full(len(sensors), 2.0), averages)))
    rho = np.maximum(correlation(now), 0.0)
    following = ratio(now) * (1 + rho) / (1 - rho)
    error = _quotient(np.sqrt(6.0 * now["weight"]), now["count"])
    both = np.maximum(_beyond_chance(following, error), slow)
    return np.where(now["weight"] > 0.0, np.sqrt(both), 1.0)


def _beyond_chance(variance: Array, error: Array) -> Array:
    excess, chance = variance - 1.0, SIGNIFICANT * error
    share = _quotient(chance, excess, 1.0)
    return np.where(excess > chance, 1.0 + excess * (1.0 - share**2), 1.0)


def _quotient(a: Array, b: Array, otherwise: float = np.inf) -> Array:
    """Return a/b, and `otherwise` where b is zero."""
    zero = b == 0.0
    quotient: Array = np.where(zero, otherwise, a / np.where(zero, 1.0, b))
    return quotient
