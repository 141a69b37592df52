"""Files that `livepde init` writes: a case with synthetic data, or a case for a table."""

from __future__ import annotations

import json
import re
import string
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np

from livepde.cases import data_schema, schema
from livepde.cases.data_schema import DataSpec
from livepde.cases.measured import Measured, measured
from livepde.cases.read import BLANK, beside, toml_line
from livepde.cases.schema import FLUX, CaseSpec
from livepde.errors import RunError
from livepde.linalg import Array
from livepde.models import EQUATIONS, Equation, Variable
from livepde.streams.oddities import sentinels, switches
from livepde.units import (
    AFTER_SLASH,
    IN_BRACKETS,
    Affine,
    conversion,
    converts,
    has_states,
    in_si,
    unit_in,
)

SCHEMA_FILE = "livepde.schema.json"  # next to a case that `livepde init` writes
DIALECT = "https://json-schema.org/draft/2020-12/schema"
MEANINGS: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_name("keys.toml").read_text(encoding="utf-8")
)
"""Class of a table -> key -> meaning, with the units of numbers."""


def case_schema() -> dict[str, Any]:
    """Return the JSON schema of a case file, with the meaning and the default of each key."""
    found = CaseSpec.model_json_schema(by_alias=True)
    tables = vars(data_schema) | vars(schema)
    for name, table in [("CaseSpec", found), *found["$defs"].items()]:
        summary, meanings = documented(table.get("description", ""))
        table["description"] = summary
        for base in reversed(tables[name].__mro__):
            meanings |= MEANINGS.get(base.__name__, {})
        for key, value in table["properties"].items():
            if key in meanings:
                value["description"] = meanings[key]
    return {"$schema": DIALECT, **found, "title": "A case of livepde"}


@cache
def schema_text() -> str:
    """Return the content of the JSON schema file."""
    return json.dumps(case_schema(), indent=1, ensure_ascii=False) + "\n"


def documented(text: str) -> tuple[str, dict[str, str]]:
    """Return the summary of a docstring, and parameter -> its meaning."""
    summary = text.partition("\n\n")[0].replace("\n", " ")
    listed = re.search(r"^Parameters\n-+\n(.*?)(?:\n\n|\Z)", text, flags=re.DOTALL | re.MULTILINE)
    items = re.findall(r"^(\w+)\n((?: +.*\n?)+)", listed[1] if listed else "", flags=re.MULTILINE)
    return summary, {name: " ".join(meaning.split()) for name, meaning in items}


# T_5cm, depth 0.05 m; but not m3/h, nor -0.5 m, since the sign may be a hyphen.
PLACE = re.compile(r"(?<![\d.,-])(\d+(?:[.,]\d+)?)[ _]?(mm|cm|m|ft)(?![A-Za-z\d/^²³])")
FRACTION = re.compile(r"\d+\.\d+")  # T_0.05
# Q_W, T_5cm degF, T_1 degF
SUFFIX = re.compile(r"(?:(?<=\w)_|(?<=[^\W\d]) |(?<=\d) (?=deg))(?P<unit>[A-Za-z]\w*)$")
LAST = re.compile(r"_(?P<unit>[A-Za-z][A-Za-z0-9]*)$")  # T_air_degF
NO_UNITS = {*string.ascii_letters, "in"}  # ambiguous at the end of a sensor's name: T_K, T_in
NUMBERED = re.compile(r"(.*?)(\d+)")  # u_17
PLACES = "places.csv"  # table of positions that is written next to the case
NOISE = "standard deviation of a single reading"
FAMILY = 8  # smallest number of numbered columns that become one line of [channels]
HEAD = """\
#:schema ./livepde.schema.json
# A case of livepde: equation, unknowns, and the role of each channel.
#   livepde check {case}     check this case, and which unknowns its sensors can identify
#   livepde run {case}       estimate the unknowns, and write a run directory
"""
OPEN = """\
# Replace each '?': the table has no value for it. 'livepde check' lists those that remain.
"""
VALUES = """\
# A measured value at an end: role = "boundary", at = "left" or "right". Other ends are closed, or
# have a flux or an exchange in [boundary], such as left = {{ flux = "1 {flux}" }}."""
ENDS = {
    1: '# Measured value at an end: role = "boundary", at = "left" or "right"; others are closed.',
    2: '# Measured value at a boundary: role = "boundary", at = its name; others are closed.',
}  # dimension -> where a case has values of the state
ROD = Path(__file__).with_name("rod.toml")  # case for the synthetic data in rod.csv


