"""Offline fit of all data: the maximum a posteriori parameter by Gauss-Newton.

Minimises, over the reduced coordinates of `SensitivityLaw` and with its prior,

    |a|^2 + sum over samples of |(z - G u(a))/noise|^2

with the forward model and time scheme of the law, and exact sensitivities. The inverse of J^T J at
the minimum approximates the posterior covariance. No online estimator is more accurate on average.
For a parameter that moves, the fit is a smoother, which also uses later data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from time import process_time

import numpy as np
from scipy.optimize import least_squares

from benchmarks.problems import Data
from livepde.fem import Inputs
from livepde.laws import Problem
from livepde.laws.reduction import Reduction
from livepde.linalg import Array
from livepde.stepping import Advance, ForwardStage, Interval, StepFailed, advance

EVALUATIONS = 60  # largest number of evaluations
LOST = 1e4  # residual, in standard deviations, if the forward model fails


@dataclass(frozen=True, eq=False)
class Fit:
    """Maximum a posteriori parameter.

    Attributes
    ----------
    coordinates
        Reduced coordinates, shape (size,).
    q, factor
        Latent coefficients at each time, shape (times, dim), and a method that returns a square
        root of their covariance at a time index, shape (dim, coordinates).
    predicted, hidden
        Predictions for assimilated and validation sensors, (times, sensors), (times, validation).
    seconds, evaluations
        Processor time, and number of forward runs with sensitivities.
    converged
        False if the iteration stopped at `EVALUATIONS`.
    """

    coordinates: Array
    q: Array
    trajectory: Trajectory
    root: Array
    predicted: Array
    hidden: Array
    seconds: float
    evaluations: int
    converged: bool

    def factor(self, at: int) -> Array:
        """Return a square root of the covariance of latent coefficients at a time index."""
        factor: Array = self.trajectory.directions(at) @ self.root
        return factor


class Trajectory:
    """Forward model with sensitivities as a function of the reduced coordinates.

    The coordinates of the initial parameter are followed by the normalised increments of unknowns
    that move as random walks.
    """

    def __init__(self, data: Data) -> None:
        self.data = data
        process = data.process
        self.model = process.model
        problem = Problem(self.model, data.observed, Advance(process.scheme, process.dt_max))
        self.control = problem.control
        reduction = Reduction.of(problem, data.modes)
        self.Phi = reduction.Phi
        self.rest = reduction.rest(0.0, 0.0)
        widths = np.diff(process.times)
        growth = [
            np.sqrt(np.concatenate([m.growth(float(h)) for m in reduction.evolutions]))
            for h in widths
        ]
        self.moving = np.flatnonzero(growth[0] > 0.0)
        self.growth = np.array(growth)[:, self.moving]
        self.size = self.Phi.shape[1] + self.growth.size
        self.forward = ForwardStage(self.model)
        spaces = (self.model.state_space, self.model.X, self.model.parameter_space)
        self.validation = (
            process.validation.bind(*spaces) if process.validation is not None else None
        )
        self.used = np.isfinite(data.z) & (process.times >= process.assimilate_from)[:, None]
        self.used[0] = False  # the initial state is known
        self.evaluations = 0
        self._last: tuple[bytes, Array, Array] | None = None

    def directions(self, at: int) -> Array:
        """Return the derivative of latent coefficients by the coordinates, shape (dim, size)."""
        if not len(self.moving):
            return self.Phi
        D = np.zeros((len(self.Phi), self.size))
        k, m = self.Phi.shape[1], len(self.moving)
        D[:, :k] = self.Phi
        D[:, k : k + at * m] = (self.Phi[:, None, self.moving] * self.growth[None, :at]).reshape(
            len(self.Phi), at * m
        )
        return D

    def latent(self, a: Array, at: int) -> Array:
        """Return the latent coefficients at a time index."""
        q: Array = self.model.latent.prior + self.directions(at) @ a
        return q

    def inputs(self, at: int) -> Inputs:
        """Return the input channels at a time index."""
        values: Mapping[str, float] = (self.data.process.inputs or [{}] * (at + 1))[at]
        return Inputs(dict(values))

    def run(self, a: Array, sensitivities: bool = True) -> tuple[Array, Array, Array]:
        """Return predictions for assimilated and validation sensors, and the former's Jacobian.

        Raises
        ------
        StepFailed
            The forward model fails at a.
        """
        process, model, observed = self.data.process, self.model, self.data.observed
        times = process.times.tolist()
        none = np.zeros(0)
        width = self.size if sensitivities else 0
        predicted = np.full(self.data.z.shape, np.nan)
        hidden = np.full((len(times), self.validation.size if self.validation else 0), np.nan)
        jacobian = np.zeros((*self.data.z.shape, width))
        y = np.zeros((model.X.dim, 1 + width))
        at = Interval(
            t0=times[0],
            t1=times[0],
            inputs0=self.inputs(0),
            inputs1=self.inputs(0),
            z0=none,
            z1=none,
        )
        y[:, 0] = model.initial(process.u0, at.end)
        for k, (t0, t1) in enumerate(pairwise(times), start=1):
            q = self.latent(a, k)
            # Later increments of a random walk have no effect yet.
            live = min(width, self.Phi.shape[1] + k * len(self.moving))
            D = self.directions(k)[:, :live]
            interval = Interval(
                t0=t0, t1=t1, inputs0=self.inputs(k - 1), inputs1=self.inputs(k), z0=none, z1=none
            )

            def stage(
                c: Array, t: float, h: float, q: Array = q, D: Array = D, of: Interval = interval
            ) -> Array:
                moment = of.at(t)
                u = self.forward.solve(c[:, 0], q, h, moment)
                if not width:
                    return u[:, None]
                factor = self.forward.tangent(u, q, h, moment)
                forcing = model.form_A.product("v", "q", D, moment, u=u, q=q)
                rhs = (model.mass @ c[:, 1:]) / h - forcing
                return np.column_stack([u, factor.solve(rhs * model.X.free[:, None])])

            end, _, failure = advance(
                self.control, stage, y[:, : 1 + live], interval.t0, interval.t1
            )
            if failure is not None:
                raise failure
            y[:, : 1 + live] = end
            u, physical = y[:, 0], model.latent.value(q)
            predicted[k] = observed.predict(u, physical, interval.end)
            if self.validation is not None:
                hidden[k] = self.validation.predict(u, physical, interval.end)
            if width:
                H_u, H_q = observed.jacobian(u, physical, interval.end)
                jacobian[k, :, :live] = H_u @ y[:, 1 : 1 + live]
                if H_q is not None:
                    jacobian[k, :, :live] += H_q @ model.latent.tangent(q, D)
        return predicted, hidden, jacobian

    def _evaluated(self, a: Array) -> tuple[Array, Array]:
        if self._last is None or self._last[0] != a.tobytes():
            self.evaluations += 1
            used, noise = self.used, self.data.noise
            try:
                predicted, _, jacobian = self.run(a)
                misfit = ((predicted - self.data.z) / noise)[used]
                scaled = (jacobian / noise[:, None])[used]
            except StepFailed:
                misfit = np.full(int(used.sum()), LOST)
                scaled = np.zeros((len(misfit), self.size))
            residual = np.concatenate([misfit, a])
            self._last = (a.tobytes(), residual, np.vstack([scaled, np.eye(self.size)]))
        return self._last[1], self._last[2]

    def residual(self, a: Array) -> Array:
        """Return the residuals of data and prior, in standard deviations."""
        return self._evaluated(a)[0]

    def jacobian(self, a: Array) -> Array:
        """Return the derivative of `residual`."""
        return self._evaluated(a)[1]


def fit(data: Data, start: Array | None = None) -> Fit:
    """Return the maximum a posteriori parameter given all data.

    Parameters
    ----------
    start
        Initial values of the leading coordinates; default the prior.
    """
    begun = process_time()
    trajectory = Trajectory(data)
    first = np.zeros(trajectory.size)
    if start is not None:
        first[: len(start)] = start
    minimum = least_squares(
        trajectory.residual,
        first,
        jac=trajectory.jacobian,
        xtol=1e-6,
        ftol=1e-8,
        max_nfev=EVALUATIONS,
    )
    root = np.linalg.inv(np.linalg.qr(trajectory.jacobian(minimum.x), mode="r"))
    seconds = process_time() - begun
    predicted, hidden, _ = trajectory.run(minimum.x, sensitivities=False)
    q = np.array([trajectory.latent(minimum.x, k) for k in range(len(data))])
    return Fit(
        minimum.x,
        q,
        trajectory,
        root,
        predicted,
        hidden,
        seconds,
        trajectory.evaluations,
        bool(minimum.status > 0),
    )
