"""Overview figure of a run: unknowns, fields, innovations, validation channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.errors import ConfigurationError
from livepde.linalg import Array
from livepde.plots.curves import profiles
from livepde.plots.style import (
    GREY,
    MOST_LINES,
    PALETTE,
    axis_label,
    empty,
    figure,
    figure_class,
    finish,
    groups,
    labelled,
    note,
    panel,
    scored_from,
    sensor_names,
    sensor_places,
    sensor_units,
    sensors_by_unit,
    time_axis,
    time_text,
    time_values,
)
from livepde.records import field_names, interval_95, refused_readings, used_errors

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDE = 30.0  # ratio of largest to smallest value from which an axis is logarithmic
RESIDUALS = (  # variable, its dimension, title of its panel
    ("innovation", "sensor", "innovation"),
    ("validation_error", "validation", "error of validation channels"),
)
SLENDER = 6.0  # length over width from which the axes of a map have different scales


def overview(
    data: xr.Dataset,
    *,
    title: str = "",
    times: Sequence[float] | int = 5,
    measured: tuple[Array, Array] | None = None,
) -> Figure:
    """Draw a run: panels for readings, unknowns, fields, innovations and validation channels.

    Parameters
    ----------
    data
        Dataset as returned by `Result.to_xarray()`.
    title
        Title above all panels.
    times
        Times of field profiles in one space dimension, or their number; maps show the last time.
    measured
        Times and readings, see `curves`. The first panels, of the whole width, then show readings
        and predictions.

    Raises
    ------
    ConfigurationError
        The dataset is empty, or Matplotlib is not installed.
    """
    figure_class()
    if not data.sizes.get("time"):
        raise ConfigurationError("the run contains no samples yet, so there is nothing to draw.")
    wide = [] if measured is None else _measured_panels(data, *measured)
    panels = _panels(data, times)
    each, columns = [*wide, *panels], 1 if len(panels) == 1 else 2
    rows: list[Any] = [[k] * columns for k in range(len(wide))]
    # A last single panel has the whole row.
    pairs = range(len(wide), len(each), columns)
    rows += [[k, min(k + 1, len(each) - 1)][:columns] for k in pairs]
    drawn = empty(len(rows), columns, title)
    axes = drawn.subplot_mosaic(rows)
    for k, draw in enumerate(each):
        draw(axes[k])
    return drawn


def curves(data: xr.Dataset, t: Array, measured: Array, *, title: str = "") -> Figure:
    """Draw the readings of each sensor, and the predictions of the model.

    Parameters
    ----------
    data
        Dataset as returned by `Result.to_xarray()`.
    t, measured
        Times, shape (samples,), and readings of the assimilated sensors followed by the validation
        sensors, NaN where missing, shape (samples, sensors).
    title
        Title above all panels.
    """
    each = _measured_panels(data, t, measured)
    drawn, axes = figure(len(each), 1, title)
    for draw, ax in zip(each, axes, strict=True):
        draw(ax)
    return drawn


def _measured_panels(data: xr.Dataset, t: Array, measured: Array) -> list[Callable[[Axes], Axes]]:
    """Return a function for each unit that draws the readings of its sensors on axes."""

    def of(sensors: list[str]) -> Callable[[Axes], Axes]:
        return lambda ax: measured_and_predicted(data, t, measured, sensors=sensors, ax=ax)

    return [of(sensors) for sensors in sensors_by_unit(data).values()]


def measured_and_predicted(
    data: xr.Dataset,
    t: Array,
    measured: Array,
    *,
    sensors: Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw readings and predictions of sensors with one unit.

    Lines of validation sensors are dashed. Their readings are not used in the estimate.

    Parameters
    ----------
    data, t, measured
        See `curves`.
    sensors
        Names of the sensors, of which the first seven are drawn; default: all.
    ax
        Axes to draw on; default: the axes of a new figure.

    Raises
    ------
    ConfigurationError
        There is no such sensor, or the sensors have several units.
    """
    ax, names = panel(ax), sensor_names(data)
    shown, units = _chosen(sensors, names, "there is no sensor"), sensor_units(data)
    several = list(dict.fromkeys(units[name] for name in shown))
    if len(several) > 1:
        raise ConfigurationError(
            f"the sensors have several units, {several}: draw those of one unit, as in sensors="
            f"{[name for name in shown if units[name] == several[0]]}."
        )
    errors = [data[name].transpose("time", of).values for name, of, _ in RESIDUALS if name in data]
    times = data["time"].values
    rows = np.searchsorted(times, t).clip(max=len(times) - 1)
    known = times[rows] == t
    expected = measured[known] - np.concatenate(errors, axis=1)[rows[known]]
    at = time_values(data, t)
    for n, name in enumerate(shown[:MOST_LINES]):
        i, colour = names.index(name), PALETTE[n % len(PALETTE)]
        ax.plot(at, measured[:, i], ".", color=colour, markersize=3, alpha=0.5)
        label, dash = name, "-"
        if i >= data.sizes.get("sensor", 0):
            label, dash = f"{name} (validation)", "--"
        ax.plot(at[known], expected[:, i], dash, color=colour, linewidth=1.2, label=label)
    time_axis(ax, data)
    ax.set_ylabel(labelled("", "".join(several)).strip())
    some = f", {MOST_LINES} of {len(shown)} sensors" if len(shown) > MOST_LINES else ""
    ax.set_title(f"measured (points) and expected one step ahead (lines){some}")
    return finish(ax)


