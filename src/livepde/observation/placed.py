"""Point sensors at uncertain positions, z_k = u(x_k + d_k) with unknown d_k, and moving sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Moment
from livepde.linalg import Array, IntArray
from livepde.observation.operator import Observation, Observed
from livepde.spaces import HilbertSpace

# Name of the unknown: one number for each sensor and coordinate.
POSITION = "position"
AXES = "xyz"
# Distance from the end of the mesh, in standard deviations of the position, within which a sensor
# lies on the end.
NEAR = 1e-6


def shift_names(sensor: str, dimension: int) -> list[str]:
    """Return the names of a sensor's shifts: "T" in 1D, else "T.x", "T.y" and so on."""
    return [sensor] if dimension == 1 else [f"{sensor}.{axis}" for axis in AXES[:dimension]]


@dataclass(frozen=True, eq=False)
class _Shift:
    """Effect of shifting one sensor along one coordinate by d: a quadratic interpolant.

    The quadratic interpolates the values at -a, 0 and b (`below`, `above`), about a standard
    deviation to each side. A derivative is not used because u has none at a node of linear
    elements. At the end of the mesh a or b is 0, and the interpolant is the straight line to the
    other side. The rows `low` and `high` evaluate the differences of u there to u at 0, shape (1,
    n); `column` is the position of the shift in q.
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


class PlacedObserved(Observed):
    """Bound point sensors at uncertain positions: linear in u, quadratic in the shifts.

    `rows` is the matrix of the values that some sensors would measure at other places
    (`Points.rows`), `at` the stated coordinates of all sensors, shape (sensors, d). The positions
    of the sensors in `uncertain` have shifts of standard deviation `std`.
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
        z = super().predict(u, q, moment)
        weights = [shift.weights(float(q[shift.column])) for shift in self.shifts]
        np.add.at(z, self._sensors, np.ravel(weights) * (self._differences @ u))
        return z

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        direct = self._direct(moment)
        H_q = np.zeros((self.size, self.parameter.dim)) if direct is None else direct
        differences = (self._differences @ u).reshape(-1, 2)
        weights = []
        for shift, difference in zip(self.shifts, differences, strict=True):
            d = float(q[shift.column])
            H_q[shift.sensor, shift.column] += float(difference @ shift.slopes(d))
            weights.append(shift.weights(d))
        return self._placed(np.ravel(weights)), H_q

    def _placed(self, weights: Array) -> sp.csr_array:
        """Return G at the shifted positions, for weights of all differences, shape (sensors, n)."""
        pattern, parts = self._parts
        values = parts[0] + weights @ parts[1:]
        return sp.csr_array((values, pattern.indices, pattern.indptr), shape=pattern.shape)

    @cached_property
    def _sensors(self) -> IntArray:
        """Number of the sensor of each row of `_differences`."""
        return np.repeat([shift.sensor for shift in self.shifts], 2)

    @cached_property
    def _differences(self) -> sp.csr_array:
        """Rows `low` and `high` of each shift in turn, shape (2 shifts, n)."""
        ends = [end for shift in self.shifts for end in (shift.low, shift.high)]
        return sp.csr_array(sp.vstack(ends, format="csr"))

    @cached_property
    def _parts(self) -> tuple[sp.csr_array, Array]:
        """Pattern of G at shifted positions, and values on it of G and of each difference."""
        rows = self._sensors
        sums = sp.csr_array(
            (np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(self.size, len(rows))
        )
        pattern = sp.csr_array(abs(self.G) + sums @ abs(self._differences))
        pattern.sort_indices()
        row = np.repeat(np.arange(self.size), np.diff(pattern.indptr))
        values = [np.asarray(self.G[row, pattern.indices])]
        for k, sensor in enumerate(rows):
            own = np.asarray(self._differences[np.full_like(row, k), pattern.indices])
            values.append(np.where(row == sensor, own, 0.0))
        return pattern, np.array(values)


def _reached(block: FieldBlock, start: Array, axis: int, step: float) -> Array:
    """Return start + step along an axis, or the last point on the way that is in the mesh."""
    least, most = 0.0, 1.0  # a share below `NEAR` counts as zero: on the end of the mesh

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


@dataclass(frozen=True, eq=False)
class Moving(Observation):
    """Point sensors with positions from the stream, z_k(t) = u(x_k(t), t).

    While its position is missing or outside of the mesh, a sensor has no reading: its prediction is
    NaN and its sample is not used. Positions are not held from one sample to the next.

    Parameters
    ----------
    positions
        Mapping from sensor name to the channel of its position; in more than one dimension to one
        channel for each coordinate.

    Examples
    --------
    >>> Moving({"probe": ("probe_x", "probe_y")}, noise=0.1).inputs
    ('probe_x', 'probe_y')
    """

    positions: Mapping[str, str | Sequence[str]]

    def __post_init__(self) -> None:
        if not self.positions:
            raise ObservationError("Moving: give at least one sensor.")
        self._reads(name for names in self.channels for name in names)

    @property
    def channels(self) -> list[tuple[str, ...]]:
        """Channels of the coordinates of each sensor."""
        given = self.positions.values()
        return [(names,) if isinstance(names, str) else tuple(names) for names in given]

    def names(self, count: int) -> tuple[str, ...]:
        return tuple(self.positions)

    @property
    def optional(self) -> frozenset[str]:
        return frozenset(name for names in self.channels for name in names)

    @property
    def portable(self) -> bool:
        return True

    def bind(
        self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace
    ) -> MovingObserved:
        return MovingObserved(self, state, X, parameter)


class MovingObserved(Observed):
    """Bound `Moving` sensors: G depends on the moment."""

    observation: Moving

    def _prepare(self) -> None:
        self.block = self.observation.scalar_block(self.state)
        dimension = self.block.field.mesh.dim()
        for name, channels in zip(self._names(), self.observation.channels, strict=True):
            if len(channels) != dimension:
                raise ObservationError(
                    f"Moving: sensor '{name}' has position channels {list(channels)}; the mesh "
                    f"has {dimension} coordinates."
                )
        # G at the last positions. Copies of an identifier share it, possibly in several threads:
        # the three values are read and replaced as one tuple, so that they are always consistent.
        self._last: tuple[bytes, sp.csr_array, Array] | None = None

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(len(self.observation.positions))

    @property
    def linear(self) -> bool:
        return False

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        G, seen = self._at(moment)
        z: Array = G @ u
        z[np.logical_not(seen)] = np.nan
        return z

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        return self._at(moment)[0], None

    def available(self, moment: Moment) -> Array:
        return self._at(moment)[1]

    def _at(self, moment: Moment) -> tuple[sp.csr_array, Array]:
        """Return G at a moment, and the mask of sensors inside the mesh."""
        given = dict(moment.inputs)
        points = np.array(
            [[given.get(name, np.nan) for name in names] for names in self.observation.channels]
        )
        key = points.tobytes()
        last = self._last
        if last is None or last[0] != key:
            seen = np.array([self.block.contains(point) for point in points])
            rows = np.flatnonzero(seen)
            G = sp.csr_array((len(points), self.state.dim))
            if len(rows):
                values = self.state.widen(self.block.probe(points[rows].T), self.observation.of)
                place = sp.csr_array(
                    (np.ones(len(rows)), (rows, np.arange(len(rows)))), (len(points), len(rows))
                )
                G = sp.csr_array(place @ values)
            # Callers share the cached mask, so it must not be changed in place.
            seen.setflags(write=False)
            self._last = last = (key, G, seen)
        return last[1], last[2]
