"""Where a table begins, ends or has gaps, and files whose clocks differ."""

import gzip
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from factories import short_rod

import livepde as lp
from livepde import cases
from livepde.cases.case import Prepared
from livepde.cases.live_case import LiveCase
from livepde.cases.measured import measured
from livepde.cases.new_case import channels_in
from livepde.cases.remedies import after_gaps, freed, start_missed, with_settings
from livepde.cli.check import _refused
from livepde.errors import CaseError, DataError, SampleError
from livepde.models import EQUATIONS, Flux, heat, with_conditions
from livepde.runs import input_findings
from livepde.samples import by_name
from livepde.streams import DataTable
from livepde.verdict import Cause, Finding, Verdict

ROWS = 61


def changed(folder: Path, change: Any, **settings: object) -> Prepared:
    path = short_rod(folder, ROWS)
    table = pd.read_csv(path.parent / "rod.csv")
    change(table)
    table.to_csv(path.parent / "rod.csv", index=False)
    return cases.load(path, settings=settings).prepare()


def without(name: str, rows: slice) -> Any:
    def change(table: pd.DataFrame) -> None:
        table.loc[table.index[rows], name] = np.nan

    return change


def noted(prepared: Prepared) -> list[Finding]:
    rows: Any = type("Rows", (list,), {})(range(ROWS))
    rows.counts = prepared.stream.remarks  # type: ignore[attr-defined]
    return input_findings(rows, ["T_left"])


def test_a_run_begins_where_all_inputs_have_a_value(tmp_path):
    plain = changed(tmp_path / "plain", lambda table: None)
    found = changed(tmp_path / "late", without("T_left", slice(20)))
    np.testing.assert_array_equal(found.stream.t, plain.raw.t[20:])
    (note,) = noted(found)
    assert "20 rows at the start, before its first value, were left out" in note.text
    assert any("T_left: the first 20 rows have no value" in text for text in _refused(found))


@pytest.mark.parametrize(("between", "value"), [("hold", 7.0), ("line", 8.0)])
def test_a_run_begins_with_what_earlier_rows_state_of_other_inputs(tmp_path, between, value):
    def change(table: pd.DataFrame) -> None:
        table.loc[:3, "T_left"] = np.nan
        table.loc[3:5, "T_right"] = [7.0, np.nan, 9.0]

    found = changed(tmp_path, change, **{"channels.T_right.between": between})
    assert by_name(found.first.z, ())["T_right"] == pytest.approx(value, abs=0.6)
    assert found.identifier.step(found.first.t, found.first.z).status.ok


def test_an_input_without_any_value_is_refused_in_terms_of_the_case(tmp_path):
    with pytest.raises(CaseError, match=r"channels\.T_left: its column has no value"):
        changed(tmp_path, without("T_left", slice(None)))


@pytest.mark.parametrize(
    ("rows", "said", "remedy"),
    [
        (slice(20, 35), "15 values in long gaps were interpolated", 'T_left.missing="skip"'),
        (slice(40, None), "21 values at the end were missing", "data.stop"),
        (slice(20, 25), "5 missing values were interpolated", ""),
    ],
)
def test_a_long_gap_of_an_input_is_the_first_to_be_mended(tmp_path, rows, said, remedy):
    prepared = changed(tmp_path, without("T_left", rows))
    (note,) = noted(prepared)
    assert said in note.text
    assert remedy in note.remedy
    assert bool(note.remedy) == bool(remedy)
    key = remedy.partition("=")[0]
    assert any(key in text for text in _refused(prepared)) == bool(remedy)
    refused = Finding("refused", "caution", "The gate rejected readings.", remedy="Check them.")
    both = after_gaps(Verdict.of([refused, note]), [note])
    shown = next(one for one in both.findings if one.what == "refused")
    assert shown.remedy.startswith(note.remedy or "Check them.")


def test_a_replay_of_complete_data_has_the_samples_of_the_batch_run(tmp_path):
    settings: dict[str, Any] = {"data.every": 2, "law.refit": False, "law.verdict": False}
    found = changed(tmp_path, without("T_left", slice(20, 26)), **settings)
    assert isinstance(found.stream, DataTable)
    with LiveCase(found.case) as wiring:
        run = wiring.live()
        run.run()
        taken = [[one.values[name] for name in found.stream.names] for one in run.journal.taken()]
        assert dict(run.journal.counts) == dict(found.stream.remarks)
    np.testing.assert_array_equal(taken, found.stream.values)


