"""Write an identifier as a co-simulation unit for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from livepde.cli.options import CodeOption, JsonOption, SetOption, load_case
from livepde.cli.printing import print_json, show, terminal
from livepde.errors import ConfigurationError

__all__ = ["fmu"]


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
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Write a case as a co-simulation unit (FMU) for Simulink, Modelica tools and others.

    Its inputs are the channels of the case, its outputs the estimates with their deviations, the
    model's value at each sensor, and a status. Where it runs, Python has to find livepde.

    Example:  livepde fmu mycase/case.toml --out rod.fmu
    """
    from livepde.exchange.fmu_export import is_code, write_unit
    from livepde.exchange.recipe import recipe_of

    code = is_code(source)
    if code and settings:
        raise ConfigurationError(f"--set belongs to a case; {source} is code.")
    recipe = recipe_of(source if code else load_case(Path(source), allow_code, settings))
    process = recipe.process
    path = write_unit(recipe, out, fmi=2 if fmi is Standard.two else 3, force=force)
    if as_json:
        print_json([], [], process.notes, unit=str(path))
    else:
        show(terminal(), [], [], process.notes)
        inside = f"{len(process.inputs)} inputs, {len(process.outputs()) + 1} outputs"
        terminal().print(escape(f"Written: {path} ({inside})"), soft_wrap=True)
