"""Fixed-interval smoother: state and unknowns at each sample, given those before and after it.

The filter carries x = m + [U C]^T xi with xi ~ N(0, I). From one sample to the next xi' is made of
xi and of the process noise in between by rotations, truncations and the contraction of the update,
so that the two are jointly Gaussian:

    xi = g + T^T xi' + R^T zeta,    T = E[xi' xi^T | z'],  g = E[xi | z'],  R^T R = I - P^T P,

P being T before the update and zeta ~ N(0, I) the part that the truncation drops.
(`FilterState.past` and `dpast` follow xi through predict and update: T and g are the images of I
and 0.) So given all samples xi ~ N(mu, B^T B) follows backward, in as many coordinates as the
square root has rows, from mu = 0 and B = I at the end (Rauch, Tung and Striebel 1965):

    mu = g + T^T mu',    B = upper triangle of a QR factorisation of [B' T; R]

The smoother is linear about one trajectory of the unknowns. This trajectory begins at the estimates
of the run, for constant unknowns at their last one, and is moved to the smoothed one by damped
Gauss-Newton steps that make samples and prior together more probable (Bell 1994), until these
change it by less than a tenth of a standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from livepde.errors import LawError
from livepde.laws.assimilation import GateDecision, absorb
from livepde.laws.filter_state import FilterState, coordinates, unaccompanied, unjudged
from livepde.laws.iterated_smoother import Window, expecting, missed, moved, placed
from livepde.laws.law import FixedInterval
from livepde.laws.sensitivity_state import SensitivityState, SensitivityWork
from livepde.linalg import Array, Mask, nonfinite_allowed
from livepde.linalg.member_arrays import changed
from livepde.stepping import KeptFactors, Span

ITERATIONS = 6  # Gauss-Newton steps at most
HALVINGS = 2  # of a step that makes samples and prior less probable
CONVERGED = 0.1  # standard deviations that a step moves the trajectory by, at the end of it
STRIDE = 2.0  # prior standard deviations that a step moves an unknown at most
ROUNDING = 1e-12  # share of a variance


@dataclass(frozen=True, eq=False)
class _Point:
    """A filter after a sample, with g and T since the one before as `dpast` and `past`, and R."""

    x: FilterState
    R: Array


@dataclass(frozen=True, eq=False)
class _SmootherPass:
    """The samples, filtered about a trajectory of reduced unknowns, shape (1 + intervals, k).

    `misfit` is minus twice the logarithm of the trajectory's probability, up to a constant, and
    `decisions` are those of the gate, the first one on the sample at the start.
    """

    trajectory: Array
    points: list[_Point]
    misfit: float
    decisions: list[GateDecision]

    @property
    def refuses(self) -> bool:
        return any(np.count_nonzero(one.refused) for one in self.decisions)


def smoothed(
    work: SensitivityWork,
    before: SensitivityState,
    after: FilterState,
    data: FixedInterval,
    used: Mask | None = None,
) -> Iterator[FilterState]:
    """Iterate over the smoothed filters of one member, the last one first.

    States that are not asked for have no coefficients.

    `before`, `after`: the member before the first sample, and its filter after the last one in the
    run: its noise level and the statistics of its innovations are those of all samples. `used`:
    readings of the last samples that a refit has used, (samples, sensors); None: there is none.
    """
    with nonfinite_allowed():  # not finite: not used
        best = _descended(*_begun(work, before, after, data, used))
    return _backward(best, after)


def _begun(
    work: SensitivityWork,
    before: SensitivityState,
    after: FilterState,
    data: FixedInterval,
    used: Mask | None,
) -> tuple[_FixedInterval, _SmootherPass | None]:
    """Return the samples with the gate's decisions on them, and a first pass; None if all fail.

    The readings are those that the run uses, in each pass, and its refit where there is one. The
    gate of the run knows the errors of the discretisation, which widen it: what it uses without
    them it uses with them. So these, which cost twice as much again, are followed only where it
    refuses a reading.
    """
    start, initial = unjudged(work.at_level(before.now, after)), bool(before.initial[0])
    work = replace(work.unjudged, options=replace(work.options, adaptive=False))
    whole = _FixedInterval(work, start, initial, after, data)
    bare = _FixedInterval(work.unaccompanied, unaccompanied(start), initial, after, data)
    best = bare.about(bare.estimated)
    if best is None or best.refuses:
        # Unknowns that move are estimated about each estimate in turn, those that stay about one.
        first, other = (None, whole.estimated) if whole.moves else (whole.estimated, None)
        best = whole.about(first) or whole.about(other)
    if best is None:
        return bare, None
    decisions = best.decisions if used is None else _fitted(best.decisions, used, data)
    samples = replace(bare, decisions=decisions)
    if not best.refuses and decisions is best.decisions:
        return samples, best
    return samples, samples.about(samples.estimated) or samples.about(None)


def _fitted(decisions: list[GateDecision], used: Mask, data: FixedInterval) -> list[GateDecision]:
    """Return the gate's decisions, those on the last samples as a refit has made them."""
    first = len(decisions) - len(used)
    found = decisions[:first]
    for decision, kept, sample in zip(
        decisions[first:], used, [data.opening, *data.intervals][first:], strict=True
    ):
        refused = (np.isfinite(sample.z1) & ~kept)[None]
        found.append(GateDecision(refused, decision.anchored & refused))
    alike = all((a.refused == b.refused).all() for a, b in zip(found, decisions, strict=True))
    return decisions if alike else found


