"""The second law: a reduced-order filter for the parameters, carried by sensitivities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
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
from livepde.laws.history import added, empty_log, opened, skipped
from livepde.laws.innovations import Innovations
from livepde.laws.iterated_smoother import AGREED, Window, distance, next_reference, placed
from livepde.laws.law import Belief, Deferred, Fit, FixedInterval, Law, Problem, Report, finite
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

GATE = 6.0  # expected standard deviations: one value of a thousand million lies beyond by chance
FIRST = 20  # Gauss-Newton steps of a first sample that a nonlinear initial state takes at most
GUESS = 2.0  # samples that the first guess of the noise counts for


@dataclass(frozen=True)
class SensitivityLaw(Law[SensitivityWork, SensitivityState]):
    """State and parameter from sparse, noisy sensors, with a covariance.

    Reduced-order filter of Moireau, Chapelle and Le Tallec (2008); Zhang's adaptive observer;
    recursive prediction error. q = q_prior + Phi a with a ~ N(0, I): Phi is the prior standard
    deviation for numbers and the leading modes of the prior for fields. The joint covariance of u
    and a has the square root [U; C]. With S the Jacobian of a step and A the derivative of A(u) q
    in q,

        predict   one implicit step for u;   S U+ = M U/h - A(u+) Phi C
        update    d = z - G u+ - D q,  Y = G U+ + D Phi C:   a += C K d,  u += U+ K d,
                  K = (I + Y^T N^-1 Y)^-1 Y^T N^-1,  [U; C] times the square root of (I + ...)^-1

    A sample costs one step and one block of back-substitutions. For unknowns that stay as they are
    U is L C with the sensitivity L = du/da. An unknown that moves (`evolution`, or `drift` for all)
    adds new columns at each substep, independent of the older ones; the factor is then compressed
    to `rank` columns, so that no forgetting factor has to be chosen.

    Bounds of numbers, and those of latent values (`within` of an unknown), hold for the reference
    about which the filter is linear, and for reported estimates; the filter itself stays linear.

    Parameters
    ----------
    modes
        Number of modes for each field: one number, or name -> number. "auto": so many that they
        hold 99.99 % of the prior variance, at most 60.
    noise
        Standard deviation of the measurement noise; default the noise of the observation. "auto":
        the noise of the observation is a first guess, and the level is found from the samples, the
        same multiple for all sensors. Without `refit` the first samples keep the weight of the
        guess: intervals are too narrow if it is too small.
    drift
        Variance of a gained per unit of time, relative to the prior, by every unknown without an
        evolution of its own: > 0 follows parameters that change. An unknown gains the less, the
        closer its variance is to that of the prior, so that no variance winds up without data.
    memory
        Time constant with which the cross-covariance of state and parameters decays.
    refit
        Fit the stored samples again whenever their number has doubled; None: never.
    rank
        Columns of the factor while unknowns move; default the number of coordinates and five times
        that of those that move.
    gate
        Innovations of more than this many expected standard deviations, times the usual size of
        normalised innovations where that exceeds 1, are not used; infinity: all are.
    gate_patience
        After so many refusals in a row a sensor is believed if most others misfit as well, else set
        aside: see `livepde.laws.gate`.
    jumps
        Test for sudden changes; an alarm is noted as "jump" and lets the unknowns move.
    guards
        Safeguards against an overconfident linearisation and a runaway estimate; None: none.
    shadows
        Discretisation errors that widen the reported covariance; None: no error does.
    verdict
        Judge the run as it goes on (`Estimate.verdict`): True; "cheap", without the directions that
        cost solves, those of terms that the process may lack; False: not at all.

    Examples
    --------
    >>> import livepde as lp
    >>> law = lp.SensitivityLaw(
    ...     modes=20, gate=5.0
    ... )  # fields have 20 modes; 5 deviations are outliers
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
    # A run may be judged that was not judged before: fleets are not.
    verdict: bool | str = field(default=True, metadata={"begins_anew": True})

    scheme: ClassVar[Scheme] = Alexander2()  # no interval holds the error of a first-order scheme
    graded_start: ClassVar[bool] = True
    relinearises: ClassVar[bool] = True

    def __post_init__(self) -> None:
        stated = isinstance(self.noise, int | float) and np.isfinite(self.noise) and self.noise > 0
        gate: Any = self.gate  # None is no gate elsewhere
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
        # Constant unknowns never need more rows than coordinates. Moving ones and noisy inputs add
        # rows at each step, and a compression needs room for the state's own uncertainty.
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
        # Unknowns that move, or that may jump, follow a change of the process themselves.
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
        """Return the state before the first sample; its shadows begin at a moment."""
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
            return state if x is state.now else _started(work, state, x)
        # The initial state is a functional of the unknowns here: its derivative is the cross-
        # covariance with them, so that samples correct both together from the first one on.
        U = model.initial_directions(q0, work.filter.reduction.Phi, moment).T[None]
        x = changed(state.now, U=U)
        return changed(_started(work, state, x), initial=np.ones(1, dtype=bool))

    @nonfinite_allowed()  # such a sample is not used
    def begin(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> SensitivityState:
        filter_, x, interval = work.filter, state.now, work.filter.problem.unread(interval)
        span = filter_.span(interval)
        state = changed(state, log=added(state.log, span, np.ones(1, dtype=bool), x.parts))
        # A state that is known, seen by sensors that see no unknown, has nothing to learn.
        if not filter_.learns(filter_.sensors.observe(x, span.end)[1]):
            # The readings count all the same: another case may assimilate them.
            seen, _ = absorb(filter_, x, span, work.options)
            return state.counted(seen.evidence)
        problem = filter_.problem
        form = problem.model.form_initial
        # The safeguards of a step never see a sample at the initial time: where this is not linear
        # in the unknowns, it has to be iterated here.
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
            # The noise level is that before the sample, which would count in each iteration else.
            level, samples = state.now.level, state.now.samples
            x = changed(x, level=level, samples=samples, kept=state.now.kept)
        now = filter_.relinearised(now) if self.relinearises else now
        opening = np.ones(1, dtype=bool)
        return changed(state, now=now, older=now, newer=now, opening=opening)

    def stepped_alone(self, work: SensitivityWork) -> str:
        if type(self) is not SensitivityLaw:  # a subclass may step in a way of its own
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

    @nonfinite_allowed()  # reported as a status
    def step_members(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, MemberReports]:
        """Return state and reports of all members after a sample of each, and refits that are due.

        They step as arrays; whoever meets something out of the ordinary, a safeguard, an alarm, a
        failure, or is late, steps alone.
        """
        # A window goes back to the time and inputs of its first row, which a run without a sample
        # at the initial time does not have yet.
        begun = state if state.log.shape[1] else changed(state, log=opened(state.log, span))
        new, told, usual = self._together(work, begun, span)
        reports = reports_of(work, new.now, told)
        if np.count_nonzero(usual) < usual.size:
            new, reports = self._apart(work, begun, new, reports, usual, span)
            usual = np.array([status.ok for status in reports.statuses])
            if not usual.any():
                return (new if len(state) > 1 else state), reports
        new, moved = refit_due(work, new)
        if moved is not None:
            taken = usual
            reports = reports.updated(moved.each(lambda number: np.where(taken, number, np.nan)))
        if len(new.fork):
            new = go_on(work, new)
        return shortened(work, new), reports

    def _together(
        self, work: SensitivityWork, state: SensitivityState, span: Span
    ) -> tuple[SensitivityState, Assimilation, Mask]:
        """Return all members after a sample, and which of them needed no special treatment."""
        filter_, before = work.filter, state.now
        x, told = assimilate(filter_, before, span, work.options)
        usual = told.finite
        if told.status.code != "ok":
            return state, told, usual
        if len(span.t0) > 1:
            usual = usual & span.together
        scale = state.scale.add(span.z1, span.z1 - told.predicted)
        parts: dict[str, Any] = {"scale": scale.without_refused(state.scale, x.screened.refused)}
        if self.guards is not None:
            usual = usual & _within(self.guards, filter_, before, x, told, scale, span)
        if self.jumps is not None and span.present.any():
            parts["watch"], alarm = watched(work, self.jumps, state, x, span)
            usual = usual & ~alarm
        if self.relinearises:
            x = filter_.relinearised(x)
        if np.count_nonzero(usual) < usual.size:
            if not usual.any():
                return state, told, usual
            x = where(usual, x, before)
            parts = {name: where(usual, part, getattr(state, name)) for name, part in parts.items()}
        return stored(work, state, x, span, usual, told.disturbed, **parts), told, usual

    def _apart(
        self,
        work: SensitivityWork,
        state: SensitivityState,
        new: SensitivityState,
        reports: MemberReports,
        usual: Mask,
        span: Span,
    ) -> tuple[SensitivityState, MemberReports]:
        """Return state and reports after those members that are not `usual` have stepped alone."""
        alone: dict[int, Report] = {}
        each: dict[int, SensitivityState] = {}
        for k in np.flatnonzero(~usual).tolist():
            one, alone[k] = step_alone(work, take(state, k), span.member(k))
            # The members share the rows of one log: whoever failed has an empty row there.
            while work.keeps_log and one.log.shape[1] <= state.log.shape[1]:
                one = changed(one, log=skipped(one.log))
            each[k] = one
        return put_each(new, each), reports.with_members(alone)

    def live(self) -> SensitivityLaw:
        if self.refit is None or self.refit.apart is not None:
            return self
        return replace(self, refit=replace(self.refit, apart=True))

    def fit(self, work: SensitivityWork, state: SensitivityState) -> Fit | None:
        return state.fit.member(0)

    def diagnosed(self, work: SensitivityWork, state: SensitivityState) -> Diagnostics[float]:
        told = no_readings(state.now, work.filter.problem.observed.size)
        return reports_of(work, state.now, told).member(0).diagnostics

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
        found = smoothed(work, before, settled.now, data, used)
        return (self.member_belief(work, x, 0) for x in found)

    def belief(self, work: SensitivityWork, state: SensitivityState) -> Belief:
        return self.member_belief(work, state.now, 0)

    def deferred(self, work: SensitivityWork, state: SensitivityState) -> Deferred:
        # Kept estimates must not hold ledgers and warm-start data, which are larger than a belief.
        now, fit = kept_for_estimates(state.now), state.fit.member(0)
        judge, level = judged(work.filter, state.now, now), float(now.level[0])

        def verdict() -> Verdict:
            found = with_noise(with_fit(judge(), fit), work, level)
            if not self.verdict:
                return found
            return with_discretisation(found, work.filter.shadows, now.shadows)

        return Deferred(read_later(self._beliefs, work, now), verdict)

    def final(
        self, work: SensitivityWork, state: SensitivityState, *, columns: bool = True
    ) -> Deferred:
        belief, before = self.deferred(work, state)
        # Of a later window the fit knows nothing of the readings before.
        whole = state.fit.member(0) if not state.window[0] else None
        if not self.verdict:
            return Deferred(belief, lambda: after_fit(before(), whole))
        tried = Columns.of(work, state) if columns else None

        def verdict() -> Verdict:
            found = after_fit(before(), whole)
            found = found if tried is None else with_columns(found, tried)
            return with_errors(found, work, state)

        return Deferred(belief, verdict)

    def factors(self, work: SensitivityWork, x: FilterState) -> tuple[Array, Array]:
        """Return the square root [U C] of the covariance that is reported, of all members."""
        return reported_factors(work.filter, x)

    def member_belief(self, work: SensitivityWork, now: FilterState, k: int) -> Belief:
        """Return the belief of one member, in latent coefficients."""
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


def _within(
    guards: Guards,
    filter_: Filter,
    before: FilterState,
    x: FilterState,
    told: Assimilation,
    scale: Scale,
    span: Span,
) -> Mask:
    """Return which members a sample neither moves too far, nor finds far off, (members,)."""
    near = guards.within_reach(x.da - before.da)
    # Ranges are at least as large as the noise, so that smaller innovations cannot run away: most
    # samples are spared the exact test.
    if told.worst > guards.runaway:
        beyond = scale.beyond(span.z1 - told.predicted, filter_.noise_of(before, span))
        near = near & ~(beyond > guards.runaway)
    return near


def _started(work: SensitivityWork, state: SensitivityState, x: FilterState) -> SensitivityState:
    start, trial = work.kept_start(x), zeros(x) if work.fits else x
    fit = FitState.none(start)
    return changed(state, start=start, trial_start=trial, fit=fit, now=x, older=x, newer=x)
