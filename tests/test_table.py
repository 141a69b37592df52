"""Samples from CSV files and JSON lines."""

import math
import re
from contextlib import closing
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from livepde.errors import DataError, SampleError, TimeOrderError
from livepde.streams import Clock, Column, DataTable, Follow, JsonLines, read_csv, read_json_lines
from livepde.streams.csvfile import header_of, how_written
from livepde.streams.intake import Intake

COLUMNS = {"T": Column(("a",)), "mean": Column(("a", "b"), factor=2.0, offset=1.0)}


@pytest.fixture
def csv(tmp_path):
    def write(text: str):
        path = tmp_path / "data.csv"
        path.write_text(text)
        return path

    return write


def test_reads_scales_and_averages(csv):
    path = csv("t, a, b, note\n0, 1, 3, x\n10, , 4, y\n20, 5, 7, z\n")
    table = read_csv(path, COLUMNS, Clock("t", factor=60.0))
    assert isinstance(table, DataTable)
    assert table.t.tolist() == [0.0, 600.0, 1200.0]
    assert np.allclose(table.values, [[1, 5], [np.nan, np.nan], [5, 13]], equal_nan=True)
    assert len(table) == 3
    first, second, _ = table
    assert first.t == 0.0
    assert first.z == {"T": 1.0, "mean": 5.0}
    assert math.isnan(second.z["T"])
    assert [s.t for s in table] == [s.t for s in table]  # again, as often as needed


@pytest.mark.parametrize("missing", ["", "NaN", "nan", "NA", "null", "-9999"])
def test_what_counts_as_missing(csv, missing):
    table = read_csv(
        csv(f"t,a\n0,1\n1,{missing}\n"), {"T": Column(("a",))}, Clock("t"), missing=[-9999]
    )
    assert np.isnan(table.values[1, 0])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("t,a,b\n0,1,1\n1,oops,1\n", "row 3, column 'a': got 'oops'"),
        ("t,a,b\n0,1,1\n\n1,1,inf\n", "row 4, column 'b': got 'inf'"),
        ("t,a,c\n0,1,1\n", "no column 'b'"),
        ("time,a,b\n0,1,1\n", "did you mean 'time'"),
        ("t,a,b\n0,1,1\nlater,1,1\n", "row 3, column 't': got 'later'"),
        ("t,a,b\n2025-01-01,1,1\n5,1,1\n", "expected a date"),
        ("t,a,b\n0,1,1\ns,K,K\n1,1,1\n", "row 3, column 't': got 's'; expected a number"),
        ("t,a,b\n0,'1,5',1\n", "row 2: 4 fields, but the header has 3; decimals need a point"),
        ('t,a,b\n0,"1,5",1\n', "got '1,5'; if that is a decimal comma, set decimal = ','"),
        ("t,a,b\n1.4.2025 9:05,1,1\n", "set time_format, perhaps '%d.%m.%Y %H:%M'"),
        ("t;a;b\n0;1,5;1\n", "3 with ';': set separator = ';' and decimal = ','."),
        ("t,a,b\n", "no rows"),
        ("", "cannot be read as a CSV file: it is empty"),
    ],
)
def test_bad_tables_name_file_row_and_column(csv, text, named):
    path = csv(text)
    clock = Clock("tim" if "did you mean" in named else "t")
    with pytest.raises(DataError) as error:
        read_csv(path, COLUMNS, clock)
    assert named in str(error.value)
    assert str(path) in str(error.value)


EXCEL = "Zeit;a;b\r\n01.04.2025 12:00;1,5;-0,5\r\n01.04.2025 12:30;;1e3\r\n"
GERMAN = Clock("Zeit", zone=ZoneInfo("Europe/Berlin"), format="%d.%m.%Y %H:%M", decimal=",")
COMMAS = {name: replace(column, decimal=",") for name, column in COLUMNS.items()}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_as_a_german_excel_writes_it(tmp_path, encoding):
    path = tmp_path / "a.csv"
    path.write_bytes(EXCEL.replace("Zeit", "Uhr ü").encode(encoding))
    clock, how = replace(GERMAN, name="Uhr ü"), {"separator": ";"}
    if encoding in ("cp1252", "utf-16"):
        with pytest.raises(DataError) as error:
            read_csv(path, COLUMNS, Clock("Uhr ü"))
        assert str(error.value).endswith(
            f"in row 1): set encoding = '{encoding}', separator = ';', decimal = ',' and "
            "time_format = '%d.%m.%Y %H:%M', or save it as 'CSV UTF-8'."
        )
        with pytest.raises(DataError, match=f": set encoding = '{encoding}', or save it"):
            read_csv(path, COMMAS, clock, **how)
        how["encoding"] = encoding
    table = read_csv(path, COMMAS, clock, **how)
    assert table.t.tolist() == [0.0, 1800.0]
    assert np.allclose(table.values, [[1.5, 2.0], [np.nan, np.nan]], equal_nan=True)
    assert str(table.origin) == "2025-04-01 10:00:00"
    if encoding == "utf-16":
        with pytest.raises(DataError, match="cannot be read while it grows"):
            Follow(path, **how)
        return
    intake = Intake(COMMAS, clock)
    with closing(Follow(path, **how)) as source:
        outcomes = [*map(intake.take, (row.values for row in source.poll(0.0))), intake.flush()]
    assert [one.t for found in outcomes for one in found.ready] == table.t.tolist()


