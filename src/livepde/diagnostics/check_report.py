"""Check reports: measured properties as values and as a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.errors import ConfigurationError

__all__ = ["CheckLine", "CheckReport"]


@dataclass(frozen=True)
class CheckLine:
    """One measured property.

    Attributes
    ----------
    name
        The property, in words or as an equation.
    value, bound
        Measured value, and the bound that it is compared with.
    ok
        True if the property holds.
    remedy
        Advice if it does not hold.
    sense
        Comparison of value and bound, "<=" or ">=".
    """

    name: str
    value: float
    bound: float
    ok: bool
    remedy: str
    sense: str = "<="

    @classmethod
    def at_most(cls, name: str, value: float, bound: float, remedy: str) -> CheckLine:
        """Return a line that holds if value <= bound; NaN never holds."""
        return cls(name, float(value), bound, bool(value <= bound), remedy)

    @classmethod
    def at_least(cls, name: str, value: float, bound: float, remedy: str) -> CheckLine:
        """Return a line that holds if value >= bound; NaN never holds."""
        return cls(name, float(value), bound, bool(value >= bound), remedy, ">=")


@dataclass(frozen=True)
class CheckReport:
    """Measured properties of one object.

    Attributes
    ----------
    name
        Name of the object.
    lines
        Measured properties.
    error
        Exception class raised by `raise_if_failed`.

    Examples
    --------
    >>> line = CheckLine.at_most("P P = P", 3e-16, 1e-12, "")
    >>> print(CheckReport("observation", (line,)))
    observation: ok
      ok    P P = P  3.0e-16 <= 1.0e-12
    """

    name: str
    lines: tuple[CheckLine, ...]
    error: type[ConfigurationError] = ConfigurationError

    @property
    def ok(self) -> bool:
        """True if every property holds."""
        return all(line.ok for line in self.lines)

    @property
    def failed(self) -> tuple[CheckLine, ...]:
        """Lines of properties that do not hold."""
        return tuple(line for line in self.lines if not line.ok)

    def raise_if_failed(self) -> CheckReport:
        """Return the report if every property holds.

        Raises
        ------
        ConfigurationError
            A property does not hold; the message names it, and the remedy.
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


def _number(value: float) -> str:
    """Return a number as text: counts and rates plainly, others in scientific notation."""
    if not np.isfinite(value):
        return str(value)
    if value == int(value) and abs(value) < 1e5:
        return str(int(value))
    if 0.01 <= abs(value) < 1e4:
        return f"{value:.2f}"
    return f"{value:.1e}"
