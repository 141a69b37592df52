"""Statistics of the normalised innovations: white and of unit variance for a right model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Mask
from livepde.linalg.member_arrays import product

WINDOW = 500  # samples: older innovations fade, so that a poor start is forgotten
SLOW = 50  # samples over which innovations are averaged to find errors that hide below the noise
LARGEST_CORRELATION = 0.999
SIGNIFICANT = 1.645  # standard errors above 1 that a statistic has by chance in 5 of 100 cases

TINY = 1e-200  # no sum of squares of anything, but no zero
FADE = 1.0 - 1.0 / WINDOW
FADES = np.array([FADE, FADE**2, FADE, FADE, FADE, FADE, FADE])  # of the sums
# A sensor that brings e has D x + s e + c after x = (seen, last, slow, slow_variance).
DECAY = np.array([[0.0], [0.0], [1.0 - 1.0 / SLOW], [(1.0 - 1.0 / SLOW) ** 2]])
SHARE = np.array([[0.0], [1.0], [1.0 / SLOW], [0.0]])
GAINED = np.array([[1.0], [0.0], [0.0], [1.0 / SLOW**2]])
# Where in products of rows of x after a sample with those of x after it, and before it, the terms
# of the sums stand.
TERMS = np.ravel_multi_index(([0, 0, 1, 0, 1, 0, 2], [0, 0, 1, 4, 5, 3, 2]), (4, 8))


@dataclass(frozen=True, eq=False)
class Innovations:
    """Fading moments of the normalised innovations e_k = d_k / sqrt(expected variance)."""

    # Shape (members, 7), fading over `WINDOW` samples: number of e; of squared weights; e^2; number
    # of pairs (e_k, e_(k-1)); their product; `slow_variance`; square of `slow`.
    sums: Array
    # Shape (members, 4, sensors), of each sensor: 1 once it has brought an e, else 0; its last e;
    # the exponential average of e over `SLOW` samples (`slow`); the variance of that for white
    # noise of size 1 (`slow_variance`).
    sensors: Array
    # e of the last sample, shape (members, sensors), NaN where missing; also of values that a gate
    # has refused twice in a row.
    newest: Array

    @classmethod
    def start(cls, sensors: int, members: int = 1) -> Innovations:
        """Return the value before any innovation."""
        never = np.full((members, sensors), np.nan)
        return cls(np.zeros((members, len(FADES))), np.zeros((members, 4, sensors)), never)

    def add(
        self, e: Array, measured: Mask | None = None, newest: Array | None = None
    ) -> Innovations:
        """Return the value after innovations of shape (members, sensors), NaN where missing.

        Members that were not `measured`, shape (members,), stay as they are; default all were.
        `newest` are those with some that were not used; default e.
        """
        # Every sum is a product of two rows of the statistics, so that one matrix product serves
        # all of them.
        seen, before = np.isfinite(e), self.sensors
        newest = e if newest is None else newest
        if np.count_nonzero(seen) == seen.size:
            counted = sensors = DECAY * before + (SHARE * e[:, None] + GAINED)
        else:
            sensors = DECAY * before + (SHARE * np.where(seen, e, 0.0)[:, None] + GAINED)
            sensors = np.where(seen[:, None], sensors, before)
            counted = sensors * seen[:, None]
        rows = np.concatenate([sensors, before], axis=1).transpose(0, 2, 1)
        products = product(counted, rows)
        sums = FADES * self.sums + products.reshape(len(e), -1).take(TERMS, axis=1)
        if measured is not None and not measured.all():
            sums = np.where(measured[:, None], sums, self.sums)
            newest = np.where(measured[:, None], newest, self.newest)
        return Innovations(sums, sensors, newest)

    @property
    def ratio(self) -> Array:
        """Mean of e^2 of each member, shape (members,); 1 if the noise level is right."""
        # `TINY` on both sides makes the ratio 1, that of a right model, before any innovation.
        return (self.sums[:, 2] + TINY) / (self.sums[:, 0] + TINY)

    @property
    def correlation(self) -> Array:
        """Correlation of successive innovations, (members,); 0 if the model explains the data."""
        # The bound keeps (1 + rho)/(1 - rho) finite, and rounding can exceed 1.
        correlation = self.sums[:, 4] / (self.sums[:, 3] + TINY) / (self.ratio + TINY)
        return np.minimum(np.maximum(correlation, -LARGEST_CORRELATION), LARGEST_CORRELATION)

    @property
    def diagnostics(self) -> Diagnostics[Array]:
        """Ratio and correlation, each of shape (members,)."""
        ratio, correlation = self.ratio, self.correlation
        return Diagnostics(innovation_ratio=ratio, innovation_correlation=correlation)

    @property
    def persistence(self) -> Array:
        """Variance of the averaged innovations over that of an average of white noise of size 1.

        Model errors smaller than the noise hardly correlate one innovation with the next, and yet
        do not average out. Shape (members,).
        """
        return (self.sums[:, 6] + TINY) / (self.sums[:, 5] + TINY)

    @property
    def inflation(self) -> Array:
        """Factor on standard deviations, at least 1, shape (members,).

        Ratio of the standard deviation of a mean of the innovations to that of a mean of white
        noise of the stated size: the square root of the larger of two variances, `persistence`, and
        ratio (1 + rho)/(1 - rho), of errors that follow a first-order autoregression.

        Both scatter about 1 where the model is right, and the larger one lies above 1 more often
        than not. So only the excess of each beyond chance counts: see `_beyond_chance`. Their
        standard errors are those for white noise: of N values the mean square has the variance 2/N,
        the correlation 1/N; and `SLOW` values make one independent value of `slow`, of which each
        sensor has one from the start.
        """
        count, weight = self.sums[:, 0], self.sums[:, 1]
        sensors = self.sensors[:, 0].sum(axis=1)
        averages = sensors + count**2 / (weight + TINY) / SLOW + TINY
        slow = _beyond_chance(self.persistence, np.sqrt(2.0 / averages))
        return np.maximum(self.scatter, np.sqrt(slow))

    @property
    def unbiased_correlation(self) -> Array:
        """`correlation` of the process behind N samples of each sensor, at least 0, (members,).

        The correlation r of N values about a mean that is fitted is too small by (1 + 3 r)/N
        (Kendall 1954), 4/N for large r. Innovations of a right model are white and fit no mean, so
        the correction is 4/N times the part of r beyond chance, as in `_beyond_chance`. At most
        (N - 1)/(N + 1): then (1 + r)/(1 - r) is N, and a mean of the innovations is as uncertain
        as each of them.
        """
        count, weight = self.sums[:, 0], self.sums[:, 1]
        sensors = np.maximum(self.sensors[:, 0].sum(axis=1), 1.0)
        N = np.maximum(count**2 / (weight + TINY) / sensors, 1.0)
        rho = np.maximum(self.correlation, 0.0)
        chance = SIGNIFICANT * np.sqrt(weight + TINY) / (count + TINY)
        beyond = rho * (1.0 - np.minimum(chance / np.maximum(rho, TINY), 1.0) ** 2)
        most = np.maximum((N - 1.0) / (N + 1.0), rho)
        return np.asarray(np.minimum(rho + 4.0 / N * beyond, most))

    @property
    def scatter(self) -> Array:
        """The part of `inflation` that comes from the size of innovations and their correlation.

        Errors that hide below the noise are not: they hardly make the innovations larger.
        """
        count, weight = self.sums[:, 0], self.sums[:, 1]
        rho = self.unbiased_correlation
        following = self.ratio * (1.0 + rho) / (1.0 - rho)
        # For white noise the mean square has the variance 2/N, and (1 + rho)/(1 - rho), about
        # 1 + 2 rho, the variance 4/N: together 6/N.
        error = np.sqrt(6.0 * weight + TINY) / (count + TINY)
        return np.sqrt(_beyond_chance(following, error))


def _beyond_chance(variance: Array, error: Array) -> Array:
    """Return variances, shrunk towards 1 as far as their standard error explains the excess.

    1 + x (1 - (c/x)^2) where the excess x is larger than c = `SIGNIFICANT` standard errors, else 1:
    an excess far beyond chance is kept in full.
    """
    excess, chance = variance - 1.0, SIGNIFICANT * error
    beyond = excess > chance
    share = np.where(beyond, chance, 0.0) / np.where(beyond, excess, 1.0)
    return np.where(beyond, 1.0 + excess * (1.0 - share**2), 1.0)
