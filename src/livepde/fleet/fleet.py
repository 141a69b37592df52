"""Fleet: identification of many processes with one model, stepped together."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from livepde import checkpoint, errors
from livepde.checkpoint import Fingerprint
from livepde.dates import stamp_of
from livepde.fem import Inputs, Moment
from livepde.fleet.assessment import assessed
from livepde.fleet.engines import Beliefs, BlockEngine, FleetEngine, SeparateEngine, beginnings
from livepde.fleet.estimate import FleetEstimate, FleetResult, number_of
from livepde.fleet.taken_by_members import TakenByMembers
from livepde.frames import layout_of
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, Belief, MemberReports, Status
from livepde.linalg import Array, IntArray, Mask, nonfinite_allowed
from livepde.linalg.member_arrays import put, take
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.samples import (
    check_noise,
    columns,
    in_order_of,
    is_frame,
    is_tabular,
    mapped,
    noise_channel,
    number,
    numbers,
    sample_of,
)
from livepde.start import assumes_zero, initial_errors, initial_readings
from livepde.stepping import Advance, Between, Scheme, Span, own_noise
from livepde.verdict import Verdict

FORMAT = 13  # version of the checkpoint format

Values = ArrayLike | Mapping[str, ArrayLike]


class Fleet:
    """Estimate the unknowns of many processes with one model, sensors and sample times.

    Members differ in data, inputs and initial values. Estimates equal those of one `Identifier` for
    each member, to rounding. `SensitivityLaw` steps members as blocks, if unknowns are numbers, the
    model is one-dimensional and linear in state and inputs, and sensors are linear and fixed.
    Otherwise (`note` is the reason), and at events such as an alarm, they are stepped one by one.

    Parameters
    ----------
    model, observation, law
        As for `Identifier`.
    members
        Number of members, or their names.
    q0, u0, u0_from, u0_errors
        As for `Identifier`: one value for all members, or a list with a value for each. The errors
        of one u0 are a tuple.
    t0, validation, scheme, dt_max, halvings, assimilate_from, between, input_noise
        As for `Identifier`.

    Raises
    ------
    ConfigurationError
        Parts that do not fit together.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> model = heat(lp.interval(0, 1, 20), lp.Normal(0.5, 0.2), {"left": 0.0, "right": 0.0})
    >>> fleet = Fleet(model, lp.Points([0.5], noise=0.01), lp.SensitivityLaw(), members=3, u0=1.0)
    >>> fleet.step(0.1, [[0.9], [0.8], [float("nan")]]).q.shape
    (3, 1)
    """

    def __init__(
        self,
        model: Model,
        observation: Observation,
        law: AnyLaw,
        members: int | Sequence[str],
        *,
        q0: Any = None,
        u0: Any = None,
        t0: float = 0.0,
        validation: Observation | None = None,
        scheme: Scheme | None = None,
        dt_max: float = np.inf,
        halvings: int = Advance.halvings,
        assimilate_from: float = -np.inf,
        between: Mapping[str, Between] | None = None,
        input_noise: Mapping[str, float] | None = None,
        u0_from: Mapping[str, Any] | list[Mapping[str, Any]] | None = None,
        u0_errors: tuple[Any, ...] | list[tuple[Any, ...]] = (),
    ) -> None:
        self.members = _member_names(members)
        self._judging = law
        law = law.for_fleet()
        q0s, u0s = self._each("q0", q0), self._each("u0", u0)
        sources = [item or {} for item in self._each("u0_from", u0_from)]
        error_lists = [tuple(item) for item in self._each("u0_errors", u0_errors)]
        largest_errors: tuple[Any, ...] = max(error_lists, key=len)
        self._member = Identifier(
            model,
            observation,
            law,
            q0=q0s[0],
            u0=u0s[0],
            t0=t0,
            validation=validation,
            scheme=scheme,
            dt_max=dt_max,
            halvings=halvings,
            assimilate_from=assimilate_from,
            between=between,
            input_noise=input_noise,
            u0_from=max(sources, key=len),
            u0_errors=largest_errors,
        )
        self.model = model = self._member.model
        self.law = law
        self.problem = self._member.problem
        # Laws evaluate `initial` on other meshes, which is only possible if members share it.
        if len({*map(id, u0s)}) > 1:
            self.problem = replace(self.problem, initial=None)
        self._work = law.prepare(self.problem)
        self._q0 = list(map(model.initial_parameter, q0s))
        self._u0 = [model.initial_values(0.0 if u is None else u) for u in u0s]
        self._stated = self._stated_at_start(u0s)
        self._assumed = [assumes_zero(model, u) for u in u0s]
        self.note = law.stepped_alone(self._work)
        self._errors = [initial_errors(model, item) for item in error_lists]
        self._engine = self._stepper(sources, u0s)
        sizes = self.observed.size, len(self.inputs), len(self)
        self._state: Any = None
        self._so_far = TakenByMembers.start(t0, *sizes)
        self._samples = 0
        self._starts: dict[int, Identifier] = {}
        self._begin_without_inputs()

    def _stated_at_start(self, u0s: Sequence[Any]) -> Array:
        """Return the inputs at t0 that u0 implies, shape (members, channels); NaN: none."""
        values = np.full((len(self.members), len(self.inputs)), np.nan)
        for k, u in enumerate(u0s):
            if k == 0 or u is not u0s[k - 1]:
                stated = self.model.boundary_readings(u)
            values[k] = [stated.get(name, np.nan) for name in self.inputs]
        return values

    def _stepper(self, sources: list[Mapping[str, Any]], u0s: list[Any]) -> FleetEngine:
        """Return an engine that steps members as blocks if the law supports it, else one by one."""
        readings = [initial_readings(self.model, self.observed, item) for item in sources]
        context = self.law, self._work, self.problem
        begins = beginnings(*context, readings, self._errors, u0s)
        if not self.note:
            return BlockEngine(self.law, self._work, begins)
        differences = {
            "u0_errors differ": any(
                not np.array_equal(item, self._errors[0]) for item in self._errors
            ),
            "u0_from differs": any(item.keys() != sources[0].keys() for item in sources),
        }
        for option, differs in differences.items():
            if differs:
                raise errors.ConfigurationError(
                    f"{option} between members, which are stepped separately, as {self.note}: give "
                    "all the same."
                )
        return SeparateEngine(self.law, self._work, begins, self.problem)

    def _each(self, what: str, value: Any) -> list[Any]:
        """Return a list with a value for each member, from a list or a common value."""
        if not isinstance(value, list):
            return [value] * len(self.members)
        if len(value) != len(self.members):
            raise errors.ConfigurationError(
                f"{what}: a list of {len(value)} for {len(self.members)} members; give one for "
                "each, or a single value for all."
            )
        return value

    def __len__(self) -> int:
        return len(self.members)

    @property
    def observed(self) -> Observed:
        """Observation operator of the assimilated sensors."""
        return self._member.observed

    @property
    def validation(self) -> Observed | None:
        """Observation operator of the validation sensors, or None."""
        return self._member.validation

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the input channels of the model and the sensors."""
        return self._member.inputs

    @property
    def together(self) -> bool:
        """True if members are stepped as blocks."""
        return not self.note

    @property
    def t(self) -> Array:
        """Time of the last accepted sample of each member, shape (members,)."""
        return self._so_far.t.copy()

    def _moments(self, t: Array, inputs: Array) -> list[Moment]:
        return [
            Moment(float(at), Inputs(dict(zip(self.inputs, row.tolist(), strict=True))))
            for at, row in zip(t, inputs, strict=True)
        ]

    def _begin_without_inputs(self) -> None:
        """Initialise the state immediately if it does not depend on inputs."""
        if self._state is None and not self.inputs:
            empty = np.zeros((len(self), 0))
            self._begin(empty, empty > 0.0)

    def _initialise(self, values: Array, missing: Mask, *, later: bool) -> dict[str, Mask]:
        """Initialise the state by the inputs of a first sample; `later`: it is after t0.

        Return channel -> mask of members without a known value at t0, or in this sample.
        """
        unstated = self._unstated & later
        self._begin(self._opening(values) if later else values, unstated)
        channels = np.flatnonzero(unstated.any(axis=0)).tolist()
        return {self.inputs[k]: unstated[:, k] | missing[:, k] for k in channels}

    def _begin(self, inputs: Array, unstated: Mask) -> None:
        moments, u0 = self._moments(self._so_far.t, inputs), self._u0
        with nonfinite_allowed():  # checked below
            if self.model.form_initial is None:
                starts = [self.model.impose(u, at) for u, at in zip(u0, moments, strict=True)]
            else:
                pairs = zip(self._q0, moments, strict=True)
                starts = [self.model.initial_state(q, at) for q, at in pairs]
            state = self._engine.start(self._q0, starts, moments)
        for k, name in enumerate(self.members if self.inputs else ()):
            if not self.law.finite(self._work, self._engine.member(state, k)):
                raise errors.SampleError(
                    f"member '{name}' gets no finite initial state: check the values of its "
                    f"inputs {list(self.inputs)}; the run begins with the next sample."
                )
        self._state, self._so_far = state, self._so_far.begun(inputs, unstated)

    def step(
        self, t: float, z: Values, inputs: Mapping[str, ArrayLike] | None = None
    ) -> FleetEstimate:
        """Process one sample of each member and return the estimates at its time.

        If the step of a member fails numerically, its status is the reason, and its next step
        starts from its last successful state; other members are not affected. Invalid input raises
        an error and changes nothing.

        Parameters
        ----------
        t
            Time, common to all members.
        z
            Measurements: an array of shape (members, sensors), NaN where missing, or (members,
            sensors, 2) with noise; a mapping from channel, or "noise of T_1", to one number or a
            number for each member, such as a table with a row for each member; or a list of such
            rows. Values with labels, such as a series or mapping, are assigned to members by name.
        inputs
            Input channel -> one number, or a number for each member; NaN holds the last value.

        Raises
        ------
        SampleError, TimeOrderError, MissingInputError
            As `Identifier.step`.
        """
        if stamp_of(t) is not None:
            raise errors.SampleError(
                f"time t is the date {t}; the times of a fleet are numbers: give the time since "
                "a date of your choice, in the unit of the model."
            )
        t = number(t, "time t")
        if not np.isfinite(t):
            raise errors.SampleError(f"time t is {t}; give the time of the sample.")
        measured, noise, validation, named = self._parsed(z, inputs)
        self._member._check_weighs(noise)
        # Times of members differ after a failed step: a sample must be later than all of them.
        last = float(self._so_far.t.max())
        self._refuse_earlier(t, last)
        values, held = self._filled(named)
        no_member = np.zeros(len(self))
        missing = np.array([held.get(name, no_member) for name in self.inputs], dtype=float)
        missing = missing.reshape(len(self.inputs), len(self)).T
        if self._state is None:
            held |= self._initialise(values, missing > 0.0, later=t > last)
        used = measured if t >= self._member.assimilate_from else np.full_like(measured, np.nan)
        earlier = self._so_far
        span_to = partial(
            Span, t0=earlier.t, t1=t, channels=self.inputs, inputs1=values, z1=used, noise=noise
        )
        if t == last:
            span = span_to(inputs0=values, z0=used)
            report = self._expected(span)
            self._state = self._engine.begin(self._state, span)
        else:
            gaps = np.stack([earlier.held, missing], axis=1)
            span = span_to(inputs0=earlier.inputs, z0=earlier.z, gaps=gaps if gaps.any() else None)
            span = span.driven(self.problem.control.held)
            self._state, report = self._engine.step(self._state, span)
        control = self.problem.control
        holding = np.array([name in control.held.last for name in self.inputs], dtype=bool)
        arguments = t, used, values, missing, report.statuses, control, holding
        self._so_far, self._samples = earlier.after(*arguments), self._samples + 1
        return self._estimate(span, measured, validation, report, held)

    def _refuse_earlier(self, t: float, last: float) -> None:
        if t < last or (t == last and self._samples):
            raise errors.TimeOrderError(
                f"the sample at t = {t!r} is not later than the last one at t = {last!r}: "
                "sort the stream, and drop repeated samples."
            )

    def _opening(self, inputs: Array) -> Array:
        """Return the inputs at the initial time, given the inputs of a later first sample."""
        unknown = np.isnan(self._stated)
        # The same object at both ends of an interval marks held inputs.
        return inputs if unknown.all() else np.where(unknown, inputs, self._stated)

    @property
    def _unstated(self) -> Mask:
        """Mask of channels of the model without a value at t0, shape (members, channels)."""
        # A "next" input requires no initial value: its first reading is the mean since t0.
        required = {*self.model.channels} - {*self.problem.control.held.next}
        mask: Mask = np.array([name in required for name in self.inputs], dtype=bool)
        return np.isnan(self._stated) & mask

    def _expected(self, span: Span) -> MemberReports:
        beliefs, count = self._engine.beliefs(self._state), len(self)
        predicted = self._predicted(self.observed, beliefs, span)
        return MemberReports((Status(),) * count, predicted, np.zeros(count, dtype=int))

    def _believed(self, state: Any, k: int) -> Belief:
        return self.problem.physical(self._engine.believed(state, k))

    def _estimate(
        self,
        span: Span,
        measured: Array,
        validation: Array,
        report: MemberReports,
        held: dict[str, Mask],
    ) -> FleetEstimate:
        state, engine, errors_of_validation = self._state, self._engine, validation
        beliefs = cache(lambda: engine.beliefs(state))
        if self.validation is not None:
            errors_of_validation = validation - self._predicted(self.validation, beliefs(), span)
        return FleetEstimate(
            t=span.t1,
            members=self.members,
            read=beliefs,
            innovation=measured - report.predicted,
            validation_error=errors_of_validation,
            statuses=report.statuses,
            steps=report.steps,
            diagnose=lambda: report.diagnostics,
            held=held,
            space=self.model.parameter_space,
            belief=lambda k: self._believed(state, k),
            state_space=self.model.state_space,
        )

    @staticmethod
    def _predicted(observed: Observed, beliefs: Beliefs, span: Span) -> Array:
        """Return the predicted readings of all members, shape (members, sensors)."""
        u, q = beliefs.u, beliefs.q
        if type(observed) is Observed and observed.linear:
            readings: Array = (observed.G @ u.T).T
            return readings
        rows = [observed.predict(u[k], q[k], span.end.member(k)) for k in range(len(span))]
        return np.array(rows)

    def _settled(self, estimate: FleetEstimate) -> FleetEstimate:
        """Return the last estimate after the deferred work of the law, for the end of a run."""
        engine, state = self._engine, self._engine.settled(self._state)
        read, belief = lambda: engine.beliefs(state), lambda k: self._believed(state, k)
        return replace(estimate, read=read, belief=belief)

    def identifier(self, member: str | int) -> Identifier:
        """Return an identifier in the state of a member, specified by name or number.

        Steps of this identifier do not change the fleet.
        """
        k = number_of(self.members, member)
        state = None if self._state is None else self._engine.member(self._state, k)
        ends = {name: values[k].copy() for name, values in self.ends.items()}
        # Cached, since its fingerprint is computed once for all checkpoints of this member.
        initial = self._starts[k] = self._starts.get(k) or self._initial_member(k)
        return initial._placed(state, ends, self._samples)

    def _initial_member(self, k: int) -> Identifier:
        """Return the identifier of a member before its first sample."""
        start = self._q0[k], self._u0[k], *self._engine.begun(k)
        return self._member._started(*start, assumed=self._assumed[k])

    def verdict(self, member: str | int) -> Verdict:
        """Return the verdict that a separate run of a member would have, by name or number.

        A fleet computes no verdicts while it steps. This method processes the stored samples of the
        member again, which takes as long as a separate run.
        """
        k = number_of(self.members, member)
        if self._state is None:
            return Verdict.unjudged()
        ends = {name: values[k].copy() for name, values in self.ends.items()}
        identifier, state = self._initial_member(k), self._engine.member(self._state, k)
        return assessed(identifier, self._judging, state, ends, self._samples)

    def template(self) -> Any:
        """Return a state of the first member with zero inputs, as a template of the structure."""
        moments = self._moments(self._so_far.t[:1], np.zeros((1, len(self.inputs))))
        engine = self._engine.subset(np.array([0]))
        return engine.start(self._q0[:1], self._u0[:1], moments)

    def subset(self, which: IntArray, state: Any, samples: int) -> Fleet:
        """Return a fleet of some members in their present states; for `Shard`.

        `which`: numbers of the members.
        `state`: state of their engine; None before the first sample.
        `samples`: number of their samples so far.
        """
        fleet = copy.copy(self)
        fleet._starts = {}
        for name in ("header", "fingerprint"):
            vars(fleet).pop(name, None)
        fleet.members = tuple(self.members[k] for k in which)
        fleet._engine = self._engine.subset(which)
        starts = self._q0, self._u0, self._errors
        fleet._q0, fleet._u0, fleet._errors = ([values[k] for k in which] for values in starts)
        fleet._assumed = [self._assumed[k] for k in which]
        fleet._stated = self._stated[which]
        fleet._so_far = take(self._so_far, which)
        fleet._state, fleet._samples = state, samples
        fleet._begin_without_inputs()
        return fleet

    def adopt(self, which: IntArray, part: Fleet) -> Any:
        """Copy times and values from a subset, and return its state; for `Shard`."""
        self._so_far = put(self._so_far, which, part._so_far)
        return part._state

    @property
    def ends(self) -> dict[str, Array]:
        """Last times, readings and inputs of all members, with gaps and counts for verdicts."""
        return dict(vars(self._so_far))

    def run(self, stream: Iterable[Sequence[Any]]) -> FleetResult:
        """Process all samples of a stream, (t, z) or (t, z, inputs), and return the estimates."""
        if is_tabular(stream):
            raise errors.SampleError(
                "a fleet takes no table as a whole: give (t, z) or (t, z, inputs) for each time."
            )
        result = FleetResult(self.members, layout_of(self.model, self.observed, self.validation))
        for item in stream:
            sample = sample_of(item)
            result.add(self.step(sample.t, sample.z, sample.inputs))
        if result.last is not None:
            result._settle(self._settled(result.last))
        return result

    def labelled(self, z: Any) -> Any:
        """Convert labelled readings of a member to a mapping from channels; see `Channels`."""
        return self._member._channels.labelled(z)

    def _parsed(
        self, z: Values, inputs: Mapping[str, ArrayLike] | None
    ) -> tuple[Array, Array | None, Array, dict[str, Array]]:
        """Return validated measurements, their noise, validation values and inputs."""
        z = mapped(z, "z") if is_frame(z) else z
        if isinstance(z, list | tuple) and z:
            rows = list(map(self.labelled, z))
            z = columns(rows) if all(isinstance(row, Mapping) for row in rows) else z
        parse = self._by_name if isinstance(z, Mapping) else self._by_place
        measured, noise, validation, named = parse(z)
        for name, values in mapped(inputs, "inputs").items():
            if name not in self.inputs:
                raise errors.SampleError(
                    f"unknown input '{name}'; model and sensors have {list(self.inputs)}."
                )
            named[name] = self._input_of(name, named.get(name), self._column(name, values))
        return measured, None if noise is None else own_noise(noise), validation, named

    def _input_of(self, name: str, before: Array | None, column: Array) -> Array:
        """Return the values of an input; `before`: its values among the readings, or None."""
        if before is None:
            return column
        conflicts = (before != column) & ~np.isnan(before) & ~np.isnan(column)
        sensors = {*self.observed.names, *(self.validation.names if self.validation else ())}
        if conflicts.any() and name not in sensors:  # a sensor may have the name of an input
            k = int(np.argmax(conflicts))
            raise errors.SampleError(
                f"input '{name}' of member '{self.members[k]}' is {before[k]:g} among the readings "
                f"and {column[k]:g} among the inputs; give one of them."
            )
        return np.where(np.isnan(column), before, column)

    def _by_name(self, z: Any) -> tuple[Array, Array | None, Array, dict[str, Array]]:
        hidden = self.validation.names if self.validation else ()
        channels, sensors = self._member.channels, (*self.observed.names, *hidden)
        noise_of = dict(zip(map(noise_channel, sensors), sensors, strict=True))
        for name in z:
            if name not in channels and name not in noise_of:
                raise errors.SampleError(
                    f"unknown channel '{name}'; this fleet has {list(channels)}."
                )
        columns = {name: self._column(name, values) for name, values in z.items()}
        missing = np.full(len(self), np.nan)

        def table(names: Sequence[str]) -> Array:
            rows = [columns.get(name, missing) for name in names]
            return np.reshape(rows, (len(names), len(self))).T

        for name in noise_of.keys() & columns.keys():
            _check_positive(noise_of[name], columns[name])
        noise = table([noise_channel(name) for name in self.observed.names])
        named = {name: columns[name] for name in self.inputs if name in columns}
        return table(self.observed.names), noise, table(hidden), named

    def _by_place(self, z: Any) -> tuple[Array, Array | None, Array, dict[str, Array]]:
        array, noise = _numbers("z", z), None
        expected, names = (len(self), self.observed.size), self.observed.names
        if array.shape == (*expected, 2):
            array, noise = array[:, :, 0], array[:, :, 1]
            for name, column in zip(names, noise.T, strict=True):
                _check_positive(name, column)
        if array.shape != expected:
            raise errors.SampleError(
                f"z has shape {array.shape}; {expected[0]} members with {expected[1]} sensors each "
                f"need {expected}, NaN where a sample is missing."
            )
        for name, column in zip(names, array.T, strict=True):
            self._refuse_infinite(name, column)
        # A sample without names contains no values of validation sensors.
        hidden = len(self.validation.names) if self.validation else 0
        return array, noise, np.full((len(self), hidden), np.nan), {}

    def _column(self, name: str, values: ArrayLike) -> Array:
        """Return the validated values of a channel, shape (members,)."""
        what = f"channel '{name}'"
        array = _numbers(what, in_order_of(self.members, values, what))
        if array.shape not in ((), (len(self),)):
            raise errors.SampleError(
                f"channel '{name}' has shape {array.shape}; give one number for all, or "
                f"{len(self)}, one for each member."
            )
        column = np.broadcast_to(array, (len(self),)).copy()
        self._refuse_infinite(name, column)
        return column

    def _refuse_infinite(self, name: str, column: Array) -> None:
        if np.isinf(column).any():
            member = self.members[int(np.argmax(np.isinf(column)))]
            raise errors.SampleError(
                f"channel '{name}' of member '{member}' is infinite; send NaN for a missing sample."
            )

    def _filled(self, named: Mapping[str, Array]) -> tuple[Array, dict[str, Mask]]:
        """Return all inputs, (members, channels), and channel -> members that hold its value."""
        values, held = np.full((len(self), len(self.inputs)), np.nan), {}
        for k, name in enumerate(self.inputs):
            column = named.get(name, values[:, k])
            missing = np.isnan(column)
            if name not in self._member._channels.optional and missing.any():
                column = np.where(missing, self._so_far.known[:, k], column)
                if np.isnan(column).any():
                    member = self.members[int(np.argmax(np.isnan(column)))]
                    raise errors.MissingInputError(
                        f"input '{name}' of member '{member}' has no value in the first sample; "
                        "start the stream where every member has one."
                    )
                if name not in self.problem.control.held.last:  # else the held value is exact
                    held[name] = missing
            values[:, k] = column
        return values, held

    @cached_property
    def fingerprint(self) -> Fingerprint:
        """Fingerprint of the problem, stored in checkpoints; computed on first access."""
        return self._member.fingerprint.of_members(self._q0, self._u0, self._errors)

    @cached_property
    def header(self) -> dict[str, Any]:
        """Properties that must agree between a fleet and a checkpoint."""
        return {
            "format": FORMAT,
            "law": type(self.law).__name__,
            "n": self.model.X.dim,
            "m": self.model.Q.dim,
            "members": list(self.members),
            "sensors": list(self.observed.names),
            "channels": list(self.inputs),
            "together": self.together,
        }

    def check(self, header: Mapping[str, Any], leaves: Mapping[str, Array], where: str) -> None:
        """Raise `RunError` if a checkpoint is of another fleet; `where` names it in messages."""
        different = [key for key, value in self.header.items() if header.get(key) != value]
        if difference := different[0] if different else self.fingerprint.differing(leaves):
            raise errors.RunError(
                f"{where} was saved with another {difference}; build the fleet as it was then."
            )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file, from which `load` continues with bit-identical numbers."""
        checkpoint.write(path, self.dump())

    def dump(self) -> bytes:
        """Return the state as bytes, in the format of `save`."""
        header = {**self.header, "begun": self._state is not None}
        leaves = {"samples": self._samples, **self.ends, **self.fingerprint.leaves}
        if self._state is not None:
            state = checkpoint.flatten(self._state)
            leaves |= {f"state/{path}": leaf for path, leaf in state.items()}
        return checkpoint.packed(header, leaves)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continue from a saved state; the fleet must be built with the same arguments.

        Raises `RunError`: the file is damaged or of another fleet.
        """
        self.restore(checkpoint.read(path), str(path))

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Continue from the bytes of `dump`; `where` names them in the errors listed at `load`."""
        header, leaves = checkpoint.unpacked(content, where)
        self.check(header, leaves, where)
        state = None
        try:
            if header["begun"]:
                moments = self._moments(self._so_far.t, np.zeros((len(self), len(self.inputs))))
                template = self._engine.start(self._q0, self._u0, moments)
                stored = {path.removeprefix("state/"): leaf for path, leaf in leaves.items()}
                state = self._engine.restored(template, stored)
            so_far, samples = self._so_far.restored(leaves), int(leaves["samples"])
        except (KeyError, ValueError) as error:
            raise errors.RunError(
                f"{where} does not fit this fleet ({error}): build it with the law's options as "
                "they were when it was saved."
            ) from error
        self._state, self._so_far, self._samples = state, so_far, samples
        self._begin_without_inputs()


def _member_names(members: int | Sequence[str]) -> tuple[str, ...]:
    """Return the names of the members; the default names are numbers from 0."""
    if isinstance(members, str) or not isinstance(members, int | Iterable):
        raise errors.ConfigurationError(
            f"members: got {members!r}; expected their count, or a list of their names."
        )
    names = tuple(map(str, range(members)) if isinstance(members, int) else members)
    if not names:
        raise errors.ConfigurationError("a fleet needs at least one member.")
    if len(set(names)) < len(names):
        raise errors.ConfigurationError("the names of the members of a fleet must differ.")
    return names


def _check_positive(name: str, noise: Array) -> None:
    """Raise `SampleError` for a standard deviation that is neither positive nor NaN."""
    valid = np.isnan(noise) | (noise > 0.0) & np.isfinite(noise)
    for value in noise[~valid].tolist():
        check_noise(name, value)


def _numbers(what: str, values: ArrayLike) -> Array:
    try:
        if np.asarray(values).dtype.kind in "USb":
            raise TypeError
        return numbers(values, what).copy()
    except (TypeError, ValueError, errors.SampleError):
        raise errors.SampleError(f"{what} holds something that is not a number.") from None
