"""The implicit stage of the paper's method, u and q in one system: solver and warm start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy  # scipy.optimize is slow to load, and rarely needed

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

STRIDE = 1.5  # factor between two values of theta that are tried
SAME = 1e-9  # of a step: steps that are the same but for rounding
ACCURACY = 1e-8  # relative, of theta: Newton goes on from there


@dataclass(frozen=True, eq=False)
class KeptFactor:
    """Where a factor was made: where it is gone, as after a restart, the same is made again."""

    # Point, data and step of its Jacobian, shapes (n + m,) and (n,); empty if none is kept.
    y: Array
    u_alpha: Array
    h: float
    # Of its metric; `information` is empty and `theta` NaN without one.
    weight: float
    sigma: float
    information: Array
    theta: float
    spent: int  # updates that stages took since then, beyond one each

    @classmethod
    def none(cls) -> KeptFactor:
        return cls(np.zeros(0), np.zeros(0), 0.0, 0.0, 0.0, np.zeros(0), math.nan, 0)

    @classmethod
    def of(cls, data: StageData, y: Array) -> KeptFactor:
        """Return the value for a factor made at a point y of a stage."""
        problem, metric = data.problem, data.problem.metric
        information = np.zeros(0) if metric.information is None else metric.information
        theta = math.nan if metric.theta is None else metric.theta
        made = y, problem.u_alpha, problem.h
        return cls(*made, metric.weight, metric.sigma, information, theta, 0)


@dataclass(frozen=True, eq=False)
class _CoupledEquation:
    """The equation of one stage, as `Newton` sees it."""

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
    """Return the root of a function of a positive number that is nearest to a start, or None."""
    # Each value is asked for once: that of a stage depends on where its iteration began.
    values = cache(function)
    start = min(max(start, least), most)
    first = values(start)
    if first == 0.0:
        return start
    # Where theta is too small a root lies above it.
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

    `carries`: True if each stage makes up for the remaining residual of the one before.
    """

    def __init__(self, terms: StageTerms, newton: Newton) -> None:
        self.terms = terms
        self.solver = BlockSolver.of(terms) or BilinearSolver.of(terms) or MonolithicSolver(terms)
        # The metric of the information learns from the residual of a stage, which therefore must
        # not be carried over to the next one.
        learns = terms.memory is not None
        least = 0.0 if learns else self.solver.ceiling
        self.newton = replace(newton, ceiling=max(newton.ceiling, least))
        self.carries = newton.share > 0.0 and not learns
        # The last factor and where it was made. Copies of an identifier share it, maybe in threads:
        # the pair is read once and replaced as a whole, and a factor made again is the same.
        self._last: tuple[Array, Factor] | None = None

    def solve(
        self,
        problem: StageProblem,
        start: Callable[[], Array],
        predicted: Array | None = None,
        kept: KeptFactor | None = None,
    ) -> tuple[StageIterate, KeptFactor]:
        """Return the solution of one stage, and the factor to keep; raises `StepFailed`."""
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
        """Return the solution whose theta is nearest to that of the start; raises `StepFailed`.

        Where theta is given the stage is all but linear. So theta is found as the root of one
        scalar function. It has a root between ends that are known beforehand: a rule is continuous,
        positive without any pull, and bounded, by mu/(floor ||u_alpha||_V~) for a constant mu.
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
        """Return the factor that is kept, made again if the last one is another."""
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
        # Dirichlet values of the stage that the factor is of, not those of this moment.
        w[fixed] = kept.y[:n][fixed]
        made = StageProblem(kept.y, kept.h, problem.moment, kept.u_alpha, metric)
        data = self.solver.data(made, w)
        at = self.solver.evaluate(data, kept.y)
        factor = self.solver.kept(self.solver.factor(data, at))
        self._last = (kept.y, factor)
        return factor

    def _kept(
        self, kept: KeptFactor, data: StageData, solved: Solution[StageIterate]
    ) -> KeptFactor:
        """Return the cached factor to keep after a stage."""
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
