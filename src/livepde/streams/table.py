"""Samples from JSON lines (a file or a stream), Parquet files, and columns in memory."""

from __future__ import annotations

import difflib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from datetime import UTC, datetime
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from livepde.dates import origin_at
from livepde.errors import DataError, SampleError, TimeOrderError, optional
from livepde.linalg import Array, IntArray, Mask
from livepde.samples import Sample
from livepde.stepping import Between
from livepde.streams.cells import Missing, cell_number, has_decimal_comma, number_of
from livepde.streams.clock import Clock, is_naive, read_times, with_second_passes
from livepde.streams.thinned import Thinned

HOUR = 3600.0  # seconds by which clocks are set back in autumn
JSON_LINES = (".jsonl", ".ndjson")  # suffixes of files of JSON lines
STREAM = "standard input"
MOST = 12  # largest number of names in a message
# Suffixes of data files. The columns of other files, which a case may name, are not listed.
SHOWN = (".csv", ".txt", ".tsv", ".tab", ".dat", ".asc", ".log", ".jsonl", ".ndjson", ".parquet")


@dataclass(frozen=True)
class Column:
    """Columns and scale of a channel: value = factor * (mean of the columns) + offset.

    If one of several columns has a missing value, the channel also has.

    Attributes
    ----------
    valid
        Range of valid values; other values count as missing.
    needed
        Whether samples without this channel are left out.
    decimal
        Decimal mark of numbers as text: "." or ",".
    noise_of
        Channel whose readings have the standard deviations in this column; "": none. If a value is
        not positive, the reading is missing. If it is missing, the noise of the sensor is used.
    between
        Behaviour of the channel between two readings. Rows that are left out still supply the
        values of channels that are not a "line".
    """

    names: tuple[str, ...]
    factor: float = 1.0
    offset: float = 0.0
    valid: tuple[float, float] = (-math.inf, math.inf)
    needed: bool = False
    decimal: str = "."
    noise_of: str = ""
    between: Between = "line"


def decimal_marks(columns: Mapping[str, Column]) -> dict[str, str]:
    """Return the decimal mark of each column of the channels, by name."""
    return {name: column.decimal for column in columns.values() for name in column.names}


@dataclass(frozen=True, eq=False)
class DataTable:
    """Checked samples in memory; an iterable of `Sample`.

    Attributes
    ----------
    t
        Times in the model's unit, shape (samples,); dates count from the first sample.
    values
        Channel values, NaN where missing, shape (samples, channels).
    names
        Names of the channels.
    origin
        Date of the first sample if times are dates, else None.
    remarks
        (kind, channel) -> number of invalid values ("invalid"), of readings without their own noise
        ("missing"), of samples left out since a needed channel is missing ("skipped"), or, with an
        empty channel, of rows that repeat the row before ("repeated").
    """

    t: Array
    values: Array
    names: tuple[str, ...]
    _: KW_ONLY
    origin: datetime | None = None
    remarks: Mapping[tuple[str, str], int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)

    def __iter__(self) -> Iterator[Sample]:
        for t, row in zip(self.t.tolist(), self.values.tolist(), strict=True):
            yield Sample(t=t, z=dict(zip(self.names, row, strict=True)))


