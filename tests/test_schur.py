"""Large coupled stages by blocks: the same results as by one factor, in few iterations."""

from __future__ import annotations

import numpy as np
import pytest

import livepde as lp
from livepde.bench import scale
from livepde.errors import ConfigurationError, LinearAlgebraError
from livepde.fem import Moment
from livepde.laws import coupled, schur
from livepde.linalg import choice

EXACT = lp.Newton(tolerance=1e-11)


def inside(x):
    return (x[0] < 0.6) | (x[1] < 0.6)


def plane(cells=16, *, A=lambda q, u, v, x: q * u * v, inner="H1", diffusion=1.0, **options):
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells)).to_meshtri()
    return lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 2.0}),
        parameter=lp.Field(mesh, lp.linear(mesh), inner=inner),
        A=A,
        B=lambda u, v, x: diffusion * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: 10 * (1 + x[0]) * (1 + 0.3 * np.sin(3 * t)),
        **options,
    )


def data(model, sensors, times):
    q = model.initial_parameter(lambda x: 1 + np.sin(np.pi * x[0]) ** 2 * x[1])
    G = sensors.matrix(model.state_space)
    return [G @ u for _, u in lp.simulate(model, q, 2.0, times, lp.Advance(lp.ImplicitEuler()))]


def run(model, sensors, law, monkeypatch, large, samples=5, **options):
    """Return (u, q) of each step, and the iterations of each solve by blocks."""
    monkeypatch.setattr(coupled, "LARGE", 1 if large else 10**9)
    monkeypatch.setattr(choice, "WIDEST_BAND", 20)  # as it would be on a finer mesh
    times = 0.05 * np.arange(samples)
    ident = lp.Identifier(model, sensors, law, q0=0.5, u0=2.0, **options)
    counts = []
    account = schur.BlockSolver.account

    def counted(self, iterations, seconds):
        counts.append(iterations)
        account(self, iterations, seconds)

    monkeypatch.setattr(schur.BlockSolver, "account", counted)
    found = []
    for t, z in zip(times, data(model, sensors, times), strict=True):
        estimate = ident.step(t, z)
        assert estimate.status.ok
        found.append(np.concatenate([estimate.u, estimate.q]))
    monkeypatch.setattr(schur.BlockSolver, "account", account)
    return np.array(found), counts


CASES = {
    "all observed": ({}, lp.Full(), {}),
    "a part observed": ({}, lp.Subdomain(inside), {}),
    "constant mu, nu, sigma": (
        {},
        lp.Subdomain(inside),
        {"damping": lp.ConstantDamping(0.5, floor=0.1), "nu": 0.1, "sigma": 0.1},
    ),
    "a diffusivity": (
        {"A": lambda q, u, v, x: (0.1 + q) * lp.dot(lp.grad(u), lp.grad(v)), "diffusion": 0.0},
        lp.Full(),
        {},
    ),
    "time-dependent": ({"A": lambda q, u, v, x: (1 + x.t) * q * u * v}, lp.Full(), {}),
    "nonlinear in q": ({"A": lambda q, u, v, x: q**3 * u * v}, lp.Full(), {}),
    "H^1.5": ({"inner": lp.Sobolev(1.5, length=0.3)}, lp.Full(), {}),
    "tunes itself": ({}, lp.Full(), {"gain": "auto"}),
}


@pytest.mark.parametrize("name", CASES)
def test_blocks_do_not_change_the_result(name, monkeypatch):
    form, sensors, options = CASES[name]
    model = plane(**form)
    law = lp.GradientLaw(**{"gain": 1e3, "newton": EXACT} | options)
    direct, none = run(model, sensors, law, monkeypatch, large=False)
    blocks, counts = run(model, sensors, law, monkeypatch, large=True)
    assert not none
    assert counts
    np.testing.assert_allclose(blocks, direct, rtol=0, atol=1e-8 * abs(direct).max())


def test_blocks_serve_the_second_order_scheme_and_averages(monkeypatch):
    model = plane()
    sensors = lp.Averages({f"z{k}": lambda x, k=k: abs(x[0] - 0.2 * k) < 0.1 for k in range(1, 5)})
    law = lp.GradientLaw(gain=1e2, newton=EXACT)
    options = {"scheme": lp.Alexander2()}
    direct, _ = run(model, sensors, law, monkeypatch, large=False, **options)
    blocks, counts = run(model, sensors, law, monkeypatch, large=True, **options)
    assert counts
    np.testing.assert_allclose(blocks, direct, rtol=0, atol=1e-8 * abs(direct).max())


