"""Runs of an identifier over whole streams: estimates, smoothed estimates and expected readings."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from livepde.dates import origin_at, since_1970
from livepde.errors import ConfigurationError, LawError
from livepde.estimate import Estimate
from livepde.fem import Inputs
from livepde.forecast import seen_rows
from livepde.hindsight import Hindsight, LinearReadings
from livepde.laws import AnyLaw, Belief, Problem
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.records import Layout
from livepde.result import Result
from livepde.samples import Channels, Readings, Sample, is_tabular, sample_of
from livepde.showing import Shown
from livepde.stepping import Interval
from livepde.taken import TakenSamples

if TYPE_CHECKING:
    import xarray as xr


class StreamRuns(Shown):
    """Methods of `Identifier` for whole streams, which process their samples one by one."""

    model: Model
    observed: Observed
    validation: Observed | None
    ignored: Sequence[str]
    law: AnyLaw
    problem: Problem
    assimilate_from: float
    _channels: Channels
    _so_far: TakenSamples
    _work: Any
    _state: Any
    _q0: Array
    _u0: Array

    @abstractmethod
    def step(self, t: Any, z: Readings, inputs: Mapping[str, float] | None = None) -> Estimate:
        """Process one sample and return the estimate at its time."""

    @abstractmethod
    def _process(
        self, t: Any, z: Readings, inputs: Mapping[str, float] | None
    ) -> tuple[Estimate, Interval]: ...

    @abstractmethod
    def _settled(self, estimate: Estimate, *, columns: bool = True) -> Estimate: ...

    @abstractmethod
    def _start(self, inputs: Inputs) -> Any: ...

    @abstractmethod
    def _started(
        self, q0: Array, u0: Array, problem: Problem, work: Any, *, assumed: bool
    ) -> Self: ...

    @abstractmethod
    def _forget(self) -> None: ...

    @abstractmethod
    def _latent_belief(self) -> Belief: ...

    @abstractmethod
    def _belief(self) -> Belief: ...

    @property
    def origin(self) -> datetime | None:
        """Date of t = 0 in UTC; None before a sample with a date. The first date is at t0."""
        origin = self._so_far.origin
        return None if np.isnan(origin) else origin_at(origin)

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
        """Process all samples of a table, a file or a stream, and return the estimates.

        Parameters
        ----------
        stream
            A pandas table or an xarray dataset with a column for each channel; the name of a file
            (`.csv`, `.jsonl`, `.parquet`); or an iterable of (t, z), (t, z, inputs) or `Sample`.
            Times are numbers or dates; the first date is at t0. Dates without a zone are in UTC.
        on_estimate
            Function such as a controller, called with each estimate before the next sample is read.
            Its return value is ignored; an exception ends the run.
        progress
            Show a progress bar with rate and remaining time.
        total
            Number of samples, for the remaining time; default len(stream) if it is defined.
        fields_every
            Store fields of every `fields_every`-th sample; numbers and innovations of all samples.
        time
            Column of the times; this and the following options require a table or a file. Default:
            the index of a table, the coordinate of a dataset, or the only column with a name such
            as time or date.
        time_unit
            Unit of times that are numbers; default the unit of the model. Required if the name of
            the column contains another unit, such as time_min.
        columns
            Channel -> name of its column, if they differ: {"T_10": "TS_3_2_1"}.
        units
            Sensor or boundary channel -> unit of its column, if it differs from the unit of the
            sensor or of the state.
        strict
            Raise an error for columns that are not channels; by default they are ignored.

        Raises
        ------
        DataError
            A channel without a column; text or infinity in a column; times that do not increase.
        ConfigurationError
            Incompatible options; dates for a model without `time_unit`.

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
        stated = {name: value for name, value in options.items() if value is not None}
        stream, result = self._samples_of(stream, stated), self._result(fields_every)
        at_start, taken = copy.copy(self), list[Sample]()  # shallow, since states are immutable
        result.smoother = partial(at_start.smoothed, taken, fields_every=fields_every)
        result.readings = partial(self._channels.readings, taken)
        if progress:
            from livepde.progress import watched

            stream = watched(stream, total)
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
            if noise is not None and not at_start._so_far.samples and not self.model.latent.moves:
                result.expected = partial(at_start._expected, taken, noise)
        return result

    def _samples_of(self, data: Any, reading: Mapping[str, Any]) -> Iterable[Any]:
        """Return the samples of a table with times of the model; a stream is returned unchanged."""
        if not is_tabular(data):
            if reading:
                raise ConfigurationError(
                    f"run: {next(iter(reading))} describes a table or a file; got "
                    f"{type(data).__name__}."
                )
            return cast("Iterable[Any]", data)
        from livepde.streams.given import Reading

        optional = [name for name in self._channels.inputs if name in self._channels.optional]
        required = [name for name in self._channels.names if name not in optional]
        units = self.model.channel_units
        for sensors in self._channels.sensors:
            units |= dict(zip(sensors.names, sensors.units, strict=True))
        reader = Reading(
            channels=required,
            optional=[*optional, *self._channels.noise],
            unit=self.model.time_unit,
            channel_units=units,
            **reading,
        )
        table = reader.table(data)
        if table.origin is None:
            return table
        stamp = since_1970(table.origin)
        t0, origin = self._so_far.since(stamp, self.model.time_unit)
        self._so_far = replace(self._so_far, origin=origin)
        return replace(table, t=table.t + t0)

    def _result(self, fields_every: int) -> Result:
        parts = self.model, self.observed, self.validation, fields_every
        return Result(*parts, ignored=self.ignored)

    def _dated(self, layout: Layout) -> Layout:
        """Return a layout with the date of t = 0 added, if times are dates."""
        if self.origin is None:
            return layout
        return replace(layout, attrs={**layout.attrs, "origin": self.origin.isoformat(sep=" ")})

    @property
    def _unsmoothed(self) -> str:
        """Reason why the law cannot smooth; empty if it can."""
        return self.law.unsmoothed(self._work)

    def smoothed(self, stream: Any, *, fields_every: int = 1) -> xr.Dataset:
        """Return smoothed unknowns and states at the samples of a run, given all samples.

        This is a fixed-interval smoother: see `livepde.laws.smoother`. A copy of the identifier
        processes all samples at least twice; the identifier itself does not change.

        Parameters
        ----------
        stream, fields_every
            As for `run`.

        Returns
        -------
        smoothed
            Dataset as `Result.to_xarray` returns it, without innovations. A constant unknown has
            its last value at all times.

        Raises
        ------
        ConfigurationError
            The identifier has already processed a sample.
        LawError
            A law without a covariance, or with the option `memory`.
        """
        if self._so_far.samples:
            raise ConfigurationError(
                "smoothed takes a run from its first sample on: call it of an identifier that has "
                "taken none."
            )
        if reason := self._unsmoothed:
            raise LawError(f"smoothed: {reason}; use SensitivityLaw.")
        stream = self._samples_of(stream, {})
        copied, hindsight, initial = copy.copy(self), Hindsight(self._q0), self._state
        for item in stream:
            sample = sample_of(item)
            estimate, interval = copied._process(sample.t, sample.z, sample.inputs)
            if initial is None:  # the initial state depends on inputs of the first sample
                initial = self._start(Inputs(interval.inputs0))
            hindsight.add(estimate, interval, copied._latent_belief().q)
        result = self._result(fields_every)
        result.layout = copied._dated(result.layout)
        data = hindsight.fixed_interval(fields_every)
        beliefs = data and self.law.smoothed(self._work, initial, copied._state, data)
        return hindsight.dataset(result, self.problem, beliefs or ())

    def _expected(
        self, samples: Iterable[Sample], noise: Array, q: Array, draws: Array
    ) -> tuple[Array, Array]:
        """Return readings for draws of the unknowns, (n, samples, sensors), and their deviations.

        Linear about q, shape (m,), for draws of shape (n, m): the samples are processed again with
        these unknowns, without readings. Standard deviations, (samples, sensors), are NaN where a
        step fails.
        """
        latent = self.model.latent
        centre = latent.inverse(q)
        linear = LinearReadings(np.array([latent.inverse(draw) for draw in draws]) - centre)
        identifier = self._started(centre, self._u0, self.problem, self._work, assumed=False)
        identifier._forget()
        missing = np.full(self.observed.size, np.nan)
        for sample in samples:
            _, own_noise, _, named = self._channels.parse(sample.z, sample.inputs)
            inputs = {name: named[name] for name in self._channels.inputs if name in named}
            estimate, interval = identifier._process(sample.t, missing, inputs)
            std = noise if own_noise is None else np.where(np.isnan(own_noise), noise, own_noise)
            used = estimate.status.ok and estimate.t >= self.assimilate_from
            latent_factor = identifier._latent_belief().q_factor
            belief = identifier._belief()
            predicted = self.observed.predict(belief.u, belief.q, interval.end)
            rows = seen_rows(self.observed, belief, interval.end)
            if latent_factor is None or rows is None:
                raise LawError(f"{type(self.law).__name__} has no covariance: use SensitivityLaw.")
            linear.add(predicted, rows, latent_factor, std if used else missing)
        return linear.readings, linear.std
