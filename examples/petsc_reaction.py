"""The paper's law on many ranks: a reaction q(x) on a fully observed plate.

Halfway, the state is saved and loaded; another number of ranks could also load it. On four ranks:
mpirun -n 4 python -m mpi4py examples/petsc_reaction.py.
"""

import tempfile
from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from livepde import petsc

STEP = 0.05


def plate(cells):
    """Return u_t - 0.1 laplace(u) + q(x) u = 10 (1 + x) with u = 2 on the left."""
    domain = mesh.create_unit_square(MPI.COMM_WORLD, cells, cells)
    V = fem.FunctionSpace(domain, ("Lagrange", 1))

    def form(u, q, v, x, t):
        return 0.1 * ufl.dot(ufl.grad(u), ufl.grad(v)) + q * u * v - 10.0 * (1.0 + x[0]) * v

    edge = [(lambda x: np.isclose(x[0], 0.0), lambda x, t: 2.0)]
    return petsc.DolfinxModel(V, V, form, dirichlet=edge, symmetric=True)


def main(cells=60, samples=60, folder=None):
    """Run the law; return the relative L2 error of q at the beginning and at the end."""
    model = plate(cells)
    law = petsc.PetscObserver(model, gain=1000.0, lower=0.0)
    u, truth = model.interpolate(lambda x: 2.0), model.parameter(lambda x: 1.0 + x[0] * x[1])
    state, process = law.init(model.parameter(0.5), u), petsc.ImplicitStep(model)

    def error():
        e = state.q - truth
        return float(np.sqrt(e.dot(model.mass_q * e) / truth.dot(model.mass_q * truth)))

    first = error()
    for k in range(samples):
        u = process.solve(u, truth, STEP * k, STEP)  # your measurements here
        state, report = law.step(state, STEP * (k + 1), u)
        if not report.status.ok:
            raise SystemExit(str(report.status))
        if folder is not None and k == samples // 2:
            petsc.save_state(Path(folder) / "state.json", model, state)
            state = petsc.load_state(Path(folder) / "state.json", model)
    return first, error()


if __name__ == "__main__":
    shared = MPI.COMM_WORLD.bcast(tempfile.mkdtemp() if MPI.COMM_WORLD.rank == 0 else None)
    first, last = main(folder=shared)
    if MPI.COMM_WORLD.rank == 0:
        print(f"relative error of q: {first:.2f} at first, {last:.4f} at the end")
