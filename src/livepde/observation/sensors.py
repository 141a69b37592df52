"""Point sensors, also moving or at uncertain positions, averages, line integrals, and matrices."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Moment, Normal, Predicate, Scalars, Unknown
from livepde.fem.measure import FineMeasure, Measure, crossed
from livepde.linalg import Array, IntArray
from livepde.observation.operator import Direct, Observation, Observed
from livepde.spaces import HilbertSpace

# Name of the unknown shifts, with one number for each sensor and coordinate.
POSITION = "position"
AXES = "xyz"
# Tolerance of the search for the end of the mesh, as a share of `REACH` standard deviations.
NEAR = 1e-6
REACH = 3.0  # standard deviations to each side within which shifted values are interpolated
PER_STD = 4  # largest number of interpolation points in a standard deviation


def shift_names(sensor: str, dimension: int) -> list[str]:
    """Return the names of a sensor's shifts: "T" in 1D, otherwise "T.x", "T.y" and so on."""
    return [sensor] if dimension == 1 else [f"{sensor}.{axis}" for axis in AXES[:dimension]]


@dataclass(frozen=True, eq=False)
class Moving(Observation):
    """Point sensors with positions from the stream, z_k(t) = u(x_k(t), t).

    If its position is missing or outside the mesh, a sensor has no reading: its prediction is NaN,
    and its value in the sample is not used. A missing position is not replaced by an earlier one.

    Parameters
    ----------
    positions
        Mapping from sensor name to the channel of its position; in more than one dimension, to a
        sequence of one channel for each coordinate.

    Examples
    --------
    >>> Moving({"probe": ("probe_x", "probe_y")}, noise=0.1).inputs
    ('probe_x', 'probe_y')
    """

    positions: Mapping[str, str | Sequence[str]]
    portable = True
    listed = ("positions", "sensor")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._reads(name for names in self.channels for name in names)

    @property
    def channels(self) -> list[tuple[str, ...]]:
        """Channels of the coordinates of each sensor."""
        positions = self.positions.values()
        return [(names,) if isinstance(names, str) else tuple(names) for names in positions]

    @property
    def optional(self) -> frozenset[str]:
        return frozenset(name for names in self.channels for name in names)

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        return MovingObserved(self, state, X, parameter)


class MovingObserved(Observed):
    """Bound `Moving` sensors: G depends on the moment."""

    observation: Moving
    linear = False

    def _prepare(self) -> None:
        self.block = self.observation.scalar_block(self.state)
        dimension = self.block.field.mesh.dim()
        for name, channels in zip(self._names(), self.observation.channels, strict=True):
            if len(channels) != dimension:
                raise ObservationError(
                    f"Moving: sensor '{name}' has position channels {list(channels)}; the mesh "
                    f"has {dimension} coordinates."
                )
        # G at the last positions. Copies of an identifier in several threads may share it, so the
        # three values are read and replaced as one tuple and are always consistent.
        self._last: tuple[bytes, sp.csr_array, Array] | None = None

    def _names(self) -> tuple[str, ...]:
        return self.observation.names(len(self.observation.positions))

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        G, inside = self._at(moment)
        z: Array = G @ u
        z[np.logical_not(inside)] = np.nan
        return z

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        return self._at(moment)[0], None

    def available(self, moment: Moment) -> Array:
        return self._at(moment)[1]

    def _at(self, moment: Moment) -> tuple[sp.csr_array, Array]:
        """Return G at a moment, and the mask of sensors inside the mesh."""
        inputs = dict(moment.inputs)
        points = np.array(
            [[inputs.get(name, np.nan) for name in names] for names in self.observation.channels]
        )
        key = points.tobytes()
        last = self._last
        if last is None or last[0] != key:
            inside = np.array([self.block.contains(point) for point in points])
            rows = np.flatnonzero(inside)
            G = sp.csr_array((len(points), self.state.dim))
            if len(rows):
                values = self.state.widen(self.block.probe(points[rows].T), self.observation.of)
                selection = sp.csr_array(
                    (np.ones(len(rows)), (rows, np.arange(len(rows)))), (len(points), len(rows))
                )
                G = sp.csr_array(selection @ values)
            # Callers share the cached mask, so it must not be changed in place.
            inside.setflags(write=False)
            self._last = last = (key, G, inside)
        return last[1], last[2]


