"""Responses of the process to model errors, along the stored samples.

The errors have amplitude one: sources, losses, flows, variable conductivities, boundary values, and
changes of unknowns. Their responses p follow by one implicit Euler step between two samples,

    M (p' - p)/h + (B + A q)' p' = load(u),

which is accurate enough for errors of unknown place and size.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import scipy

from livepde.fem import Inputs, Moment, dot, grad, shares
from livepde.laws.filter_state import PAUSE
from livepde.laws.stored_samples import Passed, StoredSamples
from livepde.linalg import Array
from livepde.model import Model
from livepde.stepping import ForwardStage
from livepde.verdict.directions import (
    Load,
    Now,
    boundary_lifts,
    flux_loads,
    force,
    later,
    scaled_channel,
)

MOST_WORK = 1e8  # maximum number of coefficients of responses in a pass
MOST_STEPS = 500  # maximum number of Euler steps; more change intervals by less than 2 %
MOST_BORDERS = 7  # maximum number of borders of layers
MOST_UNKNOWNS = 4  # maximum number of unknowns that may jump or drift
STARTS = (0.25, 0.5, 0.75)  # switching times, as fractions of the run
PLACES = (0.2, 0.4, 0.6, 0.8)  # places of a contact resistance, as fractions of the length
STEP = 0.01  # difference step: in prior standard deviations, or relative to a channel
NARROW = 0.03  # least width of a contact, as a fraction of the length
COMPARED = 4  # number of moments at which loads are compared
ALIKE = 1e-3  # relative difference below which two loads are equal
ROUNDING = 1e-11  # size of an effect, relative to its terms, below which it counts as zero


class ErrorShape(NamedTuple):
    """Spatial shape of an error of the process; its columns differ in their course in time."""

    # "source", "switched", "conductivity", "state", "layer", "border" (of layers, at `subject`; its
    # column is no single cause), "contact", "flow", "steady flow",
    # "loss", "boundary", "late boundary", "channel", "flux", "transfer", "initial" or "unknown"
    kind: str
    subject: str = ""  # channel, boundary, component, axis or unknown
    mode: float = 0.0  # number of the shape in space
    # Load, boundary values and initial value, shape (n,); None: zero.
    load: Load | Array | None = None
    lift: Load | Array | None = None
    start: Array | None = None


class Course(NamedTuple):
    """Courses in time of a response: number of columns, and values at a fraction of the run."""

    size: int
    at: Callable[[float], Array]
    constant: Array | None = None  # amplitudes whose sum is constant in time; None: ones

    def varying(self, columns: Array) -> Array:
        """Return columns, (..., columns), orthogonal to the constant course."""
        one = np.ones(self.size) if self.constant is None else self.constant
        rest: Array = columns - (columns @ one)[..., None] * one / (one @ one)
        return rest


def hats(count: int) -> Course:
    """Return hat functions in time over the run."""
    nodes = np.arange(count) / (count - 1)
    return Course(count, lambda s: np.maximum(1.0 - np.abs(s - nodes) * (count - 1), 0.0))


ALWAYS = Course(1, lambda s: np.ones(1))
SWITCHED = Course(
    1 + len(STARTS),
    lambda s: np.array([1.0, *(float(s > one) for one in STARTS)]),
    constant=np.array([1.0, *(0.0 for _ in STARTS)]),
)
CHANGES = Course(1 + len(STARTS), lambda s: np.array([s, *(float(s > one) for one in STARTS)]))


class _Numbers(NamedTuple):
    """Numbers of shapes in space and time for each family, and of noise functions in time."""

    source: tuple[int, int]
    conductivity: tuple[int, int]
    flow: tuple[int, int]
    noise: int


FULL = _Numbers((6, 17), (5, 9), (3, 9), 17)
SMALL = _Numbers((4, 9), (3, 3), (2, 3), 9)


class ErrorColumns:
    """Possible errors of a model, as columns of responses in the readings."""

    def __init__(self, samples: StoredSamples, numbers: _Numbers) -> None:
        self.samples, self.numbers = samples, numbers
        problem = samples.filter.problem
        self.model, self.observed = problem.model, problem.observed
        self.span = np.ptp(self.model.mesh.p, axis=1)
        self.shapes: list[tuple[ErrorShape, Course]] = [*self._sources(), *self._initial()]
        self.shapes += [*self._boundaries(), *self._unknowns()]
        single = self.model.state_space.single and not len(self.model.algebraic)
        if single and not next(iter(self.model.state_space.fields.values())).vector:
            self.shapes += [*self._operators(), *self._fluxes()]
        # Number of the first column of each response, and number of all columns.
        sizes = (course.size for _, course in self.shapes)
        *self.first, self.count = itertools.accumulate(sizes, initial=0)

    @cached_property
    def _powers(self) -> list[tuple[float, tuple[int, ...]]]:
        """Mode numbers and half waves along each axis, in order of decreasing wavelength.

        Modes of equal wavelength share their mean number, which is independent of the axis order.
        """
        span, most = self.span, max(max(one) for one in self.numbers[:3])
        waves = [
            (round(float(np.sum((np.array(one) * span.max() / span) ** 2)), 9), one)
            for one in itertools.product(range(most + 1), repeat=len(span))
        ]
        waves.sort(key=lambda wave: (wave[0], [-part for part in wave[1]]))
        modes: list[tuple[float, tuple[int, ...]]] = []
        for _, group in itertools.groupby(waves, key=lambda wave: wave[0]):
            same = [powers for _, powers in group]
            modes += [(len(modes) + 0.5 * (len(same) - 1), powers) for powers in same]
        return modes

    def _mode(self, number: int) -> Callable[[Any], Any]:
        """Return a mode, a product of cosines over the bounding box of the domain."""
        mesh, (_, powers) = self.model.mesh, self._powers[number]

        def shape(x: Any) -> Any:
            values: Any = 1.0
            for axis, power in enumerate(powers):
                if power:
                    values = values * np.cos(power * np.pi * shares(mesh, axis, x[axis]))
            return values

        return shape

    def _sources(self) -> Iterator[tuple[ErrorShape, Course]]:
        """Iterate over sources: the modes of a family, and uniform sources that switch on."""
        model, (modes, times) = self.model, self.numbers.source
        for name, block in model.state_space.fields.items():
            if block.vector:
                continue
            for k in range(modes):
                u = model.state_space.interpolate({name: self._mode(k)})
                load = np.asarray(model.mass @ (u - model.state_space.prior))
                yield ErrorShape("source", name, self._powers[k][0], load), hats(times)
                if k == 0:
                    yield ErrorShape("switched", name, load=load), SWITCHED

    def _initial(self) -> Iterator[tuple[ErrorShape, Course]]:
        free = self.model.X.free
        for name, block in self.model.state_space.fields.items():
            if block.vector:
                continue
            for k in range(2):
                u = self.model.state_space.interpolate({name: self._mode(k)})
                yield ErrorShape("initial", name, start=u * free), ALWAYS

    def _boundaries(self) -> Iterator[tuple[ErrorShape, Course]]:
        model, lifts = self.model, boundary_lifts(self.model)
        for name, lift in lifts.items():
            yield ErrorShape("boundary", name, lift=lift), ALWAYS
            if name in model.channels:
                yield ErrorShape("late boundary", name, lift=_late(lift, name)), ALWAYS
        for name in model.channels:
            if name not in lifts:
                yield ErrorShape("channel", name, load=_scaled(model, name)), ALWAYS

    def _fluxes(self) -> Iterator[tuple[ErrorShape, Course]]:
        for name, load in flux_loads(self.model).items():
            yield ErrorShape("flux", name, load=load), ALWAYS
            yield ErrorShape("transfer", name, load=_exchanged(load, self._rest)), ALWAYS

    def _unknowns(self) -> Iterator[tuple[ErrorShape, Course]]:
        reduction = self.samples.filter.reduction
        for label, place in reduction.stay[:MOST_UNKNOWNS]:
            load = _changed(self.model, reduction.Phi[:, place])
            yield ErrorShape("unknown", label, load=load), CHANGES

    def _operators(self) -> Iterator[tuple[ErrorShape, Course]]:
        """Iterate over flows, losses, contacts, and conductivities that vary in space or state."""
        model, (modes, times) = self.model, self.numbers.conductivity
        # A contact resists conduction, not advection. Equations that are linear but not symmetric
        # may have advection: they get no contacts.
        stage = ForwardStage(model)
        places = PLACES if stage.symmetric or not stage.keeps else ()

        def stiffness(shape: Callable[[Any], Any]) -> Any:
            return model.bilinear(lambda u, v, x: shape(x) * dot(grad(u), grad(v)))

        for k in range(1, 1 + modes):
            load = _minus(stiffness(self._mode(k)))
            yield ErrorShape("conductivity", "", self._powers[k][0], load), hats(times)
        plain = stiffness(self._mode(0))
        yield ErrorShape("state", load=_by_state(plain)), ALWAYS
        for axis, span in enumerate(self.span):
            halves = stiffness(self._halves(axis))
            yield ErrorShape("layer", "xyz"[axis], load=_minus(halves)), ALWAYS
            in_line = len(self.span) == 1
            cell = 1.0 / model.mesh.nelements if in_line else float(model.mesh.param()) / span
            for place in places:
                matrix = stiffness(self._band(axis, place, max(NARROW, 1.5 * cell)))
                yield ErrorShape("contact", "xyz"[axis], load=_minus(matrix)), ALWAYS
        if self.conductivity:
            for border in self.borders:
                matrix = stiffness(partial(_sides, border))
                yield ErrorShape("border", f"{border:.4g}", load=_minus(matrix)), ALWAYS
        modes, times = self.numbers.flow
        axes = len(self.span)
        for k in range(axes * math.ceil(modes / axes)):  # equally many along each axis
            axis, number = k % axes, k // axes
            load = _minus(self._flow(axis, self._mode(number)))
            yield ErrorShape("flow", "", axes * self._powers[number][0], load), hats(times)
            if number == 0:
                yield ErrorShape("steady flow", "xyz"[axis], load=load), ALWAYS
        yield ErrorShape("loss", load=_lost(model.mass, self._rest)), SWITCHED

    @cached_property
    def borders(self) -> list[float]:
        """Possible borders of layers: the middles between sensors on an interval."""
        if len(self.span) > 1:
            return []
        places = np.unique([at[0] for at in self.observed.places.values()])
        middles: list[float] = (0.5 * (places[1:] + places[:-1])).tolist()
        return middles if len(middles) <= MOST_BORDERS else []

    @cached_property
    def conductivity(self) -> str:
        """Label of the constant unknown that is a uniform conductivity; empty if there is none."""
        model, reduction = self.model, self.samples.filter.reduction
        free = model.X.free * model.state_space.of_fields
        u = np.random.default_rng(0).standard_normal(model.X.dim)
        moment = Moment(0.0, Inputs(dict.fromkeys(model.channels, 1.0)))
        now = Now(u, self.samples.start.q[0], moment)
        plain = free * (model.bilinear(lambda u, v, x: dot(grad(u), grad(v))) @ u)
        for label, place in reduction.stay[:MOST_UNKNOWNS]:
            own = free * _changed(model, reduction.Phi[:, place])(now)
            rest = own - plain * (own @ plain) / (plain @ plain)
            if own.any() and np.linalg.norm(rest) <= ALIKE * np.linalg.norm(own):
                return label
        return ""

    @cached_property
    def _rest(self) -> float:
        """Ambient value of losses: the mean initial state."""
        amount = np.asarray(self.model.mass @ self.model.state_space.interpolate(1.0))
        return float(amount @ self.samples.start.u[0] / amount.sum())

    def _flow(self, axis: int, shape: Callable[[Any], Any]) -> Any:
        return self.model.bilinear(lambda u, v, x: shape(x) * grad(u)[axis] * v)

    def _halves(self, axis: int) -> Callable[[Any], Any]:
        """Return a shape of two layers, -0.5 and 0.5 on the two halves along an axis."""
        mesh = self.model.mesh
        return lambda x: np.where(shares(mesh, axis, x[axis]) > 0.5, 0.5, -0.5)

    def _band(self, axis: int, place: float, wide: float) -> Callable[[Any], Any]:
        mesh = self.model.mesh
        return lambda x: np.maximum(1.0 - np.abs(shares(mesh, axis, x[axis]) - place) / wide, 0.0)

    def followed(self, one: Passed) -> tuple[Array, list[Array], Array]:
        """Return readings of all responses, states at samples, and predicted readings.

        Shapes (samples, sensors, columns), (n,) for each sample, and (samples, sensors).
        """
        samples, model = self.samples, self.model
        stage, spans = ForwardStage(model), samples.spans
        steps = max(len(spans), 1)
        work = steps * self.count * model.X.dim
        stride = max(math.ceil(work / MOST_WORK), math.ceil(steps / MOST_STEPS))
        begin, first, end = (float(t) for t in (spans[0].start, spans[0].t1, spans[-1].t1))
        # Courses in time begin with the samples, the first of which may be long after t0.
        late = max(begin, first - PAUSE * (end - first) / steps)
        p = self._initial_values()
        readings = np.full((len(spans), self.observed.size, self.count), np.nan)
        largest = np.abs(p).max(axis=1)
        states: list[Array] = []
        predicted = np.empty(readings.shape[:2])
        last, nows = begin, list[Now]()
        for number, (x, span) in enumerate(zip(samples.along(one), spans, strict=True)):
            states.append(x.u[0])
            predicted[number] = samples.filter.sensors.observe(x, span.end)[0][0]
            t, q = float(span.t1), x.q[0]
            due = (number + 1) % stride == 0 or number + 1 == len(spans) or number == 0
            if due:
                moment = span.end.member(0)
                now = Now(x.u[0], q, moment, rates=_rates(span))
                nows.append(now)
                if t > last:
                    share = max(0.5 * (t + last) - late, 0.0) / (end - late)
                    p = self._advanced(stage, p, now, t - last, share)
                    largest = np.maximum(largest, np.abs(p).max(axis=1))
                    last = t
                H, _ = self.observed.jacobian(now.u, model.latent.value(q), moment)
                readings[number] = np.asarray(H @ p.T)
        times = np.array([float(span.t1) for span in spans])
        # By symmetry some responses vanish at all sensors.
        readings = _filled(readings, times)
        for column, most in enumerate(largest):
            readings[:, :, column] = beyond_rounding(readings[:, :, column], most)
        return self._without_unknowns(readings, nows), states, predicted

    def _initial_values(self) -> Array:
        """Return the initial responses, shape (columns, n)."""
        p = np.zeros((self.count, self.model.X.dim))
        for column, (shape, _) in zip(self.first, self.shapes, strict=True):
            if shape.start is not None:
                p[column] = shape.start
        return p

    def _without_unknowns(self, readings: Array, nows: Sequence[Now]) -> Array:
        """Return readings of responses without effects of unknowns, which are not model errors."""
        compared = np.linspace(0, len(nows) - 1, min(COMPARED, len(nows))).astype(int)
        for number in self._of_unknowns([nows[k] for k in compared]):
            first, (_, course) = self.first[number], self.shapes[number]
            own = slice(first, first + course.size)
            readings[:, :, own] = course.varying(readings[:, :, own])
        return readings

    def _of_unknowns(self, nows: Sequence[Now]) -> list[int]:
        """Return the responses whose loads equal those of constant unknowns at these moments.

        Such an error cannot be distinguished from a wrong value of the unknown: for example, a
        steady flow if the velocity is unknown.
        """
        reduction = self.samples.filter.reduction
        free = self.model.X.free * self.model.state_space.of_fields

        def at_all(load: Load | Array) -> Array:
            each = (load(now) if callable(load) else load for now in nows)
            return np.concatenate([one * free for one in each])

        changes = [at_all(_changed(self.model, one)) for one in reduction.Phi.T[reduction.still]]
        sizes = np.linalg.norm(changes, axis=1) if changes else np.zeros(0)
        if not sizes.any():
            return []
        known = np.array(changes)[sizes > 0.0] / sizes[sizes > 0.0, None]
        basis, numbers = scipy.linalg.orth(known.T), list[int]()
        for number, (shape, _) in enumerate(self.shapes):
            if shape.load is None or shape.kind == "unknown":
                continue
            own = at_all(shape.load)
            size = float(np.linalg.norm(own))
            rest = float(np.linalg.norm(own - basis @ (basis.T @ own)))
            if size > 0.0 and rest <= ALIKE * size:
                numbers.append(number)
        return numbers

    def _advanced(self, stage: ForwardStage, p: Array, now: Now, h: float, share: float) -> Array:
        """Return the responses after a time h, shape (columns, n); `share`: fraction of the run."""
        loads, lifts = np.zeros_like(p), np.zeros_like(p)
        for first, (shape, course) in zip(self.first, self.shapes, strict=True):
            own, weights = slice(first, first + course.size), course.at(share)[:, None]
            if shape.load is not None:
                load = shape.load(now) if callable(shape.load) else shape.load
                loads[own] = weights * load
            if shape.lift is not None:
                lift = shape.lift(now) if callable(shape.lift) else shape.lift
                lifts[own] = weights * lift
        return later(stage, p, now, h, loads, lifts)


def _sides(border: float, x: Any) -> Array:
    """Return a shape of two layers, -0.5 and 0.5 on the two sides of a border."""
    return np.where(x[0] > border, 0.5, -0.5)


def beyond_rounding(values: Array, terms: Array) -> Array:
    """Return values, or zeros if all values are rounding errors of their terms.

    The average over errors scales each column to the size of the noise. A column of rounding, such
    as a flow along which the state is constant, would count as an error.
    """
    largest, of = (float(np.fmax.reduce(np.abs(one), axis=None)) for one in (values, terms))
    return np.zeros_like(values) if math.isfinite(of) and largest <= ROUNDING * of else values


def _minus(matrix: Any) -> Load:
    size = abs(matrix)
    return lambda now: beyond_rounding(-(matrix @ now.u), size @ np.abs(now.u))


def _by_state(stiffness: Any) -> Load:
    """Return the load of a conductivity that is linear in the state about its mean."""
    bent = _minus(0.5 * stiffness)
    return lambda now: bent(now._replace(u=(now.u - now.u.mean()) ** 2))


def _lost(mass: Any, rest: float) -> Load:
    size = abs(mass)
    return lambda now: beyond_rounding(-(mass @ (now.u - rest)), size @ np.abs(now.u))


def _exchanged(shape: Array, rest: float) -> Load:
    return lambda now: beyond_rounding(-shape * (now.u - rest), shape * np.abs(now.u))


def _late(lift: Array, name: str) -> Load:
    return lambda now: -now.rates.get(name, 0.0) * lift


def _scaled(model: Model, name: str) -> Load:
    """Return the derivative of the load in a relative change of a channel."""

    def load(now: Now) -> Array:
        change = scaled_channel(model, name, now, STEP) / STEP
        return beyond_rounding(change, force(model, now) / STEP)

    return load


def _changed(model: Model, direction: Array) -> Load:
    """Return the derivative of the load along a direction of the latent unknowns."""

    def load(now: Now) -> Array:
        driven = model.form_A.product("v", "q", direction, now.moment, q=now.q, u=now.u)
        return beyond_rounding(-driven, force(model, now) / STEP)

    return load


def _rates(span: Any) -> dict[str, float]:
    """Return the rate of change of each input over an interval."""
    h = float(span.t1 - span.start)
    if not h > 0.0:
        return {}
    change = np.broadcast_to((span.inputs1 - span.inputs0) / h, (1, len(span.channels)))[0]
    return dict(zip(span.channels, change.tolist(), strict=True))


def _filled(values: Array, times: Array) -> Array:
    """Return values with NaN replaced by linear interpolation along axis 0."""
    known = np.isfinite(values[:, 0, 0]) if values.size else np.ones(len(values), dtype=bool)
    if known.all():
        return values
    flat = values.reshape(len(values), -1)
    places = np.interp(times, times[known], np.arange(known.sum()))
    low = np.floor(places).astype(int)
    high = np.minimum(low + 1, known.sum() - 1)
    share = (places - low)[:, None]
    rows = flat[known]
    filled: Array = (1.0 - share) * rows[low] + share * rows[high]
    return filled.reshape(values.shape)
