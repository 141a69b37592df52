"""The live page: figures of datasets, the view of a run, and the page in Chromium."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import closing, contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from browser import chromium, count, text, wait
from factories import BODIES, few
from patience import PATIENCE
from skfem import MeshTri
from typer.testing import CliRunner

import livepde as lp
from livepde import cli, runs
from livepde.dashboard import cards, serve
from livepde.dashboard import view as views
from livepde.dashboard.figures import canvas, field_views, panels
from livepde.dashboard.view import Spread, View
from livepde.frames import layout_of
from livepde.models import heat
from livepde.runs import JOURNAL, Journal, RunWriter, drive, journal_of
from livepde.runs.database import checksum
from livepde.runs.journal import Event
from livepde.runs.web import Address

HOSTILE = "<script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"


def identifier(kind: str = "line", *, field: bool = False, law=None) -> lp.Identifier:
    mesh = BODIES[kind]()
    alpha = lp.Scalar(lp.LogNormal(0.1, 0.05), unit="m^2/s")
    if field:
        alpha = lp.Field(mesh, lp.linear(mesh), prior=lp.Normal(0.1), unit="m^2/s")
    spot = [(x, *[0.4] * (mesh.dim() - 1)) if mesh.dim() > 1 else x for x in (0.6, 0.3)]
    return lp.Identifier(
        heat(
            mesh, alpha, {"left": lp.Channel("T0")}, loss=lp.Scalar(lp.Normal(0.2, 0.1), unit="1/s")
        ),
        lp.Points({"a": spot[0]}, noise=0.1, unit="degC"),
        law or lp.SensitivityLaw(refit=None),
        validation=lp.Points({"b": spot[1]}),
    )


def samples(count: int, pause: float = 0.0):
    for k in range(count):
        time.sleep(pause)
        warm = 20.0 + np.sin(0.1 * k)
        values = {"T0": warm, "ambient": 0.0, "a": 0.3 * warm, "b": 0.5 * warm}
        yield lp.Sample(0.2 * k, values)


def begun(folder: Path, who: lp.Identifier, title: str = "A rod", **attrs) -> Journal:
    """Create a run directory, and return its empty journal."""
    RunWriter.create(folder, version="1", command=["livepde"], title=title)
    layout = layout_of(who.model, who.observed, who.validation)
    return Journal.create(folder / JOURNAL, who.channels, replace(layout, attrs=attrs))


def slow_run(folder: Path) -> None:
    """Run at ten samples per second until stopped; the main function of a child process."""
    who = identifier()
    with begun(folder, who, origin="2025-04-01 00:00:00") as journal:
        drive(who, samples(100_000, 0.1), journal=journal, fields_every=2)


def dataset(kind: str = "line", count: int = 6, **options):
    who = identifier(kind, **options)
    kept = journal_of(who)
    return drive(who, samples(count), journal=kept, fields_every=2).result.to_xarray()


# --- figures -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "field"), few(5, BODIES, [False, True]))
def test_every_kind_of_run_has_its_panels(kind, field):
    data = dataset(kind, field=field)
    found = {panel.name: panel for panel in panels.panels(data)}
    assert {"field:u", "innovation", "validation_error", "told", "unknown:loss"} <= {*found}
    assert ("field:alpha" in found) is field
    assert ("correlation" in found) is not field
    for panel in found.values():
        assert panel.section in panels.SECTIONS
        assert panel.title
        assert panel.about
        json.loads(panel.figure.to_json())
    drawn = {"line": "scatter", "triangle": "heatmap", "quad": "heatmap"}.get(kind, "mesh3d")
    assert found["field:u"].figure.data[0].type == drawn


@pytest.mark.slow
def test_a_run_of_one_sample_and_one_without_covariance():
    assert len(panels.panels(dataset(count=1))) > 3
    law = lp.GradientLaw(gain=1e-3, damping=lp.laws.ResidualDamping(c1=1.0))
    plain = dataset(law=law)
    assert not {"told", "correlation"} & {panel.name for panel in panels.panels(plain)}
    assert "no covariance" in str(cards.cards(plain, None))


@pytest.mark.slow
def test_an_earlier_sample_shows_its_fields():
    data = dataset(count=9)

    def profile(at):
        (estimate,) = (
            trace
            for trace in field_views.field_profile(data, "u", at).data
            if trace.name == "estimate"
        )
        return estimate.y

    times = data["snapshot"].values
    assert len(times) == 5
    assert np.array_equal(profile(None), data["u"].values[-1])
    assert np.array_equal(profile(times[2] + 1e-9), data["u"].values[2])
    assert np.array_equal(profile(-1.0), data["u"].values[0])


@pytest.mark.slow
def test_unknowns_are_drawn_with_their_intervals():
    data = dataset(count=9)
    figure = panels.unknowns(data, ["loss"])
    (line,) = (trace for trace in figure.data if trace.name == "loss")
    band = [trace.y for trace in figure.data if trace.legendgroup == "loss" and trace is not line]
    assert np.array_equal(line.y, data["loss"])
    half = 1.959964 * data["loss_std"].values
    assert np.allclose(band, [data["loss"].values - half, data["loss"].values + half])


@pytest.mark.slow
def test_runs_with_an_origin_show_dates():
    data = dataset()
    assert canvas.when_axis(data).text(0.6) == "0.6 s"
    data.attrs["origin"] = "2025-04-01 00:00:00"
    assert canvas.when_axis(data).text(3600.0) == "2025-04-01 01:00:00"
    data["time"] = data["time"] * 1e300
    assert not canvas.when_axis(data).dates


@pytest.mark.slow
def test_long_series_are_thinned_but_failures_stay():
    data = dataset(count=4)
    long = data.isel(time=np.zeros(20_000, dtype=int), snapshot=[0])
    long["status"].values[777] = 1
    (line,) = (t for t in panels.unknowns(long, ["loss"]).data if t.name == "loss")
    assert len(line.y) <= panels.MOST_POINTS + 1
    assert "failed step" in {trace.name for trace in panels.unknowns(long, ["loss"]).data}


@pytest.mark.slow
def test_names_from_files_are_text_in_figures():
    data = dataset().rename({"loss": HOSTILE, "loss_std": f"{HOSTILE}_std"})
    data["sensor"] = [HOSTILE]
    drawn = [
        panels.residuals(data, "innovation", "sensor"),
        panels.unknowns(data, [HOSTILE, HOSTILE]),
    ]
    for figure in drawn:
        names = [trace.name for trace in figure.data if "document" in (trace.name or "")]
        assert names
        assert all("<script" not in name for name in names)


# --- cuts ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_a_map_is_exact_for_linear_fields(kind):
    data = dataset(kind, count=1)
    found = field_views.plane_map(data)
    values = found.of(2.0 * data["x"].values - 3.0 * data["y"].values)
    assert found.inside.all()
    assert np.allclose(values, 2.0 * found.x - 3.0 * found.y[:, None])


def test_sensors_are_on_the_map():
    data = dataset("triangle", count=1)
    sensor, validation = field_views.field_map(data, "u").data[1:]
    assert [*sensor.text, *sensor.x, *sensor.y] == ["a", 0.6, 0.4]
    assert [*validation.text, *validation.x, *validation.y] == ["b", 0.3, 0.4]


def test_a_hole_stays_open():
    mesh = MeshTri.init_tensor(np.linspace(0, 3, 4), np.linspace(0, 3, 4))
    middle = mesh.p[:, mesh.t].mean(axis=1)
    outside = ~((abs(middle[0] - 1.5) < 0.5) & (abs(middle[1] - 1.5) < 0.5))
    data = xr.Dataset(
        {"triangle": (("cell", "corner"), mesh.t.T[outside])},
        {axis: ("vertex", mesh.p[k]) for k, axis in enumerate("xy")},
    )
    found = field_views.plane_map(data)
    x, y = np.meshgrid(found.x, found.y)
    hole = (abs(x - 1.5) < 0.4) & (abs(y - 1.5) < 0.4)
    values = found.of(np.ones(mesh.nvertices))
    assert np.isnan(values[hole]).all()
    assert np.isfinite(values[(x < 0.9) | (y > 2.1)]).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tetra", "hexahedron"])
@pytest.mark.parametrize("share", [0.5, 0.37])
def test_cuts_of_a_cube_are_whole_and_exact(kind, share):
    data = dataset(kind, count=1)

    def linear(x, y, z):
        return 2.0 * x - 3.0 * y + 0.5 * z

    def area(surface):
        a, b, c = (surface.points[surface.triangles[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0

    values = linear(*(data[axis].values for axis in "xyz"))
    parts = field_views.slices(data, share)
    assert [area(part) for part in parts] == pytest.approx([1.0, 1.0, 1.0])
    assert area(field_views.boundary(data)) == pytest.approx(6.0)
    for axis, part in enumerate(parts):
        assert np.allclose(part.points[:, axis], share)
        assert np.allclose(part.of(values), linear(*part.points.T))


# --- view ----------------------------------------------------------------------------------------


def test_thinned_samples_are_evenly_spread():
    spread = Spread(50)
    for number in range(1, 100_001):
        spread.add(number, -number)
        spread.add(number, number)  # repeat the newest
    numbers = [number for number, _ in spread]
    assert 20 <= len(numbers) <= 50
    assert (numbers[0], numbers[-1]) == (1, 100_000)
    gaps = np.diff(numbers)[:-1]
    assert gaps.min() == gaps.max() == spread.gap
    assert all(number == item for number, item in spread)


@pytest.mark.slow
def test_a_view_follows_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "OFTEN", 0.0)
    who = identifier()
    journal = begun(tmp_path, who)
    view = View(tmp_path)
    assert view.look().status == "waiting"
    stream = samples(30)
    first = [next(stream) for _ in range(10)]
    drive(who, first, journal=journal, fields_every=3)
    seen = view.look()
    assert (seen.status, seen.samples) == ("running", 10)
    assert view.look() is seen  # nothing has changed
    assert float(seen.dataset["snapshot"][-1]) == first[-1].t  # kept after the estimate
    drive(who, stream, journal=journal, fields_every=3)
    journal.note(Event(5.8, "silent", "", "nothing from the source for 9 s"))
    journal.count("malformed", "", 3)
    journal.commit()
    seen = view.look()
    assert (seen.status, seen.samples) == ("silent", 30)
    assert np.array_equal(seen.dataset["loss"], journal.dataset()["loss"])
    _, readings = journal.readings(["a", "b"])
    panel = panels.panels(seen.dataset)[0]
    assert (panel.name, panel.section) == ("measured:degC", "measured")
    assert next(iter(panels.SECTIONS)) == "measured"
    points, lines = panel.figure.data[::2], panel.figure.data[1::2]
    errors = [seen.dataset[name].values[:, 0] for name in ("innovation", "validation_error")]
    for k, error in enumerate(errors):
        assert np.array_equal(points[k].y, readings[:, k])
        assert np.allclose(lines[k].y, readings[:, k] - error)
    assert [line.name for line in lines] == ["a", "b (validation)"]
    assert [line.line.dash for line in lines] == [None, "dash"]
    said = str(cards.verdict(seen))
    assert "The source is silent: nothing from the source for 9 s." in said
    assert "Irregular rows or values: 3 malformed." in said
    journal.close()
    monkeypatch.setattr(views, "QUIET", 0.0)
    assert view.look().status == "stopped"


@pytest.mark.long
def test_a_long_run_is_read_bit_by_bit_and_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "OFTEN", 0.0)
    monkeypatch.setattr(views, "AT_ONCE", 100)
    monkeypatch.setattr(views, "ROWS", 50)
    monkeypatch.setattr(views, "FIELDS", 10)
    who = identifier()
    with begun(tmp_path, who) as journal:
        drive(who, samples(450), journal=journal, fields_every=2)
        view, looks = View(tmp_path), 1
        while (seen := view.look()).reading and looks < 20:
            looks += 1
        assert looks == 5
        whole = journal.dataset()
    assert seen.samples == 450
    assert seen.dataset.sizes["time"] <= 60
    assert 4 <= seen.dataset.sizes["snapshot"] <= 10
    warm = 20.0 + np.sin(0.5 * seen.dataset["time"])
    assert np.allclose(seen.dataset["readings of sensors"][:, 0], 0.3 * warm)
    for end in (0, -1):
        assert float(seen.dataset["time"][end]) == float(whole["time"][end])
        assert np.array_equal(seen.dataset["u"][end], whole["u"][end])


@pytest.mark.slow
def test_a_finished_run_without_a_journal(tmp_path):
    writer = RunWriter.create(tmp_path, version="1", command=["livepde"], title="A rod")
    check = runs.Check("rmse", 0.5, 0.1, "<=")
    notes = ["The case says so."]
    writer.finish(status="finished", dataset=dataset(), checks=[check], notes=notes)
    seen = View(tmp_path).look()
    assert (seen.status, seen.samples) == ("finished", 6)
    said = str(cards.verdict(seen))
    assert "Expected rmse <= 0.1, but it is 0.5." in said
    assert "The case says so." in said
    assert "Not judged: the model was not tested" in said
    alone = replace(seen, checks=[], doubts=[text for text in seen.doubts if "Not judged" in text])
    level, text = cards.gravest(alone)
    assert (level, text.partition(": ")[0]) == ("warn", "Not judged")
    assert "No problems detected" not in str(cards.verdict(alone))


def test_a_damaged_run_is_reported_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "OFTEN", 0.0)
    with begun(tmp_path, identifier()):
        pass
    view = View(tmp_path)
    (tmp_path / JOURNAL).write_bytes(b"nothing of use" * 100)
    for _ in range(3):
        seen = view.look()
    assert seen.status == "unreadable"
    assert "The run cannot be read: " in str(cards.verdict(seen))


# --- serving -------------------------------------------------------------------------------------


def test_watch_requires_a_run(tmp_path):
    result = CliRunner().invoke(cli.app, ["watch", str(tmp_path / "none")])
    assert isinstance(result.exception, lp.errors.RunError)
    assert "contains no run" in str(result.exception)


@pytest.mark.slow
def test_ctrl_c_while_it_says_where_ends_it(tmp_path, monkeypatch):
    begun(tmp_path, identifier()).close()
    before = {*threading.enumerate()}

    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["livepde.cli.finished"], "terminal", interrupted)
    assert CliRunner().invoke(cli.app, ["watch", str(tmp_path), "--address", "0"]).exit_code == 0
    assert {*threading.enumerate()} == before  # serving threads would keep the program alive


@pytest.mark.process
def test_watch_says_where_and_ends_with_ctrl_c(tmp_path, ctrl_c):
    begun(tmp_path, identifier()).close()
    command = [sys.executable, "-m", "livepde", "watch", str(tmp_path), "--address", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        try:
            url = child.stdout.readline().split()[1]
            with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
                assert "A rod" in answer.read().decode()
                assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
            child.send_signal(signal.SIGINT)
            assert child.wait(PATIENCE) == 0
        finally:
            child.kill()


# --- in a browser --------------------------------------------------------------------------------


@contextmanager
def served(folder: Path, **options):
    server = serve(folder, Address(**options))
    try:
        yield server.url
    finally:
        server.close()


def profile(page, name: str) -> list[float] | None:
    """Return the estimate that the figure of a field shows."""
    return page.execute_script(
        """
        const panel = [...document.querySelectorAll('figure.panel')]
            .find(p => p.querySelector('h3').innerText === arguments[0]);
        const plot = panel && panel.querySelector('.js-plotly-plot');
        const trace = plot && plot.data && plot.data.find(t => t.name === 'estimate');
        return trace ? [...plot.calcdata[plot.data.indexOf(trace)].map(p => p.y)] : null;
        """,
        name,
    )


def colours(page, selector: str, visibility: str = "visible") -> int:
    """Return the number of colours of an element, with or without its WebGL canvas."""
    from PIL import Image

    element = page.find_element("css selector", selector)
    page.execute_script(
        "arguments[0].scrollIntoView();"
        "arguments[0].querySelector('.gl-container').style.visibility = arguments[1]",
        element,
        visibility,
    )
    with Image.open(BytesIO(element.screenshot_as_png)) as picture:
        return len(picture.convert("RGB").getcolors(2**24))


CHILD = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_dashboard import slow_run
slow_run(Path(sys.argv[1]))
"""


