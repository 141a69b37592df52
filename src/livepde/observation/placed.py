"""Point sensors whose positions are uncertain, z_k = u(x_k + d_k) with unknown d_k."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Moment
from livepde.linalg import Array
from livepde.observation.operator import Observation, Observed
from livepde.spaces import HilbertSpace

__all__ = ["POSITION", "PlacedObserved", "shift_names"]

# Name of the unknown: one number for each sensor and coordinate.
POSITION = "position"
AXES = "xyz"
# Distance from the end of the mesh, in standard deviations of the position, within which a sensor
# lies on the end.
NEAR = 1e-6


def shift_names(sensor: str, dimension: int) -> list[str]:
    """Return the names of a sensor's shifts: its own in 1D, else one for each coordinate.

    >>> shift_names("T", 2)
    ['T.x', 'T.y']
    """
    return [sensor] if dimension == 1 else [f"{sensor}.{axis}" for axis in AXES[:dimension]]


@dataclass(frozen=True, eq=False)
class _Shift:
    """Effect of shifting one sensor along one coordinate by d: a quadratic interpolant.

    The quadratic interpolates the values at -a, 0 and b, about a standard deviation to each side. A
    derivative is not used because u has none at a node of linear elements. At the end of the mesh a
    or b is 0, and the interpolant is the straight line to the other side.

    Attributes
    ----------
    sensor, column
        Number of the sensor, and position of the shift in q.
    below, above
        Distances a and b.
    low, high
        Rows that evaluate the differences of u there to u at 0, shape (1, n).
    """

    sensor: int
    column: int
    below: float
    above: float
    low: sp.csr_array
    high: sp.csr_array

    def weights(self, d: float) -> tuple[float, float]:
        """Return the interpolation weights of both differences at a shift d."""
        a, b = self.below, self.above
        if a == 0.0 or b == 0.0:
            return (-d / a, 0.0) if b == 0.0 else (0.0, d / b)
        return d * (d - b) / (a * (a + b)), d * (d + a) / (b * (a + b))

    def slopes(self, d: float) -> tuple[float, float]:
        """Return the derivatives of `weights`."""
        a, b = self.below, self.above
        if a == 0.0 or b == 0.0:
            return (-1.0 / a, 0.0) if b == 0.0 else (0.0, 1.0 / b)
        return (2.0 * d - b) / (a * (a + b)), (2.0 * d + a) / (b * (a + b))

    def change(self, weights: tuple[float, float]) -> sp.csr_array:
        """Return the weighted sum of the differences, shape (1, n)."""
        return sp.csr_array(weights[0] * self.low + weights[1] * self.high)


class PlacedObserved(Observed):
    """Bound point sensors at uncertain positions: linear in u, quadratic in the shifts.

    Parameters
    ----------
    observation, state, X, parameter
        As for `Observed`.
    rows
        Matrix of the values that some sensors would measure at other places (`Points.rows`).
    at
        Stated coordinates of all sensors, shape (sensors, d).
    uncertain, std
        Names of the sensors whose positions are uncertain, and the standard deviation of a shift.
    """

    def __init__(
        self,
        observation: Observation,
        state: FunctionSpace,
        X: HilbertSpace,
        parameter: FunctionSpace,
        rows: Callable[[FunctionSpace, Array, Sequence[int]], sp.csr_array],
        at: Array,
        uncertain: Sequence[str],
        std: float,
    ) -> None:
        super().__init__(observation, state, X, parameter)
        block, _ = state.component(observation.of)
        labels = parameter.labels

        def difference(sensor: int, point: Array, start: Array) -> sp.csr_array:
            values = rows(state, np.array([start, point]), [sensor, sensor])
            return sp.csr_array(values[[1]] - values[[0]])

        self.shifts = []
        for name in uncertain:
            sensor = self.names.index(name)
            for axis, shift in enumerate(shift_names(name, at.shape[1])):
                label = f"{POSITION}[{shift}]"
                if label not in labels:
                    raise ObservationError(
                        f"the model has no unknown '{label}' for the position of sensor '{name}': "
                        "an Identifier adds it for assimilated sensors; elsewhere take "
                        "model.with_unknowns(observation.unknowns)."
                    )
                start = at[sensor]
                # The interpolation points lie a standard deviation away, where the shift is
                # expected, and are moved into the mesh at its boundary.
                low, high = (_reached(block, start, axis, step) for step in (-std, std))
                below, above = float(start[axis] - low[axis]), float(high[axis] - start[axis])
                ends = (difference(sensor, low, start), difference(sensor, high, start))
                self.shifts.append(_Shift(sensor, labels[label], below, above, *ends))

    @property
    def linear(self) -> bool:
        return False

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        z: Array = self._placed(q) @ u
        direct = self._direct(moment)
        return z if direct is None else z + direct @ q

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        direct = self._direct(moment)
        H_q = np.zeros((self.size, self.parameter.dim)) if direct is None else direct
        for shift in self.shifts:
            slope = shift.change(shift.slopes(float(q[shift.column])))
            H_q[shift.sensor, shift.column] += float((slope @ u)[0])
        return self._placed(q), H_q

    def _placed(self, q: Array) -> sp.csr_array:
        """Return G at the shifted positions, shape (sensors, n)."""
        rows: list[sp.csr_array] = [self.G[[k]] for k in range(self.size)]
        for shift in self.shifts:
            change = shift.change(shift.weights(float(q[shift.column])))
            rows[shift.sensor] = sp.csr_array(rows[shift.sensor] + change)
        return sp.csr_array(sp.vstack(rows, format="csr"))


def _reached(block: FieldBlock, start: Array, axis: int, step: float) -> Array:
    """Return start + step along an axis, or the last point on the way that is in the mesh.

    A distance below `NEAR` of the step counts as zero: the sensor lies on the end of the mesh.
    """
    least, most = 0.0, 1.0

    def at(share: float) -> Array:
        point: Array = start.copy()
        point[axis] += share * step
        return point

    if block.contains(at(most)):
        return at(most)
    while most - least > NEAR:
        middle = 0.5 * (least + most)
        least, most = (middle, most) if block.contains(at(middle)) else (least, middle)
    return at(least) if least > 0.0 else start
