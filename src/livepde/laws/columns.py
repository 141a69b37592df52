"""Search for an error of one column that explains a misfit: lag, offset, gain, unit, exchange.

Each candidate error is corrected in the stored samples, and the model is refitted. So inputs and
sensors are treated alike, and lags and units are exact. The initial size theta of an error, which
changes the residuals by g per unit, minimises the linear model of the samples. With
H = I + J^T J and h = J^T g at the best fit,

    theta = -g r / (g g - h H^-1 h),

and the cost decreases by (g r)^2 / (2 (g g - h H^-1 h)). The most promising errors are fitted.
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
MOST_WORK = 4e8  # maximum number of coefficients of states in all passes
PASSES = 6  # maximum number of passes over the samples in a fit
ROUNDS = 4  # maximum number of fits to improve the size of an error
# Maximum number of fitted errors of each kind, and least predicted decrease of the cost for another
# error, relative to the first: an early boundary resembles a late sensor next to it.
TRIED = {"unit": 1, "exchange": 2, "offset": 1, "gain": 2, "lag": 2}
RIVAL = 0.8
STEP = 0.02  # error for the difference quotient g, relative to the range or size of a column
LONGEST = 0.2  # longest lag of a column, as a fraction of the number of samples
PLAIN = 0.02  # range of a column, relative to its size, below which it is constant
SAME = 1e-6  # difference of times, relative to an interval, that is rounding
SETTLED = 0.02  # relative change of the size of an error at which it has converged
# Shares of the misfit and of the noise: the smaller value is a negligible misfit. Within it, the
# error with fewer free parameters is preferred.
CLOSE, SLIGHT = 0.05, 0.2
# If unknowns move: maximum number of samples in a filter pass, and of steps in all passes; least
# share of the misfit of a reported error, and maximum number of reported errors.
MOST_FOLLOWED, MOST_STEPS = 300, 20_000
LEAST_SHARE, NAMED = 0.1, 3
LAGS = 16  # maximum number of passes in a search for a longer lag
SLIGHT_LAG = 0.02  # least share explained by a lag of one sample before longer lags are tried


@dataclass(frozen=True, eq=False)
class Columns:
    """The stored samples of one member, whose columns may have errors."""

    # Parts of the law without gate, and the member with the first samples of its window.
    work: SensitivityWork
    state: SensitivityState
    places: dict[str, int]  # column of each sensor and each input in the log
    inputs: tuple[str, ...]  # names of the inputs
    options: Refit  # options of a fit

    @classmethod
    def of(cls, work: SensitivityWork, state: SensitivityState) -> Columns | str:
        """Return the columns of one member, or the reason why they cannot be tested."""
        why, options = work.unstored(state), work.refit
        if work.tried and state.trial.shape[1]:  # input noise is treated as noise of readings
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
        """The columns without outliers among the readings."""
        samples = StoredSamples.of(self.work, self.state)
        wild = ~(near_neighbours(samples.readings, WILD) & near_most(samples.readings, WILD))
        log, first = self.state.log.copy(), self.state.log.shape[1] - len(wild)
        log[0, first:, 1 : 1 + wild.shape[1]][wild] = np.nan
        return replace(self, state=changed(self.state, log=log))

    def samples(self, error: Error | None = None, *, from_prior: bool = False) -> StoredSamples:
        """Return the samples, with the columns of an error corrected.

        A fit of these samples starts at the last fit, or at the prior mean if `from_prior`.
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
                # An input requires values in all rows, a sensor has none at the first row.
                known = np.flatnonzero(np.isfinite(values[:, k]))
                last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
                values[:, k] = values[known[np.maximum(last, 0)], k]
            if not set(names) & set(self.inputs):  # the noise of readings is exchanged, too
                noise = [place + len(self.work.filter.noise) for place in at]
                log[0][:, noise] = log[0][:, noise[::-1]]
        elif error.kind == "offset":
            values = values - error.size
        elif error.kind == "lag":
            values = self._later(names[0], values[:, 0], error.size)[:, None]
        else:
            factor, constant = error.correction
            values = factor * values + constant
            if names[0] not in self.inputs:  # otherwise readings scaled to zero would fit best
                log[0][:, at[0] + len(self.work.filter.noise)] *= abs(factor)
        log[0][:, at] = values
        return changed(self.state, log=log, start=self._start(log, names))

    def _start(self, log: Array, names: Sequence[str]) -> FilterState:
        """Return the start for a corrected log: readings may determine the initial state."""
        start, initial = self.state.start, self.work.filter.problem.initial_readings
        if not self.state.opening[0]:
            return start
        for name in set(names) & set(initial):
            old, new = (rows[0][:, self.places[name]] for rows in (self.state.log, log))
            there = np.isfinite(old) & np.isfinite(new)
            shift = (new - old)[there][:1].sum()
            start = changed(start, u=start.u + shift * initial[name].weight)
        return start

    def _later(self, name: str, values: Array, by: float) -> Array:
        """Return a column evaluated at times later by `by`; NaN values remain NaN."""
        t, held = self.state.log[0, :, 0], self.work.filter.problem.control.held
        seen = np.isfinite(values)
        known, times, later = values[seen], t[seen], t + by
        near = SAME * self.interval  # a lag of whole samples meets a row up to rounding
        if name in held.last:
            place = np.searchsorted(times, later + near, side="right") - 1
        elif name in held.next:
            place = np.searchsorted(times, later - near, side="left")
        else:
            return np.where(seen, np.interp(later, times, known), np.nan)
        return np.where(seen, known[np.clip(place, 0, len(known) - 1)], np.nan)

    def whole(self, name: str) -> bool:
        """Return whether the lag of a column must be a whole number of samples.

        Readings interpolated between samples would have less noise; held inputs change with a row.
        """
        return name not in self.inputs or name in self.work.filter.problem.control.held

    def column(self, name: str) -> Array:
        """Return the finite values of a column."""
        values: Array = self.state.log[0, :, self.places[name]]
        return values[np.isfinite(values)]

    def unit(self, name: str) -> str:
        """Return the unit of a column, or ""; a boundary value has the unit of the state."""
        problem = self.work.filter.problem
        observed, single = problem.observed, problem.model.state_space.single
        if single and name in self.inputs and name in boundary_lifts(problem.model):
            return observed.unit
        sensors = dict(zip(observed.names, observed.units, strict=True))
        return (problem.model.channel_units | sensors).get(name, "")

    def cause(self, error: Error, share: float) -> Cause:
        """Return the cause for an error that explains a share of the misfit."""
        problem, first = self.work.filter.problem, error.names[0]
        of_sensor, time_unit = first in problem.observed.names, problem.model.time_unit
        return cause_of(error, share, self.unit(first), time_unit, of_sensor=of_sensor)

    @property
    def pairs(self) -> Iterator[tuple[str, str]]:
        """Pairs of columns that may be exchanged: both of the state, or with overlapping ranges."""
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
        """Errors without a size: known units instead of the expected ones, and exchanges."""
        for name in self.places:
            expected = self.unit(name)
            for number, unit in enumerate(UNITS):
                if unit.expected and unit.expected == expected:
                    yield Error("unit", (name,), unit=number)
        for pair in self.pairs:
            yield Error("exchange", pair)

    @property
    def interval(self) -> float:
        """The median time between samples."""
        return float(np.median(np.diff(self.state.log[0, :, 0])))


