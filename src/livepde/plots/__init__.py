"""Figures of a run's dataset; the only room that knows Matplotlib.

It takes datasets as `Result.to_xarray()` gives them, and arrays. Matplotlib is loaded when a figure
is drawn, not before, and without pyplot: figures are objects to save, no global state is touched.
"""

from __future__ import annotations

from livepde.plots.curves import ensemble, history, loops, profiles
from livepde.plots.dataset import NORMAL_95, interval_95, labelled, scored_from, time_scale
from livepde.plots.run import overview
from livepde.plots.style import GREY, PALETTE, figure

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
