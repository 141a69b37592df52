"""Questions of `livepde init` on a terminal about a table of measurements."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import typer

from livepde.cases.fill import Blank, blanks, filled, with_channel
from livepde.cases.read import parse
from livepde.cases.units import convert
from livepde.errors import CaseError
from livepde.models import Equation

__all__ = ["answered", "asks", "date_order"]

ENDS = ("left", "right")
TEXTS = ("column", "unit", "time_unit", "positions")  # keys whose values are no quantities
SKIP = "Press Enter to leave a question open."


def asks() -> bool:
    """Return whether standard input is a terminal."""
    return sys.stdin.isatty()


def date_order(column: str, cell: str, formats: Sequence[str]) -> str:
    """Ask for the order of day, month and year."""
    known = {str(k): form for k, form in enumerate(formats, start=1)}
    shown = "\n".join(f"  {k}  {form}" for k, form in known.items())
    typer.echo(f"How is '{cell}' in column '{column}' to be read?\n{shown}")
    while (number := typer.prompt("Number").strip()) not in known:
        typer.echo(f"Expected one of {', '.join(known)}.")
    return known[number]


def answered(text: str, equation: Equation, columns: Sequence[str], where: str) -> str:
    """Return the text of a case with answers filled in; skipped questions stay blank."""
    if blanks(text):
        typer.echo(SKIP)
    asked: set[str] = set()
    while left := [item for item in blanks(text) if item.key not in asked]:
        blank = left[0]
        asked.add(blank.key)
        text = _ask(text, blank, equation, columns, where)
    return text


def _ask(text: str, blank: Blank, equation: Equation, columns: Sequence[str], where: str) -> str:
    """Ask until the answer fits or the question is skipped."""
    while True:
        given = typer.prompt(_question(blank, equation), default="", show_default=False).strip()
        if not given:
            return text
        # An input with the name of a column is measured: a channel, and no constant.
        if blank.path[0] == "inputs" and given in columns:
            channel = {"role": "input", "column": given}
            return with_channel(filled(text, {blank.key: None}, where), blank.path[1], channel)
        try:
            return filled(text, _settings(blank, given, equation, columns), where)
        except CaseError as error:
            typer.echo(str(error))


def _question(blank: Blank, equation: Equation) -> str:
    """Return a question in one line: key, unit, and the comment of the line."""
    unit = f" [{blank.unit}]" if blank.unit else ""
    about = blank.comment.removeprefix("#").strip()
    more = ""
    if _is_place(blank):
        ends = "left or right for a value given there, " if equation.takes_values else ""
        quantities = "".join(f"{name}, " for name in equation.quantities)
        more = f" ({quantities}{ends}- to drop it)"
    elif blank.path[0] == "inputs":
        more = " (or the name of its column)"
    elif isinstance(blank.value, list):
        more = " (two, with a comma between them)"
    return f"{blank.key}{unit}{more}{': ' if about else ''}{about}\n "


def _is_place(blank: Blank) -> bool:
    return blank.path[0] == "channels" and blank.path[-1] == "at" and isinstance(blank.value, str)


def _settings(
    blank: Blank, given: str, equation: Equation, columns: Sequence[str]
) -> Mapping[str, Any]:
    """Return the settings of the case that an answer means."""
    if _is_place(blank) and (place := _place(blank, given, equation)):
        return place
    if blank.path[-1] == "column" and given not in columns:
        raise CaseError(f"There is no column '{given}' among {', '.join(columns)}.")
    if blank.path[-1] in TEXTS:
        return {blank.key: given}
    if isinstance(blank.value, list):
        return {blank.key: _quantities(given, blank)}
    return {blank.key: _quantity(given, blank)}


def _place(blank: Blank, given: str, equation: Equation) -> Mapping[str, Any]:
    """Return the settings of a place that is no point: none, a quantity or an end; else nothing."""
    channel = ".".join(blank.path[:-1])
    if given == "-":
        return {channel: None}
    if given in equation.quantities:
        return {f"{channel}.at": None, f"{channel}.quantity": given}
    if given in ENDS and equation.takes_values:
        return {f"{channel}.role": "boundary", f"{channel}.at": given}
    return {}


def _quantities(given: str, blank: Blank) -> list[Any]:
    """Return a list with the answer's quantities in the place of its texts, which stand first."""
    parts = [part.strip() for part in given.split(",")]
    rest = [value for value in blank.value if not isinstance(value, str)]
    count = len(blank.value) - len(rest)
    if len(parts) != count:
        raise CaseError(f"Got {len(parts)} values; expected {count}, as 0, 1.")
    return [*(_quantity(part, blank) for part in parts), *rest]


def _quantity(given: str, blank: Blank) -> Any:
    """Return a number with the unit of the question, or the unit that was given."""
    (value,) = parse([f"x={given}"]).values()
    difference = blank.path[-1] in ("std", "noise")
    if isinstance(value, str):
        convert(value, blank.unit, blank.key, difference=difference)
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CaseError(f"{blank.key}: got {given}; expected a number.")
    return f"{value:g} {blank.unit}" if blank.unit else value
