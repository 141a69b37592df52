"""Four runs of a problem on the same disturbances and seeds, and what is made of them."""

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
from benchmarks.control.runs import Run, closed_loop, learned, nominal, offset_free, told
from livepde import plots
from livepde.control import LQ, MPC, Controller, Estimator
from livepde.diagnostics.check_report import Table
from livepde.linalg import Array
from livepde.progress import watched

TRUE = "true model"
FIXED = "wrong fixed model"
OFFSET = "wrong fixed model, offset-free"
LEARNED = "livepde"
HORIZONS = {False: "moving horizon, reduced model", True: "moving horizon, full model"}  # do-mpc's
ROWS: Mapping[str, Callable[[Problem], Estimator]] = {
    TRUE: told,
    FIXED: nominal,
    OFFSET: offset_free,
    LEARNED: learned,
}
CONTROLLERS: Mapping[str, Callable[[Problem], Controller]] = {
    "MPC": lambda p: MPC(p.reduced, p.goal, p.period, p.horizon),
    "LQ": lambda p: LQ(p.reduced, p.goal, p.period),
}
BoolArray: TypeAlias = NDArray[np.bool_]

LEARNING = 10  # samples after the alarm that still count as learning


@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs of one problem.

    Attributes
    ----------
    problems
        One for each seed.
    runs
        (controller, row) -> a run for each seed.
    settings
        Row of a moving horizon -> its setting, that which did best on the first seed.
    """

    problems: Sequence[Problem]
    runs: Mapping[tuple[str, str], Sequence[Run]]
    settings: Mapping[str, Setting]

    @property
    def rows(self) -> list[tuple[str, str]]:
        """All (controller, row)."""
        return list(self.runs)

    def learned_at(self, seed: int, controller: str = "MPC") -> float:
        """Return until when livepde learns after the jump: `LEARNING` samples from its alarm on.

        A rule that does not look at the result. Without a jump: what the problem says, or the first
        sample at which the estimate was trusted; infinite where there is none, or no alarm.
        """
        problem, run = self.problems[seed], self.runs[controller, LEARNED][seed]
        if not math.isnan(problem.settled):
            return problem.settled
        if math.isnan(problem.jump):
            found = run.t[run.trusted]
            return float(found[0]) if len(found) else math.inf
        found = run.t[np.logical_and(run.alarms, run.t > problem.jump)]
        return float(found[0]) + LEARNING * problem.period if len(found) else math.inf

    def learning(self, seed: int, controller: str = "MPC") -> BoolArray:
        """Return which samples of a seed count as learning: at the start, and after the jump."""
        problem, run = self.problems[seed], self.runs[controller, LEARNED][seed]
        if not math.isnan(problem.settled):
            return np.asarray(run.t <= problem.settled)
        trusted = run.t[run.trusted]
        first = float(trusted[0]) if len(trusted) else math.inf
        found: BoolArray = np.asarray(run.t <= first)
        if not math.isnan(problem.jump):
            found = found | (run.t > problem.jump) & (run.t <= self.learned_at(seed, controller))
        return found

    def costs(
        self, controller: str, row: str, *, late: bool = False, paid: bool | None = None
    ) -> Array:
        """Return the cost of each seed.

        Parameters
        ----------
        late
            Only after livepde has learned the jump.
        paid
            With what violations cost; default for `MPC`, as `LQ` does not know limits.
        """
        charged = controller == "MPC" if paid is None else paid
        found = []
        for k, run in enumerate(self.runs[controller, row]):
            since = self.learned_at(k, controller) if late else -math.inf
            found.append(run.cost(self.problems[k], since, paid=charged))
        return np.array(found)

    def violations(self, controller: str, row: str, *, learning: bool | None = None) -> int:
        """Return at how many samples of all seeds a limit was violated.

        Parameters
        ----------
        learning
            Only while livepde learns, or only while it does not.
        """
        total = 0
        for k, (problem, run) in enumerate(
            zip(self.problems, self.runs[controller, row], strict=True)
        ):
            found = run.violations(problem, problem.tolerance)
            if learning is not None:
                found &= self.learning(k, controller) == learning
            total += int(found.sum())
        return total

    def times(self, controller: str, row: str, *, whole: bool = False) -> float:
        """Return the processor time of a sample over livepde's: the median of the seeds' ratios.

        Parameters
        ----------
        whole
            Of all, not of the estimator alone.
        """
        both = zip(self.runs[controller, row], self.runs[controller, LEARNED], strict=True)
        pairs = [
            (one.whole, mine.whole) if whole else (one.estimating, mine.estimating)
            for one, mine in both
        ]
        return float(np.median([one.mean() / mine.mean() for one, mine in pairs]))

    def table(self) -> Table:
        """Return cost, violations and time of every row."""
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
        How many.
    settings
        Of the moving horizon, on the reduced model and on the full one; of each the one with the
        least cost on the first seed is taken for all, which favours it. Empty: it is not run.
    linear
        Whether to run `LQ` besides, without the moving horizon.
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
    for name, found in tried.items():
        best[name] = min(found, key=lambda pair: pair[0])[1]
        rows[name] = partial(MovingHorizon, setting=best[name])
    # Those of a seed right after each other: their times are compared.
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
