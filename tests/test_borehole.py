"""The grouted borehole agrees with steady states, balances, the line source and a twin."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from factories import observe
from scipy.special import exp1

import livepde as lp
from livepde import cases
from livepde.diagnostics import check_model
from livepde.errors import ModelError
from livepde.models import EQUATIONS, borehole, grouted_borehole
from livepde.stepping import Advance, Alexander2, simulate

KNOWN = {
    "H": 20.0,
    "r_p": 0.0236,
    "r_b": 0.063,
    "C_f": 4900.0,
    "C_p": 1000.0,
    "C_g": 3.8e6,
    "T0": 10.0,
}
TRUTH = {"k": 2.5, "rho_c": 2.3e6, "R_b": 0.15, "share": 0.3}
POWER = 1000.0
HOUR = 3600.0


def unknown(name: str) -> lp.fem.Prior:
    if name == "share":
        return lp.LogitNormal(TRUTH[name], 0.05, bounds=(0.0, 1.0))
    return lp.LogNormal(TRUTH[name], 0.3 * TRUTH[name])


def model(
    cells: int = 80, far: float = 12.0, rho_c: lp.fem.Unknown | None = None, **more: float
) -> lp.Model:
    mesh = lp.interval(0.02, far, cells, geometric=True)
    unknowns = {name: unknown(name) for name in TRUTH} | ({"rho_c": rho_c} if rho_c else {})
    return grouted_borehole(mesh, **unknowns, **(KNOWN | more))


def heated(process: lp.Model, times: Any, q: Any = None) -> list[np.ndarray]:
    """Return the states of a heating that begins at 10 degC."""
    start, control = process.initial_parameter(q or TRUTH), Advance(Alexander2())
    return [u for _, u in simulate(process, start, 10.0, times, control, lambda t: {"Q": POWER})]


def final(process: lp.Model, times: Any, q: Any = None) -> Any:
    """Return the state at the nodes, in order of the radius, and the radii, after a heating."""
    x = process.state.mesh.p[0]
    order = np.argsort(x)
    return x[order], (process.state_block.at_vertices @ heated(process, times, q)[-1])[order]


def test_at_rest_the_fluid_is_warmer_by_the_resistances():
    x, T = final(model(160, far=2.0), np.linspace(0.0, 1e4 * HOUR, 200))
    per_metre = POWER / KNOWN["H"]
    wall = T[np.isclose(x, KNOWN["r_b"])][0]
    pipe = T[np.isclose(x, KNOWN["r_p"])][0]
    around = np.log(2.0 / KNOWN["r_b"]) / (2 * np.pi * TRUTH["k"])
    assert T[0] - wall == pytest.approx(per_metre * TRUTH["R_b"], rel=1e-3)
    assert T[0] - pipe == pytest.approx(per_metre * TRUTH["R_b"] * TRUTH["share"], rel=1e-6)
    assert wall - 10.0 == pytest.approx(per_metre * around, rel=1e-3)


def test_no_heat_is_lost():
    process = model(C_c=1900.0)
    rise = heated(process, np.linspace(0.0, 10 * HOUR, 61))[-1] - process.initial(10.0)
    held = 2 * np.pi * KNOWN["H"] * (process.mass @ rise).sum()
    assert held == pytest.approx(POWER * 10 * HOUR, rel=1e-6)


@pytest.mark.slow
def test_late_the_fluid_follows_the_line_source():
    """T_fluid = T0 + Q/(4 pi k H) E1(rho_c r_b^2/(4 k t)) + R_b Q/H, after some days."""
    times = np.concatenate([[0.0], np.geomspace(60.0, 200 * HOUR, 150)])
    _, T = final(model(160), times)
    x = TRUTH["rho_c"] * KNOWN["r_b"] ** 2 / (4 * TRUTH["k"] * times[-1])
    rise = POWER / KNOWN["H"] * (exp1(x) / (4 * np.pi * TRUTH["k"]) + TRUTH["R_b"])
    assert T[0] - 10.0 == pytest.approx(rise, rel=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_an_unknown_capacity_is_that_capacity(factor):
    """Radii counted by the heat they hold change nothing that is measured at the borehole."""
    times = np.concatenate([[0.0], np.geomspace(60.0, 60 * HOUR, 80)])
    capacity = lp.LogNormal(factor * TRUTH["rho_c"], 1e6)
    scaled, plain = model(160), model(160, rho_c=capacity)
    q = TRUTH | {"rho_c": factor * TRUTH["rho_c"]}
    (_, one), (_, other) = final(scaled, times, q), final(plain, times, q)
    assert one[0] == pytest.approx(other[0], abs=0.01)
    assert abs(final(scaled, times)[1][0] - one[0]) > 0.3  # and it matters


def test_nodes_are_moved_onto_the_radii():
    mesh = model(37).state.mesh
    for radius in (KNOWN["r_p"], KNOWN["r_b"]):
        assert np.isclose(mesh.p[0], radius).any()
    assert set(mesh.subdomains) == {"pipes", "grout", "ground"}
    assert sum(len(cells) for cells in mesh.subdomains.values()) == mesh.nelements


@pytest.mark.parametrize(
    ("start", "stop", "cells"), [(0.03, 6.0, 50), (0.02, 0.05, 50), (0.02, 6.0, 3)]
)
def test_a_mesh_without_room_for_the_layers_is_refused(start, stop, cells):
    mesh = lp.interval(start, stop, cells, geometric=True)
    with pytest.raises(ModelError, match="must lie inside"):
        grouted_borehole(mesh, **{name: unknown(name) for name in TRUTH}, **KNOWN)


def test_capacity_is_one_number():
    layers = lp.Piecewise({"a": lambda x: x[0] > 0.0}, lp.Normal(2e6, 1e6))
    unknowns = {name: unknown(name) for name in TRUTH} | {"rho_c": layers}
    with pytest.raises(ModelError, match="Scalar"):
        grouted_borehole(lp.interval(0.02, 6.0, 40, geometric=True), **unknowns, **KNOWN)


def plane(far: float = 12.0, cells: int = 60, **more: float) -> lp.Model:
    """The borehole on a mesh of radius and height, from its end to its middle."""
    half = (KNOWN | more)["H"] / 2
    r = np.geomspace(0.02, far, cells + 1)
    z = np.concatenate([[0.0], np.geomspace(0.05, half, 14)])
    return grouted_borehole(
        lp.fem.grid(r, z), **{name: unknown(name) for name in TRUTH}, **(KNOWN | more)
    )


def fluid(process: lp.Model, times: Any) -> np.ndarray:
    """Return the mean temperature of the fluid at all times of a heating."""
    sensor = observe(process, lp.Averages({"T": "left"}))
    return np.concatenate([sensor.G @ u for u in heated(process, times)])


@pytest.mark.slow
def test_forms_in_the_plane_pass_the_shipped_checks():
    check_model(
        plane(cells=30, C_c=1900.0), u=30.0, spread=5.0, inputs={"Q": POWER}
    ).raise_if_failed()


@pytest.mark.slow
def test_the_ends_cool_the_borehole():
    """With both ends at T0 the mean of a line source is lower, at the radius r, by

        Q/(4 pi k H) 8 (sqrt(alpha t/pi) - r/2)/H

    as long as the ends do not know of each other; about, for ours is no line.
    """
    times = np.concatenate([[0.0], np.geomspace(60.0, 100 * HOUR, 60)])
    _, endless = final(model(60), times)
    diffused = TRUTH["k"] / TRUTH["rho_c"] * times[-1]
    reach = 8 * (np.sqrt(diffused / np.pi) - KNOWN["r_b"] / 2)
    lower = POWER / KNOWN["H"] ** 2 / (4 * np.pi * TRUTH["k"]) * reach
    assert endless[0] - fluid(plane(), times)[-1] == pytest.approx(lower, rel=0.1)
    tall = KNOWN["H"] * 100  # the ends of a tall one do not matter
    _, few = final(model(60, H=tall), times)
    assert fluid(plane(H=tall), times)[-1] == pytest.approx(few[0], abs=1e-3)


@pytest.mark.study
def test_the_sandbox_from_five_hours_on(data_dir, monkeypatch):
    """k was measured independently; the interval covers it from the first sample on."""
    monkeypatch.setenv("LIVEPDE_DATA", str(data_dir))
    path = Path(__file__).resolve().parents[1] / "cases" / "thermal_response_grout.toml"
    prepared = cases.load(path).prepare()
    data = prepared.identifier.run(prepared.stream, fields_every=1000).to_xarray()
    hours, k, std = data["time"] / 3600.0, data["k"], data["k_std"]
    off = np.abs(k - 2.88)
    assert (off[hours > 20.0] < 0.05 * 2.88).all()
    assert (off < 1.96 * std)[hours > 5.0].all()
    assert std[-1] < 0.05 * 2.88


@pytest.mark.slow
@pytest.mark.parametrize("rho_c", [2.3e6, lp.LogNormal(2e6, 5e5)])
def test_the_ground_alone_with_known_and_unknown_heat_capacity(rho_c: Any) -> None:
    """Late the wall follows the line source, T = T0 + Q/(4 pi k H) E1(r^2 rho_c/(4 k t))."""
    mesh = lp.interval(0.01, 30.0, 200, geometric=True)
    k, R_b = lp.Normal(2.0, 1.0), lp.Normal(0.1, 0.05)
    process = borehole(mesh, k, R_b, H=100.0, rho_c=rho_c, T0=10.0)
    check_model(process, u=12.0, spread=2.0, inputs={"Q": 5000.0}).raise_if_failed()
    known = isinstance(rho_c, float)
    q = process.initial_parameter({"k": 2.0, "R_b": 0.1} | ({} if known else {"rho_c": 2.3e6}))
    times, control = np.geomspace(1.0, 50 * HOUR, 400).tolist(), Advance(Alexander2())
    *_, (t, u) = simulate(process, q, 10.0, [0.0, *times], control, lambda t: {"Q": 5000.0})
    wall = 10.0 + 5000.0 / (4 * np.pi * 2.0 * 100.0) * exp1(0.01**2 * 2.3e6 / (4 * 2.0 * t))
    assert (process.state_block.at_vertices @ u)[0] == pytest.approx(wall, rel=5e-3)


def test_a_case_may_leave_the_heat_capacity_unknown() -> None:
    mesh, equation = lp.interval(0.1, 5.0, 10, geometric=True), EQUATIONS["borehole"]
    unknowns = {name: lp.Normal(1.0, 0.1) for name in ("k", "R_b", "rho_c")}
    options = {"H": 100.0, "rho_c": 2.3e6, "T0": 10.0}
    assert set(equation.build(mesh, unknowns, {}, **options).parameter_space.labels) == set(
        unknowns
    )
    with pytest.raises(ModelError, match="far away"):
        equation.build(mesh, unknowns, {"right": 1.0}, **options)


SHORT = """
equation = "grouted_borehole"
initial = "10 degC"

