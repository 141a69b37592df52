"""Cost of one step of each law relative to one forward step of the same model.

The gradient law is timed from the first sample on. Its steps alternate with forward steps of the
same model and scheme with a known parameter and a stored factorisation. The median describes usual
steps; the mean includes the first steps and steps that factorise. The sensitivity law, without
refits, is timed in stretches of steps that alternate with stretches of forward steps, so that other
load on the machine affects both. All times are processor times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any, TypeAlias

import numpy as np

from livepde.diagnostics.check_report import Check, Table
from livepde.fem import Field, dot, grad, linear, rectangle
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, GradientLaw, ResidualDamping, SensitivityLaw, Shadows
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Points, Subdomain
from livepde.reproduce import seed
from livepde.runs import Outcome
from livepde.stepping import Advance, Scheme, simulate

SIZES = (31, 1_000, 10_000, 100_000)  # numbers of nodes
MODES = (1, 10, 50)  # modes of the sensitivity law
QUICK_SIZES, QUICK_MODES = (31, 10_000), (1, 10)
LONGEST_ROD = 1_000  # largest number of nodes of the rod; larger meshes are squares
GAINS = ((1.0, 0.1), (1e2, 0.1), (1e4, 0.1), (1e4, 1.0))  # gain and c_1 of the gradient law
FIRST = 100  # timed samples of the gradient law, including the first one
MEDIAN, MEAN = 2.5, 4.0  # bounds on its cost on a square, in forward steps
SENSORS = 25
BESIDE: tuple[tuple[str, Shadows | None, bool | str], ...] = (
    (", no shadows, no verdict", None, False),
    (", no shadows, verdict 'cheap'", None, "cheap"),
    (", no shadows", None, True),
    ("", Shadows(), True),
)
"""Suffix of the row, shadows and verdict of the sensitivity law."""

SETTLED = 24  # untimed steps; the first 16 have shadows each, later only one in eight


Row: TypeAlias = tuple[int, str, float, float, float, float, float | None, float | None]


@dataclass(frozen=True, eq=False)
class Problem:
    """Process that is simulated and identified.

    Attributes
    ----------
    model, omega
        Model, and the subdomain that the gradient law observes.
    points
        Sensors of the sensitivity law.
    q_true, u_true
        Exact parameter, and exact state at (x, t).
    width
        Time step; a multiple of a power of two, so that differences of times are exact.
    beginning
        Number of untimed initial steps, in which shadows are computed more often.
    steps, stretches
        Steps of a timed stretch, and number of stretches in a run.
    runs
        Number of runs.
    """

    model: Model
    omega: Subdomain
    points: Points
    q_true: Callable[[Any], Any]
    u_true: Callable[[Any, float], Any]
    width: float
    beginning: int
    steps: int
    stretches: int
    runs: int

    def u0(self, x: Any) -> Any:
        """Return the exact state at the start."""
        return self.u_true(x, 0.0)

    def forward(
        self, q: Any, count: int | None = None, scheme: Scheme = GradientLaw.scheme
    ) -> Iterator[tuple[float, Array]]:
        """Simulate with a known parameter, and yield times and states from the start on."""
        known = self.model.initial_parameter(q)
        count = self.beginning + self.steps * self.stretches if count is None else count
        times = (self.width * np.arange(count + 1)).tolist()
        return simulate(self.model, known, self.u0, times, Advance(scheme))


def problem(size: int) -> Problem:
    """Return the paper's example with `size` nodes, or a square beyond `LONGEST_ROD` nodes."""
    # Stretches are long, so that the processor's caches contain the data of the forward steps.
    steps, stretches, runs = (90, 1, 15) if size <= 100 else (30, 3, 3)
    if size <= LONGEST_ROD:
        model, omega = seed.build(nodes=size)
        points = Points(np.linspace(0.1, 0.9, SENSORS).tolist())
        return Problem(
            model, omega, points, seed.q_true, seed.u_true, 0.625, SETTLED, steps, stretches, runs
        )
    cells = round(np.sqrt(size)) - 1
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells)).to_meshtri()
    zero = {"boundary": 0.0}
    model = Model(
        state=Field(mesh, linear(mesh), dirichlet=zero),
        parameter=Field(mesh, linear(mesh), inner="H1", dirichlet=zero),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: dot(grad(u), grad(v)),
        f=_source,
    )
    omega = Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))
    side = np.linspace(0.1, 0.9, round(np.sqrt(SENSORS)))
    points = Points([(x, y) for x in side for y in side])
    return Problem(model, omega, points, _q_true, _u_true, 0.0625, SETTLED, 16, 2, 1)


def _q_true(x: Any) -> Any:
    return 16.0 * seed.q_true(x) * (x[1] ** 2 - x[1])