@pytest.mark.browser
def test_the_page_follows_a_run_and_looks_back(tmp_path):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    folder = tmp_path / "run"
    command = [sys.executable, "-c", CHILD, str(folder), str(Path(__file__).parent)]
    child = subprocess.Popen(command)
    try:
        deadline = time.monotonic() + PATIENCE
        while not (folder / JOURNAL).exists():
            assert child.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        with served(folder) as url, chromium() as page:
            page.get(url)
            wait(page, lambda p: "95 % interval" in text(p, ".card"))
            assert text(page, "h1") == "A rod"
            assert "running" in text(page, "#chip")
            assert "Estimates alpha, loss from 1 sensor, validated with 1 more" in text(
                page, "main"
            )
            assert "m²/s" in text(page, ".card")

            seen, drawn = count(page), wait(page, lambda p: profile(p, "State u"))
            wait(page, lambda p: count(p) > seen + 5)  # the run continues
            wait(page, lambda p: profile(p, "State u") != drawn)

            def at_start(p) -> bool:
                # Each sample redraws the slider, which may lose a key press.
                p.find_element(By.CSS_SELECTOR, "#slider [role=slider]").send_keys(Keys.HOME)
                return text(p, "#shown") == "history: 2025-04-01 00:00:00"

            with Journal.open(folder / JOURNAL) as journal:
                first = next(iter(journal))
            past, number = first.snapshot.profiles["u"], f"{first.numbers[0]:.3f}"

            def back(p) -> bool:
                there = np.allclose(profile(p, "State u") or np.inf, past)
                return there and text(p, ".card .value").startswith(number)

            wait(page, at_start)
            wait(page, back)
            seen = count(page)
            wait(page, lambda p: count(p) > seen + 5)  # the run continues
            wait(page, lambda p: "history" in text(p, "#shown") and back(p))

            page.find_element(By.ID, "newest").click()
            wait(page, lambda p: text(p, "#shown").startswith("newest"))
            wait(page, lambda p: not back(p))

            child.send_signal(signal.SIGKILL)
            wait(page, lambda p: "stopped unexpectedly" in text(p, "#chip"))
            wait(page, lambda p: "--resume" in text(p, "#verdict"))
    finally:
        child.kill()
        child.wait()


