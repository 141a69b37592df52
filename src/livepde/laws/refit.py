"""The refit: the most probable constant unknowns given the stored samples, from any honest prior.

Levenberg-Marquardt steps within a trust region in prior standard deviations (More 1978, Conn, Gould
and Toint 2000), with a second-order part that follows curved valleys (Transtrum and Sethna 2012).
Where the end does not explain the samples, the search begins again at the best of some screened
points. The gate acts once a search has ended, and may take back readings.

A refit that is due is made at once, or in a thread while samples continue. It is a function of the
state where it began, so that it may run at any time, and again after a restart. When the filter
goes over to it depends on the number of samples alone.
"""

from __future__ import annotations

import math
import threading
from concurrent.futures import Future
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import numpy as np
import scipy

from livepde.laws.assimilation import assimilate
from livepde.laws.filter import Filter
from livepde.laws.filter_state import FilterState
from livepde.laws.gate import FEW, near_most, near_neighbours, usual_size
from livepde.laws.history import intervals_since
from livepde.laws.iterated_smoother import HOLDS, apart, iterate_starts, usual
from livepde.laws.law import numerical
from livepde.laws.policies import Refit
from livepde.laws.sensitivity_state import (
    FitState,
    Fork,
    SensitivityState,
    SensitivityWork,
    new_window,
)
from livepde.laws.step_diagnostics import Diagnostics
from livepde.laws.stored_samples import Passed, StoredSamples, principal
from livepde.linalg import Array, Mask, nonfinite_allowed
from livepde.linalg.member_arrays import changed, put_each, take

DELTA = 1.5  # prior standard deviations of the first step at most: 0.5 to 3 do much the same
ENDS = 0.03  # posterior standard deviations of a last step
ENDS_EARLY = 1.0  # the same where the samples will be fitted again when there are twice as many
ACCEPTED = 1e-4  # least ratio of actual and predicted decrease of the cost
POOR, GOOD = 0.25, 0.75  # ratios below and above which the trust region changes
SHORTER = 0.5  # radius of the next trial over that of the one before
CLOSE = 0.1  # part of a step over which its second derivative is taken
SHORT = 0.1  # prior standard deviations of a step whose second-order part is left out
CURVED = 0.75  # largest second-order part of a step over its first-order part (Transtrum 2012)
SHORTEST, LEAST = 1e-7, 1e-9  # step, and predicted decrease relative to the cost, that are none
LARGE, DOUBTFUL = 30.0, 2.5  # mean squares of residuals that need a new search, the second one
FAR = 6.0  # prior standard deviations from the prior: no honest prior is so wrong
UNSURE = 0.5  # only where a direction keeps more than this share of its prior standard deviation
ROUNDING = 1e-12  # share of a variance
AT_BOUND = 1e-6  # prior standard deviations from a bound at which a fit is held by it
QUANTILE, BLOCKS = 0.8, 8  # of mean squares, over sensors and blocks of samples
SCREENED, FITTED, SPREAD = 32, 3, 1.5  # points, best of them that are tried, and their deviation
# Searches from elsewhere that must end at the best trajectory, and what they leave of their misfit
# at most: where no reading sees an unknown all of them end at the prior, and prove nothing.
AGREED, LEFT = 3, 0.5
# Samples over those of a search that began again in vain, from which another one does: the model is
# most likely in error. The second at the end of a run.
ANEW, ANEW_LAST = 4, 2
STAYS = 1.0  # prior standard deviations within which that end is the same
LAST, LAST_SPREAD = 8, 1.2  # fits from drawn points, before the search is given up
GATE_ROUNDS = 4
WILD = 30.0  # usual deviations beyond which a reading is refused before there is a fit
GATE = 4.0  # the same for residuals, from those before and after them
LEVERAGE = 0.1  # least share of its noise that the residual of a reading in use is taken to keep
AT_ONCE = 64  # samples up to which a refit takes no thread of its own: it is as short as ten steps
NEAR = 1.0  # standard deviations within which a refit that another one follows keeps these sums
LATER = 8  # a refit of n samples is used n / 8 samples after it began
AT_A_TIME = 3  # samples since then that a step takes with the filter of the refit

