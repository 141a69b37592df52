"""Fixed-interval smoother: state and unknowns at each sample, given all samples.

The filter represents x = m + [U C]^T xi with xi ~ N(0, I). Between two samples, rotations,
truncations and the contraction of the update map xi and the process noise to xi'. Therefore xi and
xi' are jointly Gaussian:

    xi = g + T^T xi' + R^T zeta,    T = E[xi' xi^T | z'],  g = E[xi | z'],  R^T R = I - P^T P.

Here P is T before the update, and zeta ~ N(0, I) is the part that the truncation drops.
`FilterState.past` and `dpast` propagate xi through predict and update: T and g are the images of I
and 0. Given all samples, xi ~ N(mu, B^T B) with one coordinate for each row. This follows backwards
in time from mu = 0 and B = I at the end (Rauch, Tung and Striebel 1965):

    mu = g + T^T mu',    B = upper triangle of a QR factorisation of [B' T; R]

The smoother is linear about one trajectory of the unknowns. The trajectory starts as the estimates
of the run, or as the last estimate of constant unknowns. Damped Gauss-Newton steps, which increase
the joint probability of samples and prior (Bell 1994), move it to the smoothed trajectory. They end
when the change is less than a tenth of a standard deviation.
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

ITERATIONS = 6  # largest number of Gauss-Newton steps
HALVINGS = 2  # largest number of halvings of a step that makes samples and prior less probable
CONVERGED = 0.1  # standard deviations: convergence at a step of this size
STRIDE = 2.0  # largest step of an unknown, in prior standard deviations
ROUNDING = 1e-12  # share of a variance


@dataclass(frozen=True, eq=False)
class _Point:
    """A filter after a sample, with g and T as `dpast` and `past`, and R, since the last sample."""

    x: FilterState
    R: Array


@dataclass(frozen=True, eq=False)
class _SmootherPass:
    """Filters about a trajectory of reduced unknowns, shape (1 + intervals, k).

    `misfit` is minus twice the log probability of the trajectory, up to a constant. `decisions` are
    the gate's decisions on the samples, beginning with the sample at the start.
    """

    trajectory: Array
    points: list[_Point]
    misfit: float
    decisions: list[GateDecision]

    @property
    def refuses(self) -> bool:
        return any(np.count_nonzero(decision.refused) for decision in self.decisions)


def smoothed(
    work: SensitivityWork,
    before: SensitivityState,
    after: FilterState,
    data: FixedInterval,
    used: Mask | None = None,
) -> Iterator[FilterState]:
    """Iterate over the smoothed filters of one member, backwards in time.

    States at times that are not in `data.fields` have no coefficients.

    `before`: the member before the first sample. `after`: its filter after the last sample in the
    run, whose noise level and innovation statistics are used. `used`: readings of the last samples
    that a refit used, (samples, sensors); None without a refit.
    """
    with nonfinite_allowed():  # passes with nonfinite results are not used
        best = _descended(*_first_pass(work, before, after, data, used))
    return _backward(best, after)


def _first_pass(
    work: SensitivityWork,
    before: SensitivityState,
    after: FilterState,
    data: FixedInterval,
    used: Mask | None,
) -> tuple[_FixedInterval, _SmootherPass | None]:
    """Return the samples with the gate's decisions, and a first pass or None if all fail.

    Each pass uses the same readings as the run, or as its refit if there is one. The discretisation
    errors widen the gate of the run, so that it uses any reading used without them. They triple the
    cost, and are computed only if the gate refuses a reading.
    """
    start, initial = unjudged(work.at_level(before.now, after)), bool(before.initial[0])
    work = replace(work.unjudged, options=replace(work.options, adaptive=False))
    whole = _FixedInterval(work, start, initial, after, data)
    bare = _FixedInterval(work.unaccompanied, unaccompanied(start), initial, after, data)
    best = bare.about(bare.estimated)
    if best is None or best.refuses:
        # Try moving unknowns about each successive estimate first, constants about one trajectory.
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
    """Return the gate's decisions, with a refit's decisions on the last samples."""
    first = len(decisions) - len(used)
    fitted = decisions[:first]
    for decision, kept, sample in zip(
        decisions[first:], used, [data.opening, *data.intervals][first:], strict=True
    ):
        refused = (np.isfinite(sample.z1) & ~kept)[None]
        fitted.append(GateDecision(refused, decision.anchored & refused))
    equal = all((a.refused == b.refused).all() for a, b in zip(fitted, decisions, strict=True))
    return decisions if equal else fitted


def _descended(samples: _FixedInterval, best: _SmootherPass | None) -> _SmootherPass:
    if best is None:
        raise LawError(
            "smoothed: the samples cannot be followed about any trajectory of the unknowns; take a "
            "smaller dt_max, or a prior closer to what the run found."
        )
    for _ in range(ITERATIONS):
        # A list of the filters at all samples, with their states, may need too much memory.
        moments = [
            (_reduced(samples.work, x, x.da), np.linalg.norm(x.C[0], axis=0))
            for x in _backward(best, best.points[-1].x)
        ]
        target, std = map(np.array, zip(*reversed(moments), strict=True))
        step = target - best.trajectory
        if (np.abs(step) <= CONVERGED * std + ROUNDING).all():
            break
        step *= min(1.0, STRIDE / float(np.abs(step).max()))
        tried = (samples.about(best.trajectory + 0.5**k * step) for k in range(HALVINGS + 1))
        better = next((trial for trial in tried if trial and trial.misfit < best.misfit), None)
        if better is None:
            break
        best = better
    return best


def _backward(best: _SmootherPass, after: FilterState) -> Iterator[FilterState]:
    """Iterate backwards over the filters given all samples.

    The innovation statistics, and the shift of the unknowns by discretisation errors, are taken
    from the end of the run. The shift of the state is known at the end only.
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
        # A square root is unique up to rotations of its rows: the triangle suffices.
        B = np.asarray(np.linalg.qr(np.vstack([B @ T, point.R]), mode="r"))


