"""Types of single values in a case file: quantities, places, dates, names, bounds."""

from __future__ import annotations

import codecs
import re
from datetime import date, datetime
from typing import Annotated, Any, TypeAlias

from pydantic import AfterValidator, BeforeValidator, Field

from livepde.runs.outcome import Bound, Sense

__all__ = [
    "Box",
    "Encoding",
    "Expected",
    "Identifier",
    "Instant",
    "Name",
    "Pair",
    "Point",
    "Quantity",
    "TimeFormat",
]


def _quantity(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        message = 'expected a number, or text with a unit as "20 h"'
        raise ValueError(message)  # noqa: TRY004 (pydantic collects ValueErrors only)
    return value if isinstance(value, str) else float(value)


def _limits(value: Any) -> Any:
    """[low, high], "<= number" or ">= number" -> (sense, bound)."""
    if isinstance(value, list) and len(value) == 2:
        low, high = value
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
            return "in", (float(low), float(high))
    if isinstance(value, str):
        match = re.fullmatch(r"\s*(<=|>=)\s*([-+0-9.eE]+)\s*", value)
        if match:
            try:
                return match[1], float(match[2])
            except ValueError:
                pass
    raise ValueError('expected [low, high], "<= number" or ">= number"')


def _encoding(value: str) -> str:
    try:
        codecs.lookup(value)
    except LookupError:
        raise ValueError("expected the name of an encoding, as 'utf-8', 'cp1252'") from None
    return value


def _time_format(value: str) -> str:
    moment = datetime(2001, 2, 3, 4)
    try:
        # A complete format returns the date that was written with it.
        if datetime.strptime(moment.strftime(value), value).date() == moment.date():
            return value
    except (ValueError, re.error):  # the latter of a part that stands twice
        pass
    raise ValueError("expected year, month, day and time, as '%d.%m.%Y %H:%M'")


def _flat(value: Any) -> Any:
    """{"k": {"error": x}} -> {"k.error": x}: TOML reads k.error = x as a table."""
    if not isinstance(value, dict):
        return value
    found: dict[str, Any] = {}
    for name, item in value.items():
        inner = _flat(item)
        if isinstance(inner, dict):
            found |= {f"{name}.{key}": one for key, one in inner.items()}
        else:
            found[name] = item
    return found


Quantity: TypeAlias = Annotated[float | str, BeforeValidator(_quantity)]
Pair: TypeAlias = tuple[Quantity, Quantity]
Point: TypeAlias = Quantity | tuple[Quantity, ...]
Box: TypeAlias = tuple[Quantity, Quantity, Quantity, Quantity]
Instant: TypeAlias = date | datetime | float | str
Encoding: TypeAlias = Annotated[str, AfterValidator(_encoding)]
Name: TypeAlias = Annotated[str, Field(min_length=1)]
Identifier: TypeAlias = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
TimeFormat: TypeAlias = Annotated[str, AfterValidator(_time_format)]
Expected: TypeAlias = Annotated[
    dict[str, Annotated[tuple[Sense, Bound], BeforeValidator(_limits)]], BeforeValidator(_flat)
]