def _u_true(x: Any, t: float) -> Any:
    return seed.u_true(x, t) * np.sin(np.pi * x[1])


def _source(x: Any, t: float) -> Any:
    return (2.0 * np.pi**2 - 1.0 / (1.0 + t) + _q_true(x)) * _u_true(x, t)


def step(sizes: Sequence[int] = SIZES, modes: Sequence[int] = MODES) -> Outcome:
    """Time both laws for several numbers of nodes.

    Parameters
    ----------
    sizes
        Numbers of nodes: the paper's example up to 1000 nodes, and a square beyond.
    modes
        Numbers of modes of the sensitivity law. Bounds on its cost apply beyond 1000 nodes.
    """
    rows: list[Row] = []
    checks: list[Check] = []
    for size in sizes:
        given, large = problem(size), size > LONGEST_ROD
        for gain, c1 in GAINS:
            name = f"gradient, gain {gain:g}, c1 {c1:g}"
            low, middle, high, mean = first_steps(given, GradientLaw(gain, ResidualDamping(c1)))
            rows.append((size, name, low, middle, high, mean, None, MEDIAN if large else None))
            if large:
                label = f"{size} nodes, {name}: step / forward step"
                checks.append(Check(f"{label}, median", middle, MEDIAN, "<="))
                checks.append(Check(f"{label}, mean of the first {FIRST}", mean, MEAN, "<="))
        for count in modes:
            if count > given.model.Q.free.sum():
                continue
            bare = np.inf  # median cost without shadows and verdict, measured first
            for beside, shadows, verdict in BESIDE:
                name, bound = f"sensitivity, modes {count}{beside}", 2.0 + count / 3.0
                law = SensitivityLaw(
                    modes=count, noise=1e-3, refit=None, shadows=shadows, verdict=verdict
                )
                ratios = np.array(_ratios(given, given.points, law))
                low, middle, high = np.quantile(ratios, (0.0, 0.5, 1.0)).tolist()
                mean = float(ratios.mean())
                if shadows is None and verdict is False:
                    bare = middle
                more = middle / bare - 1.0
                limit = bound if large else None
                rows.append((size, name, low, middle, high, mean, round(more, 3), limit))
                if large:
                    label = f"{size} nodes, {name}: step / forward step"
                    checks.append(Check(label, middle, bound, "<="))
    columns = ("nodes", "law", "min", "median", "max", "mean", "more", "bound")
    table = Table("One step over one forward step", columns, rows)
    note = (
        "Ratios of processor times measured in one process. A forward step is livepde.simulate "
        "with the law's scheme and a stored factorisation. Gradient law: each of the first "
        f"{FIRST} samples over the median forward step. Sensitivity law: stretches of steps after "
        f"the first {SETTLED}, without refits, with and without estimates of the discretisation "
        "error (shadows) and verdict. more: relative increase of the median due to these."
    )
    return Outcome(tables=[table], checks=checks, notes=[note])


def first_steps(given: Problem, law: GradientLaw) -> tuple[float, float, float, float]:
    """Return smallest, median, largest and mean cost of the first steps, in forward steps."""
    G = given.omega.matrix(given.model.state_space)
    samples = [(t, G @ u) for t, u in given.forward(given.q_true, FIRST)]
    spent: list[float] = []
    forward: list[float] = []
    for _ in range(given.runs):
        identifier = Identifier(given.model, given.omega, law, q0=0.0, u0=given.u0)
        states = given.forward(0.0, FIRST)
        next(states)
        for sample in samples[1:]:
            begun = process_time()
            identifier.step(*sample)
            between = process_time()
            next(states)
            spent.append(between - begun)
            forward.append(process_time() - between)
    costs = np.array(spent) / np.median(forward)
    low, middle, high = np.quantile(costs, (0.0, 0.5, 1.0)).tolist()
    return low, middle, high, float(costs.mean())


def _ratios(given: Problem, sensors: Observation, law: AnyLaw) -> list[float]:
    G = sensors.matrix(given.model.state_space)
    samples = [(t, G @ u) for t, u in given.forward(given.q_true, scheme=law.scheme)]
    ratios = []
    for _ in range(given.runs):
        identifier = Identifier(given.model, sensors, law, q0=0.0, u0=given.u0)
        states = given.forward(0.0, scheme=law.scheme)
        for sample, _ in zip(samples[: given.beginning + 1], states, strict=False):
            if sample is not samples[0]:
                identifier.step(*sample)
        for start in range(given.beginning + 1, len(samples), given.steps):
            stretch = samples[start : start + given.steps]
            begun = process_time()
            for sample in stretch:
                identifier.step(*sample)
            between = process_time()
            for _ in stretch:
                next(states)
            ratios.append((between - begun) / (process_time() - between))
    return ratios
