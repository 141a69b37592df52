"""Results of a run as pandas tables, datasets and draws; names and units of its records."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.dates import instants
from livepde.errors import LawError
from livepde.fem import FieldBlock, FunctionSpace, Normal, cells
from livepde.laws import Belief
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observed
from livepde.records import (
    DATE,
    ESTIMATES,
    PARAMETER,
    STATISTIC,
    STATUS_CODES,
    Layout,
    Snapshot,
    field_names,
    interval_95,
    refused_readings,
    scalars,
    used_errors,
)
from livepde.verdict import ModelErrors

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

MEDIAN = "the median"
FIRST_ORDER = "to first order: that of the latent value, times the slope of the transform"
STATISTICS = ("value", "std", "low", "high")
ALLOWED = ("model_low", "model_high", "effect")  # columns that allow for model errors
ERRORS = (("innovation", "sensor"), ("validation_error", "validation"))


def model_errors(data: xr.Dataset) -> ModelErrors | None:
    """Return misfit and effects in the verdict of a run; None without a verdict."""
    stored = data.attrs.get("verdict")
    return ModelErrors.from_dict(json.loads(stored).get("errors")) if stored else None


def relative_error(data: xr.Dataset, label: str) -> float:
    """Return the relative error of the last estimate; NaN without a nonzero reference."""
    reference = float(data[label].attrs.get("reference", math.nan))
    return abs(float(data[label][-1]) - reference) / abs(reference) if reference else math.nan


def estimates(data: xr.Dataset) -> pd.DataFrame:
    """Return a table of the last estimates of scalar unknowns: see `Result.summary`."""
    import pandas as pd

    errors, verdict = model_errors(data), json.loads(data.attrs.get("verdict", "{}"))
    allowed = errors.unknowns if errors is not None else ()
    by_label = {unknown.label: (unknown.low, unknown.high, unknown.effect) for unknown in allowed}
    labels, rows = scalars(data) if data.sizes["time"] else [], []
    for label in labels:
        ends = interval_95(data, label)
        values = (data[label][-1], data[f"{label}_std"][-1], *(end[-1] for end in ends))
        row: dict[str, Any] = dict(zip(STATISTICS, map(float, values), strict=True))
        row |= dict(zip(ALLOWED, by_label.get(label, (math.nan,) * 3), strict=True))
        row |= {"unit": data[label].attrs.get("units", ""), "level": verdict.get("level", "")}
        if any("reference" in data[name].attrs for name in labels):
            row["reference"] = float(data[label].attrs.get("reference", math.nan))
            row["error"] = relative_error(data, label)
        rows.append(row)
    columns = [*STATISTICS, *ALLOWED, "unit", "level"]
    table = pd.DataFrame(rows, pd.Index(labels, name="unknown"), None if rows else columns)
    if errors is not None:
        table.attrs["misfit"] = errors.misfit
    return table


def times(data: xr.Dataset) -> pd.Index[Any]:
    """Return an index with the times of a run, as dates if it has dates."""
    import pandas as pd

    dates = instants(data, data["time"].values)
    index: pd.Index[Any] = pd.Index(data["time"].values if dates is None else dates, name="time")
    return index


def frame(data: xr.Dataset) -> pd.DataFrame:
    """Return a table of numbers over time: see `Result.to_dataframe`."""
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
    """Return channel -> its values of a variable; empty if the run has no such variable."""
    if variable not in data:
        return {}
    columns = data[variable].transpose(dimension, "time").values
    return dict(zip(map(str, data[dimension].values), columns, strict=True))


def with_estimates(data: xr.Dataset) -> xr.Dataset:
    """Add dates, interval ends and the variable `estimates` to the dataset of a run."""
    intervals: dict[str, Any] = {}
    labels = scalars(data)
    for name in [*labels, *field_names(data)]:
        if f"{name}_std" in data and f"{name}_low" not in data:
            pairs = zip(("low", "high"), interval_95(data, name), strict=True)
            about = data[f"{name}_std"]
            intervals |= {f"{name}_{side}": (about.dims, x, about.attrs) for side, x in pairs}
    data = data.assign(intervals)
    dates = instants(data, data["time"].values)
    if dates is not None:
        data = data.assign_coords({DATE: ("time", dates.tz_localize(None))})
    if not labels:
        return data
    ends = ("", "_std", "_low", "_high")  # in the order of STATISTICS
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
    """Return the covariance of the scalar unknowns, by label."""
    import pandas as pd

    rows = list(space.labels.values())
    factor = _factor(belief)[rows]
    omitted = np.zeros(len(rows)) if belief.rest is None else belief.rest[rows]
    names = pd.Index(list(space.labels), name="unknown")
    return pd.DataFrame(factor @ factor.T + np.diag(omitted**2), names, names)


def draws(
    belief: Belief, space: FunctionSpace, n: int, seed: int | np.random.Generator | None
) -> tuple[Array, Array]:
    """Return draws of the coefficients of parameter and state, shapes (n, m) and (n, state).

    They are jointly normal in latent values and include the variance that the law omits. The
    state is linear to first order.
    """
    factor, rng = _factor(belief), np.random.default_rng(seed)
    xi = rng.standard_normal((n, factor.shape[1]))
    shift = xi @ factor.T
    if belief.rest is not None:
        shift += belief.rest * rng.standard_normal(shift.shape)
    q = np.empty_like(shift)
    for name, unknown in space.unknowns.items():
        part = space.part(name)
        shifted = unknown.prior.transform.shifted(belief.q[part], shift[:, part], 1.0)
        q[:, part] = np.clip(shifted, *unknown.prior.bounds)
    u_factor = belief.u_factor
    return q, belief.u + (0.0 if u_factor is None else xi @ u_factor.T)


def draws_dataset(
    model: Model, q: Array, u: Array, coordinates: Mapping[str, Sequence[float]]
) -> xr.Dataset:
    """Return a dataset of draws, given their coefficients: see `Result.sample`."""
    import xarray as xr

    space, order = model.parameter_space, vertex_order(model)
    numbers = {
        label: ("draw", q[:, k], {"units": space.unknown_of(label).unit})
        for label, k in space.labels.items()
    }
    fields: dict[str, Any] = {}
    for of, values in ((space, q), (model.state_space, u)):
        for name, block in of.fields.items():
            names = block.variables(name)
            parts = (block.at_vertices @ values[:, of.part(name)].T).reshape(len(names), -1, len(q))
            fields |= {
                key: (("draw", "vertex"), part[order].T)
                for key, part in zip(names, parts, strict=True)
            }
    axes = {axis: ("vertex", np.array(x)) for axis, x in coordinates.items()}
    return xr.Dataset({**numbers, **fields}, axes)


def prior_draws(space: FunctionSpace, n: int, seed: int | np.random.Generator | None) -> xr.Dataset:
    """Return draws of the scalar unknowns from their priors."""
    import xarray as xr

    rng, data = np.random.default_rng(seed), {}
    for label in space.labels:
        prior = space.unknown_of(label).prior
        latent = prior.latent_mean + prior.latent_std * rng.standard_normal(n)
        data[label] = ("draw", np.clip(prior.transform.value(latent), *prior.bounds))
    return xr.Dataset(data)


def predictive(
    measured: pd.DataFrame, expected: Array, std: Array, seed: int | np.random.Generator | None
) -> dict[str, xr.Dataset]:
    """Return draws of readings and log densities: see `Result.to_inference_data`.

    `measured`: readings, one column for each sensor.
    `expected`, `std`: expected readings for each draw, shape (n, samples, sensors), and standard
    deviations of the readings about them, shape (samples, sensors).
    """
    import xarray as xr

    n, values = len(expected), measured.to_numpy()
    drawn = expected + std * np.random.default_rng(seed).standard_normal(expected.shape)
    readings = {name: (("draw", "time"), drawn[..., k]) for k, name in enumerate(measured)}
    rows, columns = (np.isfinite(values) & np.isfinite(std)).nonzero()
    scale = std[rows, columns]
    e = (values[rows, columns] - expected[:, rows, columns]) / scale
    density = -0.5 * e**2 - np.log(scale) - 0.5 * math.log(2.0 * math.pi)
    # ArviZ rejects readings with equal density for all draws, as at a known initial state.
    kept = np.ptp(density, axis=0) > 1e-12 * np.abs(density).max(axis=0, initial=1.0)
    coords = {
        "time": ("reading", measured.index[rows[kept]]),
        "sensor": ("reading", measured.columns[columns[kept]].to_numpy(dtype=str)),
    }
    groups = {
        "posterior_predictive": xr.Dataset(readings, {"time": measured.index}),
        "log_likelihood": xr.Dataset({"readings": (("draw", "reading"), density[:, kept])}, coords),
    }
    return {
        name: group.assign_coords(draw=np.arange(n)).expand_dims(chain=[0])
        for name, group in groups.items()
    }


def _factor(belief: Belief) -> Array:
    if belief.q_factor is None:
        raise LawError("this law has no covariance: use SensitivityLaw.")
    return belief.q_factor


def layout_of(
    model: Model, observed: Observed, validation: Observed | None, ignored: Sequence[str] = ()
) -> Layout:
    """Return names, units and coordinates of the records of a run.

    `ignored`: names of validation sensors that never affect the verdict.
    """
    components = model.state_space.fields.items()
    places, units = _places_and_units(observed, validation)
    named_units = {*units.values()} - {""}
    mixed = len(named_units) > 1
    points = model.mesh.p[:, vertex_order(model)]
    return Layout(
        time_unit=model.time_unit,
        sensor_unit="" if mixed else "".join(named_units),
        coordinates={axis: x.tolist() for axis, x in zip("xyz", points, strict=False)},
        cells={kind: corners.tolist() for kind, corners in cells(model.mesh).items()},
        sensors=list(observed.names),
        validation=None if validation is None else list(validation.names),
        numbers=_numbers(model.parameter_space),
        units=_units(model),
        scalars=list(model.parameter_space.labels),
        fields=list(model.parameter_space.fields),
        state=[key for name, block in components for key in block.variables(name)],
        length_unit=model.length_unit,
        places=places,
        comments=_comments(model),
        attrs={"ignored": "\n".join(ignored)} if ignored else {},
        sensor_units=units if mixed else {},
    )


def _numbers(space: FunctionSpace) -> dict[str, dict[str, Any]]:
    """Return the attributes of each number of a record."""
    numbers: dict[str, dict[str, Any]] = {}
    for label in space.labels:
        unknown = space.unknown_of(label)
        unit: dict[str, Any] = {"units": unknown.unit}
        plain = isinstance(unknown.prior, Normal)  # the value is the mean, not only the median
        numbers[label] = {**unit, **_prior_attrs(unknown), **({} if plain else {"comment": MEDIAN})}
        numbers[f"{label}_std"] = {**unit, **({} if plain else {"comment": FIRST_ORDER})}
        numbers |= dict.fromkeys(interval_ends(label, unknown, 0.0, 0.0), unit)
        numbers[f"{label}_left"] = {"long_name": "share of the prior standard deviation"}
    return numbers


def _places_and_units(*groups: Observed | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Return sensor -> position, for sensors at one point, and sensor -> unit."""
    places: dict[str, Any] = {}
    units: dict[str, str] = {}
    for observed in filter(None, groups):
        places |= {name: at.tolist() for name, at in observed.places.items()}
        units |= dict(zip(observed.names, observed.units, strict=True))
    return places, units


