"""Comparison of estimators and controllers on a problem, with equal disturbances and seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.control.horizon import MovingHorizon, Setting
from benchmarks.control.problem import Problem
from benchmarks.control.runs import Run, closed_loop, informed, learned, nominal, offset_free
from livepde import plots
from livepde.control import LQ, MPC, Controller, Estimator
from livepde.diagnostics.check_report import Table
from livepde.linalg import Array
from livepde.progress import watched

TRUE = "true model"
FIXED = "wrong fixed model"
OFFSET = "wrong fixed model, offset-free"
LEARNED = "livepde"
HORIZONS = {False: "moving horizon, reduced model", True: "moving horizon, full model"}  # by do-mpc
ROWS: Mapping[str, Callable[[Problem], Estimator]] = {
    TRUE: informed,
    FIXED: nominal,
    OFFSET: offset_free,
    LEARNED: learned,
}
CONTROLLERS: Mapping[str, Callable[[Problem], Controller]] = {
    "MPC": lambda p: MPC(p.reduced, p.goal, p.period, p.horizon),
    "LQ": lambda p: LQ(p.reduced, p.goal, p.period),
}
BoolArray: TypeAlias = NDArray[np.bool_]

LEARNING = 10  # samples after the alarm that count as learning


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs of one problem.

    Attributes
    ----------
    problems
        The problem for each seed.
    runs
        (controller, row) -> a run for each seed.
    settings
        Row of a moving horizon -> its setting, which has the least cost on the first seed.
    """

    problems: Sequence[Problem]
    runs: Mapping[tuple[str, str], Sequence[Run]]
    settings: Mapping[str, Setting]

    @property
    def rows(self) -> list[tuple[str, str]]:
        """All pairs (controller, row)."""
        return list(self.runs)

    def learned_at(self, seed: int, controller: str = "MPC") -> float:
        """Return the time at which livepde has learned, `LEARNING` samples after its alarm.

        This rule does not depend on the errors of the run. Without a jump, the time is
        `Problem.settled` or the first trusted sample. Infinite without an alarm or such a sample.
        """
        problem, run = self.problems[seed], self.runs[controller, LEARNED][seed]
        if not math.isnan(problem.settled):
            return problem.settled
        if math.isnan(problem.jump):
            trusted = run.t[run.trusted]
            return float(trusted[0]) if len(trusted) else math.inf
        alarms = run.t[np.logical_and(run.alarms, run.t > problem.jump)]
        return float(alarms[0]) + LEARNING * problem.period if len(alarms) else math.inf

    def learning(self, seed: int, controller: str = "MPC") -> BoolArray:
        """Return which samples of a seed count as learning: at the start, and after the jump."""
        problem, run = self.problems[seed], self.runs[controller, LEARNED][seed]
        if not math.isnan(problem.settled):
            return np.asarray(run.t <= problem.settled)
        trusted = run.t[run.trusted]
        first = float(trusted[0]) if len(trusted) else math.inf
        learning: BoolArray = np.asarray(run.t <= first)
        if not math.isnan(problem.jump):
            learning |= (run.t > problem.jump) & (run.t <= self.learned_at(seed, controller))
        return learning

    def costs(
        self, controller: str, row: str, *, late: bool = False, paid: bool | None = None
    ) -> Array:
        """Return the cost of each seed.

        Parameters
        ----------
        late
            Include only samples after livepde has learned the jump.
        paid
            Include penalties of violations; default only for `MPC`, since `LQ` has no limits.
        """
        charged = controller == "MPC" if paid is None else paid
        costs = []
        for k, run in enumerate(self.runs[controller, row]):
            since = self.learned_at(k, controller) if late else -math.inf
            costs.append(run.cost(self.problems[k], since, paid=charged))
        return np.array(costs)

    def violations(self, controller: str, row: str, *, learning: bool | None = None) -> int:
        """Return the number of samples of all seeds at which a limit is violated.

        Parameters
        ----------
        learning
            Count only samples while livepde learns (True), or only the others (False).
        """
        total = 0
        for k, (problem, run) in enumerate(
            zip(self.problems, self.runs[controller, row], strict=True)
        ):
            violated = run.violations(problem, problem.tolerance)
            if learning is not None:
                violated &= self.learning(k, controller) == learning
            total += int(violated.sum())
        return total

    def times(self, controller: str, row: str, *, whole: bool = False) -> float:
        """Return the processor time of a sample over livepde's, as the median over seeds.

        Parameters
        ----------
        whole
            Time estimator and controller, not the estimator alone.
        """
        both = zip(self.runs[controller, row], self.runs[controller, LEARNED], strict=True)
        pairs = [
            (one.whole, mine.whole) if whole else (one.estimating, mine.estimating)
            for one, mine in both
        ]
        return float(np.median([one.mean() / mine.mean() for one, mine in pairs]))

    def table(self) -> Table:
        """Return a table with cost, violations and time of every row."""
        columns = ["controller", "model", "cost", "least", "largest", "learned"]
        columns += ["over true", "without penalties", "violations", "learning", "largest excess"]
        columns += ["estimator", "sample", "fallback", "failed"]
        rows = []
        for controller, row in self.rows:
            costs = self.costs(controller, row)
            late = self.costs(controller, row, late=True)
            best = self.costs(controller, TRUE, late=True)
            runs = self.runs[controller, row]
            beyond = [
                float(run.beyond(problem).max(initial=0.0))
                for problem, run in zip(self.problems, runs, strict=True)
            ]
            rows.append(
                [
                    controller,
                    row,
                    float(costs.mean()),
                    float(costs.min()),
                    float(costs.max()),
                    float(late.mean()),
                    float(late.mean() / best.mean()),
                    float(self.costs(controller, row, paid=False).mean()),
                    self.violations(controller, row),
                    self.violations(controller, row, learning=True),
                    max(beyond),
                    self.times(controller, row),
                    self.times(controller, row, whole=True),
                    f"{np.mean([1.0 - run.trusted.mean() for run in runs]):.1%}",
                    sum(run.failed for run in runs),
                ]
            )
        title = f"{self.problems[0].title}: {len(self.problems)} seeds"
        title += "".join(f"; {name}: {setting}" for name, setting in self.settings.items())
        return Table(title, columns, rows)

    def figure(self, quantities: Sequence[str], seed: int = 0) -> Any:
        """Draw the runs of one seed under model predictive control."""
        shown = [row for controller, row in self.rows if controller == "MPC" and row != OFFSET]
        runs = {row: self.runs["MPC", row][seed].to_xarray(self.problems[seed]) for row in shown}
        return plots.loops(runs, quantities, title=self.problems[seed].title)


