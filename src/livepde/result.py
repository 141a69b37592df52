"""Estimates, one at a time and as a table with axes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.fem import FieldBlock, FunctionSpace, Normal, cells
from livepde.frames import (
    ScalarReadout,
    covariance_of,
    draws,
    estimates,
    frame,
    over_time,
    predictive,
    prior_draws,
    times,
    with_estimates,
)
from livepde.laws import Belief, Fit, Status
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.records import (
    STATUS_CODES,
    Layout,
    Record,
    RecordArrays,
    Records,
    Snapshot,
    refused_readings,
    used_errors,
)
from livepde.showing import Shown, listed
from livepde.verdict import FLAT, Finding, Verdict, at_bound, discretised, flat, held_inputs

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from livepde.plots import RunPlots

MEDIAN = "the median"
FIRST_ORDER = "to first order: that of the latent value, times the slope of the transform"


Kept = TypeVar("Kept")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Estimate(Shown):
    """The estimate of parameter and state after one sample.

    Attributes
    ----------
    t
        Time of the sample.
    belief
        Coefficients of parameter and state, with their uncertainty.
    innovation
        Measured minus expected before the sample was used, shape (sensors,); NaN where missing.
        For `GradientLaw`, which pulls the state to the sample within the step, the output error
        after the step.
    withheld_error
        Measured minus estimated of each withheld channel.
    status
        Status of the step; unless ok, q and u are those of the last successful step.
    steps
        Substeps taken.
    diagnose
        Function that returns the diagnostics of the law; see `diagnostics`.
    held
        Input channels whose last value was held because the sample had none; at the first sample
        also those without a value at the initial time, whose first one was held.
    space
        The unknowns.
    state_space
        The components of the state; None for an estimate that was pickled.
    judge
        Function that returns the verdict of the law on the run so far; see `verdict`.
    fit
        The last fit of all stored samples; None before it, and for laws without.
    """

    t: float
    belief: Belief
    innovation: Array
    withheld_error: Array
    status: Status
    steps: int
    diagnose: Callable[[], Diagnostics[float]]
    held: tuple[str, ...]
    space: FunctionSpace
    judge: Callable[[], Verdict] = Verdict.unjudged
    fit: Fit | None = None
    state_space: FunctionSpace | None = None

    @classmethod
    def deferred(
        cls,
        read: Callable[[], Belief],
        *,
        t: float,
        innovation: Array,
        withheld_error: Array,
        status: Status,
        steps: int,
        diagnose: Callable[[], Diagnostics[float]],
        held: tuple[str, ...],
        space: FunctionSpace,
        judge: Callable[[], Verdict],
        fit: Fit | None = None,
        state_space: FunctionSpace | None = None,
    ) -> Estimate:
        """Return an estimate whose belief is computed when it is first read, and kept then.

        Parameters
        ----------
        read
            Returns the belief; it must give the same numbers at any time.
        """
        estimate = object.__new__(cls)
        estimate.__dict__.update(
            _read=read,
            t=t,
            innovation=innovation,
            withheld_error=withheld_error,
            status=status,
            steps=steps,
            diagnose=diagnose,
            held=held,
            space=space,
            judge=judge,
            fit=fit,
            state_space=state_space,
        )
        return estimate

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            # Python calls this only for a name that is not in __dict__: it reads the belief once.
            held = self.__dict__
            read = held.get("_read") if name == "belief" else None
            if read is not None:
                held["belief"] = read()
                held.pop("_read", None)  # another thread may have been faster
            if name not in held:
                raise AttributeError(f"an Estimate has no attribute '{name}'.")
            return held[name]

    def __getstate__(self) -> dict[str, Any]:
        """Return the values themselves, for pickle and copies."""
        # Functions of a law cannot be pickled, and hold its arrays: what they return is stored.
        own = {
            "belief": self.belief,
            "verdict": self.verdict,
            "diagnostics": self.diagnostics,
            "diagnose": partial(kept, self.diagnostics),
            "judge": partial(kept, self.verdict),
            "space": self.space.described,
            "state_space": None,
        }
        return {k: v for k, v in vars(self).items() if k != "_read"} | own

    def _shown(self) -> tuple[str, Mapping[str, str]]:
        rows = {}
        for label in self.space.labels:
            unit = self.space.unknown_of(label).unit
            rows[label] = f"{self[label]} {unit}".rstrip()
        for name in self.space.fields:
            values, std = self[name].median, self[name].deviation
            rows[name] = f"field, coefficients {values.min():.4g} to {values.max():.4g}"
            if np.isfinite(std).all():
                rows[name] += f", mean std. dev. {std.mean():.2g}"
        rows["status"] = self.status.code
        if self.held:
            rows["held inputs"] = listed(self.held)
        return f"Estimate at t = {self.t:g}", rows

    @cached_property
    def diagnostics(self) -> Diagnostics[float]:
        """Innovation statistics, safeguards, and other numbers of the law."""
        return self.diagnose()

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict on the trustworthiness of the estimates, by all samples so far.

        It is computed on first access, which takes about a millisecond.
        """
        shifts = self.diagnostics.shifts
        shifted = [*discretised(shifts), *held_inputs(shifts)]
        return self.judge().with_findings([*known_badly(self.belief, self.space), *shifted])

    @property
    def q(self) -> Array:
        """Coefficients of the parameter, shape (m,)."""
        return self.belief.q

    @property
    def u(self) -> Array:
        """Coefficients of the state, shape (n,)."""
        return self.belief.u

    @property
    def q_std(self) -> Array | None:
        """Standard deviation of each coefficient of q, or None if the law has none."""
        return self.belief.q_std

    @property
    def u_std(self) -> Array | None:
        """Standard deviation of each coefficient of u, or None if the law has none."""
        return self.belief.u_std

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Label of each scalar unknown -> (value, standard deviation; NaN if there is none).

        For a `Normal` mean and standard deviation. Under a transform the median, and the standard
        deviation to first order; `estimate[label]` has mean and standard deviation of these, too.
        """
        std = self.q_std
        return {
            label: (float(self.q[k]), float(std[k]) if std is not None else np.nan)
            for label, k in self.space.labels.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return time, status, unknown numbers and innovations as JSON can hold them.

        {"t", "status", "unknowns": {label: {"value", "std"}}, "innovation": [...], "verdict"}; None
        stands where there is no number.
        """
        unknowns = {
            label: {"value": _number(value), "std": _number(std)}
            for label, (value, std) in self.parameters.items()
        }
        return {
            "t": self.t,
            "status": self.status.code,
            "unknowns": unknowns,
            "innovation": [_number(value) for value in self.innovation.tolist()],
            "verdict": self.verdict.level,
        }

    def __getitem__(self, name: str) -> Marginal:
        """Return the marginal of one unknown: median, mean, standard deviation and intervals.

        Parameters
        ----------
        name
            Label of an unknown number, or name of a field or of a component of the state, which
            have values at coordinates: `estimate["u"].at([0.1, 0.5])`.

        Raises
        ------
        ConfigurationError
            There is no such unknown.
        """
        space = self.space
        std = self.q_std if self.q_std is not None else np.full_like(self.q, np.nan)
        if name in space.labels:
            k = space.labels[name]
            return Marginal(float(self.q[k]), float(std[k]), space.unknown_of(name))
        if name in space.fields:
            part = space.part(name)
            known = space.unknown_of(name)
            return Marginal(self.q[part], std[part], known, partial(self._at, name))
        if self.state_space is not None and name in self.state_space.fields:
            part = self.state_space.part(name)
            u_std = self.u_std if self.u_std is not None else np.full_like(self.u, np.nan)
            known = self.state_space.unknown_of(name)
            return Marginal(self.u[part], u_std[part], known, partial(self._at, name))
        components = () if self.state_space is None else self.state_space.fields
        raise ConfigurationError(
            f"estimate['{name}']: there is no unknown '{name}'; there are "
            f"{[*space.labels, *space.fields, *components]}."
        )

    def _at(self, name: str, points: ArrayLike) -> Marginal:
        """Return the marginals of the values of a field at points."""
        if self.state_space is None:
            raise ConfigurationError(
                f"estimate['{name}'].at: this estimate was pickled, without its mesh: call `at` "
                "of the estimate of an identifier."
            )
        unknown = name in self.space.fields
        space = self.space if unknown else self.state_space
        block, part = space.fields[name], space.part(name)
        at, one = _coordinates(points, len(block.box[0]), name)
        rows = block.probe(at, f"estimate['{name}'].at: point")
        if unknown:
            values, std = rows @ self.q[part], self.belief.deviation(rows, part)
        else:
            factor = self.belief.u_factor
            values = rows @ self.u[part]
            std = None if factor is None else np.linalg.norm(rows @ factor[part], axis=1)
        std = np.full_like(values, np.nan) if std is None else std
        shape = () if one else (at.shape[1],)
        if block.vector:
            values, std = (x.reshape(-1, at.shape[1]).T for x in (values, std))
            shape = (*shape, values.shape[1])
        if not shape:
            return Marginal(float(values[0]), float(std[0]), space.unknown_of(name))
        return Marginal(values.reshape(shape), std.reshape(shape), space.unknown_of(name))


