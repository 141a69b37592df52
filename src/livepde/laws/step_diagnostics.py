"""Diagnostics of a step: innovation statistics, safeguards, jumps, and other numbers of a law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Generic, TypeVar

import numpy as np

from livepde.linalg import Array
from livepde.verdict import Shifts
from livepde.verdict.findings import NOT_KNOWN, known

Number = TypeVar("Number")
Other = TypeVar("Other")


@dataclass(frozen=True, eq=False)
class Diagnostics(Generic[Number]):
    """Diagnostics of a step; NaN if the law does not compute a number.

    A number is a float, or an array over members. Tables and files use the names of the attributes.

    >>> diagnostics = Diagnostics(alpha=2.0, extra={"damping": 3.0})
    >>> diagnostics.alpha, diagnostics.jump, diagnostics.named()
    (2.0, nan, {'alpha': 2.0, 'damping': 3.0})

    Attributes
    ----------
    innovation_ratio
        Mean normalised innovation squared (NIS) for each reading; 1 if the noise is as stated.
    innovation_correlation
        Correlation of successive innovations; 0 if the model explains the data.
    log_evidence
        Natural logarithm of the likelihood of all readings so far, with the unknowns integrated
        out; see `Result.log_evidence`.
    noise_level
        Estimated noise over its stated value.
    refused
        Number of readings that the gate refused.
    bounded
        Number of coefficients beyond their range about the prior (`within`).
    iterated, tempered, held, restarted, runaway
        1 if the safeguard of this name acted on the sample: see `Guards`.
    smoother_moved
        Change of the unknowns by the iterated smoother at the start, in standard deviations.
    jump, jump_samples
        1 if the test for sudden changes raised an alarm, and number of samples since the change.
    residual
        Norm of r in X for `GradientLaw` and related laws.
    alpha, misfit
        Smoothing parameter of the observed part, and distance of u_alpha from the sample.
    gain, information, departure
        Gain, information about q and distance from the prior for `gain="auto"`.
    at_rest
        1 if q was held for lack of excitation.
    shadow_failed, mesh_unfollowed
        Number of steps without an estimate of a discretisation error; 1 if there is none for the
        mesh.
    shifts
        Shifts of the unknowns due to discretisation errors.
    extra
        Name -> number: further diagnostics, for example of a user-defined law.
    """

    innovation_ratio: Number = NOT_KNOWN
    innovation_correlation: Number = NOT_KNOWN
    log_evidence: Number = NOT_KNOWN
    noise_level: Number = NOT_KNOWN
    refused: Number = NOT_KNOWN
    bounded: Number = NOT_KNOWN
    iterated: Number = NOT_KNOWN
    tempered: Number = NOT_KNOWN
    held: Number = NOT_KNOWN
    restarted: Number = NOT_KNOWN
    runaway: Number = NOT_KNOWN
    smoother_moved: Number = NOT_KNOWN
    jump: Number = NOT_KNOWN
    jump_samples: Number = NOT_KNOWN
    residual: Number = NOT_KNOWN
    alpha: Number = NOT_KNOWN
    misfit: Number = NOT_KNOWN
    gain: Number = NOT_KNOWN
    information: Number = NOT_KNOWN
    departure: Number = NOT_KNOWN
    at_rest: Number = NOT_KNOWN
    shadow_failed: Number = NOT_KNOWN
    mesh_unfollowed: Number = NOT_KNOWN
    shifts: Shifts[Number] = field(default_factory=Shifts)
    extra: Mapping[str, Number] = field(default_factory=dict)

    def named(self) -> dict[str, Number]:
        """Return the known numbers, by their names in tables and files."""
        more = self.shifts.named() | dict(self.extra)
        return self._own() | {name: number for name, number in more.items() if known(number)}

    def each(self, change: Callable[[Number], Other]) -> Diagnostics[Other]:
        extra = {name: change(number) for name, number in self.extra.items()}
        own = {name: change(number) for name, number in self._own().items()}
        return Diagnostics(**own, shifts=self.shifts.each(change), extra=extra)

    def updated(self, more: Diagnostics[Number]) -> Diagnostics[Number]:
        """Return the diagnostics with their values replaced by the known values of `more`."""
        parts: dict[str, Any] = more._own()
        if more.shifts.sizes:
            parts["shifts"] = more.shifts
        return replace(self, **parts, extra={**self.extra, **more.extra})

    def member(self: Diagnostics[Array], k: int) -> Diagnostics[float]:
        return self.each(lambda number: float(number[k]))

    def _own(self) -> dict[str, Any]:
        own = vars(self)
        pairs = ((name, own[name]) for name in OWN if own[name] is not NOT_KNOWN)
        return {name: number for name, number in pairs if known(number)}


OWN = tuple(item.name for item in fields(Diagnostics) if item.name not in ("shifts", "extra"))


def stacked(members: Sequence[Diagnostics[float]]) -> Diagnostics[Array]:
    """Return the diagnostics of members as arrays, with NaN where a member has no value."""

    def column(numbers: Sequence[float]) -> Any:
        return NOT_KNOWN if all(map(math.isnan, numbers)) else np.array(numbers)

    def columns(tables: Sequence[Mapping[Any, float]]) -> dict[Any, Any]:
        names = dict.fromkeys(name for table in tables for name in table)
        arrays = {name: column([table.get(name, math.nan) for table in tables]) for name in names}
        return {name: numbers for name, numbers in arrays.items() if known(numbers)}

    shifts = [one.shifts for one in members]
    return Diagnostics(
        **columns([one._own() for one in members]),
        shifts=Shifts(
            column([one.largest for one in shifts]),
            columns([one.sizes for one in shifts]),
            columns([one.unknowns for one in shifts]),
        ),
        extra=columns([one.extra for one in members]),
    )
