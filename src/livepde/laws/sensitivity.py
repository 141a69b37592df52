"""The second law: a reduced-order filter for the parameters, carried by sensitivities."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from livepde.errors import LawError
from livepde.fem import FieldBlock, Inputs, Moment
from livepde.laws.base import Belief, Law, Problem, Report, Status
from livepde.laws.consistency import Consistency
from livepde.linalg import Array
from livepde.stepping import ForwardStage, Interval, advance

__all__ = ["Replay", "SensitivityLaw", "SensitivityState"]

CONVERGED = 0.5  # standard deviations between reference and estimate at which replays stop


@dataclass(frozen=True)
class Replay:
    """Keep one reference trajectory and replay the stored samples from a better one.

    Each plain update u += L K d leaves a second-order error that a state with long memory never
    forgets. With a replay the filter stays linear about one reference, and whenever the number of
    assimilated samples has doubled, the reference is moved to the estimate and the stored samples
    are run through again, until reference and estimate agree within half a standard deviation: a
    Gauss-Newton iteration. One replay for each doubling makes less than four times the steps in
    all; more than one is needed mostly while the store is short.

    Parameters
    ----------
    window
        At most this many samples are stored. When it is full, the estimate of that moment becomes
        the new start and the store is emptied.
    first
        Number of assimilated samples before the first replay.
    iterations
        At most this many replays for each doubling.
    """

    window: int = 4096
    first: int = 32
    iterations: int = 4

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.window:
            raise LawError("Replay: needs 1 <= first <= window.")
        if self.iterations < 1:
            raise LawError(f"Replay: iterations must be at least 1; got {self.iterations}.")


@dataclass(frozen=True, eq=False)
class Point:
    """A reference (u, q) and the linear filter about it.

    Attributes
    ----------
    u, q
        Reference state and parameter, shapes (n,) and (m,).
    L
        Sensitivity du/da, shape (n, k).
    du, da
        Estimated deviations of u and of the reduced parameter a, shapes (n,) and (k,).
    C
        Square root of the covariance of a, C C^T, shape (k, k).
    consistency
        Statistics of the innovations.
    """

    u: Array
    q: Array
    L: Array
    du: Array
    da: Array
    C: Array
    consistency: Consistency


@dataclass(frozen=True, eq=False)
class Samples:
    """Stored samples since the start of the window, in time order.

    Attributes
    ----------
    t, z, inputs
        Shapes (count + 1,), (count + 1, sensors), (count + 1, channels); first row: the start.
    """

    t: Array
    z: Array
    inputs: Array

    def append(self, t: float, z: Array, inputs: Array) -> Samples:
        """Return the samples with one more."""
        return Samples(
            np.append(self.t, t), np.vstack([self.z, z]), np.vstack([self.inputs, inputs])
        )


@dataclass(frozen=True, eq=False)
class SensitivityState:
    """Now, and for a replay where the window began and what was measured since.

    Attributes
    ----------
    now, start
        The filter now and at the start of the window.
    samples
        What was measured in between; empty without replay.
    assimilated, due
        Samples used since the start of the window, and at how many the next replay is due.
    """

    now: Point
    start: Point
    samples: Samples
    assimilated: int
    due: int


@dataclass(frozen=True, eq=False)
class SensitivityWork:
    """The problem, its forward stage and the reduction q = q_prior + Phi a."""

    problem: Problem
    forward: ForwardStage
    Phi: Array
    noise: Array


@dataclass(frozen=True)
class SensitivityLaw(Law[SensitivityWork, SensitivityState]):
    """State and parameter from sparse, noisy sensors, with a covariance.

    Reduced-order filter of Moireau, Chapelle and Le Tallec (2008); Zhang's adaptive observer;
    recursive prediction error. q = q_prior + Phi a with a ~ N(0, I): Phi is the prior deviation for
    numbers and the leading modes of the prior for fields. With S the Jacobian of a step,

        predict   one implicit step for u;   S L+ = M L/h - A(u+) Phi;   C grows by drift h
        update    d = z - G u+ - D q,  H = G L+ + D Phi:   a += K d,  u += L+ K d

    in square-root form. It costs one step and one block of back-substitutions.

    Bounds of numbers hold for the reference about which the filter is linear, and for what is
    reported; the filter itself stays linear.

    Parameters
    ----------
    modes
        Number of modes for each field: one number, or name -> number.
    noise
        Standard deviation of the measurement noise; default what the observation says.
    drift
        Variance of a gained per unit of time, relative to the prior: > 0 follows parameters that
        change.
    memory
        Time after which old sensitivities have faded to 1/e. Needed with drift: the state forgets
        what old parameters did to it.
    replay
        Iterate about one reference trajectory; for constant parameters and states with a long
        memory. Not together with `memory`.
    """

    modes: int | dict[str, int] = 12
    noise: float | None = None
    drift: float = 0.0
    memory: float = np.inf
    replay: Replay | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.drift) and self.drift >= 0):
            raise LawError(f"SensitivityLaw: drift must be a number >= 0; got {self.drift}.")
        if not self.memory > 0:
            raise LawError(f"SensitivityLaw: memory must be positive; got {self.memory}.")
        if self.replay is not None and np.isfinite(self.memory):
            raise LawError(
                "SensitivityLaw: replay keeps all of the past, memory fades it; choose one."
            )
        if self.noise is not None and not (np.isfinite(self.noise) and self.noise > 0):
            raise LawError(f"SensitivityLaw: noise must be a positive number; got {self.noise}.")

    def prepare(self, problem: Problem) -> SensitivityWork:
        observed = problem.observed
        noise = observed.noise
        if self.noise is not None:
            noise = np.full(observed.size, self.noise)
        if noise is None:
            raise LawError(
                "SensitivityLaw needs the noise level of the sensors: give noise= to the "
                "observation (one number, or one for each sensor) or to the law."
            )
        return SensitivityWork(problem, ForwardStage(problem.model), self._modes(problem), noise)

    def _modes(self, problem: Problem) -> Array:
        model = problem.model
        space = model.parameter_space
        counts = (
            self.modes if isinstance(self.modes, dict) else dict.fromkeys(space.fields, self.modes)
        )
        if set(counts) != set(space.fields):
            raise LawError(
                f"SensitivityLaw: modes names {sorted(counts)}; the fields are "
                f"{sorted(space.fields)}."
            )
        columns = []
        for name, block in space.blocks.items():
            part = space.part(name)
            if isinstance(block, FieldBlock):
                mass = model.parameter_mass[part, part]
                inner = model.Q.restricted(part, block.fixed)
                phi, _ = inner.modes(min(counts[name], int(inner.free.sum())), mass)
            else:
                phi = np.diag(1.0 / np.sqrt(model.Q.augmented[part, part].diagonal()))
            whole = np.zeros((space.dim, phi.shape[1]))
            whole[part] = phi
            columns.append(whole)
        return np.hstack(columns)

    def init(self, work: SensitivityWork, q0: Array, u0: Array) -> SensitivityState:
        n, k = len(u0), work.Phi.shape[1]
        sensors, channels = work.problem.observed.size, work.problem.channels
        start = Point(
            u0,
            q0,
            np.zeros((n, k)),
            np.zeros(n),
            np.zeros(k),
            np.eye(k),
            Consistency.start(sensors),
        )
        empty = Samples(np.zeros(0), np.zeros((0, sensors)), np.zeros((0, len(channels))))
        due = self.replay.first if self.replay else 0
        return SensitivityState(start, start, empty, 0, due)

    def step(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        point, report = self._filter(work, state.now, interval)
        if not report.status.ok:
            return state, report
        if self.replay is None:
            return replace(state, now=_recentre(work, point)), report
        state = self._store(work, state, point, interval)
        if state.assimilated >= state.due:
            for _ in range(self.replay.iterations):
                replayed, status = self._replayed(work, state)
                state = replace(state, now=replayed, due=2 * state.assimilated)
                if not status.ok:  # keep the linear estimate, say so, and try again when doubled
                    report = replace(report, notes={**report.notes, "replay_failed": 1.0})
                if not status.ok or _converged(work, replayed):
                    break
        if len(state.samples.t) > self.replay.window:
            start = _recentre(work, state.now)
            empty = Samples(state.samples.t[:0], state.samples.z[:0], state.samples.inputs[:0])
            state = SensitivityState(start, start, empty, 0, self.replay.first)
        return state, report

    def _store(
        self, work: SensitivityWork, state: SensitivityState, now: Point, interval: Interval
    ) -> SensitivityState:
        channels = work.problem.channels
        samples = state.samples
        if not len(samples.t):
            first = np.array([interval.inputs0[c] for c in channels])
            samples = samples.append(interval.t0, interval.z0, first)
        values = np.array([interval.inputs1[c] for c in channels])
        samples = samples.append(interval.t1, interval.z1, values)
        used = state.assimilated + bool(interval.present.any())
        return replace(state, now=now, samples=samples, assimilated=used)

    def _replayed(self, work: SensitivityWork, state: SensitivityState) -> tuple[Point, Status]:
        """Run the stored samples again about the reference q_ref = the estimate now."""
        start, samples = state.start, state.samples
        q = _bounded(work, state.now.q + work.Phi @ state.now.da)
        shift = _reduced(work, q - start.q)
        point = replace(
            start,
            q=q,
            u=start.u + start.L @ shift,
            du=start.du - start.L @ shift,
            da=start.da - shift,
        )
        channels = work.problem.channels
        named = [dict(zip(channels, row, strict=True)) for row in samples.inputs]
        for k in range(1, len(samples.t)):
            interval = Interval(
                samples.t[k - 1],
                samples.t[k],
                Inputs(named[k - 1]),
                Inputs(named[k]),
                samples.z[k - 1],
                samples.z[k],
            )
            point, report = self._filter(work, point, interval)
            if not report.status.ok:
                return state.now, report.status
        return point, Status()

    def _filter(
        self, work: SensitivityWork, point: Point, interval: Interval
    ) -> tuple[Point, Report]:
        """Predict over an interval and update at its end, linear about the reference."""
        model, observed = work.problem.model, work.problem.observed
        k = work.Phi.shape[1]
        direction = np.column_stack([work.Phi, work.Phi @ point.da])
        columns = [point.u, point.L, point.du]

        def stage(c: Array, t: float, h: float) -> Array:
            moment = interval.at(t)
            u = work.forward.solve(c[:, 0], point.q, h, moment)
            factor = work.forward.tangent(u, point.q, h, moment)
            forcing = model.form_A.product("v", "q", direction, moment, u=u)
            rhs = (model.mass @ c[:, 1:]) / h - forcing
            return np.column_stack([u, factor.solve(rhs * model.X.free[:, None])])

        y, steps, failure = advance(work.problem.control, stage, np.column_stack(columns), interval)
        here = observed.predict(point.u + point.du, point.q + work.Phi @ point.da, interval.end)
        if failure is not None:
            return point, Report(Status.of(failure), here)
        if not np.isfinite(y).all():
            return point, Report(Status("not_finite", "the prediction is not finite"), here)
        h = interval.t1 - interval.t0
        fade = np.exp(-h / self.memory)
        u, L = y[:, 0], fade * y[:, 1 : 1 + k]
        du = y[:, 1 + k]
        C = point.C
        if self.drift:
            C = _square_root(np.vstack([C.T, np.sqrt(self.drift * h) * np.eye(k)]))
        predicted = observed.predict(u + du, point.q + work.Phi @ point.da, interval.end)
        moved = replace(point, u=u, L=L, du=du, C=C)
        new = self._update(work, moved, interval, predicted)
        if not np.isfinite(new.da).all():
            return point, Report(Status("not_finite", "the update is not finite"), here)
        notes = {
            "innovation_ratio": new.consistency.ratio,
            "innovation_correlation": new.consistency.correlation,
        }
        return new, Report(Status(), predicted, steps, notes)

    def _update(
        self, work: SensitivityWork, point: Point, interval: Interval, predicted: Array
    ) -> Point:
        seen = work.problem.observed.available(interval.end)
        present = np.logical_and(interval.present, seen)
        if not present.any():
            return point
        noise = work.noise[present]
        H = _output(work, point, interval.end)[present]
        d = (interval.z1 - predicted)[present]
        HC = (H @ point.C) / noise[:, None]
        expected = noise * np.sqrt(1.0 + (HC**2).sum(axis=1))
        e = np.full(len(present), np.nan)
        e[present] = d / expected
        # C+ C+^T = C (I + HC^T HC)^-1 C^T from a QR factorisation of [I; HC].
        root: Array = np.asarray(np.linalg.qr(np.vstack([np.eye(len(point.da)), HC]), mode="r"))
        # SciPy's triangular solve would start threads for this small matrix; this one does not.
        C: Array = np.asarray(np.linalg.solve(root.T, point.C.T).T, dtype=float)
        step = C @ (C.T @ (H.T @ (d / noise**2)))
        return replace(
            point,
            da=point.da + step,
            du=point.du + point.L @ step,
            C=C,
            consistency=point.consistency.add(e),
        )

    def belief(self, work: SensitivityWork, state: SensitivityState) -> Belief:
        now = state.now
        return Belief(
            _bounded(work, now.q + work.Phi @ now.da),
            now.u + now.du,
            work.Phi @ now.C,
            now.L @ now.C,
            now.consistency.inflation,
        )


def _output(work: SensitivityWork, point: Point, moment: Moment) -> Array:
    """Return H = G'(u) L + D Phi, the derivative of the prediction in a."""
    u, q = point.u + point.du, point.q + work.Phi @ point.da
    H_u, H_q = work.problem.observed.jacobian(u, q, moment)
    H: Array = H_u @ point.L
    return H if H_q is None else H + H_q @ work.Phi