def test_the_clock_of_one_of_several_files_is_corrected_before_they_are_joined(tmp_path):
    path = short_rod(tmp_path / "plain", ROWS)
    plain = cases.load(path).prepare().raw
    assert plain is not None
    table = pd.read_csv(path.parent / "rod.csv")
    time, others = table.columns[0], [name for name in table.columns[1:] if name != "T_left"]
    # Further apart than the record is long: without `late` they have no time in common.
    for shift in (100.0, 1e6):
        ahead = table[[time, "T_left"]].assign(**{time: table[time] + shift})
        ahead.to_csv(path.parent / "ends.csv", index=False)
        table[[time, *others]].to_csv(path.parent / "sensors.csv", index=False)
        settings = {"data.file": ["sensors.csv", "ends.csv"], "channels.T_left.late": f"{shift} s"}
        found = cases.load(path, settings=settings).prepare().raw
        np.testing.assert_allclose(found.t, plain.t)
        columns = [found.names.index(name) for name in plain.names]
        np.testing.assert_allclose(found.values[:, columns], plain.values)


def test_the_start_of_late_channels_is_that_of_their_table(tmp_path):
    change = without("T_10", slice(3))
    late = {
        f"channels.{name}.late": "90 s" for name in ("T_left", "T_10", "T_20", "T_30", "T_right")
    }
    plain = changed(tmp_path / "plain", change).stream
    found = changed(tmp_path / "late", change, **late).stream
    np.testing.assert_allclose(found.t + 90.0, plain.t)
    columns = [found.names.index(name) for name in plain.names]
    np.testing.assert_array_equal(found.values[:, columns], plain.values)


@pytest.mark.parametrize("dated", [False, True])
def test_what_is_late_is_read_until_the_stop(tmp_path, dated):
    def change(table: pd.DataFrame) -> None:
        if dated:
            dates = pd.Timestamp("2025-03-01") + pd.to_timedelta(table["time_s"], unit="s")
            table["time_s"] = dates.dt.strftime("%Y-%m-%d %H:%M:%S")

    stop: Any = "2025-03-01 00:05" if dated else 300
    late = {f"channels.{name}.late": "20 s" for name in ("T_left", "T_10")}
    given = {**late, "channels.T_left.spikes": "keep", "data.stop": stop}
    found, plain = changed(tmp_path / "late", change, **given), changed(tmp_path, lambda _: None)
    table, raw = found.stream, plain.raw
    assert isinstance(table, DataTable)
    assert table.t[-1] == 300.0
    assert not table.remarks.keys() & {("missing", "T_left"), ("ended", "T_left")}
    for name in ("T_left", "T_10"):
        shown = raw.values[raw.t == 320.0, raw.names.index(name)]
        assert table.values[-1, table.names.index(name)] == shown


def test_a_start_that_the_first_readings_miss_is_named(tmp_path):
    prepared = changed(tmp_path, lambda table: None, initial="90 degC")
    doubted = Verdict.of([Finding("misfit", "caution", "It misfits.")])
    (found,) = start_missed(prepared, doubted)
    assert "miss the stated initial state by" in found.text
    assert 'initial={ from = "90 degC", std' in found.remedy
    assert not start_missed(prepared, Verdict.of([]))
    near = changed(tmp_path / "near", lambda table: None)
    assert not start_missed(near, doubted)
    # An unknown offset explains what the readings of its sensor miss.
    assert "`offset`" in found.remedy
    sensors = {f"channels.{name}.offset": "70 K" for name in prepared.case.roles("sensor")}
    shifted = changed(tmp_path / "shifted", lambda table: None, initial="90 degC", **sensors)
    assert not start_missed(shifted, doubted)
    # Later readings have moved on from the start: they say nothing of it.
    later = changed(tmp_path / "later", lambda table: None, initial="90 degC", **{"data.t0": -60.0})
    assert not start_missed(later, doubted)
    assert not freed(later, Cause("initial", "", ""))


def test_jumps_that_are_allowed_already_are_no_advice(tmp_path):
    cause = Cause("jump", "k", "k may have changed", 1.0, "Allow jumps.", "law.jumps=true")
    verdict = Verdict.of([Finding("misfit", "caution", "It misfits.", causes=(cause,))])
    for jumps, said in ((True, "allowed already"), (False, "Allow jumps."), (["alpha"], "Allow")):
        settings: dict[str, object] = {"law.jumps": jumps}
        prepared = changed(tmp_path / str(jumps), lambda table: None, **settings)
        (shown,) = with_settings(prepared, verdict).findings[0].causes
        assert said in shown.remedy
        assert bool(shown.setting) == (jumps is not True)


