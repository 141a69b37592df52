"""Samples from a Parquet file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from livepde.errors import DataError, SampleError, optional
from livepde.linalg import Array
from livepde.streams.clock import Clock
from livepde.streams.table import (
    Column,
    DataTable,
    check_columns,
    decimal_marks,
    no_file,
    tabulated,
)


def read_parquet(
    path: str | Path,
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Iterable[float] = (),
) -> DataTable:
    """Read channels from a Parquet file; only the columns that are needed.

    Parameters
    ----------
    columns, clock, every, missing
        As for `read_csv`; the time column may also hold dates with or without a time zone.

    Raises
    ------
    DataError
        No such file or column, or it is not Parquet; text in a channel; times that do not increase.
        The message names file, sample and column.
    """
    with optional("parquet", "Parquet files need pyarrow", DataError):
        import pyarrow as pa
        from pyarrow.parquet import ParquetFile

    where = str(path)
    names = decimal_marks(columns)
    needed = [clock.name, *(name for name in names if name != clock.name)]
    try:
        with ParquetFile(path) as file:
            check_columns(where, needed, file.schema_arrow.names)
            frame = file.read(columns=needed)
    except FileNotFoundError:
        raise no_file(Path(path)) from None
    except (OSError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise DataError(f"{where} cannot be read as a Parquet file: {reason}.") from error
    values = {name: _numbers(frame.column(name), where, name) for name in names}
    times = frame.column(clock.name).to_pylist()
    return tabulated(times, values, columns, clock, every=every, missing=missing, where=where)


def _numbers(column: Any, where: str, name: str) -> Array:
    """Return a column as numbers, NaN where there is none."""
    from pyarrow import float64, types

    kind = column.type
    tests = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
    if not any(test(kind) for test in tests):
        raise SampleError(f"{where}: column '{name}' is of type {kind}; expected numbers.")
    numbers: Array = column.cast(float64(), safe=False).to_numpy()
    return numbers