def _descended(samples: _FixedInterval, best: _SmootherPass | None) -> _SmootherPass:
    if best is None:
        raise LawError(
            "smoothed: the samples cannot be followed about any trajectory of the unknowns; take a "
            "smaller dt_max, or a prior closer to what the run found."
        )
    for _ in range(ITERATIONS):
        # One by one: the filters of all samples at once, with their states, may need much memory.
        found = [
            (_reduced(samples.work, x, x.da), np.linalg.norm(x.C[0], axis=0))
            for x in _backward(best, best.points[-1].x)
        ]
        target, std = map(np.array, zip(*reversed(found), strict=True))
        step = target - best.trajectory
        if (np.abs(step) <= CONVERGED * std + ROUNDING).all():
            break
        step *= min(1.0, STRIDE / float(np.abs(step).max()))
        tried = (samples.about(best.trajectory + 0.5**k * step) for k in range(HALVINGS + 1))
        better = next((one for one in tried if one and one.misfit < best.misfit), None)
        if better is None:
            break
        best = better
    return best


def _backward(best: _SmootherPass, after: FilterState) -> Iterator[FilterState]:
    """Iterate backward over the filters given all samples.

    Innovations are those of the run, and so is by how much discretisation has shifted the unknowns
    in the end; of the state the shift is known at the end only.
    """
    rows = best.points[-1].x.C.shape[1]
    mu, B = np.zeros(rows), np.eye(rows)
    shadows = after.shadows
    for point in reversed(best.points):
        x = point.x
        yield changed(
            x,
            du=x.du + mu @ x.U[0],
            da=x.da + mu @ x.C[0],
            U=B @ x.U,
            C=B @ x.C,
            innovations=after.innovations,
            shadows=changed(shadows, u=shadows.u[:, :, : x.u.shape[1]]),
        )
        shadows = changed(shadows, u=0.0 * shadows.u, fine=0.0 * shadows.fine)
        T = x.past[0]
        mu = x.dpast[0] + mu @ T
        # A square root is one up to rotations of its rows: the triangle is enough.
        B = np.asarray(np.linalg.qr(np.vstack([B @ T, point.R]), mode="r"))


def _reduced(work: SensitivityWork, x: FilterState, da: Array | float = 0.0) -> Array:
    """Return the reduced unknowns of a linearisation point plus a difference da, shape (k,)."""
    reduction = work.filter.reduction
    return np.asarray((reduction.reduced(x.q - work.filter.problem.model.latent.prior) + da)[0])