@dataclass(frozen=True)
class FoundChannel:
    """A channel that is proposed for a table, or an input that the table lacks."""

    name: str
    given: Mapping[str, Any]  # keys and values of the channel
    columns: tuple[str, ...]  # columns of the table; empty if the table lacks the input
    comment: str  # comment in the case file

    @property
    def is_sensor(self) -> bool:
        """Whether the channel is a sensor."""
        return bool(self.given["role"] == "sensor")


def _case_for(table: Measured, folder: Path, equation: Equation) -> str:
    """Return the text of a case in `folder` for a table; unknown values are blanks."""
    found = channels_in(table, equation)
    given = {item.name for item in found if item.columns and not item.is_sensor}
    # Noise is a standard deviation: for a temperature, a difference in K.
    noise = _open(equation.state.unit.replace("degC", "K"))
    # If no sensor measures a flux, one noise is valid for all sensors.
    mixed = any(item.given.get("quantity") == FLUX for item in found)
    found = [_with_noise(equation, item, noise) for item in found] if mixed else found
    lines = [
        *_top(table, equation, given),
        *_inline("mesh", _mesh(equation)),
        *_data_lines(table, folder, equation, found),
        *_contents(table),
        *_unknowns(equation, given),
        *_constants(found),
        *_inline("law", {} if mixed else {"noise": noise}, NOISE),
        *_steps(table, equation),
        "",
        "[channels]",
        *_channels(equation, found),
    ]
    text = "\n".join(lines)
    return f"{HEAD.format(case=folder / 'case.toml')}{OPEN}{text}\n"


def _data_lines(
    table: Measured, folder: Path, equation: Equation, channels: list[FoundChannel]
) -> Iterator[str]:
    """Yield the line of [data], with a comment on what to check."""
    data, comments = _data(table, folder, _with_states(equation, channels)), list[str]()
    if len(data.get("missing", ())) > len(table.missing):
        comments.append("missing: far outside the other values; check them")
    if table.counted:
        comments.append("time_unit: found from the numbers; check the dates above")
    # Times that are numbers begin at an event: the process is at rest before the first row.
    first = min(one.samples.t[0] for one in table.tables)
    if equation.spacing == "geometric" and table.samples.origin is None and first > 0.0:
        data["t0"] = _open(table.time_unit)
        comments.append("t0: when the process began, at rest")
    yield from _inline("data", data, "; ".join(comments))


def _with_states(equation: Equation, channels: list[FoundChannel]) -> set[str]:
    """Return the columns of inputs that may be constant, such as a power that is off."""
    inputs = (item for item in channels if not item.is_sensor)
    switched = (item for item in inputs if has_states(equation.inputs[item.name].unit))
    return {column for item in switched for column in item.columns}


def _with_noise(equation: Equation, item: FoundChannel, noise: str) -> FoundChannel:
    """Return a channel with a blank for its own noise if it is a sensor."""
    if not item.is_sensor:
        return item
    if equation.fluxes and item.given.get("quantity") == FLUX:
        noise = _open(equation.fluxes.flux)
    return replace(item, given={**item.given, "noise": noise})


def _open(unit: str, number: str = BLANK) -> str:
    """Return a quantity with its unit; by default a blank that is to be filled in."""
    return f"{number} {unit}".rstrip()


def _inline(key: str, given: Mapping[str, Any], comment: str = "") -> Iterator[str]:
    """Yield the line of an inline table with a comment; no line if the table is empty."""
    if given:
        shown = toml_line("x", given).partition(" = ")[2]
        yield _commented(f"{key} = {shown}", comment)


def _commented(line: str, text: str) -> str:
    """Return a line with a comment."""
    return f"{line:<29}  # {text}" if text else line


def _top(table: Measured, equation: Equation, inputs: set[str]) -> Iterator[str]:
    """Yield the lines of title, equation, required options, and initial state."""
    yield toml_line("title", table.path.stem)
    yield _commented(toml_line("equation", equation.name), equation.formula)
    yield f"# 'livepde equations {equation.name}' lists its keys, 'livepde equations' all equations"
    asked = equation.alternatives.get(_alternative(equation, inputs), ())
    for name, option in equation.options.items():
        if option.default is None or name in asked:
            yield _commented(f'options.{name} = "{_open(option.unit)}"', option.text)
    unit = equation.state.unit
    if unit != EQUATIONS[equation.name].state.unit:
        yield _commented(f"options.{toml_line('unit', unit)}", "of the state, and of its sensors")
    if equation.components:
        parts = dict.fromkeys(equation.components, _open(unit))
        yield from _inline("initial", parts, equation.state.text)
    elif equation.spacing == "geometric":  # around a well, where a line between sensors is no state
        yield _commented(toml_line("initial", _open(unit)), f"{equation.state.text} at rest")
    elif equation.dimension > 1:
        yield _commented(toml_line("initial", _open(unit)), f"{equation.state.text} at the start")
    else:
        yield _commented('initial = "interpolate"', "from the first sample; or a number")


