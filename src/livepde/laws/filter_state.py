"""State of the reduced-order filter: mean and covariance square root of each member."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from livepde.laws.gate import Screened
from livepde.laws.innovations import Innovations
from livepde.laws.member_arrays import changed
from livepde.laws.pauses import InputHistory
from livepde.laws.shadow_state import ShadowState
from livepde.linalg import Array, IntArray
from livepde.stepping import KeptFactors
from livepde.verdict import Ledger

NO_LEDGER = Ledger.start(0, 0, 0, 0, 0, 0, 0, 1, 0)  # of a filter that is not judged


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
    screened: Screened  # what the gate remembers of each sensor
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
    driven: InputHistory  # what the inputs have done so far

    def __len__(self) -> int:
        return len(self.member)


def along(x: FilterState, k: int, shift: Array) -> Array:
    """Return by how much the state of a member is expected to move with a shift of a, (n,)."""
    if not shift.any():
        return np.zeros(x.u.shape[1])
    # With xi ~ N(0, I) and a = C^T xi, the least xi that gives the shift is the expected one.
    weights = np.linalg.lstsq(x.C[k].T, shift, rcond=None)[0]
    moved: Array = weights @ x.U[k]
    return moved


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
