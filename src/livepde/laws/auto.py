"""The sensitivity law without anything to tune: a bank of filters, weighed by the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.bank import (
    CANDIDATES,
    STAYS,
    WIDE,
    AutoState,
    Bank,
    asleep,
    normalised,
    say_the_same,
    scaled,
)
from livepde.laws.base import Belief, Law, Problem, Report, Status
from livepde.laws.guess import first_guess
from livepde.laws.jumps import Jumps
from livepde.laws.past import Past
from livepde.laws.sensitivity import Replay, SensitivityLaw, SensitivityState
from livepde.linalg import Array
from livepde.stepping import ForwardStage, Interval

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
        Standard deviation of the measurement noise; default what the observation says. The law
        raises it where the innovations say so, and never lowers it: whoever states more than the
        sensors have means the errors of the model, which look like little noise and are none.
        Without either the level is free, and its first guess comes from differences of the first 12
        samples, which are assimilated then.
    replay
        Of the members whose unknowns stay; see `Replay`.
    gate, gate_patience
        As for `SensitivityLaw`.
    """

    modes: int | str | dict[str, int] = "auto"
    noise: float | None = None
    replay: Replay = field(default_factory=Replay)
    gate: float = np.inf
    gate_patience: int = 10

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

    @property
    def member(self) -> SensitivityLaw:
        """The law of each member, and by itself the one to take if nothing needs tuning."""
        return SensitivityLaw(
            self.modes,
            self.noise,
            replay=self.replay,
            gate=self.gate,
            gate_patience=self.gate_patience,
        )

    def prepare(self, problem: Problem) -> Bank:
        stated = self.noise is not None or problem.observed.noise is not None
        law = self.member if stated else replace(self.member, noise=1.0)  # until it is guessed
        filter_ = law.prepare(problem)
        # A factor costs in proportion to its columns, and a field that drifts is the exception.
        rank = 2 * filter_.Phi.shape[1] + 4
        filter_ = replace(filter_, rank=max(rank, filter_.rank), adaptive=True)
        drifts = any(not motion.evolution.moves for motion in filter_.motions)
        candidates = tuple(c for c in CANDIDATES if drifts or not c.drift)
        filters = tuple(replace(filter_, forward=ForwardStage(problem.model)) for _ in candidates)
        # What moves far has no use for a reference that stays.
        walks = any(motion.growth(1.0).any() for motion in filter_.motions)
        plain = replace(self.member, replay=None)
        laws = tuple(plain if walks or c.drift else self.member for c in candidates)
        return Bank(candidates, laws, filters, stated)

    def init(self, work: Bank, q0: Array, u0: Array) -> AutoState:
        return self._initial(work, self.member.init(work.filters[0], q0, u0))

    def start(self, work: Bank, q0: Array, u0: Array, moment: Moment) -> AutoState:
        return self._initial(work, self.member.start(work.filters[0], q0, u0, moment))

    def _initial(self, work: Bank, start: SensitivityState) -> AutoState:
        noise = work.filters[0].noise
        members = len(work.candidates)
        return AutoState(
            noise if work.stated else np.full_like(noise, np.nan),
            0.0,
            start.samples,
            start,
            tuple(scaled(start, candidate.scale) for candidate in work.candidates),
            work.chances,
            np.full(members, 2 * TRIAL),
            0,
            2 * TRIAL,
            2 * TRIAL,
            JUMPS.start(),
        )

    def begin(self, work: Bank, state: AutoState, interval: Interval) -> AutoState:
        if not state.known:
            return replace(state, waiting=state.waiting.add(interval, work.channels))
        members = tuple(
            work.laws[k].begin(work.filter(k, 0.0, state.noise), member, interval)
            for k, member in enumerate(state.members)
        )
        return replace(state, members=members)

    def step(self, work: Bank, state: AutoState, interval: Interval) -> tuple[AutoState, Report]:
        if state.known:
            return self._assimilated(work, state, interval)
        # Until the noise is guessed the bank runs free.
        free, report = self.member.step(
            work.filter(0, 0.0, np.ones_like(state.noise)), state.members[0], interval.silent
        )
        if not report.status.ok:
            return state, report
        waiting = state.waiting.add(interval, work.channels)
        noise = first_guess(waiting.z)
        if noise is None and len(waiting.t) > SILENCE:
            here = self.member.renewed(work.filters[0].recentred(free.now), free)
            here = replace(here, past=Past.start(here.now, here.samples))
            members = (here, *state.members[1:])
            return replace(state, waiting=here.samples, start=here, members=members), report
        if noise is None:
            return replace(state, waiting=waiting, members=(free, *state.members[1:])), report
        begun = replace(self._initial(work, state.start), noise=noise)
        notes: Mapping[str, float] = {}
        first = waiting.first(work.channels)
        if first.present.any():
            begun = self.begin(work, begun, first)
        for part in waiting.intervals(work.channels):
            begun, taken = self._assimilated(work, begun, part)
            if not taken.status.ok:
                return state, taken
            notes = taken.notes
        return begun, replace(report, notes=notes)

    def _assimilated(
        self, work: Bank, state: AutoState, interval: Interval
    ) -> tuple[AutoState, Report]:
        """Let all members that are awake take a sample, and weigh them anew."""
        tick = _tick(state, interval)
        members, gained = list(state.members), np.full(len(state.members), -np.inf)
        reports: dict[int, Report] = {}
        for k in state.awake:
            filter_ = work.filter(k, tick, state.noise)
            new, report = work.laws[k].step(filter_, members[k], interval)
            reports[k] = report
            change = new.now.evidence - members[k].now.evidence
            if new.due != members[k].due:
                # A replay mends the evidence of all samples in its window: what is left of them.
                # The window may begin anew with this sample.
                change *= min(1.0, MEMORY / (members[k].assimilated + 1))
            if work.stated and new.now.level.square < 1.0:
                least = replace(new.now.level, square=1.0)
                new = replace(new, now=replace(new.now, level=least))
            if report.status.ok and np.isfinite(change):
                members[k], gained[k] = new, change
        if not np.isfinite(gained).any():
            return state, reports[state.leader]
        before = np.exp(state.weights)
        weights = state.weights.copy()
        if interval.present.any():
            weights = work.chances + (1.0 - 1.0 / MEMORY) * (weights - work.chances) + gained
        weights = np.where(np.isfinite(gained), weights, -np.inf)
        weights = normalised(weights)
        now = replace(
            state,
            tick=tick,
            members=tuple(members),
            weights=weights,
            count=state.count + bool(interval.present.any()),
        )
        rested, alarm = self._rested(work, state, now)
        report = self._report(work, now, reports, before)
        notes = {**report.notes, "jump": float(alarm)}
        return rested, replace(report, notes=notes)

    def _rested(self, work: Bank, before: AutoState, state: AutoState) -> tuple[AutoState, bool]:
        """Return the state after those that are not needed sleep, or all wake; was it an alarm."""
        if state.count == before.count:
            return state, False
        leader = state.leader
        innovations = state.members[leader].now.consistency.newest
        usual = before.members[leader].now.consistency
        watch, alarm = JUMPS.add(state.watch, innovations, usual)
        state = replace(state, watch=watch)
        stayed, stays = (work.candidates[s.leader].drift == 0.0 for s in (before, state))
        if stayed and not stays and state.count >= 2 * TRIAL:
            soon = min(state.due, state.count + TRIAL)
            state = replace(state, due=soon, pause=TRIAL)
        if alarm or state.count >= state.due:
            return self._woken(work, state, alarm), alarm
        return (state if state.count % CHECKED else self._pruned(work, state)), False

    def _pruned(self, work: Bank, state: AutoState) -> AutoState:
        """Return the state after those members sleep that have had their time and say nothing."""
        weights = state.weights.copy()
        heavier: list[int] = []
        for k in state.awake:
            if state.count >= state.until[k] and heavier:
                twin = next((j for j in heavier if say_the_same(work, state, j, k)), None)
                if twin is not None:
                    weights[twin] = np.logaddexp(weights[twin], weights[k])
                if twin is not None or weights[k] < np.log(PRUNED):
                    weights[k] = -np.inf
                    continue
            heavier.append(k)
        members = tuple(
            member if np.isfinite(weight) else asleep(state.start)
            for member, weight in zip(state.members, weights, strict=True)
        )
        return replace(state, members=members, weights=normalised(weights))

    def _woken(self, work: Bank, state: AutoState, alarm: bool) -> AutoState:
        """Return the state with all drifts awake; what slept begins as a copy of the leader.

        After an alarm what was measured before tells of other unknowns: no replay goes back beyond
        it, and the member with the wide prior, as it were anew, allows for a jump.
        """
        members, weights, until = list(state.members), state.weights.copy(), state.until.copy()
        leader = state.leader
        if leader == WIDE and not np.isfinite(weights[STAYS]):
            members[STAYS], weights[STAYS], weights[WIDE] = members[WIDE], weights[WIDE], -np.inf
            leader = STAYS
        pause = TRIAL if alarm else state.pause
        awake = np.isfinite(weights)
        best = members[leader]
        now = work.filters[leader].recentred(best.now)
        for k, law in enumerate(work.laws):
            if awake[k]:
                if alarm:
                    recent = work.filters[k].recentred(members[k].now)
                    members[k] = law.renewed(recent, members[k])
                continue
            if k == WIDE and not alarm:
                continue
            begun = work.filters[WIDE].loosened(now, JUMPS.size) if k == WIDE else now
            copied = law.renewed(begun, best)
            members[k] = replace(copied, past=Past.start(begun, copied.samples))
            weights[k] = weights[leader] + work.chances[k] - work.chances[leader]
            until[k] = state.count + max(TRIAL, pause // 4)
        return replace(
            state,
            members=tuple(members),
            weights=normalised(weights),
            until=until,
            due=state.count + pause,
            pause=2 * pause,
        )

    def _report(
        self, work: Bank, state: AutoState, reports: dict[int, Report], before: Array
    ) -> Report:
        """Return the report of the mixture: predictions by the weights before the sample."""
        used = [k for k in reports if reports[k].status.ok]
        share = before[used] / before[used].sum()
        predicted = sum(w * reports[k].predicted for w, k in zip(share, used, strict=True))
        weights = np.exp(state.weights)
        leading = reports.get(state.leader, reports[used[0]])
        drifts = np.array([c.drift for c in work.candidates]) / state.tick
        scales = np.log([c.scale for c in work.candidates])
        levels = [member.now.level.scale for member in state.members]
        notes = dict(leading.notes)
        notes["noise_level"] = float(weights @ levels)
        notes["drift"] = float(weights @ drifts)
        notes["drifting"] = float(weights @ (drifts > 0.0))
        notes["prior_scale"] = float(np.exp(weights @ scales))
        notes["awake"] = float(len(state.awake))
        return Report(Status(), np.asarray(predicted), leading.steps, notes)

    def belief(self, work: Bank, state: AutoState) -> Belief:
        used = state.awake if state.known else [0]
        weights = np.exp(state.weights[used])
        kept = weights >= 1e-4 * weights.max()
        used = [k for k, keep in zip(used, kept, strict=True) if keep]
        weights = weights[kept] / weights[kept].sum()
        noise = state.noise if state.known else np.ones_like(state.noise)
        each = [
            self.member.belief(work.filter(k, state.tick, noise), state.members[k]) for k in used
        ]
        if len(each) == 1:
            return each[0]
        q = sum((w * b.q for w, b in zip(weights, each, strict=True)), np.zeros_like(each[0].q))
        u = sum((w * b.u for w, b in zip(weights, each, strict=True)), np.zeros_like(each[0].u))
        first = (each[0].prior_factor, each[0].rest)
        q_factor, u_factor = [], []
        for w, b in zip(np.sqrt(weights), each, strict=True):
            # The differences of the means are no deviations that correlation inflates.
            if b.q_factor is not None and b.u_factor is not None:
                q_factor.append(w * np.column_stack([b.inflation * b.q_factor, b.q - q]))
                u_factor.append(w * np.column_stack([b.inflation * b.u_factor, b.u - u]))
        return Belief(q, u, np.hstack(q_factor), np.hstack(u_factor), 1.0, *first)


def _tick(state: AutoState, interval: Interval) -> float:
    """Return the usual time between the first samples: a geometric mean, then fixed.

    The time before the first of them does not count: what is as uncertain as the prior gains
    nothing then.
    """
    h = interval.t1 - interval.t0
    if state.count < 2:
        return h
    ratio = h / state.tick
    if state.count > TRIAL or abs(ratio - 1.0) < REGULAR:  # the same filters serve again
        return state.tick
    return float(state.tick * ratio ** (1.0 / state.count))