def numbers_in(path: Path, separator: str, follow: bool) -> list[list[float]]:
    """Return the columns t, a and b of a file that is followed, or read at once."""
    if follow:
        with closing(Follow(path, separator=separator)) as source:
            rows = [row.values for row in source.poll(0.0)]
        return [[float(row[name]) for name in ("t", "a", "b")] for row in rows]
    columns = {"T": Column(("a",)), "S": Column(("b",))}
    table = read_csv(path, columns, Clock("t"), separator=separator)
    return np.column_stack([table.t, table.values]).tolist()


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize(
    "text",
    [
        "id,t,a,b\n7,0,1,2,\n7,1,3,4,\n",
        "id,t,a,b,\n7,0,1,2,cold\n7,1,3,4\n",
        'id,t,a,b\n"7,5",0,1,2\n"7,6", 1,3,4\n',
        '"id", "t", "a", "b"\n"7,5", 0, 1, 2\n7, "1", 3, 4\n',
    ],
)
def test_a_separator_at_the_end_of_a_row_shifts_no_column(csv, text, follow):
    path = csv(text)
    assert numbers_in(path, ",", follow) == [[0.0, 1.0, 2.0], [1.0, 3.0, 4.0]]


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize(
    "text",
    [
        "t a b\n0 1 2\n1 3 4\n",
        "  t a   b\n 0  1  2\n# stopped\n 1 3  4 \n\n",
        "# t, a, b\n0 1 2\n1 3 4\n",
        "# t a b\n0 1 2\n1 3 4\n",
    ],
)
def test_columns_with_blanks_between_them(csv, text, follow):
    path = csv(text)
    assert how_written(path).separator == " "
    assert header_of(path, " ", "utf-8", 0) == ["t", "a", "b"]
    assert numbers_in(path, " ", follow) == [[0.0, 1.0, 2.0], [1.0, 3.0, 4.0]]


@pytest.mark.parametrize("text", ["t T 1 a b\n0 9 1 2\n1 9 3 4\n", "t a b\n0 1\n1 3 4\n"])
def test_a_row_shorter_than_a_header_of_blanks_is_refused(csv, text):
    """Else a column would have the values of its neighbour."""
    path, columns = csv(text), {"T": Column(("a",))}
    with pytest.raises(DataError, match=r"row 2: . fields, but the header has .*a blank in them"):
        read_csv(path, columns, Clock("t"), separator=" ")
    with closing(Follow(path, separator=" ")) as source:
        assert "the header has" in source.poll(0.0)[0].broken


def test_quoted_names_with_blanks_are_one_column(csv):
    path = csv('t "T 1" a\n0  9 1\n1 9\t3\n')
    columns = {"T": Column(("a",)), "S": Column(("T 1",))}
    table = read_csv(path, columns, Clock("t"), separator=" ")
    assert table.values.tolist() == [[1.0, 9.0], [3.0, 9.0]]
    with closing(Follow(path, separator=" ")) as source:
        assert [row.values["a"] for row in source.poll(0.0)] == ["1", "3"]


def test_decimal_commas_are_no_fields_beside_an_empty_last_one(csv):
    path = csv("t,a,b,\n0,1,5,2,\n1,3,4,4,\n")  # a = 1,5
    with pytest.raises(DataError, match="row 2: 5 fields, but the header has 4; decimals need"):
        read_csv(path, COLUMNS, Clock("t"))
    with closing(Follow(path)) as source:
        assert [row.broken for row in source.poll(0.0)] == ["5 fields, the header has 4"] * 2


