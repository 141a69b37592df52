"""What a table of measurements tells of its case; what it does not tell stays open, as '?'."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import timedelta
from itertools import pairwise
from pathlib import Path

import numpy as np

from livepde.cases.read import BLANK, beside
from livepde.cases.settings import toml_line
from livepde.cases.units import conversion
from livepde.errors import CaseError, SampleError
from livepde.linalg import Array
from livepde.models import Equation
from livepde.streams import Clock, Column, Table, read_csv
from livepde.streams.clock import number_of
from livepde.streams.csvfile import UTF_8, Written, how_written
from livepde.streams.table import JSON_LINES, MISSING

__all__ = ["parts_of"]

UNIT = re.compile(r"\s*[\[(]([^\[\]()]*)[\])]\s*$")  # T [degC], time (min)
TIME = re.compile(r"(?:_|^(?=\w{3}))([A-Za-z]+)$")  # time_s, minutes
# T_5cm, depth 0.05 m; not m3/h, nor -0.5 m, whose sign may be a hyphen
PLACE = re.compile(r"(?<![\d.,-])(\d+(?:[.,]\d+)?)[ _]?(mm|cm|m|ft)(?![A-Za-z\d/^²³])")
FRACTION = re.compile(r"\d+\.\d+")  # T_0.05
HOUR = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d+)?)?")
EITHER = re.compile(r"%[dm][/-]%[dm][/-]")  # day and month: a table does not always tell which
FIRST = """\
# '?' stands for what the table does not tell: fill it in; 'livepde check' names what is left."""
CHANNELS = """\
# Drop what is no {state}. A value given at an end: role = "boundary", at = "left" or
# "right"; through an end without one nothing flows. One of role = "withheld" is only scored."""


