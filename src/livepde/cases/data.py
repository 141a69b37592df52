"""Data of a case: files, clock, live sources, and destinations of estimates."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias
from zoneinfo import ZoneInfo

import numpy as np
from pydantic import TypeAdapter, ValidationError

from livepde.cases.case_channels import columns_of, interpolates, profile_sensors
from livepde.cases.case_content import CaseContent, check_options, load_code, own_code
from livepde.cases.data_schema import BrokerSpec, DataSpec, FileSpec, NodesSpec
from livepde.cases.schema import SENSORS, CaseSpec
from livepde.cases.values import MissingValue
from livepde.dates import since_1970
from livepde.errors import CaseError
from livepde.runs.backlog import Backlog, Retention, Sink
from livepde.streams import (
    Clock,
    Column,
    DataTable,
    JsonLines,
    read_csv,
    read_json_lines,
    tabulated,
)
from livepde.streams.csvfile import header_of, read_long_csv
from livepde.streams.gaps import fill_table
from livepde.streams.intake import Habit, Policy
from livepde.streams.mqtt import Broker, MqttSink, MqttSource
from livepde.streams.oddities import wild_first_rows
from livepde.streams.sources import Follow, Lines, RowSource
from livepde.streams.table import JSON_LINES, no_file, read_parquet
from livepde.units import conversion, other_time_unit

if TYPE_CHECKING:
    from livepde.streams.opcua import OpcuaServer

DATE = re.compile(r"\s*\d{4}-\d{2}-\d{2}")
VARIABLE = "${LIVEPDE_DATA}"
UNSET = (
    f"{VARIABLE} is not set; set the environment variable LIVEPDE_DATA to the folder that contains "
    "the measurements."
)
PASSWORDS = "LIVEPDE_"  # prefix of environment variables that a case may use as passwords
TOKEN = "LIVEPDE_TOKEN"  # grants access to the page and /health; never sent to a server
LOG = logging.getLogger("livepde.run")
FAR = 3.0  # gap to the other values of a row, in their ranges, above which a value is suspect
START = "start"  # kind of remark on outliers in the first rows
BEGIN = "begin"  # kind of remark on rows before the first value of an input
LATE = (
    "late requires complete data. For a live source, delay the other channels at the source, or "
    "correct the clock."
)
SAME = 1e-9  # tolerance for equal times, as a share of the length of a record
MOMENT = 1e-6  # seconds, to which dates are rounded
LEAP = "30 d"  # default pause after which a second row has to confirm the time
Data: TypeAlias = str | Iterable[str] | RowSource | None  # None: the source in the case file


def zone_named(name: str, where: str) -> tzinfo:
    """Return the time zone with a name; raises `CaseError` if it does not exist."""
    if name == "UTC":
        return UTC
    try:
        return ZoneInfo(name)
    except (KeyError, OSError, ValueError):  # unknown name, folder, invalid name
        text = f"there is no time zone '{name}'; expected a name such as Europe/Berlin."
        raise CaseError(f"{where}: {text}") from None


def missing_in(given: Any, where: str) -> tuple[float | str, ...]:
    """Return the checked numbers and texts that mark missing values; raises `CaseError`."""
    try:
        return TypeAdapter(tuple[MissingValue, ...]).validate_python(given or ())
    except ValidationError:
        text = f'got {given!r}; expected a list such as [-9999, "OVER"].'
        raise CaseError(f"{where}: {text}") from None


def since_when(unit: str, where: str) -> tuple[str, datetime | None]:
    """Return a time unit, and its reference date or None; raises `CaseError`.

    >>> since_when("d since 1899-12-30", "data.time_unit")
    ('d', datetime.datetime(1899, 12, 30, 0, 0))
    >>> since_when("hours since 1990-1-1 0:0:0 UTC", "data.time_unit")
    ('hours', datetime.datetime(1990, 1, 1, 0, 0, tzinfo=datetime.timezone.utc))
    """
    unit, since, origin = unit.partition(" since ")
    # The CF conventions also allow single digits and the name of the zone.
    padded = re.sub(r"(?<![\d.])\d(?!\d)", "0\\g<0>", origin.strip())
    date = re.sub(r"\s*(UTC|GMT|Z)$", "+00:00" if ":" in padded else "", padded)
    try:
        return unit.strip(), datetime.fromisoformat(date) if since else None
    except ValueError:
        text = f"got 'since {origin}'; expected a date, as in 'd since 1899-12-30'."
        raise CaseError(f"{where}: {text}") from None


def clock_of(case: CaseContent, data: DataSpec | None = None) -> Clock:
    """Return the clock that reads times according to `data`, by default the table `[data]`."""
    data, unit = data or case.spec.data, case.equation.time_unit
    where = case.where("data.time_unit")
    second = conversion("s", unit, case.where("data.time")).factor if unit else 1.0
    stated, since = since_when(data.time_unit or unit, where)
    factor = conversion(stated, unit if since is None else "s", where).factor
    factor *= 1.0 if since is None else second
    start, stop = _instant(case, data.start, "start"), _instant(case, data.stop, "stop")
    zone = zone_named(case.spec.data.zone, case.where("data.zone"))
    return Clock(
        data.times[0],
        factor,
        start,
        stop,
        second,
        zone=zone,
        format=data.time_format,
        decimal=data.decimal,
        hour="".join(data.times[1:]),
        margin=max([0.0, *delays(case).values()]),
        doubt="" if data.time_unit else other_time_unit(data.times[0], unit),
        since=since,
    )


def _instant(case: CaseContent, value: Any, key: str) -> Any:
    """Return dates unchanged, and quantities in the model's unit."""
    if isinstance(value, str) and not DATE.match(value):
        return case.convert(value, case.equation.time_unit, f"data.{key}")
    return value


