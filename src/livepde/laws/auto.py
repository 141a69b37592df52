"""The sensitivity law without anything to tune: a bank of filters, weighed by the evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.assimilation import OK, MemberReports
from livepde.laws.bank import (
    CANDIDATES,
    STAYS,
    WIDE,
    AutoState,
    Bank,
    first_guess,
    normalised,
    numbered,
    say_the_same,
    scaled,
)
from livepde.laws.filter_state import FilterState
from livepde.laws.history import (
    added,
    empty_log,
    first_interval,
    intervals_since,
    opened,
    reaching,
    with_readings,
)
from livepde.laws.jumps import Jumps
from livepde.laws.law import Belief, Deferred, FixedInterval, Law, Problem, Report
from livepde.laws.member_arrays import changed, join, take
from livepde.laws.replay import Replay
from livepde.laws.sensitivity import SensitivityLaw
from livepde.laws.sensitivity_state import (
    NEVER,
    SensitivityState,
    SensitivityWork,
    new_window,
    restarted,
    without_factors,
)
from livepde.laws.shadows import Shadows
from livepde.laws.smoother import evidence, smoothed
from livepde.laws.step_diagnostics import Diagnostics
from livepde.laws.verdict import judged
from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import Alexander2, Interval, Scheme

__all__ = ["AutoLaw"]

MEMORY = 500.0  # samples over which evidence fades, so that another member can take over
PRUNED = 1e-3  # a member with less weight than that sleeps
TRIAL = 64  # samples that a member has at least to show what it can
CHECKED = 16  # samples between two looks at who may sleep
JUMPS = Jumps()
REGULAR = 1e-6  # share of a time between samples that is rounding
SILENCE = 512  # samples that tell nothing of the noise, after which the bank starts where it is


@dataclass(frozen=True)
class AutoLaw(Law[Bank, AutoState]):
    """`SensitivityLaw` with everything found from the samples.

    A bank of sensitivity laws runs side by side. Its members assume that the unknowns stay as they
    are, that they drift, at one of four rates, or that the prior is three times as wide. Member i
    has the weight

        w_i ~ chance_i prod_k p(z_k | z_1 ... z_(k-1), i)

    with a memory of 500 samples, and the estimate is the mixture of all, with its mean and
    covariance: where members differ the interval is wider.

    A member whose weight falls below 0.001, or that says the same as a heavier one, sleeps. Those
    that sleep wake as copies of the leading one when the number of samples has doubled, and when
    the process has changed: when its innovations say so (`Jumps`, noted as "jump"), or when a
    member that drifts takes the lead.

    A model with errors is a process that changes, as far as samples can tell: where it is known
    that the unknowns stay, `SensitivityLaw(replay=Replay())` says so.

    Nothing has a unit: drifts are counted in prior variances for each sample, with the usual time
    between the first samples.

    Parameters
    ----------
    modes
        As for `SensitivityLaw`.
    noise
        Standard deviation of the measurement noise; default the noise of the observation. The law
        raises this level where the innovations call for more, and never lowers it: a stated level
        above the noise of the sensors is taken to allow for model errors, which look like little
        noise and are none. Without any stated level it is free, and its first guess comes from
        differences of the first 12 samples, which are assimilated then.
    replay
        Of the members whose unknowns stay; see `Replay`.
    gate, gate_patience, shadows
        As for `SensitivityLaw`.
    """

    modes: int | str | dict[str, int] = "auto"
    noise: float | None = None
    replay: Replay = field(default_factory=Replay)
    gate: float = SensitivityLaw.gate
    gate_patience: int = 10
    shadows: Shadows | None = field(default_factory=Shadows)

    scheme: ClassVar[Scheme] = Alexander2()  # no interval holds the error of a first-order scheme
    graded_start: ClassVar[bool] = True

    def __post_init__(self) -> None:
        number = isinstance(self.noise, int | float) and np.isfinite(self.noise) and self.noise > 0
        if not (self.noise is None or number):
            raise LawError(
                f"AutoLaw: noise must be a positive number; got {self.noise!r}. The law finds the "
                "level by itself: leave noise= out of law and observation to state none."
            )
        if not isinstance(self.replay, Replay):
            raise LawError(f"AutoLaw: replay must be a Replay; got {self.replay!r}.")
        _ = self.member

    @cached_property
    def member(self) -> SensitivityLaw:
        """The law of each member, and by itself the one to take if nothing needs tuning."""
        return SensitivityLaw(
            self.modes,
            self.noise,
            replay=self.replay,
            gate=self.gate,
            gate_patience=self.gate_patience,
            shadows=self.shadows,
        )

    def weighs_readings(self) -> bool:
        return True

    def prepare(self, problem: Problem) -> Bank:
        stated = self.noise is not None or problem.observed.noise is not None
        # A replay keeps one reference, which is of no use for unknowns that move far from it.
        walks = bool(problem.model.latent.random)
        law = replace(self.member, replay=None) if walks else self.member
        if not stated:  # until it is guessed; nor is that of an initial state known
            law = replace(law, noise=1.0)
            problem = replace(problem, initial_readings={})
        work = law.prepare(problem)
        reduction = work.filter.reduction
        # A factor costs in proportion to its columns, and a field that drifts is the exception.
        rank = max(2 * reduction.size + 4, work.filter.rank)
        drifts = bool(reduction.still.any())
        candidates = tuple(c for c in CANDIDATES if drifts or not c.drift)
        replays = np.array([not (walks or c.drift) for c in candidates])
        judge = work.filter.judge
        wider = None if judge is None else judge.widened(rank - work.filter.rank)
        drift = np.zeros(len(candidates))
        work = replace(
            work,
            filter=replace(work.filter, rank=rank, drift=drift, judge=wider),
            # Some members drift: they follow a change of the process, and are compared with others.
            options=replace(
                work.options, adaptive=True, gate=replace(work.options.gate, anchors=False)
            ),
        )
        return Bank(candidates, work, replays, stated)

    def init(self, work: Bank, q0: Array, u0: Array) -> AutoState:
        return self._initial(work, self.member.init(work.work, q0, u0))

    def start(self, work: Bank, q0: Array, u0: Array, moment: Moment) -> AutoState:
        return self._initial(work, self.member.start(work.work, q0, u0, moment))

    def _initial(
        self, work: Bank, start: SensitivityState, noise: Array | None = None
    ) -> AutoState:
        """Return the bank before the first sample; one member until the noise is known."""
        if noise is None:
            stated = work.work.filter.noise
            noise = stated if work.stated else np.full_like(stated, np.nan)
        members = start
        if np.isfinite(noise).all():
            each = zip(work.candidates, work.replays, strict=True)
            members = join(
                *(
                    numbered(scaled(start, c.scale), k, self.replay.first if replays else NEVER)
                    for k, (c, replays) in enumerate(each)
                )
            )
        return AutoState(
            noise=noise,
            tick=0.0,
            waiting=start.log,
            start=start,
            members=members,
            weights=work.chances,
            until=np.full(len(work.candidates), 2 * TRIAL),
            count=0,
            due=2 * TRIAL,
            pause=2 * TRIAL,
            watch=JUMPS.start(len(noise)),
        )

    def begin(self, work: Bank, state: AutoState, interval: Interval) -> AutoState:
        span = work.work.filter.span(interval)
        if not state.known:
            return changed(state, waiting=added(state.waiting, span, np.ones(1, dtype=bool)))
        filters = work.filters(0.0, state.noise)
        return changed(state, members=self.member.begin_members(filters, state.members, span))

    def step(self, work: Bank, state: AutoState, interval: Interval) -> tuple[AutoState, Report]:
        if state.known:
            return self._assimilated(work, state, interval)
        # Until the noise is guessed one member runs free.
        filters = work.filters(0.0, np.ones_like(state.noise))
        free, report = self.member.step(filters, state.members, interval.silent)
        if not report.status.ok:
            return state, report
        span = work.work.filter.span(interval)
        one = np.ones(1, dtype=bool)
        waiting = added(opened(state.waiting, span), span, one)
        noise = first_guess(waiting[0, :, 1 : 1 + len(state.noise)])
        if noise is None and waiting.shape[1] > SILENCE:
            # So many samples told nothing of the noise: they are forgotten, so that the log does
            # not grow without end.
            here = restarted(filters, filters.filter.relinearised(free.now), free)
            nothing = empty_log(1, len(state.noise), len(work.channels))
            return changed(state, waiting=nothing, start=here, members=here), report
        if noise is None:
            return changed(state, waiting=waiting, members=free), report
        # The waiting samples are taken now, with the guessed noise, by all members from before the
        # first one.
        begun = self._initial(work, state.start, noise)
        diagnose: Callable[[], Diagnostics[float]] = Diagnostics
        first = first_interval(waiting, work.channels)
        if first.present.any():
            begun = self.begin(work, begun, first)
        for part in intervals_since(waiting, work.channels):
            begun, taken = self._assimilated(work, begun, part)
            if not taken.status.ok:
                return state, taken
            diagnose = taken.diagnose
        return begun, replace(report, diagnose=diagnose)

    def _assimilated(
        self, work: Bank, state: AutoState, interval: Interval
    ) -> tuple[AutoState, Report]:
        """Let all members that are awake take a sample, and weigh them anew."""
        tick, members = _tick(state, interval), state.members
        filters = work.filters(tick, state.noise)
        new, reports = self.member.step_members(filters, members, filters.filter.span(interval))
        change = new.now.evidence - members.now.evidence
        # A replay corrects the evidence of all samples in its window, of which the fading weights
        # remember a share alone. The window may begin anew with this sample.
        share = np.minimum(1.0, MEMORY / (members.assimilated + 1.0))
        change = np.where(new.due != members.due, change * share, change)
        if work.stated:
            new = changed(new, now=changed(new.now, level=np.maximum(new.now.level, 1.0)))
        ok = np.array([status.ok for status in reports.statuses])
        good: Mask = ok & np.isfinite(change)
        if not good.any():
            return state, reports.member(state.at(state.leader))
        # Members that sleep or have failed gain minus infinity, and so have no weight.
        gained = np.full(len(work.candidates), -np.inf)
        gained[members.now.member[good]] = change[good]
        before = np.exp(state.weights)
        weights = state.weights
        if interval.present.any():
            # Logarithms of weights relax to those before the first sample: evidence fades.
            weights = work.chances + (1.0 - 1.0 / MEMORY) * (weights - work.chances) + gained
        weights = normalised(np.where(np.isfinite(gained), weights, -np.inf))
        now = changed(
            state,
            tick=tick,
            members=new if good.all() else take(new, good),
            weights=weights,
            count=state.count + bool(interval.present.any()),
        )
        rested, onset = self._rested(work, state, now)
        return rested, self._report(work, now, members.now.member, good, reports, before, onset)

    def _rested(self, work: Bank, before: AutoState, state: AutoState) -> tuple[AutoState, int]:
        """Return the state after those that are not needed sleep, or all wake.

        Second, after an alarm, of how many samples, up to this one, innovations are too large; or
        0.
        """
        if state.count == before.count:
            return state, 0
        leader = state.leader
        at = state.at(leader)
        now = state.members.now
        innovations = now.innovations.newest[at : at + 1]
        watch, alarms = JUMPS.add(state.watch, innovations, now.screened.refused[at : at + 1])
        alarm, state = bool(alarms[0]), changed(state, watch=watch)
        onset = 0
        if alarm:
            shown = with_readings(state.members.log[at, 1:], len(state.noise))
            onset = reaching(shown, JUMPS.onset(before.watch, innovations))
        stayed = work.candidates[before.leader].drift == 0.0
        # A member that drifts takes the lead from one that does not: the process has changed, and
        # those that sleep are to be compared again soon.
        if stayed and work.candidates[leader].drift != 0.0 and state.count >= 2 * TRIAL:
            soon = min(state.due, state.count + TRIAL)
            state = changed(state, due=soon, pause=TRIAL)
        if alarm or state.count >= state.due:
            return self._woken(work, state, alarm), onset
        return (state if state.count % CHECKED else self._pruned(work, state)), 0

    def _pruned(self, work: Bank, state: AutoState) -> AutoState:
        """Return the state after those members sleep that have had their time and say nothing."""
        weights, numbers = state.weights.copy(), state.members.now.member
        heavier: list[int] = []
        for at in state.awake:
            k = int(numbers[at])
            if state.count >= state.until[k] and heavier:
                twin = next((j for j in heavier if say_the_same(work, state, j, at)), None)
                if twin is not None:
                    # The heavier of two that say the same takes over the weight of the other.
                    other = numbers[twin]
                    weights[other] = np.logaddexp(weights[other], weights[k])
                if twin is not None or weights[k] < np.log(PRUNED):
                    weights[k] = -np.inf
                    continue
            heavier.append(at)
        members = state.members
        if len(heavier) < len(members):
            members = take(members, np.sort(heavier))
        return changed(state, members=members, weights=normalised(weights))

    def _woken(self, work: Bank, state: AutoState, alarm: bool) -> AutoState:
        """Return the state with all drifts awake; sleeping members begin as copies of the leader.

        After an alarm the earlier measurements belong to other values of the unknowns: no replay
        goes back beyond the alarm, and the member with the wide prior, begun again from an inflated
        covariance, allows for a jump.
        """
        filters = work.filters(state.tick, state.noise)
        filter_ = filters.filter
        weights, until, leader = state.weights.copy(), state.until.copy(), state.leader
        best = take(state.members, state.at(leader))
        awake = {int(k): take(state.members, state.at(int(k))) for k in state.members.now.member}
        # A leader that began with the wide prior goes on as the one that stays, so that the number
        # WIDE is free for a start from an inflated covariance.
        if leader == WIDE and STAYS not in awake:
            best = numbered(awake.pop(WIDE), STAYS, int(best.due[0]))
            awake[STAYS] = best
            weights[STAYS], weights[WIDE] = weights[WIDE], -np.inf
            leader = STAYS
        pause = TRIAL if alarm else state.pause
        members: list[SensitivityState] = []
        for k in range(len(work.candidates)):
            if k in awake:
                one = awake[k]
                members.append(
                    new_window(filters, filter_.relinearised(one.now), one) if alarm else one
                )
                continue
            if k == WIDE and not alarm:
                continue
            members.append(self._copied(work, filters, best, k))
            # A copy has the evidence of the leader, and its own chance before the first sample.
            weights[k] = weights[leader] + work.chances[k] - work.chances[leader]
            until[k] = state.count + max(TRIAL, pause // 4)
        return changed(
            state,
            members=join(*members),
            weights=normalised(weights),
            until=until,
            due=state.count + pause,
            pause=2 * pause,
        )

    def _copied(
        self, work: Bank, filters: SensitivityWork, best: SensitivityState, k: int
    ) -> SensitivityState:
        """Return a member that begins as a copy of the leading one."""
        now = filters.filter.relinearised(best.now)
        begun = filters.filter.inflated(now, JUMPS.size) if k == WIDE else now
        due = self.replay.first if work.replays[k] else NEVER
        return numbered(restarted(filters, begun, best), k, due)

    def _report(
        self,
        work: Bank,
        state: AutoState,
        numbers: IntArray,
        good: Mask,
        reports: MemberReports,
        before: Array,
        onset: int,
    ) -> Report:
        """Return the report of the mixture: predictions by the weights before the sample."""
        share = before[numbers] * good
        predicted = np.where(good[:, None], reports.predicted, 0.0)
        predicted = (share / share.sum()) @ predicted
        leading = reports.member(int(np.flatnonzero(numbers == state.leader)[0]))
        logs, tick, now = state.weights, state.tick, state.members.now
        awake, level = now.member, now.level  # not all of the members

        def diagnosed() -> Diagnostics[float]:
            weights, drifts = np.exp(logs), work.drifts / tick
            return replace(
                leading.diagnostics,
                noise_level=float(weights[awake] @ np.sqrt(level)),
                drift=float(weights @ drifts),
                drifting=float(weights @ (drifts > 0.0)),
                prior_scale=float(np.exp(weights @ work.scales)),
                jump=float(onset > 0),
                jump_samples=float(onset) if onset else np.nan,
                awake=float(len(awake)),
            )

        return Report(OK, predicted, leading.steps, diagnosed)

    def settled(self, work: Bank, state: AutoState) -> AutoState:
        noise = state.noise if state.known else np.ones_like(state.noise)
        filters = work.filters(state.tick, noise)
        members = self.member.settled(filters, state.members)
        return state if members is state.members else changed(state, members=members)

    def unsmoothed(self, work: Bank) -> str:
        return ""

    def smoothed(
        self, work: Bank, before: AutoState, after: AutoState, data: FixedInterval
    ) -> Iterator[Belief]:
        """Smooth by the one member that makes all samples most probable.

        Who leads at the end need not have led before.
        """
        if not after.known:
            return iter([self.belief(work, after)] * (1 + len(data.intervals)))
        after = self.settled(work, after)
        last = take(after.members.now, after.at(after.leader))
        begun = before if before.known else self._initial(work, before.start, after.noise)
        filters = replace(work.filters(after.tick, after.noise), jumps=JUMPS)
        each, chances = [], []
        for k, chance in enumerate(work.chances.tolist()):
            first, now = take(begun.members, begun.at(k)), changed(last, member=np.array([k]))
            each.append((filters, first, now, data))
            chances.append(chance + evidence(*each[-1]))
        best = each[int(np.argmax(chances))]
        return (self.member.member_belief(filters, x, 0) for x in smoothed(*best))

    def suspended(self, work: Bank, state: AutoState) -> AutoState:
        filters = work.filters(state.tick, np.ones_like(state.noise))
        return changed(state, members=self.member.suspended(filters, state.members))

    def finite(self, work: Bank, state: AutoState) -> bool:
        return self.member.finite(work.work, state.members)

    def belief(self, work: Bank, state: AutoState) -> Belief:
        return self.deferred(work, state).belief()

    def deferred(self, work: Bank, state: AutoState) -> Deferred:
        noise = state.noise if state.known else np.ones_like(state.noise)
        filters, now = work.filters(state.tick, noise), without_factors(state.members.now)
        weights = np.exp(state.weights[now.member])
        verdict = self.unjudged
        if state.known:
            verdict = judged(filters.filter, now, state.at(state.leader))
        return Deferred(lambda: self._mixture(filters, now, weights), verdict)

    def _mixture(self, filters: SensitivityWork, now: FilterState, weights: Array) -> Belief:
        """Return the mean and covariance of all members."""
        order = np.argsort(-weights, kind="stable")
        # Members of less weight would add columns to the factors, and nothing that is seen.
        used = order[weights[order] >= 1e-4 * weights.max()]
        weights = weights[used] / weights[used].sum()
        each = [self.member.member_belief(filters, now, k) for k in used.tolist()]
        if len(each) == 1:
            return each[0]
        q = sum((w * b.q for w, b in zip(weights, each, strict=True)), np.zeros_like(each[0].q))
        u = sum((w * b.u for w, b in zip(weights, each, strict=True)), np.zeros_like(each[0].u))
        first = (each[0].prior_factor, each[0].rest)
        q_factor, u_factor = [], []
        for w, b in zip(np.sqrt(weights), each, strict=True):
            # The inflation by correlated innovations widens each member's own covariance; the
            # spread of the means is added as it is.
            if b.q_factor is not None and b.u_factor is not None:
                q_factor.append(w * np.column_stack([b.q_factor, b.q - q]))
                u_factor.append(w * np.column_stack([b.u_factor, b.u - u]))
        return Belief(q, u, np.hstack(q_factor), np.hstack(u_factor), *first)


def _tick(state: AutoState, interval: Interval) -> float:
    """Return the usual time between the first samples: a geometric mean, then fixed.

    The time before the first sample does not count: an unknown with the variance of its prior gains
    no variance by drift.
    """
    h = interval.t1 - interval.t0
    if state.count < 2:
        return h
    ratio = h / state.tick
    if state.count > TRIAL or abs(ratio - 1.0) < REGULAR:  # the same filters serve again
        return state.tick
    # Running geometric mean: log(tick) moves to log(h) by 1/count of the difference.
    return float(state.tick * ratio ** (1.0 / state.count))
