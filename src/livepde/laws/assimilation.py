"""Assimilation of one sample of each member: predict, gate, update, innovation statistics."""

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
MEMORY = 500.0  # samples: memory of the noise level
HALF_LOG = 0.5 * math.log(2.0 * math.pi)
LEARN = 0.3  # increase of the weight of the past for each sample: < 1 to forget early errors faster


@dataclass(frozen=True, eq=False)
class MemberReports:
    """Report of a step of all members, which accompanies the new state."""

    statuses: tuple[Status, ...]  # status of the step of each member
    predicted: Array  # predicted value of each sensor, shape (members, sensors)
    steps: Array  # number of substeps, shape (members,)
    # Returns the diagnostics, arrays of shape (members,); called when they are read.
    diagnose: Callable[[], Diagnostics[Array]] = Diagnostics
    # Number of parts into which the substeps were divided, shape (members,); None: undivided.
    parts: IntArray | None = None

    @cached_property
    def diagnostics(self) -> Diagnostics[Array]:
        """Innovation statistics, actions of safeguards, and other numbers of the law."""
        return self.diagnose()

    def member(self, k: int) -> Report:
        steps = int(self.steps[k])
        parts = 1 if self.parts is None else int(self.parts[k])
        diagnose = then(self.diagnose, lambda diagnostics: diagnostics.member(k))
        return Report(self.statuses[k], self.predicted[k], steps, diagnose, parts)

    def updated(self, more: Diagnostics[Array]) -> MemberReports:
        """Return the reports with the known values of `more` in their diagnostics."""
        return replace(self, diagnose=lambda: self.diagnostics.updated(more))

    def with_members(self, reports: Mapping[int, Report]) -> MemberReports:
        if not reports:
            return self
        statuses, predicted, steps = list(self.statuses), self.predicted.copy(), self.steps.copy()
        for k, report in reports.items():
            statuses[k], predicted[k], steps[k] = report.status, report.predicted, report.steps

        def diagnosed() -> Diagnostics[Array]:
            members = {k: report.diagnostics for k, report in reports.items()}
            rest = (k for k in range(len(statuses)) if k not in reports)
            members |= {k: self.diagnostics.member(k) for k in rest}
            return stacked([members[k] for k in range(len(statuses))])

        return MemberReports(tuple(statuses), predicted, steps, diagnosed, self.parts)


class GateDecision(NamedTuple):
    """Decision of a gate on a sample."""

    refused: Mask  # readings that do not correct the unknowns, shape (members, sensors)
    anchored: Mask  # refused readings that correct the state alone, shape (members, sensors)


class Assimilation(NamedTuple):
    """Outcome of the assimilation of a sample."""

    predicted: Array  # predicted value of each sensor, shape (members, sensors)
    steps: int | IntArray  # number of substeps, an int for all members or shape (members,)
    status: Status  # ok, or the reason why no member could be stepped
    finite: Mask  # members with finite results, shape (members,)
    refused: Mask  # readings that the gate refused, shape (members, sensors)
    worst: float  # largest innovation of all members in units of the noise; 0 without readings
    anchored: Mask | None = None  # readings that correct the state alone; None: no such reading

    @property
    def disturbed(self) -> Mask | None:
        """Members with a reading that corrected the state alone, (members,), or None."""
        return None if self.anchored is None else np.asarray(self.anchored.any(axis=1))

    @property
    def good(self) -> bool:
        """True if the step of the first member succeeded and its results are finite."""
        return self.status.ok and bool(self.finite[0])


def no_readings(x: FilterState, sensors: int) -> Assimilation:
    """Return the outcome of a sample without readings."""
    nothing, none = np.zeros((len(x), sensors)), np.zeros((len(x), sensors), dtype=bool)
    return Assimilation(nothing, 0, OK, np.ones(len(x), dtype=bool), none, 0.0)


@dataclass(frozen=True)
class UpdateOptions:
    """Options of a law for the update."""

    gate: Gate = field(default_factory=Gate)  # selects the readings that are used
    # True if the noise is an initial guess and a common factor is estimated from the samples.
    adaptive: bool = False
    # An earlier decision of the gate on the sample, to be repeated; None: the gate decides.
    decision: GateDecision | None = None


