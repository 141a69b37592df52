"""Transforms q = T(latent) of unknowns that stay positive or within bounds.

Transforms act coefficient by coefficient. Laws work with the latent coefficients, whose prior is
Gaussian; weak forms and sensors see q.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array

__all__ = ["Identity", "Log", "Logit", "Transform"]


class Transform(ABC):
    """A smooth increasing function of one variable with its derivatives and its inverse."""

    @abstractmethod
    def value(self, latent: Array) -> Array:
        """Return q = T(latent)."""

    @abstractmethod
    def slope(self, latent: Array) -> Array:
        """Return T'(latent)."""

    @abstractmethod
    def curvature(self, latent: Array) -> Array:
        """Return T''(latent)."""

    @abstractmethod
    def inverse(self, q: Array) -> Array:
        """Return the latent value of q; not finite where q lies outside of the range of T."""

    def shifted(self, q: Array, std: Array, z: float) -> Array:
        """Return q shifted by z latent standard deviations: a quantile of T(Gaussian).

        Parameters
        ----------
        q, std
            T of the latent mean, and T' times the latent standard deviation; NaN stays NaN. Where q
            equals an end of T's range to rounding, the latent standard deviation cannot be
            recovered, and the end on the side of z is returned.
        """
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            latent = self.inverse(q)
            moved = latent + z * std / self.slope(latent)
            # A value at an end of the range has an infinite latent value: its quantiles are the
            # ends themselves.
            moved = np.where(np.isfinite(moved), moved, np.copysign(np.inf, z))
            return np.where(np.isnan(std), np.nan, self.value(moved))


@dataclass(frozen=True)
class Identity(Transform):
    """Identity transform: q = latent."""

    def value(self, latent: Array) -> Array:
        return latent

    def slope(self, latent: Array) -> Array:
        return np.ones_like(latent)

    def curvature(self, latent: Array) -> Array:
        return np.zeros_like(latent)

    def inverse(self, q: Array) -> Array:
        return q


@dataclass(frozen=True)
class Log(Transform):
    """Logarithmic transform: q = lower + exp(latent), above a bound."""

    lower: float = 0.0

    def value(self, latent: Array) -> Array:
        return np.asarray(self.lower + np.exp(latent))

    def slope(self, latent: Array) -> Array:
        return np.asarray(np.exp(latent))

    def curvature(self, latent: Array) -> Array:
        return np.asarray(np.exp(latent))

    def inverse(self, q: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(q - self.lower))


@dataclass(frozen=True)
class Logit(Transform):
    """Logistic transform: q = lower + (upper - lower) / (1 + exp(-latent)), between bounds."""

    lower: float
    upper: float

    def _share(self, latent: Array) -> Array:
        # The logistic function by tanh does not overflow for large negative arguments.
        return np.asarray(0.5 * (1.0 + np.tanh(0.5 * latent)))

    def value(self, latent: Array) -> Array:
        return self.lower + (self.upper - self.lower) * self._share(latent)

    def slope(self, latent: Array) -> Array:
        share = self._share(latent)
        return (self.upper - self.lower) * share * (1.0 - share)

    def curvature(self, latent: Array) -> Array:
        share = self._share(latent)
        return (self.upper - self.lower) * share * (1.0 - share) * (1.0 - 2.0 * share)

    def inverse(self, q: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            # Two logarithms, since the quotient could overflow close to a bound.
            return np.asarray(np.log(q - self.lower) - np.log(self.upper - q))
