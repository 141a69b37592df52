"""Benchmark problems, and their simulated or measured data sets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import process_time
from typing import Any

import numpy as np

from livepde.fem import Inputs
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.samples import Sample
from livepde.stepping import Advance, ForwardStage, ImplicitEuler, Interval, Scheme, advance

WARM_UP = 2  # untimed samples, in which matrices are assembled once
LEVELS = (0.0, 0.01, 0.05, 0.1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Process:
    """Configuration of the estimators, and the truth.

    Attributes
    ----------
    model, observation, u0, scheme, dt_max, halvings, inputs, validation, assimilate_from
        Arguments of `Identifier`; `inputs` are the channels at each time.
    times
        Times of the samples, shape (times,); the first is the initial time.
    exact
        Data without noise, shape (times, sensors).
    q_true
        Coefficients of the exact parameter at each time, shape (times, m); None for a real process
        with an unknown truth.
    hidden
        Measured values of the validation sensors, shape (times, validation).
    weights
        Gram matrix of Z, shape (sensors, sensors); None: Euclidean.
    """

    model: Model
    observation: Observation
    times: Array
    exact: Array
    q_true: Array | None
    u0: Any
    scheme: Scheme = field(default_factory=ImplicitEuler)
    dt_max: float = np.inf
    halvings: int = Advance.halvings
    inputs: Sequence[Mapping[str, float]] | None = None
    weights: Array | None = None
    validation: Observation | None = None
    hidden: Array | None = None
    assimilate_from: float = -np.inf

    @cached_property
    def size(self) -> Array:
        """Noise of each sensor for the noise level 1, shape (sensors,)."""
        weights = np.eye(self.exact.shape[1]) if self.weights is None else self.weights
        square = np.einsum("ti,ij,tj->t", self.exact, weights, self.exact).mean()
        return np.asarray(np.sqrt(square / (len(weights) * np.diag(weights))))


@dataclass(frozen=True, eq=False)
class Data:
    """Noisy data set of a problem.

    Attributes
    ----------
    problem, process
        Problem, and its process for the seed.
    observation
        Sensors with the noise that estimators assume.
    noise
        Assumed noise of each sensor, shape (sensors,).
    z
        Measurements, shape (times, sensors).
    """

    problem: Problem
    process: Process
    observation: Observation
    noise: Array
    z: Array

    def __len__(self) -> int:
        return len(self.z)

    def __iter__(self) -> Iterator[Sample]:
        process = self.process
        names = self.observed.names
        hidden = process.validation.names(0) if process.validation is not None else ()
        for k, t in enumerate(process.times):
            z: Any = self.z[k]
            if process.hidden is not None:
                z = dict(zip(names, z, strict=True)) | dict(
                    zip(hidden, process.hidden[k], strict=True)
                )
            yield Sample(t=float(t), z=z, inputs=process.inputs[k] if process.inputs else None)

    @cached_property
    def observed(self) -> Observed:
        """Sensors, bound to the model."""
        model = self.process.model
        return self.observation.bind(model.state_space, model.X, model.parameter_space)

    @cached_property
    def forward(self) -> float:
        """Processor time of a forward step with the parameter at its prior, the unit of costs."""
        return float(np.median([self._forward() for _ in range(3)]))

    def _forward(self) -> float:
        process, model = self.process, self.process.model
        stage_of, control = ForwardStage(model), Advance(process.scheme, process.dt_max)
        q, none = model.latent.prior, np.zeros(0)
        rows = [Inputs(dict(row)) for row in process.inputs or [{}] * len(self)]
        times = process.times.tolist()
        at = Interval(t0=times[0], t1=times[0], inputs0=rows[0], inputs1=rows[0], z0=none, z1=none)
        u = model.initial(process.u0, at.end)
        start = process_time()
        for k in range(1, len(times)):
            interval = Interval(
                t0=times[k - 1], t1=times[k], inputs0=rows[k - 1], inputs1=rows[k], z0=none, z1=none
            )

            def stage(c: Array, t: float, h: float, of: Interval = interval) -> Array:
                return stage_of.solve(c, q, h, of.at(t))

            u, _, failure = advance(control, stage, u, *times[k - 1 : k + 1])
            if failure is not None:
                raise failure
            if k == WARM_UP:
                start = process_time()
        return (process_time() - start) / (len(times) - 1 - WARM_UP)

    @property
    def modes(self) -> dict[str, int]:
        """Number of modes of each field, for `SensitivityLaw`."""
        return dict.fromkeys(self.process.model.parameter_space.fields, self.problem.modes)

    def until(self, at: int) -> Data:
        """Return the data up to time index `at`."""
        process, stop = self.process, at + 1

        def cut(values: Any) -> Any:
            return None if values is None else values[:stop]

        shorter = replace(
            process,
            times=process.times[:stop],
            exact=process.exact[:stop],
            q_true=cut(process.q_true),
            inputs=cut(process.inputs),
            hidden=cut(process.hidden),
        )
        return replace(self, process=shorter, z=self.z[:stop])


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A benchmark problem.

    Parameters
    ----------
    name, summary
        Name, and description.
    make
        Seed -> process.
    floor
        Smallest noise level that estimators assume, relative to the data. It accounts for errors of
        their mesh and time step.
    levels
        Noise levels relative to the root mean square of the data; None: the data are measured.
    modes
        Number of modes of a field in the reduced coordinates of all estimators.
    gain
        Constant gain of the gradient law; None if the law does not support the sensors.
    varying
        Whether the parameter varies; if so, scores are means over the second half.
    """

    name: str
    summary: str
    make: Callable[[int], Process]
    floor: float = 1e-3
    levels: tuple[float | None, ...] = LEVELS
    modes: int = 12
    gain: float | None = None
    varying: bool = False

    def data(self, level: float | None, seed: int) -> Data:
        """Draw the truth and the noise of a seed, and return the data."""
        process = self.make(seed)
        if level is None:
            observed = process.observation.bind(
                process.model.state_space, process.model.X, process.model.parameter_space
            )
            noise = observed.noise
            assumed = np.ones(observed.size) if noise is None else noise
            return Data(self, process, process.observation, assumed, process.exact)
        rng = np.random.default_rng([seed, 1])
        noise = process.size * rng.standard_normal(process.exact.shape)
        assumed = max(level, self.floor) * process.size
        observation = replace(process.observation, noise=assumed.tolist())
        return Data(self, process, observation, assumed, process.exact + level * noise)

    def chosen(self, levels: Sequence[float] | None) -> Sequence[float | None]:
        """Return the given noise levels if the data are simulated, else the problem's levels."""
        return self.levels if levels is None or None in self.levels else levels

    def error(self, process: Process, q: Array, at: int = -1) -> float:
        """Return the relative error of q at a time index, as root mean square over unknowns."""
        if process.q_true is None:
            return float("nan")
        model, exact = process.model, process.q_true[at]
        shares = []
        for name in model.parameter_space.blocks:
            part = model.parameter_space.part(name)
            mass = model.parameter_mass[part, part]
            e, true = (q - exact)[part], exact[part]
            shares.append(float(e @ (mass @ e)) / float(true @ (mass @ true)))
        return float(np.sqrt(np.mean(shares)))
