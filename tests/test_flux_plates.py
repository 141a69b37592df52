"""Heat-flux plates as sensors, unknown heat capacities, and R and U values of a wall."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from factories import observe, rates

import livepde as lp
from benchmarks import first_hour
from livepde.cases import case_channels, load
from livepde.cases.new_case import write_template
from livepde.cases.remedies import freed
from livepde.errors import CaseError, ObservationError
from livepde.fem import Inputs, Moment
from livepde.laws.shadow_kinds import HalvedMesh
from livepde.models import EQUATIONS, conduction
from livepde.observation import Combined, FluxPlates
from livepde.runs.summary import LAYERS, SURFACES, resistance, tables
from livepde.verdict import Cause
from livepde.verdict.model_errors import Allowed, ModelErrors

REPORTS = Path(__file__).parent / "reports"
NOW = Moment(0.0, Inputs())


def wall(cells: int = 16, **options: Any) -> lp.Model:
    k = options.pop("k", lp.Normal(2.0, 1.0))
    return conduction(lp.interval(0.0, 1.0, cells), k, {"right": 0.0}, C=4.0, **options)


def read(model: lp.Model, places: dict[str, Any], u: Any) -> np.ndarray:
    seen = observe(model, FluxPlates(places))
    return seen.predict(model.state_space.interpolate(u), model.parameter_space.prior, NOW)


# --- the sensor ----------------------------------------------------------------------------------


@pytest.mark.parametrize("place", ["left", "right", 0.37])
def test_a_flux_is_of_second_order_everywhere(place: Any) -> None:
    """-k u_x of u = cos(3 x), k = 2: into the domain at the ends, towards larger x inside."""
    x = {"left": 0.0, "right": 1.0}.get(place, place)
    exact = 6.0 * math.sin(3.0 * x) * (-1.0 if place == "right" else 1.0)
    errors = []
    for cells in (20, 40, 80, 160):
        (found,) = read(wall(cells), {"q": place}, lambda x: np.cos(3.0 * x[0]))
        errors.append(abs(found - exact))
    assert errors[-1] < 2e-3
    if place != 0.37:  # cells move past it
        assert rates(errors).min() > 1.7


def test_the_flux_through_layers_is_continuous() -> None:
    """A steady state of two layers: the same flux at each place, also at the joint."""
    layers = lp.Piecewise(
        {"a": lambda x: x[0] < 0.25, "b": lambda x: x[0] >= 0.25},
        lp.Normal(1.0, 1.0),
        own={"b": lp.Scalar(lp.Normal(3.0, 1.0))},
    )
    places = {"l": "left", "a": 0.1, "joint": 0.25, "b": 0.8, "r": "right"}
    steady = lambda x: np.where(x[0] < 0.25, -x[0], -0.25 - (x[0] - 0.25) / 3.0)  # noqa: E731
    found = read(wall(k=layers), places, steady)
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0, 1.0, -1.0], rtol=1e-12)


def test_a_field_of_conductivity_counts_where_the_plate_is() -> None:
    mesh = lp.interval(0.0, 1.0, 16)
    field = lp.Field(mesh, lp.linear(mesh), prior=lp.Normal(1.0, 1.0))
    model = conduction(mesh, field, {"right": 0.0}, C=1.0)
    seen = observe(model, FluxPlates({"q": 0.5}))
    q = np.sort(mesh.p[0])[np.argsort(np.argsort(model.parameter_space.fields["k"].doflocs[0]))]
    u = model.state_space.interpolate(lambda x: -2.0 * x[0])
    assert seen.predict(u, 1.0 + q, NOW)[0] == pytest.approx(3.0)


def test_each_sensor_keeps_its_unit() -> None:
    model = wall()
    plates = FluxPlates({"q": "left"}, noise=0.3, unit="W/m^2")
    both = Combined([lp.Points({"T": 0.5}, noise=0.1, unit="degC"), plates])
    seen = observe(model, both)
    assert seen.units == ("degC", "W/m^2")
    assert seen.unit == ""
    gained = lp.observation.Calibrated(both, lambda y, q, x: 2.0 * y)
    assert observe(model, gained).units == seen.units


def plate() -> lp.Model:
    mesh = lp.rectangle((0, 1), (0, 1), (4, 4))
    return conduction(mesh, lp.Normal(1.0, 0.5), {"boundary": 0.0}, C=1.0)


@pytest.mark.parametrize(
    ("places", "conductivity", "model", "text"),
    [
        ({}, "k", wall, "give at least one place"),
        ({"q": 1.2}, "k", wall, r"'q' is at 1.2, outside the mesh from 0 to 1"),
        ({"q": 1.0}, "k", wall, r"'q' is at 1, the end of the mesh; give the name of this end"),
        ({"q": "top"}, "k", wall, r"'q' is at 'top'; the mesh names \['left', 'right'\]"),
        ({"q": 0.1}, "alpha", wall, r"'alpha'; it has \['k'\]. Set conductivity"),
        ({"q": 0.1}, "k", lambda: wall(1), "two cells or more"),
        ({"q": "left"}, "k", plate, "requires a mesh of one dimension; use Functionals"),
    ],
)
def test_what_is_no_flux_is_refused(places: Any, conductivity: str, model: Any, text: str) -> None:
    with pytest.raises(ObservationError, match=text):
        observe(model(), FluxPlates(places, conductivity))


# --- in a case -----------------------------------------------------------------------------------

CASE = """
equation = "conduction"
initial = "interpolate"
mesh = { from = 0, to = "24 cm", cells = 30 }
data = { file = "wall.csv", time = "time_s", time_unit = "s" }
[unknowns]
k = { prior = "0.8 W/(m K)", std = "0.4 W/(m K)", transform = "log" }
C = { prior = "1.5e6 J/(m^3 K)", std = "0.5e6 J/(m^3 K)", transform = "log" }
[channels]
T_inside = { role = "boundary", column = "T_inside", at = "left" }
T_outside = { role = "boundary", column = "T_outside", at = "right" }
q = { role = "sensor", column = "q_inside", quantity = "flux", at = "left", noise = "0.3 W/m^2" }
"""


def case(folder: Path, *changes: tuple[str, str]) -> Path:
    text = CASE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "wall.toml").write_text(text)
    return folder / "wall.toml"


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_a_plate_as_a_sensor_determines_k_and_C(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Truth by finite volumes, with exact surface temperatures and a plate with noise."""
    monkeypatch.setattr(first_hour, "WALL_KELVIN", 1e-3)
    truths = first_hour.write(tmp_path, "wall", seed)
    prepared = load(case(tmp_path)).prepare()
    result = prepared.identifier.run(prepared.stream)
    estimate = result.last
    assert estimate is not None
    for name, truth in truths.items():
        value, std = estimate[name].median, estimate[name].std
        assert abs(value - truth) < 3.0 * std < 0.015 * truth, (name, value, truth, std)
    data = prepared.layout.dataset(result.records)
    (row,) = next(table for table in tables(data) if table.title.startswith("Measured")).rows
    assert row[0] == "q"
    assert row[-1] == "W/m^2"
    found = resistance(data)
    assert found is not None
    assert pytest.approx(0.24 / float(data["k"][-1])) == found.R