def test_a_unit_at_the_end_of_a_name_is_that_of_the_sensor(tmp_path):
    rows = "\n".join(f"{60 * k},{50 + k},{20 + k},{k}" for k in range(9))
    path = tmp_path / "wall.csv"
    path.write_text(f"time_s,T_12cm_degF,T_20cm,T_in\n{rows}\n")
    found = channels_in(measured(path, "s"), EQUATIONS["heat"])
    given = {one.name: one.given for one in found}
    assert given["T_12cm_degF"]["unit"] == "degF"
    assert "unit" not in given["T_20cm"]
    assert "unit" not in given["T_in"]


@pytest.mark.parametrize("name", ["T_10cm degF", "T [degF]", "bottom_degF"])
def test_a_unit_in_the_name_of_a_channel_is_not_passed_over(tmp_path, name):
    """Readings in Fahrenheit that were read in Celsius moved a diffusivity by two decades."""
    path = short_rod(tmp_path, ROWS)
    settings = {"channels.T_10.column": name}
    said = f"'{name}' states the unit 'degF'.*: set unit = 'degF', or unit = 'degC'"
    with pytest.raises(CaseError, match=re.escape(said).replace(r"\.\*", ".*")):
        _ = cases.load(path, settings=settings).columns
    for key, value in (("unit", "degF"), ("unit", "degC"), ("factor", 1.0)):
        stated = cases.load(path, settings={**settings, f"channels.T_10.{key}": value})
        assert "T_10" in stated.columns


@pytest.mark.parametrize("name", ["time_min", "t [min]", "minutes"])
def test_a_unit_in_the_name_of_times_is_not_passed_over(tmp_path, name):
    """Times in minutes that were read in seconds gave a diffusivity 60 times too large."""
    rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(1e-3, std=1e-3), {"left": 0.0})
    table = pd.DataFrame({name: [1.0, 2.0, 3.0], "T": [0.9, 0.8, 0.7]})
    table.to_csv(tmp_path / "rod.csv", index=False)
    ways = ((table, name), (table.set_index(name), None), (tmp_path / "rod.csv", name))
    for given, time in ways:

        def run(unit, given=given, time=time):
            identifier = lp.Identifier(rod, lp.Points({"T": 0.5}, noise=0.1), u0=1.0)
            return identifier.run(given, time=time, time_unit=unit).last.t

        said = "the name states the unit 'min(utes)?', which is not that of the model"
        with pytest.raises(lp.errors.SampleError, match=said):
            run(None)
        assert [run("min"), run("s")] == [180.0, 3.0]
    dated = table.assign(**{name: pd.date_range("2025-01-01", periods=3, freq="min")})
    identifier = lp.Identifier(rod, lp.Points({"T": 0.5}, noise=0.1), u0=1.0)
    assert identifier.run(dated, time=name).last.t == 120.0


@pytest.mark.parametrize(
    "column",
    [
        pd.date_range("2025-01-01", periods=3),
        pd.to_timedelta([1, 2, 3], unit="s"),
        pd.Series([1.0 + 2.0j, 1.0, 2.0]),
        np.array([1.0 + 2.0j, 1.0, 2.0]),
    ],
    ids=["dates", "durations", "complex", "complex array"],
)
def test_what_is_no_number_is_no_reading(column):
    rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    identifier = lp.Identifier(rod, lp.Points({"T": 0.5}, noise=0.01), u0=1.0)
    table = pd.DataFrame({"T": column}, index=[0.1, 0.2, 0.3])
    with pytest.raises(SampleError, match="column 'T' must contain numbers only"):
        identifier.run(table)


def test_a_compressed_file_is_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(gzip.compress(b"time,T\n0,1\n1,2\n"))
    with pytest.raises(DataError, match="is compressed: unpack it first"):
        measured(path, "s")


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("0,93", "numbers only; got '0,93': read the table with decimal=','"),
        ("open", "numbers only; got 'open'."),
    ],
)
def test_text_in_a_table_is_named(cell, said):
    rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": lp.Channel("a")})
    rod = with_conditions(rod, {"right": Flux(lp.Channel("c"))})
    table = pd.DataFrame({"T": ["0.9", cell], "c": [0.0, 0.0], "a": [1.0, 1.0]}, index=[1.0, 2.0])
    identifier = lp.Identifier(rod, lp.Points({"T": 0.5}, noise=0.1, unit="degC"), u0=1.0)
    with pytest.raises(lp.errors.SampleError, match=said):
        identifier.run(table)
    with pytest.raises(lp.errors.ConfigurationError, match="the model has no unit for 'c'"):
        identifier.run(table.assign(c=1.0), units={"c": "K"})
