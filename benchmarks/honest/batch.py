"""Batch fit of all data: the maximum a posteriori theta, with the truth's own code as model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.honest.problem import Latent, Problem

Array = NDArray[Any]
MOST = 8  # largest number of Gauss-Newton steps
HALVINGS = 6
SMALL = 1e-3  # length of the last step, in standard deviations of the posterior


@dataclass(frozen=True, eq=False)
class Batch:
    """Posterior of theta, linearised about the truth.

    Attributes
    ----------
    problem, theta
        Problem, and its true theta.
    shown, J
        Readings predicted for the truth, shape (samples, sensors), and their derivative in standard
        deviations of the noise, shape (samples, sensors, coordinates).
    """

    problem: Problem
    theta: Array
    shown: Array
    J: Array

    @classmethod
    def of(cls, problem: Problem, theta: Array) -> Batch:
        """Return the posterior, linearised about a truth."""
        J = problem.jacobian(theta) / problem.noise
        return cls(problem, theta, problem.predict(theta), J)

    def std(self, latent: Latent, at: int) -> Array:
        """Return the standard deviations of an unknown, given the samples up to index `at`."""
        rows = self.J[: at + 1].reshape(-1, self.J.shape[-1])
        R = np.asarray(np.linalg.qr(np.vstack([rows, np.eye(rows.shape[1])]), mode="r"))
        factor = np.linalg.solve(R.T, latent.directions(at).T)
        std: Array = np.linalg.norm(factor, axis=0)
        return std

    def linear(self, z: Array) -> Array:
        """Return the maximum a posteriori theta of the linearised model."""
        return self.theta + _step(self.J, (z - self.shown) / self.problem.noise, self.theta)

    def fit(self, z: Array) -> Array:
        """Return the maximum a posteriori theta by damped Gauss-Newton steps from the truth."""
        theta, shown, J = self.theta, self.shown, self.J
        misfit = self._misfit(theta, shown, z)
        for _ in range(MOST):
            step = _step(J, (z - shown) / self.problem.noise, theta)
            for _ in range(HALVINGS):
                shown = self.problem.predict(theta + step)
                later = self._misfit(theta + step, shown, z)
                if later <= misfit:
                    break
                step = 0.5 * step
            else:
                return theta
            theta, misfit = theta + step, later
            length = np.sqrt(np.sum((J.reshape(-1, len(step)) @ step) ** 2) + step @ step)
            if length <= SMALL * np.sqrt(len(step)):
                return theta
            J = self.problem.jacobian(theta) / self.problem.noise
        return theta

    def _misfit(self, theta: Array, shown: Array, z: Array) -> float:
        return float(np.sum(((z - shown) / self.problem.noise) ** 2) + theta @ theta)


def _step(J: Array, residual: Array, theta: Array) -> Array:
    """Return the step that minimises |residual - J step|^2 + |theta + step|^2."""
    rows = np.vstack([J.reshape(-1, len(theta)), np.eye(len(theta))])
    right = np.concatenate([residual.ravel(), -theta])
    step: Array = np.linalg.lstsq(rows, right, rcond=None)[0]
    return step
