"""The data of a case: which file, which times."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, tzinfo
from functools import partial
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from livepde.cases.case_frame import Frame
from livepde.cases.code import check_options, load_code
from livepde.cases.schema import CaseSpec, DataSpec, FileSpec
from livepde.cases.units import conversion
from livepde.errors import LivepdeError
from livepde.streams import (
    Clock,
    Column,
    DataTable,
    JsonLines,
    read_csv,
    read_json_lines,
    tabulated,
)
from livepde.streams.clock import since_1970
from livepde.streams.csvfile import header_of
from livepde.streams.gaps import fill_table
from livepde.streams.join import join_tables
from livepde.streams.table import JSON_LINES, no_file

__all__ = [
    "assimilation_start",
    "check_hours",
    "clock_of",
    "data_file",
    "read_data",
    "reader_of",
    "without_gaps",
]

DATE = re.compile(r"\s*\d{4}-\d{2}-\d{2}")
VARIABLE = "${LIVEPDE_DATA}"


def clock_of(frame: Frame, data: DataSpec | None = None) -> Clock:
    """Return how times are read, by default those of `[data]`."""
    data, unit = data or frame.spec.data, frame.equation.time_unit
    rule = conversion(data.time_unit or unit, unit, frame.where("data.time_unit"))
    second = conversion("s", unit, frame.where("data.time")).factor if unit else 1.0
    start, stop = _instant(frame, data.start, "start"), _instant(frame, data.stop, "stop")
    return Clock(
        data.times[0],
        rule.factor,
        start,
        stop,
        second,
        zone=_zone(frame),
        format=data.time_format,
        decimal=data.decimal,
        hour="".join(data.times[1:]),
    )


def _zone(frame: Frame) -> tzinfo:
    """Return the zone of dates that name none."""
    name = frame.spec.data.zone
    try:
        return ZoneInfo(name)
    except (KeyError, OSError, ValueError):  # not found, a folder, not a name at all
        text = f"there is no time zone '{name}'; expected a name as Europe/Berlin."
        raise frame.error("data.zone", text) from None


def _instant(frame: Frame, value: Any, key: str) -> Any:
    """Return a date as it is, a quantity in the model's unit."""
    if isinstance(value, str) and not DATE.match(value):
        return frame.convert(value, frame.equation.time_unit, f"data.{key}")
    return value


def read_data(
    frame: Frame,
    columns: Mapping[str, Column],
    clock: Clock,
    source: str | Iterable[str] | None,
) -> DataTable | JsonLines:
    """Return the data: of the case's file, another file, or lines of JSON as they come."""
    spec = frame.spec.data
    if source is None and isinstance(spec.file, tuple):
        return _joined(frame, spec.file, columns)
    check_hours(frame, clock, spec.file if source is None else source)
    if not isinstance(source, str | None):
        return JsonLines(source, columns, clock, every=spec.every, missing=spec.missing)
    if source is None and frame.reader is not None:
        return _from_reader(frame, frame.reader, columns, clock)
    return _read(data_file(frame) if source is None else Path(source), columns, clock, spec)


def check_hours(frame: Frame, clock: Clock, source: Any) -> None:
    """Refuse times in two columns of a source that is no CSV file."""
    ending = Path(source).suffix if isinstance(source, str) else ""
    if clock.hour and ending in ("", ".parquet", *JSON_LINES):
        text = "times in two columns are read from CSV files only: join them in one column."
        raise frame.error("data.time", text)


def _read(path: Path, columns: Mapping[str, Column], clock: Clock, spec: DataSpec) -> DataTable:
    """Return the data of a file, whose ending tells its format."""
    if path.suffix in JSON_LINES:
        return read_json_lines(path, columns, clock, every=spec.every, missing=spec.missing)
    if path.suffix == ".parquet":
        from livepde.streams.parquet import read_parquet

        return read_parquet(path, columns, clock, every=spec.every, missing=spec.missing)
    return read_csv(
        path,
        columns,
        clock,
        every=spec.every,
        missing=spec.missing,
        separator=spec.separator,
        encoding=spec.encoding,
        skip=spec.skip,
    )


def _joined(frame: Frame, files: Sequence[FileSpec], columns: Mapping[str, Column]) -> DataTable:
    """Return several files as one table, joined by time; each channel comes from one of them."""
    specs = [frame.spec.data.of(file) for file in files]
    paths = [_found(frame, str(spec.file)) for spec in specs]
    headers = list(map(partial(_header, frame), specs, paths))
    owners = {name: _owner(frame, name, one, paths, headers) for name, one in columns.items()}
    tables = []
    for k, (spec, path) in enumerate(zip(specs, paths, strict=True)):
        # Which rows are needed is decided once they are joined.
        own = {
            name: replace(column, decimal=spec.decimal, needed=False)
            for name, column in columns.items()
            if owners[name] == k
        }
        if not own:
            raise frame.error("data.file", f"no channel has a column of {path}; leave it out.")
        tables.append(_read(path, own, clock_of(frame, spec), spec))
    second = clock_of(frame).second
    sensors = frame.roles("sensor", "withheld")
    needed = [name for name, column in columns.items() if column.needed]
    return join_tables(tables, second, sensors, needed, frame.where("data.file"))


