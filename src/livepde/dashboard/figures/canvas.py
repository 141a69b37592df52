"""The style of figures in a browser: empty figures, time axes, bands and labels.

Names that come from files are shown as text, never as markup.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr
from plotly.colors import hex_to_rgb

from livepde.dates import dated, since_1970
from livepde.linalg import Array
from livepde.plots import PALETTE, labelled, time_scale
from livepde.plots.style import shown_unit, unit_of
from livepde.runs import jumps

FAR = 1e11  # seconds from the origin beyond which times are shown as numbers
DECADES = 100.0  # ratio of values from which a scale is logarithmic
INK, GRID = "#1f2933", "#e4e7eb"
HEIGHT = 320
# A second axis for marks at times without a value.
MARKS: Any = {"overlaying": "y", "range": [0, 1], "visible": False, "fixedrange": True}
CONFIG: Any = {"displayModeBar": False, "responsive": True}  # of Plotly


def text(value: object) -> str:
    """Escape text from a file, so that Plotly shows it unchanged."""
    return html.escape(str(value), quote=False)


def unit_label(data: xr.Dataset, name: str) -> str:
    """Return the unit of a variable in the notation of axes."""
    return shown_unit(unit_of(data, name))


def empty(xlabel: str = "", ylabel: str = "", height: int = HEIGHT) -> go.Figure:
    """Return an empty figure in the style of the page."""
    axis = {"gridcolor": GRID, "zerolinecolor": GRID, "linecolor": "#9aa5b1", "automargin": True}
    figure = go.Figure()
    figure.update_layout(
        template="none",
        height=height,
        margin={"l": 12, "r": 12, "t": 8, "b": 8},
        font={"family": "system-ui, -apple-system, sans-serif", "size": 13, "color": INK},
        paper_bgcolor="white",
        plot_bgcolor="white",
        hovermode="x unified",
        hoverlabel={"namelength": 24},
        legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
        uirevision="kept",  # preserves zoom, camera and hidden lines in an update
    )
    figure.update_xaxes(**axis, title={"text": text(xlabel), "standoff": 6})
    figure.update_yaxes(**axis, title={"text": text(ylabel), "standoff": 8}, exponentformat="power")
    return figure


def over_time(data: xr.Dataset, ylabel: str, at: float | None) -> tuple[go.Figure, TimeAxis]:
    """Return a figure over time with marks at jumps and at the selected time."""
    axis = when_axis(data)
    figure = empty("" if axis.dates else labelled("time", axis.unit), ylabel)
    figure.update_xaxes(type="date" if axis.dates else "linear")
    for k, jump in enumerate(jumps(data)):
        t = axis.values([jump.t, jump.t])
        _upright(figure, t, "jump", PALETTE[1], "dash", legend=k == 0)
    if at is not None:
        _upright(figure, axis.values([at, at]), "selected time", INK, "solid", legend=False)
    return figure, axis


def _upright(figure: go.Figure, t: Any, name: str, colour: str, dash: str, *, legend: bool) -> None:
    about = {"name": name, "legendgroup": name, "showlegend": legend, "hoverinfo": "skip"}
    line(figure, t, [0.0, 1.0], colour, 1.2, dash, yaxis="y2", **about)
    figure.update_layout(yaxis2=MARKS)


def line(
    figure: go.Figure,
    x: Any,
    y: Any,
    colour: str,
    width: float,
    dash: str | None = None,
    **more: Any,
) -> None:
    """Draw a line; `more` contains arguments of Plotly's scatter."""
    style = {"color": colour, "width": width, "dash": dash}
    figure.add_scatter(x=x, y=y, line=style, **{"mode": "lines", **more})


def band(
    figure: go.Figure, x: Any, low: Array, high: Array, colour: str, name: str, opacity: float = 0.2
) -> None:
    """Fill the area between two lines."""
    shared: Any = {"legendgroup": name, "showlegend": False, "hoverinfo": "skip"}
    line(figure, x, low, colour, 0, name="from", **shared)
    red, green, blue = hex_to_rgb(colour)
    fill = f"rgba({red},{green},{blue},{opacity})"
    line(figure, x, high, colour, 0, fill="tonexty", fillcolor=fill, **shared)


def show(figure: go.Figure, parts: Sequence[Array]) -> None:
    """Fit the axis to all finite values, with a logarithmic scale for positive decades."""
    values = np.concatenate([np.ravel(part) for part in parts])
    values = values[np.isfinite(values)]
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    if low > 0.0 and high > DECADES * low:
        low, high = math.log10(low), math.log10(high)
        figure.update_layout(yaxis_type="log")
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    figure.update_layout(yaxis_range=[low - margin, high + margin])


@dataclass(frozen=True)
class TimeAxis:
    """Axis of model times: dates, or numbers in a unit that fits the span."""

    # Coordinates are start + t * scale, for dates in milliseconds since 1970, as in Plotly.
    scale: float
    start: float = 0.0
    unit: str = ""  # unit of numbers
    dates: bool = False  # whether times are dates

    def values(self, t: Any) -> Any:
        """Return the coordinates of times on the axis."""
        return self.start + np.asarray(t, dtype=float) * self.scale

    def text(self, t: float) -> str:
        """Return a time as text."""
        value = self.values(t)
        if self.dates and np.isfinite(value):
            return str(np.datetime64(int(value), "ms").astype("datetime64[s]")).replace("T", " ")
        return f"{value:.5g} {self.unit}".rstrip()


def when_axis(data: xr.Dataset) -> TimeAxis:
    """Return the time axis of a dataset."""
    dates = dated(data)
    if dates is not None:
        origin, second = dates
        if bool((np.abs(data["time"].values) * second < FAR).all()):
            return TimeAxis(1000.0 * second, 1000.0 * since_1970(origin), dates=True)
    factor, name = time_scale(data)
    return TimeAxis(1.0 / factor, unit=name)


def at_time(data: xr.Dataset, dimension: str, at: float | None) -> int:
    """Return the index of the last entry up to a time; -1 for an empty dataset."""
    times = data[dimension].values
    if at is None or not len(times):
        return len(times) - 1
    return max(int(np.searchsorted(times, at, "right")) - 1, 0)