def _comments(model: Model) -> dict[str, str]:
    """Return comments on the unknown fields whose values are medians."""
    comments: dict[str, str] = {}
    for name, block in model.parameter_space.fields.items():
        if not isinstance(block.field.prior, Normal):
            comments |= {name: MEDIAN, f"{name}_std": FIRST_ORDER}
    return comments


def vertex_order(model: Model) -> Any:
    """Return the order of stored vertices: increasing on an interval, else that of the mesh."""
    points = model.mesh.p
    return np.argsort(points[0]) if len(points) == 1 else slice(None)


def _units(model: Model) -> dict[str, str]:
    unknowns = {**model.state_space.unknowns, **model.parameter_space.unknowns}
    units = {name: unknown.unit for name, unknown in unknowns.items()}
    for name, block in model.state_space.fields.items():
        units |= dict.fromkeys(block.variables(name), units[name])
    return units


def interval_ends(name: str, unknown: Any, values: Any, std: Any) -> dict[str, Any]:
    """Return variables with the ends of 95 % intervals, unless these are mean +- 1.96 std."""
    if unknown.prior.symmetric:
        return {}
    low, high = unknown.interval(values, std)
    return {f"{name}_low": low, f"{name}_high": high}


def _prior_attrs(unknown: Any) -> dict[str, float]:
    """Return the prior and finite bounds of a scalar unknown, as attributes of its variable."""
    bounds = zip(("lower_bound", "upper_bound"), unknown.prior.bounds, strict=True)
    attributes = {name: float(bound) for name, bound in bounds if np.isfinite(bound)}
    if not unknown.evolution.moves:  # the variance of a moving unknown may increase again
        attributes["prior_std"] = float(unknown.prior.std)
    return attributes


