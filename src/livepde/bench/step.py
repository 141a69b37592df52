"""Cost of one step of each law against one forward step of the same model.

Every repetition times, one right after the other, the law's steps and the same number of implicit
Euler steps of the same model with a known parameter, its matrix factorised once; the ratio is taken
pair by pair, so that a slow moment of the machine hits both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from livepde.identifier import Identifier
from livepde.laws import AnyLaw, GradientLaw, ResidualDamping, SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Subdomain
from livepde.reproduce import seed
from livepde.runs.outcome import Check, Outcome, Table
from livepde.stepping import Advance, ImplicitEuler, simulate

__all__ = ["step"]

REPETITIONS = 15
BOUND = 8.0  # forward steps that a step of the gradient law may cost at 31 nodes


def step() -> Outcome:
    """Time both laws on the paper's example (31 nodes, cubic Hermite elements)."""
    model, observation = seed.build()
    laws: dict[str, AnyLaw] = {
        f"gradient, gain {gain:g}, c1 {c1:g}": GradientLaw(gain, ResidualDamping(c1))
        for gain, c1 in ((1.0, 0.1), (1e2, 0.1), (1e4, 0.1), (1e4, 1.0))
    }
    laws["sensitivity, 12 modes"] = SensitivityLaw(modes=12, noise=1e-3)
    rows, checks = [], []
    for name, law in laws.items():
        ratios = np.array(_ratios(model, observation, law))
        low, middle, high = np.quantile(ratios, (0.0, 0.5, 1.0))
        rows.append((name, low, middle, high))
        if isinstance(law, GradientLaw):
            checks.append(Check(f"{name}: step / forward step", middle, BOUND, "<="))
    title = f"One step over one forward step, {REPETITIONS} pairs of 99 steps"
    table = Table(title, ("law", "min", "median", "max"), rows)
    note = (
        "Ratios of times taken in one process; the forward step is livepde.simulate with the "
        "factor kept."
    )
    return Outcome(tables=[table], checks=checks, notes=[note])


def _ratios(model: Model, observation: Subdomain, law: AnyLaw) -> list[float]:
    times = seed.TIMES.tolist()
    u0 = partial(seed.u_true, t=0.0)

    def forward(q: Any) -> Iterator[tuple[float, Array]]:
        known = model.initial_parameter(q)
        return simulate(model, known, u0, times, Advance(ImplicitEuler()))

    G = observation.matrix(model.state_space)
    samples = [(t, G @ u) for t, u in forward(seed.q_true)]

    def steps() -> float:
        identifier = Identifier(model, observation, law, q0=0.0, u0=u0)
        identifier.step(*samples[1])  # builds what is built once

        def run() -> None:
            for t, z in samples[2:]:
                identifier.step(t, z)

        return _seconds(run)

    def forwards() -> float:
        states = forward(0.0)
        next(states), next(states)  # builds what is built once
        return _seconds(lambda: [None for _ in states])

    pairs = [(steps(), forwards()) for _ in range(REPETITIONS + 1)][1:]
    return [a / b for a, b in pairs]


def _seconds(run: Callable[[], object]) -> float:
    start = perf_counter()
    run()
    return perf_counter() - start
