"""Outcome of an experiment, a benchmark or a run: tables, checks, figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from livepde.diagnostics.check_report import Check, Table

if TYPE_CHECKING:
    import xarray as xr

T = TypeVar("T")

FigureFactory: TypeAlias = Callable[[], Any]
"""Returns a matplotlib Figure; called only when somebody wants to see it."""


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
        notes.append(
            f"{what} failed ({type(error).__name__}: {reason[:200]}); everything else is complete."
        )
        return otherwise
