"""The parts around the method of `GradientLaw`: stages, the rule for u_alpha, metric, gate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.coupled.coupled_stage import CoupledStage, KeptFactor
from livepde.laws.coupled.equation import StageIterate, StageProblem, StageTerms
from livepde.laws.coupled.split_forms import StageForms
from livepde.laws.damping import Damping, ResidualDamping
from livepde.laws.equation_tests import (
    EquationLedger,
    EquationTests,
    ExcitationGate,
    ExcitationLevel,
    ObservedEquation,
    Probes,
)
from livepde.laws.information import ConstantMetric, InformationMetric, MetricRule, MetricStep
from livepde.laws.law import Problem
from livepde.laws.observed_part import (
    Inverse,
    ObservedPart,
    ObservedPath,
    SelfChosenSmoothing,
    smooths,
)
from livepde.linalg import Array, Memo, Pattern
from livepde.stepping import Newton

ROUNDING = 1e-9  # of entries of P, which are at most about one
SAME = 1e-9  # of a step: times that are the same but for rounding
MOST_STAGES = 8  # kept for different sets of present sensors


@dataclass(frozen=True, eq=False)
class GradientParts:
    """Parts computed once for a problem, and the rules around the method."""

    # As given.
    problem: Problem
    newton: Newton
    damping: Damping
    # As for `StageForms`.
    M_op: Any
    N_op: Any
    nu: float
    # Rules for u_alpha and for the metric of Q.
    observed: ObservedPart
    metric: MetricRule[Any]
    # The excitation gate that holds q, and the probes that measure the excitation; None: q is never
    # held.
    gate: ExcitationGate | None = None
    probes: Probes | None = None
    memory: Pattern | None = None  # pattern of the information, for `StageTerms`
    # Tests of the equation, for the verdict; None: there is none.
    tests: EquationTests | None = None
    _stages: Memo[bytes, CoupledStage] = field(default_factory=lambda: Memo(MOST_STAGES))

    def stage(self, present: Array) -> CoupledStage:
        """Return the coupled stage for the sensors present."""
        return self._stages.get(present.tobytes(), lambda: self._made(present))

    def _made(self, present: Array) -> CoupledStage:
        terms = StageTerms(self.forms(present), self.damping, self.memory)
        return CoupledStage(terms, self.newton)

    def forms(self, present: Array) -> StageForms:
        """Return the forms of the stage for the sensors present."""
        split = self.problem.observed.split(present)
        return StageForms(self.problem.model, split, self.M_op, self.N_op, self.nu)

    def prepared(self) -> GradientParts:
        """Return the same with the stage of all sensors prepared, before the first sample comes."""
        present = np.ones(self.problem.observed.size, dtype=bool)
        self.stage(present).solver.prepare()
        return self

    def closed(self, excitation: ExcitationLevel) -> bool:
        """Return true if the gate is closed: q is held."""
        return self.gate is not None and self.gate.closed(excitation)

    def excited(
        self, excitation: ExcitationLevel, w: Array, u: Array, q: Array, moment: Moment
    ) -> ExcitationLevel:
        """Return the excitation after a sample, from w and the estimate u."""
        if self.gate is None or self.probes is None:
            return excitation
        seen = self.probes(np.array([w, u]).T, q, moment)
        return self.gate.add(excitation, seen[:, 0], seen[:, 1])

    def tested(
        self, tested: EquationLedger, present: Array, equation: Callable[[], ObservedEquation]
    ) -> EquationLedger:
        """Return the sums of the tests after a sample; one of some sensors only is left out."""
        if self.tests is None or not self.tests.possible:
            return tested
        if not present.all():
            return tested.interrupted()
        return self.tests.add(tested, equation())


class StageSequence:
    """The coupled stages of one interval, one after the other: a `Stage` for `advance`."""

    def __init__(
        self,
        coupled: CoupledStage,
        path: ObservedPath,
        metric: MetricStep,
        rate: Array | None,
        kept: KeptFactor,
        left: Array,
        width: float,
    ) -> None:
        self.coupled = coupled
        self.path = path
        self.metric = metric
        self.slope = rate
        # Without a rate other sensors are present, or q is held now or was before: another matrix,
        # so that the factor of the last stage does not serve.
        self.kept = kept if rate is not None else KeptFactor.none()
        self.left = left
        self.width = width
        self._last: tuple[StageProblem, float, StageIterate] | None = None

    def __call__(self, c: Array, t: float, h: float) -> Array:
        """Return y = (u, q) at t of the stage that begins at c; raises `StepFailed`."""
        n, project = self.coupled.terms.n, self.coupled.terms.forms.split.project
        u_alpha = self.path.at(t).u
        carries, moment = self.coupled.carries, self.path.interval.at(t)
        # A shorter step makes up for its share only: in no time the rest would be an impulse.
        left = min(1.0, self.width / h) * self.left if carries else None
        problem = StageProblem(c, h, moment, u_alpha, self.metric(h), left)
        # The observed part moves with the data, the rest as in the step before.
        follows = c.copy()
        follows[:n] += u_alpha - self.path.at(max(t - h, self.path.interval.t0)).u

        def start() -> Array:  # with r as it was
            if self.slope is None:
                return follows
            moved = follows + h * self.slope
            moved[:n] -= project(h * self.slope[:n])
            return moved

        predicted = None if self.slope is None else follows + h * self.slope
        at, self.kept = self.coupled.solve(problem, start, predicted, self.kept)
        self._last = problem, t, at
        if carries:
            self.left, self.width = at.residual, h
        return at.y

    def equation_error(self) -> Array:
        """Return R^T eps at the end, the equation error of the data, a dual vector, shape (n,).

        It balances the terms of r in the last stage, -theta R^T M_op r - R^T M r', up to the
        remaining residual of the iteration.
        """
        if self._last is None:
            return np.zeros(self.coupled.terms.n)
        (problem, t, at), forms = self._last, self.coupled.terms.forms
        n, begin = self.coupled.terms.n, max(t - problem.h, self.path.interval.t0)
        # r at the beginning of the stage: M r' is the change of M r over its length.
        before = forms.split.project(problem.c[:n]) - self.path.at(begin).u
        change = at.mass_r - forms.mass @ before
        error: Array = at.residual[:n] - at.theta * at.Mr - change / problem.h
        return error

    def rate(self, begin: Array, end: Array) -> Array:
        """Return the change of (u - u_alpha, q) over the interval, per unit of time."""
        n, interval = self.coupled.terms.n, self.path.interval
        change = end - begin
        if self.slope is None:  # the data at the beginning are not those of these sensors
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
    nu: float,
    sigma: float,
    gate: ExcitationGate | None,
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
        observed=Inverse(problem),
        metric=ConstantMetric(gain, sigma),
        gate=gate,
        probes=None if gate is None else Probes(problem.model, problem.observed.split()),
    ).prepared()


def tuned_parts(problem: Problem, nu: float, N_op: Any, newton: Newton) -> GradientParts:
    """Return the parts of the law that tunes itself."""
    _require_linear_readings(problem)
    model, observation = problem.model, problem.observed.observation
    if model.latent.moves:
        raise LawError(
            "GradientLaw: gain='auto' accumulates what is known of constant unknowns, and here "
            "one moves (evolution=): give a number for gain, or use SensitivityLaw."
        )
    whole = _sees_all(problem)
    if not whole and model.form_A.differentiates("u"):
        raise LawError(
            "GradientLaw: gain='auto' needs data of the whole state where A contains derivatives "
            "of u, because fluxes at the border of partial data would decide the unknowns: use "
            "SensitivityLaw on this Subdomain or these sensors, or give a number for gain."
        )
    metric = InformationMetric(model, observation.nodal)
    # Of partial data the smoothed part moves with w, and errors grow: they stay as they are.
    own = whole and smooths(problem.observed)
    return GradientParts(
        problem=problem,
        newton=_for_scheme(newton, problem),
        damping=ResidualDamping(),
        M_op=None,
        N_op=N_op,
        nu=nu,
        observed=SelfChosenSmoothing(problem) if own else Inverse(problem),
        metric=metric,
        memory=metric.pattern,
    ).prepared()


def _sees_all(problem: Problem) -> bool:
    hidden = abs(problem.observed.split().P) @ problem.model.X.free
    return not bool((hidden > ROUNDING).any())


def _for_scheme(newton: Newton, problem: Problem) -> Newton:
    """Return the iteration for a scheme: one of second order leaves out less than a prediction."""
    return replace(newton, share=0.0) if problem.control.scheme.order > 1 else newton


def _require_linear_readings(problem: Problem) -> None:
    if not problem.observed.linear:
        raise LawError(
            "this law needs readings z = G u, and this observation is not linear or sees a "
            "parameter directly: use SensitivityLaw."
        )
