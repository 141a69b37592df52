"""The second law: a reduced-order filter for the parameters, carried by sensitivities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.assimilation import (
    OK,
    Assimilation,
    Assimilator,
    MemberReports,
    assimilate,
    assimilate_at_once,
)
from livepde.laws.base import Belief, Law, Problem, Report, Status
from livepde.laws.filter import Filter, FilterState
from livepde.laws.guards import Guards, Scale
from livepde.laws.history import (
    added,
    empty_log,
    first_interval,
    intervals_since,
    opened,
    skipped,
    trimmed,
)
from livepde.laws.innovations import Innovations
from livepde.laws.jumps import Jumps, Watch
from livepde.laws.members import changed, join, put, take, where
from livepde.laws.reduction import Reduction
from livepde.laws.replay import (
    CONVERGED,
    Replay,
    Window,
    distance,
    missed_most,
    next_reference,
    placed,
    replayed,
)
from livepde.laws.sensors import MemberSensors
from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import BandedStage, Interval, KeptFactors, Span, member_stage

__all__ = [
    "NEVER",
    "SensitivityLaw",
    "SensitivityState",
    "SensitivityWork",
    "from_now",
    "without_factors",
]

FIRST = 20  # Gauss-Newton steps of a first sample that a nonlinear initial state takes at most
TEMPER = 10.0  # factor on the noise of a sample whose Gauss-Newton steps do not converge
GUESS = 2.0  # samples that the first guess of the noise counts for
NEVER = np.iinfo(np.int64).max  # number of samples at which a filter without replay is replayed


@dataclass(frozen=True, eq=False)
class SensitivityWork:
    """What the law computes once: the filter, and how it takes a sample."""

    filter: Filter
    choices: Assimilator


@dataclass(frozen=True, eq=False)
class SensitivityState:
    """What the law knows of each member; the leading axis of every array is the members.

    Attributes
    ----------
    now
        The filter now.
    start, window, opening, initial, reference
        Where the window of a replay begins: the filter, the row of the log, whether that row holds
        a sample that the filter has not seen, whether it is the initial state that the model says
        (`Model.initial`), and the latent parameter from which the reference of `now` comes.
    assimilated, due
        Samples used since, and at how many the next replay is due: `NEVER` without replay.
    older, newer, since_older, since_newer
        Two filters of before, to which `Guards` and `Jumps` go back, and their rows of the log.
    log
        Samples since the earliest of them, see `livepde.laws.history`.
    watch
        Innovations of the last samples, for `Jumps`.
    scale
        What the sensors have shown, for `Guards`.
    """

    now: FilterState
    start: FilterState
    window: IntArray
    opening: Mask
    initial: Mask
    reference: Array
    assimilated: IntArray
    due: IntArray
    older: FilterState
    newer: FilterState
    since_older: IntArray
    since_newer: IntArray
    log: Array = field(metadata={"grows": 1})
    watch: Watch
    scale: Scale

    def __len__(self) -> int:
        return len(self.now)

    @property
    def replays(self) -> Mask:
        """Members that keep one reference and replay, shape (members,)."""
        replays: Mask = self.due != NEVER
        return replays


@dataclass(frozen=True)
class SensitivityLaw(Law[SensitivityWork, SensitivityState]):
    """State and parameter from sparse, noisy sensors, with a covariance.

    Reduced-order filter of Moireau, Chapelle and Le Tallec (2008); Zhang's adaptive observer;
    recursive prediction error. q = q_prior + Phi a with a ~ N(0, I): Phi is the prior deviation for
    numbers and the leading modes of the prior for fields. The joint covariance of u and a has the
    square root [U; C]. With S the Jacobian of a step and A the derivative of A(u) q in q,

        predict   one implicit step for u;   S U+ = M U/h - A(u+) Phi C
        update    d = z - G u+ - D q,  Y = G U+ + D Phi C:   a += C K d,  u += U+ K d,
                  K = (I + Y^T N^-1 Y)^-1 Y^T N^-1,  [U; C] times the square root of (I + ...)^-1

    It costs one step and one block of back-substitutions. For unknowns that stay as they are U is
    L C with the sensitivity L = du/da. One that moves (`evolution`, or `drift` for all) adds new
    columns at each substep, independent of what the state remembers of older values; the factor is
    then compressed to `rank` columns, so that nothing has to be forgotten by hand.

    Bounds of numbers hold for the reference about which the filter is linear, and for what is
    reported; the filter itself stays linear.

    Parameters
    ----------
    modes
        Number of modes for each field: one number, or name -> number. "auto": so many that they
        hold 99.99 % of the prior variance, at most 60.
    noise
        Standard deviation of the measurement noise; default what the observation says. "auto": what
        the observation says is a first guess, and the level is found from the samples, the same
        multiple for all sensors.
    drift
        Variance of a gained per unit of time, relative to the prior, by every unknown without an
        evolution of its own: > 0 follows parameters that change. It gains the less the closer its
        deviation is to the prior's, so that nothing winds up while the data tell nothing.
    memory
        Time after which what the state knows of the parameters has faded to 1/e.
    replay
        Iterate about one reference trajectory; for states with a long memory. Not together with
        `memory`.
    rank
        Columns of the factor while unknowns move; default the number of coordinates and five times
        that of those that move.
    gate
        Innovations of more than this many expected deviations are not used; default all are.
    gate_patience
        After so many refusals in a row a sensor is believed again: something has really changed.
    jumps
        Test for sudden changes; an alarm is noted as "jump" and lets the unknowns move.
    guards
        What to do when a linearisation is overconfident or the estimate runs away; None: nothing.
    """

    modes: int | str | dict[str, int] = "auto"
    noise: float | str | None = None
    drift: float = 0.0
    memory: float = np.inf
    replay: Replay | None = None
    rank: int | None = None
    gate: float = np.inf
    gate_patience: int = 10
    jumps: Jumps | None = None
    guards: Guards | None = field(default_factory=Guards)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.drift) and self.drift >= 0):
            raise LawError(f"SensitivityLaw: drift must be a number >= 0; got {self.drift}.")
        if not self.memory > 0:
            raise LawError(f"SensitivityLaw: memory must be positive; got {self.memory}.")
        if self.replay is not None and np.isfinite(self.memory):
            raise LawError(
                "SensitivityLaw: replay keeps all of the past, memory fades it; choose one."
            )
        number = isinstance(self.noise, int | float) and np.isfinite(self.noise) and self.noise > 0
        if not (self.noise in (None, "auto") or number):
            raise LawError(
                f"SensitivityLaw: noise must be a positive number or 'auto'; got {self.noise!r}."
            )
        self._check_parts()

    def _check_parts(self) -> None:
        """Refuse parts that are of another kind, and gates that let nothing through."""
        for name, kind in (("replay", Replay), ("jumps", Jumps), ("guards", Guards)):
            value = getattr(self, name)
            if not (value is None or isinstance(value, kind)):
                raise LawError(
                    f"SensitivityLaw: {name} must be a {kind.__name__}, or None; got {value!r}."
                )
        if not self.gate > 0:
            raise LawError(f"SensitivityLaw: gate must be positive; got {self.gate}.")
        if self.gate_patience < 1:
            raise LawError(f"SensitivityLaw: gate_patience must be >= 1; got {self.gate_patience}.")

    def prepare(self, problem: Problem) -> SensitivityWork:
        observed, model = problem.observed, problem.model
        noise = observed.noise
        if isinstance(self.noise, int | float):
            noise = np.full(observed.size, float(self.noise))
        if noise is None:
            raise LawError(
                "SensitivityLaw needs the noise level of the sensors: give noise= to the "
                "observation (one number, or one for each sensor) or to the law."
            )
        reduction = Reduction.of(problem, self.modes)
        moving = reduction.size if self.jumps is not None else reduction.moving(self.drift)
        rank = self.rank if self.rank is not None else reduction.size + 5 * moving
        if rank < reduction.size:
            raise LawError(
                f"SensitivityLaw: rank must be at least the {reduction.size} reduced coordinates; "
                f"got {rank}."
            )
        mass = np.maximum(model.mass.diagonal(), 0.0)
        filter_ = Filter(
            problem,
            member_stage(model),
            MemberSensors(problem, reduction),
            reduction,
            noise,
            rank,
            np.sqrt(mass / mass.sum()),
            np.array([self.drift]),
            self.memory,
        )
        return SensitivityWork(
            filter_, Assimilator(self.gate, self.gate_patience, self.noise == "auto")
        )

    def init(self, work: SensitivityWork, q0: Array, u0: Array) -> SensitivityState:
        filter_, problem = work.filter, work.filter.problem
        k, n, sensors = filter_.reduction.size, len(u0), problem.observed.size
        one, zero = np.ones(1), np.zeros(1, dtype=np.int64)
        x = FilterState(
            member=zero,
            u=u0[None],
            q=q0[None],
            du=np.zeros((1, n)),
            da=np.zeros((1, k)),
            U=np.zeros((1, k, n)),
            C=np.eye(k)[None],
            age=0.0 * one,
            innovations=Innovations.start(sensors),
            refused=np.zeros((1, sensors), dtype=np.int64),
            level=one,
            samples=GUESS * one,
            evidence=0.0 * one,
            kept=filter_.stage.kept(1),
        )
        no = np.zeros(1, dtype=bool)
        return SensitivityState(
            now=x,
            start=x,
            window=zero,
            opening=no,
            initial=no,
            reference=x.q,
            assimilated=zero,
            due=np.array([self.replay.first if self.replay else NEVER]),
            older=x,
            newer=x,
            since_older=zero,
            since_newer=zero,
            log=empty_log(1, sensors, len(problem.channels)),
            watch=(self.jumps or Jumps()).start(),
            scale=Scale.start(sensors),
        )

    def start(
        self, work: SensitivityWork, q0: Array, u0: Array, moment: Moment
    ) -> SensitivityState:
        state, model = self.init(work, q0, u0), work.filter.problem.model
        if model.form_initial is None:
            return state
        U = model.initial_directions(q0, work.filter.reduction.Phi, moment).T[None]
        x = changed(state.start, U=U)
        return changed(state, start=x, now=x, older=x, newer=x, initial=np.ones(1, dtype=bool))

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # such a sample is not used
    def begin(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> SensitivityState:
        filter_, x, span = work.filter, state.now, work.filter.span(interval)
        state = changed(state, log=added(state.log, span, np.ones(1, dtype=bool)))
        # A state that is known, seen by sensors that see no unknown, has nothing to learn.
        if not filter_.observe(x, span.end)[1].any():
            return state
        problem, replays = filter_.problem, bool(state.replays[0])
        form = problem.model.form_initial
        iterates = form is not None and not form.linear_in_parameter
        if self.guards is not None and not replays:
            iterates = iterates or not problem.observed.linear
        for _ in range(FIRST):
            now = assimilate_at_once(filter_, x, span, work.choices)
            if not np.isfinite(now.da).all():
                return state
            begun = Window(
                state.start, now, interval, [], x.q[0], bool(state.initial[0]), interval.end
            )
            if not iterates or distance(filter_, begun) <= CONVERGED:
                break
            x = placed(filter_, begun, next_reference(filter_, begun))
        state = changed(state, reference=x.q)
        if not replays:
            now = filter_.recentred(now)
            return changed(state, now=now, older=now, newer=now)
        return changed(
            state,
            now=now,
            older=now,
            newer=now,
            opening=np.ones(1, dtype=bool),
            assimilated=state.assimilated + span.present,
        )

    def stepped_alone(self, work: SensitivityWork) -> str:
        if type(self) is not SensitivityLaw:  # a subclass may step in a way of its own
            return super().stepped_alone(work)
        stage = work.filter.stage
        if not isinstance(stage, BandedStage):
            return BandedStage.refuses(work.filter.problem.model)
        if not work.filter.sensors.fixed:
            return "the sensors do not see a fixed linear part of the state alone"
        return stage.refusal

    def begin_members(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> SensitivityState:
        """Return all members after a sample at the initial time."""
        each = (self.begin(work, take(state, k), span.member(k)) for k in range(len(state)))
        return join(*each)

    def step(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        state, reports = self.step_members(work, state, work.filter.span(interval))
        return state, reports.member(0)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # reported as a status
    def step_members(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, MemberReports]:
        """Return state and reports of all members after a sample of each.

        They step as arrays; whoever meets something out of the ordinary, a replay, a safeguard, an
        alarm, a failure, or is late, steps alone.
        """
        before = changed(state, log=opened(state.log, span))
        new, told, usual = self._together(work, before, span)
        reports = self._reports(work, new.now, told)
        if usual.all():
            return self._trimmed(new), reports
        alone: dict[int, Report] = {}
        for k in np.flatnonzero(~usual).tolist():
            one, alone[k] = self._alone(work, take(before, k), span.member(k))
            if not alone[k].status.ok and len(state) == 1:
                return state, reports.with_members(alone)
            if one.log.shape[1] < new.log.shape[1]:
                one = changed(one, log=skipped(one.log))
            new = one if len(state) == 1 else put(new, k, one)
        return self._trimmed(new), reports.with_members(alone)

    def _together(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, Assimilation, Mask]:
        """Return all members after a sample, and for whom nothing was out of the ordinary."""
        filter_, before = work.filter, state.now
        x, told = assimilate(filter_, before, span, work.choices)
        if not told.status.ok:
            return state, told, told.finite
        usual, replays, present = told.finite, state.replays, span.present
        if len(span) > 1:
            usual = usual & span.together
        if self.replay is not None:
            due = state.assimilated + present >= state.due
            full = state.log.shape[1] + 1 - state.window > self._most
            usual = usual & ~(replays & (due | full))
        scale, watch = state.scale, state.watch
        if (guards := self.guards) is not None:
            usual = usual & (replays | guards.within_reach(x.da - before.da))
            d = span.z1 - told.predicted
            scale = scale.add(span.z1, d)
            if (told.largest > guards.runaway).any():
                noise = np.sqrt(before.level)[:, None] * filter_.noise
                usual = usual & ~(scale.beyond(d, noise) > guards.runaway)
        if (jumps := self.jumps) is not None and present.any():
            e = x.innovations.newest
            seen, alarm = jumps.add(watch, e, before.innovations)
            watch = where(np.broadcast_to(present, alarm.shape), seen, watch)
            usual = usual & ~(alarm & present)
        if self.replay is None or not replays.any():
            x = filter_.recentred(x)
        elif not replays.all():
            x = where(replays, x, filter_.recentred(x))
        if not usual.all():
            if not usual.any():
                return state, told, usual
            x = where(usual, x, before)
            scale, watch = where(usual, scale, state.scale), where(usual, watch, state.watch)
        state = changed(state, scale=scale, watch=watch)
        return self._stored(state, x, span, usual), told, usual

    @cached_property
    def _most(self) -> int:
        """Largest number of samples in a window of a replay."""
        return self.replay.window if self.replay is not None else 0

    @cached_property
    def _back(self) -> int:
        """Least number of samples by which the law can go back; 0: it never does."""
        guards, jumps = self.guards, self.jumps
        return max(guards.past if guards else 0, jumps.window if jumps else 0)

    def _stored(
        self, state: SensitivityState, now: FilterState, span: Span, taken: Mask
    ) -> SensitivityState:
        """Return a state with the filter after a sample, which the members `taken` took."""
        if not (self._back or self.replay):
            return changed(state, now=now)
        log = added(state.log, span, taken)
        assimilated = state.assimilated
        if self.replay:
            assimilated = assimilated + (taken & span.present)
        last, parts = log.shape[1] - 1, {}
        if self._back:
            due = taken & (last - state.since_newer >= self._back)
            if due.any():
                parts = {
                    "older": where(due, state.newer, state.older),
                    "newer": where(due, now, state.newer),
                    "since_older": np.where(due, state.since_newer, state.since_older),
                    "since_newer": np.where(due, last, state.since_newer),
                }
        return changed(state, now=now, log=log, assimilated=assimilated, **parts)

    def _trimmed(self, state: SensitivityState) -> SensitivityState:
        """Return a state without the rows of the log that nobody goes back to."""
        rows = state.log.shape[1]
        if rows < 3 * max(self._back, 32):
            return state
        older = state.since_older if self._back else np.full(len(state), rows - 1)
        first = int(np.where(state.replays, np.minimum(older, state.window), older).min())
        if first < rows // 2:
            return state
        return changed(
            state,
            log=trimmed(state.log, first),
            window=np.maximum(state.window - first, 0),
            since_older=state.since_older - first,
            since_newer=state.since_newer - first,
        )

    def _reports(
        self, work: SensitivityWork, now: FilterState, told: Assimilation
    ) -> MemberReports:
        """Return what the members report after a sample."""
        notes: dict[str, Array] = {
            "innovation_ratio": now.innovations.ratio,
            "innovation_correlation": now.innovations.correlation,
        }
        if self.noise == "auto":
            notes["noise_level"] = np.sqrt(now.level)
        if np.isfinite(self.gate):
            notes["refused"] = told.refused
        if self.jumps is not None:
            notes["jump"] = np.zeros(len(now))
        steps = np.full(len(now), told.steps)
        return MemberReports((OK,) * len(now), told.predicted, steps, notes)

    # From here on a state has one member.

    def _alone(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        """Return one member after a sample, with replays, safeguards and alarms."""
        new, report = self._assimilated(work, state, interval)
        if (guards := self.guards) is not None:
            new, report = self._rescued(work, guards, state, interval, new, report)
        if report.status.ok and (jumps := self.jumps) is not None:
            new, report = self._watched(work, jumps, state, interval, new, report)
        return new, report

    def _filtered(
        self, work: SensitivityWork, x: FilterState, interval: Interval
    ) -> tuple[FilterState, Report]:
        """Return the filter after a sample, linear about its reference."""
        span = work.filter.span(interval)
        new, told = assimilate(work.filter, x, span, work.choices)
        status = told.status
        if status.ok and not told.finite[0]:
            what = "prediction" if not np.isfinite(told.predicted).all() else "update"
            status = Status("not_finite", f"the {what} is not finite")
        if not status.ok:
            predicted, _ = work.filter.observe(x, span.end)
            return x, Report(status, predicted[0])
        return new, changed(self._reports(work, new, told).member(0), status=status)

    def _assimilated(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        """Return one member after a sample, iterated or replayed where that is due."""
        x, report = self._filtered(work, state.now, interval)
        if not report.status.ok:
            return state, report
        span = work.filter.span(interval)
        state = changed(state, log=opened(state.log, span))
        one = np.ones(1, dtype=bool)
        if not state.replays[0]:
            if (guards := self.guards) is not None:
                x, notes = self._iterated(work, guards, state, interval, x)
                if notes:
                    told = self._noted(work, x)
                    report = replace(report, notes={**report.notes, **told, **notes})
            return self._stored(state, work.filter.recentred(x), span, one), report
        state = self._stored(state, x, span, one)
        if self.replay is not None and state.assimilated[0] >= state.due[0]:
            state, notes = self._replayed(work, self.replay, state)
            report = replace(report, notes={**report.notes, **notes})
        if state.log.shape[1] - state.window[0] > self._most:
            state = self.renewed(work.filter.recentred(state.now), state)
        return state, report

    @staticmethod
    def _noted(work: SensitivityWork, x: FilterState) -> dict[str, float]:
        """Return the notes on the innovations of one member."""
        return {
            "innovation_ratio": float(x.innovations.ratio[0]),
            "innovation_correlation": float(x.innovations.correlation[0]),
        }

    def window(self, work: SensitivityWork, state: SensitivityState) -> Window:
        """Return the stored samples of one member, for a replay."""
        channels, log = work.filter.problem.channels, state.log[:, int(state.window[0]) :]
        first = first_interval(log, channels)
        return Window(
            state.start,
            state.now,
            first if state.opening[0] else None,
            intervals_since(log, channels),
            state.reference[0],
            bool(state.initial[0]),
            first.end,
        )

    def _replayed(
        self, work: SensitivityWork, replay: Replay, state: SensitivityState
    ) -> tuple[SensitivityState, dict[str, float]]:
        """Return one member after replays about better references, and notes."""
        window, notes = self.window(work, state), {}
        for _ in range(replay.iterations):
            window, status = replayed(work.filter, window, work.choices)
            left = distance(work.filter, window)
            notes["replay_left"] = left
            if not status.ok:  # keep the linear estimate, say so, and try again when doubled
                notes["replay_failed"] = 1.0
            if not status.ok or left <= CONVERGED:
                break
        due, reference = 2 * state.assimilated, window.reference[None]
        return changed(state, now=window.now, reference=reference, due=due), notes

    def renewed(
        self, start: FilterState, state: SensitivityState, row: int | None = None
    ) -> SensitivityState:
        """Return one member whose window begins at a filter, with no samples yet.

        Parameters
        ----------
        row
            Of the log, to which the filter belongs; later ones are forgotten. Default the last.
        """
        log = state.log if row is None else state.log[:, : row + 1]
        zero = np.zeros(1, dtype=np.int64)
        first = self.replay.first if self.replay is not None and state.replays[0] else NEVER
        no = np.zeros(1, dtype=bool)
        return changed(
            state,
            now=start,
            start=start,
            log=log,
            window=zero + max(log.shape[1] - 1, 0),
            opening=no,
            initial=no,
            reference=start.q,
            assimilated=zero,
            due=zero + first,
        )

    def _iterated(
        self,
        work: SensitivityWork,
        guards: Guards,
        state: SensitivityState,
        interval: Interval,
        x: FilterState,
    ) -> tuple[FilterState, dict[str, float]]:
        """Return the filter after a sample that may have moved it too far, and notes.

        Too far is cured by a replay of this one sample from where the interval began.
        """
        before = state.now
        if guards.within_reach(x.da - before.da)[0]:  # cheaper to see than how far it is
            return x, {}
        filter_, kept = work.filter, x.kept

        def levelled(x: FilterState, tempered: int) -> FilterState:
            if not tempered:  # a tempered sample tells nothing about the noise
                return x
            return changed(x, level=before.level, samples=before.samples)

        for temper in range(guards.temperings + 1):
            tempered = {"tempered": 1.0} if temper else {}
            begin = changed(before, level=before.level * TEMPER ** (2 * temper), kept=kept)
            if temper:
                x, _ = self._filtered(work, begin, interval)
                if guards.within_reach(x.da - begin.da)[0]:
                    return levelled(x, temper), tempered
            reference, moment = begin.q[0], interval.end
            window = Window(begin, x, None, [interval], reference, False, moment)
            far = missed_most(filter_, window) > guards.reach
            if not (far and distance(filter_, window) > CONVERGED):
                return levelled(x, temper), tempered
            for _ in range(guards.iterations):
                window, status = replayed(filter_, window, work.choices)
                if not status.ok:
                    break
                if distance(filter_, window) <= CONVERGED:
                    return levelled(window.now, temper), {"iterated": 1.0, **tempered}
        return self._filtered(work, before, interval.silent)[0], {"held": 1.0}

    def _rescued(
        self,
        work: SensitivityWork,
        guards: Guards,
        state: SensitivityState,
        interval: Interval,
        new: SensitivityState,
        report: Report,
    ) -> tuple[SensitivityState, Report]:
        """Return one member and report after a sample that may have failed or be far off.

        Whatever led there is not used again: the state is only carried on from the past.
        """
        noise = np.sqrt(state.now.level)[:, None] * work.filter.noise
        z = interval.z1[None]
        scale = state.scale.add(z, z - report.predicted)

        def astray(report: Report) -> bool:
            beyond = scale.beyond(z - report.predicted, noise)
            return not report.status.ok or bool(beyond[0] > guards.runaway)

        if not astray(report):
            return changed(new, scale=scale), report
        older = changed(work.filter.recentred(state.older), kept=new.now.kept)
        row = int(state.since_older[0])
        silent = [item.silent for item in [*self._since(work, state, row), interval]]
        for start in (work.filter.loosened(older, 1.0), work.filter.prior_again(older)):
            again, found = self._retaken(work, state, start, row, silent)
            if not astray(found):
                notes = {**found.notes, "restarted": 1.0}
                return changed(from_now(again), scale=scale), replace(found, notes=notes)
        if not report.status.ok:
            return state, report
        return changed(new, scale=scale), replace(report, notes={**report.notes, "runaway": 1.0})

    @staticmethod
    def _since(work: SensitivityWork, state: SensitivityState, row: int) -> list[Interval]:
        """Return the intervals that one member has taken since a row of the log."""
        if not state.log.shape[1]:
            return []
        return intervals_since(state.log[:, row:], work.filter.problem.channels)

    def _retaken(
        self,
        work: SensitivityWork,
        state: SensitivityState,
        start: FilterState,
        row: int,
        intervals: Sequence[Interval],
    ) -> tuple[SensitivityState, Report]:
        """Return one member after some samples, taken again from a filter at a row of the log."""
        state = from_now(self.renewed(start, state, row))
        for interval in intervals:
            state, report = self._assimilated(work, state, interval)
            if not report.status.ok:
                break
        return state, report

    def _watched(
        self,
        work: SensitivityWork,
        jumps: Jumps,
        state: SensitivityState,
        interval: Interval,
        new: SensitivityState,
        report: Report,
    ) -> tuple[SensitivityState, Report]:
        """Return one member and report after the test for a jump.

        After an alarm the samples since the jump are taken again, from before it: the state has
        gone astray with them, and what was measured before does not belong to the unknowns of now.
        """
        if not interval.present.any():  # there is no innovation, and `newest` is that of before
            return new, replace(report, notes={**report.notes, "jump": 0.0})
        usual, e = state.now.innovations, new.now.innovations.newest
        watch, alarms = jumps.add(state.watch, e, usual)
        alarm, new = bool(alarms[0]), changed(new, watch=watch)
        if alarm:
            row = int(state.since_older[0])
            known = [*self._since(work, state, row), interval]
            before = max(len(known) - jumps.onset(state.watch, e, usual), 0)
            x, status = changed(work.filter.recentred(state.older), kept=new.now.kept), Status()
            for earlier in known[:before]:
                x, found = self._filtered(work, x, earlier)
                x, status = work.filter.recentred(x), found.status
                if not status.ok:
                    break
            start = work.filter.loosened(x, jumps.size)
            again, found = self._retaken(work, new, start, row + before, known[before:])
            if status.ok and found.status.ok:
                new = again
            else:
                now = work.filter.recentred(new.now)
                new = self.renewed(work.filter.loosened(now, jumps.size), new)
        return new, replace(report, notes={**report.notes, "jump": float(alarm)})

    def belief(self, work: SensitivityWork, state: SensitivityState) -> Belief:
        return self.member_belief(work, state.now, 0)

    def reader(self, work: SensitivityWork, state: SensitivityState) -> Callable[[], Belief]:
        now = without_factors(state.now)
        return lambda: self.member_belief(work, now, 0)

    @staticmethod
    def member_belief(work: SensitivityWork, now: FilterState, k: int) -> Belief:
        """Return what is believed of one member, in latent coefficients."""
        filter_ = work.filter
        reduction = filter_.reduction
        drift = float(filter_.drifts(now.member[k : k + 1])[0])
        return Belief(
            reduction.bounded(now.q[k] + reduction.Phi @ now.da[k]),
            now.u[k] + now.du[k],
            reduction.Phi @ now.C[k].T,
            now.U[k].T,
            float(now.innovations.inflation[k]),
            reduction.Phi,
            reduction.rest(float(now.age[k]), drift),
        )


def without_factors(x: FilterState) -> FilterState:
    """Return a filter without what its last stage has left: what estimates hold."""
    return changed(x, kept=KeptFactors.none(len(x)))


def from_now(state: SensitivityState) -> SensitivityState:
    """Return one member that goes back to now at most."""
    last = np.array([max(state.log.shape[1] - 1, 0)])
    now = state.now
    return changed(state, older=now, newer=now, since_older=last, since_newer=last)
