"""Residuals of the stored samples of one member, about a trajectory of constant unknowns.

Coordinates xi on the rows of the square root at the start define a trajectory: a = a_0 + C_0^T xi
and u = u_0 + U_0^T xi. A pass computes the residuals of all readings and their derivatives in xi.
It makes no update, so that the matrix of a step does not change.
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

FACTORS = 32  # largest number of factorised matrices in memory, one for each length of a stage
TOGETHER = 6  # trial trajectories in one pass, for a stage that propagates them as one array
AT_ONCE = 32  # largest number of trajectories in one array


def principal(H: Array) -> tuple[Array, Array]:
    """Return principal values and axes of a Hessian of the cost.

    The Hessian is the identity, from the prior, plus a positive semidefinite part. Values below 1
    are rounding errors, next to directions that readings determine to the last digit.
    """
    sizes, axes = np.linalg.eigh(H)
    return np.maximum(sizes, 1.0), axes


@dataclass(frozen=True, eq=False)
class Passed:
    """Residuals and derivatives of the samples about one trajectory."""

    xi: Array  # coordinates of the trajectory, shape (r,)
    # Readings minus predictions, in units of the noise, shape (samples, sensors); NaN if missing.
    residuals: Array
    # Derivatives of the predictions in xi, in units of the noise, (samples, sensors, r).
    slopes: Array
    end: FilterState  # state, unknowns, and their derivatives in xi as rows, after the last sample

    def cost(self, used: Mask) -> float:
        """Return half the sum of squares of the residuals in use and of xi."""
        return 0.5 * float((self.residuals[used] ** 2).sum() + self.xi @ self.xi)

    def model(self, used: Mask) -> tuple[Array, Array]:
        """Return the Gauss-Newton Hessian and the negative gradient, (r, r) and (r,)."""
        J, r = self.slopes[used], self.residuals[used]
        return np.eye(len(self.xi)) + J.T @ J, J.T @ r - self.xi


@dataclass(frozen=True, eq=False)
class StoredSamples:
    """The samples of one member since the start of its window."""

    work: SensitivityWork
    state: SensitivityState  # present state of the member
    rows: LogRows  # rows of the log since the start of the window

    @classmethod
    def of(cls, work: SensitivityWork, state: SensitivityState) -> StoredSamples:
        sensors = work.filter.problem.observed.size
        return cls(work, state, LogRows.of(state.log[:, int(state.window[0]) :], sensors))

    def __len__(self) -> int:
        return len(self.rows.times) - self._before

    @property
    def _before(self) -> int:
        """Number of rows before the first sample: 1, or 0 if the row at the start has readings."""
        return int(not self.state.opening[0])

    @cached_property
    def spans(self) -> Sequence[Span]:
        """Interval that ends at each sample; of length zero for a sample at the start."""
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
        """True if the gate may refuse readings."""
        return self.work.options.gate.beyond < np.inf

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of each reading, shape (samples, sensors)."""
        own = self.rows.noise[self._before :]
        stated: Array = np.where(np.isnan(own), self.filter.noise, own)
        return np.asarray(np.sqrt(self.state.now.level[0]) * stated)

    @cached_property
    def readings(self) -> Array:
        """All readings in units of their noise, shape (samples, sensors); NaN if missing."""
        return self._values / self.noise

    @cached_property
    def _values(self) -> Array:
        """All readings, NaN if missing; a reading without the position of its sensor is missing."""
        values = self.rows.readings[self._before :].copy()
        missing = np.isnan(self.rows.inputs[self._before :]).any(axis=1)
        for number in np.flatnonzero(missing).tolist():
            predicted, _ = self.filter.sensors.observe(self.start, self.spans[number].end)
            values[number, ~np.isfinite(predicted[0])] = np.nan
        return values

    @cached_property
    def alive(self) -> Mask:
        """Mask of the nonzero rows of the square root at the start, shape (r,); others pad it."""
        at = self.placed(np.zeros((1, self.start.C.shape[1])), rows=True)
        return np.asarray(at.C[0].any(axis=1) | at.U[0].any(axis=1))

    @cached_property
    def missing(self) -> Array:
        """NaN for each reading, shape (samples, sensors)."""
        return np.full(self.readings.shape, np.nan)

    @cached_property
    def seen(self) -> Mask:
        return np.asarray(np.isfinite(self.readings).any(axis=1))

    @property
    def together(self) -> int:
        """Number of trajectories that cost little more than a single trajectory."""
        return TOGETHER if self._batched else 1

    @property
    def _batched(self) -> bool:
        """True if several trajectories as one array save time; other stages share one factor."""
        return isinstance(self.filter.stage, BandedStage)

    @property
    def reached(self) -> Array:
        """Coordinates xi of the present estimate, shape (r,).

        Coordinates that do not change the unknowns are taken from the last refit.
        """
        now, start, reduction = self.state.now, self.start, self.filter.reduction
        shift = reduction.reduced(reduction.bounded(self.filter.estimate(now)) - start.q)[0]
        last: Array = self.state.fit.xi[0, :, 0]
        return last + coordinates(start.C[0], shift - start.C[0].T @ last)

    def within_bounds(self, xi: Array) -> Array:
        """Return xi with the smallest shift that moves the unknowns into their bounds."""
        start, reduction = self.start, self.filter.reduction
        shift = start.C[0].T @ xi
        q = start.q[0] + reduction.Phi @ shift
        inside = reduction.bounded(q)
        if inside is q:
            return xi
        return xi + coordinates(start.C[0], reduction.reduced(inside - start.q[0]) - shift)

    def placed(self, points: Array, rows: bool) -> FilterState:
        """Return the starts of trajectories, shape (points, r); `rows`: with derivatives."""
        start, reduction = self.start, self.filter.reduction
        count, (r, k), n = len(points), start.C[0].shape, start.u.shape[1]
        shifts = points @ start.C[0]
        q = start.q + shifts @ reduction.Phi.T
        C = np.broadcast_to(start.C, (count, r, k))
        if self.state.initial[0]:
            model, moment = self.filter.problem.model, self.spans[0].at(float(self.spans[0].t0[0]))
            at = moment.member(0)
            u = np.array([model.initial_state(passed, at) for passed in q])
            slopes = [model.initial_directions(passed, reduction.Phi, at).T for passed in q]
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
        """Yield slices of spans, and trajectories with derivatives, (spans, 1 + r, points, n).

        The iteration ends early if a step fails.
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
        """Yield slices and trajectories as `_followed`, computed stage by stage."""
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

    def along(self, passed: Passed) -> Iterator[FilterState]:
        """Yield the state and the unknowns of a trajectory at each sample."""
        x = self.placed(passed.xi[None], rows=False)
        for _, block in self._followed(x):
            for columns in block:
                yield changed(x, u=columns[0])

    def _compared(self, x: FilterState) -> Iterator[tuple[slice, Array, Array, Array]]:
        """Yield a slice of spans, trajectories at its end, residuals and derivatives.

        Trajectories have the shape (1 + r, points, n). Residuals and derivatives of the predictions
        are in units of the noise, shapes (spans, points, sensors) and (spans, points, r, sensors).
        Residuals of samples without a reading are NaN.
        """
        for part, block in self._followed(x):
            seen = np.flatnonzero(self.seen[part])

            def end(k: int, numbers: IntArray = part.start + seen) -> Moments:
                return self.spans[int(numbers[k])].end

            predicted, Y = self.filter.sensors.observe_each(x, block[seen], end)
            noise = self.noise[part][seen][:, None]
            shape = (len(block), *predicted.shape[1:])
            residuals, slopes = np.full(shape, np.nan), np.zeros((len(block), *Y.shape[1:]))
            residuals[seen] = (self._values[part][seen][:, None] - predicted) / noise
            slopes[seen] = Y / noise[:, :, None]
            yield part, block[-1], residuals, slopes

    def about(self, xi: Array) -> Passed | None:
        """Return residuals and derivatives about one trajectory; None if a step fails."""
        present = np.isfinite(self.readings)
        r, J = self.missing.copy(), np.zeros((*present.shape, len(xi)))
        x, taken = self.placed(xi[None], rows=True), 0
        for part, columns, residuals, Y in self._compared(x):
            r[part], J[part] = residuals[:, 0], Y[:, 0].swapaxes(1, 2)
            last, taken = columns, part.stop
        if not taken or taken < len(self):
            return None
        J[~present] = 0.0
        end = changed(x, u=last[0], U=last[1:].transpose(1, 0, 2))
        # The sum of squares is checked, because cost and Hessian overflow with the squares.
        squares = (J**2).sum() + (last**2).sum() + (r[present] ** 2).sum()
        return Passed(xi=xi, residuals=r, slopes=J, end=end) if np.isfinite(squares) else None

    def residuals(self, xi: Array) -> Array | None:
        """Return the residuals about one trajectory; None if a step fails."""
        r, taken = self.missing.copy(), 0
        for part, _, residuals, _ in self._compared(self.placed(xi[None], rows=False)):
            r[part], taken = residuals[:, 0], part.stop
        return r if taken == len(self) else None

    def costs(self, points: Array, used: Mask, limit: float = np.inf) -> tuple[Array, float]:
        """Return the costs of trajectories, and their computing time as a fraction of a pass.

        No derivatives are computed. A group of trajectories ends if all costs exceed the limit.
        """
        sums = 0.5 * (points**2).sum(axis=1)
        whole, taken = np.zeros(len(points), dtype=bool), 0
        width = AT_ONCE if self._batched else 1
        for first in range(0, len(points), width):
            group = slice(first, first + width)
            compared = self._compared(self.placed(points[group], rows=False))
            for part, _, residuals, _ in compared:
                taken += residuals.shape[1] * len(residuals)
                whole[group] = part.stop == len(self)
                squares = np.where(used[part][:, None], residuals, 0.0) ** 2
                sums[group] += 0.5 * squares.sum(axis=(0, 2))
                if not (sums[group] < limit).any():
                    whole[group] = False
                    break
        columns = 1 + int(self.alive.sum())
        costs = np.where(whole & np.isfinite(sums), sums, np.inf)
        return costs, taken / (columns * max(len(self), 1))

    def updated(self, passed: Passed, used: Mask) -> FilterState:
        """Return the filter after all readings in use, linear about a trajectory.

        It keeps the ledger and discretisation errors of the present filter, which must be close.
        """
        end, now, J = passed.end, self.state.now, passed.slopes[used]
        # The prior of xi is N(0, I); relative to the trajectory, its mean is -xi.
        mean, C, U = -passed.xi, end.C[0], end.U[0]
        if len(J):
            W, half, _ = contraction(J.T[None], (passed.residuals[used] + J @ passed.xi)[None])
            mean, C, U = mean + W[0] @ half[0], W[0].T @ C, W[0].T @ U
        # Causes are coordinates on the rows of the square root, which is unique up to a rotation.
        # The rotation chosen here brings the rows closest to the rows of the present filter.
        rows = max(now.C.shape[1], len(C))
        C, U = (extended(part[None], rows - len(part))[0] for part in (C, U))
        parts = {name: getattr(now, name) for name in ("C", "past", "causes")}
        parts = {name: extended(part, rows - part.shape[1]) for name, part in parts.items()}
        left, _, right = np.linalg.svd(parts["C"][0] @ np.linalg.pinv(C))
        turn = left @ right
        parts |= {"C": (turn @ C)[None], "U": (turn @ U)[None]}
        parts |= {"da": (mean @ end.C[0])[None], "du": (mean @ end.U[0])[None]}
        x: FilterState = changed(now, q=end.q, u=end.u, **parts)
        return self.filter.compressed(x) if rows > self.filter.rank else x

    def log_evidence(self, passed: Passed, used: Mask) -> float:
        """Return the log evidence of all readings, linear about a trajectory.

        The unknowns are integrated out. A refused reading counts as a reading at the limit of the
        gate, which is wider for sensors whose residuals in use exceed their noise.
        """
        (H, g), present = passed.model(used), np.isfinite(self.readings)
        sizes, axes = principal(H)
        lowest = passed.cost(used) - 0.5 * float(((axes.T @ g) ** 2 / sizes).sum())
        evidence = -lowest - 0.5 * float(np.log(sizes).sum())
        evidence -= float((np.log(self.noise) + HALF_LOG)[present].sum())
        refused = (present & ~used).sum(axis=0)
        for k in np.flatnonzero(refused).tolist():
            square = max(
                1.0, float((passed.residuals[used[:, k], k] ** 2).sum()) / max(used[:, k].sum(), 1)
            )
            evidence -= 0.5 * self.work.options.gate.beyond**2 * square * float(refused[k])
        return evidence

    def judged(self, passed: Passed, used: Mask) -> FilterState | None:
        """Return the filter after assimilating the readings in use one by one, about a trajectory.

        Unlike `updated`, it computes ledger and discretisation errors. None if a step fails.
        """
        state, filter_ = self.state, self.filter
        now = state.now
        at = self.placed(passed.xi[None], rows=True)
        start = changed(
            self.start,
            q=at.q,
            u=at.u,
            U=at.U,
            da=-(passed.xi @ at.C[0])[None],
            du=-(passed.xi @ at.U[0])[None],
            level=now.level,
            samples=now.samples,
            kept=now.kept,
        )
        x, options = start, replace(self.work.options, gate=Gate())
        for span, kept in zip(self.spans, used, strict=True):
            chosen = replace(span, z1=np.where(kept, span.z1, np.nan))
            if span.t1 > span.start:
                x, outcome = assimilate(filter_, x, chosen, options)
            else:
                x, outcome = absorb(filter_, x, chosen, options)
            if not outcome.good:
                return None
        return changed(x, screened=now.screened)
