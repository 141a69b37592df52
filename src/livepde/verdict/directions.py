"""Dictionary of causes of misfit: sensor errors, and terms that are missing in the model.

A term such as a source, a loss or a boundary value changes the state by the free response p, with
M p' + (B + A q)' p = load. It is computed by implicit Euler steps that span several samples, and
its effect on the sensors is interpolated in between. To distinguish causes, 10 % accuracy suffices,
so that a response costs a fraction of a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import Inputs, Moment, On, lengths
from livepde.fem.measure import unweighted
from livepde.linalg import Array, IntArray, row_product
from livepde.model import Model, mass_form
from livepde.observation import CombinedObserved, Observed, Points
from livepde.stepping import ForwardStage
from livepde.verdict.ledger import WINDOWS

FIXED = "the fixed boundary"  # boundary values that are constants of the model

# Effects of causes of unit amplitude, and limits.
REACH = 64.0  # samples in which a unit source changes the state by ...
DEVIATIONS = 3.0  # ... this multiple of the noise
SCALED = 0.1  # relative error of a channel of a source or flux
LOSS = 0.1  # share of the state that is lost in `REACH` samples
MOST_STRIDE = 16  # samples that one step spans at most
MOST_ENDS = 4  # boundaries of the mesh that are tested
OFFSET = 3.0  # standard deviations of the noise, as an offset or ...
DRIFT = 64.0  # ... as a drift within this number of samples
GAIN = 0.1  # share of the change of a prediction since the start
LAG = 3.0  # samples
SHIFT = 0.02  # displacement of a sensor over the local length of the domain, from `lengths`
AVERAGED = 0.04  # length over which a sensor, such as a long probe, averages, over the domain's
LONGEST_AVERAGE = 0.2  # largest plausible such length, over the domain's
POINTS = 8  # quadrature points of the average
JUMP = 0.3  # prior standard deviations of an unknown
MOST_JUMPS = 8  # coordinates of the unknowns that are tested for jumps
MOST_SUMS = 12_000  # numbers in each kind of sum


class Now(NamedTuple):
    """Linearisation point of a response: state, latent parameter, time, inputs, load arguments."""

    u: Array
    q: Array
    moment: Moment
    unit: float = 1.0  # usual time between samples
    rest: float = 0.0  # equilibrium state without loss: the mean of the sensors at the start
    rates: Mapping[str, float] = MappingProxyType({})  # changes of inputs per unit of time


Load: TypeAlias = Callable[[Now], Array]


class Term(NamedTuple):
    """A term of unit amplitude that may be missing or wrong in a model."""

    # "boundary", "source", "loss", "flux", "transfer" (an exchange at a boundary), "channel" (its
    # gain), or "initial" state
    kind: str
    subject: str = ""  # boundary or channel; empty for the whole domain
    # load, lift: function that returns the load, and boundary values of the response, (n,); None
    # for zero
    load: Load | None = None
    lift: Array | None = None


class Process:
    """Responses of a single-component model to terms that may be missing in it.

    `model`, `observed`: the process and its sensors.
    `level`: standard deviation of the noise, the unit of the amplitudes.
    """

    def __init__(self, model: Model, observed: Observed, level: float) -> None:
        self.model = model
        self.observed = observed
        self.level = DEVIATIONS * level
        self.stage = ForwardStage(model)
        self.terms: list[Term] = []
        if not self.refused(model):
            lifts = boundary_lifts(model).items()
            self.terms += [Term("boundary", name, lift=self.level * lift) for name, lift in lifts]
            self.terms += [*self._domain(), *self._fluxes()]
            # Add a gain for each channel of the model that is not a boundary value.
            taken = {term.subject for term in self.terms}
            others = [name for name in model.channels if name not in taken]
            self.terms += [Term("channel", name, load=_gain(model, name)) for name in others]
        zero = np.zeros(model.X.dim)
        self._lifts = np.array([zero if term.lift is None else term.lift for term in self.terms])

    @staticmethod
    def refused(model: Model) -> str:
        """Return why responses of a model are not available; empty if they are."""
        if not model.state_space.single or len(model.algebraic):
            return "the state has several components"
        block = next(iter(model.state_space.fields.values()))
        return "the state is a vector" if block.vector else ""

    @cached_property
    def _whole(self) -> Array:
        """Load of a unit source in the whole domain."""
        return np.asarray(self.model.mass @ self.model.state_space.interpolate(1.0))

    def _domain(self) -> Iterator[Term]:
        mass = self.model.mass

        def loss(now: Now) -> Array:
            return -LOSS / (REACH * now.unit) * (mass @ (now.u - now.rest))

        yield Term("source", load=_constant(self._whole, self.level))
        yield Term("loss", load=loss)
        yield Term("initial")

    def _fluxes(self) -> Iterator[Term]:
        """Iterate over a flux and an exchange at each boundary without a Dirichlet value."""
        # `MOST_ENDS` limits their number, because each requires a solve in every step.
        for name, load in flux_loads(self.model, MOST_ENDS).items():
            # The total flux equals the total of the unit source in the domain.
            shape = load * (self._whole.sum() / load.sum())
            yield Term("flux", name, load=_constant(shape, self.level))
            yield Term("transfer", name, load=_exchanged(shape))

    def start(self) -> Array:
        """Return the responses at the start, (terms, n): lifts, and another initial state."""
        p: Array = self._lifts.copy()
        p[[term.kind == "initial" for term in self.terms]] = self.level * self.model.X.free
        return p

    def advance(self, p: Array, now: Now, h: float) -> Array:
        """Return the responses after a step of length h, shape (terms, n)."""
        loads = np.zeros_like(p)
        for k, term in enumerate(self.terms):
            if term.load is not None:
                loads[k] = term.load(now)
        return later(self.stage, p, now, h, loads, self._lifts)

    def readings(self, p: Array, now: Now) -> Array:
        """Return the readings of the responses, shape (terms, sensors)."""
        physical = self.model.latent.value(now.q)
        H, _ = self.observed.jacobian(now.u, physical, now.moment)
        return np.asarray((H @ p.T).T)


def later(stage: ForwardStage, p: Array, now: Now, h: float, loads: Array, lifts: Array) -> Array:
    """Return responses p of a process after a step h; p, loads and lifts: (responses, n).

    The step solves M (p+ - p)/h + S_u p+ = load with p+ = lift on the boundary. Responses that are
    zero without load or lift are not solved for. Loads act on fields, not on states of sensors.
    """
    loads = loads * stage.model.state_space.of_fields
    lifted = lifts.any(axis=1)
    nonzero = p.any(axis=1) | loads.any(axis=1) | lifted
    if not nonzero.any():
        return np.zeros_like(p)
    if not nonzero.all():
        responses = np.zeros_like(p)
        responses[nonzero] = later(stage, p[nonzero], now, h, loads[nonzero], lifts[nonzero])
        return responses
    free = stage.model.X.free
    factor, rows = stage.linearised(now.u, now.q, h, now.moment)
    right_side = (stage.model.mass @ p.T).T / h + loads
    if lifted.any():
        right_side[lifted] -= np.asarray((rows @ lifts[lifted].T).T)
    right_side *= free
    solved: Array = factor.solve(right_side.T).T
    solved *= free
    solved[lifted] += lifts[lifted]
    return solved


def _constant(shape: Array, level: float) -> Load:
    """Return a constant load, scaled to the usual interval between samples."""
    return lambda now: level / (REACH * now.unit) * shape


def _exchanged(shape: Array) -> Load:
    """Return the load of a linear exchange with surroundings at the equilibrium state."""
    return lambda now: -LOSS / (REACH * now.unit) * shape * (now.u - now.rest)


def _gain(model: Model, name: str) -> Load:
    """Return the change of the force if a channel is larger by the share `SCALED`."""
    return lambda now: scaled_channel(model, name, now, SCALED)


def boundary_lifts(model: Model) -> dict[str, Array]:
    """Return channel -> derivative of the boundary values by it, (n,), if it is not zero.

    Boundary values that depend on no channel form the additional entry `FIXED`, a unit change.
    """
    # Boundary values are affine in the inputs, so the difference of two states is a lift.
    zero, inputs = np.zeros(model.X.dim), dict.fromkeys(model.channels, 0.0)
    base, fixed = model.impose(zero, Moment(0.0, Inputs(inputs))), model.X.free == 0.0
    lifts = {}
    for name in model.channels:
        raised = Moment(0.0, Inputs({**inputs, name: 1.0}))
        lift = model.impose(zero, raised) - base
        if lift.any():
            fixed &= lift == 0.0
            lifts[name] = lift
    return lifts | ({FIXED: fixed.astype(float)} if fixed.any() else {})


def flux_loads(model: Model, most: int | None = None) -> dict[str, Array]:
    """Return loads, (n,), of a unit flux through the first `most` boundaries, if they are free."""
    unit, loads = model.state_space.interpolate(1.0), {}
    for name in [str(boundary) for boundary in model.mesh.boundaries or {}][:most]:
        load = model.bilinear(On(name, mass_form)) @ unit
        if load.sum() > 0.0 and not load[model.X.free == 0.0].any():
            loads[name] = load
    return loads


def force(model: Model, now: Now) -> Array:
    """Return F - B(u) - A(u) q, (n,)."""
    u, moment = now.u, now.moment
    driven = model.physical_A.vector("v", moment, q=model.latent.value(now.q), u=u)
    return model.F(moment) - model.B(u, moment) - driven


def scaled_channel(model: Model, name: str, now: Now, share: float) -> Array:
    """Return the change of the force if a channel is larger by a share of its value, (n,)."""
    inputs = now.moment.inputs
    scaled = Moment(now.moment.t, Inputs({**inputs, name: (1.0 + share) * inputs[name]}))
    return force(model, now._replace(moment=scaled)) - force(model, now)


def stride(seen: int) -> int:
    """Return how many samples a step spans: few at the start of the run."""
    return min(max(seen // 8, 1), MOST_STRIDE)


@dataclass(frozen=True)
class ScoreDirection:
    """A possible cause of unit amplitude."""

    # "offset", "drift", "gain", "lag", "position", "averaging", "jump", or the kind of a `Term`
    kind: str
    subject: str = ""  # name of the sensor, channel, boundary or unknown
    size: float = np.nan  # unit amplitude in the unit below; NaN if it depends on the run
    unit: str = ""  # unit of the size
    axis: int = 0  # coordinate of a position
    # least, most: bounds of the amplitude in its unit: a displaced sensor remains in the domain and
    # does not pass its neighbour
    least: float = -np.inf
    most: float = np.inf
    at: float = np.nan  # coordinate of the sensor along the axis; NaN if not needed


# Unit amplitudes of sensor errors whose effect does not depend on the sample, in noise units
CONSTANT = {"offset": OFFSET, "drift": OFFSET / DRIFT}


class Dictionary:
    """All directions of a model and its sensors.

    Errors of single sensors come first, then jumps of unknowns, then missing terms of the process.

    `noise`: standard deviation of the noise of each sensor.
    `unknowns`: label and index of each coordinate that may jump.
    `dearer`: whether to include missing terms, which require linear solves.
    """

    def __init__(
        self,
        model: Model,
        observed: Observed,
        noise: Array,
        unknowns: list[tuple[str, int]],
        *,
        dearer: bool,
    ) -> None:
        self.left_out: list[str] = []
        self.process = Process(model, observed, float(np.median(noise))) if dearer else None
        if not dearer:
            self.left_out.append("missing sources, losses, boundary values (verdict = 'cheap')")
        elif refused := Process.refused(model):
            self.left_out.append(f"missing sources, losses, boundary values: {refused}")
        terms = self.process.terms if self.process else []
        jumps = unknowns[:MOST_JUMPS]
        self.directions: list[ScoreDirection] = []
        self.parts: dict[str, slice] = {}
        # Sums are stored for each direction, window and sensor.
        capacity = MOST_SUMS // (len(WINDOWS) * observed.size) - len(jumps) - len(terms)
        self._add_sensors(model, observed, noise, capacity)
        self.jumps = [index for _, index in jumps]
        self._add("jump", [ScoreDirection("jump", label, JUMP) for label, _ in jumps])
        self._add("process", [ScoreDirection(term.kind, term.subject) for term in terms])
        # Effects of offsets and drifts, in units of the noise, do not depend on the sample.
        self._constant = np.zeros((observed.size, len(self)))
        for kind in CONSTANT.keys() & self.parts:  # with many sensors, kinds are left out
            self._constant[:, self.parts[kind]] = CONSTANT[kind] * np.eye(observed.size)

    @cached_property
    def _varying(self) -> IntArray:
        """Indices of the sensor errors whose effect depends on the sample."""
        places = [self._places(kind) for kind in self.kinds if kind not in CONSTANT]
        return np.concatenate([*places, np.zeros(0, dtype=np.int64)])

    def _amplitudes(
        self, model: Model, observed: Observed, noise: Array, room: int, shifts: int, step: Array
    ) -> dict[str, tuple[Array, Sequence[str], int]]:
        """Return kind of sensor error -> (amplitude of each sensor, units, number of axes).

        If there are more than `room` directions, the last kinds are left out first.
        """
        sensors, units = observed.size, observed.units
        none = ("",) * sensors
        amplitudes: dict[str, tuple[Array, Sequence[str], int]] = {
            "offset": (OFFSET * noise, units, 1),
            "lag": (np.full(sensors, np.nan), none, 1),
            "position": (step, (model.length_unit,) * sensors, shifts),
            "gain": (np.full(sensors, GAIN), none, 1),
            "drift": (OFFSET * noise, units, 1),
            "averaging": (AVERAGED / SHIFT * step, (model.length_unit,) * sensors, 1),
        }
        if not shifts:
            del amplitudes["position"]
        if not (shifts and averages_on_line(model)):
            del amplitudes["averaging"]
        while amplitudes and sensors * sum(axes for *_, axes in amplitudes.values()) > room:
            kind, _ = amplitudes.popitem()
            self.left_out.append(f"{kind} of single sensors: there are {sensors}")
        return amplitudes

    def _add_sensors(self, model: Model, observed: Observed, noise: Array, room: int) -> None:
        """Append as many kinds of errors of single sensors as there is room for."""
        shifts, step = sensor_shifts(model, observed)
        amplitudes = self._amplitudes(model, observed, noise, room, len(shifts), step)
        self.kinds = tuple(amplitudes)
        for kind, (size, units, axes) in amplitudes.items():
            directions = [
                ScoreDirection(kind, name, amplitude, unit, axis)
                for axis in range(axes)
                for name, amplitude, unit in zip(observed.names, size.tolist(), units, strict=True)
            ]
            if kind == "position":
                directions = _bounded_positions(model, observed, directions)
            elif kind == "averaging":
                directions = _inside(model, observed, directions)
            self._add(kind, directions)
        self.own: IntArray = np.arange(len(self.directions)) % observed.size  # sensors
        # Axes along which sensors may be displaced, and one more for averaging.
        matrices = shifts if "position" in amplitudes else []
        self.shifted = observed.size * len(matrices)
        if "averaging" in amplitudes:
            matrices = [*matrices, sensor_averages(model, observed)]
        self.axes = len(matrices)
        if self.axes:
            # Restrict the matrices of all axes to the coefficients of the state that they use.
            rows = sp.csc_array(sp.vstack(matrices))
            self._used = np.flatnonzero(np.diff(rows.indptr))
            self._moved = row_product(sp.csr_array(rows[:, self._used]))

    def moved(self, u: Array) -> Array:
        """Return changes of readings due to shifts and averages, (members, axes * sensors)."""
        return self._moved(u.take(self._used, axis=1))

    def _add(self, part: str, directions: list[ScoreDirection]) -> None:
        """Append directions and record their indices."""
        start = len(self.directions)
        self.directions += directions
        self.parts[part] = slice(start, len(self.directions))

    def _places(self, part: str) -> IntArray:
        return np.arange(len(self))[self.parts[part]]

    def __len__(self) -> int:
        return len(self.directions)

    def plausible(self, gain: float, reach: float) -> Array:
        """Return the largest plausible amplitude of each direction, (directions,).

        `gain`: largest relative error of the scale of a sensor. `reach`: largest displacement, over
        the length of the domain. A jump is at most one prior standard deviation.
        """
        bounds = np.full(len(self), np.inf)
        largest = {"gain": gain / GAIN, "position": reach / SHIFT, "jump": 1.0 / JUMP}
        largest["averaging"] = (LONGEST_AVERAGE / AVERAGED) ** 2
        for kind, bound in largest.items():
            bounds[self.parts.get(kind, slice(0, 0))] = bound
        return bounds

    def effects(
        self, noise: Array, change: Array, late: Array, moved: Array, responses: Array
    ) -> Array:
        """Return the effect of each direction on the readings, in units of their noise.

        Shape (members, samples, sensors, directions). A drift is represented by its slope.

        `noise`: standard deviations, (members, samples, sensors).
        `change`: predictions minus the first predictions, (members, samples, sensors).
        `late`: predictions one sample earlier minus predictions, (members, samples, sensors).
        `moved`: changes due to shifts and averages, (members, samples, axes * sensors).
        `answers`: readings of responses to missing terms, (members, samples, terms, sensors).
        """
        effects = np.empty((*noise.shape, len(self)))
        effects[...] = self._constant
        by_kind = {"lag": LAG * late, "gain": GAIN * change}
        by_kind |= {"position": moved[..., : self.shifted], "averaging": moved[..., self.shifted :]}
        if self._varying.size:
            own = self.own[self._varying]  # each affects the readings of one sensor
            signals = [by_kind[kind] for kind in self.kinds if kind in by_kind]
            scaled = np.concatenate(signals, axis=2) / noise[:, :, own]
            effects[:, :, own, self._varying] = scaled
        effects[..., self.parts["process"]] = responses.swapaxes(-1, -2) / noise[..., None]
        return effects


def _bounded_positions(
    model: Model, observed: Observed, directions: list[ScoreDirection]
) -> list[ScoreDirection]:
    """Return position directions, bounded by the domain and by the nearest other sensor."""
    at = stated_positions(observed)
    if at is None:
        return directions
    vertices = np.asarray(model.mesh.p)
    low, high = vertices.min(axis=1), vertices.max(axis=1)
    distances = np.linalg.norm(at[:, None] - at[None], axis=2)
    distances[distances == 0.0] = np.inf  # the sensor itself, and sensors at the same position
    reach = np.fmin.reduce(distances, axis=1, initial=np.inf)
    bounded = []
    for index, direction in enumerate(directions):
        sensor, k = index % len(at), direction.axis
        if np.isnan(at[sensor, k]):
            bounded.append(direction)
            continue
        lower = max(float(low[k] - at[sensor, k]), -float(reach[sensor]))
        upper = min(float(high[k] - at[sensor, k]), float(reach[sensor]))
        bounded.append(replace(direction, least=lower, most=upper, at=float(at[sensor, k])))
    return bounded


def _inside(model: Model, observed: Observed, items: list[ScoreDirection]) -> list[ScoreDirection]:
    """Return the averaging directions on an interval, bounded by its ends."""
    at, (vertices,) = stated_positions(observed), np.asarray(model.mesh.p)
    if at is None:
        return items
    low, high = float(vertices.min()), float(vertices.max())
    longest = np.minimum(2.0 * np.minimum(at - low, high - at), LONGEST_AVERAGE * (high - low))
    bounds = zip(items, at[:, 0].tolist(), longest[:, 0].tolist(), strict=True)
    return [replace(direction, least=0.0, most=bound, at=x) for direction, x, bound in bounds]


def _leaves(observed: Observed) -> list[Observed]:
    """Return the elementary parts of an observation, in the order of its sensors."""
    if isinstance(observed, CombinedObserved):
        return [leaf for part in observed.parts for leaf in _leaves(part)]
    return [observed]


def _known_points(observed: Observed) -> Points | None:
    """Return an observation as points if its positions are known and not estimated, else None.

    If all its sensors depend directly on the parameter, they do not measure the state at a point.
    An example is the fluid temperature of a borehole.
    """
    observation = observed.observation
    if not isinstance(observation, Points) or observation.position_std is not None:
        return None
    return None if set(observed.names) <= set(observation.direct) else observation


def stated_positions(observed: Observed) -> Array | None:
    """Return the configured positions, (sensors, d), NaN if unknown; None if all are unknown."""
    leaves = [(leaf.size, _known_points(leaf)) for leaf in _leaves(observed)]
    known = [points.positions for _, points in leaves if points is not None]
    if not known:
        return None
    none = np.full(known[0].shape[1], np.nan)
    parts = [np.tile(none, (n, 1)) if points is None else points.positions for n, points in leaves]
    return np.concatenate(parts)


def _rows_at(observed: Observed, at: Array) -> sp.csr_array:
    """Return the matrix of values at displaced positions; zero for sensors without a position."""
    rows, first = [], 0
    for leaf in _leaves(observed):
        points, own = _known_points(leaf), at[first : first + leaf.size]
        zero = sp.csr_array((leaf.size, observed.state.dim))
        rows.append(zero if points is None else points.rows(observed.state, own, range(leaf.size)))
        first += leaf.size
    return sp.csr_array(sp.vstack(rows))


def usual_shifts(model: Model, at: Array) -> Array:
    """Return typical position errors, (sensors,), of sensors at positions (sensors, d)."""
    widths = [lengths(model.mesh, axis, column) for axis, column in enumerate(at.T)]
    return np.asarray(SHIFT * np.max(widths, axis=0))


def sensor_shifts(model: Model, observed: Observed) -> tuple[list[sp.csr_array], Array]:
    """Return the change of readings per axis if sensors are displaced, and the displacement.

    Displacements have shape (sensors,). There are no axes if no sensor has a known position.
    """
    at = stated_positions(observed)
    if at is None:
        return [], np.full(observed.size, np.nan)
    vertices = np.asarray(model.mesh.p)
    low, high = vertices.min(axis=1), vertices.max(axis=1)
    step = usual_shifts(model, at)
    changes = []
    for axis in range(at.shape[1]):
        ends, width = [], np.zeros(len(at))
        # Central differences, one-sided at the edge of the bounding box, where `width` is smaller.
        for sign in (-1.0, 1.0):
            moved = at.copy()
            moved[:, axis] = np.clip(moved[:, axis] + sign * step, low[axis], high[axis])
            try:
                ends.append(_rows_at(observed, moved))
            except ObservationError:  # inside the bounding box, but outside the mesh
                moved = at.copy()
                ends.append(_rows_at(observed, moved))
            width += sign * moved[:, axis]
        scale = sp.diags_array(step / np.where(width > 0.0, width, np.inf))
        changes.append(sp.csr_array(scale @ (ends[1] - ends[0])))
    return changes, step


def averages_on_line(model: Model) -> bool:
    """Return whether averaging of sensors along the mesh is tested: only on an interval.

    In more dimensions its direction is unknown, and along a radius, wells do not average.
    """
    return model.mesh.dim() == 1 and model.state_space.weight is unweighted


def sensor_averages(model: Model, observed: Observed) -> sp.csr_array:
    """Return the change of readings if sensors average over `AVERAGED` of an interval, (k, n).

    It is proportional to the square of the length, and zero for sensors without a position.
    """
    at = stated_positions(observed)
    if at is None:
        return sp.csr_array((observed.size, observed.state.dim))
    (vertices,) = np.asarray(model.mesh.p)
    low, high = float(vertices.min()), float(vertices.max())
    offsets = AVERAGED * (high - low) * ((np.arange(POINTS) + 0.5) / POINTS - 0.5)
    # Near an end of the interval, the average covers a shorter length.
    distance = np.minimum(at - low, high - at)
    rows = [_rows_at(observed, at + np.clip(x, -distance, distance)) for x in offsets.tolist()]
    return sp.csr_array(sum(rows[1:], rows[0]) / POINTS - _rows_at(observed, at))