def _coordinates(points: ArrayLike, axes: int, name: str) -> tuple[Array, bool]:
    """Return coordinates of points, shape (axes, points), and whether one point is meant."""
    try:
        given = np.asarray(points, dtype=float)
    except (TypeError, ValueError):
        given = np.zeros((0, 0, 0))
    one = given.ndim == 0 or (given.ndim == 1 and axes > 1)
    columns = given.reshape(-1, 1) if axes == 1 and given.ndim < 2 else np.atleast_2d(given)
    if columns.ndim != 2 or columns.shape[1] != axes:
        shapes = "(points,)" if axes == 1 else f"({axes},) or (points, {axes})"
        raise ConfigurationError(
            f"estimate['{name}'].at: got points {points!r:.60}; expected numbers, shape {shapes}."
        )
    return columns.T, one


@dataclass(frozen=True, eq=False)
class Marginal:
    """The marginal distribution of one unknown in an estimate: a Gaussian in its latent value.

    Attributes
    ----------
    median
        A number; of a field an array of coefficients.
    deviation
        Standard deviation to first order: that of the latent value times the slope of the transform
        at the median. NaN for a law without covariance.
    unknown
        The unknown with its prior.
    """

    median: Any
    deviation: Any
    unknown: Any
    _read: Callable[[ArrayLike], Marginal] | None = None

    def at(self, points: ArrayLike) -> Marginal:
        """Return the marginals of the values of a field at points.

        Parameters
        ----------
        points
            Coordinates of one or more points: on an interval a number or shape (points,), else
            shape (d,) or (points, d).

        Returns
        -------
        marginals
            Its median, deviation, mean, std and intervals have a number for each point; of a vector
            field a row of components.

        Raises
        ------
        ConfigurationError
            The unknown is a number, or the estimate was pickled.
        ObservationError
            A point outside of the mesh.

        Examples
        --------
        >>> import livepde as lp
        >>> from livepde.models import heat
        >>> model = heat(lp.interval(0.0, 1.0, 20), lp.Normal(0.1, std=0.05))
        >>> rod = lp.Identifier(model, lp.Points({"middle": 0.5}, noise=0.1), u0=20.0)
        >>> estimate = rod.step(0.1, [20.0])
        >>> estimate["u"].at([0.25, 0.5]).mean.round(3)
        array([20., 20.])
        """
        if self._read is None:
            raise ConfigurationError("at: only a field has values at points; this is a number.")
        return self._read(points)

    @property
    def mean(self) -> Any:
        """Mean: the median of a `Normal`, larger than it for a `LogNormal`."""
        return self._moments[0]

    @property
    def std(self) -> Any:
        """Standard deviation: `deviation` of a `Normal`, larger for a `LogNormal`."""
        return self._moments[1]

    @cached_property
    def _moments(self) -> tuple[Any, Any]:
        mean, std = self.unknown.prior.moments(self.median, self.deviation)
        return (float(mean), float(std)) if isinstance(self.median, float) else (mean, std)

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Return the ends of the central interval that holds it with probability `level`.

        Within its bounds, and not symmetric for a `LogNormal` or `LogitNormal`. NaN for a law
        without covariance.
        """
        low, high = self.unknown.interval(self.median, self.deviation, level)
        return (float(low), float(high)) if isinstance(self.median, float) else (low, high)

    def __str__(self) -> str:
        """Return mean and standard deviation; under a transform median and 95 % interval."""
        if not isinstance(self.median, float):
            return repr(self)
        if isinstance(self.unknown.prior, Normal):
            return f"{self.mean:.4g} ± {self.std:.2g}"
        low, high = self.interval()
        return f"{self.median:.4g} (95 %: {low:.4g} to {high:.4g})"


def known_badly(belief: Belief, space: FunctionSpace) -> Iterator[Finding]:
    """Return findings on scalar unknowns that are not identifiable, or end at a bound."""
    for label, row in space.labels.items():
        unknown, value = space.unknown_of(label), float(belief.q[row])
        lower, upper = map(float, unknown.prior.bounds)
        if value in (lower, upper):
            yield at_bound(label, value)
        left = float(belief.left([row])[0])
        if left > FLAT and not unknown.evolution.moves:
            yield flat(label, left)


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
        Names of withheld sensors that never count, for the default layout.
    """

    def __init__(
        self,
        model: Model,
        observed: Observed,
        withheld: Observed | None,
        fields_every: int = 1,
        records: Records | None = None,
        layout: Layout | None = None,
        count: int | None = None,
        ignored: Sequence[str] = (),
    ) -> None:
        self.model = model
        self.observed = observed
        self.withheld = withheld
        self.fields_every = fields_every
        self.last: Estimate | None = None
        self._settled: Belief | None = None
        self._ended = False  # a last fit was asked for
        self.smoother: Callable[[], xr.Dataset] | None = None
        self.readings: Callable[[], Array] | None = None  # of all samples, (samples, sensors)
        # From q and draws of it to the readings that they lead to, and their deviations.
        self.expected: Callable[[Array, Array], tuple[Array, Array]] | None = None
        self.records: Records = RecordArrays() if records is None else records
        self.layout = layout or layout_of(model, observed, withheld, ignored)
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
        self.records.append(self.record(estimate, self._keeps))
        self._follow(estimate)

    def announce(self, estimate: Estimate) -> bool:
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

    def settle(self, estimate: Estimate) -> None:
        """Take the last parameter and state from `Identifier.settled`, in tables and datasets."""
        self._ended = True
        if estimate is not self.last:
            self.last, self._settled = estimate, estimate.belief

    def record(self, estimate: Estimate, keeps: bool) -> Record:
        """Return the record of an estimate; `keeps`: with its fields."""
        return Record(
            t=estimate.t,
            numbers=np.array(self._readout(estimate.belief)),
            innovation=estimate.innovation,
            withheld_error=estimate.withheld_error,
            status=STATUS_CODES.index(estimate.status.code),
            steps=estimate.steps,
            notes=estimate.diagnostics.named(),
            snapshot=self.snapshot(estimate) if keeps else None,
        )

    def snapshot(self, estimate: Estimate) -> Snapshot:
        """Return the fields at the vertices."""
        space, told, left_out = self.model.parameter_space, {}, {}
        for name, field in space.fields.items():
            left = estimate.belief.modes_left(space.part(name))
            if len(left):
                # A mode counts by the share of its prior variance that the data have taken away.
                told[name] = float(np.maximum(1.0 - left**2, 0.0).sum()), len(left)
                left_out[name] = estimate.belief.left_out(field.at_vertices, space.part(name))
        profiles = self._profiles(estimate).items()
        order = vertex_order(self.model)
        ordered = {name: values[order] for name, values in profiles}
        return Snapshot(ordered, told, _correlation(estimate), left_out)

    def _profiles(self, estimate: Estimate) -> dict[str, Array]:
        """Return values and standard deviations of all fields at the vertices."""
        found: dict[str, Array] = {}
        belief = estimate.belief
        for name, block in self.model.state_space.fields.items():
            part = self.model.state_space.part(name)
            found |= _split(name, block, block.at_vertices @ estimate.u[part])
            if belief.u_factor is not None:
                squares = (block.at_vertices @ belief.u_factor[part]) ** 2
                deviation = np.sqrt(squares.sum(axis=1))
                found |= _split(name, block, deviation, "_std")
        for name, field in self.model.parameter_space.fields.items():
            part = self.model.parameter_space.part(name)
            found[name] = field.at_vertices @ estimate.q[part]
            std = belief.deviation(field.at_vertices, part)
            if std is not None:
                found[f"{name}_std"] = std
                unknown = self.model.parameter_space.unknowns[name]
                found |= interval_ends(name, unknown, found[name], std)
        return found

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
        `withheld_error:T_1` if it is withheld; and `status`.
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
        import xarray as xr

        last, model = self._last("sample"), self.model
        q, u = draws(last.belief, last.space, n, seed)
        numbers = {
            label: ("draw", q[:, k], {"units": last.space.unknown_of(label).unit})
            for label, k in last.space.labels.items()
        }
        fields: dict[str, Any] = {}
        order = vertex_order(model)
        for space, values in ((model.parameter_space, q), (model.state_space, u)):
            for name, block in space.fields.items():
                at_vertices = block.at_vertices @ values[:, space.part(name)].T
                names = block.variables(name)
                parts = at_vertices.reshape(len(names), -1, n)
                fields |= {
                    key: (("draw", "vertex"), part[order].T)
                    for key, part in zip(names, parts, strict=True)
                }
        axes = {axis: ("vertex", np.array(x)) for axis, x in self.layout.coordinates.items()}
        return xr.Dataset({**numbers, **fields}, axes)

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

        drawn = self.sample(n, seed).assign_coords(draw=np.arange(n))
        before = {
            label: ("draw", values)
            for label, values in prior_draws(self._last("prior").space, n, seed).items()
        }
        groups = {"posterior": drawn, "prior": xr.Dataset(before, {"draw": np.arange(n)})}
        chains = {name: group.expand_dims(chain=[0]) for name, group in groups.items()}
        if self.readings is not None:
            frame = self.measured
            chains["observed_data"] = xr.Dataset({name: frame[name] for name in frame})
        if self.expected is not None:
            last = self._last("to_inference_data")
            # The same draws as in `sample`, without what the law takes no account of.
            q, _ = draws(replace(last.belief, rest=None), last.space, n, seed)
            measured = self.measured[list(self.layout.sensors)]
            chains |= predictive(measured, *self.expected(last.q, q), seed)
        return xr.DataTree.from_dict(chains)

    @property
    def measured(self) -> pd.DataFrame:
        """Readings of the assimilated and then of the withheld sensors, one row for each sample.

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

        Of assimilated sensors before their reading was used, of withheld ones after the update;
        NaN where there is no reading. Raises as `measured`.
        """
        return self.measured - self.residuals

    @property
    def residuals(self) -> pd.DataFrame:
        """Measured minus predicted readings of all sensors, one row for each sample."""
        import pandas as pd

        data = self.dataset()
        columns = over_time(data, "innovation", "sensor")
        return pd.DataFrame(columns | over_time(data, "withheld_error", "withheld"), times(data))

    def _last(self, what: str) -> Estimate:
        """Return the last estimate."""
        if self.last is None:
            raise ConfigurationError(f"{what}: the run contains no samples yet.")
        return self.last

    def dataset(self) -> xr.Dataset:
        """Return the dataset that a run directory holds.

        Its dimensions are time, snapshot, vertex, sensor and withheld.
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
        records, last = RecordArrays.of(self.records), self._last_fields
        if self._complete:
            return records, last
        if self.last is not None and self._settled is not None:
            snapshot = (
                None if records.last_snapshot < len(records) - 1 else self.snapshot(self.last)
            )
            records = records.with_last(np.array(self._readout(self._settled)), snapshot)
        if self.last is not None and records.last_snapshot < len(records) - 1:
            # The last fields are part of the dataset, also where `fields_every` has left them out.
            last = self.snapshot(self.last)
        return records, last

    def __getstate__(self) -> dict[str, Any]:
        """Return what was found, without the model, whose functions may not be pickled."""
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
        left = ("model", "observed", "withheld", "_readout", "_settled")
        return {k: v for k, v in vars(self).items() if k not in left} | own

    def __getattr__(self, name: str) -> Any:
        # Python calls this only for names that are not there: those that `__getstate__` leaves out.
        if name in ("model", "observed", "withheld", "_readout", "_settled"):
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


def _number(value: float) -> float | None:
    """Return a number that JSON can hold."""
    return value if np.isfinite(value) else None


def layout_of(
    model: Model, observed: Observed, withheld: Observed | None, ignored: Sequence[str] = ()
) -> Layout:
    """Return names, units and coordinates of the records of a run.

    Parameters
    ----------
    ignored
        Names of withheld sensors that never count.
    """
    numbers: dict[str, dict[str, Any]] = {}
    for label in model.parameter_space.labels:
        unknown = model.parameter_space.unknown_of(label)
        unit: dict[str, Any] = {"units": unknown.unit}
        plain = isinstance(unknown.prior, Normal)  # then mean and standard deviation
        numbers[label] = {**unit, **_prior(unknown), **({} if plain else {"comment": MEDIAN})}
        numbers[f"{label}_std"] = {**unit, **({} if plain else {"comment": FIRST_ORDER})}
        numbers |= dict.fromkeys(interval_ends(label, unknown, 0.0, 0.0), unit)
        numbers[f"{label}_left"] = {"long_name": "share of the prior standard deviation"}
    points = model.mesh.p[:, vertex_order(model)]
    components = model.state_space.fields.items()
    places = {**observed.places, **({} if withheld is None else withheld.places)}
    units = {
        name: unit
        for one in (observed, withheld)
        if one is not None
        for name, unit in zip(one.names, one.units, strict=True)
    }
    stated = {unit for unit in units.values() if unit}
    several = len(stated) > 1
    return Layout(
        time_unit=model.time_unit,
        sensor_unit="" if several else "".join(stated),
        coordinates={axis: x.tolist() for axis, x in zip("xyz", points, strict=False)},
        cells={kind: corners.tolist() for kind, corners in cells(model.mesh).items()},
        sensors=list(observed.names),
        withheld=None if withheld is None else list(withheld.names),
        numbers=numbers,
        units=_units(model),
        scalars=list(model.parameter_space.labels),
        fields=list(model.parameter_space.fields),
        state=[key for name, block in components for key in block.variables(name)],
        length_unit=model.length_unit,
        places={name: at.tolist() for name, at in places.items()},
        comments=_field_comments(model),
        attrs={"ignored": "\n".join(ignored)} if ignored else {},
        sensor_units=units if several else {},
    )


def vertex_order(model: Model) -> Any:
    """In which order vertices are kept: along an interval, else as the mesh has them."""
    points = model.mesh.p
    return np.argsort(points[0]) if len(points) == 1 else slice(None)


def _units(model: Model) -> dict[str, str]:
    unknowns = {**model.state_space.unknowns, **model.parameter_space.unknowns}
    found = {name: unknown.unit for name, unknown in unknowns.items()}
    for name, block in model.state_space.fields.items():
        found |= dict.fromkeys(block.variables(name), found[name])
    return found


def _split(name: str, block: FieldBlock, values: Array, end: str = "") -> dict[str, Array]:
    """Return the variables of a component with their values at the vertices."""
    names = block.variables(name)
    rows = values.reshape(len(names), -1)
    return {f"{key}{end}": row for key, row in zip(names, rows, strict=True)}


def interval_ends(name: str, unknown: Any, values: Any, std: Any) -> dict[str, Any]:
    """Return variables with the ends of 95 % intervals, if those are not mean +- 1.96 std."""
    if unknown.prior.symmetric:
        return {}
    low, high = unknown.interval(values, std)
    return {f"{name}_low": low, f"{name}_high": high}


def _correlation(estimate: Estimate) -> Array | None:
    """Return the correlation matrix of the scalar unknowns."""
    labels, factor = estimate.space.labels, estimate.belief.q_factor
    if factor is None or len(labels) < 2:
        return None
    rows = factor[list(labels.values())]
    size = np.linalg.norm(rows, axis=1)
    unit = rows / np.where(size > 0.0, size, 1.0)[:, None]
    correlation: Array = unit @ unit.T
    return correlation


def _prior(unknown: Any) -> dict[str, float]:
    """Return prior and finite bounds of a scalar unknown as attributes of its variable."""
    bounds = zip(("lower_bound", "upper_bound"), unknown.prior.bounds, strict=True)
    found = {name: float(bound) for name, bound in bounds if np.isfinite(bound)}
    if not unknown.evolution.moves:  # one that moves is never known better for good
        found["prior_std"] = float(unknown.prior.std)
    return found


def _field_comments(model: Model) -> dict[str, str]:
    """Return unknown field or its standard deviation -> what it is, where it has a transform."""
    found: dict[str, str] = {}
    for name, block in model.parameter_space.fields.items():
        if not isinstance(block.field.prior, Normal):
            found |= {name: MEDIAN, f"{name}_std": FIRST_ORDER}
    return found


def summary(data: xr.Dataset) -> dict[str, dict[str, float]]:
    """Return the table of a run's dataset: last estimates, and errors of each channel."""
    rows: dict[str, dict[str, float]] = {}
    for label in filter(None, data.attrs["scalars"].split("\n") if data.sizes["time"] else ()):
        rows[label] = {
            "value": float(data[label][-1]),
            "std": float(data[f"{label}_std"][-1]),
        }
    for variable, dimension in (("innovation", "sensor"), ("withheld_error", "withheld")):
        if variable not in data:
            continue
        columns = used_errors(data, variable, dimension).T
        for name, column in zip(data[dimension].values, columns, strict=True):
            errors = column[np.isfinite(column)]
            rows[f"{variable}:{name}"] = {
                "rmse": float(np.sqrt((errors**2).mean())) if len(errors) else np.nan,
                "count": float(len(errors)),
            }
    for name, which in refused_readings(data).items():
        rows[f"innovation:{name}"]["refused"] = float(which.sum())
    return rows


def kept(value: Kept) -> Kept:
    """Return a value: with it, a function that returns it can be pickled."""
    return value
