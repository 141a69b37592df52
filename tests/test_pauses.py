"""Logger pauses, jumping clocks and changing time units are reported, and do not end a run."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from factories import usual
from typer.testing import CliRunner

import livepde as lp
from benchmarks.honest.linear import diffusion, fine_times
from livepde.cases import load
from livepde.cases.variants import Variant, run_variant
from livepde.cli import app
from livepde.fleet import Fleet
from livepde.laws.filter_state import InputHistory, pauses
from livepde.runs import sampling_findings
from livepde.stepping import Span
from livepde.streams.oddities import clock_leaps, unit_factor

ALPHA = 1.5e-5
DT = 10.0
ROWS = 600
AT = 300  # row at which something happens
PLACES = (0.03, 0.06, 0.1)
CASE = """
equation = "heat"
initial = "interpolate"
mesh = { from = 0, to = "50 cm", cells = 60 }
data = { file = "rod.csv", time = "t", time_unit = "s" }
unknowns.alpha = { prior = "2e-5 m^2/s", std = "1e-5 m^2/s", transform = "log" }
[channels]
hot = { role = "boundary", column = "hot", at = "left" }
cold = { role = "boundary", column = "cold", at = "right" }
T_1 = { role = "sensor", column = "T_1", at = "3 cm", noise = "0.05 K" }
T_2 = { role = "sensor", column = "T_2", at = "6 cm", noise = "0.05 K" }
T_3 = { role = "sensor", column = "T_3", at = "10 cm", noise = "0.05 K" }
"""


@cache
def rod(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values of a rod with a long memory, by finite volumes of its own."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(ROWS)
    fine = fine_times(t)
    begin = 1.0 - np.exp(-fine / 600.0)
    waves = 10.0 * np.sin(2 * np.pi * fine / 1500.0) + 5.0 * np.sin(2 * np.pi * fine / 640.0 + 1.0)
    drive = np.column_stack([waves * begin, 3.0 * np.sin(2 * np.pi * fine / 2100.0) * begin])
    cells, length = 200, 0.5
    width = length / cells
    between = np.full(cells, ALPHA / width)
    loss, B = np.zeros(cells), np.zeros((cells, 2))
    loss[0] = loss[-1] = B[0, 0] = B[-1, 1] = 2.0 * between[-1]
    middles = width * (np.arange(cells) + 0.5)
    C = np.array([[np.interp(x, middles, row) for row in np.eye(cells)] for x in PLACES])
    system = diffusion(between[:-1], np.full(cells, width), loss, B, C, np.zeros((3, 2)))
    seen = system.respond(drive, DT)
    seen += 0.05 * rng.standard_normal(seen.shape)
    ends = [np.interp(t, fine, column) for column in drive.T]
    return t, 20.0 + np.column_stack([*ends, seen])


def told_times(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times as a table states them, and which rows it has."""
    k, (t, _) = np.arange(ROWS), rod()
    times = {
        "small leap": t + 60.0 * (k >= AT),
        "leap": t + 3600.0 * (k >= AT),
        "milliseconds": np.where(k >= AT, 1e3 * t, t),
    }.get(kind, t)
    return times, (k < AT) | (k >= AT + 60) if kind == "gap" else k >= 0


def case(folder: Path, kind: str, seed: int = 0) -> Path:
    times, kept = told_times(kind)
    table = np.column_stack([times, rod(seed)[1]])[kept]
    header = "t,hot,cold,T_1,T_2,T_3"
    np.savetxt(folder / "rod.csv", table, "%.9g", ",", header=header, comments="")
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


def found_in(path: Path) -> list[lp.verdict.Finding]:
    table = load(path).read().raw
    times = xr.Dataset(coords={"time": ("time", table.t, {"units": "s"})})
    return sampling_findings(times, lambda: (table.t, table.values))


