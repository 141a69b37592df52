"""The observed part u_alpha of the state over one interval: G^+ z, or G_alpha z (section 3.2)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from livepde.laws.law import Problem
from livepde.laws.metrics import NoState
from livepde.laws.sample_smoothing import Balance, NoiseDetector, SmoothingOperator
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Memo
from livepde.observation import Reconstructed, Split
from livepde.stepping import Interval

LARGEST_MEMO = 8  # smoothers kept for different sets of present sensors

State = TypeVar("State")


class ObservedPath(ABC):
    """u_alpha at any time of an interval, each found once."""

    def __init__(self, problem: Problem, interval: Interval) -> None:
        self.problem = problem
        self.interval = interval
        self._found: dict[float, Reconstructed] = {}

    def at(self, t: float) -> Reconstructed:
        """Return u_alpha at a time."""
        if t not in self._found:
            self._found[t] = self.find(self.interval.z(t), self.boundary(t))
        return self._found[t]

    def boundary(self, t: float) -> Array | None:
        """Return the Dirichlet values, shape (n,); None if all of them are zero."""
        model = self.problem.model
        if model.homogeneous:
            return None
        return model.impose(np.zeros(model.X.dim), self.interval.at(t))

    @abstractmethod
    def find(self, z: Array, boundary: Array | None) -> Reconstructed:
        """Return u_alpha from measurements."""

    def diagnostics(self) -> Diagnostics[float]:
        """Return smoothing and misfit at the end of the interval, as far as known."""
        return Diagnostics()


class ObservedPart(ABC, Generic[State]):
    """Abstract rule for u_alpha; its evolving part is an explicit state."""

    @abstractmethod
    def init(self) -> State:
        """Return the state before the first sample."""

    @abstractmethod
    def over(self, state: State, split: Split, interval: Interval) -> tuple[State, ObservedPath]:
        """Return the state after the sample at the end of an interval, and u_alpha over it."""


@dataclass(frozen=True, eq=False)
class GeneralizedInverse(ObservedPart[NoState]):
    """u_alpha = G^+ z."""

    problem: Problem

    def init(self) -> NoState:
        return NoState()

    def over(
        self, state: NoState, split: Split, interval: Interval
    ) -> tuple[NoState, ObservedPath]:
        return state, _InversePath(self.problem, interval, split)


class _InversePath(ObservedPath):
    def __init__(self, problem: Problem, interval: Interval, split: Split) -> None:
        super().__init__(problem, interval)
        self.split = split

    def find(self, z: Array, boundary: Array | None) -> Reconstructed:
        return Reconstructed(self.split.reconstruct(z, boundary), 0.0, 0.0, None)


@dataclass(frozen=True, eq=False)
class RegularizedInverse(ObservedPart[NoState]):
    """u_alpha = G_alpha z, by the `reconstruction` of the observation."""

    problem: Problem

    def init(self) -> NoState:
        return NoState()

    def over(
        self, state: NoState, split: Split, interval: Interval
    ) -> tuple[NoState, ObservedPath]:
        return state, _RegularizedPath(self.problem, interval)


class _RegularizedPath(ObservedPath):
    def find(self, z: Array, boundary: Array | None) -> Reconstructed:
        present = self.interval.present
        return self.problem.observed.reconstruct(z, boundary=boundary, present=present)

    def diagnostics(self) -> Diagnostics[float]:
        found = self.at(self.interval.t1)
        return Diagnostics(alpha=found.alpha, misfit=found.misfit)


class SelfChosenSmoothing(ObservedPart[Balance]):
    """u_alpha smoothed as the noise of the samples asks for (`livepde.laws.sample_smoothing`)."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._detectors: Memo[bytes, NoiseDetector] = Memo(LARGEST_MEMO)
        self._smoothers: Memo[bytes, SmoothingOperator] = Memo(LARGEST_MEMO)

    def init(self) -> Balance:
        return Balance.none(self.problem.observed.size, self.problem.model.X.dim)

    def over(
        self, state: Balance, split: Split, interval: Interval
    ) -> tuple[Balance, ObservedPath]:
        model, key = self.problem.model, split.present.tobytes()
        detector = self._detectors.get(key, lambda: NoiseDetector(self.problem.observed, split))
        smoother, alpha = None, 0.0
        samples = [(interval.t1, interval.z1)]
        if np.isnan(state.z).all():  # the first interval
            samples.insert(0, (interval.t0, interval.z0))
        for t, z in samples:
            boundary = model.impose(np.zeros(model.X.dim), interval.at(t))
            state, noisy = detector.add(state, z, boundary)
            if noisy:
                make = partial(SmoothingOperator, self.problem.observed, split.present)
                smoother = self._smoothers.get(key, make)
                state = smoother.add(state, z, boundary)
                alpha = smoother.alpha(state)
            else:
                state = state.followed(z, boundary)
        # The alpha of the last sample serves all of the interval.
        if smoother is None:
            return state, _InversePath(self.problem, interval, split)
        return state, _SmoothedPath(self.problem, interval, split, smoother, alpha)


class _SmoothedPath(_InversePath):
    def __init__(
        self,
        problem: Problem,
        interval: Interval,
        split: Split,
        smoother: SmoothingOperator,
        alpha: float,
    ) -> None:
        super().__init__(problem, interval, split)
        self.smoother = smoother
        self.alpha = alpha

    def find(self, z: Array, boundary: Array | None) -> Reconstructed:
        if self.alpha == 0.0:
            return super().find(z, boundary)
        known = np.zeros(self.problem.model.X.dim) if boundary is None else boundary
        return Reconstructed(self.smoother(self.alpha, z, known), self.alpha, 0.0, None)

    def diagnostics(self) -> Diagnostics[float]:
        return Diagnostics(alpha=self.alpha)
