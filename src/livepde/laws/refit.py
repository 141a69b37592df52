"""The refit: the most probable constant unknowns (MAP estimate) given the stored samples.

Levenberg-Marquardt steps within a trust region in prior standard deviations (More 1978, Conn, Gould
and Toint 2000), with geodesic acceleration in curved valleys (Transtrum and Sethna 2012). If the
solution does not explain the samples, the search is repeated from the best of several screened
points. The gate is applied after a search, and may accept readings that were refused before.

A refit runs at once when it is due, or in a thread while samples continue. It depends only on the
state at its start, so that it may run at any time, and a second time after a restart. The number of
samples alone determines when the filter switches to its result.
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

DELTA = 1.5  # first trust radius, in prior standard deviations: 0.5 to 3 perform similarly
ENDS = 0.03  # a search has converged at a step of this many posterior standard deviations
ENDS_EARLY = 1.0  # same limit if the samples will be fitted again when their number has doubled
ACCEPTED = 1e-4  # least ratio of actual and predicted decrease of the cost
POOR, GOOD = 0.25, 0.75  # ratios below and above which the trust region changes
SHORTER = 0.5  # ratio of successive trust radii
CLOSE = 0.1  # fraction of a step over which its second derivative is taken
SHORT = 0.1  # prior standard deviations: shorter steps have no second-order part
CURVED = 0.75  # largest second-order part of a step over its first-order part (Transtrum 2012)
SHORTEST, LEAST = 1e-7, 1e-9  # negligible step, and negligible relative decrease of the cost
LARGE, DOUBTFUL = 30.0, 2.5  # misfits above which to search again: always, and if `UNSURE` holds
FAR = 6.0  # prior standard deviations from the prior mean: a plausible prior is not so wrong
UNSURE = 0.5  # a direction keeps more than this share of its prior standard deviation
ROUNDING = 1e-12  # share of a variance
AT_BOUND = 1e-6  # distance to an active bound, in prior standard deviations
QUANTILE, BLOCKS = 0.8, 8  # quantile of mean squares, over sensors and blocks of samples
SCREENED, FITTED, SPREAD = 32, 3, 1.5  # screened points, best points that start a search, deviation
# Searches from other points that must end at the best trajectory, and the largest ratio of final to
# initial misfit. Without the ratio, an unobserved unknown would always end at the prior and count.
AGREED, LEFT = 3, 0.5
# Ratio of the number of samples to that of the last screening in vain, from which points are
# screened again; second value: at the end of a run. The model is most likely in error.
ANEW, ANEW_LAST = 4, 2
STAYS = 1.0  # prior standard deviations within which a solution counts as unchanged
LAST, LAST_SPREAD = 8, 1.2  # searches from random points before the search is given up, deviation
GATE_ROUNDS = 4
WILD = 30.0  # usual deviations beyond which a reading is refused before a fit
GATE = 4.0  # usual deviations between a residual and its neighbours
LEVERAGE = 0.1  # least variance of the residual of a reading in use, in units of the noise
AT_ONCE = 64  # largest number of samples fitted without a thread: about as long as ten steps
NEAR = 1.0  # standard deviations within which an intermediate refit keeps the verdict's sums
LATER = 8  # the result of a refit of n samples is used n / 8 samples after its start
AT_A_TIME = 3  # samples since then that each step assimilates with the filter of the refit

IN_PROGRESS: WeakKeyDictionary[FilterState, Future[SensitivityState]] = WeakKeyDictionary()
LOCK = threading.Lock()


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a search."""

    best: Passed  # the samples about the best trajectory
    used: Mask  # readings in use, shape (samples, sensors)
    # True if no step lowers the cost further and a remaining misfit is due to the model, not to the
    # search: the samples determine all unknowns, or searches from other points end here as well.
    converged: bool
    passes: float  # number of passes over the samples
    screened: bool  # True if points were screened in vain