@pytest.mark.browser
def test_text_from_files_is_shown_as_text(tmp_path):
    who = identifier()
    with begun(tmp_path, who, title=HOSTILE) as journal:
        journal.layout = replace(journal.layout, sensors=[HOSTILE])
        drive(who, samples(5), journal=journal)
        journal.note(Event(0.5, "refused", HOSTILE, HOSTILE))
        journal.count(HOSTILE, HOSTILE)
    rewrite_layout(tmp_path / JOURNAL, sensors=[HOSTILE])
    with served(tmp_path) as url, chromium(390) as page:
        page.get(url)
        wait(page, lambda p: "95 % interval" in text(p, ".card"))
        wait(page, lambda p: HOSTILE in text(p, "#tables-events td"))
        assert text(page, "h1") == HOSTILE
        wait(page, lambda p: HOSTILE in text(p, "#tables-sensors td"))
        assert page.title == f"{HOSTILE} – livepde"
        # The fully drawn page fits a phone.
        fits = "return document.documentElement.scrollWidth <= window.innerWidth"
        wait(page, lambda p: p.execute_script(fits))


def rewrite_layout(path: Path, **changes) -> None:
    """Change the layout of a journal maliciously."""
    import sqlite3

    with closing(sqlite3.connect(path)) as db, db:
        (content,) = db.execute("SELECT value FROM meta WHERE key = 'layout'").fetchone()
        text = json.dumps({**json.loads(content), **changes})
        whole = text, checksum("meta", "layout", text)
        db.execute("UPDATE meta SET value = ?, crc = ? WHERE key = 'layout'", whole)
    db.close()


