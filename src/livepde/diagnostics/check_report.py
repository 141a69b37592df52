"""Measured numbers: checks against a bound, tables, and reports on one object."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from livepde.errors import ConfigurationError

Sense: TypeAlias = Literal["<=", ">=", "in"]
Bound: TypeAlias = float | tuple[float, float]


@dataclass(frozen=True)
class Check:
    """A number and the bound that it must satisfy.

    Attributes
    ----------
    name
        The measured quantity, in words or as an equation.
    value
        Measured number; NaN never satisfies a bound.
    bound, sense
        One number for "<=" and ">=", a pair (low, high) for "in".
    remedy
        Advice if the bound is missed.

    Examples
    --------
    >>> Check("error of q", 0.04, 0.05, "<=").ok
    True
    >>> Check("k", 2.5, (2.6, 3.1), "in").ok
    False
    """

    name: str
    value: float
    bound: Bound
    sense: Sense
    remedy: str = ""

    def __post_init__(self) -> None:
        if self.sense not in ("<=", ">=", "in"):
            raise ConfigurationError(
                f"check '{self.name}': got sense {self.sense!r}; expected '<=', '>=' or 'in'."
            )
        if isinstance(self.bound, tuple) != (self.sense == "in"):
            raise ConfigurationError(
                f"check '{self.name}': got bound {self.bound!r}; '{self.sense}' needs "
                + ("a pair (low, high)." if self.sense == "in" else "one number.")
            )

    @classmethod
    def at_most(cls, name: str, value: float, bound: float, remedy: str) -> Check:
        return cls(name, float(value), bound, "<=", remedy)

    @classmethod
    def at_least(cls, name: str, value: float, bound: float, remedy: str) -> Check:
        return cls(name, float(value), bound, ">=", remedy)

    @property
    def ok(self) -> bool:
        """True if the number satisfies the bound."""
        if isinstance(self.bound, tuple):
            return bool(self.bound[0] <= self.value <= self.bound[1])
        return bool(self.value <= self.bound if self.sense == "<=" else self.value >= self.bound)

    @property
    def bound_text(self) -> str:
        if isinstance(self.bound, tuple):
            return f"[{self.bound[0]:g}, {self.bound[1]:g}]"
        return f"{self.bound:g}"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object: name, value, bound, sense, ok."""
        bound = list(self.bound) if isinstance(self.bound, tuple) else self.bound
        return {
            "name": self.name,
            "value": self.value,
            "bound": bound,
            "sense": self.sense,
            "ok": self.ok,
        }


@dataclass(frozen=True)
class Table:
    """Table whose numbers are only formatted when it is shown."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def to_dict(self) -> dict[str, Any]:
        return {
            "title": self.title,
            "columns": list(self.columns),
            "rows": [list(row) for row in self.rows],
        }

    def markdown(self, digits: int = 5) -> str:
        """Return the table in Markdown with `digits` significant digits, or its title if empty."""

        def line(cells: Iterable[Any]) -> str:
            shown = (shown_cell(cell, digits) for cell in cells)
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in shown) + " |"

        if not self.rows:
            return f"## {self.title}"
        rule = "|" + "---|" * len(self.columns)
        return "\n".join([f"## {self.title}", "", line(self.columns), rule, *map(line, self.rows)])


def shown_cell(value: Any, digits: int) -> str:
    """Return a cell of a table as text, a dash for None."""
    if value is None:
        return "–"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class CheckReport:
    """Measured properties of one object; `raise_if_failed` raises `error`.

    Examples
    --------
    >>> line = Check.at_most("P P = P", 3e-16, 1e-12, "")
    >>> print(CheckReport("observation", (line,)))
    observation: ok
      ok    P P = P  3.0e-16 <= 1.0e-12
    """

    name: str
    lines: tuple[Check, ...]
    error: type[ConfigurationError] = ConfigurationError

    @property
    def ok(self) -> bool:
        """True if every property holds."""
        return all(line.ok for line in self.lines)

    @property
    def failed(self) -> tuple[Check, ...]:
        """Lines of properties that do not hold."""
        return tuple(line for line in self.lines if not line.ok)

    def raise_if_failed(self) -> CheckReport:
        """Return the report if every property holds.

        Raises `ConfigurationError`: a property does not hold; the message names it, and the remedy.
        """
        if not self.ok:
            raise self.error(
                f"{self.name}: "
                + " ".join(
                    f"'{line.name}' is {_number(line.value)}, needs {line.sense} "
                    f"{_number(line.bound)}: {line.remedy}"
                    for line in self.failed
                )
            )
        return self

    def __str__(self) -> str:
        verdict = "ok" if self.ok else f"{len(self.failed)} of {len(self.lines)} failed"
        wide = max((len(line.name) for line in self.lines), default=0)
        rows = [f"{self.name}: {verdict}"]
        for line in self.lines:
            mark = "ok" if line.ok else "FAIL"
            numbers = f"{_number(line.value):>7} {line.sense} {_number(line.bound)}"
            rows.append(f"  {mark:<4}  {line.name:<{wide}}  {numbers}")
            if not line.ok:
                rows.append(f"        {line.remedy}")
        return "\n".join(rows)


def _number(value: Bound) -> str:
    """Format a number: counts and rates as decimals, others in scientific notation."""
    if isinstance(value, tuple):
        return f"[{_number(value[0])}, {_number(value[1])}]"
    if not np.isfinite(value):
        return str(value)
    if value == int(value) and abs(value) < 1e5:
        return str(int(value))
    if 0.01 <= abs(value) < 1e4:
        return f"{value:.2f}"
    return f"{value:.1e}"