def read_data(case: CaseContent, source: str | Iterable[str] | None) -> DataTable | JsonLines:
    """Return the data of the case, of another file, or of a stream of JSON lines."""
    spec, columns, clock = case.spec.data, columns_of(case), clock_of(case)
    if not isinstance(source, str | None):
        check_hours(case, clock, source)
        refuse_late(case)
        return JsonLines(source, columns, clock, every=spec.every, missing=spec.missing)
    tables = _on_time(case, columns, _tables(case, source, columns, clock))
    if len(tables) == 1:
        return _until_stop(case, clock, tables[0])
    from livepde.streams.join import join_tables

    needed = [name for name, column in columns.items() if column.needed]
    between = {name: column.between for name, column in columns.items()}
    # An initial profile needs a reading of each sensor. Corrected times of late readings precede
    # the start of their table, where a stated initial state is not valid.
    together = interpolates(case) or bool(delays(case))
    sensors, where = case.roles(*SENSORS), case.where("data.file")
    joined = join_tables(
        tables,
        clock.second,
        sensors,
        needed,
        where,
        between,
        together=together,
        profile=profile_sensors(case),
    )
    return _until_stop(case, clock, joined)


def _tables(
    case: CaseContent, source: str | None, columns: Mapping[str, Column], clock: Clock
) -> list[DataTable]:
    """Return the tables of a given file, of the case's reader, or of the case's files."""
    spec = case.spec.data
    if source is None and isinstance(spec.file, tuple):
        return _of_files(case, spec.file, columns)
    check_hours(case, clock, spec.file if source is None else source)
    if source is None and case.reader is not None:
        return [_from_reader(case, case.reader, columns, clock)]
    path = data_file(case) if source is None else Path(source)
    if spec.long:
        return _of_sensors(case, path, columns, clock, spec.long)
    return [_read(path, columns, clock, spec)]


