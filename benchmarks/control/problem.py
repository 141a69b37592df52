"""Closed-loop problem: a plant, the model of the controller, and its goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from livepde.control import Goal, ReducedModel, Trust
from livepde.fem import Inputs, Moment
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation
from livepde.stepping import ForwardStage

Values = Callable[[float], Mapping[str, float]]
"""t -> name -> value."""


class Plant(Protocol):
    """True process, of which estimators and controllers see only the measurements."""

    def advance(self, t: float, inputs: Mapping[str, float]) -> None:
        """Advance to t with constant inputs."""

    def measure(self) -> Array:
        """Return the current noisy readings of the sensors, shape (sensors,)."""

    def outputs(self) -> Array:
        """Return the current outputs, shape (outputs,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """Control problem for the comparison of estimators and controllers.

    Attributes
    ----------
    name, title
        Short name, and description.
    reduced
        Reduced model of all controllers; sensors and outputs have the order of the plant's.
    identifier
        Function that returns livepde's identifier before the first sample.
    goal, period, horizon
        Arguments of `livepde.control.MPC`.
    samples
        Number of samples of a run.
    plant
        Seed -> plant at the first sample.
    truth
        t -> true values of the unknowns by label, for the true model and for figures.
    drive
        Argument of `livepde.control.Kalman`.
    reference
        t -> target values of the tracked outputs.
    disturbances
        t -> measured disturbances, constant over the period that ends at t.
    before
        Inputs before the first sample.
    limits
        t -> time-dependent limits of outputs, output -> (low, high); None: the limits of the goal.
    tolerance
        Excess over a limit that does not count as a violation.
    jump
        Time of a sudden change; NaN if there is none.
    foreseen
        Whether future disturbances are known; otherwise the forecast is their current value.
    trust
        Conditions for the use of livepde's estimate.
    settled
        Time at which livepde should have learned if there is no jump; NaN: the first trusted
        sample.
    """

    name: str
    title: str
    reduced: ReducedModel
    identifier: Callable[[], Identifier]
    goal: Goal
    period: float
    horizon: int
    samples: int
    plant: Callable[[int], Plant]
    truth: Values
    drive: Mapping[str, float]
    reference: Values
    disturbances: Values
    before: Mapping[str, float]
    limits: Callable[[float], Mapping[str, tuple[float, float]]] | None = None
    tolerance: float = 0.0
    jump: float = np.nan
    foreseen: bool = False
    trust: Trust = field(default_factory=Trust)
    settled: float = np.nan

    @property
    def times(self) -> list[float]:
        """Times of the samples."""
        return [self.period * k for k in range(self.samples + 1)]

    def limits_at(self, t: float) -> Mapping[str, tuple[float, float]]:
        """Return the limits of outputs at time t."""
        return self.goal.limits if self.limits is None else self.limits(t)

    def ahead(self, t: float) -> dict[str, Any]:
        """Return the arguments of `Loop.step` about the future: references and limits.

        Disturbances are included if they are foreseen.
        """
        coming = [t + self.period * (k + 1) for k in range(self.horizon)]
        reference = [self.reference(now) for now in coming]
        limits = [self.limits_at(now) for now in coming]
        others = [self.disturbances(now) for now in coming] if self.foreseen else [{}]
        return {
            "forecast": {name: [at[name] for at in others] for name in others[0]},
            "reference": {name: [at[name] for at in reference] for name in self.goal.track},
            "limits": {
                name: ([at[name][0] for at in limits], [at[name][1] for at in limits])
                for name in self.goal.limits
            },
        }


class Simulated:
    """Plant simulated by livepde, with a finer mesh and shorter steps than the model.

    Parameters
    ----------
    model
        Model of the process.
    sensors, outputs
        Measured quantities with their noise, and controlled quantities.
    truth
        t -> true values of the unknowns by label.
    u0
        Initial state.
    step
        Longest time step.
    seed
        Seed of the noise.
    start
        Inputs at the start.
    """

    def __init__(
        self,
        model: Model,
        sensors: Observation,
        outputs: Observation,
        truth: Values,
        *,
        u0: float,
        step: float,
        seed: int,
        start: Mapping[str, float],
    ) -> None:
        spaces = (model.state_space, model.X, model.parameter_space)
        self.model = model
        self.truth = truth
        self.dt = step
        self.forward = ForwardStage(model)
        self.sensors, self.seen = sensors.bind(*spaces), outputs.bind(*spaces)
        self.rng = np.random.default_rng(seed)
        self.t = 0.0
        self.inputs = Inputs(start)
        self.u = model.initial(u0, Moment(0.0, self.inputs))

    def advance(self, t: float, inputs: Mapping[str, float]) -> None:
        """Advance to t with constant inputs."""
        self.inputs = Inputs(inputs)
        count = int(np.ceil((t - self.t) / self.dt * (1.0 - 1e-12)))
        h = (t - self.t) / count
        for k in range(1, count + 1):
            now = self.t + k * h
            moment = Moment(now, self.inputs)
            q = self.model.latent.inverse(self._q(now))
            self.u = self.forward.solve(self.u, q, h, moment)
        self.t = t

    def measure(self) -> Array:
        """Return the current noisy readings of the sensors, shape (sensors,)."""
        exact = self.sensors.predict(self.u, self._q(self.t), Moment(self.t, self.inputs))
        noise = self.sensors.noise
        return exact if noise is None else exact + noise * self.rng.standard_normal(len(exact))

    def outputs(self) -> Array:
        """Return the current outputs, shape (outputs,)."""
        return self.seen.predict(self.u, self._q(self.t), Moment(self.t, self.inputs))

    def _q(self, t: float) -> Array:
        values = self.truth(t)
        return np.array([values[label] for label in self.model.parameter_space.labels])
