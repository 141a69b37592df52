"""Tables written by loggers: repeated hours, titles and units around a header."""

import json
import math
import tomllib
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from typer.testing import CliRunner

from livepde.cases.measured import measured
from livepde.cli import app
from livepde.errors import DataError, TimeOrderError
from livepde.runs.directory import RunWriter, open_run
from livepde.streams.clock import Clock
from livepde.streams.csvfile import header_of, how_written, read_csv
from livepde.streams.intake import Intake
from livepde.streams.sources import Follow
from livepde.streams.table import Column, DataTable, JsonLines, read_json_lines, tabulated
from livepde.units import other_time_unit

BERLIN = ZoneInfo("Europe/Berlin")
CLOCK = Clock("t", zone=BERLIN)
COLUMNS = {"a": Column(("a",))}


# --- hours that are shown twice ------------------------------------------------------------------


def local(minutes: int, count: int) -> list[str]:
    """Return local times of the night in which clocks are set back."""
    start = datetime(2026, 10, 24, 23, tzinfo=ZoneInfo("UTC"))
    moments = (start + timedelta(minutes=minutes * k) for k in range(count))
    return [str(moment.astimezone(BERLIN).replace(tzinfo=None)) for moment in moments]


def from_csv(folder: Path, rows: list[dict]) -> list[float]:
    path = folder / "log.csv"
    path.write_text("t,a\n" + "".join(f"{row['t']},{row['a']}\n" for row in rows))
    return read_csv(path, COLUMNS, CLOCK).t.tolist()


def from_json(folder: Path, rows: list[dict]) -> list[float]:
    path = folder / "log.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return read_json_lines(path, COLUMNS, CLOCK).t.tolist()


def from_lines(_: Path, rows: list[dict]) -> list[float]:
    return [sample.t for sample in JsonLines(map(json.dumps, rows), COLUMNS, CLOCK)]


def from_memory(_: Path, rows: list[dict]) -> list[float]:
    values = {"a": [row["a"] for row in rows]}
    return tabulated([row["t"] for row in rows], values, COLUMNS, CLOCK).t.tolist()


def live(_: Path, rows: list[dict]) -> list[float]:
    intake = Intake(COLUMNS, CLOCK)
    return [ready.t for row in rows for ready in intake.take(row).ready]


BATCH = [from_csv, from_json, from_lines, from_memory]
Reader = Callable[[Path, list[dict]], list[float]]


@pytest.mark.parametrize("read", [*BATCH, live])
@pytest.mark.parametrize("minutes", [1, 10, 60])
def test_a_repeated_hour_is_read_as_two_hours(tmp_path: Path, read: Reader, minutes: int) -> None:
    """Every reader converts local times to elapsed times, also for an hourly log."""
    count = 240 // minutes
    texts = local(minutes, count)
    assert len(set(texts)) == 180 // minutes
    rows = [{"t": text, "a": float(k)} for k, text in enumerate(texts)]
    assert read(tmp_path, rows) == [60.0 * minutes * k for k in range(count)]


@pytest.mark.parametrize("read", BATCH)
@pytest.mark.parametrize("again", [70, 75])
def test_a_repeated_row_is_not_a_repeated_hour(tmp_path: Path, read: Reader, again: int) -> None:
    rows = [{"t": text, "a": float(k)} for k, text in enumerate(local(1, 100))]
    with pytest.raises(TimeOrderError, match="if clocks were set back, write dates with an offset"):
        read(tmp_path, [*rows[:80], rows[again], *rows[80:]])


@pytest.mark.parametrize("read", [from_csv, from_json, from_memory])
def test_a_row_is_repeated_in_the_second_pass(tmp_path: Path, read: Reader) -> None:
    """A third time cannot be meant: the row is dropped as in any other hour."""
    rows = [{"t": text, "a": float(k)} for k, text in enumerate(local(10, 18))]
    assert read(tmp_path, [*rows[:14], rows[13], *rows[14:]]) == read(tmp_path, rows)