def _of_sensors(
    case: CaseContent,
    path: Path,
    columns: Mapping[str, Column],
    clock: Clock,
    long: tuple[str, str],
) -> list[DataTable]:
    """Read a long file, with a row for each reading, into one table for each channel."""
    spec = case.spec.data
    if path.suffix in (".parquet", *JSON_LINES):
        text = f"{path} is not a CSV file; only CSV files can have a row for each reading."
        raise case.error("data.sensor", text)
    for name, column in columns.items():
        if column.noise_of or len(column.names) > 1:
            key, owner = ("noise_column", column.noise_of) if column.noise_of else ("columns", name)
            text = "requires a table with a column for each sensor: leave it out."
            raise case.error(f"channels.{owner}.{key}", text)
    # Required channels are only checked after the tables are joined.
    columns = {name: replace(column, needed=False) for name, column in columns.items()}
    written: dict[str, Any] = {"separator": spec.separator, "encoding": spec.encoding}
    rows: dict[str, Any] = {"every": spec.every, "missing": spec.missing, "skip": spec.skip}
    return read_long_csv(path, columns, clock, long, **rows, **written)


def _until_stop(case: CaseContent, clock: Clock, table: DataTable) -> DataTable:
    """Return the rows of a table up to `stop`, for a table with corrected times."""
    if not clock.margin:
        return table
    dates, first = table.origin is not None, 0.0
    slack = SAME * float(np.ptp(table.t))
    if table.origin is not None:
        first, slack = since_1970(table.origin) * clock.second, slack + MOMENT * clock.second
    _, high = clock.bounds(dates, case.where("data"))
    end = np.searchsorted(table.t + first, high - clock.margin + slack, "right")
    return replace(table, t=table.t[:end], values=table.values[:end])


def _on_time(
    case: CaseContent, columns: Mapping[str, Column], tables: list[DataTable]
) -> list[DataTable]:
    """Return tables with corrected times; each late channel becomes a separate table."""
    late = delays(case)
    if not late:
        return tables
    from livepde.streams.join import not_late

    # The noise of a reading has the same delay as the reading.
    late |= {name: late[of] for name, one in columns.items() if (of := one.noise_of) in late}
    may_lack = {*case.roles(*SENSORS), *(late.keys() - case.spec.channels.keys())}
    each = (
        not_late(table, {name: late[name] for name in table.names if name in late}, may_lack)
        for table in tables
    )
    return [part for parts in each for part in parts]


def delays(case: CaseContent) -> dict[str, float]:
    """Return channel -> delay of its times in the model's unit, for channels that state one."""
    unit, channels = case.equation.time_unit, case.spec.channels
    return {
        name: case.convert(channel.late, unit, f"channels.{name}.late")
        for name, channel in channels.items()
        if channel.late is not None
    }


def refuse_late(case: CaseContent) -> None:
    """Refuse channels with a delay, for live sources."""
    for name in delays(case):
        raise case.error(f"channels.{name}.late", LATE)


def check_hours(case: CaseContent, clock: Clock, source: Any) -> None:
    """Refuse times in two columns unless the source is a CSV file."""
    ending = Path(source).suffix if isinstance(source, str) else ""
    if clock.hour and ending in ("", ".parquet", *JSON_LINES):
        text = "times in two columns are read from CSV files only: join them in one column."
        raise case.error("data.time", text)


def _read(path: Path, columns: Mapping[str, Column], clock: Clock, spec: DataSpec) -> DataTable:
    """Return the data of a file, whose extension determines the format."""
    rows: dict[str, Any] = {"every": spec.every, "missing": spec.missing}
    if path.suffix in JSON_LINES:
        return read_json_lines(path, columns, clock, **rows)
    if path.suffix == ".parquet":
        return read_parquet(path, columns, clock, **rows)
    rows |= {"separator": spec.separator, "encoding": spec.encoding, "skip": spec.skip}
    return read_csv(path, columns, clock, **rows)


