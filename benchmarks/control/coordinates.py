"""State of a moving-horizon estimator: coordinates of the reduced model, or all coefficients."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_discrete_are
from scipy.sparse.linalg import splu

from benchmarks.control.problem import Problem
from livepde.control import ReducedModel
from livepde.linalg import Array

FLOOR = 1e-3  # additional process noise of each coordinate, relative to the total


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates x of the reduced model as the state, shape (r,).

    Attributes
    ----------
    model
        K, E and f of mass x' = -K(q) x + E(q) c + f(q).
    mass
        Mass matrix, shape (r, r).
    scale
        Standard deviation of each coordinate in the steady-state filter, shape (r,).
    """

    model: ReducedModel
    mass: sp.csc_array
    scale: Array

    @classmethod
    def of(cls, problem: Problem) -> Coordinates:
        """Return the coordinates of a problem."""
        reduced = problem.reduced
        return cls(reduced, sp.csc_array(sp.eye_array(reduced.size)), _scale(problem))

    def here(self, x: Array, inputs: Mapping[str, float]) -> Array:
        """Transform a state of the reduced model to these coordinates."""
        return x

    def back(self, x: Array, inputs: Mapping[str, float]) -> Array:
        """Transform a state in these coordinates to the reduced model."""
        return x


@dataclass(frozen=True, eq=False)
class Coefficients(Coordinates):
    """Free finite element coefficients as the state, with their mass matrix M_ff."""

    reduced: ReducedModel

    @classmethod
    def of(cls, problem: Problem) -> Coefficients:
        reduced = problem.reduced
        frame = reduced.frame
        free = np.flatnonzero(frame.model.X.free)
        mass = sp.csr_array(frame.model.mass)
        inner = sp.csc_array(mass[free][:, free])
        V = np.zeros((mass.shape[0], len(free)))
        V[free] = np.eye(len(free))
        test = splu(inner).solve(mass[free].toarray())
        model = ReducedModel.of(replace(frame, V=V, test=test), reduced.controls)
        scale = np.linalg.norm(frame.V[free] * _scale(problem), axis=1)
        return cls(model, inner, scale, reduced)

    def here(self, x: Array, inputs: Mapping[str, float]) -> Array:
        return self.model.project(self.reduced.lift(x, inputs))

    def back(self, x: Array, inputs: Mapping[str, float]) -> Array:
        return self.reduced.project(self.model.lift(x, inputs))


def _scale(problem: Problem) -> Array:
    """Return the standard deviations of the reduced coordinates in the steady-state filter."""
    model = problem.reduced
    drive = np.array([problem.drive.get(name, 0.0) for name in model.channels])
    step = model.matrices(model.prior, problem.period)
    driven = step.B * drive
    Q = driven @ driven.T
    Q += FLOOR**2 * float(np.trace(Q)) * np.eye(len(Q))
    noise = np.diag(np.asarray(model.sensors.noise) ** 2)
    P = solve_discrete_are(step.A.T, model.sensors.C.T, Q, noise)
    return np.asarray(np.sqrt(np.diag(P)))
