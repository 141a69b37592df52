"""Exports of runs to formats of other programs, read back with their readers."""

import importlib.util
import json
import re
import shutil
import sys
import warnings
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory

import meshio
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from commands import call
from factories import BODIES
from meshio.xdmf import TimeSeriesReader
from scipy.io import netcdf_file
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.wait import WebDriverWait

import livepde as lp
from livepde import runs
from livepde.dashboard.html_report import write_report
from livepde.errors import ConfigurationError, LivepdeError, RunError
from livepde.frames import layout_of
from livepde.models import heat
from livepde.plots import interval_95
from livepde.runs import Check, RunWriter, drive, tables
from livepde.runs.exported import cf, export, udunits
from livepde.runs.journal import Event, Journal

ORIGIN = "2025-04-01 06:00:00"
SAMPLES = 6


def identifier(kind: str = "line", field: bool = False) -> lp.Identifier:
    mesh = BODIES[kind]()
    halves = {"near side": lambda x: x[0] < 0.5, "far": lambda x: x[0] >= 0.5}
    alpha = lp.Piecewise(halves, lp.LogNormal(0.1, 0.05), unit="m^2/s")
    if field:
        alpha = lp.Field(mesh, lp.linear(mesh), prior=lp.Normal(0.1), unit="m^2/s")
    loss = lp.Scalar(lp.Normal(0.2, 0.1), unit="1/s")
    points = [0.6, 0.3] if mesh.dim() == 1 else [(x, *[0.4] * (mesh.dim() - 1)) for x in (0.6, 0.3)]
    return lp.Identifier(
        heat(mesh, alpha, {"left": lp.Channel("T0")}, loss=loss),
        lp.Points({"a": points[0]}, noise=0.1, unit="degC"),
        lp.SensitivityLaw(refit=None),
        validation=lp.Points({"b, inside": points[1]}),
    )


def samples(count: int = SAMPLES):
    values = {"T0": 1.0, "ambient": 0.0, "b, inside": 0.5}
    return [lp.Sample(60.0 * t, {**values, "a": 0.1 * t}) for t in range(count)]


def described(who: lp.Identifier, **attrs):
    layout = layout_of(who.model, who.observed, who.validation)
    return replace(layout, length_unit="m", attrs={"title": "A rod", "equation": "u_t", **attrs})


def journal(path, who, **attrs) -> Journal:
    return Journal.create(path, who.channels, described(who, **attrs))


@cache
def files_of_a_run(kind: str, count: int, attrs: tuple) -> dict[str, bytes]:
    with TemporaryDirectory() as parent:
        folder, who = Path(parent) / "run", identifier(kind)
        command = ["livepde", "run", "rod.toml"]
        writer = RunWriter.create(folder, version="1.2", command=command, title="A rod")
        with journal(folder / "journal.sqlite", who, **dict(attrs)) as kept:
            driven = drive(who, samples(count), journal=kept, fields_every=2)
            assert driven.error is None
            data = driven.result.to_xarray()
        writer.finish(status="finished", dataset=data, shown=tables(data))
        return {path.name: path.read_bytes() for path in folder.iterdir()}


def made(folder, kind: str = "line", count: int = SAMPLES, **attrs) -> runs.Run:
    """Provide a finished run on a mesh of a given kind."""
    folder.mkdir()
    for name, content in files_of_a_run(kind, count, tuple(attrs.items())).items():
        (folder / name).write_bytes(content)
    return runs.open(folder)


@pytest.fixture
def rod(tmp_path) -> runs.Run:
    return made(tmp_path / "rod", origin=ORIGIN)


# --- names and units -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("m^2/s", "m2 s-1"),
        ("W/(m K)", "W m-1 K-1"),
        ("degC", "degC"),
        ("W/m^2/degC", "W m-2 K-1"),
        ("1/mm^2", "mm-2"),
        ("um", "um"),
        ("%", "%"),
        ("", "1"),
        ("1/year", "year-1"),  # in UDUNITS "a" is an are
        ("m^0.5", None),  # UDUNITS has no roots
        ("cells per well", None),
        ("3 m", None),
    ],
)
def test_units_are_those_of_udunits(unit, expected):
    assert udunits(unit) == expected


