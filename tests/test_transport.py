"""Columns of soil against formulas: Ogata-Banks, fed by the flux, immobile water."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import erfc, erfcx

import livepde as lp
from livepde import cases
from livepde.models import advection_dispersion, mobile_immobile
from livepde.stepping import Advance, Alexander2, simulate

D, V = 0.15, 2.5
ONE = lp.Normal(1.0, 1.0)
CASE = Path(__file__).parents[1] / "cases" / "soil_column.toml"
SHARE = lp.LogitNormal(0.5, 0.2, bounds=(0.0, 1.0))


def ogata_banks(x, t, R=1.0):
    """First type: Ogata and Banks (1961); van Genuchten and Alves (1982), A1."""
    a, b = ((R * x + sign * V * t) / (2 * np.sqrt(D * R * t)) for sign in (-1, 1))
    return 0.5 * erfc(a) + 0.5 * np.exp(V * x / D - b**2) * erfcx(b)


def fed_by_flux(x, t, R=1.0):
    """Third type, concentration in the column: van Genuchten and Alves (1982), A2."""
    a, b = ((R * x + sign * V * t) / (2 * np.sqrt(D * R * t)) for sign in (-1, 1))
    third = (1 + V * x / D + V**2 * t / (D * R)) * np.exp(V * x / D - b**2) * erfcx(b)
    return 0.5 * erfc(a) + np.sqrt(V**2 * t / (np.pi * D * R)) * np.exp(-(a**2)) - 0.5 * third


def immobile(x, t, phi, omega, inlet):
    """Mobile concentration by its Laplace transform, a Fourier series on a line (Durbin 1974)."""
    period = 2 * t
    s = 20.0 / period + 1j * np.pi * np.arange(4000) / period
    total = phi * s + omega * (1 - phi) * s / ((1 - phi) * s + omega)
    root = (V - np.sqrt(V**2 + 4 * phi * D * total)) / (2 * phi * D)
    first = 1.0 if inlet == "fixed" else V / (V - phi * D * root)
    terms = (np.exp(s * t + root * x[:, None]) * first / s).real
    return (terms.sum(axis=1) - 0.5 * terms[:, 0]) / period


def at_the_end(model, q, cells, stop=6.0):
    times = np.linspace(0.0, stop, cells // 2 + 1)
    control = Advance(Alexander2())
    *_, (_, u) = simulate(model, np.array(q), 0.0, times, control, lambda t: {"c_in": 1.0})
    return u


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inlet", "exact", "bound"), [("flux", fed_by_flux, 1e-3), ("fixed", ogata_banks, 4e-3)]
)
@pytest.mark.parametrize("R", [1.0, 2.0])
def test_breakthrough_in_a_column(inlet, exact, bound, R):
    mesh = lp.interval(0.0, 30.0, 400)
    model = advection_dispersion(mesh, ONE, ONE, R=R, inlet=inlet)
    u = at_the_end(model, [D, V], 400)
    assert np.abs(u - exact(mesh.p[0] + 1e-12, 6.0, R)).max() < bound


@pytest.mark.slow
def test_decay_on_the_way():
    mesh = lp.interval(0.0, 30.0, 300)
    model = advection_dispersion(mesh, ONE, ONE, decay=0.3)
    u = at_the_end(model, [D, V], 300, stop=40.0)
    root = (V - np.sqrt(V**2 + 4 * D * 0.3)) / (2 * D)
    exact = V / (V - D * root) * np.exp(root * mesh.p[0])
    assert np.abs(u - exact)[mesh.p[0] < 29].max() < 1e-4


@pytest.mark.long
@pytest.mark.parametrize("inlet", ["flux", "fixed"])
@pytest.mark.parametrize(("phi", "omega"), [(0.7, 0.3), (0.5, 0.05), (0.8, 3.0)])
def test_immobile_water_against_the_laplace_transform(inlet, phi, omega):
    mesh = lp.interval(0.0, 60.0, 600)
    model = mobile_immobile(mesh, ONE, ONE, SHARE, ONE, inlet=inlet)
    q = model.initial_parameter({"D": D, "v": V, "phi": phi, "omega": omega})
    u = at_the_end(model, q, 600)
    c = u[model.state_space.part("c")]
    x = np.array([3.0, 8.0, 11.0, 15.0, 17.0, 23.0])
    found = np.interp(x, np.sort(mesh.p[0]), c[np.argsort(mesh.p[0])])
    assert found == pytest.approx(immobile(x, 6.0, phi, omega, inlet), abs=4e-3)


@pytest.mark.slow
def test_nothing_is_lost():
    """What flowed in is in the column: c and s with their shares of the water."""
    phi = 0.6
    mesh = lp.interval(0.0, 60.0, 200)
    model = mobile_immobile(mesh, ONE, ONE, SHARE, ONE)
    q = model.initial_parameter({"D": D, "v": V, "phi": phi, "omega": 0.4})
    u = at_the_end(model, q, 200)
    whole = {"c": phi, "s": 1 - phi}
    stored = model.X.inner(u, model.state_space.interpolate(whole))
    assert stored == pytest.approx(V * 6.0, rel=1e-9)


def test_what_is_refused():
    mesh = lp.interval(0.0, 1.0, 4)
    with pytest.raises(lp.errors.ModelError, match="inlet='open'; expected one of flux, fixed"):
        advection_dispersion(mesh, ONE, ONE, inlet="open")
    with pytest.raises(lp.errors.ModelError, match="R must be at least 1"):
        advection_dispersion(mesh, ONE, ONE, R=0.0)


@pytest.mark.study
@pytest.mark.parametrize(
    ("curve", "depth", "v", "dispersion"),
    [(0, 11.0, 2.45, 0.154), (1, 17.0, 2.51, 0.126), (2, 23.0, 2.51, 0.110)],
)
def test_soil_columns_find_what_the_other_code_finds(
    curve, depth, v, dispersion, data_dir, monkeypatch
):
    monkeypatch.setenv("LIVEPDE_DATA", str(data_dir))
    place = {"data.options.curve": curve, "channels.c.at": depth}
    prepared = cases.load(CASE, allow_code=True, settings=place).prepare()
    prepared.identifier.run(prepared.stream)
    estimate = prepared.identifier.estimate()
    found = {label: value for label, (value, _) in estimate.parameters.items()}
    assert found["v"] == pytest.approx(v, rel=0.03)
    assert found["D"] == pytest.approx(dispersion, rel=0.25)
