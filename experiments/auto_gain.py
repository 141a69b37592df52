"""`GradientLaw(gain="auto")` against the best of a grid of gains, chosen by the truth.

For `seed` (discrete truth) and `seed-excited` with 0, 1, 5 and 10 % noise, white in L2, smoothed in
space by Tikhonov in the V~ norm with the discrepancy principle, nothing in time: the error of the
law that tunes itself against the smallest error of a grid of constant gains and c_1, chosen for
each level and seed by the truth.

    python experiments/auto_gain.py 100 101

runs it for these seeds of the noise.
"""

from __future__ import annotations

import sys

import numpy as np

from livepde.identifier import Identifier
from livepde.laws import GradientLaw, ResidualDamping
from livepde.observation import Discrepancy, Full, Tikhonov
from livepde.reproduce import noisy, seed, seed_excited
from livepde.streams import Twin

LEVELS = (0.0, 0.01, 0.05, 0.10)
GAINS = (10.0, 100.0, 1e3, 1e4, 1e5)
C1 = (1.0, 10.0, 100.0, 1e3)
TARGET = 1.3


def final(twin: Twin, samples, observation, law: GradientLaw, start) -> float:
    """Return the relative L2 error of q after the last sample."""
    identifier = Identifier(twin.model, observation, law, q0=0.0, u0=start)
    error = np.inf
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z)
        error = twin.error(estimate.q) if estimate.status.ok else np.inf
    return error


def compare(name: str, run, gains=GAINS, c1=C1) -> tuple[float, float]:
    """Print and return the error of the law that tunes itself, and the best of the grid."""
    own = run(GradientLaw(gain="auto"))
    grid = {(g, c): run(GradientLaw(gain=g, damping=ResidualDamping(c))) for g in gains for c in c1}
    best = min(grid, key=grid.__getitem__)
    print(
        f"{name:24s} auto {own:.4f}  best {grid[best]:.4f} (gain {best[0]:g}, c1 {best[1]:g})  "
        f"ratio {own / grid[best]:.2f}",
        flush=True,
    )
    return own, grid[best]


def main(seeds: list[int]) -> None:
    """Print the table."""
    model, omega = seed.build()
    twin = Twin(
        model=model,
        observation=omega,
        times=seed.TIMES,
        q_true=seed.q_true,
        u_true=seed.u_true,
    )
    compare(
        "seed",
        lambda law: final(twin, twin, omega, law, lambda x: seed.u_true(x, 0.0)),
        gains=(100.0, 1e3, 1e4),
        c1=(0.1, 1.0, 10.0),
    )
    model, full = seed_excited.build()
    excited = Twin(
        model=model,
        observation=full,
        q_true=seed_excited.q_true,
        u_true=seed_excited.u_true,
        times=seed_excited.TIMES,
    )

    def start(x):
        return seed_excited.u_true(x, 0.0)

    for level in LEVELS:
        found = []
        for number in seeds if level else [0]:
            smooth, samples = full, excited
            if level:
                smooth = Full(reconstruction=Tikhonov("V", Discrepancy(1.0, level=level)))
                samples = noisy.WhiteNoise(excited, level, number)
            found.append(
                compare(
                    f"seed-excited {level:4.0%}, seed {number}",
                    lambda law, s=samples, o=smooth: final(excited, s, o, law, start),
                )
            )
        own, best = np.array(found).T
        ratio = float(np.median(own / best))
        print(f"  {level:.0%}: median ratio {ratio:.2f}, {'ok' if ratio <= TARGET else 'MISSED'}")


if __name__ == "__main__":
    main([int(s) for s in sys.argv[1:]] or [100, 101])
