"""Commands `init`, `equations` and `schema`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from livepde.cases import new_case
from livepde.cases.data import missing_in, zone_named
from livepde.cases.measured import Measured, measured
from livepde.cases.read import blanks_in, filled, parse, read_toml, toml_value
from livepde.cli.options import names_in, option
from livepde.cli.printing import extent, named, print_table, terminal
from livepde.errors import ConfigurationError
from livepde.models import EQUATIONS, Equation
from livepde.runs import Table


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write to.")],
    data: Annotated[
        list[Path] | None,
        option(
            "Table of measurements with a header. The case is filled in from it. Repeatable: "
            "several tables are joined by time.",
            metavar="FILE.csv",
        ),
    ] = None,
    equation: Annotated[
        str | None,
        typer.Option(
            help="With --data: equation, as listed by 'livepde equations'. Default: heat.",
            autocompletion=names_in("livepde.models:EQUATIONS"),
            show_default=False,
        ),
    ] = None,
    time_format: Annotated[
        str,
        option(
            "With --data: format of its dates, such as '%d.%m.%Y %H:%M'. Default: detected.",
            metavar="FORMAT",
        ),
    ] = "",
    skip: Annotated[
        int | None,
        option("With --data: number of lines before the header. Default: detected.", min=0),
    ] = None,
    settings: Annotated[
        list[str] | None,
        option(
            "With --data: set a case key, such as mesh.to='40 cm'. Repeatable.",
            "--set",
            metavar="KEY=VALUE",
        ),
    ] = None,
) -> None:
    """Write a commented case, with synthetic data or for your own table.

    If you give a table, replace each '?' in the case: the table has no value for it.

    Example:  livepde init mycase
    Your own: livepde init mycase --data measured.csv --equation groundwater
    """
    console = terminal()
    if not data:
        given = {"--equation": equation, "--time-format": time_format, "--set": settings}
        for option, value in {**given, "--skip": skip}.items():
            if value not in (None, "", []):
                raise ConfigurationError(f"{option} requires --data FILE.csv.")
        case, table = new_case.write_template(folder)
        console.print(f"Wrote {case} and {table}. Next:")
    else:
        if equation is not None and ":" in equation:
            raise ConfigurationError(
                f"--equation accepts built-in equations only. Start with any of them, and write "
                f"'{equation}' into the case."
            )
        new_case.check_free(folder, ["case.toml"])
        found = named(equation or "heat", EQUATIONS, "equation")
        case = folder / "case.toml"
        _begin(console, case, data, found, parse(settings or []), time_format, skip)
    console.print(f"  livepde check {case}\n  livepde run {case}")


def _begin(
    console: Console,
    case: Path,
    data: Sequence[Path],
    equation: Equation,
    changes: dict[str, Any],
    time_format: str,
    skip: int | None,
) -> None:
    """Write a case for tables with changed keys, and print a summary with the keys to fill in."""
    zone = zone_named(str(changes.get("data.zone") or "UTC"), "--set data.zone")
    missing = missing_in(changes.get("data.missing"), "--set data.missing")
    if missing:  # `files_for` writes them; an empty setting removes the key and detected markers
        del changes["data.missing"]
    how: dict[str, Any] = {"time_format": time_format, "skip": skip, "zone": zone}
    how |= {"missing": missing, "stated": str(changes.get("data.time_unit") or "")}
    how |= {key: str(changes.get(f"data.{key}") or "") for key in ("sensor", "value")}
    first, *others = (measured(file, equation.time_unit, **how) for file in data)
    read = reduce(Measured.joined, others, first)
    equation = new_case.in_unit_of(read, equation, str(changes.get("options.unit") or ""))
    files = new_case.files_for(read, case.parent, equation)
    _show_read(console, read, equation)
    files["case.toml"] = filled(files["case.toml"], changes, f"{case}")
    new_case.write_files(case.parent, files)
    _show_written(console, case, data, files)


def _show_written(
    console: Console, case: Path, data: Sequence[Path], files: Mapping[str, str]
) -> None:
    """Print the names of the written files, and the keys to fill in there."""
    blanks = blanks_in(read_toml(files["case.toml"], str(case)))
    places = [f"{key} = {toml_value(value)}" for key, value in blanks.items()]
    places += [f"positions in {case.parent / name}" for name in files if name != "case.toml"]
    task = f"replace each '?' ({len(places)})" if places else "nothing is left open. Next"
    *others, last = map(str, data)
    tables = f"{', '.join(others)} and {last}" if others else last
    console.print(f"Wrote {case} for {tables}: {task}:")
    for place in places:
        console.print(escape(f"  {place}"))
    if places:
        console.print("Next:")


def _show_read(console: Console, read: Measured, equation: Equation) -> None:
    """Print a summary of the tables: times, and columns with roles, units and ranges."""
    rows = [_channel_row(item, read, equation) for item in new_case.channels_in(read, equation)]
    for table in read.tables:
        rows += [(name, "row number", "", "", "", "", "") for name in table.row_numbers]
        rows += [(name, "text", "", "", "", "", "") for name in table.texts]
    headings = ("column", "role", "channel", "unit", "least", "largest", "missing")
    for table in read.tables:
        console.print(f"{escape(f'{table.path}: {table.span}')}.")
    print_table(console, Table(f"Times in {' and '.join(read.time)}", headings, rows))


def _channel_row(
    item: new_case.FoundChannel, read: Measured, equation: Equation
) -> tuple[Any, ...]:
    """Return columns, role, name, unit, minimum, maximum and missing values of a channel."""
    role, given = item.given["role"], item.given.get("unit", "")
    model = (equation.inputs[item.name] if role == "input" else equation.state).unit
    if item.given.get("quantity") == "flux" and equation.fluxes is not None:
        model = equation.fluxes.flux
    block = np.array([read.columns[name] for name in item.columns])
    first, *rest = item.columns or ("?",)
    columns = f"{first} ... {rest[-1]}" if rest else first
    *ends, gaps = extent(block)
    return columns, role, item.name, given or model, *ends, gaps if item.columns else ""


def equations(
    name: Annotated[
        str,
        typer.Argument(
            help="Name of an equation. 'list' lists them.",
            autocompletion=names_in("livepde.models:EQUATIONS"),
        ),
    ] = "list",
) -> None:
    """List the built-in equations, or show the case keys of one of them.

    Example:  livepde equations heat
    """
    console = terminal()
    if name == "list":
        for item in EQUATIONS.values():
            console.print(f"[bold]{item.name}[/]  {escape(item.summary)}")
        return
    found = named(name, EQUATIONS, "equation")
    console.print(f"[bold]{found.name}[/]  {escape(found.summary)}")
    console.print(escape(found.formula))
    columns = ("table", "key", "meaning", "unit", "default")
    print_table(console, Table("Keys of a case", columns, _entries(found)))
    console.print(f"Length in {found.length_unit or '1'}, time in {found.time_unit or '1'}.")


def _entries(found: Equation) -> list[tuple[str, ...]]:
    """Return the case keys of an equation as rows: table, key, meaning, unit, default."""
    unit = found.state.unit
    rows: list[tuple[str, ...]] = [("state", "u", found.state.text, unit, "")]
    for table, known in (("[unknowns]", found.unknowns), ("[channels], input", found.inputs)):
        rows += [(table, key, item.text, item.unit, "") for key, item in known.items()]
    for key, entry in found.options.items():
        default = "needed" if entry.default is None else str(entry.default)
        choices = f" ({', '.join(entry.choices)})" if entry.choices else ""
        rows.append(("[options]", key, entry.text + choices, entry.unit, default))
    for key, item in found.quantities.items():
        rows.append(("[channels], quantity", key, item.text, unit, ""))
    if found.fluxes is not None:
        flux, transfer, source = found.fluxes
        rows += [
            ("[boundary.NAME]", "flux", "flux into the domain", flux, ""),
            ("[boundary.NAME]", "transfer", "coefficient of exchange", transfer, ""),
            ("[boundary.NAME]", "ambient", "of that exchange", unit, ""),
            ("[sources.NAME]", "value", "gained in a region", source, ""),
        ]
    return rows


def schema() -> None:
    """Print the JSON schema of case files: editors use it to complete and explain keys.

    The first line of a case names it: #:schema ./livepde.schema.json

    Example:  livepde schema > livepde.schema.json
    """
    text = new_case.schema_text().rstrip()
    terminal().print(text, markup=False)
