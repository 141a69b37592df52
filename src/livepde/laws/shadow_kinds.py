"""Shadows, the estimates of single discretisation errors: time step, mesh, and input lines."""

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

# Tolerance of the error of one step, root mean square over the domain, relative to the noise. If a
# front passes a sensor, a few readings contain the errors of ten to twenty steps: these shift the
# unknowns by less than 0.3 standard deviations (tests/test_step_choice.py).
ALLOWED = 0.03
ALIKE = 3.0  # largest ratio of two step errors that represent the steps between them
ROUNDING = 1e-9  # relative to the largest entry of an observation matrix
MESH = 4.0 / 3.0  # error of first-order elements over their difference to the halved mesh
HELD = "hold"  # kind of the shift by held inputs, which is no error if inputs really are constant
SHORT = 1.0 / 16.0  # least interval, relative to the previous one, for an estimate of curvature
SMOOTH = 0.5  # largest ratio of squared differences of changes to squared changes if smooth


@dataclass(frozen=True, eq=False)
class HalvedMesh:
    """A model on the halved mesh, its sensors, and the maps between both meshes."""

    given: Problem  # process on the given mesh
    # Process, observation and implicit stage on the halved mesh.
    model: Model
    observed: Observed
    stage: MemberStage
    # Prolongation of the state, shape (N, n), and of the latent parameter, shape (M, m).
    P: sp.csr_array | Array
    unknowns: sp.csr_array
    at: IntArray  # index on the halved mesh of each coefficient of the given mesh, shape (n,)

    @classmethod
    def of(cls, problem: Problem) -> HalvedMesh:
        """Return the process on the halved mesh; raises `LivepdeError` if it does not exist."""
        coarse, fine = problem.model, problem.model.refined()
        spaces = (fine.state_space, fine.X, fine.parameter_space)
        observed = problem.observed.observation.bind(*spaces)
        P = coarse.state_space.prolongation(fine.state_space)
        # A moving unknown may have several components, each with the coefficients of a block.
        pairs = zip(coarse.latent.parts.values(), fine.latent.parts.values(), strict=True)
        blocks = [
            sp.kron(sp.eye_array(part.evolution.copies), part.block.prolongation(finer.block))
            for part, finer in pairs
        ]
        unknowns = sp.csr_array(sp.block_diag(blocks, format="csr"))
        stage: MemberStage = member_stage(fine)
        if any(isinstance(part.block, FieldBlock) for part in coarse.latent.parts.values()):
            stage = _Prolonged(stage, unknowns)
        # A node of the given mesh is a node of the halved mesh: its row of P has a single one.
        alone = np.flatnonzero(np.abs(P.max(axis=1).toarray().ravel() - 1.0) < 1e-9)
        at = np.empty(P.shape[1], dtype=np.int64)
        at[np.asarray(P[alone].argmax(axis=1)).ravel()] = alone
        return cls(problem, fine, observed, stage, compact(P), unknowns, at)

    @cached_property
    def G(self) -> sp.csr_array | Array | None:
        """Observation matrix on the halved mesh, shape (sensors, N); None if it is not constant."""
        if type(self.observed) is not Observed or self.observed.observation.inputs:
            return None
        return compact(self.observed.G)

    @cached_property
    def _apart(self) -> Array | sp.csr_array | None:
        """Difference of the observation matrices, G P on the halved mesh minus G on the given mesh.

        Shape (sensors, n); None if it is rounding.
        """
        apart = sp.csr_array(self.observed.G @ sp.csr_array(self.P) - self.given.observed.G)
        size = float(abs(self.given.observed.G).max())
        return compact(apart) if abs(apart).max() > ROUNDING * size else None

    def prolong(self, u: Array) -> Array:
        """Return states of shape (members, n) on the halved mesh, shape (members, N)."""
        return np.asarray((self.P @ u.T).T)

    def initial_difference(self, given: Any, q: Array, u: Array, moment: Moment) -> Array:
        """Return the initial state on the halved mesh minus the prolonged one, shape (N,).

        It is zero if `given`, the initial state of the user, has no values at the new nodes.
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
        """Return readings on the halved mesh minus readings on the given mesh, (members, sensors).

        `u`, `q`: linearisation point of the sensors. `coarse`: states on the given mesh.
        `difference`: states on the halved mesh minus `coarse`. Sensors of slopes, such as flux
        plates, have different readings of the same state on both meshes.
        """
        if self.G is not None:
            more = np.asarray((self.G @ difference.T).T)
            return more if self._apart is None else more + np.asarray((self._apart @ coarse.T).T)
        # Sensors without a constant matrix are linearised at the prolonged state.
        at, both, each = self.prolong(u), self.prolong(coarse), []
        for k, state in enumerate(difference):
            latent, when = self.unknowns @ q[k], moment(k)
            physical = self.model.latent.value(latent)
            known = self.given.model.latent.value(q[k])
            apart = self.observed.predict(both[k], physical, when)
            apart -= self.given.observed.predict(coarse[k], known, when)
            # The difference is zero for a sensor without a reading, such as a missing position.
            slope = self.observed.jacobian(at[k], physical, when)[0]
            each.append(slope @ state + np.nan_to_num(apart))
        return np.array(each)


def refusal(problem: Problem, largest: int) -> str:
    """Return the reason why the mesh error is not estimated; empty if it can be."""
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
    """Return whether an initial state is defined at every point of the domain."""
    if isinstance(given, Mapping):
        return all(_pointwise(part) for part in given.values())
    return callable(given) or np.ndim(given) == 0


@dataclass(frozen=True, eq=False)
class _Prolonged(MemberStage):
    """A stage on the halved mesh with unknown fields in coefficients of the given mesh."""

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
    """Size of an error of the state relative to the tolerance `ALLOWED`.

    The size of a component is its root mean square times its largest effect on a reading, in units
    of the noise. The effect is that of a state of size one, constant or linear in a coordinate.
    Components without an effect on a sensor do not contribute.
    """

    problem: Problem  # model and sensors
    # Linearised sensors for rows of state and reduced unknowns: `MemberSensors.rows`.
    rows: Callable[[FilterState, Array, Array, Moments], Array]
    noise: Array  # standard deviation of each sensor, shape (sensors,)

    @cached_property
    def _weights(self) -> Array:
        """Weights of squared coefficients in the mean square of each component, (parts, n)."""
        model = self.problem.model
        mass = np.maximum(model.mass.diagonal(), 0.0)
        rows = []
        for part in model.state_space.parts.values():
            weights = np.zeros(len(mass))
            weights[part] = mass[part] / max(float(mass[part].sum()), 1e-300)
            rows.append(weights)
        return np.array(rows)

    @cached_property
    def _tests(self) -> tuple[Array, Array]:
        """States of size one, (tests, n), and the number of the component of each."""
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
        """Return the sizes of errors of shape (members, n) over the tolerance, shape (members,)."""
        (states, parts), at = self._tests, span.end
        # The noise of a reading is used if it is smaller than the noise of its sensor.
        noise = self.noise if span.noise is None else np.fmin(self.noise, span.noise)
        members, k = len(error), x.C.shape[2]
        U = np.broadcast_to(states, (members, *states.shape))
        seen = self.rows(x, U, np.zeros((members, len(states), k)), at)
        seen = np.abs(seen)
        if np.isnan(at.inputs).any():
            # A sensor with a missing position has no reading now: it gets the effect 1.
            seen = np.where(np.isnan(seen) | ~seen.any(axis=1, keepdims=True), 1.0, seen)
        level = np.sqrt(x.level)[:, None]
        gain = (seen / noise[..., None, :]).max(axis=2, initial=0.0) / level
        sizes = np.sqrt((error * error) @ self._weights.T)  # (members, parts)
        excess = (gain * sizes[:, parts]).max(axis=1, initial=0.0) / ALLOWED
        return np.where(np.isfinite(excess), excess, 0.0)


class ShadowedSteps(NamedTuple):
    """A block of steps of some members, from the previous error estimate to this one."""

    # The filter before and after the last step.
    x: FilterState
    end: FilterState
    # The last step, and the whole block as one step.
    step: Span
    span: Span
    # Number of steps in the block, and number of steps to the next estimate, (members,).
    waited: IntArray
    next: IntArray
    jumps: Mask  # True if the rate of the state jumped in the last step, shape (members,)


class ErrorIncrement(NamedTuple):
    """Discretisation error of a block of steps."""

    # True if the step of the shadow failed, shape (members,); such members get no error.
    failed: Mask
    parts: dict[str, Any]  # new values of fields of `ShadowState`
    # Additional error of the state and of the reduced unknowns, shapes (members, n) and (members,
    # k); None for zero.
    u: Array | None = None
    a: Array | None = None


@dataclass(frozen=True, eq=False)
class MeanProcess:
    """The process of a filter without its covariance, with the unknowns of the filter."""

    # Step control, and implicit stage of all members.
    control: Advance
    stage: MemberStage
    reduction: Reduction  # reduced coordinates of the unknowns
    moves: bool  # True if an unknown has an evolution

    def propagate(
        self, x: FilterState, u: Array, kept: KeptFactors, span: Span
    ) -> tuple[Array, KeptFactors, Mask]:
        """Return states after a span, their warm-start data, and a mask of failed members."""
        if not self.moves:
            return self._through(x, u, kept, span, [span.t1])
        # Steps are divided as in the filter (`noise_rows`).
        parts = grades(x.rate, span.t1 - span.start)
        new, now, failed = u.copy(), kept, np.zeros(len(u), dtype=bool)
        for count in sorted(set(parts.tolist())):
            times = [span.t1]
            if count > 1:
                times = pieces(self.control, span.start, span.t1, count)
            if (parts == count).all():
                return self._through(x, u, kept, span, times)
            group = np.flatnonzero(parts == count)
            members = take(x, group), u[group], take(kept, group), span.part(group)
            new[group], after, failed[group] = self._through(*members, times)
            now = put(now, group, after)
        return new, now, failed

    def _through(
        self, x: FilterState, u: Array, kept: KeptFactors, span: Span, times: list[float]
    ) -> tuple[Array, KeptFactors, Mask]:
        """Return the outcome of `propagate` for a span that is divided at `times`."""
        members, no = len(u), np.zeros(len(u), dtype=bool)
        tangents = self.reduction.directions(x.q, np.zeros((members, 0, x.C.shape[2])))
        factors: dict[float, Any] = {}  # shared by stages with equal q
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
        # Warm-start data of a state that is not finite would spoil all later steps.
        good: Mask = np.isfinite(columns[0]).all(axis=1)
        return columns[0], where(good, now, kept), ~good


class Shadow(ABC):
    """Abstract source of a discretisation error."""

    kind: ClassVar[str]

    @abstractmethod
    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        """Return the initial state of one member."""

    @abstractmethod
    def error(self, s: ShadowState, block: ShadowedSteps) -> ErrorIncrement:
        """Return the discretisation error of a block of steps."""

    def read(self, s: ShadowState, span: Span) -> dict[str, Any]:
        """Return fields of the state after the inputs of an interval, before any estimate."""
        return {}

    def restarted(self, s: ShadowState, which: Mask) -> dict[str, Any]:
        """Return fields of the state without the errors of some members; `u`, `a` excepted."""
        return {}

    def in_readings(self, s: ShadowState) -> Array | None:
        """Return errors of the readings that are not due to `ShadowState.u`; None if zero."""
        return None

    def in_state(self, s: ShadowState) -> Array | None:
        """Return errors of the state, (members, n), that are not in `ShadowState.u`; or None."""
        return None


@dataclass(frozen=True, eq=False)
class StepShadow(Shadow):
    """Error of the time step: one step minus two halved steps from the same state.

    An estimate represents half of the steps since the previous estimate and half of the steps until
    the next one. If it is much larger than the previous estimate, its weight is reduced.
    """

    halves: MeanProcess  # process with halved steps
    factor: float  # 2^p/(2^p - 1) for a scheme of order p
    tolerance: StepTolerance  # scale of an error

    kind = "step"

    @classmethod
    def of(cls, process: MeanProcess, tolerance: StepTolerance) -> StepShadow:
        control = process.control.divided(2)
        # Richardson: e(h) = c h^p, so that e(h) - e(h/2) = (1 - 2^-p) e(h).
        ratio = 2.0**control.scheme.order
        # Halved steps have other matrices: in a shared cache each would replace the other.
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
        # An error much larger than the previous one does not represent the neighbouring steps.
        alike = np.where(size <= ALIKE * s.size, 1.0, s.size / np.maximum(size, TINY))
        weight = 1.0 + (0.5 * (block.waited + block.next) - 1.0) * alike
        # The error of a step with a jump is not a reference for later steps.
        parts = {"halves": kept, "size": np.where(block.jumps | failed, s.size, size)}
        excess = self.tolerance.excess(error, block.end, block.step)
        parts["excess"] = np.where(failed, 0.0, excess)
        return ErrorIncrement(failed, parts, u=weight[:, None] * error)


@dataclass(frozen=True, eq=False)
class InputShadow(Shadow):
    """Error of linear interpolation between two readings of a channel.

    The means of a line and a curve differ by h^2/12 times the second derivative, which the last
    three readings determine. Second differences of noise sum to zero. A step in a channel, recorded
    as two rows within a moment, is not a curve.
    """

    process: MeanProcess  # process with the steps of the filter
    signs: Array  # sign of the error of each channel, (channels,): 1 if interpolated, otherwise 0

    kind = "input"

    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        zero = np.zeros((1, len(self.signs)))
        return changed(s, slope=zero, bend=zero, missed=zero)

    def read(self, s: ShadowState, span: Span) -> dict[str, Any]:
        """Return the error of the inputs by interpolation, and by values held in a gap."""
        length, change = span.t1 - span.t0, span.inputs1 - span.inputs0
        if len(length) < len(s):  # all members share the samples
            length = np.repeat(length, len(s))
        if len(change) < len(s):
            change = np.repeat(change, len(s), axis=0)
        h = length[:, None]
        if span.gaps is not None:
            return self._read_gaps(s, h, change, span.gaps)
        slope = change / h
        # The second derivative is 2 (slope - s.slope)/(h + s.length). The integral of the line
        # exceeds that of the curve by h^3/12 times it: zero for the infinite first length.
        bend = (slope - s.slope) * (h * h * h / (6.0 * (h + s.length[:, None])))
        # In a very short interval the slope is a step or noise: no curvature is computed from it.
        short = length < SHORT * s.length
        if np.count_nonzero(short):
            short &= np.isfinite(s.length)  # infinite without a previous interval
            length, bend = np.where(short, np.inf, length), np.where(short[:, None], 0.0, bend)
        return {"slope": slope, "length": length, "bend": bend, "missed": s.missed + bend}

    @staticmethod
    def _read_gaps(s: ShadowState, h: Array, change: Array, gaps: Array) -> dict[str, Any]:
        """Return the error of the inputs if channels are held in gaps.

        In a gap a channel is expected to keep its slope. The next value determines the line across
        the gap.
        """
        held, missing = gaps[:, 0], gaps[:, 1] > 0.0
        whole = held + h
        slope = np.where(missing, s.slope, change / whole)
        bend = (slope - s.slope) * whole**3 / (6.0 * (whole + s.length[:, None]))
        expected = s.slope * (held + 0.5 * h) * h
        line = 0.5 * held * (change - s.slope * held)
        missed = s.missed + np.where(missing, -expected, bend - line)
        # In a gap and at its end, no error of later steps is predicted.
        in_gap: Mask = np.asarray((gaps > 0.0).any(axis=(1, 2)))
        bend = np.where(in_gap[:, None], 0.0, bend)
        length = np.where(missing.all(axis=1), s.length, whole.max(axis=1))
        return {"slope": slope, "length": length, "bend": bend, "missed": missed}

    def error(self, s: ShadowState, block: ShadowedSteps) -> ErrorIncrement:
        ahead = (0.5 * (block.next - 1))[:, None] * s.bend  # half of the steps to the next estimate
        # The expected error of steps ahead is added in advance, so that the shift does not lag;
        # `left` subtracts it when these steps are processed.
        missed = self.signs * np.where(np.isfinite(s.missed + ahead), s.missed + ahead, 0.0)
        left = {"missed": np.where(np.isfinite(ahead), -ahead, 0.0)}
        if not missed.any():
            return ErrorIncrement(np.zeros(len(missed), dtype=bool), left)
        # The response to small errors is linear in the input, and depends little on their time in
        # the block: the last interval contains their sum.
        span = block.step
        shift = missed / (span.t1 - span.t0)[:, None]
        first, last = span.inputs0 + shift, span.inputs1 + shift
        moved = replace(span, inputs0=first, inputs1=last, interval=None)
        u, _, failed = self.process.propagate(block.x, block.x.u, block.x.kept, moved)
        return ErrorIncrement(failed, left, u=u - block.end.u)


class HeldInputShadow(InputShadow):
    """Shift of the estimates if held inputs were interpolated linearly.

    Only smooth inputs contribute: successive changes of measured inputs are similar, changes of set
    points are not. `signs` is the sign of the difference to a line: 1 if a channel is held at the
    next reading, -1 if at the last reading, 0 if it is interpolated.
    """

    kind = HELD

    def start(
        self, s: ShadowState, x: FilterState, moment: Moment | None, given: Any
    ) -> ShadowState:
        s = super().start(s, x, moment, given)
        return changed(s, held=np.full((1, 4, len(self.signs)), np.nan))

    def read(self, s: ShadowState, span: Span) -> dict[str, Any]:
        """Return the interpolation errors plus the difference of held inputs to linear inputs."""
        parts = super().read(s, span)
        # Sums of squares of successive changes, and of their differences: the ratio distinguishes
        # smooth inputs from set points.
        last, before, changes, differences = s.held.transpose(1, 0, 2)
        change = np.where(np.isfinite(last), span.stated - last, 0.0)
        changes = np.nan_to_num(changes) + change**2
        differences = np.nan_to_num(differences) + (change - np.nan_to_num(before)) ** 2
        smooth = (differences < SMOOTH * changes) & (self.signs != 0.0)
        # The next value exceeds the line by half of the change on average.
        missed = 0.5 * (span.t1 - span.t0)[:, None] * np.where(smooth, change, 0.0)
        values = np.broadcast_to(span.stated, change.shape)
        held = np.stack([values, change, changes, differences], axis=1)
        # `InputShadow` uses the same fields: its contributions are kept.
        both = {name: parts[name] + missed for name in ("bend", "missed")}
        return parts | both | {"held": held}


def input_shadows(process: MeanProcess, problem: Problem) -> Iterator[InputShadow]:
    """Iterate over the shadows of interpolated channels and of held channels."""
    held, own = problem.control.held, problem.model.channels
    lines = np.array([float(name in own and name not in held) for name in problem.channels])
    signs = np.array([float(name in held.next) - (name in held.last) for name in problem.channels])
    if lines.any():
        yield InputShadow(process, lines)
    if signs.any():
        yield HeldInputShadow(process, signs)


@dataclass(frozen=True, eq=False)
class MeshShadow(Shadow):
    """Error of the mesh: difference of the trajectories on the halved mesh and on the given mesh.

    The fine trajectory has the unknowns of the filter. Only its difference to the state of the
    filter is stored, so that samples shift both. One step per block is computed on both meshes. Up
    to the next block, the difference in the readings is constant. Its change is then known, and
    assumed linear in the block: the effect of this change on the unknowns is added.
    """

    # Processes on the given mesh and on the halved mesh.
    coarse: MeanProcess
    fine: MeanProcess
    mesh: HalvedMesh  # halved mesh, with sensors and maps

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
        # One step for the block has a time error that cancels only in the difference to a step of
        # the same length on the given mesh.
        if (block.waited > 1).any():
            coarse, blocks, failed = self.coarse.propagate(x, s.u0, blocks, span)
        # The fine trajectory starts from the prolonged state of the filter plus the difference.
        start = mesh.prolong(s.u0) + s.fine
        u, kept, wrong = self.fine.propagate(x, start, s.fine_stage, span)
        failed = failed | wrong
        fine = np.where(failed[:, None], s.fine, u - mesh.prolong(coarse))
        seen = mesh.in_readings(end.u, end.q, coarse, fine, span.end.member)
        slope = (seen - s.seen) / (span.t1 - span.t0)[:, None]
        # `gains` sums the gains of samples, times the time since the block began. Times the slope,
        # it is the effect of a linearly growing difference.
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
