"""The start of a run: the samples so far, linear about the trajectory that they make most probable.

A plain update leaves a second-order error that a state with long memory never forgets. While the
unknowns are as uncertain as their prior that error counts, so the first samples are assimilated
again, about trajectories of the unknowns that are found by damped Gauss-Newton steps: the iterated
Kalman smoother of Bell (1994). It accepts a step only if it makes the samples and the prior
together more probable, and serves unknowns that stay and unknowns that move.

A `Window` is what plain Gauss-Newton steps of a reference act on, such as those of one sample.
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
TRUSTED = 1.0  # prior standard deviations that a step moves the reference at most: a trust region
HALF = 0.5  # share of a variance that is left, below which a linearisation may have mattered
ITERATIONS = 6  # Gauss-Newton steps at most
HALVINGS = 4  # of a step that makes samples and prior less probable
CONVERGED = 0.3  # standard deviations that a step moves the trajectory by, at the end of it
HOLDS = 0.1  # the same in each direction, of the first step, for a linearisation that holds
ENOUGH = 16  # samples that no other trajectory explains as well as one that is found, and with
# which the start ends where the linearisation holds: what follows moves the estimate less
STRIDE = 2.0  # prior standard deviations that a step moves an unknown at most
OUTLIER = 6.0  # standard deviations of the noise beyond which a reading counts no more


@dataclass(frozen=True, eq=False, kw_only=True)
class Window:
    """Some samples of one member: the filter before and after them."""

    # The filter where the window begins, and after the samples.
    start: FilterState
    now: FilterState
    # Latent parameter at the start from which the reference of `now` comes, shape (m,).
    reference: Array
    # True if the window begins with the initial state that the model says (`Model.initial`).
    initial: bool
    # Time and inputs at the start, and the time since.
    moment: Moment
    length: float


def _missed(filter_: Filter, window: Window) -> Array:
    """Return by how much the reference misses the estimate at the window's start, shape (k,)."""
    reduction, drift = filter_.reduction, float(filter_.drifts(window.now.member)[0])
    estimate = reduction.bounded(filter_.estimate(window.now)[0])
    start = reduction.traced(estimate, window.start.q[0], window.length, drift)
    return reduction.reduced(start - window.reference)


def next_reference(filter_: Filter, window: Window) -> Array:
    """Return the reference at the window's start that is next: towards the estimate, (m,)."""
    step = _missed(filter_, window)
    step = step * min(1.0, TRUSTED / max(float(np.abs(step).max()), 1e-300))
    return window.reference + filter_.reduction.Phi @ step


def missed_most(filter_: Filter, window: Window) -> float:
    """Return by how many prior standard deviations the reference misses the estimate."""
    return float(np.abs(_missed(filter_, window)).max(initial=0.0))


def distance(filter_: Filter, window: Window) -> float:
    """Return the distance between estimate and reference, in standard deviations."""
    now = window.now
    shift = filter_.reduction.transition(window.length) @ _missed(filter_, window)
    # In standard deviations that are inflated as the reported ones are.
    return deviations(now, shift) / float(now.innovations.inflation[0])


def placed(filter_: Filter, window: Window, q: Array) -> FilterState:
    """Return the filter at the start of the window, linear about q."""
    model, reduction = filter_.problem.model, filter_.reduction
    now, start = window.now, window.start
    start = replace(start, level=now.level, samples=now.samples, kept=now.kept)
    shift = reduction.reduced(q - start.q[0])
    # Such an initial state moves with q along du_0/dq, and is uncertain by the unknowns alone.
    if window.initial:
        initial = model.initial_directions(q, reduction.Phi, window.moment)
        u, du = model.initial_state(q, window.moment), -initial @ shift
        U = start.C @ initial.T
        return replace(start, q=q[None], u=u[None], du=du[None], da=-shift[None], U=U)
    # The estimate does not move with the reference: du and da fall by as much.
    moved = along(start, 0, shift)
    return replace(start, q=q[None], u=start.u + moved, du=start.du - moved, da=start.da - shift)