def _of_files(
    case: CaseContent, files: Sequence[FileSpec], columns: Mapping[str, Column]
) -> list[DataTable]:
    """Read several files into tables; exactly one file has the column of each channel."""
    specs = [case.spec.data.of(file) for file in files]
    found = []
    for spec in specs:
        path = _found(case, str(spec.file))
        if path.suffix in (".parquet", *JSON_LINES):
            text = f"{path} is not a CSV file; only CSV files can be joined."
            raise case.error("data.file", text)
        found.append((path, header_of(path, spec.separator, spec.encoding, spec.skip)))
    owners = {name: _owner(case, name, one, found) for name, one in columns.items()}
    tables = []
    for k, (spec, (path, _)) in enumerate(zip(specs, found, strict=True)):
        # Required channels are only checked after the tables are joined.
        own = {
            name: replace(column, decimal=spec.decimal, needed=False)
            for name, column in columns.items()
            if owners[name] == k
        }
        if not own:
            raise case.error("data.file", f"no channel has a column of {path}; leave it out.")
        tables.append(_read(path, own, clock_of(case, spec), spec))
    return tables


def _owner(
    case: CaseContent, name: str, column: Column, files: Sequence[tuple[Path, list[str]]]
) -> int:
    """Return the index of the only file (path, header) with a column; raises `CaseError`."""
    places = [k for k, (_, header) in enumerate(files) if set(column.names) <= set(header)]
    if len(places) == 1:
        return places[0]
    what = " and ".join(map(repr, column.names))
    listed = ", ".join(str(path) for path, _ in files)
    text = f"no file has the column {what}; the files are {listed}."
    if places:
        both = " and ".join(str(files[k][0]) for k in places)
        text = f"{both} have a column {what} each; rename one."
    raise case.error(f"channels.{column.noise_of or name}", text)


def without_wild_start(case: CaseContent, table: DataTable) -> DataTable:
    """Return a record without outliers in its first rows, which would spoil the initial state.

    The record then begins after the last row with an outlier of an input.
    """
    wild = wild_first_rows(table.t, table.values, _comparable(case, table.names))
    if not wild.any():
        return table
    values, channels = np.where(wild, math.nan, table.values), case.spec.channels
    drives = np.array([name in channels and channels[name].drives for name in table.names])
    lacking = (wild & drives).any(axis=1)
    begin = int(np.flatnonzero(lacking)[-1]) + 1 if lacking.any() else 0
    counts = zip(table.names, wild.sum(axis=0).tolist(), strict=True)
    remarks = {**table.remarks, **{(START, name): n for name, n in counts if n}}
    return _from_row(case, replace(table, values=values, remarks=remarks), begin)


def wild_start(
    case: CaseContent, rows: Sequence[tuple[float, Mapping[str, float]]]
) -> list[tuple[int, str]]:
    """Return row and channel of each outlier in the first rows of a live source."""
    names = list(case.spec.channels)
    values = np.array([[row.get(name, math.nan) for name in names] for _, row in rows])
    wild = wild_first_rows(np.array([t for t, _ in rows]), values, _comparable(case, names))
    return [(k, names[i]) for k, i in np.argwhere(wild).tolist()]


def suspect_start(case: CaseContent, row: Mapping[str, float]) -> bool:
    """Return whether a value of the first row is far from all others of the same quantity."""
    names = list(case.spec.channels)
    for group in _comparable(case, names):
        values = np.sort([x for k in group if math.isfinite(x := row.get(names[k], math.nan))])
        if len(values) < 3:
            continue
        below, above = values[1] - values[0], values[-1] - values[-2]
        if below > FAR * np.ptp(values[1:]) or above > FAR * np.ptp(values[:-1]):
            return True
    return False


def _comparable(case: CaseContent, names: Sequence[str]) -> list[list[int]]:
    """Return groups of channels, as indices of `names`, that measure the same component."""
    groups: dict[str | None, list[int]] = {}
    for k, name in enumerate(names):
        channel = case.spec.channels.get(name)
        # A channel that is constant between readings may jump at any time.
        if channel is None or channel.between != "line" or channel.is_flux:
            continue
        if channel.role in ("boundary", *SENSORS):
            groups.setdefault(channel.of, []).append(k)
    return [*groups.values()]


