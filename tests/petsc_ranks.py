"""Program that tests/test_petsc.py runs: mpirun -n 2 python -m mpi4py petsc_ranks.py.

petsc_ranks.py FOUND.npz [FOLDER] writes the results of all cases to a file. With FOLDER, it resumes
from the checkpoints there, or writes checkpoints halfway if there are none.
"""

import json
import sys
from pathlib import Path

import dolfinx
import numpy as np
import petsc_problems as problems
import ufl
from mpi4py import MPI
from petsc4py import PETSc

from livepde import petsc
from livepde.errors import LivepdeError
from livepde.laws.damping import ConstantDamping, ResidualDamping
from livepde.laws.equation_tests import ExcitationGate
from livepde.petsc.petsc_model import gathered

COMM = MPI.COMM_WORLD


def mesh():
    """Return the mesh of `problems.mesh`, distributed by DOLFINx."""
    given = problems.mesh()
    points, cells = (given.p.T, given.t.T) if COMM.rank == 0 else (given.p.T[:0], given.t.T[:0])
    element = ufl.Mesh(ufl.VectorElement("Lagrange", ufl.triangle, 1))
    return dolfinx.mesh.create_mesh(COMM, np.ascontiguousarray(cells), points, element)


def left(x):
    return np.isclose(x[0], 0.0)


def space(domain):
    return dolfinx.fem.FunctionSpace(domain, ("Lagrange", 1))


def numbers(domain):
    return petsc.DolfinxModel(
        space(domain),
        problems.PRIOR,
        lambda u, q, v, x, t: (
            q[0] * ufl.dot(ufl.grad(u), ufl.grad(v))
            + q[1] * u * v
            - problems.source(x[0], ufl.sin(t)) * v
        ),
        boundary=lambda u, q, v, x, t: 0.5 * (u - 1.0) * v,
        dirichlet=[(left, lambda x, t: 2.0)],
        sensors=problems.POINTS,
        symmetric=True,
    )


def reaction(domain, omega=None, edge=2.0):
    V = space(domain)
    return petsc.DolfinxModel(
        V,
        V,
        lambda u, q, v, x, t: (
            0.1 * ufl.dot(ufl.grad(u), ufl.grad(v)) + q * u * v - 10.0 * (1.0 + x[0]) * v
        ),
        dirichlet=[(left, lambda x, t: edge)],
        sensors=problems.POINTS,
        omega=omega,
        symmetric=True,
    )


def given(vector, order, values):
    """Set a vector from values in the original order of the mesh."""
    vector.getArray()[:] = np.asarray(values)[order]
    return vector


def ordered(vector, order):
    """Return all values in the original order of the mesh on rank 0, None on other ranks."""
    parts = COMM.gather((order, vector.getArray().copy()))
    if COMM.rank:
        return None
    result = np.zeros(sum(len(part) for part, _ in parts))
    for part, values in parts:
        result[part] = values
    return result


class Checkpoints:
    """Writes checkpoints halfway through a case to a folder, or resumes from them."""

    def __init__(self, folder):
        self.folder = None if folder is None else Path(folder)
        self.resumes = folder is not None and any(Path(folder).glob("*.json"))
        COMM.barrier()

    def begin(self, name, model, state):
        return petsc.load_state(self.folder / f"{name}.json", model) if self.resumes else state

    def keep(self, name, model, state, k, count):
        if self.folder is not None and not self.resumes and k == count // 2:
            petsc.save_state(self.folder / f"{name}.json", model, state)


def filtered(name, model, law, start, checkpoints, readings):
    state = checkpoints.begin(name, model, law.init(start))
    for k, (t, z) in enumerate(readings, 1):
        if t > state.t + 1e-9:
            state, report = law.step(state, t, z)
            assert report.status.ok, report.status
            checkpoints.keep(name, model, state, k, len(readings))
    return {
        f"{name}.q": ordered(law.parameter(state), model.numbers_q),
        f"{name}.std": ordered(law.deviation(state), model.numbers_q),
        f"{name}.u": ordered(state.u, model.numbers_u),
    }


