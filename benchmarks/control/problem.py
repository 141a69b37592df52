"""What a closed-loop benchmark is: a plant, the model that a controller is given, and a task."""

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
    """The truth. No estimator and no controller sees more of it than what it measures."""

    def advance(self, t: float, inputs: Mapping[str, float]) -> None:
        """Go on to t with inputs that are held."""

    def measure(self) -> Array:
        """Return what the sensors show now, with noise, shape (sensors,)."""

    def outputs(self) -> Array:
        """Return what the outputs are now, shape (outputs,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """A task that several controllers are held against.

    Attributes
    ----------
    name, title
        Short name, and a line about it.
    reduced
        The reduced model that every controller acts on; its sensors and outputs are those of the
        plant, in this order.
    identifier
        Returns livepde's identifier, as it stands before the first sample.
    goal, period, horizon
        As for `livepde.control.MPC`.
    samples
        Length of a run.
    plant
        Seed -> the truth at the first sample.
    truth
        t -> unknown numbers of the plant by label: for the run that knows them, and for figures.
    drive
        As for `livepde.control.Kalman`.
    reference
        t -> what the tracked outputs should be.
    disturbances
        t -> measured disturbances, held over the period that ends at t.
    before
        Inputs before the first sample.
    limits
        t -> limits of outputs that change with time, output -> (least, largest); None: the goal's.
    tolerance
        By how much a limit may be missed without counting as violated.
    jump
        Time of a sudden change; NaN if there is none.
    foreseen
        Whether disturbances are known beforehand; else their forecast is what they are now.
    trust
        When livepde's estimate is used.
    settled
        Time from which it should have learned, where nothing jumps; NaN: from the first sample at
        which the estimate was trusted.
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
        """Return the limits of outputs at a time."""
        return self.goal.limits if self.limits is None else self.limits(t)

    def ahead(self, t: float) -> dict[str, Any]:
        """Return what `Loop.step` is told of the future: references and limits are known.

        So are disturbances, if they are foreseen.
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
    """A plant that livepde simulates, on a finer mesh and with shorter steps than the model.

    Parameters
    ----------
    model
        The process.
    sensors, outputs
        What is measured, with its noise, and what is controlled.
    truth
        t -> unknown numbers by label.
    u0
        Initial state.
    step
        Longest step.
    seed
        Of the noise.
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
        """Go on to t with inputs that are held."""
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
        """Return what the sensors show now, with noise, shape (sensors,)."""
        exact = self.sensors.predict(self.u, self._q(self.t), Moment(self.t, self.inputs))
        noise = self.sensors.noise
        return exact if noise is None else exact + noise * self.rng.standard_normal(len(exact))

    def outputs(self) -> Array:
        """Return what the outputs are now, shape (outputs,)."""
        return self.seen.predict(self.u, self._q(self.t), Moment(self.t, self.inputs))

    def _q(self, t: float) -> Array:
        values = self.truth(t)
        return np.array([values[label] for label in self.model.parameter_space.labels])
