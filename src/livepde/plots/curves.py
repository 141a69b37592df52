"""Elementary figures: field profiles, time histories, ensembles, closed loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.linalg import Array
from livepde.plots.style import (
    GREY,
    PALETTE,
    axis_label,
    empty,
    finish,
    labelled,
    panel,
    shades_of,
    time_scale,
    time_text,
)
from livepde.records import NORMAL_95, interval_95

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "osD^vP*X"
# Suffix of a name -> meaning, style and colour of its line in a panel of `loops`.
LOOP_LINES = {
    "reference": ("reference", "--", PALETTE[-1]),
    "truth": ("truth", "-", PALETTE[-1]),
    "low": ("limit", ":", PALETTE[1]),
    "high": ("limit", ":", PALETTE[1]),
}


def _snapshots(data: xr.Dataset, name: str, times: Sequence[float] | int) -> list[int]:
    """Return the indices of a field's snapshots nearest to `times`, or of a number of snapshots.

    In the latter case their spacing is quadratic, since an estimate changes most at the start.
    """
    fields = [str(key) for key in data if data[key].dims == ("snapshot", "vertex")]
    if name not in fields:
        raise ConfigurationError(f"the dataset has no field '{name}'; it has {fields}.")
    if "y" in data.coords:
        raise ConfigurationError("profiles are for one space dimension; use overview for maps.")
    available = data["snapshot"].values
    if not len(available):
        raise ConfigurationError("the dataset contains no snapshots: run with at least one sample.")
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
    """Draw profiles of a field on an interval at several times, the last with its 95 % band.

    Parameters
    ----------
    data
        A run's dataset, one-dimensional in space.
    name
        Field to draw: a parameter or the state.
    times
        Times to draw (nearest snapshots), or their number.
    exact
        Exact values at the vertices, drawn as plain lines: shape (vertices,), or (times, vertices)
        for one line each.
    observed
        Observed interval omega, shaded.
    markers
        Whether to mark the vertices, as in the paper.
    legend
        Whether to add a legend next to the panel.

    Raises
    ------
    ConfigurationError
        The field does not exist, has more than one space dimension, or Matplotlib is not installed.
    """
    chosen = _snapshots(data, name, times)
    ax, x = panel(ax), data["x"].values
    if observed is not None:
        ax.axvspan(*observed, color=GREY, alpha=0.12, linewidth=0, label="observed")
    truth = np.asarray([] if exact is None else exact, dtype=float)
    shades = shades_of(len(chosen))
    for order, (k, colour) in enumerate(zip(chosen, shades, strict=True)):
        style: dict[str, Any] = {"linewidth": 1.4}
        if markers:
            style = {"linewidth": 0.7, "marker": MARKERS[order % len(MARKERS)], "markersize": 3.5}
        if truth.ndim == 2:
            # Each time has an exact line in its own shade; the legend has one entry for all.
            ax.plot(x, truth[order], color=colour, linewidth=1.0, label="_exact")
            style["linestyle"] = "--"
        label = time_text(data, data["snapshot"].values[k])
        ax.plot(x, data[name].values[k], color=colour, label=label, **style)
    if f"{name}_std" in data:
        low, high = np.array(interval_95(data, name))[:, chosen[-1]]
        ax.fill_between(x, low, high, color=shades[-1], alpha=0.25, linewidth=0, label="95 %")
    if truth.ndim == 2:
        ax.plot([], [], color=GREY, linewidth=1.0, label="exact")
    elif len(truth):
        ax.plot(x, truth, color="black", linewidth=2.0, zorder=1.5, label="exact")
    ax.set_xlabel(axis_label(data, "x"))
    ax.set_ylabel(axis_label(data, name))
    ax.margins(x=0.02)
    return finish(ax, legend=legend, outside=True)


def history(
    series: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    ylabel: str = "",
    xlabel: str = "t",
    log: bool = True,
    levels: Mapping[str, float] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw time series, such as the errors of several runs.

    Parameters
    ----------
    series
        Mapping from label to (times, values).
    levels
        Label -> constant to compare with, drawn dashed.
    log
        Whether the scale of the values is logarithmic.
    """
    ax = panel(ax)
    for k, (label, (t, values)) in enumerate(series.items()):
        ax.plot(np.asarray(t), np.asarray(values), color=PALETTE[k % len(PALETTE)], label=label)
    for label, level in (levels or {}).items():
        ax.axhline(level, color=GREY, linestyle="--", linewidth=1.0, label=label)
    if log:
        ax.set_yscale("log")
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    return finish(ax, outside=True)