# --- what the sampling shows ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_even_sampling_shows_nothing(tmp_path: Path, seed: int) -> None:
    assert found_in(case(tmp_path, "plain", seed)) == []


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_gap_is_a_pause(tmp_path: Path, seed: int) -> None:
    (finding,) = found_in(case(tmp_path, "gap", seed))
    assert (finding.what, finding.severity) == ("pause", "note")
    assert finding.text.startswith("No sample for 610 s until t = 3600 s (61 usual intervals).")


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("kind", "length"), [("leap", "3600 s"), ("small leap", "60 s")])
def test_a_clock_that_leaps_is_named(tmp_path: Path, kind: str, length: str, seed: int) -> None:
    """The readings go on as after one interval, which no gap does."""
    (finding,) = found_in(case(tmp_path, kind, seed))
    assert (finding.what, finding.severity) == ("clock", "caution")
    assert f"set forward by about {length} at" in finding.text
    assert "(sample 301)" in finding.text
    assert f"add {length} to the earlier ones" in finding.causes[0].remedy
    assert finding.causes[0].kind == "clock"


def test_a_leap_of_an_hour_in_dates_may_be_of_local_time(tmp_path: Path) -> None:
    table = load(case(tmp_path, "leap")).read().raw
    times = xr.Dataset(coords={"time": ("time", table.t, {"units": "s"})})
    (plain,) = sampling_findings(times, lambda: (table.t, table.values))
    times.attrs["origin"] = "2025-03-30 01:10:00"
    (dated,) = sampling_findings(times, lambda: (table.t, table.values))
    assert "data.zone" in dated.causes[0].remedy
    assert "data.zone" not in plain.causes[0].remedy


@pytest.mark.slow
def test_a_live_run_names_a_clock_that_leaps(tmp_path: Path, monkeypatch: Any) -> None:
    path = case(tmp_path, "small leap")
    table = pd.read_csv(tmp_path / "rod.csv").iloc[AT - 150 : AT + 100]
    rows = table.to_json(orient="records", lines=True)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["run", str(path), "--data", "-"], input=rows)
    assert done.exit_code == 0, done.output
    (report,) = tmp_path.glob("runs/*/report.md")
    assert "was set forward by about 60 s" in report.read_text()


@pytest.mark.slow
def test_a_variant_has_the_findings_on_its_times(tmp_path: Path) -> None:
    """What `run` reports of the clock counts in `compare`, too."""
    ended = run_variant(case(tmp_path, "small leap"), [], Variant("as stated"), None, False)
    assert ended.level == "caution"
    assert "clock" in [finding["what"] for finding in ended.verdict["findings"]]


def test_a_unit_of_time_that_changes_is_named(tmp_path: Path) -> None:
    (finding,) = found_in(case(tmp_path, "milliseconds"))
    assert (finding.what, finding.severity) == ("clock", "do not trust")
    assert "From sample 301 on" in finding.text
    assert "1000 times as large" in finding.text
    assert "Divide the times from that row on by 1000" in finding.sentence


def test_a_logger_that_gets_slower_changes_no_unit() -> None:
    """One second, then one minute: the times go on."""
    assert unit_factor(before=100.0, after=160.0, usual=1.0, later=60.0) == 0.0
    assert unit_factor(before=100.0, after=101e3, usual=1.0, later=1e3) == 1000.0
    assert unit_factor(before=100.0, after=101e3, usual=0.1, later=100.0) == 0.0


@pytest.mark.parametrize("rows", [20, 1])
def test_a_pause_overnight_changes_no_unit(rows: int) -> None:
    """21 hours after 21 minutes are 60 times as long, but later steps are as before."""
    t = np.concatenate([60.0 * np.arange(21), 21 * 3600.0 + 60.0 * np.arange(rows)])
    (finding,) = sampling_findings(xr.Dataset(coords={"time": ("time", t, {"units": "s"})}))
    assert (finding.what, finding.severity) == ("pause", "note")


