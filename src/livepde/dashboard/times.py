"""Time axis of a run in a browser, and index of the selected time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from livepde.dates import dated
from livepde.plots import time_scale
from livepde.streams.clock import since_1970

__all__ = ["TimeAxis", "at_time", "when_axis"]

FAR = 1e11  # seconds from the origin beyond which times are numbers


@dataclass(frozen=True)
class TimeAxis:
    """Axis of model times: dates, or numbers in a unit that suits the span.

    Attributes
    ----------
    scale, start
        Coefficients of the coordinate `start + t * scale`; of dates in milliseconds since 1970, the
        convention of Plotly.
    unit
        Unit of numbers.
    dates
        Whether times are dates.
    """

    scale: float
    start: float = 0.0
    unit: str = ""
    dates: bool = False

    def values(self, t: Any) -> Any:
        """Return the coordinates of times on the axis."""
        return self.start + np.asarray(t, dtype=float) * self.scale

    def text(self, t: float) -> str:
        """Return one time as text."""
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
    """Return the index of the last entry up to a time; -1 of an empty dataset."""
    times = data[dimension].values
    if at is None or not len(times):
        return len(times) - 1
    return max(int(np.searchsorted(times, at, "right")) - 1, 0)