@pytest.mark.browser
def test_a_solid_is_drawn_and_a_token_is_asked_for(tmp_path):
    who = identifier("tetra", field=True)
    with begun(tmp_path, who) as journal:
        drive(who, samples(4), journal=journal)
    with served(tmp_path, token="secret") as url, chromium() as page:
        from selenium.webdriver.common.keys import Keys

        address = url.partition("?")[0]
        for path in ("", "_dash-layout", "assets/page.css"):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(address + path, timeout=PATIENCE)
        page.get(url)
        panel = "figure.panel canvas"
        wait(page, lambda p: len(p.find_elements("css selector", panel)) >= 3)
        wait(page, lambda p: "field, mean" in text(p, ".card"))
        drawn = ".panel:nth-child(2) .js-plotly-plot"
        wait(page, lambda p: colours(p, drawn) > colours(p, drawn, "hidden") + 200)
        assert "three cuts at 50%" in text(page, ".panel figcaption")
        page.find_element("css selector", "#cut [role=slider]").send_keys(Keys.ARROW_LEFT)
        wait(page, lambda p: "three cuts at 45%" in text(p, ".panel figcaption"))


@pytest.mark.slow
def test_the_page_loads_nothing_from_other_servers(tmp_path):
    """Checks addresses in the page's text, in addition to its requests."""
    begun(tmp_path, identifier()).close()
    with served(tmp_path) as url, urllib.request.urlopen(url, timeout=PATIENCE) as answer:
        shown = answer.read().decode()
    assert "https://" not in shown
    assert os.fspath(tmp_path) not in shown


