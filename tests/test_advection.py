"""Advection and diffusion along a column: against formulas, and the checks."""

from __future__ import annotations

import numpy as np
import pytest
from factories import broad, last_state

import livepde as lp
from livepde.cases import load
from livepde.errors import CaseError, ModelError
from livepde.models import advection_diffusion


def steady(x, w, kappa):
    return np.expm1(w * x / kappa) / np.expm1(w / kappa)


@pytest.mark.parametrize("w", [-3.0, 0.5, 2.0])
def test_steady_profile(w):
    errors = []
    for cells in (20, 40):
        mesh = lp.interval(0.0, 1.0, cells)
        model = advection_diffusion(mesh, broad(0.5), {"left": 0.0, "right": 1.0}, v=broad(w))
        found = last_state(model, 0.0, np.linspace(0, 20, 41))
        errors.append(np.abs(found - steady(mesh.p[0], w, 0.5)).max())
    assert errors[0] < 0.02
    assert errors[1] < 0.27 * errors[0]  # second order


def test_stabilised_it_is_exact_at_the_vertices_however_fast():
    mesh = lp.interval(0.0, 1.0, 10)
    sides = {"left": 0.0, "right": 1.0}
    model = advection_diffusion(mesh, broad(0.01), sides, v=broad(1.0), stabilise=True)
    found = last_state(model, 0.0, np.linspace(0, 20, 41))
    assert found == pytest.approx(steady(mesh.p[0], 1.0, 0.01), abs=1e-9)


@pytest.mark.slow
def test_a_warm_spot_drifts_with_the_water_and_spreads():
    """A Gaussian; the water follows the head, w = ratio K dH(t)/L, here back and forth."""
    kappa, K, L, ratio, start = 0.02, 3.0, 2.0, 1.5, 0.05
    mesh = lp.interval(-4.0, 4.0, 400)
    model = advection_diffusion(mesh, broad(kappa), {"boundary": 0.0}, K=broad(K), L=L, ratio=ratio)
    end = 2.0
    found = last_state(
        model,
        lambda x: np.exp(-(x[0] ** 2) / (4 * start)),
        np.linspace(0, end, 201),
        lambda t: {"dH": np.cos(t)},
    )
    moved, wide = ratio * K / L * np.sin(end), start + kappa * end
    exact = np.sqrt(start / wide) * np.exp(-((mesh.p[0] - moved) ** 2) / (4 * wide))
    assert np.abs(found - exact).max() < 2e-3


def test_dispersion_grows_with_the_speed_of_either_sign():
    mesh = lp.interval(0.0, 1.0, 40)
    sides = {"left": 0.0, "right": 1.0}
    for w in (-2.0, 2.0):
        model = advection_diffusion(mesh, broad(0.3), sides, v=broad(w), dispersivity=broad(0.1))
        plain = advection_diffusion(mesh, broad(0.5), sides, v=broad(w))
        times = np.linspace(0, 5, 11)
        assert np.allclose(last_state(model, 0.0, times), last_state(plain, 0.0, times))


def test_flux_and_head_add_up():
    mesh = lp.interval(0.0, 1.0, 20)
    sides, times = {"left": 1.0, "right": 0.0}, np.linspace(0, 0.5, 11)
    both = advection_diffusion(mesh, broad(0.1), sides, v=broad(0.5), K=broad(2.0), L=4.0)
    one = advection_diffusion(mesh, broad(0.1), sides, v=broad(0.75))
    found = last_state(both, 0.0, times, lambda t: {"dH": 0.5})
    assert np.allclose(found, last_state(one, 0.0, times))


def test_what_cannot_be_is_said():
    mesh = lp.interval(0.0, 1.0, 4)
    with pytest.raises(ModelError, match="give v"):
        advection_diffusion(mesh, broad(1.0))
    with pytest.raises(ModelError, match="L must be positive"):
        advection_diffusion(mesh, broad(1.0), v=broad(1.0), L=0.0)


CASE = """
equation = "advection_diffusion"
initial = 10.0
mesh = { from = 0, to = 1, cells = 10 }
options = { stabilise = true, ratio = 1.5 }
data = { file = "bed.csv", time = "t", time_unit = "s" }
law = { kind = "sensitivity" }

[unknowns]
kappa = { prior = 1e-6, std = 1e-7, regions = { a = [0, 0.5], b = [0.5, 1] } }
K = { prior = 0, std = 1e-5 }

[channels]
T_0 = { role = "boundary", column = "T_0", at = "left" }
T_5 = { role = "sensor", column = "T_5", at = 0.5, noise = 0.1 }
"""


def test_in_a_case_the_head_goes_with_the_conductivity(tmp_path):
    case = tmp_path / "bed.toml"
    (tmp_path / "bed.csv").write_text("t,T_0,T_5,dH\n0,10,10,0.1\n600,11,10,0.1\n")
    case.write_text(CASE)
    with pytest.raises(CaseError, match="head difference"):
        load(case).prepare()
    case.write_text(CASE + 'dH = { role = "input", column = "dH" }\n')
    assert load(case).model.channels == ("dH", "T_0")
