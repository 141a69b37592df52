"""Intervals of the unknowns that allow for errors of the model.

What errors would do to the readings makes the columns of a linear model: those of the process are
answers to it (`livepde.laws.error_columns`), those of sensors are added here. Single causes have
one column each, families many, with an amplitude for each shape in space and course in time. See
`livepde.verdict.evidence` for the average over them. Where the stored samples cannot be fitted
again, they are those of single causes on the innovations, from the sums of the verdict.
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
from livepde.laws.policies import Refit
from livepde.laws.refit import plausible
from livepde.laws.stored_samples import Passed, StoredSamples, principal
from livepde.linalg import Array, IntArray, Mask, nonfinite_allowed
from livepde.model import Model
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
RESPONSE = 1.0 / 30.0  # of the run: time constant of a slow sensor, as the shortest of `TIMES`
FEWEST = 20  # readings
SAME_ERROR = 1e-3  # relative difference of two errors of a sensor that are one
NEAR = 0.03  # posterior standard deviations within which a trajectory is that of the best fit
QUANTILE = 1.96  # standard deviations to the end of a 95 % interval
SHRINK = 10.0  # pairs of readings that the stated noise counts
OVERFLOW = "the answers of the process to errors overflow"
LEAST_LEVEL = 0.01  # least variance of the noise over the stated one that is believed


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
    """Return values at times as sensors of first order with a time constant show them.

    Between two samples, values are straight lines. NaN stays where it is.
    """
    found = values.copy()
    for k in range(1, len(times)):
        h = (times[k] - times[k - 1]) / constant
        rise = (values[k] - values[k - 1]) / h
        now = values[k] - rise + math.exp(-h) * (found[k - 1] - values[k - 1] + rise)
        found[k] = np.where(np.isfinite(now), now, values[k])
    return found


def _beyond_rounding(values: Array, terms: Array) -> Array:
    """Return `beyond_rounding` of each column."""
    each = zip(values.T, np.broadcast_to(terms, values.shape).T, strict=True)
    return np.column_stack([beyond_rounding(own, of) for own, of in each])


def _misplaced(
    problem: Problem, states: Sequence[Array]
) -> Iterator[tuple[Array, Array, tuple[Array, Array]]]:
    """Iterate over the axes along which sensors may be off.

    Slopes of the readings there, (samples, sensors), usual shifts, and depths from either end of
    the domain, (sensors,).
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
    return np.kron(np.diag(1.0 / (1.0 + modes)), one)


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


@nonfinite_allowed()  # a cause that overflows has no evidence
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


def _read(model: Model) -> set[str]:
    """Return the unknowns that equation or initial state read: the others are errors of sensors.

    Probed at a drawn state, with all inputs one.
    """
    rng = np.random.default_rng(0)
    latent, inputs = model.latent, Inputs(dict.fromkeys(model.channels, 1.0))
    moment, u = Moment(0.3, inputs), rng.uniform(0.5, 1.5, model.X.dim)
    q = latent.value(latent.prior + latent.deviations * rng.standard_normal(latent.dim))
    with np.errstate(all="ignore"):  # what is not finite is read
        parts = [model.physical_A.matrix("v", "q", moment, u=u, q=q)]
        if (form := model.form_initial) is not None:
            parts.append(form.matrix("v", "q", moment, q=latent.prior))
    fields = model.state_space.of_fields  # a slow sensor alone reads its time constant
    found = np.sum([fields @ abs(part) for part in parts], axis=0)
    return {name for name in latent.parts if found[model.parameter_space.part(name)].any()}