HIDDEN = [
    ('role = "sensor"', 'role = "validation"'),
    (
        'role = "boundary", column = "T_outside", at = "right"',
        'role = "sensor", column = "T_outside", at = "24 cm"',
    ),
]
FISHER = [
    ('"conduction"', '"fisher_kpp"'),
    ('initial = "interpolate"', "initial = 1\noptions.K = 1"),
    ('k = { prior = "0.8 W/(m K)", std = "0.4 W/(m K)"', "D = { prior = 1, std = 1"),
    ('C = { prior = "1.5e6 J/(m^3 K)", std = "0.5e6 J/(m^3 K)"', "r = { prior = 1, std = 1"),
    ('noise = "0.3 W/m^2"', "noise = 1"),
]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ([('at = "left", noise', "noise")], "needs at = the name of an end"),
        ([('at = "left", noise', 'at = "left", at_std = "1 mm", noise')], "at_std is not possible"),
        ([("[channels]", '[law]\nnoise = "0.1 K"\n[channels]')], "q measures a flux. Leave it out"),
        ([('at = "left", noise', 'at = "top", noise')], "channels.q.at"),
        ([('role = "sensor"', 'role = "input"')], "requires a sensor"),
        ([('noise = "0.3 W/m^2"', 'noise = "0.3 K"')], "channels.q.noise"),
        (HIDDEN, "a sensor with quantity = 'flux'"),
        (FISHER, "has no flux to measure"),
    ],
)
def test_a_plate_that_a_case_cannot_have_is_refused(
    tmp_path: Path, changes: list[tuple[str, str]], text: str
) -> None:
    with pytest.raises(CaseError, match=text):
        load(case(tmp_path, *changes))


