"""Dictionary of causes of misfit: errors of sensors and of the process that the model lacks.

The free response p of the state to a term that the model lacks (a source, a loss, a boundary
value), M p' + (B + A q)' p = load, is computed by implicit Euler steps over several samples, and
its effect on the sensors is interpolated between these steps. The response is needed to a tenth of
its size, to distinguish causes, and so costs a fraction of a step.
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

FIXED = "the fixed boundary"  # constants of the model, which may be wrong as well

REACH = 64.0  # samples in which a source of amplitude one moves the state by three times the noise
DEVIATIONS = 3.0
SCALED = 0.1  # of a channel of a source or flux
LOSS = 0.1  # in `REACH` samples
MOST_STRIDE = 16  # samples of one step
MOST_ENDS = 4  # boundaries of the mesh that are looked at
OFFSET = 3.0  # standard deviations of the noise: a direction of amplitude one, for ...
DRIFT = 64.0  # ... a drift in so many samples
GAIN = 0.1  # of the change of a sensor since the start
LAG = 3.0  # samples
SHIFT = 0.02  # of the length of the domain, as the cells near a sensor measure it
AVERAGED = 0.04  # of the length of the domain: a sensor that averages over it, as a long probe
LONGEST_AVERAGE = 0.2  # of the length of the domain, over which a sensor may average
POINTS = 8  # of the average
JUMP = 0.3  # prior standard deviations of an unknown
MOST_JUMPS = 8  # coordinates of unknowns that may jump
MOST_SUMS = 12_000  # numbers in one kind of sum


class Now(NamedTuple):
    """Point of a response: state, latent parameter, time, inputs, and the arguments of a load."""

    u: Array
    q: Array
    moment: Moment
    unit: float = 1.0  # usual time between samples
    rest: float = 0.0  # state that has nothing to lose: the mean of the sensors at the start
    rates: Mapping[str, float] = MappingProxyType({})  # changes of inputs per unit of time


Load: TypeAlias = Callable[[Now], Array]


class Term(NamedTuple):
    """A term that a model may lack or have wrong, with an amplitude of one."""

    # "boundary", "source", "loss", "flux", "transfer" (an exchange at a boundary), "channel" (its
    # gain), or "initial" state
    kind: str
    subject: str = ""  # boundary or channel; empty for the whole domain
    # load, lift: function that returns its load, and boundary values of its response, (n,); None
    # for zero
    load: Load | None = None
    lift: Array | None = None


class Process:
    """Responses of a model of one component to the terms that it may lack.

    `model`, `observed`, `level`: the process, its sensors, and their noise, by which amplitudes are
    counted.
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
            # A gain of each channel that drives the model other than as a boundary value.
            taken = {term.subject for term in self.terms}
            others = [name for name in model.channels if name not in taken]
            self.terms += [Term("channel", name, load=_gain(model, name)) for name in others]
        zero = np.zeros(model.X.dim)
        self._lifts = np.array([zero if term.lift is None else term.lift for term in self.terms])

    @staticmethod
    def refused(model: Model) -> str:
        """Return why a model has no such terms; empty if it has."""
        if not model.state_space.single or len(model.algebraic):
            return "the state has several components"
        block = next(iter(model.state_space.fields.values()))
        return "the state is a vector" if block.vector else ""

    @cached_property
    def _whole(self) -> Array:
        """Load of a source of one in the whole domain."""
        return np.asarray(self.model.mass @ self.model.state_space.interpolate(1.0))

    def _domain(self) -> Iterator[Term]:
        mass = self.model.mass

        def loss(now: Now) -> Array:
            return -LOSS / (REACH * now.unit) * (mass @ (now.u - now.rest))

        yield Term("source", load=_constant(self._whole, self.level))
        yield Term("loss", load=loss)
        yield Term("initial")

    def _fluxes(self) -> Iterator[Term]:
        """Iterate over a flux and an exchange at each boundary where the model states no value."""
        # Each costs a solve with every answer of the process.
        for name, load in flux_loads(self.model, MOST_ENDS).items():
            # As much as the source of amplitude one brings into the whole domain.
            shape = load * (self._whole.sum() / load.sum())
            yield Term("flux", name, load=_constant(shape, self.level))
            yield Term("transfer", name, load=_exchanged(shape))

    def start(self) -> Array:
        """Return the responses at the start, (terms, n): that to another initial state."""
        p: Array = self._lifts.copy()
        p[[term.kind == "initial" for term in self.terms]] = self.level * self.model.X.free
        return p

    def advance(self, p: Array, now: Now, h: float) -> Array:
        """Return the responses a time h later, shape (terms, n)."""
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
    """Return responses p of a process a time h later; p, loads and lifts: (responses, n).

    M (p+ - p)/h + S_u p+ = load, with p+ = lift on the boundary. A response that has not begun
    stays zero, and takes no solve. Loads act on the fields, not on the states of sensors.
    """
    loads = loads * stage.model.state_space.of_fields
    lifted = lifts.any(axis=1)
    begun = p.any(axis=1) | loads.any(axis=1) | lifted
    if not begun.any():
        return np.zeros_like(p)
    if not begun.all():
        found = np.zeros_like(p)
        found[begun] = later(stage, p[begun], now, h, loads[begun], lifts[begun])
        return found
    free = stage.model.X.free
    factor, rows = stage.linearised(now.u, now.q, h, now.moment)
    known = (stage.model.mass @ p.T).T / h + loads
    if lifted.any():
        known[lifted] -= np.asarray((rows @ lifts[lifted].T).T)
    known *= free
    solved: Array = factor.solve(known.T).T
    solved *= free
    solved[lifted] += lifts[lifted]
    return solved


