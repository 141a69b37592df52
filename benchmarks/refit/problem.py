"""Abstract problem: a model as a user writes it, its lean twin, and a truth by another code."""

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
    """A process with unknowns, its sensors and its truth.

    Attributes
    ----------
    title
        The process in a few words.
    unknowns
        By the label that livepde gives them, in its order: those of sensors come last.
    points, noise
        Sensors with their positions, and the standard deviation of their noise.
    times
        Of the samples, the first at the start, where nothing is measured.
    longest
        Longest step.
    converging
        Share of the priors from which the best cost must be reached.
    most_passes
        Passes over all samples that nine of ten fits may take.
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
        """Return the problem of a seed: itself, unless the samples depend on it."""
        return self

    def priors(self, seed: int) -> Priors:
        """Return the priors of a seed, drawn away from the truth."""
        return drawn(self.unknowns, self._random("priors", seed))

    def readings(self, seed: int) -> Array:
        """Return what is measured, with noise, shape (samples, sensors); NaN at the start."""
        shown = np.array(self.shown)
        shown += self.noise * self.errors(self._random("noise", seed))
        shown[0] = np.nan
        return shown

    def errors(self, rng: np.random.Generator) -> Array:
        """Return errors of the readings in standard deviations of the noise."""
        return rng.standard_normal(self.shown.shape)

    def random(self, what: str, seed: int) -> np.random.Generator:
        """Return the random numbers of a seed for one purpose."""
        return self._random(what, seed)

    def _random(self, what: str, seed: int) -> np.random.Generator:
        name = f"{type(self).__name__} {what}"
        return np.random.default_rng([zlib.crc32(name.encode()), seed])

    @cached_property
    def shown(self) -> Array:
        """What the sensors show without noise at the samples, shape (samples, sensors)."""
        return self.truth()

    @abstractmethod
    def truth(self) -> Array:
        """Compute `shown`, by a code that shares nothing with livepde or the lean model."""

    @abstractmethod
    def model(self, priors: Priors) -> lp.Model:
        """Return the model as a user of livepde writes it."""

    @property
    def u0(self) -> Any:
        """Initial state as a user of livepde writes it."""
        return 0.0

    @property
    def signals(self) -> Mapping[str, Array]:
        """Input channels at the samples."""
        return {}

    def sensors(self, priors: Priors) -> lp.Points:
        """Return the sensors as a user of livepde writes them."""
        return lp.Points(dict(self.points), noise=self.noise)

    def prior_of(self, name: str, priors: Priors) -> Any:
        """Return the prior of an unknown as a user of livepde writes it."""
        return self.unknowns[name].declared(priors[name])

    def identifier(self, priors: Priors, **options: Any) -> lp.Identifier:
        """Return an identifier with its defaults and some more options of the law.

        Its steps are those that are stated, as in the forward model that it is compared with.
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
        """The lean forward model, with the discretisation of `model`."""

    @abstractmethod
    def theta(self, q: Array) -> tuple[Array, Array]:
        """Return the coefficients of `process` and their derivative, shapes (J,) and (J, m)."""

    def coordinates(self, priors: Priors) -> Coordinates:
        """Return the coordinates of a fit."""
        return Coordinates.of(self.unknowns, priors)

    @property
    def q_true(self) -> Array:
        """True values of q, shape (m,)."""
        return np.array([item.truth for item in self.unknowns.values()])
