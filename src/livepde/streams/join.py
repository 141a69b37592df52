"""Several tables of one process joined by time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np
import pandas as pd

from livepde.errors import DataError
from livepde.linalg import Array
from livepde.streams.clock import origin_at, since_1970
from livepde.streams.table import DataTable

__all__ = ["join_tables"]

SAME = 1e-10  # of the whole time: times that differ by less are one moment


def join_tables(
    tables: Sequence[DataTable],
    second: float,
    sensors: Collection[str],
    needed: Collection[str],
    where: str,
) -> DataTable:
    """Merge the rows of several tables in order of time; absent channels are missing values.

    The result begins with the first row in which a sensor has a value and before which every
    table has begun. Other channels without a value in that row have the one that a line between
    their neighbours gives.

    Parameters
    ----------
    second
        One second in the unit of time.
    sensors
        Channels that are not interpolated.
    needed
        Channels without which a row is left out.
    where
        Name of the data, for messages.

    Raises
    ------
    DataError
        Some times are dates and some numbers; or the tables have no time in common.
    """
    origins = [table.origin for table in tables]
    dated = [origin for origin in origins if origin is not None]
    if 0 < len(dated) < len(tables):
        raise DataError(f"{where}: the times of one file are dates and of another numbers.")
    first = min(map(since_1970, dated), default=0.0)
    shifts = [0.0 if o is None else (since_1970(o) - first) * second for o in origins]
    times = [table.t + shift for table, shift in zip(tables, shifts, strict=True)]
    start, stop = max(t[0] for t in times), min(t[-1] for t in times)
    if stop < start:
        raise DataError(f"{where}: the files have no time in common; check dates and units.")
    whole = max(t[-1] for t in times) - min(t[0] for t in times)
    width = SAME * whole or 1.0
    keys = [np.rint(time / width) for time in times]
    moments = pd.concat([pd.Series(t, index=key) for t, key in zip(times, keys, strict=True)])
    frames = [
        pd.DataFrame(table.values, index=key, columns=list(table.names))
        for table, key in zip(tables, keys, strict=True)
    ]
    joined = pd.concat(frames, axis=1).sort_index()
    t: Array = np.asarray(moments[~moments.index.duplicated()].sort_index(), dtype=float)
    names, values = list(joined.columns), joined.to_numpy(copy=True)
    seen = np.array([name in sensors for name in names])
    usable = (t >= start - width) & np.isfinite(values[:, seen]).any(axis=1)
    if not usable.any():
        raise DataError(
            f"{where}: no sensor has a value where all files have one; check the times."
        )
    begin = int(usable.argmax())
    for k in np.flatnonzero(~seen & np.isnan(values[begin])):
        known = np.isfinite(values[:, k])
        if known.any():
            values[begin, k] = np.interp(t[begin], t[known], values[known, k])
    values, t = values[begin:], t[begin:]
    remarks: Counter[tuple[str, str]] = Counter()
    for name in needed:
        remarks["skipped", name] = int(np.isnan(values[:, names.index(name)]).sum())
    kept = np.isfinite(values[:, [names.index(name) for name in needed]]).all(axis=1)
    if not kept.any():
        raise DataError(f"{where}: no row has all channels that it needs.")
    values, t = values[kept], t[kept]
    for table in tables:
        remarks.update(table.remarks)
    origin = origin_at(first + float(t[0]) / second) if dated else None
    told = {key: number for key, number in remarks.items() if number}
    return DataTable(t - t[0] if dated else t, values, tuple(names), origin, told)