def summary(data: xr.Dataset) -> dict[str, dict[str, float]]:
    """Return a table of the last estimates and of the errors of each channel of a run."""
    rows: dict[str, dict[str, float]] = {}
    for label in scalars(data) if data.sizes["time"] else ():
        rows[label] = {"value": float(data[label][-1]), "std": float(data[f"{label}_std"][-1])}
    for variable, dimension in ERRORS:
        if variable not in data:
            continue
        columns = used_errors(data, variable, dimension).T
        for name, column in zip(data[dimension].values, columns, strict=True):
            errors = column[np.isfinite(column)]
            rows[f"{variable}:{name}"] = {
                "rmse": float(np.sqrt((errors**2).mean())) if len(errors) else np.nan,
                "count": float(len(errors)),
            }
    for name, refused in refused_readings(data).items():
        rows[f"innovation:{name}"]["refused"] = float(refused.sum())
    return rows


def snapshot_of(model: Model, belief: Belief) -> Snapshot:
    """Return the fields of a belief at the vertices, with their determined modes."""
    space, determined, left_out = model.parameter_space, {}, {}
    for name, field in space.fields.items():
        ratios = belief.modes_left(space.part(name))
        if len(ratios):
            # The weight of a mode is the share by which the data have reduced its prior variance.
            determined[name] = float(np.maximum(1.0 - ratios**2, 0.0).sum()), len(ratios)
            left_out[name] = belief.left_out(field.at_vertices, space.part(name))
    order, rows = vertex_order(model), [*space.labels.values()]
    ordered = {name: values[order] for name, values in _profiles(model, belief).items()}
    if belief.q_factor is None or len(rows) < 2:
        return Snapshot(ordered, determined, None, left_out)
    return Snapshot(ordered, determined, correlation_of(belief.q_factor[rows]), left_out)