def _from_first_inputs(case: CaseContent, table: DataTable) -> DataTable:
    """Return a record from the first row at or before which every input has a value."""
    known, begin, remarks = np.isfinite(table.values), 0, dict(table.remarks)
    for k, name in enumerate(table.names):
        channel = case.spec.channels.get(name)
        # A mean over the last interval is first needed in the second row.
        if not (channel and channel.drives) or channel.between == "next" or channel.gaps == "skip":
            continue
        if not known[:, k].any():
            text = "its column has no value, and the model needs it: choose another column, or a "
            text += "shorter time with `data.start` and `data.stop`."
            raise case.error(f"channels.{name}", text)
        if first := int(known[:, k].argmax()):
            remarks[BEGIN, name] = first
            begin = max(begin, first)
    return _from_row(case, replace(table, remarks=remarks), begin)


def _from_row(case: CaseContent, table: DataTable, begin: int) -> DataTable:
    """Return a record from a row on; held inputs start with their last value up to that row."""
    values, channels = table.values[begin:].copy(), case.spec.channels
    for k, name in enumerate(table.names if begin else ()):
        stated = table.values[: begin + 1, k]
        stated = stated[np.isfinite(stated)]
        if len(stated) and name in channels and channels[name].between == "hold":
            values[0, k] = stated[-1]
    return replace(table, t=table.t[begin:], values=values)


def without_gaps(case: CaseContent, table: DataTable) -> DataTable:
    """Return a complete record without gaps and spikes in the channels that drive the model."""
    table, channels = without_wild_start(case, table), case.spec.channels
    # Rows without a value of an input with gaps = "skip" only remain if they state another input.
    filled = [n for n, item in channels.items() if item.drives and item.gaps != "hold"]
    means = [name for name in filled if channels[name].between == "next"]
    screened = [name for name, item in channels.items() if item.screened]
    return _from_first_inputs(case, fill_table(table, filled, screened, means=means))


def reader_of(spec: CaseSpec, folder: Path, where: str, allow_code: bool) -> Any:
    """Return the user function that reads the data; None if the case has no reader."""
    if spec.data.reader is None:
        return None
    expected = "(folder, **options) -> times, {column: values}"
    key = f"{where}: data.reader"
    found = load_code(spec.data.reader, folder, key, expected, allow_code)
    check_options(found, spec.data.options, f"{where}: data.options")
    return found


def _from_reader(
    case: CaseContent, reader: Callable[..., Any], columns: Mapping[str, Column], clock: Clock
) -> DataTable:
    """Return the data that a user function returns as times and a mapping column -> values."""
    spec, where = case.spec.data, case.where(f"data.reader: {case.spec.data.reader}")
    folder = _measurements(case)
    with own_code(where):
        try:
            found = reader(folder or case.path.parent, **spec.options)
        except FileNotFoundError as error:
            remedy = "" if folder else f" {UNSET}"
            text = f"there is no file '{error.filename}'.{remedy}"
            raise case.error("data.reader", text) from None
    match found:
        case (times, Mapping() as values):
            rows: dict[str, Any] = {"every": spec.every, "missing": spec.missing, "where": where}
            return tabulated(times, values, columns, clock, **rows)
    text = f"{spec.reader} returned {type(found).__name__}; expected times and a mapping "
    raise case.error("data.reader", text + "from column to values.")


def data_file(case: CaseContent) -> Path:
    """Return the path of the only data file; relative names start at the folder of the case."""
    given = case.spec.data.file
    if given is None:
        raise case.missing("data.file", "name one, or add --data to the command.")
    if not isinstance(given, str):
        text = "several files are joined for 'check' and 'run' of a complete record; a process is "
        raise case.error("data.file", text + "followed in one: name it, or join them first.")
    return _found(case, given)


