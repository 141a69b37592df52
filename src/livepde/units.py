"""Conversion of quantities to the units of the model; pint is imported on first use."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import permutations
from tokenize import TokenError
from typing import Any

from livepde.errors import CaseError

LARGEST = 1e60  # largest number: products of four are finite
SMALLEST = 1e-60  # smallest standard deviation, rate or length
UNIT = 100  # largest number of characters of a unit
POWER = r"(?:\^|\*\*)"
KINDS = (("s", "min", "h", "d"), ("mm", "cm", "m", "ft"), ("degC", "K", "degF"))  # for hints
# Exceptions that pint's parser raises for text that is not a unit.
NOT_A_UNIT = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    MemoryError,
    RecursionError,
    SyntaxError,
    TokenError,
    TypeError,
    ValueError,
)
IN_BRACKETS = re.compile(r"\s*[\[(]([^\[\]()]*)[\])]\s*$")  # T [degC], time (min)
AFTER_SLASH = re.compile(r"^(?:[^\s/]+\s*|.+\s)/\s*([^\s/]+)$")  # Ewe/V, T 2cm / K; not flow m3/h
AT_THE_END = re.compile(r"(?:_|^(?=\w{3}))([A-Za-z]+)$")  # time_s, minutes
# power_kW, T_30cm degF, T_1 degF; not T_1 cm, which is a position
AFTER_A_WORD = re.compile(r"(?:(?<=[^\W\d])[_ ]|(?<=\d)[_ ](?=deg))(deg[CF]|[kM]W|[mc]m|ft)$")
OF_TIMES = (IN_BRACKETS, AFTER_SLASH, AT_THE_END)  # units in the name of a column of times
# hours since 2023-06-01 00:00:00, in the notation of the CF conventions
SINCE = re.compile(r"\b(\w+ since \d{4}-\d{1,2}-\d{1,2}(?!\d)[^\[\]()]*)")
OF_TIME = re.compile(r"[mu]?s|sec|min|hr?|d|(second|minute|hour|day|week|year)s?", re.I)
QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


# For temperatures, C and F are not coulomb and farad.
SCALES = {"C": "degC", "F": "degF", "deg C": "degC", "deg F": "degF"}
TEMPERATURES = ("degC", "degF", "K")

BASE = {
    "[mass]": "kg",
    "[length]": "m",
    "[time]": "s",
    "[current]": "A",
    "[temperature]": "K",
    "[substance]": "mol",
    "[luminosity]": "cd",
}

TIMES = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
LENGTHS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "km": 1000.0}
RATES = (("m^2", "m^2"), ("m", "m"), ("1", "1"), ("K", "K"), ("degC", "K"), ("K", "degC"))

# (given, unit) -> factor and offset, equal to pint's to one rounding, for common units: loading the
# registry of pint takes longer than loading the rest of a case.
USUAL = {
    **{
        (given, unit): (kind[given] / kind[unit], 0.0)
        for kind in (TIMES, LENGTHS)
        for given, unit in permutations(kind, 2)
    },
    **{(f"{a}/{t}", f"{b}/s"): (1 / TIMES[t], 0.0) for a, b in RATES for t in ("min", "h", "d")},
    **{(f"{given}/s", f"{unit}/s"): (1.0, 0.0) for given, unit in RATES[-2:]},
    **{
        (f"{a}^2{per}", f"m^2{per}"): (LENGTHS[a] ** 2, 0.0)
        for a in ("mm", "cm")
        for per in ("", "/s")
    },
    ("mm/s", "m/s"): (0.001, 0.0),
    ("degC", "K"): (1.0, 273.15),
    ("K", "degC"): (1.0, -273.15),
}


class UnitError(CaseError):
    """A unit that is not known, or of another dimension."""


@dataclass(frozen=True)
class SI:
    """Value in SI units = factor * value + offset; base unit -> its power in `exponents`."""

    factor: float
    offset: float
    exponents: dict[str, int]


@dataclass(frozen=True)
class Affine:
    """Value in the unit of the model = factor * value + offset."""

    factor: float = 1.0
    offset: float = 0.0


def convert(value: float | str, unit: str, where: str, *, difference: bool = False) -> float:
    """Convert text such as "20 h" to the unit of the model; a number is already in that unit.

    `where`: file and key, for messages.
    `difference`: the value is a difference, such as a standard deviation, so that the offset of a
    temperature scale is ignored.
    Raises `CaseError`: not a quantity, an unknown unit, or a unit of another dimension.
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
    if abs(number) > LARGEST:
        raise CaseError(f"{where}: got {number:g}; expected less than {LARGEST:g}.")
    if given.startswith(","):
        raise CaseError(f"{where}: got '{value}'; decimals need a point.")
    if not given and not unit:
        return number
    if not given:
        raise CaseError(f"{where}: got '{value}' without a unit; write {match[1]} or add a unit.")
    rule = conversion(given, unit, where)
    return rule.factor * number + (0.0 if difference else rule.offset)


