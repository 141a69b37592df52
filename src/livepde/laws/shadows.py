"""Discretisation-error estimates of a filter: shifts by time step, mesh and input interpolation.

A filter without discretisation error would process the same samples with the same gain. The error
of the filter, e of the state and s of the unknowns, satisfies

    predict   [e; s]+ = T [e; s] + d,      T the linearised step, d the error of this step
    update    [e; s] <- [e; s] - K H [e; s]

with T, H and the gain K of the filter, for constant and for moving unknowns. T is applied in the
step of the filter, where [e; s] are tangents. Each source of error, a shadow, estimates its d: the
error of the step by Richardson extrapolation from two halved steps, the error of the input lines
from the curvature of the readings. The mesh shadow has a separate trajectory on the halved mesh
with the unknowns of the filter. The difference of the two trajectories is not a d: it is added to
the predicted readings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from livepde.errors import LawError, LivepdeError
from livepde.fem import Moment
from livepde.laws.filter_state import FilterState, ShadowState, along
from livepde.laws.law import Problem
from livepde.laws.reduction import Reduction
from livepde.laws.shadow_kinds import (
    HELD,
    MeanProcess,
    MeshShadow,
    Shadow,
    ShadowedSteps,
    StepShadow,
    StepTolerance,
    input_shadows,
    refusal,
)
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, IntArray, Mask, nonfinite_allowed
from livepde.linalg.member_arrays import changed, product, put, take
from livepde.stepping import TINY, MemberStage, Moments, Span
from livepde.verdict import Shifts
from livepde.verdict.findings import NOT_KNOWN

FIRST = 16  # initial steps with an estimate in each step, because the error changes quickly
CALM = 4  # steps with an estimate in each step after a jump
JUMP = 4.0  # change of the state's rate, relative to its mean, that counts as a jump
USUAL = 16  # steps over which this change is averaged
# Weight of a step in the average, by the number of steps so far; constant for later steps.
WEIGHTS = 1.0 / np.array([1, 1, 1, *range(3, USUAL + 1)])
# Steps between later estimates, 8 on average. They vary, so that the estimates cover all phases of
# a periodic input.
LATER = np.array([5, 11, 7, 9])
AT_ONCE = 3  # largest exponent of 2 by which one estimate divides a step


@dataclass(frozen=True)
class Shadows:
    """Discretisation-error estimates of the sensitivity law.

    The sum of the signed shifts widens the reported covariance: variance plus square of the sum. If
    the error of the time step requires it, the filter divides its steps (`parts`). The filter is
    unchanged otherwise.

    The first 16 steps have an estimate each; later, one step in eight represents its neighbours:
    faster changes of the error of step or input lines are resolved on average only. On the halved
    mesh one long step replaces eight: its shift is overstated if the inputs change within them.

    Parameters
    ----------
    step
        Estimate the error of the time step, by halved steps.
    mesh
        Estimate the error of the mesh, by the halved mesh: for states and unknown fields of first
        order, and sensors that are defined independently of the mesh.
    inputs
        Estimate the error of linear interpolation between readings of a channel, by the curvature
        of three readings, and of values held in gaps, once the next value is known. For channels
        that are constant between readings (`Identifier.between`), the shift of the estimates by
        linear interpolation is estimated for the verdict alone.
    largest
        Maximum number of coefficients of the state on the halved mesh. If there are more, the mesh
        error is not estimated, because the estimate would cost more than the filter.
    parts
        Maximum number of parts of a step. A step whose error exceeds 3 % of the noise of the
        readings is repeated in 2, 4, ... parts, and so are later steps as required. 1: undivided.
    """

    step: bool = True
    mesh: bool = True
    inputs: bool = True
    largest: int = 4000
    parts: int = 16

    def __post_init__(self) -> None:
        if not (self.step or self.mesh or self.inputs):
            raise LawError("Shadows: none is left; write shadows=None to follow no error.")
        if self.largest < 1:
            raise LawError(f"Shadows: largest must be at least 1; got {self.largest}.")
        given: Any = self.parts
        if not (isinstance(given, int) and given >= 1):
            raise LawError(
                f"Shadows: parts must be a whole number of at least 1; got {self.parts!r}."
            )


@dataclass(frozen=True, eq=False)
class ShadowSet:
    """Discretisation-error estimates of a filter."""

    # Problem and reduction of the filter.
    problem: Problem
    reduction: Reduction
    # Function that applies the linearised sensors to rows of state and reduced unknowns, (members,
    # rows, sensors): `MemberSensors.rows`.
    rows: Callable[[FilterState, Array, Array, Moments], Array]
    shadows: tuple[Shadow, ...]  # one for each row of `ShadowState.u`
    refused: str  # reason for a missing mesh shadow; empty if it exists
    most: int  # maximum number of parts of a substep

    @classmethod
    def of(
        cls,
        problem: Problem,
        reduction: Reduction,
        rows: Callable[[FilterState, Array, Array, Moments], Array],
        noise: Array,
        stage: MemberStage,
        options: Shadows,
        *,
        moves: bool,
    ) -> ShadowSet:
        process = MeanProcess(problem.control, stage, reduction, moves)
        refused = refusal(problem, options.largest) if options.mesh else "mesh = false"
        shadows: list[Shadow] = []
        if options.step:
            shadows.append(StepShadow.of(process, StepTolerance(problem, rows, noise)))
        if not refused:
            # Without a halved mesh the identification continues, and reports the reason as a note.
            try:
                shadows.append(MeshShadow.of(process, problem))
            except LivepdeError as error:
                refused = f"there is no halved mesh: {str(error).rstrip('.')}"
        if options.inputs and problem.model.channels:
            shadows += input_shadows(process, problem)
        # Steps are divided only if a step shadow estimates their error and the step control allows
        # shorter steps (halvings).
        most = options.parts if options.step and problem.control.halvings else 1
        return cls(problem, reduction, rows, tuple(shadows), refused, most)

    @property
    def unfollowed(self) -> str:
        """Errors without an estimate, with reasons and remedies; empty if all are estimated."""
        missing = []
        if self.refused:
            missing.append(
                f"the error of the mesh ({self.refused}); compare with a run on more cells, "
                "`mesh.cells`"
            )
        if "step" not in self.kinds:
            missing.append("the error of the time step (step = false)")
        return "; ".join(missing)

    @cached_property
    def counted(self) -> slice:
        """Slice of the shadows that estimate an error: the last, of held inputs, does not."""
        return slice(0, len(self.kinds) - (HELD in self.kinds))

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The kind of each shadow."""
        return tuple(shadow.kind for shadow in self.shadows)

    def start(self, x: FilterState, moment: Moment | None, given: Any) -> ShadowState:
        """Return the initial shadow state of one member; `moment` is None before the start."""
        n, k, rows = x.u.shape[1], x.C.shape[2], len(self.shadows)
        u, a = np.zeros((1, rows, n)), np.zeros((1, rows, k))
        zero = np.zeros((1, len(self.problem.channels)))
        # The first block begins at the time of a sample at the start, not at time zero.
        begun = np.full(1, 0.0 if moment is None else moment.t)
        s = changed(ShadowState.none(1, n, k), u=u, a=a, inputs0=zero, begun=begun)
        for shadow in self.shadows:
            s = shadow.start(s, x, moment, given)
        return s

    def predict(self, x: FilterState, end: FilterState, span: Span) -> FilterState:
        """Return the filter state after a span, with the discretisation errors of the span."""
        s = end.shadows
        parts, jumps = _watch_rate(s, x, end, span)
        fresh = s.count == s.last  # members that begin a block
        if np.count_nonzero(fresh):
            rows = fresh[:, None]
            parts["begun"] = np.where(fresh, span.t0, s.begun)
            parts["inputs0"] = np.where(rows, span.inputs0, s.inputs0)
            if "mesh" in self.kinds:
                parts["u0"] = np.where(rows, x.u, s.u0)
        for shadow in self.shadows:
            parts |= shadow.read(s, span)
        # In a pause no error of the inputs is added: the covariance of the state covers it.
        if (pause := end.driven.pause).any() and "missed" in parts:
            rows = pause[:, None]
            parts["bend"] = np.where(rows, 0.0, parts["bend"])
            parts["missed"] = np.where(rows, s.missed, parts["missed"])
        s = changed(s, **parts)
        due = self._due(s, span, jumps)
        # Members whose blocks began together share a step over the block.
        for t in sorted(set(s.begun[due].tolist())) if np.count_nonzero(due) else ():
            group = np.flatnonzero(due & (s.begun == t))
            if len(group) == len(s):
                s = self._add_errors(s, x, end, span, jumps)
            else:
                s_group, x_group, end_group = take(s, group), take(x, group), take(end, group)
                part, jumped = span.part(group), jumps[group]
                s = put(s, group, self._add_errors(s_group, x_group, end_group, part, jumped))
        return changed(end, shadows=s)

    @staticmethod
    def _due(s: ShadowState, span: Span, jumps: Mask) -> Mask:
        """Return the members whose block ends with a span."""
        # A jump of the input changes the error of the step immediately.
        due: Mask = (s.count >= s.due) | jumps
        # A switch after a rest ends a block: the linear inputs of a block must not extend over it.
        if span.row is not None and s.held.size:
            switches = (span.row != span.inputs1) & np.isfinite(span.row) & (s.held[:, 1] == 0.0)
            due = due | switches.any(axis=1)
        # The error of a gap is added immediately: later it might cancel with that of the next gap.
        if span.gaps is not None:
            due = due | (span.gaps > 0.0).any(axis=(1, 2))
        return due

    def _add_errors(
        self, s: ShadowState, x: FilterState, end: FilterState, step: Span, jumps: Mask
    ) -> ShadowState:
        """Return shadow states with the errors of their blocks, which began together."""
        waited, span = s.count - s.last, step
        if (waited > 1).any():
            span = replace(step, t0=s.begun, inputs0=s.inputs0, interval=None)
        wait = np.where(s.count < FIRST, 1, LATER[s.count // 8 % len(LATER)])
        wait = np.where(s.count - s.jumped < CALM, 1, wait)
        # If the division has changed, the error of the next steps differs.
        wait = np.where(x.parts != step.division, 1, wait)
        block = ShadowedSteps(x, end, step, span, waited, wait, jumps)
        u, a, failed = s.u.copy(), s.a.copy(), s.failed
        parts: dict[str, Any] = {}
        for row, shadow in enumerate(self.shadows):
            error = shadow.error(s, block)
            if error.u is not None:
                u[:, row] += np.where(error.failed[:, None], 0.0, error.u)
            if error.a is not None:
                # A shift of the unknowns shifts the state by their covariance.
                good = np.isfinite(error.a).all(axis=1) & np.isfinite(end.C).all(axis=(1, 2))
                for k in np.flatnonzero(good & ~error.failed).tolist():
                    a[k, row] += error.a[k]
                    u[k, row] += along(end, k, error.a[k])
            parts |= error.parts
            failed = failed + error.failed
        begun = np.full(len(s), step.t1)
        parts |= {"begun": begun, "last": s.count, "due": s.count + wait, "failed": failed}
        return changed(s, u=u, a=a, **parts)

    def first_parts(self, x: FilterState) -> IntArray:
        """Return the initial number of parts of the substeps of the next span, (members,).

        The number of the previous span, or half of it if the error was far below the tolerance.
        """
        s, order = x.shadows, self.problem.control.scheme.order
        if self.most == 1 or not np.count_nonzero(x.parts > 1):
            return x.parts
        spare = (s.last == s.count) & (s.excess < 0.5 ** (order + 2))
        return np.where(spare, np.maximum(x.parts // 2, 1), x.parts)

    def finer_parts(self, end: FilterState, parts: IntArray) -> IntArray:
        """Return the number of parts that the substeps of a span require, (members,)."""
        s = end.shadows
        coarse = (s.last == s.count) & (s.excess > 1.0) & (parts < self.most)
        if not np.count_nonzero(coarse):
            return parts
        # For short steps the error is proportional to the step to the power `order`.
        power = np.log2(np.where(coarse, s.excess, 2.0)) / self.problem.control.scheme.order
        more = 2 ** np.clip(np.ceil(power - 1e-9), 1, AT_ONCE).astype(np.int64)
        return np.where(coarse, np.minimum(parts * more, self.most), parts)

    def chosen(self, x: FilterState, end: FilterState) -> ShadowState:
        """Return the shadows after a span with its final division; `x`: filter before the span."""
        s = end.shadows
        coarse = (s.last == s.count) & (s.excess > 1.0)
        if not np.count_nonzero(coarse):
            return s
        more, worst = coarse * (s.count - x.shadows.last), np.where(coarse, s.excess, 0.0)
        return changed(s, coarse=s.coarse + more, coarsest=np.maximum(s.coarsest, worst))

    def in_readings(self, x: FilterState, at: Moments) -> tuple[FilterState, Array]:
        """Return the filter state, and errors of predicted readings, (members, shadows, sensors).

        If such an error is not finite, the shadow counts as failed and restarts from zero.
        """
        s = x.shadows
        errors = self.rows(x, s.u, s.a, at)
        for row, shadow in enumerate(self.shadows):
            own = shadow.in_readings(s)
            if own is not None:
                errors[:, row] += own
        if np.vdot(errors, errors) < np.inf:
            return x, errors
        wrong: Mask = ~np.asarray(np.isfinite(errors).all(axis=2))
        rows = wrong[:, :, None]
        parts = {"u": np.where(rows, 0.0, s.u), "a": np.where(rows, 0.0, s.a)}
        parts["failed"] = s.failed + wrong.sum(axis=1)
        for row, shadow in enumerate(self.shadows):
            parts |= shadow.restarted(s, wrong[:, row])
        return changed(x, shadows=changed(s, **parts)), np.where(rows, 0.0, errors)

    def update(
        self, x: FilterState, U: Array, C: Array, left: Array, weights: Array, off: Array, t: float
    ) -> ShadowState:
        """Return the shadows after a sample.

        `x`: filter before the sample. `U`, `C`: square root after the sample. `left`: see
        `Update.left`. `weights`: inverse standard deviation of the noise of each reading, (members,
        sensors). `off`: errors of the predicted readings (`in_readings`). Both are zero for unused
        readings. `t`: time of the sample.
        """
        s = x.shadows
        # K^T = `gain` [U C], with the rows of the new square root.
        gain = left.swapaxes(1, 2)  # (members, sensors, r), in units of the noise
        half = product(off * weights[:, None], gain)
        parts = {"u": s.u - product(half, U), "a": s.a - product(half, C)}
        since = t - s.begun
        if s.gains.size and np.count_nonzero(since):
            # A sample multiplies the effect of earlier samples by I - K H. The ratio of variances
            # approximates this factor: the full product would require a matrix for each sensor.
            share = np.add.reduce(C * C, axis=1)
            share /= np.maximum(np.add.reduce(x.C * x.C, axis=1), TINY)
            gained = (weights * since[:, None])[:, :, None] * product(gain, C)
            parts["gains"] = share[:, None] * s.gains + gained
        return changed(s, **parts)

    def shifts(self, x: FilterState) -> tuple[Array, Array]:
        """Return the shifts of state and reduced unknowns, (members, rows, n or k)."""
        s, u = x.shadows, x.shadows.u.copy()
        for row, shadow in enumerate(self.shadows):
            own = shadow.in_state(s)
            if own is not None and u.size:  # the state is requested
                u[:, row] += own
        return u, s.a

    def diagnostics(self, x: FilterState, C: Array) -> Diagnostics[Array]:
        """Return diagnostics with the shifts of the unknowns, as arrays of shape (members,)."""
        s, Phi, latent = x.shadows, self.reduction.Phi, self.problem.model.latent
        q = self.reduction.bounded(x.q + (Phi @ x.da[:, :, None])[:, :, 0])
        each = latent.tangents(q, Phi @ s.a.transpose(0, 2, 1))  # (members, m, shadows)
        std = np.linalg.norm(latent.tangents(q, Phi @ C.transpose(0, 2, 1)), axis=2)
        shift = each / np.where(std > 0.0, std, np.inf)[:, :, None]
        total = np.abs(shift[:, :, self.counted].sum(axis=2))
        worst = np.argmax(np.where(np.isfinite(total), total, -1.0), axis=1)
        members, sizes, unknowns = np.arange(len(x)), {}, {}
        for row, kind in enumerate(self.kinds):
            # Held inputs do not contribute to the total: their worst unknown is separate.
            at_worst = worst if kind != HELD else np.argmax(np.abs(shift[:, :, row]), axis=1)
            sizes[kind] = shift[members, at_worst, row]
            for label, at in latent.space.labels.items():
                unknowns[label, kind] = each[:, at, row]
        return Diagnostics(
            shadow_failed=np.where(s.failed, s.failed, np.nan) if s.failed.any() else NOT_KNOWN,
            mesh_unfollowed=np.ones(len(x)) if self.refused else NOT_KNOWN,
            shifts=Shifts(total[members, worst], sizes, unknowns),
        )

    @nonfinite_allowed()  # a shift that overflows counts as zero
    def widening(self, x: FilterState) -> tuple[Array, Array]:
        """Return the row that the sum of all shifts adds to the reported square root [U C].

        Shapes (members, 1, n) and (members, 1, k). The row is at most one prior standard deviation
        long: wrong data cannot make the unknowns less certain than their prior, and the linear
        filter is not valid for a longer shift.
        """
        u, a = (rows[:, self.counted].sum(axis=1, keepdims=True) for rows in self.shifts(x))
        size = np.linalg.norm(self.reduction.in_prior_units(a, x.age), axis=2)
        good = (np.isfinite(size) & np.isfinite(u).all(axis=2))[..., None]
        factor = np.where(good, 1.0 / np.maximum(size, 1.0)[..., None], 0.0)
        return np.where(good, u, 0.0) * factor, np.where(good, a, 0.0) * factor


def _watch_rate(
    s: ShadowState, x: FilterState, end: FilterState, span: Span
) -> tuple[dict[str, Any], Mask]:
    """Return fields of `ShadowState` after a step, and members whose rate of the state jumped."""
    rate = (end.u - x.u) / (span.t1 - span.t0)[:, None]
    change = rate - s.rate
    count, differs = s.count + 1, np.sqrt(np.add.reduce(change * change, axis=1))
    most, early = JUMP * s.usual, count <= CALM + 1
    if np.count_nonzero(early):  # in the first steps the average is unknown
        most = np.where(early, np.inf, most)
    jumps = differs > most
    # The average is limited in a jump.
    weight = WEIGHTS[np.minimum(count, USUAL)]
    usual = s.usual + (np.minimum(differs, most) - s.usual) * weight
    parts: dict[str, Any] = {"rate": rate, "usual": usual, "count": count}
    if np.count_nonzero(jumps):
        parts["jumped"] = np.where(jumps, count, s.jumped)
    return parts, jumps
