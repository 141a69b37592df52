"""Samples from Parquet files."""

import builtins
import subprocess
import sys
from datetime import UTC, date, datetime
from decimal import Decimal

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from livepde.errors import DataError, SampleError
from livepde.streams.clock import Clock
from livepde.streams.csvfile import read_csv
from livepde.streams.table import Column, read_parquet

COLUMNS = {"a": Column(("T 1",)), "b": Column(("T 1", "T 2"), 2.0, 1.0)}
CLOCK = Clock("time")
NUMBERS = {"time": [0.0, 1.0, 2.5], "T 1": [1.0, 2.0, 3.0], "T 2": [3.0, None, -999.0]}


@pytest.fixture
def written(tmp_path):
    def write(**columns):
        path = tmp_path / "rows.parquet"
        parquet.write_table(pa.table(columns), path)
        return path

    return write


def test_the_same_as_from_csv(written, tmp_path):
    stamps = pd.date_range("2025-04-01", periods=40, freq="15min")
    frame = pd.DataFrame({"time": stamps, "T 1": np.arange(40.0), "T 2": np.arange(40) ** 2})
    frame.loc[3, "T 2"] = np.nan
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_csv(tmp_path / "a.csv", index=False)
    clock = Clock("time", start="2025-04-01 01:00", stop="2025-04-01 08:00")
    found = read_parquet(tmp_path / "a.parquet", COLUMNS, clock, every=3, missing=[16.0])
    expected = read_csv(tmp_path / "a.csv", COLUMNS, clock, every=3, missing=[16.0])
    assert len(found) > 5
    assert np.array_equal(found.t, expected.t)
    assert np.array_equal(found.values, expected.values, equal_nan=True)
    assert found.origin == expected.origin == datetime(2025, 4, 1, 1)


def test_numbers_and_what_is_missing(written):
    found = read_parquet(written(**NUMBERS), COLUMNS, CLOCK, missing=[-999])
    assert found.t.tolist() == [0.0, 1.0, 2.5]
    assert found.names == ("a", "b")
    assert np.array_equal(found.values, [[1, 5], [2, np.nan], [3, np.nan]], equal_nan=True)
    assert found.origin is None


def test_a_frame_with_its_times_as_index(tmp_path):
    frame = pd.DataFrame(NUMBERS).set_index("time")
    frame.to_parquet(tmp_path / "a.parquet")
    assert read_parquet(tmp_path / "a.parquet", COLUMNS, CLOCK).t.tolist() == [0.0, 1.0, 2.5]


@pytest.mark.parametrize(
    "times",
    [
        pa.array([datetime(2025, 4, 1, 6), datetime(2025, 4, 1, 7)], pa.timestamp("ns")),
        pa.array(
            [datetime(2025, 4, 1, 6, tzinfo=UTC), datetime(2025, 4, 1, 7, tzinfo=UTC)],
            pa.timestamp("ms", tz="Europe/Berlin"),
        ),
        pa.array(["2025-04-01T08:00+02:00", "2025-04-01 07:00"]),
    ],
    ids=["without zone", "with zone", "text"],
)
def test_dates(written, times):
    path = written(**{"time": times, "T 1": [1, 2], "T 2": [1, 2]})
    found = read_parquet(path, COLUMNS, CLOCK)
    assert found.origin == datetime(2025, 4, 1, 6)
    assert found.t.tolist() == [0.0, 3600.0]


@pytest.mark.parametrize(
    "column",
    [
        pa.array([1, None, 3], pa.int8()),
        pa.array([np.float16(1), None, np.float16(3)], pa.float16()),
        pa.array([Decimal(1), None, Decimal(3)]),
    ],
    ids=lambda column: str(column.type),
)
def test_every_kind_of_number(written, column):
    path = written(**{"time": [0, 1, 2], "T 1": column, "T 2": [1.0, 1.0, 1.0]})
    found = read_parquet(path, COLUMNS, CLOCK)
    assert np.array_equal(found.values[:, 0], [1, np.nan, 3], equal_nan=True)


def test_a_column_without_any_number_is_missing_throughout(written):
    found = read_parquet(written(**NUMBERS | {"T 2": pa.nulls(3)}), COLUMNS, CLOCK)
    assert np.isnan(found.values[:, 1]).all()


def test_only_the_columns_that_are_needed_are_read(written):
    """A broken page of another column is not met."""
    path = written(**NUMBERS, other=pa.array(["x" * 1000 + str(k) for k in range(3)]))
    group = parquet.ParquetFile(path).metadata.row_group(0)
    chunk = group.column(3)
    start = chunk.dictionary_page_offset or chunk.data_page_offset
    content = bytearray(path.read_bytes())
    content[start : start + chunk.total_compressed_size] = bytes(chunk.total_compressed_size)
    path.write_bytes(content)
    assert len(read_parquet(path, COLUMNS, CLOCK)) == 3
    with pytest.raises(DataError, match="cannot be read as a Parquet file"):
        read_parquet(path, {"a": Column(("other",))}, CLOCK)


@pytest.mark.parametrize(
    ("columns", "error", "said"),
    [
        ({"T 2": None}, SampleError, r"there is no column 'T 2'; did you mean 'T 1'\?"),
        ({"time": None}, SampleError, r"there is no column 'time'; there are T 1, T 2\."),
        ({"T 1": ["a", "b", "c"]}, SampleError, "column 'T 1' is of type string; expected numbers"),
        ({"T 1": [date(2025, 1, 1)] * 3}, SampleError, "column 'T 1' is of type date32"),
        ({"T 1": [1.0, np.inf, 1.0]}, SampleError, "column 'T 1' is infinite in sample 1"),
        ({"time": [0.0, None, 1.0]}, SampleError, "sample 1, times 'time': got None; expected"),
        (
            {name: pa.array([], pa.float64()) for name in NUMBERS},
            SampleError,
            "contains no samples",
        ),
    ],
)
def test_what_cannot_be_used_is_named(written, columns, error, said):
    rows = {name: cells for name, cells in (NUMBERS | columns).items() if cells is not None}
    with pytest.raises(error, match=said) as raised:
        read_parquet(written(**rows), COLUMNS, CLOCK)
    assert "rows.parquet" in str(raised.value)


def test_files_that_are_not_parquet(tmp_path):
    (tmp_path / "a.parquet").write_text("time,a\n0,1\n")
    (tmp_path / "empty.parquet").touch()
    with pytest.raises(DataError, match="there is no file"):
        read_parquet(tmp_path / "none.parquet", COLUMNS, CLOCK)
    for name in ("a.parquet", "empty.parquet", "."):
        with pytest.raises(DataError, match="cannot be read as a Parquet file: "):
            read_parquet(tmp_path / name, COLUMNS, CLOCK)


def test_the_extra_is_named(written, monkeypatch):
    path = written(**NUMBERS)
    load = builtins.__import__

    def missing(name, *rest, **more):
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return load(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(DataError, match=r"need pyarrow: pip install 'livepde\[parquet\]'"):
        read_parquet(path, COLUMNS, CLOCK)


@pytest.mark.slow
def test_nothing_is_loaded_before_a_file_is_read():
    code = "import sys, livepde.streams.table; sys.exit('pyarrow.parquet' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
