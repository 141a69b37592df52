"""Discretisation-error estimate of a filter: the shifts by time step, mesh and input lines.

The filter and one without discretisation error would take the same samples with the same gain. The
error of the former, e of the state and s of the unknowns, follows

    predict   [e; s]+ = T [e; s] + d,      T the linearised step, d the error that this step adds
    update    [e; s] <- [e; s] - K H [e; s]

with the filter's own T, H and gain K, for unknowns that stay and for unknowns that move. T acts
where the filter steps: [e; s] are tangents of the step. Each source of error, a shadow, estimates
its d: that of the step by Richardson's extrapolation from two halved steps, that of the input lines
from the curvature of the readings. The mesh has a trajectory of its own on the halved mesh, with
the unknowns of the filter: the difference of the two trajectories is no d, but enters the predicted
readings.
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

FIRST = 16  # steps that are all shadowed: where a run begins the error changes from step to step
CALM = 4  # steps after a jump that are all shadowed
JUMP = 4.0  # times the usual difference of two changes of the state: something has jumped
USUAL = 16  # steps over which that is averaged
# Weight of a step in that average, by the number of steps so far; later ones have the last one.
WEIGHTS = 1.0 / np.array([1, 1, 1, *range(3, USUAL + 1)])
# Steps between those that are shadowed later. They differ, so that no cycle of inputs is met at one
# phase alone; on average 8, of which each stands for those before it.
LATER = np.array([5, 11, 7, 9])
AT_ONCE = 3  # halvings of a step, as powers of two, before its error is estimated again


@dataclass(frozen=True)
class Shadows:
    """Discretisation errors that the sensitivity law estimates online.

    Their signed shifts are summed, and widen the reported covariance: variance plus square of the
    sum. The filter takes shorter steps where the error of the time step asks for it (`parts`); else
    it stays as it is.

    The first 16 steps are shadowed, later one of eight, which stands for those around it: an error
    of step or input lines that changes much faster is found on average only. The mesh is followed
    by one step in the place of eight: its shift is overstated where the drive turns within them.

    Parameters
    ----------
    step
        The time step, by halved steps.
    mesh
        The mesh, by the halved mesh: for states and unknown fields of first order and sensors that
        mean the same on every mesh.
    inputs
        The straight line between readings of a channel, by the curvature of three readings, and
        values that were held in gaps, once the next one is known. Of channels that are constant
        between readings (`Identifier.between`), the shift of the estimates by straight lines
        instead is followed for the verdict alone.
    largest
        Coefficients of the state on the halved mesh beyond which it is not followed, because that
        would cost more than the filter.
    parts
        A step whose error is larger than 3 % of the noise of the readings is taken again in 2, 4,
        ... parts, at most in so many, and so are the next ones as long as they need it. 1: none is.
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
    """The discretisation errors that are estimated online with a filter."""

    # Those of the filter.
    problem: Problem
    reduction: Reduction
    # Function that returns the readings of rows of state and reduced unknowns, (members, rows,
    # sensors): `MemberSensors.rows`.
    rows: Callable[[FilterState, Array, Array, Moments], Array]
    shadows: tuple[Shadow, ...]  # one for each row of `ShadowState.u`
    refused: str  # why the mesh has no shadow; empty if it has one
    most: int  # parts of a substep at most

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
        found: list[Shadow] = []
        if options.step:
            found.append(StepShadow.of(process, StepTolerance(problem, rows, noise)))
        if not refused:
            # An identification must not fail because its mesh error cannot be estimated: a note
            # says so.
            try:
                found.append(MeshShadow.of(process, problem))
            except LivepdeError as error:
                refused = f"there is no halved mesh: {str(error).rstrip('.')}"
        if options.inputs and problem.model.channels:
            found += input_shadows(process, problem)
        # Without a step shadow nothing tells how short steps have to be. Where steps are to be
        # those of the samples and no others (no halvings), they stay so.
        most = options.parts if options.step and problem.control.halvings else 1
        return cls(problem, reduction, rows, tuple(found), refused, most)

    @property
    def unfollowed(self) -> str:
        """Which errors are not followed, why, and what to do instead; empty if none is left out."""
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
        """Shadows that estimate an error: that of held inputs, the last one, does not."""
        return slice(0, len(self.kinds) - (HELD in self.kinds))

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each shadow."""
        return tuple(shadow.kind for shadow in self.shadows)

    def start(self, x: FilterState, moment: Moment | None, given: Any) -> ShadowState:
        """Return the shadows of one member at the start; None means no moment yet."""
        n, k, rows = x.u.shape[1], x.C.shape[2], len(self.shadows)
        u, a = np.zeros((1, rows, n)), np.zeros((1, rows, k))
        nothing = np.zeros((1, len(self.problem.channels)))
        # A sample at the start itself counts from there, and not from time zero.
        begun = np.full(1, 0.0 if moment is None else moment.t)
        s = changed(ShadowState.none(1, n, k), u=u, a=a, inputs0=nothing, begun=begun)
        for shadow in self.shadows:
            s = shadow.start(s, x, moment, given)
        return s

    def predict(self, x: FilterState, end: FilterState, span: Span) -> FilterState:
        """Return the state after a span with the errors that have come about in it."""
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
        # What inputs may have done in a pause stands in the covariance of the state.
        if (pause := end.driven.pause).any() and "missed" in parts:
            rows = pause[:, None]
            parts["bend"] = np.where(rows, 0.0, parts["bend"])
            parts["missed"] = np.where(rows, s.missed, parts["missed"])
        s = changed(s, **parts)
        due = self._due(s, span, jumps)
        # A block is one step for all members in it, which therefore have to begin together.
        for t in sorted(set(s.begun[due].tolist())) if np.count_nonzero(due) else ():
            group = np.flatnonzero(due & (s.begun == t))
            if len(group) == len(s):
                s = self._add_errors(s, x, end, span, jumps)
            else:
                some, one, after = take(s, group), take(x, group), take(end, group)
                new = self._add_errors(some, one, after, span.part(group), jumps[group])
                s = put(s, group, new)
        return changed(end, shadows=s)

    @staticmethod
    def _due(s: ShadowState, span: Span, jumps: Mask) -> Mask:
        """Return the members whose block ends with a span."""
        # After a jump of the drive the error of the step is another one at once.
        due: Mask = (s.count >= s.due) | jumps
        # A switch after a rest ends a block, which is one line: not from before it to after it.
        if span.row is not None and s.held.size:
            switches = (span.row != span.inputs1) & np.isfinite(span.row) & (s.held[:, 1] == 0.0)
            due = due | switches.any(axis=1)
        # What gaps miss counts at once: later it might cancel with that of the next one.
        if span.gaps is not None:
            due = due | (span.gaps > 0.0).any(axis=(1, 2))
        return due

    def _add_errors(
        self, s: ShadowState, x: FilterState, end: FilterState, step: Span, jumps: Mask
    ) -> ShadowState:
        """Return members whose blocks began together, with the errors of these blocks added."""
        waited, span = s.count - s.last, step
        if (waited > 1).any():
            span = replace(step, t0=s.begun, inputs0=s.inputs0, interval=None)
        wait = np.where(s.count < FIRST, 1, LATER[s.count // 8 % len(LATER)])
        wait = np.where(s.count - s.jumped < CALM, 1, wait)
        # The error of the steps that follow is another one where the division has changed.
        wait = np.where(x.parts != step.division, 1, wait)
        block = ShadowedSteps(x, end, step, span, waited, wait, jumps)
        u, a, failed = s.u.copy(), s.a.copy(), s.failed
        parts: dict[str, Any] = {}
        for row, shadow in enumerate(self.shadows):
            found = shadow.error(s, block)
            if found.u is not None:
                u[:, row] += np.where(found.failed[:, None], 0.0, found.u)
            if found.a is not None:
                # A shift of the unknowns moves the state with it, by their covariance.
                good = np.isfinite(found.a).all(axis=1) & np.isfinite(end.C).all(axis=(1, 2))
                for k in np.flatnonzero(good & ~found.failed).tolist():
                    a[k, row] += found.a[k]
                    u[k, row] += along(end, k, found.a[k])
            parts |= found.parts
            failed = failed + found.failed
        begun = np.full(len(s), step.t1)
        parts |= {"begun": begun, "last": s.count, "due": s.count + wait, "failed": failed}
        return changed(s, u=u, a=a, **parts)

    def first_parts(self, x: FilterState) -> IntArray:
        """Return in how many parts the substeps of the next span are divided at first, (members,).

        As those of the span before, or half as many where its error was far smaller than allowed.
        """
        s, order = x.shadows, self.problem.control.scheme.order
        if self.most == 1 or not np.count_nonzero(x.parts > 1):
            return x.parts
        spare = (s.last == s.count) & (s.excess < 0.5 ** (order + 2))
        return np.where(spare, np.maximum(x.parts // 2, 1), x.parts)

    def finer_parts(self, end: FilterState, parts: IntArray) -> IntArray:
        """Return in how many parts the substeps of a span have to be divided, (members,)."""
        s = end.shadows
        coarse = (s.last == s.count) & (s.excess > 1.0) & (parts < self.most)
        if not np.count_nonzero(coarse):
            return parts
        # The error goes with the power `order` of the step once that is short enough.
        power = np.log2(np.where(coarse, s.excess, 2.0)) / self.problem.control.scheme.order
        more = 2 ** np.clip(np.ceil(power - 1e-9), 1, AT_ONCE).astype(np.int64)
        return np.where(coarse, np.minimum(parts * more, self.most), parts)

    def chosen(self, x: FilterState, end: FilterState) -> ShadowState:
        """Return the shadows after a span whose division is chosen; `x` is the filter before it."""
        s = end.shadows
        coarse = (s.last == s.count) & (s.excess > 1.0)
        if not np.count_nonzero(coarse):
            return s
        more, worst = coarse * (s.count - x.shadows.last), np.where(coarse, s.excess, 0.0)
        return changed(s, coarse=s.coarse + more, coarsest=np.maximum(s.coarsest, worst))

    def in_readings(self, x: FilterState, at: Moments) -> tuple[FilterState, Array]:
        """Return by how much predictions are off, (members, shadows, sensors), and the filter.

        A shadow that is not finite there counts as failed, and begins anew from no error.
        """
        s = x.shadows
        seen = self.rows(x, s.u, s.a, at)
        for row, shadow in enumerate(self.shadows):
            more = shadow.in_readings(s)
            if more is not None:
                seen[:, row] += more
        if np.vdot(seen, seen) < np.inf:
            return x, seen
        wrong: Mask = ~np.asarray(np.isfinite(seen).all(axis=2))
        rows = wrong[:, :, None]
        parts = {"u": np.where(rows, 0.0, s.u), "a": np.where(rows, 0.0, s.a)}
        parts["failed"] = s.failed + wrong.sum(axis=1)
        for row, shadow in enumerate(self.shadows):
            parts |= shadow.restarted(s, wrong[:, row])
        return changed(x, shadows=changed(s, **parts)), np.where(rows, 0.0, seen)

    def update(
        self, x: FilterState, U: Array, C: Array, left: Array, weights: Array, off: Array, t: float
    ) -> ShadowState:
        """Return the shadows after a sample.

        `x`: the filter before it. `U`, `C`: the square root after it. `left`: `Update.left`.
        `weights`: one over the noise of each value that was used, zero for others, (members,
        sensors). `off`, `t`: by how much predictions of such values were off (`in_readings`), zero
        for others; and the time.
        """
        s = x.shadows
        # K^T = `gain` [U C], with the rows of the new square root.
        gain = left.swapaxes(1, 2)  # (members, sensors, r), in units of the noise
        half = product(off * weights[:, None], gain)
        parts = {"u": s.u - product(half, U), "a": s.a - product(half, C)}
        since = t - s.begun
        if s.gains.size and np.count_nonzero(since):
            # A sample multiplies the effect of earlier ones by I - K H, for which the share of the
            # variance that it leaves stands: the full product would need a matrix for each sensor.
            share = np.add.reduce(C * C, axis=1)
            share /= np.maximum(np.add.reduce(x.C * x.C, axis=1), TINY)
            gained = (weights * since[:, None])[:, :, None] * product(gain, C)
            parts["gains"] = share[:, None] * s.gains + gained
        return changed(s, **parts)

    def shifts(self, x: FilterState) -> tuple[Array, Array]:
        """Return the shifts of state and reduced unknowns, (members, rows, n or k)."""
        s, u = x.shadows, x.shadows.u.copy()
        for row, shadow in enumerate(self.shadows):
            more = shadow.in_state(s)
            if more is not None and u.size:  # of a state that is asked for
                u[:, row] += more
        return u, s.a

    def diagnostics(self, x: FilterState, C: Array) -> Diagnostics[Array]:
        """Return the shifts of the unknowns, numbers of shape (members,)."""
        s, Phi, latent = x.shadows, self.reduction.Phi, self.problem.model.latent
        q = self.reduction.bounded(x.q + (Phi @ x.da[:, :, None])[:, :, 0])
        each = latent.tangents(q, Phi @ s.a.transpose(0, 2, 1))  # (members, m, shadows)
        std = np.linalg.norm(latent.tangents(q, Phi @ C.transpose(0, 2, 1)), axis=2)
        shift = each / np.where(std > 0.0, std, np.inf)[:, :, None]
        total = np.abs(shift[:, :, self.counted].sum(axis=2))
        worst = np.argmax(np.where(np.isfinite(total), total, -1.0), axis=1)
        members, sizes, unknowns = np.arange(len(x)), {}, {}
        for row, kind in enumerate(self.kinds):
            # Held inputs have no part in the total, and so their own worst unknown.
            at_worst = worst if kind != HELD else np.argmax(np.abs(shift[:, :, row]), axis=1)
            sizes[kind] = shift[members, at_worst, row]
            for label, at in latent.space.labels.items():
                unknowns[label, kind] = each[:, at, row]
        return Diagnostics(
            shadow_failed=np.where(s.failed, s.failed, np.nan) if s.failed.any() else NOT_KNOWN,
            mesh_unfollowed=np.ones(len(x)) if self.refused else NOT_KNOWN,
            shifts=Shifts(total[members, worst], sizes, unknowns),
        )

    @nonfinite_allowed()  # a shift that overflows is none
    def widening(self, x: FilterState) -> tuple[Array, Array]:
        """Return the row of the square root [U C] that is reported for all shifts together.

        Shapes (members, 1, n) and (members, 1, k). The row is no longer than one prior standard
        deviation: wrong data cannot make the unknowns less certain than their prior, and a longer
        shift lies outside the range of the linear filter.
        """
        u, a = (rows[:, self.counted].sum(axis=1, keepdims=True) for rows in self.shifts(x))
        size = np.linalg.norm(self.reduction.in_prior_units(a, x.age), axis=2)
        good = (np.isfinite(size) & np.isfinite(u).all(axis=2))[..., None]
        factor = np.where(good, 1.0 / np.maximum(size, 1.0)[..., None], 0.0)
        return np.where(good, u, 0.0) * factor, np.where(good, a, 0.0) * factor


def _watch_rate(
    s: ShadowState, x: FilterState, end: FilterState, span: Span
) -> tuple[dict[str, Any], Mask]:
    """Return fields after one more step, and members whose rate of the state jumped in it."""
    rate = (end.u - x.u) / (span.t1 - span.t0)[:, None]
    more = rate - s.rate
    count, differs = s.count + 1, np.sqrt(np.add.reduce(more * more, axis=1))
    most, early = JUMP * s.usual, count <= CALM + 1
    if np.count_nonzero(early):  # in the first steps none is known
        most = np.where(early, np.inf, most)
    jumps = differs > most
    # A jump does not count as usual.
    weight = WEIGHTS[np.minimum(count, USUAL)]
    usual = s.usual + (np.minimum(differs, most) - s.usual) * weight
    parts: dict[str, Any] = {"rate": rate, "usual": usual, "count": count}
    if np.count_nonzero(jumps):
        parts["jumped"] = np.where(jumps, count, s.jumped)
    return parts, jumps
