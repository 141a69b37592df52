"""The second law: a reduced-order filter for the parameters, carried by sensitivities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.base import Belief, Law, Problem, Report, Status
from livepde.laws.consistency import Consistency
from livepde.laws.filter import Filter, Point, reduction
from livepde.laws.guards import Guards, Scale
from livepde.laws.jumps import Jumps, Watch
from livepde.laws.level import NoiseLevel
from livepde.laws.past import Past, Samples
from livepde.linalg import Array
from livepde.stepping import ForwardStage, Interval

__all__ = ["Replay", "SensitivityLaw", "SensitivityState"]

CONVERGED = 0.5  # standard deviations between reference and estimate at which replays stop
FIRST = 20  # Gauss-Newton steps of a first sample that a nonlinear initial state takes at most
TEMPER = 10.0  # factor on the noise of a sample whose Gauss-Newton steps do not converge
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
    first: int = 8
    iterations: int = 4

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.window:
            raise LawError("Replay: needs 1 <= first <= window.")
        if self.iterations < 1:
            raise LawError(f"Replay: iterations must be at least 1; got {self.iterations}.")


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
    past, scale
        What the law can go back to, and what the sensors have shown, for `Guards`.
    """

    now: Point
    start: Point
    samples: Samples
    assimilated: int
    due: int
    initial: bool
    reference: Array
    watch: Watch
    past: Past
    scale: Scale

    @property
    def span(self) -> float:
        """Time since the start of the window."""
        return float(self.samples.t[-1] - self.samples.t[0]) if len(self.samples.t) else 0.0


