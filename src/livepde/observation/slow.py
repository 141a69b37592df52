"""Sensors with a slow response: each adds a coefficient to the state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FunctionSpace, Prior, Scalars, SensorState, Unknown
from livepde.linalg import Array
from livepde.observation.operator import Observation
from livepde.observation.sensors import Averages, LineIntegrals, Points

TIME_CONSTANT = "time_constant"


@dataclass(frozen=True, eq=False)
class Slow(Observation):
    """Sensors with a first-order lag, such as thermometers in a tube.

        tau z' = y - z,      y = readings of `base`

    The state z of each sensor is a coefficient of the state of the model, with initial value y. An
    `Identifier` adds these states to its model; otherwise use `model.with_sensors`.

    Parameters
    ----------
    base
        The underlying sensors: `Points`, `Averages` or `LineIntegrals`, without `noise`.
    time_constant
        tau of each sensor, in the unit of time of the model: a positive number, or a prior of the
        unknown `time_constant[NAME]`.

    Raises
    ------
    ObservationError
        The base is another kind of sensor or has uncertain positions, or a time constant is not
        positive.

    Examples
    --------
    >>> import livepde as lp
    >>> sensors = Slow(lp.Points({"T_10": 0.1}), lp.LogNormal(300.0, std=200.0), noise=0.1)
    """

    base: Observation
    time_constant: float | Prior
    portable = True

    def __post_init__(self) -> None:
        self._refuse_component("give of= to the observation that it is made of.")
        if not isinstance(self.base, Points | Averages | LineIntegrals):
            kind = type(self.base).__name__
            raise ObservationError(
                f"Slow: got {kind} as base; expected Points, Averages or LineIntegrals. Slow "
                "sensors can be a part of Combined, and the base of Calibrated."
            )
        if self.base.unknowns or self.base.directs:
            raise ObservationError(
                "Slow: the base has uncertain positions, or reads unknowns directly. Leave out "
                "position_std and direct."
            )
        self._add_base_channels(self.base)
        constant = self.time_constant
        low = constant.bounds[0] if isinstance(constant, Prior) else constant
        if not (low >= 0.0 and (isinstance(constant, Prior) or 0.0 < constant < math.inf)):
            raise ObservationError(
                f"Slow: time_constant must be positive; got {constant!r}. As a prior use LogNormal."
            )

    @property
    def _sensors(self) -> tuple[str, ...]:
        return self.base.names(len(getattr(self.base, self.base.listed[0])))

    def names(self, count: int) -> tuple[str, ...]:
        return self._sensors

    @property
    def places(self) -> Array | None:
        return self.base.places

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        prior = self.time_constant
        return {TIME_CONSTANT: Scalars(self._sensors, prior)} if isinstance(prior, Prior) else {}

    @property
    def states(self) -> Mapping[str, SensorState]:
        constant = None if isinstance(self.time_constant, Prior) else float(self.time_constant)
        sensors = enumerate(self._sensors)
        return {name: SensorState(partial(_row, self.base, k), constant) for k, name in sensors}

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        if missing := [name for name in self._sensors if name not in state.sensors]:
            raise ObservationError(
                f"the model has no state for the slow sensor '{missing[0]}': an Identifier adds "
                "it; elsewhere take model.with_sensors(observation.states)."
            )
        at = [state.part(name).start for name in self._sensors]
        rows = np.arange(len(at))
        return sp.csr_array((np.ones(len(at)), (rows, at)), shape=(len(at), state.dim))


def _row(base: Any, number: int, state: FunctionSpace) -> sp.csr_array:
    """Return the row of G for one sensor of an observation, (1, n)."""
    return sp.csr_array(base.matrix(state))[[number]]