@pytest.mark.slow
def test_every_exported_name_is_valid_in_cf_and_keeps_the_original(rod):
    found = cf(rod.dataset)
    assert all(str(name).isidentifier() and str(name).isascii() for name in found.variables)
    assert found["alpha_near_side"].attrs["long_name"] == "alpha[near side]"
    assert found.attrs["scalars"].split() == ["alpha_near_side", "alpha_far", "loss"]
    assert found.attrs["state"] == "u"
    assert np.array_equal(found["alpha_far"], rod.dataset["alpha[far]"])


def test_names_that_would_coincide_stay_distinct():
    time = ("time", [0.0])
    data = xr.Dataset({"k[a b]": time, "k[a_b]": time, "κ": time, "2k": time}, {"time": [0.0]})
    found = cf(data)
    assert set(found.data_vars) == {"k_a_b", "k_a_b_2", "v", "v2k"}
    assert found["v"].attrs["long_name"] == "κ"


def test_a_unit_unknown_to_udunits_is_described_in_words(tmp_path):
    data = xr.Dataset({"k": ("time", [1.0], {"units": "m^0.5"})}, {"time": [0.0]}, {"scalars": "k"})
    found = cf(data)["k"].attrs
    assert found["comment"] == "unit: m^0.5"
    assert "units" not in found


@pytest.mark.slow
def test_a_number_is_exported_with_its_deviation_and_unit(rod):
    found = cf(rod.dataset)
    beside = found["loss"].attrs["ancillary_variables"].split()
    assert beside == ["loss_std", "loss_low", "loss_high", "loss_left"]
    low, high = interval_95(rod.dataset, "loss")
    assert np.array_equal(found["loss_low"], low)
    assert np.array_equal(found["loss_high"], high)
    assert found["loss_std"].attrs["long_name"] == "standard deviation of loss"
    assert found["loss_low"].attrs["units"] == "s-1"
    assert found["loss_left"].attrs["units"] == "1"
    assert found["u"].attrs["ancillary_variables"] == "u_std"
    assert all(name in found for name in beside)


@pytest.mark.slow
def test_temperatures_and_their_differences(rod):
    before = rod.dataset.copy(deep=True)
    found = cf(rod.dataset)
    xr.testing.assert_identical(rod.dataset, before)
    assert found["u"].attrs["units_metadata"] == "temperature: on_scale"
    for name in ("u_std", "innovation", "validation_error"):
        assert found[name].attrs["units_metadata"] == "temperature: difference"
    assert "units_metadata" not in found["loss"].attrs


# --- files that xarray opens -----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_xarray_opens_times_as_dates(rod, tmp_path, ending):
    target = tmp_path / f"rod{ending}"
    export(rod, target)
    options = {"engine": "scipy"} if ending == ".nc" else {"engine": "zarr"}
    with xr.open_dataset(target, **options) as found:
        found.load()
    assert found["time"].values[1] == np.datetime64("2025-04-01T06:01:00")
    assert found["snapshot"].values[-1] == np.datetime64("2025-04-01T06:05:00")
    assert found["time"].attrs["standard_name"] == "time"
    assert [found[name].attrs.get("axis") for name in ("time", "snapshot", "x")] == ["T", "T", None]
    assert found.attrs["Conventions"] == "CF-1.11"
    assert found.attrs["title"] == "A rod"
    assert found.attrs["source"] == "livepde 1.2"
    assert found.attrs["history"].endswith("livepde run rod.toml")
    assert list(found["sensor"].values) == ["a"]
    assert list(found["validation"].values) == ["b, inside"]
    assert np.array_equal(found["u"], rod.dataset["u"])
    assert found["u"].dims == ("snapshot", "vertex")
    assert found["x"].dims == ("vertex",)
    assert found["status"].attrs["flag_meanings"].split()[0] == "ok"
    flags = np.asarray(found["status"].attrs["flag_values"])
    assert flags.tolist() == list(range(len(found["status"].attrs["flag_meanings"].split())))


@pytest.mark.slow
def test_without_dates_times_are_numbers_with_a_unit(tmp_path):
    rod = made(tmp_path / "rod")
    export(rod, tmp_path / "rod.nc")
    with xr.open_dataset(tmp_path / "rod.nc", engine="scipy") as found:
        assert found["time"].values.tolist() == [60.0 * k for k in range(SAMPLES)]
        assert found["time"].attrs["units"] == "s"
        assert found["snapshot"].attrs["units"] == "s"
        for name in ("time", "snapshot"):  # CF: a time counts from a date
            assert not {"standard_name", "axis"} & set(found[name].attrs)


