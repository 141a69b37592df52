"""Solution of a coupled stage of u and q: prediction, cached factors, and search for theta."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy  # scipy.optimize is slow to import, and rarely needed

from livepde.fem import Moment
from livepde.laws.coupled.equation import (
    Metric,
    StageData,
    StageIterate,
    StageProblem,
    StageSolver,
    StageTerms,
)
from livepde.laws.coupled.stage_solvers import BilinearSolver, BlockSolver, MonolithicSolver
from livepde.linalg import Array, Factor
from livepde.stepping import Near, Newton, Solution, StepFailed

STRIDE = 1.5  # ratio of consecutive trial values of theta
SAME = 1e-9  # relative difference of steps that are equal up to rounding
ACCURACY = 1e-8  # relative accuracy of theta before the final Newton iteration


@dataclass(frozen=True, eq=False)
class KeptFactor:
    """Linearisation point of a cached factor, from which a restart recomputes the same factor."""

    # Point, data and step of the Jacobian, shapes (n + m,) and (n,); empty without a factor.
    y: Array
    u_alpha: Array
    h: float
    # Fields of its `Metric`; `information` empty or `theta` NaN: None in the metric.
    weight: float
    sigma: float
    information: Array
    theta: float
    spent: int  # updates with the factor, beyond one for each stage

    @classmethod
    def none(cls) -> KeptFactor:
        return cls(np.zeros(0), np.zeros(0), 0.0, 0.0, 0.0, np.zeros(0), math.nan, 0)

    @classmethod
    def of(cls, data: StageData, y: Array) -> KeptFactor:
        """Return the linearisation point of a factor that was computed at y."""
        problem, metric = data.problem, data.problem.metric
        information = np.zeros(0) if metric.information is None else metric.information
        theta = math.nan if metric.theta is None else metric.theta
        point = y, problem.u_alpha, problem.h
        return cls(*point, metric.weight, metric.sigma, information, theta, 0)


@dataclass(frozen=True, eq=False)
class _CoupledEquation:
    """The equation of one stage: a `StageEquation` for `Newton`."""

    solver: StageSolver
    data: StageData

    def evaluate(self, y: Array) -> StageIterate:
        return self.solver.evaluate(self.data, y)

    def factor(self, at: StageIterate) -> Factor:
        return self.solver.factor(self.data, at)

    def limited(self, at: StageIterate, allowed: float) -> bool:
        return self.solver.terms.limited(self.data, at, allowed)


def nearest_root(
    function: Callable[[float], float], start: float, least: float, most: float
) -> float | None:
    """Return the root in [least, most] nearest to a positive start, or None without a root."""
    # A value is computed once: the function of a stage depends on its initial iterate.
    values = cache(function)
    start = min(max(start, least), most)
    first = values(start)
    if first == 0.0:
        return start
    # A positive value is a theta that is too small: the side above is searched first.
    ends = {1: most, -1: least}
    sides = (1, -1) if first > 0.0 else (-1, 1)
    near = dict.fromkeys(sides, start)
    while any(near[side] != ends[side] for side in sides):
        for side in sides:
            inner, end = near[side], ends[side]
            near[side] = min(inner * STRIDE, end) if side > 0 else max(inner / STRIDE, end)
            if (values(near[side]) > 0.0) != (values(inner) > 0.0):
                low, high = sorted((inner, near[side]))
                return float(scipy.optimize.brentq(values, low, high, rtol=ACCURACY))
    return None


class CoupledStage:
    """Solves coupled stages for one set of sensors; see `livepde.laws.coupled.equation`.

    `carries`: True if each stage corrects the residual of the previous stage.
    """

    def __init__(self, terms: StageTerms, newton: Newton) -> None:
        self.terms = terms
        self.solver = BlockSolver.of(terms) or BilinearSolver.of(terms) or MonolithicSolver(terms)
        # The metric of the information uses the residual of a stage, which therefore must not be
        # carried over to the next stage.
        learns = terms.memory is not None
        least = 0.0 if learns else self.solver.ceiling
        self.newton = replace(newton, ceiling=max(newton.ceiling, least))
        self.carries = newton.share > 0.0 and not learns
        # The last factor and its linearisation point. Copies of an identifier may share it between
        # threads: the pair is read once and replaced as a whole; a recomputed factor is identical.
        self._last: tuple[Array, Factor] | None = None

    def solve(
        self,
        problem: StageProblem,
        start: Callable[[], Array],
        predicted: Array | None = None,
        kept: KeptFactor | None = None,
    ) -> tuple[StageIterate, KeptFactor]:
        """Return the solution and the record of the factor to keep; raises `StepFailed`."""
        solver, kept = self.solver, kept or KeptFactor.none()
        data = solver.data(problem)
        near = None
        if predicted is not None:
            y, factor = self._imposed(predicted, problem.moment), self._factor(kept, problem)
            near = Near(y, factor, solver.refresh)
        equation = _CoupledEquation(solver, data)

        def begin() -> Array:
            return self._imposed(start(), problem.moment)

        try:
            solved = self.newton.solve(equation, begin, near)
        except StepFailed:
            if data.problem.metric.theta is not None:
                raise
            solved = self._by_theta(equation, begin())
        return solved.at, self._kept(kept, data, solved)

    def _by_theta(self, equation: _CoupledEquation, start: Array) -> Solution[StageIterate]:
        """Return the solution whose theta is nearest to its initial value; raises `StepFailed`.

        For fixed theta a stage is nearly linear, so theta is computed as the root of a scalar
        function. Known bounds enclose a root: a damping rule is continuous, positive without any
        pull, and bounded, for a constant mu by mu/(floor ||u_alpha||_V~).
        """
        data, newton = equation.data, replace(self.newton, share=0.0)
        y = start

        def gap(theta: float) -> float:
            nonlocal y
            metric = replace(data.problem.metric, theta=theta)
            fixed = replace(data, problem=replace(data.problem, metric=metric))
            at = newton.solve(_CoupledEquation(self.solver, fixed), y).at
            y = at.y
            return self.terms.damped(data, at.norms) - theta

        first, ends = equation.evaluate(start).theta, self.terms.bracket(data)
        root = nearest_root(gap, first, *ends)
        if root is None:
            raise StepFailed("not_converged", "no weight theta of the damping solves the stage")
        gap(root)
        return newton.solve(equation, y, Near(y))

    def _imposed(self, y: Array, moment: Moment) -> Array:
        n, model = self.terms.n, self.terms.forms.model
        imposed = y.copy()
        imposed[:n] = model.impose(y[:n], moment)
        return imposed

    def _factor(self, kept: KeptFactor, problem: StageProblem) -> Factor | None:
        """Return the cached factor, recomputed if it was replaced; None if the step has changed."""
        if not len(kept.y) or abs(kept.h - problem.h) > SAME * problem.h:
            return None
        last = self._last
        if last is not None and last[0] is kept.y:
            return last[1]
        information = kept.information if len(kept.information) else None
        theta = None if math.isnan(kept.theta) else kept.theta
        metric = Metric(kept.weight, kept.sigma, None, information, theta)
        n = self.terms.n
        w = kept.u_alpha.copy()
        fixed = self.terms.forms.model.X.fixed
        # Dirichlet values at the linearisation point, not at this moment.
        w[fixed] = kept.y[:n][fixed]
        linearised = StageProblem(kept.y, kept.h, problem.moment, kept.u_alpha, metric)
        data = self.solver.data(linearised, w)
        at = self.solver.evaluate(data, kept.y)
        factor = self.solver.kept(self.solver.factor(data, at))
        self._last = (kept.y, factor)
        return factor

    def _kept(
        self, kept: KeptFactor, data: StageData, solved: Solution[StageIterate]
    ) -> KeptFactor:
        """Return the record of the factor to keep after a stage."""
        if not self.solver.keeps:
            return kept
        if solved.made is not None:
            at, factor = solved.made
            self._last = (at.y, self.solver.kept(factor))
            return KeptFactor.of(data, at.y)
        if solved.updates <= 1:
            return kept
        spent = kept.spent + solved.updates - 1
        return KeptFactor.none() if spent > self.solver.patience else replace(kept, spent=spent)
