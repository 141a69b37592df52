"""Outcome of an experiment, a benchmark or a run: tables, checks, figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

from livepde.errors import ConfigurationError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Bound", "Check", "FigureFactory", "Outcome", "Sense", "Table", "attempted"]

T = TypeVar("T")

Sense: TypeAlias = Literal["<=", ">=", "in"]
Bound: TypeAlias = float | tuple[float, float]
FigureFactory: TypeAlias = Callable[[], Any]
"""Returns a matplotlib Figure; called only when somebody wants to see it."""


@dataclass(frozen=True)
class Check:
    """A number and the bound that it must satisfy.

    Attributes
    ----------
    name
        The measured quantity.
    value
        The number; NaN never satisfies anything.
    bound
        One number for "<=" and ">=", a pair (low, high) for "in".
    sense
        "<=", ">=" or "in".

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

    @property
    def ok(self) -> bool:
        """True if the number satisfies the bound."""
        if isinstance(self.bound, tuple):
            return self.bound[0] <= self.value <= self.bound[1]
        return self.value <= self.bound if self.sense == "<=" else self.value >= self.bound

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
    """Rows to print; numbers stay numbers until they are shown."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        return {
            "title": self.title,
            "columns": list(self.columns),
            "rows": [list(row) for row in self.rows],
        }


@dataclass(frozen=True, eq=False)
class Outcome:
    """Tables, checks, notes, dataset and figures of an experiment.

    Attributes
    ----------
    tables, checks, notes
        Printed parts, in this order.
    dataset
        The run, as `Result.to_xarray()` gives it.
    figures
        File name without suffix -> function that draws a matplotlib figure.
    """

    tables: Sequence[Table] = ()
    checks: Sequence[Check] = ()
    notes: Sequence[str] = ()
    dataset: xr.Dataset | None = None
    figures: Mapping[str, FigureFactory] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """True if every check is."""
        return all(check.ok for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object: checks, tables, notes."""
        return {
            "checks": [check.to_dict() for check in self.checks],
            "tables": [table.to_dict() for table in self.tables],
            "notes": list(self.notes),
        }


def attempted(what: str, compute: Callable[[], T], otherwise: T, notes: list[str]) -> T:
    """Return the value of a computation, or `otherwise` and a note with the reason if it fails.

    A run keeps its data even if one of its diagnostics fails. `OSError`, and so `RunError`
    (a directory that cannot be written), is raised.
    """
    try:
        return compute()
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001  whatever it is, it is told
        reason = str(error).split("\n", 1)[0].rstrip(".") or "no reason given"
        notes.append(f"{what} failed ({type(error).__name__}: {reason[:200]}); all else is whole.")
        return otherwise