def _mesh(equation: Equation) -> dict[str, Any]:
    """Return the keys of [mesh], with blanks for the sides."""
    side = _open(equation.length_unit)
    if equation.dimension > 1:
        return {"x": [side, side], "y": [side, side], "cells": [20, 20]}
    graded = {"spacing": "geometric"} if equation.spacing == "geometric" else {}
    return {"from": side, "to": side, "cells": 40, **graded}


def _data(table: Measured, folder: Path, states: set[str]) -> dict[str, Any]:
    """Return the format of the files as keys of [data], without defaults.

    `states`: columns of inputs that may be constant.
    """
    # Format keys of the first file are valid for all files; the others only state differences.
    first, *others = (_written(one, folder) for one in table.tables)
    usual = {key: field.default for key, field in DataSpec.model_fields.items() if key != "time"}
    found = _unlike(first, usual)
    if others:
        own = [_unlike(other, first) for other in others]
        found["file"] = [first["file"], *(o if len(o) > 1 else o["file"] for o in own)]
    if missing := [*table.missing, *_missing(table, states)]:
        found["missing"] = missing
    return found


def _unlike(given: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Return the items whose values differ from the usual values."""
    return {key: value for key, value in given.items() if value != usual.get(key)}


def _missing(table: Measured, states: set[str]) -> list[float]:
    """Return the values that are placeholders in a column and not measurements in another."""
    columns = table.columns.items()
    found = {n: {one.value for one in sentinels(x, n not in states)} for n, x in columns}

    def usual(value: float) -> bool:
        return any(value in x and value not in found[n] for n, x in columns)

    return sorted(v for v in set().union(*found.values()) if not usual(v))


def _written(table: Measured, folder: Path) -> dict[str, Any]:
    """Return the format of a file as keys of [data], defaults included."""
    written, path = table.written, table.path
    file = path if path.is_absolute() else beside(path, folder)
    found: dict[str, Any] = {"file": file.as_posix(), "skip": written.skip}
    found["time"] = table.time[0] if len(table.time) == 1 else list(table.time)
    if unit := table.counted or (table.time_unit if table.is_of_numbers else ""):
        found["time_unit"] = unit
    if table.long:
        found["sensor"], found["value"] = table.long
    found |= {"time_format": table.time_format, "separator": written.separator}
    return found | {"decimal": written.decimal, "encoding": written.encoding}


def _contents(table: Measured) -> Iterator[str]:
    """Yield comments on the contents of the files: span, row numbers and text columns."""
    for one in table.tables:
        yield f"# {one.path.name}: {one.span}" if table.more else f"# {one.span}"
        if one.row_numbers:
            yield f"# numbers of rows: {', '.join(one.row_numbers)}"
        if one.texts:
            yield f"# without numbers: {', '.join(one.texts)}"


def _steps(table: Measured, equation: Equation) -> Iterator[str]:
    """Yield the line of time steps if the intervals between samples are uneven."""
    steps = table.steps
    # Intervals of more than one and a half times the median count as uneven.
    if len(steps) and steps.max() > 1.5 * np.median(steps):
        known = table.time_unit != BLANK
        number = f"{np.median(steps):g}" if known else BLANK
        step = _open(table.time_unit if known else equation.time_unit, number)
        given = step if table.time_unit or number == BLANK else float(step)
        yield from _inline("steps", {"dt_max": given}, "longer intervals are divided")


def _alternative(equation: Equation, inputs: set[str]) -> str:
    """Return the default choice among alternative unknowns of an equation; empty if none."""
    fits = [name for name, belongs in equation.alternatives.items() if inputs & set(belongs)]
    # The last alternative requires the fewest inputs: it is used if the table has none of them.
    return fits[0] if fits else next(reversed(list(equation.alternatives)), "")


def _unknowns(equation: Equation, inputs: set[str]) -> Iterator[str]:
    """Yield the lines of the required unknowns, with comments."""
    yield "# prior: best guess before seeing data; std: its standard deviation"
    yield '# transform = "log" keeps an unknown positive; remove it if negative values are possible'
    chosen = _alternative(equation, inputs)
    for name, variable in equation.unknowns.items():
        if name == chosen or not variable.optional:
            known = [one for one in equation.alternatives if one in equation.unknowns]
            others = ", ".join(one for one in known if one != name)
            more = f"; or {others}, or both" if name == chosen else ""
            yield from _inline(f"unknowns.{name}", _open_prior(variable), variable.text + more)


def _open_prior(variable: Variable) -> dict[str, Any]:
    """Return the keys of an unknown, with blanks for its prior."""
    prior = _open(variable.unit)
    given: dict[str, Any] = {"prior": prior, "std": prior}
    if variable.transform == "logit":
        given["bounds"] = [0, 1]
    return {**given, "transform": variable.transform} if variable.transform else given


def _constants(found: list[FoundChannel]) -> Iterator[str]:
    """Yield the lines of the inputs without a column."""
    for item in found:
        if not item.columns:
            line = f'inputs.{item.name} = "{item.given["value"]}"'
            more = f'or [channels] {item.name} = {{ role = "input", column = ... }}'
            yield _commented(line, f"{item.comment}; {more}")


def _channels(equation: Equation, found: list[FoundChannel]) -> Iterator[str]:
    """Yield the lines of [channels], with comments on their options."""
    yield f'# Remove what is not {equation.state.text}. role = "validation": predicted only.'
    if "unit" in equation.options and equation.state == EQUATIONS[equation.name].state:
        yield '# For another quantity than temperature set its unit, such as options.unit = "mg/l".'
    for name, quantity in equation.quantities.items():
        yield f'# Instead of at = ...: quantity = "{name}", the {quantity.text}.'
    if equation.takes_values:
        units = equation.fluxes
        yield VALUES.format(flux=units.flux) if units else ENDS[equation.dimension]
    for item in found:
        if item.columns:
            yield _commented(toml_line(item.name, item.given), item.comment)


def in_unit_of(table: Measured, equation: Equation, stated: str = "") -> Equation:
    """Return the equation in the unit of a table's sensors, if the equation leaves that open.

    It is the most frequent one, if every column states its unit and none has that of the equation.
    `stated`: the unit; empty: found from the columns.
    """
    if "unit" not in equation.options:
        return equation
    sensors = [item for item in channels_in(table, equation) if item.is_sensor]
    units = [str(item.given.get("unit", "")) for item in sensors]
    if stated or (units and all(unit.startswith(BLANK) for unit in units)):
        return equation.in_unit(stated or mode(units).removeprefix(BLANK).strip())
    return equation


def channels_in(table: Measured, equation: Equation) -> list[FoundChannel]:
    """Return the channels of a table, and at the end the inputs that it lacks."""
    columns = table.columns
    found, inputs = [], dict(equation.inputs)
    for label, (name, values) in zip(_labels(columns), columns.items(), strict=True):
        if entry := _input_of(name, inputs):
            found.append(_input(table, entry, name, inputs.pop(entry).unit))
        else:
            found.append(_sensor(equation, label, name, table.titled(name), values))
    found = [_by_unit(table, item, found, inputs) for item in found]
    for item in found:
        inputs.pop(item.name, None)
    there = {item.name for item in found if not item.is_sensor}
    chosen = equation.alternatives.get(_alternative(equation, there), ())
    lacking = [
        FoundChannel(name, {"role": "input", "value": _open(variable.unit)}, (), variable.text)
        for name, variable in inputs.items()
        if not variable.optional or name in chosen
    ]
    return [*_in_families(equation, found), *lacking]


def _by_unit(
    table: Measured, item: FoundChannel, others: list[FoundChannel], inputs: Mapping[str, Variable]
) -> FoundChannel:
    """Return a channel as an input if their units match, and match no other input or channel."""

    def fits(one: FoundChannel, variable: Variable) -> bool:
        unit = str(one.given.get("unit", ""))
        return unit.startswith(BLANK) and converts(unit.removeprefix(BLANK).strip(), variable.unit)

    needed = {name: variable for name, variable in inputs.items() if not variable.optional}
    names = [name for name, variable in needed.items() if fits(item, variable)]
    if len(names) != 1 or sum(fits(other, needed[names[0]]) for other in others) != 1:
        return item
    found = _input(table, names[0], item.columns[0], needed[names[0]].unit)
    return replace(found, comment=f"{found.comment}, by its unit")


def _labels(columns: Iterable[str]) -> list[str]:
    """Return the names of columns without units; the full names if these are not unique."""
    keys = {name: re.sub(r"\W+", "_", IN_BRACKETS.sub("", name)).strip("_") for name in columns}
    all_keys = ["", "", *keys.values()]  # an empty key is never unique
    return [key if all_keys.count(key) == 1 else name for name, key in keys.items()]


def _input(table: Measured, entry: str, name: str, model_unit: str) -> FoundChannel:
    """Return an input with the unit in the name of its column."""
    unit, values = _stated(table.titled(name), model_unit), table.columns[name]
    given = {"role": "input", "column": name, **({"unit": unit} if unit else {})}
    comment = _range(values)
    samples = next(one.samples for one in table.tables if name in one.samples.names)
    if switches(samples.t, values, has_states(model_unit)):
        given["between"] = "hold"
        comment += ", constant stretches with jumps"
    return FoundChannel(entry, given, (name,), comment)


def _input_of(column: str, inputs: Mapping[str, Variable]) -> str:
    """Return the input in the name of a column, such as Q, Q [W], Q_W; empty if there is none."""
    plain = IN_BRACKETS.sub("", column).strip()
    suffix = SUFFIX.search(plain)
    for name, variable in inputs.items():
        if plain == name or plain.casefold() == name.casefold():
            return name
        if suffix and plain[: suffix.start()] == name and unit_in(plain, variable.unit, SUFFIX):
            return name
    return ""


def _stated(name: str, unit: str) -> str:
    """Return the unit in the name of a column; empty without a unit or for the model's unit."""
    found = unit_in(name, unit, IN_BRACKETS, AFTER_SLASH) or unit_in(
        IN_BRACKETS.sub("", name), unit, SUFFIX
    )
    stated = IN_BRACKETS.search(name)
    if not found and stated and unit:  # without a unit of the model, numbers are not converted
        found = f"{BLANK} {stated[1]}"
    return "" if found == unit else found


def _sensor(equation: Equation, key: str, column: str, name: str, values: Array) -> FoundChannel:
    """Return a sensor with the position and unit in the name of its column."""
    at, remark = _place(equation, name)
    comments = [_range(values), *filter(None, [remark])]
    given: dict[str, Any] = {"role": "sensor", "column": column, "at": at}
    if equation.components:
        given["of"] = equation.components[0]
        comments.append(f"of {' or '.join(equation.components)}")
    unit, model = _unit_of_sensor(name, equation.state.unit), equation.state.unit
    stated = unit.removeprefix(BLANK).strip()
    flux = equation.fluxes.flux if equation.fluxes and equation.conductivity else ""
    if unit.startswith(BLANK) and flux and converts(stated, flux):
        given["quantity"], unit, model = FLUX, stated, flux
        comments.append('flux along x, at an end: at = "left" or "right"')
    same = converts(unit, model) and conversion(unit, model, name) == Affine()  # °C
    given |= {"unit": unit} if unit and not same else {}
    return FoundChannel(key, given, (column,), ", ".join(comments))


def _place(equation: Equation, name: str) -> tuple[Any, str]:
    """Return the position in the name of a sensor's column, or a blank, and a remark."""
    place, fraction = PLACE.search(name), FRACTION.search(name)
    at = _open(equation.length_unit)
    if equation.dimension > 1:
        # A name contains at most one coordinate, so the position remains a blank.
        return [at] * equation.dimension, ""
    if place is not None and equation.length_unit:
        return f"{place[1].replace(',', '.')} {place[2]}", "position from the name"
    return at, "" if fraction is None else f'at = "{fraction[0]} {equation.length_unit}"?'


def _unit_of_sensor(name: str, unit: str) -> str:
    """Return the unit in the name of a sensor's column; empty if there is none."""
    bracket, slash = IN_BRACKETS.search(name), AFTER_SLASH.search(name)
    placed = bracket and PLACE.fullmatch(bracket[1].strip())
    if bracket and not placed:
        return unit_in(name, unit, IN_BRACKETS) or (f"{BLANK} {bracket[1]}" if unit else "")
    if slash:
        asked = unit and in_si(slash[1]) is not None
        return unit_in(name, unit, AFTER_SLASH) or (f"{BLANK} {slash[1]}" if asked else "")
    if placed:
        return ""
    return _unit_at_end(name, unit)


def _unit_at_end(name: str, unit: str) -> str:
    """Return the unit at the end of the name of a column, as in T_degC; empty if none."""
    suffixes = ((pattern, pattern.search(name)) for pattern in (SUFFIX, LAST))
    named = (one for one, suffix in suffixes if suffix and suffix["unit"] not in NO_UNITS)
    return next(filter(None, (unit_in(name, unit, pattern) for pattern in named)), "")


def _in_families(equation: Equation, found: list[FoundChannel]) -> list[FoundChannel]:
    """Return the channels, with numbered sensors of unknown position (u_0, u_1, ...) combined."""

    def stem_of(item: FoundChannel) -> tuple[str, bool]:
        # The column of a numbered sensor without its number, and True; else the name, and False.
        numbered = NUMBERED.fullmatch(item.columns[0])
        open_ = item.is_sensor and BLANK in str(item.given["at"]) and "unit" not in item.given
        return (numbered[1], True) if numbered and open_ else (item.name, False)

    result: list[FoundChannel] = []
    for (stem, numbered), items in groupby(found, stem_of):
        members = list(items)
        whole = numbered and len(members) >= FAMILY
        result += [_family(equation, stem, members)] if whole else members
    return result


def _family(equation: Equation, stem: str, members: list[FoundChannel]) -> FoundChannel:
    """Return numbered sensors as a family, with `each` if they may be evenly spaced."""
    columns = tuple(item.columns[0] for item in members)
    count, first = len(members), members[0].given
    given = {key: value for key, value in first.items() if key not in ("column", "at")}
    if equation.dimension == 1 and columns == tuple(f"{stem}{k}" for k in range(count)):
        given |= {"column": f"{stem}{{}}", "each": [first["at"], first["at"], count]}
        comment = f'evenly from ... to ...; else positions = "{PLACES}" (name, x)'
    else:
        given |= {"positions": PLACES}
        comment = "fill in the places there"
    label = re.sub(r"\W+", "_", stem).strip("_") or "sensor"
    return FoundChannel(label, given, columns, comment)


def _range(values: Array) -> str:
    """Return the range of a column and its number of missing values as text."""
    present = values[np.isfinite(values)]
    missing = len(values) - len(present)
    if not len(present):
        return "nothing"
    text = f"{present.min():.4g} to {present.max():.4g}"
    return f"{text}, {missing} missing" if missing else text


def write_template(
    folder: Path, table: Path | None = None, equation: Equation = EQUATIONS["heat"]
) -> tuple[Path, Path]:
    """Write a commented case into a folder, and return the paths of case and data.

    The case is for a table of measurements, or for synthetic data that are written next to it.
    """
    if table is None:
        text = HEAD.format(case=folder / "case.toml") + ROD.read_text(encoding="utf-8")
        made = ROD.with_suffix(".csv").read_text(encoding="utf-8")
        write_files(folder, {"rod.csv": made, "case.toml": text})
        return folder / "case.toml", folder / "rod.csv"
    check_free(folder, ["case.toml"])
    found = measured(table, equation.time_unit)
    write_files(folder, files_for(found, folder, equation))
    return folder / "case.toml", table


def files_for(table: Measured, folder: Path, equation: Equation) -> dict[str, str]:
    """Return name -> text of the files of a case for a table."""
    files = {"case.toml": _case_for(table, folder, equation)}
    named = [one for one in channels_in(table, equation) if one.given.get("positions") == PLACES]
    columns = [column for one in named for column in one.columns]
    if columns:  # table of positions to be filled in
        axes = "xyz"[: equation.dimension]
        rows = [["name", *axes], *([column, *BLANK * len(axes)] for column in columns)]
        files[PLACES] = "".join(f"{','.join(row)}\n" for row in rows)
    return files


def check_free(folder: Path, names: Iterable[str]) -> None:
    """Raise `RunError` if a folder is a file or contains one of these files."""
    if folder.is_file():
        raise RunError(f"{folder} is a file: 'livepde init DIR --data {folder}' takes a table.")
    for path in (folder / name for name in names):
        if path.exists():
            raise RunError(f"{path} exists. Choose another folder. Nothing was written.")


def write_files(folder: Path, files: Mapping[str, str]) -> None:
    """Write files and the schema of cases into a folder; raises `RunError` if a file exists."""
    check_free(folder, files)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in {**files, SCHEMA_FILE: schema_text()}.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunError(f"{folder}: cannot be written: {error.strerror or error}.") from error