def _reduced(work: SensitivityWork, x: FilterState, da: Array | float = 0.0) -> Array:
    """Return the reduced unknowns of a linearisation point plus a difference da, shape (k,)."""
    reduction = work.filter.reduction
    return np.asarray((reduction.reduced(x.q - work.filter.problem.model.latent.prior) + da)[0])


@dataclass(frozen=True, eq=False)
class _FixedInterval:
    """The samples of one member, to be filtered about trajectories of its unknowns."""

    work: SensitivityWork
    start: FilterState
    initial: bool  # True if the start is the initial state of the model (`Model.initial`)
    after: FilterState
    data: FixedInterval
    # Decisions of the gate, beginning with the sample at the start; None: the gate decides.
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
        x, outcome = absorb(self.work.filter, x, span, options)
        none = np.zeros_like(outcome.refused)
        anchored = none if outcome.anchored is None else outcome.anchored
        return x, GateDecision(outcome.refused, anchored)

    @property
    def estimated(self) -> Array:
        """Trajectory of the run's estimates; constant coordinates follow from the last estimate."""
        reduction, none = self.work.filter.reduction, np.zeros((1, self.work.filter.reduction.size))
        prior = self.work.filter.problem.model.latent.prior
        a = np.atleast_2d(reduction.reduced(np.array(self.data.q) - prior))
        for number, interval in reversed(list(enumerate(self.data.intervals))):
            h = interval.t1 - interval.t0
            back = np.linalg.solve(reduction.transition(h), a[number + 1])
            a[number] = np.where(self._gained(none, number, h) > 0.0, a[number], back)
        return a

    def about(self, trajectory: Array | None) -> _SmootherPass | None:
        """Filter the samples about a trajectory, or about each estimate; None if a step fails."""
        x, misfit, decision = self._started(trajectory)
        rows = x.C.shape[1]
        first = changed(x, past=np.eye(rows)[None], dpast=np.zeros((1, rows)))
        points = [self._point(first, 0, np.zeros((0, rows)))]
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
            points.append(self._point(x, number, _truncation(P)))
            followed.append(_reduced(self.work, x))
            misfit += missed(filter_, x, interval)
            misfit += moved(filter_, followed[-2], followed[-1], h, gained) if self.moves else 0.0
        if trajectory is None or not np.isfinite(misfit):
            misfit = np.inf  # a pass about successive estimates has no single trajectory
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
        # The probability density of a shift with coordinates xi is proportional to exp(-|xi|^2/2).
        weights = coordinates(start.C[0], shift)
        misfit = float(weights @ weights)
        span = filter_.span(filter_.problem.unread(opening))
        predicted, Y = filter_.sensors.observe(x, span.end)
        none = np.zeros(predicted.shape, dtype=bool)
        decision = GateDecision(none, none)
        if filter_.learns(Y):  # the rule of `SensitivityLaw.begin`
            misfit += missed(filter_, x, opening)
            x, decision = self._absorbed(x, span, 0)
        return x, misfit, decision

    def _gained(self, variance: Array, number: int, h: float) -> Array:
        """Return the variance that coordinates gain in an interval, with its jumps, shape (k,)."""
        filter_, jumps = self.work.filter, self.work.jumps
        drifts = filter_.drifts(self.after.member)
        gained = filter_.reduction.gained(h, variance, drifts)[0]
        if jumps is not None and number in self.data.jumps:
            # The jump is at the start of the interval, and is propagated to its end.
            F = filter_.reduction.transition(h)
            size = jumps.part(self.data.jumps[number])
            gained = gained + size**2 * (F**2 @ self.work.jumping)
        return np.asarray(gained)

    def _predicted(self, x: FilterState, number: int) -> tuple[FilterState, Array | None]:
        """Return the filter before the update at the end of an interval, and P."""
        filter_, jumps, rows = self.work.filter, self.work.jumps, x.C.shape[1]
        x = changed(x, past=np.eye(rows)[None], dpast=np.zeros((1, rows)))
        if jumps is not None and number in self.data.jumps:
            size = jumps.part(self.data.jumps[number])
            x = filter_.inflated(x, size, self.work.jumping)
        span = filter_.span(self.data.intervals[number])
        x, _, failure = filter_.predict(x, span)
        return x, x.past[0] if failure is None else None

    def _point(self, x: FilterState, number: int, R: Array) -> _Point:
        """Return the point of a sample, with the state only if it is in `data.fields`."""
        x = changed(unaccompanied(x), kept=KeptFactors.none(1))
        if number not in self.data.fields:
            x = changed(x, u=x.u[:, :0], du=x.du[:, :0], U=x.U[:, :, :0])
        return _Point(x, R)


def _truncation(P: Array) -> Array:
    """Return R with R^T R = I - P^T P."""
    values, vectors = np.linalg.eigh(np.eye(P.shape[1]) - P.T @ P)
    lost = values > ROUNDING
    return np.asarray(np.sqrt(values[lost])[:, None] * vectors[:, lost].T)