def read_json_lines(
    path: str | Path,
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Missing = (),
) -> DataTable:
    """Read channels from a file of JSON lines, one object with column -> value for each time.

    Parameters
    ----------
    columns, clock, every, missing
        See `read_csv`; a column that is absent in a line has a missing value.

    Raises
    ------
    DataError
        The file does not exist; no line has a column; a line is not an object or has no time; a
        channel is not a number; times do not increase. The message names file and line.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").split("\n")
    except FileNotFoundError:
        raise no_file(Path(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read: {error}.") from error
    numbered = {k: line for k, line in enumerate(lines, start=1) if line.strip()}
    places = [f"{path}, line {k}" for k in numbered]
    rows = list(map(_object, numbered.values(), places))
    if not rows:
        raise SampleError(f"{path}: contains no samples.")
    for row, place in zip(rows, places, strict=True):
        check_columns(place, [clock.name], list(row))
    decimals = decimal_marks(columns)
    check_columns(str(path), decimals, [*dict.fromkeys(chain(*rows))])
    cells = [row[clock.name] for row in rows]
    times, dates = read_times(cells, clock, lambda k: f"{places[k]},")
    written = cells if dates else None

    def numbers(name: str, use: Any) -> Array:
        texts = ((rows[k].get(name), f"{places[k]}, '{name}'", decimals[name]) for k in use)
        return np.array([cell_number(*text, missing) for text in texts])

    where = (str(path), places.__getitem__)
    return to_table(times, written, numbers, columns, clock, every, missing, where)


def tabulated(
    times: Iterable[Any],
    values: Mapping[str, Any],
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Missing = (),
    where: str = "data",
) -> DataTable:
    """Return a table of channels from columns in memory.

    Parameters
    ----------
    times
        Numbers, dates, or dates as text.
    values
        Column -> numbers, one for each time, NaN where missing.
    columns, clock, every, missing
        See `read_csv`.
    where
        Name of the data, for messages.

    Raises
    ------
    DataError
        A column is missing, has a wrong length, text or infinity; times do not increase.
    """
    moments = times.tolist() if hasattr(times, "tolist") else list(times)
    if not moments:
        raise SampleError(f"{where}: contains no samples.")
    check_columns(where, decimal_marks(columns), list(values))
    found, dates = read_times(moments, clock, lambda k: f"{where}, sample {k}, times")

    def numbers(name: str, use: Any) -> Array:
        given = values[name]
        try:
            # NumPy would convert a date to nanoseconds, and drop an imaginary part.
            if getattr(getattr(given, "dtype", None), "kind", "") in ("m", "M", "c"):
                raise TypeError
            if hasattr(given, "iloc"):  # in pandas, a missing value need not be a float
                given = given.to_numpy(dtype=float, na_value=np.nan)
            column: Array = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            raise SampleError(
                f"{where}: column '{name}' must contain numbers only{_first_text(given)}"
            ) from None
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

    written = moments if dates else None
    return to_table(found, written, numbers, columns, clock, every, missing, (where, here))


def _first_text(column: Any) -> str:
    """Return the end of the message on the first text in a column that is not a number."""
    cells = column.tolist() if hasattr(column, "tolist") else list(column)
    texts = (cell for cell in cells if isinstance(cell, str) and number_of(cell) is None)
    for text in texts:
        if has_decimal_comma(text):
            return f"; got {text!r}: read the table with decimal=',', or replace the commas."
        return f"; got {text!r:.60}."
    return "."


def to_table(
    times: Array,
    written: Sequence[Any] | None,
    numbers: Callable[[str, Any], Array],
    columns: Mapping[str, Column],
    clock: Clock,
    every: int,
    missing: Missing,
    where: tuple[str, Callable[[int], str]],
) -> DataTable:
    """Return the table of the channels between start and stop.

    `written`: the cells of dates, None if times are numbers. `numbers`: function that returns the
    chosen rows of a column. `where`: name of the data, and function that returns that of a row.
    """
    dates, repeats = written is not None, partial(_repeats, numbers, columns)
    if written is not None:
        times = with_second_passes(
            times, written, clock, lambda *pair: bool(repeats(*np.array(pair)[:, None]).all())
        )
    rows = Thinned([column.between for column in columns.values()])
    # Rows that are left out may contain a switch or a part of a mean.
    stride = rows.stride(every)
    inside = _inside(times, dates, clock, where[0])
    use = _once(times, inside, clock if dates else None, repeats)
    repeated = len(inside) - len(use)
    use = _increasing(times, use[::stride], clock if dates else None, where[1])
    holes = tuple(one for one in missing if not isinstance(one, str))

    def scaled(column: Column, of: IntArray) -> Array:
        parts = [numbers(name, of) for name in column.names]
        parts = [np.where(np.isin(part, holes), np.nan, part) for part in parts]
        value: Array = column.factor * np.mean(parts, axis=0) + column.offset
        return value

    # Shape (samples, channels), where the number of channels may be 0.
    values = np.column_stack(
        [scaled(column, use) for column in columns.values()] or [np.zeros((len(use), 0))]
    )
    remarks = Counter(_noise_remarks(columns, values)) + Counter({("repeated", ""): repeated})
    chosen = np.zeros(len(use), dtype=bool)
    chosen[:: every // stride] = True
    kept = _complete(columns, values, chosen, remarks)
    if not kept.any():
        raise DataError(f"{where[0]}: no sample has all channels that it needs.")
    if rows.held.any():
        rows.remember(_known_before(int(use[0]), columns, scaled))
        values, kept = _with_held(times[use], values, rows, chosen, kept)
    t, values, origin = times[use][kept], values[kept], None
    if dates:
        origin = origin_at(float(t[0]) / clock.second)
        t = t - t[0]
    remarks = +remarks  # drops counts of zero
    return DataTable(t, values, tuple(columns), origin=origin, remarks=remarks)


def _repeats(
    numbers: Callable[[str, Any], Array], columns: Mapping[str, Column], one: Any, other: Any
) -> Mask:
    """Return which rows `one` have the values of the rows `other`; both are row numbers."""
    rows = np.concatenate([one, other])
    found = np.ones(len(one), dtype=bool)
    for a, b in (np.split(numbers(name, rows), 2) for name in decimal_marks(columns)):
        found &= (a == b) | (np.isnan(a) & np.isnan(b))
    return found


def _complete(
    columns: Mapping[str, Column], values: Array, chosen: Mask, remarks: Counter[tuple[str, str]]
) -> Mask:
    """Set invalid values to NaN; return which chosen samples have all needed channels.

    `remarks` counts invalid values, and each incomplete sample for its first missing channel.
    """
    kept = chosen.copy()
    for k, (name, channel) in enumerate(columns.items()):
        low, high = channel.valid
        wrong = (values[:, k] < low) | (values[:, k] > high)
        values[wrong, k] = np.nan
        lacking = kept & np.isnan(values[:, k]) & channel.needed
        kept &= ~lacking
        remarks["invalid", name] += int((wrong & chosen).sum())
        remarks["skipped", name] = int(lacking.sum())
    return kept


def _inside(times: Array, dates: bool, clock: Clock, source: str) -> IntArray:
    """Return the numbers of the rows between start and stop."""
    low, high = clock.bounds(dates, source)
    use = np.flatnonzero((times >= low) & (times <= high))
    if not len(use):
        raise DataError(f"{source}: no row lies between start and stop; check both.")
    return use


def _once(
    times: Array, use: IntArray, clock: Clock | None, repeats: Callable[[Any, Any], Mask]
) -> IntArray:
    """Return the rows without those that have the time and values of the row before.

    In an hour that clocks repeat, such a row may be a new reading. `clock`: None for numbers.
    """
    again = np.flatnonzero(np.diff(times[use]) == 0.0)
    if clock is not None:
        once = [clock.repeated_hour(t) == 0.0 for t in times[use[again]].tolist()]
        again = again[np.array(once, dtype=bool)]
    again = again[repeats(use[again], use[again + 1])]
    return np.delete(use, again + 1)


def _increasing(
    times: Array, use: IntArray, clock: Clock | None, row: Callable[[int], str]
) -> IntArray:
    """Return the rows after checking that their times increase; `clock`: None for numbers."""
    late = np.flatnonzero(np.diff(times[use]) <= 0)
    if len(late):
        last, t = times[use[late[0] : late[0] + 2]]
        raise _disorder(row(int(use[late[0] + 1])), t, last, clock)
    return use


def _known_before(
    first: int, columns: Mapping[str, Column], scaled: Callable[[Column, IntArray], Array]
) -> Array:
    """Return the last value of each "hold" channel before a row, else NaN, shape (channels,)."""
    found = np.full(len(columns), math.nan)
    for k, column in enumerate(columns.values()):
        if column.between == "hold" and first:
            values = scaled(column, np.arange(first))
            low, high = column.valid
            known = values[(values >= low) & (values <= high)]
            found[k] = known[-1] if len(known) else math.nan
    return found


def _with_held(
    t: Array, values: Array, rows: Thinned, chosen: Mask, kept: Mask
) -> tuple[Array, Mask]:
    """Return values with held inputs of all rows, and the mask of the rows that are kept.

    `chosen`: rows selected by `every`. `kept`: chosen rows that have all needed channels.
    """
    found, stays = values.copy(), kept.copy()
    # If no row is left out, only the first row may get values, from rows before it.
    count = 1 if kept.all() else len(t)
    for k, time in enumerate(t[:count].tolist()):
        row = rows.take(time, values[k], chosen=bool(chosen[k]), whole=bool(kept[k]))
        stays[k] = row is not None
        if row is not None:
            found[k] = row
    return found, stays


def _noise_remarks(columns: Mapping[str, Column], values: Array) -> dict[tuple[str, str], int]:
    """Remove readings whose noise is not positive; count these, and readings without noise."""
    remarks, places = {}, {name: k for k, name in enumerate(columns)}
    for name, column in columns.items():
        if not column.noise_of:
            continue
        # These are views, so that NaN is set in `values`.
        noise, reading = values[:, places[name]], values[:, places[column.noise_of]]
        wrong = noise <= 0.0
        remarks["invalid", column.noise_of] = int((wrong & np.isfinite(reading)).sum())
        noise[wrong] = reading[wrong] = np.nan
        remarks["missing", name] = int((np.isnan(noise) & np.isfinite(reading)).sum())
    return remarks


def without_noise(columns: Mapping[str, Column], values: dict[str, float]) -> list[str]:
    """Remove readings of a sample whose noise is not positive; return their channels."""
    refused = []
    for name, column in columns.items():
        if column.noise_of and values.get(name, math.nan) <= 0.0:
            values[name] = values[column.noise_of] = math.nan
            refused.append(column.noise_of)
    return refused


@dataclass(eq=False, repr=False)
class JsonLines:
    """Stream of samples from JSON lines, one object with column -> value for each time.

    `origin`: date of the first sample if times are dates, else None.
    """

    lines: Iterable[str]
    columns: Mapping[str, Column]
    clock: Clock
    _: KW_ONLY
    every: int = 1
    missing: Missing = ()
    origin: datetime | None = field(default=None, init=False)

    def __iter__(self) -> Iterator[Sample]:
        clock, last, zero = self.clock, -math.inf, 0.0
        first: dict[float, Array] = {}  # rows of an hour that clocks show twice
        needed = np.array([column.needed for column in self.columns.values()], dtype=bool)
        thinned = Thinned([column.between for column in self.columns.values()])
        stride = thinned.stride(self.every)
        rows = islice(self._timed_rows(thinned), 0, None, stride)
        for k, (where, row, t, dates) in enumerate(rows):
            values, dated = self._values(row, where), clock if dates else None
            t += _second_pass(t, last, row.get(clock.name), values, first, dated)
            if t <= last:
                raise _disorder(where, t, last, dated)
            if dates and math.isinf(last):  # the first sample is t = 0
                zero = t
                self.origin = origin_at(t / clock.second)
            last, chosen = t, k % (self.every // stride) == 0
            whole = not np.isnan(values[needed]).any()
            left = thinned.take(t, values, chosen=chosen, whole=whole)
            if left is not None:
                yield Sample(t=t - zero, z=dict(zip(self.columns, left.tolist(), strict=True)))

    def _values(self, row: Mapping[str, Any], where: str) -> Array:
        """Return the values of the channels in a row, NaN where they are missing or invalid."""
        values = {}
        for channel, column in self.columns.items():
            value = channel_value(column, row, self.missing, where)
            low, high = column.valid
            values[channel] = value if low <= value <= high else math.nan
        without_noise(self.columns, values)
        return np.array(list(values.values()))

    def _timed_rows(self, thinned: Thinned) -> Iterator[tuple[str, dict[str, Any], float, bool]]:
        """Yield the rows between start and stop: name, row, time, and whether it is a date.

        `thinned` stores held values of rows before start. The first row after stop ends the
        iteration, since the stream may be endless.
        """
        dates = None
        for number, line in enumerate(self.lines, start=1):
            if not line.strip():
                continue
            where = f"{STREAM}, line {number}"
            row = _object(line, where)
            t, dates = row_time(row, self.clock, where, dates)
            low, high = self.clock.bounds(dates, STREAM)
            if t > high:
                return
            if t >= low:
                yield where, row, t, dates
            elif thinned.held.any():
                thinned.remember(self._values(row, where))


def _second_pass(
    t: float, last: float, cell: Any, values: Array, first: dict[float, Array], clock: Clock | None
) -> float:
    """Return the correction of a row's time in the second pass of an hour that clocks repeat.

    `first`: time -> values in the first pass of such an hour. `clock`: None for numbers.
    """
    again = clock.repeated_hour(t) if clock is not None and is_naive(cell, clock) else 0.0
    if not again:
        first.clear()
    elif t <= last and not np.array_equal(first.get(t, ()), values, equal_nan=True):
        return again
    else:
        first[t] = values
    return 0.0


def row_time(
    row: Mapping[str, Any], clock: Clock, where: str = "row", before: bool | None = None
) -> tuple[float, bool]:
    """Return the time of a row in the model's unit, since 1970 for dates, and whether it is one.

    `before`: whether the times of earlier rows were dates.
    """
    if clock.name not in row:
        raise SampleError(f"{where}: there is no '{clock.name}'{hint(clock.name, list(row))}")
    times, dates = read_times([row[clock.name]], clock, lambda _: f"{where},", before)
    return float(times[0]), dates


def channel_value(
    column: Column, row: Mapping[str, Any], missing: Missing, where: str = "row"
) -> float:
    """Return the value of a channel in a row, or NaN."""
    places = ((name, f"{where}, '{name}'") for name in column.names)
    numbers = [cell_number(row.get(n), place, column.decimal, missing) for n, place in places]
    # NaN if one of the columns is missing.
    return column.factor * sum(numbers) / len(numbers) + column.offset


def _object(line: str, where: str) -> dict[str, Any]:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError) as error:
        reason = getattr(error, "msg", type(error).__name__)
        raise SampleError(f"{where}: is not JSON ({reason}).") from None
    if not isinstance(row, dict):
        raise SampleError(f"{where}: got {row!r}; expected an object, column -> value.")
    return row


def _disorder(where: str, t: float, last: float, clock: Clock | None) -> TimeOrderError:
    """Return the error for a time that is not later than the last; `clock`: None for numbers."""
    how, remedy = "earlier than the one before", "sort the rows."
    if t == last:
        how, remedy = "that of the one before", "drop repeated rows."
        if clock is not None:
            remedy += " If each row is a reading of one sensor, set `data.sensor` and `data.value`."
    if clock is not None and clock.zone is UTC and last - t <= HOUR * clock.second:
        zone = "`data.zone`, such as 'Europe/Berlin'"
        remedy += f" If clocks were set back here, set {zone}."
    if clock is not None and clock.repeated_hour(t):
        remedy = (
            "if clocks were set back, write dates with an offset, such as 2025-10-26 02:30+01:00."
        )
    return TimeOrderError(f"{where}: the time is {how}; {remedy}")


def check_columns(
    where: str, needed: Iterable[str], known: list[str], *, told: bool = True
) -> None:
    """Raise `SampleError` if a column is missing; `told`: whether it lists existing columns."""
    for name in needed:
        if name not in known:
            ending = hint(name, known) if told else "."
            raise SampleError(f"{where}: there is no column '{name}'{ending}")


def hint(name: str, known: list[str]) -> str:
    """Return the end of a message: the closest name, or the known names."""
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    if not known:
        return "."
    return f"; there are {', '.join(known[:MOST])}{', ...' if len(known) > MOST else ''}."


def no_file(path: Path) -> DataError:
    """Return the error for a missing file, with a hint at similar files."""
    if not path.parent.is_dir():
        return DataError(f"there is no file '{path}': there is no folder '{path.parent}'.")
    below = sorted(path.parent.glob(f"*/{path.name}"))
    if below:
        return DataError(f"there is no file '{path}'; did you mean '{below[0]}'?")
    known = sorted(item.name for item in path.parent.glob(f"*{path.suffix}") if item.is_file())
    return DataError(f"there is no file '{path}'{hint(path.name, known)}")


@contextmanager
def parquet_file(path: str | Path) -> Iterator[Any]:
    """Open a Parquet file; raises `DataError` if it does not exist or cannot be read."""
    with optional("parquet", "Parquet files need pyarrow", DataError):
        import pyarrow as pa
        from pyarrow.parquet import ParquetFile
    try:
        with ParquetFile(path) as file:
            yield file
    except FileNotFoundError:
        raise no_file(Path(path)) from None
    except (OSError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0].rstrip(".")
        raise DataError(f"{path} cannot be read as a Parquet file: {reason}.") from error


def read_parquet(
    path: str | Path,
    columns: Mapping[str, Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Missing = (),
) -> DataTable:
    """Read channels from a Parquet file, of which only the needed columns are loaded.

    `columns`, `clock`, `every`, `missing`: see `read_csv`; the time column may also contain dates
    with or without a time zone.
    Raises `DataError`: the file or a column does not exist; the file is not Parquet; a channel
    contains text; times do not increase. The message names file, sample and column.
    """
    where = str(path)
    names = decimal_marks(columns)
    needed = [clock.name, *(name for name in names if name != clock.name)]
    with parquet_file(path) as file:
        check_columns(where, needed, file.schema_arrow.names)
        frame = file.read(columns=needed)
    values = {name: _numbers(frame.column(name), where, name) for name in names}
    times = frame.column(clock.name).to_pylist()
    return tabulated(times, values, columns, clock, every=every, missing=missing, where=where)


def _numbers(column: Any, where: str, name: str) -> Array:
    """Convert a column to numbers, NaN where missing."""
    from pyarrow import float64, types

    kind = column.type
    tests = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
    if not any(test(kind) for test in tests):
        raise SampleError(f"{where}: column '{name}' is of type {kind}; expected numbers.")
    numbers: Array = column.cast(float64(), safe=False).to_numpy()
    return numbers
