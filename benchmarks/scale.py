"""Scaling of a step of the gradient law to large fields.

The process is heat conduction with an unknown reaction coefficient on a square or a cube. It is
observed in a part of the domain and driven by its boundary values; u and q are fields on the same
nodes. Sources are constant, so that a forward step costs little more than one solve.

For each size and gain, a separate process alternates forward steps and steps of the law, both with
stored factorisations, and reports the ratio of processor times. `million` runs 100 steps with a
million nodes from samples in a file, and reports the peak memory. A second table counts the
iterations of one block system with new factors to a tolerance of 1e-8. They grow with the gain and
with theta M_op, and barely with the mesh.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.processes import peak_memory
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import ConfigurationError
from livepde.fem import Field, Moment, box, dot, grad, linear, rectangle
from livepde.identifier import Identifier
from livepde.laws import GradientLaw, ResidualDamping
from livepde.laws.coupled.equation import Metric, StageForms, StageProblem, StageTerms
from livepde.laws.coupled.stage_solvers import BlockSolver
from livepde.linalg import Array
from livepde.model import Model, h1_form
from livepde.observation import Full, Subdomain
from livepde.runs import Outcome
from livepde.stepping import Advance, ImplicitEuler, simulate

__all__ = [
    "GAINS",
    "HUGE",
    "OMEGA",
    "SIZES",
    "identify",
    "iterations",
    "measure",
    "million",
    "problem",
    "q_true",
    "readings",
    "record",
    "scale",
]

SIZES = (10_000, 100_000)  # nodes of the square
CUBE = 3  # dimensions
GAINS = (1.0, 1e2, 1e4)
RATIO = 2.5  # bound on the cost of a step of the law, in forward steps
EXPONENT = 1.15  # bound on the exponent of the cost, from the smallest to the largest square
MEMORY = 3.0  # kB per coefficient of the state, bound on the peak memory
HUGE = 1_000_000  # nodes of the large run
WIDTH = 0.0625  # time step; a power of two, so that differences of times are exact
FINDING, TIMED = 16, 24  # untimed initial steps, and timed steps
MILLION = 100  # steps of the large run
ACCURACY = 0.1  # bound on the relative error of q in the large run

COUNTED = (2_500, 10_000)  # numbers of nodes for which iterations are counted
TOLERANCE = 1e-8
STEP = 0.05
# (c_1, gain) -> bound on the iterations for the first system
ITERATIONS = {
    (0.0, 1.0): 4,
    (0.0, 1e2): 5,
    (0.0, 1e4): 8,
    (0.0, 1e6): 14,
    (1.0, 1.0): 5,
    (1.0, 1e2): 6,
    (1.0, 1e4): 10,
    (1.0, 1e6): 26,
}


@dataclass(frozen=True)
class Cost:
    """Measurement of one process.

    Attributes
    ----------
    nodes
        Nodes of the mesh; each has a value of u and a value of q.
    dimension, gain
        Dimension of the mesh, and gain of the law.
    ratio, low, high
        Step over forward step: for the sums of all timed steps, smallest and largest.
    step
        Mean processor time of a step, in s.
    error
        Relative error of q at the end; q = 0 has 1.
    """

    nodes: int
    dimension: int
    gain: float
    ratio: float
    low: float
    high: float
    step: float
    error: float


@dataclass(frozen=True)
class Need:
    """Error and memory of a process that only identifies.

    Attributes
    ----------
    error
        Relative error of q at the end.
    memory
        Peak memory in kB per coefficient of the state, including interpreter, libraries, model and
        law.
    """

    error: float
    memory: float


def problem(size: int, dimension: int = 2) -> Model:
    """Return the model on a mesh with approximately `size` nodes."""
    side = round(size ** (1.0 / dimension)) - 1
    if dimension == 2:
        mesh: Any = rectangle((0.0, 1.0), (0.0, 1.0), (side, side)).to_meshtri()
    else:
        mesh = box((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), cells=(side, side, side))
    return Model(
        state=Field(mesh, linear(mesh), dirichlet={"boundary": _moving}),
        parameter=Field(mesh, linear(mesh), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: dot(grad(u), grad(v)),
        f=10.0,
    )


def _moving(x: Any, t: float) -> Any:
    return 2.0 + 0.5 * np.sin(t) * x[0] + 0.5 * np.cos(1.5 * t) * x[1]


def q_true(x: Any) -> Any:
    """Return the exact parameter."""
    return 2.0 + 3.0 * np.sin(np.pi * x[0]) ** 2 * np.sin(np.pi * x[1])


OMEGA = Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))


def readings(model: Model, steps: int) -> Iterator[tuple[float, Array]]:
    """Simulate the process, and yield times and exact readings."""
    G, truth = OMEGA.matrix(model.state_space), model.initial_parameter(q_true)
    times = (WIDTH * np.arange(steps + 1)).tolist()
    states = simulate(model, truth, 2.0, times, Advance(ImplicitEuler()))
    return ((t, G @ u) for t, u in states)


def measure(size: int, dimension: int, gain: float, steps: int = FINDING + TIMED) -> Cost:
    """Alternate forward steps and steps of the law in this process, and return their cost."""
    model = problem(size, dimension)
    samples = readings(model, steps)
    identifier = _identifier(model, gain)
    identifier.step(*next(samples))
    spent, forward = np.zeros(steps), np.zeros(steps)
    for k in range(steps):
        forward[k], sample = _timed(partial(next, samples))
        spent[k], estimate = _timed(partial(identifier.step, *sample))
        _check(estimate)
    timed = slice(FINDING, None)
    ratios = spent[timed] / forward[timed]
    return Cost(
        nodes=model.X.dim,
        dimension=dimension,
        gain=gain,
        ratio=float(spent[timed].sum() / forward[timed].sum()),
        low=float(ratios.min()),
        high=float(ratios.max()),
        step=float(spent[timed].mean()),
        error=_error(model, identifier),
    )


def record(size: int, steps: int, path: str) -> None:
    """Write the samples of a square to a file."""
    model = problem(size)
    np.save(path, np.array([z for _, z in readings(model, steps)]))


def identify(size: int, gain: float, path: str) -> Need:
    """Identify q from the file that `record` wrote."""
    model = problem(size)
    identifier = _identifier(model, gain)
    for k, z in enumerate(np.load(path, mmap_mode="r")):
        _check(identifier.step(WIDTH * k, np.array(z)))
    return Need(_error(model, identifier), peak_memory() / 1e3 / model.X.dim)


def _identifier(model: Model, gain: float) -> Identifier:
    return Identifier(model, OMEGA, GradientLaw(gain, ResidualDamping(0.1)), q0=0.0, u0=2.0)


def _check(estimate: Any) -> None:
    if not estimate.status.ok:
        raise ConfigurationError(f"benchmark scale: {estimate.status}")


def _error(model: Model, identifier: Identifier) -> float:
    truth = model.initial_parameter(q_true)
    miss, mass = identifier.estimate().q - truth, model.parameter_mass
    return float(np.sqrt((miss @ (mass @ miss)) / (truth @ (mass @ truth))))


def _timed(run: Callable[[], Any]) -> tuple[float, Any]:
    start = process_time()
    result = run()
    return process_time() - start, result


def scale(
    sizes: Sequence[int] = SIZES, gains: Sequence[float] = GAINS, cubes: Sequence[int] = ()
) -> Outcome:
    """Compare steps of the law with forward steps.

    Parameters
    ----------
    sizes, cubes
        Numbers of nodes of squares and of cubes.
    gains
        Gains of the law.
    """
    meshes = [(size, 2) for size in sizes] + [(size, CUBE) for size in cubes]
    costs = [_cost(size, dimension, gain) for size, dimension in meshes for gain in gains]
    checks = [_ratio(cost) for cost in costs]
    for gain in gains:
        squares = [cost for cost in costs if cost.dimension == 2 and cost.gain == gain]
        if len(squares) > 1:
            first, last = squares[0], squares[-1]
            exponent = float(np.log(last.step / first.step) / np.log(last.nodes / first.nodes))
            name = f"gain {gain:g}: exponent of the cost, {first.nodes} to {last.nodes} nodes"
            checks.append(Check(name, exponent, EXPONENT, "<="))
    counted = iterations()
    table = _table("One step over one forward step", costs)
    note = (
        "Ratios of processor times measured in one process, step by step. The forward step is "
        "livepde.simulate with a stored factorisation."
    )
    return Outcome(tables=[table, *counted.tables], checks=[*checks, *counted.checks], notes=[note])


def million() -> Outcome:
    """Identify a field with a million nodes in a separate process, from samples in a file."""
    gain = GAINS[-1]
    with TemporaryDirectory() as folder:
        path = f"{folder}/samples.npy"
        _alone(f"record({HUGE}, {MILLION}, {path!r})")
        need = Need(**_alone(f"asdict(identify({HUGE}, {gain}, {path!r}))"))
    cost = _cost(HUGE, 2, gain)
    name = f"{cost.nodes} nodes, {MILLION} steps"
    checks = [
        Check(f"{name}: relative error of q (q = 0: 1)", need.error, ACCURACY, "<="),
        Check(f"{name}: kB for each coefficient of the state", need.memory, MEMORY, "<="),
        _ratio(cost),
    ]
    return Outcome(tables=[_table("One step over one forward step", [cost])], checks=checks)


def _cost(size: int, dimension: int, gain: float) -> Cost:
    return Cost(**_alone(f"asdict(measure({size}, {dimension}, {gain}, {FINDING + TIMED}))"))


def _alone(expression: str) -> Any:
    """Evaluate an expression with names of this module in a separate process."""
    program = (
        "import json; from dataclasses import asdict; from benchmarks.scale import *; "
        f"print(json.dumps({expression}))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["killed, perhaps for lack of memory"])[-1]
        raise ConfigurationError(f"benchmark scale: {expression}: {last}")
    return json.loads(done.stdout)


def _ratio(cost: Cost) -> Check:
    name = f"{cost.dimension}D, {cost.nodes} nodes, gain {cost.gain:g}: step / forward step"
    return Check(name, cost.ratio, RATIO, "<=")


def _table(title: str, costs: Sequence[Cost]) -> Table:
    columns = ("nodes", "dimension", "gain", "ratio", "min", "max", "error of q (q = 0: 1)")
    rows = [(c.nodes, c.dimension, c.gain, c.ratio, c.low, c.high, c.error) for c in costs]
    return Table(title, columns, rows)


def iterations(sizes: Sequence[int] = COUNTED) -> Outcome:
    """Count iterations for several gains, with u observed everywhere.

    Parameters
    ----------
    sizes
        Numbers of nodes of the square.
    """
    rows, checks = [], []
    for size in sizes:
        model = problem(size)
        for (c1, gain), bound in ITERATIONS.items():
            count, engines = _iterations(model, c1, gain)
            rows.append((model.X.dim, c1, gain, count, *engines))
            name = f"{model.X.dim} nodes, c1 {c1:g}, gain {gain:g}: iterations"
            checks.append(Check(name, count, bound, "<="))
    title = f"The first system of a coupled stage by blocks, to {TOLERANCE:.0e}"
    columns = ("nodes", "c1", "gain", "iterations", "engine of S", "engine of C")
    return Outcome(tables=[Table(title, columns, rows)], checks=checks)


def _bump(x: Any) -> Any:
    return 2.0 + x[0] * (1.0 - x[0]) * x[1] * (1.0 - x[1])


def _iterations(model: Model, c1: float, gain: float) -> tuple[int, tuple[str, str]]:
    """Return the number of iterations for a stage's first system, and the names of the engines."""
    split = Full().bind(model.state_space, model.X, model.parameter_space).split()
    forms = StageForms(model, split, h1_form, h1_form, 0.0)
    blocks = BlockSolver.of(StageTerms(forms, ResidualDamping(c1)))
    if blocks is None:
        raise ConfigurationError(
            f"benchmark scale: {model.X.dim} nodes are too few for blocks; use more."
        )
    u = model.initial(_bump)
    c = np.concatenate([u, model.initial_parameter(0.5)])
    metric = Metric(1.0 / gain)
    data = blocks.data(StageProblem(c, STEP, Moment(STEP), split.project(u), metric))
    at = blocks.evaluate(data, c)
    _, count = blocks.factor(data, at).iterate(at.residual, TOLERANCE)
    return count, (blocks.engines["S"], blocks.engines["C"])