def test_times_of_a_model_without_units_are_plain_numbers(tmp_path):
    data = xr.Dataset({"k": ("time", [1.0, 2.0])}, {"time": [0.0, 0.5]}, {"origin": ORIGIN})
    found = cf(data)
    assert found["time"].attrs["units"] == "1"
    assert "standard_name" not in found["time"].attrs
    assert xr.decode_cf(found)["time"].values.tolist() == [0.0, 0.5]


@pytest.mark.slow
def test_fields_have_coordinates_in_the_file(rod, tmp_path):
    export(rod, tmp_path / "rod.nc")
    with xr.open_dataset(tmp_path / "rod.nc", engine="scipy", decode_cf=False) as found:
        assert found["u"].attrs["coordinates"] == "x"
        assert found["time"].attrs["units"] == f"seconds since {ORIGIN}"
        assert "_FillValue" not in found["time"].attrs
        assert found["status"].attrs["flag_values"].dtype.kind == found["status"].dtype.kind


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in BODIES if kind != "line"])
def test_a_mesh_follows_ugrid(tmp_path, kind):
    export(made(tmp_path / "run", kind), tmp_path / "run.nc")
    with xr.open_dataset(tmp_path / "run.nc", engine="scipy") as found:
        found.load()
    assert found.attrs["Conventions"] == "CF-1.11 UGRID-1.0"
    mesh = found["mesh"].attrs
    assert mesh["cf_role"] == "mesh_topology"
    dimension = mesh["topology_dimension"]
    assert dimension == {"triangle": 2, "quad": 2, "tetra": 3, "hexahedron": 3}[kind]
    role = "face_node_connectivity" if dimension == 2 else "volume_node_connectivity"
    corners = found[mesh[role]]
    assert corners.attrs["cf_role"] == role
    assert corners.attrs["start_index"] == corners.values.min() == 0
    points = [found[name].values for name in mesh["node_coordinates"].split()]
    assert len(points) == dimension
    assert corners.values.max() == len(points[0]) - 1
    assert found["u"].attrs["mesh"] == "mesh"
    assert found["u"].attrs["location"] == "node"
    assert volume(np.column_stack(points), kind, corners.values) == pytest.approx(1.0)


def volume(points, kind, corners) -> float:
    """Return the volume of a mesh of consistently oriented cells; boxes by edges at a corner."""
    ends = {"triangle": (1, 2), "quad": (1, 3), "tetra": (1, 2, 3), "hexahedron": (1, 3, 4)}[kind]
    share = {"triangle": 0.5, "quad": 1.0, "tetra": 1.0 / 6.0, "hexahedron": 1.0}[kind]
    edges = np.stack([points[corners[:, k]] - points[corners[:, 0]] for k in ends], axis=1)
    return share * float(np.linalg.det(edges).sum())


# --- tables ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_pandas_opens_the_time_series(rod, tmp_path):
    export(rod, tmp_path / "rod.csv")
    found = pd.read_csv(tmp_path / "rod.csv", dtype=str)
    numbers = [name for name in found if name.endswith("]")]
    found[numbers] = found[numbers].astype(float)  # exact, unlike the parsers of pandas 2
    data = rod.dataset
    assert pd.Timestamp(found["date"].iloc[1]) == pd.Timestamp("2025-04-01 06:01")
    assert np.array_equal(found["time [s]"], data["time"])
    for name in ("", "_std", "_low", "_high"):
        assert f"alpha[near side]{name} [m2 s-1]" in found
    assert np.array_equal(found["loss [s-1]"], data["loss"])
    low, _ = interval_95(data, "loss")
    assert np.array_equal(found["loss_low [s-1]"], low)
    assert np.array_equal(found["innovation:a [degC]"], data["innovation"][:, 0])
    assert np.array_equal(
        found["validation_error:b, inside [degC]"], data["validation_error"][:, 0]
    )
    assert found["status"].tolist() == ["ok"] * SAMPLES
    assert len(found) == SAMPLES
    pytest.importorskip("pyarrow")
    export(rod, tmp_path / "rod.parquet")
    columns = pd.read_parquet(tmp_path / "rod.parquet")
    assert list(columns) == list(found)
    assert np.array_equal(columns["loss [s-1]"], data["loss"])


