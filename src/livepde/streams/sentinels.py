"""Placeholders for missing readings: -127 of an unplugged sensor, 85 at power-on, -9999."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from livepde.linalg import Array

# DS18B20: 85 at power-on, -127 where nothing answers; loggers and databases: nines, ends of types.
KNOWN: tuple[float, ...] = (
    -127.0,
    85.0,
    -999.0,
    -9999.0,
    -99999.0,
    -99.9,
    -999.9,
    -9999.9,
    -6999.0,
    -7999.0,
)
KNOWN += (999.0, 9999.0, 99999.0, 99.9, 999.9, 9999.9, 6999.0, 7999.0, 32767.0, -32768.0, 65535.0)
REPEATED = 3  # times that another constant occurs
NEAR = 0.5  # of the range of the rest: a known sentinel lies farther outside
FAR = 1.0  # another constant lies farther outside than this
FEWEST = 8  # other values that show the range, and other levels of a constant
MOST = 4  # sentinels of a column


class Sentinel(NamedTuple):
    """A possible placeholder for missing readings: its frequency, and the range of the rest."""

    value: float
    times: int
    low: float
    high: float


def sentinels(values: Array) -> list[Sentinel]:
    """Return the values of a column that may be placeholders.

    >>> [found.value for found in sentinels(np.array([20.0, 21, 22, 21, 20, 22, 21, 23, -127]))]
    [-127.0]
    """
    rest, found = values[np.isfinite(values)], list[Sentinel]()
    while len(found) < MOST:
        one = next(filter(None, (_at(rest, end) for end in _ends(rest))), None)
        if one is None:
            break
        found.append(one)
        rest = rest[rest != one.value]
    # Ranges are those of the values that remain in the end.
    return [one._replace(low=float(rest.min()), high=float(rest.max())) for one in found]


def _ends(values: Array) -> list[float]:
    """Return the least and the largest value, the one that lies farther from the median first."""
    if not len(values):
        return []
    middle = float(np.median(values))
    return sorted((float(values.min()), float(values.max())), key=lambda x: -abs(x - middle))


def _at(values: Array, end: float) -> Sentinel | None:
    """Return an end of the range as a sentinel; None if it is none."""
    rest = values[values != end]
    count = len(values) - len(rest)
    known = end in KNOWN
    if len(rest) < FEWEST or not (known or count >= REPEATED):
        return None
    # Of a few levels, such as those of a pump, each is a constant.
    if not known and len(np.unique(rest)) < FEWEST:
        return None
    low, high = float(rest.min()), float(rest.max())
    beyond = max(low - end, end - high)
    # A constant rest has no range to compare with.
    if not 0.0 < (high - low) * (NEAR if known else FAR) < beyond:
        return None
    return Sentinel(end, count, low, high)