def parts_of(table: Path, folder: Path, equation: Equation) -> dict[str, str]:
    """Return the parts of a case in `folder` that equation and CSV file tell; others are open.

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
    file = table if table.is_absolute() else beside(table, folder)
    unit = equation.time_unit
    if unit:
        unit = "s" if samples.origin else _unit(time, unit, UNIT, TIME) or BLANK
    data = [
        toml_line("file", file.as_posix()),
        toml_line("time", time),
        *_written(written, samples, unit),
    ]
    if unused := [name for name in kinds if name not in (time, *names)]:
        data.append(f"# without numbers: {', '.join(unused)}")
    steps = np.diff(samples.t)
    step = BLANK if unit == BLANK or not len(steps) else f"{np.median(steps):g}"
    state = equation.state
    noise = f"noise = {_open(state.unit.replace('degC', 'K'))}"
    return {
        "first": FIRST,
        "title": toml_line("title", table.stem),
        "equation": "\n".join(_equation(equation)),
        "start": _open(equation.length_unit),
        "stop": _open(equation.length_unit),
        "data": "\n".join(data),
        "unknowns": "\n\n".join(_unknowns(equation)),
        "channels": "\n".join(
            [CHANNELS.format(state=state.text), *_channels(equation, names, samples)]
        ),
        "noise": f"{_told(noise, 'of a single value: its standard deviation')}\n",
        "step": "dt_max = " + _quantity(step, unit if unit != BLANK else equation.time_unit),
        "last": "",
    }


def _quantity(number: str, unit: str) -> str:
    """Return a number with a unit as TOML."""
    return f'"{number} {unit}"' if unit else number if number != BLANK else f'"{BLANK}"'


def _open(unit: str) -> str:
    """Return what stands for a quantity that is to be filled in."""
    return _quantity(BLANK, unit)


def _told(line: str, text: str) -> str:
    """Return a line with a comment, in the column of those of the template."""
    return f"{line:<29}  # {text}"


def _equation(equation: Equation) -> Iterator[str]:
    """Yield the line of the equation, and of the options that it needs."""
    yield _told(toml_line("equation", equation.name), equation.formula)
    yield f"# 'livepde equations {equation.name}' tells what it knows; 'livepde equations': others"
    for name, option in equation.options.items():
        if option.default is None:
            yield _told(f"options.{name} = {_open(option.unit)}", option.text)


def _unknowns(equation: Equation) -> Iterator[str]:
    """Yield the tables of the unknowns that have to be there."""
    for name, variable in equation.unknowns.items():
        if variable.optional:
            continue
        prior = _open(variable.unit)
        lines = {
            f"[unknowns.{name}]": variable.text,
            f"prior = {prior}": "what you would have said without data ...",
            f"std = {prior}": "... and how far off that may be",
            'transform = "log"': "it is positive; if it need not be, drop this line",
        }
        yield "\n".join(_told(line, text) for line, text in lines.items())


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
    if len(header) < 2:
        raise SampleError(
            f"{table}: has one column, '{header[0]}'; expected times and measurements, with a "
            "comma, a semicolon or a tab between them."
        )
    if not any(_kind(cell, written) in ("number", "date") for cell in rows[0]):
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
    timed = [name for name in numbers if _unit(name, "s", UNIT, TIME)]
    rising = [name for name in numbers if _rises(name, written)]
    found = [*dates, *(name for name in timed if name in rising), *rising, *timed]
    if not found:
        nameless = ""
        if "" in written.header:
            nameless = f" Column {written.header.index('') + 1} has no name: give it one."
        raise SampleError(
            f"{table}: no column holds times: expected dates, or numbers that increase from row to "
            f"row.{nameless}"
        )
    return found[0]


def _rises(name: str, written: Written) -> bool:
    k = written.header.index(name)
    values = [number_of(row[k], written.decimal) for row in written.rows if k < len(row)]
    return all(a is not None and b is not None and a < b for a, b in pairwise(values))


def _written(written: Written, samples: Table, unit: str) -> Iterator[str]:
    """Yield the lines of [data] that say how the file is written, and what is in it."""
    if samples.origin is None:
        if unit:
            yield toml_line("time_unit", unit)
        begin, end = (f"{t:g}" for t in samples.t[[0, -1]])
    else:
        begin, end = (f"{samples.origin + timedelta(seconds=t)}" for t in samples.t[[0, -1]])
    if written.time_format and samples.origin:
        line = toml_line("time_format", written.time_format)
        swapped = EITHER.search(written.time_format)
        yield _told(line, "the day first, or the month?") if swapped else line
    if written.separator != ",":
        yield toml_line("separator", written.separator)
    if written.decimal != ".":
        yield toml_line("decimal", written.decimal)
    if written.encoding != UTF_8:
        yield toml_line("encoding", written.encoding)
    told = f"# {len(samples)} rows from {begin} to {end}{' UTC' if samples.origin else ''}"
    steps = np.diff(samples.t)
    if len(steps):
        told += f", {np.median(steps):g} {unit.replace(BLANK, '')}".rstrip() + " apart"
    if len(steps) and steps.max() > 1.01 * steps.min():
        told += f" (median), {steps.min():g} to {steps.max():g}"
    yield told


def _channels(equation: Equation, names: list[str], samples: Table) -> Iterator[str]:
    """Yield the lines of the channels, those of inputs that no column is named after at the end."""
    inputs = {name: item for name, item in equation.inputs.items() if not item.optional}
    keys = [re.sub(r"\W+", "_", UNIT.sub("", name)).strip("_") for name in names]
    for key, name, values in zip(keys, names, samples.values.T, strict=True):
        key = key if key and keys.count(key) == 1 else name
        told, variable = [_range(values)], inputs.pop(key, None)
        given = {"role": "input" if variable else "sensor", "column": name}
        if variable is None:
            variable = equation.state
            place, fraction = PLACE.search(name), FRACTION.search(name)
            given["at"] = _open(equation.length_unit).strip('"')
            if place is not None and equation.length_unit:
                given["at"] = f"{place[1].replace(',', '.')} {place[2]}"
                told.append("place as its name says")
            elif fraction is not None:
                told.append(f'at = "{fraction[0]} {equation.length_unit}"?')
        stated = UNIT.search(name)
        if stated and not PLACE.fullmatch(stated[1].strip()):
            unit = _unit(name, variable.unit, UNIT) or f"{BLANK} {stated[1]}"
            given |= {"unit": unit} if unit != variable.unit else {}
        yield _told(toml_line(key, given), ", ".join(told))
    for key, variable in inputs.items():
        yield _told(toml_line(key, {"role": "input", "column": BLANK}), variable.text)


def _range(values: Array) -> str:
    """Return in words what a column holds."""
    present = values[np.isfinite(values)]
    missing = len(values) - len(present)
    told = f"{present.min():.4g} to {present.max():.4g}"
    return f"{told}, {missing} missing" if missing else told


def _unit(name: str, unit: str, *patterns: re.Pattern[str]) -> str:
    """Return the unit in the name of a column; empty if none can be converted to `unit`."""
    for given in filter(None, (pattern.search(name) for pattern in patterns)):
        for text in (given[1], re.sub(r"(?<=[A-Za-z])(?=\d)", "^", given[1])):  # m3/h, m^3/h
            with suppress(CaseError):
                conversion(text, unit, name)
                return text
    return ""