def _constant(shape: Array, level: float) -> Load:
    """Return a load that is constant but for the usual interval between samples."""
    return lambda now: level / (REACH * now.unit) * shape


def _exchanged(shape: Array) -> Load:
    """Return the load of an exchange with surroundings where the state is at rest."""
    return lambda now: -LOSS / (REACH * now.unit) * shape * (now.u - now.rest)


def _gain(model: Model, name: str) -> Load:
    """Return the load of a channel that is larger by `SCALED` than the model takes it for."""
    return lambda now: scaled_channel(model, name, now, SCALED)


def boundary_lifts(model: Model) -> dict[str, Array]:
    """Return channel -> change of the boundary values by a unit of it, (n,), if it drives any.

    Boundary values that no channel moves are one more, of size one.
    """
    # Boundary values are affine in the inputs: the difference of two states is a lift.
    zero, known = np.zeros(model.X.dim), dict.fromkeys(model.channels, 0.0)
    rest, fixed = model.impose(zero, Moment(0.0, Inputs(known))), model.X.free == 0.0
    found = {}
    for name in model.channels:
        moved = Moment(0.0, Inputs({**known, name: 1.0}))
        lift = model.impose(zero, moved) - rest
        if lift.any():
            fixed &= lift == 0.0
            found[name] = lift
    return found | ({FIXED: fixed.astype(float)} if fixed.any() else {})


def flux_loads(model: Model, most: int | None = None) -> dict[str, Array]:
    """Return loads of a flux of one, (n,), through those of `most` boundaries without a value."""
    ones, found = model.state_space.interpolate(1.0), {}
    for name in [str(one) for one in model.mesh.boundaries or {}][:most]:
        load = model.bilinear(On(name, mass_form)) @ ones
        if load.sum() > 0.0 and not load[model.X.free == 0.0].any():
            found[name] = load
    return found


def force(model: Model, now: Now) -> Array:
    """Return F - B(u) - A(u) q, (n,)."""
    u, moment = now.u, now.moment
    driven = model.physical_A.vector("v", moment, q=model.latent.value(now.q), u=u)
    return model.F(moment) - model.B(u, moment) - driven


def scaled_channel(model: Model, name: str, now: Now, share: float) -> Array:
    """Return the change of the force with a channel that is larger by a share of it, (n,)."""
    inputs = now.moment.inputs
    more = Moment(now.moment.t, Inputs({**inputs, name: (1.0 + share) * inputs[name]}))
    return force(model, now._replace(moment=more)) - force(model, now)


