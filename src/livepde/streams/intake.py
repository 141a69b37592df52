"""From rows as they come to samples in order: what is late, missing, doubled or broken is counted.

A source brings rows, column -> value, each with a time; one row need not hold all channels. Rows of
one moment make one sample. A sample is ready when a row has come that is later by more than `wait`:
so long rows may come in any order.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from livepde.errors import DataError
from livepde.streams.table import Clock, Column, channel_value, row_time

__all__ = ["Intake", "Policy", "Ready", "Refused"]


@dataclass(frozen=True)
class Policy:
    """What becomes of rows that do not come one by one in order.

    Parameters
    ----------
    wait
        Time for which a row may come after a later one; one that comes later still is refused.
    tolerance
        Rows whose times differ by at most so much are of one moment: that of the first.
    leap
        A row that is later than the newest one by more than this is refused, unless the next row
        agrees with it: a broken clock must not make all that follows too late.
    repeated
        Which value of a channel counts that comes twice for one moment.
    """

    wait: float = 0.0
    tolerance: float = 0.0
    leap: float = math.inf
    repeated: Literal["first", "last"] = "first"

    def __post_init__(self) -> None:
        for name in ("wait", "tolerance"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise DataError(f"intake: {name} must be a time >= 0; got {value}.")
        if self.repeated not in ("first", "last"):
            raise DataError(f"intake: repeated must be first or last; got {self.repeated!r}.")


@dataclass(frozen=True)
class Refused:
    """A value or row that is not used.

    Attributes
    ----------
    kind
        "malformed" (not what it should be), "late", "leap" (a time too far ahead), "repeated",
        "outside" (not between start and stop).
    channel
        Of the value; '' for a whole row.
    message
        In words.
    """

    kind: str
    channel: str
    message: str


@dataclass(frozen=True)
class Ready:
    """A sample that is complete.

    Attributes
    ----------
    t, values
        Time, and values of the channels that have come.
    tokens
        What the source gave with the rows of the sample, to acknowledge them.
    """

    t: float
    values: dict[str, float]
    tokens: tuple[Any, ...]


@dataclass
class _Open:
    values: dict[str, float] = field(default_factory=dict)
    tokens: list[Any] = field(default_factory=list)


class Intake:
    """Puts rows in order.

    Parameters
    ----------
    columns
        Channel -> where it comes from.
    clock
        How times are read.
    policy
        What becomes of rows out of order.
    missing
        Numbers that mean a missing value.
    origin
        Seconds since 1970 of t = 0 where times are dates; default the first row's.
    last
        Time of the last sample that was taken before, to go on after it.
    """

    def __init__(
        self,
        columns: Mapping[str, Column],
        clock: Clock,
        policy: Policy | None = None,
        *,
        missing: Iterable[float] = (),
        origin: float | None = None,
        last: float = -math.inf,
    ) -> None:
        self.columns = dict(columns)
        self.clock = clock
        self.policy = policy or Policy()
        self.missing = frozenset(float(number) for number in missing)
        self.origin = origin
        self.counts: Counter[tuple[str, str]] = Counter()
        self._last = last
        self._newest = last
        self._doubted = math.inf
        self._open: dict[float, _Open] = {}

    @property
    def start(self) -> datetime | None:
        """The date of t = 0, if times are dates."""
        if not self.origin:
            return None
        return datetime.fromtimestamp(self.origin, UTC).replace(tzinfo=None)

    @property
    def waiting(self) -> list[Any]:
        """Tokens of the rows that are in no sample yet."""
        return [token for sample in self._open.values() for token in sample.tokens]

    def take(self, row: Mapping[str, Any], token: Any = None) -> tuple[list[Ready], list[Refused]]:
        """Take a row; return the samples that are ready now, and what was refused."""
        refused: list[Refused] = []
        try:
            t = self._time(row)
        except DataError as error:
            return [], self._counted([Refused("malformed", "", str(error))])
        if t is None:
            return [], self._counted([Refused("outside", "", "not between start and stop")])
        if self._leaps(t):
            text = f"t = {t:g} is far ahead of the newest row at {self._newest:g}"
            return [], self._counted([Refused("leap", "", text)])
        values: dict[str, float] = {}
        for channel, column in self.columns.items():
            if not all(name in row for name in column.names):
                continue
            try:
                values[channel] = channel_value(column, row, self.missing)
            except DataError as error:
                refused.append(Refused("malformed", channel, str(error)))
        moment = self._moment(t)
        if moment is None:
            text = f"t = {t:g} is not later than the last sample at {self._last:g}"
            refused += [Refused("late", channel, text) for channel in values]
        elif values:
            self._add(moment, values, token, refused)
        self._newest = max(self._newest, t)
        return list(self._ready()), self._counted(refused)

    def flush(self) -> list[Ready]:
        """Return all samples that are still open: nothing more will come."""
        self._newest = math.inf
        return list(self._ready())

    def _counted(self, refused: list[Refused]) -> list[Refused]:
        self.counts.update((item.kind, item.channel) for item in refused)
        return refused

    def _time(self, row: Mapping[str, Any]) -> float | None:
        """Return the time of a row, None if it is outside of what is used."""
        t, dates = row_time(row, self.clock)
        low, high = self.clock.bounds(dates, "data")
        if not low <= t <= high:
            return None
        if self.origin is None:
            self.origin = t / self.clock.second if dates else 0.0
        return t - self.origin * self.clock.second if dates else t

    def _leaps(self, t: float) -> bool:
        """Return whether a row is too far ahead, and no other has said so just before."""
        doubted, self._doubted = self._doubted, math.inf
        ahead = t - self._newest > self.policy.leap and math.isfinite(self._newest)
        if ahead and not abs(t - doubted) <= self.policy.leap:
            self._doubted = t
            return True
        return False

    def _moment(self, t: float) -> float | None:
        """Return the moment that a time belongs to, None if that is past."""
        near = [s for s in self._open if abs(s - t) <= self.policy.tolerance]
        if near:
            return min(near, key=lambda s: abs(s - t))
        return t if t > self._last + self.policy.tolerance else None

    def _add(
        self, moment: float, values: Mapping[str, float], token: Any, refused: list[Refused]
    ) -> None:
        sample = self._open.setdefault(moment, _Open())
        sample.tokens.append(token)
        for channel, value in values.items():
            known = sample.values.get(channel, math.nan)
            if not math.isnan(known):
                text = f"a second value for t = {moment:g}: {value:g} after {known:g}"
                refused.append(Refused("repeated", channel, text))
                if self.policy.repeated == "first":
                    continue
            sample.values[channel] = value

    def _ready(self) -> Iterator[Ready]:
        for t in sorted(self._open):
            complete = self.policy.wait == 0.0 and len(self._open[t].values) == len(self.columns)
            passed = t + self.policy.tolerance + self.policy.wait < self._newest
            if not (passed or complete):
                return
            sample = self._open.pop(t)
            self._last = t
            yield Ready(t, sample.values, tuple(sample.tokens))
