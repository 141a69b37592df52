"""Overview figure of a run: unknowns, fields, innovations, withheld channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from livepde.errors import ConfigurationError
from livepde.linalg import Array
from livepde.plots.curves import profiles
from livepde.plots.dataset import (
    MOST_LINES,
    field_names,
    groups,
    interval_95,
    labelled,
    note,
    scored_from,
    sensor_places,
    time_text,
    time_values,
)
from livepde.plots.style import GREY, PALETTE, empty, figure_class, finish, time_axis
from livepde.records import refused_readings, used_errors

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["curves", "overview"]

WIDE = 30.0  # ratio of largest to smallest value from which an axis is logarithmic
RESIDUALS = (  # variable, its dimension, title of its panel
    ("innovation", "sensor", "innovation"),
    ("withheld_error", "withheld", "error of withheld channels"),
)
SLENDER = 6.0  # length over width from which a map has an axis of its own for each


def overview(data: xr.Dataset, *, title: str = "", times: Sequence[float] | int = 5) -> Figure:
    """Draw a run: unknowns, fields, innovations and withheld channels, one panel each.

    Parameters
    ----------
    data
        Dataset as returned by `Result.to_xarray()`.
    title
        Title above all panels.
    times
        Times at which fields are drawn, or their number (one space dimension; maps show the last).

    Raises
    ------
    ConfigurationError
        The dataset is empty, or Matplotlib is not installed.
    """
    figure_class()
    if not data.sizes.get("time"):
        raise ConfigurationError("the run holds no samples yet, so there is nothing to draw.")
    panels = _panels(data, times)
    columns = 1 if len(panels) == 1 else 2
    rows = math.ceil(len(panels) / columns)
    drawn = empty(rows, columns, title)
    grid = drawn.add_gridspec(rows, columns)
    for k, panel in enumerate(panels):
        alone = k == len(panels) - 1 and k % columns == 0  # the last one may take the whole row
        panel(drawn.add_subplot(grid[k // columns, slice(None) if alone else k % columns]))
    return drawn


def curves(data: xr.Dataset, t: Array, measured: Array, *, title: str = "") -> Figure:
    """Draw the readings of each sensor, and what the model expected of them.

    Parameters
    ----------
    data
        Dataset as returned by `Result.to_xarray()`.
    t, measured
        Times, and readings of the assimilated and then of the withheld sensors, NaN where missing,
        shapes (samples,) and (samples, sensors).
    title
        Title above all panels.
    """
    figure_class()
    errors = [data[name].transpose("time", of).values for name, of, _ in RESIDUALS if name in data]
    times = data["time"].values
    rows = np.searchsorted(times, t).clip(max=len(times) - 1)
    known = times[rows] == t
    expected = measured[known] - np.concatenate(errors, axis=1)[rows[known]]
    names = [str(name) for _, of, _ in RESIDUALS if of in data for name in data[of].values]
    units = _units_of(data, names)
    each = list(dict.fromkeys(units.values()))
    drawn = empty(len(each), 1, title)
    grid = drawn.add_gridspec(len(each), 1)
    for k, unit in enumerate(each):
        ax = drawn.add_subplot(grid[k, 0])
        shown = [i for i, name in enumerate(names) if units[name] == unit]
        for n, i in enumerate(shown[:MOST_LINES]):
            colour = PALETTE[n % len(PALETTE)]
            at = time_values(data, t)
            ax.plot(at, measured[:, i], ".", color=colour, markersize=3, alpha=0.5)
            ax.plot(at[known], expected[:, i], color=colour, linewidth=1.2, label=names[i])
        time_axis(ax, data)
        ax.set_ylabel(labelled("", unit).strip())
        ax.set_title("measured (points) and expected one step ahead (lines)")
        finish(ax)
    return drawn


def _units_of(data: xr.Dataset, names: Sequence[str]) -> dict[str, str]:
    """Return the unit of each sensor."""
    common = str(data["innovation"].attrs.get("units", ""))
    units = dict.fromkeys(names, common)
    for dimension in ("sensor", "withheld"):
        if f"{dimension}_unit" in data.coords:
            own = data[f"{dimension}_unit"].values
            units |= dict(zip(map(str, data[dimension].values), map(str, own), strict=True))
    return units


def _panels(data: xr.Dataset, times: Sequence[float] | int) -> list[Callable[[Axes], Axes]]:
    """Return a function for each panel that draws it on given axes."""
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
    """Draw one unknown over time with its 95 % band; all its regions in one panel."""
    t = time_values(data, data["time"].values)
    unit = str(data[labels[0]].attrs.get("units", ""))
    # The wide band of the prior would determine the scale and hide all later values.
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
    ax.set_ylabel(labelled(name, unit))
    ax.set_title(f"{name}: estimate and 95 % band" if len(reach) > len(labels) else name)
    return finish(ax)


def _limit_values(values: Array, ax: Axes) -> None:
    """Fit the value axis to values with a margin of 6 %; a wide range has a logarithmic axis."""
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
    """Mark samples with a failed step."""
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
    """Draw a line at each alarm of the jump test."""
    alarms = note(data, "jump")
    if alarms is None:
        return
    times = data["time"].values[alarms > 0.0]
    for k, t in enumerate(time_values(data, times)):
        text = time_text(data, times[k]).removeprefix("t = ")
        label = f"jump at {text}" if len(times) == 1 else f"{len(times)} jumps"
        if k:
            label = "_jump"
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
    if "triangle" in data:  # vertices of each cell, (cell, 3): a domain with holes or corners
        triangles = Triangulation(x, y, data["triangle"].values)
    else:
        triangles = Triangulation(x, y)
    spread = name.endswith("_std")
    drawn = ax.tripcolor(
        triangles, data[name].values[-1], shading="gouraud", cmap="cividis" if spread else "viridis"
    )
    for kind, sensors in sensor_places(data).items():
        inside, edge = ("white", "black") if kind == "sensor" else ("black", "white")
        ax.plot(sensors.x, sensors.y, "o", ms=4, mec=edge, mfc=inside)
    what = labelled(name.removesuffix("_std"), str(data[name].attrs.get("units", "")))
    ax.figure.colorbar(drawn, ax=ax, label=f"standard deviation of {what}" if spread else what)
    when = time_text(data, data["snapshot"].values[-1])
    whose = f"{'standard deviation of ' if spread else ''}{name.removesuffix('_std')}"
    ax.set_title(f"{whose} at {when}")
    width, height = np.ptp(x), np.ptp(y)
    ax.set_aspect("equal" if max(width, height) < SLENDER * min(width, height) else "auto")
    ax.margins(0.0)
    for axis, label in (("x", ax.set_xlabel), ("y", ax.set_ylabel)):
        label(labelled(axis, str(data[axis].attrs.get("units", ""))))
    return ax


def _range_panel(data: xr.Dataset, name: str, ax: Axes) -> Axes:
    """Draw smallest, median and largest value of a field in space over time."""
    t, values = time_values(data, data["snapshot"].values), data[name].values
    ax.fill_between(
        t, values.min(axis=1), values.max(axis=1), color=PALETTE[0], alpha=0.2, label="range"
    )
    ax.plot(t, np.median(values, axis=1), color=PALETTE[0], label="median")
    time_axis(ax, data)
    ax.set_ylabel(labelled(name, str(data[name].attrs.get("units", ""))))
    ax.set_title(f"{name} in space")
    return finish(ax)


def _residual_panel(data: xr.Dataset, variable: str, dimension: str, what: str, ax: Axes) -> Axes:
    """Draw measured minus predicted values of each channel, with the root mean square error."""
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
        ax.plot(
            t, root, color=PALETTE[0], label=f"root mean square; RMSE {_rms(errors[first:]):.3g}"
        )
    time_axis(ax, data)
    ax.set_ylabel(labelled("measured − expected", str(data[variable].attrs.get("units", ""))))
    ax.set_title(what)
    return finish(ax)


def _mark_refused(data: xr.Dataset, ax: Axes) -> None:
    """Mark the times of readings that were refused, for each sensor in its colour."""
    t, names = time_values(data, data["time"].values), list(map(str, data["sensor"].values))
    for name, which in refused_readings(data).items():
        colour = PALETTE[names.index(name) % len(PALETTE)]
        label = f"{name}: {which.sum()} readings refused"
        ax.plot(t[which], np.zeros(which.sum()), "x", label=label, color=colour)


def _rms(errors: Array) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt((finite**2).mean())) if len(finite) else math.nan
