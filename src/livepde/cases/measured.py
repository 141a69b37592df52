"""Layout and contents of a table of measurements, for `livepde init`."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, tzinfo
from functools import partial
from pathlib import Path
from statistics import mode

import numpy as np

from livepde.cases.read import BLANK
from livepde.errors import SampleError
from livepde.linalg import Array
from livepde.streams import Clock, Column, DataTable, read_csv
from livepde.streams.cells import Missing, is_limit, is_missing, number_of
from livepde.streams.clock import CALLED_TIME, date_formats
from livepde.streams.csvfile import Written, how_written
from livepde.streams.table import JSON_LINES
from livepde.units import AT_THE_END, IN_BRACKETS, unit_in

HOUR = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d+)?)?( ?[AaPp][Mm])?")
ROW_NUMBER = re.compile(r"(id|idx|index|n|no|nr|num|number|row|rec|record|sample|#)\.?", re.I)
VALUES = {"number", "date"}  # kinds of cells that a header does not have


@dataclass(frozen=True, eq=False)
class Measured:
    """A table of measurements as it was read."""

    path: Path
    written: Written
    time: tuple[str, ...]  # column of times; or days and times of day, two columns
    time_format: str  # of its dates; empty: ISO format, or numbers
    time_unit: str  # of its times; `BLANK` if unknown, empty if the equation's time has none
    samples: DataTable  # times, and the columns that contain numbers
    row_numbers: tuple[str, ...]  # columns that are not used
    texts: tuple[str, ...]  # columns without numbers, not used either
    missing: tuple[float | str, ...] = ()  # stated to mean a missing value, of the first table
    more: tuple[Measured, ...] = ()  # tables that are joined to this one by time

    @property
    def tables(self) -> tuple[Measured, ...]:
        """Tables that are joined: the first is this one."""
        return (self, *self.more)

    @property
    def columns(self) -> dict[str, Array]:
        """Values of each column of numbers, of all tables."""
        return {
            name: values
            for table in self.tables
            for name, values in zip(table.samples.names, table.samples.values.T, strict=True)
        }

    def joined(self, other: Measured) -> Measured:
        """Return this table with another one that is joined to it by time; raises `DataError`."""
        if both := sorted(self.columns.keys() & other.columns.keys()):
            raise SampleError(
                f"{other.path}: the column '{both[0]}' is in another table, too: rename one."
            )
        if (self.samples.origin is None) != (other.samples.origin is None):
            raise SampleError(
                f"{other.path}: one of this file and {self.path} has dates as times, the other has "
                "numbers. Use the same format in both."
            )
        return replace(self, more=(*self.more, other))

    @property
    def steps(self) -> Array:
        """Intervals between the samples."""
        return np.diff(self.samples.t)

    @property
    def span(self) -> str:
        """Number of rows, first and last time, and intervals in one sentence."""
        samples, steps = self.samples, self.steps
        unit = self.time_unit.replace(BLANK, "")
        begin, end = (_moment(t, samples.origin) for t in samples.t[[0, -1]])
        told = f"{len(samples)} rows from {begin} to {end}{' UTC' if samples.origin else ''}"
        if len(steps):
            told += f", {np.median(steps):g} {unit}".rstrip() + " apart"
        if len(steps) and steps.max() > 1.01 * steps.min():
            told += f" (median), {steps.min():g} to {steps.max():g}"
        return told


def _moment(t: float, origin: datetime | None) -> str:
    return f"{t:g}" if origin is None else f"{origin + timedelta(seconds=t)}"


def measured(
    table: Path,
    time_unit: str,
    *,
    time_format: str = "",
    skip: int | None = None,
    zone: tzinfo = UTC,
    missing: tuple[float | str, ...] = (),
) -> Measured:
    """Read a CSV file of which nothing is known.

    `time_unit`: the unit of time of the equation. `time_format`: of dates; empty: found from the
    cells. `skip`: lines before the header; None: found from the lines. `zone`: of dates
    without one. `missing`: numbers and texts that mean a missing value.
    """
    if table.suffix in (*JSON_LINES, ".parquet"):
        raise SampleError(f"{table}: expected a CSV file with a header.")
    written = how_written(table, skip=skip)
    written = replace(written, rows=[_without(row, missing) for row in written.rows])
    kinds = _kinds(table, written, time_format)
    time = _times(table, written, kinds)
    dated = kinds[time[0]] == "date"
    found = _format(table, written, time, time_format) if dated else ""
    columns, counted, texts = _sorted_out(kinds, time, written)
    if not columns:
        raise SampleError(f"{table}: no column but the times, '{time[0]}', contains numbers.")
    samples = read_csv(
        table,
        columns,
        Clock(time[0], zone=zone, format=found, decimal=written.decimal, hour="".join(time[1:])),
        separator=written.separator,
        encoding=written.encoding,
        skip=written.skip,
        missing=missing,
    )
    unit = time_unit and _unit_of_times(samples, time[0], time_unit)
    return Measured(table, written, time, found, unit, samples, counted, texts, missing)


def _without(row: Sequence[str], missing: Missing) -> list[str]:
    """Return the cells of a row, empty where they mean a missing value."""
    return ["" if is_missing(cell, missing) else cell for cell in row]


def _sorted_out(
    kinds: Mapping[str, str], time: tuple[str, ...], written: Written
) -> tuple[dict[str, Column], tuple[str, ...], tuple[str, ...]]:
    """Return the columns of measurements, those of row numbers, and those without numbers."""
    numbers = [name for name, kind in kinds.items() if kind == "number" and name not in time]
    counted = tuple(name for name in numbers if _counts_rows(name, written))
    columns = {n: Column((n,), decimal=written.decimal) for n in numbers if n not in counted}
    return columns, counted, tuple(name for name in kinds if name not in (*time, *numbers))


def _unit_of_times(samples: DataTable, name: str, unit: str) -> str:
    """Return the unit of a column of times; dates are read as seconds since the first one."""
    return "s" if samples.origin else unit_in(name, unit, IN_BRACKETS, AT_THE_END) or BLANK


def _kinds(table: Path, written: Written, form: str) -> dict[str, str]:
    """Return column -> kind of most of its cells: "number", "date", "hour" or "text"."""
    header, rows = written.header, written.rows
    if not rows:
        raise SampleError(f"{table}: has no rows below its header.")
    form = form or next(iter(written.time_formats), "")
    of_cell = partial(_kind, decimal=written.decimal, form=form)
    if VALUES.issuperset(map(of_cell, filter(None, header))):
        text = "has no header. Add a first line with the names of its columns."
        raise SampleError(f"{table}: {text}")
    if len(header) < 2:
        raise SampleError(
            f"{table}: has one column, '{header[0]}'; expected times and measurements, with a "
            "comma, a semicolon or a tab between them."
        )
    if VALUES.isdisjoint(map(of_cell, rows[0])):
        raise SampleError(
            f"{table}, row {written.skip + 2}: contains no numbers. If the header has two lines, "
            "delete the second. If the first lines are titles, set --skip."
        )
    return {
        name: mode([of_cell(cell) for cell in _cells(name, written)] or ["text"])
        for name in header
        if name
    }


def _kind(cell: str, decimal: str, form: str) -> str:
    if number_of(cell, decimal) is not None or is_limit(cell, decimal):
        return "number"
    if Clock("").stamp(cell, form) is not None or Clock("").stamp(cell) is not None:
        return "date"
    return "hour" if HOUR.fullmatch(cell.strip()) else "text"


def _times(table: Path, written: Written, kinds: Mapping[str, str]) -> tuple[str, ...]:
    """Return the column of times: dates, or numbers that increase; or days and times of day."""
    of_kind: defaultdict[str, list[str]] = defaultdict(list)
    for name, kind in kinds.items():
        of_kind[kind].append(name)
    dates, hours, numbers = of_kind["date"], of_kind["hour"], of_kind["number"]
    complete = [name for name in dates if ":" in "".join(_cells(name, written))]
    if dates and hours and not complete:
        return dates[0], hours[0]
    found = [*complete, *dates, *_most_like_times(numbers, written)]
    if found:
        return (found[0],)
    more = ""
    if "" in written.header:
        more = f" Column {written.header.index('') + 1} has no name: give it one."
    elif hours:
        more = f" '{hours[0]}' has times of day: add a column of days."
    raise SampleError(
        f"{table}: no column contains times: expected dates, or numbers that increase from row to "
        f"row.{more}"
    )


def _most_like_times(numbers: Sequence[str], written: Written) -> list[str]:
    """Return columns of numbers that may be times, those with the surest signs first."""
    timed = [name for name in numbers if unit_in(name, "s", IN_BRACKETS, AT_THE_END)]
    values = {name: _values(name, written) for name in numbers}
    rising = [name for name, found in values.items() if (found[:-1] < found[1:]).all()]
    both = [name for name in timed if name in rising]
    # Row numbers increase, too: they are times only if nothing else is.
    others = [name for name in rising if not _counts_rows(name, written)]
    return [*both, *filter(CALLED_TIME.match, rising), *others, *rising, *timed]


def _format(table: Path, written: Written, time: tuple[str, ...], given: str) -> str:
    """Return the format of dates; refuses cells whose order of day and month is not unique."""
    if given:
        return given
    cells = [" ".join(parts) for parts in zip(*(_cells(n, written) for n in time), strict=False)]
    formats = date_formats(cells)
    if len(formats) == 1:
        return formats[0]
    if not formats:
        raise SampleError(
            f"{table}, column '{time[0]}': got '{cells[0]}'; set --time-format, such as "
            "'%d.%m.%Y %H:%M'."
        )
    candidates = " or ".join(
        f"'{form}' ({_moment(Clock('').stamp(cells[0], form) or 0.0, datetime(1970, 1, 1))})"
        for form in formats
    )
    raise SampleError(
        f"{table}, column '{time[0]}': the order of day, month and year in '{cells[0]}' is "
        f"ambiguous: set --time-format, {candidates}."
    )


def _cells(name: str, written: Written) -> list[str]:
    """Return the first cells of a column that are not missing."""
    k = written.header.index(name)
    cells = (row[k].strip() for row in written.rows if k < len(row))
    return [cell for cell in cells if not is_missing(cell)]


def _values(name: str, written: Written) -> Array:
    """Return the first numbers of a column, NaN where a cell is none."""
    k = written.header.index(name)
    cells = (number_of(row[k], written.decimal) for row in written.rows if k < len(row))
    return np.array(list(cells), dtype=float)


def _counts_rows(name: str, written: Written) -> bool:
    """Return whether a column numbers the rows, by its name and its values."""
    values = _values(name, written)
    counts = bool((values[1:] == values[:-1] + 1).all())
    return bool(ROW_NUMBER.fullmatch(name.strip())) and len(values) > 1 and counts
