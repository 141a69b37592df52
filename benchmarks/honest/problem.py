"""Abstract problem of the benchmark: a truth with a code of its own, and what livepde is told."""

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
"""An input channel as a smooth function of the time; it is read at the samples only."""

DIFFERENCE = 1e-5  # step of finite differences, in standard deviations of the prior


@dataclass(frozen=True, eq=False)
class Latent:
    """One unknown in terms of standard normal coordinates theta.

    Attributes
    ----------
    mean
        Of its Gaussian: of the logarithm where `log`.
    directions
        Number of a sample -> derivative in theta of the value then, shape (values, coordinates).
        A field has a value at each vertex of livepde's mesh.
    log
        Whether the unknown is the exponential of the Gaussian.
    """

    mean: float
    directions: Callable[[int], Array]
    log: bool = True

    def value(self, theta: Array, at: int) -> Array:
        """Return the Gaussian, shape (values,)."""
        return np.asarray(self.mean + self.directions(at) @ theta)

    def inverse(self, q: Any) -> Array:
        """Return the Gaussian of a physical value; -inf for what is not positive."""
        q = np.atleast_1d(np.asarray(q, dtype=float))
        if not self.log:
            return np.asarray(q)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(q > 0.0, np.log(np.maximum(q, 0.0)), -np.inf))


def constant(
    prior: float, std: float, number: int, coordinates: int, *, log: bool = True
) -> Latent:
    """Return a number that is one of the coordinates; its prior is that of a `Scalar`."""
    row = np.zeros((1, coordinates))
    row[0, number] = std / prior if log else std
    return Latent(float(np.log(prior)) if log else prior, lambda at: row, log)


def waves(length: float, *parts: tuple[float, float]) -> Signal:
    """Return a sum of sines that is zero at the start.

    Parameters
    ----------
    length
        Of the run.
    parts
        Amplitude and number of periods in the run.
    """
    return lambda t: np.asarray(sum(a * np.sin(2 * np.pi * n * t / length) for a, n in parts))


class Problem(ABC):
    """A process, its sensors, and a truth that shares no code with livepde.

    Attributes
    ----------
    title
        The process in a few words.
    length, intervals
        Of the run; samples are evenly spaced, the first at 0.
    points
        Sensors and where they are.
    noise
        Standard deviation of the sensors.
    latents
        The unknowns by the label that livepde gives them.
    coordinates
        Number of coordinates theta.
    channels
        Input channels.
    moving
        Unknowns that move.
    u0
        Initial state, a number.
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
        """Return the channels at some times, shape (times, channels)."""
        if not self.channels:
            return np.zeros((len(times), 0))
        return np.column_stack([signal(times) for signal in self.channels.values()])

    @abstractmethod
    def predict(self, theta: Array) -> Array:
        """Return what the sensors show without noise, shape (samples, sensors)."""

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return coordinates from the prior and what the sensors show without noise."""
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
        """Return the process as a user of livepde writes it, mesh included.

        Parameters
        ----------
        refine
            Into so many each cell is divided, to compare with the truth.
        """

    def identifier(self, freed: str | None = None) -> lp.Identifier:
        """Return the identifier with its defaults.

        Parameters
        ----------
        freed
            Sensor whose offset is an unknown, of two noise levels.
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
