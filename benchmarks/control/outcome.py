"""Tables and checks of `python -m benchmarks control`."""

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

OF_TRUE = 1.10  # largest cost relative to the true model, after the jump has been learned
OF_FIXED = 0.70  # largest cost relative to the wrong fixed model, after the jump has been learned
WORST = 1.05  # largest total cost of any seed, relative to the wrong fixed model
SHORT = 0.6  # share of the samples in a short run; the rod's jump is at 0.42
CHEAPER = 20.0  # smallest processor time of the moving horizon relative to livepde


@dataclass(frozen=True)
class Contest:
    """Problem with the options of its comparison.

    Attributes
    ----------
    make
        Seed -> problem.
    settings
        Settings of the moving horizons.
    quantities
        Quantities in the figure.
    linear
        Whether to run `LQ`, too, which ignores limits.
    shown
        Seed of the figure; the last seed if there are fewer.
    """

    make: Callable[[int], Problem]
    settings: Sequence[Setting]
    quantities: Sequence[str]
    linear: bool = True
    shown: int = 0

    def compare(self, seeds: int, short: bool, progress: bool) -> Comparison:
        """Run the comparison; `short` uses fewer samples and only the first setting."""
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
    """Compare control by true model, wrong fixed model, livepde and do-mpc's moving horizon.

    Parameters
    ----------
    only
        Names of problems; default all.
    seeds
        Number of seeds of each problem.
    short
        Shorter runs, and only the first setting of the moving horizon, on the reduced model.
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
    runs = {name: PROBLEMS[name].compare(seeds, short, progress) for name in only or PROBLEMS}
    return Outcome(
        tables=[comparison.table() for comparison in runs.values()],
        checks=[check for name in runs for check in promises(runs[name])],
        notes=[
            "cost, least, largest: mean, minimum and maximum over seeds, for MPC with penalties of "
            "violations (LQ has no limits). learned: cost after livepde has learned, 10 samples "
            "after its alarm, or without a jump from the first trusted sample on; over true: "
            "this cost relative to the true model. violations: samples of all seeds; learning: "
            "violations while livepde learns. estimator, sample: processor time relative to "
            "livepde, median over seeds. do-mpc's moving horizon estimates all finite element "
            "coefficients or the state of livepde's reduced model, with the setting that has the "
            "least cost on the first seed."
        ],
        figures={
            name: partial(PROBLEMS[name].figure, comparison) for name, comparison in runs.items()
        },
    )


def promises(comparison: Comparison) -> list[Check]:
    """Return the checks of a problem; costs of `LQ` exclude violations, since it has no limits."""
    checks, problem = [], comparison.problems[0]
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
        checks += [
            Check(f"{what}: learned cost over true model's", true, OF_TRUE, "<="),
            Check(f"{what}: total cost over wrong model's, worst seed", total, WORST, "<="),
        ]
        if not math.isnan(problem.jump):
            name, fixed = f"{what}: learned cost over wrong model's", over(FIXED, True)[0]
            checks.append(Check(name, fixed, OF_FIXED, "<="))
            if controller == "MPC":
                plain = over(FIXED, True, False)[0]
                checks.append(Check(f"{name}, without penalties", plain, OF_FIXED, "<="))
    allowed = comparison.violations("MPC", TRUE)
    allowed += comparison.violations("MPC", LEARNED, learning=True)
    violations = comparison.violations("MPC", LEARNED)
    checks.append(Check(f"{problem.name}, MPC: violations", violations, allowed, "<="))
    for row in comparison.settings:
        cost = comparison.costs("MPC", LEARNED).mean() / comparison.costs("MPC", row).mean()
        what = f"{problem.name}, {row}"
        ratio = comparison.times("MPC", row)
        checks += [
            Check(f"{what}: its processor time over livepde's", ratio, CHEAPER, ">="),
            Check(f"{what}: livepde's cost over that with it", float(cost), 1.0, "<="),
        ]
    return checks


def both(*settings: Setting) -> list[Setting]:
    """Return settings of the moving horizon for the reduced and for the full model."""
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
        shown=1,  # the wall of seed 0 is almost equal to the prior
    ),
    "battery": Contest(
        battery,
        both(Setting(16, 1.0, 1.0), Setting(30, 1.0, 1.0)),
        ["mean", "surface", "I", "D"],
        linear=False,
    ),
}
