"""What tests/test_parallel.py runs on several ranks: mpirun -n 2 python tests/ranks.py OUT.npz."""

import sys

import numpy as np
import scipy.sparse as sp

import livepde as lp
from livepde.laws.coupled.blocks import BlockSolver
from livepde.laws.coupled.distributed import DistributedSolver
from livepde.linalg import Pattern, choose, in_use
from livepde.parallel import petsc
from livepde.stepping import Advance, ImplicitEuler, Newton, simulate

CELLS = 50  # along each side: a band too wide for banded LU


def plate(kind: str = "tri") -> lp.Model:
    mesh = lp.rectangle((0, 1), (0, 0.8), (CELLS, CELLS))
    if kind == "tri":
        mesh = mesh.to_meshtri()
    return lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet={"right": 2.0}),
        parameter=lp.Field(mesh, lp.linear(mesh), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=[
            lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("left", lambda u, v, x: 3.0 * (u - 2.0) * v),  # not on every rank's cells
        ],
        f=lambda x, t: 10.0 * (1.0 + x[0]),
    )


def gradient() -> dict[str, np.ndarray]:
    """The paper's law, u observed everywhere, q a field: its stage is shared.

    A sample with a gap is rank 0's, which takes the stage by blocks.
    """
    engine, found = in_use(), {}
    model = plate() if engine is None else engine.build(plate)
    control = Advance(ImplicitEuler())
    q = model.initial_parameter(lambda x: 1.0 + x[0] * x[1])
    truth = list(simulate(model, q, bump, 0.05 * np.arange(4), control))
    law = lp.GradientLaw(gain=100.0, newton=Newton(share=0.0))
    identifier = lp.Identifier(model, lp.Full(), law, u0=bump, q0=0.5)
    for name, gap, (t, u) in zip(("first", "full", "gap"), (0, 0, 9), truth[1:], strict=True):
        z = u[model.X.free > 0.0]
        z[:gap] = np.nan
        estimate = identifier.step(t, z)
        assert estimate.status.ok
        found |= {f"{name}.q": estimate.q, f"{name}.u": estimate.u}
        solver = identifier._work.stage(np.isfinite(z)).solver
        shared = engine is not None and not gap
        assert isinstance(solver, DistributedSolver if shared else BlockSolver)
    return found


def refused() -> None:
    """A part of u, which the stage on several ranks does not know."""
    part = lp.Subdomain(lambda x: x[0] < 0.6)
    lp.Identifier(in_use().build(plate), part, lp.GradientLaw(), u0=bump, q0=0.5)


def bump(x: np.ndarray) -> np.ndarray:
    return 2.0 + 10.0 * x[0] * (1.0 - x[0]) * x[1] * (0.8 - x[1])


def sensitivity() -> dict[str, np.ndarray]:
    """A few modes of a field, from points: a factor for many right-hand sides."""
    model = plate("quad")
    sensors = lp.Points([(0.2, 0.3), (0.6, 0.4), (0.5, 0.7)], noise=0.01)
    law = lp.SensitivityLaw(modes=4, noise=0.01)
    identifier = lp.Identifier(model, sensors, law, u0=2.0)
    for k in range(1, 3):
        estimate = identifier.step(0.02 * k, np.array([2.1, 2.2, 2.15]) + 0.05 * k)
    assert estimate.status.ok
    return {"sensitivity.q": estimate.q, "sensitivity.u": estimate.u}


CASE = """
title = "A heated plate"
equation = "heat"
initial = 0
mesh = { x = [0, 1], y = [0, 0.8], cells = [50, 50] }
boundary = { left = 1, right = 0 }
law = { kind = "sensitivity", noise = 0.01, modes = 3 }
data = { file = "data.csv", time = "t", time_unit = "s" }

[unknowns.alpha]
prior = 0.1
std = 0.03
transform = "log"
field = true
length = 0.5

[channels]
near = { role = "sensor", column = "near", at = [0.2, 0.3] }
far = { role = "sensor", column = "far", at = [0.6, 0.5] }
"""


def case_data() -> str:
    rows = [
        f"{t},{0.8 * (1 - 0.25**k):.6f},{0.4 * (1 - 0.5**k):.6f}" for k, t in enumerate(range(4))
    ]
    return "\n".join(["t,near,far", *rows]) + "\n"


def systems() -> dict[str, np.ndarray]:
    """Symmetric systems and others, with one right-hand side and with several."""
    found = {}
    side = sp.diags_array([-np.ones(59), 4.1 * np.ones(60), -np.ones(59)], offsets=[-1, 0, 1])
    links = sp.diags_array([np.ones(59), np.ones(59)], offsets=[-1, 1])
    grid = sp.kron(sp.eye_array(60), side) - sp.kron(links, sp.eye_array(60))
    wind = sp.kron(sp.eye_array(60), sp.diags_array([np.ones(59)], offsets=[1]))
    b = np.random.default_rng(0).standard_normal((3600, 3))
    for name, matrix in (("symmetric", grid), ("other", grid + 0.3 * wind)):
        matrix = sp.csr_array(matrix)
        matrix.sort_indices()
        solver = choose(Pattern.of(matrix), symmetric=name == "symmetric").solver
        factor = solver.factorise(matrix.data)
        found[f"{name}.one"], found[f"{name}.many"] = factor.solve(b[:, 0]), factor.solve(b)
        np.testing.assert_allclose(matrix @ found[f"{name}.many"], b, atol=1e-8)
    return found


def everything() -> dict[str, np.ndarray]:
    return systems() | gradient() | sensitivity()


if __name__ == "__main__":
    with petsc() as engine:
        if engine is not None:
            found = everything()
            np.savez(sys.argv[1], ranks=engine.team.size, **found)
