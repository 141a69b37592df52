"""What `python -m benchmarks control` prints: tables, and the promises with their bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.control.battery import battery
from benchmarks.control.compare import FIXED, LEARNED, TRUE, Comparison, compare
from benchmarks.control.horizon import Setting
from benchmarks.control.problem import Problem
from benchmarks.control.rod import rod
from benchmarks.control.wall import wall
from livepde.diagnostics.check_report import Check
from livepde.errors import ConfigurationError
from livepde.linalg import Array
from livepde.runs import Outcome

OF_TRUE = 1.10  # cost over that of the true model, after the jump has been learned
OF_FIXED = 0.70  # cost over that of the wrong fixed model, then
WORST = 1.05  # total cost over that of the wrong fixed model, in any seed
SHORT = 0.6  # share of the samples in a short run: the rod's jump is at 0.42
CHEAPER = 20.0  # times less processor time than the moving horizon takes for a sample


@dataclass(frozen=True)
class Contest:
    """A problem of the benchmark.

    Attributes
    ----------
    make
        Seed -> problem.
    settings
        Of the moving horizon.
    quantities
        What its figure shows.
    linear
        Whether `LQ` is run besides: it knows no limits.
    shown
        Which seed its figure shows, if there are so many.
    """

    make: Callable[[int], Problem]
    settings: Sequence[Setting]
    quantities: Sequence[str]
    linear: bool = True
    shown: int = 0

    def compare(self, seeds: int, short: bool, progress: bool) -> Comparison:
        """Return its runs, or short ones, and the moving horizon with its first setting only."""
        settings = self.settings[:1] if short else self.settings
        make = self._short if short else self.make
        return compare(make, seeds, settings, linear=self.linear, progress=progress)

    def _short(self, seed: int) -> Problem:
        problem = self.make(seed)
        return replace(problem, samples=round(SHORT * problem.samples))

    def figure(self, comparison: Comparison) -> Any:
        """Draw the runs of one seed."""
        return comparison.figure(self.quantities, min(self.shown, len(comparison.problems) - 1))


def control(
    only: Sequence[str] | None = None,
    seeds: int = 5,
    *,
    short: bool = False,
    progress: bool = False,
) -> Outcome:
    """Compare true model, wrong fixed model, livepde and do-mpc's moving horizon in the loop.

    Parameters
    ----------
    only
        Names of problems; default all.
    seeds
        How many of each.
    short
        Shorter runs, and the moving horizon with its first setting only, on the reduced model.
    progress
        Show a bar.

    Raises
    ------
    ConfigurationError
        do-mpc is not installed.
    """
    if find_spec("do_mpc") is None:
        raise ConfigurationError(
            "benchmark control: do-mpc is not installed: pip install 'livepde[control]'."
        )
    found = {name: PROBLEMS[name].compare(seeds, short, progress) for name in only or PROBLEMS}
    return Outcome(
        tables=[comparison.table() for comparison in found.values()],
        checks=[check for name in found for check in promises(found[name])],
        notes=[
            "cost, least, largest: over the seeds; for MPC with what violations cost, LQ does not "
            "know limits. learned: the cost from 10 samples after livepde's alarm on, or where "
            "nothing jumps from the first trusted sample on; over true: that over the true "
            "model's. violations: samples of all seeds; learning: those while livepde learned. "
            "estimator, sample: processor time of a sample over livepde's, of the estimator and "
            "of all, median of the seeds. do-mpc's moving horizon estimates all coefficients of "
            "the finite elements, as livepde does, or those of livepde's reduced model; it has "
            "the setting that did best, with the truth, on the first seed."
        ],
        figures={
            name: partial(PROBLEMS[name].figure, comparison) for name, comparison in found.items()
        },
    )


def promises(comparison: Comparison) -> list[Check]:
    """Return the checks of a problem; `LQ` does not know limits and is not charged for them."""
    found, problem = [], comparison.problems[0]
    for controller in dict.fromkeys(controller for controller, _ in comparison.rows):
        what = f"{problem.name}, {controller}"

        def over(
            row: str, late: bool, paid: bool | None = None, controller: str = controller
        ) -> Array:
            mine, others = (
                comparison.costs(controller, name, late=late, paid=paid) for name in (LEARNED, row)
            )
            return np.array([mine.mean() / others.mean(), (mine / others).max()])

        true, total = over(TRUE, True)[0], over(FIXED, False)[1]
        found += [
            Check(f"{what}: learned cost over true model's", true, OF_TRUE, "<="),
            Check(f"{what}: total cost over wrong model's, worst seed", total, WORST, "<="),
        ]
        if not math.isnan(problem.jump):
            name, fixed = f"{what}: learned cost over wrong model's", over(FIXED, True)[0]
            found.append(Check(name, fixed, OF_FIXED, "<="))
            if controller == "MPC":
                plain = over(FIXED, True, False)[0]
                found.append(Check(f"{name}, without penalties", plain, OF_FIXED, "<="))
    allowed = comparison.violations("MPC", TRUE)
    allowed += comparison.violations("MPC", LEARNED, learning=True)
    violations = comparison.violations("MPC", LEARNED)
    found.append(Check(f"{problem.name}, MPC: violations", violations, allowed, "<="))
    for row in comparison.settings:
        cost = comparison.costs("MPC", LEARNED).mean() / comparison.costs("MPC", row).mean()
        what = f"{problem.name}, {row}"
        ratio = comparison.times("MPC", row)
        found += [
            Check(f"{what}: its processor time over livepde's", ratio, CHEAPER, ">="),
            Check(f"{what}: livepde's cost over that with it", float(cost), 1.0, "<="),
        ]
    return found


def both(*settings: Setting) -> list[Setting]:
    """Return settings of the moving horizon on the reduced and on the full model."""
    return [replace(setting, full=full) for full in (False, True) for setting in settings]


PROBLEMS: Mapping[str, Contest] = {
    "rod": Contest(
        rod,
        both(Setting(10, 1.0, 1.0), Setting(10, 10.0, 1.0), Setting(20, 10.0, 1.0)),
        ["tip", "face", "heater", "k"],
    ),
    "wall": Contest(
        wall,
        both(Setting(24, 1.0, 1.0), Setting(48, 1.0, 10.0)),
        ["air", "heater", "k[masonry]", "k[insulation]"],
        linear=False,
        shown=1,  # the first one has nearly the wall that is believed in
    ),
    "battery": Contest(
        battery,
        both(Setting(16, 1.0, 1.0), Setting(30, 1.0, 1.0)),
        ["mean", "surface", "I", "D"],
        linear=False,
    ),
}
