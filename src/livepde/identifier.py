"""The only object with state: one call for every sample."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from functools import cache, partial
from itertools import pairwise
from numbers import Real
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from livepde import checkpoint
from livepde.checkpoint import Fingerprint, fingerprint
from livepde.dates import origin_at, since_1970, stamp_of
from livepde.errors import (
    ConfigurationError,
    LawError,
    MissingInputError,
    RunError,
    SampleError,
    TimeOrderError,
)
from livepde.fem import Inputs, Moment
from livepde.forecast import Forecast, ahead, seen_rows
from livepde.hindsight import Hindsight, LinearReadings
from livepde.laws import (
    AnyLaw,
    Belief,
    InitialReading,
    Law,
    Problem,
    Report,
    SensitivityLaw,
    Status,
    numerical,
    stepped,
)
from livepde.laws.later import then
from livepde.laws.step_diagnostics import Diagnostics
from livepde.laws.verdict import StepLedger
from livepde.linalg import Array, nonfinite_allowed
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.records import Layout
from livepde.result import Estimate, Result
from livepde.samples import (
    Channels,
    Readings,
    Sample,
    check_noise,
    is_tabular,
    number,
    numbers,
    sample_of,
)
from livepde.showing import Shown, listed, options_of
from livepde.stepping import MOST_SUBSTEPS, Advance, Between, End, Held, Interval, Scheme
from livepde.units import conversion
from livepde.verdict import InputLedger, ValidationLedger, Verdict

if TYPE_CHECKING:
    import xarray as xr

FORMAT = 13  # of the checkpoint
INPUTS = ("inputs", "known")  # of the last accepted sample, and those that hold now


class Identifier(Shown):
    """Identifies parameter and state of a model, sample by sample.

    Parameters
    ----------
    model
        The process.
    observation
        Observation by the assimilated sensors.
    law
        Update law of the estimates; default `SensitivityLaw()`, which uses the noise of the
        sensors and the priors of the unknowns.
    q0, u0
        Initial values: numbers, functions of x, coefficients, or for several unknowns a mapping.
        A number as u0 is the value of all components of the state; a mapping names each of them.
        q0 defaults to the prior mean, u0 to the initial state of the model (`initial`), else zero.
        Without a sample at t0, boundary channels begin with the values that u0 has on their
        boundaries. A u0 that is left out, or varies along such a boundary, states none.
    t0
        Initial time. A first sample at exactly t0 describes the start and takes no step; a law
        may update the unknowns of the initial state by it. Without one, channels of the model
        whose value at t0 is not known hold their first one over the first interval: the estimate
        (`Estimate.held`) and the verdict name them.
    validation
        Sensors that are never assimilated, only predicted: a run that misses them is doubted.
    ignored
        Names of those of `validation` that are only shown, such as a faulty sensor: how the run
        predicts them never counts against it.
    scheme, dt_max
        Time scheme, default that of the law (`Law.scheme`); a longer interval between samples is
        divided into substeps.
    halvings
        A substep that is not solved is halved at most this often, before the step is a failed
        status. 0: that at once, as where steps are to be those of the samples and no others; nor
        are the first ones graded then, as for laws with a covariance (`Advance.start`).
    assimilate_from
        Samples before this time drive inputs and are scored, but not assimilated.
    between
        Input channel -> how it behaves between two readings. "line", the default: it changes
        linearly. "hold": a reading holds until the next one, such as the state of a switch. "next":
        a reading is the mean since the last one, such as the mean power of an interval, or the
        setting of an actuator that is reported with the sample after it.
    input_noise
        Channel of the model -> standard deviation of its noise, independent from sample to sample:
        it makes the state less certain, for laws that have a covariance.
    u0_from
        Channel -> derivative of u0 in its reading at t0, in a form as that of u0 (a function of x,
        say): for a u0 that was made of readings. Their noise becomes the uncertainty of u0, and
        they are not assimilated once more. A pair (derivative, standard deviation) states the noise
        of this reading.
    u0_errors
        Independent errors of u0 itself, each one standard deviation, in forms as that of u0: the
        functions of `random_field`, say. They are learned with the unknowns, for laws that have a
        covariance.

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
        _check_parts(model, observation, law)
        t0, dt_max = _time("t0", t0), _time("dt_max", dt_max)
        if not dt_max > 0:
            raise ConfigurationError(f"dt_max must be positive; got {dt_max}.")
        for what, part, kind, expected in (
            ("validation", validation, Observation, "an observation, such as Points"),
            ("scheme", scheme, Scheme, "a time scheme, such as Alexander2()"),
        ):
            if part is not None and not isinstance(part, kind):
                raise ConfigurationError(f"{what}: got {part!r:.80}; expected {expected}.")
        u0_errors = tuple(u0_errors)
        _check_start(model, t0, u0, {"u0_from": u0_from, "u0_errors": u0_errors})
        # Unknowns of the sensors, as an offset, join those of the model: laws treat both alike.
        known = model.parameter_space.unknowns
        own = {name: item for name, item in observation.unknowns.items() if name not in known}
        model = model.with_unknowns(own) if own else model
        self.model = model
        self.law = law
        spaces = (model.state_space, model.X, model.parameter_space)
        self.observed: Observed = observation.bind(*spaces)
        self.validation = validation.bind(*spaces) if validation is not None else None
        self.ignored = tuple(ignored)
        known_names = self.validation.names if self.validation is not None else ()
        for name in self.ignored:
            if name not in known_names:
                raise ConfigurationError(
                    f"ignored: '{name}' is none of the sensors in validation, {list(known_names)}."
                )
        self._channels = Channels(model.channels, self.observed, self.validation)
        # Positions of moving sensors are no inputs of the process: they move on lines.
        held = Held.of(between or {}, [c for c in self.inputs if c not in self._optional_inputs])
        # The first steps after the start are short where intervals have to hold their error.
        start = float(t0) if law.graded_start else math.nan
        control = Advance(scheme or law.scheme, dt_max, halvings, held, start=start)
        noise, readings = (
            self._input_noise(input_noise or {}),
            self._initial_readings(u0_from or {}),
        )
        errors = self._initial_errors(u0_errors)
        self.problem = Problem(model, self.observed, control, noise, readings, errors, u0)
        self.assimilate_from = _time("assimilate_from", assimilate_from)
        self._work = law.prepare(self.problem)
        self._q0 = model.initial_parameter(q0)
        self._u0 = model.initial_values(0.0 if u0 is None else u0)
        self._stated = model.boundary_readings(u0)  # at t0
        self._state: Any = None
        self._t = float(t0)
        self._origin = math.nan  # seconds from 1970 to t = 0, where times are dates
        self._z = np.full(self.observed.size, np.nan)
        self._inputs: Inputs = Inputs({})
        self._known = self._inputs  # the same, or what holds since the sample of a failed step
        self._samples = 0
        self._fingerprint = self._lazy_fingerprint()
        self._validation = ValidationLedger.start(self.validation.size if self.validation else 0)
        self._gaps = InputLedger.start(len(self.inputs))
        self._steps = StepLedger.start()
        # Boundary values may come with the first sample; the initial state has to wait for them
        # then.
        if not self.inputs:
            self._begin(self._inputs)

    def _shown(self) -> tuple[str, Mapping[str, str]]:
        _, model = self.model._shown()
        rows = {name: text for name, text in model.items() if name.startswith("unknown ")}
        rows = {"equation": model["equation"], **rows, "law": options_of(self.law)}
        for kind, sensors in (("sensors", self.observed), ("validation", self.validation)):
            if sensors is not None:
                rows[kind] = listed(sensors.names)
        if self.inputs:
            rows["inputs"] = listed(self.inputs)
        rows["time"] = f"{self._t:g} {self.model.time_unit}".rstrip()
        if self.origin is not None:
            rows["time"] += f" since {self.origin} UTC"
        return f"Identifier after {self._samples} samples", rows

    def _lazy_fingerprint(self) -> Callable[[], Fingerprint]:
        parts = self.law, self.problem, self.validation
        return cache(partial(fingerprint, *parts, self._q0, self._u0))  # copies share it

    def _started(self, q0: Array, u0: Array, errors: Array) -> Identifier:
        """Return an identifier of the same parts with another start; for `Fleet.identifier`.

        Latent parameter, state and its own errors have the shapes (m,), (n,) and (errors, n).
        """
        other = copy.copy(self)
        other._q0, other._u0 = q0, u0
        other.problem = replace(self.problem, initial_errors=errors)
        other._fingerprint = other._lazy_fingerprint()
        return other

    def _placed(self, state: Any, ends: Mapping[str, Array], samples: int) -> Identifier:
        """Return an identifier of the same parts in another state; for `Fleet.identifier`.

        `state` is None before the first sample; `ends` is that of one member in `Fleet.ends`.
        """
        other = copy.copy(self)
        other._state, other._samples = state, samples
        other._t, other._z = float(ends["t"]), ends["z"]
        other._gaps = InputLedger(
            ends["held_counts"].astype(np.int64), ends["held"], ends["unstated"]
        )
        other._steps = StepLedger(ends["steps"].astype(np.int64), np.zeros(2))
        names = self.inputs if state is not None else ()
        other._inputs, other._known = (
            Inputs(dict(zip(names, ends[part].tolist(), strict=bool(names)))) for part in INPUTS
        )
        return other

    def _input_noise(self, given: Mapping[str, float]) -> dict[str, float]:
        """Return the noise of input channels, checked."""
        stds: Mapping[str, Any] = given
        for name, std in stds.items():
            if name not in self.model.channels:
                raise ConfigurationError(
                    f"input_noise: the model has no channel '{name}'; it has "
                    f"{list(self.model.channels)}. Specify the noise of sensors in the observation."
                )
            if not (isinstance(std, Real) and 0.0 < float(std) < math.inf):
                raise ConfigurationError(
                    f"input_noise of '{name}' must be a positive number; got {std!r}."
                )
        return dict(given)

    def _initial_readings(self, u0_from: Mapping[str, Any]) -> dict[str, InitialReading]:
        """Return the readings that u0 was made of, each with the derivative of u0 in it."""
        known = {*self.observed.names, *self.model.channels}
        for name in u0_from:
            if name not in known:
                raise ConfigurationError(
                    f"u0_from: '{name}' is neither an assimilated sensor nor a channel of the "
                    f"model; these are {sorted(known)}."
                )
        space = self.model.state_space
        found = {}
        for name, given in u0_from.items():
            weight, noise = given if isinstance(given, tuple) else (given, math.nan)
            found[name] = InitialReading(space.interpolate(weight), check_noise(name, noise))
        return found

    def _initial_errors(self, u0_errors: Iterable[Any]) -> Array:
        """Return coefficients of the errors of u0, shape (errors, n)."""
        space = self.model.state_space
        found = np.array([space.interpolate(error) for error in u0_errors])
        found = found.reshape(-1, self.model.X.dim)
        if not np.isfinite(found).all():
            raise ConfigurationError("u0_errors: an error of u0 is not finite; give finite values.")
        return found

    def __deepcopy__(self, memo: dict[int, Any]) -> Identifier:
        """Return an identifier that continues independently; model, law and matrices are shared."""
        other = copy.copy(self)
        other._state, other._z = copy.deepcopy((self._state, self._z), memo)
        return other

    def _begin(self, inputs: Inputs) -> None:
        self._state = self._start(inputs)
        self._inputs = self._known = inputs

    def _start(self, inputs: Inputs) -> Any:
        moment = Moment(self._t, inputs)
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
        return self._t

    @property
    def origin(self) -> datetime | None:
        """The date of t = 0 in UTC, once a sample with a date was taken; the first is at t0."""
        return None if math.isnan(self._origin) else origin_at(self._origin)

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel a sample may name."""
        return self._channels.names

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that the model and the sensors read."""
        return self._channels.inputs

    @property
    def _optional_inputs(self) -> frozenset[str]:
        """Inputs that may be missing: positions of moving sensors."""
        return self._channels.optional

    def step(
        self,
        t: float | datetime | np.datetime64,
        z: Readings,
        inputs: Mapping[str, float] | None = None,
    ) -> Estimate:
        """Take one sample and return the estimate at its time.

        Parameters
        ----------
        t
            Time in the unit of the model, or a date; the first date is at t0.
        z, inputs
            As of a `Sample`: an array in the order of the sensors, or a mapping by names. In a row
            of a pandas table that has all channels, other columns are ignored.

        Returns
        -------
        estimate
            A step that fails numerically changes nothing and says so in its `status`; the next
            sample tries again from the last good state. One with the status "departed" takes the
            sample and holds the unknowns. Bad input raises and changes nothing.

        Raises
        ------
        SampleError
            Wrong shape, text, infinity, or an unknown channel; a noise that is not positive, or one
            for a law that does not weigh readings.
        TimeOrderError
            t is not later than the sample before.
        MissingInputError
            An input has no value yet; a later gap holds the last value and is noted. The position
            of a moving sensor may be missing, and is not held.
        """
        return self._taken(t, z, inputs)[0]

    def _taken(
        self, t: Any, z: Readings, inputs: Mapping[str, float] | None
    ) -> tuple[Estimate, Interval]:
        """Take one sample; return the estimate, and the interval that the law was given."""
        t, origin = self._counted(t)
        t = self._time_of_next(t)
        measured, noise, validation, named = self._channels.parse(z, inputs)
        if noise is not None:
            self._check_weighs(noise)
        values, held = self._filled(named)
        unstated = self._begun_by(values, t) if self._state is None else ()
        # Spin-up: inputs drive the state, readings are only compared with it.
        used = measured if t >= self.assimilate_from else np.full_like(measured, np.nan)
        names, gaps = self._channels.inputs, {}
        if names:
            missing = np.array(list(map(held.__contains__, names)), dtype=float)
            if held or np.count_nonzero(self._gaps.held):
                gaps = self._gaps.gaps(names, missing)
        now = End(t=t, inputs=values, z=used, noise=noise, gaps=gaps)
        # A first sample at the initial time has an empty interval: both ends are the sample.
        interval = Interval.between(self._last if t > self._t else now, now)
        parts = self.law, self._work, self.problem
        self._state, report = stepped(*parts, self._state, interval)
        self._samples += 1
        self._origin = origin
        stretched = self.problem.control.stretches(t - self._t)
        self._steps = self._steps.add(report.status.code, t - self._t, stretched)
        if report.status.taken:
            if names:
                self._gaps = self._gaps.add(t - self._t, missing)
            self._t, self._z, self._inputs = t, used, values
            self._known = values
        else:  # a value that holds until the next reading may not be read again
            last = {name: values[name] for name in self.problem.control.held.last}
            self._known = Inputs({**self._known, **last})
        held = (*held, *unstated)
        estimate = self._estimate(t, measured, validation, values, report, held, scored=True)
        return estimate, replace(interval, parts=report.parts)

    def _filled(self, named: Mapping[str, float]) -> tuple[Inputs, tuple[str, ...]]:
        """Return all inputs, and those whose missing value is replaced by the last one."""
        values, missing = self._channels.filled(named, self._known)
        # A value that holds until the next reading is not missing.
        known = self.problem.control.held.last
        return values, tuple(name for name in missing if name not in known) if known else missing

    @property
    def _last(self) -> End:
        """The last accepted sample, where the next interval begins."""
        return End(t=self._t, inputs=self._inputs, z=self._z)

    def _counted(self, t: Any) -> tuple[Any, float]:
        """Return a time in the unit of the model, and the origin from which a date counts."""
        if type(t) is float or (stamp := stamp_of(t)) is None:
            return t, self._origin
        return self._since(stamp)

    def _since(self, stamp: float) -> tuple[float, float]:
        """Return the time of a date in seconds since 1970, and the origin from which it counts."""
        unit = self.model.time_unit
        if not unit:
            raise ConfigurationError(
                "the time is a date, and the model has no unit of time: name it, as in "
                'Model(..., time_unit="s").'
            )
        second = conversion("s", unit, "time_unit").factor
        if not self._samples:
            return self._t, stamp - self._t / second
        if math.isnan(self._origin):
            raise SampleError(
                "the time is a date, and those of the samples before are numbers: give numbers."
            )
        return (stamp - self._origin) * second, self._origin

    def _time_of_next(self, t: float) -> float:
        """Return the time of the next sample, checked; only the first may be at the start."""
        if type(t) is not float or not math.isfinite(t):
            t = number(t, "time t")
            if math.isnan(t):
                raise SampleError("time t is NaN; give the time of the sample.")
        if t < self._t and not self._samples:
            raise TimeOrderError(
                f"the sample at t = {t!r} is before the initial time t0 = {self._t!r}: set `t0`."
            )
        if t < self._t or (t == self._t and self._samples):
            raise TimeOrderError(
                f"the sample at t = {t!r} is not later than the last one at t = {self._t!r}: "
                "sort the stream, and drop repeated samples."
            )
        return t

    def _opening(self, inputs: Inputs, t: float) -> Inputs:
        """Return the inputs at the initial time, from those at t of the first sample."""
        if t == self._t or not self._stated:
            return inputs
        return Inputs({**inputs, **self._stated})

    def _begun_by(self, values: Inputs, t: float) -> tuple[str, ...]:
        """Begin with a first sample, unless no finite state comes of its inputs.

        Return the channels of the model that have no value at the initial time.
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
        self._state, self._inputs, self._known = state, inputs, inputs
        # The mean over the first interval comes with its end.
        known = {*self._stated, *self.problem.control.held.next}
        missing = [name for name in self.model.channels if name not in known]
        unstated = tuple(missing) if t > self._t else ()
        mask = np.array([name in unstated for name in self.inputs], dtype=float)
        self._gaps = replace(self._gaps, unstated=mask)
        return unstated

    @property
    def _place(self) -> tuple[Any, ...]:
        """Snapshot for `return_to`, of values that a step replaces but never changes in place."""
        ledgers = self._validation, self._gaps, self._steps, self._origin
        inputs = self._inputs, self._known
        return self._state, self._t, self._z, inputs, self._samples, ledgers

    def _return_to(self, place: tuple[Any, ...]) -> None:
        """Go back to a snapshot by `place`, as if no sample had been taken since then."""
        self._state, self._t, self._z, inputs, self._samples, ledgers = place
        self._inputs, self._known = inputs
        self._validation, self._gaps, self._steps, self._origin = ledgers

    def _check_weighs(self, noise: Array | None) -> None:
        """Refuse the noise of readings where the law does not weigh them; None: there is none."""
        if noise is not None and not self.law.weighs_readings():
            raise SampleError(
                f"{type(self.law).__name__} does not weigh readings by their noise: leave it out "
                "of the samples."
            )

    def _latent_belief(self) -> Belief:
        """Return the belief of the law: q and its factor in latent coefficients.

        Those are the coefficients of `Model.Q`: of logarithms, say, or of harmonics.
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
        # Estimates that are kept hold the small state of the law; mean and factors are computed
        # when read.
        latent, judge = self.law.deferred(self._work, self._state)
        problem, error = self.problem, validation
        read = latent if self.model.latent.plain else then(latent, problem.physical)
        if self.validation is not None:
            belief = read()
            read = lambda: belief  # noqa: E731
            predicted = self.validation.predict(belief.u, belief.q, Moment(t, inputs))
            error = validation - predicted
            if scored and t >= self.assimilate_from:
                # Of the predicted values, without the noise of the sensors.
                rows = seen_rows(self.validation, belief, Moment(t, inputs))
                variance = np.zeros(len(error)) if rows is None else (rows * rows).sum(axis=1)
                self._validation = self._validation.add(validation, predicted, variance)
        return Estimate.deferred(
            read,
            t=t,
            innovation=measured - report.predicted,
            validation_error=error,
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
        """Return the verdict of the law with the findings on steps, validation sensors and gaps."""
        validation, gaps, steps = self._validation, self._gaps, self._steps
        known, ignored = self.validation, self.ignored
        names, units = ((), ()) if known is None else (known.names, known.units)
        inputs = self._channels.inputs
        if not names and not steps.irregular and gaps.silent:
            return judge

        def found() -> Verdict:
            held = gaps.findings(inputs, diagnose().shifts)
            return judge().with_findings(
                [*steps.findings(), *validation.findings(names, ignored, units), *held]
            )

        return found

    def estimate(self) -> Estimate:
        """Return the estimate at the time of the last accepted sample.

        Raises
        ------
        MissingInputError
            Model or sensors need channels and no sample has come yet.
        """
        if self._state is None:
            raise MissingInputError(
                f"No estimate before the first sample: it brings the inputs {list(self.inputs)}."
            )
        nothing = np.full(self.observed.size, np.nan)
        hidden = np.full(self.validation.size if self.validation else 0, np.nan)
        belief = self._belief()
        moment = Moment(self._t, self._inputs)
        predicted = self.observed.predict(belief.u, belief.q, moment)
        known = partial(self.law.diagnosed, self._work, self._state)
        report = Report(Status(), predicted, diagnose=known)
        return self._estimate(self._t, nothing, hidden, self._inputs, report, ())

    def _settled(self, estimate: Estimate, *, columns: bool = True) -> Estimate:
        """Return the last estimate after a fit of all stored samples, for the end of a run.

        The identifier does not change: the next sample finds it as it was. See `refit`.

        Parameters
        ----------
        columns
            Whether its verdict looks for errors of single columns, such as one in another unit,
            where something speaks against the estimates.
        """
        if self._state is None:
            return estimate
        state = self.law.settled(self._work, self._state)
        latent, judge = self.law.final(self._work, state, columns=columns)
        if state is self._state:
            known = partial(self.law.diagnosed, self._work, state)
            return replace(estimate, judge=self._judge(judge, known))

        def diagnose() -> Diagnostics[float]:
            # What the last sample brought stays; the shifts belong to the new estimate.
            now = self.law.diagnosed(self._work, state)
            before = estimate.diagnostics
            return replace(
                before, shifts=now.shifts, log_evidence=now.log_evidence, bounded=now.bounded
            )

        return replace(
            estimate,
            belief=self.problem.physical(latent()),
            diagnose=diagnose,
            judge=self._judge(judge, diagnose),
            fit=self.law.fit(self._work, state),
        )

    def refit(self) -> Estimate:
        """Fit all stored samples again, continue from there, and return the estimate.

        The most probable unknowns given these samples: see `livepde.laws.Refit`. For a law that
        stores no samples the estimate is as it was.

        Raises
        ------
        MissingInputError
            As for `estimate`.
        """
        if self._state is not None:
            self._state = self.law.settled(self._work, self._state)
        return self.estimate()

    def forecast(self, times: ArrayLike, inputs: Mapping[str, ArrayLike] | None = None) -> Forecast:
        """Return predicted readings if nothing more is measured; nothing is learned.

        Unknowns that evolve follow their prior, and standard deviations grow with them.

        Parameters
        ----------
        times
            Later than the last sample and increasing, numbers or dates; the first may be the time
            of this sample, for the readings at present.
        inputs
            Channel -> its value, or one for each time. A missing value (left out, NaN) is the last
            one held; the position of a moving sensor only at the time of the last sample.

        Raises
        ------
        SampleError
            Another shape, text, infinity, an unknown input, or too many substeps between two times.
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
        if np.iterable(times) and stamp_of(next(iter(times), None)) is not None:
            times = [self._counted(time)[0] for time in times]
        t = np.atleast_1d(numbers(self._counted(times)[0], "forecast: times"))
        if t.ndim != 1 or not np.isfinite(t).all():
            raise SampleError(f"forecast: times must be finite numbers; got {times!r}.")
        if not len(t) or t[0] < self._t or np.any(np.diff(t) <= 0.0):
            raise TimeOrderError(
                f"forecast: times must increase from the last sample at t = {self._t!r} on; got "
                f"{t.tolist()}."
            )
        far = np.diff(t, prepend=self._t)
        if any(map(self.problem.control.stretches, far.tolist())):
            raise SampleError(
                f"forecast: two times are more than {MOST_SUBSTEPS} substeps of dt_max = "
                f"{self.problem.control.dt_max:g} apart; give times in between, or a longer dt_max."
            )
        planned = self._channels.planned(inputs, t.tolist(), self._t, self._known)
        state, last = self._state, self._last
        if state is None:
            opening = self._opening(planned[0], float(t[0]))
            state, last = self._start(opening), replace(last, inputs=opening)
        blank = np.full(self.observed.size, np.nan)
        ends = [
            End(t=when, inputs=then, z=blank)
            for when, then in zip(t.tolist(), planned, strict=True)
        ]
        intervals = [Interval.between(start, stop) for start, stop in pairwise([last, *ends])]
        sensors = self._channels.sensors
        return ahead(self.law, self._work, self.problem, sensors, state, intervals)

    def run(
        self,
        stream: Any,
        *,
        on_estimate: Callable[[Estimate], object] | None = None,
        progress: bool = False,
        total: int | None = None,
        fields_every: int = 1,
        time: str | None = None,
        time_unit: str | None = None,
        columns: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        strict: bool | None = None,
    ) -> Result:
        """Take every sample of a table, a file or a stream, and collect the estimates.

        Parameters
        ----------
        stream
            A pandas table or an xarray dataset with a column for each channel; the name of a file
            (`.csv`, `.jsonl`, `.parquet`); or an iterable of (t, z), (t, z, inputs) or `Sample`.
            Times are numbers or dates; the first date is at t0. Dates without a zone are in UTC.
        on_estimate
            Called with each estimate before the next sample is asked for: a controller, say. Its
            return value is ignored; an exception ends the run.
        progress
            Show a bar with rate and time left.
        total
            Number of samples, for the time left; default len(stream) if it has one.
        fields_every
            Keep the fields of every so many samples (scalars and innovations of all).
        time
            Column of the times; this and the options below are of tables and files. Default: the
            index of a table, the coordinate of a dataset, or the one column that is called time,
            date or the like.
        time_unit
            Unit of times that are numbers; default that of the model. Required if the name of
            their column has another one, such as time_min.
        columns
            Channel -> name of its column, where they differ: {"T_10": "TS_3_2_1"}.
        units
            Sensor -> unit of its column, where that is not the unit of the sensor.
        strict
            Refuse columns that are no channel; by default they are ignored.

        Raises
        ------
        DataError
            A channel without a column; text or infinity in one; times that do not increase.
        ConfigurationError
            Options that do not fit; dates for a model without `time_unit`.

        Examples
        --------
        >>> import pandas as pd
        >>> import livepde as lp
        >>> from livepde.models import heat
        >>> model = heat(lp.interval(0.0, 1.0, 20), lp.Normal(0.1, std=0.05))
        >>> rod = lp.Identifier(model, lp.Points({"middle": 0.5}, noise=0.1), u0=20.0)
        >>> table = pd.DataFrame({"middle": [20.0, 20.1]}, index=[1.0, 2.0])
        >>> len(rod.run(table))
        2
        """
        options: dict[str, Any] = {"time": time, "time_unit": time_unit, "columns": columns}
        options |= {"units": units, "strict": strict}
        given = {name: value for name, value in options.items() if value is not None}
        stream = self._samples_of(stream, given)
        result = Result(
            self.model, self.observed, self.validation, fields_every, ignored=self.ignored
        )
        begun, taken = copy.copy(self), list[Sample]()  # states of laws are values
        result.smoother = partial(begun.smoothed, taken, fields_every=fields_every)
        result.readings = partial(self._channels.readings, taken)
        if progress:
            from livepde.progress import watched

            size = total if total is not None else getattr(stream, "__len__", lambda: None)()
            stream = watched(stream, size)
        for item in stream:
            sample = sample_of(item)
            estimate = self.step(sample.t, sample.z, sample.inputs)
            if not len(result):
                result.layout = self._dated(result.layout)
            result.add(estimate)
            taken.append(Sample(t=sample.t, z=copy.copy(sample.z), inputs=copy.copy(sample.inputs)))
            if on_estimate is not None:
                on_estimate(estimate)
        if result.last is not None:
            result._settle(self._settled(result.last))
            noise = self.law.reading_noise(self._work, self._state)
            if noise is not None and not begun._samples and not self.model.latent.moves:
                result.expected = partial(begun._expected, taken, noise)
        return result

    def _samples_of(self, data: Any, reading: Mapping[str, Any]) -> Iterable[Any]:
        """Return a stream as it is, and the samples of a table with times of the model."""
        if not is_tabular(data):
            if reading:
                raise ConfigurationError(
                    f"run: {next(iter(reading))} describes a table or a file; got "
                    f"{type(data).__name__}."
                )
            return cast("Iterable[Any]", data)
        from livepde.streams.given import Reading

        optional = [name for name in self.inputs if name in self._optional_inputs]
        needed = [name for name in self.channels if name not in optional]
        units = {
            name: unit
            for sensors in self._channels.sensors
            for name, unit in zip(sensors.names, sensors.units, strict=True)
        }
        how = Reading(
            channels=needed,
            optional=[*optional, *self._channels.noise],
            unit=self.model.time_unit,
            sensor_units=units,
            **reading,
        )
        table = how.table(data)
        if table.origin is None:
            return table
        t0, self._origin = self._since(since_1970(table.origin))
        return replace(table, t=table.t + t0)

    def _dated(self, layout: Layout) -> Layout:
        """Return the layout of a run with the date of t = 0, if times are dates."""
        if self.origin is None:
            return layout
        return replace(layout, attrs={**layout.attrs, "origin": self.origin.isoformat(sep=" ")})

    @property
    def _unsmoothed(self) -> str:
        """Why the law smooths nothing; empty if it does."""
        return self.law.unsmoothed(self._work)

    def smoothed(self, stream: Any, *, fields_every: int = 1) -> xr.Dataset:
        """Return the smoothed unknowns and state at each sample of a run, given all of them.

        A fixed-interval smoother: see `livepde.laws.smoother`. All samples are taken by a copy of
        this identifier, as in a run, and then at least once more; this one stays as it is.

        Parameters
        ----------
        stream, fields_every
            As for `run`.

        Returns
        -------
        smoothed
            As `Result.to_xarray` of the run, without innovations. A constant unknown
            has one value at all times: the last one.

        Raises
        ------
        ConfigurationError
            An identifier that has taken a sample.
        LawError
            A law without a covariance that a smoother could follow.
        """
        if self._samples:
            raise ConfigurationError(
                "smoothed takes a run from its first sample on: call it of an identifier that has "
                "taken none."
            )
        if why := self._unsmoothed:
            raise LawError(f"smoothed: {why}; use SensitivityLaw.")
        stream = self._samples_of(stream, {})
        who, run, before = copy.copy(self), Hindsight(self._q0), self._state
        for item in stream:
            sample = sample_of(item)
            estimate, interval = who._taken(sample.t, sample.z, sample.inputs)
            if before is None:  # the law begins with the first sample
                before = self._start(Inputs(interval.inputs0))
            run.add(estimate, interval, who._latent_belief().q)
        result = Result(
            self.model, self.observed, self.validation, fields_every, ignored=self.ignored
        )
        result.layout = who._dated(result.layout)
        data = run.fixed_interval(fields_every)
        beliefs = data and self.law.smoothed(self._work, before, who._state, data)
        return run.dataset(result, self.problem, beliefs or ())

    def _expected(
        self, samples: Iterable[Sample], noise: Array, q: Array, draws: Array
    ) -> tuple[Array, Array]:
        """Return readings that draws of the unknowns lead to, and their standard deviation.

        Linear about q, shape (m,), for draws of shape (n, m): the samples are taken again from
        there, without their readings. Shapes (n, samples, sensors) and (samples, sensors); NaN
        where a step fails.
        """
        latent = self.model.latent
        centre = latent.inverse(q)
        found = LinearReadings(np.array([latent.inverse(draw) for draw in draws]) - centre)
        who = self._started(centre, self._u0, self.problem.initial_errors)
        who._state = None
        if not who.inputs:
            who._begin(who._inputs)
        nothing = np.full(self.observed.size, np.nan)
        for sample in samples:
            _, own, _, named = self._channels.parse(sample.z, sample.inputs)
            inputs = {name: named[name] for name in self.inputs if name in named}
            estimate, interval = who._taken(sample.t, nothing, inputs)
            std = noise if own is None else np.where(np.isnan(own), noise, own)
            used = estimate.status.ok and estimate.t >= self.assimilate_from
            latent_factor = who._latent_belief().q_factor
            belief = who._belief()
            predicted = self.observed.predict(belief.u, belief.q, interval.end)
            rows = seen_rows(self.observed, belief, interval.end)
            if latent_factor is None or rows is None:
                raise LawError(f"{type(self.law).__name__} has no covariance: use SensitivityLaw.")
            found.add(predicted, rows, latent_factor, std if used else nothing)
        return found.readings, found.std

    @property
    def fingerprint(self) -> Fingerprint:
        """Numbers by which a checkpoint of this problem is known; computed when first asked for."""
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
        """Return the state as `save` writes it."""
        header = {**self._header(), "begun": self._state is not None}
        leaves = {
            "t": self._t,
            "z": self._z,
            "samples": self._samples,
            "inputs": np.array([self._inputs[c] for c in self._inputs]),
            "known": np.array([self._known[c] for c in self._known]),
            "validation": self._validation.sums,
            "validation_last": self._validation.last,
            "held_counts": self._gaps.counts,
            "held": self._gaps.held,
            "steps": self._steps.counts,
            "lengths": self._steps.lengths,
            "origin": self._origin,
            "unstated": self._gaps.unstated,
            **self.fingerprint.leaves,
        }
        if self._state is not None:
            leaves |= checkpoint.flatten(self._state)
        return checkpoint.packed(header, leaves)

    def load(self, path: str | os.PathLike[str]) -> None:
        """Continue from a saved state; the identifier must be built as the one that was saved.

        Raises
        ------
        RunError
            The file is damaged, or of another problem: another model, prior, sensor place or
            boundary value, say, or another option of the law.
        """
        self.restore(checkpoint.read(path), str(path))

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Continue from the bytes of `dump`, named `where` in messages. Raises as `load`."""
        header, leaves = checkpoint.unpacked(content, where)
        # Nothing of this identifier changes before all parts of the checkpoint have been read.
        mine = self._header()
        for key, value in mine.items():
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
        if differs := self.fingerprint.differing(leaves):
            raise RunError(
                f"{where} was saved with another {differs}. Build the identifier as it was then, "
                "or start a new run."
            )
        state = None
        try:
            t, samples = float(leaves["t"]), int(leaves["samples"])
            origin = float(leaves["origin"])
            z = checkpoint.rebuild(self._z, leaves, "z")
            validation = ValidationLedger(leaves["validation"], leaves["validation_last"])
            gaps = InputLedger(
                counts=leaves["held_counts"].astype(np.int64),
                held=leaves["held"],
                unstated=leaves["unstated"],
            )
            steps = StepLedger(leaves["steps"].astype(np.int64), leaves["lengths"])
            names = self.inputs if len(leaves["inputs"]) else ()
            inputs, known = (
                Inputs(dict(zip(names, leaves[part].tolist(), strict=True))) for part in INPUTS
            )
            if header["begun"]:
                template = self.law.init(self._work, self._q0, self._u0)
                state = checkpoint.rebuild(template, leaves)
        except (KeyError, ValueError) as error:
            raise RunError(
                f"{where} does not fit this identifier ({error}): build it with the law's options "
                "as they were when it was saved."
            ) from error
        self._t, self._samples, self._z, self._origin = t, samples, z, origin
        self._inputs, self._known = inputs, known
        self._state, self._validation, self._gaps, self._steps = state, validation, gaps, steps
        if state is None and not self.inputs:
            self._begin(inputs)


def _check_parts(*parts: object) -> None:
    """Refuse what is not a model, an observation and a law, in this order."""
    for part, kind in zip(parts, (Model, Observation, Law), strict=True):
        if not isinstance(part, kind):
            remedy = ": call it" if isinstance(part, type) and issubclass(part, kind) else ""
            raise ConfigurationError(
                "Identifier(model, observation, law): as "
                f"{kind.__name__.lower()}, got {part!r:.80}{remedy}."
            )


def _time(name: str, value: Any) -> float:
    """Return a time or duration of the options."""
    if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf" or math.isnan(value):
        raise ConfigurationError(
            f"{name} must be a number, in the unit of time of the model; got {value!r}."
        )
    return float(value)


def _check_start(model: Model, t0: float, u0: Any, uncertain: Mapping[str, Any]) -> None:
    """Refuse an initial time that is not finite, and an initial state given twice or not at all."""
    if not np.isfinite(t0):
        raise ConfigurationError(f"t0 must be a finite number; got {t0}.")
    for name, given in uncertain.items():
        if given and u0 is None:
            raise ConfigurationError(f"{name} describes u0: give u0, too.")
    if u0 is not None and model.form_initial is not None:
        raise ConfigurationError("the model has its own initial state (initial=): leave out u0.")