def _found(case: CaseContent, given: str) -> Path:
    """Return the path of a data file; relative names start at the folder of the case."""
    if VARIABLE in given:
        if (folder := _measurements(case)) is None:
            raise case.error("data.file", UNSET)
        given = given.replace(VARIABLE, str(folder))
    path = case.path.parent / Path(given).expanduser()
    if not path.is_file() and not case.spec.data.follow:
        raise case.error("data.file", str(no_file(path)))
    return path


def _measurements(case: CaseContent) -> Path | None:
    """Return the folder of measurements shared by several cases; None if there is none."""
    named = os.environ.get("LIVEPDE_DATA")
    if named:
        return Path(named).absolute()
    for base in (Path.cwd(), *case.path.absolute().parents):
        folder = base.parent / "shared" / "data"
        if folder.is_dir():
            return folder
    return None


def time_of(
    case: CaseContent, key: Literal["assimilate_from", "t0"], origin: datetime | None
) -> float | None:
    """Return the model time that a key of `[data]` states; None if the key is missing."""
    value = _instant(case, getattr(case.spec.data, key), key)
    if value is None or isinstance(value, float | int):
        return value
    if origin is None:
        text = f"got the date {value}; the times of the data are numbers."
        raise case.error(f"data.{key}", text)
    clock = clock_of(case)
    stamp = clock.stamp(value)
    if stamp is None:
        text = f"got '{value}'; expected a date such as 2025-04-01 12:00."
        raise case.error(f"data.{key}", text)
    return (stamp - since_1970(origin)) * clock.second


def source_of(
    case: CaseContent, data: Data, position: str, passwords: Mapping[str, str] | None = None
) -> RowSource:
    """Return the source of rows, from a position on; `data` None means the case's source."""
    spec, passwords = case.spec.data, passwords or {}
    if isinstance(data, str):
        return _file_source(case, Path(data), position)
    if data is not None:
        return Lines(data) if isinstance(data, Iterable) else data
    if spec.mqtt is not None:
        topics = {**dict.fromkeys(spec.mqtt.rows), **spec.mqtt.columns}
        return MqttSource(_broker(case, spec.mqtt, "data.mqtt", passwords), topics, spec.times[0])
    if spec.opcua is not None:
        from livepde.streams.opcua import OpcuaSource

        server = _server(case, spec.opcua, "data.opcua", passwords)
        interval = case.positive(spec.opcua.interval, "s", "data.opcua.interval")
        return OpcuaSource(server, spec.opcua.columns, spec.times[0], interval)
    return _file_source(case, data_file(case), position)


def _file_source(case: CaseContent, path: Path, position: str) -> Follow:
    spec = case.spec.data
    if spec.follow and not path.exists():
        LOG.warning("there is no file '%s' yet: waiting for it", path)
    return Follow(
        path,
        separator=spec.separator,
        encoding=spec.encoding,
        skip=spec.skip,
        times=spec.times,
        follow=spec.follow,
        position=position,
    )


def publishers_of(case: CaseContent, passwords: Mapping[str, str]) -> list[Sink]:
    """Return the destinations of estimates that the case defines."""
    sinks: list[Sink] = []
    if (spec := case.spec.output.mqtt) is not None:
        broker = _broker(case, spec, "output.mqtt", passwords)
        title = case.spec.title or case.name
        discovery = spec.discovery is not None
        sinks.append(MqttSink(broker, spec.topic, discovery=discovery, title=title))
    if (nodes := case.spec.output.opcua) is not None:
        from livepde.streams.opcua import OpcuaSink

        sinks.append(OpcuaSink(_server(case, nodes, "output.opcua", passwords), nodes.columns))
    return sinks


def source_text(case: CaseContent) -> str:
    """Return a description of the source of the rows of a case."""
    spec = case.spec.data
    if spec.mqtt is not None:
        topics = ", ".join([*spec.mqtt.rows, *spec.mqtt.columns])
        return f"{topics} of the broker at {spec.mqtt.host}:{spec.mqtt.port}"
    if spec.opcua is not None:
        return f"{len(spec.opcua.columns)} nodes of {spec.opcua.url}"
    if isinstance(spec.file, tuple):
        return ", ".join(file.file for file in spec.file)
    return str(spec.file or spec.reader)


