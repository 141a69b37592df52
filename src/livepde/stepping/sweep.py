"""Many steps of an affine process with fixed unknowns, each by a product with a small matrix.

If stages of equal length differ only in their inputs, a step of a scheme is y+ = Q y + g, with one
matrix Q for each length. All g in a block of steps are solved for at once, as members of one stage.
Then the forcing of the tangents is solved for in the same way, since they have the same Q.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from livepde.linalg import Array, IntArray, nonfinite_allowed
from livepde.stepping.interval import Moments
from livepde.stepping.member_stage import BandedStage, MemberStage, StageOfMembers
from livepde.stepping.schemes import Advance, Scheme, advance, safe_point

BLOCK = 256  # steps that are solved for at once
WIDEST = 256  # coefficients of a state up to which products are cheaper than stages
NOTHING = np.zeros(0)
MOST_ENTRIES = 2e7  # most entries of all matrices of a sweep, 160 MB
REPEATED = 8  # mean number of steps per length from which the matrices are cheaper than stages


@dataclass(frozen=True, eq=False, kw_only=True)
class Steps:
    """The substeps of the spans of one process."""

    # starts, lengths, of: start, length, and index of the span of each substep.
    starts: Array
    lengths: Array
    of: IntArray
    after: IntArray  # number of substeps up to the end of each span
    # ends, inputs0, inputs1, channels: start and end of each span, (spans, 2), and the inputs
    # there, (spans, channels).
    ends: Array
    inputs0: Array
    inputs1: Array
    channels: tuple[str, ...]

    @classmethod
    def through(
        cls,
        ends: Array,
        parts: IntArray,
        inputs0: Array,
        inputs1: Array,
        channels: tuple[str, ...],
        control: Advance,
    ) -> Steps:
        """Return the substeps of a control through spans if no step fails.

        `parts`: number of parts of each substep, (spans,). `inputs0`, `inputs1`: from the samples.
        """
        substeps, counts = list[tuple[float, float]](), list[int]()

        def begin(t: float, h: float) -> None:
            substeps.append((t, h))

        for (start, stop), division in zip(ends.tolist(), parts.tolist(), strict=True):
            count = len(substeps)
            if stop > start:
                divided = control.divided(max(division, 1))
                advance(divided, lambda y, t, h: y, NOTHING, start, stop, begin)
            counts.append(len(substeps) - count)
        starts, lengths = np.reshape(substeps, (-1, 2)).T
        inputs0, inputs1 = control.held.acting(channels, inputs0, inputs1, inputs1)
        return cls(
            starts=starts,
            lengths=lengths,
            of=np.repeat(np.arange(len(ends)), counts),
            after=np.cumsum(counts),
            ends=ends,
            inputs0=inputs0,
            inputs1=inputs1,
            channels=channels,
        )

    @property
    def repeat(self) -> bool:
        """Whether there are many steps with few different lengths."""
        return len(np.unique(self.lengths)) * REPEATED <= len(self.lengths)

    def moments(self, some: IntArray, t: float, members: int) -> Moments:
        """Return the inputs of all members at a time t after the start of the substeps `some`."""
        of = self.of[some]
        begin, end = self.ends[of].T
        share = ((self.starts[some] + t - begin) / (end - begin))[:, None]
        first, last = self.inputs0[of], self.inputs1[of]
        inputs = np.where(first == last, last, (1.0 - share) * first + share * last)
        return Moments(t, self.channels, inputs.repeat(members, axis=0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Sweep:
    """Trajectories of members with fixed unknowns through all steps.

    `q`: unknowns, (members, dim). `directions`: their derivatives along each tangent, (members, r,
    m). `matrices`: length of a step -> transpose of Q, (members, n, n).
    """

    stage: BandedStage
    scheme: Scheme
    steps: Steps
    q: Array
    directions: Array
    matrices: Mapping[float, Array]

    @classmethod
    @nonfinite_allowed()
    def of(
        cls, stage: MemberStage, scheme: Scheme, steps: Steps, q: Array, directions: Array
    ) -> Sweep | None:
        """Return the sweep; None if it is not applicable, or if separate stages are cheaper."""
        if not (isinstance(stage, BandedStage) and stage.repeats and steps.repeat):
            return None
        (members, _, m), n = directions.shape, stage.model.X.dim
        lengths = np.unique(steps.lengths).tolist()
        if n > WIDEST or len(lengths) * members * n * n > MOST_ENTRIES:
            return None
        zero, matrices = np.zeros((members, n, m)), dict[float, Array]()
        homogeneous = cls(
            stage=stage, scheme=scheme, steps=steps, q=q, directions=zero, matrices=matrices
        )
        units = np.zeros((1 + n, 1, members, n))
        units[1:, 0] = np.eye(n)[:, None]
        for h in lengths:
            first = np.flatnonzero(steps.lengths == h)[:1]
            matrices[h] = homogeneous._advanced(units, first, {})[1:, 0].transpose(1, 0, 2).copy()
            if not np.isfinite(matrices[h]).all():
                return None
        return replace(homogeneous, directions=directions)

    @nonfinite_allowed()
    def blocks(self, columns: Array) -> Iterator[tuple[slice, Array]]:
        """Yield indices of spans, and columns at their ends, (spans, 1 + r, members, n).

        `columns`: initial states and tangents, (1 + r, members, n).
        """
        steps, r = self.steps, len(columns) - 1
        for first in range(0, max(len(steps.of), 1), BLOCK):
            safe_point()
            rows, factors = np.arange(first, min(first + BLOCK, len(steps.of))), dict[float, Any]()
            zero = np.zeros((1, len(rows), *columns.shape[1:]))
            states = self._recursion(columns[:1], rows, self._advanced(zero, rows, factors))
            at_steps = states
            if r:
                zero = np.broadcast_to(zero, (r, *zero.shape[1:]))
                driven = self._advanced(np.concatenate([states[:, :-1], zero]), rows, factors)[1:]
                at_steps = np.concatenate([states, self._recursion(columns[1:], rows, driven)])
            columns = at_steps[:, -1]
            low, high = np.searchsorted(steps.after, [first, first + len(rows)], side="right")
            part = slice(int(low) if first else 0, int(high))
            if part.start < part.stop:
                yield part, at_steps[:, steps.after[part] - first].swapaxes(0, 1)

    def _recursion(self, columns: Array, rows: IntArray, driven: Array) -> Array:
        """Return columns before the steps `rows` and after the last, (c, steps + 1, members, n)."""
        c, count, members, n = driven.shape
        states = np.empty((count + 1, members, c, n))
        states[0], driven = columns.swapaxes(0, 1), driven.transpose(1, 2, 0, 3)
        for k, h in enumerate(self.steps.lengths[rows].tolist()):
            np.matmul(states[k], self.matrices[h], out=states[k + 1])
            states[k + 1] += driven[k]
        return states.transpose(2, 0, 1, 3)

    def _advanced(self, columns: Array, rows: IntArray, factors: dict[float, Any]) -> Array:
        """Return columns, (1 + r, steps, members, n), each advanced by one of the steps `rows`."""
        advanced, lengths = np.empty(columns.shape), self.steps.lengths[rows]
        for h in np.unique(lengths).tolist():
            equal = np.flatnonzero(lengths == h)
            advanced[:, equal] = self._advance_equal(columns[:, equal], rows[equal], h, factors)
        return advanced

    def _advance_equal(
        self, columns: Array, rows: IntArray, h: float, factors: dict[float, Any]
    ) -> Array:
        """Return columns advanced by steps of equal length, which are members of one stage."""
        c, steps, members, n = columns.shape
        q = np.tile(self.q, (steps, 1))
        directions = np.tile(self.directions, (steps, 1, 1))
        zero, kept = np.zeros(len(q), dtype=np.int64), self.stage.kept(len(q))

        def stage(columns: Array, t: float, length: float) -> Array:
            at = self.steps.moments(rows, t, members)
            work = StageOfMembers(zero, q, directions, length, at, kept, zero > 0, factors)
            return self.stage.advance(columns, work)[0]

        joined = columns.reshape(c, steps * members, n)
        return self.scheme.advance(stage, joined, 0.0, h).reshape(columns.shape)
