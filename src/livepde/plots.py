"""Figures of a run's dataset; the only room that knows Matplotlib.

It takes datasets as `Result.to_xarray()` gives them, and arrays. Matplotlib is loaded when a figure
is drawn, not before, and without pyplot: figures are objects to save, no global state is touched.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.linalg import Array

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "GREY",
    "NORMAL_95",
    "PALETTE",
    "ensemble",
    "figure",
    "history",
    "interval_95",
    "labelled",
    "loops",
    "overview",
    "profiles",
    "scored_from",
    "time_scale",
]

# Okabe and Ito (2008): told apart with every common kind of colour blindness. Yellow is left out:
# it cannot be seen on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#7f7f7f"
MARKERS = "osD^vP*X"
NORMAL_95 = 1.959964  # half-width of a 95 % interval in standard deviations
MOST_LINES = 7  # in one panel; more sensors are drawn as one line with their range
MOST_POINTS = 20_000  # for which a free place for the legend is looked for
PANEL = (5.4, 3.4)  # inches
CLOCKS = ((2 * 86400.0, 86400.0, "d"), (2 * 3600.0, 3600.0, "h"))  # span from which, factor, unit


def interval_95(data: xr.Dataset, name: str) -> tuple[Array, Array]:
    """Return the ends of the 95 % interval of a variable that has a deviation.

    Those of the dataset, which are mapped through a transform and lie within bounds; where it has
    none, the value and 1.96 deviations.
    """
    if f"{name}_low" in data:
        return data[f"{name}_low"].values, data[f"{name}_high"].values
    value, half = data[name].values, NORMAL_95 * data[f"{name}_std"].values
    return value - half, value + half


def _figure_class() -> type[Figure]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigurationError(
            "Figures need Matplotlib, which is not installed: pip install 'livepde[plots]'."
        ) from None
    return Figure


def figure(rows: int = 1, columns: int = 1, title: str = "") -> tuple[Figure, list[Axes]]:
    """Return an empty figure and its panels, row by row.

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.
    """
    drawn = _empty(rows, columns, title)
    return drawn, list(drawn.subplots(rows, columns, squeeze=False).ravel())


def _empty(rows: int, columns: int, title: str) -> Figure:
    size = (PANEL[0] * columns, PANEL[1] * rows)
    drawn = _figure_class()(figsize=size, layout="constrained")
    if title:
        drawn.suptitle(title)
    return drawn


def _panel(ax: Axes | None) -> Axes:
    return figure()[1][0] if ax is None else ax


def labelled(name: str, unit: str) -> str:
    """Return the label of an axis."""
    for plain, pretty in (("degC", "°C"), ("**", "^"), ("^2", "²"), ("^3", "³")):
        unit = unit.replace(plain, pretty)
    return f"{name} [{unit}]" if unit and unit != "1" else name


def time_scale(data: xr.Dataset) -> tuple[float, str]:
    """Return factor and unit in which times are shown: a month in seconds tells nobody anything."""
    unit = str(data["time"].attrs.get("units", ""))
    if unit in ("s", "second", "seconds") and data.sizes["time"]:
        span = float(data["time"][-1] - data["time"][0])
        for least, factor, name in CLOCKS:
            if span >= least:
                return factor, name
    return 1.0, unit


def _finish(ax: Axes, *, legend: bool = True, outside: bool = False) -> Axes:
    ax.grid(True, alpha=0.3, linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    if legend and ax.get_legend_handles_labels()[0]:
        if outside:
            ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False)
        else:
            # "best" compares with every point drawn: too slow on long runs.
            points = sum(np.size(line.get_xdata()) for line in ax.lines)
            place: Any = "best" if points <= MOST_POINTS else "upper right"
            ax.legend(loc=place, fontsize="small", framealpha=0.85, edgecolor="none")
    return ax


def _shades(count: int) -> list[Any]:
    """Return colours for a sequence in time, early to late: viridis without its yellow."""
    import matplotlib as mpl

    shades: list[Any] = list(mpl.colormaps["viridis"](np.linspace(0.0, 0.88, max(count, 2))))
    return shades[:count]


def _snapshots(data: xr.Dataset, times: Sequence[float] | int) -> list[int]:
    """Return indices of the snapshots nearest to the times, or of some, most of them early.

    An estimate changes most at the start, so the spread is quadratic.
    """
    available = data["snapshot"].values
    if not len(available):
        raise ConfigurationError("the dataset holds no snapshots: run with at least one sample.")
    if isinstance(times, int):
        spread = np.linspace(0, 1, min(times, len(available))) ** 2 * (len(available) - 1)
        return [int(k) for k in np.unique(spread.round())]
    return [int(np.abs(available - t).argmin()) for t in times]


def profiles(
    data: xr.Dataset,
    name: str,
    *,
    times: Sequence[float] | int = 6,
    exact: ArrayLike | None = None,
    observed: tuple[float, float] | None = None,
    markers: bool = True,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw a field on an interval at several times; the last one with its 95 % band.

    Parameters
    ----------
    data
        A run's dataset, one-dimensional in space.
    name
        Field to draw: a parameter or the state.
    times
        Times to draw (the nearest snapshots), or how many.
    exact
        Exact values at the vertices, drawn as plain lines: shape (vertices,), or (times, vertices)
        for one line each.
    observed
        Interval omega that is observed, shaded.
    markers
        Mark the vertices, as the paper does.
    legend
        Put a legend beside the panel.

    Raises
    ------
    ConfigurationError
        No such field, more than one space dimension, or Matplotlib is not installed.
    """
    if name not in data or data[name].dims != ("snapshot", "vertex"):
        fields = [str(key) for key in data if data[key].dims == ("snapshot", "vertex")]
        raise ConfigurationError(f"the dataset has no field '{name}'; it has {fields}.")
    if "y" in data.coords:
        raise ConfigurationError("profiles are for one space dimension; use overview for maps.")
    ax = _panel(ax)
    chosen = _snapshots(data, times)
    factor, unit = time_scale(data)
    x = data["x"].values
    if observed is not None:
        ax.axvspan(*observed, color=GREY, alpha=0.12, linewidth=0, label="observed")
    truth = None if exact is None else np.asarray(exact, dtype=float)
    shades = _shades(len(chosen))
    for order, (k, colour) in enumerate(zip(chosen, shades, strict=True)):
        values = data[name].values[k]
        label = f"t = {data['snapshot'].values[k] / factor:.4g} {unit}".rstrip()
        style = {"marker": MARKERS[order % len(MARKERS)], "markersize": 3.5} if markers else {}
        if truth is not None and truth.ndim == 2:
            ax.plot(x, truth[order], color=colour, linewidth=1.0, label="_exact")
        ax.plot(
            x,
            values,
            color=colour,
            linewidth=0.7 if markers else 1.4,
            linestyle="--" if truth is not None and truth.ndim == 2 else "-",
            label=label,
            **style,  # type: ignore[arg-type]
        )
    if f"{name}_std" in data:
        low, high = (end[chosen[-1]] for end in interval_95(data, name))
        ax.fill_between(x, low, high, color=shades[-1], alpha=0.25, linewidth=0, label="95 %")
    if truth is not None and truth.ndim == 1:
        ax.plot(x, truth, color="black", linewidth=2.0, zorder=1.5, label="exact")
    elif truth is not None:
        ax.plot([], [], color=GREY, linewidth=1.0, label="exact")
    ax.set_xlabel(labelled("x", str(data["x"].attrs.get("units", ""))))
    ax.set_ylabel(labelled(name, str(data[name].attrs.get("units", ""))))
    ax.margins(x=0.02)
    return _finish(ax, legend=legend, outside=True)


