"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from livepde.cases import Case

__all__ = ["CaseArgument", "CodeOption", "JsonOption", "OutOption", "SetOption", "load_case"]

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object, with 'checks'; exit 1 if one fails.")
]
OutOption = Annotated[
    Path | None,
    typer.Option(help="Run directory to make. Default: a new one in runs/.", show_default=False),
]
CodeOption = Annotated[
    bool,
    typer.Option(
        "--allow-code", help="Load the equation or reader of your own that the case names."
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Another value than the case has, as law.noise='2 K'. Repeat it for more.",
        show_default=False,
    ),
]
CaseArgument = Annotated[Path, typer.Argument(help="The case file (TOML).", show_default=False)]


def load_case(case: Path, allow_code: bool, settings: Sequence[str] | None) -> Case:
    """Read a case with the settings of the command line."""
    from livepde import cases
    from livepde.cases.settings import parse

    return cases.load(case, allow_code=allow_code, settings=parse(settings or ()))