@pytest.mark.parametrize("minutes", [10, 60])
def test_a_case_for_local_times_needs_their_zone(tmp_path: Path, minutes: int) -> None:
    """Sorting rows or dropping repeated rows would mix or lose an hour."""
    path, count = tmp_path / "wall.csv", 240 // minutes
    rows = [f"{text},{20.0 + 0.1 * k:.1f}" for k, text in enumerate(local(minutes, count))]
    path.write_text("\n".join(["t,a", *rows]))
    with pytest.raises(TimeOrderError, match=r"If clocks were set back here, set `data\.zone`"):
        measured(path, "s")
    made = ["init", str(tmp_path / "wall"), "--data", str(path)]
    result = CliRunner().invoke(app, [*made, "--set", "data.zone=Europe/Berlin"])
    assert result.exit_code == 0, result.output
    assert 'zone = "Europe/Berlin"' in (tmp_path / "wall/case.toml").read_text()
    assert measured(path, "s", zone=BERLIN).steps.max() == 60.0 * minutes


@pytest.mark.parametrize("read", BATCH)
def test_dates_with_an_offset_are_never_moved(tmp_path: Path, read: Reader) -> None:
    texts = ["2026-10-25 02:30+01:00", "2026-10-25 02:10+01:00"]
    rows = [{"t": text, "a": float(k)} for k, text in enumerate(texts)]
    with pytest.raises(TimeOrderError):
        read(tmp_path, rows)


# --- titles and units of loggers -----------------------------------------------------------------

TITLE = '"TOA5","CR1000","CR1000","1234","CR1000.Std.31","CPU:wall.CR1","1234","Table1"\n'
NAMES = '"TIMESTAMP","RECORD","T_1","T_2"\n'
UNITS = '"TS","RN","Deg C","Deg C"\n'
KINDS = '"","","Avg","Avg"\n'
VALUES = [
    '"2025-01-01 00:00:00",0,1.25,"NAN"\n',
    '"2025-01-01 00:10:00",1,1.5,2\n',
    '"2025-01-01 00:20:00",2,"NAN",3\n',
]
HEADS = {
    "TOA5": TITLE + NAMES + UNITS + KINDS,
    "units": NAMES + UNITS,
    "plain": NAMES,
    "empty lines": "\n" + TITLE + "\n" + NAMES + "\n" + UNITS + KINDS,
}
TOA5_COLUMNS = {"a": Column(("T_1",)), "b": Column(("T_2",))}
STAMP = Clock("TIMESTAMP")


def table(path: Path) -> DataTable:
    return read_csv(path, TOA5_COLUMNS, STAMP)


@pytest.mark.parametrize("head", HEADS)
def test_a_complete_file_of_a_logger(tmp_path: Path, head: str) -> None:
    path = tmp_path / "log.dat"
    path.write_text(HEADS[head] + "".join(VALUES))
    found = table(path)
    assert found.t.tolist() == [0.0, 600.0, 1200.0]
    np.testing.assert_array_equal(found.values, [[1.25, math.nan], [1.5, 2.0], [math.nan, 3.0]])
    assert header_of(path, ",", "utf-8", 0) == ["TIMESTAMP", "RECORD", "T_1", "T_2"]
    written = how_written(path)
    assert written.header == ["TIMESTAMP", "RECORD", "T_1", "T_2"]
    assert [row[1] for row in written.rows] == ["0", "1", "2"]


