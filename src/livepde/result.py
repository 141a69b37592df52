"""Estimates, one at a time and as a table with axes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Integral
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from livepde.errors import ConfigurationError
from livepde.estimate import Estimate, kept, read_together
from livepde.frames import (
    covariance_of,
    draws,
    draws_dataset,
    estimates,
    frame,
    layout_of,
    over_time,
    predictive,
    prior_draws,
    snapshot_of,
    summary,
    times,
    with_estimates,
)
from livepde.laws import Belief
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.readout import ScalarReadout
from livepde.records import STATUS_CODES, Layout, Record, RecordArrays, Records, Snapshot
from livepde.showing import Shown
from livepde.verdict import Verdict

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from livepde.plots import RunPlots

OF_MODEL = ("model", "observed", "validation", "_readout", "_settled")  # lost by pickling


class Result(Shown):
    """Estimates of a run, as they are added.

    Scalars, innovations and status are kept for every sample; fields, evaluated at the vertices of
    the mesh, for every `fields_every`-th and the last.

    Parameters
    ----------
    records
        Store of the estimates; default arrays in memory.
    layout
        Names, units and coordinates of the numbers of records; default those of model and sensors.
    count
        Number of earlier estimates, not all of which need be kept; default that of the records.
    ignored
        Names of validation sensors that never count, for the default layout.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> rod = heat(lp.interval(0.0, 1.0, 8), lp.LogNormal(0.1, std=0.05), {"left": 0.0})
    >>> sensors = lp.Points({"T_50": 0.5}, noise=0.01)
    >>> data = [(0.5, [0.93]), (1.0, [0.81]), (2.0, [0.64])]
    >>> result = lp.Identifier(rod, sensors, u0=1.0).run(data)
    >>> len(result), list(result.summary().index)
    (3, ['alpha'])
    """

    def __init__(
        self,
        model: Model,
        observed: Observed,
        validation: Observed | None,
        fields_every: int = 1,
        records: Records | None = None,
        layout: Layout | None = None,
        count: int | None = None,
        ignored: Sequence[str] = (),
    ) -> None:
        _check_count("fields_every", fields_every)
        self.model = model
        self.observed = observed
        self.validation = validation
        self.fields_every = int(fields_every)
        self.last: Estimate | None = None
        self._settled: Belief | None = None
        self._ended = False  # a last fit was asked for
        self.smoother: Callable[[], xr.Dataset] | None = None
        self.readings: Callable[[], Array] | None = None  # of all samples, (samples, sensors)
        # From q and draws of it to the readings that they lead to, and their deviations.
        self.expected: Callable[[Array, Array], tuple[Array, Array]] | None = None
        self.records: Records = RecordArrays() if records is None else records
        self.layout = layout or layout_of(model, observed, validation, ignored)
        # Of a result that was pickled: its records are complete, and the model is not there.
        self._complete, self._last_fields = False, cast("Snapshot | None", None)
        self._count = len(self.records) if count is None else count
        self._readout = ScalarReadout(model.parameter_space)

    def __len__(self) -> int:
        return self._count

    def _shown(self) -> tuple[str, Mapping[str, str]]:
        title = f"Result of {len(self)} samples"
        if self.last is None:
            return title, {}
        _, rows = self.last._shown()
        until = f"{title} until t = {self.last.t:g} {self.layout.time_unit}".rstrip()
        return until, {**rows, "verdict": self.verdict.level}

    @property
    def verdict(self) -> Verdict:
        """The verdict on the run so far: that of the last estimate."""
        return Verdict.unjudged() if self.last is None else self.last.verdict

    @property
    def log_evidence(self) -> float:
        """Logarithm of the marginal likelihood of all readings; NaN for a law without covariance.

        The density of the readings of the assimilated sensors, in their unit, with the unknowns
        integrated out: after a fit of the stored samples linear about that fit, else the sum of the
        log densities of the innovations. Readings that were refused count as if at the limit of
        the gate. Two runs can be compared if they assimilate the same readings.
        """
        return math.nan if self.last is None else float(self.last.diagnostics.log_evidence)

    def add(self, estimate: Estimate) -> None:
        """Add one estimate."""
        self.records.append(*self._records([(estimate, self._keeps)]))
        self._follow(estimate)

    def _announce(self, estimate: Estimate) -> bool:
        """Count an estimate whose record is stored later; return whether it keeps its fields."""
        keeps = self._keeps
        self._follow(estimate)
        return keeps

    @property
    def _keeps(self) -> bool:
        """Whether the next estimate is stored with its fields."""
        return self._count % self.fields_every == 0

    def _follow(self, estimate: Estimate) -> None:
        self._count += 1
        self._settled, self._ended = None, False
        self.last = estimate

    def _settle(self, estimate: Estimate) -> None:
        """Take the last parameter and state from the end of a run, in tables and datasets."""
        self._ended = True
        if estimate is not self.last:
            self.last, self._settled = estimate, estimate.belief

    def _records(self, estimates: Sequence[tuple[Estimate, bool]]) -> Iterator[Record]:
        """Iterate over the records of estimates, each with whether its fields are kept."""
        read_together([estimate for estimate, _ in estimates])
        numbers = self._readout([estimate.belief for estimate, _ in estimates])
        for (estimate, keeps), row in zip(estimates, numbers, strict=True):
            yield Record(
                t=estimate.t,
                numbers=row,
                innovation=estimate.innovation,
                validation_error=estimate.validation_error,
                status=STATUS_CODES.index(estimate.status.code),
                steps=estimate.steps,
                notes=estimate.diagnostics.named(),
                snapshot=self._snapshot(estimate) if keeps else None,
            )

    def _snapshot(self, estimate: Estimate) -> Snapshot:
        return snapshot_of(self.model, estimate.belief)

    def to_xarray(self) -> xr.Dataset:
        """Return a dataset of the run over time: numbers, fields, errors of the sensors.

        It is that of `dataset`, and has besides: `date` over `time`, if times are dates; the ends
        `_low` and `_high` of the 95 % interval of each unknown, whatever its prior; and
        `estimates` over (`time`, `parameter`, `statistic`), with the value, std, low and high of
        each number: `data.estimates.sel(parameter="alpha", statistic="high")`.
        """
        return with_estimates(self.dataset())

    def to_dataframe(self) -> pd.DataFrame:
        """Return the numbers over time as a pandas table, one row for each sample.

        The index has dates if the samples have. Columns are, for an unknown `alpha`: `alpha`,
        `alpha_std`, `alpha_low` and `alpha_high`; for a sensor `T_1` `innovation:T_1`, or
        `validation_error:T_1` for validation; and `status`.
        """
        return frame(self.dataset())

    def summary(self) -> pd.DataFrame:
        """Return the last estimates as a pandas table, one row for each unknown number.

        Columns: `value` and `std`; `low` and `high`, the 95 % interval if the model is exact;
        `model_low` and `model_high`, the one that allows for errors of the model, and `effect`,
        by how much these may move the value, relative to it (NaN where the run cannot judge it);
        `unit`; and `level`, that of the verdict on the whole run. The attribute `misfit` is the
        root mean square of the residuals over the noise.
        """
        return estimates(self.dataset())

    def covariance(self) -> pd.DataFrame:
        """Return the covariance of the last numbers among the unknowns, by name.

        Under a transform it is that to first order, as are the standard deviations.

        Raises
        ------
        LawError
            A law without a covariance.
        """
        last = self._last("covariance")
        return covariance_of(last.belief, last.space)

    def correlation(self) -> pd.DataFrame:
        """Return the correlation of the last numbers among the unknowns, by name."""
        found = self.covariance()
        size = np.sqrt(np.diag(found))
        return found.div(size, axis=0).div(size, axis=1)

    def sample(self, n: int, seed: int | np.random.Generator | None = None) -> xr.Dataset:
        """Return draws from the last estimate: numbers, unknown fields and the state.

        Parameters
        ----------
        n
            Number of draws.
        seed
            Of the random numbers, or their generator.

        Returns
        -------
        draws
            Numbers over `draw`, fields and state over (`draw`, `vertex`). They are jointly normal
            in latent values, and unknowns lie within their bounds; modes that the law leaves out
            are drawn as well.

        Raises
        ------
        LawError
            A law without a covariance.
        ConfigurationError
            There is no estimate yet; the result was pickled.
        """
        last = self._last("sample")
        _check_count("sample: n", n)
        drawn = draws(last.belief, last.space, n, seed)
        return draws_dataset(self.model, *drawn, self.layout.coordinates)

    def to_inference_data(self, n: int = 1000, seed: int | None = 0) -> xr.DataTree:
        """Return what ArviZ (from 1.0 on) plots and compares: an xarray DataTree.

        Its groups:

        - `posterior`: the draws of `sample`. `prior`: draws of the numbers among the unknowns.
        - `observed_data`: the readings of all sensors, of a result of `Identifier.run`.
        - `posterior_predictive`: for each draw of the unknowns, draws of the readings of the
          assimilated sensors, noise included.
        - `log_likelihood`: `readings` over `reading`, for each draw of the unknowns the log density
          of each assimilated reading, so that `arviz.loo` compares models by it. A reading that no
          unknown reaches, as at a known initial state, is left out.

        For the last two all samples are taken again, which takes as long as a run. What a draw
        leads to is linear about the last estimate: the model from the initial state on, without
        corrections by the readings. So these are no predictions one step ahead, which are
        `predicted` and do not depend on a draw. Noise of inputs, errors of the initial state and of
        the discretisation widen each density. Readings that the gate has refused count as the
        others. Runs of unknowns that move, and runs that continue an earlier one, have neither
        group.

        Parameters
        ----------
        n, seed
            As for `sample`.
        """
        import xarray as xr

        last = self._last("prior")
        groups = {"posterior": self.sample(n, seed), "prior": prior_draws(last.space, n, seed)}
        number = np.arange(n)
        chains = {
            name: group.assign_coords(draw=number).expand_dims(chain=[0])
            for name, group in groups.items()
        }
        if self.readings is not None:
            frame = self.measured
            chains["observed_data"] = xr.Dataset({name: frame[name] for name in frame})
        if self.expected is not None:
            # The same draws as in `sample`, without what the law takes no account of.
            q, _ = draws(replace(last.belief, rest=None), last.space, n, seed)
            measured = self.measured[list(self.layout.sensors)]
            chains |= predictive(measured, *self.expected(last.q, q), seed)
        return xr.DataTree.from_dict(chains)

    @property
    def measured(self) -> pd.DataFrame:
        """Readings of the assimilated and then of the validation sensors, one row for each sample.

        Raises
        ------
        ConfigurationError
            Estimates that were added one by one.
        """
        import pandas as pd

        if self.readings is None:
            raise ConfigurationError(
                "the samples of this result are not known; use the result of Identifier.run."
            )
        residuals = self.residuals
        return pd.DataFrame(self.readings(), residuals.index, residuals.columns)

    @property
    def predicted(self) -> pd.DataFrame:
        """Readings as the model predicted them, one row for each sample.

        Of assimilated sensors before a reading was used, of validation sensors after the update;
        NaN where there is no reading. Raises as `measured`.
        """
        return self.measured - self.residuals

    @property
    def residuals(self) -> pd.DataFrame:
        """Measured minus predicted readings of all sensors, one row for each sample."""
        import pandas as pd

        data = self.dataset()
        columns = over_time(data, "innovation", "sensor")
        return pd.DataFrame(
            columns | over_time(data, "validation_error", "validation"), times(data)
        )

    def _last(self, what: str) -> Estimate:
        if self.last is None:
            raise ConfigurationError(f"{what}: the run contains no samples yet.")
        return self.last

    def dataset(self) -> xr.Dataset:
        """Return the dataset that a run directory holds.

        Its dimensions are time, snapshot, vertex, sensor and validation.
        Scalar unknowns are variables over `time`, fields over (`snapshot`, `vertex`), with `_std`
        variables beside them, and `_low` and `_high`, the ends of the 95 % interval, for unknowns
        with a transform or bounds; innovations over (`time`, `sensor`). Units are attributes. Of a
        law with covariance also `_left`, the remaining share of the prior standard deviation of a
        scalar; `_modes`, the number of modes of a field that the data determine, and `_left_out`,
        the share of its mean variance in modes that the law leaves out, over `snapshot`; and
        `correlation` of the last scalars, over (`unknown`, `other`). The attribute `verdict` is the
        result of `Verdict.to_dict`, as JSON; `log_evidence` that of the result; and
        `bounded_at_end`, after a last fit that has converged, the number of coefficients that a
        bound holds there.
        """
        data = self.layout.dataset(*self._finished())
        if self.last is not None:
            data.attrs["verdict"] = json.dumps(self.verdict.to_dict())
            if math.isfinite(self.log_evidence):
                data.attrs["log_evidence"] = self.log_evidence
            fit = self.last.fit
            if self._ended and fit is not None and fit.converged:
                # What the search has met on its way is no matter of where it has ended.
                bounded = self.last.diagnostics.bounded
                data.attrs["bounded_at_end"] = 0.0 if math.isnan(bounded) else bounded
        return data

    def _finished(self) -> tuple[RecordArrays, Snapshot | None]:
        """Return all records, and the last fields if `fields_every` has left them out."""
        records, fields = RecordArrays.of(self.records), self._last_fields
        if self._complete or self.last is None:
            return records, fields
        # The last fields are part of the dataset, also where `fields_every` has left them out.
        missing = records.last_snapshot < len(records) - 1
        last = self._snapshot(self.last) if missing or self._settled is not None else None
        if self._settled is not None:
            numbers = self._readout([self._settled])[0]
            records = records.with_last(numbers, None if missing else last)
        return records, last if missing else fields

    def __getstate__(self) -> dict[str, Any]:
        """Return the records, without the model, whose functions may not be pickled."""
        records, fields = self._finished()
        own: dict[str, Any] = {
            "records": records,
            "_last_fields": fields,
            "_complete": True,
            "smoother": None,
            "expected": None,
        }
        if self.readings is not None:
            own["readings"] = partial(kept, self.readings())
        return {k: v for k, v in vars(self).items() if k not in OF_MODEL} | own

    def __getattr__(self, name: str) -> Any:
        # Python calls this only for names that are not there: those that `__getstate__` leaves out.
        if name in OF_MODEL:
            raise ConfigurationError(
                "this result was pickled, without its model: it has its estimates, datasets and "
                "tables. To add samples or to smooth, run an identifier again."
            )
        raise AttributeError(f"a Result has no attribute '{name}'.")

    def smoothed(self) -> xr.Dataset:
        """Return a dataset of unknowns and state over time, given all samples of the run.

        Names as in `to_xarray`; intervals are those given all samples. The samples are taken again
        at least twice: see `Identifier.smoothed`.

        Raises
        ------
        ConfigurationError
            Estimates that were added one by one.
        LawError
            A law without a covariance that a smoother could follow.
        """
        if self.smoother is None:
            raise ConfigurationError(
                "Result.smoothed: the samples of this result are not known; call "
                "Identifier.smoothed(stream) of a new identifier."
            )
        return self.smoother()

    def table(self) -> dict[str, dict[str, float]]:
        """Return the last estimates and the root mean square errors of all sensors.

        Rows are scalar unknowns (value, std) and channels (rmse, count).
        """
        return summary(self.dataset())

    @property
    def plot(self) -> RunPlots:
        """Figures by name, `plot.estimates("alpha", ax=ax)`; `plot()` draws all of the run.

        They need the extra `plots`.
        """
        from livepde.plots import RunPlots

        return RunPlots(self)


def _check_count(name: str, value: Any) -> None:
    """Refuse anything but a whole number of at least 1."""
    if not isinstance(value, Integral) or int(value) < 1:
        raise ConfigurationError(f"{name} must be a whole number, at least 1; got {value!r}.")
