"""The samples since a law may have to begin again, of all members: a log that only grows.

A log has the shape (members, rows, 1 + sensors + channels): time, measurements and inputs. Rows
of a member that did not take a sample have the time NaN.
"""

from __future__ import annotations

import numpy as np

from livepde.fem import Inputs
from livepde.laws.base import Problem
from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import Interval, Span

__all__ = [
    "added",
    "empty_log",
    "first_interval",
    "following",
    "intervals_since",
    "opened",
    "skipped",
    "span_between",
    "trimmed",
]

SPARE = np.inf  # time of rows that are not in use
ROWS = 64  # least room of a log


def empty_log(members: int, sensors: int, channels: int) -> Array:
    """Return a log without rows."""
    return np.zeros((members, 0, 1 + sensors + channels))


def opened(log: Array, span: Span) -> Array:
    """Return a log that begins at the start of a span, unless it has begun."""
    if log.shape[1]:
        return log
    begun = _extended(log)
    row, sensors = begun[:, -1], span.z1.shape[1]
    row[:] = np.nan
    row[:, 0] = span.t0
    # Withheld sensors of a fleet may read more channels, which come last.
    row[:, 1 + sensors :] = span.inputs0[:, : log.shape[2] - 1 - sensors]
    return begun


def added(log: Array, span: Span, taken: Mask) -> Array:
    """Return a log with the sample at the end of a span, of those members that took it."""
    longer = _extended(log)
    row, sensors = longer[:, -1], span.z1.shape[1]
    row[:, 0] = span.t1
    row[:, 1 : 1 + sensors] = span.z1
    row[:, 1 + sensors :] = span.inputs1[:, : log.shape[2] - 1 - sensors]
    row[~taken] = np.nan
    return longer


def skipped(log: Array) -> Array:
    """Return a log with a sample that nobody took."""
    longer = _extended(log)
    longer[:, -1] = np.nan
    return longer


def _extended(log: Array) -> Array:
    """Return a log with one more row, to be written at once.

    Logs share a buffer: the row is where no log has written yet, else in a copy.
    """
    rows, buffer = log.shape[1], log.base
    if (
        not isinstance(buffer, np.ndarray)
        or buffer.ndim != 3
        or buffer.shape[1] <= rows
        or buffer[0, rows, 0] != SPARE
    ):
        room = max(ROWS, 2 * rows)
        buffer = np.full((log.shape[0], room, log.shape[2]), SPARE)
        buffer[:, :rows] = log
    return buffer[:, : rows + 1]


def trimmed(log: Array, first: int) -> Array:
    """Return a log from a row on."""
    return log[:, first:].copy()


def _rows(log: Array, sensors: int) -> list[tuple[float, Array, Array]]:
    """Return time, measurements and inputs of the rows of the one member of a log."""
    taken = log[0][np.isfinite(log[0, :, 0])]
    return [(float(row[0]), row[1 : 1 + sensors], row[1 + sensors :]) for row in taken]


def first_interval(log: Array, channels: tuple[str, ...]) -> Interval:
    """Return what one member measured in the first row, as an interval without length."""
    sensors = log.shape[2] - 1 - len(channels)
    ((t, z, inputs),) = _rows(log[:, :1], sensors)
    named = Inputs(dict(zip(channels, inputs.tolist(), strict=True)))
    return Interval(t, t, named, named, z, z)


def intervals_since(log: Array, channels: tuple[str, ...]) -> list[Interval]:
    """Return the intervals between the rows of one member, in time order."""
    sensors = log.shape[2] - 1 - len(channels)
    rows = _rows(log, sensors)
    named = [Inputs(dict(zip(channels, row[2].tolist(), strict=True))) for row in rows]
    return [
        Interval(rows[k - 1][0], rows[k][0], named[k - 1], named[k], rows[k - 1][1], rows[k][1])
        for k in range(1, len(rows))
    ]


def following(log: Array, row: int) -> int:
    """Return the next row of one member, shape (rows, ...), that it took; their number if none."""
    row += 1
    while row < len(log) and not np.isfinite(log[row, 0]):
        row += 1
    return row


def span_between(log: Array, rows: IntArray, row: int, problem: Problem) -> Span:
    """Return what members measured in one row, with one row before of each, as an interval."""
    sensors = problem.observed.size
    first, last = log[np.arange(len(log)), rows], log[:, row]
    inputs0, inputs1 = first[:, 1 + sensors :], last[:, 1 + sensors :]
    if problem.control.hold:
        inputs0 = inputs1
    z0, z1 = first[:, 1 : 1 + sensors], last[:, 1 : 1 + sensors]
    return Span(first[:, 0], float(last[0, 0]), problem.channels, inputs0, inputs1, z0, z1)