def assimilate(
    filter_: Filter, x: FilterState, span: Span, options: UpdateOptions
) -> tuple[FilterState, Assimilation]:
    """Predict over a span and update at its end, about the linearisation points."""
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
    """Update a state predicted to the end of a span with the measurements there.

    Includes gate, verdict and statistics. `steps`: number of substeps of the prediction.
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
    """Update a state with a sample that has readings, from Y = [U C] H^T and the innovations."""
    at, judge, shadows = span.end, filter_.judge, filter_.shadows
    present: Mask = np.isfinite(innovations)
    whole = np.count_nonzero(present) == present.size
    measured = None if whole else np.asarray(present.any(axis=1))
    noise = filter_.noise_of(x, span)
    # From here on, values are in units of the noise: an innovation has the variance 1 + |Y|^2.
    Y, d = Y / noise[:, None], innovations / noise
    sizes = np.abs(d)
    worst = float(np.fmax.reduce(sizes, axis=None))
    variance = 1.0 + np.add.reduce(Y * Y, axis=1)
    e, corrected = d / np.sqrt(variance), d
    errors, shift = np.zeros(0), None
    if shadows is not None:
        x, errors = shadows.in_readings(x, at)
        # The estimated discretisation error has its own finding: the gate and the verdict must not
        # count its effect on the innovations a second time.
        shift = np.add.reduce(errors[:, shadows.counted], axis=1) / noise
        corrected = d + shift
    kept = _admitted(options, x, span, present, innovations, noise, (e, d, variance, shift))
    used, parts = kept.used, dict[str, Any](kept.parts)
    if used is not present:
        whole, e = bool(used.all()), np.where(used, e, np.nan)
    if not whole:  # zeros in place of missing values carry no information
        d, corrected = np.where(used, d, 0.0), np.where(used, corrected, 0.0)
        Y = np.where(used[:, None], Y, 0.0)
    causes = x.causes
    if judge is not None:
        sample = Y, corrected, used, noise, predicted
        causes, parts["ledger"] = _judged(judge, filter_, x, *sample, span)
    parts["innovations"] = x.innovations.add(e, measured, kept.newest)
    changes, update = filter_.update(x, Y, d, causes)
    parts |= changes
    parts["evidence"] = x.evidence + _density(options, x, update, noise, present, kept.refused)
    if options.adaptive:
        parts |= _noise_level(x, used, d, update)
    if shadows is not None:
        weights = used / noise  # zero for missing values
        U, C, errors = parts["U"], parts["C"], np.where(used[:, None], errors, 0.0)
        parts["shadows"] = shadows.update(x, U, C, update.left, weights, errors, span.t1)
    new = changed(x, **parts)
    if kept.anchored is not None and kept.anchored.any():
        new = filter_.anchor.corrected(new, innovations, kept.anchored, at)
    good = _finite(new, sizes, worst)
    return new, Assimilation(predicted, steps, OK, good, kept.refused, worst, kept.anchored)


def _density(
    options: UpdateOptions,
    x: FilterState,
    update: Update,
    noise: Array,
    present: Mask,
    refused: Mask,
) -> Array:
    """Return the log density of the readings given the samples before, shape (members,)."""
    logs = ((np.log(noise) + HALF_LOG) * present).sum(axis=1)
    density = -0.5 * update.misfit - update.spread - logs
    if np.count_nonzero(refused) and options.gate.beyond < math.inf:
        # A refused reading counts as a reading at the limit of the gate, so that the evidence
        # covers the same readings whatever is refused.
        limit = options.gate.beyond**2 * np.maximum(x.innovations.ratio, 1.0)
        density = density - 0.5 * limit * refused.sum(axis=1)
    return np.asarray(density)


class _Admitted(NamedTuple):
    """Readings that are used and refused, and fields of the filter state that change."""

    used: Mask
    refused: Mask
    anchored: Mask | None = None  # refused readings that correct the state alone
    newest: Array | None = None  # normalised innovations that count in the test for jumps
    parts: Mapping[str, Any] = {}  # fields of the filter state to replace


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

    `scaled`: arguments `e`, `d`, `variance` and `shift` of `_far`.
    """
    refused = np.zeros(present.shape, dtype=bool)
    if options.decision is not None:
        refused, anchored = options.decision
        return _Admitted(present & ~refused, refused, anchored)
    if not options.gate.beyond < math.inf:
        return _Admitted(present, refused)
    z, pause = span.z1, x.driven.pause
    if z.shape != present.shape:  # members that share one sample
        z = np.broadcast_to(z, present.shape)
    far = _far(x, *scaled, pause, present, options.gate.beyond)
    if far is None:
        return _Admitted(present, refused, parts={"screened": x.screened.fitted(z, present)})
    gated = options.gate(x.screened, z, innovations, noise, far, present, span.t1, pause)
    newest = np.where(gated.counted, scaled[0], np.nan)
    parts = {"screened": gated.state}
    return _Admitted(gated.kept, present & ~gated.kept, gated.anchored, newest, parts)


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
    """Return the mask of misfitting readings, or None if all fit and no sensor is being refused.

    The limit grows with the usual size of normalised innovations, so that an understated noise does
    not make the gate refuse most readings. `e`: normalised innovations. `d`, `variance`:
    innovations and their variance, in units of the noise. `shift`: estimated discretisation errors
    in the innovations, which widen the gate except after a pause, or None.
    """
    # Values within the unwidened limits pass in any case, which saves most samples the rest.
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
    """Return the members with finite estimates and innovation statistics, shape (members,)."""
    # A nonfinite entry of U makes du nonfinite, whatever its weight. An innovation whose square
    # overflows makes the statistics nonfinite. One finite sum of squares excludes both for all
    # members at once.
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
    """Return the causes before the update, and the ledger with the sample added to its sums."""
    prior = filter_.problem.model.latent.prior

    def a() -> Array:
        reduced: Array = filter_.reduction.reduced(x.q - prior) + x.da
        if filter_.shadows is not None:
            reduced -= np.add.reduce(x.shadows.a[:, filter_.shadows.counted], axis=1)
        return reduced

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


def _noise_level(x: FilterState, used: Mask, d: Array, update: Update) -> dict[str, Array]:
    """Return the fields of the noise level after a sample.

    This is one step of expectation maximisation. At the right level, the noise variance equals the
    mean square of the residuals after the update plus the posterior variance of the predictions.
    This also holds while the unknowns are uncertain.
    """
    left = update.left
    residual = d - (update.half[:, None] @ left)[:, 0]
    count, measured = np.maximum(used.sum(axis=1), 1), used.any(axis=1)
    square = ((residual * residual).sum(axis=1) + (left * left).sum(axis=(1, 2))) / count
    samples = np.minimum(x.samples + LEARN, MEMORY)
    level = x.level * (1.0 + (square - 1.0) / samples)
    return {
        "level": np.where(measured, level, x.level),
        "samples": np.where(measured, samples, x.samples),
    }