@dataclass(frozen=True, eq=False)
class _Pass:
    """The samples, assimilated linear about one trajectory of the unknowns."""

    # Reduced unknowns at the start and in each interval, shape (1 + intervals, k): those about
    # which the filter was linear, and those that it then estimates from all samples.
    trajectory: Array
    smoothed: Array
    x: FilterState  # the filter after the last sample
    # Minus twice the logarithm of the probability of the trajectory, up to a constant.
    misfit: float


def iterate_starts(
    work: SensitivityWork, state: SensitivityState, due: Mask
) -> tuple[SensitivityState, Diagnostics[Array] | None]:
    """Return all members after the iteration of those that are due, and diagnostics if one was."""
    moved = np.full(len(state), np.nan)
    each: dict[int, SensitivityState] = {}
    for k in np.flatnonzero(due).tolist():
        each[k], moved[k] = _iterated(work, take(state, k))
    state = put_each(state, each)
    if np.isnan(moved).all():
        return state, None
    return state, replace(state.now.innovations.diagnostics, smoother_moved=moved)


def _iterated(work: SensitivityWork, state: SensitivityState) -> tuple[SensitivityState, float]:
    """Return one member about its most probable trajectory, and how far that has moved it, or NaN.

    The move is in standard deviations of the unknowns. The start ends where the samples have halved
    the variance of constant unknowns in all directions, and an iteration hardly moves the estimate.
    """
    count, moved, shares = int(state.assimilated[0]), math.nan, _shares(state.start, state.now)
    holds = HOLDS * math.sqrt(len(shares))
    # While all directions keep most of their variance, no estimate has moved far enough for its
    # linearisation to matter.
    if shares[0] < HALF:
        found, moved = _searched(work, state, holds)
        if found is not None:
            # Earlier values would cost columns in each later update.
            found = changed(found, past=found.past[:, :, :0], dpast=found.dpast[:, :0])
            state = changed(state, now=work.filter.relinearised(found))
        stays = shares[-1] < HALF and not work.filter.moves
        if stays and count >= ENOUGH and moved <= holds:
            return changed(state, due=np.array([NEVER])), moved
    if count >= work.window:
        return new_window(work, state.now, state), moved
    return changed(state, due=2 * state.assimilated), moved


def _searched(
    work: SensitivityWork, state: SensitivityState, holds: float
) -> tuple[FilterState | None, float]:
    """Return the filter about the most probable trajectory, and how far that has moved it.

    None and infinity if no trajectory is possible. `holds`: a move that changes no linearisation.
    """
    samples, now = _Samples.of(work, state), state.now
    # A search needs neither the ledger nor the errors of the discretisation, which cost twice as
    # much again.
    searched = samples.unaccompanied
    best = iterated_smoother(searched)
    if best is None or not searched.believable(best):  # it has not found the samples but lost them
        return None, math.inf
    moved = apart(work.filter, best.x, now)
    if searched is samples:
        return best.x, moved
    size = now.C.shape[2]
    # Other members of a fleet may have more rows: of one without them, those are zero.
    more = now.U[0, size:].any() or now.C[0, size:].any()
    square = not more and best.x.C.shape[1] == size
    if moved <= holds and usual(now) and square:
        # Ledger and errors of the discretisation are linear about the trajectory, on the rows of
        # the square root, which are those of the prior: updates move them alike.
        causes = now.causes[:, :size]
        parts = {"ledger": now.ledger, "causes": causes, "shadows": now.shadows}
        return changed(best.x, **parts), moved
    whole = samples.about(best.trajectory)
    return None if whole is None else whole.x, moved


def iterated_smoother(samples: _Samples) -> _Pass | None:
    """Return the pass about the most probable trajectory; None if none could be followed."""
    ends: list[_Pass] = []
    for trajectory in _beginnings(samples):
        one = samples.about(trajectory)
        if one is None:
            continue
        ends.append(_descended(samples, one))
        step = (one.smoothed - one.trajectory)[-1]
        held = deviations(one.x, step) <= HOLDS * math.sqrt(len(step))
        # Gauss-Newton steps end in a local minimum: other beginnings are spared only if this one
        # explains the samples, and either these are many or its first linearisation held.
        if samples.explained(ends[-1]) and (len(samples.intervals) >= ENOUGH or held):
            break
    return min(ends, key=lambda one: one.misfit, default=None)


