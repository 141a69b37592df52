"""Control objectives, and controllers on a reduced model: linear-quadratic, and do-mpc."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real
from typing import Any, Literal, Protocol

import numpy as np
from scipy.linalg import null_space, solve_discrete_are

from livepde.control.reduction import Discrete, ReducedModel
from livepde.errors import ConfigurationError
from livepde.linalg import Array

FREE = (-np.inf, np.inf)


def _finite(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _range(ends: Any) -> bool:
    """Return True for (least, largest); either may be infinite."""
    pair = np.shape(ends) == (2,) and all(isinstance(end, Real) for end in ends)
    return pair and bool(ends[0] < ends[1])


@dataclass(frozen=True)
class Goal:
    """Control objective: weights, prices and limits.

    The cost of a sample is the sum of track (y - reference)^2 + penalty (units beyond a limit) over
    outputs, and of move (v - v before)^2 + price v over controls.

    Parameters
    ----------
    track
        Mapping from output to the weight of its error.
    move
        Mapping from control to the weight of its change between samples; > 0.
    inputs
        Mapping from control to the (least, largest) value of the actuator; never exceeded.
    limits
        Mapping from output to its (least, largest) value; enforced by `MPC`, ignored by `LQ`. They
        may change with time: `Loop.step`.
    price
        Mapping from control to the cost of one unit of it in a sample; ignored by `LQ`.
    penalty
        Cost of one unit beyond a limit in one sample, in `MPC`; default a hundred times the sum of
        the weights of errors, or 100 without.
    """

    track: Mapping[str, float]
    move: Mapping[str, float]
    inputs: Mapping[str, tuple[float, float]]
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    price: Mapping[str, float] = field(default_factory=dict)
    penalty: float | None = None

    def __post_init__(self) -> None:
        for option, valid, expected in (
            ("track", lambda weight: _finite(weight) and weight >= 0.0, "a positive number"),
            # These weights are the diagonal of R in the Riccati equation, which must be regular.
            ("move", lambda weight: _finite(weight) and weight >= 1e-300, "a positive number"),
            ("inputs", _range, "(least, largest) with least < largest"),
            ("limits", _range, "(least, largest) with least < largest"),
            ("price", _finite, "a number"),
        ):
            values = getattr(self, option)
            if not isinstance(values, Mapping):
                raise ConfigurationError(
                    f"Goal: {option} must be a mapping from names to numbers; got {values!r}."
                )
            for name, value in values.items():
                if not valid(value):
                    raise ConfigurationError(
                        f"Goal: {option}['{name}'] must be {expected}; got {value!r}."
                    )
        if not (np.isfinite(self.beyond) and self.beyond >= 0.0):
            raise ConfigurationError(f"Goal: penalty must be at least 0; got {self.penalty}.")

    @property
    def beyond(self) -> float:
        """Cost of one unit beyond a limit in one sample."""
        return 100.0 * (sum(self.track.values()) or 1.0) if self.penalty is None else self.penalty

    def check(self, model: ReducedModel) -> None:
        """Raise `ConfigurationError` if the goal does not fit a reduced model."""
        for option, names, allowed in (
            ("track", self.track, model.outputs.names),
            ("limits", self.limits, model.outputs.names),
            ("move", self.move, model.controls),
            ("inputs", self.inputs, model.controls),
            ("price", self.price, model.controls),
        ):
            for name in names:
                if name not in allowed:
                    raise ConfigurationError(
                        f"Goal: {option} names '{name}'; the reduced model has {list(allowed)}."
                    )
        missing = [name for name in model.controls if name not in self.move]
        if missing or not (self.track or self.price):
            raise ConfigurationError(
                f"Goal: give a weight for the changes of {missing}."
                if missing
                else "Goal: track names no output; give at least one and its weight, or a price."
            )

    def range(self, model: ReducedModel) -> tuple[Array, Array]:
        """Return least and largest values of the controls, shapes (controls,)."""
        low, high = zip(*(self.inputs.get(name, FREE) for name in model.controls), strict=True)
        return np.array(low), np.array(high)


@dataclass(frozen=True, eq=False)
class Known:
    """Estimated state and unknown numbers of a reduced model at one time.

    Attributes
    ----------
    x, q
        Coordinates of the state, shape (r,), and unknown numbers, shape (m,).
    factor
        Square root of the covariance of q, shape (m, k); without columns q counts as exact.
    offset
        Estimated unmeasured disturbance added to each channel, shape (channels,); None: zero. It
        acts on the state equation.
    model
        Reduced model relinearised at the estimate, for unknown fields and models that are not
        affine in u, on the basis of the controller's model; the outputs of the controller are used.
        None: the model of the controller.
    source, why
        "estimate", or "fallback" with the reason why the estimate is not trusted.
    """

    x: Array
    q: Array
    factor: Array
    source: Literal["estimate", "fallback"] = "estimate"
    why: str = ""
    offset: Array | None = None
    model: ReducedModel | None = None

    @property
    def std(self) -> Array:
        """Standard deviation of each unknown number, shape (m,)."""
        return np.asarray(np.linalg.norm(self.factor, axis=1))

    def scenarios(self, kappa: float, most: int) -> Array:
        """Return q, and q +- kappa standard deviations along principal directions, shape (k, m).

        Parameters
        ----------
        kappa
            Number of standard deviations.
        most
            Maximum number of directions.
        """
        axes, sizes, _ = np.linalg.svd(self.factor, full_matrices=False)
        shifts = kappa * (axes * sizes).T[:most]
        return np.vstack([self.q[None], self.q + shifts, self.q - shifts])


@dataclass(frozen=True, eq=False)
class Plan:
    """Preview data at a sample: references, disturbances and limits over the horizon.

    Attributes
    ----------
    reference
        References of the tracked outputs, in the order of `Goal.track`, at the end of each coming
        period, shape (horizon, tracked).
    disturbances
        Disturbances, in the order of `ReducedModel.disturbances`, over each coming period, shape
        (horizon, disturbances).
    low, high
        Limits of the outputs in the order of `Goal.limits` at the end of each coming period, shapes
        (horizon, limited).
    """

    reference: Array
    disturbances: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Decision:
    """Decision of a controller: control inputs, status and memory.

    Attributes
    ----------
    inputs
        Control inputs, in the order of `ReducedModel.controls`, shape (controls,).
    status
        "ok", or a description of the failure and of the fallback action.
    memory
        State of the controller for the next sample, such as the initial guess of an optimisation.
    """

    inputs: Array
    status: str
    memory: Array


class Controller(Protocol):
    """Protocol of controllers: frozen objects whose state is in `Decision.memory`."""

    @property
    def model(self) -> ReducedModel:
        """Reduced model of the controller."""

    @property
    def goal(self) -> Goal:
        """Control objective."""

    @property
    def period(self) -> float:
        """Sampling period."""

    @property
    def horizon(self) -> int:
        """Prediction horizon in periods."""

    def start(self) -> Array:
        """Return the initial memory; its shape never changes."""

    def decide(self, known: Known, plan: Plan, before: Array, memory: Array) -> Decision:
        """Return the control inputs for the coming period.

        Parameters
        ----------
        known
            Present state and unknown numbers.
        plan
            Future references and disturbances.
        before
            Inputs applied in the past period, shape (controls,).
        memory
            Memory of the previous decision.
        """


def check(controller: Controller) -> None:
    """Raise `ConfigurationError` if the numbers of a controller are invalid."""
    controller.goal.check(controller.model)
    kind = type(controller).__name__
    if not (np.isfinite(controller.period) and controller.period > 0):
        raise ConfigurationError(
            f"{kind}: period must be a positive number; got {controller.period}."
        )
    if controller.horizon != int(controller.horizon) or controller.horizon < 1:
        raise ConfigurationError(
            f"{kind}: horizon must be a whole number, at least 1; got {controller.horizon}."
        )


# Weight of states that no tracked output sees, relative to the trace of the weight matrix.
TINY = 1e-10
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0, "ipopt.max_iter": 200}
# Largest distance of a scenario from the estimate, as a share of the distance to the bound.
FARTHEST = 0.9
# Finite substitute of a limit that is temporarily infinite: Ipopt needs finite parameters.
FAR = 1e12
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")


@dataclass(frozen=True, eq=False)
class LQ:
    """Stationary linear-quadratic controller about the steady state that meets the reference.

    The cost weighs changes of the controls, so the feedback acts on (x, previous v). The target (x,
    v) is the steady state of the model at the present unknown numbers and disturbances that is
    closest to the reference within the actuator ranges. The inputs are clipped to these ranges.
    Output limits and previews are ignored. The gain is reused while the unknown numbers do not
    change.

    Parameters
    ----------
    model, goal
        Reduced model, and control objective.
    period
        Sampling period.
    """

    model: ReducedModel
    goal: Goal
    period: float
    horizon: int = 1

    def __post_init__(self) -> None:
        check(self)
        if not sum(self.goal.track.values()) > 0.0:
            raise ConfigurationError(
                "LQ: Goal.track has no positive weight; give one, or take MPC, which knows prices."
            )

    def start(self) -> Array:
        """Return the initial memory: unknown numbers and their gain, NaN until computed."""
        count = len(self.model.controls)
        return np.full(len(self.model.unknowns) + count * (self.model.size + count), np.nan)

    def decide(self, known: Known, plan: Plan, before: Array, memory: Array) -> Decision:
        """Return the control inputs for the coming period; see `Controller.decide`."""
        low, high = self.goal.range(self.model)
        model = known.model or self.model
        step = model.matrices(known.q, self.period).with_offset(known.offset)
        try:
            x, v = self.target(step, plan.reference[0], plan.disturbances[0])
            m, cached = len(known.q), np.isfinite(memory).all()
            if known.model is not None:  # it differs at each sample: the gain is not cached
                gain = self.gain(step)
            elif cached and np.array_equal(memory[:m], known.q):
                gain = memory[m:].reshape(len(before), -1)
            else:
                gain = self.gain(step)
                memory = np.concatenate([known.q, gain.ravel()])
        except np.linalg.LinAlgError as error:
            return Decision(before, f"no gain ({error}): the inputs were held", memory)
        inputs = before - gain @ np.concatenate([known.x - x, before - v])
        if not np.isfinite(inputs).all():
            return Decision(before, "no finite state or target: the inputs were held", memory)
        return Decision(np.clip(inputs, low, high), "ok", memory)

    def _parts(self) -> tuple[list[int], list[int], list[int], Array]:
        """Return columns of controls and disturbances, rows of tracked outputs, their weights."""
        model, track = self.model, self.goal.track
        rows = [model.outputs.names.index(name) for name in track]
        controls, others = model.columns(model.controls), model.columns(model.disturbances)
        return controls, others, rows, np.array(list(track.values()))

    def gain(self, step: Discrete) -> Array:
        """Return the Riccati feedback gain from (x, previous v) to minus the change of v."""
        # State (x, v before) and input dv: v = v before + dv acts during the period.
        controls, _, rows, weights = self._parts()
        r, count = len(step.A), len(controls)
        B = step.B[:, controls]
        A = np.block([[step.A, B], [np.zeros((count, r)), np.eye(count)]])
        B = np.vstack([B, np.eye(count)])
        C = np.hstack([self.model.outputs.C[rows], self.model.outputs.D[np.ix_(rows, controls)]])
        Q = C.T @ (weights[:, None] * C)
        # A state that no tracked output sees has zero weight: without a small one the Riccati
        # equation may have no stabilising solution.
        Q += TINY * np.trace(Q) * np.eye(len(Q))
        R = np.diag([self.goal.move[name] for name in self.model.controls])
        P = solve_discrete_are(A, B, Q, R)
        gain: Array = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        return gain

    def target(self, step: Discrete, reference: Array, disturbances: Array) -> tuple[Array, Array]:
        """Return the steady state (x, v) that is closest to the reference within the ranges."""
        controls, others, rows, weights = self._parts()
        model, low, high = self.model, *self.goal.range(self.model)
        r = len(step.A)
        # Steady states x = A x + B v + B_d d + f: a particular one, and the null space along which
        # the tracked outputs are fitted.
        steady = np.hstack([np.eye(r) - step.A, -step.B[:, controls]])
        base = np.linalg.lstsq(steady, step.B[:, others] @ disturbances + step.f, rcond=None)[0]
        null = null_space(steady)
        C = np.hstack([model.outputs.C[rows], model.outputs.D[np.ix_(rows, controls)]])
        offset = model.outputs.D[np.ix_(rows, others)] @ disturbances + model.outputs.d[rows]
        root = np.sqrt(weights)
        misfit = root * (reference - offset - C @ base)
        pair = base + null @ np.linalg.lstsq(root[:, None] * (C @ null), misfit, rcond=None)[0]
        v = np.clip(pair[r:], low, high)
        if not np.array_equal(v, pair[r:]):
            if len(v) > 1:  # if one control is at its bound, the others may compensate for it
                from scipy.optimize import lsq_linear

                move = null @ np.linalg.pinv(null[r:])  # derivative of (x, v) in v
                effect = root[:, None] * (C @ move)
                right_side = misfit + effect @ base[r:]
                v = np.clip(lsq_linear(effect, right_side, (low, high), method="bvls").x, low, high)
            pair = pair + null @ np.linalg.lstsq(null[r:], v - pair[r:], rcond=None)[0]
        return np.asarray(pair[:r]), v


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
        self.problem  # noqa: B018  raises an error now if a package is missing

    @property
    def scenarios(self) -> int:
        """Number of scenarios."""
        directions = min(self.directions, len(self.model.unknowns)) if self.kappa else 0
        return 1 + 2 * directions

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
        low = process.set_variable("_tvp", "low", (len(goal.limits) or 1, 1))
        high = process.set_variable("_tvp", "high", (len(goal.limits) or 1, 1))
        A = process.set_variable("_p", "A", (r, r))
        B = process.set_variable("_p", "B", (r, len(model.channels)))
        f = process.set_variable("_p", "f", (r, 1))
        order = (*model.controls, *model.disturbances)
        c = casadi.vertcat(v, d)[[order.index(name) for name in model.channels]]
        after = A @ x + B @ c + f
        C, D, shift = map(casadi.DM, (model.outputs.C, model.outputs.D, model.outputs.d))
        y = C @ after + D @ c + shift
        process.set_rhs("x", after)
        cost, row = 0.0, model.outputs.names.index
        for k, (name, weight) in enumerate(goal.track.items()):
            cost += weight * (y[row(name)] - reference[k]) ** 2
        for name, price in goal.price.items():
            cost += price * v[model.controls.index(name)]
        process.set_expression("cost", cost)
        for k, name in enumerate(goal.limits):
            process.set_expression(f"low_{name}", low[k] - y[row(name)])
            process.set_expression(f"high_{name}", y[row(name)] - high[k])
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
        scenarios = known.scenarios(self.kappa, (self.scenarios - 1) // 2)
        scenarios = np.array([model.shifted(known.q, scenario - known.q) for scenario in scenarios])
        # The optimisation problem has a fixed number of scenarios; unused ones repeat the estimate.
        q = np.vstack([scenarios, np.tile(known.q, (self.scenarios - len(scenarios), 1))])
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
            reason = f"Ipopt: {mpc.solver_stats['return_status']}: the inputs were held"
            return Decision(before, reason, memory)
        low, high = self.goal.range(model)
        inputs = (mpc.opt_x_num["_u", 0, 0] * mpc._u_scaling).full().ravel()
        solution = mpc.opt_x_num.master.full().ravel()
        return Decision(np.clip(inputs, low, high), "ok", solution)


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress warnings of do-mpc about optional packages and of CasADi about its changes."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The (ONNX|approximateMPC) feature", UserWarning)
        warnings.filterwarnings("ignore", "\\s*casadi", FutureWarning)
        yield


def packages() -> tuple[Any, Any]:
    """Return do_mpc and casadi.

    Raises `ConfigurationError`: one of them is not installed.
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