UNDER_WAY: WeakKeyDictionary[FilterState, Future[SensitivityState]] = WeakKeyDictionary()
LOCK = threading.Lock()


@dataclass(frozen=True, eq=False)
class Found:
    """End of a search."""

    best: Passed  # the samples about the trajectory where it ended
    used: Mask  # readings in use, shape (samples, sensors)
    # True if no step lowers the cost any more, and samples that are not explained pin all unknowns,
    # or searches from elsewhere end here as well: then the model is in error, not the search.
    converged: bool
    passes: float  # passes over the samples that it took
    screened: bool  # True if it began again at screened points, and that was no use


def refitted(
    samples: StoredSamples, options: Refit, *, last: bool, screened: int = 0
) -> Found | None:
    """Return the end of a search from the present estimate; None if no trajectory is possible.

    `last`: True for the end of a run: the search converges. Else it ends within a standard
    deviation, as the same samples are fitted again later. `screened`: how many samples the last
    search had that began again at screened points in vain.
    """
    search = _Search(samples, options, last, lacking=1 if screened else AGREED)
    screens = search.search(screened)
    if search.best is None:
        return None
    for _ in range(GATE_ROUNDS if samples.gated else 0):
        used = search.plausible
        if (used == search.used).all():
            break
        search.begin(used)
    return Found(
        best=search.best,
        used=search.used,
        converged=search.settled and not search.lost,
        passes=search.passes,
        screened=screens and (search.unexplained or search.far) and not search.lost,
    )


def plausible(samples: StoredSamples, options: Refit, one: Passed) -> Mask:
    """Return the readings that a fit which has ended at a trajectory uses, (samples, sensors)."""
    search = _Search(samples, options, last=True)
    search.best = one
    return search.plausible if samples.gated else search.used


