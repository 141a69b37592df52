"""Iterated Kalman smoother for the start of a run, about the most probable trajectory.

A plain update leaves a linearisation error that a state with long memory never forgets. This error
matters while the unknowns are about as uncertain as their prior. Therefore the first samples are
assimilated again, about trajectories of the unknowns from damped Gauss-Newton steps (the iterated
Kalman smoother of Bell 1994). A step is accepted only if it increases the joint probability of
samples and prior. The method applies to constant and to moving unknowns.

A `Window` is the data of plain Gauss-Newton steps of a reference, for example for one sample.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from livepde.fem import Moment
from livepde.laws.assimilation import absorb, assimilate
from livepde.laws.filter import Filter
from livepde.laws.filter_state import FilterState, along, coordinates
from livepde.laws.history import first_interval, intervals_since
from livepde.laws.sensitivity_state import NEVER, SensitivityState, SensitivityWork, new_window
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Mask
from livepde.linalg.member_arrays import changed, put_each, take
from livepde.stepping import Interval

AGREED = 0.5  # standard deviations between reference and estimate at which the steps stop
TRUSTED = 1.0  # trust radius of a step of the reference, in prior standard deviations
HALF = 0.5  # remaining share of a variance below which a linearisation error may matter
ITERATIONS = 6  # largest number of Gauss-Newton steps
HALVINGS = 4  # largest number of trials of a step, each half as long as the one before
CONVERGED = 0.3  # standard deviations: convergence at a step of this size
HOLDS = 0.1  # standard deviations in each direction: a first step below this needs no iteration
ENOUGH = 16  # samples: with so many, a trajectory that explains them is taken to be unique, and the
# start ends once the linearisation holds, because later samples move the estimate less
STRIDE = 2.0  # largest step of an unknown, in prior standard deviations
OUTLIER = 6.0  # standard deviations of the noise beyond which a reading has little weight


@dataclass(frozen=True, eq=False, kw_only=True)
class Window:
    """Filters before and after consecutive samples of one member."""

    start: FilterState  # filter at the start of the window
    now: FilterState  # filter after the samples
    # Latent parameter at the start that gave the linearisation point of `now`, shape (m,).
    reference: Array
    # True if the window begins with the initial state of the model (`Model.initial`).
    initial: bool
    moment: Moment  # time and inputs at the start
    length: float  # time since the start


def _estimate_shift(filter_: Filter, window: Window) -> Array:
    """Return the estimate minus the reference, at the start of the window, shape (k,)."""
    reduction, drift = filter_.reduction, float(filter_.drifts(window.now.member)[0])
    estimate = reduction.bounded(filter_.estimate(window.now)[0])
    start = reduction.traced(estimate, window.start.q[0], window.length, drift)
    return reduction.reduced(start - window.reference)


def next_reference(filter_: Filter, window: Window) -> Array:
    """Return the next reference at the start of the window, towards the estimate, (m,)."""
    step = _estimate_shift(filter_, window)
    step = step * min(1.0, TRUSTED / max(float(np.abs(step).max()), 1e-300))
    return window.reference + filter_.reduction.Phi @ step


def missed_most(filter_: Filter, window: Window) -> float:
    """Return the largest distance of reference and estimate, in prior standard deviations."""
    return float(np.abs(_estimate_shift(filter_, window)).max(initial=0.0))


def distance(filter_: Filter, window: Window) -> float:
    """Return the distance between estimate and reference, in standard deviations."""
    now = window.now
    shift = filter_.reduction.transition(window.length) @ _estimate_shift(filter_, window)
    # The inflation makes these the reported standard deviations.
    return deviations(now, shift) / float(now.innovations.inflation[0])


def placed(filter_: Filter, window: Window, q: Array) -> FilterState:
    """Return the filter at the start of the window with the linearisation point q."""
    model, reduction = filter_.problem.model, filter_.reduction
    now, start = window.now, window.start
    start = replace(start, level=now.level, samples=now.samples, kept=now.kept)
    shift = reduction.reduced(q - start.q[0])
    # The initial state of the model changes with q along du_0/dq, and has no other uncertainty.
    if window.initial:
        initial = model.initial_directions(q, reduction.Phi, window.moment)
        u, du = model.initial_state(q, window.moment), -initial @ shift
        U = start.C @ initial.T
        return replace(start, q=q[None], u=u[None], du=du[None], da=-shift[None], U=U)
    # The estimate stays the same: du and da decrease by the shift of the reference.
    moved = along(start, 0, shift)
    return replace(start, q=q[None], u=start.u + moved, du=start.du - moved, da=start.da - shift)


@dataclass(frozen=True, eq=False)
class _Pass:
    """Result of assimilating the samples about one trajectory of the unknowns."""

    # Reduced unknowns at the start and in each interval, shapes (1 + intervals, k): linearisation
    # points of the filter, and smoothed estimates from all samples.
    trajectory: Array
    smoothed: Array
    x: FilterState  # the filter after the last sample
    misfit: float  # minus twice the log probability of the trajectory, up to a constant


def iterate_starts(
    work: SensitivityWork, state: SensitivityState, due: Mask
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after iterating the starts that are due, and diagnostics or None."""
    moved = np.full(len(state), np.nan)
    each: dict[int, SensitivityState] = {}
    for k in np.flatnonzero(due).tolist():
        each[k], moved[k] = _iterated(work, take(state, k))
    state = put_each(state, each)
    if np.isnan(moved).all():
        return state, None
    return state, replace(state.now.innovations.diagnostics, smoother_moved=moved)