def refitted(
    samples: StoredSamples, options: Refit, *, last: bool, screened: int = 0
) -> Found | None:
    """Return the result of a search from the present estimate; None if every trajectory fails.

    `last`: True at the end of a run, for full convergence. Otherwise the search stops within a
    standard deviation, because the samples are fitted again later. `screened`: number of samples in
    the last search that screened points in vain.
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


def plausible(samples: StoredSamples, options: Refit, current: Passed) -> Mask:
    """Return the readings that a fit with a given solution uses, shape (samples, sensors)."""
    search = _Search(samples, options, last=True)
    search.best = current
    return search.plausible if samples.gated else search.used


@dataclass(eq=False)
class _Search:
    """A search for the most probable trajectory, which counts its passes over the samples."""

    samples: StoredSamples
    options: Refit
    last: bool
    lacking: int = AGREED  # searches from other points that must still end at the best trajectory
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
        """Readings near the best trajectory, shape (samples, sensors), in use or not.

        A reading is refused if its residual is far from its neighbours in time, or far beyond its
        standard deviation. With few samples only the second test applies.
        """
        best, gate = self.best, self.samples.work.options.gate.beyond
        if best is None:
            return self.used
        H, _ = best.model(self.used)
        sizes, axes = principal(H)
        J, r = best.slopes, best.residuals
        variance = ((J @ axes) ** 2 / sizes).sum(axis=-1)
        # A residual varies less than the noise if its reading is in use, and more otherwise.
        e = r / np.sqrt(np.where(self.used, np.maximum(1.0 - variance, LEVERAGE), 1.0 + variance))
        near = near_neighbours(r, GATE)
        for k, column in enumerate(e.T):
            usual = usual_size(column[self.used[:, k]])
            limit = WILD if np.isfinite(column).sum() > FEW else gate
            with np.errstate(invalid="ignore"):
                near[:, k] &= np.abs(column) <= limit * usual
        return near

    def search(self, screened: int) -> bool:
        """Search from the present estimate, and from other points if the solution is suspicious.

        `screened`: as in `refitted`. Returns True if points were screened.
        """
        start = self.samples.reached
        self.descend(start)
        # An unchanged solution was already compared with other points, on fewer samples.
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
        """Repeat the search from the best trajectory, with other readings in use."""
        before, self.used, self.best = self.best, used, None
        if before is not None:
            self._descend(before)

    def descend(self, xi: Array) -> None:
        """Search from a trajectory, or from the prior mean if a step along it fails."""
        start = self._about(self.samples.within_bounds(xi))
        if start is None and xi.any():
            start = self._about(np.zeros_like(xi))
        if start is not None:
            self._descend(start)

    def _about(self, xi: Array) -> Passed | None:
        self.passes += 1.0
        return self.samples.about(xi)

    def _elsewhere(self, xi: Array) -> None:
        """Search from another point, and count it if it ends at the best trajectory."""
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
        """Take Levenberg-Marquardt steps from a trajectory, and keep the result if it is best."""
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

    def _free(self, current: Passed, g: Array) -> Array:
        """Return a basis of the directions without an active bound, shape (r, free)."""
        samples = self.samples
        reduction, start = samples.filter.reduction, samples.start
        lower, upper = reduction.ends
        q = start.q[0] + reduction.Phi @ (start.C[0].T @ current.xi)
        along = reduction.Phi @ (start.C[0].T @ g)
        span = np.abs(reduction.Phi).max(axis=1, initial=0.0)
        low, high = q <= lower + 1e-9 * span, q >= upper - 1e-9 * span
        held = (low & (along < 0.0)) | (high & (along > 0.0))
        if not held.any():
            return np.eye(len(g))
        rows = (reduction.Phi @ start.C[0].T)[held]
        return np.asarray(scipy.linalg.null_space(rows))

    def _stepped(
        self, current: Passed, model: _Quadratic, delta: float, budget: float
    ) -> tuple[Passed | None, float]:
        """Return the pass after an accepted step, or None, and the trust radius."""
        cost, bend = current.cost(self.used), None
        several = 1  # one trial; if it fails, several shorter trials together
        while self.passes < budget:
            if several == 1 and (better := self._short_step(current, model, delta)):
                return better, delta
            steps, predicted, bend = self._trials(current, model, delta, several, bend)
            if not steps:
                return None, delta
            tried, taken = self.samples.costs(current.xi + np.array(steps), self.used, cost)
            self.passes += taken
            best = int(np.argmin(tried))
            ratio = (cost - float(tried[best])) / predicted[best]
            delta = _trusted(delta, float(np.linalg.norm(steps[best])), ratio)
            several = self.samples.together
            if ratio > ACCEPTED and (better := self._about(current.xi + steps[best])):
                return better, delta
        return None, delta

    def _trials(
        self, current: Passed, model: _Quadratic, delta: float, several: int, bend: Array | None
    ) -> tuple[list[Array], list[float], Array | None]:
        """Return steps of decreasing length, their predicted decreases of the cost, and the bend.

        `bend`: result of `_bend`, or None if it has not been computed.
        """
        steps, predicted, cost = list[Array](), list[float](), current.cost(self.used)
        for radius in delta * SHORTER ** np.arange(several):
            step, shift = model.step(radius)
            gain = model.gain(step)
            if np.linalg.norm(step) < SHORTEST or gain < LEAST * cost:
                break
            bend = self._bend(current, step) if bend is None else bend
            curved = model.shifted(model.axes.T @ (bend * (step @ step)), shift)
            if np.linalg.norm(curved) < CURVED * np.linalg.norm(step):
                step = step + 0.5 * curved
            steps.append(self.samples.within_bounds(current.xi + step) - current.xi)
            predicted.append(gain)
        return steps, predicted, bend

    def _short_step(self, current: Passed, model: _Quadratic, delta: float) -> Passed | None:
        """Return the pass after a step short enough to omit its second-order part, or None."""
        step, _ = model.step(delta)
        gain, cost = model.gain(step), current.cost(self.used)
        if not SHORTEST <= np.linalg.norm(step) < SHORT or gain < LEAST * cost:
            return None
        better = self._about(self.samples.within_bounds(current.xi + step))
        accepted = better is not None and cost - better.cost(self.used) > ACCEPTED * gain
        return better if accepted else None

    def _bend(self, current: Passed, step: Array) -> Array:
        """Return J' d2r/ds2 of the residuals r along a step, by differences; zero on failure."""
        near = self.samples.residuals(current.xi + CLOSE * step)
        self.passes += 1.0 / (1 + int(self.samples.alive.sum()))
        if near is None:
            return np.zeros(len(step))
        J = current.slopes[self.used]
        change = (near - current.residuals)[self.used] / CLOSE + J @ step
        bend: Array = J.T @ change * (2.0 / CLOSE) / float(step @ step)
        return bend if np.isfinite(bend).all() else np.zeros(len(step))

    @property
    def suspicious(self) -> bool:
        """True if the misfit, or the distance from the prior, suggests a wrong local minimum."""
        return self.lost or self.far or self._square > LARGE

    @property
    def far(self) -> bool:
        """True if the best trajectory is far outside the prior N(0, I)."""
        if self.best is None:
            return False
        return float(self.best.xi @ self.best.xi) > FAR**2 + 2.0 * float(self.samples.alive.sum())

    @property
    def lost(self) -> bool:
        """True if the samples are not explained and leave a direction of the unknowns uncertain.

        False if searches from other points end at the same trajectory.
        """
        if self.best is None:
            return True
        if not self.unexplained or self.lacking <= 0:
            return False
        H, _ = self.best.model(self.used)
        # Compare covariances of the unknowns only: rows of an uncertain start may keep theirs.
        C = self.samples.start.C[0]
        sizes, axes = principal(H)
        left = axes.T @ C
        before, after = C.T @ C, left.T @ (left / sizes[:, None])
        floor = ROUNDING * np.trace(before) * np.eye(len(before))
        shares = scipy.linalg.eigh(after, before + floor, eigvals_only=True)
        return math.sqrt(max(shares[-1], 0.0)) > UNSURE

    @property
    def unexplained(self) -> bool:
        """True if the residuals of the best trajectory are larger than the noise."""
        return self._square > DOUBTFUL

    @property
    def _square(self) -> float:
        if self.best is None:
            return math.inf
        return _misfit(self.best.residuals, self.samples.readings, self.used)

    def screen(self) -> None:
        """Search from the best of a sample of points around the prior."""
        points = self._spread(SPREAD * _normal(SCREENED, int(self.samples.alive.sum())))
        costs, taken = self.samples.costs(points, self.used)
        self.passes += taken
        order = np.argsort(costs)
        # At the end of a run, a misfit that determines all unknowns most likely is a model error.
        fitted = 1 if self.last and not self.lost else FITTED
        for place in order[:fitted].tolist():
            known = self.best is not None and self._near(self.best, points[place])
            if np.isfinite(costs[place]) and not known:
                self._elsewhere(points[place])
            if not self.suspicious or self.lacking <= 0:
                return

    def _spread(self, points: Array) -> Array:
        """Return points in all coordinates, moved into the bounds of the unknowns."""
        alive = self.samples.alive
        whole = np.zeros((len(points), len(alive)))
        whole[:, alive] = points
        return np.array([self.samples.within_bounds(xi) for xi in whole])

    def _near(self, current: Passed, xi: Array) -> bool:
        """True if a point is within a posterior standard deviation of a trajectory."""
        H, _ = current.model(self.used)
        away = xi - current.xi
        return float(away @ H @ away) < 1.0

    def _misfit(self, current: Passed) -> float:
        return float((current.residuals[self.used] ** 2).sum())

    def draw(self) -> None:
        """Search from random points, as a last attempt."""
        drawn = np.random.default_rng(0).standard_normal((LAST, int(self.samples.alive.sum())))
        for xi in self._spread(LAST_SPREAD * drawn):
            self._elsewhere(xi)
            if not self.suspicious or self.lacking <= 0:
                return


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """Quadratic model of the cost about a trajectory, in its free principal directions."""

    # Hessian, negative gradient, principal values and axes, and components of g along the axes.
    H: Array
    g: Array
    sizes: Array
    axes: Array
    along: Array
    decrease: float  # decrease of the model from the trajectory to its minimum

    @classmethod
    def of(cls, H: Array, g: Array, free: Array) -> _Quadratic:
        """Return the model restricted to the span of the columns of `free`, shape (r, free)."""
        sizes, axes = principal(free.T @ H @ free)
        decrease = 0.5 * float(((axes.T @ (free.T @ g)) ** 2 / sizes).sum())
        axes = free @ axes
        return cls(H, g, sizes, axes, axes.T @ g, decrease)

    def step(self, radius: float) -> tuple[Array, float]:
        """Return the minimiser within a ball, and the shift of the Hessian that gives it."""
        shift = _shift(self.sizes, self.along, radius)
        return self.shifted(self.along, shift), shift

    def shifted(self, along: Array, shift: float) -> Array:
        """Solve with the shifted Hessian, for a right-hand side in components along the axes."""
        return np.asarray(self.axes @ (along / (self.sizes + shift)))

    def gain(self, step: Array) -> float:
        """Return the decrease of the model for a step."""
        return float(self.g @ step - 0.5 * step @ self.H @ step)