def usual(x: FilterState) -> bool:
    """True if the innovations of one member are no larger than their noise makes usual."""
    count, squares = x.innovations.sums[0, 0], x.innovations.sums[0, 2]
    return bool(squares <= count + 3.0 * math.sqrt(2.0 * count))


def _beginnings(samples: _Samples) -> Iterator[Array]:
    """Return trajectories to begin at, the most promising one first."""
    shape = 1 + len(samples.intervals), samples.state.now.C.shape[2]
    if not samples.work.filter.moves:  # where the filter has come to, with its safeguards
        yield np.broadcast_to(samples.reached, shape)
    plain = samples.about(None)
    if plain is not None:
        yield plain.smoothed
    yield np.zeros(shape)


def _descended(samples: _Samples, best: _Pass) -> _Pass:
    for _ in range(ITERATIONS):
        step = best.smoothed - best.trajectory
        # Where the step is within the uncertainty, the second-order error is far below it.
        if deviations(best.x, step[-1]) <= CONVERGED:
            break
        step *= min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-300))
        tried = (samples.about(best.trajectory + 0.5**k * step) for k in range(HALVINGS))
        better = next((one for one in tried if one and one.misfit < best.misfit), None)
        if better is None:
            break
        gained, best = best.misfit - better.misfit, better
        if gained <= CONVERGED**2:  # what a step of so many standard deviations gains
            break
    return best


def _shares(before: FilterState, now: FilterState) -> Array:
    """Return the remaining shares of the variance of the unknowns of one member, ascending."""
    # Eigenvalues of the covariance now relative to that at the start: they have no units.
    earlier, later = before.C[0].T @ before.C[0], now.C[0].T @ now.C[0]
    # The eigenproblem needs a definite matrix, also where a coordinate began without variance.
    return np.asarray(eigh(later, earlier + 1e-12 * np.trace(earlier) * np.eye(len(later)))[0])


def apart(filter_: Filter, x: FilterState, other: FilterState) -> float:
    """Return how far estimates of two filters are apart, in standard deviations of the first."""
    shift = filter_.reduction.reduced(filter_.estimate(x) - filter_.estimate(other))[0]
    return deviations(x, shift)