# --- fields on their mesh --------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", BODIES)
def test_xdmf_contains_all_times(tmp_path, kind, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    run = made(tmp_path / "run", kind)
    export(run, tmp_path / "run.xdmf")
    assert not list(elsewhere.iterdir())
    data = run.dataset
    with TimeSeriesReader(tmp_path / "run.xdmf") as reader:
        points, cells = reader.read_points_cells()
        assert reader.num_steps == data.sizes["snapshot"] == 4
        for k in range(reader.num_steps):
            t, fields, _ = reader.read_data(k)
            assert t == data["snapshot"].values[k]
            assert np.array_equal(fields["u"], data["u"].values[k])
            assert np.array_equal(fields["u_std"], data["u_std"].values[k])
    assert [block.type for block in cells] == [kind]
    assert np.array_equal(points[:, 0], data["x"])
    if kind != "line":
        dimension = 2 if kind in ("triangle", "quad") else 3
        assert volume(points[:, :dimension], kind, cells[0].data) == pytest.approx(1.0)
    else:
        lengths = np.diff(points[cells[0].data][:, :, 0], axis=1)
        assert lengths.sum() == pytest.approx(1.0)
        assert (lengths > 0.0).all()


@pytest.mark.slow
def test_unknown_fields_are_also_on_the_mesh(tmp_path):
    writer = RunWriter.create(tmp_path / "run", version="1", command=[], title="A rod")
    data = drive(identifier(field=True), samples()).result.to_xarray()
    writer.finish(status="finished", dataset=data)
    export(runs.open(tmp_path / "run"), tmp_path / "run.vtu")
    found = meshio.read(tmp_path / "run.vtu")
    assert {"u", "u_std", "alpha", "alpha_std"} <= set(found.point_data)


# --- a run in progress ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_in_progress_is_exported_up_to_its_last_estimate(tmp_path):
    folder, who = tmp_path / "rod", identifier()
    RunWriter.create(folder, version="1", command=["livepde"], title="A rod")
    with journal(folder / "journal.sqlite", who) as kept:
        drive(who, samples(), journal=kept)
        kept.checkpoint(b"")  # commits
        for ending in (".nc", ".csv", ".xdmf", ".vtu"):
            export(runs.open(folder), tmp_path / f"rod{ending}")
        write_report(runs.open(folder), tmp_path / "rod.html")
        assert kept.accepted == SAMPLES
    assert len(pd.read_csv(tmp_path / "rod.csv")) == SAMPLES
    assert "running · 6 samples · 0 s to 300 s" in Page(tmp_path / "rod.html").text


def test_a_run_without_estimates_has_nothing_to_export(tmp_path):
    folder, who = tmp_path / "rod", identifier()
    RunWriter.create(folder, version="1", command=["livepde"], title="A rod")
    with journal(folder / "journal.sqlite", who), pytest.raises(RunError, match="no estimates yet"):
        export(runs.open(folder), tmp_path / "rod.nc")


# --- the report ------------------------------------------------------------------------------

HOSTILE = '</script><img src="http://evil.example/x"><script>alert(1)</script>'


class Page(HTMLParser):
    """Parser that collects external addresses, scripts and text of a page."""

    FETCHING = ("src", "href", "srcset", "data", "poster", "action", "background", "xlink:href")

    def __init__(self, path) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.fetched += [value for name, value in attrs if name in self.FETCHING]

    def handle_data(self, data):
        self.texts.append(data)

    @property
    def text(self) -> str:
        return "\n".join(self.texts)


def watched_run(folder, title="A rod", status="finished"):
    """Return a run with notes, checks, events and counts, under a given title."""
    who = identifier()
    writer = RunWriter.create(folder, version="1.2", command=["livepde"], title=title, case=title)
    with journal(folder / "journal.sqlite", who, origin=ORIGIN) as kept:
        data = drive(who, samples(), journal=kept).result.to_xarray()
        kept.note(Event(60.0, "silent", "a", f"nothing came: {title}"))
        kept.note(Event(120.0, "jump", "", "something jumped"))
        kept.count("late", "a", 3)
        kept.checkpoint(b"")
    data.attrs["equation"] = title
    checks = [Check("error", 0.5, 0.1, "<="), Check("rmse", 0.5, 0.6, "<=")]
    writer.finish(status=status, dataset=data, checks=checks, notes=[f"do not believe {title}"])
    return runs.open(folder)


@pytest.mark.slow
def test_a_report_contains_notes_checks_events_and_counts(tmp_path):
    run = watched_run(tmp_path / "run")
    code, output = call("export", run.path, tmp_path / "run.html")
    assert code == 0
    assert str(tmp_path / "run.html") in output
    page = Page(tmp_path / "run.html")
    for said in (
        "A rod – livepde",
        "finished · 6 samples · 2025-04-01 06:00:00 to 2025-04-01 06:05:00",
        "do not believe A rod",
        "alpha[near side]",
        "FAILED",
        "nothing came: A rod",
        "2025-04-01 06:01:00",
        "late",
        "livepde 1.2",
    ):
        assert said in page.text
    with pytest.raises(RunError, match=r"run\.html exists"):
        call("export", run.path, tmp_path / "run.html")


@pytest.mark.slow
def test_all_formats_are_checked_before_one_is_written(tmp_path, monkeypatch):
    run = watched_run(tmp_path / "run")
    monkeypatch.setitem(sys.modules, "meshio", None)  # simulates a missing package
    with pytest.raises(ConfigurationError, match=r"rod\.xdmf: this format needs meshio: pip"):
        call("export", run.path, tmp_path / "rod.csv", tmp_path / "rod.xdmf")
    assert not (tmp_path / "rod.csv").exists()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["line", "triangle", "tetra"])
