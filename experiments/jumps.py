"""Compare how laws follow a jump: a diffusivity rises by a fifth at t = 20.

python -m experiments.jumps
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import livepde as lp
from experiments.failed_steps import FailedSteps
from livepde.stepping import ForwardStage

STEPS = FailedSteps()
TIMES = np.arange(0.0, 40.05, 0.05)
JUMP, BEFORE, AFTER = 20.0, 0.3, 0.36
NOISE, SEEDS = 0.01, 5
MESH = lp.interval(0.0, 1.0, 30)
POINTS = [0.25, 0.5, 0.75]


def rod(a: lp.fem.Unknown) -> lp.Model:
    """Return a rod whose left end oscillates, with diffusivity a."""
    ends: dict[str, Any] = {"left": lambda x, t: np.sin(3 * t) + 0.0 * x[0], "right": 0.0}
    state = lp.Field(MESH, lp.fem.linear(MESH), dirichlet=ends)
    return lp.Model(state, {"a": a}, A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)))


def truth(t: float) -> float:
    """Return the true diffusivity at a time."""
    return AFTER if t >= JUMP else BEFORE


def states() -> list[tuple[float, Any]]:
    """Simulate the rod with the true diffusivity; return pairs of time and state."""
    model = rod(lp.Normal(BEFORE))
    forward, u = ForwardStage(model), model.initial(0.0)
    path = [(0.0, u)]
    for t0, t1 in pairwise(TIMES.tolist()):
        u = forward.solve(u, np.array([truth(t1)]), t1 - t0, lp.fem.Moment(t1))
        path.append((t1, u))
    return path


def measured(law: lp.laws.Law[Any, Any], unknown: lp.fem.Unknown, exact: Any, seed: int) -> Any:
    """Return the error before the jump, the time to follow 90 % of it, and the error at the end."""
    rng, model = np.random.default_rng(seed), rod(unknown)
    sensors: lp.observation.Observation = lp.Points(POINTS, noise=NOISE)
    noise = NOISE
    if isinstance(law, lp.GradientLaw):
        sensors, noise = lp.Full(), 0.0
    identifier = lp.Identifier(model, sensors, law, u0=0.0, scheme=lp.ImplicitEuler())
    G, values = identifier.observed.G, []
    for t, u in exact:
        z = G @ u + noise * rng.standard_normal(G.shape[0])
        values.append(STEPS.seen(identifier.step(t, z)).parameters["a"][0])
    a = np.array(values)
    before = np.sqrt(np.mean((a - BEFORE)[(TIMES > 15) & (TIMES < JUMP)] ** 2))
    end = np.sqrt(np.mean((a - AFTER)[TIMES > 35] ** 2))
    late = TIMES >= JUMP
    there = np.flatnonzero(np.abs(a[late] - AFTER) < 0.1 * (AFTER - BEFORE))
    return before, TIMES[late][there[0]] - JUMP if len(there) else np.inf, end


def main() -> None:
    """Print the errors of all laws as a table."""
    walk = {
        rate: lp.Scalar(lp.Normal(0.2, 0.2), evolution=lp.RandomWalk(rate))
        for rate in (0.005, 0.02, 0.1)
    }
    constant, S = lp.Normal(0.2, 0.2), lp.SensitivityLaw
    rows: dict[str, tuple[Any, lp.fem.Unknown]] = {
        "constant": (S(), constant),
        "constant, memory 2": (S(memory=2.0), constant),
        "constant, no refit": (S(refit=None), constant),
        **{f"random walk {rate:g}": (S(), unknown) for rate, unknown in walk.items()},
        "random walk 0.02, memory 2": (S(memory=2.0), walk[0.02]),
        "random walk 0.02, narrow factor": (S(rank=1), walk[0.02]),
        "random walk 0.02, wide factor": (S(rank=30), walk[0.02]),
        **{
            f"gradient law, u exact, gain {gain:g}": (
                lp.GradientLaw(gain, lp.laws.ResidualDamping(10.0)),
                constant,
            )
            for gain in (1.0, 10.0)
        },
    }
    exact = states()
    table = Table(title=f"A jump from {BEFORE} to {AFTER}; noise {NOISE}; mean of {SEEDS} seeds")
    for column in ("law", "error before", "time to follow", "error at the end"):
        table.add_column(column)
    for name, (law, unknown) in rows.items():
        scores = np.array([measured(law, unknown, exact, seed) for seed in range(SEEDS)])
        table.add_row(name, *(f"{value:.3g}" for value in scores.mean(axis=0)))
    Console(width=100).print(table)
    STEPS.report()


if __name__ == "__main__":
    main()
