"""A fleet of rods stepped together against as many separate identifiers, pair by pair."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from livepde.fem import Channel, Scalar, interval
from livepde.fleet import Fleet
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import heat
from livepde.observation import Points
from livepde.runs.outcome import Check, Outcome, Table
from livepde.stepping import Advance, ImplicitEuler, simulate

__all__ = ["fleet"]

NODES = 100
SENSORS = (0.2, 0.4, 0.6, 0.8)
NOISE = 0.01
STEP = 0.05
TRUTHS = 20  # rods of other coefficients; each member has noise of its own
BEGIN = 20  # samples before the first pair: what is computed once is computed
LENGTH = 5  # steps of a pair
REPETITIONS = 7
FASTER = 10.0  # times, at least: the promise
EQUAL = 1e-8  # relative to the largest estimate: rounding


def fleet(members: int = 1000) -> Outcome:
    """Time a step of a fleet against one of as many separate objects with the same data.

    Rods of 100 nodes, whose diffusivity and loss are unknown, heated at one end.
    """
    model, sensors, law = _rod(), Points(SENSORS, noise=NOISE), SensitivityLaw()
    together = Fleet(model, sensors, law, members, u0=0.0)
    separate = [Identifier(model, sensors, law, u0=0.0) for _ in range(members)]
    ratios, apart = [], 0.0
    samples = _samples(model, members)
    for k in range(REPETITIONS + 1):
        piece = samples[:BEGIN] if not k else samples[BEGIN + (k - 1) * LENGTH :][:LENGTH]
        start = perf_counter()
        for t, z, heated in piece:
            estimate = together.step(t, z, _inputs(heated))
        middle = perf_counter()
        for t, z, heated in piece:
            inputs = _inputs(heated)
            found = [one.step(t, row, inputs) for one, row in zip(separate, z, strict=True)]
        stop = perf_counter()
        q = np.array([one.q for one in found])
        apart = max(apart, float(np.abs(estimate.q / q - 1.0).max()))
        if k:
            ratios.append((stop - middle) / (middle - start))
    low, middle_ratio, high = np.quantile(ratios, (0.0, 0.5, 1.0))
    title = f"Separate objects over a fleet of {members}, {REPETITIONS} pairs of {LENGTH} steps"
    rows = [(f"rod of {NODES} nodes, 2 unknowns, 4 sensors", low, middle_ratio, high)]
    return Outcome(
        tables=[Table(title, ("time per step and rod", "min", "median", "max"), rows)],
        checks=[
            Check("fleet: times faster per step and rod", float(middle_ratio), FASTER, ">="),
            Check("fleet: relative difference of the estimates", apart, EQUAL, "<="),
        ],
        notes=["Ratios of times taken in one process, one thread, one right after the other."],
    )


def _rod() -> Model:
    ends = {"left": Channel("heated"), "right": 0.0}
    loss = Scalar(0.5, std=0.5, transform="log", bounds=(0.0, np.inf))
    alpha = Scalar(0.5, std=0.25, transform="log", bounds=(0.0, np.inf))
    return heat(interval(0.0, 1.0, NODES - 1), alpha, ends, loss=loss)


def _inputs(heated: float) -> dict[str, float]:
    return {"heated": heated, "ambient": 0.0}


def _samples(model: Model, members: int) -> list[tuple[float, Array, float]]:
    """Return time, measurements of all members, and the temperature of the heated end."""
    rng = np.random.default_rng(0)
    times = [STEP * k for k in range(BEGIN + REPETITIONS * LENGTH + 1)]

    def heated(t: float) -> float:
        return float(np.sin(t) + np.sin(3.1 * t))

    sensors = Points(SENSORS).matrix(model.state_space)
    truths, control = [], Advance(ImplicitEuler())
    for _ in range(TRUTHS):
        q = model.initial_parameter({"alpha": rng.uniform(0.3, 0.8), "loss": rng.uniform(0.2, 1.0)})
        states = simulate(model, q, 0.0, times, control, lambda t: _inputs(heated(t)))
        truths.append([sensors @ u for _, u in states])
    which = np.arange(members) % TRUTHS
    shown = np.array(truths)[which]
    shown += NOISE * rng.standard_normal(shown.shape)
    return [(t, shown[:, k], heated(t)) for k, t in enumerate(times) if k]
