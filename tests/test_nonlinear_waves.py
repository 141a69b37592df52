"""Burgers, Korteweg-de Vries, Kuramoto-Sivashinsky, Allen-Cahn: exact solutions, checks, data."""

import importlib.util
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from skfem import ElementLineHermite

import livepde as lp
from livepde.models import allen_cahn, burgers, kdv, kuramoto_sivashinsky
from livepde.stepping import Advance, Alexander2, simulate

ONE = lp.Normal(1.0, 1.0)


def cole_hopf(x, t, nu):
    """u = -2 nu phi_x/phi with phi = 1.5 + exp(-nu t) cos x, for a = 1."""
    phi, slope = 1.5 + np.exp(-nu * t) * np.cos(x), -np.exp(-nu * t) * np.sin(x)
    return -2 * nu * slope / phi


def soliton(x, t, a, b, speed, start):
    """Height 3 speed/a, on the whole line."""
    return 3 * speed / a / np.cosh(np.sqrt(speed / b) / 2 * (x - start - speed * t)) ** 2


def front(x, t, D, r):
    """u = 1 grows into u = 0 at the speed 3 (r D/2)^(1/2)."""
    return 0.5 - 0.5 * np.tanh(np.sqrt(r / D / 8) * (x - 3 * np.sqrt(r * D / 2) * t))


def error(model, q, exact, times):
    """Return the largest error at the end at the vertices."""
    stream = simulate(model, np.array(q), lambda x: exact(x[0], 0.0), times, Advance(Alexander2()))
    *_, (t, u) = stream
    found = model.state_block.at_vertices @ u - exact(model.state.mesh.p[0], t)
    return np.abs(found).max()


def ring(function, length, *given):
    return lambda n: function(lp.interval(0.0, length, n), *given)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "q", "exact", "cells", "stop", "bound"),
    [
        (ring(burgers, 2 * np.pi, ONE, ONE), [1.0, 0.3], partial(cole_hopf, nu=0.3), 20, 3.0, 2e-5),
        (
            ring(kdv, 40.0, ONE, ONE),
            [6.0, 1.0],
            partial(soliton, a=6.0, b=1.0, speed=1.0, start=15.0),
            80,
            8.0,
            1e-3,  # of a height of 0.5
        ),
        (
            lambda n: allen_cahn(lp.interval(-2.0, 3.0, n), ONE, ONE, dirichlet={}),
            [0.02, 3.0],
            partial(front, D=0.02, r=3.0),
            40,
            2.0,
            1e-3,
        ),
    ],
    ids=["burgers", "soliton", "front"],
)
def test_exact_solutions_at_second_order_in_time(build, q, exact, cells, stop, bound):
    coarse, fine = (
        error(build(n), q, exact, np.linspace(0.0, stop, n + 1)) for n in (cells, 2 * cells)
    )
    assert fine < bound
    assert coarse / fine > 3.5


@pytest.mark.slow
def test_burgers_scales_with_its_advection():
    """a u obeys the equation with a = 1."""
    mesh, nu, a = lp.interval(0.0, 2 * np.pi, 30), 0.3, 2.5
    model = burgers(mesh, ONE, a)
    scaled = lambda x, t: cole_hopf(x, t, nu) / a  # noqa: E731
    assert error(model, [nu], scaled, np.linspace(0, 3, 61)) < 2e-5


@pytest.mark.slow
def test_small_waves_of_kuramoto_sivashinsky_grow_as_they_must():
    mesh, k = lp.interval(0.0, 4 * np.pi, 40), 0.5
    model = kuramoto_sivashinsky(mesh, 1.0, ONE, ONE)
    b, c = 1.5, 0.8
    rate = b * k**2 - c * k**4
    small = lambda x, t: 1e-7 * np.exp(rate * t) * np.cos(k * x)  # noqa: E731
    assert error(model, [b, c], small, np.linspace(0.0, 2.0, 41)) < 1e-4 * 1e-7


def unknowns(mesh, *values):
    start = lp.Field(mesh, ElementLineHermite(), inner="H1", prior=lp.Normal(std=1.0))
    return *(lp.LogNormal(v, v) for v in values), start


def test_an_unknown_start_takes_over_the_sides():
    mesh = lp.interval(0.0, 1.0, 6)
    nu, start = unknowns(mesh, 0.1)
    ring = burgers(mesh, nu, u0=start)
    assert ring.parameter_space.fields["u0"].size == ring.X.dim == 12
    held = burgers(mesh, nu, u0=start, dirichlet={"left": 0.0, "right": 1.0})
    fixed = held.parameter_space.fixed - 1  # behind nu
    assert held.parameter_space.fields["u0"].field.dirichlet == {"left": 0.0}
    assert fixed.tolist() == [0]


def reader():
    path = Path(__file__).parents[1] / "cases" / "discovery.py"
    spec = importlib.util.spec_from_file_location("discovery", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.field


def test_the_reader_adds_noise_to_all_and_hides_some(data_dir):
    field = reader()
    t, clean = field(data_dir, "pde_find/burgers.mat")
    assert (len(t), len(clean), t[0], t[-1]) == (101, 256, 0.0, 10.0)
    u = np.array(list(clean.values()))
    assert u[:, 0] == pytest.approx(np.exp(-((np.arange(256) / 16 - 6) ** 2)), abs=1e-6)
    noisy = np.array(list(field(data_dir, "pde_find/burgers.mat", noise=0.1, seed=1)[1].values()))
    for part in (noisy - u, (noisy - u)[:, :1]):
        assert part.std() == pytest.approx(0.1 * u.std(), rel=0.15)
    rare = np.array(list(field(data_dir, "pde_find/burgers.mat", share=0.2)[1].values()))
    assert np.isfinite(rare).mean() == pytest.approx(0.2, rel=0.05)
    assert np.nanmax(np.abs(rare - u)) == 0.0
