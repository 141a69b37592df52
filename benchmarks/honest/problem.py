"""Abstract problem of the benchmark: a truth with its own code, and the model for livepde."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import livepde as lp

Array = NDArray[Any]
Signal = Callable[[Array], Array]
"""Input channel as a smooth function of time, which is read only at the samples."""

DIFFERENCE = 1e-5  # step of finite differences, in standard deviations of the prior


@dataclass(frozen=True, eq=False)
class Latent:
    """Unknown as a function of standard normal coordinates theta.

    Attributes
    ----------
    mean
        Mean of the Gaussian, which is the logarithm of the unknown if `log` is true.
    directions
        Index of a sample -> derivative of the Gaussian by theta, shape (values, coordinates). A
        field has a value at each vertex of livepde's mesh.
    log
        Whether the unknown is the exponential of the Gaussian.
    """

    mean: float
    directions: Callable[[int], Array]
    log: bool = True

    def value(self, theta: Array, at: int) -> Array:
        """Return the Gaussian at a sample, shape (values,)."""
        return np.asarray(self.mean + self.directions(at) @ theta)

    def inverse(self, q: Any) -> Array:
        """Return the Gaussian of a physical value; with `log`, -inf if it is not positive."""
        q = np.atleast_1d(np.asarray(q, dtype=float))
        if not self.log:
            return np.asarray(q)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(q > 0.0, np.log(np.maximum(q, 0.0)), -np.inf))


def constant(
    prior: float, std: float, number: int, coordinates: int, *, log: bool = True
) -> Latent:
    """Return a constant unknown that depends on one coordinate, with the prior of a `Scalar`."""
    row = np.zeros((1, coordinates))
    row[0, number] = std / prior if log else std
    return Latent(float(np.log(prior)) if log else prior, lambda at: row, log)


def waves(length: float, *parts: tuple[float, float]) -> Signal:
    """Return a sum of sines that is zero at the start.

    Parameters
    ----------
    length
        Length of the run.
    parts
        Amplitude, and number of periods in the run.
    """
    return lambda t: np.asarray(sum(a * np.sin(2 * np.pi * n * t / length) for a, n in parts))


class Problem(ABC):
    """Process, its sensors, and a truth that shares no code with livepde.

    Attributes
    ----------
    title
        Description of the process.
    length, intervals
        Length of the run, and number of intervals between evenly spaced samples from 0 on.
    points
        Name -> position of each sensor.
    noise
        Standard deviation of the sensors.
    latents
        livepde's label -> unknown.
    coordinates
        Number of coordinates theta.
    channels
        Input channels by name.
    moving
        Labels of unknowns that move.
    u0
        Constant initial state.
    """

    title: str
    length: float
    intervals: int
    points: Mapping[str, Any]
    noise: float
    latents: Mapping[str, Latent]
    coordinates: int
    channels: Mapping[str, Signal]
    moving: tuple[str, ...] = ()
    u0: float = 0.0
    direct: Mapping[str, Any] = MappingProxyType({})

    @property
    def times(self) -> Array:
        """Times of the samples."""
        return np.linspace(0.0, self.length, self.intervals + 1)

    def inputs(self, times: Array) -> Array:
        """Return the channels at given times, shape (times, channels)."""
        if not self.channels:
            return np.zeros((len(times), 0))
        return np.column_stack([signal(times) for signal in self.channels.values()])

    @abstractmethod
    def predict(self, theta: Array) -> Array:
        """Return the readings without noise, shape (samples, sensors)."""

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw coordinates from the prior, and return them with the readings without noise."""
        theta = rng.standard_normal(self.coordinates)
        return theta, self.predict(theta)

    def jacobian(self, theta: Array) -> Array:
        """Return the derivative of `predict`, shape (samples, sensors, coordinates)."""
        here, columns = self.predict(theta), []
        for k in range(self.coordinates):
            step = np.zeros(self.coordinates)
            step[k] = DIFFERENCE
            columns.append(self.predict(theta + step) - here)
        return np.stack(columns, axis=-1) / DIFFERENCE

    @abstractmethod
    def model(self, refine: int = 1) -> lp.Model:
        """Return the model with its mesh, as a user of livepde would write it.

        Parameters
        ----------
        refine
            Number of parts of each cell in each direction, for comparisons with the truth.
        """

    def identifier(self, freed: str | None = None) -> lp.Identifier:
        """Return the identifier with default options.

        Parameters
        ----------
        freed
            Sensor with an unknown offset, whose prior standard deviation is twice the noise.
        """
        model, direct = self.model(), dict(self.direct)
        if freed is not None:
            model = model.with_unknowns({"offset": lp.Normal(0.0, std=2.0 * self.noise)})
            seen = direct.get(freed)
            direct[freed] = lambda q, x: q.offset + (seen(q, x) if seen is not None else 0.0)
        sensors = lp.Points(dict(self.points), noise=self.noise, direct=direct)
        if model.form_initial is not None:
            return lp.Identifier(model, sensors, lp.SensitivityLaw())
        return lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=self.u0)
