"""State of the sensitivity law: filter, stored samples, refits and safeguards of each member."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np

from livepde.laws.assimilation import HALF_LOG, OK, Assimilation, MemberReports, UpdateOptions
from livepde.laws.filter import Filter, robust_factors
from livepde.laws.filter_state import NO_LEDGER, FilterState, unaccompanied
from livepde.laws.history import added, trimmed, withdrawn
from livepde.laws.later import Later
from livepde.laws.law import Fit
from livepde.laws.noise_rows import rows_of_sensors
from livepde.laws.policies import Guards, Jumps, Refit, Watch
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed, join_fields, take, where, zeros
from livepde.records import refusal
from livepde.stepping import Span

MOST_TRIED = 600  # largest number of samples stored for trials of columns
EARLY = 100  # samples: a column that is wrong from the start causes a disturbance before this
SMOOTHED = 64  # largest number of samples that the iterated smoother uses
LEAST = 32  # least number of rows by which a log is shortened: a copy for each sample costs more
FEW = 20_000  # largest square root, in numbers, for which several samples are read together
NEVER = np.iinfo(np.int64).max  # value of `due` if no refit is due any more


@dataclass(frozen=True, eq=False)
class SensitivityWork:
    """Filter and update options of a law; the other fields are attributes of the law."""

    filter: Filter
    options: UpdateOptions
    refit: Refit | None
    guards: Guards | None
    jumps: Jumps | None
    fades: bool
    relinearises: bool

    @cached_property
    def unjudged(self) -> SensitivityWork:
        return replace(self, filter=replace(self.filter, judge=None))

    @cached_property
    def unaccompanied(self) -> SensitivityWork:
        """The work for a search, without ledger and discretisation errors."""
        return replace(self, filter=replace(self.filter, shadows=None, judge=None))

    @cached_property
    def keeps_log(self) -> bool:
        """True if the law may go back to earlier samples."""
        return bool(self.back or self.window)

    def kept_start(self, x: FilterState) -> FilterState:
        """Return the filter at the start of a window; zeros for a law without windows."""
        return x if self.window else zeros(x)

    @cached_property
    def _of_sensors(self) -> IntArray:
        return rows_of_sensors(self.filter.problem, self.filter.reduction)

    def evidence_of_refused(self, log: Array, kept: Array, level: Array) -> Array:
        """Return the log density of the readings missing from `kept`, as if at the gate's limit.

        `level`: noise variance over its stated value, shape (members,).
        """
        sensors = len(self.filter.noise)
        readings, stds = slice(1, 1 + sensors), slice(1 + sensors, 1 + 2 * sensors)
        lost = np.isfinite(log[:, :, readings]) & ~np.isfinite(kept[:, :, readings])
        stated = np.where(np.isfinite(log[:, :, stds]), log[:, :, stds], self.filter.noise)
        limit = self.options.gate.beyond
        each = np.log(stated * np.sqrt(level)[:, None, None]) + HALF_LOG + 0.5 * limit**2
        return np.asarray(-np.where(lost, each, 0.0).sum(axis=(1, 2)))

    def at_level(self, start: FilterState, now: FilterState) -> FilterState:
        """Return the filter at the start of a window, scaled to the noise level of `now`.

        An initial state made of readings is as uncertain as these readings.
        """
        rows = self._of_sensors
        if not (self.options.adaptive and len(rows)) or start.age.any() or not start.U.any():
            return start
        U = start.U.copy()
        U[:, rows] *= np.sqrt(now.level / start.level)[:, None, None]
        return changed(start, U=U)

    @cached_property
    def jumping(self) -> Mask:
        """Coordinates of the unknowns that may jump, shape (k,)."""
        names = self.jumps.unknowns if self.jumps is not None else ()
        return self.filter.reduction.named(names, "Jumps: unknowns")

    @cached_property
    def fits(self) -> bool:
        """True if the stored samples depend on constant unknowns alone, so that a fit applies."""
        return not (self.fades or self.filter.moves or self.filter.problem.input_noise)

    def tried_samples(self, state: SensitivityState) -> SensitivityState:
        """Return one member whose samples for trials of columns are the samples to be fitted."""
        start = state.trial_start
        first = np.array([not start.ledger.seen[0]])
        return changed(
            state,
            start=start,
            log=state.trial,
            window=np.zeros(1, dtype=np.int64),
            opening=first,
            initial=first & (self.filter.problem.model.form_initial is not None),
            fit=FitState.none(start),
        )

    def unstored(self, state: SensitivityState) -> str:
        """Return why the stored samples of a member cannot be fitted; empty if they can."""
        if self.refit is None:
            return "the law stores no samples"
        if not self.fits:
            return "unknowns move, inputs have noise, or the past fades"
        return "" if state.log.shape[1] else "no sample is stored"

    @cached_property
    def window(self) -> int:
        """Largest number of samples in a refit or an iterated start; 0 without either."""
        if self.refit is None:
            return 0
        return self.refit.window if self.fits else min(self.refit.start, SMOOTHED)

    @cached_property
    def tried(self) -> int:
        """Number of samples stored for trials of columns, in addition to the fit's; may be 0."""
        if self.refit is None or self.filter.judge is None or self.fades or not self.window:
            return 0
        return min(self.refit.window, MOST_TRIED)

    @cached_property
    def back(self) -> int:
        """Least number of samples by which the law can go back; 0 if it never goes back."""
        guards, jumps = self.guards, self.jumps
        return max(guards.past if guards else 0, jumps.window if jumps else 0)