@cache
def conversion(given: str, unit: str, where: str) -> Affine:
    """Return the conversion from the unit `given` to `unit`; raise `CaseError` if none exists."""
    if unit in TEMPERATURES:
        given = SCALES.get(given, given)
    if given == unit:
        return Affine()
    if (known := USUAL.get((with_powers(given), unit))) is not None:
        return Affine(*known)
    check_unit(given, where)
    zero, one, two = _converted(given, unit, where)
    # In logarithmic units such as decibels, three equidistant values do not lie on a line.
    if not math.isclose(two - one, one - zero):
        raise CaseError(f"{where}: '{given}' has no linear scale; {_expected(unit)}.")
    return Affine(float(one - zero), float(zero))


def _converted(given: str, unit: str, where: str) -> tuple[float, float, float]:
    """Return the values 0, 1 and 2 of the unit `given` in another unit."""
    registry = pint_registry()
    import pint

    try:
        parsed = parsed_unit(registry, given)
        zero, one, two = (registry.Quantity(k, parsed).to(unit).magnitude for k in (0.0, 1.0, 2.0))
        return zero, one, two
    except pint.UndefinedUnitError as error:
        raise UnitError(
            f"{where}: '{error.args[0] if error.args else given}' is not a unit that is known; "
            f"{_expected(unit)}."
        ) from None
    except pint.DimensionalityError:
        raise UnitError(
            f"{where}: '{given}' cannot be converted to '{unit or '1'}'; {_expected(unit)}."
        ) from None
    except (pint.PintError, *NOT_A_UNIT):
        raise UnitError(f"{where}: '{given}' is not a unit; {_expected(unit)}.") from None


def with_powers(unit: str) -> str:
    """Insert the operator of powers that a unit omits.

    >>> with_powers("m3/h"), with_powers("W m-2 K-1"), with_powers("m^2/s**0.5")
    ('m^3/h', 'W m^-2 K^-1', 'm^2/s**0.5')
    """
    return re.sub(r"(?<=[A-Za-z])(?=-?\d)", "^", unit)


def parsed_unit(registry: Any, unit: str) -> Any:
    """Return a unit parsed by pint; the operator of powers may be omitted."""
    import pint

    with suppress(pint.PintError, *NOT_A_UNIT):
        return registry.parse_units(unit)
    return registry.parse_units(with_powers(unit))


def converts(given: str, unit: str) -> bool:
    """Return whether `given` can be converted to `unit`; False if either is empty."""
    try:
        conversion(given, unit, given)
    except CaseError:
        return False
    return bool(given and unit)


def has_states(unit: str) -> bool:
    """Return whether a constant input of this unit may be a state such as off; not a temperature.

    >>> has_states("W"), has_states("degC")
    (True, False)
    """
    return unit not in KINDS[-1]


def unit_in(name: str, unit: str, *patterns: re.Pattern[str]) -> str:
    """Return the unit in the name of a column, if it can be converted to `unit`; else empty."""
    for match in filter(None, (pattern.search(name) for pattern in patterns)):
        powers = with_powers(match[1])
        for text in (powers, match[1], powers.replace("_", "/")):  # L_s is L/s
            with suppress(CaseError):
                conversion(text, unit, name)
                return SCALES.get(text, text) if unit in TEMPERATURES else text
    return ""


def counted_since(name: str) -> str:
    """Return text such as "hours since 2023-06-01" in the name of a column; else empty.

    >>> counted_since("time [hours since 2023-06-01 00:00:00]"), counted_since("s since start")
    ('hours since 2023-06-01 00:00:00', '')
    """
    match = SINCE.search(name)
    return match[1].strip() if match else ""