def _trusted(delta: float, length: float, ratio: float) -> float:
    """Return the trust radius after a step, from the ratio of actual and predicted decrease."""
    if ratio < POOR:
        return length * (SHORTER if ratio > 0.0 else SHORTER**2)
    return max(delta, 2.0 * length) if ratio > GOOD else delta


def _shift(sizes: Array, g: Array, delta: float) -> float:
    """Return the shift of the Hessian that puts the minimum of the model inside a ball."""
    if np.linalg.norm(g / sizes) <= delta:
        return 0.0
    # The length decreases with the shift. |g|/(shift + 1) bounds it, which gives the bracket.
    low, high = 0.0, float(np.linalg.norm(g)) / delta
    for _ in range(60):
        shift = 0.5 * (low + high)
        longer = np.linalg.norm(g / (sizes + shift)) > delta
        low, high = (shift, high) if longer else (low, shift)
    return high


def _normal(count: int, size: int) -> Array:
    """Return a Latin hypercube sample of N(0, I), shape (count, size)."""
    ranks = np.random.default_rng(0).random((count, size)).argsort(axis=0)
    return np.asarray(scipy.special.ndtri((ranks + 0.5) / count))


def _misfit(residuals: Array, readings: Array, used: Mask) -> float:
    """Return a high quantile of mean squares of residuals, over sensors and blocks of samples.

    The unit is the stated noise variance, or its estimate from second differences if larger.
    """
    shown = np.where(used, readings, np.nan)
    squares = list[Array]()
    for k in range(readings.shape[1]):
        differences = np.diff(shown[np.isfinite(shown[:, k]), k], n=2)
        noise = max(1.0, float((differences**2).mean()) / 6.0) if len(differences) else 1.0
        square = residuals[used[:, k], k] ** 2
        if len(square):
            parts = min(BLOCKS, len(square))
            edges = np.arange(parts) * len(square) // parts
            sizes = np.diff(edges, append=len(square))
            squares.append(np.add.reduceat(square, edges) / (sizes * noise))
    return float(np.quantile(np.concatenate(squares), QUANTILE)) if squares else 0.0