@dataclass(frozen=True, eq=False)
class SensitivityState:
    """State of the law for each member; the leading axis of every array is the members."""

    now: FilterState  # the present filter
    # Start of the window of a refit or an iterated start: filter and row of the log. `opening`: the
    # row has a sample that the filter has not assimilated. `initial`: the state is the initial
    # state of the model (`Model.initial`).
    start: FilterState
    window: IntArray
    opening: Mask
    initial: Mask
    # Number of samples in the window, and their number at the next refit; `NEVER`: no refit.
    assimilated: IntArray
    due: IntArray
    fit: FitState  # the last refit
    fork: Fork  # a refit in progress while samples continue
    # Two earlier filters, to which `Guards` and `Jumps` go back, and their rows of the log.
    older: FilterState
    newer: FilterState
    since_older: IntArray
    since_newer: IntArray
    # Samples since the earliest of these filters, see `livepde.laws.history`.
    log: Array = field(metadata={"grows": 1})
    # Samples for trials of columns (`SensitivityWork.tried`), and the filter before them.
    trial: Array = field(metadata={"grows": 1})
    trial_start: FilterState
    watch: Watch  # innovations of the last samples, for `Jumps`
    scale: Scale  # range of the readings of each sensor so far, for `Guards`

    def __len__(self) -> int:
        return len(self.now)

    def counted(self, evidence: Array) -> SensitivityState:
        """Return the state with new evidence, for readings that change no estimate."""
        names = ("start", "now", "older", "newer")
        return changed(self, **{n: changed(getattr(self, n), evidence=evidence) for n in names})

    @property
    def unaccompanied(self) -> SensitivityState:
        """The state for a search, without ledger and discretisation errors."""
        return changed(self, start=unaccompanied(self.start), now=unaccompanied(self.now))


@dataclass(frozen=True, eq=False)
class FitState:
    """The last refit of each member."""

    samples: IntArray  # number of samples, 0 before the first refit, shape (members,)
    # Half the sum of squares of the residuals in use and of the unknowns, in standard deviations,
    # shape (members,).
    cost: Array
    # Number of readings in these samples, and number of readings not used, shapes (members,).
    readings: Array
    refused: Array
    # Cost of all refits of the window, in samples propagated with derivatives, shape (members,).
    work: Array
    # 1 if the search ended in a minimum that explains the samples, else 0, shape (members,).
    converged: Array
    # Number of samples in the last search that screened points in vain, else 0, shape (members,).
    screened: IntArray
    # Solution in coordinates on the rows of the start, shape (members, r, 1).
    xi: Array = field(metadata={"grows": 1})

    @classmethod
    def none(cls, start: FilterState) -> FitState:
        """Return the value before any refit, for windows that begin at `start`."""
        members, rows = start.C.shape[:2]
        zero, nothing = np.zeros(members), np.zeros(members, dtype=np.int64)
        return cls(
            samples=nothing,
            cost=zero,
            readings=zero,
            refused=zero,
            work=zero,
            converged=zero,
            screened=nothing,
            xi=np.zeros((members, rows, 1)),
        )

    def member(self, k: int) -> Fit | None:
        """Return the last refit of member `k`; None before the first refit."""
        if not self.samples[k]:
            return None
        return Fit(
            samples=int(self.samples[k]),
            cost=float(self.cost[k]),
            passes=float(self.work[k]) / int(self.samples[k]),
            readings=int(self.readings[k]),
            refused=int(self.refused[k]),
            converged=bool(self.converged[k]),
        )