@dataclass(frozen=True, eq=False)
class _FixedInterval:
    """The samples of one member, ready to be filtered about trajectories of its unknowns."""

    work: SensitivityWork
    start: FilterState
    initial: bool  # True if it begins with the initial state that the model says
    after: FilterState
    data: FixedInterval
    # Those of the gate on the samples, the first one at the start; None: it decides.
    decisions: Sequence[GateDecision] | None = None

    @property
    def moves(self) -> bool:
        return self.work.filter.moves or bool(self.work.jumps is not None and self.data.jumps)

    def _absorbed(
        self, x: FilterState, span: Span, number: int
    ) -> tuple[FilterState, GateDecision]:
        """Return the filter after the update by a sample, and the gate's decision on it."""
        options = self.work.options
        if self.decisions is not None:
            options = replace(options, decision=self.decisions[number])
        x, told = absorb(self.work.filter, x, span, options)
        none = np.zeros_like(told.refused)
        anchored = none if told.anchored is None else told.anchored
        return x, GateDecision(told.refused, anchored)

    @property
    def estimated(self) -> Array:
        """Trajectory of the run's estimates; coordinates without process noise are traced back."""
        reduction, none = self.work.filter.reduction, np.zeros((1, self.work.filter.reduction.size))
        prior = self.work.filter.problem.model.latent.prior
        a = np.atleast_2d(reduction.reduced(np.array(self.data.q) - prior))
        for number, interval in reversed(list(enumerate(self.data.intervals))):
            h = interval.t1 - interval.t0
            back = np.linalg.solve(reduction.transition(h), a[number + 1])
            a[number] = np.where(self._gained(none, number, h) > 0.0, a[number], back)
        return a

    def about(self, trajectory: Array | None) -> _SmootherPass | None:
        """Filter the samples, linear about a trajectory or each estimate; None if that fails."""
        x, misfit, decision = self._started(trajectory)
        rows = x.C.shape[1]
        nothing = changed(x, past=np.eye(rows)[None], dpast=np.zeros((1, rows)))  # lies before
        points = [self._kept(nothing, 0, np.zeros((0, rows)))]
        followed, decisions = [_reduced(self.work, x)], [decision]
        filter_ = self.work.filter
        for number, interval in enumerate(self.data.intervals, start=1):
            h = interval.t1 - interval.t0
            if trajectory is None:
                x = filter_.relinearised(x)
            elif self.moves:
                x = expecting(filter_, x, trajectory[number], h)
            gained = self._gained((x.C**2).sum(axis=1), number - 1, h)
            x, P = self._predicted(x, number - 1)
            if P is None:
                return None
            x, decision = self._absorbed(x, filter_.span(interval), number)
            if not np.isfinite((x.u + x.du).sum() + x.da.sum() + x.C.sum()):
                return None
            decisions.append(decision)
            points.append(self._kept(x, number, _forgotten(P)))
            followed.append(_reduced(self.work, x))
            misfit += missed(filter_, x, interval)
            misfit += moved(filter_, followed[-2], followed[-1], h, gained) if self.moves else 0.0
        if trajectory is None or not np.isfinite(misfit):
            misfit = np.inf  # a pass about each estimate in turn follows no single trajectory
        return _SmootherPass(np.array(followed), points, misfit, decisions)

    def _started(self, trajectory: Array | None) -> tuple[FilterState, float, GateDecision]:
        """Return the filter after a sample at the start, the misfit, and the gate's decision."""
        filter_, opening, start = self.work.filter, self.data.opening, self.start
        q, shift = start.q[0], np.zeros(start.C.shape[2])
        if trajectory is not None:
            shift = trajectory[0] - _reduced(self.work, start)
            q = q + filter_.reduction.Phi @ shift
        end = self.data.intervals[-1].t1 if self.data.intervals else opening.t1
        window = Window(
            start=start,
            now=self.after,
            reference=start.q[0],
            initial=self.initial,
            moment=opening.end,
            length=end - opening.t1,
        )
        x = placed(filter_, window, filter_.reduction.bounded(q))
        # Coordinates xi of the shift: its probability at the start goes with exp(-|xi|^2/2).
        weights = coordinates(start.C[0], shift)
        misfit = float(weights @ weights)
        span = filter_.span(filter_.problem.unread(opening))
        predicted, Y = filter_.sensors.observe(x, span.end)
        none = np.zeros(predicted.shape, dtype=bool)
        decision = GateDecision(none, none)
        if filter_.learns(Y):  # as the law begins
            misfit += missed(filter_, x, opening)
            x, decision = self._absorbed(x, span, 0)
        return x, misfit, decision

    def _gained(self, variance: Array, number: int, h: float) -> Array:
        """Return the variance that coordinates gain in an interval, with a jump, shape (k,)."""
        filter_, jumps = self.work.filter, self.work.jumps
        drifts = filter_.drifts(self.after.member)
        gained = filter_.reduction.gained(h, variance, drifts)[0]
        if jumps is not None and number in self.data.jumps:
            # The jump is at the beginning of the interval, and is carried to its end.
            F = filter_.reduction.transition(h)
            gained = gained + jumps.size**2 * (F**2 @ self.work.jumping)
        return np.asarray(gained)

    def _predicted(self, x: FilterState, number: int) -> tuple[FilterState, Array | None]:
        """Return the filter before the update at the end of an interval, and P."""
        filter_, jumps, rows = self.work.filter, self.work.jumps, x.C.shape[1]
        x = changed(x, past=np.eye(rows)[None], dpast=np.zeros((1, rows)))
        if jumps is not None and number in self.data.jumps:
            x = filter_.inflated(x, jumps.size, self.work.jumping)
        span = filter_.span(self.data.intervals[number])
        x, _, failure = filter_.predict(x, span)
        return x, x.past[0] if failure is None else None

    def _kept(self, x: FilterState, number: int, R: Array) -> _Point:
        """Return a point with the state where it is asked for."""
        x = changed(unaccompanied(x), kept=KeptFactors.none(1))
        if number not in self.data.fields:
            x = changed(x, u=x.u[:, :0], du=x.du[:, :0], U=x.U[:, :, :0])
        return _Point(x, R)


def _forgotten(P: Array) -> Array:
    """Return R with R^T R = I - P^T P."""
    values, vectors = np.linalg.eigh(np.eye(P.shape[1]) - P.T @ P)
    lost = values > ROUNDING
    return np.asarray(np.sqrt(values[lost])[:, None] * vectors[:, lost].T)
