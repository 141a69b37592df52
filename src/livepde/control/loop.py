"""Closed control loop with one call for each sample."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from livepde import checkpoint
from livepde.control.controllers import Controller, Decision, Known, Plan
from livepde.control.estimators import Estimator, Kalman, Learned, Trust
from livepde.errors import ConfigurationError, RunError, SampleError
from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.samples import labelled, number, numbers

Future: TypeAlias = Mapping[str, ArrayLike]
"""Name -> one number, or a number for each coming period."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Action:
    """Control action of a sample: inputs to apply, with the estimate behind them.

    Attributes
    ----------
    t
        Time of the sample in the unit of the model.
    inputs
        Mapping from control to the value to apply until the next sample.
    known
        State and unknown numbers used by the controller.
    outputs
        Mapping from output to its present estimated value.
    status
        "ok", or a description of the controller's failure and of the fallback action.
    estimate
        Estimate of the identifier; None with another estimator.
    """

    t: float
    inputs: Mapping[str, float]
    known: Known
    outputs: Mapping[str, float]
    status: str
    estimate: Estimate | None

    @property
    def source(self) -> str:
        """Source of the state: "estimate" or "fallback"."""
        return self.known.source

    @property
    def why(self) -> str:
        """Reason why the estimate is not trusted; empty if it is."""
        return self.known.why