def test_the_start_is_made_of_temperatures_only(tmp_path: Path) -> None:
    first_hour.write(tmp_path, "wall")
    prepared = load(case(tmp_path)).read()
    z = prepared.first.z
    ends = prepared.u0(np.array([[0.0, 0.24]]))
    assert ends.tolist() == [z["T_inside"], z["T_outside"]]


def test_noise_of_the_temperature_at_a_plate_is_noted(tmp_path: Path) -> None:
    noisy = ('at = "left" }', 'at = "left", noise = "0.1 K" }')
    (note,) = [note for note in load(case(tmp_path, noisy)).notes if "T_inside" in note]
    assert "boundary.left = { flux = 'J' }" in note
    assert not [note for note in load(case(tmp_path)).notes if "T_inside" in note]


@pytest.mark.long
def test_a_scale_of_the_plate_may_be_unknown(tmp_path: Path) -> None:
    first_hour.write(tmp_path, "wall")
    path = case(tmp_path, ('at = "left", noise', 'at = "left", gain = 0.03, noise'))
    prepared = load(path, settings={"data.stop": 6000.0, "law.verdict": False}).prepare()
    estimate = prepared.identifier.run(prepared.stream).last
    assert estimate is not None
    assert estimate["gain[q]"].std == pytest.approx(0.03, rel=0.05)


def test_an_offset_of_the_plate_may_be_unknown(tmp_path: Path) -> None:
    first_hour.write(tmp_path, "wall")
    stated = ('at = "left", noise', 'at = "left", offset = "2 W/m^2", noise')
    assert case_channels.unknowns_of(load(case(tmp_path, stated)))["offset"].unit == "W/m^2"
    note = Cause("offset", "q", "", size=1.0)
    assert freed(load(case(tmp_path)).prepare(), note) == ('channels.q.offset="2 W/m^2"',)
    assert not freed(load(case(tmp_path)).prepare(), Cause("position", "q", "", size=0.01))
    sensor = 'T_mid = { role = "sensor", column = "T_inside", at = 0.1, offset = "1 K", noise = 1 }'
    with pytest.raises(CaseError, match="all share one prior"):
        load(case(tmp_path, stated, ("[channels]", f"[channels]\n{sensor}")))


def test_init_opens_the_noise_of_each_kind_of_sensor(tmp_path: Path) -> None:
    table = tmp_path / "wall.csv"
    table.write_text("time_s,T_in [degC],q [W/m2]\n0,20,5\n60,20,6\n120,21,5\n")
    write_template(tmp_path / "new", table, EQUATIONS["conduction"])
    text = (tmp_path / "new" / "case.toml").read_text()
    assert text.count('noise = "? K"') == text.count('noise = "? W/m^2"') == 1
    assert "law" not in tomllib.loads(text)


# --- R and U -------------------------------------------------------------------------------------


