"""Samples from files of CSV and JSON lines, and from JSON lines as they come."""

from __future__ import annotations

import csv
import difflib
import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, tzinfo
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from livepde.errors import DataError, SampleError, TimeOrderError
from livepde.identifier import Sample
from livepde.linalg import Array

__all__ = [
    "JSON_LINES",
    "Clock",
    "Column",
    "JsonLines",
    "Table",
    "channel_value",
    "check_columns",
    "read_csv",
    "read_json_lines",
    "row_time",
    "tabulated",
]

JSON_LINES = (".jsonl", ".ndjson")  # endings of files of JSON lines
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "#n/a"})
Instant: TypeAlias = float | str | date | datetime


@dataclass(frozen=True)
class Column:
    """Where a channel comes from: value = factor * (mean of the columns) + offset.

    Several columns are averaged; where one of them is missing, so is the channel.

    Attributes
    ----------
    valid
        A value outside is missing.
    needed
        A sample without this channel is left out.
    """

    names: tuple[str, ...]
    factor: float = 1.0
    offset: float = 0.0
    valid: tuple[float, float] = (-math.inf, math.inf)
    needed: bool = False


@dataclass(frozen=True)
class Clock:
    """How the time column is read, and what of it is used.

    Attributes
    ----------
    name
        The time column: numbers, or dates and times in ISO format.
    factor
        Multiplies numbers to give the model's time; dates become seconds divided by `second`.
    start, stop
        First and last time used, in the terms of the column: a number (in the model's unit) or
        a date.
    second
        One second in the model's unit of time.
    zone
        Of dates that name none.
    """

    name: str
    factor: float = 1.0
    start: Instant | None = None
    stop: Instant | None = None
    second: float = 1.0
    zone: tzinfo = UTC

    def bounds(self, dates: bool, where: str) -> tuple[float, float]:
        """Return start and stop in model time (dates: since 1970)."""
        low, high = -math.inf, math.inf
        if self.start is not None:
            low = self._bound(self.start, dates, f"{where}: start")
        if self.stop is not None:
            high = self._bound(self.stop, dates, f"{where}: stop")
            if dates and _whole_day(self.stop):
                high += 86399.999 * self.second  # a day includes its hours
        return low, high

    def stamp(self, value: Any) -> float | None:
        """Return seconds since 1970 of a date or a date as text, None if it is neither."""
        try:
            if isinstance(value, str):
                value = datetime.fromisoformat(value.strip())
            if isinstance(value, date) and not isinstance(value, datetime):
                value = datetime(value.year, value.month, value.day)
            if not isinstance(value, datetime):
                return None
            return (value if value.tzinfo else value.replace(tzinfo=self.zone)).timestamp()
        except (ValueError, OverflowError):
            return None

    def _bound(self, value: Instant, dates: bool, what: str) -> float:
        if dates:
            stamp = self.stamp(value)
            if stamp is None:
                raise SampleError(f"{what}: got {value!r}; the times are dates, as 2025-04-01.")
            return stamp * self.second
        if isinstance(value, str | date):
            raise SampleError(f"{what}: got {str(value)!r}; the times are numbers, not dates.")
        return float(value)


@dataclass(frozen=True, eq=False)
class Table:
    """Samples in memory, checked: iterate over it, as often as needed.

    Attributes
    ----------
    t
        Times in the model's unit, shape (samples,); dates count from the first sample.
    values
        Channel values, NaN where missing, shape (samples, channels).
    names
        Channels.
    origin
        The first sample's date, if times are dates.
    remarks
        (kind, channel) -> how many values were not valid ("invalid"), and samples left out because
        a channel is missing that they need ("skipped").
    """

    t: Array
    values: Array
    names: tuple[str, ...]
    origin: datetime | None = None
    remarks: Mapping[tuple[str, str], int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)

    def __iter__(self) -> Iterator[Sample]:
        for t, row in zip(self.t.tolist(), self.values.tolist(), strict=True):
            yield Sample(t, dict(zip(self.names, row, strict=True)))