class Loop:
    """Control loop of an estimator and a controller.

    Parameters
    ----------
    estimator
        An `Identifier`, with a nominal model in parallel as a fallback; or any `Estimator`.
    controller
        `LQ`, `MPC`, or any `Controller`.
    trust
        Conditions for using the estimate of an identifier.
    drive
        Mapping from channel to the standard deviation of its noise, for the filter of the nominal
        model; default a tenth of the range of each control.
    before
        Mapping from control to the value applied before the first sample; default the lower end of
        its range.

    Raises
    ------
    ConfigurationError
        Estimator and controller do not fit together.
    """

    def __init__(
        self,
        estimator: Identifier | Estimator,
        controller: Controller,
        trust: Trust | None = None,
        *,
        drive: Mapping[str, float] | None = None,
        before: Mapping[str, float] | None = None,
    ) -> None:
        model = controller.model
        low, high = controller.goal.range(model)
        if isinstance(estimator, Identifier):
            amplitudes = dict(drive or {})
            if not amplitudes:
                width = np.where(np.isfinite(high - low), 0.1 * (high - low), 1.0)
                amplitudes = dict(zip(model.controls, width.tolist(), strict=True))
            start = model.project(estimator.u0)
            nominal = Kalman(model, controller.period, drive=amplitudes, x=start)
            estimator = Learned(estimator, nominal, trust)
        elif trust is not None:
            raise ConfigurationError("Loop: trust is for an Identifier; give it to `Learned`.")
        self.estimator: Estimator = estimator
        self.controller = controller
        applied = np.where(np.isfinite(low), low, 0.0)
        for name, value in (before or {}).items():
            if name not in model.controls:
                raise ConfigurationError(
                    f"Loop: before names '{name}'; the controls are {list(model.controls)}."
                )
            if not np.isfinite(value):
                raise ConfigurationError(f"Loop: before['{name}'] must be a number; got {value}.")
            applied[model.controls.index(name)] = float(value)
        self._before: Array = applied
        self._memory: Array = controller.start()
        self._disturbances: Array = np.full(len(model.disturbances), np.nan)

    def step(
        self,
        t: Any,
        z: Any,
        inputs: Mapping[str, float] | None = None,
        *,
        reference: Future | None = None,
        forecast: Future | None = None,
        limits: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    ) -> Action:
        """Process a sample and return the inputs to apply until the next sample.

        Parameters
        ----------
        t, z
            As for `Identifier.step`; a mapping of measurements may also contain inputs.
        inputs
            Measured disturbances, and applied controls if they differ from the requested values.
            NaN means missing: a disturbance holds its last value, a control has the requested
            value.
        reference
            Mapping from tracked output to a number, or to values at the end of each coming period.
        forecast
            Mapping from disturbance to a number, or to values over each coming period; default the
            present value.
        limits
            Mapping from output to (least, largest), each a number or values at the end of each
            coming period; default the limits of the goal.

        Raises
        ------
        SampleError
            A reference is missing, an unknown name is used, or a limit is given where the goal has
            none.
        """
        controller, model = self.controller, self.controller.model
        z, stated = self._separated(labelled(z), inputs or {})
        applied = _held(model.controls, self._before, stated)
        now = _held(model.disturbances, self._disturbances, stated)
        if missing := [n for n, v in zip(model.disturbances, now, strict=True) if np.isnan(v)]:
            raise SampleError(
                f"input '{missing[0]}' has no value yet; send it with the first sample."
            )
        names, values = (*model.controls, *model.disturbances), np.concatenate([applied, now])
        channels = dict(zip(names, values.tolist(), strict=True))
        plan = self._plan(reference or {}, forecast or {}, now, limits or {})
        # All arguments are validated before the estimator is stepped, so that an invalid sample
        # changes nothing.
        belief = self.estimator.step(t, z, channels)
        self._before, self._disturbances = applied, now  # also if the controller raises an error
        decision = self._possible(controller.decide(belief, plan, applied, self._memory), applied)
        self._before, self._memory = decision.inputs, decision.memory
        y = model.outputs(belief.x, model.values(channels))
        estimate = getattr(self.estimator, "estimate", None)
        return Action(
            t=number(t, "time t") if estimate is None else estimate.t,
            inputs=dict(zip(model.controls, decision.inputs.tolist(), strict=True)),
            known=belief,
            outputs=dict(zip(model.outputs.names, y.tolist(), strict=True)),
            status=decision.status,
            estimate=estimate,
        )

    def _separated(self, z: Any, inputs: Mapping[str, float]) -> tuple[Any, dict[str, float]]:
        """Separate measurements from inputs, which a mapping `z` may contain."""
        model = self.controller.model
        if isinstance(z, Mapping):
            inputs = {name: z[name] for name in model.channels if name in z} | dict(inputs)
            # A channel that a sensor of the same name measures is both.
            z = {k: v for k, v in z.items() if k not in model.channels or k in model.sensors.names}
        named = {name: number(v, f"input '{name}'") for name, v in inputs.items()}
        for name in named:
            if name not in model.channels:
                raise SampleError(f"unknown input '{name}'; there are {list(model.channels)}.")
        return z, named

    def _possible(self, decision: Decision, applied: Array) -> Decision:
        """Return a decision within the actuator ranges, whatever the controller returned."""
        model, inputs = self.controller.model, np.asarray(decision.inputs, dtype=float)
        if inputs.shape != applied.shape:
            raise ConfigurationError(
                f"{type(self.controller).__name__}.decide returned inputs of shape {inputs.shape}; "
                f"the controls are {list(model.controls)}: return {applied.shape}."
            )
        finite, status = np.isfinite(inputs), decision.status
        if not finite.all():
            inputs, status = applied, "an input that is not finite: the inputs were held"
        clipped = np.clip(inputs, *self.controller.goal.range(model))
        if status == "ok" and not np.array_equal(clipped, inputs):
            status = "an input beyond its range: it was set to the end of it"
        memory = decision.memory if finite.all() else self._memory
        return Decision(clipped, status, memory)

    def _plan(
        self,
        reference: Future,
        forecast: Future,
        now: Array,
        limits: Mapping[str, tuple[ArrayLike, ArrayLike]],
    ) -> Plan:
        """Return validated preview data over the horizon."""
        goal, model, count = self.controller.goal, self.controller.model, self.controller.horizon
        for name, ends in _mapping(limits, "limits").items():
            if not isinstance(ends, tuple | list) or len(ends) != 2:
                raise SampleError(f"limits['{name}'] must be (least, largest); got {ends!r}.")
        sides = []
        for k, side in enumerate(("least", "largest")):
            default = np.array([ends[k] for ends in goal.limits.values()])
            stated = {name: ends[k] for name, ends in limits.items()}
            values = _ahead(stated, tuple(goal.limits), default, count, "limits")
            # A controller has slack variables only for the limits that the goal has.
            new = np.isinf(default) & np.isfinite(values).any(axis=0)
            if new.any():
                name = list(goal.limits)[int(np.flatnonzero(new)[0])]
                raise SampleError(
                    f"limits['{name}'] has a {side} value, and the goal has none; give one in "
                    "Goal.limits, so that the controller is built with it."
                )
            sides.append(values)
        crossed = (sides[0] > sides[1]).any(axis=0)
        if crossed.any():
            name = list(goal.limits)[int(np.flatnonzero(crossed)[0])]
            raise SampleError(f"limits['{name}']: the least value is above the largest one.")
        return Plan(
            _ahead(reference, tuple(goal.track), None, count, "reference"),
            _ahead(forecast, model.disturbances, now, count, "forecast"),
            *sides,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file; `load` continues from it with bit-identical numbers."""
        leaves = {
            "estimator": np.frombuffer(self.estimator.dump(), dtype=np.uint8),
            "before": self._before,
            "memory": self._memory,
            "disturbances": self._disturbances,
        }
        checkpoint.write(path, checkpoint.packed({"kind": "loop"}, leaves))

    def load(self, path: str | os.PathLike[str]) -> None:
        """Restore a saved state; the loop must be built with the same arguments.

        Raises `RunError`: the file is damaged or of another loop.
        """
        where = str(path)
        header, leaves = checkpoint.unpacked(checkpoint.read(path), where)
        own = {"before": self._before, "disturbances": self._disturbances, "memory": self._memory}
        matches = all(k in leaves and leaves[k].shape == value.shape for k, value in own.items())
        if header.get("kind") != "loop" or not matches:
            raise RunError(f"{where} is of another loop: build it as it was when it was saved.")
        self.estimator.restore(leaves["estimator"].tobytes(), where)
        self._before, self._memory = leaves["before"], leaves["memory"]
        self._disturbances = leaves["disturbances"]


def _held(names: Sequence[str], last: Array, given: Mapping[str, float]) -> Array:
    """Return the given values; inputs without one (NaN, absent) hold their last value."""
    new = np.array([given.get(name, np.nan) for name in names])
    return np.where(np.isnan(new), last, new)


def _mapping(given: Any, what: str) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise SampleError(f"{what} must be a mapping from names to values; got {given!r}.")
    return given


def _ahead(
    given: Future, names: tuple[str, ...], default: Array | None, horizon: int, what: str
) -> Array:
    """Return values over the horizon, shape (horizon, names); only limits may be infinite."""
    for name in _mapping(given, what):
        if name not in names:
            raise SampleError(f"{what} names '{name}'; there are {list(names)}.")
    columns = []
    for k, name in enumerate(names):
        if name in given:
            values = np.atleast_1d(numbers(given[name], f"{what}['{name}']"))
            wrong = np.isnan(values) | (np.isinf(values) & (what != "limits"))
            if values.ndim > 1 or not len(values) or wrong.any():
                raise SampleError(
                    f"{what}['{name}'] must be a number, or one for each period; got "
                    f"{given[name]!r}."
                )
        elif default is None:
            raise SampleError(f"{what}: '{name}' has none; give a number, or one for each period.")
        else:
            values = default[k : k + 1]
        # The last value holds to the end of the horizon; values beyond it are not used.
        columns.append(values[np.minimum(np.arange(horizon), len(values) - 1)])
    return np.column_stack(columns) if columns else np.zeros((horizon, 0))
