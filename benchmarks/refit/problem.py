"""Abstract problem: a user's model, a lean forward model, and a truth by another code."""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

import livepde as lp
from benchmarks.refit.process import Process
from benchmarks.refit.unknowns import Belief, Coordinates, Unknown, drawn

Array = NDArray[Any]
Priors = Mapping[str, Belief]


class Problem(ABC):
    """Process with unknowns, its sensors and its truth.

    Attributes
    ----------
    title
        Description of the process.
    unknowns
        livepde's label -> unknown, in livepde's order, with unknowns of sensors last.
    points, noise
        Sensors with their positions, and standard deviation of their noise.
    times
        Times of the samples; the first is the start, without readings.
    longest
        Longest time step.
    converging
        Share of the priors from which the best cost must be reached.
    most_passes
        Bound on the passes over all samples of nine in ten fits.
    law
        Options of the law.
    """

    title: str
    unknowns: Mapping[str, Unknown]
    points: Mapping[str, Any]
    noise: float
    times: Array
    longest: float = np.inf
    converging: ClassVar[float] = 0.95
    most_passes: ClassVar[float] = 13.0
    law: ClassVar[Mapping[str, Any]] = {}

    def at(self, seed: int) -> Problem:
        """Return the problem of a seed, which is the same unless the samples depend on the seed."""
        return self

    def priors(self, seed: int) -> Priors:
        """Draw the priors of a seed, distant from the truth."""
        return drawn(self.unknowns, self._random("priors", seed))

    def readings(self, seed: int) -> Array:
        """Return the noisy readings, shape (samples, sensors); NaN at the start."""
        shown = np.array(self.shown)
        shown += self.noise * self.errors(self._random("noise", seed))
        shown[0] = np.nan
        return shown

    def errors(self, rng: np.random.Generator) -> Array:
        """Draw errors of the readings, in standard deviations of the noise."""
        return rng.standard_normal(self.shown.shape)

    def random(self, what: str, seed: int) -> np.random.Generator:
        """Return the random generator of a seed for one purpose."""
        return self._random(what, seed)

    def _random(self, what: str, seed: int) -> np.random.Generator:
        name = f"{type(self).__name__} {what}"
        return np.random.default_rng([zlib.crc32(name.encode()), seed])

    @cached_property
    def shown(self) -> Array:
        """Readings without noise, shape (samples, sensors)."""
        return self.truth()

    @abstractmethod
    def truth(self) -> Array:
        """Compute `shown` by a code that is independent of livepde and the lean model."""

    @abstractmethod
    def model(self, priors: Priors) -> lp.Model:
        """Return the model as a user of livepde would write it."""

    @property
    def u0(self) -> Any:
        """Initial state as a user of livepde would write it."""
        return 0.0

    @property
    def signals(self) -> Mapping[str, Array]:
        """Input channels at the samples."""
        return {}

    def sensors(self, priors: Priors) -> lp.Points:
        """Return the sensors as a user of livepde would write them."""
        return lp.Points(dict(self.points), noise=self.noise)

    def prior_of(self, name: str, priors: Priors) -> Any:
        """Return the prior of an unknown as a user of livepde would write it."""
        return self.unknowns[name].declared(priors[name])

    def identifier(self, priors: Priors, **options: Any) -> lp.Identifier:
        """Return an identifier with defaults, except for given options of the law.

        Its time steps equal those of the lean forward model.
        """
        stated = {"shadows": lp.laws.Shadows(parts=1)}
        law = lp.SensitivityLaw(**{**stated, **self.law, **options})
        model, sensors = self.model(priors), self.sensors(priors)
        return lp.Identifier(model, sensors, law, u0=self.u0, dt_max=self.longest)

    def stream(self, z: Array) -> list[tuple[float, Array, dict[str, float]]]:
        """Return samples for `Identifier.run`."""
        names = list(self.signals)
        inputs = np.column_stack([*self.signals.values(), np.zeros(len(self.times))])
        return [
            (float(t), row, dict(zip(names, values, strict=False)))
            for t, row, values in zip(self.times, z, inputs.tolist(), strict=True)
        ]

    @cached_property
    @abstractmethod
    def process(self) -> Process:
        """Lean forward model with the discretisation of `model`."""

    @abstractmethod
    def theta(self, q: Array) -> tuple[Array, Array]:
        """Return the coefficients of `process` and their derivative by q, (J,) and (J, m)."""

    def coordinates(self, priors: Priors) -> Coordinates:
        """Return the coordinates of a fit."""
        return Coordinates.of(self.unknowns, priors)

    @property
    def q_true(self) -> Array:
        """True values of q, shape (m,)."""
        return np.array([item.truth for item in self.unknowns.values()])