def stride(seen: int) -> int:
    """Return over how many samples a step goes: short ones while the process is young."""
    return min(max(seen // 8, 1), MOST_STRIDE)


@dataclass(frozen=True)
class ScoreDirection:
    """A possible cause with an amplitude of one."""

    # "offset", "drift", "gain", "lag", "position", "averaging", "jump", or that of a `Term`
    kind: str
    subject: str = ""  # name of the sensor, channel, boundary or unknown
    size: float = np.nan  # the amplitude in its unit; NaN where that is not known beforehand
    unit: str = ""  # of the size
    axis: int = 0  # coordinate of a position
    # least, most: bounds of the amount in its unit: a sensor is inside the body, and not beyond the
    # next one
    least: float = -np.inf
    most: float = np.inf
    at: float = np.nan  # coordinate of the sensor along the axis; NaN if it does not matter


# Amplitudes of errors of sensors that are the same at each sample, in units of the noise
CONSTANT = {"offset": OFFSET, "drift": OFFSET / DRIFT}


class Dictionary:
    """All directions of a model and its sensors.

    Those of the sensors come first, each seen by its own sensor only; then jumps of unknowns, and
    missing terms of the process.

    `noise`: standard deviation of each sensor.
    `unknowns`: labels of the coordinates that may jump, each with its place.
    `dearer`: with the directions that cost solves: terms that the process may lack.
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
        # Every direction is a row and a column of sums of products, kept for each window.
        room = MOST_SUMS // (len(WINDOWS) * observed.size) - len(jumps) - len(terms)
        self._add_sensors(model, observed, noise, room)
        self.jumps = [place for _, place in jumps]
        self._add("jump", [ScoreDirection("jump", label, JUMP) for label, _ in jumps])
        self._add("process", [ScoreDirection(term.kind, term.subject) for term in terms])
        # Offsets and drifts, in units of the noise, are the same at each sample.
        self._constant = np.zeros((observed.size, len(self)))
        for kind in CONSTANT.keys() & self.parts:  # many sensors leave out kinds
            self._constant[:, self.parts[kind]] = CONSTANT[kind] * np.eye(observed.size)

    @cached_property
    def _changing(self) -> IntArray:
        """Places of the directions of sensors whose signals change from sample to sample."""
        places = [self._places(kind) for kind in self.kinds if kind not in CONSTANT]
        return np.concatenate([*places, np.zeros(0, dtype=np.int64)])

    def _amplitudes(
        self, model: Model, observed: Observed, noise: Array, room: int, shifts: int, step: Array
    ) -> dict[str, tuple[Array, Sequence[str], int]]:
        """Return the amplitudes of the kinds of errors of sensors that there is room for.

        Those of each sensor, their units, and along how many axes there is one. Where room is short
        the last kinds are left out first.
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
        """Append the directions of single sensors, as many kinds as there is room for."""
        shifts, step = sensor_shifts(model, observed)
        amplitudes = self._amplitudes(model, observed, noise, room, len(shifts), step)
        self.kinds = tuple(amplitudes)
        for kind, (size, of, axes) in amplitudes.items():
            found = [
                ScoreDirection(kind, name, one, unit, axis)
                for axis in range(axes)
                for name, one, unit in zip(observed.names, size.tolist(), of, strict=True)
            ]
            if kind == "position":
                found = _within_reach(model, observed, found)
            elif kind == "averaging":
                found = _inside(model, observed, found)
            self._add(kind, found)
        self.own: IntArray = np.arange(len(self.directions)) % observed.size  # sensors
        # Axes along which sensors may be off, and one more on which they may average.
        places = shifts if "position" in amplitudes else []
        self.shifted = observed.size * len(places)
        if "averaging" in amplitudes:
            places = [*places, sensor_averages(model, observed)]
        self.axes = len(places)
        if self.axes:
            # The coefficients of the state that matter, and the matrices of all axes on them.
            rows = sp.csc_array(sp.vstack(places))
            self._used = np.flatnonzero(np.diff(rows.indptr))
            self._moved = row_product(sp.csr_array(rows[:, self._used]))

    def moved(self, u: Array) -> Array:
        """Return changes of readings by shifts and averages, (members, axes * sensors)."""
        return self._moved(u.take(self._used, axis=1))

    def _add(self, part: str, directions: list[ScoreDirection]) -> None:
        """Append directions, and note their places."""
        start = len(self.directions)
        self.directions += directions
        self.parts[part] = slice(start, len(self.directions))

    def _places(self, part: str) -> IntArray:
        return np.arange(len(self))[self.parts[part]]

    def __len__(self) -> int:
        return len(self.directions)

    def plausible(self, gain: float, reach: float) -> Array:
        """Return the largest plausible amplitude of each direction, (directions,).

        `gain`: of the scale of a sensor. `reach`: of its place, over the length of the domain. A
        jump is at most a prior standard deviation.
        """
        found = np.full(len(self), np.inf)
        each = {"gain": gain / GAIN, "position": reach / SHIFT, "jump": 1.0 / JUMP}
        each["averaging"] = (LONGEST_AVERAGE / AVERAGED) ** 2
        for kind, most in each.items():
            found[self.parts.get(kind, slice(0, 0))] = most
        return found

    def effects(
        self, noise: Array, change: Array, late: Array, moved: Array, answers: Array
    ) -> Array:
        """Return the change of readings along each direction, in units of their noise.

        Shape (members, samples, sensors, directions). That of a drift is its slope.

        `noise`: shape (members, samples, sensors).
        `change`, `late`: predictions less the first ones, and predictions a sample earlier less
        those of now, (members, samples, sensors).
        `moved`: changes by shifts and averages, (members, samples, axes * sensors).
        `answers`: readings due to missing terms, (members, samples, terms, sensors).
        """
        found = np.empty((*noise.shape, len(self)))
        found[...] = self._constant
        each = {"lag": LAG * late, "gain": GAIN * change}
        each |= {"position": moved[..., : self.shifted], "averaging": moved[..., self.shifted :]}
        if self._changing.size:
            own = self.own[self._changing]  # each changes the readings of one sensor
            parts = [each[kind] for kind in self.kinds if kind in each]
            signals = np.concatenate(parts, axis=2) / noise[:, :, own]
            found[:, :, own, self._changing] = signals
        found[..., self.parts["process"]] = answers.swapaxes(-1, -2) / noise[..., None]
        return found


def _within_reach(
    model: Model, observed: Observed, found: list[ScoreDirection]
) -> list[ScoreDirection]:
    """Return the directions of positions, bounded by the body and by the nearest other sensor."""
    at = stated_positions(observed)
    if at is None:
        return found
    vertices = np.asarray(model.mesh.p)
    low, high = vertices.min(axis=1), vertices.max(axis=1)
    apart = np.linalg.norm(at[:, None] - at[None], axis=2)
    apart[apart == 0.0] = np.inf  # itself, and sensors at the same place
    reach = np.fmin.reduce(apart, axis=1, initial=np.inf)
    bounded = []
    for number, one in enumerate(found):
        sensor, k = number % len(at), one.axis
        if np.isnan(at[sensor, k]):
            bounded.append(one)
            continue
        least = max(float(low[k] - at[sensor, k]), -float(reach[sensor]))
        most = min(float(high[k] - at[sensor, k]), float(reach[sensor]))
        bounded.append(replace(one, least=least, most=most, at=float(at[sensor, k])))
    return bounded


def _inside(model: Model, observed: Observed, found: list[ScoreDirection]) -> list[ScoreDirection]:
    """Return the directions of averages on a line, bounded by its ends."""
    at, (vertices,) = stated_positions(observed), np.asarray(model.mesh.p)
    if at is None:
        return found
    low, high = float(vertices.min()), float(vertices.max())
    most = np.minimum(2.0 * np.minimum(at - low, high - at), LONGEST_AVERAGE * (high - low))
    each = zip(found, at[:, 0].tolist(), most[:, 0].tolist(), strict=True)
    return [replace(one, least=0.0, most=longest, at=x) for one, x, longest in each]


def _leaves(observed: Observed) -> list[Observed]:
    """Return the observations that an observation is made of, in the order of its sensors."""
    if isinstance(observed, CombinedObserved):
        return [leaf for part in observed.parts for leaf in _leaves(part)]
    return [observed]


def _stated(observed: Observed) -> Points | None:
    """Return the sensors of an observation if each has a position that is not estimated anyway.

    Sensors that all depend directly on the parameter read another quantity than the state at a
    place, such as the fluid of a borehole.
    """
    observation = observed.observation
    if not isinstance(observation, Points) or observation.position_std is not None:
        return None
    return None if set(observed.names) <= set(observation.direct) else observation


def stated_positions(observed: Observed) -> Array | None:
    """Return the stated positions of sensors, (sensors, d); NaN for those without; None if all."""
    leaves = [(leaf.size, _stated(leaf)) for leaf in _leaves(observed)]
    known = [points.positions for _, points in leaves if points is not None]
    if not known:
        return None
    none = np.full(known[0].shape[1], np.nan)
    parts = [np.tile(none, (n, 1)) if points is None else points.positions for n, points in leaves]
    return np.concatenate(parts)


def _rows_at(observed: Observed, at: Array) -> sp.csr_array:
    """Return the matrix of the values at other places; zero for sensors without a position."""
    rows, first = [], 0
    for leaf in _leaves(observed):
        points, own = _stated(leaf), at[first : first + leaf.size]
        none = sp.csr_array((leaf.size, observed.state.dim))
        rows.append(none if points is None else points.rows(observed.state, own, range(leaf.size)))
        first += leaf.size
    return sp.csr_array(sp.vstack(rows))


def usual_shifts(model: Model, at: Array) -> Array:
    """Return by how much sensors at places (sensors, d) may well be off, (sensors,)."""
    each = [lengths(model.mesh, axis, column) for axis, column in enumerate(at.T)]
    return np.asarray(SHIFT * np.max(each, axis=0))


def sensor_shifts(model: Model, observed: Observed) -> tuple[list[sp.csr_array], Array]:
    """Return how readings change if sensors are shifted along each axis, and by how much, (n,).

    No axes if no sensor has a position, or only uncertain ones that are estimated anyway; zero for
    single ones.
    """
    at = stated_positions(observed)
    if at is None:
        return [], np.full(observed.size, np.nan)
    vertices = np.asarray(model.mesh.p)
    low, high = vertices.min(axis=1), vertices.max(axis=1)
    step = usual_shifts(model, at)
    found = []
    for axis in range(at.shape[1]):
        ends, width = [], np.zeros(len(at))
        # Central differences; at the edge of the box they are one-sided, and `width` is shorter.
        for sign in (-1.0, 1.0):
            moved = at.copy()
            moved[:, axis] = np.clip(moved[:, axis] + sign * step, low[axis], high[axis])
            try:
                ends.append(_rows_at(observed, moved))
            except ObservationError:  # outside of a mesh that is no box
                moved = at.copy()
                ends.append(_rows_at(observed, moved))
            width += sign * moved[:, axis]
        scale = sp.diags_array(step / np.where(width > 0.0, width, np.inf))
        found.append(sp.csr_array(scale @ (ends[1] - ends[0])))
    return found, step


def averages_on_line(model: Model) -> bool:
    """Return whether a sensor may average along the mesh.

    Elsewhere nobody knows over which direction; along a radius none does, as wells do not.
    """
    return model.mesh.dim() == 1 and model.state_space.weight is unweighted


def sensor_averages(model: Model, observed: Observed) -> sp.csr_array:
    """Return how readings on a line change if sensors average over `AVERAGED` of it, (k, n).

    The change grows with the square of the length. Zero for sensors without a position.
    """
    at = stated_positions(observed)
    if at is None:
        return sp.csr_array((observed.size, observed.state.dim))
    (vertices,) = np.asarray(model.mesh.p)
    low, high = float(vertices.min()), float(vertices.max())
    off = AVERAGED * (high - low) * ((np.arange(POINTS) + 0.5) / POINTS - 0.5)
    # At an end the average is over a shorter length.
    half = np.minimum(at - low, high - at)
    rows = [_rows_at(observed, at + np.clip(x, -half, half)) for x in off.tolist()]
    return sp.csr_array(sum(rows[1:], rows[0]) / POINTS - _rows_at(observed, at))
