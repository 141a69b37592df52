"""What a controller is to reach, what it is asked at a sample, and what it answers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, Protocol

import numpy as np

from livepde.control.known import Known
from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError
from livepde.linalg import Array

__all__ = ["Controller", "Decision", "Goal", "Plan", "check"]

FREE = (-np.inf, np.inf)


def _real(value: Any) -> bool:
    return isinstance(value, Real)


def _finite(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


@dataclass(frozen=True)
class Goal:
    """What is paid for, and what must not happen.

    The cost of a sample is the sum of track (y - reference)^2 + penalty (units beyond a limit) over
    outputs, and of move (v - v before)^2 + price v over controls.

    Parameters
    ----------
    track
        Output -> weight of its error.
    move
        Control -> weight of its change from sample to sample; > 0.
    inputs
        Control -> (least, largest) value that the actuator takes; never left.
    limits
        Output -> (least, largest) value; `MPC` keeps them, `LQ` does not know them. They may change
        with time: `Loop.step`.
    price
        Control -> what a unit of it costs in a sample; `LQ` does not know it.
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
        for what, weights, least in (("track", self.track, 0.0), ("move", self.move, 1e-300)):
            for name, weight in weights.items():
                if not (_finite(weight) and weight >= least):
                    raise ConfigurationError(
                        f"Goal: {what}['{name}'] must be a positive number; got {weight!r}."
                    )
        for what, ranges in (("inputs", self.inputs), ("limits", self.limits)):
            for name, ends in ranges.items():
                two = np.shape(ends) == (2,) and all(_real(end) for end in ends)
                if not two or not ends[0] < ends[1]:
                    raise ConfigurationError(
                        f"Goal: {what}['{name}'] must be (least, largest) with least < largest; "
                        f"got {ends}."
                    )
        for name, price in self.price.items():
            if not (_finite(price)):
                raise ConfigurationError(f"Goal: price['{name}'] must be a number; got {price!r}.")
        if not (np.isfinite(self.beyond) and self.beyond >= 0.0):
            raise ConfigurationError(f"Goal: penalty must be at least 0; got {self.penalty}.")

    @property
    def beyond(self) -> float:
        """Cost of one unit beyond a limit in one sample."""
        return 100.0 * (sum(self.track.values()) or 1.0) if self.penalty is None else self.penalty

    def check(self, model: ReducedModel) -> None:
        """Raise `ConfigurationError` where it names what the model does not have."""
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
class Plan:
    """What is known of the future at a sample.

    Attributes
    ----------
    reference
        Of the tracked outputs, in the order of `Goal.track`, at the end of each coming period,
        shape (horizon, tracked).
    disturbances
        In the order of `ReducedModel.disturbances`, over each coming period, shape
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
    """What a controller sets.

    Attributes
    ----------
    inputs
        In the order of `ReducedModel.controls`, shape (controls,).
    status
        "ok", or what went wrong and what was done instead.
    memory
        What it wants to be given at the next sample: where an optimisation begins, say.
    """

    inputs: Array
    status: str
    memory: Array


class Controller(Protocol):
    """A controller: frozen; what it remembers goes through `Decision.memory`."""

    @property
    def model(self) -> ReducedModel:
        """The reduced model that it acts on."""

    @property
    def goal(self) -> Goal:
        """What it is to reach."""

    @property
    def period(self) -> float:
        """Time between two samples."""

    @property
    def horizon(self) -> int:
        """Number of periods that it looks ahead."""

    def start(self) -> Array:
        """Return the memory before the first sample, of the shape that it keeps."""

    def decide(self, known: Known, plan: Plan, before: Array, memory: Array) -> Decision:
        """Return what to set from now on.

        Parameters
        ----------
        known
            State and unknown numbers now.
        plan
            References and disturbances to come.
        before
            What was applied up to now, shape (controls,).
        memory
            What it left at the sample before.
        """


def check(controller: Controller) -> None:
    """Raise `ConfigurationError` where a controller's numbers make no sense."""
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