def _iterated(work: SensitivityWork, state: SensitivityState) -> tuple[SensitivityState, float]:
    """Return one member about its most probable trajectory, and the move of its estimate.

    The move is in standard deviations, NaN without an iteration. The start ends when the samples
    have halved the variance of constant unknowns in all directions and a move is negligible.
    """
    count, moved, shares = int(state.assimilated[0]), math.nan, _shares(state.start, state.now)
    holds = HOLDS * math.sqrt(len(shares))
    # While all directions keep most of their variance, the estimate has not moved far enough for
    # the linearisation to matter.
    if shares[0] < HALF:
        x, moved = _searched(work, state, holds)
        if x is not None:
            # Earlier values would be additional columns in each later update.
            x = changed(x, past=x.past[:, :, :0], dpast=x.dpast[:, :0])
            state = changed(state, now=work.filter.relinearised(x))
        stays = shares[-1] < HALF and not work.filter.moves
        if stays and count >= ENOUGH and moved <= holds:
            return changed(state, due=np.array([NEVER])), moved
    if count >= work.window:
        return new_window(work, state.now, state), moved
    return changed(state, due=2 * state.assimilated), moved


def _searched(
    work: SensitivityWork, state: SensitivityState, holds: float
) -> tuple[FilterState | None, float]:
    """Return the filter about the most probable trajectory, and the move of its estimate.

    The result is None and infinity if no trajectory is plausible. `holds`: a negligible move.
    """
    samples, now = _Samples.of(work, state), state.now
    # The search omits ledger and discretisation errors, which triple its cost.
    searched = samples.unaccompanied
    best = iterated_smoother(searched)
    if best is None or not searched.believable(best):
        return None, math.inf
    moved = apart(work.filter, best.x, now)
    if searched is samples:
        return best.x, moved
    size = now.C.shape[2]
    # Padding rows, for other members of a fleet with more rows, are zero.
    more = now.U[0, size:].any() or now.C[0, size:].any()
    square = not more and best.x.C.shape[1] == size
    if moved <= holds and usual(now) and square:
        # Ledger and discretisation errors remain valid about the same trajectory: they refer to the
        # rows of the square root, which are the rows of the prior in both filters.
        causes = now.causes[:, :size]
        parts = {"ledger": now.ledger, "causes": causes, "shadows": now.shadows}
        return changed(best.x, **parts), moved
    whole = samples.about(best.trajectory)
    return None if whole is None else whole.x, moved


def iterated_smoother(samples: _Samples) -> _Pass | None:
    """Return the pass about the most probable trajectory; None if all trajectories fail."""
    ends: list[_Pass] = []
    for trajectory in _initial_trajectories(samples):
        first = samples.about(trajectory)
        if first is None:
            continue
        ends.append(_descended(samples, first))
        step = (first.smoothed - first.trajectory)[-1]
        held = deviations(first.x, step) <= HOLDS * math.sqrt(len(step))
        # Gauss-Newton steps end in a local minimum. Other starts are skipped only if this one
        # explains the samples, and either these are many or its first linearisation held.
        if samples.explained(ends[-1]) and (len(samples.intervals) >= ENOUGH or held):
            break
    return min(ends, key=lambda end: end.misfit, default=None)


def usual(x: FilterState) -> bool:
    """Return True if the innovations of one member are not significantly larger than expected."""
    count, squares = x.innovations.sums[0, 0], x.innovations.sums[0, 2]
    return bool(squares <= count + 3.0 * math.sqrt(2.0 * count))