@pytest.mark.parametrize("head", HEADS)
def test_a_file_of_a_logger_that_grows(tmp_path: Path, head: str) -> None:
    """A file that grows by single characters has the rows of the complete file."""
    path = tmp_path / "log.dat"
    source, found = Follow(path, follow=True), []
    text = HEADS[head] + "".join(VALUES)
    for k in range(0, len(text), 7):
        with path.open("a") as file:
            file.write(text[k : k + 7])
        found += source.poll(0.0)
    source.close()
    assert not [row.broken for row in found if row.broken]
    assert [row.values["RECORD"] for row in found] == ["0", "1", "2"]
    intake = Intake(TOA5_COLUMNS, STAMP)
    ready = [one for row in found for one in intake.take(row.values).ready]
    assert [one.t for one in ready] == table(path).t.tolist()


@pytest.mark.parametrize("head", HEADS)
def test_a_file_of_a_logger_is_continued_anywhere(tmp_path: Path, head: str) -> None:
    path = tmp_path / "log.dat"
    lines = [*HEADS[head].splitlines(keepends=True), *VALUES]
    for known in range(1, len(lines) + 1):
        path.write_text("".join(lines[:known]))
        source = Follow(path, follow=True)
        before = source.poll(0.0)
        position = source.position([])
        source.close()
        path.write_text("".join(lines))
        again = Follow(path, follow=True, position=position)
        rows = [*before, *again.poll(0.0)]
        again.close()
        assert [row.broken for row in rows] == ["", "", ""], known
        assert [row.values["RECORD"] for row in rows] == ["0", "1", "2"]


def test_text_among_the_values_is_not_a_label(tmp_path: Path) -> None:
    path = tmp_path / "log.dat"
    path.write_text(NAMES + VALUES[0] + UNITS + "".join(VALUES[1:]))
    with pytest.raises(DataError, match="row 3, column 'TIMESTAMP': got 'TS'"):
        table(path)
    source = Follow(path)
    rows = source.poll(0.0)
    assert len(rows) == 4  # the intake counts the text row as malformed
    source.close()


# --- dates of a run ------------------------------------------------------------------------------


def run_in(folder: Path, unit: str, origin: str | None) -> xr.Dataset:
    """Write and return the estimates of a run whose snapshots differ from its samples."""
    attrs = {"origin": origin} if origin else {}
    data = xr.Dataset(
        {"k": ("time", [1.0, 2.0, 3.0]), "T": (("snapshot", "vertex"), [[0.0, 1.0]])},
        {"time": ("time", [0.0, 1.5, 3.0], {"units": unit}), "snapshot": ("snapshot", [3.0])},
        attrs,
    )
    writer = RunWriter.create(folder, version="1", command=["livepde"], title="A run")
    writer.finish(status="finished", dataset=data, shown=[], checks=[], notes=[])
    return data


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "step"), [("s", "1.5s"), ("min", "90s"), ("h", "90min"), ("d", "36h"), ("day", "36h")]
)
def test_other_programs_read_dates_of_a_run(tmp_path: Path, unit: str, step: str) -> None:
    data = run_in(tmp_path / "run", unit, "2025-03-01 06:00:00")
    with xr.open_dataset(tmp_path / "run" / "estimates.nc", engine="scipy") as other:
        dates = pd.date_range("2025-03-01 06:00", periods=3, freq=step)
        np.testing.assert_array_equal(other["time"], dates.to_numpy())
        assert other["snapshot"].values[0] == dates.to_numpy()[-1]
    mine = open_run(tmp_path / "run").dataset
    xr.testing.assert_identical(mine, data)  # here they are numbers, as they were


def test_times_without_a_date_stay_numbers(tmp_path: Path) -> None:
    data = run_in(tmp_path / "run", "s", None)
    with xr.open_dataset(tmp_path / "run" / "estimates.nc", engine="scipy") as other:
        assert other["time"].values.tolist() == [0.0, 1.5, 3.0]
    xr.testing.assert_identical(open_run(tmp_path / "run").dataset, data)


