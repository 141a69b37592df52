"""Identifier: sequential estimation of unknowns and state, one call for each sample."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from livepde import checkpoint
from livepde.checkpoint import Fingerprint, fingerprint
from livepde.dates import stamp_of
from livepde.errors import ConfigurationError, MissingInputError, RunError, SampleError
from livepde.estimate import Estimate
from livepde.fem import Inputs, Moment
from livepde.forecast import Forecast, ahead, future_times, seen_rows
from livepde.laws import (
    AnyLaw,
    Belief,
    Problem,
    Report,
    SensitivityLaw,
    Status,
    numerical,
    stepped,
)
from livepde.laws.later import then
from livepde.laws.step_diagnostics import Diagnostics
from livepde.laws.verdict import with_assumed_start
from livepde.linalg import Array, nonfinite_allowed
from livepde.model import Model
from livepde.observation import Observation
from livepde.samples import Channels, Readings, numbers
from livepde.showing import listed, options_of
from livepde.start import (
    assumes_zero,
    check_ignored,
    check_kinds,
    check_parts,
    check_start,
    stated_problem,
    time_option,
    with_sensors,
)
from livepde.stepping import Advance, Between, End, Held, Interval, Scheme
from livepde.stream_runs import StreamRuns
from livepde.taken import TakenSamples
from livepde.verdict import Verdict

FORMAT = 14  # version of the checkpoint format


class Identifier(StreamRuns):
    """Estimate the unknowns and the state of a model, sample by sample.

    Parameters
    ----------
    model
        The process.
    observation
        Observation operator of the assimilated sensors.
    law
        Update law of the estimates; default `SensitivityLaw()`, which uses the noise of the
        sensors and the priors of the unknowns.
    q0, u0
        Initial values: numbers, functions of x, coefficients, or mappings from names to those. A
        number as u0 applies to all components of the state; a mapping requires each of them. q0
        defaults to the prior mean, u0 to the initial state of the model (`initial`) or zero. If
        there is no sample at t0, the value of u0 on a boundary is the initial value of its channel,
        unless u0 is left out or varies along that boundary.
    t0
        Initial time. A first sample at exactly t0 takes no step; a law may update the unknowns of
        the initial state with it. If there is none, channels of the model without a known value
        at t0 hold their first value over the first interval. The verdict and `Estimate.held` list
        them.
    validation
        Sensors that are predicted but never assimilated. Large errors count against the verdict.
    ignored
        Names of validation sensors, such as a faulty one, that never affect the verdict.
    scheme, dt_max
        Time scheme, default `Law.scheme`, and longest substep: a longer interval between samples
        is divided.
    halvings
        Maximum number of successive halvings of a failed substep, before the status of the step is
        a failure. 0: no substep is halved, and the first substeps are not graded as they otherwise
        are for laws with a covariance (`Advance.start`).
    assimilate_from
        Samples before this time drive inputs and are compared with the model, not assimilated.
    between
        Input channel -> its behaviour between two readings. "line", the default: linear. "hold": a
        reading holds until the next reading, such as the state of a switch. "next": a reading is
        the mean since the previous reading, such as the mean power of an interval, or the setting
        of an actuator that is reported with the next sample.
    input_noise
        Channel of the model -> standard deviation of its noise, independent from sample to sample.
        Laws with a covariance include it in the uncertainty of the state.
    u0_from
        For a u0 computed from readings: channel -> derivative of u0 with respect to its reading at
        t0, such as a function of x. The noise of these readings becomes the uncertainty of u0, and
        they are not assimilated again. A pair (derivative, standard deviation) specifies the noise
        of the reading.
    u0_errors
        Independent errors of u0, each of one standard deviation, specified like u0, for example by
        the functions of `random_field`. Laws with a covariance estimate them with the unknowns.

    Raises
    ------
    ConfigurationError
        Parts that do not fit together.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    >>> sensors = lp.Points({"T_50": 0.5}, noise=0.01)
    >>> identifier = lp.Identifier(rod, sensors, u0=1.0)
    >>> for t, reading in [(0.5, 0.93), (1.0, 0.81), (2.0, 0.64)]:
    ...     estimate = identifier.step(t, {"T_50": reading})
    >>> low, high = estimate["alpha"].interval()
    >>> low < estimate["alpha"].median < high
    True
    """

    def __init__(
        self,
        model: Model,
        observation: Observation,
        law: AnyLaw | None = None,
        *,
        q0: Any = None,
        u0: Any = None,
        t0: float = 0.0,
        validation: Observation | None = None,
        ignored: Collection[str] = (),
        scheme: Scheme | None = None,
        dt_max: float = np.inf,
        halvings: int = Advance.halvings,
        assimilate_from: float = -np.inf,
        between: Mapping[str, Between] | None = None,
        input_noise: Mapping[str, float] | None = None,
        u0_from: Mapping[str, Any] | None = None,
        u0_errors: Iterable[Any] = (),
    ) -> None:
        law = SensitivityLaw() if law is None else law
        check_parts(model, observation, law)
        check_kinds(validation, scheme)
        t0, dt_max = time_option("t0", t0), time_option("dt_max", dt_max)
        if not dt_max > 0:
            raise ConfigurationError(f"dt_max must be positive; got {dt_max}.")
        u0_errors = tuple(u0_errors)
        check_start(model, t0, u0, {"u0_from": u0_from, "u0_errors": u0_errors})
        # Unknowns of sensors, such as an offset, are added to the model: laws treat both equally.
        self.model = model = with_sensors(model, observation, validation)
        self.law = law
        spaces = (model.state_space, model.X, model.parameter_space)
        self.observed = observation.bind(*spaces)
        self.validation = validation.bind(*spaces) if validation is not None else None
        self.ignored = tuple(ignored)
        self._channels = Channels(model.channels, self.observed, self.validation)
        hidden = self._channels.hidden
        check_ignored(self.ignored, hidden)
        # Positions of moving sensors are not inputs of the process: they are always linear.
        optional = self._channels.optional
        held = Held.of(between or {}, [c for c in self.inputs if c not in optional])
        # Graded first steps keep the error of the time step small against the reported intervals.
        start = float(t0) if law.graded_start else math.nan
        control = Advance(scheme or law.scheme, dt_max, halvings, held, start=start)
        parts = model, self.observed, control, u0
        self.problem = stated_problem(
            *parts, input_noise=input_noise, u0_from=u0_from, u0_errors=u0_errors
        )
        self.assimilate_from = time_option("assimilate_from", assimilate_from)
        self._work = law.prepare(self.problem)
        self._q0 = model.initial_parameter(q0)
        self._u0 = model.initial_values(0.0 if u0 is None else u0)
        self._stated = model.boundary_readings(u0)  # at t0
        self._assumed = assumes_zero(model, u0)
        self._fingerprint = self._lazy_fingerprint()
        sizes = self.observed.size, len(hidden), len(self.inputs)
        self._so_far = TakenSamples.start(t0, *sizes)
        self._forget()

    def _forget(self) -> None:
        """Reset the state of the law to the start."""
        self._state: Any = None
        # With inputs, the initial state depends on boundary values of the first sample.
        if not self.inputs:
            self._begin(self._so_far.inputs)

    def _shown(self) -> tuple[str, Mapping[str, str]]:
        _, model = self.model._shown()
        rows = {name: text for name, text in model.items() if name.startswith("unknown ")}
        rows = {"equation": model["equation"], **rows, "law": options_of(self.law)}
        for kind, sensors in (("sensors", self.observed), ("validation", self.validation)):
            if sensors is not None:
                rows[kind] = listed(sensors.names)
        if self.inputs:
            rows["inputs"] = listed(self.inputs)
        rows["time"] = f"{self.t:g} {self.model.time_unit}".rstrip()
        if self.origin is not None:
            rows["time"] += f" since {self.origin} UTC"
        return f"Identifier after {self._so_far.samples} samples", rows

    def _lazy_fingerprint(self) -> Callable[[], Fingerprint]:
        parts = self.law, self.problem, self.validation
        return cache(partial(fingerprint, *parts, self._q0, self._u0))  # copies share it

    def _started(
        self, q0: Array, u0: Array, problem: Problem, work: Any, *, assumed: bool
    ) -> Identifier:
        """Return a copy of the identifier with another start.

        `q0`, `u0`: latent parameters and state, shapes (m,) and (n,). `problem`, `work`: the
        problem with this start, and its prepared data. `assumed`: u0 is the default, zero.
        """
        other = copy.copy(self)
        other._q0, other._u0 = q0, u0
        other.problem, other._work, other._assumed = problem, work, assumed
        other._fingerprint = other._lazy_fingerprint()
        return other

    def _placed(self, state: Any, ends: Mapping[str, Array], samples: int) -> Identifier:
        """Return a copy of the identifier in the state of a member, for `Fleet.identifier`.

        `state`: state of the law, None before the first sample. `ends`: values of the member in
        `Fleet.ends`. `samples`: number of its samples.
        """
        other = copy.copy(self)
        other._state = state
        names = self.inputs if state is not None else ()
        other._so_far = self._so_far.placed(ends, names, samples)
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Identifier:
        """Return an independent copy that shares model, law and matrices."""
        other = copy.copy(self)
        other._state, other._so_far = copy.deepcopy((self._state, self._so_far), memo)
        return other

    def _begin(self, inputs: Inputs) -> None:
        self._state = self._start(inputs)
        self._so_far = replace(self._so_far, inputs=inputs, known=inputs)

    def _start(self, inputs: Inputs) -> Any:
        moment = Moment(self.t, inputs)
        if self.model.form_initial is not None:
            u0 = self.model.initial_state(self._q0, moment)
        else:
            u0 = self.model.impose(self._u0, moment)
        return self.law.start(self._work, self._q0, u0, moment)

    @property
    def u0(self) -> Array:
        """Coefficients of the given initial state, without boundary values, shape (n,)."""
        return self._u0

    @property
    def t(self) -> float:
        """Time of the last accepted sample."""
        return self._so_far.t

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels that a sample may contain."""
        return self._channels.names

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the input channels of the model and the sensors."""
        return self._channels.inputs

    def step(
        self,
        t: float | datetime | np.datetime64,
        z: Readings,
        inputs: Mapping[str, float] | None = None,
    ) -> Estimate:
        """Process one sample and return the estimate at its time.

        Parameters
        ----------
        t
            Time in the unit of the model, or a date; the first date is at t0.
        z, inputs
            As in `Sample`: an array in the order of the sensors, or a mapping from channels. If a
            row of a pandas table has all channels, its other columns are ignored.

        Returns
        -------
        estimate
            If a step fails numerically, its `status` is the reason, and the next sample continues
            from the last successful state. With the status "departed", the state is advanced and
            the unknowns are held. Invalid input raises an error and changes nothing.

        Raises
        ------
        SampleError
            Wrong shape, text, infinity, or an unknown channel; a noise that is not positive, or a
            noise for a law that does not weigh readings.
        TimeOrderError
            t is not later than the previous sample.
        MissingInputError
            An input has no value yet. In later gaps the last value is held and counted. The
            position of a moving sensor may be missing and is never held.
        """
        return self._process(t, z, inputs)[0]

    def _process(
        self, t: Any, z: Readings, inputs: Mapping[str, float] | None
    ) -> tuple[Estimate, Interval]:
        """Process one sample; return the estimate and the interval passed to the law."""
        t, origin = self._so_far.counted(t, self.model.time_unit)
        t = self._so_far.time_of_next(t)
        measured, noise, validation, named = self._channels.parse(z, inputs)
        self._check_weighs(noise)
        values, held = self._filled(named)
        unstated = self._initialise(values, t) if self._state is None else ()
        # Spin-up: inputs drive the state, readings are only compared with it.
        assimilated = measured if t >= self.assimilate_from else np.full_like(measured, np.nan)
        earlier, names = self._so_far, self._channels.inputs
        missing = np.array(list(map(held.__contains__, names)), dtype=float)
        gaps = earlier.gaps.gaps(names, missing)
        end = End(t=t, inputs=values, z=assimilated, noise=noise, gaps=gaps)
        # The interval of a first sample at the initial time is empty: both its ends are the sample.
        interval = Interval.between(earlier.last if t > earlier.t else end, end)
        context = self.law, self._work, self.problem
        self._state, report = stepped(*context, self._state, interval)
        self._so_far = earlier.after(end, report.status, missing, self.problem.control, origin)
        held = (*held, *unstated)
        estimate = self._estimate(t, measured, validation, values, report, held, scored=True)
        return estimate, replace(interval, parts=report.parts)

    def _filled(self, named: Mapping[str, float]) -> tuple[Inputs, tuple[str, ...]]:
        """Return all inputs, and the names of missing inputs that hold their last value."""
        values, missing = self._channels.filled(named, self._so_far.known)
        # A value that holds until the next reading is not missing.
        held = self.problem.control.held.last
        return values, tuple(name for name in missing if name not in held) if held else missing

    def _opening(self, inputs: Inputs, t: float) -> Inputs:
        """Return the inputs at the initial time, given `inputs` of the first sample, at time t."""
        if t == self.t or not self._stated:
            return inputs
        return Inputs({**inputs, **self._stated})

    def _initialise(self, values: Inputs, t: float) -> tuple[str, ...]:
        """Initialise the state by the inputs of a first sample; raise `SampleError` if not finite.

        Return the channels of the model without a known value at the initial time.
        """
        inputs = self._opening(values, t)
        try:
            with nonfinite_allowed():
                state = self._start(inputs)
                finite = self.law.finite(self._work, state)
        except Exception as error:
            if numerical(error) is None:
                raise
            finite = False
        if not finite:
            raise SampleError(
                f"the sample at t = {t:g} gives no finite initial state: check the values of its "
                f"inputs {list(self.inputs)}; the run begins with the next one."
            )
        self._state = state
        # A "next" input requires no initial value: its first reading is the mean since then.
        known = {*self._stated, *self.problem.control.held.next}
        missing = [name for name in self.model.channels if name not in known]
        unstated = tuple(missing) if t > self.t else ()
        self._so_far = self._so_far.begun(inputs, unstated, self.inputs)
        return unstated

    @property
    def _place(self) -> tuple[Any, TakenSamples]:
        """Snapshot for `_return_to`; steps replace these values and never modify them."""
        return self._state, self._so_far

    def _return_to(self, place: tuple[Any, TakenSamples]) -> None:
        """Restore a snapshot from `_place`, which undoes all later samples."""
        self._state, self._so_far = place

    def _check_weighs(self, noise: Array | None) -> None:
        """Raise `SampleError` if readings have their own noise and the law does not weigh them."""
        if noise is not None and not self.law.weighs_readings():
            raise SampleError(
                f"{type(self.law).__name__} does not weigh readings by their noise: leave it out "
                "of the samples."
            )

    def _latent_belief(self) -> Belief:
        """Return the belief of the law, with q and its factor in latent coefficients.

        Latent coefficients are elements of `Model.Q`, for example logarithms or amplitudes.
        """
        belief: Belief = self.law.belief(self._work, self._state)
        return belief

    def _belief(self) -> Belief:
        return self.problem.physical(self._latent_belief())

    def _estimate(
        self,
        t: float,
        measured: Array,
        validation: Array,
        inputs: Inputs,
        report: Report,
        held: tuple[str, ...],
        *,
        scored: bool = False,
    ) -> Estimate:
        # A stored estimate keeps only the small state of the law; mean and factors are computed on
        # first access.
        latent, judge = self.law.deferred(self._work, self._state)
        problem, errors = self.problem, validation
        belief_of = latent if self.model.latent.plain else then(latent, problem.physical)
        if self.validation is not None:
            belief = belief_of()
            belief_of = lambda: belief  # noqa: E731
            predicted = self.validation.predict(belief.u, belief.q, Moment(t, inputs))
            errors = validation - predicted
            if scored and t >= self.assimilate_from:
                # Variance of the predicted values, without the noise of the sensors.
                rows = seen_rows(self.validation, belief, Moment(t, inputs))
                variance = np.zeros(len(errors)) if rows is None else (rows * rows).sum(axis=1)
                scores = self._so_far.validation.add(validation, predicted, variance)
                self._so_far = replace(self._so_far, validation=scores)
        return Estimate.deferred(
            belief_of,
            t=t,
            innovation=measured - report.predicted,
            validation_error=errors,
            status=report.status,
            steps=report.steps,
            diagnose=report.diagnose,
            held=held,
            space=self.model.parameter_space,
            state_space=self.model.state_space,
            judge=self._judge(judge, lambda: report.diagnostics),
            fit=self.law.fit(self._work, self._state),
        )

    def _judge(
        self, judge: Callable[[], Verdict], diagnose: Callable[[], Diagnostics[float]]
    ) -> Callable[[], Verdict]:
        """Return a function for the law's verdict with findings on steps, validation and gaps."""
        so_far = self._so_far
        validation, gaps, steps = so_far.validation, so_far.gaps, so_far.steps
        observed, ignored = self.validation, self.ignored
        names, units = ((), ()) if observed is None else (observed.names, observed.units)
        inputs = self._channels.inputs
        zero_start = self._assumed
        if not names and not steps.irregular and gaps.silent and not zero_start:
            return judge

        def found() -> Verdict:
            held_findings = gaps.findings(inputs, diagnose().shifts)
            verdict = judge().with_findings(
                [*steps.findings(), *validation.findings(names, ignored, units), *held_findings]
            )
            return with_assumed_start(verdict) if zero_start else verdict

        return found

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last accepted sample.

        Raises
        ------
        MissingInputError
            Model or sensors require inputs, and no sample has been processed yet.
        """
        if self._state is None:
            raise MissingInputError(
                f"No estimate before the first sample: it brings the inputs {list(self.inputs)}."
            )
        no_innovation = np.full(self.observed.size, np.nan)
        no_validation = np.full(self.validation.size if self.validation else 0, np.nan)
        belief = self._belief()
        so_far = self._so_far
        predicted = self.observed.predict(belief.u, belief.q, Moment(so_far.t, so_far.inputs))
        diagnose = partial(self.law.diagnosed, self._work, self._state)
        report = Report(Status(), predicted, diagnose=diagnose)
        return self._estimate(so_far.t, no_innovation, no_validation, so_far.inputs, report, ())

    def _settled(self, estimate: Estimate, *, columns: bool = True) -> Estimate:
        """Return the last estimate after a refit of all stored samples, for the end of a run.

        The identifier itself does not change. See `refit`.

        Parameters
        ----------
        columns
            If findings count against the estimates, test single columns for errors, such as values
            in another unit.
        """
        if self._state is None:
            return estimate
        state = self.law.settled(self._work, self._state)
        latent, judge = self.law.final(self._work, state, columns=columns)
        if state is self._state:
            diagnose_now = partial(self.law.diagnosed, self._work, state)
            return replace(estimate, judge=self._judge(judge, diagnose_now))

        def diagnose() -> Diagnostics[float]:
            # Diagnostics of the last sample are kept; the replaced ones depend on the new estimate.
            new = self.law.diagnosed(self._work, state)
            last = estimate.diagnostics
            return replace(
                last, shifts=new.shifts, log_evidence=new.log_evidence, bounded=new.bounded
            )

        return replace(
            estimate,
            belief=self.problem.physical(latent()),
            diagnose=diagnose,
            judge=self._judge(judge, diagnose),
            fit=self.law.fit(self._work, state),
        )

    def refit(self) -> Estimate:
        """Refit all stored samples, continue from the result, and return the estimate.

        The result is the most probable unknowns given these samples: see `livepde.laws.Refit`. If
        the law stores no samples, the estimate does not change.

        Raises
        ------
        MissingInputError
            Model or sensors require inputs, and no sample has been processed yet.
        """
        if self._state is not None:
            self._state = self.law.settled(self._work, self._state)
        return self.estimate()

    def forecast(self, times: ArrayLike, inputs: Mapping[str, ArrayLike] | None = None) -> Forecast:
        """Return predicted readings without further measurements; the identifier does not change.

        Moving unknowns evolve as in their prior, and standard deviations increase accordingly.

        Parameters
        ----------
        times
            Increasing numbers or dates after the last sample. The first may be the time of the last
            sample, for its readings.
        inputs
            Channel -> one value, or one for each time. The last value is held where one is missing
            (left out, NaN); the position of a moving sensor only at the time of the last sample.

        Raises
        ------
        SampleError
            Wrong shape, text, infinity, an unknown input, or too many substeps between two times.
        TimeOrderError
            Times that do not increase.
        MissingInputError
            An input has no value yet.

        Examples
        --------
        >>> import livepde as lp
        >>> from livepde.models import heat
        >>> model = heat(lp.interval(0.0, 1.0, 20), lp.Normal(0.1, std=0.05))
        >>> rod = lp.Identifier(model, lp.Points({"middle": 0.5}), lp.GradientLaw(), u0=20.0)
        >>> rod.forecast([1.0, 2.0])["middle"].round(6)
        array([20., 20.])
        """
        taken, unit = self._so_far, self.model.time_unit
        stated_times: Any = times
        if np.iterable(times) and stamp_of(next(iter(times), None)) is not None:
            stated_times = [taken.counted(time, unit)[0] for time in times]
        requested = np.atleast_1d(numbers(taken.counted(stated_times, unit)[0], "forecast: times"))
        t = future_times(requested, stated_times, taken.t, self.problem.control)
        planned = self._channels.planned(inputs, t, taken.t, taken.known)
        state, last = self._state, taken.last
        if state is None:
            opening = self._opening(planned[0], t[0])
            state, last = self._start(opening), replace(last, inputs=opening)
        empty = np.full(self.observed.size, np.nan)
        ends = [End(t=when, inputs=then, z=empty) for when, then in zip(t, planned, strict=True)]
        intervals = [Interval.between(start, stop) for start, stop in pairwise([last, *ends])]
        sensors = self._channels.sensors
        return ahead(self.law, self._work, self.problem, sensors, state, intervals)

    @property
    def fingerprint(self) -> Fingerprint:
        """Fingerprint of the problem, stored in its checkpoints; computed on first access."""
        return self._fingerprint()

    def _header(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "law": type(self.law).__name__,
            "n": self.model.X.dim,
            "m": self.model.Q.dim,
            "sensors": list(self.observed.names),
            "channels": list(self.inputs),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state to a file, from which `load` continues with bit-identical numbers."""
        checkpoint.write(path, self.dump())

    def dump(self) -> bytes:
        """Return the state as bytes, in the format of `save`."""
        header = {**self._header(), "begun": self._state is not None}
        leaves = self._so_far.leaves | self.fingerprint.leaves
        if self._state is not None:
            leaves |= checkpoint.flatten(self._state)
        return checkpoint.packed(header, leaves)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continue from a saved state; the identifier must be built with the same arguments.

        Raises
        ------
        RunError
            The file is damaged, or was saved for another problem: for example another model, prior,
            sensor position, boundary value or option of the law.
        """
        self.restore(checkpoint.read(path), str(path))

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Continue from the bytes of `dump`; `where` names them in the errors listed at `load`."""
        header, leaves = checkpoint.unpacked(content, where)
        # The identifier does not change until all parts of the checkpoint have been read.
        own_header = self._header()
        for key, value in own_header.items():
            if header.get(key) != value:
                if key == "format":
                    raise RunError(
                        f"{where} was saved by another version of livepde, in another format: "
                        "continue with that version, or start again."
                    )
                raise RunError(
                    f"{where} was saved with {key} = {header.get(key)!r}; this identifier has "
                    f"{value!r}. Build it as it was when it was saved."
                )
        if changes := self.fingerprint.differing(leaves):
            raise RunError(
                f"{where} was saved with another {changes}. Build the identifier as it was then, "
                "or start a new run."
            )
        state = None
        try:
            so_far = self._so_far.restored(leaves, self.inputs)
            if header["begun"]:
                template = self.law.init(self._work, self._q0, self._u0)
                state = checkpoint.rebuild(template, leaves)
        except (KeyError, ValueError) as error:
            raise RunError(
                f"{where} does not fit this identifier ({error}): build it with the law's options "
                "as they were when it was saved."
            ) from error
        self._state, self._so_far = state, so_far
        if state is None and not self.inputs:
            self._begin(so_far.inputs)
