"""How a step of the gradient law scales to large fields.

The process is heat conduction with an unknown reaction coefficient on a square or a cube, observed
in a part of it and moved by its boundary values; u and q are fields of the same nodes. Sources are
constant: a forward step is little more than one solve, and nothing else hides what the law costs.

For each size and gain a process of its own steps the law and then the forward model, with their
factors kept, and reports the ratio of processor times and the most memory it ever had. A second
table counts the iterations of one system by blocks with new factors, to 1e-8: they grow with the
gain, and with theta M_op, and hardly with the mesh.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from time import process_time
from typing import Any

import numpy as np

from livepde.errors import ConfigurationError
from livepde.fem import Field, Moment, box, dot, grad, linear, rectangle
from livepde.identifier import Identifier
from livepde.laws import GradientLaw, ResidualDamping
from livepde.laws.coupled import CoupledStage, Gains
from livepde.linalg import Array
from livepde.model import Model, h1_form
from livepde.observation import Full, Subdomain
from livepde.runs.outcome import Check, Outcome, Table
from livepde.stepping import Advance, ImplicitEuler, Newton, simulate
from livepde.stepping.newton import StepFailed

__all__ = ["GAINS", "SIZES", "iterations", "million", "scale"]

SIZES = (10_000, 100_000)  # nodes of the square
CUBE = 3  # dimensions
GAINS = (1.0, 1e2, 1e4)
RATIO = 2.5  # forward steps that a step of the law may cost
EXPONENT = 1.15  # of the cost of a step from the smallest to the largest square
MEMORY = 3.0  # kB for each coefficient of the state
HUGE = 1_000_000  # from here on memory is bounded: below, the interpreter itself counts
WIDTH = 0.0625  # time step, a binary number
FINDING, TIMED = 12, 12  # steps before those that are timed, and these
MILLION = 100  # steps of the run with a million nodes
ACCURACY = 0.2  # relative error of q there, at most

COUNTED = (2_500, 10_000)  # nodes where iterations are counted
TOLERANCE = 1e-8
STEP = 0.05
# (c_1, gain) -> iterations that the first system may take
ITERATIONS = {
    (0.0, 1.0): 4,
    (0.0, 1e2): 5,
    (0.0, 1e4): 8,
    (0.0, 1e6): 14,
    (1.0, 1.0): 5,
    (1.0, 1e2): 6,
    (1.0, 1e4): 17,
    (1.0, 1e6): 55,
}


@dataclass(frozen=True)
class Cost:
    """What one process measured.

    Attributes
    ----------
    nodes
        Of the mesh: each has a value of u and one of q.
    dimension, gain
        Of the mesh, and of the law.
    ratio, low, high
        Median, least and largest of step over forward step.
    step
        Processor time of a step.
    error
        Relative error of q at the end; that of q = 0 is 1.
    memory
        kB for each coefficient of the state, everything included.
    """

    nodes: int
    dimension: int
    gain: float
    ratio: float
    low: float
    high: float
    step: float
    error: float
    memory: float


def problem(size: int, dimension: int = 2) -> Model:
    """Return the process with about so many nodes."""
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


def _truth(x: Any) -> Any:
    return 2.0 + 3.0 * np.sin(np.pi * x[0]) ** 2 * np.sin(np.pi * x[1])


OMEGA = Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))


def _samples(model: Model, G: Any, q: Array, steps: int) -> Iterator[tuple[float, Array]]:
    times = (WIDTH * np.arange(steps + 1)).tolist()
    states = simulate(model, q, 2.0, times, Advance(ImplicitEuler()))
    return ((t, G @ u) for t, u in states)


def measure(size: int, dimension: int, gain: float, steps: int = FINDING + TIMED) -> Cost:
    """Step the law, then the forward model, in this process."""
    model = problem(size, dimension)
    n = model.X.dim
    G = OMEGA.matrix(model.state_space)
    truth = model.initial_parameter(_truth)
    law = GradientLaw(gain, ResidualDamping(0.1))
    identifier = Identifier(model, OMEGA, law, q0=0.0, u0=2.0)
    spent, forward, q = [], [], np.zeros(0)
    samples = _samples(model, G, truth, steps)
    identifier.step(*next(samples))
    for _ in range(steps):
        seconds, sample = _timed(partial(next, samples))
        forward.append(seconds)
        t, z = sample
        seconds, estimate = _timed(partial(identifier.step, t, z))
        if not estimate.status.ok:
            raise ConfigurationError(f"bench scale: {estimate.status}")
        spent.append(seconds)
        q = estimate.q
    timed = slice(min(FINDING, steps // 2), None)
    ratios = np.array(spent[timed]) / np.array(forward[timed])
    miss = q - truth
    mass = model.parameter_mass
    error = float(np.sqrt((miss @ (mass @ miss)) / (truth @ (mass @ truth))))
    return Cost(
        n,
        dimension,
        gain,
        float(np.sum(spent[timed]) / np.sum(forward[timed])),
        float(ratios.min()),
        float(ratios.max()),
        float(np.mean(spent[timed])),
        error,
        _peak() / n,
    )


def _timed(run: Callable[[], Any]) -> tuple[float, Any]:
    start = process_time()
    found = run()
    return process_time() - start, found


def _peak() -> float:
    """Return the most memory this process ever had, in kB."""
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e3 if sys.platform == "darwin" else most * 1.024


def scale(
    sizes: Sequence[int] = SIZES, gains: Sequence[float] = GAINS, cubes: Sequence[int] = ()
) -> Outcome:
    """Compare steps of the law with forward steps, each pair in a process of its own.

    Parameters
    ----------
    sizes, cubes
        Numbers of nodes of squares and of cubes.
    gains
        Of the law.
    """
    asked = [(size, 2) for size in sizes] + [(size, CUBE) for size in cubes]
    costs = [_alone(size, d, gain, FINDING + TIMED) for size, d in asked for gain in gains]
    checks = [check for cost in costs for check in _checks(cost)]
    for gain in gains:
        squares = [cost for cost in costs if cost.dimension == 2 and cost.gain == gain]
        if len(squares) > 1:
            first, last = squares[0], squares[-1]
            exponent = float(np.log(last.step / first.step) / np.log(last.nodes / first.nodes))
            name = f"gain {gain:g}: exponent of the cost, {first.nodes} to {last.nodes} nodes"
            checks.append(Check(name, exponent, EXPONENT, "<="))
    counted = iterations()
    table = _table("One step over one forward step, and what it needs", costs)
    note = (
        "Ratios of processor times taken in one process, step by step; the forward step is "
        "livepde.simulate with the factor kept. Memory is the most the process ever had, with "
        "interpreter, libraries, model, law, and the factor of the forward step."
    )
    return Outcome(tables=[table, *counted.tables], checks=[*checks, *counted.checks], notes=[note])


def million(size: int = HUGE) -> Outcome:
    """Identify a field with a million nodes in 100 steps."""
    cost = _alone(size, 2, GAINS[-1], MILLION)
    name = f"{cost.nodes} nodes, {MILLION} steps: relative error of q (q = 0: 1)"
    checks = [Check(name, cost.error, ACCURACY, "<="), *_checks(cost)]
    return Outcome(tables=[_table(f"{MILLION} steps", [cost])], checks=checks)


def _alone(size: int, dimension: int, gain: float, steps: int) -> Cost:
    """Return `measure` of a process of its own."""
    program = (
        "import json; from dataclasses import asdict; from livepde.bench.scale import measure; "
        f"print(json.dumps(asdict(measure({size}, {dimension}, {gain}, {steps}))))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["killed"])[-1]
        raise ConfigurationError(f"bench scale: {size} nodes, gain {gain:g}: {last}")
    return Cost(**json.loads(done.stdout))


def _checks(cost: Cost) -> list[Check]:
    name = f"{cost.dimension}D, {cost.nodes} nodes, gain {cost.gain:g}"
    checks = [Check(f"{name}: step / forward step", cost.ratio, RATIO, "<=")]
    if cost.dimension == 2 and cost.nodes > 0.9 * HUGE:
        checks.append(Check(f"{name}: kB for each coefficient", cost.memory, MEMORY, "<="))
    return checks


def _table(title: str, costs: Sequence[Cost]) -> Table:
    columns = ("nodes", "dimension", "gain", "ratio", "min", "max", "error of q", "kB")
    rows = [
        (c.nodes, c.dimension, c.gain, c.ratio, c.low, c.high, c.error, c.memory) for c in costs
    ]
    return Table(title, columns, rows)


def iterations(sizes: Sequence[int] = COUNTED) -> Outcome:
    """Count iterations at several gains, u observed everywhere.

    Parameters
    ----------
    sizes
        Numbers of nodes of the square: each has a value of u and one of q.
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
    """Return the iterations of a stage's first system, and the names of the engines."""
    observed = Full().bind(model.state_space, model.X, model.parameter_space)
    M_op = model.bilinear(h1_form)
    gains = Gains(gain, ResidualDamping(c1), 0.0, 0.0, M_op, M_op)
    stage = CoupledStage(model, observed.split(), gains, Newton(iterations=1))
    blocks = stage.by_blocks
    if blocks is None:
        raise ConfigurationError(
            f"bench scale: a problem with {model.X.dim} nodes is not solved by blocks; take more."
        )
    blocks.tolerance = TOLERANCE
    u = model.initial(_bump)
    c = np.concatenate([u, model.initial_parameter(0.5)])
    with suppress(StepFailed):  # one update is all that is wanted
        stage.solve(c, STEP, Moment(STEP), observed.split().R @ u, c.copy())
    return blocks.iterations[0], (blocks.engines["S"], blocks.engines["C"])
