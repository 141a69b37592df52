"""To begin with: a case to start from, and the ready-made equations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from livepde.cli.options import names_in
from livepde.cli.printing import (
    named,
    print_table,
    terminal,
)
from livepde.errors import ConfigurationError

__all__ = ["equations", "init"]


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write to.")],
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="Your own table, with a header: what it tells is filled in.",
            show_default=False,
        ),
    ] = None,
    equation: Annotated[
        str | None,
        typer.Option(
            help="With --data: one of those that 'livepde equations' shows. Default: heat.",
            autocompletion=names_in("livepde.models:EQUATIONS"),
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a commented case to start from, with made-up data that it runs on, or for your own.

    Example:  livepde init mycase
    Your own: livepde init mycase --data measured.csv --equation groundwater
    """
    from livepde.cases.template import write_template
    from livepde.models import EQUATIONS

    if equation is not None and data is None:
        raise ConfigurationError("--equation belongs to a table of your own: add --data FILE.csv.")
    if equation is not None and ":" in equation:
        raise ConfigurationError(
            f"--equation takes a ready-made one: begin with any, and write '{equation}' into the "
            "case."
        )
    found = named(equation or "heat", EQUATIONS, "equation")
    case, table = write_template(folder, data, found)
    console = terminal()
    if data is None:
        console.print(f"Wrote {case} and {table}. Next:", soft_wrap=True)
    else:
        console.print(
            f"Wrote {case} for {data}: fill in what it says '?' for. Next:", soft_wrap=True
        )
    console.print(f"  livepde check {case}\n  livepde run {case}", soft_wrap=True)


def equations(
    name: Annotated[
        str,
        typer.Argument(
            help="Name of an equation; 'list' shows them.",
            autocompletion=names_in("livepde.models:EQUATIONS"),
        ),
    ] = "list",
) -> None:
    """Show the ready-made equations, and what a case says about one of them.

    Example:  livepde equations heat
    """
    from livepde.models import EQUATIONS
    from livepde.runs import Table

    console = terminal()
    if name == "list":
        for item in EQUATIONS.values():
            console.print(f"[bold]{item.name}[/]  {escape(item.summary)}", soft_wrap=True)
        return
    found = named(name, EQUATIONS, "equation")
    console.print(f"[bold]{found.name}[/]  {escape(found.summary)}", soft_wrap=True)
    console.print(escape(found.formula), soft_wrap=True)
    rows = [("state", "u", found.state.text, found.state.unit, "")]
    for table, known in (("[unknowns]", found.unknowns), ("[channels], input", found.inputs)):
        rows += [(table, key, item.text, item.unit, "") for key, item in known.items()]
    for key, option in found.options.items():
        default = "needed" if option.default is None else str(option.default)
        choices = f" ({', '.join(option.choices)})" if option.choices else ""
        rows.append(("[options]", key, option.text + choices, option.unit, default))
    unit = found.state.unit
    rows += [
        ("[channels], quantity", key, item.text, unit, "") for key, item in found.quantities.items()
    ]
    if found.fluxes is not None:
        flux, transfer, source = found.fluxes
        rows += [
            ("[boundary.NAME]", "flux", "flux into the domain", flux, ""),
            ("[boundary.NAME]", "transfer", "coefficient of exchange", transfer, ""),
            ("[boundary.NAME]", "ambient", "of that exchange", unit, ""),
            ("[sources.NAME]", "value", "gained in a region", source, ""),
        ]
    columns = ("where", "name", "what", "unit", "default")
    print_table(console, Table("What a case says about it", columns, rows))
    console.print(f"Length in {found.length_unit or '1'}, time in {found.time_unit or '1'}.")