@dataclass(eq=False)
class _Search:
    """A search for the most probable trajectory; it keeps the best one, and counts its passes."""

    samples: StoredSamples
    options: Refit
    last: bool
    lacking: int = AGREED  # searches from elsewhere that have yet to end at the best trajectory
    used: Mask = field(init=False)
    best: Passed | None = None
    settled: bool = False
    passes: float = 0.0

    def __post_init__(self) -> None:
        readings = self.samples.readings
        self.used = np.isfinite(readings)
        if self.samples.gated:
            self.used = near_neighbours(readings, WILD) & near_most(readings, WILD)

    @property
    def plausible(self) -> Mask:
        """Readings near the best trajectory, (samples, sensors); not only those in use.

        A residual is refused that is far from those before and after it, and one far beyond what
        the noise and what is left unknown allow; of few samples there is the latter only.
        """
        one, gate = self.best, self.samples.work.options.gate.beyond
        if one is None:
            return self.used
        H, _ = one.model(self.used)
        sizes, axes = principal(H)
        J, r = one.slopes, one.residuals
        shown = ((J @ axes) ** 2 / sizes).sum(axis=-1)
        # Residuals of readings in use vary less than the noise, those of others more.
        e = r / np.sqrt(np.where(self.used, np.maximum(1.0 - shown, LEVERAGE), 1.0 + shown))
        near = near_neighbours(r, GATE)
        for k, column in enumerate(e.T):
            usual = usual_size(column[self.used[:, k]])
            limit = WILD if np.isfinite(column).sum() > FEW else gate
            with np.errstate(invalid="ignore"):
                near[:, k] &= np.abs(column) <= limit * usual
        return near

    def search(self, screened: int) -> bool:
        """Search from the present estimate, and from elsewhere if the end needs it.

        `screened` as in `refitted`. Returns whether it began again at screened points.
        """
        start = self.samples.reached
        self.descend(start)
        # Fewer samples have shown that there is no other end, if this is the same.
        stays = self.best is not None and np.linalg.norm(self.best.xi - start) < STAYS
        more = len(self.samples) >= (ANEW_LAST if self.last else ANEW) * screened
        screens = self.suspicious and (more or (self.far and not stays))
        if screens:
            self.screen()
        elif screened and stays:
            self.lacking = 0
        if self.last and self.lost:
            self.draw()
        return screens

    def begin(self, used: Mask) -> None:
        """Search again from the best trajectory, with other readings in use."""
        before, self.used, self.best = self.best, used, None
        if before is not None:
            self._descend(before)

    def descend(self, xi: Array) -> None:
        """Search from a trajectory, and keep where that ends if it is better."""
        start = self._about(self.samples.within_bounds(xi))
        if start is None and xi.any():
            start = self._about(np.zeros_like(xi))
        if start is not None:
            self._descend(start)

    def _about(self, xi: Array) -> Passed | None:
        self.passes += 1.0
        return self.samples.about(xi)

    def _elsewhere(self, xi: Array) -> None:
        """Search from another point, and note whether that ends at the best trajectory."""
        start, best = self._about(self.samples.within_bounds(xi)), self.best
        if start is None:
            return
        end = self._descend(start)
        if best is not None and self._near(best, end.xi):
            if self._misfit(end) < LEFT * self._misfit(start):
                self.lacking -= 1
        elif self.best is end:
            self.lacking = AGREED

    def _descend(self, start: Passed) -> Passed:
        """Take Levenberg-Marquardt steps from a pass, and keep the end if it is the best."""
        end, settled, ends = start, False, ENDS if self.last else ENDS_EARLY
        budget, delta = self.passes + self.options.passes, DELTA
        while self.passes < budget:
            H, g = end.model(self.used)
            model = _Quadratic.of(H, g, self._free(end, g))
            if math.sqrt(2.0 * model.decrease) < ends:
                settled = True
                break
            better, delta = self._stepped(end, model, delta, budget)
            if better is None:
                break
            end = better
        if self.best is None or end.cost(self.used) < self.best.cost(self.used):
            self.best, self.settled = end, settled
        return end

    def _free(self, one: Passed, g: Array) -> Array:
        """Return a basis of the directions in which no bound is in the way, (r, free)."""
        samples = self.samples
        reduction, start = samples.filter.reduction, samples.start
        lower, upper = reduction.ends
        q = start.q[0] + reduction.Phi @ (start.C[0].T @ one.xi)
        along = reduction.Phi @ (start.C[0].T @ g)
        span = np.abs(reduction.Phi).max(axis=1, initial=0.0)
        low, high = q <= lower + 1e-9 * span, q >= upper - 1e-9 * span
        held = (low & (along < 0.0)) | (high & (along > 0.0))
        if not held.any():
            return np.eye(len(g))
        rows = (reduction.Phi @ start.C[0].T)[held]
        return np.asarray(scipy.linalg.null_space(rows))

    def _stepped(
        self, one: Passed, model: _Quadratic, delta: float, budget: float
    ) -> tuple[Passed | None, float]:
        """Return the pass after an accepted step, None if there is none, and the trust region."""
        cost, bend = one.cost(self.used), None
        several = 1  # one trial, and where it fails shorter ones at once
        while self.passes < budget:
            if several == 1 and (better := self._short_step(one, model, delta)):
                return better, delta
            steps, predicted, bend = self._trials(one, model, delta, several, bend)
            if not steps:
                return None, delta
            tried, taken = self.samples.costs(one.xi + np.array(steps), self.used, cost)
            self.passes += taken
            best = int(np.argmin(tried))
            ratio = (cost - float(tried[best])) / predicted[best]
            delta = _trusted(delta, float(np.linalg.norm(steps[best])), ratio)
            several = self.samples.together
            if ratio > ACCEPTED and (better := self._about(one.xi + steps[best])):
                return better, delta
        return None, delta

    def _trials(
        self, one: Passed, model: _Quadratic, delta: float, several: int, bend: Array | None
    ) -> tuple[list[Array], list[float], Array | None]:
        """Return steps of shrinking length, the decrease that each predicts, and the bend.

        `bend`: that of `_bend`, None before it is known.
        """
        steps, predicted, cost = list[Array](), list[float](), one.cost(self.used)
        for radius in delta * SHORTER ** np.arange(several):
            step, shift = model.step(radius)
            gain = model.gain(step)
            if np.linalg.norm(step) < SHORTEST or gain < LEAST * cost:
                break
            bend = self._bend(one, step) if bend is None else bend
            curved = model.shifted(model.axes.T @ (bend * (step @ step)), shift)
            if np.linalg.norm(curved) < CURVED * np.linalg.norm(step):
                step = step + 0.5 * curved
            steps.append(self.samples.within_bounds(one.xi + step) - one.xi)
            predicted.append(gain)
        return steps, predicted, bend

    def _short_step(self, one: Passed, model: _Quadratic, delta: float) -> Passed | None:
        """Return the pass after a step so short that it needs no second-order part, or None."""
        step, _ = model.step(delta)
        gain, cost = model.gain(step), one.cost(self.used)
        if not SHORTEST <= np.linalg.norm(step) < SHORT or gain < LEAST * cost:
            return None
        better = self._about(self.samples.within_bounds(one.xi + step))
        accepted = better is not None and cost - better.cost(self.used) > ACCEPTED * gain
        return better if accepted else None

    def _bend(self, one: Passed, step: Array) -> Array:
        """Return J' d2r/ds2 of the residuals r along a step, by a difference; zero if it fails."""
        near = self.samples.residuals(one.xi + CLOSE * step)
        self.passes += 1.0 / (1 + int(self.samples.alive.sum()))
        if near is None:
            return np.zeros(len(step))
        J = one.slopes[self.used]
        change = (near - one.residuals)[self.used] / CLOSE + J @ step
        bend: Array = J.T @ change * (2.0 / CLOSE) / float(step @ step)
        return bend if np.isfinite(bend).all() else np.zeros(len(step))

    @property
    def suspicious(self) -> bool:
        """True if the best trajectory does not explain the samples, or contradicts the prior.

        So do wrong minima.
        """
        return self.lost or self.far or self._square > LARGE

    @property
    def far(self) -> bool:
        """True if the best trajectory is far outside the prior, N(0, I) of all coordinates."""
        if self.best is None:
            return False
        return float(self.best.xi @ self.best.xi) > FAR**2 + 2.0 * float(self.samples.alive.sum())

    @property
    def lost(self) -> bool:
        """True if samples that are not explained leave an unknown as uncertain as its prior.

        Unless searches from elsewhere end at the same trajectory.
        """
        if self.best is None:
            return True
        if not self.unexplained or self.lacking <= 0:
            return False
        H, _ = self.best.model(self.used)
        # Of the unknowns: rows of an uncertain start, and padding, may stay as they were.
        C = self.samples.start.C[0]
        sizes, axes = principal(H)
        left = axes.T @ C
        before, after = C.T @ C, left.T @ (left / sizes[:, None])
        floor = ROUNDING * np.trace(before) * np.eye(len(before))
        shares = scipy.linalg.eigh(after, before + floor, eigvals_only=True)
        return math.sqrt(max(shares[-1], 0.0)) > UNSURE

    @property
    def unexplained(self) -> bool:
        """True if the best trajectory leaves more than the noise."""
        return self._square > DOUBTFUL

    @property
    def _square(self) -> float:
        if self.best is None:
            return math.inf
        return _misfit(self.best.residuals, self.samples.readings, self.used)

    def screen(self) -> None:
        """Search from the best of some points of the prior."""
        points = self._spread(SPREAD * _normal(SCREENED, int(self.samples.alive.sum())))
        costs, taken = self.samples.costs(points, self.used)
        self.passes += taken
        order = np.argsort(costs)
        # At the end of a run a misfit that pins all unknowns is most likely an error of the model.
        fitted = 1 if self.last and not self.lost else FITTED
        for place in order[:fitted].tolist():
            known = self.best is not None and self._near(self.best, points[place])
            if np.isfinite(costs[place]) and not known:
                self._elsewhere(points[place])
            if not self.suspicious or self.lacking <= 0:
                return

    def _spread(self, points: Array) -> Array:
        """Return points in all coordinates, within the bounds of the unknowns."""
        alive = self.samples.alive
        whole = np.zeros((len(points), len(alive)))
        whole[:, alive] = points
        return np.array([self.samples.within_bounds(one) for one in whole])

    def _near(self, one: Passed, xi: Array) -> bool:
        """True if a point is within a posterior standard deviation of a trajectory."""
        H, _ = one.model(self.used)
        away = xi - one.xi
        return float(away @ H @ away) < 1.0

    def _misfit(self, one: Passed) -> float:
        return float((one.residuals[self.used] ** 2).sum())

    def draw(self) -> None:
        """Search from drawn points, before it is given up."""
        drawn = np.random.default_rng(0).standard_normal((LAST, int(self.samples.alive.sum())))
        for xi in self._spread(LAST_SPREAD * drawn):
            self._elsewhere(xi)
            if not self.suspicious or self.lacking <= 0:
                return


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """The quadratic model of the cost about a trajectory, in its free principal directions."""

    # Hessian and direction of descent, principal values and axes, and g along these.
    H: Array
    g: Array
    sizes: Array
    axes: Array
    along: Array
    decrease: float  # by which the model falls to its minimum

    @classmethod
    def of(cls, H: Array, g: Array, free: Array) -> _Quadratic:
        """Return the model in directions with the basis `free`, (r, free)."""
        sizes, axes = principal(free.T @ H @ free)
        decrease = 0.5 * float(((axes.T @ (free.T @ g)) ** 2 / sizes).sum())
        axes = free @ axes
        return cls(H, g, sizes, axes, axes.T @ g, decrease)

    def step(self, radius: float) -> tuple[Array, float]:
        """Return the step to the minimum within a ball, and the shift of the Hessian for it."""
        shift = _shift(self.sizes, self.along, radius)
        return self.shifted(self.along, shift), shift

    def shifted(self, along: Array, shift: float) -> Array:
        """Return the solution with a shifted Hessian, for a right side along the axes."""
        return np.asarray(self.axes @ (along / (self.sizes + shift)))

    def gain(self, step: Array) -> float:
        """Return by how much the model falls with a step."""
        return float(self.g @ step - 0.5 * step @ self.H @ step)


