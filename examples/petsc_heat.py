"""Filter on many ranks: conductivity and loss of a plate from three thermometers.

On four ranks: mpirun -n 4 python -m mpi4py examples/petsc_heat.py.
"""

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from livepde import petsc
from livepde.petsc.petsc_model import gathered

STEP, NOISE, TRUTH = 0.05, 0.002, [0.4, 1.5]


def plate(cells=60):
    """Return u_t - k laplace(u) + s u = 3 (1 + x), u = 1 on the left, measured at three points."""
    domain = mesh.create_unit_square(MPI.COMM_WORLD, cells, cells)
    V = fem.FunctionSpace(domain, ("Lagrange", 1))

    def form(u, q, v, x, t):
        k, s = q
        return k * ufl.dot(ufl.grad(u), ufl.grad(v)) + s * u * v - 3.0 * (1.0 + x[0]) * v

    return petsc.DolfinxModel(
        V,
        [0.3, 1.0],
        form,
        dirichlet=[(lambda x: np.isclose(x[0], 0.0), lambda x, t: 1.0)],
        sensors=[(0.2, 0.3), (0.6, 0.45), (0.9, 0.7)],
        symmetric=True,
    )


def main(cells=60, samples=40):
    """Run the filter; return estimate and standard deviation of k and s."""
    model = plate(cells)
    prior, modes = model.parameter([0.3, 1.0]), petsc.number_modes(model.create_q(), [0.1, 0.5])
    law = petsc.PetscFilter(model, prior, modes, NOISE, lower=0.01)
    u, truth = model.interpolate(lambda x: 1.0), model.parameter(TRUTH)
    state, process, rng = law.init(u), petsc.ImplicitStep(model), np.random.default_rng(0)
    for k in range(samples):
        u = process.solve(u, truth, STEP * k, STEP)  # your measurements here
        z = law.read(u) + NOISE * rng.standard_normal(3)
        state, report = law.step(state, STEP * (k + 1), z)
        if not report.status.ok:
            raise SystemExit(str(report.status))
    q, std = gathered(law.parameter(state)), gathered(law.deviation(state))
    return {"k": (q[0], std[0]), "s": (q[1], std[1])}


if __name__ == "__main__":
    found = main()
    if MPI.COMM_WORLD.rank == 0:
        print(*(f"{name} = {v:.3f} ± {s:.3f}" for name, (v, s) in found.items()), sep="\n")
