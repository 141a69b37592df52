"""Both laws on PETSc vectors: cost relative to a forward step, memory of a rank, weak scaling.

The models in DOLFINx are a heated plate and a reaction q(x). The filter estimates three constants
of the plate from three points, and the paper's law q(x) from u everywhere. Each law alternates with
`ImplicitStep`, which receives the true q. Each number of ranks is a separate program. Ranks wait
for each other, which amplifies other load on the machine. Therefore the shortest sample counts.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import ROOT
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import ConfigurationError
from livepde.petsc import DolfinxModel, ImplicitStep, PetscFilter, PetscObserver, number_modes
from livepde.petsc.petsc_model import gathered
from livepde.runs import Outcome

STEP = 0.05
FIRST = 2  # untimed samples, in which preconditioners are built
NUMBERS = [0.3, 1.0, 0.5]
FILTER = 1.5 * (1 + len(NUMBERS))  # bound on the cost of the filter, in forward steps
OBSERVER = 5.0  # bound on the cost of the paper's law, in forward steps
LARGE = 50_000  # number of nodes from which these bounds apply
EQUAL = 1e-6  # largest relative difference of the norm of q
SHARE = 1.3  # largest share of a rank, times the number of ranks
AS_ROOT = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
COLUMNS = ("ranks", "nodes", "law", "forward steps", "seconds", "efficiency", "share", "MB")


def petsc(size: int, ranks: Sequence[int], samples: int) -> Outcome:
    """Time steps with several numbers of ranks, with `size` nodes in all and for each rank.

    Parameters
    ----------
    size
        Number of nodes.
    ranks
        Numbers of ranks; the first is the reference for the others.
    samples
        Number of timed samples, of which the shortest counts.
    """
    command = shutil.which("mpirun")
    if command is None:
        raise ConfigurationError("benchmark petsc requires mpirun: see docs/parallel.md.")
    one, checks, rows = ranks[0], [], []
    # A fixed problem on all ranks, then a fixed number of nodes per rank (weak scaling).
    settings = [(count, size) for count in ranks]
    settings += [(count, size * count // one) for count in ranks[1:]]
    runs = {pair: _run(command, *pair, samples) for pair in settings}
    first = runs[one, size]
    for (count, nodes), run in runs.items():
        for law, bound in (("filter", FILTER), ("observer", OBSERVER)):
            cost, seconds = run[law]["cost"], run[law]["seconds"]
            ideal = first[law]["seconds"] * (one / count) * (nodes / size)
            share, memory = run["share"], run["memory"]
            rows.append((count, run["nodes"], law, cost, seconds, ideal / seconds, share, memory))
            name = f"{law}, {count} ranks, {run['nodes']} nodes"
            if run["nodes"] >= LARGE:
                checks.append(Check(f"{name}: forward steps", cost, bound, "<="))
            if nodes == size and count != one:
                apart = abs(run[law]["q"] / first[law]["q"] - 1.0)
                checks.append(Check(f"{name}: norm of q against {one}", apart, EQUAL, "<="))
        checks.append(
            Check(f"{count} ranks, {run['nodes']} nodes: share", run["share"], SHARE, "<=")
        )
    notes = [
        "forward steps: time of a sample over a step with known q. efficiency: per node, relative "
        f"to {one} rank(s). share: share of nonzeros on the largest rank, times the number of "
        "ranks. MB: memory of this rank, including libraries."
    ]
    return Outcome(tables=[Table("Both laws on PETSc", COLUMNS, rows)], checks=checks, notes=notes)


def _run(command: str, ranks: int, size: int, samples: int) -> dict[str, Any]:
    worker = [sys.executable, "-m", "mpi4py", "-m", "benchmarks.petsc", str(size), str(samples)]
    done = subprocess.run(
        [command, "-n", str(ranks), *worker],
        cwd=ROOT,
        env={**os.environ, **AS_ROOT, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no reason given"]
        raise ConfigurationError(f"benchmark petsc: {ranks} ranks ended with an error: {lines[0]}")
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def _models(cells: int) -> tuple[DolfinxModel, DolfinxModel]:
    """Return the plate with three unknown constants, and the reaction with an unknown field."""
    ufl, dolfinx = import_module("ufl"), import_module("dolfinx")
    comm = import_module("mpi4py.MPI").COMM_WORLD
    V = dolfinx.fem.FunctionSpace(
        dolfinx.mesh.create_unit_square(comm, cells, cells), ("Lagrange", 1)
    )
    left = [(lambda x: np.isclose(x[0], 0.0), lambda x, t: 2.0)]

    def heat(u: Any, q: Any, v: Any, x: Any, t: Any) -> Any:
        source = (1.0 + q[2] * x[0]) * (1.0 + ufl.sin(t))
        return q[0] * ufl.dot(ufl.grad(u), ufl.grad(v)) + q[1] * u * v - source * v

    def reaction(u: Any, q: Any, v: Any, x: Any, t: Any) -> Any:
        return 0.1 * ufl.dot(ufl.grad(u), ufl.grad(v)) + q * u * v - 10.0 * (1.0 + x[0]) * v

    points = [(0.21, 0.33), (0.6, 0.45), (0.5, 0.71)]
    first = DolfinxModel(V, NUMBERS, heat, dirichlet=left, sensors=points, symmetric=True)
    return first, DolfinxModel(V, V, reaction, dirichlet=left, symmetric=True)


def _timed(
    model: DolfinxModel, true: Any, samples: int, law: Any, state: Any, read: Callable[[Any], Any]
) -> tuple[dict[str, float], Any]:
    """Return times of a law on data of a true q, and its final state."""
    forward, u = ImplicitStep(model), model.interpolate(lambda x: 2.0)
    steps, times, comm = [], [], model.mesh.comm
    for k in range(FIRST + samples):
        comm.barrier()
        start = perf_counter()
        u = forward.solve(u, true, STEP * k, STEP)
        comm.barrier()
        middle = perf_counter()
        state, report = law.step(state, STEP * (k + 1), read(u))
        comm.barrier()
        steps.append(middle - start)
        times.append(perf_counter() - middle)
        if not report.status.ok:
            raise ConfigurationError(f"benchmark petsc: a step failed: {report.status}")
    seconds = float(np.min(times[FIRST:]))
    return {"cost": seconds / float(np.min(steps[FIRST:])), "seconds": seconds}, state


def _worker(size: int, samples: int) -> None:
    """Process samples on all ranks, and print times and memory as JSON."""
    few, field = _models(round(np.sqrt(size)) - 1)
    start = few.interpolate(lambda x: 2.0)
    modes = number_modes(few.create_q(), [0.1, 0.5, 0.5])
    law = PetscFilter(few, few.parameter(NUMBERS), modes, 1e-3)
    true = few.parameter([0.25, 1.5, 0.8])
    filtered, state = _timed(few, true, samples, law, law.init(start), law.read)
    filtered["q"] = float(np.linalg.norm(gathered(law.parameter(state))))
    paper = PetscObserver(field, gain=100.0)
    true = field.parameter(lambda x: 1.0 + x[0] * x[1])
    begin = paper.init(field.parameter(0.5), field.interpolate(lambda x: 2.0))
    learned, end = _timed(field, true, samples, paper, begin, lambda u: u)
    learned["q"] = float(end.q.norm())
    kinds = import_module("petsc4py.PETSc").Mat.InfoType
    comm, largest = few.mesh.comm, field.mass.getInfo(kinds.LOCAL)["nz_used"]
    share = comm.allreduce(largest, import_module("mpi4py.MPI").MAX) * comm.size
    memory = comm.allgather(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000.0)
    result = {
        "nodes": field.mass.getSize()[0],
        "filter": filtered,
        "observer": learned,
        "share": share / field.mass.getInfo(kinds.GLOBAL_SUM)["nz_used"],
        "memory": max(memory),
    }
    if comm.rank == 0:
        sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    _worker(int(sys.argv[1]), int(sys.argv[2]))
