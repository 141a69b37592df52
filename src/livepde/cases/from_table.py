"""What a table of measurements tells of its case; what it does not tell stays open, as '?'."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np

from livepde.cases.read import BLANK
from livepde.cases.settings import toml_line
from livepde.cases.units import conversion
from livepde.errors import CaseError, SampleError
from livepde.linalg import Array
from livepde.models import EQUATIONS
from livepde.streams import Clock, Column, Table, read_csv
from livepde.streams.clock import number_of
from livepde.streams.csvfile import UTF_8, Written, how_written
from livepde.streams.table import JSON_LINES, MISSING

__all__ = ["parts_of"]

HEAT = EQUATIONS["heat"]
UNIT = re.compile(r"\s*[\[(]([^\[\]()]*)[\])]\s*$")  # T [degC], time (min)
TAIL = re.compile(r"_([A-Za-z]+)$")  # time_s
PLACE = re.compile(r"(\d+(?:[.,]\d+)?)[ _]?(mm|cm|m|ft)(?![A-Za-z])")  # T_5cm, depth 0.05 m
FRACTION = re.compile(r"\d+\.\d+")  # T_0.05
HOUR = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d+)?)?")
EITHER = re.compile(r"%[dm][/-]%[dm][/-]")  # day and month: a table does not always tell which
FIRST = """\
# '?' stands for what the table does not tell: fill it in; 'livepde check' names what is left."""
PRIOR = f"""\
prior = "{BLANK} m^2/s"              # copper 1e-4, steel 1e-5, stone and ice 1e-6, soil 5e-7
std = "{BLANK} m^2/s"                # how far off that may be
transform = "log"              # keeps it positive"""
CHANNELS = """\
# Delete what is no temperature. One at an end of the mesh is given: role = "boundary", at = "left"
# or "right"; through an end without one no heat flows. One of role = "withheld" is only scored."""
NOISE = f"""\
noise = "{BLANK} K"                  # of a single value: its standard deviation
"""


def parts_of(table: Path, folder: Path) -> dict[str, str]:
    """Return the parts of a case in `folder` that a CSV file tells; others are left open.

    Raises
    ------
    DataError
        There is no such file, or it is no table of times and measurements; one sentence.
    """
    if table.suffix in (*JSON_LINES, ".parquet"):
        raise SampleError(f"{table}: a case is begun from a CSV file, with a header.")
    written = how_written(table)
    kinds = _kinds(table, written)
    time = _times(table, written, kinds)
    names = [name for name, kind in kinds.items() if kind == "number" and name != time]
    if not names:
        raise SampleError(f"{table}: beside the times, '{time}', no column holds numbers.")
    samples = read_csv(
        table,
        {name: Column((name,), decimal=written.decimal) for name in names},
        Clock(time, format=written.time_format, decimal=written.decimal),
        separator=written.separator,
        encoding=written.encoding,
    )
    unit = "s" if samples.origin else _unit(time, HEAT.time_unit, UNIT, TAIL) or BLANK
    steps = np.diff(samples.t)
    step = f"{np.median(steps):g} {unit}" if len(steps) and unit != BLANK else f"{BLANK} s"
    file = table if table.is_absolute() else Path(os.path.relpath(table, folder))
    data = [
        toml_line("file", file.as_posix()),
        toml_line("time", time),
        *_written(written, samples, unit),
    ]
    if unused := [name for name in kinds if name not in (time, *names)]:
        data.append(f"# without numbers: {', '.join(unused)}")
    channels = (
        _channel(name, column) for name, column in zip(names, samples.values.T, strict=True)
    )
    return {
        "first": FIRST,
        "title": toml_line("title", table.stem),
        "start": f'"{BLANK} m"',
        "stop": f'"{BLANK} m"',
        "data": "\n".join(data),
        "prior": PRIOR,
        "channels": "\n".join([CHANNELS, *channels]),
        "noise": NOISE,
        "step": f'"{step}"',
        "last": "",
    }


