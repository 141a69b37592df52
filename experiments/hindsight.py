"""The grid search of section 4, which chooses gains by the true error of the observed state.

Minimises the integral of ||R u - R u*||_X^2 over c_1 with partial, exact data, and over constant mu
and nu with noisy data. Grids run from 0.1 to 1000 in decimal steps, as in the paper. Such a search
is impossible online. The objective rewards a state that is pulled to the data rather than a correct
q: with exact data it selects the largest c_1 of the grid, which gives the worst q.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.integrate import trapezoid

import livepde as lp
from experiments.failed_steps import FailedSteps
from livepde.observation import Discrepancy, Tikhonov
from livepde.reproduce import seed
from livepde.streams import RelativeNoise, Twin

GRID = (0.1, 1.0, 10.0, 100.0, 1000.0)


STEPS = FailedSteps()


@dataclass(frozen=True)
class Tried:
    """Grid point with its gains, objective and relative L2 error of q at the end."""

    gains: tuple[float, ...]
    objective: float
    error: float


def try_out(twin: Twin, law: lp.GradientLaw, gains: tuple[float, ...]) -> Tried:
    """Run a law at one grid point; the objective is infinite if a step failed."""
    X, R = twin.model.X, twin.observed.split().R
    identifier = lp.Identifier(twin.model, twin.observation, law, q0=0.0, u0=seed.start, halvings=0)
    squares = []
    for sample in twin:
        estimate = STEPS.seen(identifier.step(sample.t, sample.z))
        if not estimate.status.ok:
            return Tried(gains, np.inf, np.nan)
        squares.append(X.norm(R @ (estimate.u - twin.u(sample.t))) ** 2)
    return Tried(gains, float(trapezoid(squares, twin.times)), twin.error(estimate.q))


def partial(gain: float, samples: int = 101, steps: tuple[float, ...] = GRID) -> list[Tried]:
    """Evaluate each c_1 in the paper's first experiment."""
    twin = seed.twin_of(clamped=True, times=seed.TIMES[:samples])
    laws = {c1: lp.paper.law(gain, lp.laws.ResidualDamping(c1), seed.D) for c1 in steps}
    return [try_out(twin, law, (c1,)) for c1, law in laws.items()]


def noisy(
    level: float,
    gain: float,
    samples: int = 126,
    steps: tuple[float, ...] = GRID,
    smooth: bool = False,
) -> list[Tried]:
    """Evaluate each mu and nu in the paper's second experiment, with alpha = 0 or G_alpha in V~."""
    twin = seed.twin_of(clamped=True, times=0.6 * np.arange(samples), noise=RelativeNoise(level))
    if smooth:
        rule = Tikhonov("V", Discrepancy(level=level))
        twin = replace(twin, observation=replace(twin.observation, reconstruction=rule))
    tried = []
    for mu, nu in product(steps, steps):
        law = lp.paper.law(gain, lp.laws.ConstantDamping(mu), seed.D, nu)
        tried.append(try_out(twin, law, (mu, nu)))
    return tried


def best(tried: list[Tried]) -> Tried:
    """Return the grid point with the smallest objective."""
    return min(tried, key=lambda item: item.objective)


def show(title: str, names: tuple[str, ...], tried: list[Tried]) -> None:
    """Print the table of a search, with the smallest objective marked."""
    winner = best(tried)
    print(f"\n{title}")
    print("".join(f"{name:>9}" for name in names) + f"{'objective':>13}{'error of q':>12}")
    for item in tried:
        gains = "".join(f"{value:9g}" for value in item.gains)
        mark = "   <- least" if item is winner else ""
        print(f"{gains}{item.objective:13.4g}{item.error:12.4g}{mark}")


def main() -> None:
    quick = "--quick" in sys.argv
    for gain in (1.0, 100.0, 1e4):
        show(f"partial exact data, gain {gain:g}, t = 60", ("c1",), partial(gain))
    for level in (0.01,) if quick else (0.01, 0.05, 0.1):
        for smooth in (False, True):
            tried = noisy(level, 1.0, smooth=smooth)
            how = "G_alpha in V~" if smooth else "alpha = 0 as in the paper"
            show(f"noise {level:.0%}, {how}, gain 1, t = 75", ("mu", "nu"), tried)
    STEPS.report()


if __name__ == "__main__":
    main()