def test_vtk_reads_the_meshes(tmp_path, kind):
    pyvista = pytest.importorskip("pyvista")  # the readers of ParaView
    run = made(tmp_path / "run", kind)
    last = run.dataset["u"].values[-1]
    for ending in (".vtu", ".vtk"):
        export(run, tmp_path / f"run{ending}")
        assert np.allclose(pyvista.read(tmp_path / f"run{ending}").point_data["u"], last)
    export(run, tmp_path / "run.xdmf")
    reader = pyvista.get_reader(tmp_path / "run.xdmf")
    assert list(reader.time_values) == run.dataset["snapshot"].values.tolist()
    reader.set_active_time_value(reader.time_values[-1])
    found = reader.read()
    found = found[0] if isinstance(found, pyvista.MultiBlock) else found
    assert np.allclose(found.point_data["u"], last)


def complaints(path) -> list[str]:
    """Return the errors of a CF checker, each with its section of the conventions."""
    runner = pytest.importorskip("compliance_checker.runner")
    suite = runner.CheckSuite()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the checker calls deprecated functions
        suite.load_all_available_checkers()
        with suite.load_dataset(str(path)) as data:
            ((found, crashed),) = suite.run_all(data, ["cf:1.11"]).values()
    assert not crashed
    highest = suite.checkers["cf:1.11"].HIGH
    # The value is a boolean, or the number of passed parts and the number of parts.
    missed = [one for one in found if one.weight == highest and not passed(one.value)]
    return [f"{one.name}: {text}" for one in missed for text in one.msgs]


def passed(value: bool | tuple[int, int]) -> bool:
    return value[0] == value[1] if isinstance(value, tuple) else value


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    ["triangle", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("line", "hexahedron"))],
)
def test_a_checker_of_cf_accepts_the_files(tmp_path, kind):
    export(made(tmp_path / "run", kind, origin=ORIGIN), tmp_path / "run.nc")
    # The roles of UGRID are part of CF 1.11, appendix A; the checker only knows older versions.
    found = [text for text in complaints(tmp_path / "run.nc") if "cf_role" not in text]
    assert not found


@pytest.mark.long
def test_a_checker_of_cf_accepts_times_without_a_date(tmp_path):
    export(made(tmp_path / "run"), tmp_path / "run.nc")
    # Seconds without a date are not a CF time. The checker expects one because of the name.
    name_alone = "'time' should have standard_name='time'"
    assert all(name_alone in text for text in complaints(tmp_path / "run.nc"))
    with xr.open_dataset(tmp_path / "run.nc", engine="scipy") as found:
        wrong = found.load()
    wrong["time"].attrs["standard_name"] = "time"
    wrong.to_netcdf(tmp_path / "wrong.nc", engine="scipy")
    assert any("since" in text for text in complaints(tmp_path / "wrong.nc"))


