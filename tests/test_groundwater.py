"""Groundwater and soil columns agree with formulas and published tests."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from commands import call
from scipy.integrate import quad
from scipy.special import erfc, erfcx, exp1
from skfem import ElementQuad1, MeshQuad

import livepde as lp
from livepde.cases import load
from livepde.cases.read import parse
from livepde.cases.remedies import freed, start_missed, usual_shift
from livepde.diagnostics import check_model
from livepde.errors import CaseError, ModelError
from livepde.fem import grid
from livepde.models import (
    advection_dispersion,
    borehole,
    groundwater,
    mobile_immobile,
    pumping_test,
)
from livepde.stepping import Advance, Alexander2, simulate
from livepde.verdict import Cause

ROOT = Path(__file__).parents[1]
k, Ss, b, Q = 7.6e-4, 2.5e-5, 7.0, 9.1e-3
TIMES = np.concatenate([[0.0], np.geomspace(0.05, 5e4, 70)])


def theis(r: Any, t: Any, T: float, S: float, rate: float) -> Any:
    """Drawdown of a well that is pumped from time 0 on."""
    return rate / (4 * np.pi * T) * exp1(r**2 * S / (4 * T * t))


def positive(value: float) -> lp.LogNormal:
    return lp.LogNormal(value, value)


def radial(cells: int = 80) -> lp.Model:
    mesh = lp.interval(0.1, 5000.0, cells, geometric=True)
    return pumping_test(mesh, positive(k), positive(Ss), b=b)


def history(model: lp.Model, times: Any, at: Any, inputs: Any, q: Any = None) -> Any:
    """Return the state at places of shape (d, n), for all times but the first."""
    probe = model.state_block.probe(np.atleast_2d(at))
    steps = simulate(model, model.initial_parameter(q), 0.0, times, Advance(Alexander2()), inputs)
    return np.array([probe @ u for _, u in steps])[-(len(times) - 1) :]


@pytest.mark.slow
def test_drawdown_is_that_of_theis():
    r = np.array([10.0, 30.0, 90.0, 300.0])
    exact = theis(r, TIMES[1:, None], k * b, Ss * b, Q)
    errors = []
    for cells in (80, 160):
        found = history(radial(cells), TIMES, r, lambda t: {"Q": Q})
        errors.append(np.abs(found - exact).max())
    assert errors[0] < 0.002 * exact.max()
    assert errors[1] < 0.3 * errors[0]  # second order


@pytest.mark.slow
def test_drawdown_recovers_when_the_pump_stops():
    """Theis with a second well of negative rate from then on."""
    stop = 2000.0
    times = np.concatenate([TIMES[stop > TIMES], stop + TIMES])
    found = history(radial(), times, [30.0], lambda t: {"Q": Q if t <= stop else 0.0})[-30:, 0]
    late = times[-30:]
    exact = theis(30.0, late, k * b, Ss * b, Q) - theis(30.0, late - stop, k * b, Ss * b, Q)
    assert np.abs(found - exact).max() < 0.02 * Q / (4 * np.pi * k * b)


L = 2e-9  # leakance, 1/s: a layer of 16 years


def hantush(r: float, t: float) -> float:
    """Drawdown in a leaky aquifer (Hantush and Jacob 1955): the integral over y = exp(s)."""
    T, low = k * b, np.log(r**2 * Ss / (4 * k * t))
    leak = r**2 * L / (4 * T)
    found, _ = quad(lambda s: np.exp(-np.exp(s) - leak * np.exp(-s)), low, 5.0, limit=200)
    return float(Q / (4 * np.pi * T) * found)


@pytest.mark.slow
def test_drawdown_in_a_leaky_aquifer_is_that_of_hantush():
    mesh = lp.interval(0.1, 20_000.0, 180, geometric=True)
    model = pumping_test(mesh, positive(k), positive(Ss), positive(L), b=b)
    r, times = [30.0, 90.0, 300.0], np.concatenate([[0.0], np.geomspace(0.05, 1e6, 90)])
    found = history(model, times, r, lambda t: {"Q": Q})[30:]
    exact = np.array([[hantush(one, t) for one in r] for t in times[31:]])
    assert np.abs(found - exact).max() < 0.001 * exact.max()


def pumped(folder: Path, count: int = 40, **settings: Any) -> Any:
    """Return a case with readings of a leaky aquifer; the first one comes after 20 minutes."""
    t = np.geomspace(1200.0, 3e4, count)
    rng = np.random.default_rng(1)
    z = {
        f"h{r}": [hantush(r, one) for one in t] + rng.normal(0.0, 1e-3, count)
        for r in (30, 60, 120)
    }
    pd.DataFrame({"t": t, **z, "Q": Q}).to_csv(folder / "test.csv", index=False)
    sensors = "".join(
        f'{name} = {{ role = "sensor", column = "{name}", at = {name[1:]}.0 }}\n' for name in z
    )
    case = folder / "case.toml"
    case.write_text(f"""