def _reduced(work: SensitivityWork, dq: Array) -> Array:
    """Return a with Phi a = dq: the columns of Phi are orthonormal in Q."""
    a: Array = work.Phi.T @ work.problem.model.Q.dual(dq)
    return a


def _bounded(work: SensitivityWork, q: Array) -> Array:
    lower, upper = work.problem.model.parameter_space.bounds
    return np.clip(q, lower, upper)


def _converged(work: SensitivityWork, point: Point) -> bool:
    """Return true if the estimate is within half a standard deviation of the reference."""
    shift = _bounded(work, point.q + work.Phi @ point.da) - point.q
    deviations = np.linalg.solve(point.C, _reduced(work, shift))
    return bool(np.linalg.norm(deviations) <= CONVERGED * point.consistency.inflation)


def _recentre(work: SensitivityWork, point: Point) -> Point:
    """Move the reference to the estimate, within the bounds.

    Bounds hold for references and for what is reported, not for the linear filter: what lies
    beyond them stays in da and du, so that nothing the data said is lost.
    """
    shift = _reduced(work, _bounded(work, point.q + work.Phi @ point.da) - point.q)
    beyond = point.L @ (point.da - shift)
    return replace(
        point,
        u=point.u + point.du - beyond,
        q=point.q + work.Phi @ shift,
        du=beyond,
        da=point.da - shift,
    )


def _square_root(rows: Array) -> Array:
    """Return C with C C^T = rows^T rows."""
    root: Any = np.linalg.qr(rows, mode="r")
    lower: Array = root.T
    return lower
