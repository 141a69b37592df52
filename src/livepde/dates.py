"""Times of a run as dates, where it has them."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["SECONDS", "dated", "instants", "when"]

SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "day": 86400.0}


def dated(data: xr.Dataset) -> tuple[datetime, float] | None:
    """Return the date of t = 0 and the seconds of a unit of time; None if times are numbers."""
    unit, origin = str(data["time"].attrs.get("units", "")), data.attrs.get("origin")
    if origin is None or unit not in SECONDS:
        return None
    return datetime.fromisoformat(str(origin)), SECONDS[unit]


def when(data: xr.Dataset, t: float) -> str:
    """Return a time of a run as text: a date if it has one."""
    dates = dated(data)
    if dates is None:
        return f"t = {t:.6g} {data['time'].attrs.get('units', '')}".rstrip()
    origin, second = dates
    return (origin + timedelta(seconds=t * second)).isoformat(sep=" ", timespec="seconds")


def instants(data: xr.Dataset, times: Any) -> Any:
    """Return times of a run as dates (a pandas index); None if it has none."""
    dates = dated(data)
    if dates is None:
        return None
    import pandas as pd

    origin, second = dates
    seconds = np.asarray(times, dtype=float) * second
    return pd.Timestamp(origin) + pd.to_timedelta(seconds, unit="s")
