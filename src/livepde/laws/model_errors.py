"""Intervals of the unknowns that allow for model errors.

The effects of errors on the readings are the columns of a linear model. Columns of process errors
are responses of the process (`livepde.laws.error_columns`); columns of sensor errors are computed
here. A single cause has one column; a family has an amplitude for each shape in space and course in
time. `livepde.verdict.evidence` averages over them. If the stored samples cannot be refitted, the
intervals follow from the effects of single causes on the innovations, from the sums of the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias

import numpy as np
import scipy

from livepde.fem import Inputs, Moment, Scalar
from livepde.laws.error_columns import FULL, MOST_WORK, SMALL, ErrorColumns, beyond_rounding, hats
from livepde.laws.filter import Filter
from livepde.laws.filter_state import FilterState
from livepde.laws.law import Problem
from livepde.laws.layers import Layers
from livepde.laws.policies import Refit
from livepde.laws.refit import plausible
from livepde.laws.stored_samples import Passed, StoredSamples, principal
from livepde.linalg import Array, IntArray, Mask, nonfinite_allowed
from livepde.model import Model
from livepde.verdict import Cause
from livepde.verdict.directions import (
    AVERAGED,
    LONGEST_AVERAGE,
    SHIFT,
    averages_on_line,
    sensor_averages,
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
from livepde.verdict.model_errors import USUAL, Allowed, ModelErrors

MANY = 150  # least number of samples for the full list of errors, to distinguish its members
MOST_COLUMNS = 250  # number of process columns in the full list, for an estimate of the work
MOST_SENSORS = 12  # maximum number of sensors with separate slow noise
CAUSE_SIZES = (1.0, 4.0, 16.0, 64.0, 256.0)  # standard deviations of the noise
FAMILY_SIZES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
JOINT_SIZES = (1.0, 10.0, 100.0)
JOINT = (("source", "conductivity"), ("source", "sensors"), ("source", "sensors", "conductivity"))
BESIDE_SIZES = (4.0, 64.0)  # sizes of a family in combination with a single cause
BESIDE = (("source",), ("common",), ("sensors",))
TIMES = (1.0 / 30.0, 1.0 / 6.0, 2.0, math.inf)  # correlation times over the length of the run
MOST_GAIN = 0.3  # plausible standard deviation of the relative scale of a sensor
FARTHEST = 0.1  # plausible standard deviation of a position, over the length of the domain
RESPONSE = 1.0 / 30.0  # time constant of a slow sensor over the length of the run, as in `TIMES`
FEWEST = 20  # least number of readings
SAME_ERROR = 1e-3  # relative difference below which two errors of a sensor are equal
NEAR = 0.03  # distance of a trajectory from the best fit that is negligible, in posterior std
QUANTILE = 1.96  # half width of a 95 % interval in standard deviations
SHRINK = 10.0  # weight of the configured noise variance, as a number of pairs of readings
OVERFLOW = "the responses of the process to errors overflow"
LEAST_LEVEL = 0.01  # lower bound of an estimated noise variance over the configured variance


def _sensor_columns(
    samples: StoredSamples, predicted: Array, states: Sequence[Array]
) -> Iterator[tuple[Array, float]]:
    """Iterate over errors of single sensors and of all sensors: effect on readings, largest size.

    Effects have shape (samples, sensors), in the unit of the readings. The largest size is a
    plausible standard deviation of the amplitude.
    """
    times = samples.times
    share = (times - times[0]) / max(float(np.ptp(times)), 1e-300)
    count, sensors = predicted.shape
    # The first positions of a moving sensor may be missing.
    finite = np.isfinite(predicted)
    change = predicted - predicted[finite.argmax(axis=0), np.arange(sensors)]
    change = _beyond_rounding(change, predicted)
    rate = np.gradient(change, times, axis=0) if count > 1 else np.zeros_like(predicted)
    problem = samples.filter.problem
    each: list[tuple[Array, float | Array]] = [
        (np.ones_like(predicted), math.inf),
        (np.broadcast_to(share[:, None], predicted.shape), math.inf),
        (change, MOST_GAIN),
        (-rate, math.inf),
    ]
    slow = _slow(times, predicted, RESPONSE * max(float(np.ptp(times)), 1e-300))
    each.append((_beyond_rounding(slow - predicted, predicted), math.inf))
    if averages_on_line(problem.model):
        mean = (sensor_averages(problem.model, problem.observed) @ np.column_stack(states)).T
        longest = (LONGEST_AVERAGE / AVERAGED) ** 2
        each.append((_beyond_rounding(mean, predicted), longest))
    common = [(change, MOST_GAIN), (-rate, math.inf)]
    for slope, step, depths in _misplaced(problem, states):
        each.append((slope, FARTHEST / SHIFT * step))
        common += [(slope * depth, FARTHEST) for depth in depths]
    for effect, most in each:
        for k in range(sensors):
            own = np.zeros_like(predicted)
            own[:, k] = effect[:, k]
            yield own, float(np.broadcast_to(most, sensors)[k])
    for effect, most in common:
        yield effect, most


def _slow(times: Array, values: Array, constant: float) -> Array:
    """Return the readings of first-order sensors with a time constant.

    Values are interpolated linearly between samples. NaN values remain NaN.
    """
    readings = values.copy()
    for k in range(1, len(times)):
        h = (times[k] - times[k - 1]) / constant
        rise = (values[k] - values[k - 1]) / h
        now = values[k] - rise + math.exp(-h) * (readings[k - 1] - values[k - 1] + rise)
        readings[k] = np.where(np.isfinite(now), now, values[k])
    return readings


def _beyond_rounding(values: Array, terms: Array) -> Array:
    """Apply `beyond_rounding` to each column."""
    each = zip(values.T, np.broadcast_to(terms, values.shape).T, strict=True)
    return np.column_stack([beyond_rounding(own, of) for own, of in each])


def _misplaced(
    problem: Problem, states: Sequence[Array]
) -> Iterator[tuple[Array, Array, tuple[Array, Array]]]:
    """Iterate over the axes along which sensors may be misplaced.

    Each item has slopes of the readings, (samples, sensors), usual shifts of the sensors, and their
    distances to both ends of the domain, (sensors,).
    """
    positions = stated_positions(problem.observed)
    shifts, step = sensor_shifts(problem.model, problem.observed)
    every = np.column_stack(states)
    for axis, matrix in enumerate(shifts):
        size = abs(matrix)
        terms = (size @ np.abs(every)).T / step
        slope = _beyond_rounding((matrix @ every).T / step, terms)
        vertices = np.asarray(problem.model.mesh.p)[axis]
        at = np.zeros(len(step)) if positions is None else np.nan_to_num(positions[:, axis])
        yield slope, step, (at - float(vertices.min()), at - float(vertices.max()))


def _slow_noise(times: Array, sensors: int, count: int) -> tuple[Array, Array]:
    """Return slow noise, common to all sensors and of each sensor, (samples, sensors, columns)."""
    share = (times - times[0]) / max(float(np.ptp(times)), 1e-300)
    each = np.array([hats(count).at(s) for s in share.tolist()])
    together = np.repeat(each[:, None, :], sensors, axis=1)
    own = np.einsum("tc,sk->tskc", each, np.eye(sensors)).reshape(len(times), sensors, -1)
    return together, own


def _root(modes: Array, count: int, time: float) -> Array:
    """Return a square root of the covariance of amplitudes of hat functions in time.

    Each mode in space is an Ornstein-Uhlenbeck process in time, or constant if `time` is infinite,
    with variance 1/(1 + mode)^2.
    """
    nodes = np.arange(count) / max(count - 1, 1)
    covariance = np.ones((count, count))
    if not math.isinf(time):
        covariance = np.exp(-np.abs(nodes[:, None] - nodes) / time)
    sizes, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(sizes, 0.0))
    return np.kron(np.diag(1.0 / (1.0 + modes)), root)


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
) -> tuple[ModelErrors, list[Cause]] | str:
    """Return misfit and intervals that allow for model errors, or the reason why there are none.

    Also return layers as a cause of the misfit, if a constant conductivity is unknown.

    `std`, `shift`: reported standard deviations of the latent unknowns, and their shifts by the
    discretisation, (m,).
    """
    best = _best(samples, options)
    if best is None:
        return "a step of the model fails at the best fit"
    fit, used = best
    if used.sum() < FEWEST:
        return f"fewer than {FEWEST} readings are in use"
    start, reduction = samples.start, samples.filter.reduction
    T = reduction.Phi @ start.C[0].T
    model, causes, families, layers = linear_model(samples, fit, used, T)
    mixture = averaged(model, causes, families).widened(shift)
    low, high = mixture.interval
    if not np.isfinite([low, high]).all():
        return OVERFLOW
    noise = _noise_of_each(fit.residuals, used)
    narrow = np.sqrt(model.asked[1] + shift**2)
    base = start.q[0]
    errors = ModelErrors(
        misfit=_rms((fit.residuals / noise)[used]),
        of_signal=_of_signal(samples.readings, fit.residuals, used),
        sensors={
            name: _rms(column[there]) / float(own)
            for name, column, there, own in zip(
                samples.filter.problem.observed.names, fit.residuals.T, used.T, noise, strict=True
            )
            if there.any()
        },
        unknowns=tuple(
            _allowed(samples.filter, samples.state.now, (base + low, base + high), narrow, std)
        ),
    )
    unit = samples.filter.problem.model.length_unit
    return errors, [] if layers is None else [layers.cause(model, unit)]


@nonfinite_allowed()  # a cause that overflows has no evidence
def errors_of_innovations(
    filter_: Filter, x: FilterState, ranges: Array, std: Array, shift: Array
) -> ModelErrors | str:
    """Return misfit and intervals from the innovations of a run that cannot be refitted.

    The average is over the single causes of the verdict, of sensors and of the process, without
    families. `ranges`: range of the readings of each sensor, (sensors,).
    """
    judge, ledger = filter_.judge, x.ledger
    if judge is None or not ledger.seen[0]:
        return "the run is not judged"
    w, settled = judge.summed_up(ledger, x.causes)
    ledger, Phi = settled.of_member(0), filter_.reduction.Phi
    count, squares = ledger.noise[0, 0], ledger.noise[2, 0]
    if count.sum() < FEWEST:
        return f"fewer than {FEWEST} readings are in use"
    moved = Phi @ (x.C[0].T @ w[0])  # truth minus estimate for each cause
    most = judge.dictionary.plausible(MOST_GAIN, FARTHEST)
    mixture = averaged_causes(ledger, moved, most, std).widened(shift)
    low, high = mixture.interval
    if not np.isfinite([low, high]).all():
        return OVERFLOW
    there = count > 0.0
    count, squares, level = (part[there] for part in (count, squares, levels(ledger)[0]))
    known = filter_.estimate(x)[0]
    # Noise above its configured level is not a model error.
    typical = max(weighted_median(level, count), 1.0)
    plain = np.hypot(math.sqrt(typical) * np.linalg.norm(Phi @ x.C[0].T, axis=1), shift)
    span = ranges[there] / (np.sqrt(x.level[0]) * filter_.noise[there])
    signal = math.sqrt((count * span**2).sum() / 12.0)  # if readings are uniform in their range
    each = np.sqrt(squares / count / level)
    names = np.array(filter_.problem.observed.names)[there].tolist()
    return ModelErrors(
        misfit=math.sqrt((squares / level).sum() / count.sum()),
        of_signal=math.sqrt(squares.sum()) / signal if signal > 0.0 else math.inf,
        sensors=dict(zip(names, each.tolist(), strict=True)),
        unknowns=tuple(_allowed(filter_, x, (known + low, known + high), plain, std)),
    )


def _best(samples: StoredSamples, options: Refit) -> tuple[Passed, Mask] | None:
    """Return the pass about the best fit, and a mask of the readings in use; None if it fails."""
    fit = samples.about(samples.reached)
    if fit is None:
        return None
    used = plausible(samples, options, fit) & np.isfinite(fit.residuals)
    # Coordinates of an uncertain start are not unknowns: the linear model determines them.
    H, g = fit.model(used)
    sizes, axes = principal(H)
    step = axes @ (axes.T @ g / sizes)
    if not samples.start.U.any() or step @ H @ step < NEAR**2:
        return fit, used
    better = samples.about(samples.within_bounds(fit.xi + step))
    if better is None or better.cost(used) > fit.cost(used):
        return fit, used
    return better, plausible(samples, options, better) & np.isfinite(better.residuals)


def _rms(values: Array) -> float:
    return math.sqrt(float((values**2).mean()))


def _of_signal(readings: Array, residuals: Array, used: Mask) -> float:
    """Return the misfit over the scatter of the readings about the mean of their sensor."""
    about = [column[there] - column[there].mean() for column, there in _columns(readings, used)]
    signal = _rms(np.concatenate(about))
    return _rms(residuals[used]) / signal if signal > 0.0 else math.inf


def _columns(values: Array, used: Mask) -> Iterator[tuple[Array, Mask]]:
    """Iterate over the sensors with readings in use: values, and mask of the readings in use."""
    for column, there in zip(values.T, used.T, strict=True):
        if there.any():
            yield column, there


def _read(model: Model) -> set[str]:
    """Return the unknowns in the equation or initial state: the others are errors of sensors.

    The derivatives are tested at a random state, with all inputs equal to 1.
    """
    rng = np.random.default_rng(0)
    latent, inputs = model.latent, Inputs(dict.fromkeys(model.channels, 1.0))
    moment, u = Moment(0.3, inputs), rng.uniform(0.5, 1.5, model.X.dim)
    q = latent.value(latent.prior + latent.deviations * rng.standard_normal(latent.dim))
    with np.errstate(all="ignore"):  # an entry that is not finite counts as nonzero
        parts = [model.physical_A.matrix("v", "q", moment, u=u, q=q)]
        if (form := model.form_initial) is not None:
            parts.append(form.matrix("v", "q", moment, q=latent.prior))
    fields = model.state_space.of_fields  # only a slow sensor depends on its time constant
    effect = np.sum([fields @ abs(part) for part in parts], axis=0)
    return {name for name in latent.parts if effect[model.parameter_space.part(name)].any()}


def _allowed(
    filter_: Filter, x: FilterState, ends: tuple[Array, Array], narrow: Array, std: Array
) -> Iterator[Allowed]:
    """Iterate over the unknowns with intervals that allow for model errors.

    `ends`: ends of the intervals of the latent unknowns. `narrow`, `std`: standard deviations from
    the noise alone, and reported standard deviations.
    """
    problem, reduction = filter_.problem, filter_.reduction
    latent = problem.model.latent
    scalars = {n: p.unknown for n, p in latent.parts.items() if isinstance(p.unknown, Scalar)}
    corrections = {name for name, unknown in scalars.items() if unknown.corrects}  # of inputs
    own = (latent.parts.keys() - _read(problem.model)) | corrections
    known = reduction.bounded(filter_.estimate(x)[0])
    # An interval whose centre violates a bound is shifted to the bound, and clipped there.
    middle = 0.5 * (ends[0] + ends[1])
    beyond = reduction.bounded(middle) - middle
    wide = (ends[0] + beyond, ends[1] + beyond)
    both = (known, *wide, known - QUANTILE * std, known + QUANTILE * std)
    value, low_end, high_end, plain_low, plain_high = (
        latent.value(reduction.bounded(point)) for point in both
    )
    # Correlated innovations widen the reported interval: the result contains it in any case.
    ends = np.minimum(low_end, plain_low), np.maximum(high_end, plain_high)
    widths = 2.0 * QUANTILE * narrow
    wider = (both[2] - both[1]) / np.where(widths > 0.0, widths, np.inf)
    for name, item in latent.parts.items():
        part = problem.model.parameter_space.part(name)
        labels = item.block.labels(name)
        prior, unit = item.unknown.prior, item.unknown.unit
        usual = USUAL * float(prior.latent_std) if prior.symmetric else 0.0
        rows = [values[part] for values in (value, *ends, plain_low, plain_high)]
        table = np.array([*rows, wider[item.part][: item.size]])  # harmonics: the constant part
        if len(labels) != item.size:  # a field
            labels, table = [name], _root_mean_squares(table)[:, None]
        for label, numbers in zip(labels, table.T.tolist(), strict=True):
            yield Allowed.of(label, unit, numbers, usual=usual, of_sensor=name in own)


def _root_mean_squares(every: Array) -> Array:
    """Return the root mean squares over a field of value, interval ends and width ratio."""
    value, *ends, wider = every
    size, ratio = (float(np.sqrt((values**2).mean())) for values in (value, wider))
    widths = [float(np.sqrt(((end - value) ** 2).mean())) for end in ends]
    low, high, plain_low, plain_high = widths
    return np.array([size, size - low, size + high, size - plain_low, size + plain_high, ratio])


def linear_model(
    samples: StoredSamples, one: Passed, used: Mask, T: Array
) -> tuple[LinearModel, Causes, list[Family], Layers | None]:
    """Return a linear model of the readings in use, the possible errors, and possible layers.

    `one`, `used`: best fit, and readings in use. `T`: linear map from the coordinates xi to the
    requested numbers, (numbers, r).
    """
    work = len(samples) * samples.filter.problem.model.X.dim
    fine = len(samples) >= MANY and work * MOST_COLUMNS < MOST_WORK
    numbers = FULL if fine else SMALL
    errors = ErrorColumns(samples, numbers)
    responses, states, predicted = errors.followed(one)
    noise, times, sensors = samples.noise, samples.times, predicted.shape[1]
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

    own = add(responses)
    family: dict[str, list[tuple[float, IntArray, int]]] = {}
    steps: list[int] = []
    for first, (shape, course) in zip(errors.first, errors.shapes, strict=True):
        columns = own[first : first + course.size]
        if shape.kind in ("source", "conductivity", "flow"):
            family.setdefault(shape.kind, []).append((shape.mode, columns, course.size))
        elif shape.kind == "border":
            steps += columns.tolist()
        else:
            causes += [(column, math.inf) for column in columns.tolist()]
    for kind, members in family.items():
        modes, each, sizes = zip(*members, strict=True)
        number = np.array(modes) - min(modes)
        families[kind] = (np.concatenate(each), partial(_root, number, sizes[0]))
    J = one.slopes / level
    stated = _basis_of_sensors(samples, J[used])
    for effect, largest in _sensor_columns(samples, predicted, states):
        column = int(add(effect[:, :, None])[0])
        parts[-1] = _beyond(parts[-1], stated)
        causes.append((column, largest))
    together, apart = _slow_noise(times, sensors, numbers.noise)
    families["common"] = (add(together), partial(_root, np.zeros(1), numbers.noise))
    if 1 < sensors <= MOST_SENSORS:
        families["sensors"] = (add(apart), partial(_root, np.zeros(sensors), numbers.noise))
    J = J[used]
    z = (one.residuals / level)[used] + J @ one.xi
    Z = np.concatenate(parts, axis=1)
    # Rates are unknown next to a missing position of a moving sensor.
    known = np.isfinite(Z).all(axis=1)
    J, z, Z = J[known], z[known], Z[known]
    columns, most = map(np.array, zip(*causes, strict=True))
    single = Causes(columns, most, CAUSE_SIZES)
    layers = None
    if steps:
        ends = float(errors.model.mesh.p.min()), float(errors.model.mesh.p.max())
        layers = Layers(errors.conductivity, errors.borders, ends, np.array(steps))
    return LinearModel(J=J, Z=Z, z=z, T=T), single, list(_families(families)), layers


def _basis_of_sensors(samples: StoredSamples, J: Array) -> Array:
    """Return an orthonormal basis of the effects of sensor unknowns on readings, (readings, k).

    `J`: derivatives of the readings in the coordinates xi, (readings, r).
    """
    filter_ = samples.filter
    model, own = filter_.problem.model, np.zeros(filter_.reduction.size, dtype=bool)
    read = _read(model)
    for name, evolution in zip(model.latent.parts, filter_.reduction.evolutions, strict=True):
        own[evolution.part] = name not in read
    if not own.any():
        return np.zeros((len(J), 0))
    by_unknown = J @ np.linalg.pinv(samples.start.C[0].T)
    effects = by_unknown[:, own]
    effects[~np.isfinite(effects).all(axis=1)] = 0.0
    sizes = np.linalg.norm(effects, axis=0)
    basis: Array = scipy.linalg.orth(effects / np.where(sizes > 0.0, sizes, 1.0))
    return basis


def _beyond(effect: Array, basis: Array) -> Array:
    """Return an effect, (readings, 1), or zeros if it equals the effect of a sensor unknown.

    An unknown is not a model error: its prior determines its size.
    """
    known = np.where(np.isfinite(effect), effect, 0.0)
    rest = known - basis @ (basis.T @ known)
    same = np.linalg.norm(rest) <= SAME_ERROR * np.linalg.norm(known)
    return np.zeros_like(effect) if same else effect


def _level(residuals: Array, used: Mask) -> float:
    """Return the noise estimated from successive residuals, over the configured noise.

    The result is the median over all readings. The relative weights of the sensors remain those of
    the estimate, and sensors with few readings have little influence.
    """
    each = [(_variance(column[there]), there.sum()) for column, there in _columns(residuals, used)]
    return math.sqrt(weighted_median(*np.transpose(each)))


def _noise_of_each(residuals: Array, used: Mask) -> Array:
    """Return the noise of each sensor from successive residuals, over the configured noise.

    The estimate of a sensor with few readings is close to `_level`; without readings it is NaN.
    """
    usual, noise = _level(residuals, used) ** 2, np.full(residuals.shape[1], np.nan)
    for k in np.flatnonzero(used.any(axis=0)):
        noise[k] = math.sqrt(_variance(residuals[used[:, k], k], usual))
    return noise


def _variance(residuals: Array, usual: float = 1.0) -> float:
    """Return the variance of successive residuals over the configured one, shrunk to `usual`."""
    squares = 0.5 * float((np.diff(residuals) ** 2).sum())
    return max((squares + SHRINK * usual) / (len(residuals) - 1 + SHRINK), LEAST_LEVEL)