def _initial_trajectories(samples: _Samples) -> Iterator[Array]:
    """Yield trajectories to start from, the most promising first."""
    shape = 1 + len(samples.intervals), samples.state.now.C.shape[2]
    if not samples.work.filter.moves:  # the estimate of the filter, which used safeguards
        yield np.broadcast_to(samples.reached, shape)
    plain = samples.about(None)
    if plain is not None:
        yield plain.smoothed
    yield np.zeros(shape)


def _descended(samples: _Samples, best: _Pass) -> _Pass:
    for _ in range(ITERATIONS):
        step = best.smoothed - best.trajectory
        # For a step within the uncertainty, the linearisation error is far below the step.
        if deviations(best.x, step[-1]) <= CONVERGED:
            break
        step *= min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-300))
        tried = (samples.about(best.trajectory + 0.5**k * step) for k in range(HALVINGS))
        better = next((trial for trial in tried if trial and trial.misfit < best.misfit), None)
        if better is None:
            break
        gained, best = best.misfit - better.misfit, better
        if gained <= CONVERGED**2:  # the gain of a step of `CONVERGED` standard deviations
            break
    return best


def _shares(before: FilterState, now: FilterState) -> Array:
    """Return the remaining shares of the variance of the unknowns of one member, ascending."""
    # Eigenvalues of the present covariance relative to the covariance at the start have no units.
    earlier, later = before.C[0].T @ before.C[0], now.C[0].T @ now.C[0]
    # The shift makes the matrix definite if a coordinate has no variance at the start.
    return np.asarray(eigh(later, earlier + 1e-12 * np.trace(earlier) * np.eye(len(later)))[0])


def apart(filter_: Filter, x: FilterState, other: FilterState) -> float:
    """Return the distance of the estimates of two filters, in standard deviations of the first."""
    shift = filter_.reduction.reduced(filter_.estimate(x) - filter_.estimate(other))[0]
    return deviations(x, shift)


