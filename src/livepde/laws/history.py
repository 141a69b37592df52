"""Log of the samples of all members to which a law may return; rows are only appended.

A log has the shape (members, rows, 2 + 2 sensors + 2 channels). Its columns are: time; readings;
their noise (NaN: noise of the sensor); inputs; time for which each input has been held without a
reading; number of parts into which the substeps since the row before were divided. The time is NaN
in a row of a member that did not assimilate the sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from livepde.fem import Inputs
from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import End, Interval, Span, gaps_of, own_noise

SPARE = np.inf  # time of unused rows of a buffer
ROWS = 64  # least number of rows of a buffer


def empty_log(sensors: int, channels: int) -> Array:
    """Return a log of one member without rows."""
    return np.zeros((1, 0, 2 + 2 * sensors + 2 * channels))


def _inputs(log: Array, sensors: int) -> tuple[slice, slice]:
    """Return the columns of the inputs of a log, and of the times for which they were held."""
    first = 1 + 2 * sensors
    middle = first + (log.shape[2] - 1 - first) // 2
    return slice(first, middle), slice(middle, -1)


def opened(log: Array, span: Span) -> Array:
    """Return a log with a row for the start of a span, unless it has rows."""
    if log.shape[1]:
        return log
    begun = _extended(log)
    row, sensors = begun[:, -1], span.z1.shape[1]
    row[:] = np.nan
    row[:, 0] = span.t0
    inputs, held = _inputs(log, sensors)
    # Validation sensors of a fleet may use additional channels, which come last.
    row[:, inputs] = span.inputs0[:, : inputs.stop - inputs.start]
    row[:, held], row[:, -1] = 0.0, 1.0
    return begun


def added(log: Array, span: Span, taken: Mask, parts: IntArray) -> Array:
    """Return a log with a row for the sample at the end of a span, for the members `taken`."""
    longer = _extended(log)
    row, sensors = longer[:, -1], span.z1.shape[1]
    row[:, 0] = span.t1
    row[:, 1 : 1 + sensors] = span.z1
    row[:, 1 + sensors : 1 + 2 * sensors] = np.nan if span.noise is None else span.noise
    inputs, held = _inputs(log, sensors)
    known = inputs.stop - inputs.start
    row[:, inputs] = span.stated[:, :known]
    row[:, held], row[:, -1] = 0.0, parts
    if span.gaps is not None:
        before, missing = span.gaps[:, 0, :known], span.gaps[:, 1, :known]
        row[:, held] = missing * (before + (span.t1 - span.t0)[:, None])
    if np.count_nonzero(taken) < len(taken):
        row[~taken] = np.nan
    return longer


def skipped(log: Array) -> Array:
    """Return a log with an empty row, for a sample that no member assimilated."""
    longer = _extended(log)
    longer[:, -1] = np.nan
    return longer


def _extended(log: Array) -> Array:
    """Return a log with an additional row in a shared buffer or a copy; write the row at once."""
    # A time other than SPARE shows that another log with the same first rows uses the next row.
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


def withdrawn(log: Array, sensors: Mask, since: Array) -> Array:
    """Return a log without the readings of given sensors since given times."""
    removed = sensors[:, None] & (log[:, :, :1] >= since[:, None])
    readings = log[:, :, 1 : 1 + sensors.shape[1]]
    if np.isnan(readings[removed]).all():
        return log
    copy = log.copy()
    copy[:, :, 1 : 1 + sensors.shape[1]][removed] = np.nan
    return copy


def trimmed(log: Array, first: int) -> Array:
    """Return a copy of a log that begins at row `first`."""
    return log[:, first:].copy()


class LogRows(NamedTuple):
    """Rows of one member that have a time, as arrays whose first axis is the rows."""

    times: Array
    readings: Array
    noise: Array  # NaN: noise of the sensor
    inputs: Array
    held: Array  # time for which each input has been held without a reading
    parts: IntArray

    @classmethod
    def of(cls, log: Array, sensors: int) -> LogRows:
        """Return the rows of a log of one member."""
        rows, (inputs, held) = log[0][np.isfinite(log[0, :, 0])], _inputs(log, sensors)
        return cls(
            times=rows[:, 0],
            readings=rows[:, 1 : 1 + sensors],
            noise=rows[:, 1 + sensors : inputs.start],
            inputs=rows[:, inputs],
            held=rows[:, held],
            parts=rows[:, -1].astype(int),
        )


def _rows(log: Array, channels: tuple[str, ...]) -> list[End]:
    rows = LogRows.of(log, (log.shape[2] - 2 - 2 * len(channels)) // 2)
    ends, before = list[End](), [0.0] * len(channels)
    for t, z, noise, inputs, held, parts in zip(*rows, strict=True):
        named = Inputs(dict(zip(channels, inputs.tolist(), strict=True)))
        gaps, now = {}, held.tolist()
        if any(before) or (any(now) and ends):
            gaps = gaps_of(channels, before, now)
        before = now
        own = own_noise(noise)
        end = End(t=float(t), inputs=named, z=z, noise=own, gaps=gaps, parts=int(parts))
        ends.append(end)
    return ends


def first_interval(log: Array, channels: tuple[str, ...]) -> Interval:
    """Return the first row of one member as an interval of length zero."""
    (row,) = _rows(log[:, :1], channels)
    return Interval.between(row, row)


def intervals_since(log: Array, channels: tuple[str, ...]) -> list[Interval]:
    """Return the intervals between the rows of one member, in time order."""
    return [Interval.between(first, last) for first, last in pairwise(_rows(log, channels))]


def reaching(shown: Sequence[bool] | Mask, readings: int) -> int:
    """Return the number of last samples among which `readings` have a reading, or of all."""
    places = np.flatnonzero(shown)
    return len(shown) - int(places[max(len(places) - readings, 0)])


def changing(intervals: Sequence[Interval], number: int) -> range:
    """Return the intervals at whose starts a change in interval `number` may act.

    A change within an interval acts in part at its start and in part at its end. Without readings
    at its ends, it cannot be told from a change in a neighbour.
    """
    shown = [bool(interval.present.any()) for interval in intervals]
    first = number
    while first and not shown[first - 1]:
        first -= 1
    return range(first, shown.index(True, number) + 2)