@pytest.fixture
def several(tmp_path):
    """Provide a folder with two runs, one of which failed at its first sample."""
    for name in ("east", "north west"):
        who = identifier()
        with begun(tmp_path / name, who, title=name) as journal:
            drive(who, samples(4 if name == "east" else 0), journal=journal)
    (tmp_path / "notes").mkdir()
    return tmp_path


@pytest.mark.slow
def test_many_runs_are_a_table(several):
    from livepde.dashboard.page import PerRun, overview_table

    views = PerRun(several, "", 10, lambda name: View(several / name))
    for _ in range(2):
        told, table = overview_table(views)
    assert told.children == "2 runs."
    titles = [cell.children for cell in table.children[0].children.children]
    # The marginal of alpha, which is log-normal, has no single number for its width.
    assert titles[4:] == ["alpha [m²/s], median ± first-order std. dev.", "loss [1/s] ± std. dev."]
    rows = {row.children[0].children.children: row.children for row in table.children[1].children}
    assert {*rows} == {"east", "north west"}
    assert rows["north west"][0].children.href == "/run/north%20west/"
    assert rows["north west"][4].children == "–"
    assert " ± " in rows["east"][4].children
    with pytest.raises(KeyError):
        views["../east"]
    with pytest.raises(KeyError):
        views["notes"]


@pytest.mark.slow
def test_each_run_has_its_page_behind_the_table(several):
    with served(several) as url:
        for path, known in (("", "_dash-"), ("run/east/", "/run/east/_dash-")):
            answer = urllib.request.urlopen(url + path, timeout=PATIENCE)
            assert known in answer.read().decode()
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        other = urllib.request.urlopen(f"{url}run/notes/", timeout=PATIENCE)
        assert "/run/notes/" not in other.read().decode()  # not a run: shows the table
    with served(several, token="secret") as url:
        address = url.partition("?")[0]
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"{address}run/east/_dash-layout", timeout=PATIENCE)


@pytest.mark.browser
def test_a_link_leads_from_the_table_to_a_run(several):
    with served(several) as url, chromium() as page:
        page.get(url)
        wait(page, lambda p: "±" in text(p, "#runs"))
        # The table is drawn anew now and then, maybe between finding the link and the click.
        wait(page, lambda p: p.find_element("link text", "east").click() is None)
        wait(page, lambda p: count(p) == 4)