def loops(runs: Mapping[str, xr.Dataset], rows: Sequence[str], *, title: str = "") -> Figure:
    """Draw closed-loop runs: a column for each run, a row for each quantity, common axes.

    Parameters
    ----------
    runs
        Mapping from name to a dataset with the quantities over `time` and, if available, their
        references (`_reference`), limits (`_low`, `_high`), true values (`_truth`) and standard
        deviations (`_std`). Quantities with the attribute `held` are constant between samples.
    rows
        Names of the quantities.

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.
    """
    drawn = empty(len(rows), len(runs), title)
    drawn.set_size_inches(3.2 * len(runs), 2.2 * len(rows))
    grid = drawn.subplots(len(rows), len(runs), squeeze=False, sharex=True, sharey="row")
    for column, (label, data) in enumerate(runs.items()):
        factor, clock = time_scale(data)
        t = data["time"].values / factor
        for row, name in enumerate(rows):
            ax = grid[row][column]
            _loop_panel(ax, data, name, t)
            if row == 0:
                ax.set_title(label, fontsize="medium")
            if column == 0:
                ax.set_ylabel(axis_label(data, name))
            if row == len(rows) - 1:
                ax.set_xlabel(labelled("t", clock))
            finish(ax, legend=column == 0)
    return drawn


def _loop_panel(ax: Axes, data: xr.Dataset, name: str, t: Array) -> None:
    """Draw one quantity of a closed loop, with limits and targets, over times of shape (times,)."""
    for end, (meaning, style, colour) in LOOP_LINES.items():
        if f"{name}_{end}" in data:
            said = ax.get_legend_handles_labels()[1]
            label = "" if meaning in said else meaning  # both limits have one legend entry
            line = data[f"{name}_{end}"].values
            ax.plot(t, line, style, color=colour, linewidth=1.0, label=label)
    values = data[name].values
    if f"{name}_std" in data:
        half = NORMAL_95 * data[f"{name}_std"].values
        ax.fill_between(t, values - half, values + half, color=PALETTE[0], alpha=0.25)
    drawstyle: Any = "steps-post" if "held" in data[name].attrs else "default"
    ax.plot(t, values, color=PALETTE[0], linewidth=1.2, drawstyle=drawstyle)


def intervals(
    estimates: Mapping[str, tuple[float, float, float]], unit: str = "", *, ax: Axes | None = None
) -> Axes:
    """Draw several intervals of a number below each other, with a line through the first value.

    Parameters
    ----------
    estimates
        Label -> value, lower and upper end, for example of the variants of `livepde compare`.
        Intervals with infinite or unknown ends are omitted.
    unit
        Unit of the number.
    ax
        Axes to draw on; default: the axes of a new figure.
    """
    ax = panel(ax)
    for row, (value, low, high) in enumerate(estimates.values()):
        colour = PALETTE[0] if row else PALETTE[1]
        ax.plot([value], [row], "o", color=colour)
        if np.isfinite(high - low):
            ax.plot([low, high], [row, row], color=colour, linewidth=2.0)
        if not row:
            ax.axvline(value, color=GREY, linestyle="--", linewidth=1.0)
    ax.set_yticks(range(len(estimates)), list(estimates))
    ax.invert_yaxis()
    ax.set_xlabel(labelled("95 % interval", unit))
    return ax


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
    """Draw an ensemble over time: thin lines for runs, and a thick mean with its minimum.

    Parameters
    ----------
    times
        Shape (times,).
    values
        Positive numbers, shape (runs, times); the scale is logarithmic.
    levels
        Label -> constant to compare with, drawn dashed.
    legend
        Whether to add a legend next to the panel.
    """
    ax = panel(ax)
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
    return finish(ax, legend=legend, outside=True)
