"""Figures of a run's dataset, to look at in a browser: of the live page and of reports.

Pure functions: a dataset as `Result.to_xarray()` or `Layout.dataset` gives it, and the time to look
back to. Names that come from files are shown as text, never as markup.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr

from livepde.dashboard import cuts
from livepde.linalg import Array
from livepde.plots import GREY, PALETTE, interval_95, labelled, scored_from, time_scale
from livepde.runs import jumps
from livepde.runs.summary import SECONDS, scalars, shown

__all__ = [
    "CONFIG",
    "SECTIONS",
    "Panel",
    "at_time",
    "correlation",
    "field_map",
    "field_profile",
    "field_solid",
    "groups",
    "panels",
    "ratio",
    "residuals",
    "told",
    "unknowns",
    "when_axis",
]

SECTIONS = {
    "estimates": "Estimates",
    "sensors": "Sensors against the model",
    "told": "What the data have told",
}
MOST_POINTS = 2000  # of a line
MOST_LINES = 7  # in one panel; more sensors are drawn as one line with their range
DECADES = 100.0  # from which ratio on a scale is logarithmic
FINE = 0.2  # share of a mesh's lines on each side that may lie far out
OUT = 4.0  # how many times larger a domain is than where its mesh is fine, to begin there
FAR = 1e11  # seconds from the origin beyond which times are numbers
INK, GRID = "#1f2933", "#e4e7eb"
HEIGHT = 320
CONFIG: Any = {"displayModeBar": False, "responsive": True}  # for Plotly
SURE, FLAT = 0.1, 0.9  # shares of the prior deviation: pinned, told hardly anything


@dataclass(frozen=True, eq=False)
class Panel:
    """A figure with what it shows in words.

    Attributes
    ----------
    name
        Its own among the panels of a run.
    section
        Key of `SECTIONS`.
    title, about
        Plain text: what it is, and how to read it.
    """

    name: str
    section: str
    title: str
    about: str
    figure: go.Figure


def panels(data: xr.Dataset, at: float | None = None, cut: float = 0.5) -> list[Panel]:
    """Return all there is to draw of a run.

    Parameters
    ----------
    data
        A run's dataset; empty ones give no panel.
    at
        Time to look back to; default the newest.
    cut
        Where solids are cut, as share of their size along each axis.
    """
    if not data.sizes.get("time"):
        return []
    found = [*_unknown_panels(data, at), *_field_panels(data, at, cut)]
    for variable, dimension in (("innovation", "sensor"), ("withheld_error", "withheld")):
        if variable in data and data.sizes.get(dimension):
            found.append(_residual_panel(data, variable, dimension, at))
    if "innovation_ratio" in data:
        about = (
            "Misses of the sensors, squared, over what noise and uncertainty allow: about 1 or "
            "less is well. Above 4 the model does not explain the data."
        )
        title = "Does the model explain the data?"
        found.append(Panel("ratio", "sensors", title, about, ratio(data, at)))
    if _known(data, at):
        about = (
            "What is left of the deviation that was assumed before any data: left of 10 % the data "
            "decide, right of 90 % they have told hardly anything."
        )
        found.append(Panel("told", "told", "How much is still open", about, told(data, at)))
    if "correlation" in data:
        about = "Near +1 or −1 the data tell only a combination of two unknowns (newest estimate)."
        title = "Which unknowns are told only together"
        found.append(Panel("correlation", "told", title, about, correlation(data)))
    return found


# --- time and text --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TimeAxis:
    """How model times are shown: dates, or numbers in a unit that suits the span.

    Attributes
    ----------
    scale, start
        What is drawn is `start + t * scale`; of dates in milliseconds since 1970, as Plotly has it.
    unit
        Of numbers.
    dates
        Whether they are dates.
    """

    scale: float
    start: float = 0.0
    unit: str = ""
    dates: bool = False

    def values(self, t: Any) -> Any:
        """Return what is drawn for times."""
        return self.start + np.asarray(t, dtype=float) * self.scale

    def text(self, t: float) -> str:
        """Return one time as text."""
        value = self.values(t)
        if self.dates and np.isfinite(value):
            return str(np.datetime64(int(value), "ms").astype("datetime64[s]")).replace("T", " ")
        return f"{value:.5g} {self.unit}".rstrip()


def when_axis(data: xr.Dataset) -> TimeAxis:
    """Return how the times of a dataset are shown."""
    unit, origin = str(data["time"].attrs.get("units", "")), data.attrs.get("origin")
    times = data["time"].values
    near = bool((np.abs(times) * SECONDS.get(unit, 1.0) < FAR).all())
    if origin is not None and unit in SECONDS and near:
        start = datetime.fromisoformat(str(origin)).replace(tzinfo=UTC).timestamp()
        return TimeAxis(1000.0 * SECONDS[unit], 1000.0 * start, dates=True)
    factor, name = time_scale(data)
    return TimeAxis(1.0 / factor, unit=name)


def at_time(data: xr.Dataset, dimension: str, at: float | None) -> int:
    """Return the index of the last entry up to a time; -1 of an empty dataset."""
    times = data[dimension].values
    if at is None or not len(times):
        return len(times) - 1
    return max(int(np.searchsorted(times, at, "right")) - 1, 0)


def groups(data: xr.Dataset) -> dict[str, list[str]]:
    """Return unknown -> labels of its numbers: one, or one for each region."""
    found: dict[str, list[str]] = {}
    for label in scalars(data):
        found.setdefault(label.partition("[")[0], []).append(label)
    return found


def _text(value: object) -> str:
    """Return text from a file so that Plotly shows it as it stands."""
    return html.escape(str(value), quote=False)


def _unit(data: xr.Dataset, name: str) -> str:
    return str(data[name].attrs.get("units", ""))


def _bounded(data: xr.Dataset) -> xr.Dataset:
    """Return at most so many times, spread evenly; failed steps and jumps are kept."""
    count = data.sizes["time"]
    if count <= MOST_POINTS:
        return data
    kept = np.zeros(count, dtype=bool)
    kept[np.linspace(0, count - 1, MOST_POINTS).round().astype(int)] = True
    notable = data["status"].values != 0
    if "jump" in data:
        notable |= data["jump"].values > 0.0
    kept[np.flatnonzero(notable)[:MOST_POINTS]] = True
    return data.isel(time=kept)


def _rgba(colour: str, alpha: float) -> str:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha})"


def _empty(xlabel: str = "", ylabel: str = "", height: int = HEIGHT) -> go.Figure:
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
        uirevision="kept",  # zoom, camera and hidden lines survive an update
    )
    figure.update_xaxes(**axis, title={"text": _text(xlabel), "standoff": 6})
    figure.update_yaxes(
        **axis, title={"text": _text(ylabel), "standoff": 8}, exponentformat="power"
    )
    return figure


def _over_time(data: xr.Dataset, ylabel: str, at: float | None) -> tuple[go.Figure, TimeAxis]:
    """Return a figure over time with what happened: jumps, and the time that is looked at."""
    axis = when_axis(data)
    figure = _empty("" if axis.dates else labelled("time", axis.unit), ylabel)
    figure.update_xaxes(type="date" if axis.dates else "linear")
    for k, jump in enumerate(jumps(data)):
        t = axis.values([jump.t, jump.t])
        _upright(figure, t, "jump", PALETTE[1], "dash", legend=k == 0)
    if at is not None:
        _upright(figure, axis.values([at, at]), "shown time", INK, "solid", legend=False)
    return figure, axis


def _upright(figure: go.Figure, t: Any, name: str, colour: str, dash: str, *, legend: bool) -> None:
    line = {"color": colour, "width": 1.2, "dash": dash}
    figure.add_scatter(
        x=t,
        y=[0.0, 1.0],
        yaxis="y2",
        mode="lines",
        line=line,
        name=name,
        legendgroup=name,
        showlegend=legend,
        hoverinfo="skip",
    )
    figure.update_layout(
        yaxis2={"overlaying": "y", "range": [0, 1], "visible": False, "fixedrange": True}
    )


def _band(
    figure: go.Figure,
    x: Any,
    low: Array,
    high: Array,
    colour: str,
    name: str,
    opacity: float = 0.2,
) -> None:
    shared: dict[str, Any] = {
        "mode": "lines",
        "line": {"width": 0, "color": colour},
        "legendgroup": name,
        "showlegend": False,
    }
    figure.add_scatter(x=x, y=low, name="from", hoverinfo="skip", **shared)
    figure.add_scatter(
        x=x, y=high, fill="tonexty", fillcolor=_rgba(colour, opacity), hoverinfo="skip", **shared
    )


def _show(figure: go.Figure, parts: Sequence[Array]) -> None:
    """Let the axis show all finite values; positive ones over decades on a logarithmic scale."""
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


# --- unknown numbers ------------------------------------------------------------------------------


def _unknown_panels(data: xr.Dataset, at: float | None) -> list[Panel]:
    found = []
    for name, labels in groups(data).items():
        about = "Line: estimate."
        if np.isfinite(data[f"{labels[0]}_std"].values).any():
            about = "Line: estimate. Band: holds the true value with 95 % probability."
        if any("reference" in data[label].attrs for label in labels):
            about += " Dashed: reference value."
        figure = unknowns(data, labels, at)
        found.append(Panel(f"unknown:{name}", "estimates", f"Unknown {name}", about, figure))
    return found


def unknowns(data: xr.Dataset, labels: Sequence[str], at: float | None = None) -> go.Figure:
    """Draw numbers of one unit over time, with their 95 % bands, reference and bounds.

    Parameters
    ----------
    labels
        Scalar unknowns of the dataset.
    """
    data = _bounded(data)
    figure, axis = _over_time(data, _pretty(data, labels[0]), at)
    t = axis.values(data["time"].values)
    # The prior's band would flatten everything that follows.
    late = slice(max(len(t) // 2, scored_from(data) + len(t) // 20), None)
    reach: list[Array] = []
    opacity = 0.2 if len(labels) <= 2 else 0.1
    for k, label in enumerate(labels):
        colour = PALETTE[k % len(PALETTE)]
        value = data[label].values
        low, high = interval_95(data, label)
        reach.append(value)
        if np.isfinite(low[late]).any():
            reach += [low[late], high[late]]
            if len(labels) <= MOST_LINES:
                _band(figure, t, low, high, colour, label, opacity)
        half = np.nan_to_num(np.maximum(high - value, value - low), nan=0.0)
        figure.add_scatter(
            x=t,
            y=value,
            mode="lines+markers" if len(t) == 1 else "lines",
            line={"color": colour, "width": 2},
            name=_text(_short(label)),
            legendgroup=label,
            showlegend=len(labels) > 1,
            customdata=half,
            hovertemplate="%{y:.4g} ± %{customdata:.2g}" if half.any() else "%{y:.4g}",
        )
        reference = data[label].attrs.get("reference")
        if reference is not None:
            reach.append(np.array([float(reference)]))
            figure.add_scatter(
                x=t[[0, -1]],
                y=[float(reference)] * 2,
                mode="lines",
                line={"color": colour, "width": 1.2, "dash": "dash"},
                name="reference",
                legendgroup=label,
                showlegend=k == 0,
                hovertemplate="%{y:.4g}",
            )
    _show(figure, reach)
    _mark_failures(figure, data, axis)
    return figure


def _short(label: str) -> str:
    """Return the region of a label that has one."""
    return label.partition("[")[2].removesuffix("]") or label


def _pretty(data: xr.Dataset, name: str) -> str:
    """Return the unit of a variable for an axis."""
    return labelled("", _unit(data, name)).strip().strip("[]")


def _mark_failures(figure: go.Figure, data: xr.Dataset, axis: TimeAxis) -> None:
    failed = data["time"].values[data["status"].values != 0]
    if not len(failed):
        return
    figure.add_scatter(
        x=axis.values(failed),
        y=np.full(len(failed), 0.02),
        yaxis="y2",
        mode="markers",
        marker={"symbol": "x", "color": PALETTE[1], "size": 8},
        name="failed step",
        hoverinfo="skip",
    )
    figure.update_layout(
        yaxis2={"overlaying": "y", "range": [0, 1], "visible": False, "fixedrange": True}
    )


# --- fields ---------------------------------------------------------------------------------------


def _field_panels(data: xr.Dataset, at: float | None, cut: float) -> list[Panel]:
    unknown, state = (str(data.attrs.get(key, "")).split() for key in ("fields", "state"))
    found: list[Panel] = []
    if not data.sizes.get("snapshot"):
        return found
    k = at_time(data, "snapshot", at)
    when = when_axis(data).text(float(data["snapshot"].values[k]))
    draw, hint = _drawn(data, cut)
    for name in [*unknown, *state]:
        if name not in data:
            continue
        title = f"{'Unknown field' if name in unknown else 'State'} {name}"
        deviates = f"{name}_std" in data and bool(data[f"{name}_std"].values[k].any())
        about = f"Estimate at {when}.{hint}"
        profile = draw is field_profile
        if profile and deviates:
            about += " Band: holds the true one with 95 % probability."
        found.append(Panel(f"field:{name}", "estimates", title, about, draw(data, name, at)))
        if not profile and deviates and name in unknown:
            about = f"Standard deviation at {when}: small where the data have told.{hint}"
            spread = draw(data, f"{name}_std", at)
            title = f"How sure: {name}"
            found.append(Panel(f"field:{name}_std", "estimates", title, about, spread))
    return found


def _drawn(data: xr.Dataset, cut: float) -> tuple[Callable[..., go.Figure], str]:
    """Return what draws a field, and how to read it."""
    if "z" in data.coords:
        hint = f" Surface, seen through, and three cuts at {cut:.0%} of its size: drag to turn."
        return partial(field_solid, cut=cut), hint
    if "y" in data.coords:
        return field_map, " Shown is where the mesh is fine: double-click for all." * _zoomed(data)
    return field_profile, " Grey: at the start."


def _zoomed(data: xr.Dataset) -> bool:
    drawn = cuts.plane_map(data)
    return _fine(drawn.x) is not None or _fine(drawn.y) is not None


def field_profile(data: xr.Dataset, name: str, at: float | None = None) -> go.Figure:
    """Draw a field along an interval: with its 95 % band, and as it was at the start."""
    k = at_time(data, "snapshot", at)
    figure = _empty(labelled("x", _unit(data, "x")), _pretty(data, name))
    x, values = data["x"].values, data[name].values
    reach = [values]
    if k > 0:
        figure.add_scatter(
            x=x,
            y=values[0],
            mode="lines",
            line={"color": GREY, "width": 1.2, "dash": "dot"},
            name="start",
            hovertemplate="%{y:.4g}",
        )
    if f"{name}_std" in data:
        low, high = interval_95(data, name)
        late = slice(len(values) // 10, None)
        reach += [low[late], high[late]]
        _band(figure, x, low[k], high[k], PALETTE[0], name)
    figure.add_scatter(
        x=x,
        y=values[k],
        mode="lines",
        line={"color": PALETTE[0], "width": 2.2},
        name="estimate",
        hovertemplate="%{y:.4g}",
    )
    _show(figure, reach)
    figure.update_layout(showlegend=k > 0)
    return figure


def field_map(data: xr.Dataset, name: str, at: float | None = None) -> go.Figure:
    """Draw a field on a plane domain, on lines as dense as its mesh."""
    drawn = cuts.plane_map(data)
    values = data[name].values[at_time(data, "snapshot", at)]
    unit = labelled("", _unit(data, "x")).strip()
    figure = _empty(f"x {unit}", f"y {unit}", height=380)
    figure.add_heatmap(
        x=drawn.x,
        y=drawn.y,
        z=drawn.of(values).astype(np.float32),
        colorscale=_colours(name),
        colorbar=_bar(data, name),
        hovertemplate="x %{x:.4g}, y %{y:.4g}: %{z:.4g}<extra></extra>",
    )
    figure.update_layout(hovermode="closest", yaxis={"scaleanchor": "x", "constrain": "domain"})
    figure.update_xaxes(constrain="domain", showgrid=False, zeroline=False)
    figure.update_yaxes(showgrid=False, zeroline=False)
    figure.update_layout(xaxis_range=_fine(drawn.x), yaxis_range=_fine(drawn.y))
    return figure


def _fine(lines: Array) -> list[float] | None:
    """Return where a mesh is fine, if its domain goes on far beyond."""
    low, high = np.quantile(lines, [FINE, 1.0 - FINE]).tolist()
    return [low, high] if np.ptp(lines) > OUT * (high - low) else None


def field_solid(
    data: xr.Dataset, name: str, at: float | None = None, cut: float = 0.5
) -> go.Figure:
    """Draw a field in a solid: its surface, seen through, and cuts across x, y and z."""
    values = data[name].values[at_time(data, "snapshot", at)]
    figure = _empty(height=440)
    parts = [(cuts.boundary(data), 0.15), *((found, 1.0) for found in cuts.slices(data, cut))]
    low, high = float(values.min()), float(values.max())
    for k, (surface, opacity) in enumerate(parts):
        x, y, z = surface.points.T
        i, j, l = surface.triangles.T
        figure.add_mesh3d(
            x=x,
            y=y,
            z=z,
            i=i,
            j=j,
            k=l,
            intensity=surface.of(values),
            cmin=low,
            cmax=high if high > low else low + 1.0,
            colorscale=_colours(name),
            colorbar=_bar(data, name),
            showscale=k == 0,
            opacity=opacity,
            flatshading=True,
            lighting={"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
            hovertemplate="%{x:.4g}, %{y:.4g}, %{z:.4g}: %{intensity:.4g}<extra></extra>",
        )
    unit = labelled("", _unit(data, "x")).strip()
    axes = {
        f"{axis}axis": {"title": {"text": _text(f"{axis} {unit}")}, "gridcolor": GRID}
        for axis in "xyz"
    }
    camera = {"eye": {"x": 1.5, "y": 1.5, "z": 1.1}, "center": {"x": 0, "y": 0, "z": -0.1}}
    figure.update_layout(
        hovermode="closest", scene={**axes, "aspectmode": "data", "camera": camera}
    )
    return figure


def _colours(name: str) -> str:
    return "Cividis" if name.endswith("_std") else "Viridis"


def _bar(data: xr.Dataset, name: str) -> dict[str, Any]:
    title = {"text": _text(_pretty(data, name)), "side": "right"}
    return {"title": title, "thickness": 14, "outlinewidth": 0, "exponentformat": "power"}


# --- sensors --------------------------------------------------------------------------------------


def _residual_panel(data: xr.Dataset, variable: str, dimension: str, at: float | None) -> Panel:
    figure = residuals(data, variable, dimension, at)
    if variable == "innovation":
        about = (
            "Measured minus what the model expected before it saw the sample. Well if it scatters "
            "about zero; a curve that stays on one side speaks of an offset or a missing process."
        )
        if "residual" in data:
            about = "Measured minus what the model says after the step. Well if about zero."
        title = "Sensors: measured − expected"
        return Panel(variable, "sensors", title, about + _crowd(data, dimension), figure)
    about = (
        "Measured minus estimated of channels that are withheld: the estimate never sees them, so "
        "they test it."
    )
    about += _crowd(data, dimension)
    return Panel(variable, "sensors", "Withheld sensors: measured − estimated", about, figure)


def _crowd(data: xr.Dataset, dimension: str) -> str:
    """Return how many sensors are drawn as one."""
    count = data.sizes[dimension]
    return f" Line: root mean square of {count}; band: their range." if count > MOST_LINES else ""


def residuals(
    data: xr.Dataset, variable: str, dimension: str, at: float | None = None
) -> go.Figure:
    """Draw errors of sensors over time: each, or of many their range.

    Parameters
    ----------
    variable, dimension
        "innovation" over "sensor", or "withheld_error" over "withheld".
    """
    data = _bounded(data)
    figure, axis = _over_time(data, _pretty(data, variable), at)
    t, errors = axis.values(data["time"].values), data[variable].values
    names = [str(name) for name in data[dimension].values]
    mode = "lines" if len(t) > 60 else "lines+markers"
    if len(names) <= MOST_LINES:
        for k, name in enumerate(names):
            figure.add_scatter(
                x=t,
                y=errors[:, k],
                mode=mode,
                line={"color": PALETTE[k % len(PALETTE)], "width": 1.3},
                marker={"size": 5},
                name=_text(name),
                hovertemplate="%{y:+.3g}",
            )
        figure.update_layout(showlegend=True)
        return figure
    some = np.isfinite(errors).any(axis=1)
    t, errors = t[some], errors[some]
    if len(t):
        low, high = np.nanmin(errors, axis=1), np.nanmax(errors, axis=1)
        _band(figure, t, low, high, PALETTE[0], "range")
        figure.add_scatter(
            x=t,
            y=np.sqrt(np.nanmean(errors**2, axis=1)),
            mode=mode,
            line={"color": PALETTE[0], "width": 1.8},
            name="root mean square",
            showlegend=True,
            hovertemplate="%{y:.3g}",
        )
    return figure


def ratio(data: xr.Dataset, at: float | None = None) -> go.Figure:
    """Draw the squared misses of the sensors over what is expected of them."""
    data = _bounded(data)
    figure, axis = _over_time(data, "", at)
    t, values = axis.values(data["time"].values), data["innovation_ratio"].values
    figure.add_scatter(
        x=t,
        y=values,
        mode="lines",
        line={"color": PALETTE[0], "width": 2},
        name="misses to expected",
        hovertemplate="%{y:.3g}",
    )
    for level, name, colour in ((1.0, "as expected", GREY), (4.0, "too large", PALETTE[1])):
        figure.add_scatter(
            x=t[[0, -1]],
            y=[level, level],
            mode="lines",
            line={"color": colour, "width": 1.2, "dash": "dash"},
            name=name,
            hoverinfo="skip",
        )
    figure.update_yaxes(rangemode="tozero")
    return figure


# --- what the data have told ----------------------------------------------------------------------


def _known(data: xr.Dataset, at: float | None) -> dict[str, float]:
    """Return unknown -> share of its prior deviation that is left; of fields over their modes."""
    found: dict[str, float] = {}
    k = at_time(data, "time", at)
    for label in scalars(data):
        left = float(data[f"{label}_left"].values[k]) if f"{label}_left" in data else math.nan
        if math.isfinite(left):
            found[label] = left
    for name in str(data.attrs.get("fields", "")).split():
        if f"{name}_modes" in data:
            modes = data[f"{name}_modes"]
            count = int(modes.attrs["of"])
            some = float(modes.values[at_time(data, "snapshot", at)])
            open_modes = f"{name} ({some:.1f} of {count} modes told)"
            found[open_modes] = math.sqrt(max(1.0 - some / count, 0.0)) if count else math.nan
    return found


def told(data: xr.Dataset, at: float | None = None) -> go.Figure:
    """Draw the share of the prior deviation that is left of each unknown."""
    known = dict(reversed(_known(data, at).items()))
    figure = _empty("prior deviation left [%]", height=max(170, 90 + 26 * len(known)))
    shares = [100.0 * left for left in known.values()]
    colours = [
        PALETTE[2] if share <= 100 * SURE else PALETTE[1] if share > 100 * FLAT else PALETTE[0]
        for share in shares
    ]
    figure.add_bar(
        x=shares,
        y=[_text(name) for name in known],
        orientation="h",
        marker={"color": colours},
        text=[shown(share, ".2g" if share < 100 else ".0f", " %") for share in shares],
        textposition="auto",
        hoverinfo="skip",
    )
    for level in (SURE, FLAT):
        figure.add_vline(x=100 * level, line={"color": GREY, "dash": "dash", "width": 1})
    figure.update_layout(hovermode=False, xaxis_range=[0, max(105.0, 1.05 * max(shares))])
    figure.update_yaxes(type="category")
    return figure


def correlation(data: xr.Dataset) -> go.Figure:
    """Draw how the newest estimates of numbers are correlated."""
    names = [_text(name) for name in data["unknown"].values]
    values = data["correlation"].values
    figure = _empty(height=max(260, 120 + 30 * len(names)))
    figure.add_heatmap(
        x=names,
        y=names,
        z=values,
        zmin=-1,
        zmax=1,
        colorscale="RdBu_r",
        colorbar={"thickness": 14, "outlinewidth": 0},
        texttemplate="%{z:.2f}" if len(names) <= 10 else "",
        hovertemplate="%{y}, %{x}: %{z:.2f}<extra></extra>",
    )
    figure.update_layout(hovermode="closest")
    figure.update_xaxes(type="category", showgrid=False)
    figure.update_yaxes(type="category", showgrid=False, autorange="reversed")
    return figure
