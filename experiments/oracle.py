"""Compare the paper's lower bounds on mu and nu for the true e and p with rules that use no truth.

The bounds of Assumptions cond:mu_1, cond:mu02, cond:nu and ass:mu_nu contain ||e||_Q, ||p||_V^ and
||d||_V~, which are unknown online. Here the twin provides them after every sample. This must never
move into the library.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

import livepde as lp
from experiments.failed_steps import FailedSteps
from livepde.diagnostics import Errors, Spaces, TwinTracker, bounds, conditions, constants
from livepde.laws.damping import (
    Constants,
    ExactBound,
    Norms,
    nu_exact,
    theta_exact,
    theta_noisy,
)
from livepde.reproduce import seed
from livepde.streams import RelativeNoise, Twin

FLOOR = 1e-8
STEPS = FailedSteps()


@dataclass(frozen=True)
class Oracle(lp.laws.Damping):
    """The smallest theta that the paper allows for the true errors of the previous sample.

    With exact data only r is current; with noise all errors are those of the previous sample. Below
    ||r||_X = FLOOR the damping is linear in r.
    """

    constants: Constants
    truth: Errors
    c1: float = 1.0
    noisy: bool = False
    theta_max: float = 1e3

    def theta(self, r: lp.laws.Residual) -> float:
        size = Norms(float(np.sqrt(r.X)), float(np.sqrt(r.VX)))
        if self.noisy:
            t = self.truth
            asked = theta_noisy(self.constants, t.e, t.p.V, t.r, t.d, c1=self.c1)
            return min(asked, self.theta_max)
        if r.VX == 0.0:
            return self.c1
        share = min(size.X / FLOOR, 1.0)
        asked = theta_exact(self.constants, self.truth.p.V, size)
        return max(share * asked, self.c1 * r.X / r.VX)


@dataclass(frozen=True)
class Found:
    """Run of a law, with its errors, the final relative L2 error of q, and the largest nu."""

    name: str
    law: lp.GradientLaw
    errors: list[Errors]
    error: float
    nu: float


def follow(name: str, twin: Twin, law: lp.GradientLaw, c: Constants, u0: Any, nu: bool) -> Found:
    """Run a law on a twin; update an oracle, and nu if requested, after every sample."""
    spaces = Spaces.of(twin.model, twin.observed, law)
    samples = list(twin)
    tracker = TwinTracker(twin, spaces, law.gain, law.damping)
    identifier = lp.Identifier(twin.model, twin.observation, law, q0=0.0, u0=u0)
    estimate = STEPS.seen(identifier.step(samples[0].t, samples[0].z))
    errors = tracker.add(estimate, samples[0].z)
    largest = law.nu
    for before, sample in pairwise(samples):
        if isinstance(law.damping, Oracle):
            law = replace(law, damping=replace(law.damping, truth=errors))
            if nu:
                law = replace(law, nu=nu_exact(c, errors.e, errors.p))
            largest = max(largest, law.nu)
            identifier = lp.Identifier(
                twin.model, twin.observation, law, q0=estimate.q, u0=estimate.u, t0=before.t
            )
            STEPS.seen(identifier.step(before.t, before.z))
            tracker.damping = law.damping
        estimate = STEPS.seen(identifier.step(sample.t, sample.z))
        errors = tracker.add(estimate, sample.z)
    return Found(name, law, tracker.errors, twin.error(estimate.q), largest)


def run(gain: float = 100.0, samples: int = 41, level: float = 0.0) -> list[Found]:
    """Run all rules on the paper's example, from the exact initial state."""
    noise = RelativeNoise(level) if level else None
    twin = seed.twin_of(times=seed.TIMES[:samples], noise=noise)
    spaces = Spaces(twin.model, twin.observed)
    c = constants(spaces, twin.q, twin.states[::10], gain=gain)
    zero = Norms()
    nothing = Errors(0.0, 0.0, r=zero, p=zero, d=zero, r_alpha=zero, Pu=0.0, rate=0.0, theta=0.0)
    rules: dict[str, tuple[lp.laws.Damping, bool]] = {
        "c1 alone (ResidualDamping)": (lp.laws.ResidualDamping(1.0), False),
        "ExactBound, ||p|| <= 0.01": (ExactBound(c, 0.01, 1.0, FLOOR), False),
        "oracle mu": (Oracle(c, nothing, noisy=level > 0), False),
        "oracle mu and nu": (Oracle(c, nothing, noisy=level > 0), True),
    }
    return [
        follow(name, twin, lp.GradientLaw(gain, rule), c, seed.start, nu)
        for name, (rule, nu) in rules.items()
    ]


def main() -> None:
    for level in (0.0, 0.01):
        print(f"\nseed, gain 100, noise {level:.0%}: relative L2 error of q at t = 24 (q = 0: 1)")
        print(f"{'rule':<28} {'error of q':>10} {'energy end/start':>17} {'largest nu':>11}")
        for found in run(level=level):
            energy = found.errors[-1].energy / found.errors[0].energy
            print(f"{found.name:<28} {found.error:10.4g} {energy:17.4g} {found.nu:11.4g}")
    found = run()[2]
    twin = seed.twin_of(times=[0, 1])
    c = constants(Spaces(twin.model, twin.observed), twin.q, twin.states, gain=100.0)
    print(f"\n{found.name}:")
    print(bounds(found.errors, c))
    print(conditions(found.errors, c, floor=FLOOR))
    STEPS.report()


if __name__ == "__main__":
    main()