def first_stage(model, gain, monkeypatch):
    monkeypatch.setattr(coupled, "LARGE", 1)
    monkeypatch.setattr(choice, "WIDEST_BAND", 20)
    law = lp.GradientLaw(gain=gain, damping=lp.ResidualDamping(1.0))
    ident = lp.Identifier(model, lp.Full(), law, q0=0.5, u0=2.0)
    stage = ident._work.stage(np.ones(ident.observed.size, dtype=bool))
    u = model.initial(lambda x: 2.0 + x[0] * (1 - x[0]) * x[1] * (1 - x[1]))
    c = np.concatenate([u, model.initial_parameter(0.5)])
    equation = coupled._Equation(stage, c, 0.05, Moment(0.05), stage.split.R @ u)
    return stage, equation, c


def test_iterations_with_new_factors(monkeypatch):
    """To 1e-8, on two meshes: they hardly depend on the mesh."""
    monkeypatch.setattr(coupled, "LARGE", 1)
    monkeypatch.setattr(choice, "WIDEST_BAND", 20)
    outcome = scale.scale((300, 1100))
    assert len(outcome.checks) == 2 * len(scale.BOUNDS)
    assert [check.name for check in outcome.checks if not check.ok] == []
    assert all("LU" in row[4] and row[5] for row in outcome.tables[0].rows)
    monkeypatch.setattr(coupled, "LARGE", 10**9)
    with pytest.raises(ConfigurationError, match="take more"):
        scale.scale((300,))


def test_factors_are_kept_while_that_pays_and_renewed_where_they_fail(monkeypatch):
    stage, equation, c = first_stage(plane(), 1e3, monkeypatch)
    blocks = stage.by_blocks
    residual = equation.residual(c)
    equation.factor(c, sweep=True).solve(residual)
    first = blocks._factors
    blocks.costs.factor = np.inf  # new factors never pay
    equation.factor(0.9 * c, sweep=True).solve(residual)
    assert blocks._factors is first
    monkeypatch.setattr(schur, "ITERATIONS", 6)
    far = coupled._Equation(stage, c, 50.0, Moment(50.0), c[: stage.n])
    residual = far.residual(c)
    x = far.factor(c, sweep=True).solve(residual)
    assert blocks._factors is not first  # 6 iterations with the factors of h = 0.05 are too few
    assert np.isfinite(x).all()
    again = blocks._factors
    blocks.costs.extra = 2.0 * blocks.costs.factor  # they have cost more than new ones
    far.factor(c, sweep=True).solve(residual)
    assert blocks._factors is not again


def test_a_system_that_does_not_converge_is_a_status(monkeypatch):
    stage, equation, c = first_stage(plane(), 1e6, monkeypatch)
    monkeypatch.setattr(schur, "ITERATIONS", 1)
    monkeypatch.setattr(schur, "TOLERANCE", 0.0)
    residual = equation.residual(c)
    with pytest.raises(LinearAlgebraError, match="smaller gain or a smaller time step"):
        equation.factor(c, sweep=True).solve(residual)
    assert not stage.by_blocks.cycles  # without them it does not converge either
    model, sensors = plane(), lp.Full()
    times = 0.05 * np.arange(2)
    ident = lp.Identifier(model, sensors, lp.GradientLaw(gain=1e6), q0=0.5, u0=2.0)
    z = data(model, sensors, times)
    ident.step(0.0, z[0])
    estimate = ident.step(0.05, z[1])
    assert not estimate.status.ok
    assert np.isfinite(estimate.u).all()


def test_infinite_coefficients_are_refused(monkeypatch):
    stage, _, _ = first_stage(plane(), 1.0, monkeypatch)
    data = np.full(stage.solver.pattern.nnz, np.inf)
    with pytest.raises(LinearAlgebraError, match="finite"):
        stage.by_blocks.factorise(data, 0.05, 1.0)


def test_banded_problems_are_factorised_at_any_size(monkeypatch):
    monkeypatch.setattr(coupled, "LARGE", 1)
    mesh = lp.interval(0.0, 1.0, 40)
    model = lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
        parameter=lp.Field(mesh, lp.linear(mesh)),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    ident = lp.Identifier(model, lp.Full(), lp.GradientLaw(), q0=0.5, u0=0.0)
    assert ident._work.stage(np.ones(ident.observed.size, dtype=bool)).by_blocks is None