def deviations(x: FilterState, shift: Array) -> float:
    """Return the length of a shift of the unknowns of one member in standard deviations."""
    return float(np.linalg.norm(coordinates(x.C[0], shift)))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Samples:
    """The samples of one member since the start, ready to be assimilated again."""

    work: SensitivityWork
    state: SensitivityState
    opening: Interval
    intervals: Sequence[Interval]
    # The same with the errors of the discretisation, by which the gate decides; None: these have
    # them, or the law follows none.
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
        """The same samples, assimilated without ledger and discretisation errors."""
        if self.work.filter.judge is None and self.work.filter.shadows is None:
            return self
        work, state = self.work.unaccompanied, self.state.unaccompanied
        precise = None if self.work.filter.shadows is None else self
        return replace(self, work=work, state=state, precise=precise)

    def explained(self, one: _Pass) -> bool:
        """True if a pass misses the samples by no more than their noise makes usual.

        Squared misfits of m readings, each in standard deviations of its noise, sum up to m, give
        or take the square root of 2 m.
        """
        readings = sum(int(np.isfinite(interval.z1).sum()) for interval in self.intervals)
        return one.misfit <= readings + 3.0 * math.sqrt(2.0 * readings)

    def believable(self, one: _Pass) -> bool:
        """True if a pass ends as near to the prior at its end as unknowns may be (`within`)."""
        reduction = self.work.filter.reduction
        parts = reduction.problem.model.latent.parts.values()
        last = reduction.in_prior_units(one.smoothed[-1][None, None], one.x.age)
        return bool(np.abs(last).max() <= max(item.unknown.within for item in parts))

    @property
    def reached(self) -> Array:
        """Reduced unknowns as the filter estimates them now, shape (k,)."""
        filter_ = self.work.filter
        estimate = filter_.estimate(self.state.now) - filter_.problem.model.latent.prior
        return np.asarray(filter_.reduction.reduced(estimate)[0])

    def about(self, trajectory: Array | None) -> _Pass | None:
        """Assimilate the samples, linear about a trajectory or each estimate; None if it fails."""
        found = self._about(trajectory)
        return found if found or self.precise is None else self.precise.about(trajectory)

    def _unlike(self, x: FilterState) -> bool:
        """True if the gate has refused a reading that it may use in the run.

        What it uses without discretisation errors it uses with them, which widen it.
        """
        return self.precise is not None and bool(np.count_nonzero(x.screened.refused))

    def _about(self, trajectory: Array | None) -> _Pass | None:
        filter_, reduction = self.work.filter, self.work.filter.reduction
        prior = filter_.problem.model.latent.prior
        known = self.state.start.q[0]
        # No trajectory of the modes can move the rest of the start, which therefore is kept.
        beyond = known - prior - reduction.Phi @ reduction.reduced(known - prior)  # of the modes
        q = known if trajectory is None else prior + beyond + reduction.Phi @ trajectory[0]
        x, misfit = self._placed(q), 0.0
        if self.state.opening[0]:
            misfit += missed(filter_, x, self.opening)
            x, _ = absorb(filter_, x, filter_.span(self.opening), self.work.options)
            if self._unlike(x):
                return None
        x = self._remembered(x)
        # The prior of the start is a ~ N(0, I): minus twice its logarithm is |a|^2.
        followed = [reduction.reduced(x.q[0] - prior)]
        misfit += float(followed[0] @ followed[0])
        for number, interval in enumerate(self.intervals, start=1):
            h = interval.t1 - interval.t0
            if trajectory is None:
                x = filter_.relinearised(x)
            elif filter_.moves:
                x = expecting(filter_, x, trajectory[number], h)
            x, told = assimilate(filter_, x, filter_.span(interval), self.work.options)
            if self._unlike(x) or not told.good:
                return None
            x = self._remembered(x)
            followed.append(reduction.reduced(x.q[0] - prior))
            misfit += missed(filter_, x, interval)
            misfit += self._moved(followed, x, h)
        x = x if filter_.moves else filter_.remembered(x)  # what stays is now as it always was
        smoothed = np.broadcast_to(x.dpast[0].reshape(-1, x.C.shape[2]), np.shape(followed))
        return _Pass(np.array(followed), smoothed, x, misfit)

    def _moved(self, followed: Sequence[Array], x: FilterState, h: float) -> float:
        """Return the misfit that the last increment of the unknowns adds."""
        filter_, reduction = self.work.filter, self.work.filter.reduction
        if not filter_.moves:
            return 0.0
        # Its density is that given the value before: its variance is that of the process noise.
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
    # Beyond `OUTLIER` the cost grows like a logarithm, so that no wrong reading chooses the
    # trajectory.
    beyond = 2.0 * OUTLIER**2 * np.log(np.maximum(e / OUTLIER, 1.0))
    return float(np.nansum(np.minimum(e, OUTLIER) ** 2 + beyond))


def moved(filter_: Filter, before: Array, after: Array, h: float, gained: Array) -> float:
    """Return the squared increment of a trajectory in a time h, in units of its process noise."""
    increment = after - filter_.reduction.transition(h) @ before
    return float((increment[gained > 0.0] ** 2 / gained[gained > 0.0]).sum())


def expecting(filter_: Filter, x: FilterState, a: Array, h: float) -> FilterState:
    """Return a filter whose linearisation point is expected to have the unknowns a in a time h."""
    reduction = filter_.reduction
    now = np.linalg.solve(reduction.transition(h), a)
    shift = now - reduction.reduced(x.q[0] - filter_.problem.model.latent.prior)
    q = reduction.bounded(x.q + reduction.Phi @ shift)
    return changed(x, q=q, da=x.da - reduction.reduced(q - x.q))
