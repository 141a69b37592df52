"""Layout and contents of a table of measurements, for `livepde init`."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, tzinfo
from functools import partial
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np

from livepde.cases.data import since_when
from livepde.cases.read import BLANK
from livepde.errors import SampleError
from livepde.linalg import Array
from livepde.streams import Clock, Column, DataTable, read_csv
from livepde.streams.cells import Missing, is_limit, is_missing, number_of
from livepde.streams.clock import CALLED_TIME, ELAPSED, date_formats, elapsed_formats
from livepde.streams.csvfile import UTF_8, Written, how_written, read_long_csv, texts_of
from livepde.streams.join import join_tables
from livepde.streams.table import JSON_LINES, parquet_file, read_parquet
from livepde.units import OF_TIMES, conversion, counted_since, unit_in

HOUR = re.compile(r"\d+:\d{2}(:\d{2}(\.\d+)?)?( ?[AaPp][Mm])?")
ROW_NUMBER = re.compile(r"(id|idx|index|n|no|nr|num|number|row|rec|record|sample|#)\.?", re.I)
# Units of times relative to a date, and the smallest plausible number: the year 2000.
COUNTED = {
    "ms since 1970-01-01T00:00Z": 946684800e3,
    "s since 1970-01-01T00:00Z": 946684800.0,
    "d since 1899-12-30": 36526.0,  # Excel
}
LATEST = 2.7  # largest plausible over smallest number: the year 2051, or 2169 for Excel
DATED = re.compile(r"^t\b|time|date|datum|zeit|temps", re.I)
VALUED = re.compile(r"val|wert|reading|result|state", re.I)  # name of the column of values
UNITS = re.compile(r"unit|einheit|unité|eenheid", re.I)  # name of the column of units
FIRST_ROWS = 1000  # rows from which the columns of a Parquet file are recognised
MOSTLY = 0.9  # smallest share of distinct pairs of time and sensor in a long table
VALUES = {"number", "date", "hour"}  # kinds of cells that do not occur in a header


@dataclass(frozen=True, eq=False)
class Measured:
    """A table of measurements, with its detected format."""

    path: Path
    written: Written
    time: tuple[str, ...]  # time column, or the columns of days and times of day
    time_format: str  # format of dates; empty: ISO format, or numbers
    time_unit: str  # unit of times; `BLANK` if unknown, empty if the equation has no time unit
    samples: DataTable  # times, and the columns that contain numbers
    row_numbers: tuple[str, ...]  # unused columns of row numbers
    texts: tuple[str, ...]  # unused columns without numbers
    missing: tuple[float | str, ...] = ()  # stated markers of missing values, for the first table
    counted: str = ""  # unit and reference date of times, such as "d since 1899-12-30"; or empty
    more: tuple[Measured, ...] = ()  # tables that are joined to this table by time
    long: tuple[str, str] | None = None  # columns of sensors and values, if each row is a reading
    units: Mapping[str, str] = field(default_factory=dict)  # sensor -> unit, in a long table

    @property
    def tables(self) -> tuple[Measured, ...]:
        """All joined tables; the first is this table."""
        return (self, *self.more)

    @property
    def columns(self) -> dict[str, Array]:
        """Column of numbers -> values, for all tables."""
        return {
            name: values
            for table in self.tables
            for name, values in zip(table.samples.names, table.samples.values.T, strict=True)
        }

    def joined(self, other: Measured) -> Measured:
        """Return this table joined with another table by time; raises `SampleError`."""
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

    def titled(self, name: str) -> str:
        """Return the name of a column with its unit in brackets, if the table has it elsewhere."""
        if unit := self.units.get(name, ""):
            return f"{name} [{unit}]"
        (table,) = (one for one in self.tables if name in one.samples.names)
        return table.written.titled(name)

    @property
    def is_of_numbers(self) -> bool:
        """Whether times are numbers, whose unit a case has to state."""
        return self.samples.origin is None and self.time_format not in ELAPSED

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
        text = f"{len(samples)} rows from {begin} to {end}{' UTC' if samples.origin else ''}"
        if len(steps):
            text += f", {np.median(steps):g} {unit}".rstrip() + " apart"
        if len(steps) and steps.max() > 1.01 * steps.min():
            text += f" (median), {steps.min():g} to {steps.max():g}"
        known = self.counted or (self.time_format if self.time_format in ELAPSED else "")
        return f"{text}; times are read as {known}" if known else text


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
    stated: str = "",
    sensor: str = "",
    value: str = "",
) -> Measured:
    """Read a CSV or Parquet file of unknown format, except for arguments; raises `SampleError`.

    `time_unit`: time unit of the equation. `time_format`: format of dates; empty: detected from the
    cells. `skip`: number of lines before the header; None: detected. `zone`: time zone of dates
    without one. `missing`: markers of missing values. `stated`: unit of times; empty: detected from
    name and numbers. `sensor`, `value`: columns of a long table, with a row for each reading;
    empty: detected.
    """
    if table.suffix in JSON_LINES:
        raise SampleError(f"{table}: expected a CSV file with a header, or a Parquet file.")
    parquet = table.suffix == ".parquet"
    written = _parquet_written(table) if parquet else how_written(table, skip=skip)
    written = replace(written, rows=[_without(row, missing) for row in written.rows])
    kinds = _kinds(table, written, time_format)
    time = _times(table, written, kinds)
    clock, unit = _clock(table, written, time, kinds[time[0]], time_format, stated)
    columns, row_numbers, texts = _sorted_out(kinds, time, written)
    if not columns:
        raise SampleError(f"{table}: no column but the times, '{time[0]}', contains numbers.")
    zoned, long = replace(clock, zone=zone), None
    units: Mapping[str, str] = {}
    how: dict[str, Any] = {"separator": written.separator, "encoding": written.encoding}
    how |= {"skip": written.skip, "missing": missing}
    if parquet:
        samples = read_parquet(table, columns, zoned, missing=missing)
    elif found := _readings(table, written, zoned, list(columns), texts, sensor, value):
        long, units = (found.sensor, found.value), found.units
        columns = {name: Column((name,), decimal=written.decimal) for name in found.names}
        parts = read_long_csv(table, columns, zoned, long, **how)
        samples = join_tables(parts, 1.0, list(columns), (), f"{table}", together=False)
        row_numbers, texts = (), ()
    else:
        samples = read_csv(table, columns, zoned, **how)
    counted, steps = (unit, "s") if clock.since else ("", unit)
    steps = time_unit and (steps or BLANK)
    known = (samples, row_numbers, texts, missing, counted)
    return Measured(table, written, time, clock.format, steps, *known, long=long, units=units)


def _parquet_written(path: Path) -> Written:
    """Return the columns and the first rows of a Parquet file as a text file has them."""
    with parquet_file(path) as file:
        names = file.schema_arrow.names
        batch = next(file.iter_batches(FIRST_ROWS), None)
    columns = [column.to_pylist() for column in batch.columns] if batch else []
    rows = [["" if x is None else str(x) for x in row] for row in zip(*columns, strict=True)]
    return Written(",", ".", UTF_8, 0, (), names, rows)


@dataclass(frozen=True)
class _Readings:
    """Columns and sensors of a long table, with a row for each reading."""

    sensor: str
    value: str
    names: tuple[str, ...]
    units: Mapping[str, str]  # sensor -> unit; empty without a column of units


def _readings(
    table: Path,
    written: Written,
    clock: Clock,
    numbers: Sequence[str],
    texts: Sequence[str],
    sensor: str,
    value: str,
) -> _Readings | None:
    """Return the layout of a long table; None for a table with a column for each sensor.

    In a long table times repeat, but not for the same sensor. `sensor`, `value`: stated columns.
    """
    asked = [sensor] if sensor else list(texts)
    if not asked:
        return None
    how = (written.separator, written.encoding, clock, written.skip)
    _, found = texts_of(table, [*clock.names, *asked, *texts], *how)
    cells = {name: list(map(str.strip, column)) for name, column in found.items()}
    if not (name := sensor or _naming_sensors(asked, cells, clock)):
        return None
    known = tuple(filter(None, dict.fromkeys(cells[name])))
    pairs = ({*zip(cells[name], cells[one], strict=True)} for one in texts if UNITS.search(one))
    units = next((dict(pair) for pair in pairs if len(pair) == len(known)), {})
    return _Readings(name, value or _valued(table, name, numbers), known, units)


def _naming_sensors(asked: Sequence[str], cells: Mapping[str, list[str]], clock: Clock) -> str:
    """Return the column with the sensor of each row, if times repeat; else an empty text."""
    moments = list(zip(*(cells[name] for name in clock.names), strict=True))
    if len(set(moments)) == len(moments):
        return ""

    def names_sensors(names: list[str]) -> bool:
        # When clocks are set back, some times of a sensor occur twice.
        apart = len({*zip(names, moments, strict=True)})
        return len(set(filter(None, names))) > 1 and apart >= MOSTLY * len(moments)

    return next((name for name in asked if names_sensors(cells[name])), "")


def _valued(table: Path, sensor: str, numbers: Sequence[str]) -> str:
    """Return the column of values of a long table; raises `SampleError` if it is ambiguous."""
    values = [one for one in numbers if VALUED.search(one)]
    values = values or [one for one in numbers if one != sensor]
    if len(values) == 1:
        return values[0]
    raise SampleError(
        f"{table}: each row is a reading of '{sensor}': set data.value to the column of "
        f"values{', perhaps ' if values else ''}{' or '.join(values)}."
    )


def _clock(
    table: Path, written: Written, time: tuple[str, ...], kind: str, form: str, stated: str
) -> tuple[Clock, str]:
    """Return the clock of a table, and the unit of times with its date, if any, or empty."""
    dated = kind in ("date", "hour")
    form = _format(table, written, time, form) if dated else ""
    unit = "s" if dated else stated or _unit_of_times(written, time[0])
    each, since = since_when(unit, f"{table}: time_unit")
    factor = conversion(each, "s", f"{table}: time_unit").factor if since else 1.0
    known: dict[str, Any] = {"format": form, "decimal": written.decimal, "since": since}
    return Clock(time[0], factor, hour="".join(time[1:]), **known), unit


def _without(row: Sequence[str], missing: Missing) -> list[str]:
    """Return the cells of a row, with markers of missing values replaced by empty cells."""
    return ["" if is_missing(cell, missing) else cell for cell in row]


def _sorted_out(
    kinds: Mapping[str, str], time: tuple[str, ...], written: Written
) -> tuple[dict[str, Column], tuple[str, ...], tuple[str, ...]]:
    """Return the columns of measurements, of row numbers, and without numbers."""
    numbers = [name for name, kind in kinds.items() if kind == "number" and name not in time]
    counted = tuple(name for name in numbers if _counts_rows(name, written))
    columns = {n: Column((n,), decimal=written.decimal) for n in numbers if n not in counted}
    return columns, counted, tuple(name for name in kinds if name not in (*time, *numbers))


def _unit_of_times(written: Written, name: str) -> str:
    """Return the unit of times that are numbers, with its reference date, if any, or empty."""
    if found := counted_since(name) or unit_in(written.titled(name), "s", *OF_TIMES):
        return found
    values, named = _values(name, written), DATED.search(name)
    for unit, least in COUNTED.items() if named else ():
        if ((values >= least) & (values < LATEST * least)).all():
            return unit
    return ""


def _kinds(table: Path, written: Written, form: str) -> dict[str, str]:
    """Return column -> most frequent kind of its cells: "number", "date", "hour" or "text"."""
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
    if number_of(cell, decimal) is not None or is_limit(cell):
        return "number"
    if Clock("").stamp(cell, form) is not None or Clock("").stamp(cell) is not None:
        return "date"
    return "hour" if HOUR.fullmatch(cell.strip()) else "text"


def _times(table: Path, written: Written, kinds: Mapping[str, str]) -> tuple[str, ...]:
    """Return the time column (dates or increasing numbers), or columns of days and times."""
    of_kind: defaultdict[str, list[str]] = defaultdict(list)
    for name, kind in kinds.items():
        of_kind[kind].append(name)
    dates, hours, numbers = of_kind["date"], of_kind["hour"], of_kind["number"]
    complete = [name for name in dates if ":" in "".join(_cells(name, written))]
    if dates and hours and not complete:
        return dates[0], hours[0]
    found = [*complete, *dates, *_most_like_times(numbers, hours, written)]
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


def _most_like_times(numbers: Sequence[str], hours: Sequence[str], written: Written) -> list[str]:
    """Return columns that may be times, the most certain first.

    `hours`: columns such as 0:10:00, which are times if they are elapsed times. If there are any,
    columns of numbers are times only if their name indicates it.
    """
    timed = [n for n in numbers if counted_since(n) or unit_in(written.titled(n), "s", *OF_TIMES)]
    rising = [name for name in numbers if _rises(name, written)]
    named = [*filter(rising.__contains__, timed), *filter(CALLED_TIME.match, rising)]
    if hours:
        return [*named, *(name for name in hours if elapsed_formats(_cells(name, written)))]
    # Row numbers also increase: they come after other increasing numbers.
    return [*named, *sorted(rising, key=lambda name: _counts_rows(name, written)), *timed]


def _format(table: Path, written: Written, time: tuple[str, ...], given: str) -> str:
    """Return the format of dates or elapsed times; raises `SampleError` if it is ambiguous."""
    if given:
        return given
    cells = [" ".join(parts) for parts in zip(*(_cells(n, written) for n in time), strict=False)]
    formats = elapsed_formats(cells) or date_formats(cells)
    if len(formats) == 1:
        return formats[0]
    raise SampleError(f"{table}, column '{time[0]}': {_ask_format(cells[0], formats)}")


def _ask_format(cell: str, formats: Sequence[str]) -> str:
    """Return the message on a time that has no format, or several."""
    if not formats:
        return f"got '{cell}'; set --time-format, such as '%d.%m.%Y %H:%M'."
    if formats[0] in ELAPSED:
        return (
            f"if '{cell}' is an elapsed time, set --time-format "
            f"{' or '.join(map(repr, formats))}; if it is a time of day, add a column of days."
        )
    candidates = " or ".join(
        f"'{form}' ({_moment(Clock('').stamp(cell, form) or 0.0, datetime(1970, 1, 1))})"
        for form in formats
    )
    return (
        f"the order of day, month and year in '{cell}' is ambiguous: set --time-format, "
        f"{candidates}."
    )


def _cells(name: str, written: Written) -> list[str]:
    """Return the first cells of a column that are not missing."""
    k = written.header.index(name)
    cells = (row[k].strip() for row in written.rows if k < len(row))
    return [cell for cell in cells if not is_missing(cell)]


def _values(name: str, written: Written) -> Array:
    """Return the numbers in the first cells of a column, NaN for other cells."""
    k = written.header.index(name)
    cells = (number_of(row[k], written.decimal) for row in written.rows if k < len(row))
    return np.array(list(cells), dtype=float)


def _rises(name: str, written: Written) -> bool:
    values = _values(name, written)
    return bool((values[:-1] < values[1:]).all())


def _counts_rows(name: str, written: Written) -> bool:
    """Return whether a column contains row numbers, according to its name and values."""
    values = _values(name, written)
    counts = bool((values[1:] == values[:-1] + 1).all())
    return bool(ROW_NUMBER.fullmatch(name.strip())) and len(values) > 1 and counts
