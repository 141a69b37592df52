"""Intervals of the unknowns that allow for errors of the model, from the stored samples.

What errors would do to the readings makes the columns of a linear model. Errors of the process are
sources, losses, flows, conductivities that vary, boundary values, and unknowns that change. Their
answers p of amplitude one go on by one implicit Euler step between two samples,

    M (p' - p)/h + (B + A q)' p' = load(u),

which is exact enough for an error of which neither place nor size is known. Errors of sensors are
added to them. Single causes have one column each, families many, with an amplitude for each shape
in space and course in time. See `livepde.verdict.evidence` for the average over them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from livepde.fem import Scalar, dot, grad
from livepde.laws.filter import Filter
from livepde.laws.filter_state import PAUSE, FilterState
from livepde.laws.policies import Refit
from livepde.laws.refit import plausible
from livepde.laws.stored_samples import Passed, StoredSamples, principal
from livepde.linalg import Array, IntArray, Mask, nonfinite_allowed
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
    sensor_shifts,
    stated_positions,
)
from livepde.verdict.evidence import (
    Causes,
    Family,
    LinearModel,
    averaged,
    averaged_causes,
    levels,
    weighted_median,
)
from livepde.verdict.model_errors import Allowed, ModelErrors

MOST_WORK = 1e8  # coefficients of answers that a pass may compute
MOST_STEPS = 500  # Euler steps of an answer; with more of them intervals move by less than 2 %
MOST_UNKNOWNS = 4  # that may jump or drift
STARTS = (0.25, 0.5, 0.75)  # of the run, where something is switched on or changes
PLACES = (0.2, 0.4, 0.6, 0.8)  # of the length, where a contact may resist
STEP = 0.01  # of a difference: prior standard deviations of an unknown, share of a channel
NARROW = 0.03  # of the length: a contact
ROUNDING = 1e-11  # share of its terms, below which an effect is none: it would be scaled to one
MANY = 150  # samples that tell apart what the full list has
MOST_COLUMNS = 250  # of the process in the full list
MOST_SENSORS = 12  # with slow noise of their own
CAUSE_SIZES = (1.0, 4.0, 16.0, 64.0, 256.0)  # standard deviations of the noise
FAMILY_SIZES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
JOINT_SIZES = (1.0, 10.0, 100.0)
JOINT = (("source", "conductivity"), ("source", "sensors"), ("source", "sensors", "conductivity"))
BESIDE_SIZES = (4.0, 64.0)  # of a family beside a single cause
BESIDE = (("source",), ("common",), ("sensors",))
TIMES = (1.0 / 30.0, 1.0 / 6.0, 2.0, math.inf)  # correlation times over the length of the run
MOST_GAIN = 0.3  # standard deviation of the scale of a sensor that is plausible
FARTHEST = 0.1  # the same of its place, over the length of the domain
FEWEST = 20  # readings
NEAR = 0.03  # posterior standard deviations within which a trajectory is that of the best fit
QUANTILE = 1.96  # standard deviations to the end of a 95 % interval
SHRINK = 10.0  # pairs of readings that the stated noise counts
OVERFLOW = "the answers of the process to errors overflow"
LEAST_LEVEL = 0.01  # least variance of the noise over the stated one that is believed


class Answer(NamedTuple):
    """A shape of error of the process, with columns that differ by their course in time."""

    # What it is: "source", "conductivity", "flow", "loss", "boundary", "late boundary", "flux",
    # "channel", "contact", "initial", "unknown"; and its channel, boundary or unknown.
    kind: str
    subject: str = ""
    mode: float = 0.0  # number of its shape in space
    # Its load, its boundary values, and its value at the start, (n,); None for zero.
    load: Load | Array | None = None
    lift: Load | Array | None = None
    start: Array | None = None


class Course(NamedTuple):
    """Courses in time of an answer: number of columns, and their values at a share of the run."""

    size: int
    at: Callable[[float], Array]


def hats(count: int) -> Course:
    """Return hat functions on the run."""
    nodes = np.arange(count) / (count - 1)
    return Course(count, lambda s: np.maximum(1.0 - np.abs(s - nodes) * (count - 1), 0.0))


ALWAYS = Course(1, lambda s: np.ones(1))
SWITCHED = Course(1 + len(STARTS), lambda s: np.array([1.0, *(float(s > one) for one in STARTS)]))
CHANGES = Course(1 + len(STARTS), lambda s: np.array([s, *(float(s > one) for one in STARTS)]))


class _Numbers(NamedTuple):
    """How many shapes in space and time the families have."""

    source: tuple[int, int]
    conductivity: tuple[int, int]
    flow: tuple[int, int]
    noise: int


FULL = _Numbers((6, 17), (5, 9), (3, 9), 17)
SMALL = _Numbers((4, 9), (3, 3), (2, 3), 9)


class ErrorColumns:
    """Errors that a model and its sensors can have."""

    def __init__(self, samples: StoredSamples, numbers: _Numbers) -> None:
        self.samples, self.numbers = samples, numbers
        problem = samples.filter.problem
        self.model, self.observed = problem.model, problem.observed
        vertices = np.asarray(self.model.mesh.p)
        self.low, self.high = vertices.min(axis=1), vertices.max(axis=1)
        self.answers: list[tuple[Answer, Course]] = [*self._sources(), *self._initial()]
        self.answers += [*self._boundaries(), *self._unknowns()]
        single = self.model.state_space.single and not len(self.model.algebraic)
        if single and not next(iter(self.model.state_space.fields.values())).vector:
            self.answers += [*self._operators(), *self._fluxes()]
        # Number of the first column of each answer, and of all columns of the process.
        sizes = (course.size for _, course in self.answers)
        *self.first, self.count = itertools.accumulate(sizes, initial=0)

    @cached_property
    def _powers(self) -> list[tuple[float, tuple[int, ...]]]:
        """Half waves along each axis of the shapes, the longest waves first, with their number.

        Waves of one length have one number, their mean: it depends on no order of the axes.
        """
        span, most = self.high - self.low, max(max(one) for one in self.numbers[:3])
        some = [
            (round(float(np.sum((np.array(one) * span.max() / span) ** 2)), 9), one)
            for one in itertools.product(range(most + 1), repeat=len(span))
        ]
        some.sort(key=lambda one: (one[0], [-part for part in one[1]]))
        found: list[tuple[float, tuple[int, ...]]] = []
        for _, group in itertools.groupby(some, key=lambda one: one[0]):
            same = [powers for _, powers in group]
            found += [(len(found) + 0.5 * (len(same) - 1), powers) for powers in same]
        return found

    def _mode(self, number: int) -> Callable[[Any], Any]:
        """Return a product of cosines over the box of the domain, the longest waves first."""
        low, span, (_, powers) = self.low, self.high - self.low, self._powers[number]

        def shape(x: Any) -> Any:
            found = 1.0
            for axis, power in enumerate(powers):
                found = found * np.cos(power * np.pi * (x[axis] - low[axis]) / span[axis])
            return found

        return shape

    def _sources(self) -> Iterator[tuple[Answer, Course]]:
        """Iterate over sources: of a family, and switched on at some time."""
        model, (modes, times) = self.model, self.numbers.source
        for name, block in model.state_space.fields.items():
            if block.vector:
                continue
            for k in range(modes):
                u = model.state_space.interpolate({name: self._mode(k)})
                load = np.asarray(model.mass @ (u - model.state_space.prior))
                yield Answer("source", name, self._powers[k][0], load), hats(times)
                if k == 0:
                    yield Answer("switched", name, load=load), SWITCHED

    def _initial(self) -> Iterator[tuple[Answer, Course]]:
        free = self.model.X.free
        for name, block in self.model.state_space.fields.items():
            if block.vector:
                continue
            for k in range(2):
                u = self.model.state_space.interpolate({name: self._mode(k)})
                yield Answer("initial", name, start=u * free), ALWAYS

    def _boundaries(self) -> Iterator[tuple[Answer, Course]]:
        model, lifts = self.model, boundary_lifts(self.model)
        for name, lift in lifts.items():
            yield Answer("boundary", name, lift=lift), ALWAYS
            if name in model.channels:
                yield Answer("late boundary", name, lift=_late(lift, name)), ALWAYS
        for name in model.channels:
            if name not in lifts:
                yield Answer("channel", name, load=_scaled(model, name)), ALWAYS

    def _fluxes(self) -> Iterator[tuple[Answer, Course]]:
        for name, load in flux_loads(self.model).items():
            yield Answer("flux", name, load=load), ALWAYS

    def _unknowns(self) -> Iterator[tuple[Answer, Course]]:
        reduction = self.samples.filter.reduction
        for label, place in reduction.stay[:MOST_UNKNOWNS]:
            load = _changed(self.model, reduction.Phi[:, place])
            yield Answer("unknown", label, load=load), CHANGES

    def _operators(self) -> Iterator[tuple[Answer, Course]]:
        """Iterate over flows, losses, and conductivities that vary in space and with the state."""
        model, (modes, times) = self.model, self.numbers.conductivity
        # A contact stops what is conducted, not what a flow carries. A flow is looked for in linear
        # equations only.
        stage = ForwardStage(model)
        places = PLACES if stage.symmetric or not stage.keeps else ()

        def stiffness(shape: Callable[[Any], Any]) -> Any:
            return model.bilinear(lambda u, v, x: shape(x) * dot(grad(u), grad(v)))

        for k in range(1, 1 + modes):
            load = _minus(stiffness(self._mode(k)))
            yield Answer("conductivity", "", self._powers[k][0], load), hats(times)
        plain = stiffness(self._mode(0))
        yield Answer("state", load=_by_state(plain)), ALWAYS
        for axis, (low, span) in enumerate(zip(self.low, self.high - self.low, strict=True)):
            halves = stiffness(_halves(axis, low + 0.5 * span))
            yield Answer("layer", "xyz"[axis], load=_minus(halves)), ALWAYS
            wide = max(NARROW, 1.5 * float(model.mesh.param()) / span)
            for place in places:
                matrix = stiffness(_band(axis, low + place * span, wide * span))
                yield Answer("contact", "xyz"[axis], load=_minus(matrix)), ALWAYS
        modes, times = self.numbers.flow
        axes = len(self.low)
        for k in range(axes * math.ceil(modes / axes)):  # along each axis as many
            axis, number = k % axes, k // axes
            load = _minus(self._flow(axis, self._mode(number)))
            yield Answer("flow", "", axes * self._powers[number][0], load), hats(times)
            if number == 0:
                yield Answer("steady flow", "xyz"[axis], load=load), ALWAYS
        yield Answer("loss", load=_lost(model.mass)), SWITCHED

    def _flow(self, axis: int, shape: Callable[[Any], Any]) -> Any:
        return self.model.bilinear(lambda u, v, x: shape(x) * grad(u)[axis] * v)

    def followed(self, one: Passed) -> tuple[Array, list[Array], Array]:
        """Return the readings of all answers, states at samples, and predicted readings.

        Shapes (samples, sensors, columns), (n,) for each sample, and (samples, sensors).
        """
        samples, model = self.samples, self.model
        stage, spans = ForwardStage(model), samples.spans
        steps = max(len(spans), 1)
        work = steps * self.count * model.X.dim
        stride = max(math.ceil(work / MOST_WORK), math.ceil(steps / MOST_STEPS))
        begin, first, end = (float(t) for t in (spans[0].start, spans[0].t1, spans[-1].t1))
        # Courses in time are those of the samples: the first may come long after t0.
        late = max(begin, first - PAUSE * (end - first) / steps)
        p = np.zeros((self.count, model.X.dim))
        for column, (answer, _) in zip(self.first, self.answers, strict=True):
            if answer.start is not None:
                p[column] = answer.start
        found = np.full((len(spans), self.observed.size, self.count), np.nan)
        largest = np.abs(p).max(axis=1)
        states: list[Array] = []
        predicted = np.empty(found.shape[:2])
        last = begin
        for number, (x, span) in enumerate(zip(samples.along(one), spans, strict=True)):
            states.append(x.u[0])
            predicted[number] = samples.filter.sensors.observe(x, span.end)[0][0]
            t, q = float(span.t1), x.q[0]
            due = (number + 1) % stride == 0 or number + 1 == len(spans) or number == 0
            if due:
                moment = span.end.member(0)
                now = Now(x.u[0], q, moment, rates=_rates(span))
                if t > last:
                    share = max(0.5 * (t + last) - late, 0.0) / (end - late)
                    p = self._advanced(stage, p, now, t - last, share)
                    largest = np.maximum(largest, np.abs(p).max(axis=1))
                    last = t
                H, _ = self.observed.jacobian(now.u, model.latent.value(q), moment)
                found[number] = np.asarray(H @ p.T)
        times = np.array([float(span.t1) for span in spans])
        # By symmetry some answers do not reach the sensors.
        found = _filled(found, times)
        for column, most in enumerate(largest):
            found[:, :, column] = beyond_rounding(found[:, :, column], most)
        return found, states, predicted

    def _advanced(self, stage: ForwardStage, p: Array, now: Now, h: float, share: float) -> Array:
        """Return the answers a time h later, shape (columns, n)."""
        loads, lifts = np.zeros_like(p), np.zeros_like(p)
        for first, (answer, course) in zip(self.first, self.answers, strict=True):
            own, weights = slice(first, first + course.size), course.at(share)[:, None]
            if answer.load is not None:
                load = answer.load(now) if callable(answer.load) else answer.load
                loads[own] = weights * load
            if answer.lift is not None:
                lift = answer.lift(now) if callable(answer.lift) else answer.lift
                lifts[own] = weights * lift
        return later(stage, p, now, h, loads, lifts)


def _halves(axis: int, middle: float) -> Callable[[Any], Any]:
    """Return a shape that tells two layers apart, the same from either side but for its sign."""
    return lambda x: np.where(x[axis] > middle, 0.5, -0.5)


def _band(axis: int, place: float, wide: float) -> Callable[[Any], Any]:
    return lambda x: np.maximum(1.0 - np.abs(x[axis] - place) / wide, 0.0)


def beyond_rounding(values: Array, terms: Array) -> Array:
    """Return values, or zeros where all of them are rounding of the terms they are sums of.

    The average over errors scales each column to the size of the noise: one of rounding alone, as
    that of a flow across a state that does not vary along it, would count as an error.
    """
    largest, of = (float(np.fmax.reduce(np.abs(one), axis=None)) for one in (values, terms))
    return np.zeros_like(values) if math.isfinite(of) and largest <= ROUNDING * of else values


def _minus(matrix: Any) -> Load:
    size = abs(matrix)
    return lambda now: beyond_rounding(-(matrix @ now.u), size @ np.abs(now.u))


def _by_state(stiffness: Any) -> Load:
    """Return the load of a conductivity that varies with the state about its mean."""
    bent = _minus(0.5 * stiffness)
    return lambda now: bent(now._replace(u=(now.u - now.u.mean()) ** 2))


def _lost(mass: Any) -> Load:
    size = abs(mass)
    return lambda now: beyond_rounding(-(mass @ (now.u - now.u.mean())), size @ np.abs(now.u))


def _late(lift: Array, name: str) -> Load:
    return lambda now: -now.rates.get(name, 0.0) * lift


def _scaled(model: Model, name: str) -> Load:
    """Return the load of a channel that is larger by its own size."""

    def load(now: Now) -> Array:
        more = scaled_channel(model, name, now, STEP) / STEP
        return beyond_rounding(more, force(model, now) / STEP)

    return load


def _changed(model: Model, direction: Array) -> Load:
    """Return the derivative of the load by a latent unknown."""

    def load(now: Now) -> Array:
        ends = (now.q + STEP * direction, now.q - STEP * direction)
        up, down = (force(model, now._replace(q=q)) for q in ends)
        return beyond_rounding(up - down, up) / (2.0 * STEP)

    return load


def _rates(span: Any) -> dict[str, float]:
    """Return the change of each input in a unit of time over an interval."""
    h = float(span.t1 - span.start)
    if not h > 0.0:
        return {}
    change = np.broadcast_to((span.inputs1 - span.inputs0) / h, (1, len(span.channels)))[0]
    return dict(zip(span.channels, change.tolist(), strict=True))


def _filled(values: Array, times: Array) -> Array:
    """Return values along axis 0 with straight lines where they are NaN."""
    known = np.isfinite(values[:, 0, 0]) if values.size else np.ones(len(values), dtype=bool)
    if known.all():
        return values
    flat = values.reshape(len(values), -1)
    places = np.interp(times, times[known], np.arange(known.sum()))
    low = np.floor(places).astype(int)
    high = np.minimum(low + 1, known.sum() - 1)
    share = (places - low)[:, None]
    some = flat[known]
    found: Array = (1.0 - share) * some[low] + share * some[high]
    return found.reshape(values.shape)


def _sensor_columns(
    samples: StoredSamples, predicted: Array, states: Sequence[Array]
) -> Iterator[tuple[Array, float]]:
    """Iterate over errors of single sensors, and of all: effect on readings, largest size.

    Effects have shape (samples, sensors), in the unit of the readings. The largest size is a
    standard deviation of the amplitude that is plausible.
    """
    times = samples.times
    share = (times - times[0]) / max(float(np.ptp(times)), 1e-300)
    count, sensors = predicted.shape
    # A sensor that moves may have no place at first.
    seen = np.isfinite(predicted)
    change = predicted - predicted[seen.argmax(axis=0), np.arange(sensors)]
    for column, level in zip(change.T, predicted.T, strict=True):
        column[:] = beyond_rounding(column, level)
    rate = np.gradient(change, times, axis=0) if count > 1 else np.zeros_like(predicted)
    problem = samples.filter.problem
    each = [
        (np.ones_like(predicted), math.inf),
        (np.broadcast_to(share[:, None], predicted.shape), math.inf),
        (change, MOST_GAIN),
        (-rate, math.inf),
    ]
    common = [(change, MOST_GAIN), (-rate, math.inf)]
    positions = stated_positions(problem.observed)
    shifts, step = sensor_shifts(problem.model, problem.observed)
    for axis, matrix in enumerate(shifts):
        size = abs(matrix)
        slope = np.array([matrix @ u for u in states]) / step
        terms = np.array([size @ np.abs(u) for u in states]) / step
        for k in range(sensors):
            slope[:, k] = beyond_rounding(slope[:, k], terms[:, k])
        vertices = np.asarray(problem.model.mesh.p)[axis]
        low, high = float(vertices.min()), float(vertices.max())
        each.append((slope, FARTHEST * (high - low)))
        at = np.zeros(sensors) if positions is None else np.nan_to_num(positions[:, axis])
        common += [(slope * (at - end), FARTHEST) for end in (low, high)]  # depths from either
    for effect, most in each:
        for k in range(sensors):
            own = np.zeros_like(predicted)
            own[:, k] = effect[:, k]
            yield own, most
    for effect, most in common:
        yield effect, most


def _slow_noise(times: Array, sensors: int, count: int) -> tuple[Array, Array]:
    """Return slow noise common to all sensors, and of each, (samples, sensors, columns)."""
    share = (times - times[0]) / max(float(np.ptp(times)), 1e-300)
    each = np.array([hats(count).at(s) for s in share.tolist()])
    together = np.repeat(each[:, None, :], sensors, axis=1)
    own = np.einsum("tc,sk->tskc", each, np.eye(sensors)).reshape(len(times), sensors, -1)
    return together, own


def _root(modes: Array, count: int, time: float) -> Array:
    """Return a square root of the covariance of amplitudes of hat functions in time.

    For each mode in space, with variance 1/(1 + mode)^2, an Ornstein-Uhlenbeck process, or a
    constant.
    """
    nodes = np.arange(count) / max(count - 1, 1)
    each = np.ones((count, count))
    if not math.isinf(time):
        each = np.exp(-np.abs(nodes[:, None] - nodes) / time)
    sizes, axes = np.linalg.eigh(each)
    one = axes * np.sqrt(np.maximum(sizes, 0.0))
    found: Array = np.kron(np.diag(1.0 / (1.0 + modes)), one)
    return found


Roots: TypeAlias = Callable[[float], Array]


def _families(known: Mapping[str, tuple[IntArray, Roots]]) -> Iterator[Family]:
    groups: list[tuple[tuple[str, ...], tuple[float, ...]]]
    groups = [((name,), FAMILY_SIZES) for name in known]
    groups += [(names, JOINT_SIZES) for names in JOINT if set(names) <= set(known)]
    for names, sizes in groups:
        beside = BESIDE_SIZES if names in BESIDE else ()
        for time in TIMES:
            parts = tuple((known[name][0], known[name][1](time)) for name in names)
            yield Family(parts, sizes, beside)


@nonfinite_allowed()  # a hypothesis that overflows has no evidence
def model_errors(
    samples: StoredSamples, options: Refit, std: Array, shift: Array
) -> ModelErrors | str:
    """Return misfit and intervals that allow for errors of the model, or why there are none.

    `std`, `shift`: reported standard deviations of the latent unknowns, and their shifts by the
    discretisation, (m,).
    """
    found = _best(samples, options)
    if found is None:
        return "a step of the model fails at the best fit"
    one, used = found
    if used.sum() < FEWEST:
        return f"fewer than {FEWEST} readings are in use"
    start, reduction = samples.start, samples.filter.reduction
    T = reduction.Phi @ start.C[0].T
    model, causes, families = linear_model(samples, one, used, T)
    mixture = averaged(model, causes, families).widened(shift)
    low, high = mixture.interval
    if not np.isfinite([low, high]).all():
        return OVERFLOW
    noise = _noise_of_each(one.residuals, used)
    narrow = np.sqrt(model.asked[1] + shift**2)
    base = start.q[0]
    return ModelErrors(
        misfit=_rms((one.residuals / noise)[used]),
        of_signal=_of_signal(samples.readings, one.residuals, used),
        sensors={
            name: _rms(column[there]) / float(own)
            for name, column, there, own in zip(
                samples.filter.problem.observed.names, one.residuals.T, used.T, noise, strict=True
            )
            if there.any()
        },
        unknowns=tuple(
            _allowed(samples.filter, samples.state.now, (base + low, base + high), narrow, std)
        ),
    )


@nonfinite_allowed()
def errors_of_innovations(
    filter_: Filter, x: FilterState, ranges: Array, std: Array, shift: Array
) -> ModelErrors | str:
    """Return the same from the innovations of a run whose samples cannot be fitted again.

    The average is over errors of single sensors and of the process that the verdict looks for, and
    has no families. `ranges`: of the readings of each sensor, (sensors,).
    """
    judge, ledger = filter_.judge, x.ledger
    if judge is None or not ledger.seen[0]:
        return "the run is not judged"
    w, settled = judge.summed_up(ledger, x.causes)
    ledger, Phi = settled.of_member(0), filter_.reduction.Phi
    count, squares = ledger.noise[0, 0], ledger.noise[2, 0]
    if count.sum() < FEWEST:
        return f"fewer than {FEWEST} readings are in use"
    moved = Phi @ (x.C[0].T @ w[0])  # truth less estimate by each cause
    most = judge.dictionary.plausible(MOST_GAIN, FARTHEST)
    mixture = averaged_causes(ledger, moved, most, std).widened(shift)
    low, high = mixture.interval
    if not np.isfinite([low, high]).all():
        return OVERFLOW
    there = count > 0.0
    count, squares, level = (part[there] for part in (count, squares, levels(ledger)[0]))
    known = filter_.estimate(x)[0]
    # Noise that is larger than stated is no error of the model.
    typical = max(weighted_median(level, count), 1.0)
    plain = np.hypot(math.sqrt(typical) * np.linalg.norm(Phi @ x.C[0].T, axis=1), shift)
    span = ranges[there] / (np.sqrt(x.level[0]) * filter_.noise[there])
    signal = math.sqrt((count * span**2).sum() / 12.0)  # of readings that fill their range
    each = np.sqrt(squares / count / level)
    names = np.array(filter_.problem.observed.names)[there].tolist()
    return ModelErrors(
        misfit=math.sqrt((squares / level).sum() / count.sum()),
        of_signal=math.sqrt(squares.sum()) / signal if signal > 0.0 else math.inf,
        sensors=dict(zip(names, each.tolist(), strict=True)),
        unknowns=tuple(_allowed(filter_, x, (known + low, known + high), plain, std)),
    )


def _best(samples: StoredSamples, options: Refit) -> tuple[Passed, Mask] | None:
    """Return the samples about the best fit, and the readings in use; None if a step fails."""
    one = samples.about(samples.reached)
    if one is None:
        return None
    used = plausible(samples, options, one) & np.isfinite(one.residuals)
    # Coordinates of an uncertain start are no unknowns: they are those of the linear model.
    H, g = one.model(used)
    sizes, axes = principal(H)
    step = axes @ (axes.T @ g / sizes)
    if not samples.start.U.any() or step @ H @ step < NEAR**2:
        return one, used
    better = samples.about(samples.within_bounds(one.xi + step))
    if better is None or better.cost(used) > one.cost(used):
        return one, used
    return better, plausible(samples, options, better) & np.isfinite(better.residuals)


def _rms(values: Array) -> float:
    return math.sqrt(float((values**2).mean()))


def _of_signal(readings: Array, residuals: Array, used: Mask) -> float:
    """Return the misfit over the scatter of the readings of each sensor about their mean."""
    about = [column[there] - column[there].mean() for column, there in _columns(readings, used)]
    signal = _rms(np.concatenate(about))
    return _rms(residuals[used]) / signal if signal > 0.0 else math.inf


def _columns(values: Array, used: Mask) -> Iterator[tuple[Array, Mask]]:
    """Iterate over the sensors that have readings in use."""
    for column, there in zip(values.T, used.T, strict=True):
        if there.any():
            yield column, there


def _allowed(
    filter_: Filter, x: FilterState, ends: tuple[Array, Array], narrow: Array, std: Array
) -> Iterator[Allowed]:
    """Iterate over the unknowns, with intervals that allow for errors of the model.

    `ends`: of these, of the latent unknowns. `narrow`, `std`: standard deviations by the noise
    alone, and those that are reported.
    """
    problem, reduction = filter_.problem, filter_.reduction
    latent = problem.model.latent
    own = set(problem.observed.observation.unknowns)
    for name, item in latent.parts.items():
        if isinstance(item.unknown, Scalar) and item.unknown.corrects:  # an input
            own.add(name)
    known = filter_.estimate(x)[0]
    both = (known, *ends, known - QUANTILE * std, known + QUANTILE * std)
    value, low_end, high_end, plain_low, plain_high = (
        latent.value(reduction.bounded(one)) for one in both
    )
    # The plain interval is wider where innovations follow each other: it is a part of this one.
    ends = np.minimum(low_end, plain_low), np.maximum(high_end, plain_high)
    widths = 2.0 * QUANTILE * narrow
    wider = (both[2] - both[1]) / np.where(widths > 0.0, widths, np.inf)
    for name, item in latent.parts.items():
        part = slice(item.part.start, item.part.start + item.size)
        labels = item.block.labels(name)
        unit = item.unknown.unit
        if len(labels) == item.size:
            rows = zip(labels, range(part.start, part.stop), strict=True)
            for label, k in rows:
                numbers = [float(one[k]) for one in (value, *ends, plain_low, plain_high, wider)]
                yield Allowed.of(label, unit, numbers, of_sensor=name in own)
            continue
        size = float(np.sqrt((value[part] ** 2).mean()))
        every = (*ends, plain_low, plain_high)
        off = [float(np.sqrt(((end[part] - value[part]) ** 2).mean())) for end in every]
        numbers = [size, size - off[0], size + off[1], size - off[2], size + off[3]]
        numbers.append(float(np.sqrt((wider[part] ** 2).mean())))
        yield Allowed.of(name, unit, numbers, of_sensor=name in own)


def linear_model(
    samples: StoredSamples, one: Passed, used: Mask, T: Array
) -> tuple[LinearModel, Causes, list[Family]]:
    """Return the readings in use as a linear model, and what may be wrong.

    `one`, `used`: the best fit, and the readings that it uses. `T`: what is asked for, as rows on
    the coordinates xi, (numbers, r).
    """
    work = len(samples) * samples.filter.problem.model.X.dim
    fine = len(samples) >= MANY and work * MOST_COLUMNS < MOST_WORK
    numbers = FULL if fine else SMALL
    errors = ErrorColumns(samples, numbers)
    answers, states, predicted = errors.followed(one)
    noise = samples.noise
    level = _level(one.residuals, used)
    parts: list[Array] = []
    causes: list[tuple[int, float]] = []
    families: dict[str, tuple[IntArray, Roots]] = {}
    place = 0

    def add(columns: Array) -> IntArray:
        nonlocal place
        flat = (columns / (level * noise[:, :, None]))[used]
        parts.append(flat)
        place += flat.shape[1]
        return np.arange(place - flat.shape[1], place)

    own = add(answers)
    family: dict[str, list[tuple[float, IntArray, int]]] = {}
    for first, (answer, course) in zip(errors.first, errors.answers, strict=True):
        columns = own[first : first + course.size]
        if answer.kind in ("source", "conductivity", "flow"):
            family.setdefault(answer.kind, []).append((answer.mode, columns, course.size))
            continue
        causes += [(column, math.inf) for column in columns.tolist()]
    for kind, members in family.items():
        modes = np.array([mode for mode, _, _ in members])
        modes -= modes.min()
        count = members[0][2]
        columns = np.concatenate([one for _, one, _ in members])
        families[kind] = (columns, partial(_root, modes, count))
    for effect, largest in _sensor_columns(samples, predicted, states):
        causes.append((int(add(effect[:, :, None])[0]), largest))
    times = samples.times
    sensors = predicted.shape[1]
    together, apart = _slow_noise(times, sensors, numbers.noise)
    families["common"] = (add(together), partial(_root, np.zeros(1), numbers.noise))
    if 1 < sensors <= MOST_SENSORS:
        families["sensors"] = (add(apart), partial(_root, np.zeros(sensors), numbers.noise))
    J = (one.slopes / level)[used]
    z = (one.residuals / level)[used] + J @ one.xi
    Z = np.concatenate(parts, axis=1)
    # Beside a missing position of a sensor that moves, rates are not known.
    known = np.isfinite(Z).all(axis=1)
    J, z, Z = J[known], z[known], Z[known]
    columns = np.array([column for column, _ in causes])
    most = np.array([largest for _, largest in causes])
    single = Causes(columns, most, CAUSE_SIZES)
    return LinearModel(J=J, Z=Z, z=z, T=T), single, list(_families(families))


def _level(residuals: Array, used: Mask) -> float:
    """Return the noise that successive residuals show, over the noise that is stated.

    That of the median reading: so the weights of the sensors stay those of the estimate, and one
    that has hardly a reading counts for little.
    """
    found = [(_variance(column[there]), there.sum()) for column, there in _columns(residuals, used)]
    return math.sqrt(weighted_median(*np.transpose(found)))


def _noise_of_each(residuals: Array, used: Mask) -> Array:
    """Return the noise that successive residuals of each sensor show, over the stated one.

    Few readings are taken to have the noise of the others. NaN for a sensor without one.
    """
    usual, found = _level(residuals, used) ** 2, np.full(residuals.shape[1], np.nan)
    for k in np.flatnonzero(used.any(axis=0)):
        found[k] = math.sqrt(_variance(residuals[used[:, k], k], usual))
    return found


def _variance(residuals: Array, usual: float = 1.0) -> float:
    """Return the variance that successive residuals of a sensor show, over the stated one."""
    squares = 0.5 * float((np.diff(residuals) ** 2).sum())
    return max((squares + SHRINK * usual) / (len(residuals) - 1 + SHRINK), LEAST_LEVEL)
