"""Types of tables and values in a case file, for validation by pydantic and for JSON schema."""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import date, datetime
from typing import Annotated, Any, TypeAlias

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    WithJsonSchema,
)
from pydantic_core import CoreSchema

from livepde.diagnostics.check_report import Bound, Sense
from livepde.streams.cells import number_of
from livepde.streams.clock import ELAPSED


class Spec(BaseModel):
    """A table of the case file: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=False)


def _quantity(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        message = 'expected a number, or text with a unit as "20 h"'
        raise ValueError(message)  # noqa: TRY004 (pydantic collects ValueErrors only)
    return value if isinstance(value, str) else float(value)


class Also:
    """Additional JSON schemas of short forms that a validator accepts."""

    def __init__(self, *schemas: dict[str, Any]) -> None:
        self.schemas = schemas

    def __get_pydantic_json_schema__(
        self, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON schema, extended by the short forms (a hook of pydantic)."""
        return {"anyOf": [handler(core_schema), *self.schemas]}


TEXT, NUMBER = ({"type": kind} for kind in ("string", "number"))
LIST = {"type": "array", "items": {"anyOf": [NUMBER, TEXT]}}
BOUNDS: dict[str, Any] = {
    "anyOf": [
        {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2},
        {"type": "string", "pattern": r"^\s*(<=|>=)\s*[-+0-9.eE]+\s*$"},
        {"type": "object"},  # TOML parses alpha.error = ... as a table
    ]
}


def short(key: str) -> BeforeValidator:
    """Return a validator that converts a value that is not a table to a table {key: value}."""
    return BeforeValidator(lambda given: given if isinstance(given, Mapping) else {key: given})


def _number(value: Any) -> Any:
    """Refuse true and false, which pydantic would convert to 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("expected a number")  # noqa: TRY004 (pydantic collects ValueErrors only)
    return value


def _missing(value: Any) -> Any:
    """Convert text that a data file would read as a number to this number."""
    text = value.strip() if isinstance(value, str) else ""
    number = number_of(value)
    if not text and number is None:
        raise ValueError('expected a number, or text such as "OVER"')
    return text if number is None else number


def options_of(kind: type) -> BeforeValidator:
    """Return a validator that requires numbers for numeric options, booleans for switches."""

    def checked(value: Any) -> Any:
        for key, given in value.items() if isinstance(value, Mapping) else ():
            usual = getattr(kind, key, None)
            switch = isinstance(usual, bool)
            if isinstance(usual, int | float) and switch != isinstance(given, bool):
                rule = "true or false" if switch else "a number"
                raise ValueError(f"{key} must be {rule}; got {given!r}")
        return value

    return BeforeValidator(checked)


def _limits(value: Any) -> Any:
    """Convert [low, high], "<= number" or ">= number" to (sense, bound)."""
    if isinstance(value, list) and len(value) == 2:
        low, high = value
        if all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
            return "in", (float(low), float(high))
    if isinstance(value, str):
        match = re.fullmatch(r"\s*(<=|>=)\s*([-+0-9.eE]+)\s*", value)
        with suppress(ValueError):
            if match:
                return match[1], float(match[2])
    raise ValueError('expected [low, high], "<= number" or ">= number"')


def _encoding(value: str) -> str:
    try:
        codecs.lookup(value)
    except LookupError:
        raise ValueError("expected the name of an encoding, as 'utf-8', 'cp1252'") from None
    return value


def _time_format(value: str) -> str:
    if value in ELAPSED:
        return value
    moment = datetime(2001, 2, 3, 4)
    with suppress(ValueError, re.error):  # re.error: a directive occurs twice
        # A complete format parses the date that it has formatted.
        if datetime.strptime(moment.strftime(value), value).date() == moment.date():
            return value
    known = f"or of an elapsed time: {', '.join(ELAPSED)}"
    raise ValueError(f"expected year, month, day and time, as '%d.%m.%Y %H:%M', {known}")


def _flat(value: Any) -> Any:
    """Convert {"k": {"error": x}} to {"k.error": x}, since TOML parses k.error = x as a table."""
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
Number: TypeAlias = Annotated[float, BeforeValidator(_number)]
MissingValue: TypeAlias = Annotated[float | str, BeforeValidator(_missing)]
PositiveFloat: TypeAlias = Annotated[Number, Field(gt=0)]


def _nonzero(value: float) -> float:
    if not value:
        raise ValueError("got 0; expected another number")
    return value


NonzeroFloat: TypeAlias = Annotated[Number, AfterValidator(_nonzero)]
PositiveInt: TypeAlias = Annotated[int, Field(gt=0), BeforeValidator(_number)]
NonNegativeInt: TypeAlias = Annotated[int, Field(ge=0), BeforeValidator(_number)]
Pair: TypeAlias = tuple[Quantity, Quantity]
Point: TypeAlias = Quantity | tuple[Quantity, ...]
Box: TypeAlias = tuple[Quantity, Quantity, Quantity, Quantity]
Instant: TypeAlias = date | datetime | float | str
Encoding: TypeAlias = Annotated[str, AfterValidator(_encoding)]
Name: TypeAlias = Annotated[str, Field(min_length=1)]
Identifier: TypeAlias = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
TimeFormat: TypeAlias = Annotated[str, AfterValidator(_time_format)]
Expected: TypeAlias = Annotated[
    dict[str, Annotated[tuple[Sense, Bound], BeforeValidator(_limits)]],
    BeforeValidator(_flat),
    WithJsonSchema({"type": "object", "additionalProperties": BOUNDS}),
]
