"""State of the filter: mean and covariance square root of each member, and its statistics.

In a pause, an interval much longer than usual, linear interpolation of the inputs is not valid. The
state after a pause is as uncertain as if the inputs had varied as before the pause. Therefore the
next readings mainly correct the state and barely change the unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from livepde.laws.gate import Screened
from livepde.laws.innovations import Innovations
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.stepping import KeptFactors, Span
from livepde.verdict import Ledger

PAUSE = 5.0  # usual intervals: a longer interval is a pause
SETTLED = 20  # intervals required before a pause can be detected
FORGOTTEN = 50.0  # time constant, in intervals, with which the pace decreases
SPREAD = 1.0 / np.sqrt(8.0)  # standard deviation of a sine over its range
NO_LEDGER = Ledger.start(0, 0, 0, 0, 0, 0, 0, 1, 0)  # for a filter without a verdict


@dataclass(frozen=True, eq=False)
class InputHistory:
    """Ranges and rates of change of the inputs so far, and the usual interval between samples."""

    # Range of each input and its largest rate of change, shapes (members, channels).
    low: Array
    high: Array
    steepest: Array
    # Longest usual interval, which decays while shorter intervals follow, so that rare pauses do
    # not count as usual. Shape (members,); 0 before the first interval.
    pace: Array
    count: Array  # number of intervals so far, at most `SETTLED`, shape (members,)
    pause: Mask  # whether the last interval was a pause, shape (members,)

    @classmethod
    def start(cls, channels: int, members: int = 1) -> InputHistory:
        far = np.full((members, channels), np.inf)
        none = np.zeros(members)
        return cls(
            low=far, high=-far, steepest=np.zeros_like(far), pace=none, count=none, pause=none > 0.0
        )

    def after(self, span: Span) -> InputHistory:
        """Return the history after an interval; rates of change in a pause are ignored."""
        length = span.t1 - span.t0
        if not length.all():
            return self
        pause: Mask = (length > PAUSE * self.pace) & (self.count >= SETTLED)
        # The first interval begins at t0 and may have any length.
        late = (self.count == 1.0) & (self.pace > PAUSE * length)
        pace = np.where(late, length, self.pace)
        known = self.low.shape[1]  # validation sensors of a fleet may use additional channels
        first, last = span.inputs0[:, :known], span.inputs1[:, :known]
        slopes = np.abs(last - first) / length[:, None]
        if np.count_nonzero(pause):
            slopes = np.where(pause[:, None], 0.0, slopes)
            # With this limit, a permanently slower pace counts as usual after a few samples.
            length = np.where(pause, PAUSE * pace, length)
        return InputHistory(
            low=np.fmin(self.low, last),
            high=np.fmax(self.high, last),
            steepest=np.fmax(self.steepest, slopes),
            pace=np.maximum(pace + (length - pace) / FORGOTTEN, length),
            count=np.minimum(self.count + 1.0, SETTLED),
            pause=pause,
        )

    def deviation(self, length: Array) -> Array:
        """Return the standard deviations of inputs from straight lines, (members, channels)."""
        spread = SPREAD * (self.high - self.low)
        deviation: Array = np.minimum(spread, 0.5 * self.steepest * length[:, None])
        return np.where(np.isfinite(deviation), deviation, 0.0)


def pauses(times: Sequence[float] | Array) -> list[int]:
    """Return the indices of the samples that end a pause, by the rule of `InputHistory`."""
    ends, pace = [], 0.0
    for k, length in enumerate(np.diff(times).tolist()):
        if k == 1 and pace > PAUSE * length:
            pace = length
        if k >= SETTLED and length > PAUSE * pace:
            ends.append(k + 1)
            length = PAUSE * pace
        pace = max(pace + (length - pace) / FORGOTTEN, length)
    return ends


@dataclass(frozen=True, eq=False)
class ShadowState:
    """Estimated discretisation errors; the leading axis of every array is the members."""

    # Shifts of state and reduced unknowns due to the discretisation, one row for each shadow,
    # shapes (members, shadows, n) and (members, shadows, k).
    u: Array
    a: Array
    # Number of steps so far, and step numbers of the last and the next shadow step, (members,).
    count: IntArray
    last: IntArray
    due: IntArray
    # Rate of change of the state in the last step, (members, n); usual change of this rate from one
    # step to the next, (members,); and step number of the last much larger change, (members,).
    rate: Array
    usual: Array
    jumped: IntArray
    size: Array  # norm of the last error of the step shadow, (members,); infinite before the first
    # Time, state and inputs at the last shadow step, shapes (members,), (members, n) and (members,
    # channels). The state has no columns if no shadow requires it.
    begun: Array
    u0: Array
    inputs0: Array
    # Length of the last interval, infinite before the first, and rate of change of the inputs in
    # it; shapes (members,) and (members, channels).
    length: Array
    slope: Array
    # Integral of the deviation of the inputs from straight lines over the last interval, and sum of
    # such integrals that no shadow step has used yet, shapes (members, channels).
    bend: Array
    missed: Array
    # For inputs that are held: last value, last change, and sums of squares of the changes and of
    # the differences of successive changes, shape (members, 4, channels).
    held: Array
    # Warm-start data of the last stages of halved steps, and of a block of steps.
    halves: KeptFactors
    blocks: KeptFactors
    # State on the mesh of half the width minus the state of the filter, shape (members, N), and
    # warm-start data of the last stage on that mesh.
    fine: Array
    fine_stage: KeptFactors
    seen: Array  # change of the predicted readings due to `fine`, shape (members, sensors)
    # Sum of the gains of the samples since the last shadow step, each times the time since that
    # step, shape (members, sensors, k). The sensor axis is empty if no shadow requires the gains.
    gains: Array
    failed: IntArray  # number of shadow steps without a solution, shape (members,)
    # Error of the last shadow step of the step shadow over the tolerance, shape (members,).
    excess: Array
    # Number of steps whose error exceeded the tolerance, and their largest `excess`, (members,).
    coarse: IntArray
    coarsest: Array

    def __len__(self) -> int:
        return len(self.count)

    @classmethod
    def none(cls, members: int, n: int, k: int) -> ShadowState:
        # Fields may share an array, because steps never write into the arrays of a state.
        zero, time = np.zeros(members, dtype=np.int64), np.zeros(members)
        counts = ("count", "last", "due", "jumped", "failed", "coarse")
        empty = ("u0", "inputs0", "slope", "bend", "missed", "fine", "seen")
        same: dict[str, Any] = dict.fromkeys(counts, zero)
        same |= dict.fromkeys(("usual", "begun", "excess", "coarsest"), time)
        same |= dict.fromkeys(("size", "length"), time + np.inf)
        same |= dict.fromkeys(empty, np.zeros((members, 0)))
        same |= dict.fromkeys(("halves", "blocks", "fine_stage"), KeptFactors.none(members))
        return cls(
            u=np.zeros((members, 0, n)),
            a=np.zeros((members, 0, k)),
            rate=np.zeros((members, n)),
            held=np.zeros((members, 4, 0)),
            gains=np.zeros((members, 0, k)),
            **same,
        )

    def without_stages(self) -> ShadowState:
        """Return the state without warm-start data and other data for the next steps."""
        nothing = np.zeros((len(self), 0))
        return changed(
            self,
            halves=self.halves.forgotten(),
            blocks=self.blocks.forgotten(),
            fine_stage=self.fine_stage.forgotten(),
            u0=nothing,
            inputs0=nothing,
            gains=np.zeros((len(self), 0, self.a.shape[2])),
        )


@dataclass(frozen=True, eq=False)
class FilterState:
    """State of the filter of each member after the samples so far."""

    member: IntArray  # numbers of the members, shape (members,)
    # Linearisation point: state and latent parameters, shapes (members, n) and (members, m).
    u: Array
    q: Array
    # Estimated differences of u and of the reduced unknowns a from the linearisation point,
    # (members, n) and (members, k).
    du: Array
    da: Array
    # Square root of the joint covariance of u and a, shapes (members, r, n) and (members, r, k);
    # r = k for constant unknowns.
    U: Array = field(metadata={"grows": 1})
    C: Array = field(metadata={"grows": 1})
    # Square root and estimate of earlier values of a, concatenated, for a smoother; shapes
    # (members, r, p) and (members, p), with p = 0 without a smoother.
    past: Array = field(metadata={"grows": 1})
    dpast: Array
    age: Array  # time over which the prior of the unknowns has evolved, shape (members,)
    # Rate at which the readings forget the process noise of moving unknowns, shape (members,). It
    # determines how steps are divided.
    rate: Array
    innovations: Innovations  # statistics of the innovations
    # Number of parts into which the substeps of the last interval were divided, shape (members,).
    parts: IntArray
    screened: Screened  # memory of the gate, by sensor
    # Noise variance over its stated value, 1 unless the filter estimates it, and the number of
    # samples that this estimate is worth, shapes (members,).
    level: Array
    samples: Array
    # Log-likelihood of all readings so far, each sample given the samples before, (members,). A
    # refused reading counts as a reading at the limit of the gate.
    evidence: Array
    kept: KeptFactors  # warm-start data of the last stage for the next stage
    # Data of the verdict, which the filter never reads: shifts of the estimate by possible causes
    # of misfit, as coordinates on the rows of the square root, (members, r, columns); and running
    # sums. See `livepde.verdict`.
    causes: Array = field(metadata={"grows": 1, "begins_anew": True})
    ledger: Ledger = field(metadata={"begins_anew": True})
    shadows: ShadowState  # estimated discretisation error
    driven: InputHistory  # ranges and rates of the inputs so far

    def __len__(self) -> int:
        return len(self.member)


def coordinates(C: Array, shift: Array) -> Array:
    """Return the least-norm xi with C^T xi = shift: its mean if xi ~ N(0, I) and a = C^T xi."""
    return np.asarray(np.linalg.lstsq(C.T, shift, rcond=None)[0])


def along(x: FilterState, k: int, shift: Array) -> Array:
    """Return the expected shift of the state of member `k` for a given shift of a, (n,)."""
    if not shift.any():
        return np.zeros(x.u.shape[1])
    return np.asarray(coordinates(x.C[k], shift) @ x.U[k])


def extended(rows: Array, count: int) -> Array:
    """Return rows of a square root, (members, r, ...), with `count` rows of zeros appended."""
    members, r, size = rows.shape
    longer = np.zeros((members, r + count, size))
    longer[:, :r] = rows
    return longer


def with_rows(x: FilterState, U: Array, C: Array) -> FilterState:
    """Append rows [U C] to a filter state, independent of the past and of all causes."""
    past, causes = (extended(part, U.shape[1]) for part in (x.past, x.causes))
    U, C = np.concatenate([x.U, U], axis=1), np.concatenate([x.C, C], axis=1)
    return changed(x, U=U, C=C, past=past, causes=causes)


def unjudged(x: FilterState) -> FilterState:
    """Return a filter state without its ledger."""
    return changed(x, causes=np.zeros((*x.causes.shape[:2], 0)), ledger=NO_LEDGER)


def unaccompanied(x: FilterState) -> FilterState:
    """Return a filter state without its ledger and without discretisation errors."""
    members, k = x.da.shape
    return changed(unjudged(x), shadows=ShadowState.none(members, x.u.shape[1], k))
