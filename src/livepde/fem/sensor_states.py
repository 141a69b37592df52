"""States of slow sensors, as coefficients after the coefficients of fields.

A sensor with the input z = G u has the output y with tau y' = z - y. In a form, it is represented
by a measure of one point with weight one, where u is the pair of input and output.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from livepde.fem.field_blocks import Block, Local
from livepde.fem.measure import Measure
from livepde.linalg import Array, IntArray


@dataclass(frozen=True)
class SensorState:
    """A slow sensor.

    Attributes
    ----------
    row
        Function of the state space that returns the row G, (1, n), of the input of the sensor.
    time_constant
        Time constant in the unit of time of the model; None: the unknown `time_constant[NAME]`.
    """

    row: Callable[[Any], sp.csr_array]
    time_constant: float | None

    @property
    def unknown(self) -> bool:
        return self.time_constant is None


class SensorPair(NamedTuple):
    """Input and output of a slow sensor, in a form."""

    seen: Any
    shown: Any


class SensorBlock(Block):
    """The coefficient of a slow sensor.

    `number` is its index among all coefficients, and `row` the row of its input, (1, number).
    """

    size = 1

    def __init__(self, number: int, row: sp.csr_array) -> None:
        self.row = sp.csr_array(row)
        # Local coefficients are relative to the first coefficient of the block.
        self._dofs: IntArray = np.append(self.row.indices - number, 0).astype(np.int32)[:, None]

    def dofs_on(self, measure: Measure) -> IntArray:
        return self._dofs

    def local(self, measure: Measure) -> Local:
        def evaluate(_: str) -> Array:
            values = np.zeros((2, len(self._dofs), 1, 1))
            values[0, :-1, 0, 0], values[1, -1] = self.row.data, 1.0
            return values

        return Local(self._dofs, [("value", (2,))], evaluate)

    def jet(self, parts: Local, values: Array) -> SensorPair:
        return SensorPair(*values)

    def prior(self) -> Array:
        return np.zeros(1)  # `FunctionSpace.completed` sets it to the input

    def labels(self, name: str) -> tuple[str, ...]:
        return ()


@dataclass(frozen=True, eq=False)
class SensorMeasure(Measure):
    """A slow sensor as a measure of one point with weight one."""

    sensor: str = ""
    members: IntArray | None = field(default_factory=lambda: np.zeros(1, dtype=np.int64))

    @property
    def on_boundary(self) -> bool:
        return False

    @cached_property
    def shape(self) -> tuple[int, int]:
        return 1, 1

    @cached_property
    def points(self) -> Array:
        return np.zeros((self.mesh.dim(), 1, 1))

    @cached_property
    def weights(self) -> Array:
        return np.ones((1, 1))