def run_of(k: list[float], std: list[float], correlation: float, **attrs: Any) -> xr.Dataset:
    labels = [f"k[{name}]" for name in "ab"[: len(k)]]
    data: dict[str, Any] = {}
    for label, value, one in zip(labels, k, std, strict=True):
        data[label] = ("time", [9.0, value])
        data[f"{label}_std"] = ("time", [9.0, one])
    coords: dict[str, Any] = {"time": [0.0, 1.0]}
    if len(k) > 1:
        r = [[1.0, 0.0, correlation], [0.0, 1.0, 0.0], [correlation, 0.0, 1.0]]
        data["correlation"] = (("unknown", "other"), r)
        coords["unknown"] = [labels[0], "C", labels[1]]
    thick = "{" + ", ".join(f'"{label}": 0.12' for label in labels) + "}"
    return xr.Dataset(data, coords, {LAYERS: thick, **attrs})


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_R_and_U_have_the_spread_of_draws(correlation: float) -> None:
    """Against draws of the joint log-normal distribution of both layers."""
    k, relative = np.array([0.4, 1.5]), np.array([0.02, 0.06])
    data = run_of(k.tolist(), (k * relative).tolist(), correlation, **{SURFACES: 0.17})
    found = resistance(data)
    assert found is not None
    covariance = np.outer(relative, relative) * [[1.0, correlation], [correlation, 1.0]]
    draws = np.random.default_rng(0).multivariate_normal(np.log(k), covariance, 200_000)
    R = (0.12 / np.exp(draws)).sum(axis=1)
    U = 1.0 / (R + 0.17)
    assert pytest.approx(np.median(R), rel=2e-3) == found.R
    assert found.relative == pytest.approx(np.log(R).std(), rel=0.02)
    assert pytest.approx(np.median(U), rel=2e-3) == found.U
    assert found.relative_U == pytest.approx(np.log(U).std(), rel=0.02)


def test_the_report_of_a_wall_says_which_resistance_it_is() -> None:
    plain = {row[0]: row for table in tables(run_of([0.4], [0.004], 0.0)) for row in table.rows}
    assert plain["R, without surface resistances"][1:] == (
        "0.3000",
        "0.0030",
        "0.2942 to 0.3059",
        "m^2 K/W",
    )
    assert plain["U, without surface resistances"][1] == "3.333"
    data = run_of([0.4], [0.004], 0.0, **{SURFACES: 0.17})
    names = [row[0] for table in tables(data) for row in table.rows]
    assert "U, with 0.17 m^2 K/W of surface resistances" in names


def test_the_interval_of_a_wall_allows_for_model_errors() -> None:
    """R is highest where each conductivity is lowest, and U the other way round."""
    data = run_of([0.4, 0.6], [0.004, 0.006], 0.0, **{SURFACES: 0.17})
    found = [
        Allowed(label, "W/(m K)", k, 0.9 * k, 1.2 * k, 0.98 * k, 1.02 * k, 5.0)
        for label, k in zip(["k[a]", "k[b]"], [0.4, 0.6], strict=True)
    ]
    errors = ModelErrors(3.0, 0.1, unknowns=tuple(found)).to_dict()
    data.attrs["verdict"] = json.dumps({"level": "caution", "errors": errors})
    (wall,) = (table for table in tables(data) if "Wall" in table.title)
    assert wall.columns[2] == "with model errors"
    R, U = wall.rows
    assert (R[1], R[2]) == ("0.5000", "0.4167 to 0.5556")
    assert (U[1], U[2]) == ("1.4925", "1.3783 to 1.7045")


def test_the_layers_of_a_case_have_their_thickness(tmp_path: Path) -> None:
    regions = 'transform = "log", regions = { a = [0, "8 cm"], b = ["8 cm", "24 cm"] } }\nC'
    path = case(tmp_path, ('transform = "log" }\nC', regions))
    settings = {"output.surface_resistances": ["0.13 m^2 K/W", "0.04 m^2 K/W"]}
    first_hour.write(tmp_path, "wall")
    attrs = load(path, settings=settings).read().attributes
    assert xr.Dataset(attrs=attrs).attrs[SURFACES] == pytest.approx(0.17)
    assert eval(attrs[LAYERS]) == {"k[a]": pytest.approx(0.08), "k[b]": pytest.approx(0.16)}


FIELD = ('transform = "log" }\nC', 'transform = "log", field = true }\nC')


