"""The stored samples of one member, followed about one trajectory of constant unknowns.

With xi the coordinates of the start on the rows of its square root, a = a_0 + C_0^T xi and
u = u_0 + U_0^T xi, a trajectory is a point xi. A pass gives the residuals of all readings and their
derivatives in xi; nothing is updated on the way, so that the matrix of a step stays the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from livepde.laws.assimilation import HALF_LOG, absorb, assimilate
from livepde.laws.filter import Filter, contraction
from livepde.laws.filter_state import FilterState, coordinates, extended
from livepde.laws.gate import Gate
from livepde.laws.history import LogRows, first_interval, intervals_since
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.stepping import BandedStage, Moments, Span, StageOfMembers, Steps, Sweep, advance

FACTORS = 32  # factorised matrices that a pass keeps: one for each length of a stage
TOGETHER = 6  # trajectories that are tried at once where one array holds them
AT_ONCE = 32  # trajectories that are followed as one array


def principal(H: Array) -> tuple[Array, Array]:
    """Return principal values and axes of a Hessian of the cost.

    It is the identity, of the prior, and more: values below one are rounding, beside readings that
    tell another direction up to the last digit.
    """
    sizes, axes = np.linalg.eigh(H)
    return np.maximum(sizes, 1.0), axes


@dataclass(frozen=True, eq=False)
class Passed:
    """The samples about one trajectory."""

    xi: Array  # coordinates of the trajectory, shape (r,)
    # Readings less predictions, in units of the noise, shape (samples, sensors); NaN: missing.
    residuals: Array
    # Derivatives of the predictions in xi, in units of the noise, (samples, sensors, r).
    slopes: Array
    end: FilterState  # state, unknowns, and their derivatives in xi as rows, after the last sample

    def cost(self, used: Mask) -> float:
        """Return half the sum of squares of residuals in use and of xi."""
        return 0.5 * float((self.residuals[used] ** 2).sum() + self.xi @ self.xi)

    def model(self, used: Mask) -> tuple[Array, Array]:
        """Return Hessian and direction of descent of the cost, (r, r) and (r,)."""
        J, r = self.slopes[used], self.residuals[used]
        return np.eye(len(self.xi)) + J.T @ J, J.T @ r - self.xi


@dataclass(frozen=True, eq=False)
class StoredSamples:
    """The samples of one member since the start of its window."""

    # Parts of the law, the member as it is now, and its rows since the start of the window.
    work: SensitivityWork
    state: SensitivityState
    rows: LogRows

    @classmethod
    def of(cls, work: SensitivityWork, state: SensitivityState) -> StoredSamples:
        sensors = work.filter.problem.observed.size
        return cls(work, state, LogRows.of(state.log[:, int(state.window[0]) :], sensors))

    def __len__(self) -> int:
        return len(self.rows.times) - self._before

    @property
    def _before(self) -> int:
        """LogRows before the first sample: the row at the start is one, if it has readings."""
        return int(not self.state.opening[0])

    @cached_property
    def spans(self) -> Sequence[Span]:
        """Intervals that lead to each sample; the first has no length if it is at the start."""
        state, filter_ = self.state, self.filter
        log, channels = state.log[:, int(state.window[0]) :], filter_.problem.channels
        intervals = intervals_since(log, channels)
        if state.opening[0]:
            intervals = [first_interval(log, channels), *intervals]
        return [filter_.span(interval) for interval in intervals]

    @cached_property
    def start(self) -> FilterState:
        """The filter before the first sample."""
        return self.work.at_level(self.state.start, self.state.now)

    @property
    def times(self) -> Array:
        return self.rows.times[self._before :]

    @property
    def filter(self) -> Filter:
        return self.work.filter

    @property
    def gated(self) -> bool:
        """True if readings may be refused."""
        return self.work.options.gate.beyond < np.inf

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of each reading, (samples, sensors)."""
        own = self.rows.noise[self._before :]
        found: Array = np.where(np.isnan(own), self.filter.noise, own)
        return np.asarray(np.sqrt(self.state.now.level[0]) * found)

    @cached_property
    def readings(self) -> Array:
        """All readings in units of their noise, (samples, sensors); NaN: missing."""
        return self._values / self.noise

    @cached_property
    def _values(self) -> Array:
        """All readings; one of a sensor whose position is missing is none."""
        found = self.rows.readings[self._before :].copy()
        missing = np.isnan(self.rows.inputs[self._before :]).any(axis=1)
        for number in np.flatnonzero(missing).tolist():
            predicted, _ = self.filter.sensors.observe(self.start, self.spans[number].end)
            found[number, ~np.isfinite(predicted[0])] = np.nan
        return found

    @cached_property
    def alive(self) -> Mask:
        """LogRows of the square root at the start that are not zero, as padding is, shape (r,)."""
        at = self.placed(np.zeros((1, self.start.C.shape[1])), rows=True)
        return np.asarray(at.C[0].any(axis=1) | at.U[0].any(axis=1))

    @cached_property
    def missing(self) -> Array:
        """NaN for each reading, (samples, sensors)."""
        return np.full(self.readings.shape, np.nan)

    @cached_property
    def seen(self) -> Mask:
        return np.asarray(np.isfinite(self.readings).any(axis=1))

    @property
    def together(self) -> int:
        """Trajectories that cost little more than one."""
        return TOGETHER if self._batched else 1

    @property
    def _batched(self) -> bool:
        """True if trajectories as one array take less time: else they would share one factor."""
        return isinstance(self.filter.stage, BandedStage)

    @property
    def reached(self) -> Array:
        """Coordinates xi of the present estimate, shape (r,).

        Those of an uncertain start, which no unknown has, are where the last refit ended.
        """
        now, start, reduction = self.state.now, self.start, self.filter.reduction
        shift = reduction.reduced(reduction.bounded(self.filter.estimate(now)) - start.q)[0]
        last: Array = self.state.fit.xi[0, :, 0]
        return last + coordinates(start.C[0], shift - start.C[0].T @ last)

    def within_bounds(self, xi: Array) -> Array:
        """Return xi, moved the least so that the unknowns are within their bounds."""
        start, reduction = self.start, self.filter.reduction
        shift = start.C[0].T @ xi
        q = start.q[0] + reduction.Phi @ shift
        inside = reduction.bounded(q)
        if inside is q:
            return xi
        return xi + coordinates(start.C[0], reduction.reduced(inside - start.q[0]) - shift)

    def placed(self, points: Array, rows: bool) -> FilterState:
        """Return the start of trajectories, shape (points, r), with or without derivatives."""
        start, reduction = self.start, self.filter.reduction
        count, (r, k), n = len(points), start.C[0].shape, start.u.shape[1]
        shifts = points @ start.C[0]
        q = start.q + shifts @ reduction.Phi.T
        C = np.broadcast_to(start.C, (count, r, k))
        if self.state.initial[0]:
            model, moment = self.filter.problem.model, self.spans[0].at(float(self.spans[0].t0[0]))
            at = moment.member(0)
            u = np.array([model.initial_state(one, at) for one in q])
            slopes = [model.initial_directions(one, reduction.Phi, at).T for one in q]
            U = C @ np.array(slopes)
        else:
            u = start.u + points @ start.U[0]
            U = np.broadcast_to(start.U, (count, r, n))
        return changed(
            start,
            member=np.zeros(count, dtype=np.int64),
            q=q,
            u=u,
            du=np.zeros((count, n)),
            da=np.zeros((count, k)),
            U=U if rows else U[:, :0],
            C=C if rows else C[:, :0],
            past=np.zeros((count, r if rows else 0, 0)),
            kept=self.filter.stage.kept(count),
        )

    @cached_property
    def _steps(self) -> Steps:
        rows, problem = self.rows, self.filter.problem
        start = np.maximum(np.arange(len(self)) - 1 + self._before, 0)
        ends = np.stack([rows.times[start], self.times], axis=1)
        parts, inputs1 = rows.parts[self._before :], rows.inputs[self._before :]
        channels = problem.channels
        return Steps.through(ends, parts, rows.inputs[start], inputs1, channels, problem.control)

    def _followed(self, x: FilterState) -> Iterator[tuple[slice, Array]]:
        """Yield numbers of spans, and trajectories with derivatives, (spans, 1 + r, points, n).

        It ends early where a step fails.
        """
        if not len(self):
            return iter(())
        stage, scheme = self.filter.stage, self.filter.problem.control.scheme
        along = self.filter.reduction.directions(x.q, x.C)
        columns = np.concatenate([x.u[None], x.U.transpose(1, 0, 2)])
        sweep = Sweep.of(stage, scheme, self._steps, x.q, along)
        return self._stepped(x, columns, along) if sweep is None else sweep.blocks(columns)

    def _stepped(
        self, x: FilterState, columns: Array, along: Array
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the same, one stage after the other."""
        filter_, factors, kept = self.filter, dict[float, Any](), x.kept
        exact = np.zeros(len(x.member), dtype=bool)
        for number, span in enumerate(self.spans):
            if len(factors) > FACTORS:
                factors.clear()

            def stage(columns: Array, t: float, h: float, span: Span = span) -> Array:
                nonlocal kept
                work = StageOfMembers(x.member, x.q, along, h, span.at(t), kept, exact, factors)
                y, kept = filter_.stage.advance(columns, work)
                return y

            if span.t1 > span.start:
                control = filter_.problem.control.divided(span.division)
                columns, _, failure = advance(control, stage, columns, span.start, span.t1)
                if failure is not None:
                    return
            yield slice(number, number + 1), columns[None]

    def along(self, one: Passed) -> Iterator[FilterState]:
        """Yield the state and the unknowns of a trajectory at each sample."""
        x = self.placed(one.xi[None], rows=False)
        for _, found in self._followed(x):
            for columns in found:
                yield changed(x, u=columns[0])

    def _compared(self, x: FilterState) -> Iterator[tuple[slice, Array, Array, Array]]:
        """Yield numbers of spans, and trajectories after the last one, (1 + r, points, n).

        With residuals and derivatives of the predictions, in units of the noise, (spans, points,
        sensors) and (spans, points, r, sensors). NaN for samples without a reading.
        """
        for some, found in self._followed(x):
            seen = np.flatnonzero(self.seen[some])

            def end(k: int, numbers: IntArray = some.start + seen) -> Moments:
                return self.spans[int(numbers[k])].end

            predicted, Y = self.filter.sensors.observe_each(x, found[seen], end)
            noise = self.noise[some][seen][:, None]
            shape = (len(found), *predicted.shape[1:])
            missed, slopes = np.full(shape, np.nan), np.zeros((len(found), *Y.shape[1:]))
            missed[seen] = (self._values[some][seen][:, None] - predicted) / noise
            slopes[seen] = Y / noise[:, :, None]
            yield some, found[-1], missed, slopes

    def about(self, xi: Array) -> Passed | None:
        """Return the samples about one trajectory with derivatives; None if a step fails."""
        there = np.isfinite(self.readings)
        r, J = self.missing.copy(), np.zeros((*there.shape, len(xi)))
        x, taken = self.placed(xi[None], rows=True), 0
        for some, columns, missed, Y in self._compared(x):
            r[some], J[some] = missed[:, 0], Y[:, 0].swapaxes(1, 2)
            last, taken = columns, some.stop
        if not taken or taken < len(self):
            return None
        J[~there] = 0.0
        end = changed(x, u=last[0], U=last[1:].transpose(1, 0, 2))
        # Of squares: what overflows there has neither a cost nor a direction.
        squares = (J**2).sum() + (last**2).sum() + (r[there] ** 2).sum()
        return Passed(xi=xi, residuals=r, slopes=J, end=end) if np.isfinite(squares) else None

    def residuals(self, xi: Array) -> Array | None:
        """Return the residuals about one trajectory; None if a step fails."""
        r, taken = self.missing.copy(), 0
        for some, _, missed, _ in self._compared(self.placed(xi[None], rows=False)):
            r[some], taken = missed[:, 0], some.stop
        return r if taken == len(self) else None

    def costs(self, points: Array, used: Mask, limit: float = np.inf) -> tuple[Array, float]:
        """Return the costs of trajectories, and how much of a pass they took.

        States alone are followed. Where all costs exceed the limit, the rest is left out.
        """
        found = 0.5 * (points**2).sum(axis=1)
        whole, taken = np.zeros(len(points), dtype=bool), 0
        width = AT_ONCE if self._batched else 1
        for first in range(0, len(points), width):
            part = slice(first, first + width)
            compared = self._compared(self.placed(points[part], rows=False))
            for some, _, missed, _ in compared:
                taken += missed.shape[1] * len(missed)
                whole[part] = some.stop == len(self)
                squares = np.where(used[some][:, None], missed, 0.0) ** 2
                found[part] += 0.5 * squares.sum(axis=(0, 2))
                if not (found[part] < limit).any():
                    whole[part] = False
                    break
        columns = 1 + int(self.alive.sum())
        cost = np.where(whole & np.isfinite(found), found, np.inf)
        return cost, taken / (columns * max(len(self), 1))

    def updated(self, one: Passed, used: Mask) -> FilterState:
        """Return the filter after all readings in use, linear about a trajectory.

        Ledger and discretisation errors are those of the present filter, which has to be near by.
        """
        end, now, J = one.end, self.state.now, one.slopes[used]
        # The prior of xi is N(0, I); about the trajectory its mean is -xi.
        mean, C, U = -one.xi, end.C[0], end.U[0]
        if len(J):
            W, half, _ = contraction(J.T[None], (one.residuals[used] + J @ one.xi)[None])
            mean, C, U = mean + W[0] @ half[0], W[0].T @ C, W[0].T @ U
        # Causes are coordinates on the rows of the square root, which is one up to a rotation: the
        # one that brings these rows nearest to those of the present filter.
        rows = max(now.C.shape[1], len(C))
        C, U = (extended(part[None], rows - len(part))[0] for part in (C, U))
        parts = {name: getattr(now, name) for name in ("C", "past", "causes")}
        parts = {name: extended(part, rows - part.shape[1]) for name, part in parts.items()}
        left, _, right = np.linalg.svd(parts["C"][0] @ np.linalg.pinv(C))
        turn = left @ right
        parts |= {"C": (turn @ C)[None], "U": (turn @ U)[None]}
        parts |= {"da": (mean @ end.C[0])[None], "du": (mean @ end.U[0])[None]}
        found: FilterState = changed(now, q=end.q, u=end.u, **parts)
        return self.filter.compressed(found) if rows > self.filter.rank else found

    def log_evidence(self, one: Passed, used: Mask) -> float:
        """Return the log of the likelihood of all readings, linear about a trajectory.

        The unknowns are integrated out. A reading that is not in use counts as one at the limit of
        the gate, which is wider where the residuals in use are larger than their noise.
        """
        (H, g), there = one.model(used), np.isfinite(self.readings)
        sizes, axes = principal(H)
        lowest = one.cost(used) - 0.5 * float(((axes.T @ g) ** 2 / sizes).sum())
        found = -lowest - 0.5 * float(np.log(sizes).sum())
        found -= float((np.log(self.noise) + HALF_LOG)[there].sum())
        refused = (there & ~used).sum(axis=0)
        for k in np.flatnonzero(refused).tolist():
            square = max(
                1.0, float((one.residuals[used[:, k], k] ** 2).sum()) / max(used[:, k].sum(), 1)
            )
            found -= 0.5 * self.work.options.gate.beyond**2 * square * float(refused[k])
        return found

    def judged(self, one: Passed, used: Mask) -> FilterState | None:
        """Return the filter that has taken the readings in use one by one, about a trajectory.

        It has ledger and discretisation errors, which `updated` has not; None if a step fails.
        """
        state, filter_ = self.state, self.filter
        now = state.now
        at = self.placed(one.xi[None], rows=True)
        start = changed(
            self.start,
            q=at.q,
            u=at.u,
            U=at.U,
            da=-(one.xi @ at.C[0])[None],
            du=-(one.xi @ at.U[0])[None],
            level=now.level,
            samples=now.samples,
            kept=now.kept,
        )
        x, options = start, replace(self.work.options, gate=Gate())
        for span, kept in zip(self.spans, used, strict=True):
            chosen = replace(span, z1=np.where(kept, span.z1, np.nan))
            if span.t1 > span.start:
                x, told = assimilate(filter_, x, chosen, options)
            else:
                x, told = absorb(filter_, x, chosen, options)
            if not told.good:
                return None
        return changed(x, screened=now.screened)
