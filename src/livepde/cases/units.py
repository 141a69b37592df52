"""Quantities with units, converted to the model's; pint is imported when the first one is met."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cache
from tokenize import TokenError
from typing import Any

from livepde.errors import CaseError

__all__ = ["SI", "Affine", "conversion", "convert", "in_si"]

KINDS = (("s", "min", "h", "d"), ("mm", "cm", "m", "ft"), ("degC", "K", "degF"))  # for hints
# What pint's parser lets through for text that is no unit at all.
NOT_A_UNIT = (AssertionError, AttributeError, SyntaxError, TokenError, TypeError, ValueError)
QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


BASE = {
    "[mass]": "kg",
    "[length]": "m",
    "[time]": "s",
    "[current]": "A",
    "[temperature]": "K",
    "[substance]": "mol",
    "[luminosity]": "cd",
}


@dataclass(frozen=True)
class SI:
    """value in SI units = factor * value + offset; `exponents` of the base units."""

    factor: float
    offset: float
    exponents: dict[str, int]


@dataclass(frozen=True)
class Affine:
    """value in the model's unit = factor * value + offset."""

    factor: float = 1.0
    offset: float = 0.0


def convert(value: float | str, unit: str, where: str, *, difference: bool = False) -> float:
    """Return a quantity in the model's unit.

    Parameters
    ----------
    value
        A number, already in that unit, or text such as "20 h".
    unit
        The model's unit; empty: a pure number.
    where
        File and key, for the message.
    difference
        A difference of two values, such as a deviation: the zero of temperature scales drops out.

    Raises
    ------
    CaseError
        Not a quantity, an unknown unit, or one of another dimension.
    """
    if not isinstance(value, str):
        return float(value)
    match = QUANTITY.match(value)
    if match is None:
        raise CaseError(
            f"{where}: got '{value}'; expected a number"
            + (f' in {unit}, or text with a unit as "1 {unit}".' if unit else " without a unit.")
        )
    number, given = float(match[1]), match[2]
    if given.startswith(","):
        raise CaseError(f"{where}: got '{value}'; decimals need a point.")
    if not given:
        raise CaseError(f"{where}: got '{value}' without a unit; write {match[1]} or add a unit.")
    rule = conversion(given, unit, where)
    return rule.factor * number + (0.0 if difference else rule.offset)


@cache
def conversion(given: str, unit: str, where: str) -> Affine:
    """Return how values in the unit `given` become values in the model's unit."""
    if given == unit:
        return Affine()
    pint = _pint()
    registry = _registry()
    try:
        parsed = registry.parse_units(given)
        zero, one, two = (registry.Quantity(k, parsed).to(unit).magnitude for k in (0.0, 1.0, 2.0))
    except pint.UndefinedUnitError as error:
        raise CaseError(
            f"{where}: '{error.args[0] if error.args else given}' is not a unit that is known; "
            f"{_expected(unit, given)}."
        ) from None
    except pint.DimensionalityError:
        raise CaseError(
            f"{where}: '{given}' cannot be converted to '{unit or '1'}'; {_expected(unit, given)}."
        ) from None
    except (pint.PintError, *NOT_A_UNIT):
        raise CaseError(f"{where}: '{given}' is not a unit; {_expected(unit, given)}.") from None
    if not math.isclose(two - one, one - zero):  # decibels
        raise CaseError(f"{where}: '{given}' has no linear scale; {_expected(unit, given)}.")
    return Affine(float(one - zero), float(zero))


def in_si(unit: str) -> SI | None:
    """Return how values in a unit become values in units of the SI; None if it has none.

    >>> in_si("km/h").exponents, round(in_si("degC").offset, 2)
    ({'m': 1, 's': -1}, 273.15)
    """
    registry = _registry()
    try:
        parsed = registry.parse_units(unit)
        zero, one, two = (registry.Quantity(k, parsed).to_base_units() for k in (0.0, 1.0, 2.0))
    except (_pint().PintError, *NOT_A_UNIT):
        return None
    if not math.isclose((two - one).magnitude, (one - zero).magnitude):
        return None
    exponents = {BASE[name]: power for name, power in one.dimensionality.items() if name in BASE}
    if len(exponents) < len(one.dimensionality) or any(p != int(p) for p in exponents.values()):
        return None
    whole = {name: int(power) for name, power in exponents.items()}
    offset = float(zero.magnitude)
    return SI(float(one.magnitude) - offset, offset, whole)


def _expected(unit: str, given: str) -> str:
    if not unit:
        return "expected a number without a unit"
    if re.search(r"[A-Za-z][0-9]", given):
        return f"write powers as in '{unit}'" if "^" in unit else f"expected one as '{unit}'"
    others = next((kind for kind in KINDS if unit in kind), (unit,))
    return f"expected one as {' or '.join(filter(None, (', '.join(others[:-1]), others[-1])))}"


def _pint() -> Any:
    import pint

    return pint


@cache
def _registry() -> Any:
    return _pint().UnitRegistry()
