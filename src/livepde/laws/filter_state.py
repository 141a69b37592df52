"""State of the filter: mean and covariance square root of each member, and what surrounds them.

Pauses of a source: in an interval much longer than usual, inputs are no straight lines. After a
pause the state is as uncertain as inputs could have made it that varied in the pause as they did
before. So the next readings correct the state and hardly the unknowns, which are kept.
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

PAUSE = 5.0  # usual intervals: in a longer one inputs are not known
SETTLED = 20  # intervals before which none is usual
FORGOTTEN = 50.0  # shorter intervals that follow, until the pace has fallen by 63 %
SPREAD = 1.0 / np.sqrt(8.0)  # standard deviation of a sine over its range
NO_LEDGER = Ledger.start(0, 0, 0, 0, 0, 0, 0, 1, 0)  # of a filter that is not judged


@dataclass(frozen=True, eq=False)
class InputHistory:
    """Ranges and rates of the inputs so far, and the pace of their samples."""

    # Range of each input, and its largest rate of change, shapes (members, channels).
    low: Array
    high: Array
    steepest: Array
    # Longest usual interval, which fades while shorter ones follow: a pause a week is no pace.
    # Shape (members,); 0 before.
    pace: Array
    count: Array  # intervals so far, at most `SETTLED`, shape (members,)
    pause: Mask  # whether the last interval was a pause, shape (members,)

    @classmethod
    def start(cls, channels: int, members: int = 1) -> InputHistory:
        far = np.full((members, channels), np.inf)
        none = np.zeros(members)
        return cls(
            low=far, high=-far, steepest=np.zeros_like(far), pace=none, count=none, pause=none > 0.0
        )

    def after(self, span: Span) -> InputHistory:
        """Return the value after an interval; a pause does not show how steep inputs are."""
        length = span.t1 - span.t0
        if not length.all():
            return self
        pause: Mask = (length > PAUSE * self.pace) & (self.count >= SETTLED)
        # The first interval, from t0 on, may be of any length.
        late = (self.count == 1.0) & (self.pace > PAUSE * length)
        pace = np.where(late, length, self.pace)
        known = self.low.shape[1]  # a fleet's validation sensors may read more channels
        first, last = span.inputs0[:, :known], span.inputs1[:, :known]
        slopes = np.abs(last - first) / length[:, None]
        if np.count_nonzero(pause):
            slopes = np.where(pause[:, None], 0.0, slopes)
            # A pace that changes for good is usual after a few samples.
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
        """Return by how much inputs may leave their lines in pauses, (members, channels)."""
        spread = SPREAD * (self.high - self.low)
        found: Array = np.minimum(spread, 0.5 * self.steepest * length[:, None])
        return np.where(np.isfinite(found), found, 0.0)


def pauses(times: Sequence[float] | Array) -> list[int]:
    """Return the numbers of the samples that end a pause, by the rule of `InputHistory`."""
    found, pace = [], 0.0
    for k, length in enumerate(np.diff(times).tolist()):
        if k == 1 and pace > PAUSE * length:
            pace = length
        if k >= SETTLED and length > PAUSE * pace:
            found.append(k + 1)
            length = PAUSE * pace
        pace = max(pace + (length - pace) / FORGOTTEN, length)
    return found


@dataclass(frozen=True, eq=False)
class ShadowState:
    """Shifts of the estimates of each member; the leading axis of every array is the members."""

    # Shifts of state and reduced unknowns by the discretisation, a row for each shadow, shapes
    # (members, shadows, n) and (members, shadows, k).
    u: Array
    a: Array
    # Steps so far, and at which the shadows were taken last and are taken next, (members,).
    count: IntArray
    last: IntArray
    due: IntArray
    # Change of the state per unit of time in the last step, how much that usually differs from one
    # step to the next, and the count of steps at which it last differed by much more; shapes
    # (members, n), (members,) and (members,).
    rate: Array
    usual: Array
    jumped: IntArray
    size: Array  # norm of the last error that the step shadow found, (members,); infinite before
    # Time, state and inputs where the shadows were taken last; the state without columns if no
    # shadow needs it. Shapes (members,), (members, n) and (members, channels).
    begun: Array
    u0: Array
    inputs0: Array
    # Of the last interval, infinite before the first, and how inputs changed in it per unit of
    # time; shapes (members,) and (members, channels).
    length: Array
    slope: Array
    # Integral over the last interval of the difference of the inputs from straight lines, and the
    # sum of these integrals that no shadow has stepped with yet, shapes (members, channels).
    bend: Array
    missed: Array
    # Of inputs that are held: last value, last change, and sums of the squares of changes and of
    # their differences, shape (members, 4, channels).
    held: Array
    # Warm-start data of the last stages of halved steps, and of a block of steps.
    halves: KeptFactors
    blocks: KeptFactors
    # The state on the halved mesh minus that of the filter, shape (members, N), and the warm-start
    # data of the last stage on the halved mesh.
    fine: Array
    fine_stage: KeptFactors
    seen: Array  # the difference in the predicted readings due to `fine`, shape (members, sensors)
    # Sum of the gains of the samples since the shadows were taken last, each times the time since
    # then, shape (members, sensors, k); without sensors if no shadow needs it.
    gains: Array
    failed: IntArray  # how many shadow steps had no solution, shape (members,)
    # Error of the last step that the step shadow took, over what is allowed, shape (members,).
    excess: Array
    # How many steps were left with a larger one, and the largest `excess` of them, (members,).
    coarse: IntArray
    coarsest: Array

    def __len__(self) -> int:
        return len(self.count)

    @classmethod
    def none(cls, members: int, n: int, k: int) -> ShadowState:
        # No step writes into the arrays of a state, so that several fields may share one.
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
        """Return the shifts alone, without the data that only the next steps need."""
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
    """State of a filter for each member, after the samples so far."""

    member: IntArray  # numbers of the members, shape (members,)
    # Linearisation point: state and latent parameter, shapes (members, n) and (members, m).
    u: Array
    q: Array
    # Estimated differences of u and of the reduced unknowns a from the linearisation point,
    # (members, n) and (members, k).
    du: Array
    da: Array
    # Square root of the joint covariance of u and a, shapes (members, r, n) and (members, r, k). As
    # long as nothing moves, r = k.
    U: Array = field(metadata={"grows": 1})
    C: Array = field(metadata={"grows": 1})
    # Square root and estimate of earlier values of a, one after the other, that a smoother follows;
    # shapes (members, r, p) and (members, p), p = 0 otherwise.
    past: Array = field(metadata={"grows": 1})
    dpast: Array
    age: Array  # time for which the unknowns have moved, shape (members,)
    # How fast the readings forget the process noise of unknowns that move, by which steps are
    # divided, shape (members,).
    rate: Array
    innovations: Innovations  # statistics of the innovations
    # In how many parts the substeps since the sample before were divided, shape (members,).
    parts: IntArray
    screened: Screened  # memory of the gate, by sensor
    # Square of the noise as a multiple of the stated one, 1 unless the filter finds it, and how
    # many samples that stands for, shapes (members,).
    level: Array
    samples: Array
    # Logarithm of the likelihood of all readings so far, each sample given those before; a reading
    # that is refused counts as one at the limit of the gate, (members,).
    evidence: Array
    kept: KeptFactors  # warm-start data of the last stage for the next one
    # Data of the verdict: the shifts of the estimate by possible causes of misfit, as coordinates
    # on the rows of the square root, (members, r, columns), and running sums; see
    # `livepde.verdict`. The filter itself never reads them.
    causes: Array = field(metadata={"grows": 1, "begins_anew": True})
    ledger: Ledger = field(metadata={"begins_anew": True})
    shadows: ShadowState  # estimated discretisation error
    driven: InputHistory  # ranges and rates of the inputs so far

    def __len__(self) -> int:
        return len(self.member)


def coordinates(C: Array, shift: Array) -> Array:
    """Return the least xi with C^T xi = shift: the expected one if xi ~ N(0, I) and a = C^T xi."""
    return np.asarray(np.linalg.lstsq(C.T, shift, rcond=None)[0])


def along(x: FilterState, k: int, shift: Array) -> Array:
    """Return by how much the state of a member is expected to move with a shift of a, (n,)."""
    if not shift.any():
        return np.zeros(x.u.shape[1])
    return np.asarray(coordinates(x.C[k], shift) @ x.U[k])


def extended(rows: Array, count: int) -> Array:
    """Return rows of a square root, (members, r, ...), and so many rows of zeros."""
    members, r, size = rows.shape
    longer = np.zeros((members, r + count, size))
    longer[:, :r] = rows
    return longer


def with_rows(x: FilterState, U: Array, C: Array) -> FilterState:
    """Return a filter state with more rows [U C], independent of the past and of all causes."""
    past, causes = (extended(part, U.shape[1]) for part in (x.past, x.causes))
    U, C = np.concatenate([x.U, U], axis=1), np.concatenate([x.C, C], axis=1)
    return changed(x, U=U, C=C, past=past, causes=causes)


def unjudged(x: FilterState) -> FilterState:
    """Return a filter state without its ledger."""
    return changed(x, causes=np.zeros((*x.causes.shape[:2], 0)), ledger=NO_LEDGER)


def unaccompanied(x: FilterState) -> FilterState:
    """Return a filter state without its ledger and without the errors of the discretisation."""
    members, k = x.da.shape
    return changed(unjudged(x), shadows=ShadowState.none(members, x.u.shape[1], k))
