"""Figures of a run's dataset; the only subpackage that imports Matplotlib.

The input is a dataset as returned by `Result.to_xarray()`, or arrays. Matplotlib is imported when a
figure is drawn, not before, and without pyplot: figures are objects to save, and no global state is
changed.
"""

from __future__ import annotations

from livepde.plots.curves import ensemble, history, intervals, loops, profiles
from livepde.plots.run_figure import (
    RunPlots,
    corner,
    curves,
    estimates,
    field,
    measured_and_predicted,
    overview,
    residuals,
)
from livepde.plots.style import (
    GREY,
    PALETTE,
    figure,
    labelled,
    scored_from,
    sensor_places,
    time_scale,
)
from livepde.records import NORMAL_95, interval_95

__all__ = [
    "GREY",
    "NORMAL_95",
    "PALETTE",
    "RunPlots",
    "corner",
    "curves",
    "ensemble",
    "estimates",
    "field",
    "figure",
    "history",
    "interval_95",
    "intervals",
    "labelled",
    "loops",
    "measured_and_predicted",
    "overview",
    "profiles",
    "residuals",
    "scored_from",
    "sensor_places",
    "time_scale",
]