@pytest.mark.parametrize("character", ["\x0c", "\x1c", "\x85", "\u2028"])
def test_only_a_line_end_ends_a_line(tmp_path, character):
    path = tmp_path / "log.csv"
    path.write_text(f"time_s,T{character}5\r\n0,20.5\r\n60,21.0\r\n", encoding="utf-8", newline="")
    written = how_written(path)
    assert list(written.header) == ["time_s", f"T{character}5"]
    assert [list(row) for row in written.rows] == [["0", "20.5"], ["60", "21.0"]]


# --- texts that mean a missing value -------------------------------------------------------------

TEXTS = {"time_s": [0, 1, 2, 3], "c": ["<0.5", "OVER", "1.0", "---"], "d": [1, 2, "FAULT", 4]}


def texts(folder: Path) -> Path:
    path = folder / "texts.csv"
    pd.DataFrame(TEXTS).to_csv(path, index=False)
    return path


def test_texts_of_a_column_are_named_together_with_the_key_that_states_them(tmp_path):
    with pytest.raises(DataError, match=r"row 2, column 'c': got '<0.5'.*\['<0.5', 'OVER'\]"):
        measured(texts(tmp_path), "s")
    with pytest.raises(DataError, match=r"column 'd': got 'FAULT'.*\['<0.5', 'OVER', 'FAULT'\]"):
        measured(texts(tmp_path), "s", missing=("<0.5", "OVER"))


def test_a_stated_text_is_missing_in_every_source(tmp_path):
    columns, clock = {"c": Column(("c",))}, Clock("time_s")
    stated: dict = {"missing": ["<0.5", "OVER", 1.0]}
    rows = pd.DataFrame(TEXTS).to_dict("records")
    lines = [json.dumps(row) for row in rows]
    path = tmp_path / "texts.jsonl"
    path.write_text("\n".join(lines))
    tables = [
        read_csv(texts(tmp_path), columns, clock, **stated),
        read_json_lines(path, columns, clock, **stated),
    ]
    for table in tables:
        assert np.isnan(table.values).all()
    for sample in JsonLines(lines, columns, clock, **stated):
        assert math.isnan(sample.z["c"])
    assert not any(Intake(columns, clock, **stated).take(row).remarks for row in rows)


def test_init_writes_the_stated_texts_into_the_case(tmp_path):
    args = ["init", str(tmp_path / "new"), "--data", str(texts(tmp_path))]
    given = "data.missing=['<0.5', 'OVER', 'FAULT', '-1']"
    told = CliRunner().invoke(app, [*args, "--set", given])
    assert told.exit_code == 0, told.output
    case = (tmp_path / "new" / "case.toml").read_text()
    assert 'missing = ["<0.5", "OVER", "FAULT", -1.0]' in case
    refused = CliRunner().invoke(
        app, [*args[:1], str(tmp_path / "b"), *args[2:], "--set", given[:18]]
    )
    assert refused.exit_code != 0


# --- elapsed times, and numbers that count from a date -------------------------------------------


def init_of(folder: Path, times: list[str], name: str, *options: str) -> tuple[str, str]:
    """Return what `livepde init` prints of a table with these times, and its line of data."""
    rows = "".join(f"{time},{20 + k % 3}\n" for k, time in enumerate(times))
    (folder / "log.csv").write_text(f"{name},c\n{rows}")
    given = ["init", str(folder / "new"), "--data", str(folder / "log.csv"), *options]
    told = CliRunner().invoke(app, given)
    if told.exit_code:
        return str(told.exception), ""
    lines = (folder / "new" / "case.toml").read_text().splitlines()
    return " ".join(told.output.split()), next(line for line in lines if line.startswith("data ="))


def test_elapsed_times_are_read_beyond_a_day(tmp_path):
    times = ["0:00:00", "10:00:00", "26:00:30", "103:00:30.5"]
    said, line = init_of(tmp_path, times, "Elapsed [min]")
    assert "4 rows from 0 to 370830" in said
    assert "times are read as h:mm:ss." in said
    assert line.endswith('time = "Elapsed [min]", time_format = "h:mm:ss" }')


