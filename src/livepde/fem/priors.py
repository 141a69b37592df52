"""Priors of unknowns, and their evolution between samples.

A prior is Gaussian in a latent value a, with q = T(a). Laws use a; weak forms and sensors use q. An
evolution is a linear stochastic differential equation for a about its prior mean,

    d(a - prior) = K (a - prior) dt + noise.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.errors import SpaceError, require_positive
from livepde.linalg import Array


@dataclass(frozen=True)
class Evolution:
    """Evolution model of an unknown. The base class, with the instance `CONSTANT`, is constant."""

    @property
    def copies(self) -> int:
        """Number of components of the evolution; `visible` are their weights in q."""
        return 1

    @property
    def visible(self) -> Array:
        """Weight of each component in q, shape (copies,)."""
        return np.ones(1)

    @property
    def generator(self) -> Array:
        """Drift matrix K of the components, shape (copies, copies)."""
        return np.zeros((1, 1))

    @property
    def moves(self) -> bool:
        """Whether the unknown varies in time."""
        return self != CONSTANT

    def transition(self, h: float) -> Array:
        """Return exp(K h), shape (copies, copies)."""
        return np.eye(1)

    def growth(self, h: float, std: float) -> Array:
        """Return the variance added in a time h over the prior variance, shape (copies,)."""
        return np.zeros(1)


@dataclass(frozen=True)
class RandomWalk(Evolution):
    """Random walk: the increment in a time h has the standard deviation rate * sqrt(h).

    The rate is in the unit of the unknown (for a `LogNormal`, of its logarithm) per square root of
    the model's unit of time.

    Examples
    --------
    >>> import livepde as lp
    >>> day = 86400.0  # s
    >>> flux = lp.Scalar(lp.Normal(0.0, std=1e-6), evolution=lp.RandomWalk(1e-7 / day**0.5))
    >>> flux.evolution.moves
    True
    """

    rate: float

    def __post_init__(self) -> None:
        require_positive("RandomWalk: rate", self.rate, SpaceError)

    def growth(self, h: float, std: float) -> Array:
        # The variance rate^2 h, relative to std^2.
        return np.array([self.rate**2 * h / std**2])


@dataclass(frozen=True)
class MeanReverting(Evolution):
    """Ornstein-Uhlenbeck process with relaxation time `time`; its stationary law is the prior.

    Examples
    --------
    >>> import livepde as lp
    >>> load = lp.Scalar(lp.Normal(0.0, std=10.0), evolution=lp.MeanReverting(time=3600.0))
    >>> load.evolution.moves
    True
    """

    time: float

    def __post_init__(self) -> None:
        require_positive("MeanReverting: time", self.time, SpaceError)

    @property
    def generator(self) -> Array:
        return np.array([[-1.0 / self.time]])

    def transition(self, h: float) -> Array:
        return np.array([[np.exp(-h / self.time)]])

    def growth(self, h: float, std: float) -> Array:
        # The variance decays by exp(-2 h/time), and the noise restores the prior variance.
        return np.array([-np.expm1(-2.0 * h / self.time)])


@dataclass(frozen=True)
class Periodic(Evolution):
    """A constant and harmonics: q(t) = q_0 + sum over k of a_k cos(2 pi k t/period + phase_k).

    The constant has the prior mean; each harmonic has the prior standard deviation. The amplitudes
    rotate with time, so that the evolution is autonomous.
    """

    period: float
    harmonics: int = 1

    def __post_init__(self) -> None:
        require_positive("Periodic: period", self.period, SpaceError)
        if self.harmonics < 1:
            raise SpaceError(f"Periodic: harmonics must be at least 1; got {self.harmonics}.")

    @property
    def copies(self) -> int:
        return 1 + 2 * self.harmonics

    @property
    def visible(self) -> Array:
        # A harmonic is a rotating pair (a cos, a sin), and q contains its first component.
        return np.array([1.0] + self.harmonics * [1.0, 0.0])

    @property
    def generator(self) -> Array:
        K = np.zeros((self.copies, self.copies))
        for k in range(1, self.harmonics + 1):
            omega, at = 2.0 * np.pi * k / self.period, 2 * k - 1
            K[at, at + 1], K[at + 1, at] = -omega, omega
        return K

    def transition(self, h: float) -> Array:
        F = np.eye(self.copies)
        for k in range(1, self.harmonics + 1):
            angle, at = 2.0 * np.pi * k * h / self.period, 2 * k - 1
            c, s = np.cos(angle), np.sin(angle)
            F[at : at + 2, at : at + 2] = [[c, -s], [s, c]]
        return F

    def growth(self, h: float, std: float) -> Array:
        return np.zeros(self.copies)


CONSTANT = Evolution()


class Transform(ABC):
    """A smooth increasing function of one variable, with its derivatives and its inverse."""

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
        """Return the latent value of q; it is not finite if q is outside the range of T."""

    def shifted(self, q: Array, std: Array, z: float) -> Array:
        """Return q shifted by z latent standard deviations: a quantile of T(Gaussian).

        `q` is T of the latent mean, and `std` is T' times the latent standard deviation. NaN
        remains NaN. If q equals an end of the range of T up to rounding, the latent standard
        deviation cannot be recovered, and the end on the side of z is returned.
        """
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            latent = self.inverse(q)
            shifted = latent + z * std / self.slope(latent)
            # At an end of the range, the latent value is infinite, and the quantiles are the ends.
            shifted = np.where(np.isfinite(shifted), shifted, np.copysign(np.inf, z))
            return np.where(np.isnan(std), np.nan, self.value(shifted))

    def moments(self, q: Array, std: Array) -> tuple[Array, Array]:
        """Return mean and standard deviation of T(Gaussian); see `shifted` for `q` and `std`.

        If q equals an end of the range of T up to rounding, `q` and `std` are returned unchanged.
        """
        # T is analytic in a strip, so the trapezoidal rule converges faster than any power of the
        # step: the error is 1e-8 for latent standard deviations up to 20.
        steps = 0.05 * np.arange(-200, 201)
        weights = np.exp(-0.5 * steps**2)
        weights /= weights.sum()
        mean, variance = np.zeros_like(q), np.zeros_like(q)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            latent = self.inverse(q)
            spread = std / self.slope(latent)
            for z, weight in zip(steps, weights, strict=True):
                mean = mean + weight * self.value(latent + z * spread)
            for z, weight in zip(steps, weights, strict=True):
                variance = variance + weight * (self.value(latent + z * spread) - mean) ** 2
        inside = np.isfinite(latent)
        return np.where(inside, mean, q), np.where(inside, np.sqrt(variance), std)


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

    def moments(self, q: Array, std: Array) -> tuple[Array, Array]:
        return q, std


@dataclass(frozen=True)
class Log(Transform):
    """Logarithmic transform: q = lower + exp(latent), above a lower bound."""

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

    def moments(self, q: Array, std: Array) -> tuple[Array, Array]:
        above = q - self.lower
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            variance = (std / above) ** 2  # variance of the logarithm
            factor = np.exp(0.5 * variance)
            mean, spread = self.lower + above * factor, above * factor * np.sqrt(np.expm1(variance))
        inside = above > 0.0
        return np.where(inside, mean, q), np.where(inside, spread, std)


@dataclass(frozen=True)
class Logit(Transform):
    """Logistic transform: q = lower + (upper - lower) / (1 + exp(-latent)), between two bounds."""

    lower: float
    upper: float

    def _share(self, latent: Array) -> Array:
        # The logistic function in terms of tanh does not overflow for large negative arguments.
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
            # Two logarithms, because the quotient could overflow near a bound.
            return np.asarray(np.log(q - self.lower) - np.log(self.upper - q))


class Prior(ABC):
    """Abstract prior distribution of a number.

    `std` is the standard deviation in the unit of the unknown; estimates are within `bounds`.
    """

    std: float
    bounds: tuple[float, float]

    @property
    @abstractmethod
    def centre(self) -> float:
        """Median of the unknown: q at the latent mean."""

    @property
    @abstractmethod
    def transform(self) -> Transform:
        """The transform q = T(latent)."""

    @property
    def text(self) -> str:
        """The prior as text, with bounds if they are not the default bounds of its class."""
        usual = self.bounds == getattr(type(self), "bounds", None)
        bounds = "" if usual else f", bounds={self.bounds}"
        return f"{type(self).__name__}({self.centre:g}, std={self.std:g}{bounds})"

    @property
    def latent_mean(self) -> float:
        """Mean of the latent value."""
        return float(self.transform.inverse(np.array(float(self.centre))))

    @property
    def latent_std(self) -> float:
        """Standard deviation of the latent value: `std` over the slope at the latent mean."""
        return float(self.std / self.transform.slope(np.array(self.latent_mean)))

    @property
    def latent_bounds(self) -> tuple[float, float]:
        """Bounds of the latent value; infinite if the transform enforces them."""
        return (-np.inf, np.inf)

    @property
    def symmetric(self) -> bool:
        """Whether intervals are value +- multiples of std: no transform and no bounds."""
        return False

    def interval(self, value: Any, std: Any, level: float = 0.95) -> tuple[Array, Array]:
        """Return the ends of the central interval that contains q with probability `level`.

        They are quantiles of a Gaussian latent value, mapped by the transform and clipped to the
        bounds. `value` are medians, and `std` standard deviations to first order (the latent
        standard deviation times the slope at the median), of equal shape.
        """
        from statistics import NormalDist

        if not 0.0 < level < 1.0:
            raise SpaceError(f"interval: level must lie between 0 and 1; got {level}.")
        z = NormalDist().inv_cdf(0.5 + 0.5 * level)
        value, std = np.asarray(value, dtype=float), np.asarray(std, dtype=float)
        low, high = (np.clip(self.transform.shifted(value, std, s), *self.bounds) for s in (-z, z))
        return low, high

    def moments(self, value: Any, std: Any) -> tuple[Array, Array]:
        """Return mean and standard deviation of q for a Gaussian latent value.

        See `interval` for `value` and `std`. Bounds of a `Normal` are ignored.
        """
        value, std = np.asarray(value, dtype=float), np.asarray(std, dtype=float)
        return self.transform.moments(value, std)

    def _check(self, centre: str) -> None:
        """Raise an error for invalid numbers; `centre` is the name of the centre: "mean"."""
        kind, at = type(self).__name__, self.centre
        require_positive(f"{kind}: std", self.std, SpaceError)
        lower, upper = self.bounds
        if not lower < upper:
            raise SpaceError(
                f"{kind}: bounds must be (lower, upper) with lower < upper; got {self.bounds}."
            )
        if not lower <= at <= upper:
            raise SpaceError(f"{kind}: {centre} {at} is outside its bounds {self.bounds}.")
        if not np.isfinite(self.transform.inverse(np.array(at))):
            raise SpaceError(
                f"{kind}: {centre} {at} must be finite, and strictly inside {self.bounds}."
            )


@dataclass(frozen=True)
class Normal(Prior):
    """Normal distribution of q with `mean` and `std`, in the unit of the unknown.

    Estimates are clipped to `bounds`, (lower, upper).

    Examples
    --------
    >>> import livepde as lp
    >>> prior = lp.Normal(2.0, std=0.5)
    >>> prior.centre, prior.std
    (2.0, 0.5)
    """

    mean: float = 0.0
    std: float = 1.0
    bounds: tuple[float, float] = (-np.inf, np.inf)

    def __post_init__(self) -> None:
        self._check("mean")

    @property
    def centre(self) -> float:
        return self.mean

    @property
    def transform(self) -> Transform:
        return Identity()

    @property
    def latent_bounds(self) -> tuple[float, float]:
        return self.bounds

    @property
    def symmetric(self) -> bool:
        return not np.isfinite(self.bounds).any()


@dataclass(frozen=True)
class LogNormal(Prior):
    """Normal distribution of log(q - lower): q is positive, or above a finite lower bound.

    Parameters
    ----------
    median
        Median, in the unit of the unknown.
    std
        Standard deviation to first order, in the same unit: the logarithm has std/(median - lower).
    bounds
        (lower, inf) with a finite lower bound.

    Examples
    --------
    >>> import livepde as lp
    >>> prior = lp.LogNormal(1e-4, std=5e-5)
    >>> prior.centre
    0.0001
    """

    median: float
    std: float
    bounds: tuple[float, float] = (0.0, np.inf)

    def __post_init__(self) -> None:
        lower, upper = self.bounds
        if np.isfinite(upper) or not np.isfinite(lower):
            raise SpaceError(
                f"LogNormal: bounds must be (lower, inf) with a finite lower one; got "
                f"{self.bounds}; with an upper one take LogitNormal."
            )
        self._check("median")

    @property
    def centre(self) -> float:
        return self.median

    @property
    def transform(self) -> Transform:
        return Log(self.bounds[0])


@dataclass(frozen=True)
class LogitNormal(Prior):
    """Normal distribution of log((q - lower)/(upper - q)): q is strictly between two bounds.

    Parameters
    ----------
    median
        Median, in the unit of the unknown.
    std
        Standard deviation to first order, in the same unit.
    bounds
        (lower, upper), both finite.

    Examples
    --------
    >>> import livepde as lp
    >>> porosity = lp.LogitNormal(0.3, bounds=(0.0, 1.0), std=0.1)
    >>> porosity.centre
    0.3
    """

    median: float
    std: float
    bounds: tuple[float, float]

    def __post_init__(self) -> None:
        if not np.isfinite(self.bounds).all():
            raise SpaceError(f"LogitNormal: needs two finite bounds; got {self.bounds}.")
        self._check("median")

    @property
    def centre(self) -> float:
        return self.median

    @property
    def transform(self) -> Transform:
        return Logit(*self.bounds)
