"""Several tables of one process joined by time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.dates import origin_at, since_1970
from livepde.errors import DataError
from livepde.linalg import Array, Mask
from livepde.stepping import Between
from livepde.streams.table import DataTable

if TYPE_CHECKING:
    import pandas as pd

EARLY = "early"  # kind of the remark on readings before another file begins
PAUSE = 5.0  # usual intervals beyond which readings are far apart
SAME = 1e-10  # times that differ by less, relative to the total duration, are equal


def join_tables(
    tables: Sequence[DataTable],
    second: float,
    sensors: Collection[str],
    needed: Collection[str],
    where: str,
    between: Mapping[str, Between] | None = None,
    *,
    together: bool,
    profile: Collection[str] = (),
) -> DataTable:
    """Merge the rows of several tables in order of time; absent channels are missing values.

    The result begins with the first row in which a sensor has a value and all tables with inputs
    have begun. Inputs without a value in this row are interpolated linearly, or have their last or
    next value, according to `between`.

    `second`: one second in the unit of time.
    `sensors`: channels that are not interpolated.
    `needed`: channels without which a row is left out.
    `where`: name of the data, for messages.
    `between`: channel -> its behaviour between two readings; default "line".
    `together`: whether tables with only sensors must also have begun.
    `profile`: sensors of the initial profile. Their missing values in the first row are linearly
    interpolated, unless their readings before and after it are far apart.
    Raises `DataError`: some times are dates and some numbers; or the tables have no time in common.
    """
    times, first = _on_one_clock(tables, second, where)
    between = between or {}
    start, width = _common_start(tables, times, sensors, between, where, together=together)
    t, joined = _outer_join(tables, times, width)
    names, values = list(joined.columns), joined.to_numpy(copy=True)
    sensed, known = joined.columns.isin(list(sensors)), np.isfinite(values)
    usable = (t >= start - width) & known[:, sensed].any(axis=1)
    if not usable.any():
        raise DataError(
            f"{where}: no sensor has a value where all files have one; check the times."
        )
    begin = int(usable.argmax())
    kinds: Any = np.array([between.get(name, "line") for name in names])
    # A run needs all inputs at its start, where a slower logger may have no row.
    opened = ~sensed | joined.columns.isin(list(profile))
    for k in np.flatnonzero(opened & ~known[begin] & known.any(axis=0)):
        at = known[:, k]
        if not sensed[k] or _is_amid(t[begin], t[at]):
            values[begin, k] = _opening(t[begin], t[at], values[at, k], kinds[k])
    inputs = values[begin:, [names.index(name) for name in needed]]
    kept = np.isfinite(inputs).all(axis=1)
    if not kept.any():
        raise DataError(f"{where}: no row has all channels that it needs.")
    # A row that lacks needed channels still keeps its means and the changes of held inputs.
    held = kinds != "line"
    last = joined.ffill().shift().to_numpy()
    new = known & ((kinds == "next") | (joined.to_numpy() != last))
    states = new[begin:, held].any(axis=1) & (np.cumsum(kept) > 0) & ~kept
    values[begin:][np.ix_(states, ~held)] = np.nan
    kept |= states
    t, values, origin = t[begin:][kept], values[begin:][kept], None
    remarks = _counted("skipped", needed, np.isnan(inputs))
    remarks += _counted(EARLY, joined.columns[sensed], known[:begin, sensed])
    remarks = sum((Counter(table.remarks) for table in tables), remarks)
    if first is not None:
        t, origin = t - t[0], origin_at(first + t[0] / second)
    return DataTable(t, values, tuple(names), origin=origin, remarks=remarks)


def _common_start(
    tables: Sequence[DataTable],
    times: Sequence[Array],
    sensors: Collection[str],
    between: Mapping[str, Between],
    where: str,
    *,
    together: bool,
) -> tuple[float, float]:
    """Return the time at which all required tables have begun, and the tolerance of equal times.

    Refuses tables without a time in common; held inputs continue after their last reading.
    """
    starts, ends = np.transpose([(t[0], t[-1]) for t in times])
    holds = [all(between.get(name) == "hold" for name in table.names) for table in tables]
    if np.where(holds, np.inf, ends).min() < starts.max():
        raise DataError(f"{where}: the files have no time in common; check dates and units.")
    driving = [together or not {*table.names} <= {*sensors} for table in tables]
    start = starts[driving].max(initial=starts.min())
    return start, SAME * (ends.max() - starts.min()) or 1.0


def _counted(kind: str, names: Iterable[str], marked: Mask) -> Counter[tuple[str, str]]:
    """Count the marked rows of each column, shape (rows, columns); counts of zero are omitted."""
    counts = zip(names, marked.sum(axis=0).tolist(), strict=True)
    return Counter({(kind, name): n for name, n in counts if n})


def not_late(
    table: DataTable, late: Mapping[str, float], sensors: Collection[str]
) -> list[DataTable]:
    """Split a table so that the times of late channels can be corrected.

    A channel without values is not corrected. If the first reading of a late sensor is after the
    start of the channels, it has a missing value at their start; an input must be known there.

    `late`: channel -> delay of its times relative to its values, in the unit of the times.
    `sensors`: channels that may be missing.
    """
    seen = np.isfinite(table.values)
    late = {name: by for name, by in late.items() if seen[:, table.names.index(name)].any()}
    rest = [name not in late for name in table.names]
    names = tuple(compress(table.names, rest))
    found = [replace(table, values=table.values[:, rest], names=names)] if names else []
    start = table.t[0] - (0.0 if names else min(late.values()))
    for name, by in late.items():
        values = table.values[:, table.names.index(name)]
        known = np.isfinite(values)
        t, own = table.t[known] - by, values[known, None]
        if name in sensors and t[0] > start:
            t, own = np.append(start, t), np.vstack([np.full((1, 1), np.nan), own])
        found.append(replace(table, t=t, values=own, names=(name,), remarks={}))
    return found


def _is_amid(t: float, times: Array) -> bool:
    """Return whether a time is between two consecutive times that are not far apart."""
    k, steps = int(np.searchsorted(times, t)), np.diff(times)
    return bool(0 < k < len(times) and steps[k - 1] <= PAUSE * np.median(steps))


def _opening(t: float, times: Array, values: Array, between: Between) -> float:
    """Return the value of a channel at a time without a reading, NaN if it is unknown."""
    if between == "line":
        return float(np.interp(t, times, values))
    k = int(np.searchsorted(times, t))  # first later time
    if between == "hold":
        return float(values[k - 1]) if k else np.nan
    return float(values[k]) if k < len(values) else np.nan


def _on_one_clock(
    tables: Sequence[DataTable], second: float, where: str
) -> tuple[list[Array], float | None]:
    """Return the times of each table relative to the earliest origin, and this origin.

    The origin is in seconds since 1970, or None if times are numbers.
    """
    dated = [since_1970(table.origin) for table in tables if table.origin is not None]
    if not dated:
        return [table.t for table in tables], None
    if len(dated) < len(tables):
        raise DataError(f"{where}: the times of one file are dates and of another numbers.")
    first = min(dated)
    begun = zip(tables, dated, strict=True)
    return [table.t + (origin - first) * second for table, origin in begun], first


def _outer_join(
    tables: Sequence[DataTable], times: Sequence[Array], width: float
) -> tuple[Array, pd.DataFrame]:
    """Return the times of all rows in order, shape (rows,), and a column for each channel.

    Times in the same interval of length `width` are one row, with the time of the first table.
    """
    import pandas as pd  # slow to load, and not needed for a single table

    keys = [np.rint(t / width) for t in times]
    moments = pd.concat([pd.Series(t, index=key) for t, key in zip(times, keys, strict=True)])
    frames = [
        pd.DataFrame(table.values, index=key, columns=list(table.names))
        for table, key in zip(tables, keys, strict=True)
    ]
    t = np.asarray(moments.groupby(level=0).first(), dtype=np.float64)
    return t, pd.concat(frames, axis=1).sort_index()
