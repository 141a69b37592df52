"""The second law: a reduced-order filter for the parameters, carried by sensitivities."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from livepde.errors import LawError
from livepde.fem import Evolution, FieldBlock, Inputs, Moment, RandomWalk
from livepde.laws.base import Belief, Law, Problem, Report, Status
from livepde.laws.consistency import Consistency
from livepde.laws.jumps import Jumps, Watch
from livepde.laws.level import NoiseLevel
from livepde.linalg import Array
from livepde.stepping import ForwardStage, Interval, StepFailed, advance

__all__ = ["Replay", "SensitivityLaw", "SensitivityState"]

CONVERGED = 0.5  # standard deviations between reference and estimate at which replays stop
FIRST = 20  # Gauss-Newton steps of a first sample that a nonlinear initial state takes at most
STRIDE = 1.0  # prior deviations that a replay moves its reference at most: a trust region


@dataclass(frozen=True)
class Replay:
    """Keep one reference trajectory and replay the stored samples from a better one.

    Each plain update u += L K d leaves a second-order error that a state with long memory never
    forgets. With a replay the filter stays linear about one reference, and whenever the number of
    assimilated samples has doubled, the reference is moved to the estimate and the stored samples
    are run through again, until reference and estimate agree within half a standard deviation: a
    Gauss-Newton iteration, whose steps are at most one prior deviation long. One replay for each
    doubling makes less than four times the steps in all; more than one is needed mostly while the
    store is short.

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
    du, da
        Estimated deviations of u and of the reduced parameter a, shapes (n,) and (k,).
    U, C
        Square root of the joint covariance of u and a, [U; C] [U; C]^T, shapes (n, r) and (k, r).
        As long as nothing moves, r = k and U = L C with the sensitivity L = du/da.
    consistency
        Statistics of the innovations.
    refused
        How many values in a row of each sensor the gate has refused, shape (sensors,).
    level
        Estimated noise as a multiple of the stated one; 1 unless the law finds it.
    evidence
        Logarithm of the likelihood of all samples so far, each given those before.
    """

    u: Array
    q: Array
    du: Array
    da: Array
    U: Array = field(metadata={"grows": 1})
    C: Array = field(metadata={"grows": 1})
    consistency: Consistency
    refused: Array
    level: NoiseLevel
    evidence: float


@dataclass(frozen=True, eq=False)
class Samples:
    """Stored samples since the start of the window, in time order.

    Attributes
    ----------
    t, z, inputs
        Shapes (count + 1,), (count + 1, sensors), (count + 1, channels); first row: the start,
        with what was assimilated there.
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
    initial
        True while the window begins with the initial state that the model says (`Model.initial`).
    reference
        Latent parameter at the start of the window from which the reference of `now` comes.
    watch
        Innovations of the last samples, for `Jumps`.
    """

    now: Point
    start: Point
    samples: Samples
    assimilated: int
    due: int
    initial: bool
    reference: Array
    watch: Watch

    @property
    def span(self) -> float:
        """Time since the start of the window."""
        return float(self.samples.t[-1] - self.samples.t[0]) if len(self.samples.t) else 0.0


@dataclass(frozen=True, eq=False)
class Motion:
    """How one unknown moves by itself, in reduced coordinates.

    Attributes
    ----------
    part
        Where its reduced coordinates stand: copies times modes.
    evolution, std
        Its model, and the prior deviation of its latent coefficients.
    """

    part: slice
    evolution: Evolution
    std: float

    def transition(self, h: float) -> Array:
        """Return the transition of its coordinates in a time h."""
        F = self.evolution.transition(h)
        return np.asarray(np.kron(F, np.eye((self.part.stop - self.part.start) // len(F))))

    def growth(self, h: float) -> Array:
        """Return the variance its coordinates gain in a time h."""
        gained = self.evolution.growth(h, self.std)
        return np.repeat(gained, (self.part.stop - self.part.start) // len(gained))

    def backward(self, h: float) -> Array:
        """Return what the coordinates are expected to have been a time h before: matrix on them."""
        F = self.transition(h)
        return np.asarray(np.linalg.solve(F @ F.T + np.diag(self.growth(h)), F).T)


@dataclass(frozen=True, eq=False)
class SensitivityWork:
    """The problem, its forward stage and the reduction a_latent = prior + Phi a.

    `scale` weighs the coefficients of the state when a factor is compressed: the square root of the
    mass of each.
    """

    problem: Problem
    forward: ForwardStage
    Phi: Array
    motions: tuple[Motion, ...]
    noise: Array
    scale: Array
    rank: int

    @cached_property
    def moves(self) -> bool:
        """True if an unknown moves by itself."""
        return any(motion.evolution.moves for motion in self.motions)

    def transition(self, h: float) -> Array:
        """Return the transition of all reduced coordinates in a time h, shape (k, k)."""
        return np.asarray(block_diag(*(motion.transition(h) for motion in self.motions)))

    def moved(self, point: Point, h: float) -> Point:
        """Return a point whose unknowns have moved for a time h; those of its state have not.

        What they gain is in new columns of the factor, in the same order for every h.
        """
        if not self.moves or h == 0.0:
            return point
        F = self.transition(h)
        gained = np.sqrt(np.concatenate([motion.growth(h) for motion in self.motions]))
        new = np.diag(gained)[:, gained > 0.0]
        q = self.problem.model.latent.moved(point.q, h)
        U = np.hstack([point.U, np.zeros((len(point.u), new.shape[1]))])
        return replace(point, q=q, da=F @ point.da, U=U, C=np.hstack([F @ point.C, new]))

    def traced(self, q: Array, start: Array, h: float) -> Array:
        """Return the latent parameter that is expected to have become q in a time h.

        Parameters
        ----------
        start
            One at that time; what no mode sees is taken from it.
        """
        if not self.moves:
            return q
        prior = self.problem.model.latent.prior
        back = block_diag(*(motion.backward(h) for motion in self.motions))
        return start + self.Phi @ (back @ self.reduced(q - prior) - self.reduced(start - prior))

    def directions(self, point: Point) -> Array:
        """Return the columns of the factor and da in latent coefficients, shape (m, r + 1)."""
        directions: Array = self.Phi @ np.column_stack([point.C, point.da])
        return directions

    def latent(self, point: Point) -> Array:
        """Return the estimated latent parameter, not yet bounded."""
        q: Array = point.q + self.Phi @ point.da
        return q

    def predict(self, point: Point, moment: Moment) -> Array:
        """Return what the sensors are expected to show."""
        return self.problem.predict(point.u + point.du, self.latent(point), moment)

    def output(self, point: Point, moment: Moment) -> Array:
        """Return the derivative of the prediction along the columns of the factor, H [U; C]."""
        problem, latent = self.problem, self.problem.model.latent
        a = self.latent(point)
        H_u, H_q = problem.observed.jacobian(point.u + point.du, latent.value(a), moment)
        HC: Array = H_u @ point.U
        return HC if H_q is None else HC + H_q @ latent.tangent(a, self.Phi @ point.C)

    def reduced(self, dq: Array) -> Array:
        """Return a with Phi a = dq: the columns of Phi are orthonormal in Q."""
        a: Array = self.Phi.T @ self.problem.model.Q.dual(dq)
        return a

    def bounded(self, q: Array) -> Array:
        """Return the latent parameter within its bounds."""
        lower, upper = self.problem.model.latent.bounds
        return np.clip(q, lower, upper)


@dataclass(frozen=True)
class SensitivityLaw(Law[SensitivityWork, SensitivityState]):
    """State and parameter from sparse, noisy sensors, with a covariance.

    Reduced-order filter of Moireau, Chapelle and Le Tallec (2008); Zhang's adaptive observer;
    recursive prediction error. q = q_prior + Phi a with a ~ N(0, I): Phi is the prior deviation for
    numbers and the leading modes of the prior for fields. The joint covariance of u and a has the
    square root [U; C]. With S the Jacobian of a step and A the derivative of A(u) q in q,

        predict   one implicit step for u;   S U+ = M U/h - A(u+) Phi C
        update    d = z - G u+ - D q,  Y = G U+ + D Phi C:   a += C K d,  u += U+ K d,
                  K = (I + Y^T N^-1 Y)^-1 Y^T N^-1,  [U; C] times the square root of (I + ...)^-1

    It costs one step and one block of back-substitutions. For unknowns that stay as they are U is
    L C with the sensitivity L = du/da. One that moves (`evolution`, or `drift` for all) adds new
    columns at each substep, independent of what the state remembers of older values; the factor is
    then compressed to `rank` columns, so that nothing has to be forgotten by hand.

    Bounds of numbers hold for the reference about which the filter is linear, and for what is
    reported; the filter itself stays linear.

    Parameters
    ----------
    modes
        Number of modes for each field: one number, or name -> number.
    noise
        Standard deviation of the measurement noise; default what the observation says. "auto": what
        the observation says is a first guess, and the level is found from the samples, the same
        multiple for all sensors.
    drift
        Variance of a gained per unit of time, relative to the prior, by every unknown without an
        evolution of its own: > 0 follows parameters that change.
    memory
        Time after which what the state knows of the parameters has faded to 1/e.
    replay
        Iterate about one reference trajectory; for states with a long memory. Not together with
        `memory`.
    rank
        Columns of the factor while unknowns move; default the number of coordinates and five times
        that of those that move.
    gate
        Innovations of more than this many expected deviations are not used; default all are.
    gate_patience
        After so many refusals in a row a sensor is believed again: something has really changed.
    jumps
        Test for sudden changes; an alarm is noted as "jump" and lets the unknowns move.
    """

    modes: int | dict[str, int] = 12
    noise: float | str | None = None
    drift: float = 0.0
    memory: float = np.inf
    replay: Replay | None = None
    rank: int | None = None
    gate: float = np.inf
    gate_patience: int = 10
    jumps: Jumps | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.drift) and self.drift >= 0):
            raise LawError(f"SensitivityLaw: drift must be a number >= 0; got {self.drift}.")
        if not self.memory > 0:
            raise LawError(f"SensitivityLaw: memory must be positive; got {self.memory}.")
        if self.replay is not None and np.isfinite(self.memory):
            raise LawError(
                "SensitivityLaw: replay keeps all of the past, memory fades it; choose one."
            )
        number = isinstance(self.noise, int | float) and np.isfinite(self.noise) and self.noise > 0
        if not (self.noise in (None, "auto") or number):
            raise LawError(
                f"SensitivityLaw: noise must be a positive number or 'auto'; got {self.noise!r}."
            )
        if not self.gate > 0:
            raise LawError(f"SensitivityLaw: gate must be positive; got {self.gate}.")
        if self.gate_patience < 1:
            raise LawError(f"SensitivityLaw: gate_patience must be >= 1; got {self.gate_patience}.")

    def prepare(self, problem: Problem) -> SensitivityWork:
        observed, model = problem.observed, problem.model
        noise = observed.noise
        if isinstance(self.noise, int | float):
            noise = np.full(observed.size, float(self.noise))
        if noise is None:
            raise LawError(
                "SensitivityLaw needs the noise level of the sensors: give noise= to the "
                "observation (one number, or one for each sensor) or to the law."
            )
        Phi, motions = self._modes(problem)
        moving = sum(m.part.stop - m.part.start for m in motions if m.growth(1.0).any())
        moving = Phi.shape[1] if self.jumps is not None else moving
        rank = self.rank if self.rank is not None else Phi.shape[1] + 5 * moving
        if rank < Phi.shape[1]:
            raise LawError(
                f"SensitivityLaw: rank must be at least the {Phi.shape[1]} reduced coordinates; "
                f"got {rank}."
            )
        mass = np.maximum(model.mass.diagonal(), 0.0)
        scale = np.sqrt(mass / mass.sum())
        forward = ForwardStage(model)
        return SensitivityWork(problem, forward, Phi, motions, noise, scale, rank)

    def _modes(self, problem: Problem) -> tuple[Array, tuple[Motion, ...]]:
        """Return Phi, shape (m, k), and how its coordinates move."""
        model = problem.model
        fields = model.parameter_space.fields
        counts = self.modes if isinstance(self.modes, dict) else dict.fromkeys(fields, self.modes)
        if set(counts) != set(fields):
            raise LawError(
                f"SensitivityLaw: modes names {sorted(counts)}; the fields are {sorted(fields)}."
            )
        blocks, motions, start = [], [], 0
        for name, item in model.latent.parts.items():
            first = slice(item.part.start, item.part.start + item.size)
            if isinstance(item.block, FieldBlock):
                part = model.parameter_space.part(name)
                inner = model.Q.restricted(first, item.block.fixed)
                count = min(counts[name], int(inner.free.sum()))
                phi, _ = inner.modes(count, model.parameter_mass[part, part])
            else:
                phi = np.eye(item.size) * item.unknown.latent_std
            evolution = item.evolution
            if self.drift and not evolution.moves:
                evolution = RandomWalk(np.sqrt(self.drift) * item.unknown.latent_std)
            blocks.append(np.kron(np.eye(evolution.copies), phi))
            stop = start + blocks[-1].shape[1]
            motions.append(Motion(slice(start, stop), evolution, item.unknown.latent_std))
            start = stop
        Phi: Array = np.asarray(block_diag(*blocks))
        return Phi, tuple(motions)

    def init(self, work: SensitivityWork, q0: Array, u0: Array) -> SensitivityState:
        k = work.Phi.shape[1]
        sensors, channels = work.problem.observed.size, work.problem.channels
        start = Point(
            u0,
            q0,
            np.zeros(len(u0)),
            np.zeros(k),
            np.zeros((len(u0), k)),
            np.eye(k),
            Consistency.start(sensors),
            np.zeros(sensors, dtype=np.int64),
            NoiseLevel(),
            0.0,
        )
        empty = Samples(np.zeros(0), np.zeros((0, sensors)), np.zeros((0, len(channels))))
        due = self.replay.first if self.replay else 0
        watch = (self.jumps or Jumps()).start()
        return SensitivityState(start, start, empty, 0, due, False, q0, watch)

    def start(
        self, work: SensitivityWork, q0: Array, u0: Array, moment: Moment
    ) -> SensitivityState:
        state, model = self.init(work, q0, u0), work.problem.model
        if model.form_initial is None:
            return state
        point = replace(state.start, U=model.initial_directions(q0, work.Phi, moment))
        return replace(state, start=point, now=point, initial=True)

    def begin(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> SensitivityState:
        point = state.now
        # A state that is known, seen by sensors that see no unknown, has nothing to learn.
        if not work.output(point, interval.end).any():
            return state
        form, begun = work.problem.model.form_initial, state
        for _ in range(FIRST):
            new, _ = self._update(work, point, interval, work.predict(point, interval.end))
            if not np.isfinite(new.da).all():
                return state
            begun = replace(state, now=new, reference=point.q)
            if form is None or form.linear_in_parameter or _left(work, begun) <= CONVERGED:
                break
            point = _placed(work, state, _next(work, begun), interval.end)
        if self.replay is None:
            return replace(begun, now=_recentre(work, new))
        return self._store(work, begun, new, interval)

    def step(
        self, work: SensitivityWork, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        point, report = self._filter(work, state.now, interval)
        if not report.status.ok:
            return state, report
        state, point, report, alarm = self._watched(work, state, point, report)
        if self.replay is None:
            return replace(state, now=_recentre(work, point)), report
        if alarm:  # what was measured before does not belong to the unknowns of now
            return self._renewed(_recentre(work, point), state), report
        state = self._store(work, state, point, interval)
        if state.assimilated >= state.due:
            for _ in range(self.replay.iterations):
                state, status = self._replayed(work, state)
                state = replace(state, due=2 * state.assimilated)
                left = _left(work, state)
                notes = {**report.notes, "replay_left": left}
                if not status.ok:  # keep the linear estimate, say so, and try again when doubled
                    notes["replay_failed"] = 1.0
                report = replace(report, notes=notes)
                if not status.ok or left <= CONVERGED:
                    break
        if len(state.samples.t) > self.replay.window:
            state = self._renewed(_recentre(work, state.now), state)
        return state, report

    def _renewed(self, start: Point, state: SensitivityState) -> SensitivityState:
        """Return a state whose window begins here."""
        empty = Samples(state.samples.t[:0], state.samples.z[:0], state.samples.inputs[:0])
        first = self.replay.first if self.replay else 0
        return SensitivityState(start, start, empty, 0, first, False, start.q, state.watch)

    def _watched(
        self, work: SensitivityWork, state: SensitivityState, point: Point, report: Report
    ) -> tuple[SensitivityState, Point, Report, bool]:
        """Return state, filter and report after the test for a jump, and whether there is one."""
        if self.jumps is None:
            return state, point, report, False
        usual = state.now.consistency
        watch, alarm = self.jumps.add(state.watch, point.consistency.newest, usual)
        report = replace(report, notes={**report.notes, "jump": float(alarm)})
        if alarm:
            point = _loosened(work, point, self.jumps.size)
        return replace(state, watch=watch), point, report, alarm

    def _store(
        self, work: SensitivityWork, state: SensitivityState, now: Point, interval: Interval
    ) -> SensitivityState:
        channels = work.problem.channels
        samples = state.samples
        if not len(samples.t) and interval.t1 > interval.t0:
            first = np.array([interval.inputs0[c] for c in channels])
            samples = samples.append(interval.t0, np.full_like(interval.z1, np.nan), first)
        values = np.array([interval.inputs1[c] for c in channels])
        samples = samples.append(interval.t1, interval.z1, values)
        used = state.assimilated + bool(interval.present.any())
        return replace(state, now=now, samples=samples, assimilated=used)

    def _replayed(
        self, work: SensitivityWork, state: SensitivityState
    ) -> tuple[SensitivityState, Status]:
        """Run the stored samples again about a reference at the estimate, or on the way to it."""
        samples, q = state.samples, _next(work, state)
        channels = work.problem.channels
        named = [dict(zip(channels, row, strict=True)) for row in samples.inputs]
        first = Moment(samples.t[0], Inputs(named[0]))
        point = _placed(work, state, q, first)
        if np.isfinite(samples.z[0]).any():
            z = samples.z[0]
            at = Interval(first.t, first.t, first.inputs, first.inputs, z, z)
            point, _ = self._update(work, point, at, work.predict(point, first))
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
                return state, report.status
        return replace(state, now=point, reference=q), Status()

    def _filter(
        self, work: SensitivityWork, point: Point, interval: Interval
    ) -> tuple[Point, Report]:
        """Predict over an interval and update at its end, linear about the reference."""

        def failed(status: Status) -> tuple[Point, Report]:
            return point, Report(status, work.predict(point, interval.end))

        # What unknowns gain in one substep is independent of what they gain in the next.
        count = work.problem.control.count(interval) if work.moves else 1
        moved, steps = point, 0
        for part in interval.divided(count):
            moved, taken, failure = _predicted(work, moved, part)
            steps += taken
            if failure is not None:
                return failed(Status.of(failure))
        if not all(np.isfinite(x).all() for x in (moved.u, moved.U, moved.du)):
            return failed(Status("not_finite", "the prediction is not finite"))
        moved = replace(moved, U=np.exp(-(interval.t1 - interval.t0) / self.memory) * moved.U)
        predicted = work.predict(moved, interval.end)
        new, refused = self._update(work, moved, interval, predicted)
        if not np.isfinite(new.da).all():
            return failed(Status("not_finite", "the update is not finite"))
        notes = {
            "innovation_ratio": new.consistency.ratio,
            "innovation_correlation": new.consistency.correlation,
        }
        if self.noise == "auto":
            notes["noise_level"] = new.level.scale
        if np.isfinite(self.gate):
            notes["refused"] = float(refused)
        return new, Report(Status(), predicted, steps, notes)

    def _update(
        self, work: SensitivityWork, point: Point, interval: Interval, predicted: Array
    ) -> tuple[Point, int]:
        """Return the filter after the sample, and how many values the gate refused."""
        d = interval.z1 - predicted
        present = np.isfinite(d)
        if not present.any():
            return point, 0
        noise = point.level.scale * work.noise
        Y = work.output(point, interval.end) / noise[:, None]
        e = d / (noise * np.sqrt(1.0 + (Y**2).sum(axis=1)))
        used, count = present, 0
        if np.isfinite(self.gate):
            far = present & ~(np.abs(e) <= self.gate)
            refused = np.where(far, point.refused + 1, np.where(present, 0, point.refused))
            used = present & ~(far & (refused <= self.gate_patience))
            count = int(present.sum() - used.sum())
            point = replace(point, refused=refused)
            e = np.where(used, e, np.nan)
        point = replace(point, consistency=point.consistency.add(e))
        if not used.any():
            return point, count
        Y = Y[used]
        # (I + Y^T Y)^-1 = W W^T with W = R^-1 from a QR factorisation of [I; Y].
        root: Array = np.asarray(np.linalg.qr(np.vstack([np.eye(Y.shape[1]), Y]), mode="r"))
        # SciPy's triangular solve would start threads for this small matrix; this one does not.
        W: Array = np.asarray(np.linalg.inv(root), dtype=float)
        d = (d / noise)[used]
        half = W.T @ (Y.T @ d)
        U, C = point.U @ W, point.C @ W
        spread = float(np.log(np.abs(np.diag(root))).sum() + np.log(noise[used]).sum())
        evidence = point.evidence - 0.5 * float(d @ d - half @ half) - spread
        new = replace(
            point, da=point.da + C @ half, du=point.du + U @ half, C=C, U=U, evidence=evidence
        )
        if self.noise == "auto":
            # What the update leaves of the sample, and what is left of its variance.
            seen = Y @ W
            left = float(((d - seen @ half) ** 2).mean() + (seen**2).sum(axis=1).mean())
            new = replace(new, level=point.level.add(left))
        return new, count

    def belief(self, work: SensitivityWork, state: SensitivityState) -> Belief:
        now = state.now
        return Belief(
            work.bounded(work.latent(now)),
            now.u + now.du,
            work.Phi @ now.C,
            now.U,
            now.consistency.inflation,
        )


def _predicted(
    work: SensitivityWork, point: Point, interval: Interval
) -> tuple[Point, int, StepFailed | None]:
    """Return the filter at the end of an interval, substeps taken, and why it failed or None."""
    model, end = work.problem.model, work.moved(point, interval.t1 - interval.t0)
    at_end = work.directions(end)

    def stage(c: Array, t: float, h: float) -> Array:
        moment, q, directions = interval.at(t), end.q, at_end
        if work.moves and t != interval.t1:
            now = work.moved(point, t - interval.t0)
            q, directions = now.q, work.directions(now)
        u = work.forward.solve(c[:, 0], q, h, moment)
        factor = work.forward.tangent(u, q, h, moment)
        forcing = model.form_A.product("v", "q", directions, moment, u=u, q=q)
        rhs = (model.mass @ c[:, 1:]) / h - forcing
        return np.column_stack([u, factor.solve(rhs * model.X.free[:, None])])

    columns = np.column_stack([end.u, end.U, end.du])
    y, steps, failure = advance(work.problem.control, stage, columns, interval)
    if failure is not None or not np.isfinite(y).all():
        return replace(end, u=y[:, 0], U=y[:, 1:-1], du=y[:, -1]), steps, failure
    U, C = y[:, 1:-1], end.C
    if C.shape[1] > work.rank:
        U, C = _compressed(U, C, work.scale, work.rank)
    return replace(end, u=y[:, 0], U=U, C=C, du=y[:, -1]), steps, None


def _along(point: Point, shift: Array) -> Array:
    """Return by how much the state is expected to move with a shift of a, shape (n,)."""
    if not shift.any():
        return np.zeros(len(point.u))
    weights = np.linalg.lstsq(point.C, shift, rcond=None)[0]
    along: Array = point.U @ weights
    return along


def _missed(work: SensitivityWork, state: SensitivityState) -> Array:
    """Return by how much the reference misses the estimate at the window's start, reduced (k,)."""
    estimate = work.bounded(work.latent(state.now))
    return work.reduced(work.traced(estimate, state.start.q, state.span) - state.reference)


