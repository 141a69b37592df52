"""What `livepde bench control` prints: tables, and the promises with their bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from livepde.bench.control.battery import battery
from livepde.bench.control.compare import FIXED, HORIZON, LEARNED, TRUE, Comparison, compare
from livepde.bench.control.horizon import Setting
from livepde.bench.control.problem import Problem
from livepde.bench.control.rod import rod
from livepde.bench.control.wall import wall
from livepde.errors import ConfigurationError
from livepde.linalg import Array
from livepde.runs.outcome import Check, Outcome

__all__ = ["PROBLEMS", "control"]

OF_TRUE = 1.10  # cost over that of the true model, after the jump has been learned
OF_FIXED = 0.70  # cost over that of the wrong fixed model, then
WORST = 1.05  # total cost over that of the wrong fixed model, in any seed
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
    checks
        What is promised of it.
    linear
        Whether `LQ` is run besides: it knows no limits.
    """

    make: Callable[[int], Problem]
    settings: Sequence[Setting]
    quantities: Sequence[str]
    checks: Callable[[Comparison], list[Check]]
    linear: bool = True

    def compare(self, seeds: int, progress: bool) -> Comparison:
        """Return its runs."""
        return compare(self.make, seeds, self.settings, linear=self.linear, progress=progress)


def control(
    only: Sequence[str] | None = None, seeds: int = 5, *, progress: bool = False
) -> Outcome:
    """Compare true model, wrong fixed model, livepde and do-mpc's moving horizon in the loop.

    Parameters
    ----------
    only
        Names of problems; default all.
    seeds
        How many of each.
    progress
        Show a bar.

    Raises
    ------
    ConfigurationError
        do-mpc is not installed.
    """
    if find_spec("do_mpc") is None:
        raise ConfigurationError(
            "bench control needs do-mpc, which is not installed: pip install 'livepde[control]'."
        )
    found = {name: PROBLEMS[name].compare(seeds, progress) for name in only or PROBLEMS}
    return Outcome(
        tables=[comparison.table() for comparison in found.values()],
        checks=[check for name in found for check in PROBLEMS[name].checks(found[name])],
        notes=[
            "cost, least, largest: over the seeds, with what violations cost. learned: from 10 "
            "samples after livepde's alarm on, or where nothing jumps from the first trusted "
            "sample on; over true: that cost over the true model's. violations: samples of all "
            "seeds; learning: those while livepde learned. estimator, sample: processor time of a "
            "sample over livepde's, of the estimator and of all. The moving horizon has the "
            "setting that did best, with the truth, on the first seed."
        ],
        figures={
            name: lambda name=name: found[name].figure(PROBLEMS[name].quantities)  # type: ignore[misc]
            for name in found
        },
    )


def promises(comparison: Comparison) -> list[Check]:
    """Return the checks of the rod under model predictive control, and of the other controller."""
    found = []
    for controller in dict.fromkeys(controller for controller, _ in comparison.rows):

        def late(row: str, paid: bool = True, controller: str = controller) -> float:
            return float(comparison.costs(controller, row, late=True, paid=paid).mean())

        what, mine = f"rod, {controller}", comparison.costs(controller, LEARNED)
        wrong = comparison.costs(controller, FIXED)
        found += [
            Check(
                f"{what}: learned cost over true model's", late(LEARNED) / late(TRUE), OF_TRUE, "<="
            ),
            Check(
                f"{what}: learned cost over wrong model's",
                late(LEARNED) / late(FIXED),
                OF_FIXED,
                "<=",
            ),
            Check(
                f"{what}: the same without penalties",
                late(LEARNED, paid=False) / late(FIXED, paid=False),
                OF_FIXED,
                "<=",
            ),
            Check(
                f"{what}: total cost over wrong model's, worst seed",
                float((mine / wrong).max()),
                WORST,
                "<=",
            ),
        ]
    allowed = comparison.violations("MPC", TRUE)
    allowed += comparison.violations("MPC", LEARNED, learning=True)
    found.append(
        Check("rod, MPC: violations", comparison.violations("MPC", LEARNED), allowed, "<=")
    )
    if comparison.setting is not None:
        ratio = comparison.seconds("MPC", HORIZON) / comparison.seconds("MPC", LEARNED)
        costs = [float(comparison.costs("MPC", row).mean()) for row in (LEARNED, HORIZON)]
        found += [
            Check("rod: times cheaper than the moving horizon", ratio, CHEAPER, ">="),
            Check("rod: cost over that with the moving horizon", costs[0] / costs[1], 1.0, "<="),
        ]
    return found


def bounded(comparison: Comparison) -> list[Check]:
    """Return the checks of a process whose outputs have limits, which only `MPC` knows."""
    what = f"{comparison.problems[0].name}, MPC"

    def late(row: str) -> float:
        return float(comparison.costs("MPC", row, late=True).mean())

    def costs(row: str) -> Array:
        return comparison.costs("MPC", row)

    allowed = comparison.violations("MPC", TRUE)
    allowed += comparison.violations("MPC", LEARNED, learning=True)
    worst = float((costs(LEARNED) / costs(FIXED)).max())
    found = [
        Check(f"{what}: learned cost over true model's", late(LEARNED) / late(TRUE), OF_TRUE, "<="),
        Check(f"{what}: total cost over wrong model's, worst seed", worst, WORST, "<="),
        Check(f"{what}: violations", comparison.violations("MPC", LEARNED), allowed, "<="),
    ]
    if comparison.setting is not None:
        ratio = comparison.seconds("MPC", HORIZON) / comparison.seconds("MPC", LEARNED)
        cost = float(costs(LEARNED).mean() / costs(HORIZON).mean())
        found += [
            Check(f"{what}: times cheaper than the moving horizon", ratio, CHEAPER, ">="),
            Check(f"{what}: cost over that with the moving horizon", cost, 1.0, "<="),
        ]
    return found


PROBLEMS: Mapping[str, Contest] = {
    "rod": Contest(
        rod,
        [Setting(10, 1.0, 1.0), Setting(20, 1.0, 0.1), Setting(20, 1.0, 0.01)],
        ["tip", "face", "heater", "k"],
        promises,
    ),
    "wall": Contest(
        wall,
        [Setting(24, 1.0, 1.0), Setting(48, 1.0, 10.0), Setting(24, 1.0, 0.1)],
        ["air", "heater", "k[masonry]", "k[insulation]"],
        bounded,
        linear=False,
    ),
    "battery": Contest(
        battery,
        [Setting(16, 1.0, 1.0), Setting(30, 1.0, 0.1), Setting(30, 0.1, 1.0)],
        ["mean", "surface", "I", "D"],
        bounded,
        linear=False,
    ),
}