def _broker(case: CaseContent, spec: BrokerSpec, key: str, passwords: Mapping[str, str]) -> Broker:
    return Broker(
        host=spec.host,
        port=spec.port,
        client_id=spec.client_id or f"livepde-{case.name}",
        username=spec.username,
        password=passwords.get(key),
        tls=spec.tls,
        ca_file=spec.ca_file,
        session=round(case.positive(spec.session, "s", f"{key}.session")),
    )


def _server(
    case: CaseContent, spec: NodesSpec, key: str, passwords: Mapping[str, str]
) -> OpcuaServer:
    from livepde.streams.opcua import OpcuaServer

    policy, mode, *files = (spec.security or ",").split(",")
    paths = [str(case.path.parent / file) for file in files]
    security = ",".join([policy, mode, *paths]) if spec.security else ""
    return OpcuaServer(spec.url, spec.username, passwords.get(key), security)


def passwords_of(case: CaseContent, own: bool, allowed: Iterable[str]) -> dict[str, str]:
    """Return key of a connection -> its password, checked before any connection is opened.

    `own`: whether the source in the case file is used. `allowed`: environment variables that may be
    sent, in addition to those whose names begin with LIVEPDE_.
    """
    spec, allowed, found = case.spec, set(allowed), {}
    sources = {"data.mqtt": spec.data.mqtt, "data.opcua": spec.data.opcua} if own else {}
    sinks = {"output.mqtt": spec.output.mqtt, "output.opcua": spec.output.opcua}
    for key, one in {**sources, **sinks}.items():
        if one is None or one.password_env is None:
            continue
        name, where = one.password_env, f"{key}.password_env"
        # A case from another author must not send secrets of this machine to its servers.
        if name not in allowed and (name == TOKEN or not name.startswith(PASSWORDS)):
            text = f"the environment variable {name} would be sent to a server that the case names;"
            text += f" if you trust it, add --allow-env {name}, or let the name begin with "
            raise case.error(where, f"{text}{PASSWORDS}.")
        if name not in os.environ:
            raise case.error(where, f"the environment variable {name} is not set; set it.")
        found[key] = os.environ[name]
    return found


def limits_of(case: CaseContent) -> tuple[Backlog, Retention, float | None]:
    """Return limits of backlog and retention, and seconds until a source is silent, or None."""
    intake, output = case.spec.intake, case.spec.output
    # By default all estimates are kept.
    span = case.positive(output.retain, case.equation.time_unit, "output.retain", math.inf)
    silence = None
    if intake.silence is not None:
        silence = case.positive(intake.silence, "s", "intake.silence")
    return Backlog(intake.overflow, intake.queue), Retention(span, output.thin), silence


def policy_of(case: CaseContent) -> Policy:
    """Return the policy for rows that are late, repeated or incomplete."""
    spec, unit = case.spec.intake, case.equation.time_unit

    def duration(value: float | str, key: str) -> float:
        return case.convert(value, unit, key, difference=True)

    habits = {}
    for name, channel in case.spec.channels.items():
        wait = duration(channel.wait or 0.0, f"channels.{name}.wait")
        filled = channel.gaps == "interpolate"
        habits[name] = Habit(wait, channel.repeated, filled, channel.screened, channel.between)
    # If the model has no time unit, 30 days cannot be converted, and any pause is accepted.
    leap = case.convert(LEAP, unit, "intake.leap") if unit else math.inf
    leap = case.positive(spec.leap, unit, "intake.leap", leap)
    return Policy(
        wait=duration(spec.wait, "intake.wait"),
        tolerance=duration(spec.tolerance, "intake.tolerance"),
        leap=leap,
        repeated=spec.repeated,
        shift=duration(spec.shift, "intake.shift"),
        channels=habits,
    )
