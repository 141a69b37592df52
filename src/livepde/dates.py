"""Conversion between times of a run and dates."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

CLOCKS = {"s": "seconds", "min": "minutes", "h": "hours", "d": "days", "day": "days"}
TIMES = ("time", "snapshot")  # coordinates of a dataset that are times
OWN = "units_of_run"  # attribute of a time with an epoch: the unit of time of the run

SECOND = np.timedelta64(1, "s")
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "day": 86400.0}


def origin_at(stamp: float) -> datetime:
    """Convert seconds since 1970 to an origin: a date in UTC without a zone."""
    return datetime.fromtimestamp(stamp, UTC).replace(tzinfo=None)


def since_1970(origin: datetime) -> float:
    """Convert an origin, a date in UTC without a zone, to seconds since 1970."""
    return origin.replace(tzinfo=UTC).timestamp()


def stamp_of(time: Any) -> float | None:
    """Convert a date to seconds since 1970; a date without zone is UTC. None for other values.

    >>> stamp_of(np.datetime64("1970-01-02")), stamp_of(3.0)
    (86400.0, None)
    """
    if isinstance(time, np.datetime64):
        return None if np.isnat(time) else float((time - np.datetime64(0, "s")) / SECOND)
    if not isinstance(time, datetime):
        return None
    try:
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except ValueError:  # pandas' NaT is a date
        return None


def dated(data: xr.Dataset) -> tuple[datetime, float] | None:
    """Return the date of t = 0 and the unit of time in seconds; None if times are numbers."""
    unit, origin = str(data["time"].attrs.get("units", "")), data.attrs.get("origin")
    if origin is None or unit not in SECONDS:
        return None
    return datetime.fromisoformat(str(origin)), SECONDS[unit]


def since(unit: str, origin: Any) -> dict[str, str]:
    """Return the CF attributes of times since a date; empty without a date or a known unit."""
    if origin is None or unit not in CLOCKS:
        return {}
    return {"units": f"{CLOCKS[unit]} since {origin}", "calendar": "standard"}


def with_epoch(data: xr.Dataset) -> xr.Dataset:
    """Return a dataset with CF attributes of its times, so that other programs read dates.

    The numbers do not change. The dataset of a run without dates is returned unchanged.
    """
    unit = str(data["time"].attrs.get("units", ""))
    attrs = since(unit, data.attrs.get("origin"))
    if not attrs:
        return data
    described = data.copy(deep=False)
    for name in TIMES:
        described[name] = described[name].copy(deep=False)
        described[name].attrs = {**described[name].attrs, **attrs, OWN: unit}
    return described


def without_epoch(data: xr.Dataset) -> xr.Dataset:
    """Undo `with_epoch` for a dataset that was read with its times as numbers."""
    if OWN not in data["time"].attrs:
        return data
    plain = data.copy(deep=False)
    for name in TIMES:
        if name in plain.coords:
            plain[name].attrs = {"units": data["time"].attrs[OWN]} if name == "time" else {}
    return plain


def when(data: xr.Dataset, t: float) -> str:
    """Format a time of a run, as a date if the run has dates."""
    dates = dated(data)
    if dates is None:
        return f"t = {t:.6g} {data['time'].attrs.get('units', '')}".rstrip()
    origin, second = dates
    return (origin + timedelta(seconds=t * second)).isoformat(sep=" ", timespec="seconds")


def instants(data: xr.Dataset, times: Any) -> Any:
    """Return times of a run as a pandas index of dates; None if the run has no dates."""
    dates = dated(data)
    if dates is None:
        return None
    import pandas as pd

    origin, second = dates
    seconds = np.asarray(times, dtype=float) * second
    return pd.Timestamp(origin) + pd.to_timedelta(seconds, unit="s")