def test_a_sensor_that_began_before_a_pause_shows_nothing_of_the_clock() -> None:
    t = 10.0 * np.concatenate([np.arange(40), 100.0 + np.arange(10)])
    drawn = np.random.default_rng(0).standard_normal((50, 2)).cumsum(axis=0)
    late = drawn.copy()
    late[:39, 1] = np.nan
    assert clock_leaps(t, late, [40]) == clock_leaps(t, drawn[:, :1], [40])


@pytest.mark.slow
def test_check_says_it(tmp_path: Path) -> None:
    path = case(tmp_path, "small leap")
    result = CliRunner().invoke(app, ["check", str(path)])
    assert result.exit_code == 0
    assert "set forward by about 60 s" in " ".join(result.output.split())


# --- parameters survive a pause ------------------------------------------------------------------


def estimate_of(path: Path) -> lp.Estimate:
    prepared = load(path).prepare()
    found = prepared.identifier.run(prepared.stream).last
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", usual(["small leap", "gap"]))
@pytest.mark.parametrize("seed", usual([0, 1]))
def test_the_unknowns_survive(tmp_path: Path, kind: str, seed: int) -> None:
    """The rod remembers an hour, and its ends have gone on unseen for ten minutes."""
    found = estimate_of(case(tmp_path, kind, seed))
    low, high = found["alpha"].interval()
    assert low <= ALPHA <= high
    assert found["alpha"].std < 1.5e-7  # 1 %: as without the pause
    assert found.verdict.level == "trusted"


def samples() -> list[tuple[float, dict[str, float]]]:
    """Return the first rows of the rod, with a gap of forty."""
    names = ("hot", "cold", "T_1", "T_2", "T_3")
    rows = list(zip(rod()[0].tolist(), rod()[1].tolist(), strict=True))
    return [(t, dict(zip(names, row, strict=True))) for t, row in rows[:60] + rows[100:140]]


def parts(std: float = 1e-5, **options: Any) -> tuple[Any, ...]:
    model = lp.models.heat(
        lp.interval(0.0, 0.5, 30),
        lp.Scalar(lp.LogNormal(2e-5, std=std)),
        {"left": lp.Channel("hot"), "right": lp.Channel("cold")},
    )
    places = dict(zip(("T_1", "T_2", "T_3"), PLACES, strict=True))
    return model, lp.Points(places, noise=0.05), lp.SensitivityLaw(**options)


def identifier(std: float = 1e-5, **options: Any) -> lp.Identifier:
    return lp.Identifier(*parts(std, **options), u0=20.0)


@pytest.mark.slow
def test_the_state_is_less_certain_after_a_pause_and_the_unknown_is_not() -> None:
    who, before = identifier(1e-7, refit=None), None
    for t, z in samples():
        found = who.step(t, z | dict.fromkeys(("T_1", "T_2", "T_3"), np.nan))
        spread = np.linalg.norm(found.belief.u_factor)
        if before is not None and t - before[0] > 100.0:
            # Nothing is known of the end of the rod in the pause: several kelvin nearby.
            assert spread > 2.0 * before[1]
            assert found["alpha"].std == pytest.approx(before[2])
            return
        before = t, spread, found["alpha"].std
    raise AssertionError("there is no pause")


def test_inputs_that_never_moved_stay_known() -> None:
    history = InputHistory.start(1)
    for k in range(30):
        history = history.after(span(float(k), float(k + 1), 7.0))
    after = history.after(span(30.0, 90.0, 7.0))
    assert after.pause.tolist() == [True]
    assert after.deviation(np.array([60.0])).tolist() == [[0.0]]


def span(t0: float, t1: float, value: float) -> Span:
    inputs, none = np.array([[value]]), np.zeros((1, 0))
    parts = {"inputs0": inputs, "inputs1": inputs, "z0": none, "z1": none}
    return Span(t0=np.array([t0]), t1=t1, channels=("a",), **parts)


@pytest.mark.parametrize("seed", range(4))
def test_the_law_and_the_report_have_the_same_pauses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.5, 1.5, 200)
    steps[[40, 90, 91]] *= 12.0
    times = np.concatenate([[0.0], np.cumsum(steps)])
    history, found = InputHistory.start(1), []
    for k in range(200):
        history = history.after(span(float(times[k]), float(times[k + 1]), 0.0))
        found += [k + 1] if history.pause[0] else []
    assert found == pauses(times)
    assert found


