"""Common style of figures: empty figures, colours, grids and legends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.errors import optional
from livepde.plots.dataset import time_label

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Palette of Okabe and Ito (2008), distinguishable with all common kinds of colour blindness. Yellow
# is omitted, because it is invisible on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#7f7f7f"
# Number of points up to which Matplotlib searches a free place for the legend.
MOST_POINTS = 20_000
# Width and height of a panel in inches.
PANEL = (5.4, 3.4)


def figure_class() -> type[Figure]:
    """Return Matplotlib's figure class; raise `ConfigurationError` without Matplotlib."""
    with optional("plots", "Figures need Matplotlib, which is not installed"):
        from matplotlib.figure import Figure
    return Figure


def figure(rows: int = 1, columns: int = 1, title: str = "") -> tuple[Figure, list[Axes]]:
    """Return an empty figure and its panels, row by row.

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.
    """
    drawn = empty(rows, columns, title)
    return drawn, list(drawn.subplots(rows, columns, squeeze=False).ravel())


def empty(rows: int, columns: int, title: str) -> Figure:
    """Return an empty figure with the size of a number of panels."""
    size = (PANEL[0] * columns, PANEL[1] * rows)
    drawn = figure_class()(figsize=size, layout="constrained")
    if title:
        drawn.suptitle(title)
    return drawn


def panel(ax: Axes | None) -> Axes:
    """Return the given axes, or the axes of a new figure."""
    return figure()[1][0] if ax is None else ax


def time_axis(ax: Axes, data: xr.Dataset) -> None:
    """Label the time axis of a panel whose times are those of `time_values`."""
    label = time_label(data)
    ax.set_xlabel(label)
    if not label:
        import matplotlib.dates

        dates: Any = matplotlib.dates  # has no types
        locator = dates.AutoDateLocator(maxticks=7)
        ax.xaxis.set_major_locator(locator)
        ax.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))


def finish(ax: Axes, *, legend: bool = True, outside: bool = False) -> Axes:
    """Add grid and legend to a finished panel."""
    ax.grid(True, alpha=0.3, linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    if legend and ax.get_legend_handles_labels()[0]:
        if outside:
            ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False)
        else:
            # loc="best" tests every point drawn, which is too slow for long runs.
            points = sum(np.size(line.get_xdata()) for line in ax.lines)
            place: Any = "best" if points <= MOST_POINTS else "upper right"
            ax.legend(loc=place, fontsize="small", framealpha=0.85, edgecolor="none")
    return ax


def shades_of(count: int) -> list[Any]:
    """Return colours for a sequence in time, early to late: viridis without its yellow end."""
    import matplotlib as mpl

    shades: list[Any] = list(mpl.colormaps["viridis"](np.linspace(0.0, 0.88, max(count, 2))))
    return shades[:count]