@pytest.mark.slow
def test_coordinates_have_no_fill_value(rod):
    with netcdf_file(rod.path / "estimates.nc", mmap=False) as found:
        assert not hasattr(found.variables["time"], "_FillValue")
        assert not hasattr(found.variables["snapshot"], "_FillValue")


@pytest.mark.slow
def test_a_copied_case_that_is_not_text_is_shown_up_to_its_error(tmp_path):
    run = watched_run(tmp_path / "run")
    (run.path / "case.toml").write_bytes('title = "Fühler"'.encode("cp1252"))
    write_report(run, tmp_path / "run.html")
    assert 'title = "F\N{REPLACEMENT CHARACTER}hler"' in Page(tmp_path / "run.html").text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "doubts", "said"),
    [
        (0.05, [], "No problems detected"),
        (0.05, ["Model misfit."], "Model misfit"),
        (0.5, [], "Expected error <= 0.1, but it is 0.5"),
    ],
)
def test_a_report_starts_with_its_problems(tmp_path, monkeypatch, value, doubts, said):
    monkeypatch.setattr(runs, "doubts", lambda data: doubts)
    writer = RunWriter.create(tmp_path / "run", version="1", command=[], title="A rod")
    data = drive(identifier(), samples()).result.to_xarray()
    checks = [Check("error", value, 0.1, "<=")]
    writer.finish(status="finished", dataset=data, checks=checks, notes=["a note"])
    write_report(runs.open(tmp_path / "run"), tmp_path / "run.html")
    page = Page(tmp_path / "run.html")
    assert page.text.index(said) < page.text.index("a note") < page.text.index("Estimates")
    assert ("FAILED" in page.text) == (value > 0.1)
    assert ("No problems detected" in page.text) == (value <= 0.1 and not doubts)


@pytest.mark.slow
def test_a_report_loads_nothing_from_the_network(tmp_path):
    write_report(watched_run(tmp_path / "run"), tmp_path / "run.html")
    page = Page(tmp_path / "run.html")
    assert page.text.index("Measured and modelled") < page.text.index("Residuals")
    assert page.fetched == []
    assert not {"link", "iframe", "object", "embed", "base", "img"} & set(page.tags)
    text = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "url(" not in text.split("<style>")[1].split("</style>")[0]


@pytest.mark.slow
def test_titles_names_and_texts_are_escaped(tmp_path):
    run = watched_run(tmp_path / "run", HOSTILE)
    run.dataset = run.dataset.assign_coords(sensor=[HOSTILE])  # which become part of a script
    write_report(run, tmp_path / "run.html")
    text = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert HOSTILE not in text
    page = Page(tmp_path / "run.html")
    assert page.fetched == []
    assert "img" not in page.tags
    assert page.tags.count("script") == 2
    assert page.text.count(HOSTILE) >= 4  # heading, equation, note, event, case


@pytest.mark.slow
def test_a_report_needs_plotly(tmp_path, monkeypatch):
    run = watched_run(tmp_path / "run")
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'livepde\[dashboard\]'"):
        write_report(run, tmp_path / "run.html")


@pytest.fixture(scope="module")
def browser():
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no Chromium: install chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    with webdriver.Chrome(options, webdriver.ChromeService(driver)) as found:
        yield found