@pytest.mark.parametrize(
    ("changes", "first", "text"),
    [
        ([], "-0.1 m^2 K/W", "expected 0 or more"),
        ([], "0.1 K", "surface_resistances"),
        ([FIELD], "0.1 m^2 K/W", "requires a wall"),
    ],
)
def test_surface_resistances_are_checked(
    tmp_path: Path, changes: list[tuple[str, str]], first: str, text: str
) -> None:
    settings = {"output.surface_resistances": [first, "0 m^2 K/W"]}
    with pytest.raises(CaseError, match=text):
        load(case(tmp_path, *changes), settings=settings)


# --- a report of a user --------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("table", ["wall_start.csv", "wall_straight.csv"])
def test_a_wall_that_begins_in_a_curve_or_a_line(table: str) -> None:
    """Truths of finite volumes: k 0.62 W/(m K), C 1.35e6 J/(m^3 K)."""
    settings = {"data.file": table}
    prepared = load(REPORTS / "wall_start.toml", allow_code=True, settings=settings).prepare()
    estimate = prepared.identifier.run(prepared.stream).last
    assert estimate is not None
    assert estimate.verdict.level == "trusted"
    for name, truth in {"k": 0.62, "C": 1.35e6}.items():
        low, high = estimate[name].interval()
        assert low <= truth <= high, (name, low, truth, high)
        assert high - low < 0.1 * truth


@pytest.mark.parametrize(
    "bend", [lambda x: 20.0 - 80.0 * x + 99.0 * x**2, lambda x: np.sin(8.0 * x)]
)
@pytest.mark.parametrize("at", ["left", 0.1475])
def test_the_halved_mesh_shows_what_plates_read_there(at: Any, bend: Any) -> None:
    """A plate reads another value of the same state on cells half as wide."""
    layers = {"one": lambda x: x[0] < 0.2, "two": lambda x: x[0] > 0.2}
    k = lp.Piecewise(layers, lp.LogNormal(0.5, 0.4))
    coarse = conduction(lp.interval(0.0, 0.3, 30), k, {"right": 0.0}, C=4.0)
    problem = lp.Identifier(coarse, FluxPlates({"q": at}, noise=0.3), u0=20.0).problem
    mesh = HalvedMesh.of(problem)
    u, fine = (one.state_space.interpolate(lambda x: bend(x[0])) for one in (coarse, mesh.model))
    q = coarse.initial_parameter({"k": [0.7, 0.2]})
    difference = (fine - mesh.prolong(u[None])[0])[None]
    (found,) = mesh.in_readings(u[None], q[None], u[None], difference, lambda k: NOW)
    there, here = mesh.model.latent.value(mesh.unknowns @ q), coarse.latent.value(q)
    expected = mesh.observed.predict(fine, there, NOW) - problem.observed.predict(u, here, NOW)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.slow
def test_a_plate_at_an_end_is_judged_by_the_error_that_the_mesh_makes() -> None:
    """The mesh moves k by .02 %: an interval of .1 % is nearly as wide as without its error."""
    mesh, times = lp.interval(0.0, 1.0, 40), np.linspace(0.0, 4.0, 81)
    ends = {"left": lp.Channel("T_in"), "right": 0.0}
    model = conduction(mesh, lp.LogNormal(1.0, 0.4), ends, C=lp.LogNormal(4.0, 1.0))
    fine = conduction(lp.interval(0.0, 1.0, 160), lp.Normal(1.0, 1.0), ends, C=lp.Normal(4.0, 1.0))
    sensors = Combined([lp.Points({"T": 0.4}, noise=0.01), FluxPlates({"q": "left"}, noise=0.05)])
    twin = lp.streams.Twin(
        model=fine,
        observation=sensors,
        q_true={"k": 0.8, "C": 5.0},
        u0=0.0,
        times=times,
        inputs=lambda t: {"T_in": math.sin(t) ** 2},
        dt_max=0.0125,
    )
    samples, stds = list(twin), []
    for shadows in (None, lp.laws.Shadows()):
        law = lp.SensitivityLaw(shadows=shadows)
        result = lp.Identifier(model, sensors, law, u0=0.0).run(samples)
        stds.append(result.last.parameters["C"][1])
        assert all(finding.what != "discretisation" for finding in result.verdict.findings)
    assert stds[1] < 1.5 * stds[0]
