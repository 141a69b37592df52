"""`GradientLaw`, the adaptive observer of Boiger and Kaltenbacher: stages, parameters and state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.coupled.coupled_stage import CoupledStage, KeptFactor
from livepde.laws.coupled.equation import StageForms, StageIterate, StageProblem, StageTerms
from livepde.laws.damping import Damping, ResidualDamping
from livepde.laws.equation_tests import (
    EquationLedger,
    EquationTests,
    ExcitationGate,
    ExcitationLevel,
    ObservedEquation,
    Probes,
)
from livepde.laws.gate import ReadingRange
from livepde.laws.information import (
    ConstantMetric,
    InformationMetric,
    MetricRule,
    MetricStep,
    StepBegin,
    Transition,
)
from livepde.laws.law import Belief, Deferred, Law, Problem, Report, Status
from livepde.laws.observed_part import (
    ObservedPart,
    ObservedPath,
    SelfChosenSmoothing,
    StatedReconstruction,
    smooths,
)
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Memo, Pattern
from livepde.model import h1_form
from livepde.stepping import Interval, Newton, advance

ROUNDING = 1e-9  # absolute, for entries of P, which are at most about one
MOST_STAGES = 8  # capacity of the cache, which has a stage for each set of present sensors


@dataclass(frozen=True, eq=False)
class GradientParts:
    """Quantities computed once for a problem, and the rules that the method applies."""

    # The problem, the nonlinear iteration of a stage, and the rule for theta.
    problem: Problem
    newton: Newton
    damping: Damping
    # Integrands of M and N, and the weight of N: see `StageForms`.
    M_op: Any
    N_op: Any
    nu: float
    # Rules for u_alpha and for the metric of Q.
    observed: ObservedPart
    metric: MetricRule[Any]
    # Gate that holds q without excitation, and probes that measure the excitation; None: no gate.
    gate: ExcitationGate | None = None
    probes: Probes | None = None
    memory: Pattern | None = None  # pattern of the information matrix J; None: constant gain
    tests: EquationTests | None = None  # tests for the verdict; None: runs are not judged
    _stages: Memo[bytes, CoupledStage] = field(default_factory=lambda: Memo(MOST_STAGES))

    def stage(self, present: Array) -> CoupledStage:
        def build() -> CoupledStage:
            terms = StageTerms(self.forms(present), self.damping, self.memory)
            return CoupledStage(terms, self.newton)

        return self._stages.get(present.tobytes(), build)

    def forms(self, present: Array) -> StageForms:
        split = self.problem.observed.split(present)
        return StageForms(self.problem.model, split, self.M_op, self.N_op, self.nu)

    def prepared(self) -> GradientParts:
        """Prepare the stage for the complete set of sensors, and return these parts."""
        present = np.ones(self.problem.observed.size, dtype=bool)
        self.stage(present).solver.prepare()
        return self

    def excited(
        self, excitation: ExcitationLevel, w: Array, u: Array, q: Array, moment: Moment
    ) -> ExcitationLevel:
        if self.gate is None or self.probes is None:
            return excitation
        values = self.probes(np.array([w, u]).T, q, moment)
        return self.gate.add(excitation, values[:, 0], values[:, 1])

    def tested(
        self, tested: EquationLedger, present: Array, equation: Callable[[], ObservedEquation]
    ) -> EquationLedger:
        """Return the sums of the equation tests after a sample; incomplete samples are skipped."""
        if self.tests is None or not self.tests.possible:
            return tested
        if not present.all():
            return tested.interrupted()
        return self.tests.add(tested, equation())


@dataclass(eq=False)
class StageSequence:
    """Consecutive coupled stages of one interval: a `Stage` for `advance`."""

    coupled: CoupledStage
    path: ObservedPath
    metric: MetricStep
    slope: Array | None  # last rate of change of (u - u_alpha, q); None: stages are not predicted
    kept: KeptFactor
    # Residual of the last stage, and its step size.
    left: Array
    width: float
    _last: tuple[StageProblem, float, StageIterate] | None = None

    def __call__(self, c: Array, t: float, h: float) -> Array:
        """Return the solution y = (u, q) at t of the stage from c; raises `StepFailed`."""
        n, project = self.coupled.terms.n, self.coupled.terms.forms.split.project
        u_alpha = self.path.at(t).u
        carries, moment = self.coupled.carries, self.path.interval.at(t)
        # The ratio of steps is at most 1: in a short step the full residual would be an impulse.
        left = min(1.0, self.width / h) * self.left if carries else None
        problem = StageProblem(c, h, moment, u_alpha, self.metric(h), left)
        # The prediction shifts the observed part with the data, and extrapolates u - u_alpha and q.
        follows = c.copy()
        follows[:n] += u_alpha - self.path.at(max(t - h, self.path.interval.t0)).u

        def start() -> Array:  # r is unchanged
            if self.slope is None:
                return follows
            y = follows + h * self.slope
            y[:n] -= project(h * self.slope[:n])
            return y

        predicted = None if self.slope is None else follows + h * self.slope
        at, self.kept = self.coupled.solve(problem, start, predicted, self.kept)
        self._last = problem, t, at
        if carries:
            self.left, self.width = at.residual, h
        return at.y

    def equation_error(self) -> Array:
        """Return the equation error R^T eps of the data at the end, a dual vector of shape (n,).

        In the last stage it equals -theta R^T M_op r - R^T M r', up to the residual of the
        nonlinear iteration.
        """
        if self._last is None:
            return np.zeros(self.coupled.terms.n)
        (problem, t, at), forms = self._last, self.coupled.terms.forms
        n, begin = self.coupled.terms.n, max(t - problem.h, self.path.interval.t0)
        # r at the beginning of the stage: M r' is a difference quotient over the stage.
        before = forms.split.project(problem.c[:n]) - self.path.at(begin).u
        change = at.mass_r - forms.mass @ before
        return np.asarray(at.residual[:n] - at.theta * at.Mr - change / problem.h)

    def rate(self, begin: Array, end: Array) -> Array:
        """Return the mean rate of change of (u - u_alpha, q) over the interval."""
        n, interval = self.coupled.terms.n, self.path.interval
        change = end - begin
        if self.slope is None:  # the initial data may come from other sensors
            change[:n] -= self.coupled.terms.forms.split.project(change[:n])
        else:
            change[:n] -= self.path.at(interval.t1).u - self.path.at(interval.t0).u
        return change / (interval.t1 - interval.t0)


def constant_parts(
    problem: Problem,
    gain: float,
    damping: Damping,
    newton: Newton,
    *,
    M_op: Any,
    N_op: Any,
    nu: float = 0.0,
    sigma: float = 0.0,
    gate: ExcitationGate | None = None,
) -> GradientParts:
    """Return the parts of a law with a constant gain."""
    _require_linear_readings(problem)
    return GradientParts(
        problem=problem,
        newton=_for_scheme(newton, problem),
        damping=damping,
        M_op=M_op,
        N_op=N_op,
        nu=nu,
        observed=StatedReconstruction(problem),
        metric=ConstantMetric(gain, sigma),
        gate=gate,
        probes=None if gate is None else Probes(problem.model, problem.observed.split()),
    ).prepared()


def _tuned_parts(problem: Problem, nu: float, N_op: Any, newton: Newton) -> GradientParts:
    """Return the parts of a law with `gain="auto"`."""
    _require_linear_readings(problem)
    model, observation = problem.model, problem.observed.observation
    if model.latent.moves:
        raise LawError(
            "GradientLaw: gain='auto' accumulates what is known of constant unknowns, and here "
            "one moves (evolution=): give a number for gain, or use SensitivityLaw."
        )
    hidden = abs(problem.observed.split().P) @ model.X.free
    whole = not (hidden > ROUNDING).any()
    if not whole and model.form_A.differentiates("u"):
        raise LawError(
            "GradientLaw: gain='auto' needs data of the whole state where A contains derivatives "
            "of u, because fluxes at the border of partial data would decide the unknowns: use "
            "SensitivityLaw on this Subdomain or these sensors, or give a number for gain."
        )
    metric = InformationMetric(model, observation.nodal)
    # Partial data are not smoothed: the part that smoothing removes moves with w, and errors grow.
    own = whole and smooths(problem.observed)
    return GradientParts(
        problem=problem,
        newton=_for_scheme(newton, problem),
        damping=ResidualDamping(),
        M_op=None,
        N_op=N_op,
        nu=nu,
        observed=SelfChosenSmoothing(problem) if own else StatedReconstruction(problem),
        metric=metric,
        memory=metric.pattern,
    ).prepared()


def _for_scheme(newton: Newton, problem: Problem) -> Newton:
    """Return the iteration; the stages of second-order schemes are solved to `tolerance`."""
    return replace(newton, share=0.0) if problem.control.scheme.order > 1 else newton


def _require_linear_readings(problem: Problem) -> None:
    if not problem.observed.linear:
        raise LawError(
            "this law needs readings z = G u, and this observation is not linear or sees a "
            "parameter directly: use SensitivityLaw."
        )


@dataclass(frozen=True, eq=False)
class GradientState:
    """Estimates u^ and q^, and the initial data of the next step."""

    # Coefficients, shapes (n,) and (m,).
    u: Array
    q: Array
    u_alpha: Array  # observed part of the state at the last sample, shape (n,)
    rate: Array  # last rate of change of (u^ - u_alpha, q^), shape (n + m,)
    kept: KeptFactor  # cached factor of the coupled stage
    # Residual of the last stage, shape (n + m,), which the next stage corrects; and its step size.
    left: Array
    width: float
    # Mask of the sensors with a reading in the last sample, (sensors,); True if q was held.
    present: Array
    frozen: bool
    # States of the rules for u_alpha and for the metric of Q, and of the excitation gate.
    observed: Any
    metric: Any
    excitation: ExcitationLevel
    tested: EquationLedger  # sums of the tests of the equation
    readings: ReadingRange  # range of the accepted readings, to detect wild ones


@dataclass(frozen=True)
class GradientLaw(Law[GradientParts, GradientState]):
    """Adaptive observer of Boiger and Kaltenbacher (2016), (est_exact_q) and (est_exact_u).

        q' = gain A(w)* r - sigma q,            w = u_alpha + P u,  r = R u - u_alpha
        M u' + B(w) + A(w) q + theta R^T M_op r + nu P^T N_op P u = F

    An implicit step solves both equations as one system: see `StageSolver.evaluate` in
    `livepde.laws.coupled.equation`.

    u_alpha = G^+ z. If the `reconstruction` of the observation regularises, u_alpha = G_alpha z:
    the equations are (noisy_q) and (noisy_u), and the diagnostics contain alpha and the misfit
    ||G u_alpha - z||_Z. For a `Subdomain` the integrals are split as in the paper: over omega the
    forms use the data, M_op and r are integrated over omega, and N_op outside omega.

    A reading is wild if it exceeds the past range of its sensor by ten times the range of all
    readings. Up to three consecutive wild readings of a sensor are discarded.

    Use this law for observed subdomains and averages. A few noisy point sensors mislead it, because
    flux jumps at the sensors reward a vanishing diffusivity: use `SensitivityLaw` for them.

    Parameters
    ----------
    gain
        Scale of the inner product of Q, > 0: it determines how fast q adapts. The theory holds for
        every value. The step is stable for every value, because u and q are solved together.

        "auto": the metric of Q follows from r, the excitation and the prior (`std` of the unknowns)
        alone (`livepde.laws.information`). `damping`, `M_op` and `sigma` must keep their defaults.
        "auto" requires data of the whole state. With partial data it is experimental: the data are
        not smoothed, and an A with derivatives of u, such as a diffusivity, raises `LawError`.
    damping
        Rule for theta = mu / ||r||_V~.
    nu
        Weight of P N P u, >= 0. It draws P u to zero, not to the truth. It is required if the
        process does not damp the unobserved part (D < 0); otherwise it may help or harm.
    sigma
        Weight of the stabilising term of (noisy_q), >= 0. It draws q to zero, and the logarithm of
        a positive unknown to its prior median.
    M_op, N_op
        Integrands (u, v, x) of M and N of (MN1), (MN2); default u v + grad u . grad v.
        `diffusion_operator(D)` is the integrand of the paper, with |D|.
    newton
        The nonlinear iteration, with its stopping criterion.
    gate
        With a constant gain: rule that holds q while only noise excites it, because q would drift
        with the noise. None: q is never held.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> rod = heat(lp.interval(0.0, 1.0, 8), lp.Normal(0.1, std=0.05), {"left": 0.0})
    >>> identifier = lp.Identifier(rod, lp.Full(noise=0.1), lp.GradientLaw(), u0=1.0)
    """

    gain: float | Literal["auto"] = 1.0
    damping: Damping = field(default_factory=ResidualDamping)
    nu: float = 0.0
    sigma: float = 0.0
    M_op: Any = h1_form
    N_op: Any = h1_form
    newton: Newton = field(default_factory=Newton)
    gate: ExcitationGate | None = field(default_factory=ExcitationGate)

    def __post_init__(self) -> None:
        gain: Any = self.gain
        if gain == "auto":
            if (self.damping, self.M_op, self.sigma) != (ResidualDamping(), h1_form, 0.0):
                raise LawError(
                    "GradientLaw: gain='auto' chooses damping, M_op and sigma itself: leave them "
                    "out, or give a number for gain."
                )
        elif isinstance(gain, str) or not (np.isfinite(gain) and gain > 0):
            raise LawError(f"GradientLaw: gain must be a positive number or 'auto'; got {gain!r}.")
        for name in ("nu", "sigma"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise LawError(f"GradientLaw: {name} must be a number >= 0; got {value}.")

    def prepare(self, problem: Problem) -> GradientParts:
        if len(problem.model.algebraic):
            raise LawError(
                "GradientLaw: a component of the state has no mass term, so M is not an inner "
                "product of X: use SensitivityLaw, or give M a term for each component."
            )
        if slow := [*problem.model.sensors]:
            raise LawError(
                f"GradientLaw compares readings with the field, and '{slow[0]}' responds slowly: "
                "leave out its time constant, or use SensitivityLaw."
            )
        if problem.input_noise or problem.initial_rank:
            raise LawError(
                "GradientLaw has no covariance that input_noise, u0_from or u0_errors could enter: "
                "leave them out, or use SensitivityLaw."
            )
        parts = self._parts(problem)
        metric, prior = parts.metric, np.zeros((problem.model.Q.dim, 0))
        # A constant gain does not use the prior, whose standard deviation may be arbitrary.
        if isinstance(metric, InformationMetric):
            prior = metric.probes
        forms = parts.stage(np.ones(problem.observed.size, dtype=bool)).terms.forms
        return replace(parts, tests=EquationTests(forms, prior))

    def _parts(self, problem: Problem) -> GradientParts:
        if self.gain == "auto":
            return _tuned_parts(problem, self.nu, self.N_op, self.newton)
        return constant_parts(
            problem,
            self.gain,
            self.damping,
            self.newton,
            M_op=self.M_op,
            N_op=self.N_op,
            nu=self.nu,
            sigma=self.sigma,
            gate=self.gate,
        )

    def init(self, work: GradientParts, q0: Array, u0: Array) -> GradientState:
        return GradientState(
            u=u0,
            q=q0,
            u_alpha=np.zeros(len(u0)),
            rate=np.zeros(len(u0) + len(q0)),
            kept=KeptFactor.none(),
            left=np.zeros(len(u0) + len(q0)),
            width=0.0,
            present=np.zeros(work.problem.observed.size, dtype=bool),
            frozen=False,
            observed=work.observed.init(),
            metric=work.metric.init(q0),
            excitation=ExcitationLevel.none(),
            tested=EquationLedger.none(),
            readings=ReadingRange.start(work.problem.observed.size),
        )

    def start(self, work: GradientParts, q0: Array, u0: Array, moment: Moment) -> GradientState:
        form = work.problem.model.form_initial
        if form is not None and form.data("v", "q", moment, q=q0).any():
            raise LawError(
                "the initial state depends on unknowns (initial=), which this law cannot learn: "
                "use SensitivityLaw, or leave out initial= and give u0."
            )
        return self.init(work, q0, u0)

    def step(
        self, work: GradientParts, state: GradientState, interval: Interval
    ) -> tuple[GradientState, Report]:
        interval, readings = state.readings.screened(interval, work.problem.observed.noise)
        refused = int(np.count_nonzero(readings.wild > state.readings.wild))
        interval = work.problem.linear_readings(interval, state.u)
        before, state = state, replace(state, readings=readings)
        closed = work.gate is not None and work.gate.closed(state.excitation)
        new, report = self._advanced(work, state, interval, closed)
        # If prior and data cannot explain the new q, the step is repeated with q held.
        if report.status.ok and (doubt := work.metric.doubt(new.metric, new.q)):
            new, report = self._advanced(work, state, interval, frozen=True)
            if report.status.ok:
                report = replace(report, status=Status("departed", doubt))
        elif closed and report.status.ok:
            tested = replace(new.tested, rests=new.tested.rests + 1)
            new, report = replace(new, tested=tested), report.updated(Diagnostics(at_rest=1.0))
        if not report.status.taken:
            return before, report
        if refused:
            report = report.updated(Diagnostics(refused=float(refused)))
        return new, report

    def _advanced(
        self, work: GradientParts, state: GradientState, interval: Interval, frozen: bool
    ) -> tuple[GradientState, Report]:
        """Return the state at the end of an interval, with q held if `frozen`, and a report."""
        model, n = work.problem.model, len(state.u)
        coupled = work.stage(interval.present)
        forms, length = coupled.terms.forms, interval.t1 - interval.t0
        moment = interval.at(interval.t1)
        R = forms.split.project

        # u_alpha, and the metric of Q in which A(w)^T r moves q
        observed, path = work.observed.over(state.observed, forms.split, interval)
        u_alpha = path.at(interval.t1).u
        w = u_alpha + state.u - R(state.u)
        same = np.array_equal(interval.present, state.present)
        begin = StepBegin(state.q, w, moment, length)
        rule = work.metric.frozen if frozen else work.metric.step
        metric = rule(state.metric, forms, begin)

        # u and q together, by coupled stages
        predicts = same and frozen == state.frozen
        # The matrix depends on the sensors and on whether q is held: if either changed, the factor
        # of the last stage is not used.
        rate, kept = (state.rate, state.kept) if predicts else (None, KeptFactor.none())
        # While q is held, the residual of its equation is rounding, due to the large weight of Q.
        left = state.left if predicts and not frozen else 0.0 * state.left
        stages = StageSequence(coupled, path, metric, rate, kept, left, state.width)
        y = np.concatenate([state.u, state.q])
        end, steps, failure = advance(work.problem.control, stages, y, interval.t0, interval.t1)
        if failure is not None:
            predicted = work.problem.predict(state.u, state.q, interval.end)
            return state, Report(Status.of(failure), predicted)

        # u - r is w = u_alpha + P u at the end. The metric is updated with q before clipping.
        u, q = end[:n], model.latent.clipped(end[n:])
        r, change = R(u) - u_alpha, end[n:] - state.q
        error = cache(stages.equation_error)
        after = Transition(forms, end[n:], u - r, change, error, moment, length)
        learned = work.metric.learn(state.metric, after)

        def equation() -> ObservedEquation:
            rate = forms.mass @ (u_alpha - path.at(interval.t0).u) / length
            return ObservedEquation(error=error(), rate=rate, w=u - r, q=end[n:], moment=moment)

        new = GradientState(
            u=u,
            q=q,
            u_alpha=u_alpha,
            rate=stages.rate(y, end),
            kept=stages.kept,
            left=stages.left,
            width=stages.width,
            present=interval.present,
            frozen=frozen,
            observed=observed,
            metric=learned,
            excitation=work.excited(state.excitation, u - r, u, q, moment),
            tested=work.tested(state.tested, interval.present, equation),
            readings=state.readings,
        )
        known = path.diagnostics().updated(work.metric.diagnostics(learned, q, length))

        def diagnostics() -> Diagnostics[float]:
            return replace(known, residual=model.X.norm(r))

        predicted = work.problem.predict(u, q, interval.end)
        return new, Report(Status(), predicted, steps, cache(diagnostics))

    def belief(self, work: GradientParts, state: GradientState) -> Belief:
        return Belief(state.q, state.u)

    def deferred(self, work: GradientParts, state: GradientState) -> Deferred:
        belief, tests, tested = self.belief(work, state), work.tests, state.tested
        judge = self.unjudged if tests is None else lambda: tests.verdict(tested)
        return Deferred(lambda: belief, judge)
