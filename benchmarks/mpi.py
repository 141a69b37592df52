"""The gradient law on one rank and on more: how much faster, and what crosses between ranks.

A plate, heated and with a reaction q(x) that is as large a field as u, which is observed
everywhere: only then several ranks share the stage. Stages are solved to Newton's tolerance. Runs
with one rank and with more take turns, each a program of its own, and the shortest counts. Where
the system permits it (to root), timed steps have real-time priority: ranks wait for each other, so
that other work would count many times.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from time import perf_counter
from typing import Any

import numpy as np
import scipy.sparse as sp

from benchmarks import ROOT
from livepde.errors import ConfigurationError
from livepde.fem import Field, dot, grad, linear, rectangle
from livepde.identifier import Identifier
from livepde.laws import GradientLaw
from livepde.linalg import Array, Pattern, analyse
from livepde.model import Model
from livepde.observation import Full
from livepde.parallel import Team
from livepde.runs.outcome import Check, Outcome, Table
from livepde.stepping import Newton

__all__ = ["mpi", "plate"]

STEP = 0.05
FIRST = 2  # samples before the clock starts: matrices are laid out, and Newton comes close
AS_ROOT = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
FASTER = 1.6  # two ranks, at least,
LARGE = 200_000  # from so many nodes on
EQUAL = 1e-6  # of q, relative
TRAFFIC = ("messages", "size", "reductions", "led_messages", "led_size")  # see parallel.traffic


def mpi(size: int, ranks: Sequence[int], samples: int, rounds: int) -> Outcome:
    """Time steps with several numbers of ranks, in turns.

    Parameters
    ----------
    size
        Number of nodes: each has a value of u and one of q.
    ranks
        Numbers of ranks; the first is what the others are held against.
    samples
        Of which the time counts.
    rounds
        How often the runs take turns.
    """
    command = shutil.which("mpirun")
    if command is None:
        raise ConfigurationError("benchmark mpi needs mpirun: see docs/parallel.md.")
    found: dict[int, list[dict[str, Any]]] = {count: [] for count in ranks}
    for _ in range(rounds):
        for count in ranks:
            found[count].append(_run(command, count, size, samples))
    times = {count: min(run["seconds"] for run in runs) for count, runs in found.items()}
    one = ranks[0]
    rows = [
        (
            count,
            runs[0]["nodes"],
            times[one] / times[count],
            max(run["memory"] for run in runs),
            *(runs[0]["traffic"][name] for name in TRAFFIC),
        )
        for count, runs in found.items()
    ]
    columns = (
        *("ranks", "nodes", "speed-up", "MB of rank 0", "messages", "MB sent", "reductions"),
        *("messages of rank 0", "MB of its vectors"),
    )
    nodes = found[one][0]["nodes"]
    checks = []
    for count in ranks[1:]:
        apart = _apart(found[one][0]["q"], found[count][0]["q"])
        checks.append(Check(f"{count} ranks: q against {one}", apart, EQUAL, "<="))
        if count == 2 and nodes >= LARGE:
            checks.append(Check("2 ranks: speed-up", times[one] / times[2], FASTER, ">="))
    title = f"A step of the gradient law with PETSc, {nodes} nodes; what crosses in a step"
    notes = [f"A step took {t:.2g} s on {count} ranks here." for count, t in times.items()]
    return Outcome(tables=[Table(title, columns, rows)], checks=checks, notes=notes)


def _apart(a: Sequence[float], b: Sequence[float]) -> float:
    return float(np.linalg.norm(np.subtract(a, b)) / np.linalg.norm(a))


def _run(command: str, ranks: int, size: int, samples: int) -> dict[str, Any]:
    worker = [sys.executable, "-m", "benchmarks.mpi", str(size), str(samples)]
    done = subprocess.run(
        [command, "-n", str(ranks), *worker],
        cwd=ROOT,
        env={**os.environ, **AS_ROOT, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = done.stderr.strip().splitlines() or ["no reason given"]
        raise ConfigurationError(f"benchmark mpi: {ranks} ranks ended with an error: {said[0]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def plate(size: int) -> Model:
    """Return the model with about so many nodes."""
    cells = round(np.sqrt(size)) - 1
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells)).to_meshtri()
    return Model(
        state=Field(mesh, linear(mesh), dirichlet={"boundary": 2.0}),
        parameter=Field(mesh, linear(mesh), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: 0.1 * dot(grad(u), grad(v)),
        f=lambda x, t: 10.0 * (1.0 + x[0]),
    )


def _trajectory(model: Model, samples: int) -> list[Array]:
    """Return what the true q does, by the scheme of the law."""
    free = model.X.free
    q = model.initial_parameter(lambda x: 1.0 + x[0] * x[1])
    u = model.initial(2.0)
    forward = model.form_A.matrix("v", "u", q=q) + model.form_B.matrix("v", "u")
    whole = sp.csr_array(model.mass / STEP + forward)
    mask = sp.diags_array(free)
    inner = sp.csr_array(mask @ whole @ mask + sp.diags_array(1.0 - free))
    inner.sort_indices()
    factor = analyse(Pattern.of(inner), symmetric=True).factorise(inner.data)
    found = []
    for _ in range(samples):
        residual = whole @ u - model.mass @ (u / STEP) - model.F()
        u = u - factor.solve(residual * free)
        found.append(u)
    return found


class Undisturbed:
    """Gives every rank real-time priority, where that is permitted."""

    def __init__(self, team: Team) -> None:
        with suppress(PermissionError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))

    def close(self) -> None:
        """The process ends soon."""


def _worker(size: int, samples: int) -> None:
    """Take samples on all ranks, and print what it took."""
    from livepde.parallel import petsc
    from livepde.parallel.traffic import TrafficLog, traffic

    with petsc() as engine:
        if engine is None:
            return
        log = engine.team.share(TrafficLog)
        model = engine.build(plate, size)
        truth = _trajectory(model, FIRST + samples)
        # Else what a prediction lets Newton leave, by default, is what q would differ by.
        law = GradientLaw(gain=100.0, newton=Newton(share=0.0))
        identifier = Identifier(model, Full(), law, u0=2.0, q0=0.5)
        free, seconds = model.X.free > 0.0, []
        for k, u in enumerate(truth):
            if k == FIRST:
                before = traffic(log)
                engine.team.share(Undisturbed)
            start = perf_counter()
            estimate = identifier.step((k + 1) * STEP, u[free])
            seconds.append(perf_counter() - start)
            if not estimate.status.ok:
                raise ConfigurationError(f"benchmark mpi: a step failed: {estimate.status}")
        crossed = traffic(log).since(before)
        scale = {"size": 1e6, "led_size": 1e6}
        shown = {
            name: value / samples / scale.get(name, 1.0) for name, value in vars(crossed).items()
        }
        result = {
            "nodes": model.X.dim,
            "seconds": float(np.sum(seconds[FIRST:])) / samples,
            "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000.0,
            "traffic": shown,
            "q": estimate.q[:: max(1, len(estimate.q) // 1000)].tolist(),
        }
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    _worker(int(sys.argv[1]), int(sys.argv[2]))
