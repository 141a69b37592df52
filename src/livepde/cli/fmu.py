"""Write an identifier as a co-simulation unit for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from livepde.cli.options import CodeOption, JsonOption, SetOption, load_case
from livepde.cli.printing import CHECK_FAILED, print_json, show, terminal
from livepde.errors import ConfigurationError

if TYPE_CHECKING:
    from livepde.cases import Case
    from livepde.runs import Check, Table

__all__ = ["fmu"]

CLOSE = 1e-10  # relative difference of any output, between the unit and the identifier


class Standard(StrEnum):
    """Versions of the interface."""

    two = "2"
    three = "3"


def fmu(
    source: Annotated[
        str,
        typer.Argument(
            metavar="CASE",
            help="The case file (TOML); or file.py:function or module:function of your own, which "
            "returns an Identifier.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="File to write. Default: the case's name.", show_default=False),
    ] = None,
    fmi: Annotated[Standard, typer.Option(help="Version of the standard: FMI 2.0 or 3.0.")] = (
        Standard.two
    ),
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Run the unit (by FMPy) on the data of the case, then the identifier in Python, "
            "and compare all outputs: takes as long as two runs of the case.",
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Write a case as a co-simulation unit (FMU) for Simulink, Modelica tools and others.

    Its inputs are the channels of the case, its outputs the estimates with their deviations, the
    model's value at each sensor, and a status. Where it runs, Python has to find livepde.

    Example:  livepde fmu mycase/case.toml --out rod.fmu --verify
    """
    from livepde.exchange.export import is_code, write_unit
    from livepde.exchange.recipe import recipe_of

    if is_code(source) and (settings or verify):
        raise ConfigurationError(
            f"{'--verify' if verify else '--set'} belongs to a case; {source} is code."
        )
    case = None if is_code(source) else load_case(Path(source), allow_code, settings)
    recipe = recipe_of(case or source)
    process = recipe.process
    path = write_unit(recipe, out, fmi=2 if fmi is Standard.two else 3, force=force)
    shown, checks = _compared(path, case) if verify and case is not None else ([], [])
    if as_json:
        print_json(shown, checks, process.notes, unit=str(path))
    else:
        show(terminal(), shown, checks, process.notes)
        inside = f"{len(process.inputs)} inputs, {len(process.outputs()) + 1} outputs"
        terminal().print(escape(f"Written: {path} ({inside})"), soft_wrap=True)
    if as_json and not all(check.ok for check in checks):
        raise typer.Exit(CHECK_FAILED)


def _compared(path: Path, case: Case) -> tuple[list[Table], list[Check]]:
    from livepde.exchange import compare_fmu
    from livepde.runs import Check, Table

    found = compare_fmu(path, case, progress=True)
    rows = [[name, value] for name, value in found.differences.items()]
    title = f"Unit and identifier after each of {found.samples} samples"
    table = Table(title, ["output", "largest relative difference"], rows)
    return [table], [Check("largest relative difference", found.largest, CLOSE, "<=")]