def _owner(
    frame: Frame, name: str, column: Column, paths: Sequence[Path], headers: Sequence[list[str]]
) -> int:
    """Return the number of the one file that has a column."""
    places = [k for k, header in enumerate(headers) if set(column.names) <= set(header)]
    if len(places) == 1:
        return places[0]
    what = " and ".join(map(repr, column.names))
    text = f"no file has the column {what}; the files are {', '.join(map(str, paths))}."
    if places:
        both = " and ".join(str(paths[k]) for k in places)
        text = f"{both} have a column {what} each; rename one."
    raise frame.error(f"channels.{column.noise_of or name}", text)


def _header(frame: Frame, spec: DataSpec, path: Path) -> list[str]:
    """Return the names of the columns of one of several files."""
    if path.suffix in (".parquet", *JSON_LINES):
        raise frame.error("data.file", f"{path} is no CSV file; only these are joined.")
    return header_of(path, spec.separator, spec.encoding, spec.skip)


def without_gaps(frame: Frame, table: DataTable) -> DataTable:
    """Return a finished record without gaps and spikes of the channels that drive the model."""
    channels = frame.spec.channels
    interpolated = [name for name, item in channels.items() if item.gaps == "interpolate"]
    screened = [name for name, item in channels.items() if item.screened]
    return fill_table(table, interpolated, screened)


def reader_of(spec: CaseSpec, folder: Path, where: str, allow_code: bool) -> Any:
    """Return the function that reads the data; None if a file holds them."""
    if spec.data.reader is None:
        return None
    expected = "(folder, **options) -> times, {column: values}"
    key = f"{where}: data.reader"
    found = load_code(spec.data.reader, folder, key, expected, allow_code)
    check_options(found, spec.data.options, f"{where}: data.options")
    return found


def _from_reader(
    frame: Frame, reader: Callable[..., Any], columns: Mapping[str, Column], clock: Clock
) -> DataTable:
    """Return the data of the user's function: times, and a mapping from column to values."""
    spec, where = frame.spec.data, frame.where(f"data.reader: {frame.spec.data.reader}")
    folder = _measurements(frame)
    try:
        found = reader(folder or frame.path.parent, **spec.options)
    except LivepdeError:
        raise
    except FileNotFoundError as error:
        raise frame.error(
            "data.reader", f"there is no file '{error.filename}'.{_unset(folder)}"
        ) from None
    except Exception as error:
        text = f"{spec.reader} failed with {type(error).__name__}: {error}."
        raise frame.error("data.reader", text) from error
    match found:
        case (times, Mapping() as values):
            pass
        case _:
            text = f"{spec.reader} returned {type(found).__name__}; expected times and a mapping "
            raise frame.error("data.reader", text + "from column to values.")
    return tabulated(
        times, values, columns, clock, every=spec.every, missing=spec.missing, where=where
    )


def _unset(folder: Path | None) -> str:
    remedy = f" {VARIABLE} is not set; set it to the folder that holds the measurements."
    return "" if folder else remedy


def data_file(frame: Frame) -> Path:
    """Return the data file; relative names start at the case file."""
    given = frame.spec.data.file
    if given is None:
        raise frame.missing("data.file", "name one, or add --data to the command.")
    if not isinstance(given, str):
        text = "several files are joined for 'check' and 'run' of a complete record; a process is "
        raise frame.error("data.file", text + "followed in one: name it, or join them first.")
    return _found(frame, given)


def _found(frame: Frame, given: str) -> Path:
    """Return where a file of the case is; relative names start at the case file."""
    if VARIABLE in given:
        given = given.replace(VARIABLE, str(_data_folder(frame)))
    path = frame.path.parent / Path(given).expanduser()
    if not path.is_file() and not frame.spec.data.follow:
        raise frame.error("data.file", str(no_file(path)))
    return path


def _data_folder(frame: Frame) -> Path:
    folder = _measurements(frame)
    if folder is None:
        raise frame.error(
            "data.file",
            f"{VARIABLE} is not set; set the environment variable LIVEPDE_DATA to the folder that "
            "holds the measurements.",
        )
    return folder


def _measurements(frame: Frame) -> Path | None:
    """Return the folder of measurements that several cases share, if there is one."""
    named = os.environ.get("LIVEPDE_DATA")
    if named:
        return Path(named).absolute()
    for base in (Path.cwd(), *frame.path.absolute().parents):
        folder = base.parent / "shared" / "data"
        if folder.is_dir():
            return folder
    return None


def assimilation_start(frame: Frame, clock: Clock, origin: datetime | None) -> float:
    """Return the model time from which sensors are assimilated."""
    value = _instant(frame, frame.spec.data.assimilate_from, "assimilate_from")
    if value is None:
        return float(-np.inf)
    if isinstance(value, float | int):
        return float(value)
    if origin is None:
        text = f"got the date {value}; the times of the data are numbers."
        raise frame.error("data.assimilate_from", text)
    stamp = clock.stamp(value)
    if stamp is None:
        text = f"got '{value}'; expected a date as 2025-04-01 12:00."
        raise frame.error("data.assimilate_from", text)
    return (stamp - since_1970(origin)) * clock.second