def read_csv(
    path: str | Path,
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Iterable[float] = (),
    separator: str = ",",
) -> Table:
    """Read channels from a CSV file with one header line.

    Parameters
    ----------
    columns
        Channel -> where it comes from.
    every
        Keep every so many rows.
    missing
        Numbers that mean a missing sample (-9999). Empty cells and NaN always do.
    separator
        What stands between two fields, as "," or ";".

    Raises
    ------
    DataError
        No such file or column; text or infinity in a channel; times that do not increase. The
        message names file, row (the header is row 1) and column.
    """
    import pandas as pd

    path = Path(path)
    needed = [clock.name, *(name for column in columns.values() for name in column.names)]
    try:
        header = list(pd.read_csv(path, nrows=0, skipinitialspace=True, sep=separator).columns)
        _check_separator(path, header, separator)
        check_columns(str(path), needed, header)
        _check_widths(path, len(header), separator)
        frame = pd.read_csv(
            path,
            usecols=sorted(set(needed)),
            dtype=str,
            keep_default_na=False,
            skipinitialspace=True,
            sep=separator,
            skip_blank_lines=False,
        )
    except (OSError, pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as a CSV file: {error}.") from error
    blank = (frame == "").all(axis=1)
    rows = np.flatnonzero(~blank.to_numpy()) + 2
    frame = frame.loc[~blank]
    if not len(frame):
        raise DataError(f"{path}: holds no rows beside its header.")
    times, dates = _times(
        frame[clock.name].tolist(), clock, lambda k: f"{path}, row {rows[k]}, column"
    )

    def numbers(name: str, use: Any) -> Array:
        return _numbers(frame[name].to_numpy()[use], rows[use], f"{path}", name)

    def where(k: int) -> str:
        return f"{path}, row {rows[k]}, column '{clock.name}'"

    return _table(times, dates, numbers, columns, clock, every, missing, (f"{path}", where))


def read_json_lines(
    path: str | Path,
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Iterable[float] = (),
) -> Table:
    """Read channels from a file of JSON lines, one object with column -> value for each moment.

    Parameters
    ----------
    columns, clock, every, missing
        As for `read_csv`; a column that a line has not is missing there.

    Raises
    ------
    DataError
        No such file; no such column in any line; a line that is no object or has no time; no
        number in a channel; times that do not increase. The message names file and line.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read: {error}.") from error
    places = [f"{path}, line {k}" for k, line in enumerate(lines, start=1) if line.strip()]
    texts = [line for line in lines if line.strip()]
    rows = [_object(text, place) for text, place in zip(texts, places, strict=True)]
    if not rows:
        raise SampleError(f"{path}: holds no samples.")
    for row, place in zip(rows, places, strict=True):
        check_columns(place, [clock.name], list(row))
    needed = [name for column in columns.values() for name in column.names]
    check_columns(str(path), needed, [*dict.fromkeys(name for row in rows for name in row)])
    times, dates = _times([row[clock.name] for row in rows], clock, lambda k: f"{places[k]},")

    def numbers(name: str, use: Any) -> Array:
        return np.array([_number(rows[k].get(name), f"{places[k]}, '{name}'") for k in use])

    where = (str(path), places.__getitem__)
    return _table(times, dates, numbers, columns, clock, every, missing, where)


def tabulated(
    times: Iterable[Any],
    values: Mapping[str, Any],
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Iterable[float] = (),
    where: str = "data",
) -> Table:
    """Return channels of columns that are in memory already.

    Parameters
    ----------
    times
        Numbers, dates, or dates as text.
    values
        Column -> numbers, as many as there are times; NaN where missing.
    columns, clock, every, missing
        As for `read_csv`.
    where
        For messages: what the columns come from.

    Raises
    ------
    DataError
        No such column; another length; no finite number; times that do not increase.
    """
    moments = times.tolist() if hasattr(times, "tolist") else list(times)
    if not moments:
        raise SampleError(f"{where}: holds no samples.")
    needed = [name for column in columns.values() for name in column.names]
    check_columns(where, needed, list(values))
    found, dates = _times(moments, clock, lambda k: f"{where}, sample {k}, times")

    def numbers(name: str, use: Any) -> Array:
        try:
            column: Array = np.asarray(values[name], dtype=float)
        except (TypeError, ValueError):
            raise SampleError(f"{where}: column '{name}' does not hold numbers only.") from None
        if column.shape != (len(moments),):
            raise SampleError(
                f"{where}: column '{name}' has shape {column.shape}; there are {len(moments)} "
                "times."
            )
        infinite = np.flatnonzero(np.isinf(column))
        if len(infinite):
            raise SampleError(
                f"{where}: column '{name}' is infinite in sample {infinite[0]}; NaN is missing."
            )
        chosen: Array = column[use]
        return chosen

    def here(k: int) -> str:
        return f"{where}, sample {k}"

    return _table(found, dates, numbers, columns, clock, every, missing, (where, here))


def _table(
    times: Array,
    dates: bool,
    numbers: Callable[[str, Any], Array],
    columns: Mapping[str, Column],
    clock: Clock,
    every: int,
    missing: Iterable[float],
    where: tuple[str, Callable[[int], str]],
) -> Table:
    """Return the channels between start and stop; `numbers` gives the chosen rows of a column."""
    source, row = where
    low, high = clock.bounds(dates, source)
    use = np.flatnonzero((times >= low) & (times <= high))
    if not len(use):
        raise DataError(f"{source}: no row lies between start and stop; check both.")
    use = use[::every]
    late = np.flatnonzero(np.diff(times[use]) <= 0)
    if len(late):
        raise _disorder(row(int(use[late[0] + 1])))
    holes = tuple(float(number) for number in missing)
    names = dict.fromkeys(name for column in columns.values() for name in column.names)
    found = {name: numbers(name, use) for name in names}
    for name, column in found.items():
        found[name] = np.where(np.isin(column, holes), np.nan, column)
    values = np.column_stack(
        [
            column.factor * np.mean([found[name] for name in column.names], axis=0) + column.offset
            for column in columns.values()
        ]
        or [np.zeros((len(use), 0))]
    )
    remarks: dict[tuple[str, str], int] = {}
    kept = np.full(len(use), True)
    for k, (name, channel) in enumerate(columns.items()):
        low, high = channel.valid
        wrong = (values[:, k] < low) | (values[:, k] > high)
        values[wrong, k] = np.nan
        lacking = kept & np.isnan(values[:, k]) & channel.needed
        kept &= ~lacking
        remarks |= {("invalid", name): int(wrong.sum()), ("skipped", name): int(lacking.sum())}
    if not kept.any():
        raise DataError(f"{source}: no sample has all channels that it needs.")
    t, values, origin = times[use][kept], values[kept], None
    if dates:
        origin = datetime.fromtimestamp(float(t[0]) / clock.second, UTC).replace(tzinfo=None)
        t = t - t[0]
    told = {key: number for key, number in remarks.items() if number}
    return Table(t, values, tuple(columns), origin, told)


class JsonLines:
    """Samples from JSON lines, one object with column -> value for each moment, as they come."""

    def __init__(
        self,
        lines: Iterable[str],
        columns: Mapping[str, Column],
        clock: Clock,
        *,
        every: int = 1,
        missing: Iterable[float] = (),
        where: str = "standard input",
    ) -> None:
        self._lines = lines
        self._columns = columns
        self._clock = clock
        self._every = every
        self._missing = tuple(float(number) for number in missing)
        self._where = where
        self.origin: datetime | None = None

    def __iter__(self) -> Iterator[Sample]:
        clock, kept, last = self._clock, 0, -math.inf
        zero: float | None = None
        for number, line in enumerate(self._lines, start=1):
            if not line.strip():
                continue
            where = f"{self._where}, line {number}"
            row = _object(line, where)
            t, dates = row_time(row, clock, where)
            low, high = clock.bounds(dates, self._where)
            if t > high:
                return
            if t < low:
                continue
            kept += 1
            if (kept - 1) % self._every:
                continue
            if t <= last:
                raise _disorder(where)
            last = t
            if zero is None:
                zero = t if dates else 0.0
                if dates:
                    stamp = datetime.fromtimestamp(t / clock.second, UTC)
                    self.origin = stamp.replace(tzinfo=None)
            values = {
                channel: channel_value(column, row, self._missing, where)
                for channel, column in self._columns.items()
            }
            for channel, column in self._columns.items():
                low, high = column.valid
                if not low <= values[channel] <= high:
                    values[channel] = math.nan
            if not any(
                math.isnan(values[c]) for c, column in self._columns.items() if column.needed
            ):
                yield Sample(t - zero, values)


def row_time(row: Mapping[str, Any], clock: Clock, where: str = "row") -> tuple[float, bool]:
    """Return the time of a row in the model's unit, and whether it is a date (then since 1970)."""
    if clock.name not in row:
        raise SampleError(f"{where}: there is no '{clock.name}'{_hint(clock.name, list(row))}")
    times, dates = _times([row[clock.name]], clock, lambda _: f"{where},")
    return float(times[0]), dates


def channel_value(
    column: Column, row: Mapping[str, Any], missing: Collection[float], where: str = "row"
) -> float:
    """Return the value of a channel in a row, NaN if it is missing."""
    numbers = []
    for name in column.names:
        value = _number(row.get(name), f"{where}, '{name}'")
        numbers.append(math.nan if value in missing else value)
    return column.factor * sum(numbers) / len(numbers) + column.offset


def check_columns(where: str, needed: Iterable[str], known: list[str]) -> None:
    """Raise `SampleError` with a hint if a column is not there."""
    for name in needed:
        if name not in known:
            raise SampleError(f"{where}: there is no column '{name}'{_hint(name, known)}")


def _check_separator(path: Path, header: list[str], separator: str) -> None:
    """Refuse a header that another separator would divide."""
    if len(header) > 1:
        return
    for other in {",", ";", "\t"} - {separator}:
        if header and other in header[0]:
            raise SampleError(
                f"{path}: the header is one field with {separator!r} between fields, and "
                f"{header[0].count(other) + 1} with {other!r}: say separator = {other!r}."
            )


def _check_widths(path: Path, width: int, separator: str) -> None:
    """Refuse a row with more fields than the header: pandas would cut it without a word."""
    with path.open(newline="", encoding="utf-8") as file:
        for number, row in enumerate(csv.reader(file, delimiter=separator), start=1):
            if any(field.strip() for field in row[width:]):
                raise SampleError(
                    f"{path}, row {number}: {len(row)} fields, but the header has {width}; "
                    "decimals need a point, and fields with a comma in them quotes."
                )


def _object(line: str, where: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError) as error:
        reason = getattr(error, "msg", type(error).__name__)
        raise SampleError(f"{where}: is not JSON ({reason}).") from None
    if not isinstance(row, dict):
        raise SampleError(f"{where}: got {row!r}; expected an object, column -> value.")
    return row


def _number(value: Any, where: str) -> float:
    """Return a float, NaN if it is missing."""
    if value is None or (isinstance(value, str) and value.strip().lower() in MISSING):
        return math.nan
    try:
        if isinstance(value, bool):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise SampleError(
            f"{where}: got {value!r}; expected a number (leave it empty if it is missing)."
        ) from None
    if math.isinf(number):
        raise SampleError(
            f"{where}: got {value!r}; a channel must be finite (leave it empty if it is missing)."
        )
    return number


def _numbers(cells: Any, rows: Any, where: str, name: str) -> Array:
    """Return a column of text as numbers; its row is looked for only if one is wrong."""
    try:
        found: Array = np.array([c if c else "nan" for c in cells], dtype=float)
    except ValueError:
        found = np.full(len(cells), np.inf)
    if np.isinf(found).any():
        found = np.array(
            [
                _number(cell, f"{where}, row {row}, column '{name}'")
                for cell, row in zip(cells, rows, strict=True)
            ]
        )
    return found


def _times(cells: list[Any], clock: Clock, where: Callable[[int], str]) -> tuple[Array, bool]:
    """Return times in the model's unit, and whether they are dates; `where` names a cell."""
    first = cells[0]
    dates = isinstance(first, date) or (isinstance(first, str) and not _is_number(first))
    times = np.empty(len(cells))
    for k, cell in enumerate(cells):
        value = clock.stamp(cell) if dates else _float(cell)
        if value is None or not math.isfinite(value):
            raise SampleError(
                f"{where(k)} '{clock.name}': got {cell!r}; expected "
                + ("a date and time as 2025-04-01 12:00." if dates else "a number, as before.")
            )
        times[k] = value
    return times * (clock.second if dates else clock.factor), dates


def _float(cell: Any) -> float | None:
    try:
        return None if isinstance(cell, bool) else float(cell)
    except (TypeError, ValueError, OverflowError):
        return None


def _is_number(cell: str) -> bool:
    return _float(cell) is not None


def _whole_day(value: Any) -> bool:
    if isinstance(value, str):
        return len(value.strip()) == len("2025-04-01")
    return isinstance(value, date) and not isinstance(value, datetime)


def _disorder(where: str) -> TimeOrderError:
    return TimeOrderError(
        f"{where}: the time is not later than the one before; sort the rows and drop repeated ones."
    )


def _hint(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; there are {', '.join(known[:12])}{', ...' if len(known) > 12 else ''}."
