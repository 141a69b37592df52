"""Whether the innovations are what the filter expects: white, and of the expected size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array

__all__ = ["Consistency"]

WINDOW = 500  # samples: older innovations fade, so that a poor start is forgotten
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
    last
        e of the last sample, shape (sensors,), NaN where missing.
    """

    count: float
    square: float
    pairs: float
    product: float
    last: Array

    @classmethod
    def start(cls, sensors: int) -> Consistency:
        """Return the value before any innovation."""
        return cls(0.0, 0.0, 0.0, 0.0, np.full(sensors, np.nan))

    def add(self, e: Array) -> Consistency:
        """Return the value after one more vector of normalised innovations."""
        products = e * self.last
        both = np.isfinite(products)
        fade = 1.0 - 1.0 / WINDOW
        return Consistency(
            fade * self.count + float(np.isfinite(e).sum()),
            fade * self.square + float(np.nansum(e**2)),
            fade * self.pairs + float(both.sum()),
            fade * self.product + float(products[both].sum()),
            e,
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
    def inflation(self) -> float:
        """Factor on standard deviations: sqrt(ratio (1 + rho)/(1 - rho)), at least 1.

        The variance of a mean of errors that follow a first-order autoregression.
        """
        rho = max(self.correlation, 0.0)
        return float(np.sqrt(max(1.0, self.ratio * (1 + rho) / (1 - rho))))