def test_two_parts_of_an_elapsed_time_are_not_guessed(tmp_path):
    times = ["0:00", "0:30", "70:10"]
    said, _ = init_of(tmp_path, times, "t")
    assert "if '0:00' is an elapsed time, set --time-format 'h:mm' or 'mm:ss'; if" in said
    said, _ = init_of(tmp_path, times, "t", "--time-format", "mm:ss")
    assert "from 0 to 4210" in said


def test_repeating_times_of_day_are_not_elapsed_times(tmp_path):
    said, _ = init_of(tmp_path, ["22:00:00", "23:00:00", "0:00:00"], "clock")
    assert "'clock' has times of day: add a column of days" in said


@pytest.mark.parametrize(
    ("wrong", "form", "remedy"),
    [
        ("0:75:00", "h:mm:ss", "expected an elapsed time as time_format has it, 'h:mm:ss'"),
        ("0:05:00", "", "if it is an elapsed time, set time_format = 'h:mm:ss'"),
    ],
)
def test_an_elapsed_time_that_is_not_read_leads_to_the_format(wrong, form, remedy):
    with pytest.raises(DataError, match=remedy):
        tabulated([wrong], {"a": [1.0]}, COLUMNS, Clock("t", format=form))


@pytest.mark.parametrize(
    ("first", "step", "unit", "from_"),
    [
        (45752.5, 1 / 24, "d since 1899-12-30", "2025-04-05 12:00:00"),
        (1743854400, 3600, "s since 1970-01-01T00:00Z", "2025-04-05 12:00:00"),
        (1743854400000, 3600000, "ms since 1970-01-01T00:00Z", "2025-04-05 12:00:00"),
    ],
)
def test_numbers_that_count_from_a_date_are_dates(tmp_path, first, step, unit, from_):
    times = [repr(first + step * k) for k in range(5)]
    said, line = init_of(tmp_path, times, "Excel Date/Time")
    assert f"5 rows from {from_} to 2025-04-05 16:00:00" in said
    assert f"times are read as {unit}." in said
    assert f'time_unit = "{unit}"' in line


@pytest.mark.parametrize(
    ("date", "first"),
    [
        ("2023-06-01 00:00:00", "2023-06-01 10:00:00"),
        ("2023-06-01T00:00:00 +02:00", "2023-06-01 08:00:00"),
        ("2023-6-1 0:0:0.0 UTC", "2023-06-01 10:00:00"),
        ("2023-06-01 UTC", "2023-06-01 10:00:00"),
    ],
)
def test_times_in_the_convention_of_cf_are_dates(tmp_path, date, first):
    stated = f"hours since {date}"
    said, line = init_of(tmp_path, [repr(10 + k / 4) for k in range(5)], f"time [{stated}]")
    assert f"5 rows from {first}" in said
    assert f'time_unit = "{stated}"' in line
    # A case without the unit does not read hours as seconds.
    assert other_time_unit(f"time [{stated}]", "s") == stated


def test_a_stated_unit_is_not_replaced_by_a_date(tmp_path):
    times = [repr(45752.5 + k) for k in range(5)]
    said, line = init_of(tmp_path, times, "time", "--set", "data.time_unit=s")
    assert "5 rows from 45752.5 to 45756.5, 1 s apart" in said
    assert 'time_unit = "s"' in line
    said, _ = init_of(tmp_path / "new", times, "time", "--set", "data.time_unit=d since noon")
    assert "got 'since noon'; expected a date, as in 'd since 1899-12-30'" in said


def test_day_numbers_of_a_repeated_hour_are_distinguished():
    noon = datetime(1899, 12, 30)
    clock = Clock("t", 86400.0, zone=BERLIN, since=noon)
    days = [(datetime.fromisoformat(text) - noon) / timedelta(days=1) for text in local(30, 12)]
    table = tabulated(days, {"a": np.arange(12.0)}, COLUMNS, clock)
    assert table.t == pytest.approx(1800.0 * np.arange(12))


