"""Whether the innovations are what the filter expects: white, and of the expected size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from livepde.linalg import Array

__all__ = ["Consistency"]

WINDOW = 500  # samples: older innovations fade, so that a poor start is forgotten
SLOW = 50  # samples over which innovations are averaged to find errors that hide below the noise
LARGEST_CORRELATION = 0.999
SIGNIFICANT = 1.645  # standard errors above 1 that a statistic has by chance in 5 of 100 cases


@dataclass(frozen=True, eq=False)
class Consistency:
    """Fading moments of the normalised innovations e_k = d_k / sqrt(expected variance).

    Attributes
    ----------
    count, weight, square
        Sums of 1, of squared weights, and of e_k^2 over innovations, fading over `WINDOW` samples.
    pairs, product
        Sums of 1 and of e_k e_(k-1).
    slow_expected, slow_square
        Sums of `slow_variance` and of the squared `slow`.
    last
        Last e of each sensor, shape (sensors,), NaN before its first.
    newest
        e of the last sample, shape (sensors,), NaN where missing.
    slow, slow_variance
        Exponential average of e over `SLOW` samples, and its variance for white noise of size 1,
        shapes (sensors,).
    """

    count: float
    weight: float
    square: float
    pairs: float
    product: float
    slow_expected: float
    slow_square: float
    last: Array
    newest: Array
    slow: Array
    slow_variance: Array

    @classmethod
    def start(cls, sensors: int) -> Consistency:
        """Return the value before any innovation."""
        never, zero = np.full(sensors, np.nan), np.zeros(sensors)
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, never, never, zero, zero)

    def add(self, e: Array) -> Consistency:
        """Return the value after one more vector of normalised innovations."""
        seen = np.isfinite(e)
        both = seen & np.isfinite(self.last)
        count, pairs = int(np.count_nonzero(seen)), int(np.count_nonzero(both))

        def where_seen(new: Array, else_: Array | float) -> Array:
            return new if count == len(e) else np.where(seen, new, else_)

        known = where_seen(e, 0.0)
        # Before its first value a sensor has no product, and later none where it is missing.
        before = self.last if pairs == len(e) else np.where(both, self.last, 0.0)
        slow = where_seen(self.slow + (known - self.slow) / SLOW, self.slow)
        kept = (1.0 - 1.0 / SLOW) ** 2 * self.slow_variance + 1.0 / SLOW**2
        slow_variance = where_seen(kept, self.slow_variance)
        fade = 1.0 - 1.0 / WINDOW
        return Consistency(
            fade * self.count + count,
            fade**2 * self.weight + count,
            fade * self.square + float(known @ known),
            fade * self.pairs + pairs,
            fade * self.product + float(known @ before),
            fade * self.slow_expected + float(slow_variance @ seen),
            fade * self.slow_square + float((slow * slow) @ seen),
            where_seen(e, self.last),
            e,
            slow,
            slow_variance,
        )

    @property
    def ratio(self) -> float:
        """Mean of e^2; 1 if the noise level is right."""
        return self.square / self.count if self.count else 1.0

    @cached_property
    def correlation(self) -> float:
        """Correlation of successive innovations; 0 if the model explains the data."""
        if not self.pairs or not self.square:
            return 0.0
        value = self.product / self.pairs / self.ratio
        return min(max(value, -LARGEST_CORRELATION), LARGEST_CORRELATION)

    @property
    def persistence(self) -> float:
        """Variance of the averaged innovations over that of an average of white noise of size 1.

        Model errors smaller than the noise hardly correlate one innovation with the next, and yet
        do not average out.
        """
        return self.slow_square / self.slow_expected if self.slow_expected else 1.0

    @property
    def inflation(self) -> float:
        """Factor on standard deviations, at least 1.

        By how much a mean of the innovations is less certain than one of white noise of the stated
        size. The larger of two variances: `persistence`, and ratio (1 + rho)/(1 - rho), of errors
        that follow a first-order autoregression.

        Both scatter about 1 where the model is right, and the larger one lies above 1 more often
        than not. So each counts by what it exceeds chance: see `_beyond_chance`. Their standard
        errors are those for white noise: of N values the mean square has the variance 2/N, the
        correlation 1/N; and `SLOW` values make one independent value of `slow`, of which each
        sensor has one from the start.
        """
        if not self.weight:
            return 1.0
        averages = float(np.isfinite(self.last).sum()) + self.count**2 / self.weight / SLOW
        slow = _beyond_chance(self.persistence, math.sqrt(2.0 / averages))
        return max(self.scatter, math.sqrt(slow))

    @property
    def scatter(self) -> float:
        """The part of `inflation` that comes from the size of innovations and their correlation.

        Errors that hide below the noise are not: they hardly make the innovations larger.
        """
        if not self.weight:
            return 1.0
        rho = max(self.correlation, 0.0)
        following = self.ratio * (1 + rho) / (1 - rho)
        return math.sqrt(_beyond_chance(following, math.sqrt(6.0 * self.weight) / self.count))


def _beyond_chance(variance: float, error: float) -> float:
    """Return a variance, shrunk towards 1 as far as its standard error explains what it exceeds 1.

    1 + x (1 - (c/x)^2) where the excess x is larger than c = `SIGNIFICANT` standard errors, else 1:
    nothing is lost of what is far beyond chance.
    """
    excess, chance = variance - 1.0, SIGNIFICANT * error
    return 1.0 + excess * (1.0 - (chance / excess) ** 2) if excess > chance else 1.0
