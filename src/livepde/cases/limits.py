"""Limits of size, depth and numbers of a case, checked before anything is built."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from livepde.errors import CaseError

__all__ = [
    "CELLS",
    "LARGEST",
    "MEMBERS",
    "SMALLEST",
    "check_cells",
    "check_document",
    "check_text",
    "check_unit",
]

DEPTH = 32  # tables, lists and parts of a key within one another
LARGEST = 1e60  # of a number: products of four are finite
SMALLEST = 1e-60  # of a standard deviation, a rate, a length
CELLS = 2_000_000  # of a mesh that a case describes itself
MEMBERS = 10_000  # channels of one `each`
COUNTS = {  # keys that say how much is kept or tried -> the most
    "every": 1_000_000,
    "fields_every": 1_000_000_000,
    "harmonics": 100,
    "iterations": 1000,
    "modes": 10_000,
    "past": 10_000,
    "queue": 10_000_000,
    "seeds": 10_000,
    "temperings": 100,
    "thin": 1_000_000_000,
    "window": 100_000,
}
OTHER = 1_000_000_000  # of any other whole number
FREE = ("data.missing",)  # keys whose numbers only stand for something
NAMES = 10_000  # of a table
UNIT = 100  # characters of a unit
LONGEST = 200  # characters of a name
POWER = r"(?:\^|\*\*)"
NAME = re.compile(r"[\w\"'-]+")
DOTTED = re.compile(r"(?:a\s?\.\s?){" + str(DEPTH) + "}")
DIGITS = re.compile(r"[0-9_]{400}")


def check_text(text: str, where: str) -> None:
    """Refuse a document that would take long to read, before it is read."""
    if DOTTED.search(NAME.sub("a", text)):
        raise CaseError(f"{where}: a key has more than {DEPTH} parts; a case needs few.")
    if DIGITS.search(text):
        raise CaseError(f"{where}: a number has 400 digits or more; write it shorter, as 2.5e9.")


def check_document(document: Mapping[str, Any], where: str) -> None:
    """Refuse numbers and depths that no case needs."""
    for key, value, depth in _values(document, where):
        if depth > DEPTH:
            text = f"more than {DEPTH} tables or lists within one another"
            raise CaseError(f"{where}: {key[:LONGEST]}: {text}.")
        if max(map(len, key.split("."))) > LONGEST:
            raise CaseError(f"{where}: {key[:LONGEST]}...: a name has at most {LONGEST} letters.")
        if key.startswith(FREE) or isinstance(value, bool):
            continue
        name = key.rpartition(".")[2]
        if isinstance(value, int) and abs(value) > COUNTS.get(name, OTHER):
            most = COUNTS.get(name, OTHER)
            raise CaseError(f"{where}: {key}: got {_digits(value)}; expected at most {most}.")
        if isinstance(value, float) and LARGEST < abs(value) < float("inf"):
            raise CaseError(f"{where}: {key}: got {value:g}; expected less than {LARGEST:g}.")


def _digits(value: int) -> str:
    return str(value) if abs(value) < 10**20 else f"a number of {value.bit_length()} bits"


def _values(value: Any, where: str) -> Iterator[tuple[str, Any, int]]:
    """Iterate over all values with their keys and depths; deeper levels are not entered."""
    stack: list[tuple[str, Any, int]] = [("", value, 0)]
    while stack:
        key, value, depth = stack.pop()
        if depth > DEPTH or not isinstance(value, Mapping | list):
            yield key, value, depth
        elif isinstance(value, Mapping):
            if len(value) > NAMES:
                what = key or "the case"
                raise CaseError(
                    f"{where}: {what} has {len(value)} names; expected at most {NAMES}."
                )
            stack += [(f"{key}.{n}" if key else n, v, depth + 1) for n, v in value.items()]
        else:
            stack += [(key, item, depth + 1) for item in value]


def check_cells(number: float, where: str) -> None:
    """Refuse a mesh that is too large to be built here."""
    if number > CELLS:
        raise CaseError(
            f"{where}: got {number:.3g} cells; a mesh of a case has at most {CELLS}: take a file "
            "(mesh.file) for a larger one."
        )


def check_unit(unit: str, where: str) -> None:
    """Refuse a unit that is too long, or that raises a power to a power."""
    if len(unit) > UNIT:
        raise CaseError(f"{where}: a unit has at most {UNIT} characters; got {len(unit)}.")
    flat = re.sub(rf"\s*({POWER}|[()])\s*", r"\1", unit)
    if re.search(rf"{POWER}[-+(]*[0-9]{{3,}}", flat) or _towers(flat):
        raise CaseError(
            f"{where}: '{unit}' is not a unit: powers are numbers below 100, and none is raised to "
            "another."
        )
    if re.search(r"[0-9]{10}", flat):
        raise CaseError(f"{where}: '{unit}' is not a unit: its numbers have less than 10 digits.")


def _towers(unit: str) -> bool:
    """Return whether a power, or a group with a power in it, is raised to a power."""
    if re.search(rf"{POWER}[-+(]*[0-9.]*\)*{POWER}", unit):
        return True
    powers, marks = 0, []
    for match in re.finditer(rf"\(|\)|{POWER}", unit):
        sign = match[0]
        if sign == "(":
            marks.append(powers)
        elif sign == ")":
            inside = powers > (marks.pop() if marks else powers)
            if inside and re.match(POWER, unit[match.end() :]):
                return True
        else:
            powers += 1
    return False
