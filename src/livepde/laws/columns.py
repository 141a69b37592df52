"""Whether one column of the data explains a misfit: late, off, scaled, turned, exchanged ...

An error of a column is tried on the stored samples themselves: the column is corrected, and the
model is fitted again. So inputs and sensors are compared alike, and lags and units are exact.
An error of one size theta, which changes the residuals by g, first gets the size where the linear
model of the samples has its minimum. With H = I + J^T J and h = J^T g at the best fit,

    theta = -g r / (g g - h H^-1 h),

and the cost falls by (g r)^2 / (2 (g g - h H^-1 h)). The most promising errors are fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, combinations

import numpy as np

from livepde.fem import Channel
from livepde.laws.column_errors import UNITS, Error, cause_of, units_of
from livepde.laws.filter_state import FilterState, unaccompanied
from livepde.laws.gate import Gate, near_most, near_neighbours
from livepde.laws.history import intervals_since
from livepde.laws.one_member import filtered
from livepde.laws.policies import Refit
from livepde.laws.refit import WILD, Found, refitted
from livepde.laws.sensitivity_state import MOST_TRIED, SensitivityState, SensitivityWork
from livepde.laws.stored_samples import Passed, StoredSamples, principal
from livepde.linalg import Array, nonfinite_allowed
from livepde.linalg.member_arrays import changed
from livepde.verdict import Cause
from livepde.verdict.directions import boundary_lifts

FEWEST_ROWS, FEWEST_READINGS = 20, 40
MOST_WORK = 4e8  # coefficients of states that all passes may compute
PASSES = 6  # over the samples that a fit may take
ROUNDS = 4  # fits of an error whose size changes from one to the next
# Errors of each kind that are fitted, at most; and what the linear model must promise of a further
# one, over the first: an early boundary looks like a late sensor next to it.
TRIED = {"unit": 1, "exchange": 2, "offset": 1, "gain": 2, "lag": 2}
RIVAL = 0.8
STEP = 0.02  # of the range of a column, or of its size: the error of which g is taken
LONGEST = 0.2  # of the samples, by which a column may be late
PLAIN = 0.02  # range of a column over its size below which it is constant
SAME = 1e-6  # of an interval: times that are the same but for rounding
SETTLED = 0.02  # relative change of a size that is none
# Of the misfit, and of the noise: within the smaller one nothing is left to explain, and the error
# with fewer numbers is likelier.
CLOSE, SLIGHT = 0.05, 0.2
# Where unknowns move: samples that a filter follows in a pass, and in all passes; the share of a
# misfit that is worth a word, and how many such errors are named.
MOST_FOLLOWED, MOST_STEPS = 300, 20_000
SOME, NAMED = 0.1, 3
LAGS = 16  # passes of a search for a longer lag, at most
SLIGHT_LAG = 0.02  # share that a lag of one sample has to explain before longer ones are tried


@dataclass(frozen=True, eq=False)
class Columns:
    """The stored samples of one member as columns that may be wrong."""

    # Parts of the law without gate, and the member with the first samples of its window.
    work: SensitivityWork
    state: SensitivityState
    places: dict[str, int]  # column of the log of each sensor and each input
    inputs: tuple[str, ...]  # names of the inputs
    options: Refit  # those of a fit

    @classmethod
    def of(cls, work: SensitivityWork, state: SensitivityState) -> Columns | str:
        """Return the columns of one member, or why they cannot be looked at."""
        why, options = work.unstored(state), work.refit
        if work.tried and state.trial.shape[1]:  # noise of inputs is that of the readings here
            why, state = "", work.tried_samples(state)
        if why or options is None:
            return why
        problem = work.filter.problem
        names, channels = problem.observed.names, problem.channels
        inputs = tuple(name for name in channels if name in problem.model.channels)
        places = {name: 1 + k for k, name in enumerate(names)}
        first = 1 + 2 * len(names)
        places |= {name: first + channels.index(name) for name in inputs}
        log = state.log[:, int(state.window[0]) :]
        log = log[:, np.isfinite(log[0, :, 0])]
        most = _most_rows(work, len(places), len(inputs))
        log = log[:, :most].copy()
        if lacking := _lacking(log, len(names), most):
            return lacking
        own = log[0][:, 1 + len(names) : first]
        own[:] = np.where(np.isnan(own), work.filter.noise, own)
        open_gate = replace(work.options, gate=Gate())
        zero = np.zeros(1, dtype=np.int64)
        begun = changed(state, log=log, window=zero)
        return cls(replace(work, options=open_gate), begun, places, inputs, options)._without_wild

    @property
    def _without_wild(self) -> Columns:
        """The same without readings that are far off all others."""
        samples = StoredSamples.of(self.work, self.state)
        wild = ~(near_neighbours(samples.readings, WILD) & near_most(samples.readings, WILD))
        log, first = self.state.log.copy(), self.state.log.shape[1] - len(wild)
        log[0, first:, 1 : 1 + wild.shape[1]][wild] = np.nan
        return replace(self, state=changed(self.state, log=log))

    def samples(self, error: Error | None = None, *, from_prior: bool = False) -> StoredSamples:
        """Return the samples, with the columns of an error corrected.

        A fit of them begins at the last fit, or at the prior mean.
        """
        state = self.state if error is None else self.corrected(error)
        begun = changed(state, now=self.state.start) if from_prior else state
        return StoredSamples.of(self.work, begun)

    def corrected(self, error: Error) -> SensitivityState:
        log, names = self.state.log.copy(), error.names
        at = [self.places[name] for name in names]
        values = log[0][:, at]
        if error.kind == "exchange":
            values = values[:, ::-1].copy()
            for k, name in enumerate(names):
                if name not in self.inputs:
                    continue
                # A sensor has no reading where the stored samples begin; an input needs a value.
                known = np.flatnonzero(np.isfinite(values[:, k]))
                last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
                values[:, k] = values[known[np.maximum(last, 0)], k]
            if not set(names) & set(self.inputs):  # the noise of a reading goes with it
                noise = [place + len(self.work.filter.noise) for place in at]
                log[0][:, noise] = log[0][:, noise[::-1]]
        elif error.kind == "offset":
            values = values - error.size
        elif error.kind == "lag":
            values = self._later(names[0], values[:, 0], error.size)[:, None]
        else:
            factor, constant = error.correction
            values = factor * values + constant
            if names[0] not in self.inputs:  # else readings that shrink to nothing would fit best
                log[0][:, at[0] + len(self.work.filter.noise)] *= abs(factor)
        log[0][:, at] = values
        return changed(self.state, log=log, start=self._start(log, names))

    def _start(self, log: Array, names: Sequence[str]) -> FilterState:
        """Return the start with other columns: an initial state that is made of readings moves."""
        start, made = self.state.start, self.work.filter.problem.initial_readings
        if not self.state.opening[0]:
            return start
        for name in set(names) & set(made):
            old, new = (rows[0][:, self.places[name]] for rows in (self.state.log, log))
            there = np.isfinite(old) & np.isfinite(new)
            shift = (new - old)[there][:1].sum()
            start = changed(start, u=start.u + shift * made[name].weight)
        return start

    def _later(self, name: str, values: Array, by: float) -> Array:
        """Return the values of a column that come later by a time; NaN stays where it is."""
        t, held = self.state.log[0, :, 0], self.work.filter.problem.control.held
        seen = np.isfinite(values)
        known, times, asked = values[seen], t[seen], t + by
        near = SAME * self.interval  # late by whole samples, a row is met but for rounding
        if name in held.last:
            place = np.searchsorted(times, asked + near, side="right") - 1
        elif name in held.next:
            place = np.searchsorted(times, asked - near, side="left")
        else:
            return np.where(seen, np.interp(asked, times, known), np.nan)
        return np.where(seen, known[np.clip(place, 0, len(known) - 1)], np.nan)

    def whole(self, name: str) -> bool:
        """Whether a column can only be late by whole samples.

        Readings between two samples would have less noise, and what is held changes with a row.
        """
        return name not in self.inputs or name in self.work.filter.problem.control.held

    def column(self, name: str) -> Array:
        """Return the values of a column that are there."""
        values: Array = self.state.log[0, :, self.places[name]]
        return values[np.isfinite(values)]

    def unit(self, name: str) -> str:
        """Return the unit of a sensor or an input, of the state for its boundary values; or ""."""
        problem = self.work.filter.problem
        observed, single = problem.observed, problem.model.state_space.single
        if single and name in self.inputs and name in boundary_lifts(problem.model):
            return observed.unit
        sensors = dict(zip(observed.names, observed.units, strict=True))
        return (problem.model.channel_units | sensors).get(name, "")

    def cause(self, error: Error, share: float) -> Cause:
        """Return an error that explains a share of the misfit as a cause."""
        problem, first = self.work.filter.problem, error.names[0]
        of_sensor, time_unit = first in problem.observed.names, problem.model.time_unit
        return cause_of(error, share, self.unit(first), time_unit, of_sensor=of_sensor)

    @property
    def pairs(self) -> Iterator[tuple[str, str]]:
        """Columns that may have been exchanged: of another kind they have nothing in common."""
        boundary = self.work.filter.problem.model.boundary_values
        states = set(self.places) - set(self.inputs)
        states |= {value.name for value in boundary if isinstance(value, Channel)}
        for pair in combinations(self.places, 2):
            first, second = (self.column(name) for name in pair)
            if not len(first) or not len(second):
                continue
            apart = first.min() > second.max() or second.min() > first.max()
            if not apart or states.issuperset(pair):
                yield pair

    @property
    def without_size(self) -> Iterator[Error]:
        """Errors that have no size: other units that are known, and exchanges."""
        for name in self.places:
            expected = self.unit(name)
            for number, unit in enumerate(UNITS):
                if unit.expected and unit.expected == expected:
                    yield Error("unit", (name,), unit=number)
        for pair in self.pairs:
            yield Error("exchange", pair)

    @property
    def interval(self) -> float:
        """The usual time between samples."""
        return float(np.median(np.diff(self.state.log[0, :, 0])))


def _lacking(log: Array, sensors: int, most: int) -> str:
    """Return why so few rows of samples tell nothing of a column; empty if they are enough."""
    if most < FEWEST_ROWS:
        return "the mesh is too large, or the columns are too many, to try each"
    if np.isfinite(log[0, :, 1 : 1 + sensors]).sum() < FEWEST_READINGS:
        return f"fewer than {FEWEST_READINGS} readings are stored"
    return f"fewer than {FEWEST_ROWS} samples are stored" if log.shape[1] < FEWEST_ROWS else ""


def _most_rows(work: SensitivityWork, columns: int, inputs: int) -> int:
    """Return how many samples all passes can afford, with so many columns and inputs of them."""
    # At two places: errors of each input, a search for its lag, and all exchanges with an input.
    passes = 2 * inputs * (3 + columns + LAGS) + PASSES * ROUNDS * sum(TRIED.values())
    most = MOST_TRIED
    if work.filter.moves:  # units, exchanges, and lags of one sample and of more
        passes = columns * (5 + columns // 2) + LAGS * TRIED["lag"]
        most = min(MOST_FOLLOWED, MOST_STEPS // passes)
    each = work.filter.problem.model.X.dim * (1 + work.filter.reduction.size)
    return min(most, int(MOST_WORK / (passes * each)))


@dataclass(frozen=True, eq=False)
class _Fit:
    """The quadratic model of the cost about a trajectory, and its minimum."""

    one: Passed
    columns: Array
    inverse: Array
    step: Array
    cost: float

    @classmethod
    def about(cls, one: Passed) -> _Fit:
        used = np.isfinite(one.residuals)
        H, g = one.model(used)
        sizes, axes = principal(H)
        inverse = (axes / sizes) @ axes.T
        step = inverse @ g
        cost = one.cost(used) - 0.5 * float(g @ step)
        return cls(one, one.slopes[used], np.asarray(inverse), step, cost)

    def freed(self, g: Array) -> tuple[float, float]:
        """Return by how much the cost falls if residuals may change along g, and the size."""
        there = np.isfinite(self.one.residuals)
        along = np.where(np.isfinite(g), g, 0.0)[there]
        r = self.one.residuals[there] - self.columns @ self.step
        h = self.columns.T @ along
        den = float(along @ along - h @ self.inverse @ h)
        if not den > 1e-9 * float(along @ along):
            return 0.0, 0.0
        num = float(along @ r)
        return 0.5 * num**2 / den, -num / den


@nonfinite_allowed()  # such an error explains nothing
def likely_columns(columns: Columns, least: float) -> list[Cause]:
    """Return the errors of columns that explain most of the misfit, the likeliest first.

    None where the misfit is less than `least` times the noise.
    """
    if columns.work.filter.moves:
        return _likely_filtered(columns, least)
    samples, search = columns.samples(), _Trials(columns)
    found = search.refitted(samples)
    if found is None:
        return []
    base = _Fit.about(found.best)
    noise = _noise(found.best.residuals)
    misfit = 2.0 * base.cost - noise
    if not misfit > least * noise:
        return []
    # Where a column is grossly wrong the best fit is no place to ask what is.
    prior = samples.about(0.0 * found.best.xi)
    places = [base] if prior is None else [base, _Fit.about(prior)]
    promising = [item for at in places for item in search.promising(at, base.cost)]
    tried = _varied(sorted(promising, key=lambda item: -item[0]))
    close = min(CLOSE, SLIGHT * noise / misfit)
    kept = search.explaining(tried, close, lambda cost: 1.0 - (2.0 * cost - noise) / misfit)
    kept.sort(key=lambda item: close * item[1].numbers - item[0])
    return [columns.cause(error, share) for share, error in kept if share > 0.0]


class _Trials:
    """The errors of some columns, and the misfit that each explains."""

    def __init__(self, columns: Columns) -> None:
        self.columns = columns
        self.options = replace(columns.options, passes=min(columns.options.passes, PASSES))
        self.base = columns.samples()
        self.vain = len(self.base) if columns.state.fit.screened[0] else 0

    def refitted(self, samples: StoredSamples) -> Found | None:
        """Return the end of a search; it begins at no other points where that was no use before."""
        found = refitted(samples, self.options, last=False, screened=self.vain)
        if found is not None and found.screened:
            self.vain = len(samples)
        return found

    def explaining(
        self, tried: Sequence[Error], close: float, share_of: Callable[[float], float]
    ) -> list[tuple[float, Error]]:
        """Return errors as they were fitted, and the share of the misfit that each explains.

        `close`: a share that is nothing. `share_of`: the share, from the cost of a fit.
        """
        kept: list[tuple[float, Error]] = []
        for error in tried:
            if any(share >= 1.0 - close and one.numbers <= error.numbers for share, one in kept):
                continue  # nothing is left to explain
            end = self.fitted(error)
            if end is not None:
                kept.append((share_of(end[0]), end[1]))
        return kept

    def promising(self, at: _Fit, cost: float) -> Iterator[tuple[float, Error]]:
        """Iterate over errors, and by how much they lower a cost by the model about a fit."""
        each = [*(self._of_one(at, name) for name in self.columns.places), self._exchanged(at)]
        for gained, error in chain(*each):
            yield cost - at.cost + gained, error

    def _of_one(self, base: _Fit, name: str) -> Iterator[tuple[float, Error]]:
        columns, values = self.columns, self.columns.column(name)
        if len(values) < FEWEST_ROWS // 2:
            return
        driving, steps = name in columns.inputs, self._steps(values)
        if "lag" in steps and driving and columns.whole(name):
            del steps["lag"]
            yield self._switched_late(base, name)
        slopes: dict[str, Array] = {}
        for kind, step in steps.items():
            g = self._change(base, Error(kind, (name,), step))
            if g is None:
                continue
            slopes[kind] = g / step
            gained, theta = base.freed(slopes[kind])
            # Correcting by theta changes the residuals by theta g: so the column is off by theta.
            yield gained, Error(kind, (name,), self._bounded(kind, name, theta))
        if steps.keys() - slopes.keys() <= {"lag"}:
            units = self._units(base, name, slopes) if driving else self._sensor_units(base, name)
            yield from units

    def _steps(self, values: Array) -> dict[str, float]:
        """Return kind -> size of the errors whose slopes are taken; of a constant, the offset."""
        span, size = float(np.ptp(values)), float(np.abs(values).max())
        steps = {"offset": STEP * (span if span > 0.0 else max(size, 1.0))}
        if span > PLAIN * size:
            steps |= {"gain": STEP, "lag": self.columns.interval}
        return steps

    def _switched_late(self, base: _Fit, name: str) -> tuple[float, Error]:
        """Return how late an input is that is held, and by how much that lowers the cost.

        A switch has no derivative in time that would say how far it is to go.
        """
        columns = self.columns

        def gained(error: Error) -> float:
            one = columns.samples(error).about(base.one.xi)
            return -np.inf if one is None else base.cost - _Fit.about(one).cost

        longest = int(LONGEST * columns.state.log.shape[1])
        return _Lag(name, columns.interval, longest, gained).best

    def _bounded(self, kind: str, name: str, theta: float) -> float:
        columns = self.columns
        if kind == "gain":
            return float(np.clip(theta, -0.9, 9.0))
        if kind == "lag":
            longest = LONGEST * columns.interval * columns.state.log.shape[1]
            lag = float(np.clip(theta, -longest, longest))
            step = columns.interval
            return step * round(lag / step) if columns.whole(name) else lag
        return theta

    def _units(
        self, base: _Fit, name: str, slopes: dict[str, Array]
    ) -> Iterator[tuple[float, Error]]:
        """Iterate over units that a column may be in, by the linear model of offset and gain."""
        values = self.columns.column(name)
        middle = float(values.mean())
        there = np.isfinite(base.one.residuals)
        for number in units_of(self.columns.unit(name), scaled=True):
            _, _, factor, constant, _ = UNITS[number]
            # values - offset, then divided by 1 + gain: to first order in the change of the column.
            change = (factor * middle + constant) - middle
            g = -change * slopes["offset"]
            if "gain" in slopes:
                # slopes["gain"] is the change by -values; about the middle it is that of the rest.
                about_middle = slopes["gain"] - middle * slopes["offset"]
                g = g - (factor - 1.0) * about_middle
            r = (base.one.residuals + np.where(np.isfinite(g), g, 0.0))[there]
            J, xi = base.columns, base.one.xi
            slope = J.T @ r - xi
            cost = 0.5 * float(r @ r + xi @ xi - slope @ base.inverse @ slope)
            yield base.cost - cost, Error("unit", (name,), unit=number)

    def _sensor_units(self, base: _Fit, name: str) -> Iterator[tuple[float, Error]]:
        """Iterate over the same of a sensor: the trajectory is the same."""
        # A case may have stated the wrong one of two units of temperature.
        for number in units_of(self.columns.unit(name), scaled=False):
            error = Error("unit", (name,), unit=number)
            yield base.cost - _Fit.about(self._seen(base, error)).cost, error

    def _seen(self, base: _Fit, error: Error) -> Passed:
        """Return the same trajectory as other sensors show it, with the noise of their columns."""
        new, one = self.columns.samples(error), base.one
        ratio = self.base.noise / new.noise
        residuals = new.readings - (self.base.readings - one.residuals) * ratio
        return replace(one, residuals=residuals, slopes=one.slopes * ratio[:, :, None])

    def _exchanged(self, base: _Fit) -> Iterator[tuple[float, Error]]:
        columns = self.columns
        for pair in columns.pairs:
            error = Error("exchange", pair)
            if self._only_sensors(error):
                one: Passed | None = self._seen(base, error)
            else:
                one = columns.samples(error).about(base.one.xi)
            if one is not None:
                yield base.cost - _Fit.about(one).cost, error

    def _change(self, base: _Fit, error: Error) -> Array | None:
        """Return by how much the correction of a column changes the residuals."""
        if self._only_sensors(error):
            if error.kind == "lag":
                return self._lagged(self.base, base.one, error.names[0], error.size)
            return self._seen(base, error).residuals - base.one.residuals
        r = self.columns.samples(error).residuals(base.one.xi)
        return None if r is None else r - base.one.residuals

    def _lagged(self, samples: StoredSamples, one: Passed, name: str, by: float) -> Array:
        """Return by how much residuals change if predictions of a sensor come later by a time.

        Shifted readings would change by their noise, too, which hides a slow signal.
        """
        predicted, place = samples.readings - one.residuals, self.columns.places[name] - 1
        t, h = samples.times, predicted[:, place]
        there, change = np.isfinite(h), np.zeros_like(predicted)
        change[:, place] = h - np.interp(t - by, t[there], h[there])
        return change

    def _only_sensors(self, error: Error) -> bool:
        return not set(error.names) & set(self.columns.inputs)

    def _end(self, error: Error, *, from_prior: bool) -> _Fit | None:
        """Return where a fit with a corrected column ends."""
        found = self.refitted(self.columns.samples(error, from_prior=from_prior))
        return None if found is None else _Fit.about(found.best)

    def fitted(self, error: Error) -> tuple[float, Error] | None:
        """Return the cost of a fit with a corrected column, and the error, its size improved.

        It begins at the last fit, which may be far off with the right columns, or at the prior
        mean, whichever ends better.
        """
        ends = {prior: self._end(error, from_prior=prior) for prior in (False, True)}
        costs = {prior: np.inf if end is None else end.cost for prior, end in ends.items()}
        from_prior = costs[True] < costs[False]
        fit = ends[from_prior]
        for number in range(ROUNDS):
            fit = self._end(error, from_prior=from_prior) if number else fit
            if fit is None:
                return None
            cost, used = fit.cost, error
            if not error.numbers:
                break
            again = self._improved(fit, error)
            if again is None or abs(again.size - error.size) <= SETTLED * abs(again.size):
                break
            error = again
        return cost, used

    def _improved(self, fit: _Fit, error: Error) -> Error | None:
        """Return an error with the size where the linear model about it has its minimum."""
        columns, values = self.columns, self.columns.column(error.names[0])
        step = {"offset": STEP * max(float(np.ptp(values)), 1e-12), "gain": STEP}
        h = step.get(error.kind, columns.interval)
        if error.kind == "lag" and self._only_sensors(error):
            change = self._lagged(columns.samples(error), fit.one, error.names[0], h)
        else:
            more = columns.samples(replace(error, size=error.size + h)).residuals(fit.one.xi)
            if more is None:
                return None
            change = more - fit.one.residuals
        _, theta = fit.freed(change / h)
        return replace(error, size=self._bounded(error.kind, error.names[0], error.size + theta))


def _likely_filtered(columns: Columns, least: float) -> list[Cause]:
    """Return the same where unknowns move, so that a filter has to follow the samples.

    Offsets and gains are known from the innovations. A lag is looked for in steps that double.
    """
    e = _innovations(columns, columns.state)
    if e is None:
        return []
    noise = _noise(e)
    misfit = float(np.nansum(e**2)) - noise
    if not misfit > least * noise:
        return []

    def share(error: Error) -> float:
        found = _innovations(columns, columns.corrected(error))
        return -np.inf if found is None else 1.0 - (float(np.nansum(found**2)) - noise) / misfit

    kept = [(share(error), error) for error in columns.without_size]
    longest = int(LONGEST * columns.state.log.shape[1])
    lags = [_Lag(name, columns.interval, longest, share) for name in columns.places]
    lags = sorted(lags, key=lambda lag: -lag.of(lag.first))[: TRIED["lag"]]
    kept += [lag.best for lag in lags if lag.of(lag.first) > SLIGHT_LAG]
    kept = sorted((one for one in kept if one[0] > SOME), key=lambda one: -one[0])[:NAMED]
    return [columns.cause(error, found) for found, error in kept]


@dataclass(frozen=True, eq=False)
class _Lag:
    """How late a column may be, in whole samples."""

    name: str
    interval: float
    longest: int  # samples
    share: Callable[[Error], float]  # of the misfit that an error explains
    known: dict[int, float] = field(default_factory=dict)

    def error(self, count: int) -> Error:
        """Return the error of a column that is so many samples late."""
        return Error("lag", (self.name,), count * self.interval)

    def of(self, count: int) -> float:
        """Return the share that such an error explains."""
        if count not in self.known:
            self.known[count] = self.share(self.error(count)) if count else 0.0
        return self.known[count]

    @property
    def first(self) -> int:
        """One sample, late or early, whichever explains more."""
        return max((-1, 1), key=self.of)

    @property
    def best(self) -> tuple[float, Error]:
        """The error that explains most, looked for in steps that double, and then halve."""
        best = self.first
        while abs(2 * best) <= self.longest and self.of(2 * best) > self.of(best):
            best *= 2
        step = abs(best) // 2
        while step:
            best = max((best - step, best, best + step), key=self.of)
            step //= 2
        return self.of(best), self.error(best)


def _innovations(columns: Columns, state: SensitivityState) -> Array | None:
    """Return normalised innovations of stored samples, (samples, sensors); None if a step fails."""
    # A noise that is found would grow with a misfit, and hide it.
    work = replace(
        columns.work.unaccompanied, options=replace(columns.work.options, adaptive=False)
    )
    x, found = unaccompanied(state.start), []
    for interval in intervals_since(state.log, work.filter.problem.channels):
        x, report = filtered(work, x, interval)
        if not report.status.ok:
            return None
        x = work.filter.relinearised(x)
        measured = np.isfinite(interval.z1)
        found.append(np.where(measured, x.innovations.newest[0], np.nan))
    return np.array(found)


def _varied(tried: Sequence[tuple[float, Error]]) -> list[Error]:
    """Return the most promising errors of each kind, those without free numbers first."""
    kept: list[Error] = []
    first: dict[str, float] = {}
    for gained, error in tried:
        same = [other for other in kept if other.kind == error.kind]
        new = all((one.names, one.unit) != (error.names, error.unit) for one in same)
        promises = gained > 0.0 and gained >= RIVAL * first.setdefault(error.kind, gained)
        if promises and new and len(same) < TRIED[error.kind]:
            kept.append(error)
    return sorted(kept, key=lambda error: error.numbers)


def _noise(residuals: Array) -> float:
    """Return the sum of squares of the noise, as successive differences show it."""
    total = 0.0
    for column in residuals.T:
        r = column[np.isfinite(column)]
        if len(r) > 1:
            total += len(r) * 0.5 * float((np.diff(r) ** 2).mean())
    return total
