"""One sample of every member: predict, gate outliers, update, keep the innovation statistics."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from livepde.laws.filter import Filter, Update
from livepde.laws.filter_state import FilterState
from livepde.laws.law import Report, Status
from livepde.laws.member_arrays import changed
from livepde.laws.step_diagnostics import Diagnostics, stacked
from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import Span
from livepde.verdict import Judge, ScoredSample

__all__ = ["OK", "Assimilation", "MemberReports", "assimilate", "assimilate_at_once"]

OK = Status()
MEMORY = 500.0  # samples: older ones fade from the noise level
LEARN = 0.3  # of a sample each adds to the count: errors of the first guess fade fast


@dataclass(frozen=True, eq=False)
class MemberReports:
    """Report of a step of all members, beside the new state.

    Attributes
    ----------
    statuses
        Status of the step of each member.
    predicted
        Predicted value of each sensor, shape (members, sensors).
    steps
        Substeps taken, shape (members,).
    diagnose
        Function that returns the diagnostics, numbers of shape (members,); called when read.
    """

    statuses: tuple[Status, ...]
    predicted: Array
    steps: Array
    diagnose: Callable[[], Diagnostics[Array]] = Diagnostics

    @cached_property
    def diagnostics(self) -> Diagnostics[Array]:
        """Innovation statistics, safeguards, and other numbers of the law."""
        return self.diagnose()

    def member(self, k: int) -> Report:
        """Return the report of one member."""
        steps = int(self.steps[k])
        found = cache(lambda: self.diagnostics.member(k))
        return Report(self.statuses[k], self.predicted[k], steps, found)

    def updated(self, more: Diagnostics[Array]) -> MemberReports:
        """Return the reports with all that other diagnostics know among their own."""
        return replace(self, diagnose=cache(lambda: self.diagnostics.updated(more)))

    def with_members(self, reports: Mapping[int, Report]) -> MemberReports:
        """Return the reports with those of some members exchanged."""
        if not reports:
            return self
        statuses, predicted, steps = list(self.statuses), self.predicted.copy(), self.steps.copy()
        for k, one in reports.items():
            statuses[k], predicted[k], steps[k] = one.status, one.predicted, one.steps

        def diagnosed() -> Diagnostics[Array]:
            each = (reports.get(k, self.member(k)) for k in range(len(statuses)))
            return stacked([one.diagnostics for one in each])

        return MemberReports(tuple(statuses), predicted, steps, cache(diagnosed))


@dataclass(frozen=True, eq=False)
class Assimilation:
    """Outcome of the assimilation of a sample.

    Attributes
    ----------
    predicted
        Predicted value of each sensor, shape (members, sensors).
    steps
        Substeps taken.
    status
        Why no member could be stepped, or ok.
    finite
        Members whose numbers are finite, shape (members,).
    refused
        Values that the gate refused, shape (members,).
    largest
        Largest innovation in units of the noise, shape (members,); 0 without.
    """

    predicted: Array
    steps: int
    status: Status
    finite: Mask
    refused: Array
    largest: Array


@dataclass(frozen=True)
class UpdateOptions:
    """Predict and update with the options of a law.

    Attributes
    ----------
    gate, patience
        Innovations beyond `gate` expected standard deviations are refused, `patience` times in a
        row.
    adaptive
        True if the noise is a first guess whose multiple is found from the samples; their
        likelihood is kept then, too.
    """

    gate: float = math.inf
    patience: int = 10
    adaptive: bool = False


def assimilate(
    filter_: Filter, x: FilterState, span: Span, options: UpdateOptions
) -> tuple[FilterState, Assimilation]:
    """Predict over a span and update at its end, linear about the linearisation points."""
    end, steps, failure = filter_.predict(x, span)
    if failure is not None:
        predicted, _ = filter_.sensors.observe(x, span.end)
        zero = np.zeros(len(x))
        return x, Assimilation(predicted, steps, Status.of(failure), zero > 0.0, zero, zero)
    return _absorbed(filter_, end, span, options, steps)


def assimilate_at_once(
    filter_: Filter, x: FilterState, span: Span, options: UpdateOptions
) -> FilterState:
    """Update a state that belongs to the end of a span by the measurements there."""
    return _absorbed(filter_, x, span, options, 0)[0]


def _absorbed(
    filter_: Filter, x: FilterState, span: Span, options: UpdateOptions, steps: int
) -> tuple[FilterState, Assimilation]:
    """Return the predicted filter after the measurements: gate, verdict, update, statistics."""
    predicted, Y = filter_.sensors.observe(x, span.end)
    d = span.z1 - predicted
    used: Mask = np.isfinite(d)
    whole = bool(used.all())
    measured = None if whole else np.asarray(used.any(axis=1))
    if measured is not None and not measured.any():
        zero = np.zeros(len(x))
        finite: Mask = np.isfinite((x.u + x.du).sum(axis=1) + x.U.sum(axis=(1, 2)))
        return x, Assimilation(predicted, steps, OK, finite, zero, zero)
    noise = filter_.noise_of(span)
    if options.adaptive or x.level[0] != 1.0:
        noise = np.sqrt(x.level)[:, None] * noise
    # From here on in units of the noise: variance of an innovation 1 + |Y|^2.
    Y, d = Y / noise[:, None], d / noise
    largest = np.fmax.reduce(np.abs(d), axis=1, initial=0.0)
    variance = 1.0 + (Y * Y).sum(axis=1)
    e = d / np.sqrt(variance)
    shadows = filter_.shadows
    off = None if shadows is None else shadows.seen(x, span.end)
    expected, told = e, d
    if shadows is not None and off is not None:
        # Shifts of the innovations by the known discretisation error have a finding of their own:
        # neither the gate nor the verdict may count them again.
        known = off[:, shadows.counted].sum(axis=1) / noise
        expected, told = d / np.sqrt(variance + known * known), d + known
    gate = _gated(x, e, expected, used, options)
    if gate.newest is not None:
        used, whole = gate.used, bool(gate.used.all())
        e = np.where(used, e, np.nan)
    if not whole:  # missing values take part as zeros, which carry no information
        Y, d, told = (
            np.where(used[:, None], Y, 0.0),
            np.where(used, d, 0.0),
            np.where(used, told, 0.0),
        )
        if off is not None:
            off = np.where(used[:, None], off, 0.0)
    if filter_.judge is not None:
        x = _judged(filter_.judge, filter_, x, Y, told, used, noise, predicted, span)
    new, made = filter_.update(x, Y, d)
    parts: dict[str, Any] = {
        "innovations": x.innovations.add(e, measured, gate.newest),
        "refused": gate.refused,
    }
    if options.adaptive:
        parts |= _learned(x, used, d, noise, made)
    if shadows is not None and off is not None:
        parts["shadows"] = shadows.updated(x, new, made.left, used / noise, off, span.t1)
    # An entry of U that is not finite makes du not finite, whatever its weight. An innovation whose
    # square overflows would leave statistics that are not finite.
    sums = (new.u + new.du).sum(axis=1) + new.da.sum(axis=1)
    finite = np.isfinite(sums + largest * largest)
    return changed(new, **parts), Assimilation(predicted, steps, OK, finite, gate.dropped, largest)


def _judged(
    judge: Judge,
    filter_: Filter,
    x: FilterState,
    Y: Array,
    d: Array,
    used: Mask,
    noise: Array,
    predicted: Array,
    span: Span,
) -> FilterState:
    """Return the state before an update, with the sample added to the sums of the verdict."""
    prior = filter_.problem.model.latent.prior

    def a() -> Array:
        found: Array = filter_.reduction.reduced(x.q - prior) + x.da
        if filter_.shadows is not None:
            found = found - x.shadows.a[:, filter_.shadows.counted].sum(axis=1)
        return found

    def q() -> Array:
        return filter_.estimate(x)

    z, at, u = span.z1, span.end, x.u + x.du
    sample = ScoredSample(x.C, x.causes, a, q, u, Y, d, used, z, predicted, noise, at)
    causes, ledger = judge.add(x.ledger, sample)
    return changed(x, causes=causes, ledger=ledger)


class Gated(NamedTuple):
    """Outcome of the gate for a sample.

    Attributes
    ----------
    used, refused
        Values that are used, and how many in a row of each sensor were refused, (members, sensors).
    dropped
        Number of values refused now, shape (members,).
    newest
        Normalised innovations for the test for jumps, (members, sensors); None: all of them.
    """

    used: Mask
    refused: IntArray
    dropped: Array
    newest: Array | None


def _gated(x: FilterState, e: Array, expected: Array, used: Mask, options: UpdateOptions) -> Gated:
    """Return which values pass: normalised innovations e, and those by the wider `expected`.

    The gate is as much wider as the innovations are usually larger than expected, so that a noise
    that is stated too small does not close it.
    """
    passed = Gated(used, x.refused, np.zeros(len(x)), None)
    if options.gate == math.inf:
        return passed
    limit = options.gate * np.sqrt(np.maximum(x.innovations.ratio, 1.0))
    far = used & ~(np.abs(expected) <= limit[:, None])
    if not (far.any() or x.refused.any()):
        return passed
    refused = np.where(far, x.refused + 1, np.where(used, 0, x.refused))
    kept = used & ~(far & (refused <= options.patience))
    dropped = (used.sum(axis=1) - kept.sum(axis=1)).astype(float)
    # One value alone is no change of the process; a second one in a row may be.
    return Gated(kept, refused, dropped, np.where(kept | (refused > 1), e, np.nan))


def _learned(x: FilterState, used: Mask, d: Array, noise: Array, made: Update) -> dict[str, Array]:
    """Return evidence and noise level after a sample.

    The noise level is found by expectation maximisation, sample by sample: under the right level
    the mean square of the residual after an update, plus the posterior variance of the prediction,
    is the variance of the noise, also while the unknowns are uncertain.
    """
    left = made.left
    logs = (np.log(noise) * used).sum(axis=1)
    missed = d - (made.half[:, None] @ left)[:, 0]
    count, told = np.maximum(used.sum(axis=1), 1), used.any(axis=1)
    square = ((missed * missed).sum(axis=1) + (left * left).sum(axis=(1, 2))) / count
    samples = np.minimum(x.samples + LEARN, MEMORY)
    level = x.level * (1.0 + (square - 1.0) / samples)
    return {
        "evidence": x.evidence - 0.5 * made.misfit - made.spread - logs,
        "level": np.where(told, level, x.level),
        "samples": np.where(told, samples, x.samples),
    }
