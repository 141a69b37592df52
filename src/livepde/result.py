"""Result of a run: its estimates, tables and datasets."""

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

OF_MODEL = ("model", "observed", "validation", "_readout", "_settled")  # dropped by pickle


class Result(Shown):
    """Estimates of a run, which are added one by one.

    Scalars, innovations and status are stored for every sample. Fields, evaluated at the vertices
    of the mesh, are stored for every `fields_every`-th sample and the last.

    Parameters
    ----------
    records
        Store of the estimates; default arrays in memory.
    layout
        Names, units and coordinates of the records; default from model and sensors.
    count
        Number of earlier estimates, if not all are stored; default the number of records.
    ignored
        Names of validation sensors that never affect the verdict, for the default layout.

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
        self._ended = False  # the last estimate follows a final refit
        self.smoother: Callable[[], xr.Dataset] | None = None
        self.readings: Callable[[], Array] | None = None  # all readings, (samples, sensors)
        # (q, draws of q) -> expected readings for each draw, and their standard deviations.
        self.expected: Callable[[Array, Array], tuple[Array, Array]] | None = None
        self.records: Records = RecordArrays() if records is None else records
        self.layout = layout or layout_of(model, observed, validation, ignored)
        # A result that was pickled has complete records and no model.
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
        """Verdict on the run so far, from the last estimate."""
        return Verdict.unjudged() if self.last is None else self.last.verdict

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood of all readings; NaN for a law without covariance.

        It is the log density of the readings of the assimilated sensors, in their unit, with the
        unknowns integrated out. After a refit it is linear about that fit, otherwise it is the sum
        of the log densities of the innovations. A refused reading counts as a reading at the limit
        of the gate. Runs can be compared if they assimilate the same readings.
        """
        return math.nan if self.last is None else float(self.last.diagnostics.log_evidence)

    def add(self, estimate: Estimate) -> None:
        """Add an estimate."""
        self.records.append(*self._records([(estimate, self._keeps)]))
        self._follow(estimate)

    def _announce(self, estimate: Estimate) -> bool:
        """Count an estimate whose record is stored later; return whether to store its fields."""
        with_fields = self._keeps
        self._follow(estimate)
        return with_fields

    @property
    def _keeps(self) -> bool:
        """Whether the next estimate is stored with its fields."""
        return self._count % self.fields_every == 0

    def _follow(self, estimate: Estimate) -> None:
        self._count += 1
        self._settled, self._ended = None, False
        self.last = estimate

    def _settle(self, estimate: Estimate) -> None:
        """Replace the last estimate, also in tables and datasets, by the final one of a run."""
        self._ended = True
        if estimate is not self.last:
            self.last, self._settled = estimate, estimate.belief

    def _records(self, estimates: Sequence[tuple[Estimate, bool]]) -> Iterator[Record]:
        """Iterate over the records of pairs (estimate, whether to store its fields)."""
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
        """Return a dataset of the run over time: numbers, fields and errors of the sensors.

        In addition to the variables of `dataset`, it contains `date` over `time`, if times are
        dates; the ends `_low` and `_high` of the 95 % interval of every unknown; and `estimates`
        over (`time`, `parameter`, `statistic`), with value, std, low and high of each number, as in
        `data.estimates.sel(parameter="alpha", statistic="high")`.
        """
        return with_estimates(self.dataset())

    def to_dataframe(self) -> pd.DataFrame:
        """Return the numbers over time as a pandas table, one row for each sample.

        The index contains dates if the samples have dates. The columns of an unknown `alpha` are
        `alpha`, `alpha_std`, `alpha_low` and `alpha_high`. The column of a sensor `T_1` is
        `innovation:T_1`, or `validation_error:T_1` for validation. The last column is `status`.
        """
        return frame(self.dataset())

    def summary(self) -> pd.DataFrame:
        """Return the last estimates as a pandas table, one row for each unknown number.

        Columns: `value` and `std`; `low` and `high`, the 95 % interval if the model is exact;
        `model_low` and `model_high`, the 95 % interval that allows for model errors; `effect`, the
        possible change of the value by model errors relative to the value (NaN if not judged);
        `unit`; and `level`, the level of the verdict on the whole run. The attribute `misfit` is
        the root mean square of the residuals divided by the noise.
        """
        return estimates(self.dataset())

    def covariance(self) -> pd.DataFrame:
        """Return the covariance of the last estimates of scalar unknowns, by name.

        Under a transform, it is the covariance to first order, as are the standard deviations.

        Raises
        ------
        LawError
            A law without a covariance.
        """
        last = self._last("covariance")
        return covariance_of(last.belief, last.space)

    def correlation(self) -> pd.DataFrame:
        """Return the correlation of the last scalar estimates; raises as `covariance`."""
        covariance = self.covariance()
        size = np.sqrt(np.diag(covariance))
        return covariance.div(size, axis=0).div(size, axis=1)

    def sample(self, n: int, seed: int | np.random.Generator | None = None) -> xr.Dataset:
        """Return draws from the last estimate: numbers, unknown fields and the state.

        Parameters
        ----------
        n
            Number of draws.
        seed
            Seed of the random numbers, or a generator.

        Returns
        -------
        draws
            Numbers over `draw`, fields and state over (`draw`, `vertex`). They are jointly normal
            in latent values, within the bounds of the unknowns. Modes that the law omits are also
            drawn.

        Raises
        ------
        LawError
            A law without a covariance.
        ConfigurationError
            There is no estimate yet, or the result was pickled.
        """
        last = self._last("sample")
        _check_count("sample: n", n)
        drawn = draws(last.belief, last.space, n, seed)
        return draws_dataset(self.model, *drawn, self.layout.coordinates)

    def to_inference_data(self, n: int = 1000, seed: int | None = 0) -> xr.DataTree:
        """Return an xarray DataTree for plots and model comparison with ArviZ, 1.0 or newer.

        Groups:

        - `posterior`: the draws of `sample`. `prior`: draws of the scalar unknowns.
        - `observed_data`: readings of all sensors, for a result of `Identifier.run`.
        - `posterior_predictive`: for each draw of the unknowns, draws of the readings of the
          assimilated sensors, including noise.
        - `log_likelihood`: `readings` over `reading`, the log density of each assimilated reading
          for each draw of the unknowns; `arviz.loo` compares models by it. Readings that do not
          depend on the unknowns, as at a known initial state, are omitted.

        For the last two groups all samples are processed again, which takes as long as a run. The
        readings for a draw are linear about the last estimate: they follow the model from the
        initial state, without corrections by readings. One-step predictions, which do not depend
        on a draw, are in `predicted`. Noise of inputs and errors of the initial state and the
        discretisation widen each density. Refused readings count like all others. Both groups are
        absent for moving unknowns and for runs that continue an earlier run.

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
            # The same draws as in `sample`, without the modes that the law omits.
            q, _ = draws(replace(last.belief, rest=None), last.space, n, seed)
            measured = self.measured[list(self.layout.sensors)]
            chains |= predictive(measured, *self.expected(last.q, q), seed)
        return xr.DataTree.from_dict(chains)

    @property
    def measured(self) -> pd.DataFrame:
        """Readings of the assimilated, then of the validation sensors, one row for each sample.

        Raises
        ------
        ConfigurationError
            The result is not from `Identifier.run`, and its readings are not known.
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
        """Predicted readings, one row for each sample; NaN where there is no reading.

        Predictions for assimilated sensors precede the update, those for validation sensors follow
        it. Raises as `measured`.
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
        """Return the dataset that a run directory contains.

        Its dimensions are time, snapshot, vertex, sensor and validation. Scalar unknowns are over
        `time`, fields over (`snapshot`, `vertex`), innovations over (`time`, `sensor`). The suffix
        `_std` is the standard deviation; `_low` and `_high` are the ends of the 95 % interval of an
        unknown with a transform or bounds. A law with covariance adds `_left`, the remaining share
        of the prior standard deviation of a scalar; `_modes`, the number of modes of a field that
        the data determine, and `_left_out`, the share of its mean variance in modes that the law
        omits, over `snapshot`; and `correlation` of the last scalars, over (`unknown`, `other`).
        Attributes are the units, `verdict` (`Verdict.to_dict` as JSON), `log_evidence`, and, after
        a converged last refit, `bounded_at_end`: the number of its coefficients at a bound.
        """
        data = self.layout.dataset(*self._finished())
        if self.last is not None:
            data.attrs["verdict"] = json.dumps(self.verdict.to_dict())
            if math.isfinite(self.log_evidence):
                data.attrs["log_evidence"] = self.log_evidence
            fit = self.last.fit
            if self._ended and fit is not None and fit.converged:
                # Bounds that were only active during the search do not count.
                bounded = self.last.diagnostics.bounded
                data.attrs["bounded_at_end"] = 0.0 if math.isnan(bounded) else bounded
        return data

    def _finished(self) -> tuple[RecordArrays, Snapshot | None]:
        """Return all records, and the last fields if the last record does not contain them."""
        records, fields = RecordArrays.of(self.records), self._last_fields
        if self._complete or self.last is None:
            return records, fields
        # The dataset contains the last fields whatever `fields_every` is.
        missing = records.last_snapshot < len(records) - 1
        last = self._snapshot(self.last) if missing or self._settled is not None else None
        if self._settled is not None:
            numbers = self._readout([self._settled])[0]
            records = records.with_last(numbers, None if missing else last)
        return records, last if missing else fields

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without the model, whose functions pickle may not support."""
        records, fields = self._finished()
        attributes: dict[str, Any] = {
            "records": records,
            "_last_fields": fields,
            "_complete": True,
            "smoother": None,
            "expected": None,
        }
        if self.readings is not None:
            attributes["readings"] = partial(kept, self.readings())
        return {k: v for k, v in vars(self).items() if k not in OF_MODEL} | attributes

    def __getattr__(self, name: str) -> Any:
        # Python calls this only for missing names, such as those that `__getstate__` drops.
        if name in OF_MODEL:
            raise ConfigurationError(
                "this result was pickled, without its model: it has its estimates, datasets and "
                "tables. To add samples or to smooth, run an identifier again."
            )
        raise AttributeError(
            f"a Result has no attribute '{name}': estimates are in last['alpha'] and "
            "to_dataframe(), figures in plot. An Identifier forecasts, saves and loads."
        )

    def smoothed(self) -> xr.Dataset:
        """Return a dataset of smoothed unknowns and states, given all samples of the run.

        Names are as in `to_xarray`. All samples are processed again, at least twice: see
        `Identifier.smoothed`.

        Raises
        ------
        ConfigurationError
            The result is not from `Identifier.run`, and its samples are not known.
        LawError
            A law without a covariance, or with the option `memory`.
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
        """Figures by name, such as `plot.estimates("alpha", ax=ax)`; `plot()` draws all of them.

        They require the extra `plots`.
        """
        from livepde.plots import RunPlots

        return RunPlots(self)


def _check_count(name: str, value: Any) -> None:
    """Raise `ConfigurationError` unless the value is a positive whole number."""
    if not isinstance(value, Integral) or int(value) < 1:
        raise ConfigurationError(f"{name} must be a whole number, at least 1; got {value!r}.")