@pytest.mark.parametrize("rest", ['1,1,"x\n2,2,y\n', '1,1,"x', '2,1,1\n"'])
def test_a_quote_that_does_not_end(csv, rest):
    """Else all that follows it would be one field, and lost without a word."""
    with pytest.raises(DataError, match="cannot be read as a CSV file: a quote is not closed"):
        read_csv(csv("t,a,b\n0,1,1\n" + rest), COLUMNS, Clock("t"))


def test_quotes_and_what_looks_like_an_end(csv):
    path = csv('\n"t","a","b"\n0,"1","1"\n\n1,2,"2"\nend,1,1')
    with pytest.raises(DataError, match="row 6, column 't': got 'end'"):
        read_csv(path, COLUMNS, Clock("t"))
    table = read_csv(csv('t,a,"b\nb"\n0,1,"x\ny"\n1,2,3'), {"T": Column(("a",))}, Clock("t"))
    assert table.values[:, 0].tolist() == [1.0, 2.0]


def test_a_point_in_times_is_none_of_decimals(csv):
    with pytest.raises(DataError, match=r"row 3, column 't': got '0\.5'; with decimal = ','"):
        read_csv(csv("t,a,b\n0,1,1\n0.5,1,1\n"), COMMAS, Clock("t", decimal=","))


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
@pytest.mark.parametrize("start", [b"PK\x03\x04", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"])
def test_a_workbook_is_no_text_in_any_encoding(tmp_path, start, encoding):
    path = tmp_path / "book.csv"
    path.write_bytes(start + b"t,a,b\n0,1,1\n")
    with pytest.raises(DataError, match=r"book\.csv is a workbook, not text: save its sheet as"):
        read_csv(path, COLUMNS, Clock("t"), encoding=encoding)


def test_json_lines_may_have_decimal_commas_as_text(tmp_path):
    path = tmp_path / "data.jsonl"
    path.write_text('{"Zeit": "0,5", "a": "1,5", "b": 2.5}\n')
    clock = Clock("Zeit", decimal=",")
    (sample,) = read_json_lines(path, COMMAS, clock)
    (live,) = JsonLines(path.read_text().splitlines(), COMMAS, clock)
    assert sample == live
    assert (sample.t, sample.z) == (0.5, {"T": 1.5, "mean": 5.0})


@pytest.mark.parametrize("column", ["t", "a"])
def test_a_column_that_is_there_twice_is_refused(csv, column):
    path = csv(f"t,a,b,{column},c,c\n0,1,2,3,4,5\n")
    with pytest.raises(DataError, match=f"two columns are called '{column}'; rename one"):
        read_csv(path, COLUMNS, Clock("t"))
    with closing(Follow(path)) as source:
        told, row = source.poll(0.0)
    assert "two columns are called" in told.broken
    assert column not in row.values


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (
            "1,5",
            "1.234",
            "row 2, column 'a': got '1.234'; with decimal = ',', a point is not a decimal",
        ),
        ("01.04.2025 12:30", "31.02.2025 12:30", "as time_format has it, '%d.%m.%Y %H:%M'"),
    ],
)
def test_a_point_is_no_decimal_comma_and_a_format_is_kept(csv, old, new, named):
    with pytest.raises(DataError, match=re.escape(named)):
        read_csv(csv(EXCEL.replace(old, new)), COMMAS, GERMAN, separator=";")


@pytest.mark.parametrize("times", ["0,2,1", "0,1,1"])
def test_time_has_to_increase(csv, times):
    rows = "".join(f"{t},{k},1\n" for k, t in enumerate(times.split(",")))
    with pytest.raises(TimeOrderError, match="row 4, column 't'"):
        read_csv(csv("t,a,b\n" + rows), COLUMNS, Clock("t"))


def test_rows_that_repeat_the_one_before_are_left_out_and_counted(csv):
    found = read_csv(csv("t,a,b\n0,1,1\n1,2,\n1,2,\n1,2,\n2,2,3\n"), COLUMNS, Clock("t"))
    assert found.t.tolist() == [0.0, 1.0, 2.0]
    assert found.remarks["repeated", ""] == 2


NIGHT = datetime(2025, 10, 25, 22, tzinfo=UTC)  # in Berlin the day begins on which 3:00 is 2:00


