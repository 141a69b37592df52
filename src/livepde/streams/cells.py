"""Conversion of table cells to numbers, and texts for missing values."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable
from typing import Any, TypeAlias

from livepde.errors import SampleError

Missing: TypeAlias = Collection[float | str]
"""Numbers and texts in a table that stand for a missing value."""

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--", "---", "#n/a", "#nv"})
LIMIT = re.compile(r"\s*[<>≤≥]\s*(.+?)\s*")  # such as <0.5: outside the range of an instrument
COMMA = "if that is a decimal comma, set decimal = ','."
NO_POINT = "with decimal = ',', a point is not a decimal mark."
POINT = str.maketrans(",.", ".,")  # swaps both, so that a number with a point is refused
MOST = 5  # largest number of texts in a message


def number_of(cell: Any, decimal: str = ".") -> float | None:
    """Return a number, or a text that contains a number, as float; otherwise None."""
    try:
        if isinstance(cell, str):
            if "_" in cell:  # Python would convert 1_000 to 1000
                return None
            cell = cell if decimal == "." else cell.translate(POINT)
        return None if isinstance(cell, bool) else float(cell)
    except (TypeError, ValueError, OverflowError):
        return None


def has_decimal_comma(cell: Any) -> bool:
    """Return whether a cell is a number with a decimal comma."""
    return isinstance(cell, str) and "," in cell and number_of(cell, ",") is not None


def is_limit(cell: str) -> bool:
    """Return whether a text is a detection limit, such as <0.5."""
    found = LIMIT.fullmatch(cell)
    return found is not None and number_of(found[1].replace(",", ".")) is not None


def is_missing(cell: Any, missing: Missing = ()) -> bool:
    """Return whether a cell is empty or stands for a missing value.

    >>> is_missing(" NaN"), is_missing("OVER"), is_missing("OVER", ["OVER"])
    (True, False, True)
    """
    if not isinstance(cell, str):
        return cell is None
    text = cell.strip()
    return text.lower() in MISSING or text in missing


def cell_number(
    value: Any,
    where: str,
    decimal: str = ".",
    missing: Missing = (),
    others: Iterable[Any] = (),
) -> float:
    """Convert a cell to float, NaN if the value is missing.

    `missing`: texts and numbers that stand for a missing value. `others`: other cells of the
    column, whose texts are also listed in an error message.
    """
    if is_missing(value, missing):
        return math.nan
    number = number_of(value, decimal)
    if number is None:
        remedy = _remedy(value, decimal, [value, *others], missing)
        raise SampleError(f"{where}: got {value!r}; {remedy}")
    if math.isinf(number):
        raise SampleError(
            f"{where}: got {value!r}; a channel must be finite (leave it empty if it is missing)."
        )
    return math.nan if number in missing else number


def _remedy(value: Any, decimal: str, cells: Iterable[Any], missing: Missing) -> str:
    """Return the end of the message about a cell that is not a number."""
    if decimal == "." and has_decimal_comma(value):
        return COMMA
    if decimal != "." and number_of(value) is not None:
        return NO_POINT
    if not isinstance(value, str):
        return "expected a number (leave it empty if it is missing)."

    def odd(cell: Any) -> bool:
        read = is_missing(cell, missing) or number_of(cell, decimal) is not None
        return isinstance(cell, str) and not read and "'" not in cell

    texts = dict.fromkeys(cell.strip() for cell in cells if odd(cell))
    stated = [one for one in missing if isinstance(one, str)]
    key = f"data.missing={[*stated, *list(texts)[:MOST]]}"
    return (
        f'expected a number. If such text means a missing value, add --set "{key}", or this key '
        "to the case."
    )