@pytest.mark.browser
@pytest.mark.parametrize("kind", ["line", "triangle", "tetra"])
def test_a_browser_draws_a_report_without_the_network(tmp_path, browser, kind):
    run = made(tmp_path / "run", kind, origin=ORIGIN)
    write_report(run, tmp_path / "run.html")
    browser.get((tmp_path / "run.html").as_uri())
    count = (tmp_path / "run.html").read_text(encoding="utf-8").count("<div data-figure=")
    assert count >= 5
    drawn = "[data-figure]:has(.main-svg)"
    WebDriverWait(browser, 60).until(
        lambda _: len(browser.find_elements(By.CSS_SELECTOR, drawn)) == count
    )
    buttons = browser.find_elements(By.CLASS_NAME, "modebar-btn")
    titles = {button.get_attribute("data-title") for button in buttons}
    assert not [title for title in titles if re.search("share|cloud|edit", title, re.IGNORECASE)]
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [
        message["params"]["request"]["url"].partition(":")[0]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
    assert "file" in asked
    assert set(asked) <= {"file", "data", "blob"}
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


# --- the command -----------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_several_formats(rod, tmp_path):
    targets = [tmp_path / name for name in ("a.nc", "a.CSV", "a.xdmf", "a.zarr")]
    code, output = call("export", rod.path, *targets)
    assert code == 0
    for target in targets:
        assert target.exists()
        assert str(target) in output
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.long
@pytest.mark.parametrize("name", ["a.nc", "a.csv", "a.xdmf", "a.vtu", "a.zarr"])
def test_files_are_only_overwritten_with_force(rod, tmp_path, name):
    target = tmp_path / name
    export(rod, target)
    other = made(tmp_path / "other", count=3)
    with pytest.raises(RunError, match=f"{name} exists. Choose another file, or add --force"):
        call("export", other.path, tmp_path / "new.csv", target)
    assert not (tmp_path / "new.csv").exists()
    assert call("export", other.path, target, "--force")[0] == 0
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    if name == "a.zarr":
        assert xr.open_dataset(target, engine="zarr").sizes["time"] == 3


@pytest.mark.slow
def test_the_data_file_of_xdmf_is_not_overwritten_either(rod, tmp_path):
    (tmp_path / "a.h5").write_text("mine")
    with pytest.raises(RunError, match=r"a\.h5 exists"):
        export(rod, tmp_path / "a.xdmf")
    assert (tmp_path / "a.h5").read_text() == "mine"
    assert not (tmp_path / "a.xdmf").exists()


@pytest.mark.slow
def test_a_folder_that_is_not_a_store_is_not_overwritten(rod, tmp_path):
    mine = tmp_path / "mine.zarr"
    mine.mkdir()
    (mine / "notes").write_text("mine")
    with pytest.raises(RunError, match="is a folder"):
        export(rod, mine, force=True)
    assert (mine / "notes").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a.xlsx"], r"there is no format '\.xlsx'; expected one of \.nc, "),
        (["nowhere/a.nc"], "cannot be written: No such file or directory"),
        (["a.nc", "--at", "60"], r"contains all times; a time is only chosen for \.vtu and \.vtk"),
        (["a.vtu", "--at", "noon"], "--at: got 'noon'"),
        (["a.vtu", "--at", "3 m"], "--at: 'm' cannot be converted to 's'"),
    ],
)
def test_impossible_exports_are_refused_with_one_sentence(rod, tmp_path, arguments, said):
    first, *more = arguments
    with pytest.raises(LivepdeError, match=said):
        call("export", rod.path, tmp_path / first, *more)
    assert [path.name for path in tmp_path.iterdir()] == ["rod"]


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["110", "1.9 min", "2025-04-01 06:02", "2025-04-01T08:02+02:00"])
def test_a_moment_is_a_number_a_quantity_or_a_date(rod, tmp_path, moment):
    assert call("export", rod.path, tmp_path / "a.vtu", "--at", moment)[0] == 0
    found = meshio.read(tmp_path / "a.vtu")
    assert np.array_equal(found.point_data["u"], rod.dataset["u"].values[1])


def test_a_moment_outside_the_run_is_refused(rod, tmp_path):
    with pytest.raises(ConfigurationError, match="outside the run, from"):
        call("export", rod.path, tmp_path / "a.vtu", "--at", "2026-04-01 06:02")


@pytest.mark.slow
def test_a_date_needs_dates(tmp_path):
    run = made(tmp_path / "rod")
    with pytest.raises(ConfigurationError, match="the run's times have no date"):
        call("export", run.path, tmp_path / "a.vtu", "--at", "2025-04-01")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "package"), [("a.zarr", "zarr"), ("a.xdmf", "h5py"), ("a.vtu", "meshio")]
)
def test_a_missing_package_is_named_with_its_extra(rod, tmp_path, monkeypatch, name, package):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda wanted: None if wanted == package else find(wanted)
    )
    said = rf"needs {package}: pip install 'livepde\[formats\]'"
    with pytest.raises(ConfigurationError, match=said):
        export(rod, tmp_path / name)
    assert not (tmp_path / name).exists()
