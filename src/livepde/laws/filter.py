"""Reduced-order extended Kalman filter in square-root form, linear about a linearisation point.

The filter of Moireau, Chapelle and Le Tallec (2008), for several members at once: the leading axis
of every array is the members. An identifier has one member, a fleet any number. Let a ~ N(0, I) be
the reduced unknowns, and P = [U C]^T [U C] the joint covariance of u and a. Let S be the Jacobian
of a step, and A the derivative of A(u) q in q. Then

    predict   one implicit step for u;   U+ S^T = U M/h - C Phi^T A(u+)^T
    update    d = z - h(u, q),  Y = U H_u^T + C Phi^T H_q^T,  W W^T = (I + Y N^-1 Y^T)^-1
              [u; a] += [U C]^T W W^T Y N^-1 d,   [U C] <- W^T [U C]

For constant unknowns, U = C L^T with the sensitivity L = du/da. The reported covariance is wider
where the innovations require it (`robust_factors`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.linalg import lapack

from livepde.laws.filter_state import FilterState, along, extended, with_rows
from livepde.laws.law import Problem
from livepde.laws.member_sensors import Anchor, MemberSensors
from livepde.laws.noise_rows import (
    NoiseRows,
    after_pause,
    grades,
    lines,
    pieces,
    unread_inputs,
    with_input_errors,
)
from livepde.laws.reduction import Reduction
from livepde.laws.shadows import ShadowSet
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed, join, product, put, take
from livepde.stepping import Interval, MemberStage, Span, StageOfMembers, StepFailed, advance
from livepde.verdict import Judge

Steps: TypeAlias = int | IntArray

FEW_SUBSTEPS = 600  # largest number of substeps that propagate the uncertainty of a pause
FEW = 8  # largest number of members for which LAPACK is called member by member
BLOCK = 32  # block size of LAPACK's QR, in columns


class Update(NamedTuple):
    """Matrices and vectors of an update; W is defined in the docstring of this module."""

    # Shapes (members, r, r) and (members, r, sensors).
    W: Array
    Y: Array
    # W^T Y d, shape (members, r), and d^T (I + Y^T Y)^-1 d, shape (members,).
    half: Array
    misfit: Array

    @property
    def left(self) -> Array:
        """Return W^T Y, shape (members, r, sensors)."""
        return product(self.W.transpose(0, 2, 1), self.Y)

    @property
    def spread(self) -> Array:
        """Return log det (I + Y^T Y)/2, shape (members,)."""
        return np.asarray(-np.log(np.abs(np.diagonal(self.W, axis1=1, axis2=2))).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Filter:
    """Predict and update, linear about the linearisation point of a `FilterState`.

    Overflow raises no error: callers check that the results are finite.
    """

    problem: Problem  # model and sensors
    stage: MemberStage  # implicit stage of the time scheme, for all members
    sensors: MemberSensors  # observation operator of all members
    reduction: Reduction  # reduced coordinates of the unknowns
    noise: Array  # standard deviation of each sensor, shape (sensors,)
    # A square root of more than `rank` rows is compressed. The norm of the state weighs its
    # coefficients by `scale`, the square roots of their normalised diagonal masses, shape (n,).
    rank: int
    scale: Array
    # Prior variances gained per unit of time by unknowns without an evolution, one value for each
    # member number, shape (numbers,), or one for all, shape (1,).
    drift: Array
    fading: float = np.inf  # time constant of decay of the cross-covariance of state and unknowns
    judge: Judge | None = None  # accumulates the statistics of the verdict; None: no verdict
    shadows: ShadowSet | None = None  # estimated discretisation errors; None: no error is estimated

    def drifts(self, member: IntArray) -> Array:
        return self.drift[member] if len(self.drift) > 1 else np.repeat(self.drift, len(member))

    @cached_property
    def anchor(self) -> Anchor:
        """Operator that corrects the state alone, by readings that do not change the unknowns."""
        return Anchor(self.problem, self.sensors)

    @cached_property
    def moves(self) -> bool:
        return self.reduction.moves or bool(self.drift.any())

    def span(self, interval: Interval) -> Span:
        """Return the span of a filter with one member for an interval."""
        return Span.of(interval.driven(self.problem.control.held), self.problem.channels)

    @cached_property
    def _driving(self) -> IntArray:
        """Columns of the input channels that are interpolated linearly between readings."""
        channels = self.problem.channels
        return np.array([channels.index(name) for name in lines(self.problem)], dtype=np.int64)

    def input_gaps(self, span: Span) -> Mask | None:
        """Return the members with an input that was not read in a span, (members,), or None.

        Their innovations may be due to that input. None means that all inputs were read.
        """
        if span.gaps is None:
            return None
        unread: Mask = np.asarray((span.gaps[:, :, self._driving] > 0.0).any(axis=(1, 2)))
        return unread if np.count_nonzero(unread) else None

    def learns(self, Y: Array) -> bool:
        """Return whether readings with the rows Y, (members, r, sensors), change an estimate.

        The rows of a sensor at an uncertain position in a uniform state contain rounding errors.
        """
        return bool((np.square(Y / self.noise) > np.finfo(float).eps).any())

    def noise_of(self, x: FilterState, z: Span | Interval) -> Array:
        """Return the standard deviation of each reading at the end, shape (members, sensors).

        The default is the noise of the sensor. Both are scaled by the noise level of the member.
        """
        noise: Array = self.noise
        if z.noise is not None:
            noise = np.where(np.isnan(z.noise), noise, z.noise)
        return np.asarray(np.sqrt(x.level)[:, None] * noise)

    def estimate(self, x: FilterState) -> Array:
        """Return the estimated latent parameters before bounds are applied, shape (members, m)."""
        return x.q + x.da @ self.reduction.Phi.T

    def _with_noise(self, x: FilterState, h: float, noise: NoiseRows | None) -> FilterState:
        """Return the state with the unknowns predicted over a time h and rows for their noise."""
        end = self.unknowns_after(x, h)
        if noise is None:
            return end
        U, past, causes = (extended(part, len(noise)) for part in (x.U, x.past, x.causes))
        C = np.concatenate([end.C, noise.at_end()], axis=1)
        return changed(end, U=U, C=C, past=past, causes=causes)

    def _noise(self, x: FilterState, start: float, h: float) -> NoiseRows | None:
        """Return the process noise of a step; None if no coordinate gains variance."""
        if h == 0.0 or not self.moves:
            return None
        drifts = self.drifts(x.member)
        variance = np.einsum("brk,brk->bk", x.C, x.C)
        gained = self.reduction.gained(h, variance, drifts)
        # Members share one array: a coordinate that gains in one member has rows in all members.
        (grows,) = np.asarray((gained > 0.0).any(axis=0)).nonzero()
        if not len(grows):
            return None
        lengths = tuple((self.reduction.rates[grows] * h).tolist())
        weight = self.problem.control.scheme.weight
        return NoiseRows(
            start=start,
            length=h,
            scale=np.sqrt(gained[:, grows]),
            lengths=lengths,
            columns=grows,
            k=x.C.shape[2],
            weight=weight,
        )

    def unknowns_after(self, x: FilterState, h: float) -> FilterState:
        """Return the state with its unknowns and their shadows predicted without process noise."""
        if h == 0.0 or not self.reduction.moves:
            return changed(x, age=x.age + h)
        F = self.reduction.transition(h)
        shadows = x.shadows
        if shadows.a.shape[1]:
            shadows = changed(shadows, a=shadows.a @ F.T)
        q, da = self.reduction.predict(x.q, h), x.da @ F.T
        return changed(x, q=q, da=da, C=x.C @ F.T, age=x.age + h, shadows=shadows)

    def predict(self, x: FilterState, span: Span) -> tuple[FilterState, Steps, StepFailed | None]:
        """Return the state at the end of a span, the number of substeps, and the failure or None.

        The number of substeps is an array over the members if they differ. The process noise of the
        unknowns is independent from substep to substep. If `Span.parts` is None, the error of the
        time step determines into how many parts the substeps are divided.
        """
        shadows, parts = self.shadows, x.parts if span.parts is None else span.parts
        if shadows is None:
            return self._by_parts(x, span, parts)
        if span.parts is not None:
            end, taken, failure = self._by_parts(x, span, parts)
            kept = end if failure else changed(end, shadows=shadows.chosen(x, end))
            return kept, taken, failure
        parts = shadows.first_parts(x)
        end, taken, failure = self._by_parts(x, span, parts)
        while failure is None:
            better = shadows.finer_parts(end, parts)
            group = np.flatnonzero(better != parts)
            if not len(group):
                return changed(end, shadows=shadows.chosen(x, end)), taken, None
            parts = better
            if len(group) == len(x):
                end, taken, failure = self._by_parts(x, span, parts)
                continue
            subset = take(x, group), span.part(group), parts[group]
            after, steps, failure = self._by_parts(*subset)
            end, taken = put(end, group, after), np.broadcast_to(taken, (len(x),)).copy()
            taken[group] = steps
        return x, taken, failure

    def _by_parts(
        self, x: FilterState, span: Span, parts: IntArray
    ) -> tuple[FilterState, Steps, StepFailed | None]:
        """Predict over a span with the substeps divided into `parts`, shape (members,)."""
        if (parts == parts[0]).all():
            end, taken, failure = self._predicted(x, replace(span, parts=parts))
            return changed(end, parts=parts), taken, failure
        ends, steps = list[FilterState](), np.zeros(len(x), dtype=np.int64)
        groups = [np.flatnonzero(parts == count) for count in sorted(set(parts.tolist()))]
        for group in groups:
            subset = take(x, group), span.part(group), parts[group]
            after, steps[group], failure = self._by_parts(*subset)
            if failure is not None:
                return x, steps, failure
            ends.append(after)
        return take(join(*ends), np.argsort(np.concatenate(groups))), steps, None

    def _predicted(
        self, x: FilterState, span: Span
    ) -> tuple[FilterState, Steps, StepFailed | None]:
        """Predict over a span, for members that divide their substeps equally."""
        x, end, taken, failure = self._divided(x, span)
        if failure is None:
            end, failure = self._with_inputs(x, end, span)
        if failure is not None:
            return x, taken, failure
        if self.shadows is not None:
            end = self.shadows.predict(x, end, span)
        if self.fading < math.inf:  # exponential decay of the cross-covariance
            end = changed(end, U=np.exp(-(span.t1 - span.start) / self.fading) * end.U)
        return end, taken, None

    def _with_inputs(
        self, x: FilterState, end: FilterState, span: Span
    ) -> tuple[FilterState, StepFailed | None]:
        """Add the errors of noisy and unread inputs, and of inputs in a pause, to a prediction."""
        noise, failure = self.problem.input_noise, None
        if noise:
            end, failure = with_input_errors(self.carried, x, end, span, noise)
        # For constant unknowns, held values count as exact here, as they do in a refit.
        if failure is None and (self.moves or noise) and self.input_gaps(span) is not None:
            errors = unread_inputs(self.problem, x, span)
            end, failure = with_input_errors(self.carried, x, end, span, errors)
            end = self._limited(end)
        end = changed(end, driven=x.driven.after(span))
        if failure is None and np.count_nonzero(end.driven.pause):
            coarse = self._coarse(span.t1 - span.start)
            end, failure = after_pause(coarse.carried, self.problem, x, end, span)
            end = self._limited(end)
        return end, failure

    def _coarse(self, length: float) -> Filter:
        """Return the filter with substeps long enough that `length` has at most `FEW_SUBSTEPS`."""
        control, longest = self.problem.control, length / FEW_SUBSTEPS
        if longest <= control.dt_max:
            return self
        return replace(
            self, problem=replace(self.problem, control=replace(control, dt_max=longest))
        )

    def _divided(
        self, x: FilterState, span: Span
    ) -> tuple[FilterState, FilterState, Steps, StepFailed | None]:
        """Return the start with the `rate` that the step requires, and the results of `carried`."""
        if not self.moves:
            return x, *self._through(x, span, [span.t1])
        length, more = span.t1 - span.start, True
        while more:
            end, taken, failure = self.carried(x, span)
            if failure is not None:
                break
            rate = np.maximum(x.rate, end.rate)
            more = bool((grades(rate, length) > grades(x.rate, length)).any())
            if more:  # the readings forget the process noise faster than `x.rate` allows for
                x = changed(x, rate=rate)
        return x, end, taken, failure

    def carried(self, x: FilterState, span: Span) -> tuple[FilterState, Steps, StepFailed | None]:
        """Return the state at the end of a span whose inputs are known exactly."""
        if not self.moves:
            return self._through(x, span, [span.t1])
        # Each part of a step has independent process noise.
        parts, taken = grades(x.rate, span.t1 - span.start), np.zeros(len(x), dtype=np.int64)
        for count in sorted(set(parts.tolist())):
            times = pieces(self.problem.control, span.start, span.t1, count)
            if (parts == count).all():
                return self._through(x, span, times)
            group = np.flatnonzero(parts == count)
            after, steps, failure = self._through(take(x, group), span.part(group), times)
            if failure is not None:
                return x, steps, failure
            x, taken[group] = put(x, group, after), steps
        return x, taken, None

    def _through(
        self, x: FilterState, span: Span, times: list[float]
    ) -> tuple[FilterState, int, StepFailed | None]:
        """Return the state after the parts of a span that end at `times`."""
        first, taken = span.start, 0
        for stop in times:
            x, steps, failure = self._advanced(x, span, first, stop)
            first, taken = stop, taken + steps
            if failure is not None:
                break
        return x, taken, failure

    def _advanced(
        self, x: FilterState, span: Span, start: float, stop: float
    ) -> tuple[FilterState, int, StepFailed | None]:
        """Return the state at time `stop`, the end of a part of a span that begins at `start`."""
        noise, rows = self._noise(x, start, stop - start), x.U.shape[1]
        end, kept = self._with_noise(x, stop - start, noise) if self.moves else x, x.kept
        shifted: Mask = np.asarray(x.da.any(axis=1) | x.du.any(axis=1))
        deviates = bool(shifted.any())
        shadows = x.shadows.u.shape[1]

        at_end = self._directions(end, end.C, deviates)
        factors: dict[float, Any] = {}  # factorised matrices, for stages of a step with the same q
        begun, length = start, stop - start

        def begin(t: float, h: float) -> None:
            nonlocal begun, length
            begun, length = t, h

        def stage(columns: Array, t: float, h: float) -> Array:
            nonlocal kept
            q, along = end.q, at_end
            if self.moves and (t != stop or (noise and noise.weight == 1.0)):
                # An inner stage requires the unknowns at its own time: the unknowns at the end of
                # the step would reduce the order of the time scheme.
                now = self.unknowns_after(x, t - start) if t != stop else end
                C = now.C[:, :rows]
                if noise:
                    C = np.concatenate([C, noise.at_stage(t, begun, length)], axis=1)
                q, along = now.q, self._directions(now, C, deviates)
            same = factors if q is end.q else {}
            work = StageOfMembers(x.member, q, along, h, span.at(t), kept, shifted, same, shadows)
            y, kept = self.stage.advance(columns, work)
            return y

        last = [end.du[None]] if deviates else []
        if shadows:
            last.append(end.shadows.u.transpose(1, 0, 2))
        columns = np.concatenate([end.u[None], end.U.transpose(1, 0, 2), *last])
        control, count = self.problem.control.divided(span.division), end.U.shape[1]
        columns, steps, failure = advance(control, stage, columns, start, stop, begin)
        if failure is not None:
            return x, steps, failure
        U = columns[1 : 1 + count].transpose(1, 0, 2)
        du = columns[1 + count] if deviates else end.du
        parts: dict[str, Any] = {"u": columns[0], "U": U, "du": du, "kept": kept}
        if shadows:
            parts["shadows"] = changed(end.shadows, u=columns[-shadows:].transpose(1, 0, 2))
        new = changed(end, **parts)
        if noise and stop == span.t1:
            new = changed(new, rate=self._rate(new, noise, span))
        return self._limited(new), steps, None

    def _directions(self, at: FilterState, C: Array, deviates: bool) -> Array:
        """Return the derivatives of q along all tangents, (members, tangents, m)."""
        # The estimate relative to the linearisation point, [du; da], is one more tangent, so that
        # it follows the same linear model as the rows of [U C].
        C = np.concatenate([C, at.da[:, None]], axis=1) if deviates else C
        directions = self.reduction.directions(at.q, C)
        if not at.shadows.u.shape[1]:
            return directions
        # A separate call keeps the other directions the same to the last bit.
        return np.concatenate([directions, self.reduction.directions(at.q, at.shadows.a)], axis=1)

    def _rate(self, x: FilterState, noise: NoiseRows, span: Span) -> Array:
        """Return how fast the readings at the end forget the process noise, shape (members,)."""
        U = x.U[:, -len(noise) :]
        C = np.zeros((*U.shape[:2], x.C.shape[2]))  # direct readings of an unknown do not fade
        Y = self.sensors.rows(x, U, C, span.end)
        # The noise of the sensors, not of the readings, gives the same parts in a forecast.
        level = np.sqrt(x.level)[:, None]
        return noise.rate(x.rate, Y / (level * self.noise)[:, None])

    @staticmethod
    def update(
        x: FilterState, Y: Array, d: Array, causes: Array
    ) -> tuple[dict[str, Array], Update]:
        """Return the fields of the state after a sample, and the matrices of the update.

        `Y`, `d`: observed square root, (members, r, sensors), and innovations, (members, sensors),
        in units of the noise; zero for missing values. `causes`: `FilterState.causes` before the
        update.
        """
        W, half, misfit = contraction(Y, d)
        Wt, row = W.transpose(0, 2, 1), half[:, None]
        U, C, parts = product(Wt, x.U), product(Wt, x.C), {"causes": causes}
        # Past values and causes are coordinates on the rows of the square root, so that W^T applies
        # to them too.
        if x.past.shape[2]:
            parts["past"] = past = Wt @ x.past
            parts["dpast"] = x.dpast + (row @ past)[:, 0]
        if causes.shape[2]:
            parts["causes"] = product(Wt, causes)
        da, du = x.da + product(row, C)[:, 0], x.du + product(row, U)[:, 0]
        return parts | {"da": da, "du": du, "U": U, "C": C}, Update(W, Y, half, misfit)

    def remembered(self, x: FilterState) -> FilterState:
        """Return the state with the present values of a appended to `past`, to be smoothed."""
        now = self.reduction.reduced(x.q - self.problem.model.latent.prior) + x.da
        # As additional columns on the same rows, these values keep their covariance with later
        # values, by which every later sample smooths them.
        past, dpast = np.concatenate([x.past, x.C], axis=2), np.concatenate([x.dpast, now], axis=1)
        return changed(x, past=past, dpast=dpast)

    def relinearised(self, x: FilterState) -> FilterState:
        """Return the state with its linearisation point at the estimate, within the bounds.

        Bounds (`Reduction.ends`) apply to linearisation points and reported estimates, not to the
        linear filter. An excess beyond a bound stays in da and du, so that no information is lost.
        """
        estimate = x.q + x.da.dot(self.reduction.Phi.T)
        within = self.reduction.bounded(estimate)
        da, du, u = np.zeros(x.da.shape), np.zeros(x.du.shape), x.u + x.du
        if within is not estimate:
            beyond = (within != estimate).any(axis=1)
            # Least squares raises an error if a square root is not finite. Such a member fails with
            # its own status and must not stop the others.
            for k in np.flatnonzero(beyond & np.isfinite(x.C).all(axis=(1, 2))).tolist():
                shift = self.reduction.reduced(within[k] - x.q[k])
                da[k] = x.da[k] - shift
                du[k] = along(x, k, da[k])
                u[k] -= du[k]
                estimate[k] = x.q[k] + self.reduction.Phi @ shift
        return changed(x, u=u, q=estimate, du=du, da=da)

    def inflated(self, x: FilterState, size: float, chosen: Mask | None = None) -> FilterState:
        """Return the state with the covariance of the unknowns inflated.

        An independent error of `size` prior standard deviations is added to each reduced
        coordinate, or to those in `chosen`, shape (k,). The covariance of u does not change.
        """
        members, k = x.da.shape
        # The added rows are zero in U, so that the added error is independent of the state.
        rows = size * (np.eye(k) if chosen is None else np.eye(k)[chosen])
        U = np.zeros((members, len(rows), x.u.shape[1]))
        return self._limited(with_rows(x, U, np.broadcast_to(rows, (members, *rows.shape))))

    def with_prior(self, x: FilterState) -> FilterState:
        """Return the state with the prior of the unknowns and the estimate of u."""
        # The prior is independent of the state and of earlier values: U, past and causes are zero.
        members, k = x.da.shape
        prior = np.broadcast_to(self.problem.model.latent.prior, x.q.shape)
        C = np.broadcast_to(np.eye(k), (members, k, k))
        U, du, da = np.zeros((members, k, x.u.shape[1])), np.zeros_like(x.du), np.zeros_like(x.da)
        past = np.zeros((members, k, x.past.shape[2]))
        causes = np.zeros((members, k, x.causes.shape[2]))
        shadows = changed(x.shadows, a=np.zeros_like(x.shadows.a))
        new = changed(x, u=x.u + x.du, q=prior, du=du, da=da, U=U, C=C, past=past, causes=causes)
        return changed(new, shadows=shadows)

    def _limited(self, x: FilterState) -> FilterState:
        return self.compressed(x) if x.C.shape[1] > self.rank else x

    def compressed(self, x: FilterState) -> FilterState:
        """Return the state with a square root of `rank` rows.

        A rotation moves the uncertainty of the unknowns, and its correlation with the state, to the
        first k rows, which are kept. The other rows concern the state alone: their leading
        directions in the norm of `scale` are kept.
        """
        k = x.C.shape[2]
        rotation, root = np.linalg.qr(x.C, mode="complete")
        turned = rotation.transpose(0, 2, 1)
        rotated, past, causes = (turned @ part for part in (x.U, x.past, x.causes))
        alone = rotated[:, k:]
        weighted = alone * self.scale
        # The size of the Gram matrix does not depend on the mesh. The loss of half the digits does
        # not matter for the choice of directions.
        square = weighted @ weighted.transpose(0, 2, 1)
        square[~np.isfinite(square).all(axis=(1, 2))] = 0.0  # the caller reports such members
        _, vectors = np.linalg.eigh(square)
        leading = vectors[:, :, ::-1][:, :, : self.rank - k].transpose(0, 2, 1)
        C = extended(root[:, :k], leading.shape[1])
        U = np.concatenate([rotated[:, :k], leading @ alone], axis=1)
        past = np.concatenate([past[:, :k], leading @ past[:, k:]], axis=1)
        causes = np.concatenate([causes[:, :k], leading @ causes[:, k:]], axis=1)
        return changed(x, U=U, C=C, past=past, causes=causes)


def contraction(Y: Array, d: Array) -> tuple[Array, Array, Array]:
    """Return W with W W^T = (I + Y Y^T)^-1, (members, r, r), W^T Y d, and d^T (I + Y^T Y)^-1 d.

    A QR factorisation of [I 0; Y^T d] gives [R c; 0 s] with R = W^-1, c = W^T Y d, and s the square
    root of the last result. No matrix is squared, which would halve the digits.
    """
    members, r, sensors = Y.shape
    stacked = np.zeros((members, r + 1, r + sensors))  # transposed: LAPACK counts down the columns
    stacked[:, :r, r:], stacked[:, r, r:] = Y, d
    stacked.reshape(members, -1)[:, : r * (r + sensors) : r + sensors + 1] = 1.0
    if members > FEW:
        upper: Array = np.asarray(np.linalg.qr(stacked.transpose(0, 2, 1), mode="r"))
        good = np.isfinite(upper).all(axis=(1, 2))
        # Inverting entries that are not finite may raise an error, which would stop all members.
        inverse = np.full((members, r, r), np.nan)
        inverse[good] = np.linalg.inv(upper[good, :r, :r])
        return inverse, upper[:, :r, r], upper[:, r, r] ** 2
    # For one matrix, NumPy's call for stacks of matrices takes ten times longer than LAPACK.
    inverse, last = np.empty((members, r, r)), np.empty((members, r + 1))
    for k in range(members):
        factored = lapack.dgeqrf(stacked[k].T, lwork=BLOCK * (r + 1), overwrite_a=1)[0]
        last[k] = factored[: r + 1, r]
        inverse[k] = lapack.dtrtri(factored[:r, :r])[0]
    # LAPACK leaves the reflectors of the factorisation below the diagonal.
    return inverse * _upper(r), last[:, :r], last[:, r] ** 2


@lru_cache(maxsize=16)
def _upper(r: int) -> Array:
    """Return ones in the upper triangle of an r by r matrix."""
    return np.triu(np.ones((r, r)))


def robust_factors(reduction: Reduction, x: FilterState) -> tuple[Array, Array]:
    """Return a square root [U C] of the robust covariance, (members, r, n) and (members, r, k).

    The sandwich V = P (1 + lambda F) P of Huber (1967) and White (1982), including the prior. In
    units of the prior at this time, P is the covariance of the filter and F = P^-1 - 1 the
    information in the samples. The factor lambda is the square of `Innovations.inflation`, by which
    a mean of the innovations scatters more than expected. A direction with the remaining share p of
    its prior variance gets the variance p (p + lambda (1 - p)), at most its prior variance. The
    variance of an unobserved direction stays the same, however wrong the sensors are.

    Uncertainty of the state alone has no prior: its variance is multiplied by lambda.
    """
    inflation = x.innovations.inflation
    right = inflation == 1.0
    if right.all():
        return x.U, x.C
    k = x.C.shape[2]
    finite = np.isfinite(x.C).all(axis=(1, 2)) & np.isfinite(inflation)
    C = reduction.in_prior_units(np.where(finite[:, None, None], x.C, 0.0), x.age)
    # In the principal axes of the posterior relative to the prior, each direction has its own
    # share p, the square of a singular value.
    rotation, singular, _ = np.linalg.svd(C)
    share = np.minimum(singular * singular, 1.0)
    # Factors on standard deviations: the formula of the docstring for the first k rows, and the
    # square root of lambda for the others, which concern the state alone.
    widths = np.repeat(inflation[:, None], rotation.shape[1], axis=1)
    widened = share + inflation[:, None] ** 2 * (1.0 - share)
    widths[:, :k] = np.sqrt(np.minimum(widened, 1.0 / np.maximum(share, np.finfo(float).tiny)))
    widths[~finite] = 1.0
    rows = widths[:, :, None] * rotation.transpose(0, 2, 1)
    rows[right] = np.eye(rows.shape[1])  # results do not depend on the other members
    return rows @ x.U, rows @ x.C


def reported_factors(filter_: Filter, x: FilterState) -> tuple[Array, Array]:
    """Return `robust_factors` with one additional row for the discretisation error."""
    U, C = robust_factors(filter_.reduction, x)
    if filter_.shadows is None:
        return U, C
    u, a = filter_.shadows.widening(x)
    return np.concatenate([U, u], axis=1), np.concatenate([C, a], axis=1)