[mesh]
x = ["2 cm", "12 m"]      # radius
y = ["5 cm", "10.05 m"]   # height, from the end of the borehole to its middle
cells = [40, 12]
spacing = ["geometric", "geometric"]

[options]
H = "20 m"
r_p = "23.6 mm"
r_b = "63 mm"
C_f = 4900
C_p = 1000
C_g = 3.8e6
T0 = "10 degC"

[unknowns]
k = { prior = 2, std = 1, transform = "log" }
rho_c = { prior = 2.3e6, std = 1e5, transform = "log" }
R_b = { prior = 0.12, std = 0.05, transform = "log" }
share = { prior = 0.3, std = 0.05, transform = "logit", bounds = [0, 1] }

[data]
file = "test.csv"
time = "t"

[channels]
Q = { role = "input", column = "Q", unit = "W" }
T_fluid = { role = "sensor", column = "T", unit = "degC", over = "left", noise = 0.01 }
"""


@pytest.mark.long
@pytest.mark.parametrize("finite", [True, False])
def test_a_short_borehole_from_a_case(tmp_path: Path, finite: bool) -> None:
    """Its ends cool it: a case of radius and height finds k, one of the radius alone does not."""
    times = np.concatenate([[0.0], np.geomspace(300.0, 150 * HOUR, 40)])
    T = fluid(plane(cells=60), times) + np.random.default_rng(3).normal(0.0, 0.01, len(times))
    rows = [f"{t},{POWER},{one}" for t, one in zip(times, T, strict=True)]
    (tmp_path / "test.csv").write_text("\n".join(["t,Q,T", *rows]))
    case = SHORT
    if not finite:
        low, high = SHORT.index("x = ["), SHORT.index("\n[options]")
        mesh = 'from = "2 cm"\nto = "12 m"\ncells = 40\nspacing = "geometric"\n'
        case = (case[:low] + mesh + case[high:]).replace('over = "left"', 'at = "2 cm"')
    (tmp_path / "case.toml").write_text(case)
    prepared = cases.load(tmp_path / "case.toml").prepare()
    found = prepared.identifier.run(prepared.stream).last["k"]
    assert (abs(found.mean - TRUTH["k"]) < 2 * found.std) == finite