def other_time_unit(name: str, unit: str) -> str:
    """Return the unit of time in the name of a column if it is not `unit`; else empty.

    >>> other_time_unit("time_min", "s"), other_time_unit("t [s]", "s")
    ('min', '')
    """
    if unit and (counted := counted_since(name)):
        return counted
    matches = (pattern.search(name) for pattern in OF_TIMES)
    if not (unit and any(match and OF_TIME.fullmatch(match[1]) for match in matches)):
        return ""  # without loading pint
    return other_unit(name, unit, *OF_TIMES)


def other_unit(name: str, unit: str, *patterns: re.Pattern[str]) -> str:
    """Return the unit in the name of a column if it converts to `unit` but differs; else empty.

    >>> other_unit("T [degF]", "degC", IN_BRACKETS), other_unit("q (W/m2)", "W/m^2", IN_BRACKETS)
    ('degF', '')
    """
    if not unit:
        return ""
    given = unit_in(name, unit, *patterns)
    return given if given and conversion(given, unit, name) != Affine() else ""


def is_other_kind(given: str, unit: str) -> bool:
    """Return whether `given` is a unit with a dimension that cannot be converted to `unit`.

    >>> is_other_kind("W", "W/m^3"), is_other_kind("kW/m3", "W/m^3"), is_other_kind("left", "K")
    (True, False, False)
    """
    if not (given and unit) or converts(with_powers(given), unit):
        return False
    known = in_si(given)
    return known is not None and bool(known.exponents)


def in_si(unit: str) -> SI | None:
    """Return the conversion from a unit to SI base units; None if there is none.

    >>> in_si("km/h").exponents, round(in_si("degC").offset, 2)
    ({'m': 1, 's': -1}, 273.15)
    """
    registry = pint_registry()
    import pint

    try:
        check_unit(unit, "a unit")
        parsed = parsed_unit(registry, unit)
        zero, one, two = (registry.Quantity(k, parsed).to_base_units() for k in (0.0, 1.0, 2.0))
    except (pint.PintError, CaseError, *NOT_A_UNIT):
        return None
    if not math.isclose((two - one).magnitude, (one - zero).magnitude):
        return None
    # Units of FMI are products of integer powers of the seven SI base units.
    exponents = {BASE[name]: power for name, power in one.dimensionality.items() if name in BASE}
    if len(exponents) < len(one.dimensionality) or any(p != int(p) for p in exponents.values()):
        return None
    powers = {name: int(power) for name, power in exponents.items()}
    offset = float(zero.magnitude)
    return SI(float(one.magnitude) - offset, offset, powers)


def check_unit(unit: str, where: str) -> None:
    """Raise `CaseError` for a unit that is too long, or has large or nested powers."""
    if len(unit) > UNIT:
        raise CaseError(f"{where}: a unit has at most {UNIT} characters; got {len(unit)}.")
    compact = re.sub(rf"\s*({POWER}|[()])\s*", r"\1", with_powers(unit))
    if re.search(rf"{POWER}[-+(]*[0-9]{{3,}}", compact) or _nested_powers(compact):
        raise CaseError(
            f"{where}: '{unit}' is not a unit: powers are numbers below 100, and none is raised to "
            "another."
        )
    if re.search(r"[0-9]{10}", compact):
        raise CaseError(f"{where}: '{unit}' is not a unit: its numbers have less than 10 digits.")


def _nested_powers(unit: str) -> bool:
    """Return whether a power, or a group that contains a power, is raised to a power."""
    if re.search(rf"{POWER}[-+(]*[0-9.]*\)*{POWER}", unit):
        return True
    count, starts = 0, []
    for match in re.finditer(rf"\(|\)|{POWER}", unit):
        sign = match[0]
        if sign == "(":
            starts.append(count)
        elif sign == ")":
            inside = count > (starts.pop() if starts else count)
            if inside and re.match(POWER, unit[match.end() :]):
                return True
        else:
            count += 1
    return False


def _expected(unit: str) -> str:
    if not unit:
        return "expected no unit: remove it"
    others = next((kind for kind in KINDS if unit in kind), (unit,))
    return (
        f"expected a unit such as {' or '.join(filter(None, (', '.join(others[:-1]), others[-1])))}"
    )


@cache
def pint_registry() -> Any:
    """Return the unit registry of pint, created on first use."""
    import pint

    return pint.UnitRegistry()