equation = "pumping_test"
initial = 0.0
options = {{ b = {b} }}
mesh = {{ from = 0.1, to = 5000.0, cells = 80, spacing = "geometric" }}
data = {{ file = "test.csv", time = "t" }}
law.noise = 1e-3
[unknowns]
k = {{ prior = 3e-4, std = 6e-4, transform = "log" }}
Ss = {{ prior = 1e-4, std = 3e-4, transform = "log" }}
[channels]
Q = {{ role = "input", column = "Q" }}
{sensors}""")
    return load(case, settings={key.replace("__", "."): value for key, value in settings.items()})


@pytest.mark.slow
def test_readings_that_move_against_the_prior_are_named(tmp_path: Path):
    """Heads fall where the drawdown of the model rises."""
    case = pumped(tmp_path, 20).path
    coarse = ("--set", "data.t0=0", "--set", "mesh.cells=25")
    code, output = call("check", case, *coarse)
    assert code == 0
    assert "Readings, and their prediction at the prior" in output
    assert "Check the sign" not in output
    table = pd.read_csv(tmp_path / "test.csv")
    table[["h30", "h60", "h120"]] *= -1.0
    table.to_csv(tmp_path / "test.csv", index=False)
    code, output = call("check", case, *coarse)
    assert code == 0
    assert "h30, h60, h120: the readings fall where the prior predicts a rise" in output
    # A run names the rate, which turns all of them, where its steps do not fail.
    settings = {"data.t0": 0.0, "law.noise": 0.02}
    prepared = load(case, settings=settings).prepare()
    verdict = prepared.identifier.run(prepared.stream).last.verdict
    assert verdict.level == "do not trust"
    (misfit,) = (one for one in verdict.findings if one.what == "misfit")
    assert misfit.causes[0].text == "Q may have the opposite sign"
    assert misfit.causes[0].setting == "channels.Q.factor=-1"


LEAKY = {"unknowns__leakance": {"prior": 1e-9, "std": 2e-9, "transform": "log"}}


@pytest.mark.slow
def test_the_state_at_rest_is_that_of_the_time_when_pumping_began(tmp_path: Path):
    def ended(**settings: Any) -> Any:
        prepared = pumped(tmp_path, **LEAKY, **settings).prepare()
        return prepared, prepared.identifier.run(prepared.stream).last

    prepared, last = ended(data__t0=0.0)
    assert last.verdict.level == "trusted"
    for name, truth in (("k", k), ("Ss", Ss), ("leakance", L)):
        low, high = last[name].interval()
        assert low < truth < high
    # Without the key the aquifer would be at rest at the first row, and the run says so.
    prepared, last = ended()
    assert last.verdict.level != "trusted"
    (found,) = start_missed(prepared, last.verdict)
    assert "set `data.t0`" in found.remedy


def test_a_time_of_the_start_that_cannot_be_is_refused(tmp_path: Path):
    with pytest.raises(CaseError, match=r"data\.t0: 2000 s is later than the first row"):
        _ = pumped(tmp_path, data__t0=2000.0).prepare().identifier
    with pytest.raises(CaseError, match=r"data\.t0: .* interpolated from the first row"):
        _ = pumped(tmp_path, data__t0=0.0, initial="interpolate").prepare().identifier
    with pytest.raises(CaseError, match=r"data\.t0: got the date"):
        _ = pumped(tmp_path, data__t0="2025-04-01").prepare().identifier


@pytest.mark.slow
def test_an_aquifer_that_is_taken_for_confined(tmp_path: Path):
    prepared = pumped(tmp_path, data__t0=0.0).prepare()
    last = prepared.identifier.run(prepared.stream).last
    assert last.verdict.level == "caution"
    for name, truth in (("k", k), ("Ss", Ss)):
        one = last.verdict.errors[name]
        assert one.low < truth < one.high
    # A place near the well may be off by less than one far away, and a leak can be estimated.
    assert usual_shift(prepared, "h30") == pytest.approx(
        0.25 * usual_shift(prepared, "h120"), rel=0.2
    )
    (leak,) = freed(prepared, Cause("loss", "", "", size=1e-5))
    assert leak.startswith("unknowns.leakance=")
    case = pumped(
        tmp_path, data__t0=0.0, **{"unknowns__leakance": parse([leak])["unknowns.leakance"]}
    )
    again = case.prepare()
    better = again.identifier.run(again.stream).last
    assert better.verdict.level == "trusted"
    low, high = better["leakance"].interval()
    assert low < L < high


def plane(cell: float = 4.0) -> MeshQuad:
    """A square of 6 km whose cells grow away from its middle."""
    outer = np.cumsum(cell * 1.35 ** np.arange(1, 20))
    half = np.concatenate([np.arange(0.0, 60.1, cell), 60.0 + outer[outer < 2940.0], [3000.0]])
    axis = np.concatenate([-half[:0:-1], half])
    return MeshQuad.init_tensor(axis, axis)


@pytest.mark.long
def test_wells_in_the_plane_superpose():
    T, S = 5e-3, 2e-3
    wells = {"Q1": (-20.0, 0.0), "Q2": (21.0, 9.0)}
    rates = {"Q1": 4e-3, "Q2": -2e-3}
    model = groundwater(
        plane(), positive(T), positive(S), {"boundary": 0.0}, wells=wells, radius=6.0
    )
    at = np.array([[0.0, -50.0, 21.0, 40.0], [0.0, 20.0, -30.0, 40.0]])
    times = np.concatenate([[0.0], np.geomspace(5.0, 5e4, 40)])
    found = history(model, times, at, lambda t: rates)
    exact = np.zeros_like(found)
    for name, (x, y) in wells.items():
        r = np.hypot(at[0] - x, at[1] - y)
        exact -= theis(r, times[1:, None], T, S, rates[name])
    later = times[1:] > 100.0  # until then a wave passes that is not much wider than the cells
    scale = rates["Q1"] / (4 * np.pi * T)
    assert np.abs(found - exact)[later].max() < 0.03 * scale
    assert np.abs(found - exact).max() < 0.1 * scale


def test_water_is_kept_whatever_the_fields():
    """No flow across the boundary: what the wells take is what the storage gives."""
    mesh = lp.rectangle((0.0, 100.0), (0.0, 80.0), (10, 8))
    element = ElementQuad1()
    T, S = (lp.Field(mesh, element, prior=lp.LogNormal(v, std=v)) for v in (1e-2, 1e-3))
    model = groundwater(
        mesh, T, S, wells={"Q": (40.0, 40.0)}, radius=25.0, recharge=1e-8, element=element
    )
    q = {
        "T": lambda x: 1e-2 * np.exp(np.sin(x[0] / 9)),
        "S": lambda x: 1e-3 * np.exp(np.cos(x[1] / 7)),
    }
    latent = model.initial_parameter(q)
    S_values = model.latent.value(latent)[model.parameter_space.part("S")]
    times = np.linspace(0.0, 3600.0, 13)
    *_, (_, u) = simulate(model, latent, 0.0, times, Advance(Alexander2()), lambda t: {"Q": 2e-4})
    rate = 1e-8 * 8000.0 - 2e-4
    stored = S_values @ (model.mass @ u)
    assert stored == pytest.approx(3600.0 * rate, rel=2e-3)  # the source's quadrature


def test_a_constant_field_of_storativity_is_a_number():
    mesh = lp.rectangle((0.0, 100.0), (0.0, 80.0), (10, 8))
    element, given = ElementQuad1(), {"wells": {"Q": (40.0, 40.0)}, "radius": 25.0}
    S = lp.Field(mesh, element, prior=lp.LogNormal(1e-3, std=1e-3))
    model = groundwater(mesh, positive(1e-2), S, {"left": 0.0}, **given)
    known = groundwater(mesh, positive(1e-2), positive(1e-3), {"left": 0.0}, **given)
    u = model.initial(lambda x: np.sin(x[0] / 20) * x[1] / 80)
    moment = lp.fem.Moment(0.0, {"Q": 1e-3})
    values = [m.form_A.vector("v", moment, u=u, q=m.initial_parameter()) for m in (model, known)]
    assert np.allclose(*values)


def test_what_is_wrong_is_said():
    mesh, T = lp.rectangle((0.0, 60.0), (0.0, 60.0), (4, 4)), positive(1e-2)
    with pytest.raises(ModelError, match=r"'Q' at \(70.0, 0.0\) lies outside"):
        groundwater(mesh, T, T, wells={"Q": (70.0, 0.0)}, radius=30.0)
    with pytest.raises(ModelError, match=r"radius=21.4 or more \(got 1\)"):
        groundwater(mesh, T, T, wells={"Q": (30.0, 10.0)}, radius=1.0)
    groundwater(mesh, T, T, wells={"Q": (30.0, 10.0)}, radius=21.4)  # not rounded down
    with pytest.raises(ModelError, match="S by region is not possible"):
        groundwater(mesh, T, lp.Piecewise({"a": lambda x: x[0] > 30.0}, lp.Normal(1.0, 1.0)))
    with pytest.raises(ModelError, match="thickness, must be a positive number"):
        pumping_test(lp.interval(0.1, 10.0, 5, geometric=True), T, T, b=0.0)
    # A drawdown with the quotient of two storages in its weak form was four times too large.
    rings = lp.Piecewise({"near": lambda x: x[0] < 20.0, "far": lambda x: x[0] > 20.0}, T)
    radii = lp.interval(0.1, 1000.0, 9, geometric=True)
    field = lp.Field(radii, lp.linear(radii), prior=T)
    for varies in (rings, field):
        with pytest.raises(ModelError, match="pumping_test: an unknown Ss must be one number"):
            pumping_test(radii, T, varies, b=10.0)
        with pytest.raises(ModelError, match="borehole: an unknown rho_c must be one number"):
            borehole(radii, T, T, H=1.0, rho_c=varies, T0=10.0)
        with pytest.raises(ModelError, match="mobile_immobile: an unknown phi must be one number"):
            mobile_immobile(radii, T, T, varies, T)
    with pytest.raises(ModelError, match="needs a mesh of a plane"):
        groundwater(lp.interval(0.0, 1.0, 5), T, T, wells={"Q": (0.5,)})
    with pytest.raises(ModelError, match="inlet='open'; expected one of flux, fixed"):
        advection_dispersion(mesh, ONE, ONE, inlet="open")
    with pytest.raises(ModelError, match="R must be at least 1"):
        advection_dispersion(mesh, ONE, ONE, R=0.0)


@pytest.mark.slow
def test_the_tomography_of_horkheim_passes_the_checks():
    place = spec_from_file_location("pumping", ROOT / "cases" / "pumping.py")
    pumping = module_from_spec(place)
    place.loader.exec_module(pumping)
    mesh = grid([-600.0, -90.0, -12.0, -4.0, 4.0, 12.0, 90.0], [-700.0, -30.0, -6.0, 6.0, 700.0])
    one = lp.Field(mesh, ElementQuad1(), prior=lp.LogNormal(1.0, std=1.0))
    unknowns = {"T": positive(0.03), "S": positive(0.02), "Y": one, "Z": one}
    check_model(pumping.four_tests(mesh, unknowns, {}, length=8.0), u=1.0).raise_if_failed()


D, V = 0.15, 2.5
ONE = lp.Normal(1.0, 1.0)
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


def test_an_unknown_decay_is_that_of_the_option():
    mesh = lp.interval(0.0, 30.0, 30)
    given = at_the_end(advection_dispersion(mesh, ONE, ONE, decay=0.3), [D, V], 30)
    found = at_the_end(advection_dispersion(mesh, ONE, ONE, decay=ONE), [D, V, 0.3], 30)
    assert np.allclose(found, given, rtol=1e-9, atol=1e-12)


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
