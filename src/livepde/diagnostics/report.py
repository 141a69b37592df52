"""What a check found, as a value and as a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.errors import ConfigurationError

__all__ = ["CheckLine", "CheckReport"]


@dataclass(frozen=True)
class CheckLine:
    """One property that was measured.

    Attributes
    ----------
    name
        The property, in words or as an equation.
    value, bound
        What was measured and what it is compared with.
    ok
        True if the property holds.
    remedy
        What to do if it does not.
    sense
        How value and bound are compared, "<=" or ">=".
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
    """All properties of one object, one line each.

    Attributes
    ----------
    name
        What was checked.
    lines
        What was measured.
    error
        What `raise_if_failed` raises.

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
        """The lines that do not hold."""
        return tuple(line for line in self.lines if not line.ok)

    def raise_if_failed(self) -> CheckReport:
        """Return the report itself if all is well.

        Raises
        ------
        ConfigurationError
            A property does not hold; the message says which, and the remedy.
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
    """Return counts and rates as they are, small and large numbers with their power of ten."""
    if not np.isfinite(value):
        return str(value)
    if value == int(value) and abs(value) < 1e5:
        return str(int(value))
    if 0.01 <= abs(value) < 1e4:
        return f"{value:.2f}"
    return f"{value:.1e}"