def _trusted(delta: float, length: float, ratio: float) -> float:
    """Return the trust region after a step, from the ratio of actual and predicted decrease."""
    if ratio < POOR:
        return length * (SHORTER if ratio > 0.0 else SHORTER**2)
    return max(delta, 2.0 * length) if ratio > GOOD else delta


def _shift(sizes: Array, g: Array, delta: float) -> float:
    """Return the shift of the Hessian with which the minimum of the model is within a ball."""
    if np.linalg.norm(g / sizes) <= delta:
        return 0.0
    # The length falls with the shift; the bracket holds since |g|/(shift + 1) bounds the length.
    low, high = 0.0, float(np.linalg.norm(g)) / delta
    for _ in range(60):
        shift = 0.5 * (low + high)
        longer = np.linalg.norm(g / (sizes + shift)) > delta
        low, high = (shift, high) if longer else (low, shift)
    return high


def _normal(count: int, size: int) -> Array:
    """Return a Latin hypercube of points of N(0, I), shape (count, size)."""
    ranks = np.random.default_rng(0).random((count, size)).argsort(axis=0)
    return np.asarray(scipy.special.ndtri((ranks + 0.5) / count))


def _misfit(residuals: Array, readings: Array, used: Mask) -> float:
    """Return a high quantile of mean squares of residuals, over sensors and blocks of samples.

    In units of the noise that is stated, or that second differences show if that is larger.
    """
    shown = np.where(used, readings, np.nan)
    squares = []
    for k in range(readings.shape[1]):
        seen = shown[np.isfinite(shown[:, k]), k]
        bends = np.diff(seen, n=2)
        noise = max(1.0, float((bends**2).mean()) / 6.0) if len(bends) else 1.0
        for block in np.array_split(residuals[used[:, k], k], BLOCKS):
            if len(block):
                squares.append(float((block**2).mean()) / noise)
    return float(np.quantile(squares, QUANTILE)) if squares else 0.0


