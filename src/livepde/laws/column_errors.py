"""Errors of columns of the data: units, sentences, and the case settings that correct them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from livepde.verdict import Cause, channel_setting
from livepde.verdict.sentences import clause, estimating, table_of, width

TEMPERATURES = ("degC", "degF", "K")


class Unit(NamedTuple):
    """A unit that a column may have instead of its expected unit."""

    # Actual and expected unit; empty if unknown.
    name: str
    expected: str
    # Conversion of values to the expected unit: factor times value plus constant.
    factor: float
    constant: float
    # Ratio, > 1, by which values are too large or too small; NaN for other conversions.
    times: float = np.nan


UNITS: tuple[Unit, ...] = (
    Unit("degF", "degC", 1.0 / 1.8, -32.0 / 1.8),
    Unit("degC", "degF", 1.8, 32.0),
    Unit("K", "degC", 1.0, -273.15),
    Unit("degC", "K", 1.0, 273.15),
    Unit("", "", -1.0, 0.0),  # opposite sign
    *(
        Unit("", "", power, 0.0, times)
        for times in (10.0, 100.0, 1000.0, 60.0, 3600.0, 3.6)
        for power in (1.0 / times, times)
    ),
)


def units_of(expected: str, *, scaled: bool) -> list[int]:
    """Return the numbers in `UNITS` of the possible units; `expected` is empty if unknown.

    `scaled`: whether a temperature may have another factor, such as tenths, or the opposite sign.
    """
    temperature = expected in TEMPERATURES

    def may_be(unit: Unit) -> bool:
        return temperature or not expected if unit.name else scaled or not temperature

    return [number for number, unit in enumerate(UNITS) if may_be(unit)]


@dataclass(frozen=True)
class Error:
    """An error of one column, or an exchange of two columns."""

    kind: str  # "offset", "gain", "lag", "unit" or "exchange"
    names: tuple[str, ...]  # names of the columns
    # Offset in the unit of the column, gain as a factor minus one, or lag in time.
    size: float = 0.0
    unit: int = 0  # number in `UNITS`

    @property
    def numbers(self) -> int:
        """Number of free parameters."""
        return int(self.kind in ("offset", "gain", "lag"))

    @property
    def correction(self) -> tuple[float, float]:
        """Factor and constant that correct the values of a gain or unit error."""
        unit = UNITS[self.unit]
        return (1.0 / (1.0 + self.size), 0.0) if self.numbers else (unit.factor, unit.constant)


def cause_of(error: Error, share: float, unit: str, time_unit: str, *, of_sensor: bool) -> Cause:
    """Return the cause of a share of the misfit for an error; `unit`: unit of the column."""
    kind, first, size, (factor, _) = error.kind, error.names[0], error.size, error.correction
    variant, positive = kind, size > 0
    more: dict[str, object] = {"other": error.names[-1], "table": table_of(first)}
    if kind == "unit":
        variant, positive = _unit_variant(error), factor < 1.0
        other = UNITS[error.unit]
        more |= {"unit": other.name, "expected": other.expected, "factor": other.times}
        more |= {"correction": f"{factor:.6g}"}
    text, remedy = clause(
        variant, first, size, time_unit if kind == "lag" else unit, positive=positive, **more
    )
    if kind == "offset" and of_sensor:
        remedy = estimating(kind, first, width(size, unit))
    setting = _setting(error, variant, time_unit, of_sensor=of_sensor)
    known = float("nan") if error.kind in ("unit", "exchange") else size
    return Cause(error.kind, first, text, float(min(share, 1.0)), remedy, setting, known)


def _setting(error: Error, variant: str, time_unit: str, *, of_sensor: bool) -> str:
    """Return the case settings that correct a column; empty if no setting does."""
    first, size, factor = error.names[0], error.size, f"{error.correction[0]:.6g}"
    if error.kind == "exchange":
        pairs = (error.names, error.names[::-1])
        return "; ".join(channel_setting(one, "column", json.dumps(other)) for one, other in pairs)
    keys = {
        "gain": ("factor", factor),
        "lag": ("late", f'"{size:.4g} {time_unit}"' if time_unit else f"{size:.4g}"),
        "unit": ("unit", f'"{UNITS[error.unit].name}"'),
        "factor": ("factor", factor),
        "sign": ("factor", factor),
    }
    if of_sensor:
        keys["offset"] = ("offset", f"{2.0 * abs(size):.2g}")
    return channel_setting(first, *keys[variant]) if variant in keys else ""


def _unit_variant(error: Error) -> str:
    """Return the variant of a unit error: "unit" if the unit is known, "sign" or "factor"."""
    if UNITS[error.unit].name:
        return "unit"
    return "sign" if error.correction[0] < 0.0 else "factor"
