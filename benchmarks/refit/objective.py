"""Cost of a fit, c(a) = |r|^2/2 + |a|^2/2, with the lean forward model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import LostError, Trajectory

Array = NDArray[Any]
LOST = 1e4  # residual, in standard deviations, if the forward model has no solution


class Objective:
    """Residuals in standard deviations and their derivative, for `scipy.optimize.least_squares`.

    Parameters
    ----------
    problem, priors
        Problem, and priors of its unknowns.
    z
        Readings, shape (samples, sensors), NaN if missing.
    """

    def __init__(self, problem: Problem, priors: Priors, z: Array) -> None:
        self.problem = problem
        self.coordinates = problem.coordinates(priors)
        self.z = z[1:]
        self.used = np.isfinite(self.z)
        self._last: tuple[bytes, Trajectory | None, Array] | None = None

    def _evaluated(self, a: Array) -> tuple[bytes, Trajectory | None, Array]:
        key = a.tobytes()
        if self._last is None or self._last[0] != key:
            process, q = self.problem.process, self.coordinates.value(a)
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    path = process.states(self.problem.theta(q)[0])
                    shown = process.predicted(path, q)
                misfit = ((shown - self.z) / self.problem.noise)[self.used]
                self._last = (key, path, np.concatenate([misfit, a]))
            except LostError:
                lost = np.full(int(self.used.sum()), LOST)
                self._last = (key, None, np.concatenate([lost, a]))
        return self._last

    def residual(self, a: Array) -> Array:
        """Return misfits and coordinates, both in standard deviations."""
        return self._evaluated(a)[2]

    def jacobian(self, a: Array) -> Array:
        """Return the derivative of `residual`, with the states of its last call."""
        path, size = self._evaluated(a)[1], self.coordinates.size
        if path is None:
            rows = np.zeros((int(self.used.sum()), size))
        else:
            q, dq = self.coordinates.value(a), self.coordinates.tangent(a)
            along = self.problem.theta(q)[1] @ dq
            shown = self.problem.process.shown_tangents(path, along, dq)
            rows = (shown / self.problem.noise)[self.used]
        return np.vstack([rows, np.eye(size)])

    def cost(self, a: Array) -> float:
        """Return c(a)."""
        residual = self.residual(a)
        return 0.5 * float(residual @ residual)

    def root(self, a: Array) -> Array:
        """Return R with R^T R = I + J^T J, so that |R da| is a distance in posterior deviations."""
        return np.asarray(np.linalg.qr(self.jacobian(a), mode="r"))