def refit_due(
    work: SensitivityWork, state: SensitivityState
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after the refits that are due, and diagnostics if there was one."""
    due, rows = state.assimilated >= state.due, state.log.shape[1]
    if work.fits and 0 < work.window < rows:  # samples without a reading need room
        due = due | (rows - state.window > work.window)
    if not np.count_nonzero(due):
        return state, None
    if not work.fits:
        return iterate_starts(work, state, due)
    if (options := work.refit) is None:
        return state, None
    alone = len(state) == 1
    which = np.flatnonzero(due).tolist()
    each = {k: _after_due(work, options, take(state, k), alone=alone) for k in which}
    return put_each(state, each), None


def _after_due(
    work: SensitivityWork, options: Refit, state: SensitivityState, *, alone: bool
) -> SensitivityState:
    """Return one member after a refit that is due; `alone`: not of a fleet."""
    count = int(state.assimilated[0])
    if max(count, state.log.shape[1] - 1 - int(state.window[0])) >= options.window:
        return new_window(work, state.now, state)
    # A window but the first begins with what is known: it has nothing to search for.
    if count <= options.start and options.apart and alone and count > AT_ONCE:
        state = changed(state, fork=Fork.of(state))
    elif count <= options.start:
        state = refitted_now(work, options, state)
    later = 2 * count if 2 * count <= options.start else options.window
    return changed(state, due=np.array([later]))


@nonfinite_allowed()  # such a trajectory is refused
def settle(
    work: SensitivityWork, state: SensitivityState
) -> tuple[SensitivityState, list[Mask | None]]:
    """Return all members after a last refit, and the readings it has used or None, of each."""
    used: list[Mask | None] = [None] * len(state)
    each: dict[int, SensitivityState] = {}
    options = work.refit
    if options is None or not work.fits:
        return state, used
    for k in range(len(state)):
        one = take(state, k)
        if one.log.shape[1] and (one.assimilated[0] or one.opening[0]):
            each[k], used[k] = _settled(work, options, one)
    return put_each(state, each), used


def _settled(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> tuple[SensitivityState, Mask | None]:
    """Return one member after a last refit, and the readings it has used or None."""
    samples = StoredSamples.of(work, state)
    state = changed(state, fork=Fork.none(state.now))  # this is a refit of more samples
    try:
        found = refitted(samples, options, last=True, screened=int(state.fit.screened[0]))
        after = _after(work, state, samples, found, last=True)
    except Exception as error:
        if numerical(error) is None:
            raise
        return _after(work, state, samples, None, last=True), None
    return after, None if found is None else found.used


def refitted_now(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> SensitivityState:
    """Return one member after a refit that another one follows."""
    samples = StoredSamples.of(work, state)
    found = refitted(samples, options, last=False, screened=int(state.fit.screened[0]))
    return _after(work, state, samples, found, last=False)


def _after(
    work: SensitivityWork,
    state: SensitivityState,
    samples: StoredSamples,
    found: Found | None,
    *,
    last: bool,
) -> SensitivityState:
    count, spent = state.assimilated, state.fit.work
    x = None if found is None else _filter(samples, found, last=last)
    if found is None or x is None:
        fit = changed(state.fit, samples=count, converged=np.zeros(1))
        return changed(state, fit=fit)
    there = np.isfinite(samples.readings)
    fit = FitState(
        samples=count,
        cost=np.array([found.best.cost(found.used)]),
        readings=np.array([float(there.sum())]),
        refused=np.array([float((there & ~found.used).sum())]),
        work=spent + found.passes * len(samples),
        converged=np.array([float(found.converged)]),
        screened=np.array([len(samples)]) if found.screened else state.fit.screened,
        xi=found.best.xi[None, :, None],
    )
    now = work.filter.relinearised(x)
    # A filter to go back to that was set with this sample is that after the fit.
    newer = now if state.since_newer[0] == state.log.shape[1] - 1 else state.newer
    return changed(state, now=now, newer=newer, fit=fit)


def _filter(samples: StoredSamples, found: Found, *, last: bool) -> FilterState | None:
    """Return the filter that continues from the end of a search; None if a step fails."""
    now = samples.state.now
    evidence = samples.start.evidence + samples.log_evidence(found.best, found.used)
    best = changed(samples.updated(found.best, found.used), evidence=evidence)
    away = apart(samples.filter, best, now)
    # Sums of the verdict and errors of the discretisation stay with the filter until then: a later
    # refit of the same samples may compute them again.
    if (away <= HOLDS and usual(now)) or (away <= NEAR and not last):
        return _within(samples.filter, best) if last else best
    x = samples.judged(found.best, found.used)
    if x is None:
        return None
    x = changed(x, evidence=evidence)
    return _within(samples.filter, x) if last else x


def _within(filter_: Filter, x: FilterState) -> FilterState:
    """Return a filter about a best fit, at that fit if the linear one is beyond a bound.

    Estimates are clipped to their bounds one by one. An unknown at its bound keeps the linear step,
    so that it is clipped there; the others keep the values of the fit, without that step.
    """
    reduction, estimate = filter_.reduction, filter_.estimate(x)
    within = reduction.bounded(estimate)
    if within is estimate:
        return x
    latent = filter_.problem.model.latent
    held = (estimate != within) & (np.abs(within - x.q) <= AT_BOUND * latent.deviations)
    beyond = np.where(held, estimate - x.q, 0.0)
    return changed(x, da=reduction.reduced(beyond), du=np.zeros_like(x.du))


def go_on(work: SensitivityWork, state: SensitivityState) -> SensitivityState:
    """Return one member after a sample, with the refit under way taken a step further."""
    fork, options = state.fork, work.refit
    if options is None:
        return state
    if not fork.fitted[0]:
        refit = _under_way(work, options, state)
        count = int(fork.samples[0])
        if state.assimilated[0] < count + max(count // LATER, 1):
            return state
        try:
            found = refit.result()
        except Exception as error:
            if numerical(error) is None:
                raise
            # Of the same samples it would fail again: the filter goes on, and the fit is none.
            failed = changed(state.fit, samples=fork.samples, converged=np.zeros(1))
            return _without(changed(state, fit=failed), fork.filter)
        state = changed(state, fit=found.fit)
        if found.now is fork.filter:  # no better trajectory was found
            return _without(state, fork.filter)
        fork = changed(fork, filter=found.now, fitted=np.ones(1, dtype=bool))
    return _caught_up(work, state, fork)


def _under_way(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> Future[SensitivityState]:
    fork = state.fork
    with LOCK:
        if fork.filter in UNDER_WAY:
            return UNDER_WAY[fork.filter]
        future = UNDER_WAY[fork.filter] = Future()
    log = state.log[:, : int(fork.row[0]) + 1]
    begun = changed(state, now=fork.filter, log=log, assimilated=fork.samples)
    begun = _without(begun, fork.filter)
    # A daemon: a program that ends does not wait for it.
    threading.Thread(target=_run, args=(future, work, options, begun), daemon=True).start()
    return future


@nonfinite_allowed()  # such a trajectory is refused
def _run(
    future: Future[SensitivityState], work: SensitivityWork, options: Refit, state: SensitivityState
) -> None:
    try:
        future.set_result(refitted_now(work, options, state))
    except Exception as error:  # noqa: BLE001, raised where the result is asked for
        future.set_exception(error)


def _caught_up(work: SensitivityWork, state: SensitivityState, fork: Fork) -> SensitivityState:
    """Return one member after the next samples since a refit, which has ended."""
    row, last, x = int(fork.row[0]), state.log.shape[1] - 1, fork.filter
    rows = state.log[:, row : row + 1 + AT_A_TIME]
    for interval in intervals_since(rows, work.filter.problem.channels):
        x, told = assimilate(work.filter, x, work.filter.span(interval), work.options)
        if not told.good:
            return _without(state, x)
        x, row = work.filter.relinearised(x), row + 1
    if row < last:
        return changed(state, fork=changed(fork, filter=x, row=np.array([row])))
    newer = x if state.since_newer[0] == last else state.newer
    return _without(changed(state, now=x, newer=newer), x)


def _without(state: SensitivityState, x: FilterState) -> SensitivityState:
    return changed(state, fork=Fork.none(x))
