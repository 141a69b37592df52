"""Whether the innovations are what the filter expects: white, and of the expected size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array

__all__ = ["Consistency"]

WINDOW = 500  # samples: older innovations fade, so that a poor start is forgotten
SLOW = 50  # samples over which innovations are averaged to find errors that hide below the noise
LARGEST_CORRELATION = 0.999


@dataclass(frozen=True, eq=False)
class Consistency:
    """Fading moments of the normalised innovations e_k = d_k / sqrt(expected variance).

    Attributes
    ----------
    count, square
        Sums of 1 and of e_k^2 over innovations, fading over `WINDOW` samples.
    pairs, product
        Sums of 1 and of e_k e_(k-1).
    slow_count, slow_square
        Sums of 1 and of the squared `slow`.
    last
        Last e of each sensor, shape (sensors,), NaN before its first.
    newest
        e of the last sample, shape (sensors,), NaN where missing.
    slow
        Exponential average of e over `SLOW` samples, shape (sensors,).
    """

    count: float
    square: float
    pairs: float
    product: float
    slow_count: float
    slow_square: float
    last: Array
    newest: Array
    slow: Array

    @classmethod
    def start(cls, sensors: int) -> Consistency:
        """Return the value before any innovation."""
        nothing = np.full(sensors, np.nan)
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, nothing, nothing, np.zeros(sensors))

    def add(self, e: Array) -> Consistency:
        """Return the value after one more vector of normalised innovations."""
        products = e * self.last
        both = np.isfinite(products)
        seen = np.isfinite(e)
        slow = np.where(seen, self.slow + (e - self.slow) / SLOW, self.slow)
        fade = 1.0 - 1.0 / WINDOW
        return Consistency(
            fade * self.count + float(seen.sum()),
            fade * self.square + float(np.nansum(e**2)),
            fade * self.pairs + float(both.sum()),
            fade * self.product + float(products[both].sum()),
            fade * self.slow_count + float(seen.sum()),
            fade * self.slow_square + float((slow[seen] ** 2).sum()),
            np.where(seen, e, self.last),
            e,
            slow,
        )

    @property
    def ratio(self) -> float:
        """Mean of e^2; 1 if the noise level is right."""
        return self.square / self.count if self.count else 1.0

    @property
    def correlation(self) -> float:
        """Correlation of successive innovations; 0 if the model explains the data."""
        if not self.pairs or not self.square:
            return 0.0
        value = self.product / self.pairs / self.ratio
        return float(np.clip(value, -LARGEST_CORRELATION, LARGEST_CORRELATION))

    @property
    def persistence(self) -> float:
        """Variance of the averaged innovations over that of an average of white noise of size 1.

        Model errors smaller than the noise hardly correlate one innovation with the next, and yet
        do not average out.
        """
        if not self.slow_count:
            return 1.0
        return (2 * SLOW - 1) * self.slow_square / self.slow_count

    @property
    def inflation(self) -> float:
        """Factor on standard deviations, at least 1.

        By how much a mean of the innovations is less certain than one of white noise of the stated
        size. The larger of two variances: `persistence`, and ratio (1 + rho)/(1 - rho), of errors
        that follow a first-order autoregression.
        """
        rho = max(self.correlation, 0.0)
        return float(np.sqrt(max(1.0, self.ratio * (1 + rho) / (1 - rho), self.persistence)))
