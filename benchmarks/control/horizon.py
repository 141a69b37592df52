"""Moving-horizon estimator of do-mpc in the loop, on the full or on the reduced model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.control.coordinates import Coefficients, Coordinates
from benchmarks.control.problem import Problem
from benchmarks.control.runs import nominal
from livepde.checkpoint import packed, unpacked
from livepde.control import Known, ReducedModel
from livepde.control.controllers import packages, quiet
from livepde.fem import LogNormal
from livepde.linalg import Array
from livepde.observation import Transformed

RADAU = ((5 / 12, -1 / 12), (3 / 4, 1 / 4))  # Radau IIA with two stages, the second at the end
QUIET = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": 0,
    "ipopt.max_iter": 100,
    "show_eval_warnings": False,
}
ROUNDING = 1e-12  # relative size below which entries of a matrix are rounding errors
FARTHEST = 6.0  # prior standard deviations, bound on unknowns so that exp does not overflow


@dataclass(frozen=True)
class Setting:
    """Settings of the estimator.

    Parameters
    ----------
    samples
        Length of the window.
    state, unknowns
        Weights of the arrival cost. `state` weights the distance of the window's initial state from
        the last solution, in standard deviations of the steady-state filter. `unknowns` weights
        the distance from the last estimate, in prior standard deviations.
    full
        True: estimate all finite element coefficients, as in a direct implementation with do-mpc.
        False: estimate the coordinates of our reduced model.
    """

    samples: int
    state: float
    unknowns: float
    full: bool = False

    def __str__(self) -> str:
        return f"{self.samples} samples, arrival {self.state:g} and {self.unknowns:g}"


class MovingHorizon:
    """Estimator of state and unknown constants by least squares over a window, do-mpc's `MHE`.

    Until the window is full, and if Ipopt finds no solution, it returns the estimate of the nominal
    model. It has no covariance, so that a controller treats its estimate as exact.

    Parameters
    ----------
    problem
        Control problem; each period is a step of the Radau method, do-mpc's default.
    setting
        Window and weights.

    Attributes
    ----------
    mhe
        Estimator object of do-mpc.
    """

    def __init__(self, problem: Problem, setting: Setting) -> None:
        self.problem = problem
        self.setting = setting
        self.nominal = nominal(problem)
        self.coordinates = (Coefficients if setting.full else Coordinates).of(problem)
        self.failed = 0
        count, model = setting.samples, self.coordinates.model
        self._z = np.zeros((count, len(model.sensors.names)))
        self._c = np.zeros((count, len(model.channels)))
        self._x = np.zeros((count + 1, model.size))
        self._taken = 0
        self.mhe = self._built()  # built here, so that it does not count as time of a sample

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        """Process a sample, as in `Estimator.step`; the first sample is the initial state."""
        known = self.nominal.step(t, z, inputs)
        model = self.coordinates.model
        noise, x = np.asarray(model.sensors.noise), self.coordinates.here(known.x, inputs)
        self._z = np.vstack([self._z[1:], np.asarray(z, dtype=float) / noise])
        self._c = np.vstack([self._c[1:], model.values(inputs)])
        self._x = np.vstack([self._x[1:], x])
        self._taken += 1
        count = self.setting.samples
        if self._taken <= count:  # the first sample is the initial state
            why = f"the window of {count} samples is not full"
            return Known(known.x, known.q, known.factor, "fallback", why)
        mhe = self.mhe
        if self._taken == count + 1:
            self._begin()
        else:
            mhe.opt_p_num["_x_prev"] = mhe.opt_x_num["_x", 1, -1]
        before = mhe.opt_x_num.master
        mhe.opt_p_num["_p_est_prev"] = mhe.opt_x_num["_p_est"]
        for k in range(count):
            mhe.opt_p_num["_tvp", k] = self._c[k]
            mhe.opt_p_num["_y_meas", k] = self._z[k]
        mhe.solve()
        if not mhe.solver_stats["success"]:
            self.failed += 1
            mhe.opt_x_num.master = before
            why = f"Ipopt: {mhe.solver_stats['return_status']}"
            return Known(known.x, known.q, known.factor, "fallback", why)
        last = self.coordinates.scale * mhe.opt_x_num["_x", -1, -1].full().ravel()
        x = self.coordinates.back(last, inputs)
        q = self._numbers(mhe.opt_x_num["_p_est"].full().ravel(), np.exp)
        return Known(x, np.asarray(q), np.zeros((len(q), 0)))

    def dump(self) -> bytes:
        """Return the state of the estimator."""
        leaves = {
            "nominal": np.frombuffer(self.nominal.dump(), dtype=np.uint8),
            "z": self._z,
            "c": self._c,
            "x": self._x,
            "taken": self._taken,
            "solution": self.mhe.opt_x_num.master.full().ravel(),
        }
        return packed({"kind": "moving horizon"}, leaves)

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Continue from what `dump` returned."""
        _, leaves = unpacked(content, where)
        self.nominal.restore(leaves["nominal"].tobytes(), where)
        self._z, self._c, self._x = leaves["z"], leaves["c"], leaves["x"]
        self._taken = int(leaves["taken"])
        self.mhe.opt_x_num.master = packages()[1].DM(leaves["solution"])

    def _begin(self) -> None:
        """Initialise the solver with the states of the nominal model."""
        mhe, scaled = self.mhe, self._x / self.coordinates.scale
        for k, x in enumerate(scaled):
            mhe.opt_x_num["_x", k, -1] = x
        for k, x in enumerate(scaled[1:]):
            mhe.opt_x_num["_z", k, -1, "inner"] = np.tile(x, (len(RADAU), 1)).T
        mhe.opt_x_num["_p_est"] = 0.0
        mhe.opt_p_num["_x_prev"] = mhe.opt_x_num["_x", 0, -1]

    def _numbers(self, p: Any, exp: Any) -> list[Any]:
        """Return the unknowns for coordinates p in prior standard deviations."""
        model = self.coordinates.model
        space = model.frame.model.parameter_space
        values = []
        for k, (label, prior, std) in enumerate(
            zip(model.unknowns, model.prior, model.std, strict=True)
        ):
            positive = isinstance(space.unknown_of(label).prior, LogNormal)
            values.append(prior * exp(std / prior * p[k]) if positive else prior + std * p[k])
        return values

    def _built(self) -> Any:
        """Return do-mpc's estimator for the problem and the setting."""
        do_mpc, casadi = packages()
        period, setting = self.problem.period, self.setting
        model, scale = self.coordinates.model, self.coordinates.scale
        r, m = model.size, len(model.unknowns)
        process = do_mpc.model.Model("discrete")
        x = process.set_variable("_x", "x", (r, 1))
        inner = process.set_variable("_z", "inner", (r, len(RADAU)))
        c = process.set_variable("_tvp", "c", (len(model.channels), 1))
        p = process.set_variable("_p", "p", (m, 1))
        with quiet():
            seen = _reading(model, scale[:, None] * inner[:, -1], c)
        process.set_meas("z", seen / casadi.DM(model.sensors.noise), meas_noise=True)
        process.set_rhs("x", inner[:, -1])
        q = [1.0, *self._numbers(p, casadi.exp)]
        rates = []
        for k in range(len(RADAU)):
            rate = 0.0
            for i, value in enumerate(q):
                K = _sparse(model.K[i] * scale / scale[:, None])
                driven = casadi.DM(model.E[i] / scale[:, None]) @ c
                driven += casadi.DM(model.f[i] / scale)
                rate += value * (driven - K @ inner[:, k])
            rates.append(rate)
        mass = _sparse(self.coordinates.mass.toarray() * scale / scale[:, None])
        balance = [
            mass @ (inner[:, k] - x) - period * sum(a * v for a, v in zip(row, rates, strict=True))
            for k, row in enumerate(RADAU)
        ]
        process.set_alg("balance", casadi.vertcat(*balance))
        process.setup()
        mhe = do_mpc.estimator.MHE(process, ["p"])
        mhe.settings.n_horizon = setting.samples
        mhe.settings.t_step = period
        mhe.settings.meas_from_data = False
        mhe.settings.store_full_solution = False
        mhe.settings.nlpsol_opts = QUIET
        mhe.set_default_objective(
            P_x=np.diag(np.full(r, setting.state)),
            P_v=np.eye(len(model.sensors.names)),
            P_p=setting.unknowns * np.eye(m),
        )
        future, readings, none = mhe.get_tvp_template(), mhe.get_y_template(), mhe.get_p_template()
        mhe.set_tvp_fun(lambda t: future)
        mhe.set_y_fun(lambda t: readings)
        mhe.set_p_fun(lambda t: none)
        mhe.bounds["lower", "_p_est", "p"] = -FARTHEST
        mhe.bounds["upper", "_p_est", "p"] = FARTHEST
        with quiet():
            mhe.setup()
        return mhe


def _sparse(matrix: Array) -> Any:
    """Return a sparse CasADi matrix without entries that are rounding errors."""
    small = np.abs(matrix) <= ROUNDING * np.abs(matrix).max()
    return packages()[1].sparsify(packages()[1].DM(np.where(small, 0.0, matrix)))


def _reading(model: ReducedModel, x: Any, c: Any) -> Any:
    """Return the predicted readings as a CasADi expression."""
    casadi = packages()[1]
    seen, sensors = model.sensors, model.frame.sensors.observation
    if not isinstance(sensors, Transformed):
        return casadi.DM(seen.C) @ x + casadi.DM(seen.D) @ c + casadi.DM(seen.d)
    # The argument of the transformation is linear in x, without boundary values.
    linear = np.asarray(model.frame.sensors.G @ model.frame.V)
    return sensors.function(casadi.DM(linear) @ x)
