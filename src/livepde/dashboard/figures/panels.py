"""Panels of a run in a browser: figures over time in sections, each with a caption.

Pure functions: a dataset as `Result.to_xarray()` or `Layout.dataset` gives it, and the time to look
back to.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr

from livepde.dashboard.figures import canvas
from livepde.dashboard.figures.field_views import drawn_by, field_profile
from livepde.dashboard.view import READINGS
from livepde.frames import ERRORS
from livepde.linalg import Array
from livepde.plots import GREY, PALETTE, style
from livepde.records import field_names, interval_95, scalars, used_errors
from livepde.runs.summary import shown

SECTIONS = {
    "measured": "Measured and modelled",
    "estimates": "Estimates",
    "sensors": "Residuals",
    "told": "Identifiability",
}
MOST_POINTS = 2000  # largest number of points of a line
SURE, FLAT = 0.1, 0.9  # shares of the prior standard deviation: determined, not identifiable


@dataclass(frozen=True, eq=False)
class Panel:
    """A figure with its title and caption."""

    name: str  # unique name among the panels of a run
    section: str  # key of `SECTIONS`
    title: str  # plain text
    about: str  # caption, plain text
    figure: go.Figure


def panels(data: xr.Dataset, at: float | None = None, cut: float = 0.5) -> list[Panel]:
    """Return all panels of a run.

    `data`: a run's dataset; empty ones give no panel.
    `at`: time to look back to; default the newest.
    `cut`: position of the cuts through solids, as a share of their size along each axis.
    """
    if not data.sizes.get("time"):
        return []
    return [
        *_measured_panels(data, at),
        *_unknown_panels(data, at),
        *_field_panels(data, at, cut),
        *_residual_panels(data, at),
        *_told_panels(data, at),
    ]


def _measured_panels(data: xr.Dataset, at: float | None) -> Iterator[Panel]:
    """Yield a panel for the sensors of each unit if readings are known."""
    if not any(name in data for name in READINGS.values()):
        return
    units = style.sensors_by_unit(data)
    for unit, names in units.items():
        about = "Points: readings. Lines: predictions of the model one step ahead."
        if "validation" in data and set(names) & set(map(str, data["validation"].values)):
            about += " Dashed: validation sensors, which it never uses."
        if len(names) > style.MOST_LINES:
            about += f" The first {style.MOST_LINES} of {len(names)} sensors."
        title = f"Measured and modelled{f', {unit}' if len(units) > 1 else ''}"
        figure = measured(data, names[: style.MOST_LINES], unit, at)
        yield Panel(f"measured:{unit}", "measured", title, about, figure)


def measured(data: xr.Dataset, sensors: Sequence[str], unit: str, at: float | None) -> go.Figure:
    """Draw readings and predictions of sensors with one unit."""
    data = _bounded(data)
    figure, axis = canvas.over_time(data, style.shown_unit(unit), at)
    t = axis.values(data["time"].values)
    for error, dimension in ERRORS:
        if error not in data:
            continue
        readings, errors = (
            data[name].transpose("time", dimension).values for name in (READINGS[error], error)
        )
        for k, name in enumerate(map(str, data[dimension].values)):
            if name not in sensors:
                continue
            colour = PALETTE[list(sensors).index(name) % len(PALETTE)]
            about = {"legendgroup": name, "hovertemplate": "%{y:.4g}"}
            figure.add_scatter(
                x=t,
                y=readings[:, k],
                mode="markers",
                marker={"color": colour, "size": 4, "opacity": 0.6},
                name=canvas.text(f"{name}, measured"),
                showlegend=False,
                **about,
            )
            label, dash = name, None
            if dimension == "validation":
                label, dash = f"{name} (validation)", "dash"
            about |= {"name": canvas.text(label), "mode": _line_mode(t)}
            canvas.line(figure, t, readings[:, k] - errors[:, k], colour, 1.6, dash, **about)
    figure.update_layout(showlegend=True)
    return figure


def _line_mode(t: Array) -> str:
    """Return the mode of a line, with markers if it would be invisible as a single point."""
    return "lines+markers" if len(t) == 1 else "lines"


def _unknown_panels(data: xr.Dataset, at: float | None) -> Iterator[Panel]:
    for name, labels in style.groups(data).items():
        about = "Line: estimate."
        if np.isfinite(data[f"{labels[0]}_std"].values).any():
            about = "Line: estimate. Band: 95 % interval."
        if any("reference" in data[label].attrs for label in labels):
            about += " Dashed: reference value."
        figure = unknowns(data, labels, at)
        yield Panel(f"unknown:{name}", "estimates", f"Unknown {name}", about, figure)


def _field_panels(data: xr.Dataset, at: float | None, cut: float) -> Iterator[Panel]:
    if not data.sizes.get("snapshot"):
        return
    unknown, state = (str(data.attrs.get(key, "")).split() for key in ("fields", "state"))
    k = canvas.at_time(data, "snapshot", at)
    when = canvas.when_axis(data).text(float(data["snapshot"].values[k]))
    draw, hint = drawn_by(data, cut)
    for name in filter(data.__contains__, [*unknown, *state]):
        title = f"{'Unknown field' if name in unknown else 'State'} {name}"
        deviates = f"{name}_std" in data and bool(data[f"{name}_std"].values[k].any())
        profile = draw is field_profile
        about = f"Estimate at {when}.{hint}{' Band: 95 % interval.' * (profile and deviates)}"
        yield Panel(f"field:{name}", "estimates", title, about, draw(data, name, at))
        if not profile and deviates and name in unknown:
            about = f"Standard deviation at {when}.{hint}"
            spread = draw(data, f"{name}_std", at)
            title = f"Standard deviation of {name}"
            yield Panel(f"field:{name}_std", "estimates", title, about, spread)


def _residual_panels(data: xr.Dataset, at: float | None) -> Iterator[Panel]:
    for variable, dimension in ERRORS:
        if variable not in data or not (count := data.sizes.get(dimension)):
            continue
        title = "Validation sensors: measured − estimated"
        about = (
            "Measured minus estimated, of the validation sensors, which the estimate does not use."
        )
        if variable == "innovation":
            title = "Sensors: measured − predicted"
            about = (
                "Measured minus predicted, one step ahead. If the model is right, it scatters "
                "about zero. If it stays on one side, there is an offset or a missing process."
            )
            if style.note(data, "residual") is not None:
                about = (
                    "Measured minus estimated, after the step. If the model is right, it is about "
                    "zero."
                )
        if count > style.MOST_LINES:
            about += f" Line: root mean square of {count}; band: their range."
        yield Panel(variable, "sensors", title, about, residuals(data, variable, dimension, at))
    if style.note(data, "innovation_ratio") is not None:
        about = (
            "Ratio of squared innovations to their expected square. If the model is right, it is "
            "about 1 or less. Above 4, the model does not fit the data."
        )
        yield Panel("ratio", "sensors", "Innovation ratio", about, ratio(data, at))


def _told_panels(data: xr.Dataset, at: float | None) -> Iterator[Panel]:
    if shares := open_shares(data, at):
        about = (
            "Standard deviation as a share of the prior's. Below 10 %, an unknown is well "
            "determined. Above 90 %, it is not identifiable from these data."
        )
        yield Panel("told", "told", "Remaining uncertainty", about, told(shares))
    if "correlation" in data:
        about = (
            "Near +1 or −1, only a combination of both unknowns is identifiable (newest estimate)."
        )
        title = "Correlation of the estimates"
        yield Panel("correlation", "told", title, about, correlation(data))


def _bounded(data: xr.Dataset) -> xr.Dataset:
    """Return a dataset thinned to evenly spread samples; failed steps and jumps are kept."""
    count = data.sizes["time"]
    if count <= MOST_POINTS:
        return data
    kept = np.zeros(count, dtype=bool)
    kept[np.linspace(0, count - 1, MOST_POINTS).round().astype(int)] = True
    notable = data["status"].values != 0
    alarms = style.note(data, "jump")
    if alarms is not None:
        notable |= alarms > 0.0
    kept[np.flatnonzero(notable)[:MOST_POINTS]] = True
    return data.isel(time=kept)


def unknowns(data: xr.Dataset, labels: Sequence[str], at: float | None = None) -> go.Figure:
    """Draw numbers of one unit over time, with their 95 % bands, reference and bounds.

    `labels`: scalar unknowns of the dataset.
    """
    data = _bounded(data)
    figure, axis = canvas.over_time(data, canvas.unit_label(data, labels[0]), at)
    t = axis.values(data["time"].values)
    # The wide band of the prior would hide all later values.
    late = slice(max(len(t) // 2, style.scored_from(data) + len(t) // 20), None)
    reach: list[Array] = []
    opacity = 0.2 if len(labels) <= 2 else 0.1
    for k, label in enumerate(labels):
        colour = PALETTE[k % len(PALETTE)]
        value = data[label].values
        low, high = interval_95(data, label)
        reach.append(value)
        if np.isfinite(low[late]).any():
            reach += [low[late], high[late]]
            if len(labels) <= style.MOST_LINES:
                canvas.band(figure, t, low, high, colour, label, opacity)
        std = np.nan_to_num(data[f"{label}_std"].values, nan=0.0)
        about: dict[str, Any] = {"legendgroup": label, "showlegend": len(labels) > 1}
        about |= {"name": canvas.text(_short(label)), "mode": _line_mode(t), "customdata": std}
        hover = "%{y:.4g} ± %{customdata:.2g}" if std.any() else "%{y:.4g}"
        canvas.line(figure, t, value, colour, 2, hovertemplate=hover, **about)
        reference = data[label].attrs.get("reference")
        if reference is not None:
            reach.append(np.array([float(reference)]))
            about = {"legendgroup": label, "showlegend": k == 0, "hovertemplate": "%{y:.4g}"}
            ends = [float(reference)] * 2
            canvas.line(figure, t[[0, -1]], ends, colour, 1.2, "dash", name="reference", **about)
    canvas.show(figure, reach)
    _mark_failures(figure, data, axis)
    return figure


def _short(label: str) -> str:
    """Return the region in a label."""
    return label.partition("[")[2].removesuffix("]") or label


def _mark_failures(figure: go.Figure, data: xr.Dataset, axis: canvas.TimeAxis) -> None:
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
    figure.update_layout(yaxis2=canvas.MARKS)


def residuals(
    data: xr.Dataset, variable: str, dimension: str, at: float | None = None
) -> go.Figure:
    """Draw errors of sensors over time: each one, or their range if there are many.

    `variable`, `dimension`: "innovation" over "sensor", or "validation_error" over "validation".
    """
    data = _bounded(data)
    figure, axis = canvas.over_time(data, canvas.unit_label(data, variable), at)
    t, errors = axis.values(data["time"].values), used_errors(data, variable, dimension)
    names = [str(name) for name in data[dimension].values]
    mode = "lines" if len(t) > 60 else "lines+markers"
    if len(names) <= style.MOST_LINES:
        for k, name in enumerate(names):
            about = {"name": canvas.text(name), "mode": mode, "hovertemplate": "%{y:+.3g}"}
            colour = PALETTE[k % len(PALETTE)]
            canvas.line(figure, t, errors[:, k], colour, 1.3, marker={"size": 5}, **about)
        figure.update_layout(showlegend=True)
        return figure
    some = np.isfinite(errors).any(axis=1)
    t, errors = t[some], errors[some]
    if len(t):
        low, high = np.nanmin(errors, axis=1), np.nanmax(errors, axis=1)
        canvas.band(figure, t, low, high, PALETTE[0], "range")
        root = np.sqrt(np.nanmean(errors**2, axis=1))
        about = {"name": "root mean square", "mode": mode, "hovertemplate": "%{y:.3g}"}
        canvas.line(figure, t, root, PALETTE[0], 1.8, showlegend=True, **about)
    return figure


def ratio(data: xr.Dataset, at: float | None) -> go.Figure:
    """Draw the ratio of squared innovations to their expected square."""
    data = _bounded(data)
    figure, axis = canvas.over_time(data, "", at)
    t, values = axis.values(data["time"].values), style.note(data, "innovation_ratio")
    about = {"name": "innovation ratio", "hovertemplate": "%{y:.3g}"}
    canvas.line(figure, t, values, PALETTE[0], 2, **about)
    for level, name, colour in ((1.0, "as expected", GREY), (4.0, "too large", PALETTE[1])):
        canvas.line(
            figure, t[[0, -1]], [level] * 2, colour, 1.2, "dash", name=name, hoverinfo="skip"
        )
    figure.update_yaxes(rangemode="tozero")
    return figure


def open_shares(data: xr.Dataset, at: float | None) -> dict[str, float]:
    """Return unknown -> posterior over prior standard deviation, for fields over all modes."""
    found: dict[str, float] = {}
    k = canvas.at_time(data, "time", at)
    for label in scalars(data):
        left = style.prior_left(data, label, k)
        if math.isfinite(left):
            found[label] = left
    for name in field_names(data):
        if f"{name}_modes" in data:
            newest = canvas.at_time(data, "snapshot", at)
            known, count, left = style.modes_determined(data, name, newest)
            found[f"{name} ({known:.1f} of {count} modes determined)"] = left
    return found


def told(left: dict[str, float]) -> go.Figure:
    """Draw the posterior over prior standard deviation of each unknown."""
    known = dict(reversed(left.items()))
    figure = canvas.empty(
        "share of the prior standard deviation [%]", height=max(170, 90 + 26 * len(known))
    )
    shares = [100.0 * left for left in known.values()]
    colours = [
        PALETTE[2] if share <= 100 * SURE else PALETTE[1] if share > 100 * FLAT else PALETTE[0]
        for share in shares
    ]
    figure.add_bar(
        x=shares,
        y=[canvas.text(name) for name in known],
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
    """Draw the correlations of the newest estimates of numbers."""
    names = [canvas.text(name) for name in data["unknown"].values]
    values = data["correlation"].values
    figure = canvas.empty(height=max(260, 120 + 30 * len(names)))
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
