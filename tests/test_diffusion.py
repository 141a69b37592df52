"""Heat and conduction with losses, transfer and sources: against formulas, and the checks."""

from __future__ import annotations

import numpy as np
import pytest
from factories import broad, last_state

import livepde as lp
from livepde.errors import ModelError
from livepde.models import conduction, heat
from livepde.stepping import Advance, Alexander2, simulate


def test_loss_is_one_more_rate_of_decay():
    mesh = lp.interval(0.0, 1.0, 40)
    model = heat(mesh, broad(0.1), {"boundary": 0.0}, loss=broad(0.7))
    times, mode = np.linspace(0, 2, 81), np.sin(np.pi * mesh.p[0])
    found = last_state(model, lambda x: np.sin(np.pi * x[0]), times, lambda t: {"ambient": 0.0})
    assert np.abs(found - np.exp(-(0.1 * np.pi**2 + 0.7) * 2) * mode).max() < 1e-3


def test_loss_pulls_to_the_surroundings_as_a_fin_does():
    """Steady: alpha u'' = loss (u - 20), u(0) = 50, insulated at 1: a hyperbolic cosine."""
    mesh = lp.interval(0.0, 1.0, 80)
    model = heat(mesh, broad(0.1), {"left": 50.0}, loss=broad(0.9))
    found = last_state(model, 20.0, np.linspace(0, 60, 61), lambda t: {"ambient": 20.0})
    exact = 20 + 30 * np.cosh(3 * (1 - mesh.p[0])) / np.cosh(3)
    assert np.abs(found - exact).max() < 2e-3


@pytest.mark.parametrize("scale", [1.0, 2e6])
def test_transfer_at_the_free_end(scale):
    """Steady: a straight line whose slope is that of Newton's law, alpha u' = -h (u - 10)."""
    mesh = lp.interval(0.0, 1.0, 10)
    k, h = broad(0.5 * scale), broad(1.5 * scale)
    if scale == 1.0:
        model = heat(mesh, k, {"left": 30.0}, transfer=h)
    else:
        model = conduction(mesh, k, {"left": 30.0}, C=scale, transfer=h)
    found = last_state(model, 10.0, np.linspace(0, 50, 51), lambda t: {"ambient": 10.0})
    assert found == pytest.approx(30 - 15 * mesh.p[0], abs=1e-6)


def test_source_by_layer():
    """Steady: a parabola where heat is gained, straight lines elsewhere."""
    mesh = lp.interval(0.0, 1.0, 40)
    halves = {"warm": lambda x: x[0] < 0.5, "still": lambda x: x[0] >= 0.5}
    source = lp.Piecewise(halves, lp.Normal(0.0, 1.0))
    model = heat(mesh, broad(0.5), {"boundary": 0.0}, source=source)
    q = model.initial_parameter({"alpha": 0.5, "source": [2.0, 0.0]})
    *_, (_, u) = simulate(model, q, 0.0, np.linspace(0, 40, 81), Advance(Alexander2()))
    x = mesh.p[0]
    exact = np.where(x < 0.5, 1.5 * x - 2 * x**2, 0.5 * (1 - x))
    assert model.state_block.at_vertices @ u == pytest.approx(exact, abs=1e-6)


def test_capacity_by_layer_keeps_the_heat():
    """Insulated layers of 3 and 1 J/(m^3 K) end at their weighted mean."""
    mesh = lp.interval(0.0, 1.0, 20)
    model = conduction(mesh, broad(1.0), C=lambda x: np.where(x[0] < 0.5, 3.0, 1.0))
    found = last_state(model, lambda x: 8.0 * (x[0] < 0.51), np.linspace(0, 20, 101))
    start = model.mass @ model.initial(lambda x: 8.0 * (x[0] < 0.51))
    assert found == pytest.approx(np.full(21, start.sum() / 2.0), abs=1e-6)
    assert found[0] == pytest.approx(6.0, abs=0.1)


def test_conduction_is_heat_in_other_units():
    mesh = lp.interval(0.0, 0.5, 25)
    times = np.linspace(0, 86400, 49)
    sides = {"left": lambda x, t: 10 * np.sin(2 * np.pi * t / 86400), "right": 0.0}
    one = last_state(heat(mesh, lp.Normal(5e-7, 1e-7), sides), 0.0, times)
    two = last_state(conduction(mesh, lp.Normal(1.25, 1.0), sides, C=2.5e6), 0.0, times)
    assert np.allclose(one, two, rtol=1e-10, atol=1e-12)


def test_what_cannot_be_is_said():
    mesh = lp.interval(0.0, 1.0, 4)
    with pytest.raises(ModelError, match="without a value, and there is none"):
        heat(mesh, broad(1.0), {"left": 0.0, "right": 0.0}, transfer=broad(1.0))
    with pytest.raises(ModelError, match="must be positive"):
        conduction(mesh, broad(1.0), C=0.0)


def test_the_surroundings_do_not_make_each_step_factorise_anew():
    exchange = {"loss": lp.Normal(0.1), "transfer": lp.Normal(0.2)}
    model = heat(lp.interval(0.0, 1.0, 4), lp.Normal(1.0), {"left": 0.0}, **exchange)
    assert model.steady
    assert not model.constant