def test_a_case_runs_with_day_numbers(tmp_path):
    times = [repr(45752.5 + k / 48) for k in range(30)]
    init_of(tmp_path, times, "time")
    case = tmp_path / "new" / "case.toml"
    filled = {"mesh.from": "0", "mesh.to": "1", "law.noise": "0.1", "channels.c.at": "0.5"}
    filled |= {f"unknowns.alpha.{key}": "1e-6" for key in ("prior", "std")}
    settings = [part for key, value in filled.items() for part in ("--set", f"{key}={value}")]
    start = ["--set", "data.start=2025-04-05 13:00"]
    told = CliRunner().invoke(app, ["check", str(case), *settings, *start])
    assert "28 samples" in told.output, told.output
    assert "2025-04-05 13:00" in told.output


# --- units in the names of columns ---------------------------------------------------------------


def channels_of(folder: Path, equation: str, *columns: str, time: str = "time [s]") -> dict:
    """Return the channels of the case that `livepde init` writes for columns of these names."""
    rows = [",".join([str(k), *[str(20 + k % 3)] * len(columns)]) for k in range(9)]
    (folder / "log.csv").write_text("\n".join([",".join([time, *columns]), *rows]))
    given = ["init", str(folder / "new"), "--data", str(folder / "log.csv")]
    told = CliRunner().invoke(app, [*given, "--equation", equation])
    assert told.exit_code == 0, told.output
    return tomllib.loads((folder / "new" / "case.toml").read_text())


def test_the_only_column_in_the_unit_of_a_missing_input_is_this_input(tmp_path):
    case = channels_of(tmp_path, "borehole", "T [°C]", "P [kW]", "Batt [V]")
    power = {"role": "input", "column": "P [kW]", "unit": "kW"}
    assert case["channels"]["Q"] == power
    assert "Q" not in case.get("inputs", {})
    assert case["channels"]["Batt"]["unit"] == "? V"
    assert "unit" not in case["channels"]["T"]  # °C is the unit of the model


def test_two_columns_in_the_unit_of_an_input_are_not_guessed(tmp_path):
    case = channels_of(tmp_path, "borehole", "T [C]", "P1 [kW]", "P2 [kW]")
    assert case["inputs"]["Q"] == "? W"
    assert case["channels"]["P1"]["unit"] == "? kW"


def test_a_column_in_the_unit_of_a_flux_is_a_flux(tmp_path):
    case = channels_of(tmp_path, "conduction", "T (C)", "q in (W/m²)", "q out [kW/m2]")
    found = case["channels"]["q_in"]
    assert (found["quantity"], found.get("unit")) == ("flux", None)
    assert case["channels"]["q_out"]["unit"] == "kW/m2"


@pytest.mark.parametrize(
    ("name", "unit"),
    [("T_air_degF", "degF"), ("T [F]", "degF"), ("T/K", "K"), ("T (C)", None), ("I/mA", "? mA"),
     ("in/out", None), ("T_K", None)],
)  # fmt: skip
def test_the_unit_in_a_name_is_found(tmp_path, name, unit):
    case = channels_of(tmp_path, "heat", name, "T_2 [°C]", time="time/h")
    assert case["data"]["time_unit"] == "h"
    channel, _ = case["channels"].values()
    assert channel.get("unit") == unit


def test_a_first_row_of_elapsed_time_and_limits_is_no_second_header(tmp_path):
    (tmp_path / "log.csv").write_text("t;c\n0:00:00;<0.5\n0:00:10;1,5\n0:00:20;2,5\n")
    with pytest.raises(DataError, match=r"row 2, column 'c': got '<0\.5'"):
        measured(tmp_path / "log.csv", "s")
    assert len(measured(tmp_path / "log.csv", "s", missing=("<0.5",)).samples) == 3