@dataclass(frozen=True, eq=False)
class Fork:
    """A refit in progress while samples continue; the arrays are empty without one."""

    # Filter at the start of the refit; after its end, the filter that continues from its result.
    filter: FilterState
    samples: IntArray  # number of samples that are fitted, shape (1,)
    row: IntArray  # row of the log that the filter has assimilated last, shape (1,)
    fitted: Mask  # True after the end of the refit, shape (1,)

    @classmethod
    def none(cls, x: FilterState) -> Fork:
        """Return the value without a refit in progress."""
        nothing = np.zeros(0, dtype=np.int64)
        return cls(take(x, nothing), samples=nothing, row=nothing, fitted=nothing.astype(bool))

    @classmethod
    def of(cls, state: SensitivityState) -> Fork:
        """Return the value at the start of a refit of all stored samples of one member."""
        row = np.array([state.log.shape[1] - 1])
        no = np.zeros(1, dtype=bool)
        return cls(state.now, samples=state.assimilated, row=row, fitted=no)

    def __len__(self) -> int:
        return len(self.samples)


@dataclass(frozen=True, eq=False)
class Scale:
    """Range of the readings of each sensor so far, and its first innovation."""

    # Smallest and largest reading, and size of the first innovation, shapes (members, sensors); NaN
    # before any reading.
    low: Array
    high: Array
    first: Array

    @classmethod
    def start(cls, sensors: int, members: int = 1) -> Scale:
        never = np.full((members, sensors), np.nan)
        return cls(never, never, never)

    @property
    def ranges(self) -> Array:
        """Ranges of the readings so far, (members, sensors); zero before any reading."""
        return np.nan_to_num(self.high - self.low)

    def add(self, z: Array, d: Array) -> Scale:
        """Return the ranges after a sample z with innovations d, NaN where missing."""
        first, unseen = self.first, np.isnan(self.first)
        if np.count_nonzero(unseen):
            first = np.where(unseen, np.abs(d), first)
        # fmin and fmax ignore NaN: a missing reading does not change the range.
        return Scale(np.fmin(self.low, z), np.fmax(self.high, z), first)

    def without_refused(self, before: Scale, refused: IntArray) -> Scale:
        """Return the ranges after a sample, unchanged from `before` for refused readings.

        An outlier in the range would hide any later runaway.
        """
        if not np.count_nonzero(refused):
            return self
        pairs = zip(vars(before).values(), vars(self).values(), strict=True)
        return Scale(*(np.where(refused, earlier, now) for earlier, now in pairs))

    def beyond(self, d: Array, noise: Array) -> Array:
        """Return the largest innovation over the largest range so far, shape (members,).

        Both are in units of the noise of their sensor, and the range is at least 1. It is the range
        of the sensor that varied most, because a wave may not have reached the other sensors yet.
        """
        # The first innovation replaces the range of a sensor with a single reading.
        ranges = np.fmax(np.fmax(self.high - self.low, self.first), noise) / noise
        unseen = np.isnan(self.first) | np.isnan(self.low)
        worst = np.fmax.reduce(np.where(unseen, np.nan, np.abs(d) / noise), axis=1)
        largest = np.where(unseen, 0.0, ranges).max(axis=1)
        # Without readings there is no innovation, hence no runaway.
        return np.where(np.isnan(worst), 0.0, worst / np.where(largest > 0.0, largest, np.inf))


def stored(
    work: SensitivityWork,
    state: SensitivityState,
    now: FilterState,
    span: Span,
    taken: Mask,
    anchored: Mask | None = None,
    **parts: Any,
) -> SensitivityState:
    """Return a state with the filter after a sample, stored for the members in `taken`."""
    if not work.keeps_log:
        return changed(state, now=now, **parts)
    log = added(state.log, span, taken, now.parts)
    parts["log"] = log
    if np.count_nonzero(now.screened.excluded):
        parts |= _set_aside(work, state, now, log, taken)
    if work.window:
        parts["assimilated"] = state.assimilated + (taken & span.present)
    # A window ends at a pause, which changes the state as a disturbance does.
    pause = now.driven.pause
    begun = taken & (pause if anchored is None else pause | anchored)
    if work.tried and len(state) == 1:
        parts |= _trial(work, state, now, span, disturbed=bool(begun[0] & ~pause[0]))
    if work.window and np.count_nonzero(begun):
        parts |= _windows_from(state, now, log.shape[1] - 1, begun)
    parts |= _points_of_return(work, state, now, taken, log.shape[1] - 1)
    return changed(state, now=now, **parts)


