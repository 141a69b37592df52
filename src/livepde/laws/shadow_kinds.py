"""Sources of discretisation errors, shadows: time step, halved mesh, and lines of inputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp

from livepde.fem import FieldBlock, Moment
from livepde.laws.filter_state import FilterState, ShadowState
from livepde.laws.law import Problem
from livepde.laws.noise_rows import grades, pieces
from livepde.laws.reduction import Reduction
from livepde.linalg import Array, IntArray, Mask, compact
from livepde.linalg.member_arrays import changed, put, take, where
from livepde.model import Model
from livepde.observation import Observed
from livepde.stepping import (
    TINY,
    Advance,
    KeptFactors,
    MemberStage,
    Moments,
    Span,
    StageOfMembers,
    advance,
    member_stage,
)

# Of the noise of a reading: the error of one step, root mean square over the domain. A front that
# passes a sensor shows the errors of ten to twenty steps, in a few readings: with this share they
# shift the unknowns by less than 0.3 standard deviations (tests/test_step_choice.py).
ALLOWED = 0.03
ALIKE = 3.0  # ratio of the errors of two steps that others between them have, too
ROUNDING = 1e-9  # of the largest entry of an observation matrix
MESH = 4.0 / 3.0  # error of elements of first order over its difference to the halved mesh
HELD = "hold"  # kind of the shift by inputs that are held: no error if they are what is stated
SHORT = 1.0 / 16.0  # of the interval before: a shorter one shows no curvature
SMOOTH = 0.5  # differences of changes over changes, squared: below, an input changes smoothly


@dataclass(frozen=True, eq=False)
class HalvedMesh:
    """A model on the halved mesh, its sensors, and the maps between both meshes."""

    given: Problem  # the process on the given mesh
    # The process, its observation, and its implicit stage.
    model: Model
    observed: Observed
    stage: MemberStage
    # Prolongation of the state, shape (N, n), and of the latent parameter, shape (M, m).
    P: sp.csr_array | Array
    unknowns: sp.csr_array
    at: IntArray  # which coefficient of the halved mesh is that of each of the mesh, shape (n,)

    @classmethod
    def of(cls, problem: Problem) -> HalvedMesh:
        """Return the process on the halved mesh; raises `LivepdeError` if there is none."""
        coarse, fine = problem.model, problem.model.refined()
        spaces = (fine.state_space, fine.X, fine.parameter_space)
        observed = problem.observed.observation.bind(*spaces)
        P = coarse.state_space.prolongation(fine.state_space)
        # An unknown that moves may have several components, each with the coefficients of a block.
        pairs = zip(coarse.latent.parts.values(), fine.latent.parts.values(), strict=True)
        blocks = [
            sp.kron(sp.eye_array(one.evolution.copies), one.block.prolongation(other.block))
            for one, other in pairs
        ]
        unknowns = sp.csr_array(sp.block_diag(blocks, format="csr"))
        stage: MemberStage = member_stage(fine)
        if any(isinstance(part.block, FieldBlock) for part in coarse.latent.parts.values()):
            stage = _Prolonged(stage, unknowns)
        # A node of the mesh is one of the halved mesh: its row has a single one.
        alone = np.flatnonzero(np.abs(P.max(axis=1).toarray().ravel() - 1.0) < 1e-9)
        at = np.empty(P.shape[1], dtype=np.int64)
        at[np.asarray(P[alone].argmax(axis=1)).ravel()] = alone
        return cls(problem, fine, observed, stage, compact(P), unknowns, at)

    @cached_property
    def G(self) -> sp.csr_array | Array | None:
        """Observation matrix of the state, shape (sensors, N), if it is constant; else None."""
        if type(self.observed) is not Observed or self.observed.observation.inputs:
            return None
        return compact(self.observed.G)

    @cached_property
    def _apart(self) -> Array | sp.csr_array | None:
        """What constant sensors read of a state on the halved mesh, less what they read of it.

        Shape (sensors, n); None for nothing but rounding.
        """
        apart = sp.csr_array(self.observed.G @ sp.csr_array(self.P) - self.given.observed.G)
        size = float(abs(self.given.observed.G).max())
        return compact(apart) if abs(apart).max() > ROUNDING * size else None

    def prolong(self, u: Array) -> Array:
        """Return states on the halved mesh, shape (members, N) for (members, n)."""
        return np.asarray((self.P @ u.T).T)

    def initial_difference(self, given: Any, q: Array, u: Array, moment: Moment) -> Array:
        """Return the initial state on the halved mesh minus that of the given mesh, shape (N,).

        It is zero if `given`, as a user gave it, defines no values at the new nodes.
        """
        coarse = self.prolong(u[None])[0]
        if self.model.form_initial is not None:
            return np.asarray(self.model.initial_state(self.unknowns @ q, moment) - coarse)
        if given is None or not _pointwise(given):
            return np.zeros_like(coarse)
        return np.asarray(self.model.initial(given, moment) - coarse)

    def in_readings(
        self, u: Array, q: Array, coarse: Array, difference: Array, moment: Callable[[int], Moment]
    ) -> Array:
        """Return what sensors on the halved mesh read more than on the given one.

        `coarse` are states on the given mesh, `difference` those on the halved mesh less them, and
        `u`, `q` where sensors are linearised; the result has the shape (members, sensors). Sensors
        that read slopes, as flux plates, read another value of the same state there.
        """
        if self.G is not None:
            found = np.asarray((self.G @ difference.T).T)
            return found if self._apart is None else found + np.asarray((self._apart @ coarse.T).T)
        # Sensors without one constant matrix: their derivative at the prolonged state.
        at, both, each = self.prolong(u), self.prolong(coarse), []
        for k, more in enumerate(difference):
            latent, when = self.unknowns @ q[k], moment(k)
            physical = self.model.latent.value(latent)
            known = self.given.model.latent.value(q[k])
            apart = self.observed.predict(both[k], physical, when)
            apart -= self.given.observed.predict(coarse[k], known, when)
            # A sensor without a reading, as one whose position is missing, is not apart.
            slope = self.observed.jacobian(at[k], physical, when)[0]
            each.append(slope @ more + np.nan_to_num(apart))
        return np.array(each)


def refusal(problem: Problem, largest: int) -> str:
    """Return why a process is not followed on the halved mesh; empty if it is."""
    model = problem.model
    size = model.X.dim * 2 ** model.mesh.dim()
    if size > largest:
        return (
            f"the state has about {size} coefficients on the halved mesh, more than `largest` = "
            f"{largest} of the shadows"
        )
    if not problem.observed.observation.portable:
        return "the readings of its sensors are coefficients of the given mesh"
    return ""


def _pointwise(given: Any) -> bool:
    """Return whether an initial state is given at every point of the domain."""
    if isinstance(given, Mapping):
        return all(_pointwise(part) for part in given.values())
    return callable(given) or np.ndim(given) == 0


@dataclass(frozen=True, eq=False)
class _Prolonged(MemberStage):
    """A stage on the halved mesh that takes unknown fields as those of the mesh have them."""

    stage: MemberStage
    unknowns: sp.csr_array

    def twin(self) -> _Prolonged:
        return _Prolonged(self.stage.twin(), self.unknowns)

    def kept(self, members: int) -> KeptFactors:
        return self.stage.kept(members)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        q = np.asarray((self.unknowns @ stage.q.T).T)
        none = np.zeros((len(q), 0, self.unknowns.shape[0]))
        return self.stage.advance(columns, stage._replace(q=q, directions=none))


@dataclass(frozen=True, eq=False)
class StepTolerance:
    """Size of an error of the state in units of what is allowed.

    A component of the state counts by its root mean square, times the largest reading, in units of
    its noise, of a state of size one: constant, or linear in a coordinate. So components that no
    sensor sees do not count.
    """

    problem: Problem  # model and sensors
    # Readings of rows of state and reduced unknowns: `MemberSensors.rows`.
    rows: Callable[[FilterState, Array, Array, Moments], Array]
    noise: Array  # standard deviation of each sensor, shape (sensors,)

    @cached_property
    def _weights(self) -> Array:
        """Weights of the squares of coefficients in the mean square of each part, (parts, n)."""
        model = self.problem.model
        mass = np.maximum(model.mass.diagonal(), 0.0)
        found = []
        for part in model.state_space.parts.values():
            weights = np.zeros(len(mass))
            weights[part] = mass[part] / max(float(mass[part].sum()), 1e-300)
            found.append(weights)
        return np.array(found)

    @cached_property
    def _tests(self) -> tuple[Array, Array]:
        """States of size one, (tests, n), and the part of each."""
        space = self.problem.model.state_space
        states, parts = [], []
        for number, (name, block) in enumerate(space.fields.items()):
            p = block.field.mesh.p
            middle, half = 0.5 * (p.max(axis=1) + p.min(axis=1)), 0.5 * np.ptp(p, axis=1)
            functions = [lambda x: np.ones(x.shape[1:])]
            for axis in np.flatnonzero(half > 0.0):
                functions.append(
                    lambda x, i=axis, m=middle, w=half: (x[i] - m[i]) / w[i]  # type: ignore[misc]
                )
            for function in functions:
                state = np.zeros(space.dim)
                state[space.part(name)] = block.interpolate(function)
                states.append(state)
                parts.append(number)
        return np.array(states), np.array(parts)

    def excess(self, error: Array, x: FilterState, span: Span) -> Array:
        """Return the sizes of errors of the state after a span, (members, n), over the allowed."""
        (states, parts), at = self._tests, span.end
        # A reading counts by its noise if that is smaller than the noise of its sensor.
        noise = self.noise if span.noise is None else np.fmin(self.noise, span.noise)
        members, k = len(error), x.C.shape[2]
        U = np.broadcast_to(states, (members, *states.shape))
        seen = self.rows(x, U, np.zeros((members, len(states), k)), at)
        seen = np.abs(seen)
        if np.isnan(at.inputs).any():
            # A sensor whose place is missing shows nothing now: elsewhere it shows values.
            seen = np.where(np.isnan(seen) | ~seen.any(axis=1, keepdims=True), 1.0, seen)
        level = np.sqrt(x.level)[:, None]
        gain = (seen / noise[..., None, :]).max(axis=2, initial=0.0) / level
        sizes = np.sqrt((error * error) @ self._weights.T)  # (members, parts)
        found = (gain * sizes[:, parts]).max(axis=1, initial=0.0) / ALLOWED
        return np.where(np.isfinite(found), found, 0.0)


class ShadowedSteps(NamedTuple):
    """Steps of some members whose error a shadow estimates: all since the previous estimate."""

    # The filter before and after the last of them.
    x: FilterState
    end: FilterState
    # The last step, and all steps as one.
    step: Span
    span: Span
    # Number of steps in it, and from now to the next estimate, (members,).
    waited: IntArray
    next: IntArray
    jumps: Mask  # members of which the rate of the state jumped in the last step, shape (members,)


class ErrorIncrement(NamedTuple):
    """Discretisation error of a block of steps."""

    # Members whose shadow could not be stepped, shape (members,); nothing is added for them.
    failed: Mask
    parts: dict[str, Any]  # fields of `ShadowState` to exchange
    # Additional error of the state and of the reduced unknowns, shapes (members, n) and (members,
    # k); None for zero.
    u: Array | None = None
    a: Array | None = None


@dataclass(frozen=True, eq=False)
class MeanProcess:
    """The process of a filter without covariance: members with the unknowns of the filter."""

    # Step control, and implicit stage of all members.
    control: Advance
    stage: MemberStage
    reduction: Reduction  # the reduced coordinates of the unknowns
    moves: bool  # True if an unknown moves

    def propagate(
        self, x: FilterState, u: Array, kept: KeptFactors, span: Span
    ) -> tuple[Array, KeptFactors, Mask]:
        """Return states after a span, their warm-start data, and which members failed."""
        if not self.moves:
            return self._through(x, u, kept, span, [span.t1])
        # The filter takes the steps of some members in parts (`noise_rows`): so does this.
        parts = grades(x.rate, span.t1 - span.start)
        new, now, failed = u.copy(), kept, np.zeros(len(u), dtype=bool)
        for count in sorted(set(parts.tolist())):
            times = [span.t1]
            if count > 1:
                times = pieces(self.control, span.start, span.t1, count)
            if (parts == count).all():
                return self._through(x, u, kept, span, times)
            group = np.flatnonzero(parts == count)
            some = take(x, group), u[group], take(kept, group), span.part(group)
            new[group], after, failed[group] = self._through(*some, times)
            now = put(now, group, after)
        return new, now, failed

    def _through(
        self, x: FilterState, u: Array, kept: KeptFactors, span: Span, times: list[float]
    ) -> tuple[Array, KeptFactors, Mask]:
        """Return the same as `propagate`, through the parts of a span that end at some times."""
        members, no = len(u), np.zeros(len(u), dtype=bool)
        tangents = self.reduction.directions(x.q, np.zeros((members, 0, x.C.shape[2])))
        factors: dict[float, Any] = {}  # of all stages of a step that have the same q
        now = kept

        def stage(columns: Array, t: float, h: float) -> Array:
            nonlocal now
            q, same = x.q, factors
            if self.moves:
                q, same = self.reduction.predict(q, t - span.start), {}
            work = StageOfMembers(x.member, q, tangents, h, span.at(t), now, no, same)
            y, now = self.stage.advance(columns, work)
            return y

        first, columns = span.start, u[None]
        for stop in times:
            control = self.control.divided(span.division)
            columns, _, failure = advance(control, stage, columns, first, stop)
            if failure is not None:
                return u, kept, ~no
            first = stop
        # Warm-start data of a state that is not finite would spoil all later ones.
        good: Mask = np.isfinite(columns[0]).all(axis=1)
        return columns[0], where(good, now, kept), ~good


class Shadow(ABC):
    """Abstract source of a discretisation error."""

    kind: ClassVar[str]

    @abstractmethod
    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        """Return the state before the first step, of one member."""

    @abstractmethod
    def error(self, s: ShadowState, block: ShadowedSteps) -> ErrorIncrement:
        """Return the discretisation error of a block of steps."""

    def read(self, s: ShadowState, span: Span) -> dict[str, Any]:
        """Return fields of the state after one more interval was read, before any estimate."""
        return {}

    def restarted(self, s: ShadowState, which: Mask) -> dict[str, Any]:
        """Return fields of the state in which members have no error except `ShadowState.u`."""
        return {}

    def in_readings(self, s: ShadowState) -> Array | None:
        """Return the error of the readings except that due to `ShadowState.u`; None if zero."""
        return None

    def in_state(self, s: ShadowState) -> Array | None:
        """Return the error of the state except that in `ShadowState.u`, shape (members, n)."""
        return None


@dataclass(frozen=True, eq=False)
class StepShadow(Shadow):
    """The error of the time step: one step less two halved ones, from the same state.

    One step stands for half of those since the estimate before and half of those until the next,
    unless its error is much larger than the one estimated before.
    """

    halves: MeanProcess  # the process by halved steps
    factor: float  # 2^p/(2^p - 1) for a scheme of order p
    tolerance: StepTolerance  # what is allowed of an error

    kind = "step"

    @classmethod
    def of(cls, process: MeanProcess, tolerance: StepTolerance) -> StepShadow:
        control = process.control.divided(2)
        # Richardson: e(h) = c h^p, so that e(h) - e(h/2) = (1 - 2^-p) e(h).
        ratio = 2.0**control.scheme.order
        # Halved steps have matrices of their own: in a common cache both would factorise anew.
        halves = replace(process, control=control, stage=process.stage.twin())
        return cls(halves, ratio / (ratio - 1.0), tolerance)

    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        return changed(s, halves=self.halves.stage.kept(1))

    def error(self, s: ShadowState, block: ShadowedSteps) -> ErrorIncrement:
        u, kept, failed = self.halves.propagate(block.x, block.x.u, s.halves, block.step)
        error = self.factor * (block.end.u - u)
        size = np.sqrt((error * error).sum(axis=1))
        # An error much larger than the one before is that of this step alone.
        alike = np.where(size <= ALIKE * s.size, 1.0, s.size / np.maximum(size, TINY))
        weight = 1.0 + (0.5 * (block.waited + block.next) - 1.0) * alike
        # The error of a step with a jump is exceptional and no measure for the next ones.
        parts = {"halves": kept, "size": np.where(block.jumps | failed, s.size, size)}
        excess = self.tolerance.excess(error, block.end, block.step)
        parts["excess"] = np.where(failed, 0.0, excess)
        return ErrorIncrement(failed, parts, u=weight[:, None] * error)


@dataclass(frozen=True, eq=False)
class InputShadow(Shadow):
    """The error of the straight line between two readings of a channel.

    The mean of a line misses that of a curve by h^2/12 times its second derivative, which the last
    three readings tell. Second differences of noise add up to nothing. A step that is written as
    two rows a moment apart is no curve.
    """

    process: MeanProcess  # the process itself
    signs: Array  # sign of the error of each channel, shape (channels,): 1 for a line, 0 for none

    kind = "input"

    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        nothing = np.zeros((1, len(self.signs)))
        return changed(s, slope=nothing, bend=nothing, missed=nothing)

    def read(self, s: ShadowState, span: Span) -> dict[str, Any]:
        """Return the error of inputs by straight lines, and by values held in a gap."""
        length, change = span.t1 - span.t0, span.inputs1 - span.inputs0
        if len(length) < len(s):  # members that have their samples in common
            length = np.repeat(length, len(s))
        if len(change) < len(s):
            change = np.repeat(change, len(s), axis=0)
        h = length[:, None]
        if span.gaps is not None:
            return self._read_gaps(s, h, change, span.gaps)
        slope = change / h
        # The second derivative is 2 (slope - s.slope)/(h + s.length), and the line lies above the
        # curve by h^3/12 of it in the integral; the infinite first length makes this zero.
        bend = (slope - s.slope) * (h * h * h / (6.0 * (h + s.length[:, None])))
        # Across a moment the slope is a step, or noise: the next interval must not be compared.
        short = length < SHORT * s.length
        if np.count_nonzero(short):
            short &= np.isfinite(s.length)  # infinite if no interval is known
            length, bend = np.where(short, np.inf, length), np.where(short[:, None], 0.0, bend)
        return {"slope": slope, "length": length, "bend": bend, "missed": s.missed + bend}

    @staticmethod
    def _read_gaps(s: ShadowState, h: Array, change: Array, gaps: Array) -> dict[str, Any]:
        """Return the same where channels are held.

        In a gap a channel is expected to go on as before; once it has a value again the line across
        the gap is known.
        """
        held, missing = gaps[:, 0], gaps[:, 1] > 0.0
        whole = held + h
        slope = np.where(missing, s.slope, change / whole)
        bend = (slope - s.slope) * whole**3 / (6.0 * (whole + s.length[:, None]))
        expected = s.slope * (held + 0.5 * h) * h
        line = 0.5 * held * (change - s.slope * held)
        missed = s.missed + np.where(missing, -expected, bend - line)
        # Of the next steps nothing is expected, where there is a gap.
        some: Mask = np.asarray((gaps > 0.0).any(axis=(1, 2)))
        bend = np.where(some[:, None], 0.0, bend)
        length = np.where(missing.all(axis=1), s.length, whole.max(axis=1))
        return {"slope": slope, "length": length, "bend": bend, "missed": missed}

    def error(self, s: ShadowState, block: ShadowedSteps) -> ErrorIncrement:
        ahead = (0.5 * (block.next - 1))[:, None] * s.bend  # of half of the steps until the next
        # Steps ahead are counted in advance, so that the shift does not lag behind: `left` takes
        # this off again when they have been read.
        missed = self.signs * np.where(np.isfinite(s.missed + ahead), s.missed + ahead, 0.0)
        left = {"missed": np.where(np.isfinite(ahead), -ahead, 0.0)}
        if not missed.any():
            return ErrorIncrement(np.zeros(len(missed), dtype=bool), left)
        # Only their sum counts, wherever in the block the inputs were missed.
        span = block.step
        # The response is linear in the input for small errors: one interval takes the sum of all.
        off = missed / (span.t1 - span.t0)[:, None]
        first, last = span.inputs0 + off, span.inputs1 + off
        moved = replace(span, inputs0=first, inputs1=last, interval=None)
        u, _, failed = self.process.propagate(block.x, block.x.u, block.x.kept, moved)
        return ErrorIncrement(failed, left, u=u - block.end.u)


class HeldInputShadow(InputShadow):
    """Shift of the estimates by straight lines instead of inputs that are held between readings.

    Only inputs that change smoothly count: successive changes of measured inputs are alike, those
    of set points are not. The sign of a channel is that of its error if it were a line: 1 if it is
    held at the next reading, -1 at the last one, 0 for lines.
    """

    kind = HELD

    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        s = super().start(s, x, moment, given)
        return changed(s, held=np.full((1, 4, len(self.signs)), np.nan))

    def read(self, s: ShadowState, span: Span) -> dict[str, Any]:
        """Return the errors of lines, and the difference of held inputs to straight lines."""
        parts = super().read(s, span)
        # Sums of squares of successive changes, and of differences of them: the ratio tells smooth
        # inputs from set points.
        last, before, changes, differences = s.held.transpose(1, 0, 2)
        change = np.where(np.isfinite(last), span.stated - last, 0.0)
        changes = np.nan_to_num(changes) + change**2
        differences = np.nan_to_num(differences) + (change - np.nan_to_num(before)) ** 2
        smooth = (differences < SMOOTH * changes) & (self.signs != 0.0)
        # The held later value exceeds the straight line by half of the change on average.
        missed = 0.5 * (span.t1 - span.t0)[:, None] * np.where(smooth, change, 0.0)
        values = np.broadcast_to(span.stated, change.shape)
        held = np.stack([values, change, changes, differences], axis=1)
        # `InputShadow` reads its lines from the same fields: what it adds to them must stay.
        both = {name: parts[name] + missed for name in ("bend", "missed")}
        return parts | both | {"held": held}


def input_shadows(process: MeanProcess, problem: Problem) -> Iterator[InputShadow]:
    """Iterate over the shadows of the channels that are lines, and of those that are held."""
    held, own = problem.control.held, problem.model.channels
    lines = np.array([float(name in own and name not in held) for name in problem.channels])
    signs = np.array([float(name in held.next) - (name in held.last) for name in problem.channels])
    if lines.any():
        yield InputShadow(process, lines)
    if signs.any():
        yield HeldInputShadow(process, signs)


@dataclass(frozen=True, eq=False)
class MeshShadow(Shadow):
    """The error of the mesh: a trajectory on the halved mesh against one on the mesh.

    The fine trajectory has the unknowns of the filter, and follows where samples move the state:
    only its difference to the state of the filter is kept. Several steps are taken at once on both
    meshes. Up to the next block the difference in the readings is held constant; then its change is
    known, is taken as linear in between, and the effect of this change on the unknowns is added.
    """

    # The process on the mesh, and on the halved mesh.
    coarse: MeanProcess
    fine: MeanProcess
    mesh: HalvedMesh  # the halved mesh

    kind = "mesh"

    @classmethod
    def of(cls, process: MeanProcess, problem: Problem) -> MeshShadow:
        """Return the shadow of a process; raises `LivepdeError`."""
        mesh, coarse = HalvedMesh.of(problem), replace(process, stage=process.stage.twin())
        return cls(coarse, replace(process, stage=mesh.stage), mesh)

    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        if moment is None:
            difference = np.zeros((1, self.mesh.model.X.dim))
            seen = np.zeros((1, self.mesh.observed.size))
        else:
            difference = self.mesh.initial_difference(given, x.q[0], x.u[0], moment)[None]
            seen = self.mesh.in_readings(x.u, x.q, x.u, difference, lambda k: moment)
        kept = {"blocks": self.coarse.stage.kept(1), "fine_stage": self.fine.stage.kept(1)}
        gains = np.zeros((1, seen.shape[1], x.C.shape[2]))
        return changed(s, u0=x.u, fine=difference, seen=seen, gains=gains, **kept)

    def error(self, s: ShadowState, block: ShadowedSteps) -> ErrorIncrement:
        x, end, mesh, span = block.x, block.end, self.mesh, block.span
        coarse, blocks, failed = end.u, s.blocks, np.zeros(len(x), dtype=bool)
        # A long step for the whole block has a time error of its own, which cancels only in the
        # difference to a step of the same length on the coarse mesh.
        if (block.waited > 1).any():
            coarse, blocks, failed = self.coarse.propagate(x, s.u0, blocks, span)
        # The fine trajectory begins at the filter's state, prolonged, and the difference so far.
        start = mesh.prolong(s.u0) + s.fine
        u, kept, wrong = self.fine.propagate(x, start, s.fine_stage, span)
        failed = failed | wrong
        fine = np.where(failed[:, None], s.fine, u - mesh.prolong(coarse))
        seen = mesh.in_readings(end.u, end.q, coarse, fine, span.end.member)
        slope = (seen - s.seen) / (span.t1 - span.t0)[:, None]
        # `gains` weighs the gain of each sample by the time since the block began: times the slope
        # that is the effect of a difference which has grown linearly.
        a = MESH * (slope[:, None] @ s.gains)[:, 0]
        parts = {"blocks": blocks, "fine": fine, "fine_stage": kept, "seen": seen}
        return ErrorIncrement(failed, parts | {"gains": np.zeros_like(s.gains)}, a=a)

    def restarted(self, s: ShadowState, which: Mask) -> dict[str, Any]:
        rows = which[:, None]
        return {"fine": np.where(rows, 0.0, s.fine), "seen": np.where(rows, 0.0, s.seen)}

    def in_readings(self, s: ShadowState) -> Array | None:
        return -MESH * s.seen

    def in_state(self, s: ShadowState) -> Array | None:
        return -MESH * s.fine[:, self.mesh.at]
