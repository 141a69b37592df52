"""Compare `GradientLaw(gain="auto")` with the best constant gain of a grid, chosen by the truth.

Data of `seed` and `seed-excited`, discrete truth, with 0, 1, 5 and 10 % noise that is white in L2.
The self-tuning law gets no gain, noise level or smoothing. The best constant gain has the smallest
error of the grid for each noise seed, with Tikhonov smoothing in the V~ norm by the discrepancy
principle with the exact level. Errors are relative L2 errors of q after the last sample, t = 60;
q = 0 has error 1. The prior standard deviation is 0.01 for `seed` and 1 for `seed-excited`.

    python -m experiments.auto_gain

runs seeds 100 to 109 in about a quarter of an hour; `python -m experiments.auto_gain seed 100 101`
runs one example with these seeds.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from experiments.failed_steps import FailedSteps
from experiments.seed_excited_noise import WhiteNoise
from livepde.identifier import Identifier
from livepde.laws import GradientLaw, ResidualDamping
from livepde.observation import Discrepancy, Full, Subdomain, Tikhonov
from livepde.reproduce import seed, seed_excited
from livepde.streams import Twin

LEVELS = (0.0, 0.01, 0.05, 0.10)
SEEDS = tuple(range(100, 110))
TARGET = 1.3
STEPS = FailedSteps()  # of the self-tuning law
EXAMPLES: dict[str, tuple[Any, float, tuple[float, ...], tuple[float, ...]]] = {
    # module, prior standard deviation of q, gains in units of 1/std^2, c1
    "seed": (seed, 0.01, (1e2, 1e4, 1e6, 1e8), (0.1, 1.0, 10.0, 100.0)),
    "seed-excited": (
        seed_excited,
        1.0,
        (10.0, 100.0, 1e3, 1e5),
        (1.0, 100.0, 1e3),
    ),
}


def final(twin: Twin, samples: Any, observation: Any, law: GradientLaw, u0: Any) -> float:
    """Run a law; return the relative L2 error of q at the end, infinity if the last step failed."""
    identifier = Identifier(twin.model, observation, law, q0=0.0, u0=u0)
    error = np.inf
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z)
        if law.gain == "auto":
            STEPS.seen(estimate)
        error = twin.error(estimate.q) if estimate.status.ok else np.inf
    return error


def smoothed(observation: Any, level: float) -> Any:
    """Return the observation with the smoothing used for constant gains."""
    how = Tikhonov("V", Discrepancy(1.0, level=level))
    if isinstance(observation, Full):
        return Full(reconstruction=how)
    return Subdomain(observation.omega, reconstruction=how)


def compare(name: str, level: float, number: int) -> tuple[float, float]:
    """Print and return the error of the self-tuning law and the smallest error of the grid."""
    module, std, gains, damping = EXAMPLES[name]
    twin = module.twin_of(std)
    observation, u0 = twin.observation, module.start
    samples = list(WhiteNoise(twin, level, number) if level else twin)
    sensors = smoothed(observation, level) if level else observation

    own = final(twin, samples, observation, GradientLaw(gain="auto"), u0)
    grid = {
        (g, c): final(twin, samples, sensors, GradientLaw(gain=g, damping=ResidualDamping(c)), u0)
        for g, c in product(gains, damping)
    }
    best = min(grid, key=grid.__getitem__)
    print(
        f"{name} {level:.0%}, seed {number}: auto {own:.5f}, best {grid[best]:.5f} "
        f"(gain {best[0]:g}, c1 {best[1]:g}), ratio {own / grid[best]:.2f}",
        flush=True,
    )
    return own, grid[best]


def main(names: Sequence[str], seeds: Sequence[int]) -> None:
    """Print the table of median errors and their ratios."""
    rows = []
    for name, level in product(names, LEVELS):
        errors = np.array([compare(name, level, k) for k in (seeds if level else (0,))])
        ratio = errors[:, 0] / errors[:, 1]
        own, best = np.median(errors, axis=0)
        rows.append(
            f"{name:14s} {level:4.0%}  {own:9.5f}  {best:9.5f}  {np.median(ratio):6.2f} "
            f"({ratio.min():.2f} to {ratio.max():.2f})  "
            f"{'ok' if np.median(ratio) <= TARGET else 'MISSED'}"
        )
    print(f"\n{'example':14s} noise       auto       best  ratio, median (range)")
    print("\n".join(rows))
    STEPS.report()


if __name__ == "__main__":
    asked = sys.argv[1:]
    main(
        [a for a in asked if a in EXAMPLES] or list(EXAMPLES),
        [int(a) for a in asked if a.isdigit()] or SEEDS,
    )
