"""Times of a run as dates, where it has them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

CLOCKS = {"s": "seconds", "min": "minutes", "h": "hours", "d": "days", "day": "days"}
TIMES = ("time", "snapshot")  # coordinates of a dataset that are times
OWN = "units_of_run"  # attribute of a time with an epoch: its unit as the run has it

SECOND = np.timedelta64(1, "s")
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "day": 86400.0}


def origin_at(stamp: float) -> datetime:
    """Return the date of seconds since 1970 as origins are kept: in UTC, without a zone."""
    return datetime.fromtimestamp(stamp, UTC).replace(tzinfo=None)


def since_1970(origin: datetime) -> float:
    """Return the seconds since 1970 of a date in UTC without a zone, as of `origin_at`."""
    return origin.replace(tzinfo=UTC).timestamp()


def stamp_of(time: Any) -> float | None:
    """Return the seconds since 1970 of a date, None of anything else; without a zone it is UTC.

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
    """Return the date of t = 0 and the seconds of a unit of time; None if times are numbers."""
    unit, origin = str(data["time"].attrs.get("units", "")), data.attrs.get("origin")
    if origin is None or unit not in SECONDS:
        return None
    return datetime.fromisoformat(str(origin)), SECONDS[unit]


def since(unit: str, origin: Any) -> dict[str, str]:
    """Return the CF attributes of times in a unit, counted from a date; none without a date."""
    if origin is None or unit not in CLOCKS:
        return {}
    return {"units": f"{CLOCKS[unit]} since {origin}", "calendar": "standard"}


def with_epoch(data: xr.Dataset) -> xr.Dataset:
    """Return a dataset whose times count from a date, so that other programs read dates.

    The numbers stay as they are. A run without dates is returned as it is.
    """
    unit = str(data["time"].attrs.get("units", ""))
    attrs = since(unit, data.attrs.get("origin"))
    if not attrs:
        return data
    found = data.copy(deep=False)
    for name in TIMES:
        found[name] = found[name].copy(deep=False)
        found[name].attrs = {**found[name].attrs, **attrs, OWN: unit}
    return found


def without_epoch(data: xr.Dataset) -> xr.Dataset:
    """Return a dataset of `with_epoch`, read with its times as numbers, as it was before."""
    if OWN not in data["time"].attrs:
        return data
    found = data.copy(deep=False)
    for name in TIMES:
        if name in found.coords:
            found[name].attrs = {"units": data["time"].attrs[OWN]} if name == "time" else {}
    return found


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
