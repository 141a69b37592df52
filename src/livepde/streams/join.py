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
PAUSE = 5.0  # usual intervals, beyond which readings are far apart
SAME = 1e-10  # of the whole time: times that differ by less are one moment


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

    The result begins with the first row in which a sensor has a value and before which every
    table with inputs has begun. Other channels without a value in that row have the one that their
    neighbours give: on a line, or the last or the next one.

    `second`: one second in the unit of time.
    `sensors`: channels that are not interpolated.
    `needed`: channels without which a row is left out.
    `where`: name of the data, for messages.
    `between`: channel -> how it behaves between two readings; a line if it is left out.
    `together`: the tables of sensors must have begun, too.
    `profile`: sensors that an initial profile is made of. In the first row they have the value on
    the line between their readings before and after it, unless these are far apart.
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
    # A run needs each input at its start, where a slower logger may have no row.
    opened = ~sensed | joined.columns.isin(list(profile))
    for k in np.flatnonzero(opened & ~known[begin] & known.any(axis=0)):
        at = known[:, k]
        if not sensed[k] or _is_amid(t[begin], t[at]):
            values[begin, k] = _opening(t[begin], t[at], values[at, k], kinds[k])
    inputs = values[begin:, [names.index(name) for name in needed]]
    kept = np.isfinite(inputs).all(axis=1)
    if not kept.any():
        raise DataError(f"{where}: no row has all channels that it needs.")
    # A row that is left out keeps the means that it states, and what changes of inputs that hold.
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
    """Return when all tables that have to have begun, and by how little one moment may differ.

    Refuses tables without a time in common; what holds continues after its last reading.
    """
    starts, ends = np.transpose([(t[0], t[-1]) for t in times])
    holds = [all(between.get(name) == "hold" for name in table.names) for table in tables]
    if np.where(holds, np.inf, ends).min() < starts.max():
        raise DataError(f"{where}: the files have no time in common; check dates and units.")
    driving = [together or not {*table.names} <= {*sensors} for table in tables]
    start = starts[driving].max(initial=starts.min())
    return start, SAME * (ends.max() - starts.min()) or 1.0


def _counted(kind: str, names: Iterable[str], marked: Mask) -> Counter[tuple[str, str]]:
    """Return how many rows of each column are marked, (rows, columns), where any is."""
    counts = zip(names, marked.sum(axis=0).tolist(), strict=True)
    return Counter({(kind, name): n for name, n in counts if n})


def not_late(
    table: DataTable, late: Mapping[str, float], sensors: Collection[str]
) -> list[DataTable]:
    """Return a table as several, in which the times of late channels are earlier.

    A channel without values stays where it is. A sensor whose times are early has no value at the
    start of the others, which begin as before; an input has to be known from the start.

    `late`: channel -> how much later than its values its times are, in the unit of the times.
    `sensors`: channels that may be missing.
    """
    seen = np.isfinite(table.values)
    late = {name: by for name, by in late.items() if seen[:, table.names.index(name)].any()}
    rest = [name not in late for name in table.names]
    names = tuple(compress(table.names, rest))
    found = [replace(table, values=table.values[:, rest], names=names)] if names else []
    for name, by in late.items():
        values = table.values[:, table.names.index(name)]
        known = np.isfinite(values)
        t, own = table.t[known] - by, values[known, None]
        if names and name in sensors and t[0] > table.t[0]:
            t, own = np.append(table.t[:1], t), np.vstack([np.full((1, 1), np.nan), own])
        found.append(replace(table, t=t, values=own, names=(name,), remarks={}))
    return found


def _is_amid(t: float, times: Array) -> bool:
    """Return whether a time is between two of several, which are not far apart."""
    k, steps = int(np.searchsorted(times, t)), np.diff(times)
    return bool(0 < k < len(times) and steps[k - 1] <= PAUSE * np.median(steps))


def _opening(t: float, times: Array, values: Array, between: Between) -> float:
    """Return the value of a channel at a time where it has none."""
    if between == "line":
        return float(np.interp(t, times, values))
    k = int(np.searchsorted(times, t))  # the first one later
    if between == "hold":
        return float(values[k - 1]) if k else np.nan
    return float(values[k]) if k < len(values) else np.nan


def _on_one_clock(
    tables: Sequence[DataTable], second: float, where: str
) -> tuple[list[Array], float | None]:
    """Return the times of each table, and the date from which all count: the earliest origin.

    The date is in seconds since 1970, or None where times are numbers.
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

    Times that fall into one interval of this width are one row, with the first table's time.
    """
    import pandas as pd  # slow to load, and a single table needs none

    keys = [np.rint(t / width) for t in times]
    moments = pd.concat([pd.Series(t, index=key) for t, key in zip(times, keys, strict=True)])
    frames = [
        pd.DataFrame(table.values, index=key, columns=list(table.names))
        for table, key in zip(tables, keys, strict=True)
    ]
    t = np.asarray(moments.groupby(level=0).first(), dtype=np.float64)
    return t, pd.concat(frames, axis=1).sort_index()