def _lacking(log: Array, sensors: int, most: int) -> str:
    """Return the reason why there are too few rows to test columns; empty if there are enough."""
    if most < FEWEST_ROWS:
        return "the mesh is too large, or the columns are too many, to try each"
    if np.isfinite(log[0, :, 1 : 1 + sensors]).sum() < FEWEST_READINGS:
        return f"fewer than {FEWEST_READINGS} readings are stored"
    return f"fewer than {FEWEST_ROWS} samples are stored" if log.shape[1] < FEWEST_ROWS else ""


def _most_rows(work: SensitivityWork, columns: int, inputs: int) -> int:
    """Return the maximum number of samples for the work of all passes; `inputs` of `columns`."""
    # At two fits: errors of each input, a search for its lag, and exchanges with an input.
    passes = 2 * inputs * (3 + columns + LAGS) + PASSES * ROUNDS * sum(TRIED.values())
    most = MOST_TRIED
    if work.filter.moves:  # units, exchanges, lags of one sample and longer lags
        passes = columns * (5 + columns // 2) + LAGS * TRIED["lag"]
        most = min(MOST_FOLLOWED, MOST_STEPS // passes)
    each = work.filter.problem.model.X.dim * (1 + work.filter.reduction.size)
    return min(most, int(MOST_WORK / (passes * each)))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Quadratic model of the cost about a trajectory, and its minimum."""

    passed: Passed
    slopes: Array
    inverse: Array
    step: Array
    cost: float

    @classmethod
    def about(cls, passed: Passed) -> _Fit:
        used = np.isfinite(passed.residuals)
        H, g = passed.model(used)
        sizes, axes = principal(H)
        inverse = (axes / sizes) @ axes.T
        step = inverse @ g
        cost = passed.cost(used) - 0.5 * float(g @ step)
        return cls(passed, passed.slopes[used], np.asarray(inverse), step, cost)

    def freed(self, g: Array) -> tuple[float, float]:
        """Return the decrease of the cost by a change of the residuals along g, and its size."""
        there = np.isfinite(self.passed.residuals)
        along = np.where(np.isfinite(g), g, 0.0)[there]
        r = self.passed.residuals[there] - self.slopes @ self.step
        h = self.slopes.T @ along
        den = float(along @ along - h @ self.inverse @ h)
        if not den > 1e-9 * float(along @ along):
            return 0.0, 0.0
        num = float(along @ r)
        return 0.5 * num**2 / den, -num / den


@nonfinite_allowed()  # a fit that overflows explains nothing
def likely_columns(columns: Columns, least: float) -> list[Cause]:
    """Return the errors of columns that explain most of the misfit, the likeliest first.

    The list is empty if the misfit is less than `least` times the noise.
    """
    if columns.work.filter.moves:
        return _likely_filtered(columns, least)
    samples, search = columns.samples(), _Trials(columns)
    fit = search.refitted(samples)
    if fit is None:
        return []
    base = _Fit.about(fit.best)
    noise = _noise(fit.best.residuals)
    misfit = 2.0 * base.cost - noise
    if not misfit > least * noise:
        return []
    # With a gross error the best fit is biased: errors are linearised about the prior mean, too.
    prior = samples.about(0.0 * fit.best.xi)
    points = [base] if prior is None else [base, _Fit.about(prior)]
    promising = [item for at in points for item in search.promising(at, base.cost)]
    tried = _selected(sorted(promising, key=lambda item: -item[0]))
    close = min(CLOSE, SLIGHT * noise / misfit)
    kept = search.explaining(tried, close, lambda cost: 1.0 - (2.0 * cost - noise) / misfit)
    kept.sort(key=lambda item: close * item[1].numbers - item[0])
    return [columns.cause(error, share) for share, error in kept if share > 0.0]


class _Trials:
    """Candidate errors of columns, and the share of the misfit that each explains."""

    def __init__(self, columns: Columns) -> None:
        self.columns = columns
        self.options = replace(columns.options, passes=min(columns.options.passes, PASSES))
        self.base = columns.samples()
        self.screened = len(self.base) if columns.state.fit.screened[0] else 0

    def refitted(self, samples: StoredSamples) -> Found | None:
        """Return the fit of samples; further starting points are skipped if they failed before."""
        fit = refitted(samples, self.options, last=False, screened=self.screened)
        if fit is not None and fit.screened:
            self.screened = len(samples)
        return fit

    def explaining(
        self, tried: Sequence[Error], close: float, share_of: Callable[[float], float]
    ) -> list[tuple[float, Error]]:
        """Return the fitted errors, and the share of the misfit that each explains.

        `close`: negligible share. `share_of`: function from the cost of a fit to the share.
        """
        kept: list[tuple[float, Error]] = []
        for error in tried:
            if any(share >= 1.0 - close and e.numbers <= error.numbers for share, e in kept):
                continue  # a simpler error explains the misfit
            end = self.fitted(error)
            if end is not None:
                kept.append((share_of(end[0]), end[1]))
        return kept

    def promising(self, at: _Fit, cost: float) -> Iterator[tuple[float, Error]]:
        """Iterate over errors, and the decrease of the cost in the linear model about a fit."""
        each = [*(self._candidates(at, name) for name in self.columns.places), self._exchanged(at)]
        for gained, error in chain(*each):
            yield cost - at.cost + gained, error

    def _candidates(self, base: _Fit, name: str) -> Iterator[tuple[float, Error]]:
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
            # A correction by theta changes the residuals by theta g: the error has the size theta.
            yield gained, Error(kind, (name,), self._bounded(kind, name, theta))
        if steps.keys() - slopes.keys() <= {"lag"}:
            units = self._units(base, name, slopes) if driving else self._sensor_units(base, name)
            yield from units

    def _steps(self, values: Array) -> dict[str, float]:
        """Return kind -> size of the difference quotients; a constant column has only an offset."""
        span, size = float(np.ptp(values)), float(np.abs(values).max())
        steps = {"offset": STEP * (span if span > 0.0 else max(size, 1.0))}
        if span > PLAIN * size:
            steps |= {"gain": STEP, "lag": self.columns.interval}
        return steps

    def _switched_late(self, base: _Fit, name: str) -> tuple[float, Error]:
        """Return the decrease of the cost by the best lag of a held input, and the lag.

        The lag is searched, because a switch has no derivative in time.
        """
        columns = self.columns

        def gained(error: Error) -> float:
            passed = columns.samples(error).about(base.passed.xi)
            return -np.inf if passed is None else base.cost - _Fit.about(passed).cost

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
        """Iterate over possible units of an input, by the linear model of offset and gain."""
        values = self.columns.column(name)
        middle = float(values.mean())
        there = np.isfinite(base.passed.residuals)
        for number in units_of(self.columns.unit(name), scaled=True):
            _, _, factor, constant, _ = UNITS[number]
            # The conversion is an offset at the middle and a gain about it, to first order.
            change = (factor * middle + constant) - middle
            g = -change * slopes["offset"]
            if "gain" in slopes:
                # slopes["gain"] is the effect of -values: subtract its value at the middle.
                about_middle = slopes["gain"] - middle * slopes["offset"]
                g = g - (factor - 1.0) * about_middle
            r = (base.passed.residuals + np.where(np.isfinite(g), g, 0.0))[there]
            J, xi = base.slopes, base.passed.xi
            slope = J.T @ r - xi
            cost = 0.5 * float(r @ r + xi @ xi - slope @ base.inverse @ slope)
            yield base.cost - cost, Error("unit", (name,), unit=number)

    def _sensor_units(self, base: _Fit, name: str) -> Iterator[tuple[float, Error]]:
        """Iterate over possible units of a sensor, which do not change the trajectory."""
        # The configured unit of a temperature may be wrong.
        for number in units_of(self.columns.unit(name), scaled=False):
            error = Error("unit", (name,), unit=number)
            yield base.cost - _Fit.about(self._corrected(base, error)).cost, error

    def _corrected(self, base: _Fit, error: Error) -> Passed:
        """Return the trajectory with residuals and noise for corrected columns of sensors."""
        new, passed = self.columns.samples(error), base.passed
        ratio = self.base.noise / new.noise
        residuals = new.readings - (self.base.readings - passed.residuals) * ratio
        return replace(passed, residuals=residuals, slopes=passed.slopes * ratio[:, :, None])

    def _exchanged(self, base: _Fit) -> Iterator[tuple[float, Error]]:
        columns = self.columns
        for pair in columns.pairs:
            error = Error("exchange", pair)
            if self._only_sensors(error):
                passed: Passed | None = self._corrected(base, error)
            else:
                passed = columns.samples(error).about(base.passed.xi)
            if passed is not None:
                yield base.cost - _Fit.about(passed).cost, error

    def _change(self, base: _Fit, error: Error) -> Array | None:
        """Return the change of residuals by the correction of a column; None if a step fails."""
        if self._only_sensors(error):
            if error.kind == "lag":
                return self._lagged(self.base, base.passed, error.names[0], error.size)
            return self._corrected(base, error).residuals - base.passed.residuals
        r = self.columns.samples(error).residuals(base.passed.xi)
        return None if r is None else r - base.passed.residuals

    def _lagged(self, samples: StoredSamples, passed: Passed, name: str, by: float) -> Array:
        """Return the change of the residuals if the predictions of a sensor are delayed by `by`.

        A shift of the readings would also shift their noise, which hides a slow signal.
        """
        predicted, place = samples.readings - passed.residuals, self.columns.places[name] - 1
        t, h = samples.times, predicted[:, place]
        there, change = np.isfinite(h), np.zeros_like(predicted)
        change[:, place] = h - np.interp(t - by, t[there], h[there])
        return change

    def _only_sensors(self, error: Error) -> bool:
        return not set(error.names) & set(self.columns.inputs)

    def _end(self, error: Error, *, from_prior: bool) -> _Fit | None:
        """Return the fit with a corrected column; None if it fails."""
        fit = self.refitted(self.columns.samples(error, from_prior=from_prior))
        return None if fit is None else _Fit.about(fit.best)

    def fitted(self, error: Error) -> tuple[float, Error] | None:
        """Return the cost of a fit with a corrected column, and the error with improved size.

        The fit starts at the last fit or the prior mean, whichever reaches the lower cost: with
        correct columns, the last fit may be a poor start.
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
            improved = self._improved(fit, error)
            if improved is None or abs(improved.size - error.size) <= SETTLED * abs(improved.size):
                break
            error = improved
        return cost, used

    def _improved(self, fit: _Fit, error: Error) -> Error | None:
        """Return an error with the size at the minimum of the linear model about it."""
        columns, values = self.columns, self.columns.column(error.names[0])
        step = {"offset": STEP * max(float(np.ptp(values)), 1e-12), "gain": STEP}
        h = step.get(error.kind, columns.interval)
        if error.kind == "lag" and self._only_sensors(error):
            change = self._lagged(columns.samples(error), fit.passed, error.names[0], h)
        else:
            shifted = columns.samples(replace(error, size=error.size + h)).residuals(fit.passed.xi)
            if shifted is None:
                return None
            change = shifted - fit.passed.residuals
        _, theta = fit.freed(change / h)
        return replace(error, size=self._bounded(error.kind, error.names[0], error.size + theta))


def _likely_filtered(columns: Columns, least: float) -> list[Cause]:
    """Return the likely errors if unknowns move, by filter passes over the samples.

    Offsets and gains follow from the innovations: only units, exchanges and lags are searched.
    """
    e = _innovations(columns, columns.state)
    if e is None:
        return []
    noise = _noise(e)
    misfit = float(np.nansum(e**2)) - noise
    if not misfit > least * noise:
        return []

    def share(error: Error) -> float:
        new = _innovations(columns, columns.corrected(error))
        return -np.inf if new is None else 1.0 - (float(np.nansum(new**2)) - noise) / misfit

    kept = [(share(error), error) for error in columns.without_size]
    longest = int(LONGEST * columns.state.log.shape[1])
    lags = [_Lag(name, columns.interval, longest, share) for name in columns.places]
    lags = sorted(lags, key=lambda lag: -lag.of(lag.first))[: TRIED["lag"]]
    kept += [lag.best for lag in lags if lag.of(lag.first) > SLIGHT_LAG]
    notable = (item for item in kept if item[0] > LEAST_SHARE)
    kept = sorted(notable, key=lambda item: -item[0])[:NAMED]
    return [columns.cause(error, explained) for explained, error in kept]


@dataclass(frozen=True, eq=False)
class _Lag:
    """Search for the lag of a column, in whole samples."""

    name: str
    interval: float
    longest: int  # maximum number of samples
    share: Callable[[Error], float]  # objective to maximise, such as the explained share
    known: dict[int, float] = field(default_factory=dict)

    def error(self, count: int) -> Error:
        """Return the error of a column with a lag of `count` samples."""
        return Error("lag", (self.name,), count * self.interval)

    def of(self, count: int) -> float:
        """Return the objective for a lag of `count` samples."""
        if count not in self.known:
            self.known[count] = self.share(self.error(count)) if count else 0.0
        return self.known[count]

    @property
    def first(self) -> int:
        """The better lag of -1 and 1 samples."""
        return max((-1, 1), key=self.of)

    @property
    def best(self) -> tuple[float, Error]:
        """Objective and error of the best lag, by a search with doubling, then halving steps."""
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
    # An adaptive noise level would grow with a misfit, and hide it.
    work = replace(
        columns.work.unaccompanied, options=replace(columns.work.options, adaptive=False)
    )
    x, rows = unaccompanied(state.start), []
    for interval in intervals_since(state.log, work.filter.problem.channels):
        x, report = filtered(work, x, interval)
        if not report.status.ok:
            return None
        x = work.filter.relinearised(x)
        measured = np.isfinite(interval.z1)
        rows.append(np.where(measured, x.innovations.newest[0], np.nan))
    return np.array(rows)


def _selected(tried: Sequence[tuple[float, Error]]) -> list[Error]:
    """Return the most promising errors of each kind, errors without free parameters first."""
    kept: list[Error] = []
    first: dict[str, float] = {}
    for gained, error in tried:
        same = [other for other in kept if other.kind == error.kind]
        new = all((other.names, other.unit) != (error.names, error.unit) for other in same)
        promises = gained > 0.0 and gained >= RIVAL * first.setdefault(error.kind, gained)
        if promises and new and len(same) < TRIED[error.kind]:
            kept.append(error)
    return sorted(kept, key=lambda error: error.numbers)


def _noise(residuals: Array) -> float:
    """Return the sum of squares of the noise, estimated from successive differences."""
    total = 0.0
    for column in residuals.T:
        r = column[np.isfinite(column)]
        if len(r) > 1:
            total += len(r) * 0.5 * float((np.diff(r) ** 2).mean())
    return total
