"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any

import typer

from livepde import cases
from livepde.cases import Case
from livepde.cases.read import parse
from livepde.errors import CaseError, RunError


def option(text: str, *names: str, **more: Any) -> Any:
    """Return an option without a displayed default: its help text states it if necessary."""
    return typer.Option(*names, help=text, show_default=False, **more)


def argument(text: str, **more: Any) -> Any:
    """Return an argument without a displayed default."""
    return typer.Argument(help=text, show_default=False, **more)


JsonOption = Annotated[
    bool, option("Print one JSON object. If a check fails, exit with code 1.", "--json")
]
OutOption = Annotated[Path | None, option("Run directory to create. Default: a new one in runs/.")]
CodeOption = Annotated[
    bool,
    option("Load the Python code (equation or reader) that the case names.", "--allow-code"),
]
EnvOption = Annotated[
    list[str] | None,
    option(
        "Allow the case to send this environment variable as a password (`password_env`). "
        "Repeatable. Not required for names that begin with LIVEPDE_.",
        "--allow-env",
        metavar="NAME",
    ),
]
SetOption = Annotated[
    list[str] | None,
    option(
        "Override a case setting, such as `law.noise='2 K'`. An empty value removes the key. "
        "Repeatable.",
        "--set",
        metavar="KEY=VALUE",
    ),
]
RunArgument = Annotated[Path, argument("A run directory.", metavar="RUN")]
ForceOption = Annotated[bool, option("Overwrite existing files.", "--force")]
DataOption = Annotated[
    str | None, option("Use this data instead of the case's (.csv, .jsonl, .parquet).")
]
CaseArgument = Annotated[Path, argument("The case file (TOML).")]


def names_in(place: str) -> Callable[[str], list[str]]:
    """Return a shell completion: keys of `module:MAPPING` that begin with the typed text.

    The module is imported on completion only.
    """

    def complete(incomplete: str) -> list[str]:
        return [name for name in resolve_name(place) if name.startswith(incomplete)]

    return complete


def load_case(case: Path, allow_code: bool, settings: Sequence[str] | None) -> Case:
    """Read a case with the settings of the command line."""
    return cases.load(case, allow_code=allow_code, settings=parse(settings or ()))


@contextmanager
def of_a_run(stored: bool) -> Iterator[None]:
    """Convert a `CaseError` to a `RunError` with a remedy if the case is stored in a run."""
    try:
        yield
    except CaseError as error:
        if not stored:
            raise
        moved = "The case has been moved or changed. Add --data FILE with its data."
        raise RunError(f"{error} {moved}") from error