def _profiles(model: Model, belief: Belief) -> dict[str, Array]:
    """Return values and standard deviations of all fields at the vertices."""
    profiles: dict[str, Array] = {}
    for name, block in model.state_space.fields.items():
        part = model.state_space.part(name)
        profiles |= _components(name, block, block.at_vertices @ belief.u[part])
        if belief.u_factor is not None:
            squares = (block.at_vertices @ belief.u_factor[part]) ** 2
            profiles |= _components(name, block, np.sqrt(squares.sum(axis=1)), "_std")
    for name, field in model.parameter_space.fields.items():
        part = model.parameter_space.part(name)
        profiles[name] = field.at_vertices @ belief.q[part]
        std = belief.deviation(field.at_vertices, part)
        if std is not None:
            profiles[f"{name}_std"] = std
            unknown = model.parameter_space.unknowns[name]
            profiles |= interval_ends(name, unknown, profiles[name], std)
    return profiles


def _components(name: str, block: FieldBlock, values: Array, end: str = "") -> dict[str, Array]:
    """Return the values at the vertices as variables, one for each component of a vector."""
    names = block.variables(name)
    rows = values.reshape(len(names), -1)
    return {f"{key}{end}": row for key, row in zip(names, rows, strict=True)}


def correlation_of(rows: Array) -> Array:
    """Return correlations from square roots of covariances, shape (..., numbers, r)."""
    size = np.linalg.norm(rows, axis=-1)
    unit = rows / np.where(size > 0.0, size, 1.0)[..., None]
    correlation: Array = unit @ unit.swapaxes(-1, -2)
    return correlation