def _kinds(table: Path, written: Written) -> dict[str, str]:
    """Return column -> what most of its cells are: "number", "date", "hour" or "text"."""
    header, rows = written.header, written.rows
    if not rows:
        raise SampleError(f"{table}: holds no rows beside its header.")

    def kind(cells: list[str]) -> str:
        found = Counter(_kind(cell, written) for cell in cells if cell.lower() not in MISSING)
        return found.most_common(1)[0][0] if found else "text"

    if all(_kind(cell, written) in ("number", "date") for cell in header if cell):
        raise SampleError(f"{table}: has no header: begin it with a line of names of its columns.")
    if sum(map(bool, header)) < 2:
        raise SampleError(
            f"{table}: has one column, '{header[0]}'; expected times and measurements, with a "
            "comma, a semicolon or a tab between them."
        )
    if kind(rows[0]) == "text":
        raise SampleError(
            f"{table}, row 2: holds no numbers; the header is one line: delete the second."
        )
    return {
        name: kind([row[k].strip() for row in rows if k < len(row)])
        for k, name in enumerate(header)
        if name
    }


def _kind(cell: str, written: Written) -> str:
    if number_of(cell, written.decimal) is not None:
        return "number"
    if Clock("").stamp(cell, written.time_format) is not None:
        return "date"
    return "hour" if HOUR.fullmatch(cell.strip()) else "text"


def _times(table: Path, written: Written, kinds: Mapping[str, str]) -> str:
    """Return the column of times: dates, or numbers that increase, best with a unit of time."""
    dates, hours, numbers = (
        [n for n, k in kinds.items() if k == kind] for kind in ("date", "hour", "number")
    )
    if dates and hours:
        raise SampleError(
            f"{table}: the day is in '{dates[0]}' and the time in '{hours[0]}': join them in one "
            "column, as 2025-04-01 12:00."
        )
    timed = [name for name in numbers if _unit(name, HEAT.time_unit, UNIT, TAIL)]
    rising = [name for name in numbers if _rises(name, written)]
    found = [*dates, *(name for name in timed if name in rising), *rising, *timed]
    if not found:
        raise SampleError(
            f"{table}: no column holds times: expected dates, or numbers that increase from row to "
            "row."
        )
    return found[0]


def _rises(name: str, written: Written) -> bool:
    k = written.header.index(name)
    values = [number_of(row[k], written.decimal) for row in written.rows if k < len(row)]
    return all(a is not None and b is not None and a < b for a, b in pairwise(values))


def _written(written: Written, samples: Table, unit: str) -> Iterator[str]:
    """Yield the lines of [data] that say how the file is written, and what is in it."""
    if samples.origin is None:
        yield toml_line("time_unit", unit)
        begin, end = (f"{t:g}" for t in samples.t[[0, -1]])
    else:
        begin, end = (f"{samples.origin + timedelta(seconds=t)}" for t in samples.t[[0, -1]])
    if written.time_format and samples.origin:
        remark = "    # the day first, or the month?" if EITHER.search(written.time_format) else ""
        yield toml_line("time_format", written.time_format) + remark
    if written.separator != ",":
        yield toml_line("separator", written.separator)
    if written.decimal != ".":
        yield toml_line("decimal", written.decimal)
    if written.encoding != UTF_8:
        yield toml_line("encoding", written.encoding)
    told = f"# {len(samples)} rows from {begin} to {end}{' UTC' if samples.origin else ''}"
    steps = np.diff(samples.t)
    if len(steps):
        told += f", {np.median(steps):g} {unit} apart".replace(f" {BLANK}", "")
    if len(steps) and steps.max() > 1.01 * steps.min():
        told += f" (median), {steps.min():g} to {steps.max():g}"
    yield told


def _channel(name: str, values: Array) -> str:
    """Return the line of a channel: its place and unit, if the name of its column has them."""
    given: dict[str, str] = {"role": "sensor", "column": name, "at": f"{BLANK} m"}
    unit = _unit(name, HEAT.state.unit, UNIT)
    if unit and unit != HEAT.state.unit:
        given["unit"] = unit
    place, present = PLACE.search(name), values[np.isfinite(values)]
    told = f"{present.min():.4g} to {present.max():.4g}"
    if place is not None:
        given["at"] = f"{place[1].replace(',', '.')} {place[2]}"
        told += ", place as its name says"
    elif (fraction := FRACTION.search(name)) is not None:
        told += f', at "{fraction[0]} m"?'
    if missing := len(values) - len(present):
        told += f", {missing} missing"
    key = re.sub(r"\W+", "_", UNIT.sub("", name)).strip("_") or name
    return f"{toml_line(key, given)}  # {told}"


def _unit(name: str, unit: str, *patterns: re.Pattern[str]) -> str:
    """Return the unit in the name of a column; empty if none can be converted to `unit`."""
    for given in filter(None, (pattern.search(name) for pattern in patterns)):
        with suppress(CaseError):
            conversion(given[1], unit, name)
            return given[1]
    return ""
