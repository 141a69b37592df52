"""Errors that a column of the data may have, in words, and the settings of a case against them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from livepde.verdict import Cause, channel_setting
from livepde.verdict.sentences import clause, estimating, table_of, width

TEMPERATURES = ("degC", "degF", "K")


class Unit(NamedTuple):
    """A unit that a column may have."""

    # The unit, and the expected one; empty if they are not known.
    name: str
    expected: str
    # Of the conversion of its values.
    factor: float
    constant: float
    # How many times too large or too small its values are; NaN where only their sign is turned.
    times: float = np.nan


UNITS: tuple[Unit, ...] = (
    Unit("degF", "degC", 1.0 / 1.8, -32.0 / 1.8),
    Unit("degC", "degF", 1.8, 32.0),
    Unit("K", "degC", 1.0, -273.15),
    Unit("degC", "K", 1.0, 273.15),
    Unit("", "", -1.0, 0.0),  # counted in the other direction
    *(
        Unit("", "", power, 0.0, times)
        for times in (10.0, 100.0, 1000.0, 60.0, 3600.0, 3.6)
        for power in (1.0 / times, times)
    ),
)


def units_of(expected: str, *, scaled: bool) -> list[int]:
    """Return the numbers of the units in which a quantity may be; its unit is empty if not known.

    `scaled`: whether a temperature may be counted in tenths, say, or with the opposite sign.
    """
    temperature = expected in TEMPERATURES

    def may_be(unit: Unit) -> bool:
        return temperature or not expected if unit.name else scaled or not temperature

    return [number for number, unit in enumerate(UNITS) if may_be(unit)]


@dataclass(frozen=True)
class Error:
    """An error of a column, or of two."""

    kind: str  # "offset", "gain", "lag", "unit" or "exchange"
    names: tuple[str, ...]  # the columns
    # Of an offset in the unit of the column, of a gain as a factor less one, of a lag in time.
    size: float = 0.0
    unit: int = 0  # number in `UNITS`

    @property
    def numbers(self) -> int:
        """How many numbers of it are free."""
        return int(self.kind in ("offset", "gain", "lag"))

    @property
    def correction(self) -> tuple[float, float]:
        """Factor and constant with which the values of a gain, or in a unit, are right."""
        unit = UNITS[self.unit]
        return (1.0 / (1.0 + self.size), 0.0) if self.numbers else (unit.factor, unit.constant)


def cause_of(error: Error, share: float, unit: str, time_unit: str, *, of_sensor: bool) -> Cause:
    """Return an error that explains a share of a misfit as a cause; `unit`: of its column."""
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
    """Return the settings of a case that correct a column; empty if there are none."""
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
    """Return whether a column is in a unit that is known, has another sign, or another factor."""
    if UNITS[error.unit].name:
        return "unit"
    return "sign" if error.correction[0] < 0.0 else "factor"
