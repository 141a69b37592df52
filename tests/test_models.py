"""Ready-made equations against formulas."""

from __future__ import annotations

import numpy as np
import pytest
from factories import observe

import livepde as lp
from livepde.models import EQUATIONS, borehole, fluid, heat, reaction_diffusion
from livepde.stepping import Advance, Alexander2, simulate


def last(stream):
    *_, (_, u) = stream
    return u


def test_heat_decays_as_the_first_mode_does():
    mesh = lp.interval(0.0, 1.0, 40)
    model = heat(mesh, lp.Normal(0.1, 1.0), {"boundary": 0.0})
    times = np.linspace(0, 2, 81)
    u = last(
        simulate(
            model, np.array([0.1]), lambda x: np.sin(np.pi * x[0]), times, Advance(Alexander2())
        )
    )
    exact = np.exp(-0.1 * np.pi**2 * 2) * np.sin(np.pi * mesh.p[0])
    assert np.abs(model.state_block.at_vertices @ u - exact).max() < 2e-3


@pytest.mark.parametrize(
    "alpha",
    [
        lp.Normal(0.1, 1.0),
        lp.Piecewise({"a": lambda x: x[0] < 0.5, "b": lambda x: x[0] >= 0.5}, lp.Normal(0.1, 1.0)),
    ],
)
def test_heat_by_layer_in_the_plane(alpha):
    mesh = lp.rectangle((0.0, 1.0), (0.0, 2.0), (4, 5))
    model = heat(mesh, alpha, {"left": 1.0, "right": 0.0})
    q = model.initial_parameter()
    u = last(simulate(model, q, 0.0, np.linspace(0, 200, 50), Advance(lp.ImplicitEuler())))
    assert np.allclose(model.state_block.at_vertices @ u, 1.0 - mesh.p[0], atol=1e-6)


def test_heat_takes_a_field():
    mesh = lp.interval(0.0, 1.0, 10)
    element = EQUATIONS["heat"].element(mesh)
    model = heat(mesh, lp.Field(mesh, element, prior=lp.Normal(2.0)), {"boundary": 0.0})
    known = heat(mesh, lp.Normal(2.0, 1.0), {"boundary": 0.0})
    u = model.initial(lambda x: x[0] ** 2 * (1 - x[0]))
    q = model.initial_parameter()
    assert np.allclose(model.A(u)(q), known.A(u)(np.array([2.0])))


def test_borehole_follows_the_line_source():
    """After a long time T(r) = T0 + Q/(4 pi k H) E1(rho_c r^2 / 4 k t)."""
    from scipy.special import exp1

    H, rho_c, k, power = 20.0, 2e6, 2.5, 1000.0
    mesh = lp.interval(0.02, 12.0, 80, geometric=True)
    model = borehole(mesh, lp.Normal(k, 1.0), lp.Normal(0.1, 0.1), H=H, rho_c=rho_c, T0=10.0)
    times = np.linspace(0, 60 * 3600.0, 361)
    q = np.array([k, 0.1])
    u = last(simulate(model, q, 10.0, times, Advance(Alexander2()), lambda t: {"Q": power}))
    r = mesh.p[0]
    exact = 10.0 + power / (4 * np.pi * k * H) * exp1(rho_c * r**2 / (4 * k * times[-1]))
    here = r < 1.0
    assert np.abs((model.state_block.at_vertices @ u - exact)[here]).max() < 0.02


def test_fluid_sees_the_resistance():
    mesh = lp.interval(0.05, 5.0, 20, geometric=True)
    model = borehole(mesh, lp.Normal(2.0, 1.0), lp.Normal(0.1, 0.1), H=20.0, rho_c=2e6, T0=10.0)
    points = lp.Points({"T": 0.05}, direct={"T": fluid(20.0)})
    observed = observe(model, points)
    moment = lp.fem.Moment(0.0, {"Q": 1000.0})
    u = model.initial(10.0)
    assert observed.predict(u, np.array([2.0, 0.1]), moment) == pytest.approx([10.0 + 0.1 * 50.0])


def test_reaction_diffusion_is_the_papers_example():
    mesh = lp.interval(0.0, 1.0, 20)
    unknown = lp.Normal(3.0, 1.0)
    model = reaction_diffusion(mesh, unknown, D=0.5, f=lambda x, t: 0.0 * x[0])
    times = np.linspace(0, 1, 101)
    u0 = lambda x: np.sin(np.pi * x[0])  # noqa: E731
    u = last(simulate(model, np.array([3.0]), u0, times, Advance(Alexander2())))
    rate = 0.5 * np.pi**2 + 3.0
    exact = np.exp(-rate) * np.sin(np.pi * mesh.p[0])
    assert np.abs(model.state_block.at_vertices @ u - exact).max() < 1e-5


def test_geometric_interval():
    mesh = lp.interval(0.1, 10.0, 4, geometric=True)
    x = np.sort(mesh.p[0])
    assert np.allclose(x[1:] / x[:-1], 10**0.5)
    with pytest.raises(lp.errors.SpaceError, match="start > 0"):
        lp.interval(0.0, 1.0, 4, geometric=True)
    with pytest.raises(lp.errors.SpaceError, match="rectangle"):
        lp.rectangle((0, 1), (1, 0), (2, 2))