def observed(name, model, law, checkpoints, data):
    q0, u0 = model.parameter(0.5), model.interpolate(lambda x: 2.0)
    state, held = checkpoints.begin(name, model, law.init(q0, u0)), []
    for k, (t, z) in enumerate(data, 1):
        if t > state.t + 1e-9:
            state, report = law.step(state, t, given(model.create_u(), model.numbers_u, z))
            assert report.status.ok, report.status
            checkpoints.keep(name, model, state, k, len(data))
            held.append(report.held)
    return {
        f"{name}.q": ordered(state.q, model.numbers_q),
        f"{name}.u": ordered(state.u, model.numbers_u),
        f"{name}.held": np.array(held),
    }


def filters(domain, checkpoints):
    model = numbers(domain)
    modes = petsc.number_modes(model.create_q(), problems.STD)
    prior, start = model.parameter(problems.PRIOR), model.interpolate(lambda x: 2.0)
    law = petsc.PetscFilter(model, prior, modes, problems.NOISE, gate=np.inf)
    found = filtered("numbers", model, law, start, checkpoints, problems.readings())
    model = reaction(domain)
    law = petsc.PetscFilter(
        model, model.parameter(1.0), petsc.leading_modes(model, problems.MODES), problems.NOISE
    )
    start = model.interpolate(lambda x: 2.0)
    return found | filtered("modes", model, law, start, checkpoints, problems.field_readings())


def observers(domain, checkpoints):
    found = {}
    laws = {
        "full": (None, {}),
        "part": (problems.omega, {"nu": 0.01, "sigma": 0.1}),
        "constant": (problems.omega, {"damping": ConstantDamping(mu=0.5)}),
        "bounded": (None, {"lower": 0.4, "upper": 1.2}),
    }
    for name, (omega, options) in laws.items():
        model = reaction(domain, omega)
        law = petsc.PetscObserver(model, gain=100.0, gate=None, tolerance=1e-9, **options)
        found |= observed(name, model, law, checkpoints, problems.data())
    model = reaction(domain, edge=0.0)
    law = petsc.PetscObserver(model, gain=100.0, gate=ExcitationGate(window=2.0))
    return found | observed("rest", model, law, checkpoints, problems.rest())


def shares(domain):
    """Return for each rank the owned rows, the nonzeros, and the cells including ghosts."""
    model = reaction(domain)
    info = model.mass.getInfo(PETSc.Mat.InfoType.LOCAL)
    cells = domain.topology.index_map(2)
    mine = (
        model.create_u().getLocalSize(),
        info["nz_used"],
        cells.size_local + cells.num_ghosts,
    )
    return {"shares": np.array(COMM.allgather(mine))}


def checked(domain):
    model = reaction(domain, problems.omega)
    u, w = model.interpolate(lambda x: 1.0 + x[0]), model.interpolate(lambda x: 2.0 + x[1])
    reports = [
        petsc.check_petsc_model(model, u, model.parameter(0.5), 0.1, w),
        petsc.check_petsc_model(numbers(domain), u, numbers(domain).parameter([0.3, 1.0]), 0.1),
    ]
    wrong = reaction(domain)

    def doubled(u, q, t, w):
        matrix = model.jacobian_q(u, q, t).copy()
        matrix.scale(2.0)
        return matrix

    wrong.jacobian_q = doubled
    reports.append(petsc.check_petsc_model(wrong, u, model.parameter(0.5), 0.1))
    return {"checks": np.array([report.ok for report in reports])}