def _set_aside(
    work: SensitivityWork, state: SensitivityState, now: FilterState, log: Array, taken: Mask
) -> dict[str, Any]:
    """Return the fields that change if the gate excludes sensors.

    Their readings since the first refusal are removed from the log, and a refit in progress that
    uses one of these readings is dropped.
    """
    kept = withdrawn(log, now.screened.excluded & taken[:, None], now.screened.since)
    if kept is log:
        return {"log": log}
    # A refit counts the removed readings as refused. Otherwise evidence would depend on the number
    # of readings in use, and on the unit of the sensor.
    evidence = state.start.evidence + work.evidence_of_refused(log, kept, now.level)
    parts = {"log": kept, "start": changed(state.start, evidence=evidence)}
    row = int(state.fork.row[0]) + 1 if len(state.fork) else 0
    if np.array_equal(kept[:, :row], log[:, :row], equal_nan=True):
        return parts
    return {**parts, "fork": Fork.none(now), "due": state.assimilated}


def _points_of_return(
    work: SensitivityWork, state: SensitivityState, now: FilterState, taken: Mask, last: int
) -> dict[str, Any]:
    """Return the fields of the earlier filters after a sample in the `last` row of the log."""
    # Two earlier filters suffice. Every `back` samples the newer filter becomes the older one, so
    # that the law can go back by at least `back` and less than 2 `back` samples.
    if not work.back or last - state.since_newer.min() < work.back:
        return {}
    due = taken & (last - state.since_newer >= work.back)
    if not due.any():
        return {}
    return {
        "older": where(due, state.newer, state.older),
        "newer": where(due, now, state.newer),
        "since_older": np.where(due, state.since_newer, state.since_older),
        "since_newer": np.where(due, last, state.since_newer),
    }


def _trial(
    work: SensitivityWork, state: SensitivityState, now: FilterState, span: Span, *, disturbed: bool
) -> dict[str, Any]:
    """Return the fields of one member's samples for trials of columns, after another sample.

    For constant unknowns, the samples of the fit also serve the trials. After a disturbance that a
    wrong column may have caused, the state is wrong too, and separate samples are stored. That
    cause is possible early in a run, and later if an input is held: its clock shows at switches.
    """
    before, start = state.trial, state.trial_start
    if not before.shape[1]:
        before = state.log[:, int(state.window[0]) :]
        if work.fits:
            late = before.shape[1] > EARLY and not work.filter.problem.control.held
            if late or not disturbed:
                return {}
            before, start = before[:, : work.tried], state.start
            if before.shape[1] == work.tried:
                return {"trial": before, "trial_start": start}
    if before.shape[1] >= work.tried or _reaches(before, span.t1):  # full, or a repeated sample
        return {}
    trial = added(before, span, np.ones(1, dtype=bool), now.parts)
    if not now.driven.pause[0]:
        return {"trial": trial, "trial_start": start}
    if work.fits:
        return {"trial": trimmed(trial, trial.shape[1]), "trial_start": zeros(now)}
    return {"trial": trimmed(trial, trial.shape[1] - 1), "trial_start": now}


def _reaches(log: Array, t: float) -> bool:
    """Return True if a log of one member has a row at time `t` or later."""
    return bool(log.shape[1]) and not log[0, -1, 0] < t


def _windows_from(
    state: SensitivityState, now: FilterState, row: int, begun: Mask
) -> dict[str, Any]:
    """Return the fields if new windows begin with the filter at a row, for the members `begun`.

    A trajectory of constant unknowns cannot follow a disturbance or a pause.
    """
    zero = np.zeros(len(begun), dtype=np.int64)
    return {
        "start": where(begun, now, state.start),
        "window": np.where(begun, row, state.window),
        "opening": state.opening & ~begun,
        "initial": state.initial & ~begun,
        "assimilated": np.where(begun, zero, state.assimilated),
        "due": np.where(begun, zero + 1, state.due),
        "fit": where(begun, FitState.none(now), state.fit),
        "fork": Fork.none(now),
    }


def shortened(work: SensitivityWork, state: SensitivityState) -> SensitivityState:
    """Return a state without the rows of the log that are no longer needed."""
    rows, least = state.log.shape[1], max(work.back, LEAST)
    if rows <= least:
        return state
    # The first row that any member may still go back to; row numbers are shifted by it.
    older = state.since_older if work.back else np.full(len(state), rows - 1)
    if older.min() < least:
        return state
    stays = state.due != NEVER
    first = int(np.where(stays, np.minimum(older, state.window), older).min())
    if first < least:
        return state
    return changed(
        state,
        log=trimmed(state.log, first),
        window=np.maximum(state.window - first, 0),
        fork=changed(state.fork, row=state.fork.row - first),
        since_older=state.since_older - first,
        since_newer=state.since_newer - first,
    )


