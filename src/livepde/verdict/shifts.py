"""Shifts of the unknowns by errors of the discretisation, and the findings on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from livepde.verdict.findings import Finding, Severity
from livepde.verdict.sentences import FINDINGS

SHIFTED = 2.0  # standard deviations by which discretisation has shifted an unknown
DECIDES = 5.0  # the same, from which the interval is little else
GUESSED = 2.0  # the same by input lines alone: where inputs jump, a guess of even the wrong sign
SHARED = 1.0  # the same by one kind of error, from which it is named
SETTING = 1.0  # the same if inputs are readings: no interval holds that
HOLD = "hold"
LISTED = 5  # unknowns in a sentence
REFINE = {
    "step": (
        "the time step",
        "Reduce `steps.dt_max`, or use a second-order scheme.",
    ),
    "mesh": ("the mesh", "Refine the mesh (`mesh.cells`) where the state varies most."),
    "input": ("the linear interpolation of inputs", "Sample these inputs more often."),
}
"""Kind of a discretisation error -> its name, and the remedy."""

NOT_KNOWN: Any = math.nan
Number = TypeVar("Number")
Other = TypeVar("Other")


@dataclass(frozen=True, eq=False)
class Shifts(Generic[Number]):
    """Shifts of the unknown numbers by errors that are estimated online.

    Kinds of errors are "step", "mesh", "input" and so on. A number is a float, or an array over
    members.

    Attributes
    ----------
    largest
        Largest shift of an unknown by all kinds together, in standard deviations; NaN: not known.
    sizes
        Kind -> shift of that unknown, in standard deviations.
    unknowns
        (Label of an unknown, kind) -> its shift, in the unit of the unknown.
    """

    largest: Number = NOT_KNOWN
    sizes: Mapping[str, Number] = field(default_factory=dict)
    unknowns: Mapping[tuple[str, str], Number] = field(default_factory=dict)

    def by(self, kind: str) -> dict[str, Number]:
        """Return label -> shift by one kind of error."""
        return {label: shift for (label, of), shift in self.unknowns.items() if of == kind}

    def named(self) -> dict[str, Number]:
        """Return the numbers by their names in tables and files, NaN among them."""
        sizes = {f"{kind}_shift": size for kind, size in self.sizes.items()}
        shifts = {f"{label}_{kind}_shift": shift for (label, kind), shift in self.unknowns.items()}
        return {"discretisation_shift": self.largest, **sizes, **shifts}

    def each(self, change: Callable[[Number], Other]) -> Shifts[Other]:
        """Return the shifts with a function of each number that is known."""
        return Shifts(
            change(self.largest) if known(self.largest) else NOT_KNOWN,
            {kind: change(size) for kind, size in self.sizes.items()},
            {pair: change(shift) for pair, shift in self.unknowns.items()},
        )


def known(number: Any) -> bool:
    """Return whether a number, or an array over members, is known: that is not NaN alone."""
    if isinstance(number, float):  # as most are: without a call of NumPy
        return not math.isnan(number)
    return bool(np.ndim(number)) or not math.isnan(number)


def discretised(shifts: Shifts[float]) -> Iterator[Finding]:
    """Return the finding that the discretisation has shifted the unknowns, if it has."""
    total = shifts.largest
    sizes = {kind: abs(shifts.sizes[kind]) for kind in REFINE if kind in shifts.sizes}
    if not total > SHIFTED or not sizes:
        return
    # Shares may cancel in the total: the largest is named, and each from `SHARED` on.
    largest = max(sizes.values())
    parts = sorted(sizes, key=lambda kind: -sizes[kind])
    parts = [kind for kind in parts if sizes[kind] >= min(largest, SHARED)]
    each = [f"{REFINE[kind][0]} by {sizes[kind]:.1f}{_listed(shifts.by(kind))}" for kind in parts]
    text, _ = FINDINGS["discretisation"].filled(total=total, each=", ".join(each))
    remedy = " ".join(REFINE[kind][1] for kind in parts)
    # Shifts are part of the reported variance. Beyond five deviations the interval is little else,
    # and depends more on the mesh and the step than on the data.
    unsure = total > DECIDES or sizes.get("input", 0.0) > GUESSED
    severity: Severity = "caution" if unsure else "note"  # the interval holds it
    yield Finding("discretisation", severity, text, evidence=total, remedy=remedy)


def held_inputs(shifts: Shifts[float]) -> Iterator[Finding]:
    """Return whether inputs that are constant between readings would matter as straight lines."""
    total = abs(shifts.sizes.get(HOLD, math.nan))
    if not total > SETTING:
        return
    moved = {label: -shift for label, shift in shifts.by(HOLD).items()}
    text, remedy = FINDINGS["hold"].filled(total=total, each=_listed(moved))
    yield Finding("hold", "caution", text, evidence=total, remedy=remedy)


def _listed(shifts: Mapping[str, float]) -> str:
    """Return the shifts of the first unknowns in parentheses."""
    parts = [f"{label} by {shift:+.2g}" for label, shift in shifts.items() if math.isfinite(shift)]
    return f" ({', '.join(parts[:LISTED])})" if parts else ""