@dataclass(frozen=True)
class SensitivityLaw(Law[Filter, SensitivityState]):
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
        Number of modes for each field: one number, or name -> number. "auto": so many that they
        hold 99.99 % of the prior variance, at most 60.
    noise
        Standard deviation of the measurement noise; default what the observation says. "auto": what
        the observation says is a first guess, and the level is found from the samples, the same
        multiple for all sensors.
    drift
        Variance of a gained per unit of time, relative to the prior, by every unknown without an
        evolution of its own: > 0 follows parameters that change. It gains the less the closer its
        deviation is to the prior's, so that nothing winds up while the data tell nothing.
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
    guards
        What to do when a linearisation is overconfident or the estimate runs away; None: nothing.
    """

    modes: int | str | dict[str, int] = "auto"
    noise: float | str | None = None
    drift: float = 0.0
    memory: float = np.inf
    replay: Replay | None = None
    rank: int | None = None
    gate: float = np.inf
    gate_patience: int = 10
    jumps: Jumps | None = None
    guards: Guards | None = field(default_factory=Guards)

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
        self._check_parts()

    def _check_parts(self) -> None:
        """Refuse parts that are of another kind, and gates that let nothing through."""
        for name, kind in (("replay", Replay), ("jumps", Jumps), ("guards", Guards)):
            value = getattr(self, name)
            if not (value is None or isinstance(value, kind)):
                raise LawError(
                    f"SensitivityLaw: {name} must be a {kind.__name__}, or None; got {value!r}."
                )
        if not self.gate > 0:
            raise LawError(f"SensitivityLaw: gate must be positive; got {self.gate}.")
        if self.gate_patience < 1:
            raise LawError(f"SensitivityLaw: gate_patience must be >= 1; got {self.gate_patience}.")

    def prepare(self, problem: Problem) -> Filter:
        observed, model = problem.observed, problem.model
        noise = observed.noise
        if isinstance(self.noise, int | float):
            noise = np.full(observed.size, float(self.noise))
        if noise is None:
            raise LawError(
                "SensitivityLaw needs the noise level of the sensors: give noise= to the "
                "observation (one number, or one for each sensor) or to the law."
            )
        Phi, motions = reduction(problem, self.modes, self.drift)
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
        return Filter(
            problem,
            forward,
            Phi,
            motions,
            noise,
            scale,
            rank,
            self.gate,
            self.gate_patience,
            self.noise == "auto",
        )

    def init(self, work: Filter, q0: Array, u0: Array) -> SensitivityState:
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
        empty = Samples.empty(sensors, len(channels))
        due = self.replay.first if self.replay else 0
        watch = (self.jumps or Jumps()).start()
        past, scale = Past.start(start, empty), Scale.start(sensors)
        return SensitivityState(start, start, empty, 0, due, False, q0, watch, past, scale)

    def start(self, work: Filter, q0: Array, u0: Array, moment: Moment) -> SensitivityState:
        state, model = self.init(work, q0, u0), work.problem.model
        if model.form_initial is None:
            return state
        point = replace(state.start, U=model.initial_directions(q0, work.Phi, moment))
        return replace(state, start=point, now=point, initial=True)

    def begin(self, work: Filter, state: SensitivityState, interval: Interval) -> SensitivityState:
        point = state.now
        # A state that is known, seen by sensors that see no unknown, has nothing to learn.
        if not work.output(point, interval.end).any():
            return state
        form, begun = work.problem.model.form_initial, state
        iterates = form is not None and not form.linear_in_parameter
        if self.guards is not None and self.replay is None:
            iterates = iterates or not work.problem.observed.linear
        for _ in range(FIRST):
            new, _ = work.updated(point, interval, work.predict(point, interval.end))
            if not np.isfinite(new.da).all():
                return state
            begun = replace(state, now=new, reference=point.q)
            if not iterates or _left(work, begun) <= CONVERGED:
                break
            point = _placed(work, state, _next(work, begun), interval.end)
        if self.replay is None:
            now = work.recentred(new)
            return replace(begun, now=now, past=Past.start(now, begun.samples))
        begun = self._store(work, begun, new, interval)
        return replace(begun, past=Past.start(new, begun.samples))

    def _far(self, work: Filter, state: SensitivityState) -> bool:
        """Return whether a law without replay moved an unknown too far by one linearisation."""
        if self.guards is None or self.replay is not None:
            return False
        far = np.abs(_missed(work, state)).max(initial=0.0) > self.guards.reach
        return bool(far) and _left(work, state) > CONVERGED

    def step(
        self, work: Filter, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        new, report = self._assimilated(work, state, interval)
        if (guards := self.guards) is not None:
            new, report = self._rescued(work, guards, state, interval, new, report)
        if report.status.ok and (jumps := self.jumps) is not None:
            new, report = self._watched(work, jumps, state, interval, new, report)
        return new, report

    def _assimilated(
        self, work: Filter, state: SensitivityState, interval: Interval
    ) -> tuple[SensitivityState, Report]:
        """Return the state after a sample."""
        point, report = self._filter(work, state.now, interval)
        if not report.status.ok:
            return state, report
        if self.replay is None:
            if (guards := self.guards) is not None:
                point, notes = self._iterated(work, guards, state, interval, point)
                if notes:
                    notes = {**report.notes, **_consistent(point), **notes}
                    report = replace(report, notes=notes)
            return self._remember(work, state, work.recentred(point), interval), report
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
            state = self.renewed(work.recentred(state.now), state)
        return self._remember(work, state, state.now, interval), report

    def _remember(
        self, work: Filter, state: SensitivityState, now: Point, interval: Interval
    ) -> SensitivityState:
        """Return a state that stands at a filter, and whose past holds the sample."""
        if self.guards is None and self.jumps is None:
            return replace(state, now=now)
        length = max(
            self.guards.past if self.guards is not None else 0,
            self.jumps.window if self.jumps is not None else 0,
        )
        past = state.past.add(now, interval, work.problem.channels, length)
        return replace(state, now=now, past=past)

    def renewed(self, start: Point, state: SensitivityState) -> SensitivityState:
        """Return a state whose window begins at a filter, with no samples yet."""
        empty = state.samples.since(len(state.samples.t))
        first = self.replay.first if self.replay else 0
        return replace(
            state,
            now=start,
            start=start,
            samples=empty,
            assimilated=0,
            due=first,
            initial=False,
            reference=start.q,
        )

    def _iterated(
        self,
        work: Filter,
        guards: Guards,
        state: SensitivityState,
        interval: Interval,
        point: Point,
    ) -> tuple[Point, dict[str, float]]:
        """Return the filter after a sample that may have moved it too far, and notes.

        Too far is cured by a replay of this one sample from where the interval began.
        """
        if guards.within_reach(point.da - state.now.da):  # cheaper to see than how far it is
            return point, {}
        level = state.now.level
        for temper in range(guards.temperings + 1):
            tempered = {"tempered": 1.0} if temper else {}
            begin = replace(state.now, level=level.times(TEMPER**temper), kept=point.kept)
            if temper:
                point, _ = self._filter(work, begin, interval)
                if guards.within_reach(point.da - begin.da):
                    return _levelled(point, level, temper), tempered
            window = self._store(work, self.renewed(begin, state), point, interval)
            if not self._far(work, window):
                return _levelled(point, level, temper), tempered
            for _ in range(guards.iterations):
                window, status = self._replayed(work, window)
                if not status.ok:
                    break
                if _left(work, window) <= CONVERGED:
                    return _levelled(window.now, level, temper), {"iterated": 1.0, **tempered}
        return self._filter(work, state.now, interval.silent)[0], {"held": 1.0}

    def _rescued(
        self,
        work: Filter,
        guards: Guards,
        state: SensitivityState,
        interval: Interval,
        new: SensitivityState,
        report: Report,
    ) -> tuple[SensitivityState, Report]:
        """Return state and report after a sample that may have failed or be far off.

        Whatever led there is not used again: the state is only carried on from the past.
        """
        noise = state.now.level.scale * work.noise
        scale = state.scale.add(interval.z1, interval.z1 - report.predicted)

        def astray(report: Report) -> bool:
            d = interval.z1 - report.predicted
            return not report.status.ok or scale.beyond(d, noise) > guards.runaway

        if not astray(report):
            return replace(new, scale=scale), report
        older = replace(work.recentred(state.past.older), kept=new.now.kept)
        known = [*state.past.samples.intervals(work.problem.channels), interval]
        silent = [item.silent for item in known]
        for start in (work.loosened(older, 1.0), work.fresh(older)):
            again, found = self._retaken(work, state, start, silent)
            if not astray(found):
                notes = {**found.notes, "restarted": 1.0}
                again = replace(again, scale=scale, past=Past.start(again.now, again.samples))
                return again, replace(found, notes=notes)
        if not report.status.ok:
            return state, report
        return replace(new, scale=scale), replace(report, notes={**report.notes, "runaway": 1.0})

    def _retaken(
        self, work: Filter, state: SensitivityState, start: Point, intervals: list[Interval]
    ) -> tuple[SensitivityState, Report]:
        """Return state and report after some samples, taken again from another start."""
        state = self.renewed(start, state)
        state = replace(state, past=Past.start(start, state.samples))
        for interval in intervals:
            state, report = self._assimilated(work, state, interval)
            if not report.status.ok:
                break
        return state, report

    def _watched(
        self,
        work: Filter,
        jumps: Jumps,
        state: SensitivityState,
        interval: Interval,
        new: SensitivityState,
        report: Report,
    ) -> tuple[SensitivityState, Report]:
        """Return state and report after the test for a jump.

        After an alarm the samples since the jump are taken again, from before it: the state has
        gone astray with them, and what was measured before does not belong to the unknowns of now.
        """
        if not interval.present.any():  # there is no innovation, and `newest` is that of before
            return new, replace(report, notes={**report.notes, "jump": 0.0})
        usual, e = state.now.consistency, new.now.consistency.newest
        watch, alarm = jumps.add(state.watch, e, usual)
        new = replace(new, watch=watch)
        if alarm:
            past = state.past
            known = [*past.samples.intervals(work.problem.channels), interval]
            before = max(len(known) - jumps.onset(state.watch, e, usual), 0)
            point, status = replace(work.recentred(past.older), kept=new.now.kept), Status()
            for earlier in known[:before]:
                point, found = self._filter(work, point, earlier)
                point, status = work.recentred(point), found.status
                if not status.ok:
                    break
            start = work.loosened(point, jumps.size)
            again, found = self._retaken(work, new, start, known[before:])
            if status.ok and found.status.ok:
                new = again
            else:
                new = self.renewed(work.loosened(work.recentred(new.now), jumps.size), new)
        return new, replace(report, notes={**report.notes, "jump": float(alarm)})

    def _store(
        self, work: Filter, state: SensitivityState, now: Point, interval: Interval
    ) -> SensitivityState:
        samples = state.samples.add(interval, work.problem.channels)
        used = state.assimilated + bool(interval.present.any())
        return replace(state, now=now, samples=samples, assimilated=used)

    def _replayed(self, work: Filter, state: SensitivityState) -> tuple[SensitivityState, Status]:
        """Run the stored samples again about a reference at the estimate, or on the way to it."""
        samples, q = state.samples, _next(work, state)
        channels = work.problem.channels
        first = samples.first(channels)
        point = _placed(work, state, q, first.end)
        if first.present.any():
            point, _ = work.updated(point, first, work.predict(point, first.end))
        for interval in samples.intervals(channels):
            point, report = self._filter(work, point, interval)
            if not report.status.ok:
                return state, report.status
        return replace(state, now=point, reference=q), Status()

    def _filter(self, work: Filter, point: Point, interval: Interval) -> tuple[Point, Report]:
        """Predict over an interval and update at its end, linear about the reference."""

        def failed(status: Status) -> tuple[Point, Report]:
            return point, Report(status, work.predict(point, interval.end))

        interval = work.problem.control.over(interval)
        # What unknowns gain in one substep is independent of what they gain in the next.
        count = work.problem.control.count(interval) if work.moves else 1
        moved, steps = point, 0
        for part in interval.divided(count):
            moved, taken, failure = work.advanced(moved, part)
            steps += taken
            if failure is not None:
                return failed(Status.of(failure))
        if np.isfinite(self.memory):
            fade = np.exp(-(interval.t1 - interval.t0) / self.memory)
            moved = replace(moved, U=fade * moved.U)
        predicted = work.predict(moved, interval.end)
        new, refused = work.updated(moved, interval, predicted)
        if not np.isfinite(new.da).all():
            return failed(Status("not_finite", "the update is not finite"))
        notes = _consistent(new)
        if self.noise == "auto":
            notes["noise_level"] = new.level.scale
        if np.isfinite(self.gate):
            notes["refused"] = float(refused)
        return new, Report(Status(), predicted, steps, notes)

    def belief(self, work: Filter, state: SensitivityState) -> Belief:
        return self.reader(work, state)()

    def reader(self, work: Filter, state: SensitivityState) -> Callable[[], Belief]:
        now = state.now  # not held: it has factors of the last stage
        q, da, u, du, U, C = now.q, now.da, now.u, now.du, now.U, now.C
        consistency, age = now.consistency, now.age

        def read() -> Belief:
            latent = work.bounded(q + work.Phi @ da)
            spread = consistency.inflation
            return Belief(latent, u + du, work.Phi @ C, U, spread, work.Phi, work.rest(age))

        return read


def _missed(work: Filter, state: SensitivityState) -> Array:
    """Return by how much the reference misses the estimate at the window's start, reduced (k,)."""
    estimate = work.bounded(work.latent(state.now))
    return work.reduced(work.traced(estimate, state.start.q, state.span) - state.reference)


