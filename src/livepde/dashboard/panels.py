"""Panels of a run in a browser: figures in sections, each with a caption.

Pure functions: a dataset as `Result.to_xarray()` or `Layout.dataset` gives it, and the time to look
back to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
import xarray as xr

from livepde.dashboard.field_views import drawn_by, field_profile
from livepde.dashboard.figures import correlation, open_shares, ratio, residuals, told, unknowns
from livepde.dashboard.times import at_time, when_axis
from livepde.plots.dataset import MOST_LINES, groups, note

__all__ = ["SECTIONS", "Panel", "panels"]

SECTIONS = {
    "estimates": "Estimates",
    "sensors": "Sensors against the model",
    "told": "What the data have told",
}


@dataclass(frozen=True, eq=False)
class Panel:
    """A figure with its title and caption.

    Attributes
    ----------
    name
        Unique name among the panels of a run.
    section
        Key of `SECTIONS`.
    title, about
        Title and caption, as plain text.
    """

    name: str
    section: str
    title: str
    about: str
    figure: go.Figure


def panels(data: xr.Dataset, at: float | None = None, cut: float = 0.5) -> list[Panel]:
    """Return all panels of a run.

    Parameters
    ----------
    data
        A run's dataset; empty ones give no panel.
    at
        Time to look back to; default the newest.
    cut
        Position of the cuts through solids, as a share of their size along each axis.
    """
    if not data.sizes.get("time"):
        return []
    found = [*_unknown_panels(data, at), *_field_panels(data, at, cut)]
    for variable, dimension in (("innovation", "sensor"), ("withheld_error", "withheld")):
        if variable in data and data.sizes.get(dimension):
            found.append(_residual_panel(data, variable, dimension, at))
    if note(data, "innovation_ratio") is not None:
        about = (
            "Misses of the sensors, squared, over what noise and uncertainty allow: about 1 or "
            "less is well. Above 4 the model does not explain the data."
        )
        title = "Does the model explain the data?"
        found.append(Panel("ratio", "sensors", title, about, ratio(data, at)))
    if open_shares(data, at):
        about = (
            "What is left of the standard deviation that was assumed before any data: left of 10 % "
            "the data decide, right of 90 % they have told hardly anything."
        )
        found.append(Panel("told", "told", "How much is still open", about, told(data, at)))
    if "correlation" in data:
        about = "Near +1 or −1 the data tell only a combination of two unknowns (newest estimate)."
        title = "Which unknowns are told only together"
        found.append(Panel("correlation", "told", title, about, correlation(data)))
    return found


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


def _field_panels(data: xr.Dataset, at: float | None, cut: float) -> list[Panel]:
    unknown, state = (str(data.attrs.get(key, "")).split() for key in ("fields", "state"))
    found: list[Panel] = []
    if not data.sizes.get("snapshot"):
        return found
    k = at_time(data, "snapshot", at)
    when = when_axis(data).text(float(data["snapshot"].values[k]))
    draw, hint = drawn_by(data, cut)
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


def _residual_panel(data: xr.Dataset, variable: str, dimension: str, at: float | None) -> Panel:
    figure = residuals(data, variable, dimension, at)
    if variable == "innovation":
        about = (
            "Measured minus what the model expected before it saw the sample. Well if it scatters "
            "about zero; a curve that stays on one side speaks of an offset or a missing process."
        )
        if note(data, "residual") is not None:
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
