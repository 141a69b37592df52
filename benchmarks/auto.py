"""Errors and cost of `GradientLaw(gain="auto")`, on the square of `benchmarks.scale`.

A field is identified from data on a strip of a square, on several meshes, from exact data and from
data with white noise. The law receives neither a gain nor the noise level. Errors are L2 errors of
q relative to the error of q = 0. With exact data, the error is compared with the smallest error of
a grid of constant gains and c_1. The cost is measured on the processes of
`python -m benchmarks step`, in steps of the forward model.

`benchmarks.partial` provides the reactions on partial data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks import partial, scale
from benchmarks import step as steps
from livepde.diagnostics.check_report import Check, Table
from livepde.identifier import Identifier
from livepde.laws import GradientLaw, ResidualDamping
from livepde.linalg import Array
from livepde.model import Model
from livepde.runs import Outcome

SIZES = (64, 256, 1024, 2500, 10_000)  # nodes of the square
LEVELS = (0.0, 1e-3, 1e-2)  # noise relative to the root mean square of the readings
SEEDS = 5  # data sets for each level of noise
SAMPLES = 100
GAINS = (1.0, 1e2, 1e4, 1e6)  # constant gains for comparison
DAMPINGS = (0.1, 1.0)  # their c_1
WORST = 1.05  # bound on the error of any sample with status ok; q = 0 has 1
RATIO = 1.3  # bound on the error with exact data over the error of the best constant gain
COSTS = {31: 15.0, 1_000: 15.0, 10_000: 10.0}  # nodes -> bound on the cost of a step


@dataclass(frozen=True)
class Course:
    """Errors of q along a run.

    Attributes
    ----------
    worst, last
        Largest error of a sample with status ok, and error after the last sample.
    failed
        Number of samples with another status.
    """

    worst: float
    last: float
    failed: int


@dataclass(frozen=True, eq=False)
class Square:
    """The process on one mesh, and its exact readings.

    Attributes
    ----------
    model
        The process.
    truth
        Exact parameter, shape (m,).
    samples
        Times and readings.
    """

    model: Model
    truth: Array
    samples: list[tuple[float, Array]]

    @classmethod
    def of(cls, size: int) -> Square:
        """Return a square with approximately `size` nodes."""
        model = scale.problem(size)
        truth = model.initial_parameter(scale.q_true)
        return cls(model, truth, list(scale.readings(model, SAMPLES)))

    def noisy(self, level: float, seed: int) -> list[tuple[float, Array]]:
        """Return samples with white noise, relative to the root mean square of all readings."""
        if level == 0.0:
            return self.samples
        rng = np.random.default_rng(seed)
        size = level * float(np.sqrt(np.mean([np.mean(z**2) for _, z in self.samples])))
        return [(t, z + size * rng.standard_normal(len(z))) for t, z in self.samples]

    def follow(self, law: GradientLaw, samples: Sequence[tuple[float, Array]]) -> Course:
        """Run a law, and return its errors of q."""
        identifier = Identifier(self.model, scale.OMEGA, law, q0=0.0, u0=2.0)
        worst = last = 0.0
        failed = 0
        for t, z in samples:
            estimate = identifier.step(t, z)
            last = self.error(estimate.q)
            if estimate.status.ok:
                worst = max(worst, last)
            else:
                failed += 1
        return Course(worst, last, failed)

    def error(self, q: Array) -> float:
        """Return the L2 error of q relative to the error of q = 0."""
        mass, miss = self.model.parameter_mass, q - self.truth
        return float(np.sqrt((miss @ (mass @ miss)) / (self.truth @ (mass @ self.truth))))


def auto(
    sizes: Sequence[int] = SIZES,
    seeds: int = SEEDS,
    costs: Sequence[int] = tuple(COSTS),
    reactions: Sequence[str] = (),
    levels: Sequence[float] = partial.LEVELS,
) -> Outcome:
    """Check errors and cost of the law with automatic gain.

    Parameters
    ----------
    sizes
        Numbers of nodes of the square.
    seeds
        Data sets for each level of noise.
    costs
        Numbers of nodes for which the cost is measured; keys of `COSTS`.
    reactions, levels
        Names of processes in `benchmarks.partial`, and their noise levels.
    """
    rows: list[tuple[object, ...]] = []
    checks: list[Check] = []
    for size in sizes:
        square = Square.of(size)
        best, name = _best(square)
        for level in LEVELS:
            courses = [
                square.follow(GradientLaw(gain="auto"), square.noisy(level, seed))
                for seed in range(seeds if level else 1)
            ]
            worst, last = max(c.worst for c in courses), [c.last for c in courses]
            failed = sum(c.failed for c in courses)
            rows.append((square.model.X.dim, level, min(last), max(last), worst, failed, name))
            label = f"{square.model.X.dim} nodes, noise {level:g}"
            checks.append(Check(f"{label}: largest error with status ok", worst, WORST, "<="))
            if level == 0.0:
                ratio = max(last) / best
                checks.append(Check(f"{label}: error / best constant gain", ratio, RATIO, "<="))
                name = ""
    times, bounds = _costs(costs)
    columns = ("nodes", "noise", "least", "largest", "worst", "failed", "best constant gain")
    table = Table("Error of q after the last sample (q = 0: 1)", columns, rows)
    note = (
        f"{SAMPLES} samples, {seeds} data sets for each noise level. worst: largest error of a "
        "sample with status ok; failed: samples with another status. Constant gains: "
        f"{', '.join(f'{gain:g}' for gain in GAINS)} with c1 {DAMPINGS[0]:g} and {DAMPINGS[1]:g}."
    )
    tables, checks = [table, times], [*checks, *bounds]
    if reactions:
        hidden, more = partial.partial(reactions, levels, seeds)
        tables, checks = [*tables, hidden], [*checks, *more]
    return Outcome(tables=tables, checks=checks, notes=[note])


def _best(square: Square) -> tuple[float, str]:
    """Return the smallest error of constant gains with exact data, and a description of it."""
    errors = []
    for gain, c1 in product(GAINS, DAMPINGS):
        course = square.follow(GradientLaw(gain, ResidualDamping(c1)), square.samples)
        errors.append((course.last, f"{course.last:.3g}: {gain:g}, c1 {c1:g}"))
    return min(errors)


def _costs(sizes: Sequence[int]) -> tuple[Table, list[Check]]:
    """Return a table and checks of the cost of a step, in forward steps of the same process."""
    rows, checks = [], []
    for size in sizes:
        low, middle, high, mean = steps.first_steps(steps.problem(size), GradientLaw(gain="auto"))
        rows.append((size, low, middle, high, mean, COSTS[size]))
        name = f"{size} nodes: step / forward step, median"
        checks.append(Check(name, middle, COSTS[size], "<="))
    columns = ("nodes", "min", "median", "max", "mean", "bound")
    return Table("One step over one forward step", columns, rows), checks
