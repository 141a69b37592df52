"""Statistics of normalised innovations, which are white with unit variance for a right model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Mask
from livepde.linalg.member_arrays import product

WINDOW = 500  # samples: memory of the statistics, so that a poor start is forgotten
SLOW = 50  # samples over which innovations are averaged to detect errors smaller than the noise
LARGEST_CORRELATION = 0.999
SIGNIFICANT = 1.645  # standard errors: one-sided 5 % level of the normal distribution

TINY = 1e-200  # avoids division by zero; smaller than any sum of squares
FADE = 1.0 - 1.0 / WINDOW
FADES = np.array([FADE, FADE**2, FADE, FADE, FADE, FADE, FADE])  # decay factors of the sums
# An innovation e changes x = (seen, last, slow, slow_variance) of its sensor to D x + s e + c.
DECAY = np.array([[0.0], [0.0], [1.0 - 1.0 / SLOW], [(1.0 - 1.0 / SLOW) ** 2]])
SHARE = np.array([[0.0], [1.0], [1.0 / SLOW], [0.0]])
GAINED = np.array([[1.0], [0.0], [0.0], [1.0 / SLOW**2]])
# Positions of the terms of `sums` among the products of x after a sample with x after and before.
TERMS = np.ravel_multi_index(([0, 0, 1, 0, 1, 0, 2], [0, 0, 1, 4, 5, 3, 2]), (4, 8))


@dataclass(frozen=True, eq=False)
class Innovations:
    """Exponentially weighted moments of the normalised innovations e_k = d_k / sqrt(variance)."""

    # Weighted sums over about `WINDOW` samples, shape (members, 7): number of e; squared weights;
    # e^2; number of pairs (e_k, e_(k-1)); their product; `slow_variance`; square of `slow`.
    sums: Array
    # For each sensor, shape (members, 4, sensors): 1 after its first e, else 0; its last e; the
    # exponential average of e over `SLOW` samples (`slow`); the variance of this average for white
    # noise of unit variance (`slow_variance`).
    sensors: Array
    # e of the last sample, shape (members, sensors), NaN where missing; includes innovations that
    # a gate refused, from the second in a row on.
    newest: Array

    @classmethod
    def start(cls, sensors: int, members: int = 1) -> Innovations:
        """Return the statistics before any innovation."""
        never = np.full((members, sensors), np.nan)
        return cls(np.zeros((members, len(FADES))), np.zeros((members, 4, sensors)), never)

    def add(
        self, e: Array, measured: Mask | None = None, newest: Array | None = None
    ) -> Innovations:
        """Return the statistics after innovations e (members, sensors), NaN where missing.

        `measured`: members with a reading, shape (members,); others do not change. Default all.
        `newest`: innovations including refused ones that count in the test for jumps; default e.
        """
        # Each sum is a product of two rows of the statistics: one matrix product gives all sums.
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
        # `TINY` makes the ratio 1 before any innovation.
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
        """Variance of averaged innovations over its value for unit white noise, (members,).

        Model errors smaller than the noise barely correlate successive innovations, but they do not
        average out.
        """
        return (self.sums[:, 6] + TINY) / (self.sums[:, 5] + TINY)

    @property
    def inflation(self) -> Array:
        """Factor on standard deviations, at least 1, shape (members,).

        Ratio of the standard deviation of a mean of the innovations to its value for white noise of
        the stated size. It is the square root of the larger of two variances: `persistence`, and
        ratio (1 + rho)/(1 - rho) for errors that follow a first-order autoregression.

        If the model is right, both scatter about 1, and the larger one usually exceeds 1. Only the
        significant excess of each is used, see `_beyond_chance`. The standard errors are those for
        white noise: with N values, the mean square has the variance 2/N, and the correlation 1/N.
        `SLOW` values give one independent value of `slow`, and each sensor starts with one.
        """
        count, weight = self.sums[:, 0], self.sums[:, 1]
        sensors = self.sensors[:, 0].sum(axis=1)
        averages = sensors + count**2 / (weight + TINY) / SLOW + TINY
        slow = _beyond_chance(self.persistence, np.sqrt(2.0 / averages))
        return np.maximum(self.scatter, np.sqrt(slow))

    @property
    def unbiased_correlation(self) -> Array:
        """`correlation` corrected for the bias of N samples of each sensor, at least 0, (members,).

        The bias of the correlation r of N values about a fitted mean is -(1 + 3 r)/N (Kendall
        1954), -4/N for large r. Innovations of a right model are white and fit no mean. Therefore
        the correction is 4/N times the significant part of r, as in `_beyond_chance`. The upper
        limit (N - 1)/(N + 1) makes (1 + r)/(1 - r) equal to N: then a mean of the innovations is as
        uncertain as each innovation.
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
        """The part of `inflation` due to the size and correlation of innovations, (members,).

        Errors smaller than the noise are not included: they barely increase the innovations.
        """
        count, weight = self.sums[:, 0], self.sums[:, 1]
        rho = self.unbiased_correlation
        following = self.ratio * (1.0 + rho) / (1.0 - rho)
        # For white noise the variances are 2/N for the mean square and 4/N for (1 + rho)/(1 - rho),
        # which is about 1 + 2 rho. Their sum is 6/N.
        error = np.sqrt(6.0 * weight + TINY) / (count + TINY)
        return np.sqrt(_beyond_chance(following, error))


def _beyond_chance(variance: Array, error: Array) -> Array:
    """Return variances with their excess over 1 reduced to its significant part.

    The result is 1 + x (1 - (c/x)^2) if the excess x is larger than c = `SIGNIFICANT` standard
    errors, else 1. A highly significant excess is almost unchanged.
    """
    excess, chance = variance - 1.0, SIGNIFICANT * error
    beyond = excess > chance
    share = np.where(beyond, chance, 0.0) / np.where(beyond, excess, 1.0)
    return np.where(beyond, 1.0 + excess * (1.0 - share**2), 1.0)