def deviations(x: FilterState, shift: Array) -> float:
    """Return the length of a shift of the unknowns of one member in standard deviations."""
    return float(np.linalg.norm(coordinates(x.C[0], shift)))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Samples:
    """The samples of one member since the start, to be assimilated again."""

    work: SensitivityWork
    state: SensitivityState
    opening: Interval
    intervals: Sequence[Interval]
    # The samples with discretisation errors, which widen the gate. None: these samples include
    # them, or the law does not estimate them.
    precise: _Samples | None = None

    @classmethod
    def of(cls, work: SensitivityWork, state: SensitivityState) -> _Samples:
        """Return the samples of the window of one member."""
        log, channels = state.log[:, int(state.window[0]) :], work.filter.problem.channels
        opening = first_interval(log, channels)
        intervals = intervals_since(log, channels)
        return cls(work=work, state=state, opening=opening, intervals=intervals)

    @property
    def unaccompanied(self) -> _Samples:
        """The samples, to be assimilated without ledger and discretisation errors."""
        if self.work.filter.judge is None and self.work.filter.shadows is None:
            return self
        work, state = self.work.unaccompanied, self.state.unaccompanied
        precise = None if self.work.filter.shadows is None else self
        return replace(self, work=work, state=state, precise=precise)

    def explained(self, pass_: _Pass) -> bool:
        """Return True if the misfit of a pass is not significantly larger than the noise.

        The sum of m squared residuals, in units of the noise, has the mean m and variance 2 m.
        """
        readings = sum(int(np.isfinite(interval.z1).sum()) for interval in self.intervals)
        return pass_.misfit <= readings + 3.0 * math.sqrt(2.0 * readings)

    def believable(self, pass_: _Pass) -> bool:
        """Return True if the last estimate of a pass is within `within` of the prior then."""
        reduction = self.work.filter.reduction
        parts = reduction.problem.model.latent.parts.values()
        last = reduction.in_prior_units(pass_.smoothed[-1][None, None], pass_.x.age)
        return bool(np.abs(last).max() <= max(item.unknown.within for item in parts))

    @property
    def reached(self) -> Array:
        """Present estimate of the reduced unknowns, shape (k,)."""
        filter_ = self.work.filter
        estimate = filter_.estimate(self.state.now) - filter_.problem.model.latent.prior
        return np.asarray(filter_.reduction.reduced(estimate)[0])

    def about(self, trajectory: Array | None) -> _Pass | None:
        """Assimilate the samples about a trajectory, or about each estimate; None on failure."""
        result = self._about(trajectory)
        return result if result or self.precise is None else self.precise.about(trajectory)

    def _needs_precise(self, x: FilterState) -> bool:
        """Return True if the gate refused a reading that it may use with discretisation errors.

        These errors widen the gate, so that a reading used without them is used with them.
        """
        return self.precise is not None and bool(np.count_nonzero(x.screened.refused))

    def _about(self, trajectory: Array | None) -> _Pass | None:
        filter_, reduction = self.work.filter, self.work.filter.reduction
        prior = filter_.problem.model.latent.prior
        known = self.state.start.q[0]
        # Keep the part of the start outside the modes, which no trajectory can change.
        beyond = known - prior - reduction.Phi @ reduction.reduced(known - prior)
        q = known if trajectory is None else prior + beyond + reduction.Phi @ trajectory[0]
        x, misfit = self._placed(q), 0.0
        if self.state.opening[0]:
            misfit += missed(filter_, x, self.opening)
            x, _ = absorb(filter_, x, filter_.span(self.opening), self.work.options)
            if self._needs_precise(x):
                return None
        x = self._remembered(x)
        # The prior at the start is a ~ N(0, I): minus twice its log density is |a|^2.
        followed = [reduction.reduced(x.q[0] - prior)]
        misfit += float(followed[0] @ followed[0])
        for number, interval in enumerate(self.intervals, start=1):
            h = interval.t1 - interval.t0
            if trajectory is None:
                x = filter_.relinearised(x)
            elif filter_.moves:
                x = expecting(filter_, x, trajectory[number], h)
            x, outcome = assimilate(filter_, x, filter_.span(interval), self.work.options)
            if self._needs_precise(x) or not outcome.good:
                return None
            x = self._remembered(x)
            followed.append(reduction.reduced(x.q[0] - prior))
            misfit += missed(filter_, x, interval)
            misfit += self._moved(followed, x, h)
        x = x if filter_.moves else filter_.remembered(x)  # constants have one smoothed value
        smoothed = np.broadcast_to(x.dpast[0].reshape(-1, x.C.shape[2]), np.shape(followed))
        return _Pass(np.array(followed), smoothed, x, misfit)

    def _moved(self, followed: Sequence[Array], x: FilterState, h: float) -> float:
        """Return the misfit of the last increment of the unknowns."""
        filter_, reduction = self.work.filter, self.work.filter.reduction
        if not filter_.moves:
            return 0.0
        # The increment, given the value before, has the variance of the process noise.
        gained = reduction.gained(h, np.zeros((1, reduction.size)), filter_.drifts(x.member))[0]
        return moved(filter_, followed[-2], followed[-1], h, gained)

    def _remembered(self, x: FilterState) -> FilterState:
        return self.work.filter.remembered(x) if self.work.filter.moves else x

    def _placed(self, q: Array) -> FilterState:
        state, opening = self.state, self.opening
        length = self.intervals[-1].t1 - opening.t1 if self.intervals else 0.0
        now, initial = state.now, bool(state.initial[0])
        window = Window(
            start=self.work.at_level(state.start, now),
            now=now,
            reference=state.start.q[0],
            initial=initial,
            moment=opening.end,
            length=length,
        )
        return placed(self.work.filter, window, self.work.filter.reduction.bounded(q))


def missed(filter_: Filter, x: FilterState, interval: Interval) -> float:
    """Return the squared misfit of the linearisation point at the end of an interval."""
    alone = changed(x, du=np.zeros_like(x.du), da=np.zeros_like(x.da))
    predicted, _ = filter_.sensors.observe(alone, filter_.span(interval).end)
    e = np.abs((interval.z1 - predicted) / filter_.noise_of(x, interval))
    # Beyond `OUTLIER` the cost grows logarithmically, which limits the influence of outliers.
    beyond = 2.0 * OUTLIER**2 * np.log(np.maximum(e / OUTLIER, 1.0))
    return float(np.nansum(np.minimum(e, OUTLIER) ** 2 + beyond))


def moved(filter_: Filter, before: Array, after: Array, h: float, gained: Array) -> float:
    """Return the squared increment of a trajectory in a time h, in units of its process noise."""
    increment = after - filter_.reduction.transition(h) @ before
    return float((increment[gained > 0.0] ** 2 / gained[gained > 0.0]).sum())


def expecting(filter_: Filter, x: FilterState, a: Array, h: float) -> FilterState:
    """Return a filter whose linearisation point evolves to the reduced unknowns a in a time h."""
    reduction = filter_.reduction
    now = np.linalg.solve(reduction.transition(h), a)
    shift = now - reduction.reduced(x.q[0] - filter_.problem.model.latent.prior)
    q = reduction.bounded(x.q + reduction.Phi @ shift)
    return changed(x, q=q, da=x.da - reduction.reduced(q - x.q))