def compare(
    make: Callable[[int], Problem],
    seeds: int,
    settings: Sequence[Setting] = (),
    *,
    linear: bool = True,
    progress: bool = False,
) -> Comparison:
    """Run a problem with every estimator and controller.

    Parameters
    ----------
    make
        Seed -> problem.
    seeds
        Number of seeds.
    settings
        Settings of the moving horizons on the reduced and on the full model. For each model, the
        setting with the least cost on the first seed is used for all seeds, which favours it.
    linear
        Whether to run `LQ`, too, without the moving horizons.
    progress
        Show a bar.
    """
    problems = [make(seed) for seed in range(seeds)]
    used = CONTROLLERS if linear else {"MPC": CONTROLLERS["MPC"]}
    controllers = {name: [of(problem) for problem in problems] for name, of in used.items()}
    runs: dict[tuple[str, str], list[Run]] = {}

    def run(controller: str, seed: int, estimator: Estimator) -> Run:
        return closed_loop(problems[seed], estimator, controllers[controller][seed], seed)

    best: dict[str, Setting] = {}
    rows: dict[str, Callable[[Problem], Estimator]] = dict(ROWS)
    tried: dict[str, list[tuple[float, Setting]]] = {}
    for setting in watched(settings, len(settings), "settings") if progress else settings:
        cost = run("MPC", 0, MovingHorizon(problems[0], setting)).cost(problems[0])
        tried.setdefault(HORIZONS[setting.full], []).append((cost, setting))
    for name, costs in tried.items():
        best[name] = min(costs, key=lambda pair: pair[0])[1]
        rows[name] = partial(MovingHorizon, setting=best[name])
    # All rows of a seed run consecutively, because their times are compared.
    jobs = [
        (controller, seed, row)
        for controller in used
        for seed in range(seeds)
        for row in (rows if controller == "MPC" else ROWS)
    ]
    for controller, seed, row in watched(jobs, len(jobs), "loops") if progress else jobs:
        done = run(controller, seed, rows[row](problems[seed]))
        runs.setdefault((controller, row), []).append(done)
    return Comparison(problems, runs, best)
