"""Interface of our forward model for other packages, and choice of their best setting."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from benchmarks.offline import Trajectory
from benchmarks.problems import Data
from benchmarks.scoring import Contender, Known, Score, scored
from livepde.fem import Moment
from livepde.linalg import Array
from livepde.stepping import ForwardStage, Interval, StepFailed, advance


class Augmented:
    """Forward model of the augmented state x = (free coefficients of u, reduced coordinates a)."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.trajectory = Trajectory(data)
        self.model = self.trajectory.model
        self.forward = ForwardStage(self.model)
        self.free = np.flatnonzero(self.model.X.free)
        self.n, self.k = len(self.free), self.trajectory.Phi.shape[1]
        self.times = data.process.times.tolist()

    @cached_property
    def moments(self) -> list[Moment]:
        """Time and inputs of each sample."""
        return [Moment(t, self.trajectory.inputs(k)) for k, t in enumerate(self.times)]

    @cached_property
    def start(self) -> Array:
        """Free coefficients of the known initial state."""
        start: Array = self.model.initial(self.data.process.u0, self.moments[0])[self.free]
        return start

    def latent(self, a: Array) -> Array:
        """Return the latent coefficients for reduced coordinates a."""
        q: Array = self.model.latent.prior + self.trajectory.Phi @ a
        return q

    def full(self, x: Array, at: int) -> Array:
        """Return all coefficients of the state at a time index."""
        u = np.zeros(self.model.X.dim)
        u[self.free] = x[: self.n]
        return self.model.impose(u, self.moments[at])

    def forecast(self, x: Array, at: int) -> Array:
        """Advance x from the previous sample to sample `at`."""
        q, none = self.latent(x[self.n :]), np.zeros(0)
        before, now = self.moments[at - 1], self.moments[at]
        interval = Interval(
            t0=before.t, t1=now.t, inputs0=before.inputs, inputs1=now.inputs, z0=none, z1=none
        )

        def stage(c: Array, t: float, h: float) -> Array:
            return self.forward.solve(c, q, h, interval.at(t))

        u, _, failure = advance(
            self.trajectory.control, stage, self.full(x, at - 1), before.t, now.t
        )
        if failure is not None:
            raise failure
        return np.concatenate([u[self.free], x[self.n :]])

    def output(self, x: Array, at: int) -> Array:
        """Return the predicted readings."""
        q = self.model.latent.value(self.latent(x[self.n :]))
        return self.data.observed.predict(self.full(x, at), q, self.moments[at])

    def growth(self, at: int) -> Array:
        """Return the standard deviation of the increment of each reduced coordinate, (k,)."""
        gained = np.zeros(self.k)
        gained[self.trajectory.moving] = self.trajectory.growth[at - 1]
        return gained

    def known(self, mean: Array, root: Array | None) -> Known:
        """Return latent coefficients and factor; raise `StepFailed` if `mean` is not finite."""
        if not np.isfinite(mean).all():
            raise StepFailed("not_finite", "the estimate is not finite")
        return self.latent(mean), None if root is None else self.trajectory.Phi @ root


def best(data: Data, settings: Mapping[str, Contender]) -> Score:
    """Run all settings, and return the score with the least error and its setting as note."""
    scores = []
    for setting, contender in settings.items():
        score = scored(contender, data)
        if score is not None:
            scores.append(replace(score, note="; ".join(filter(None, (setting, score.note)))))
    return min(scores, key=lambda score: math.inf if math.isnan(score.error) else score.error)
