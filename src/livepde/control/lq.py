"""Linear-quadratic controller on a reduced model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space, solve_discrete_are

from livepde.control.goal import Decision, Goal, Known, Plan, check
from livepde.control.linear import Discrete
from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError
from livepde.linalg import Array

# Weight of states that no tracked output sees, relative to the trace of the weight matrix.
TINY = 1e-10


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
            m, kept = len(known.q), np.isfinite(memory).all()
            if known.model is not None:  # another one at each sample: its gain is not kept
                gain = self.gain(step)
            elif kept and np.array_equal(memory[:m], known.q):
                gain = memory[m:].reshape(len(before), -1)
            else:
                gain = self.gain(step)
                memory = np.concatenate([known.q, gain.ravel()])
        except np.linalg.LinAlgError as error:
            return Decision(before, f"no gain ({error}): the inputs were held", memory)
        wanted = before - gain @ np.concatenate([known.x - x, before - v])
        if not np.isfinite(wanted).all():
            return Decision(before, "no finite state or target: the inputs were held", memory)
        return Decision(np.clip(wanted, low, high), "ok", memory)

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
        found: Array = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        return found

    def target(self, step: Discrete, reference: Array, disturbances: Array) -> tuple[Array, Array]:
        """Return the steady state (x, v) that is closest to the reference within the ranges."""
        controls, others, rows, weights = self._parts()
        model, low, high = self.model, *self.goal.range(self.model)
        r = len(step.A)
        # Steady states x = A x + B v + B_d d + f: a particular one, and the null space along which
        # the tracked outputs are fitted.
        steady = np.hstack([np.eye(r) - step.A, -step.B[:, controls]])
        one = np.linalg.lstsq(steady, step.B[:, others] @ disturbances + step.f, rcond=None)[0]
        along = null_space(steady)
        C = np.hstack([model.outputs.C[rows], model.outputs.D[np.ix_(rows, controls)]])
        offset = model.outputs.D[np.ix_(rows, others)] @ disturbances + model.outputs.d[rows]
        root = np.sqrt(weights)
        missed = root * (reference - offset - C @ one)
        pair = one + along @ np.linalg.lstsq(root[:, None] * (C @ along), missed, rcond=None)[0]
        v = np.clip(pair[r:], low, high)
        if not np.array_equal(v, pair[r:]):
            if len(v) > 1:  # where one of them is at its end, the others may do its work
                from scipy.optimize import lsq_linear

                move = along @ np.linalg.pinv(along[r:])  # of the pair, with v
                effect = root[:, None] * (C @ move)
                rest = missed + effect @ one[r:]
                v = np.clip(lsq_linear(effect, rest, (low, high), method="bvls").x, low, high)
            pair = pair + along @ np.linalg.lstsq(along[r:], v - pair[r:], rcond=None)[0]
        return np.asarray(pair[:r]), v
