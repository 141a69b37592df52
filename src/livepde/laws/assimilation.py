"""One sample of every member: predict, gate outliers, update, keep the innovation statistics."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from livepde.laws.filter import Filter, Update
from livepde.laws.filter_state import FilterState
from livepde.laws.gate import Gate
from livepde.laws.later import then
from livepde.laws.law import Report, Status
from livepde.laws.step_diagnostics import Diagnostics, stacked
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.stepping import Span
from livepde.verdict import Judge, Ledger, ScoredSample

OK = Status()
MEMORY = 500.0  # samples: older ones fade from the noise level
HALF_LOG = 0.5 * math.log(2.0 * math.pi)
LEARN = 0.3  # of a sample each adds to the count: errors of the first guess fade fast


@dataclass(frozen=True, eq=False)
class MemberReports:
    """Report of a step of all members, in addition to the new state."""

    statuses: tuple[Status, ...]  # status of the step of each member
    predicted: Array  # predicted value of each sensor, shape (members, sensors)
    steps: Array  # substeps taken, shape (members,)
    # Function that returns the diagnostics, numbers of shape (members,); called when read.
    diagnose: Callable[[], Diagnostics[Array]] = Diagnostics
    # In how many parts the substeps were divided, shape (members,); None: not at all.
    parts: IntArray | None = None

    @cached_property
    def diagnostics(self) -> Diagnostics[Array]:
        """Innovation statistics, safeguards, and other numbers of the law."""
        return self.diagnose()

    def member(self, k: int) -> Report:
        steps = int(self.steps[k])
        parts = 1 if self.parts is None else int(self.parts[k])
        diagnose = then(self.diagnose, lambda found: found.member(k))
        return Report(self.statuses[k], self.predicted[k], steps, diagnose, parts)

    def updated(self, more: Diagnostics[Array]) -> MemberReports:
        """Return the reports with all that other diagnostics know among their own."""
        return replace(self, diagnose=lambda: self.diagnostics.updated(more))

    def with_members(self, reports: Mapping[int, Report]) -> MemberReports:
        if not reports:
            return self
        statuses, predicted, steps = list(self.statuses), self.predicted.copy(), self.steps.copy()
        for k, one in reports.items():
            statuses[k], predicted[k], steps[k] = one.status, one.predicted, one.steps

        def diagnosed() -> Diagnostics[Array]:
            found = {k: one.diagnostics for k, one in reports.items()}
            rest = (k for k in range(len(statuses)) if k not in reports)
            found |= {k: self.diagnostics.member(k) for k in rest}
            return stacked([found[k] for k in range(len(statuses))])

        return MemberReports(tuple(statuses), predicted, steps, diagnosed, self.parts)


class GateDecision(NamedTuple):
    """Decision of a gate on a sample."""

    refused: Mask  # readings that do not correct the unknowns, shape (members, sensors)
    anchored: Mask  # those of them that correct the state alone


class Assimilation(NamedTuple):
    """Outcome of the assimilation of a sample."""

    predicted: Array  # predicted value of each sensor, shape (members, sensors)
    steps: int | IntArray  # substeps taken, one number for all members or shape (members,)
    status: Status  # why no member could be stepped, or ok
    finite: Mask  # members whose numbers are finite, shape (members,)
    refused: Mask  # values that the gate refused, shape (members, sensors)
    worst: float  # largest innovation of all members in units of the noise; 0 without
    anchored: Mask | None = None  # those that correct the state alone; None: none does

    @property
    def disturbed(self) -> Mask | None:
        """Members of which a reading has corrected the state alone, (members,); None: none."""
        return None if self.anchored is None else np.asarray(self.anchored.any(axis=1))

    @property
    def good(self) -> bool:
        """True if the step of the one member was taken and its numbers are finite."""
        return self.status.ok and bool(self.finite[0])


def no_readings(x: FilterState, sensors: int) -> Assimilation:
    """Return the outcome of a sample without readings."""
    nothing, none = np.zeros((len(x), sensors)), np.zeros((len(x), sensors), dtype=bool)
    return Assimilation(nothing, 0, OK, np.ones(len(x), dtype=bool), none, 0.0)


@dataclass(frozen=True)
class UpdateOptions:
    """Predict and update with the options of a law."""

    gate: Gate = field(default_factory=Gate)  # which readings are used
    # True if the noise is a first guess whose multiple is found from the samples.
    adaptive: bool = False
    # An earlier decision of the gate on the sample, which holds again; None: the gate decides.
    decision: GateDecision | None = None


def assimilate(
    filter_: Filter, x: FilterState, span: Span, options: UpdateOptions
) -> tuple[FilterState, Assimilation]:
    """Predict over a span and update at its end, linear about the linearisation points."""
    end, steps, failure = filter_.predict(x, span)
    if failure is None:
        return absorb(filter_, end, span, options, steps)
    predicted, _ = filter_.sensors.observe(x, span.end)
    none = np.zeros(len(x), dtype=bool)
    refused = np.zeros(predicted.shape, dtype=bool)
    return x, Assimilation(predicted, steps, Status.of(failure), none, refused, 0.0)


def absorb(
    filter_: Filter, x: FilterState, span: Span, options: UpdateOptions, steps: int | IntArray = 0
) -> tuple[FilterState, Assimilation]:
    """Update a state at the end of a span by the measurements there.

    Gate, verdict, update, statistics; `steps` are the substeps that have led to the state.
    """
    predicted, Y = filter_.sensors.observe(x, span.end)
    d = span.z1 - predicted
    if not d.size or np.count_nonzero(np.isfinite(d)):
        return _updated(filter_, x, span, options, predicted, Y, d, steps)
    sums = (x.u + x.du).sum(axis=1) + x.da.sum(axis=1)
    finite: Mask = np.isfinite(sums + x.U.sum(axis=(1, 2)) + x.C.sum(axis=(1, 2)))
    return x, Assimilation(predicted, steps, OK, finite, np.zeros(d.shape, dtype=bool), 0.0)


def _updated(
    filter_: Filter,
    x: FilterState,
    span: Span,
    options: UpdateOptions,
    predicted: Array,
    Y: Array,
    innovations: Array,
    steps: int | IntArray,
) -> tuple[FilterState, Assimilation]:
    """Return the same after a sample with a reading, from [U C] H^T and the innovations."""
    at, judge, shadows = span.end, filter_.judge, filter_.shadows
    present: Mask = np.isfinite(innovations)
    whole = np.count_nonzero(present) == present.size
    measured = None if whole else np.asarray(present.any(axis=1))
    noise = filter_.noise_of(x, span)
    # From here on in units of the noise: variance of an innovation 1 + |Y|^2.
    Y, d = Y / noise[:, None], innovations / noise
    sizes = np.abs(d)
    worst = float(np.fmax.reduce(sizes, axis=None))
    variance = 1.0 + np.add.reduce(Y * Y, axis=1)
    e, told = d / np.sqrt(variance), d
    off, shift = np.zeros(0), None
    if shadows is not None:
        x, off = shadows.in_readings(x, at)
        # Shifts of the innovations by the known discretisation error have a finding of their own:
        # neither the gate nor the verdict may count them again.
        shift = np.add.reduce(off[:, shadows.counted], axis=1) / noise
        told = d + shift
    kept = _admitted(options, x, span, present, innovations, noise, (e, d, variance, shift))
    used, parts = kept.used, dict[str, Any](kept.parts)
    if used is not present:
        whole, e = bool(used.all()), np.where(used, e, np.nan)
    if not whole:  # missing values take part as zeros, which carry no information
        d, told = np.where(used, d, 0.0), np.where(used, told, 0.0)
        Y = np.where(used[:, None], Y, 0.0)
    causes = x.causes
    if judge is not None:
        causes, parts["ledger"] = _judged(judge, filter_, x, Y, told, used, noise, predicted, span)
    parts["innovations"] = x.innovations.add(e, measured, kept.newest)
    changes, made = filter_.update(x, Y, d, causes)
    parts |= changes
    parts["evidence"] = x.evidence + _density(options, x, made, noise, present, kept.refused)
    if options.adaptive:
        parts |= _learned(x, used, d, made)
    if shadows is not None:
        weights = used / noise  # missing values have none
        U, C, off = parts["U"], parts["C"], np.where(used[:, None], off, 0.0)
        parts["shadows"] = shadows.update(x, U, C, made.left, weights, off, span.t1)
    new = changed(x, **parts)
    if kept.anchored is not None and kept.anchored.any():
        new = filter_.anchor.corrected(new, innovations, kept.anchored, at)
    good = _finite(new, sizes, worst)
    return new, Assimilation(predicted, steps, OK, good, kept.refused, worst, kept.anchored)


def _density(
    options: UpdateOptions,
    x: FilterState,
    made: Update,
    noise: Array,
    present: Mask,
    refused: Mask,
) -> Array:
    """Return the logarithm of the density of the readings, (members,)."""
    logs = ((np.log(noise) + HALF_LOG) * present).sum(axis=1)
    density = -0.5 * made.misfit - made.spread - logs
    if np.count_nonzero(refused) and options.gate.beyond < math.inf:
        # The same readings count whatever is refused: one that is counts as one at the limit.
        limit = options.gate.beyond**2 * np.maximum(x.innovations.ratio, 1.0)
        density = density - 0.5 * limit * refused.sum(axis=1)
    return np.asarray(density)


class _Admitted(NamedTuple):
    """Which readings are used, which are refused, and the memory of the gate."""

    used: Mask
    refused: Mask
    anchored: Mask | None = None  # those of the refused that correct the state alone
    newest: Array | None = None  # normalised innovations that count in the test for jumps
    parts: Mapping[str, Any] = {}  # fields of the filter state to exchange


def _admitted(
    options: UpdateOptions,
    x: FilterState,
    span: Span,
    present: Mask,
    innovations: Array,
    noise: Array,
    scaled: tuple[Array, Array, Array, Array | None],
) -> _Admitted:
    """Return the readings that are used, by an earlier decision or by the gate.

    `scaled`: normalised innovations, and what `_far` takes besides.
    """
    refused = np.zeros(present.shape, dtype=bool)
    if options.decision is not None:
        refused, anchored = options.decision
        return _Admitted(present & ~refused, refused, anchored)
    if not options.gate.beyond < math.inf:
        return _Admitted(present, refused)
    z, pause = span.z1, x.driven.pause
    if z.shape != present.shape:  # members may share one sample
        z = np.broadcast_to(z, present.shape)
    far = _far(x, *scaled, pause, present, options.gate.beyond)
    if far is None:
        return _Admitted(present, refused, parts={"screened": x.screened.fitted(z, present)})
    found = options.gate(x.screened, z, innovations, noise, far, present, span.t1, pause)
    newest = np.where(found.counted, scaled[0], np.nan)
    parts = {"screened": found.state}
    return _Admitted(found.kept, present & ~found.kept, found.anchored, newest, parts)


def _far(
    x: FilterState,
    e: Array,
    d: Array,
    variance: Array,
    shift: Array | None,
    pause: Mask,
    used: Mask,
    beyond: float,
) -> Mask | None:
    """Return which values do not fit; None if all do, of members that refuse no sensor.

    The gate is as much wider as the innovations are usually larger than expected, so that a noise
    that is stated too small does not close it.

    `e`, `d`, `variance`: normalised innovations, and innovations with their variance, in units of
    the noise. `shift`: known errors of the innovations, which widen the gate but after a pause;
    None: none.
    """
    # Values within the bare gate pass, whatever widens it: most samples are spared the limits.
    near, quiet = np.abs(e) <= beyond, not np.count_nonzero(x.screened.refused)
    if quiet and np.count_nonzero(near) == near.size:
        return None
    expected = e
    if shift is not None:
        expected = np.where(pause[:, None], e, d / np.sqrt(variance + shift * shift))
    limit = beyond * np.sqrt(np.maximum(x.innovations.ratio, 1.0))
    far: Mask = used & ~(np.abs(expected) <= limit[:, None])
    return None if quiet and not far.any() else far


def _finite(x: FilterState, sizes: Array, worst: float) -> Mask:
    """Return which members are finite, with the squares of their innovations, (members,)."""
    # An entry of U that is not finite makes du not finite, whatever its weight. An innovation whose
    # square overflows would leave statistics that are not finite. The squares of all members tell
    # at once that nothing of this has happened.
    squares = np.vdot(x.u, x.u) + np.vdot(x.du, x.du) + np.vdot(x.da, x.da)
    if squares + worst * worst < math.inf:
        return np.asarray(x.member >= 0)
    sums = (x.u + x.du).sum(axis=1) + x.da.sum(axis=1)
    return np.asarray(np.isfinite(sums + np.fmax.reduce(sizes, axis=1, initial=0.0) ** 2))


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
) -> tuple[Array, Ledger]:
    """Return causes before an update and the ledger, with the sample added to the sums."""
    prior = filter_.problem.model.latent.prior

    def a() -> Array:
        found: Array = filter_.reduction.reduced(x.q - prior) + x.da
        if filter_.shadows is not None:
            found -= np.add.reduce(x.shadows.a[:, filter_.shadows.counted], axis=1)
        return found

    def q() -> Array:
        return filter_.estimate(x)

    z, at, u = span.z1, span.end, x.u + x.du
    sample = ScoredSample(
        C=x.C,
        M=x.causes,
        a=a,
        q=q,
        u=u,
        Y=Y,
        d=d,
        used=used,
        z=z,
        predicted=predicted,
        noise=noise,
        at=at,
    )
    return judge.add(x.ledger, sample)


def _learned(x: FilterState, used: Mask, d: Array, made: Update) -> dict[str, Array]:
    """Return the noise level after a sample.

    The noise level is found by expectation maximisation, sample by sample: under the right level
    the mean square of the residual after an update, plus the posterior variance of the prediction,
    is the variance of the noise, also while the unknowns are uncertain.
    """
    left = made.left
    missed = d - (made.half[:, None] @ left)[:, 0]
    count, told = np.maximum(used.sum(axis=1), 1), used.any(axis=1)
    square = ((missed * missed).sum(axis=1) + (left * left).sum(axis=(1, 2))) / count
    samples = np.minimum(x.samples + LEARN, MEMORY)
    level = x.level * (1.0 + (square - 1.0) / samples)
    return {
        "level": np.where(told, level, x.level),
        "samples": np.where(told, samples, x.samples),
    }
