"""Evolution models of unknowns q(t) between two samples, as assumed by the laws.

Each is a linear stochastic differential equation for the latent coefficients about their prior
mean,

    d(q - prior) = K (q - prior) dt + noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.errors import SpaceError
from livepde.linalg import Array


def _positive(what: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise SpaceError(f"{what} must be a positive number; got {value}.")


@dataclass(frozen=True)
class Evolution:
    """Evolution model of an unknown; this base class, `CONSTANT`, does not move."""

    @property
    def copies(self) -> int:
        """Number of components of the evolution; q is a sum of the `visible` ones."""
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
        """True unless the unknown is constant."""
        return self != CONSTANT

    def transition(self, h: float) -> Array:
        """Return exp(K h), shape (copies, copies)."""
        return np.eye(1)

    def growth(self, h: float, std: float) -> Array:
        """Return the variance added to each component in h, relative to the prior's, (copies,)."""
        return np.zeros(1)


@dataclass(frozen=True)
class RandomWalk(Evolution):
    """Random walk: a standard deviation of rate * sqrt(h) is added in a time h.

    Parameters
    ----------
    rate
        In the unit of the unknown (of its logarithm for a `LogNormal`) per square root of the
        model's unit of time.
    """

    rate: float

    def __post_init__(self) -> None:
        _positive("RandomWalk: rate", self.rate)

    def growth(self, h: float, std: float) -> Array:
        # The variance rate^2 h, relative to std^2.
        return np.array([self.rate**2 * h / std**2])


@dataclass(frozen=True)
class MeanReverting(Evolution):
    """Ornstein-Uhlenbeck process: relaxation time `time`, stationary law the prior."""

    time: float

    def __post_init__(self) -> None:
        _positive("MeanReverting: time", self.time)

    @property
    def generator(self) -> Array:
        return np.array([[-1.0 / self.time]])

    def transition(self, h: float) -> Array:
        return np.array([[np.exp(-h / self.time)]])

    def growth(self, h: float, std: float) -> Array:
        # exp(-2 h/time) of the variance is left; the noise restores that of the prior.
        return np.array([-np.expm1(-2.0 * h / self.time)])


@dataclass(frozen=True)
class Periodic(Evolution):
    """A constant and harmonics: q(t) = q_0 + sum over k of a_k cos(2 pi k t/period + phase_k).

    The constant has the prior mean; each harmonic has the prior standard deviation. The amplitudes
    rotate with time, so that the equation is autonomous and a law needs no clock.
    """

    period: float
    harmonics: int = 1

    def __post_init__(self) -> None:
        _positive("Periodic: period", self.period)
        if self.harmonics < 1:
            raise SpaceError(f"Periodic: harmonics must be at least 1; got {self.harmonics}.")

    @property
    def copies(self) -> int:
        return 1 + 2 * self.harmonics

    @property
    def visible(self) -> Array:
        # A harmonic is a pair (a cos, a sin) that rotates: q contains its first component.
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
