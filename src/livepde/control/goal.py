"""Control objective, and what a controller is given and returns at a sample."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError
from livepde.linalg import Array

FREE = (-np.inf, np.inf)
Source: TypeAlias = Literal["estimate", "fallback"]


def _finite(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _range(ends: Any) -> bool:
    """Return True for (least, largest); either may be infinite."""
    two = np.shape(ends) == (2,) and all(isinstance(end, Real) for end in ends)
    return two and bool(ends[0] < ends[1])


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
        for what in ("track", "move", "inputs", "limits", "price"):
            if not isinstance(getattr(self, what), Mapping):
                raise ConfigurationError(
                    f"Goal: {what} must be a mapping from names to numbers; got "
                    f"{getattr(self, what)!r}."
                )
        for what, valid, expected in (
            ("track", lambda weight: _finite(weight) and weight >= 0.0, "a positive number"),
            # R of the Riccati equation is made of these and must be regular.
            ("move", lambda weight: _finite(weight) and weight >= 1e-300, "a positive number"),
            ("inputs", _range, "(least, largest) with least < largest"),
            ("limits", _range, "(least, largest) with least < largest"),
            ("price", _finite, "a number"),
        ):
            for name, value in getattr(self, what).items():
                if not valid(value):
                    raise ConfigurationError(
                        f"Goal: {what}['{name}'] must be {expected}; got {value!r}."
                    )
        if not (np.isfinite(self.beyond) and self.beyond >= 0.0):
            raise ConfigurationError(f"Goal: penalty must be at least 0; got {self.penalty}.")

    @property
    def beyond(self) -> float:
        """Cost of one unit beyond a limit in one sample."""
        return 100.0 * (sum(self.track.values()) or 1.0) if self.penalty is None else self.penalty

    def check(self, model: ReducedModel) -> None:
        """Raise `ConfigurationError` if it names quantities that the model does not have."""
        for what, names, known in (
            ("track", self.track, model.outputs.names),
            ("limits", self.limits, model.outputs.names),
            ("move", self.move, model.controls),
            ("inputs", self.inputs, model.controls),
            ("price", self.price, model.controls),
        ):
            for name in names:
                if name not in known:
                    raise ConfigurationError(
                        f"Goal: {what} names '{name}'; the reduced model has {list(known)}."
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
        affine in u. None: the model of the controller. Its basis is that of the controller's model;
        a controller uses its own outputs.
    source, why
        "estimate", or "fallback" with the reason why the estimate is not trusted.
    """

    x: Array
    q: Array
    factor: Array
    source: Source = "estimate"
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
    what = type(controller).__name__
    if not (np.isfinite(controller.period) and controller.period > 0):
        raise ConfigurationError(
            f"{what}: period must be a positive number; got {controller.period}."
        )
    if controller.horizon != int(controller.horizon) or controller.horizon < 1:
        raise ConfigurationError(
            f"{what}: horizon must be a whole number, at least 1; got {controller.horizon}."
        )