@pytest.mark.parametrize("stop", ["2025-10-26", date(2025, 10, 26)])
def test_a_day_includes_its_hours_also_if_it_has_25(csv, stop):
    local = [(NIGHT + timedelta(minutes=30 * k)).astimezone(GERMAN.zone) for k in range(52)]
    clock = Clock("t", start="2025-10-26", stop=stop, zone=GERMAN.zone)
    table = read_csv(csv("t,a,b\n" + "".join(f"{t},1,1\n" for t in local)), COLUMNS, clock)
    assert table.t.tolist() == [1800.0 * k for k in range(50)]


def dates(csv, **options):
    rows = [f"2025-04-{day:02d} {hour:02d}:00,1,1" for day in (1, 2, 3) for hour in (0, 12)]
    clock = Clock("t", **{k: v for k, v in options.items() if k != "every"})
    every = options.get("every", 1)
    return read_csv(csv("\n".join(["t,a,b", *rows]) + "\n"), COLUMNS, clock, every=every)


def test_dates_count_from_the_first_sample(csv):
    table = dates(csv)
    assert table.t.tolist() == [43200.0 * k for k in range(6)]
    assert str(table.origin) == "2025-04-01 00:00:00"


def test_start_stop_every(csv):
    table = dates(csv, start="2025-04-01 12:00", stop="2025-04-02")  # a day includes its hours
    assert len(table) == 3
    assert str(table.origin) == "2025-04-01 12:00:00"
    assert len(dates(csv, every=4)) == 2
    assert dates(csv, second=1 / 3600).t[1] == 12.0
    with pytest.raises(DataError, match="no row lies between"):
        dates(csv, start="2026-01-01")
    with pytest.raises(SampleError, match="times are dates"):
        dates(csv, start=3.0)
    with pytest.raises(SampleError, match="times are numbers"):
        read_csv(csv("t,a,b\n0,1,1\n"), COLUMNS, Clock("t", stop="2025-04-01"))


def test_json_lines_come_one_at_a_time():
    def lines():
        yield '{"t": 0, "a": 1, "b": 3, "more": "text"}\n'
        yield "\n"
        yield '{"t": 1, "a": null}\n'
        raise AssertionError("read ahead")

    stream = iter(JsonLines(lines(), COLUMNS, Clock("t")))
    assert next(stream).z == {"T": 1.0, "mean": 5.0}
    assert math.isnan(next(stream).z["mean"])


def test_json_lines_with_dates_and_bounds(tmp_path):
    path = tmp_path / "data.jsonl"
    rows = [f'{{"t": "2025-04-0{day}", "a": {day}, "b": -9999}}' for day in (1, 2, 3, 4, 5)]
    path.write_text("\n".join(rows))
    clock = Clock("t", start="2025-04-02", stop="2025-04-04")
    stream = read_json_lines(path, COLUMNS, clock, missing=[-9999], every=2)
    samples = list(stream)
    assert [s.t for s in samples] == [0.0, 2 * 86400.0]
    assert [s.z["T"] for s in samples] == [2.0, 4.0]
    assert math.isnan(samples[0].z["mean"])
    assert str(stream.origin) == "2025-04-02 00:00:00"
    with pytest.raises(DataError, match="there is no file"):
        read_json_lines(tmp_path / "none.jsonl", COLUMNS, clock)
    for line, told in (
        ("[" * 100_000, "line 7: is not JSON"),
        (f'{{"t": {"9" * 5000}}}', "line 7: is not JSON"),
        ('{"a": 1}', "line 7: there is no column 't'"),
        ('{"t": "2025-04-06", "a": "warm"}', "line 7, 'a': got 'warm'"),
        ('{"t": "2025-04-03"}', "line 7: the time is earlier"),
    ):
        path.write_text("\n".join([*rows, "", line]))
        with pytest.raises(DataError, match=re.escape(told)):
            read_json_lines(path, COLUMNS, Clock("t"))


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("not json", "is not JSON"),
        ('{"t": "later", "a": 1}', "got 'later'; expected a number, as in the other rows"),
        ("[1, 2]", "expected an object"),
        ('{"t": 1, "a": "warm"}', "line 2, 'a': got 'warm'"),
        ('{"t": 1, "a": 1e999}', "must be finite"),
        ('{"t": 0, "a": 1}', "that of the one before"),
        ('{"t": true, "a": 1}', "got True"),
    ],
)
def test_bad_lines(line, named):
    stream = JsonLines(['{"t": 0, "a": 1, "b": 1}', line], COLUMNS, Clock("t"))
    with pytest.raises(DataError) as error:
        list(stream)
    assert named in str(error.value)
    assert "line 2" in str(error.value)
