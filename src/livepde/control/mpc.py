"""Model predictive control with do-mpc on the reduced model."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from livepde.control.goal import Decision, Goal, Known, Plan, check
from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError
from livepde.linalg import Array

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0, "ipopt.max_iter": 200}
# Largest distance of a scenario from the estimate, as a share of the distance to the bound.
FARTHEST = 0.9
# Finite substitute of a limit that is temporarily infinite: Ipopt needs finite parameters.
FAR = 1e12
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True, eq=False)
class MPC:
    """Multi-stage (scenario) model predictive control with do-mpc: robust to parameter uncertainty.

    At each sample, scenarios of the unknown numbers are the estimate and points `kappa` standard
    deviations to both sides along the leading directions of their covariance (in latent values for
    transformed unknowns: half or twice the estimate, never zero). The first input is common to all
    scenarios. With a better estimate the scenarios contract, and the control becomes less cautious.
    Actuator ranges are never exceeded; output limits are soft constraints with the penalty of the
    goal.

    If Ipopt finds no solution, the inputs are held, and the status of the action reports it.

    Parameters
    ----------
    model, goal
        Reduced model, and control objective.
    period
        Sampling period.
    horizon
        Prediction horizon in periods.
    kappa
        Distance of the scenarios in standard deviations; 0: certainty equivalence.
    directions
        Number of covariance directions with two scenarios each.

    Raises
    ------
    ConfigurationError
        do-mpc is not installed: pip install 'livepde[control]'.
    """

    model: ReducedModel
    goal: Goal
    period: float
    horizon: int = 20
    kappa: float = 2.0
    directions: int = 1

    def __post_init__(self) -> None:
        check(self)
        if not (np.isfinite(self.kappa) and self.kappa >= 0.0) or self.directions < 1:
            raise ConfigurationError(
                "MPC: kappa must be a number, at least 0, and directions at least 1; got "
                f"{self.kappa} and {self.directions}."
            )
        self.problem  # noqa: B018  a package that is missing is told now

    @property
    def scenarios(self) -> int:
        """Number of scenarios."""
        most = min(self.directions, len(self.model.unknowns)) if self.kappa else 0
        return 1 + 2 * most

    def start(self) -> Array:
        """Return the initial memory: the starting point of the optimisation."""
        return np.zeros(int(self.problem.opt_x_num.master.shape[0]))

    def _process(self) -> Any:
        """Return the model in do-mpc's form: dynamics, cost, and excess over each limit."""
        do_mpc, casadi = packages()
        model, goal, r = self.model, self.goal, self.model.size
        process = do_mpc.model.Model("discrete")
        x = process.set_variable("_x", "x", (r, 1))
        v = process.set_variable("_u", "v", (len(model.controls), 1))
        d = process.set_variable("_tvp", "d", (len(model.disturbances) or 1, 1))
        reference = process.set_variable("_tvp", "reference", (len(goal.track) or 1, 1))
        ends = {
            side: process.set_variable("_tvp", side, (len(goal.limits) or 1, 1))
            for side in ("low", "high")
        }
        A = process.set_variable("_p", "A", (r, r))
        B = process.set_variable("_p", "B", (r, len(model.channels)))
        f = process.set_variable("_p", "f", (r, 1))
        channels = [
            v[model.controls.index(name)]
            if name in model.controls
            else d[model.disturbances.index(name)]
            for name in model.channels
        ]
        c = casadi.vertcat(*channels)
        after = A @ x + B @ c + f
        y = casadi.DM(model.outputs.C) @ after + casadi.DM(model.outputs.D) @ c
        y += casadi.DM(model.outputs.d)
        process.set_rhs("x", after)
        cost = 0.0
        for k, (name, weight) in enumerate(goal.track.items()):
            cost += weight * (y[model.outputs.names.index(name)] - reference[k]) ** 2
        for name, price in goal.price.items():
            cost += price * v[model.controls.index(name)]
        process.set_expression("cost", cost)
        for k, name in enumerate(goal.limits):
            value = y[model.outputs.names.index(name)]
            process.set_expression(f"low_{name}", ends["low"][k] - value)
            process.set_expression(f"high_{name}", value - ends["high"][k])
        process.setup()
        return process

    @cached_property
    def problem(self) -> Any:
        """Optimal control problem of do-mpc; all changing data are set at each sample."""
        do_mpc, casadi = packages()
        model, goal, process = self.model, self.goal, self._process()
        mpc = do_mpc.controller.MPC(process)
        mpc.settings.n_horizon = self.horizon
        mpc.settings.n_robust = 1 if self.scenarios > 1 else 0
        mpc.settings.t_step = self.period
        mpc.settings.store_full_solution = False
        mpc.settings.nlpsol_opts = QUIET
        mpc.set_objective(mterm=casadi.SX(0.0), lterm=process.aux["cost"])
        low, high = goal.range(model)
        width = np.where(np.isfinite(high - low), high - low, 1.0)
        mpc.scaling["_x", "x"] = 1.0 / np.abs(model.outputs.C).max()
        mpc.scaling["_u", "v"] = width
        # do-mpc applies its weights to changes of scaled inputs, so they are rescaled.
        mpc.set_rterm(v=np.array([goal.move[name] for name in model.controls]) * width**2)
        mpc.bounds["lower", "_u", "v"] = low
        mpc.bounds["upper", "_u", "v"] = high
        for name, limits in goal.limits.items():
            for side, limit in zip(("low", "high"), limits, strict=True):
                if np.isfinite(limit):
                    mpc.set_nl_cons(
                        f"{side}_{name}",
                        process.aux[f"{side}_{name}"],
                        ub=0.0,
                        soft_constraint=True,
                        penalty_term_cons=goal.beyond,
                    )
        future, uncertain = mpc.get_tvp_template(), mpc.get_p_template(self.scenarios)
        mpc.set_tvp_fun(lambda t: future)
        mpc.set_p_fun(lambda t: uncertain)
        with quiet():
            mpc.setup()
        mpc.future, mpc.uncertain = future, uncertain
        return mpc

    def decide(self, known: Known, plan: Plan, before: Array, memory: Array) -> Decision:
        """Return the control inputs for the coming period; see `Controller.decide`."""
        mpc, model = self.problem, known.model or self.model
        found = known.scenarios(self.kappa, (self.scenarios - 1) // 2)
        found = np.array([model.shifted(known.q, one - known.q) for one in found])
        # The optimisation problem has a fixed number of scenarios; unused ones repeat the estimate.
        q = np.vstack([found, np.tile(known.q, (self.scenarios - len(found), 1))])
        # A scenario on a bound can make the model degenerate (zero diffusivity), so scenarios stop
        # short of the bounds.
        q = np.clip(
            q, *(known.q + FARTHEST * (end - known.q) for end in (model.lower, model.upper))
        )
        for k, values in enumerate(q):
            step = model.matrices(values, self.period).with_offset(known.offset)
            mpc.uncertain["_p", k] = np.concatenate([step.A.ravel("F"), step.B.ravel("F"), step.f])
        for k in range(self.horizon + 1):
            at = min(k, self.horizon - 1)
            if model.disturbances:
                mpc.future["_tvp", k, "d"] = plan.disturbances[at]
            if self.goal.track:
                mpc.future["_tvp", k, "reference"] = plan.reference[at]
            if self.goal.limits:
                mpc.future["_tvp", k, "low"] = np.maximum(plan.low[at], -FAR)
                mpc.future["_tvp", k, "high"] = np.minimum(plan.high[at], FAR)
        mpc.opt_p_num["_x0"] = known.x
        mpc.opt_p_num["_u_prev"] = before
        mpc.opt_p_num["_tvp"] = mpc.future["_tvp"]
        mpc.opt_p_num["_p"] = mpc.uncertain["_p"]
        mpc.opt_x_num.master = memory
        mpc.solve()
        if mpc.solver_stats["return_status"] not in SOLVED:
            why = f"Ipopt: {mpc.solver_stats['return_status']}: the inputs were held"
            return Decision(before, why, memory)
        low, high = self.goal.range(model)
        wanted = (mpc.opt_x_num["_u", 0, 0] * mpc._u_scaling).full().ravel()
        solution = mpc.opt_x_num.master.full().ravel()
        return Decision(np.clip(wanted, low, high), "ok", solution)


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress warnings of do-mpc about optional packages and of CasADi about its changes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The (ONNX|approximateMPC) feature", UserWarning)
        warnings.filterwarnings("ignore", "\\s*casadi", FutureWarning)
        yield


def packages() -> tuple[Any, Any]:
    """Return do_mpc and casadi.

    Raises
    ------
    ConfigurationError
        One of them is not installed.
    """
    try:
        with quiet():
            import casadi
            import do_mpc
    except ImportError:
        raise ConfigurationError(
            "MPC needs do-mpc, which is not installed: pip install 'livepde[control]'; or take LQ."
        ) from None
    return do_mpc, casadi