def refusals(domain, folder):
    """Return the error messages of invalid arguments."""
    model, V = reaction(domain), space(domain)
    few, u = numbers(domain), model.create_u()
    modes, prior = petsc.number_modes(few.create_q(), problems.STD), few.create_q()
    law = petsc.PetscFilter(few, prior, modes, problems.NOISE)
    observer = petsc.PetscObserver(few, gate=None)

    def form(u, q, v, x, t):
        return q * u * v

    petsc.save_state(folder / "small.json", few, law.init(u))
    attempts = {
        "modes": lambda: petsc.PetscFilter(few, prior, [], 1.0),
        "noise": lambda: petsc.PetscFilter(few, prior, modes, 0.0),
        "filter bounds": lambda: petsc.PetscFilter(few, prior, modes, 1.0, lower=1.0, upper=0.0),
        "z": lambda: law.step(law.init(u), 0.1, [1.0]),
        "time": lambda: law.step(law.init(u), 0.0, [1.0, 2.0, 3.0]),
        "gain": lambda: petsc.PetscObserver(model, gain=0.0),
        "nu": lambda: petsc.PetscObserver(model, nu=-1.0),
        "bounds": lambda: petsc.PetscObserver(model, lower=1.0, upper=0.0),
        "sample time": lambda: observer.step(observer.init(prior, u), 0.0, u),
        "numbers": lambda: observer.step(observer.init(prior, u), 0.1, u),
        "outside": lambda: petsc.DolfinxModel(V, V, form, sensors=[(2.0, 2.0)]),
        "element": lambda: (
            petsc.DolfinxModel(
                dolfinx.fem.FunctionSpace(domain, ("Lagrange", 2)), V, form
            ).numbers_u
        ),
        "no checkpoint": lambda: petsc.load_state(folder / "none.json", few),
        "another model": lambda: petsc.load_state(folder / "small.json", model),
    }
    messages = {}
    for name, attempt in attempts.items():
        try:
            attempt()
        except LivepdeError as error:
            messages[name] = f"{type(error).__name__}: {error}"
    return messages


def opened(domain):
    """Return the state residual after a step without damping, with a nonlinear Robin boundary."""
    V = space(domain)
    model = petsc.DolfinxModel(
        V,
        V,
        lambda u, q, v, x, t: ufl.dot(ufl.grad(u), ufl.grad(v)) + q * u * v - 10.0 * v,
        boundary=lambda u, q, v, x, t: 5.0 * u**3 * v,
    )
    damping = ResidualDamping(0.0)
    law = petsc.PetscObserver(model, gain=10.0, damping=damping, gate=None, tolerance=1e-9)
    begin, data = model.interpolate(lambda x: 2.0), model.interpolate(lambda x: 2.0 + x[0])
    state, report = law.step(law.init(model.parameter(0.5), begin), 0.1, data)
    assert report.status.ok
    rate = model.mass * ((state.u - begin) / 0.1)
    left = rate + model.residual(state.u, state.q, 0.1, data)
    return left.norm() / rate.norm()


def failures(domain):
    """Return the status of a step without a solution, which must not change the state."""
    V = space(domain)
    model = petsc.DolfinxModel(
        V, [1.0], lambda u, q, v, x, t: q[0] * ufl.sqrt(u - 10.0) * v, sensors=problems.POINTS
    )
    u, q = model.interpolate(lambda x: 2.0), model.create_q()
    law = petsc.PetscFilter(model, q, petsc.number_modes(q, 1.0), 1.0)
    first = law.init(u)
    after, report = law.step(first, 0.1, np.zeros(3))
    return f"{report.status}" if after is first else "moved"


def robust(domain):
    """Run the filter with outliers and bounds; return used readings and estimates in bounds."""
    model = numbers(domain)
    modes = petsc.number_modes(model.create_q(), problems.STD)
    prior, start = model.parameter(problems.PRIOR), model.interpolate(lambda x: 2.0)
    law = petsc.PetscFilter(model, prior, modes, problems.NOISE, patience=2, lower=0.1, upper=1.05)
    state, used, inside = law.init(start), [], []
    for t, z in problems.readings():
        z[2] += 50.0
        state, report = law.step(state, t, z)
        used.append(report.used)
        q = gathered(law.parameter(state))
        raw = prior + modes[0] * state.a[0] + modes[1] * state.a[1]
        inside.append([q.min(), q.max(), (raw - law.parameter(state)).norm()])
    return {"robust.used": np.array(used), "robust.inside": np.array(inside)}


if __name__ == "__main__":
    domain = mesh()
    checkpoints = Checkpoints(sys.argv[2] if len(sys.argv) > 2 else None)
    found = filters(domain, checkpoints) | observers(domain, checkpoints)
    if checkpoints.folder is None:
        folder = Path(sys.argv[1]).parent
        said = refusals(domain, folder)
        found |= shares(domain) | checked(domain) | robust(domain)
        found |= {"said": json.dumps(said), "failed": failures(domain), "open": opened(domain)}
    if COMM.rank == 0:
        np.savez(sys.argv[1], ranks=COMM.size, **found)