def refit_due(
    work: SensitivityWork, state: SensitivityState
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after the refits due, and the diagnostics of an iterated start or None."""
    due, rows = state.assimilated >= state.due, state.log.shape[1]
    if work.fits and 0 < work.window < rows:  # samples without readings fill the log, too
        due = due | (rows - state.window > work.window)
    if not np.count_nonzero(due):
        return state, None
    if not work.fits:
        return iterate_starts(work, state, due)
    if (options := work.refit) is None:
        return state, None
    alone = len(state) == 1
    which = np.flatnonzero(due).tolist()
    each = {k: _with_due_refit(work, options, take(state, k), alone=alone) for k in which}
    return put_each(state, each), None


def _with_due_refit(
    work: SensitivityWork, options: Refit, state: SensitivityState, *, alone: bool
) -> SensitivityState:
    """Return one member after a refit that is due; `alone`: not part of a fleet."""
    count = int(state.assimilated[0])
    if max(count, state.log.shape[1] - 1 - int(state.window[0])) >= options.window:
        return new_window(work, state.now, state)
    # A later window begins with the posterior of the one before, and requires no search.
    if count <= options.start and options.apart and alone and count > AT_ONCE:
        state = changed(state, fork=Fork.of(state))
    elif count <= options.start:
        state = refitted_now(work, options, state)
    later = 2 * count if 2 * count <= options.start else options.window
    return changed(state, due=np.array([later]))


@nonfinite_allowed()  # a nonfinite trajectory is refused
def settle(
    work: SensitivityWork, state: SensitivityState
) -> tuple[SensitivityState, list[Mask | None]]:
    """Return all members after a final refit, and for each the readings it used or None."""
    used: list[Mask | None] = [None] * len(state)
    each: dict[int, SensitivityState] = {}
    options = work.refit
    if options is None or not work.fits:
        return state, used
    for k in range(len(state)):
        member = take(state, k)
        if member.log.shape[1] and (member.assimilated[0] or member.opening[0]):
            each[k], used[k] = _settled(work, options, member)
    return put_each(state, each), used


def _settled(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> tuple[SensitivityState, Mask | None]:
    """Return one member after a final refit, and the readings that it used or None."""
    samples = StoredSamples.of(work, state)
    state = changed(state, fork=Fork.none(state.now))  # replaced by this refit of more samples
    try:
        result = refitted(samples, options, last=True, screened=int(state.fit.screened[0]))
        after = _with_result(work, state, samples, result, last=True)
    except Exception as error:
        if numerical(error) is None:
            raise
        return _with_result(work, state, samples, None, last=True), None
    return after, None if result is None else result.used


def refitted_now(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> SensitivityState:
    """Return one member after an intermediate refit, which a later refit follows."""
    samples = StoredSamples.of(work, state)
    result = refitted(samples, options, last=False, screened=int(state.fit.screened[0]))
    return _with_result(work, state, samples, result, last=False)


def _with_result(
    work: SensitivityWork,
    state: SensitivityState,
    samples: StoredSamples,
    result: Found | None,
    *,
    last: bool,
) -> SensitivityState:
    count, spent = state.assimilated, state.fit.work
    x = None if result is None else _filter(samples, result, last=last)
    if result is None or x is None:
        fit = changed(state.fit, samples=count, converged=np.zeros(1))
        return changed(state, fit=fit)
    present = np.isfinite(samples.readings)
    fit = FitState(
        samples=count,
        cost=np.array([result.best.cost(result.used)]),
        readings=np.array([float(present.sum())]),
        refused=np.array([float((present & ~result.used).sum())]),
        work=spent + result.passes * len(samples),
        converged=np.array([float(result.converged)]),
        screened=np.array([len(samples)]) if result.screened else state.fit.screened,
        xi=result.best.xi[None, :, None],
    )
    now = work.filter.relinearised(x)
    # If the newer point of return is this sample, it becomes the filter after the fit.
    newer = now if state.since_newer[0] == state.log.shape[1] - 1 else state.newer
    return changed(state, now=now, newer=newer, fit=fit)


def _filter(samples: StoredSamples, result: Found, *, last: bool) -> FilterState | None:
    """Return the filter that continues from the result of a search; None if a step fails."""
    now = samples.state.now
    evidence = samples.start.evidence + samples.log_evidence(result.best, result.used)
    best = changed(samples.updated(result.best, result.used), evidence=evidence)
    distance = apart(samples.filter, best, now)
    # Close to the present filter, its ledger and discretisation errors remain valid. An
    # intermediate refit tolerates more, because a later one computes both again.
    if (distance <= HOLDS and usual(now)) or (distance <= NEAR and not last):
        return _within(samples.filter, best) if last else best
    x = samples.judged(result.best, result.used)
    if x is None:
        return None
    x = changed(x, evidence=evidence)
    return _within(samples.filter, x) if last else x


def _within(filter_: Filter, x: FilterState) -> FilterState:
    """Return a filter about a fit, without its last linear step if that step leaves the bounds.

    Estimates are clipped to their bounds one by one. An unknown at its bound keeps the linear step
    and is clipped there. The other unknowns keep the values of the fit, without the step.
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
    """Return one member after a sample, with its refit in progress advanced."""
    fork, options = state.fork, work.refit
    if options is None:
        return state
    if not fork.fitted[0]:
        refit = _in_progress(work, options, state)
        count = int(fork.samples[0])
        if state.assimilated[0] < count + max(count // LATER, 1):
            return state
        try:
            result = refit.result()
        except Exception as error:
            if numerical(error) is None:
                raise
            # Repeating it on the same samples would fail again: the filter continues without it.
            failed = changed(state.fit, samples=fork.samples, converged=np.zeros(1))
            return _without_fork(changed(state, fit=failed), fork.filter)
        state = changed(state, fit=result.fit)
        if result.now is fork.filter:  # the refit found no trajectory
            return _without_fork(state, fork.filter)
        fork = changed(fork, filter=result.now, fitted=np.ones(1, dtype=bool))
    return _caught_up(work, state, fork)


def _in_progress(
    work: SensitivityWork, options: Refit, state: SensitivityState
) -> Future[SensitivityState]:
    fork = state.fork
    with LOCK:
        if fork.filter in IN_PROGRESS:
            return IN_PROGRESS[fork.filter]
        future = IN_PROGRESS[fork.filter] = Future()
    log = state.log[:, : int(fork.row[0]) + 1]
    begun = changed(state, now=fork.filter, log=log, assimilated=fork.samples)
    begun = _without_fork(begun, fork.filter)
    # The program must not wait for a daemon thread at its end.
    threading.Thread(target=_run, args=(future, work, options, begun), daemon=True).start()
    return future


@nonfinite_allowed()  # a nonfinite trajectory is refused
def _run(
    future: Future[SensitivityState], work: SensitivityWork, options: Refit, state: SensitivityState
) -> None:
    try:
        future.set_result(refitted_now(work, options, state))
    except Exception as error:  # noqa: BLE001, raised by `Future.result`
        future.set_exception(error)


def _caught_up(work: SensitivityWork, state: SensitivityState, fork: Fork) -> SensitivityState:
    """Return one member whose finished refit assimilates the next samples since its start."""
    row, last, x = int(fork.row[0]), state.log.shape[1] - 1, fork.filter
    rows = state.log[:, row : row + 1 + AT_A_TIME]
    for interval in intervals_since(rows, work.filter.problem.channels):
        x, outcome = assimilate(work.filter, x, work.filter.span(interval), work.options)
        if not outcome.good:
            return _without_fork(state, x)
        x, row = work.filter.relinearised(x), row + 1
    if row < last:
        return changed(state, fork=changed(fork, filter=x, row=np.array([row])))
    newer = x if state.since_newer[0] == last else state.newer
    return _without_fork(changed(state, now=x, newer=newer), x)


def _without_fork(state: SensitivityState, x: FilterState) -> SensitivityState:
    return changed(state, fork=Fork.none(x))