def reports_of(work: SensitivityWork, now: FilterState, outcome: Assimilation) -> MemberReports:
    """Return the reports of the members after a sample."""
    members = len(now)
    diagnose = read_later(_diagnosed, work, kept_for_estimates(now), outcome.refused)
    steps = np.full(members, outcome.steps)
    return MemberReports((OK,) * members, outcome.predicted, steps, diagnose, now.parts)


def _diagnosed(
    samples: Sequence[tuple[SensitivityWork, FilterState, Mask]],
) -> list[Diagnostics[Array]]:
    """Return the diagnostics of each sample, from the filter after it and the refused readings."""
    (work, *_), now = samples[0], joined([x for _, x, _ in samples])
    reduction, shadows = work.filter.reduction, work.filter.shadows
    result = replace(now.innovations.diagnostics, log_evidence=now.evidence)
    if work.options.adaptive:
        result = replace(result, noise_level=np.sqrt(now.level))
    if work.options.gate.beyond < np.inf:
        refused = np.concatenate([refused for *_, refused in samples])
        result = _with_refused(result, refused, work.filter.problem.observed.names)
    if work.jumps is not None:
        result = replace(result, jump=np.zeros(len(now)))
    if shadows is not None:
        result = result.updated(shadows.diagnostics(now, robust_factors(reduction, now)[1]))
    estimate = work.filter.estimate(now)
    held = reduction.held(estimate)
    if held.any():
        result = replace(result, bounded=np.where(held > 0, held, np.nan))
    if len(samples) == 1:
        return [result]
    return [result.each(itemgetter([k])) for k in range(len(samples))]


def _with_refused(
    result: Diagnostics[Array], refused: Mask, sensors: Sequence[str]
) -> Diagnostics[Array]:
    """Return diagnostics with the number of refused readings, and a number for each sensor."""
    which = np.flatnonzero(refused.any(axis=0)).tolist()
    each = {refusal(sensors[i]): np.where(refused[:, i], 1.0, np.nan) for i in which}
    count = refused.sum(axis=1).astype(float)
    return replace(result, refused=count, extra={**result.extra, **each})


def joined(states: Sequence[FilterState]) -> FilterState:
    """Join filters after several samples as members of one, with the fields that estimates use."""
    names = ("member", "u", "q", "du", "da", "U", "C", "age", "level", "evidence", "innovations")
    shadows = join_fields([x.shadows for x in states], ("u", "a", "fine", "failed"))
    return changed(join_fields(states, names), shadows=shadows)


def read_later(of: Any, work: SensitivityWork, x: FilterState, *more: Any) -> Later[Any]:
    """Return a deferred call of `of` with a filter from `kept_for_estimates`."""
    # Joining large arrays saves no time and would copy them.
    few = len(x) == 1 and x.U.size <= FEW
    return Later(of, (work, x, *more), (of, id(work), x.U.shape) if few else None)


def kept_for_estimates(x: FilterState) -> FilterState:
    """Return a filter state without the data for its next steps and its verdict."""
    shadows = x.shadows.without_stages() if x.shadows.u.shape[1] else x.shadows
    none = x.causes[:, :, :0]
    return changed(x, kept=x.kept.forgotten(), shadows=shadows, causes=none, ledger=NO_LEDGER)


def new_window(
    work: SensitivityWork, start: FilterState, state: SensitivityState, row: int | None = None
) -> SensitivityState:
    """Return one member with a new window that begins at a filter and has no samples yet.

    `row`: row of the log of this filter; later rows are dropped. Default the last row.
    """
    log = state.log if row is None else state.log[:, : row + 1]
    kept = work.kept_start(start)
    zero = np.zeros(1, dtype=np.int64)
    no = np.zeros(1, dtype=bool)
    return changed(
        state,
        now=start,
        start=kept,
        log=log,
        window=zero + log.shape[1] - 1,
        opening=no,
        initial=no,
        assimilated=zero,
        due=zero + (1 if work.window else NEVER),
        fit=FitState.none(kept),
        fork=Fork.none(start),
    )


def restarted(
    work: SensitivityWork, start: FilterState, state: SensitivityState, row: int | None = None
) -> SensitivityState:
    """Return one member with a `new_window` that cannot go back beyond its start."""
    return without_past(new_window(work, start, state, row))


def without_past(state: SensitivityState) -> SensitivityState:
    """Return one member that cannot go back beyond the present."""
    last = np.array([state.log.shape[1] - 1])
    now = state.now
    return changed(state, older=now, newer=now, since_older=last, since_newer=last)