def estimates(data: xr.Dataset, name: str | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw an unknown number, in all its regions, over time with its 95 % band.

    Parameters
    ----------
    data
        Dataset as returned by `Result.to_xarray()`.
    name
        Name of the unknown; optional if there is only one.
    ax
        Axes to draw on; default: the axes of a new figure.

    Raises
    ------
    ConfigurationError
        The unknown number does not exist, or there are several and `name` is missing.
    """
    known = groups(data)
    if name is None and len(known) == 1:
        (name,) = known
    if name is None or name not in known:
        wrong = "" if name is None else f"there is no unknown number '{name}'; "
        raise ConfigurationError(f"plots: {wrong}name one of the numbers {list(known)}.")
    return _scalar_panel(data, name, known[name], panel(ax))


def residuals(data: xr.Dataset, *, validation: bool = False, ax: Axes | None = None) -> Axes:
    """Draw measured minus predicted readings of the assimilated sensors.

    Parameters
    ----------
    data, ax
        See `estimates`.
    validation
        Whether to draw the validation sensors instead.

    Raises
    ------
    ConfigurationError
        The run has no validation sensors.
    """
    variable, dimension, what = RESIDUALS[validation]
    if variable not in data:
        raise ConfigurationError("plots: the run has no validation sensors.")
    return _residual_panel(data, variable, dimension, what, panel(ax))


def field(data: xr.Dataset, name: str, *, std: bool = False, ax: Axes | None = None) -> Axes:
    """Draw an unknown field or the state: on a plane its last values, else its values over time.

    Parameters
    ----------
    data, ax
        See `estimates`.
    name
        Name of the field.
    std
        Whether to draw its standard deviation, which requires a plane domain.

    Raises
    ------
    ConfigurationError
        The field does not exist, or has no map of its standard deviation.
    """
    known = [*field_names(data), *str(data.attrs.get("state", "")).split()]
    _chosen([name], known, "plots: there is no field")
    panels = _field_panels(data, name, 5)
    if std and len(panels) < 2:
        raise ConfigurationError(
            f"plots: no map of the standard deviation of '{name}': leave out std."
        )
    return panels[std](panel(ax))


def corner(draws: xr.Dataset, names: Sequence[str] | None = None, *, axes: Any = None) -> Any:
    """Draw pairwise scatter plots of unknown numbers, with histograms on the diagonal.

    Parameters
    ----------
    draws
        Dataset as returned by `Result.sample()`.
    names
        Names of the numbers; default: all.
    axes
        Matrix of axes to draw on, shape (numbers, numbers); default: the axes of a new figure.

    Returns
    -------
    axes
        The matrix of axes; axes above the diagonal are hidden.
    """
    numbers = [str(name) for name in draws.data_vars if draws[name].dims == ("draw",)]
    shown = _chosen(names, numbers, "plots: there is no unknown number")
    if not shown:
        raise ConfigurationError("plots: there is no unknown number to draw.")
    size = len(shown)
    if axes is None:
        axes = empty(size, size, "").subplots(size, size, squeeze=False)
    for i, of in enumerate(shown):
        values = draws[of].values
        axes[i][i].hist(values, bins=40, color=PALETTE[0], alpha=0.7)
        axes[size - 1][i].set_xlabel(axis_label(draws, of))
        if i:
            axes[i][0].set_ylabel(axis_label(draws, of))
        for k in range(i):
            x = draws[shown[k]].values
            axes[i][k].plot(x, values, ".", color=PALETTE[0], markersize=2, alpha=0.3)
            axes[k][i].set_visible(False)
    return axes


def _chosen(names: Sequence[str] | None, known: list[str], what: str) -> list[str]:
    """Return the names to draw, by default all; `what` begins the message for unknown names."""
    shown = known if names is None else list(names)
    for name in shown:
        if name not in known:
            raise ConfigurationError(f"{what} '{name}'; there are {known}.")
    return shown


class RunPlots:
    """Figures of a result, such as `result.plot.estimates("alpha")`.

    Each method draws on `ax`, or on a new figure, and returns the axes. A call, `result.plot()`,
    draws an overview of the run and returns the figure.
    """

    def __init__(self, result: Any) -> None:
        self._result = result

    def _data(self) -> xr.Dataset:
        if not len(self._result):
            raise ConfigurationError("plot: the run contains no samples yet.")
        data: xr.Dataset = self._result.dataset()
        return data

    def __call__(self, **options: Any) -> Figure:
        """Draw an overview of the run, see `livepde.plots.overview`."""
        data = self._data()
        if self._result.readings is not None:
            readings = data["time"].values, self._result.readings()
            options = {"measured": readings, **options}
        return overview(data, **options)

    def measured_and_predicted(
        self, *, sensors: Sequence[str] | None = None, ax: Axes | None = None
    ) -> Axes:
        """Draw readings and predictions of sensors with one unit."""
        data, measured = self._data(), self._result.measured
        t = data["time"].values
        return measured_and_predicted(data, t, measured.to_numpy(), sensors=sensors, ax=ax)

    def estimates(self, name: str | None = None, *, ax: Axes | None = None) -> Axes:
        """Draw an unknown number over time with its 95 % band."""
        return estimates(self._data(), name, ax=ax)

    def residuals(self, *, validation: bool = False, ax: Axes | None = None) -> Axes:
        """Draw measured minus predicted readings."""
        return residuals(self._data(), validation=validation, ax=ax)

    def field(self, name: str, *, std: bool = False, ax: Axes | None = None) -> Axes:
        """Draw an unknown field or the state."""
        return field(self._data(), name, std=std, ax=ax)

    def corner(
        self, names: Sequence[str] | None = None, *, n: int = 2000, seed: int = 0, axes: Any = None
    ) -> Any:
        """Draw scatter plots of `n` draws of the unknown numbers; return the matrix of axes."""
        return corner(self._result.sample(n, seed), names, axes=axes)


def _panels(data: xr.Dataset, times: Sequence[float] | int) -> list[Callable[[Axes], Axes]]:
    """Return a function for each panel that draws it on axes."""
    panels: list[Callable[[Axes], Axes]] = [
        partial(_scalar_panel, data, name, labels) for name, labels in groups(data).items()
    ]
    state = [name for name in str(data.attrs.get("state", "")).split() if name in data]
    for name in [*field_names(data), *state]:
        panels += _field_panels(data, name, times)
    for variable, dimension, what in RESIDUALS:
        if variable in data and data.sizes.get(dimension):
            panels.append(partial(_residual_panel, data, variable, dimension, what))
    return panels


def _scalar_panel(data: xr.Dataset, name: str, labels: Sequence[str], ax: Axes) -> Axes:
    """Draw an unknown in all its regions over time, with 95 % bands."""
    t = time_values(data, data["time"].values)
    # Early values of the band are wide and would hide later values, so they do not set the scale.
    late = slice(max(len(t) // 10, scored_from(data) + len(t) // 20), None)
    reach: list[Array] = []
    for k, label in enumerate(labels):
        value = data[label].values
        low, high = interval_95(data, label)
        colour = PALETTE[k % len(PALETTE)]
        short = label[len(name) :].strip("[]") or name
        known = bool(np.isfinite(low[-1]))
        end = f"{short} = {value[-1]:.4g}"
        if known:
            end += f", 95 %: {low[-1]:.4g} to {high[-1]:.4g}"
        ax.plot(t, value, color=colour, label=end)
        reach.append(value)
        if known:
            ax.fill_between(t, low, high, color=colour, alpha=0.2, linewidth=0)
            reach += [low[late], high[late]]
    _limit_values(np.concatenate(reach), ax)
    _mark_failures(data, ax)
    _mark_jumps(data, ax)
    time_axis(ax, data)
    ax.set_ylabel(axis_label(data, labels[0], name))
    ax.set_title(f"{name}: estimate and 95 % band" if len(reach) > len(labels) else name)
    return finish(ax)


def _limit_values(values: Array, ax: Axes) -> None:
    """Fit the value axis to values with a margin of 6 %; for a wide range it is logarithmic."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return
    low, high = finite.min(), finite.max()
    if low > 0.0 and high > WIDE * low:
        ax.set_yscale("log")
        margin = (high / low) ** 0.06
        ax.set_ylim(low / margin, high * margin)
    elif high > low:
        margin = 0.06 * (high - low)
        ax.set_ylim(low - margin, high + margin)


def _mark_failures(data: xr.Dataset, ax: Axes) -> None:
    failed = time_values(data, data["time"].values[data["status"].values != 0])
    if len(failed):
        ax.plot(
            failed,
            np.full(len(failed), 0.02),
            "|",
            color=PALETTE[1],
            transform=ax.get_xaxis_transform(),
            label=f"{len(failed)} failed steps",
        )


def _mark_jumps(data: xr.Dataset, ax: Axes) -> None:
    alarms = note(data, "jump")
    if alarms is None:
        return
    times = data["time"].values[alarms > 0.0]
    for k, t in enumerate(time_values(data, times)):
        text = time_text(data, times[k]).removeprefix("t = ")
        label = f"jump at {text}" if len(times) == 1 else f"{len(times)} jumps"
        label = "_jump" if k else label
        ax.axvline(t, label=label, color=PALETTE[1], linestyle="--", linewidth=1.0)


def _field_panels(
    data: xr.Dataset, name: str, times: Sequence[float] | int
) -> list[Callable[[Axes], Axes]]:
    """Return functions that draw a field: profiles, maps, or its range over time in 3D."""
    if "y" not in data.coords:

        def profile(ax: Axes) -> Axes:
            profiles(data, name, times=times, markers=False, ax=ax).set_title(f"{name} over time")
            return ax

        return [profile]
    if "z" in data.coords:
        return [partial(_range_panel, data, name)]
    maps = (name, f"{name}_std")
    return [partial(_map_panel, data, variable) for variable in maps if variable in data]


def _map_panel(data: xr.Dataset, name: str, ax: Axes) -> Axes:
    """Draw the last snapshot of a field on a plane domain."""
    from matplotlib.tri import Triangulation

    x, y = data["x"].values, data["y"].values
    # The cells, shape (cells, 3), are needed since a domain may have holes or corners.
    triangles = Triangulation(x, y, data["triangle"].values if "triangle" in data else None)
    spread = name.endswith("_std")
    drawn = ax.tripcolor(
        triangles, data[name].values[-1], shading="gouraud", cmap="cividis" if spread else "viridis"
    )
    for kind, sensors in sensor_places(data).items():
        inside, edge = ("white", "black") if kind == "sensor" else ("black", "white")
        ax.plot(sensors.x, sensors.y, "o", ms=4, mec=edge, mfc=inside)
    what = axis_label(data, name, name.removesuffix("_std"))
    ax.figure.colorbar(drawn, ax=ax, label=f"standard deviation of {what}" if spread else what)
    when = time_text(data, data["snapshot"].values[-1])
    whose = f"{'standard deviation of ' if spread else ''}{name.removesuffix('_std')}"
    ax.set_title(f"{whose} at {when}")
    width, height = np.ptp(x), np.ptp(y)
    ax.set_aspect("equal" if max(width, height) < SLENDER * min(width, height) else "auto")
    ax.margins(0.0)
    ax.set_xlabel(axis_label(data, "x"))
    ax.set_ylabel(axis_label(data, "y"))
    return ax


def _range_panel(data: xr.Dataset, name: str, ax: Axes) -> Axes:
    t, values = time_values(data, data["snapshot"].values), data[name].values
    low, high = values.min(axis=1), values.max(axis=1)
    ax.fill_between(t, low, high, color=PALETTE[0], alpha=0.2, label="range")
    ax.plot(t, np.median(values, axis=1), color=PALETTE[0], label="median")
    time_axis(ax, data)
    ax.set_ylabel(axis_label(data, name))
    ax.set_title(f"{name} in space")
    return finish(ax)


def _residual_panel(data: xr.Dataset, variable: str, dimension: str, what: str, ax: Axes) -> Axes:
    """Draw measured minus predicted values of each channel, with root mean square errors."""
    t = time_values(data, data["time"].values)
    errors = used_errors(data, variable, dimension)
    names = [str(name) for name in data[dimension].values]
    first = scored_from(data)
    ax.axhline(0.0, color="black", linewidth=0.8)
    if first:
        ax.axvline(t[first], color=GREY, linestyle=":", label="assimilated from here")
    _mark_jumps(data, ax)
    if len(names) <= MOST_LINES:
        marker, width = ("None", 0.6) if len(t) > 100 else (".", 0.9)
        for k, name in enumerate(names):
            label = f"{name}: RMSE {_rms(errors[first:, k]):.3g}"
            line = ax.plot(t, errors[:, k], color=PALETTE[k % len(PALETTE)], label=label)[0]
            line.set(marker=marker, linewidth=width, alpha=0.8)
        if variable == "innovation":
            _mark_refused(data, ax)
    else:
        some = np.isfinite(errors).any(axis=1)
        t, seen = t[some], errors[some]
        label = f"range of {len(names)} channels"
        low, high = np.nanmin(seen, axis=1), np.nanmax(seen, axis=1)
        ax.fill_between(t, low, high, color=PALETTE[0], alpha=0.25, linewidth=0, label=label)
        root = np.sqrt(np.nanmean(seen**2, axis=1))
        label = f"root mean square; RMSE {_rms(errors[first:]):.3g}"
        ax.plot(t, root, color=PALETTE[0], label=label)
    time_axis(ax, data)
    ax.set_ylabel(axis_label(data, variable, "measured − expected"))
    ax.set_title(what)
    return finish(ax)


def _mark_refused(data: xr.Dataset, ax: Axes) -> None:
    """Mark the times of refused readings, in the colour of each sensor."""
    t, names = time_values(data, data["time"].values), list(map(str, data["sensor"].values))
    for name, which in refused_readings(data).items():
        colour = PALETTE[names.index(name) % len(PALETTE)]
        label = f"{name}: {which.sum()} readings refused"
        ax.plot(t[which], np.zeros(which.sum()), "x", label=label, color=colour)


def _rms(errors: Array) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt((finite**2).mean())) if len(finite) else math.nan