def _allowed(
    filter_: Filter, x: FilterState, ends: tuple[Array, Array], narrow: Array, std: Array
) -> Iterator[Allowed]:
    """Iterate over the unknowns, with intervals that allow for errors of the model.

    `ends`: of these, of the latent unknowns. `narrow`, `std`: standard deviations by the noise
    alone, and those that are reported.
    """
    problem, reduction = filter_.problem, filter_.reduction
    latent = problem.model.latent
    scalars = {n: p.unknown for n, p in latent.parts.items() if isinstance(p.unknown, Scalar)}
    corrections = {name for name, unknown in scalars.items() if unknown.corrects}  # of inputs
    own = (latent.parts.keys() - _read(problem.model)) | corrections
    known = reduction.bounded(filter_.estimate(x)[0])
    # An interval about a value beyond a bound is one about the bound: the half within it is left.
    middle = 0.5 * (ends[0] + ends[1])
    beyond = reduction.bounded(middle) - middle
    wide = (ends[0] + beyond, ends[1] + beyond)
    both = (known, *wide, known - QUANTILE * std, known + QUANTILE * std)
    value, low_end, high_end, plain_low, plain_high = (
        latent.value(reduction.bounded(one)) for one in both
    )
    # The plain interval is wider where innovations follow each other: it is a part of this one.
    ends = np.minimum(low_end, plain_low), np.maximum(high_end, plain_high)
    widths = 2.0 * QUANTILE * narrow
    wider = (both[2] - both[1]) / np.where(widths > 0.0, widths, np.inf)
    for name, item in latent.parts.items():
        part = problem.model.parameter_space.part(name)
        labels = item.block.labels(name)
        prior, unit = item.unknown.prior, item.unknown.unit
        usual = USUAL * float(prior.latent_std) if prior.symmetric else 0.0
        shown = [one[part] for one in (value, *ends, plain_low, plain_high)]
        every = np.array([*shown, wider[item.part][: item.size]])  # of harmonics, the constant
        if len(labels) != item.size:  # a field
            labels, every = [name], _root_mean_squares(every)[:, None]
        for label, numbers in zip(labels, every.T.tolist(), strict=True):
            yield Allowed.of(label, unit, numbers, usual=usual, of_sensor=name in own)


def _root_mean_squares(every: Array) -> Array:
    """Return size, ends of both intervals and their ratio of a field, from those of its numbers."""
    value, *ends, wider = every
    size, ratio = (float(np.sqrt((one**2).mean())) for one in (value, wider))
    off = [float(np.sqrt(((end - value) ** 2).mean())) for end in ends]
    return np.array([size, size - off[0], size + off[1], size - off[2], size + off[3], ratio])


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

    own = add(answers)
    columns_of = zip(errors.first, errors.answers, strict=True)
    family: dict[str, list[tuple[float, IntArray, int]]] = {}
    for first, (answer, course) in columns_of:
        columns = own[first : first + course.size]
        if answer.kind in ("source", "conductivity", "flow"):
            family.setdefault(answer.kind, []).append((answer.mode, columns, course.size))
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
    # Beside a missing position of a sensor that moves, rates are not known.
    known = np.isfinite(Z).all(axis=1)
    J, z, Z = J[known], z[known], Z[known]
    columns, most = map(np.array, zip(*causes, strict=True))
    single = Causes(columns, most, CAUSE_SIZES)
    return LinearModel(J=J, Z=Z, z=z, T=T), single, list(_families(families))


def _basis_of_sensors(samples: StoredSamples, J: Array) -> Array:
    """Return an orthonormal basis of what unknowns of sensors do to the readings, (readings, k).

    `J`: derivatives of these by the coordinates xi, (readings, r).
    """
    filter_ = samples.filter
    model, own = filter_.problem.model, np.zeros(filter_.reduction.size, dtype=bool)
    read = _read(model)
    for name, evolution in zip(model.latent.parts, filter_.reduction.evolutions, strict=True):
        own[evolution.part] = name not in read
    if not own.any():
        return np.zeros((len(J), 0))
    by_unknown = J @ np.linalg.pinv(samples.start.C[0].T)
    some = by_unknown[:, own]
    some[~np.isfinite(some).all(axis=1)] = 0.0
    sizes = np.linalg.norm(some, axis=0)
    found: Array = scipy.linalg.orth(some / np.where(sizes > 0.0, sizes, 1.0))
    return found


def _beyond(effect: Array, basis: Array) -> Array:
    """Return an effect, (readings, 1), or zeros if it is that of an unknown of a sensor.

    An error that is an unknown is no error of the model: its prior says how large it may be.
    """
    known = np.where(np.isfinite(effect), effect, 0.0)
    rest = known - basis @ (basis.T @ known)
    same = np.linalg.norm(rest) <= SAME_ERROR * np.linalg.norm(known)
    return np.zeros_like(effect) if same else effect


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
