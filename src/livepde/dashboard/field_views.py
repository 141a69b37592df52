"""Fields of a run in a browser: along an interval, on a plane domain, in a solid."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr

from livepde.dashboard import cuts
from livepde.dashboard.canvas import (
    GRID,
    at_time,
    band,
    empty,
    line,
    show,
    text,
    unit_label,
    unit_of,
)
from livepde.linalg import Array
from livepde.plots import GREY, PALETTE, interval_95, labelled, sensor_places

FINE = 0.2  # share of a mesh's lines on each side that may lie far out
OUT = 4.0  # how many times larger a domain is than where its mesh is fine, to begin there


def drawn_by(data: xr.Dataset, cut: float) -> tuple[Callable[..., go.Figure], str]:
    """Return the function that draws a field, and a hint for its caption."""
    if "z" in data.coords:
        hint = f" Translucent surface, and three cuts at {cut:.0%} of its size: drag to rotate."
        return partial(field_solid, cut=cut), hint
    if "y" in data.coords:
        return field_map, " The region of fine mesh is shown. Double-click to show all." * _zoomed(
            data
        )
    return field_profile, " Grey: initial state."


def _zoomed(data: xr.Dataset) -> bool:
    drawn = cuts.plane_map(data)
    return _fine(drawn.x) is not None or _fine(drawn.y) is not None


def field_profile(data: xr.Dataset, name: str, at: float | None = None) -> go.Figure:
    """Draw a field along an interval: with its 95 % band, and as it was at the start."""
    k = at_time(data, "snapshot", at)
    figure = empty(labelled("x", unit_of(data, "x")), unit_label(data, name))
    x, values = data["x"].values, data[name].values
    reach = [values]
    if k > 0:
        line(figure, x, values[0], GREY, 1.2, "dot", name="start", hovertemplate="%{y:.4g}")
    if f"{name}_std" in data:
        low, high = interval_95(data, name)
        # The wide band of the prior would determine the scale and hide all later values.
        late = slice(len(values) // 10, None)
        reach += [low[late], high[late]]
        band(figure, x, low[k], high[k], PALETTE[0], name)
    line(figure, x, values[k], PALETTE[0], 2.2, name="estimate", hovertemplate="%{y:.4g}")
    show(figure, reach)
    figure.update_layout(showlegend=k > 0)
    return figure


def field_map(data: xr.Dataset, name: str, at: float | None = None) -> go.Figure:
    """Draw a field on a plane domain, on lines as dense as its mesh."""
    drawn = cuts.plane_map(data)
    values = data[name].values[at_time(data, "snapshot", at)]
    unit = labelled("", unit_of(data, "x")).strip()
    figure = empty(f"x {unit}", f"y {unit}", height=380)
    figure.add_heatmap(
        x=drawn.x,
        y=drawn.y,
        z=drawn.of(values).astype(np.float32),
        colorscale=_colours(name),
        colorbar=_bar(data, name),
        zsmooth="best",
        hovertemplate="x %{x:.4g}, y %{y:.4g}: %{z:.4g}<extra></extra>",
    )
    for kind, sensors in sensor_places(data).items():
        inside, edge = ("white", "black") if kind == "sensor" else ("black", "white")
        figure.add_scatter(
            x=sensors.x,
            y=sensors.y,
            text=sensors.names,
            mode="markers",
            marker={"size": 7, "color": inside, "line": {"color": edge, "width": 1.2}},
            showlegend=False,
            hovertemplate=f"{kind} %{{text}}<extra></extra>",
        )
    figure.update_layout(hovermode="closest", yaxis={"scaleanchor": "x", "constrain": "domain"})
    figure.update_xaxes(constrain="domain", showgrid=False, zeroline=False)
    figure.update_yaxes(showgrid=False, zeroline=False)
    figure.update_layout(xaxis_range=_fine(drawn.x), yaxis_range=_fine(drawn.y))
    return figure


def _fine(lines: Array) -> list[float] | None:
    """Return where a mesh is fine, if its domain extends far beyond."""
    low, high = np.quantile(lines, [FINE, 1.0 - FINE]).tolist()
    return [low, high] if np.ptp(lines) > OUT * (high - low) else None


def field_solid(
    data: xr.Dataset, name: str, at: float | None = None, cut: float = 0.5
) -> go.Figure:
    """Draw a field in a solid: its surface, seen through, and cuts across x, y and z."""
    values = data[name].values[at_time(data, "snapshot", at)]
    figure = empty(height=440)
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
    unit = labelled("", unit_of(data, "x")).strip()
    axes = {
        f"{axis}axis": {"title": {"text": text(f"{axis} {unit}")}, "gridcolor": GRID}
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
    title = {"text": text(unit_label(data, name)), "side": "right"}
    return {"title": title, "thickness": 14, "outlinewidth": 0, "exponentformat": "power"}
