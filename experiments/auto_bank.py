"""`AutoLaw` against the best of a grid of hand-set sensitivity laws, chosen by the truth.

The grid has the drift, the noise level (a third of the right one, the right one, three times it)
and replay where nothing drifts. The law that tunes itself is told the right noise level, three
times it, or none. The viscosity that wanders is not said to: its evolution is taken out of the
model. Of the constant unknowns the fit of all data with hindsight is printed as well. Medians over
seeds; the share of 95 % intervals that hold the truth; processor time over that of the plain law.

    python -m experiments.auto_bank [--quick] [problem ...]

--quick: one seed, 1 and 10 % noise, the right noise level and three drifts in the grid.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from itertools import product
from time import process_time

import numpy as np

import livepde as lp
from benchmarks.accuracy import run_law
from benchmarks.offline import fit
from benchmarks.problems import PROBLEMS, Data, Problem
from benchmarks.problems.flow import SIDES
from benchmarks.scoring import Judge
from livepde.models import burgers

DRIFTS = (0.0, 0.01, 0.1, 1.0, 10.0)  # prior variances gained in the whole run
FACTORS = (1 / 3, 1.0, 3.0)  # of the noise level
NAMES = ("seed", "seed-excited", "burgers-varying", "heat2d", "wall")


@dataclass(frozen=True)
class Tried:
    """Relative error of the parameter, coverage, processor time."""

    error: float
    covered: float
    seconds: float


def data_of(problem: Problem, level: float, seed: int) -> Data:
    """Return a data set whose model says of no unknown that it moves."""
    data = problem.data(level, seed)
    if problem.name != "burgers-varying":
        return data
    unknown = lp.LogNormal(0.1, 0.05)
    model = burgers(lp.interval(0.0, 1.0, 32), unknown, dirichlet=SIDES)
    return replace(data, process=replace(data.process, model=model))


def try_out(data: Data, law: lp.laws.AnyLaw, noise: float | None = 1.0) -> Tried:
    """Run a law that is told a multiple of the noise level, or nothing."""
    told = None if noise is None else (noise * data.noise).tolist()
    start = process_time()
    try:
        score = run_law(data, replace(data.observation, noise=told), law)
    except (lp.LivepdeError, np.linalg.LinAlgError, FloatingPointError):
        return Tried(np.inf, 0.0, process_time() - start)
    error = score.error if np.isfinite(score.error) else np.inf
    return Tried(error, score.covered, process_time() - start)


def offline(data: Data) -> float:
    """Return the error of the fit of all data."""
    found, judge = fit(data), Judge(data)
    return judge.judged((k, found.q[k], None) for k in judge.scored)[0]


def main() -> None:
    quick = "--quick" in sys.argv
    names = [name for name in sys.argv[1:] if not name.startswith("-")] or list(NAMES)
    levels, seeds = ((0.01, 0.1), 1) if quick else ((0.0, 0.01, 0.05, 0.1), 3)
    drifts, factors = (DRIFTS[::2], FACTORS[1:2]) if quick else (DRIFTS, FACTORS)
    print(
        f"{'problem':<17}{'noise':>6}{'auto':>9}{'covered':>9}{'x 3':>9}{'untold':>9}"
        f"{'best':>9}{'drift':>7}{'noise x':>8}{'ratio':>7}{'offline':>9}{'ratio':>7}{'time':>6}"
    )
    for name, level in product(names, levels):
        problem = PROBLEMS[name]
        auto: dict[float | None, list[Tried]] = {1.0: [], 3.0: [], None: []}
        hand: dict[tuple[float, float], list[Tried]] = {}
        limits = []
        for seed in range(seeds):
            data = data_of(problem, level, seed)
            times, space = data.process.times, data.process.model.parameter_space
            modes = dict.fromkeys(space.fields, problem.modes)
            for noise, tried in auto.items():
                tried.append(try_out(data, lp.AutoLaw(modes), noise))
            for drift, noise in product(drifts, factors):
                replay, rate = None if drift else lp.Replay(), drift / float(np.ptp(times))
                law = lp.SensitivityLaw(modes, drift=rate, replay=replay)
                hand.setdefault((drift, noise), []).append(try_out(data, law, noise))
            if not problem.varying:
                limits.append(offline(data))
        errors = {key: float(np.median([t.error for t in tried])) for key, tried in hand.items()}
        best = min(errors, key=lambda key: errors[key])
        mine, tripled, untold = (float(np.median([t.error for t in x])) for x in auto.values())
        covered = float(np.mean([t.covered for t in auto[1.0]]))
        cost = sum(t.seconds for t in auto[1.0]) / sum(t.seconds for t in hand[0.0, 1.0])
        limit = float(np.median(limits)) if limits else np.nan
        print(
            f"{name:<17}{level:6.0%}{mine:9.4f}{covered:9.2f}{tripled:9.4f}{untold:9.4f}"
            f"{errors[best]:9.4f}{best[0]:7g}{best[1]:8.2f}{mine / errors[best]:7.2f}"
            f"{limit:9.4f}{mine / limit:7.2f}{cost:6.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