def test_a_pause_a_week_stays_a_pause() -> None:
    steps = np.ones(3000)
    weekly = np.arange(99, 3000, 200)
    steps[weekly] = 60.0
    assert pauses(np.concatenate([[0.0], np.cumsum(steps)])) == (weekly + 1).tolist()


def test_a_pause_each_night_is_usual_after_some() -> None:
    steps = np.tile([*np.ones(24), 8.0], 10)
    assert len(pauses(np.concatenate([[0.0], np.cumsum(steps)]))) < 4


@pytest.mark.slow
def test_the_last_smoothed_is_the_last_filtered_across_a_pause() -> None:
    rows = samples()
    last = identifier(refit=None, shadows=None).run(rows).last
    smoothed = identifier(refit=None, shadows=None).smoothed(rows)
    std = last["alpha"].std
    assert float(smoothed["alpha"][-1]) == pytest.approx(last["alpha"].median, abs=0.1 * std)
    assert float(smoothed["alpha_std"][-1]) == pytest.approx(std, rel=0.03)


# --- pauses together with other features ---------------------------------------------------------

SENSORS = ("T_1", "T_2", "T_3")


def few(gap: bool) -> list[tuple[float, dict[str, float]]]:
    """Return the first rows of the rod, eight of which may be left out."""
    rows = [(t, z) for t, z in samples() if t < 42 * DT]
    return [row for k, row in enumerate(rows) if not (gap and 30 <= k < 38)]


@pytest.mark.long
@pytest.mark.parametrize("uncertain", [{}, {"input_noise": {"hot": 0.1}}])
def test_a_pause_of_one_member_is_none_of_another(uncertain: Any) -> None:
    """The samples of one member fail for eight rows: its next interval is a pause."""
    options = {"u0": 20.0, **uncertain}
    singles = [lp.Identifier(*parts(), **options) for _ in range(2)]
    fleet, paused = Fleet(*parts(), members=["a", "b"], **options), list[list[bool]]()
    for k, (t, z) in enumerate(few(gap=False)):
        rows = [z, {**z, "T_2": z["T_2"] + 0.01, "hot": 1e300 if 30 <= k < 38 else z["hot"]}]
        found = fleet.step(t, {name: [row[name] for row in rows] for name in z})
        alone = [single.step(t, row) for single, row in zip(singles, rows, strict=True)]
        np.testing.assert_allclose(found.q, [one.q for one in alone], rtol=1e-9)
        paused.append([bool(single._state.now.driven.pause[0]) for single in singles])
    assert paused[38] == [False, True]


@pytest.mark.slow
@pytest.mark.parametrize("cut", [30, 31])
def test_a_run_with_all_kinds_of_noise_goes_on_to_the_bit_at_a_pause(cut: int) -> None:
    """Noise per reading, readings that are missing, an uncertain start and a noisy input."""
    rng = np.random.default_rng(1)
    rows = list[tuple[float, dict[str, Any]]]()
    for t, z in few(gap=True):
        noise = {name: (z[name], 0.05 + 0.1 * rng.random()) for name in SENSORS}
        lost = {name: np.nan for name in SENSORS if t > 0.0 and rng.random() < 0.3}
        rows.append((t, {**z, **noise, **lost}))

    def begun() -> lp.Identifier:
        errors = [lambda x: 0.3 * np.ones(x.shape[1:]), lambda x: x[0]]
        return lp.Identifier(*parts(), u0=20.0, u0_errors=errors, input_noise={"hot": 0.1})

    whole, first, second = begun(), begun(), begun()
    for t, z in rows:
        whole.step(t, z)
    for t, z in rows[:cut]:
        first.step(t, z)
    second.restore(first.dump())
    for t, z in rows[cut:]:
        second.step(t, z)
    assert second.dump() == whole.dump()