def history(
    series: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    ylabel: str = "",
    xlabel: str = "t",
    log: bool = True,
    levels: Mapping[str, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw numbers over time, such as the error of several runs.

    Parameters
    ----------
    series
        Label -> (times, values).
    levels
        Label -> constant to compare with, drawn dashed.
    log
        Logarithmic scale of the values.
    """
    ax = _panel(ax)
    for k, (label, (t, values)) in enumerate(series.items()):
        ax.plot(np.asarray(t), np.asarray(values), color=PALETTE[k % len(PALETTE)], label=label)
    for label, level in (levels or {}).items():
        ax.axhline(level, color=GREY, linestyle="--", linewidth=1.0, label=label)
    if log:
        ax.set_yscale("log")
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    return _finish(ax, outside=True)


def loops(runs: Mapping[str, xr.Dataset], rows: Sequence[str], *, title: str = "") -> Figure:
    """Draw closed loops: a column for each run, a row for each quantity, with common axes.

    Parameters
    ----------
    runs
        Name -> dataset with the quantities over `time`, and where there are such, what each should
        be (`_reference`), its limits (`_low`, `_high`), what it is (`_truth`), its deviation
        (`_std`). With the attribute `held` values are held from sample to sample.
    rows
        Names of the quantities.

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.
    """
    drawn = _empty(len(rows), len(runs), title)
    drawn.set_size_inches(3.2 * len(runs), 2.2 * len(rows))
    grid = drawn.subplots(len(rows), len(runs), squeeze=False, sharex=True, sharey="row")
    for column, (label, data) in enumerate(runs.items()):
        factor, clock = time_scale(data)
        t = data["time"].values / factor
        for row, name in enumerate(rows):
            ax, values = grid[row][column], data[name].values
            for end, style in (("reference", "--"), ("truth", "-"), ("low", ":"), ("high", ":")):
                if f"{name}_{end}" in data:
                    limit = end in ("low", "high")
                    said = ax.get_legend_handles_labels()[1]
                    meaning = "limit" if limit else end
                    ax.plot(
                        t,
                        data[f"{name}_{end}"].values,
                        style,
                        color=PALETTE[1] if limit else PALETTE[-1],
                        linewidth=1.0,
                        label="" if meaning in said else meaning,
                    )
            if f"{name}_std" in data:
                half = NORMAL_95 * data[f"{name}_std"].values
                ax.fill_between(t, values - half, values + half, color=PALETTE[0], alpha=0.25)
            drawstyle: Any = "steps-post" if "held" in data[name].attrs else "default"
            ax.plot(t, values, color=PALETTE[0], linewidth=1.2, drawstyle=drawstyle)
            if row == 0:
                ax.set_title(label, fontsize="medium")
            if column == 0:
                ax.set_ylabel(labelled(name, str(data[name].attrs.get("units", ""))))
            if row == len(rows) - 1:
                ax.set_xlabel(labelled("t", clock))
            _finish(ax, legend=column == 0)
    return drawn


def ensemble(
    times: ArrayLike,
    values: ArrayLike,
    *,
    ylabel: str = "",
    xlabel: str = "t",
    levels: Mapping[str, float] | None = None,
    legend: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw several runs over time: each one thin, their mean thick with its least value marked.

    Parameters
    ----------
    times
        Shape (times,).
    values
        Positive numbers, shape (runs, times); the scale is logarithmic.
    levels
        Label -> constant to compare with, drawn dashed.
    legend
        Put a legend beside the panel.
    """
    ax = _panel(ax)
    t, rows = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    mean = rows.mean(axis=0)
    least = int(mean.argmin())
    for k, row in enumerate(rows):
        label = "each run" if k == 0 else "_run"
        ax.plot(t, row, color=PALETTE[5], linewidth=0.6, alpha=0.7, label=label)
    ax.plot(t, mean, color=PALETTE[0], linewidth=1.8, label="mean")
    ax.plot(t[least], mean[least], "o", color=PALETTE[1], zorder=3, label="least")
    for label, level in (levels or {}).items():
        ax.axhline(level, color=GREY, linestyle="--", linewidth=1.0, label=label)
    ax.set_yscale("log")
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    return _finish(ax, legend=legend, outside=True)


def overview(data: xr.Dataset, *, title: str = "", times: Sequence[float] | int = 5) -> Figure:
    """Draw a run: unknowns, fields, innovations and withheld channels, one panel each.

    Parameters
    ----------
    data
        As `Result.to_xarray()` gives it.
    title
        Above all panels.
    times
        Times at which fields are drawn, or how many (one space dimension; maps show the last).

    Raises
    ------
    ConfigurationError
        The dataset is empty, or Matplotlib is not installed.
    """
    _figure_class()
    if not data.sizes.get("time"):
        raise ConfigurationError("the run holds no samples yet, so there is nothing to draw.")
    panels: list[Any] = []
    for name, labels in _scalars(data).items():
        panels.append(lambda ax, name=name, labels=labels: _scalar_panel(data, name, labels, ax))
    state = [name for name in str(data.attrs.get("state", "")).split() if name in data]
    for name in [*str(data.attrs.get("fields", "")).split(), *state]:
        panels += _field_panels(data, name, times)
    for variable, dimension, what in (
        ("innovation", "sensor", "innovation"),
        ("withheld_error", "withheld", "error of withheld channels"),
    ):
        if variable in data and data.sizes.get(dimension):
            panels.append(
                lambda ax, v=variable, d=dimension, w=what: _residual_panel(data, v, d, w, ax)
            )
    columns = 1 if len(panels) == 1 else 2
    rows = math.ceil(len(panels) / columns)
    drawn = _empty(rows, columns, title)
    grid = drawn.add_gridspec(rows, columns)
    for k, panel in enumerate(panels):
        alone = k == len(panels) - 1 and k % columns == 0  # the last one may take the whole row
        panel(drawn.add_subplot(grid[k // columns, slice(None) if alone else k % columns]))
    return drawn


def _scalars(data: xr.Dataset) -> dict[str, list[str]]:
    """Return unknown -> its labels: one for a number, one for each region of a piecewise one."""
    groups: dict[str, list[str]] = {}
    for label in filter(None, str(data.attrs.get("scalars", "")).split("\n")):
        groups.setdefault(label.split("[")[0], []).append(label)
    return groups


def _scalar_panel(data: xr.Dataset, name: str, labels: Sequence[str], ax: Axes) -> Axes:
    """Draw one unknown over time with its 95 % band; its regions together."""
    factor, clock = time_scale(data)
    t = data["time"].values / factor
    unit = str(data[labels[0]].attrs.get("units", ""))
    # The prior's band would flatten everything that follows.
    late = slice(max(len(t) // 10, scored_from(data) + len(t) // 20), None)
    reach: list[Array] = []
    for k, label in enumerate(labels):
        value = data[label].values
        low, high = interval_95(data, label)
        colour = PALETTE[k % len(PALETTE)]
        short = label[len(name) :].strip("[]") or name
        known = bool(np.isfinite(low[-1]))
        end = f"{short} = {value[-1]:.4g}"
        if f"{label}_low" in data:
            end += f", {low[-1]:.3g} to {high[-1]:.3g}" if known else ""
        elif known:
            end += f" ± {high[-1] - value[-1]:.2g}"
        ax.plot(t, value, color=colour, label=end)
        reach.append(value)
        if known:
            ax.fill_between(t, low, high, color=colour, alpha=0.2, linewidth=0)
            reach += [low[late], high[late]]
    finite = np.concatenate(reach)
    finite = finite[np.isfinite(finite)]
    if len(finite) and finite.max() > finite.min():
        margin = 0.06 * (finite.max() - finite.min())
        ax.set_ylim(finite.min() - margin, finite.max() + margin)
    _mark_failures(data, ax)
    _mark_jumps(data, ax)
    ax.set_xlabel(labelled("t", clock))
    ax.set_ylabel(labelled(name, unit))
    ax.set_title(f"{name}: estimate and 95 % band" if len(reach) > len(labels) else name)
    return _finish(ax)


def _mark_failures(data: xr.Dataset, ax: Axes) -> None:
    """Mark samples whose step failed."""
    failed = data["time"].values[data["status"].values != 0] / time_scale(data)[0]
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
    """Draw a line at each alarm of the test for jumps."""
    if "jump" not in data or data["jump"].dims != ("time",):
        return
    times = data["time"].values[data["jump"].values > 0.0] / time_scale(data)[0]
    for k, t in enumerate(times):
        label = f"jump at {t:.4g}" if len(times) == 1 else f"{len(times)} jumps"
        if k:
            label = "_jump"
        ax.axvline(t, label=label, color=PALETTE[1], linestyle="--", linewidth=1.0)


def _field_panels(data: xr.Dataset, name: str, times: Sequence[float] | int) -> list[Any]:
    """Return what draws a field: profiles, maps, or its range over time in three dimensions."""
    if "y" not in data.coords:

        def profile(ax: Axes) -> Axes:
            profiles(data, name, times=times, markers=False, ax=ax).set_title(f"{name} over time")
            return ax

        return [profile]
    if "z" in data.coords:
        return [lambda ax: _range_panel(data, name, ax)]
    names = [name, *([f"{name}_std"] if f"{name}_std" in data else [])]
    return [lambda ax, n=n: _map_panel(data, n, ax) for n in names]


def _map_panel(data: xr.Dataset, name: str, ax: Axes) -> Axes:
    """Draw the last snapshot of a field on a plane domain."""
    from matplotlib.tri import Triangulation

    x, y = data["x"].values, data["y"].values
    if "triangle" in data:  # vertices of each cell, (cell, 3): a domain with holes or corners
        triangles = Triangulation(x, y, data["triangle"].values)
    else:
        triangles = Triangulation(x, y)
    factor, unit = time_scale(data)
    spread = name.endswith("_std")
    drawn = ax.tripcolor(
        triangles,
        data[name].values[-1],
        shading="gouraud",
        cmap="cividis" if spread else "viridis",
    )
    what = labelled(name.removesuffix("_std"), str(data[name].attrs.get("units", "")))
    ax.figure.colorbar(drawn, ax=ax, label=f"standard deviation of {what}" if spread else what)
    when = f"t = {data['snapshot'].values[-1] / factor:.4g} {unit}".rstrip()
    whose = f"{'deviation of ' if spread else ''}{name.removesuffix('_std')}"
    ax.set_title(f"{whose} at {when}")
    ax.set_aspect("equal")
    ax.margins(0.0)
    ax.set_xlabel("x")
    ax.set_ylabel("y")
    return ax


def _range_panel(data: xr.Dataset, name: str, ax: Axes) -> Axes:
    """Draw smallest, median and largest value of a field in space over time."""
    factor, unit = time_scale(data)
    t, values = data["snapshot"].values / factor, data[name].values
    ax.fill_between(
        t, values.min(axis=1), values.max(axis=1), color=PALETTE[0], alpha=0.2, label="range"
    )
    ax.plot(t, np.median(values, axis=1), color=PALETTE[0], label="median")
    ax.set_xlabel(labelled("t", unit))
    ax.set_ylabel(labelled(name, str(data[name].attrs.get("units", ""))))
    ax.set_title(f"{name} in space")
    return _finish(ax)


def _residual_panel(data: xr.Dataset, variable: str, dimension: str, what: str, ax: Axes) -> Axes:
    """Draw measured minus expected of each channel, with its root mean square error."""
    factor, clock = time_scale(data)
    t = data["time"].values / factor
    errors = data[variable].transpose("time", dimension).values
    names = [str(name) for name in data[dimension].values]
    first = scored_from(data)
    ax.axhline(0.0, color="black", linewidth=0.8)
    if first:
        ax.axvline(t[first], color=GREY, linestyle=":", label="assimilated from here")
    _mark_jumps(data, ax)
    if len(names) <= MOST_LINES:
        for k, name in enumerate(names):
            label = f"{name}: RMSE {_rms(errors[first:, k]):.3g}"
            colour = PALETTE[k % len(PALETTE)]
            marker, width = ("None", 0.6) if len(t) > 100 else (".", 0.9)
            ax.plot(
                t,
                errors[:, k],
                color=colour,
                linewidth=width,
                marker=marker,
                alpha=0.8,
                label=label,
            )
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
    ax.set_xlabel(labelled("t", clock))
    ax.set_ylabel(labelled("measured − expected", str(data[variable].attrs.get("units", ""))))
    ax.set_title(what)
    return _finish(ax)


def scored_from(data: xr.Dataset) -> int:
    """Return the first sample that was assimilated: what comes before is not scored."""
    start = data.attrs.get("assimilate_from")
    if start is None:
        return 0
    first = int(np.searchsorted(data["time"].values, float(start)))
    return first if first < data.sizes["time"] else 0


def _rms(errors: Array) -> float:
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt((finite**2).mean())) if len(finite) else math.nan