@dataclass(frozen=True, eq=False)
class Points(Observation):
    """Point sensors, z_k = u(x_k), or a component of u(x_k) if u is a vector field.

    Parameters
    ----------
    points
        Positions: a sequence, or a mapping from sensor name to position. A position is a number in
        1D, otherwise a sequence of d coordinates.
    direct
        Mapping from sensor name to a function (q, x) for a direct dependence on the parameter,
        linear in q: z_k = u(x_k) + direct(q, x). Example: {"T_fluid": lambda q, x: q.R_b *
        x.inputs["Q"] / H}.
    position_std
        Standard deviation of each coordinate of the true positions: one number for all sensors, or
        a mapping from the names of some sensors to one common number. The shifts are additional
        unknowns: `position[NAME]`, or `position[NAME.x]` and so on in more than one dimension. The
        effects of shifts along several coordinates are added, which is exact to first order.
    component
        Index of the measured component, starting at 0, if the state is a vector field: one for all
        sensors, or one for each. Two components at one position are two sensors.

    Raises
    ------
    ObservationError
        There is no position, or options do not match the sensors. On binding: a position is outside
        the mesh, or `component` is missing for a vector field.

    Examples
    --------
    >>> Points({"TS_10": 0.10, "TS_20": 0.20}, noise=0.1, unit="degC").names(2)
    ('TS_10', 'TS_20')
    """

    points: Mapping[str, Any] | Sequence[Any]
    direct: Mapping[str, Direct] = field(default_factory=dict)
    position_std: float | Mapping[str, float] | None = None
    component: int | Sequence[int] | None = None
    portable = True
    listed = ("points", "position")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_component()
        given = self.position_std
        if given is None:
            return
        for name in self.uncertain:
            if name not in self.names(len(self.points)):
                raise ObservationError(f"Points: position_std: no sensor is called '{name}'.")
        values = set(given.values()) if isinstance(given, Mapping) else {given}
        if len(values) != 1 or not all(np.isfinite(std) and std > 0.0 for std in values):
            raise ObservationError(
                "Points: position_std must be one positive number, which all sensors named have in "
                f"common; got {given!r}."
            )

    def _check_component(self) -> None:
        """Raise an error if components are not indices, or not one for each sensor."""
        if self.component is None:
            return
        numbers = np.asarray(self.component)
        valid = numbers.shape in ((), (len(self.points),)) and numbers.dtype.kind in "iu"
        if not (valid and (numbers >= 0).all()):
            raise ObservationError(
                "Points: component must be the number of a component, from 0, or one for each of "
                f"{len(self.points)} sensors; got {self.component!r}."
            )

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of the sensors whose positions are uncertain."""
        if isinstance(self.position_std, Mapping):
            return tuple(self.position_std)
        return () if self.position_std is None else self.names(len(self.points))

    @property
    def shift_std(self) -> float:
        """Standard deviation of a shift; 0 if positions are certain."""
        if isinstance(self.position_std, Mapping):
            return float(next(iter(self.position_std.values())))
        return float(self.position_std or 0.0)

    @property
    def positions(self) -> Array:
        """Coordinates of the sensors, shape (sensors, d)."""
        points = self.points.values() if isinstance(self.points, Mapping) else self.points
        return np.array([np.atleast_1d(p) for p in points], dtype=float)

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        if self.position_std is None:
            return {}
        dimension = self.positions.shape[1]
        names = [shift for name in self.uncertain for shift in shift_names(name, dimension)]
        return {POSITION: Scalars(names, Normal(0.0, self.shift_std))}

    def bind(self, state: FunctionSpace, X: HilbertSpace, parameter: FunctionSpace) -> Observed:
        kind = Observed if self.position_std is None else PlacedObserved
        return kind(self, state, X, parameter)

    @property
    def places(self) -> Array:
        return self.positions

    @property
    def directs(self) -> Mapping[str, Direct]:
        return self.direct

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        mapping = isinstance(self.points, Mapping)
        what = f"sensors {list(self.points)}: number" if mapping else "sensor"
        return self.rows(state, self.positions, range(len(self.points)), what)

    def rows(
        self, state: FunctionSpace, at: Array, which: Sequence[int], what: str = "sensor"
    ) -> sp.csr_array:
        """Return the matrix of readings of given sensors at given positions, (k, n).

        `at`: coordinates, (k, d). `which`: index of the sensor at each position. `what`: name of a
        position in messages.
        """
        block, _ = state.component(self.of)
        values = block.probe(at.T, what)
        if block.vector:
            # Rows of the first component at all positions, then rows of the second, and so on.
            axes = self._components(values.shape[0] // len(at))[list(which)]
            values = values[axes * len(at) + np.arange(len(at))]
        elif self.component is not None:
            raise ObservationError(
                f"Points: component = {self.component!r} requires a state that is a vector at each "
                "point: leave it out."
            )
        return state.widen(sp.csr_array(values), self.of)

    def _components(self, count: int) -> IntArray:
        """Return the index of the component that each sensor measures, below `count`."""
        if self.component is None:
            raise ObservationError(
                f"Points: the state is a vector of {count} components at each point: name the "
                "measured one, as component = 0, or one for each sensor."
            )
        numbers: IntArray = np.broadcast_to(np.asarray(self.component), (len(self.points),))
        if (numbers >= count).any():
            raise ObservationError(
                f"Points: there is no component {numbers.max()}: the state has {count} at each "
                "point, counted from 0."
            )
        return numbers


@dataclass(frozen=True, eq=False)
class _Shift:
    """Effect of shifting one sensor along one coordinate by d: a cubic spline.

    The spline interpolates u at the shifts `places`, which extend to `REACH` standard deviations or
    to the end of the mesh on each side, and is linear beyond. If the mesh extends to neither side,
    as at the top of a disc, the shift has no effect. Derivatives of u are not used, because they do
    not exist at nodes of linear elements. `rows`, (places, n), evaluate differences of u to its
    value at d = 0. `column` is the index of the shift in q.
    """

    sensor: int
    column: int
    places: Array
    rows: sp.csr_array

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline  # slow to import and rarely needed

        return CubicSpline(self.places, np.eye(len(self.places)))

    def weights(self, d: float) -> Array:
        """Return the interpolation weights of all differences at a shift d."""
        if len(self.places) < 2:
            return np.zeros(len(self.places))
        clipped = min(max(d, self.places[0]), self.places[-1])
        return np.asarray(self._spline(clipped) + (d - clipped) * self._spline(clipped, 1))

    def slopes(self, d: float) -> Array:
        """Return the derivatives of `weights`."""
        if len(self.places) < 2:
            return np.zeros(len(self.places))
        return np.asarray(self._spline(min(max(d, self.places[0]), self.places[-1]), 1))


class PlacedObserved(Observed):
    """Bound `Points` at uncertain positions: linear in u, and a spline in each shift."""

    observation: Points
    linear = False

    def _prepare(self) -> None:
        points, at, std = self.observation, self.observation.positions, self.observation.shift_std
        block, _ = self.state.component(points.of)
        names, labels = points.names(len(at)), self.parameter.labels

        def differences(sensor: int, axis: int, shifts: Array) -> sp.csr_array:
            shifted = np.repeat(at[[sensor]], len(shifts), axis=0)
            shifted[:, axis] += shifts
            points_tested = np.concatenate([at[[sensor]], shifted])
            values = points.rows(self.state, points_tested, [sensor] * len(points_tested))
            return sp.csr_array(values[1:] - values[np.zeros(len(shifts), dtype=int)])

        self.shifts = []
        for name in points.uncertain:
            sensor = names.index(name)
            for axis, shift in enumerate(shift_names(name, at.shape[1])):
                label = f"{POSITION}[{shift}]"
                if label not in labels:
                    raise ObservationError(
                        f"the model has no unknown '{label}' for the position of sensor '{name}': "
                        "an Identifier adds it for assimilated sensors; elsewhere take "
                        "model.with_unknowns(observation.unknowns)."
                    )
                start, reach = at[sensor], REACH * std
                low, high = (_last_inside(block, start, axis, step) for step in (-reach, reach))
                # Between nodes of linear elements, u has no curvature to resolve.
                step = min(std, max(float(block.widths(start)[axis]), std / PER_STD))
                places = _spaced(low[axis] - start[axis], high[axis] - start[axis], step)
                rows = differences(sensor, axis, places)
                self.shifts.append(_Shift(sensor, labels[label], places, rows))

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        z = super().predict(u, q, moment)
        weights = [shift.weights(float(q[shift.column])) for shift in self.shifts]
        np.add.at(z, self._sensors, np.concatenate(weights) * (self._differences @ u))
        return z

    def jacobian(self, u: Array, q: Array, moment: Moment) -> tuple[sp.csr_array, Array | None]:
        direct = self._direct(moment)
        H_q = np.zeros((self.size, self.parameter.dim)) if direct is None else direct.copy()
        weights = []
        for shift in self.shifts:
            d = float(q[shift.column])
            H_q[shift.sensor, shift.column] += float(shift.slopes(d) @ (shift.rows @ u))
            weights.append(shift.weights(d))
        return self._placed(np.concatenate(weights)), H_q

    def _placed(self, weights: Array) -> sp.csr_array:
        """Return G at the shifted positions, for weights of all differences, shape (sensors, n)."""
        pattern, parts = self._parts
        values = parts[0] + weights @ parts[1:]
        return sp.csr_array((values, pattern.indices, pattern.indptr), shape=pattern.shape)

    @cached_property
    def _sensors(self) -> IntArray:
        """Index of the sensor for each row of `_differences`."""
        counts = [len(shift.places) for shift in self.shifts]
        return np.repeat([shift.sensor for shift in self.shifts], counts)

    @cached_property
    def _differences(self) -> sp.csr_array:
        """Rows of all shifts, stacked: shape (all places, n)."""
        return sp.csr_array(sp.vstack([shift.rows for shift in self.shifts], format="csr"))

    @cached_property
    def _parts(self) -> tuple[sp.csr_array, Array]:
        """Pattern of G at shifted positions, and values of G and of each difference on it."""
        rows = self._sensors
        sums = sp.csr_array(
            (np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(self.size, len(rows))
        )
        pattern = sp.csr_array(abs(self.G) + sums @ abs(self._differences))
        pattern.sort_indices()
        row = np.repeat(np.arange(self.size), np.diff(pattern.indptr))
        values = [np.asarray(self.G[row, pattern.indices])]
        for k, sensor in enumerate(rows):
            difference = np.asarray(self._differences[np.full_like(row, k), pattern.indices])
            values.append(np.where(row == sensor, difference, 0.0))
        return pattern, np.array(values)


def _spaced(low: float, high: float, step: float) -> Array:
    """Return numbers from low to high, including 0, at distances of at most a step."""
    ends = (np.linspace(0.0, end, 1 + math.ceil(abs(end) / step - NEAR)) for end in (low, high))
    return np.unique(np.concatenate([*ends, [0.0]]))


def _last_inside(block: FieldBlock, start: Array, axis: int, step: float) -> Array:
    """Return start + step along an axis, or the last point before it inside the mesh."""
    inside, outside = 0.0, 1.0  # if the share is below `NEAR`, the start is at the end of the mesh

    def at(share: float) -> Array:
        point: Array = start.copy()
        point[axis] += share * step
        return point

    if block.contains(at(outside)):
        return at(outside)
    while outside - inside > NEAR:
        centre = 0.5 * (inside + outside)
        inside, outside = (centre, outside) if block.contains(at(centre)) else (inside, centre)
    return at(inside) if inside > 0.0 else start


@dataclass(frozen=True, eq=False)
class Averages(Observation):
    """Mean values over regions or boundaries, z_k = (integral of u over omega_k) / |omega_k|.

    Integrals use the volume element of the state, see `Field.weight`.

    Parameters
    ----------
    regions
        Mapping from sensor name to the name of a subdomain or boundary of the mesh, or to a
        predicate on x. Cells that its border crosses are divided, so it need not align with cells.

    Examples
    --------
    >>> sensors = Averages({"core": lambda x: x[0] < 0.1, "wall": "right"}, noise=0.1)
    """

    regions: Mapping[str, Predicate | str]
    portable = True
    listed = ("regions", "region")

    def __post_init__(self) -> None:
        regions: Any = self.regions
        if not isinstance(regions, Mapping):
            raise ObservationError(
                "Averages: expected a mapping, sensor name -> predicate on x or name of a boundary "
                f"or subdomain, as in Averages({{'core': lambda x: x[0] < 0.1}}); got {regions!r}."
            )
        super().__post_init__()
        for name, region in regions.items():
            if not (isinstance(name, str) and (isinstance(region, str) or callable(region))):
                raise ObservationError(
                    f"Averages: {name!r}: {region!r} is not a region; expected the name of a "
                    "sensor and a predicate on x, or a boundary or subdomain of the mesh."
                )

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        block = self.scalar_block(state)
        rows = [self._row(block, name, region) for name, region in self.regions.items()]
        return state.widen(sp.csr_array(np.array(rows)), self.of)

    @staticmethod
    def _row(block: FieldBlock, name: str, region: Predicate | str) -> Array:
        mesh, weight = block.field.mesh, block.field.weight
        boundary = region if isinstance(region, str) else None
        names = [*(mesh.boundaries or {}), *(mesh.subdomains or {})]
        if boundary is not None and boundary not in names:
            raise ObservationError(
                f"Averages: region '{name}' is '{boundary}'; the mesh names {names or 'nothing'}."
            )
        order = max(2 * int(block.field.element.maxdeg), block.field.order)
        measure = Measure(mesh, order, boundary, weight=weight)
        if isinstance(region, str):
            size, row = _integral(block, measure, lambda x, _: 1.0)
            if size == 0.0:  # a boundary on the axis
                size, row = _integral(block, Measure(mesh, order, boundary), lambda x, _: 1.0)
        else:
            size, row = _integral_inside(block, measure, region)
        if size <= 0:
            raise ObservationError(f"Averages: region '{name}' contains no part of the mesh.")
        return row / size


def _integral_inside(block: FieldBlock, measure: Measure, region: Predicate) -> tuple[float, Array]:
    """Return the size of a region and integrals over it; cells at its border are divided."""
    mesh, cut = block.field.mesh, crossed(measure, region)
    size, row = _integral(block, measure, lambda x, cells: region(x) * ~np.isin(cells, cut))
    # Without quadrature points in the region and crossed cells, search finer parts of all cells.
    divided = cut if size > 0 or len(cut) else np.arange(mesh.nelements)
    if len(divided):
        fine = FineMeasure(mesh, measure.order, members=divided, weight=measure.weight)
        size_inside, row_inside = _integral(block, fine, lambda x, _: region(x))
        size, row = size + size_inside, row + row_inside
    return size, row


def _integral(
    block: FieldBlock, measure: Measure, density: Callable[[Array, IntArray], Any]
) -> tuple[float, Array]:
    """Return the integrals of a density and of its product with each shape function, (size,).

    The density is a function of points and of the indices of their cells, shape (cells, 1).
    """
    size, row = 0.0, np.zeros(block.size)
    for part, piece in measure.pieces():
        cells = np.arange(part.start, part.stop) if piece.cells is None else piece.cells
        weights = density(piece.points, cells[:, None]) * piece.weights
        size += float(weights.sum())
        local = block.local(piece)
        np.add.at(row, local.dofs, (local.part("value")[0] * weights).sum(axis=-1))
    return size, row


@dataclass(frozen=True, eq=False)
class LineIntegrals(Observation):
    """Integrals along straight lines, z_k = integral of u from a_k to b_k: beams, fibres.

    Exact up to rounding for finite element functions: the line is split at cell boundaries, with
    Gauss quadrature in between.

    Parameters
    ----------
    lines
        Mapping from sensor name to (start, end): numbers in 1D, otherwise sequences of d
        coordinates.
    mean
        Whether to divide by the length.

    Examples
    --------
    >>> beams = LineIntegrals({"beam": ([0.0, 0.2], [1.0, 0.7])}, mean=True, noise=0.01)
    """

    lines: Mapping[str, tuple[Any, Any]]
    mean: bool = False
    portable = True
    listed = ("lines", "line")

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        block = self.scalar_block(state)
        rows = sp.vstack([self._row(block, name, *ends) for name, ends in self.lines.items()])
        return state.widen(sp.csr_array(rows), self.of)

    def _row(self, block: FieldBlock, name: str, start: Any, end: Any) -> sp.csr_array:
        a, b = (np.atleast_1d(np.asarray(point, dtype=float)) for point in (start, end))
        mesh = block.field.mesh
        if a.shape != b.shape or len(a) != mesh.dim():
            raise ObservationError(
                f"LineIntegrals: line '{name}' goes from {a.tolist()} to {b.tolist()}; the mesh "
                f"has {mesh.dim()} coordinates."
            )
        length = float(np.linalg.norm(b - a))
        if not length > 0:
            raise ObservationError(f"LineIntegrals: line '{name}' has no length.")
        # This number of Gauss points is exact for polynomials of the degree of the element.
        nodes, weights = np.polynomial.legendre.leggauss(int(block.field.element.maxdeg) // 2 + 1)
        cuts = _cuts(mesh, a, b)
        width = np.diff(cuts)[:, None]
        s = (cuts[:-1, None] + 0.5 * width * (1.0 + nodes)).ravel()
        w = (0.5 * width * weights).ravel() * (1.0 if self.mean else length)
        values = block.probe(a[:, None] + (b - a)[:, None] * s, f"line '{name}': point")
        return sp.csr_array(sp.csr_array(w[None, :]) @ values)


def _cuts(mesh: Any, a: Array, b: Array) -> Array:
    """Return the intersections of a line with facets, as increasing fractions of its length.

    Only bounding boxes of facets are tested, since additional cuts are harmless.
    """
    corners = mesh.p[:, mesh.facets].transpose(2, 0, 1)  # (facets, d, vertices)
    d = len(a)
    if d == 1:
        normals = np.ones((len(corners), 1))
    elif d == 2:
        side = corners[:, :, 1] - corners[:, :, 0]
        normals = np.column_stack([-side[:, 1], side[:, 0]])
    else:
        first = corners[:, :, 1] - corners[:, :, 0]
        normals = np.cross(first, corners[:, :, 2] - corners[:, :, 0])
    slope = normals @ (b - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.einsum("fd,fd->f", normals, corners[:, :, 0] - a) / slope
    s, corners = s[np.isfinite(s)], corners[np.isfinite(s)]
    points = a + s[:, None] * (b - a)
    # Rounding must not remove the cut of a line along a facet or through a vertex.
    tolerance = 1e-9 * (mesh.p.max() - mesh.p.min())
    low, high = corners.min(axis=2) - tolerance, corners.max(axis=2) + tolerance
    cuts = s[np.all((points >= low) & (points <= high), axis=1) & (s > 0) & (s < 1)]
    return np.unique(np.concatenate([[0.0], cuts, [1.0]]))


@dataclass(frozen=True, eq=False)
class Matrix(Observation):
    """Linear observation with a dense or sparse matrix G, (sensors, n), and labels of its rows."""

    G: Any
    labels: Sequence[str] | None = None

    def __post_init__(self) -> None:
        self._refuse_component("G uses all components.")

    def names(self, count: int) -> tuple[str, ...]:
        if self.labels is None:
            return super().names(count)
        if len(self.labels) != count:
            raise ObservationError(f"Matrix: {len(self.labels)} labels for {count} rows.")
        return tuple(self.labels)

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        stored: Any = self.G if sp.issparse(self.G) else np.atleast_2d(self.G)
        matrix = sp.csr_array(stored)
        if matrix.shape[1] != state.seen:
            raise ObservationError(
                f"Matrix: G has {matrix.shape[1]} columns; the state has {state.seen} coefficients."
            )
        return sp.csr_array(
            (matrix.data, matrix.indices, matrix.indptr), (matrix.shape[0], state.dim)
        )
