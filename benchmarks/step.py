"""Cost of one step of each law against one forward step of the same model.

The gradient law is timed from the first sample on, in turns with steps of the same model and the
same scheme with a known parameter, the matrix factorised once: the median is that of usual steps,
the mean also holds the first ones and those that factorise. A run of the sensitivity law, without
refits, is timed in stretches of steps, one right after the other, so that a slow moment of the
machine hits both.
Times are those of the processor: what else runs on the machine is not counted.
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

SIZES = (31, 1_000, 10_000, 100_000)  # nodes
MODES = (1, 10, 50)  # reduced unknowns of the sensitivity law
QUICK_SIZES, QUICK_MODES = (31, 10_000), (1, 10)
LONGEST_ROD = 1_000  # nodes of the rod; more are those of a square
GAINS = ((1.0, 0.1), (1e2, 0.1), (1e4, 0.1), (1e4, 1.0))  # gain and c_1 of the gradient law
FIRST = 100  # samples over which steps of the gradient law are timed, the first one included
MEDIAN, MEAN = 2.5, 4.0  # forward steps that one of them may cost on a square
SENSORS = 25
BESIDE: tuple[tuple[str, Shadows | None, bool | str], ...] = (
    (", no shadows, no verdict", None, False),
    (", no shadows, verdict 'cheap'", None, "cheap"),
    (", no shadows", None, True),
    ("", Shadows(), True),
)
"""What the sensitivity law follows beside its estimates."""

SETTLED = 24  # steps after which one of some is shadowed


Row: TypeAlias = tuple[int, str, float, float, float, float, float | None, float | None]


@dataclass(frozen=True, eq=False)
class Problem:
    """A process that is simulated and identified.

    Attributes
    ----------
    model, omega
        The process, and where it is observed for the gradient law.
    points
        What the sensitivity law observes.
    q_true, u_true
        The exact parameter, and the exact state at (x, t).
    width
        Time step, a binary number: the differences of all times are exactly this.
    beginning
        Steps that are not timed: the law has not found in yet.
    steps, stretches
        Steps that are timed at once, and how often that is done in a run.
    runs
        How often the run is repeated.
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
        """Simulate with a known parameter: the initial state, and after each step."""
        known = self.model.initial_parameter(q)
        count = self.beginning + self.steps * self.stretches if count is None else count
        times = (self.width * np.arange(count + 1)).tolist()
        return simulate(self.model, known, self.u0, times, Advance(scheme))


def problem(size: int) -> Problem:
    """Return the paper's example with so many nodes, or the same on a square if there are many."""
    # Stretches are long, or the forward steps would find the processor's caches without their data.
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
    """Time both laws at several numbers of nodes.

    Parameters
    ----------
    sizes
        Numbers of nodes: of the paper's example up to 1000, beyond them of the same on a square.
    modes
        Reduced unknowns of the sensitivity law, whose cost is bounded beyond 1000 nodes.
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
            bare = np.inf  # of the law without shadows and verdict, which comes first
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
        "Ratios of processor times taken in one process; the forward step is livepde.simulate with "
        f"the factor kept. Gradient law: the first {FIRST} samples, each step over the median "
        f"forward step; sensitivity law: stretches of steps after the first {SETTLED}, no "
        "refits, with and without its shadows of the discretisation error and its verdict; more: "
        "what these add to the step without both, by the medians. A forward step is one of the "
        "law's own scheme."
    )
    return Outcome(tables=[table], checks=checks, notes=[note])


def first_steps(given: Problem, law: GradientLaw) -> tuple[float, float, float, float]:
    """Return least, median, largest and mean cost of the first steps, in forward steps."""
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
