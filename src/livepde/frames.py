"""Results of a run: tables of pandas, a dataset with axes, draws, and rows of numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from livepde.dates import instants
from livepde.errors import LawError
from livepde.fem import FunctionSpace, Normal
from livepde.laws import Belief
from livepde.linalg import Array
from livepde.records import (
    DATE,
    ESTIMATES,
    PARAMETER,
    STATISTIC,
    STATUS_CODES,
    field_names,
    interval_95,
    scalars,
)
from livepde.verdict import ModelErrors

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

STATISTICS = ("value", "std", "low", "high")
ERRORS = (("innovation", "sensor"), ("withheld_error", "withheld"))
LEVEL = 0.95
Ends: TypeAlias = Callable[[float, float], tuple[float, ...]]


def model_errors(data: xr.Dataset) -> ModelErrors | None:
    """Return misfit and effects that the verdict of a run has stated; None without."""
    stored = data.attrs.get("verdict")
    return ModelErrors.from_dict(json.loads(stored).get("errors")) if stored else None


def relative_error(data: xr.Dataset, label: str) -> float:
    """Return the relative error of the last estimate to the reference, NaN without one."""
    reference = float(data[label].attrs.get("reference", math.nan))
    return abs(float(data[label][-1]) - reference) / abs(reference) if reference else math.nan


def estimates(data: xr.Dataset) -> pd.DataFrame:
    """Return the last estimates of the numbers of a run, one row for each: see `Result.summary`."""
    import pandas as pd

    errors = model_errors(data)
    verdict = json.loads(data.attrs["verdict"]) if "verdict" in data.attrs else {}
    allowed = {} if errors is None else {one.label: one for one in errors.unknowns}
    labels, rows = scalars(data) if data.sizes["time"] else [], []
    for label in labels:
        ends = interval_95(data, label)
        values = (data[label][-1], data[f"{label}_std"][-1], *(end[-1] for end in ends))
        row: dict[str, Any] = dict(zip(STATISTICS, map(float, values), strict=True))
        one = allowed.get(label)
        row["model_low"] = math.nan if one is None else one.low
        row["model_high"] = math.nan if one is None else one.high
        row["effect"] = math.nan if one is None else one.effect
        row |= {"unit": data[label].attrs.get("units", ""), "level": verdict.get("level", "")}
        if any("reference" in data[name].attrs for name in labels):
            row["reference"] = float(data[label].attrs.get("reference", math.nan))
            row["error"] = relative_error(data, label)
        rows.append(row)
    columns = [*STATISTICS, "model_low", "model_high", "effect", "unit", "level"]
    found = pd.DataFrame(rows, pd.Index(labels, name="unknown"), None if rows else columns)
    if errors is not None:
        found.attrs["misfit"] = errors.misfit
    return found


def times(data: xr.Dataset) -> pd.Index[Any]:
    """Return the times of a run for an index: dates where it has them."""
    import pandas as pd

    dates = instants(data, data["time"].values)
    index: pd.Index[Any] = pd.Index(data["time"].values if dates is None else dates, name="time")
    return index


def frame(data: xr.Dataset) -> pd.DataFrame:
    """Return numbers over time, one row for each sample: see `Result.to_dataframe`."""
    import pandas as pd

    columns: dict[str, Array] = {}
    for label in scalars(data):
        low, high = interval_95(data, label)
        columns |= {label: data[label].values, f"{label}_std": data[f"{label}_std"].values}
        columns |= {f"{label}_low": low, f"{label}_high": high}
    for variable, dimension in ERRORS:
        for name, values in over_time(data, variable, dimension).items():
            columns[f"{variable}:{name}"] = values
    columns["status"] = np.array(STATUS_CODES)[data["status"].values]
    return pd.DataFrame(columns, times(data))


def over_time(data: xr.Dataset, variable: str, dimension: str) -> dict[str, Array]:
    """Return the values of each channel of a variable; none if the run has no such variable."""
    if variable not in data:
        return {}
    columns = data[variable].transpose(dimension, "time").values
    return dict(zip(map(str, data[dimension].values), columns, strict=True))


def with_estimates(data: xr.Dataset) -> xr.Dataset:
    """Return the dataset of a run with dates, and with its numbers on separate axes."""
    found: dict[str, Any] = {}
    labels = scalars(data)
    for name in [*labels, *field_names(data)]:
        if f"{name}_std" in data and f"{name}_low" not in data:
            sides = zip(("low", "high"), interval_95(data, name), strict=True)
            about = data[f"{name}_std"]
            found |= {f"{name}_{side}": (about.dims, x, about.attrs) for side, x in sides}
    data = data.assign(found)
    dates = instants(data, data["time"].values)
    if dates is not None:
        data = data.assign_coords({DATE: ("time", dates.tz_localize(None))})
    if not labels:
        return data
    ends = ("", "_std", "_low", "_high")  # as STATISTICS
    columns = [[data[f"{label}{end}"].values for end in ends] for label in labels]
    values = np.array(columns).transpose(2, 0, 1)
    units = [str(data[label].attrs.get("units", "")) for label in labels]
    return data.assign({ESTIMATES: (("time", PARAMETER, STATISTIC), values)}).assign_coords(
        {
            PARAMETER: (PARAMETER, labels),
            STATISTIC: (STATISTIC, list(STATISTICS)),
            f"{PARAMETER}_unit": (PARAMETER, units),
        }
    )


def covariance_of(belief: Belief, space: FunctionSpace) -> pd.DataFrame:
    """Return the covariance of the numbers among the unknowns, by label."""
    import pandas as pd

    rows = list(space.labels.values())
    factor = _factor(belief)[rows]
    rest = np.zeros(len(rows)) if belief.rest is None else belief.rest[rows]
    names = pd.Index(list(space.labels), name="unknown")
    return pd.DataFrame(factor @ factor.T + np.diag(rest**2), names, names)


def draws(
    belief: Belief, space: FunctionSpace, n: int, seed: int | np.random.Generator | None
) -> tuple[Array, Array]:
    """Return draws of the coefficients of parameter and state, shapes (n, m) and (n, state).

    Jointly normal in latent values, with what the law leaves out; the state to first order.
    """
    factor, rng = _factor(belief), np.random.default_rng(seed)
    xi = rng.standard_normal((n, factor.shape[1]))
    shift = xi @ factor.T
    if belief.rest is not None:
        shift += belief.rest * rng.standard_normal(shift.shape)
    q = np.empty_like(shift)
    for name, unknown in space.unknowns.items():
        part = space.part(name)
        moved = unknown.prior.transform.shifted(belief.q[part], shift[:, part], 1.0)
        q[:, part] = np.clip(moved, *unknown.prior.bounds)
    u_factor = belief.u_factor
    return q, belief.u + (0.0 if u_factor is None else xi @ u_factor.T)


def prior_draws(
    space: FunctionSpace, n: int, seed: int | np.random.Generator | None
) -> dict[str, Array]:
    """Return draws of the numbers among the unknowns from their priors, each of shape (n,)."""
    rng, found = np.random.default_rng(seed), {}
    for label in space.labels:
        prior = space.unknown_of(label).prior
        latent = prior.latent_mean + prior.latent_std * rng.standard_normal(n)
        found[label] = np.clip(prior.transform.value(latent), *prior.bounds)
    return found


def predictive(
    measured: pd.DataFrame,
    expected: Array,
    std: Array,
    seed: int | np.random.Generator | None,
) -> dict[str, xr.Dataset]:
    """Return draws of readings and log densities: see `Result.to_inference_data`.

    Parameters
    ----------
    measured
        Readings, one column for each sensor.
    expected, std
        What they are for each draw, shape (n, samples, sensors), and their standard deviations
        about it, shape (samples, sensors).
    """
    import xarray as xr

    n, values = len(expected), measured.to_numpy()
    drawn = expected + std * np.random.default_rng(seed).standard_normal(expected.shape)
    shown = {name: (("draw", "time"), drawn[..., k]) for k, name in enumerate(measured)}
    rows, columns = (np.isfinite(values) & np.isfinite(std)).nonzero()
    scale = std[rows, columns]
    e = (values[rows, columns] - expected[:, rows, columns]) / scale
    density = -0.5 * e**2 - np.log(scale) - 0.5 * math.log(2.0 * math.pi)
    # ArviZ refuses readings that are the same for all draws, as where the initial state is known.
    told = np.ptp(density, axis=0) > 1e-12 * np.abs(density).max(axis=0, initial=1.0)
    about = {
        "time": ("reading", measured.index[rows[told]]),
        "sensor": ("reading", measured.columns[columns[told]].to_numpy(dtype=str)),
    }
    groups = {
        "posterior_predictive": xr.Dataset(shown, {"time": measured.index}),
        "log_likelihood": xr.Dataset({"readings": (("draw", "reading"), density[:, told])}, about),
    }
    return {
        name: group.assign_coords(draw=np.arange(n)).expand_dims(chain=[0])
        for name, group in groups.items()
    }


def _factor(belief: Belief) -> Array:
    """Return the square root of the covariance of the unknowns."""
    if belief.q_factor is None:
        raise LawError("this law has no covariance: use SensitivityLaw.")
    return belief.q_factor


class ScalarReadout:
    """Numbers of the scalar unknowns, in the order of `Layout.numbers`.

    The arithmetic equals that of `Belief` and of `Scalar.interval` to the last bit; quantities that
    do not change between samples are computed once.
    """

    def __init__(self, space: FunctionSpace) -> None:
        rows = list(space.labels.values())
        consecutive = bool(rows) and rows == list(range(rows[0], rows[0] + len(rows)))
        self._rows: Any = slice(rows[0], rows[-1] + 1) if consecutive else rows
        self._ends = [_ends(space.unknown_of(label)) for label in space.labels]
        self._prior: tuple[Array | None, list[float]] = (None, [])

    def __call__(self, belief: Belief) -> list[float]:
        """Return (value, standard deviation, interval ends, share left) of all, concatenated."""
        if not self._ends:
            return []
        values = belief.q[self._rows].tolist()
        deviations, shares = self._deviations(belief)
        found: list[float] = []
        for value, std, ends, share in zip(values, deviations, self._ends, shares, strict=True):
            found += (value, std, *ends(value, std), share)
        return found

    def _deviations(self, belief: Belief) -> tuple[list[float], list[float]]:
        """Return standard deviations, and their ratios to those of the prior."""
        factor, nothing = belief.q_factor, [math.nan] * len(self._ends)
        if factor is None:
            return nothing, nothing
        # Rows of a column-major matrix would be summed in another order, with other rounding.
        chosen = factor[self._rows]
        after = np.sqrt(np.add.reduce(chosen * chosen, axis=1))
        std = after
        if not factor.flags.c_contiguous:
            std = np.sqrt(np.add.reduce(factor * factor, axis=1))[self._rows]
        if belief.rest is not None:
            std = np.hypot(std, belief.rest[self._rows])
        if belief.prior_factor is None:
            return std.tolist(), nothing
        if self._prior[0] is not belief.prior_factor:
            self._prior = belief.prior_factor, self._before(belief.prior_factor)
        pairs = zip(after.tolist(), self._prior[1], strict=True)
        return std.tolist(), [share / before for share, before in pairs]

    def _before(self, prior: Array) -> list[float]:
        """Return prior standard deviations; NaN if there is none."""
        before = np.linalg.norm(prior[self._rows], axis=1)
        found: list[float] = np.where(before > 0.0, before, np.nan).tolist()
        return found


def _ends(unknown: Any) -> Ends:
    """Return the function from value and standard deviation to interval ends; () if symmetric."""
    if unknown.prior.symmetric:
        return lambda value, std: ()
    if not isinstance(unknown.prior, Normal):
        return lambda value, std: tuple(map(float, unknown.interval(value, std, LEVEL)))
    from statistics import NormalDist

    quantile = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)
    lower, upper = map(float, unknown.prior.bounds)

    def clipped(value: float, std: float) -> tuple[float, float]:
        if not math.isfinite(value + quantile * std):
            low, high = unknown.interval(value, std, LEVEL)
            return float(low), float(high)
        low, high = value - quantile * std, value + quantile * std
        return min(max(low, lower), upper), min(max(high, lower), upper)

    return clipped