def _next(work: SensitivityWork, state: SensitivityState) -> Array:
    """Return the reference at the window's start that is next: towards the estimate, (m,)."""
    step = _missed(work, state)
    step = step * min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-300))
    q: Array = state.reference + work.Phi @ step
    return q


def _placed(work: SensitivityWork, state: SensitivityState, q: Array, first: Moment) -> Point:
    """Return the filter at the start of the window, linear about q."""
    start, model = replace(state.start, level=state.now.level), work.problem.model
    shift = work.reduced(q - start.q)
    if state.initial:
        U = model.initial_directions(q, work.Phi, first)
        u, du = model.initial_state(q, first), -U @ shift
        return replace(start, q=q, u=u, du=du, da=-shift, U=U)
    along = _along(start, shift)
    return replace(start, q=q, u=start.u + along, du=start.du - along, da=start.da - shift)


def _left(work: SensitivityWork, state: SensitivityState) -> float:
    """Return the distance between estimate and reference, in standard deviations."""
    point, shift = state.now, work.transition(state.span) @ _missed(work, state)
    deviations = np.linalg.lstsq(point.C, shift, rcond=None)[0]
    return float(np.linalg.norm(deviations)) / point.consistency.inflation


def _recentre(work: SensitivityWork, point: Point) -> Point:
    """Move the reference to the estimate, within the bounds.

    Bounds hold for references and for what is reported, not for the linear filter: what lies
    beyond them stays in da and du, so that nothing the data said is lost.
    """
    estimate = work.latent(point)
    within = work.bounded(estimate)
    if np.array_equal(within, estimate):
        zero = np.zeros(len(point.da))
        return replace(point, u=point.u + point.du, q=estimate, du=0.0 * point.du, da=zero)
    shift = work.reduced(within - point.q)
    beyond = _along(point, point.da - shift)
    return replace(
        point,
        u=point.u + point.du - beyond,
        q=point.q + work.Phi @ shift,
        du=beyond,
        da=point.da - shift,
    )


