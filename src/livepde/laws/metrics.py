"""The metric of Q in which q learns: a constant gain, or the information that the data have given.

A rule returns the `Metric` of the second line for each stage, and carries its statistics from
sample to sample.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from livepde.fem import Moment
from livepde.laws.coupled import Metric
from livepde.laws.coupled.split_forms import StageForms
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array

HOLD = 1e12  # times smaller is a gain that keeps q where it is

MetricStep = Callable[[float], Metric]
"""Step h of a stage -> its metric."""


@dataclass(frozen=True)
class NoState:
    """Empty state of a rule that carries nothing from sample to sample."""


@dataclass(frozen=True, eq=False)
class StepBegin:
    """A step before it is taken."""

    # Parameter at its beginning, and w = u_alpha + P u with the data at its end.
    q: Array
    w: Array
    # Time and inputs at its end, and how long it is.
    moment: Moment
    length: float


@dataclass(frozen=True, eq=False)
class Transition:
    """A step that was taken, for a rule to learn from."""

    forms: StageForms  # the forms of the stage
    # Parameter as the stage has found it, and w = u_alpha + P u, at its end.
    q: Array
    w: Array
    change: Array  # by how much q has changed, shape (m,)
    # Returns the equation error of the data at its end, shape (n,), R^T eps = -theta R^T M_op r -
    # R^T M r'.
    error: Callable[[], Array]
    # Time and inputs at its end, and how long it was.
    moment: Moment
    length: float


State = TypeVar("State")


class MetricRule(ABC, Generic[State]):
    """Abstract rule for the metric of Q."""

    @abstractmethod
    def init(self, q0: Array) -> State:
        """Return the state before the first sample."""

    @abstractmethod
    def step(self, state: State, forms: StageForms, begin: StepBegin) -> MetricStep:
        """Return the metric of the stages of a step."""

    @abstractmethod
    def frozen(self, state: State, forms: StageForms, begin: StepBegin) -> MetricStep:
        """Return the same for a step in which q is held."""

    def learn(self, state: State, after: Transition) -> State:
        """Return the state after a step."""
        return state

    def doubt(self, state: State, q: Array) -> str:
        """Return why an estimate is not to be believed; empty if it may be."""
        return ""

    def diagnostics(self, state: State, q: Array, length: float) -> Diagnostics[float]:
        """Return gain, information and departure after a step, as far as known."""
        return Diagnostics()


@dataclass(frozen=True, eq=False)
class ConstantMetric(MetricRule[NoState]):
    """G_Q/gain, and the stabilising term sigma q of (noisy_q)."""

    gain: float
    sigma: float

    def init(self, q0: Array) -> NoState:
        return NoState()

    def step(self, state: NoState, forms: StageForms, begin: StepBegin) -> MetricStep:
        return lambda _: Metric(1.0 / self.gain, self.sigma)

    def frozen(self, state: NoState, forms: StageForms, begin: StepBegin) -> MetricStep:
        return lambda _: Metric(HOLD / self.gain)