def _next(work: Filter, state: SensitivityState) -> Array:
    """Return the reference at the window's start that is next: towards the estimate, (m,)."""
    step = _missed(work, state)
    step = step * min(1.0, STRIDE / max(float(np.abs(step).max()), 1e-300))
    q: Array = state.reference + work.Phi @ step
    return q


def _placed(work: Filter, state: SensitivityState, q: Array, first: Moment) -> Point:
    """Return the filter at the start of the window, linear about q."""
    start = replace(state.start, level=state.now.level, kept=state.now.kept)
    model = work.problem.model
    shift = work.reduced(q - start.q)
    if state.initial:
        initial = model.initial_directions(q, work.Phi, first)
        u, du = model.initial_state(q, first), -initial @ shift
        return replace(start, q=q, u=u, du=du, da=-shift, U=initial @ start.C)
    along = start.along(shift)
    return replace(start, q=q, u=start.u + along, du=start.du - along, da=start.da - shift)


def _left(work: Filter, state: SensitivityState) -> float:
    """Return the distance between estimate and reference, in standard deviations."""
    point, shift = state.now, work.transition(state.span) @ _missed(work, state)
    deviations = np.linalg.lstsq(point.C, shift, rcond=None)[0]
    return float(np.linalg.norm(deviations)) / point.consistency.inflation


def _levelled(point: Point, level: NoiseLevel, tempered: int) -> Point:
    """Return a filter after a sample; a tempered one tells nothing about the noise."""
    return replace(point, level=level) if tempered else point


def _consistent(point: Point) -> dict[str, float]:
    """Return the notes on the innovations."""
    return {
        "innovation_ratio": point.consistency.ratio,
        "innovation_correlation": point.consistency.correlation,
    }