def _loosened(work: SensitivityWork, point: Point, size: float) -> Point:
    """Return the filter with `size` prior deviations added to what is uncertain of every unknown.

    Independent of what the state remembers: the state is as well known as before.
    """
    k = len(point.da)
    C = np.hstack([point.C, size * np.eye(k)])
    U = np.hstack([point.U, np.zeros((len(point.u), k))])
    if C.shape[1] > work.rank:
        U, C = _compressed(U, C, work.scale, work.rank)
    return replace(point, U=U, C=C)


def _compressed(U: Array, C: Array, scale: Array, rank: int) -> tuple[Array, Array]:
    """Return the factor with `rank` columns.

    A rotation gathers all that is uncertain about the parameters, and the state with them, in the
    first columns: they stay as they are. Of the rest, which is the state's alone, the leading
    directions are kept, measured by `scale`.
    """
    k = len(C)
    rotation, root = np.linalg.qr(C.T, mode="complete")
    rotated = U @ rotation
    alone = rotated[:, k:]
    weighted = scale[:, None] * alone
    _, vectors = np.linalg.eigh(weighted.T @ weighted)
    kept = alone @ vectors[:, ::-1][:, : rank - k]
    square: Array = np.zeros((k, rank))
    square[:, :k] = root[:k].T
    return np.hstack([rotated[:, :k], kept]), square
