"""The sensitivity law: a reduced-order extended Kalman filter for state and parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from livepde.errors import LawError
from livepde.fem import Inputs, Moment
from livepde.laws.assimilation import (
    Assimilation,
    MemberReports,
    UpdateOptions,
    absorb,
    assimilate,
    no_readings,
)
from livepde.laws.columns import Columns
from livepde.laws.filter import Filter, reported_factors
from livepde.laws.filter_state import NO_LEDGER, FilterState, InputHistory, ShadowState
from livepde.laws.gate import Gate, Screened
from livepde.laws.history import (
    LogRows,
    added,
    empty_log,
    first_interval,
    intervals_since,
    opened,
    skipped,
)
from livepde.laws.innovations import Innovations
from livepde.laws.iterated_smoother import AGREED, Window, distance, next_reference, placed
from livepde.laws.law import (
    Belief,
    Deferred,
    Fit,
    FixedInterval,
    Law,
    Problem,
    Report,
    finite,
    stepped,
)
from livepde.laws.member_sensors import MemberSensors
from livepde.laws.noise_rows import PAUSE_ROWS, input_rank, with_initial_rows
from livepde.laws.one_member import step_alone, watched
from livepde.laws.policies import Guards, Jumps, Refit
from livepde.laws.reduction import Reduction
from livepde.laws.refit import go_on, refit_due, settle
from livepde.laws.sensitivity_state import (
    NEVER,
    FitState,
    Fork,
    Scale,
    SensitivityState,
    SensitivityWork,
    joined,
    kept_for_estimates,
    read_later,
    reports_of,
    shortened,
    stored,
)
from livepde.laws.shadows import Shadows, ShadowSet
from livepde.laws.smoother import smoothed
from livepde.laws.step_diagnostics import Diagnostics
from livepde.laws.verdict import (
    after_fit,
    judge_of,
    judged,
    with_columns,
    with_discretisation,
    with_errors,
    with_fit,
    with_noise,
)
from livepde.linalg import Array, Mask, nonfinite_allowed
from livepde.linalg.member_arrays import changed, put_each, take, where, zeros
from livepde.stepping import (
    Alexander2,
    BandedStage,
    Interval,
    Scheme,
    Span,
    member_stage,
)
from livepde.verdict import Verdict

GATE = 6.0  # expected standard deviations: a Gaussian value lies beyond with probability 2e-9
FIRST = 20  # largest number of Gauss-Newton steps for a sample at the initial time
NOT_STORED = "innovations: the first samples are no longer stored (`law.refit.window`)"
GUESS = 2.0  # weight of the initial guess of the noise level, in samples


@dataclass(frozen=True)
class SensitivityLaw(Law[SensitivityWork, SensitivityState]):
    """Estimate state and parameters from sparse, noisy sensors, with a covariance.

    Reduced-order filter of Moireau, Chapelle and Le Tallec (2008), related to Zhang's adaptive
    observer and to recursive prediction error methods. The parameter is q = q_prior + Phi a with
    a ~ N(0, I). Phi is the prior standard deviation for numbers, and the leading prior modes for
    fields. The joint covariance of u and a has the square root [U; C]. Let S be the Jacobian of a
    step and A the derivative of A(u) q in q. Then

        predict   one implicit step for u;   S U+ = M U/h - A(u+) Phi C
        update    d = z - G u+ - D q,  Y = G U+ + D Phi C:   a += C K d,  u += U+ K d,
                  K = (I + Y^T N^-1 Y)^-1 Y^T N^-1,  [U; C] times the square root of (I + ...)^-1

    A sample costs one step and one block of back-substitutions. For constant unknowns, U = L C with
    the sensitivity L = du/da. The process noise of a moving unknown (`evolution`, or `drift` for
    all) adds independent columns at each substep. The factor is compressed to `rank` columns.

    Bounds of numbers and of latent values (`within` of an unknown) apply to the linearisation point
    and to reported estimates; the filter itself stays linear.

    Parameters
    ----------
    modes
        Number of modes for each field: one number, or name -> number. "auto": the number of modes
        that contain 99.99 % of the prior variance, at most 60.
    noise
        Standard deviation of the measurement noise; default the noise of the observation. "auto":
        the noise of the observation is an initial guess, and one common factor for all sensors is
        estimated from the samples. Without `refit` the first samples keep the weight of the guess:
        intervals are too narrow if it is too small.
    drift
        Variance of a gained per unit of time, relative to the prior, by every unknown without its
        own evolution; > 0 tracks parameters that change. The gain decreases as the variance of an
        unknown approaches its prior variance, so that no variance winds up without data.
    memory
        Time constant with which the cross-covariance of state and parameters decays.
    refit
        Fit the stored samples again whenever their number has doubled; None: never.
    rank
        Largest number of columns of the factor; default: one for each reduced coordinate, five more
        for each that moves or may jump, and some for errors of the inputs.
    gate
        Innovations are refused beyond this many expected standard deviations, times the usual size
        of normalised innovations where that exceeds 1. Infinity: all innovations are used.
    gate_patience
        After this many refusals in a row, the readings of a sensor are accepted if most other
        sensors misfit too. Otherwise the sensor is excluded: see `livepde.laws.gate`.
    jumps
        Test for sudden changes. An alarm is noted as "jump", and allows the unknowns to change.
    guards
        Safeguards against an overconfident linearisation and a runaway estimate; None: none.
    shadows
        Discretisation errors that widen the reported covariance; None: none.
    verdict
        True: run the model checks (`Estimate.verdict`). "cheap": skip the checks for terms missing
        from the process, which require additional solves. False: no checks.

    Examples
    --------
    >>> import livepde as lp
    >>> law = lp.SensitivityLaw(modes=20, gate=5.0)  # 20 modes for each field
    >>> law.gate
    5.0
    """

    modes: int | str | dict[str, int] = "auto"
    noise: float | str | None = None
    drift: float = 0.0
    memory: float = np.inf
    refit: Refit | None = field(default_factory=Refit)
    rank: int | None = None
    gate: float = GATE
    gate_patience: int = 10
    jumps: Jumps | None = None
    guards: Guards | None = field(default_factory=Guards)
    shadows: Shadows | None = field(default_factory=Shadows)
    # A run may resume with another setting: fleets run without a verdict.
    verdict: bool | str = field(default=True, metadata={"begins_anew": True})

    scheme: ClassVar[Scheme] = Alexander2()  # intervals do not cover the error of first order
    graded_start: ClassVar[bool] = True
    relinearises: ClassVar[bool] = True

    def __post_init__(self) -> None:
        stated = isinstance(self.noise, int | float) and np.isfinite(self.noise) and self.noise > 0
        gate: Any = self.gate  # users may pass None, which other settings accept
        kinds = (("refit", Refit), ("jumps", Jumps), ("guards", Guards), ("shadows", Shadows))
        parts = [(getattr(self, name), name, kind) for name, kind in kinds]
        for holds, name, rule in (
            (np.isfinite(self.drift) and self.drift >= 0, "drift", "a number >= 0"),
            (self.memory > 0, "memory", "positive"),
            (self.noise in (None, "auto") or stated, "noise", "a positive number or 'auto'"),
            *(
                (isinstance(part, kind | None), name, f"a {kind.__name__}, or None")
                for part, name, kind in parts
            ),
            (isinstance(gate, int | float) and gate > 0, "gate", "positive"),
            (self.gate_patience >= 1, "gate_patience", ">= 1"),
            (self.verdict in (True, False, "cheap"), "verdict", "True, 'cheap' or False"),
        ):
            if not holds:
                raise LawError(
                    f"SensitivityLaw: {name} must be {rule}; got {getattr(self, name)!r}."
                )

    @property
    def fades(self) -> bool:
        """True if the cross-covariance of state and unknowns decays (`memory`)."""
        return bool(np.isfinite(self.memory))

    def weighs_readings(self) -> bool:
        return True

    def reading_noise(self, work: SensitivityWork, state: SensitivityState) -> Array | None:
        return np.asarray(np.sqrt(state.now.level[0]) * work.filter.noise)

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
        # Constant unknowns need one row for each coordinate. Moving unknowns and noisy inputs add
        # rows at each step, and a compression needs rows for the uncertainty of the state alone.
        moving = reduction.moving(self.drift)
        if self.jumps is not None:
            jumping = int(reduction.named(self.jumps.unknowns, "Jumps: unknowns").sum())
            moving = max(moving, jumping)
        rank = self.rank if self.rank is not None else reduction.size + 5 * moving
        rank += input_rank(problem) + PAUSE_ROWS if self.rank is None else 0
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
            judge_of(
                problem,
                reduction,
                noise,
                self.verdict,
                rank,
                kept=not (self.drift or self.memory < np.inf),
            ),
        )
        if self.shadows is not None:
            parts = problem, reduction, filter_.sensors.rows, noise, filter_.stage, self.shadows
            followed = ShadowSet.of(*parts, moves=filter_.moves)
            filter_ = replace(filter_, shadows=followed)
        # Unknowns that move or may jump follow a change of the process; constants do not.
        anchors = not (filter_.moves or self.jumps is not None)
        gate = Gate(self.gate, self.gate_patience, anchors)
        return SensitivityWork(
            filter=filter_,
            options=UpdateOptions(gate, self.noise == "auto"),
            refit=self.refit,
            guards=self.guards,
            jumps=self.jumps,
            fades=self.fades,
            relinearises=self.relinearises,
        )

    def init(self, work: SensitivityWork, q0: Array, u0: Array) -> SensitivityState:
        return self._init(work, q0, u0, None)

    def _init(
        self, work: SensitivityWork, q0: Array, u0: Array, moment: Moment | None
    ) -> SensitivityState:
        """Return the state before the first sample; the shadows start at `moment`."""
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
            past=np.zeros((1, k, 0)),
            dpast=np.zeros((1, 0)),
            age=0.0 * one,
            rate=0.0 * one,
            innovations=Innovations.start(sensors),
            parts=np.ones(1, dtype=np.int64),
            screened=Screened.start(sensors),
            level=one,
            samples=GUESS * one,
            evidence=0.0 * one,
            kept=filter_.stage.kept(1),
            causes=np.zeros((1, k, filter_.judge.rank if filter_.judge else 0)),
            ledger=filter_.judge.start() if filter_.judge else NO_LEDGER,
            shadows=ShadowState.none(1, n, k),
            driven=InputHistory.start(len(problem.channels)),
        )
        if filter_.shadows is not None:
            given = problem.initial
            x = changed(x, shadows=filter_.shadows.start(x, moment, given))
        no = np.zeros(1, dtype=bool)
        return SensitivityState(
            now=x,
            start=work.kept_start(x),
            window=zero,
            opening=no,
            initial=no,
            assimilated=zero,
            due=np.array([1 if work.window else NEVER]),
            fit=FitState.none(x),
            fork=Fork.none(x),
            older=x,
            newer=x,
            since_older=zero,
            since_newer=zero,
            log=empty_log(sensors, len(problem.channels)),
            trial=empty_log(sensors, len(problem.channels)),
            trial_start=zeros(x) if work.fits else x,
            watch=(self.jumps or Jumps()).start(sensors),
            scale=Scale.start(sensors),
        )

    def start(
        self, work: SensitivityWork, q0: Array, u0: Array, moment: Moment
    ) -> SensitivityState:
        state, model = self._init(work, q0, u0, moment), work.filter.problem.model
        if model.form_initial is None:
            filter_ = work.filter
            parts = (filter_.problem, filter_.reduction, filter_.noise)
            x = with_initial_rows(state.now, *parts, moment)
            return state if x is state.now else _with_start(work, state, x)
        # The initial state depends on the unknowns. Its derivative gives their cross-covariance, so
        # that samples correct both from the first one on.
        U = model.initial_directions(q0, work.filter.reduction.Phi, moment).T[None]
        x = changed(state.now, U=U)
        return changed(_with_start(work, state, x), initial=np.ones(1, dtype=bool))

    @nonfinite_allowed()  # a sample with a nonfinite result is not used
    def begin(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> SensitivityState:
        filter_, x, interval = work.filter, state.now, work.filter.problem.unread(interval)
        span = filter_.span(interval)
        state = changed(state, log=added(state.log, span, np.ones(1, dtype=bool), x.parts))
        # The readings carry no information if the state is known and no sensor sees an unknown.
        if not filter_.learns(filter_.sensors.observe(x, span.end)[1]):
            # Their evidence counts, so that it is comparable with a case that assimilates them.
            seen, _ = absorb(filter_, x, span, work.options)
            return state.counted(seen.evidence)
        problem = filter_.problem
        form = problem.model.form_initial
        # The safeguards of a step do not cover the sample at the initial time. If the initial state
        # or the sensors are nonlinear, the update is iterated here.
        iterates = form is not None and not form.linear_in_parameter
        if self.guards is not None:
            iterates = iterates or not problem.observed.linear
        for _ in range(FIRST):
            now, _ = absorb(filter_, x, span, work.options)
            if not np.isfinite(now.da).all():
                return state
            initial = bool(state.initial[0])
            begun = Window(
                start=state.now,
                now=now,
                reference=x.q[0],
                initial=initial,
                moment=interval.end,
                length=0.0,
            )
            if not iterates or distance(filter_, begun) <= AGREED:
                break
            x = placed(filter_, begun, next_reference(filter_, begun))
            # Restore the noise level, so that the sample counts once and not in each iteration.
            level, samples = state.now.level, state.now.samples
            x = changed(x, level=level, samples=samples, kept=state.now.kept)
        now = filter_.relinearised(now) if self.relinearises else now
        opening = np.ones(1, dtype=bool)
        return changed(state, now=now, older=now, newer=now, opening=opening)

    def stepped_alone(self, work: SensitivityWork) -> str:
        if type(self) is not SensitivityLaw:  # a subclass may override `step`
            return super().stepped_alone(work)
        stage = work.filter.stage
        if not isinstance(stage, BandedStage):
            return BandedStage.refuses(work.filter.problem.model)
        if not work.filter.sensors.fixed:
            return "the sensors do not see a fixed linear part of the state alone"
        return stage.refusal

    def step(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        state, reports = self.step_members(work, state, work.filter.span(interval))
        return state, reports.member(0)

    @nonfinite_allowed()  # nonfinite results are reported as a status
    def step_members(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, MemberReports]:
        """Return state and reports of all members after one sample each and the refits due.

        Members are stepped as arrays. A member with a safeguard, an alarm, a failure or a late
        sample is stepped separately.
        """
        # A window needs a first row with time and inputs, which a run without a sample at the
        # initial time does not have yet.
        begun = state if state.log.shape[1] else changed(state, log=opened(state.log, span))
        new, outcome, regular = self._step_jointly(work, begun, span)
        reports = reports_of(work, new.now, outcome)
        if np.count_nonzero(regular) < regular.size:
            new, reports = self._step_separately(work, begun, new, reports, regular, span)
            regular = np.array([status.ok for status in reports.statuses])
            if not regular.any():
                return (new if len(state) > 1 else state), reports
        new, moved = refit_due(work, new)
        if moved is not None:
            taken = regular
            reports = reports.updated(moved.each(lambda number: np.where(taken, number, np.nan)))
        if len(new.fork):
            new = go_on(work, new)
        return shortened(work, new), reports

    def _step_jointly(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, Assimilation, Mask]:
        """Return all members after a sample, the assimilation, and the mask of regular members."""
        filter_, before = work.filter, state.now
        x, outcome = assimilate(filter_, before, span, work.options)
        regular = outcome.finite
        if outcome.status.code != "ok":
            return state, outcome, regular
        if len(span.t0) > 1:
            regular = regular & span.together
        scale = state.scale.add(span.z1, span.z1 - outcome.predicted)
        parts: dict[str, Any] = {"scale": scale.without_refused(state.scale, x.screened.refused)}
        if self.guards is not None:
            regular = regular & _admissible(self.guards, filter_, before, x, outcome, scale, span)
        if self.jumps is not None and span.present.any():
            parts["watch"], alarm = watched(work, self.jumps, state, x, span)
            regular = regular & ~alarm
        if self.relinearises:
            x = filter_.relinearised(x)
        if np.count_nonzero(regular) < regular.size:
            if not regular.any():
                return state, outcome, regular
            x = where(regular, x, before)
            parts = {
                name: where(regular, part, getattr(state, name)) for name, part in parts.items()
            }
        return stored(work, state, x, span, regular, outcome.disturbed, **parts), outcome, regular

    def _step_separately(
        self,
        work: SensitivityWork,
        state: SensitivityState,
        new: SensitivityState,
        reports: MemberReports,
        regular: Mask,
        span: Span,
    ) -> tuple[SensitivityState, MemberReports]:
        """Return state and reports after stepping each member outside `regular` separately."""
        alone: dict[int, Report] = {}
        each: dict[int, SensitivityState] = {}
        for k in np.flatnonzero(~regular).tolist():
            one, alone[k] = step_alone(work, take(state, k), span.member(k))
            # All members share the rows of the log: a member whose step failed gets an empty row.
            while work.keeps_log and one.log.shape[1] <= state.log.shape[1]:
                one = changed(one, log=skipped(one.log))
            each[k] = one
        return put_each(new, each), reports.with_members(alone)

    def for_fleet(self) -> SensitivityLaw:
        return replace(self, verdict=False)

    def work_from(self, work: SensitivityWork, problem: Problem) -> SensitivityWork:
        return replace(work, filter=replace(work.filter, problem=problem))

    def reassessed(
        self,
        problem: Problem,
        state: SensitivityState,
        t0: float,
        start: Callable[[SensitivityWork, Inputs], SensitivityState],
    ) -> tuple[SensitivityWork, SensitivityState] | Verdict:
        if not self.verdict:
            return Verdict.unjudged()
        channels, rows = problem.channels, LogRows.of(state.log, problem.observed.size)
        if state.window[0] or not len(rows.times) or rows.times[0] != t0:
            return Verdict.of((), (NOT_STORED,), judged=False)
        work = self.prepare(problem)
        after = start(work, Inputs(dict(zip(channels, rows.inputs[0].tolist(), strict=True))))
        if np.isfinite(rows.readings[0]).any():
            first = first_interval(state.log, channels)
            after, _ = stepped(self, work, problem, after, first)
        for interval in intervals_since(state.log, channels):
            after, _ = stepped(self, work, problem, after, interval)
        # The log lacks readings of excluded sensors: the memory of the gate is that of the member.
        return work, changed(after, now=changed(after.now, screened=state.now.screened))

    def live(self) -> SensitivityLaw:
        if self.refit is None or self.refit.apart is not None:
            return self
        return replace(self, refit=replace(self.refit, apart=True))

    def fit(self, work: SensitivityWork, state: SensitivityState) -> Fit | None:
        return state.fit.member(0)

    def diagnosed(self, work: SensitivityWork, state: SensitivityState) -> Diagnostics[float]:
        outcome = no_readings(state.now, work.filter.problem.observed.size)
        return reports_of(work, state.now, outcome).member(0).diagnostics

    def settled(self, work: SensitivityWork, state: SensitivityState) -> SensitivityState:
        return settle(work, state)[0]

    def finite(self, work: SensitivityWork, state: SensitivityState) -> bool:
        x = state.now
        return finite(x.u, x.q, x.du, x.da, x.U, x.C)

    def unsmoothed(self, work: SensitivityWork) -> str:
        return "memory= lets the past fade, which no smoother can follow" if self.fades else ""

    def smoothed(
        self,
        work: SensitivityWork,
        before: SensitivityState,
        after: SensitivityState,
        data: FixedInterval,
    ) -> Iterator[Belief]:
        if self.fades:
            return super().smoothed(work, before, after, data)
        settled, (used,) = settle(work, after)
        result = smoothed(work, before, settled.now, data, used)
        return (self.member_belief(work, x, 0) for x in result)

    def belief(self, work: SensitivityWork, state: SensitivityState) -> Belief:
        return self.member_belief(work, state.now, 0)

    def deferred(self, work: SensitivityWork, state: SensitivityState) -> Deferred:
        # Stored estimates omit ledgers and warm-start data, which are larger than a belief.
        now, fit = kept_for_estimates(state.now), state.fit.member(0)
        judge, level = judged(work.filter, state.now, now), float(now.level[0])

        def verdict() -> Verdict:
            result = with_noise(with_fit(judge(), fit), work, level)
            if not self.verdict:
                return result
            return with_discretisation(result, work.filter.shadows, now.shadows)

        return Deferred(read_later(self._beliefs, work, now), verdict)

    def final(
        self, work: SensitivityWork, state: SensitivityState, *, columns: bool = True
    ) -> Deferred:
        belief, before = self.deferred(work, state)
        # The fit of a later window does not cover the readings before that window.
        whole = state.fit.member(0) if not state.window[0] else None
        if not self.verdict:
            return Deferred(belief, lambda: after_fit(before(), whole))
        tried = Columns.of(work, state) if columns else None

        def verdict() -> Verdict:
            result = after_fit(before(), whole)
            result = result if tried is None else with_columns(result, tried)
            return with_errors(result, work, state)

        return Deferred(belief, verdict)

    def factors(self, work: SensitivityWork, x: FilterState) -> tuple[Array, Array]:
        """Return the square root [U C] of the reported covariance of all members."""
        return reported_factors(work.filter, x)

    def member_belief(self, work: SensitivityWork, now: FilterState, k: int) -> Belief:
        """Return the belief of member `k`, in latent coefficients."""
        return self._beliefs([(work, take(now, k))])[0]

    def _beliefs(self, samples: Sequence[tuple[SensitivityWork, FilterState]]) -> list[Belief]:
        (work, _), now = samples[0], joined([x for _, x in samples])
        reduction, drifts = work.filter.reduction, work.filter.drifts(now.member).tolist()
        Phi, ages, (U, C) = reduction.Phi, now.age.tolist(), self.factors(work, now)
        return [
            Belief(
                reduction.bounded(now.q[k] + Phi @ now.da[k]),
                now.u[k] + now.du[k],
                Phi @ C[k].T,
                U[k].T,
                Phi,
                reduction.rest(ages[k], drifts[k]),
            )
            for k in range(len(now))
        ]


def _admissible(
    guards: Guards,
    filter_: Filter,
    before: FilterState,
    x: FilterState,
    outcome: Assimilation,
    scale: Scale,
    span: Span,
) -> Mask:
    """Return which members need no safeguard, from move and innovations, shape (members,)."""
    near = guards.within_reach(x.da - before.da)
    # Ranges are at least as large as the noise, so that smaller innovations cannot be a runaway.
    # This bound saves most samples the exact test.
    if outcome.worst > guards.runaway:
        beyond = scale.beyond(span.z1 - outcome.predicted, filter_.noise_of(before, span))
        near = near & ~(beyond > guards.runaway)
    return near


def _with_start(work: SensitivityWork, state: SensitivityState, x: FilterState) -> SensitivityState:
    start, trial = work.kept_start(x), zeros(x) if work.fits else x
    fit = FitState.none(start)
    return changed(state, start=start, trial_start=trial, fit=fit, now=x, older=x, newer=x)
