"""Intake of rows into samples in order; late, missing, doubled and broken ones are counted.

A source brings rows, column -> value, each with a time; one row need not hold all channels. Rows of
one moment make one sample. A sample is ready when a row has come that is later by more than `wait`:
so long rows may come in any order.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import pairwise
from statistics import median
from typing import Any, Literal, Protocol

from livepde.errors import DataError, SampleError
from livepde.streams.clock import Clock, is_naive, origin_at, since_1970
from livepde.streams.gaps import BEYOND, RECENT, Series, decided
from livepde.streams.table import Column, channel_value, row_time, without_noise

__all__ = ["Habit", "Intake", "IntakeOutcome", "Past", "Policy", "Ready", "Remark", "gather"]


@dataclass(frozen=True)
class Habit:
    """How one channel arrives.

    Parameters
    ----------
    wait
        A sample without this channel waits so long for it, if that is longer than `Policy.wait`.
    repeated
        Which value counts that comes twice for one moment; default that of the policy.
    interpolated
        A sample without this channel takes a value interpolated from the next one, if that comes
        while the sample waits; it waits no longer then.
    screened
        A spike is refused, if two later values have come while the sample waited.
    """

    wait: float = 0.0
    repeated: Literal["first", "last"] | None = None
    interpolated: bool = False
    screened: bool = False


@dataclass(frozen=True)
class Policy:
    """What becomes of rows that do not come one by one, in order and complete.

    Parameters
    ----------
    wait
        Time for which a row may come after a later one; one that comes later still is refused.
    tolerance
        Rows whose times differ by at most so much are of one moment: that of the first.
    leap
        A row that is later than the newest one by more than this, or by more than a hundred times
        the longest but one of the last steps, waits for the next one: it is refused, unless that
        is later still, and by at most `leap`.
    repeated
        Which value of a channel counts that comes twice for one moment.
    channels
        Channel -> what is special about it.
    """

    wait: float = 0.0
    tolerance: float = 0.0
    leap: float = math.inf
    repeated: Literal["first", "last"] = "first"
    channels: Mapping[str, Habit] = field(default_factory=dict)

    def __post_init__(self) -> None:
        waits = {f"wait of '{name}'": habit.wait for name, habit in self.channels.items()}
        for name, value in {"wait": self.wait, "tolerance": self.tolerance, **waits}.items():
            if not (math.isfinite(value) and value >= 0):
                raise DataError(f"intake: {name} must be a time >= 0; got {value}.")
        for choice in (self.repeated, *(habit.repeated for habit in self.channels.values())):
            if choice not in ("first", "last", None):
                raise DataError(f"intake: repeated must be first or last; got {choice!r}.")

    def keeps(self, channel: str) -> Literal["first", "last"]:
        """Return which of two values of a channel counts."""
        return self.habit(channel).repeated or self.repeated

    def habit(self, channel: str) -> Habit:
        """Return the options of a channel."""
        return self.channels.get(channel, PLAIN)


STEPS = 16  # between rows, that have to be known to know what is usual
LONG = 100.0  # usual steps, after which a row is far ahead
AGREE = 5  # rows too late that agree with each other are believed rather than the clock
INSIST = (
    50  # of them, where no sample was taken at their times: they may be the backlog of a logger
)
PLAIN = Habit()
NAN = math.nan


@dataclass(frozen=True)
class Remark:
    """Something about a row, a value or a sample that is worth counting.

    Attributes
    ----------
    kind
        Not used: "malformed" (not what it should be), "invalid" (a value outside of what is
        valid), "spike", "late", "leap" (a time too far ahead), "repeated", "outside" (not between
        start and stop), "skipped" (a sample without what it must have); of a whole row "repeated"
        means that it was taken before, with the same values. "clock": rows have shown that the
        clock was wrong or set back. Used all the same:
        "disordered" (came after a later one), "missing" (a sample without this channel),
        "interpolated" (the same, and its value lies between known ones).
    channel
        Of the value; '' for a whole row.
    message
        In words; of several the first's.
    number
        How often.
    row
        Token of the row that it is about, the last one of a sample.
    """

    kind: str
    channel: str
    message: str
    number: int = 1
    row: Any = None


def gather(found: dict[tuple[str, str], Remark], remark: Remark) -> None:
    """Add a remark to those of its kind and channel: the first one's words, and their number."""
    key = remark.kind, remark.channel
    same = found.get(key)
    found[key] = remark if same is None else replace(same, number=same.number + remark.number)


@dataclass(frozen=True)
class Ready:
    """A sample that is complete.

    Attributes
    ----------
    t, values
        Time, and values of the channels that have come.
    tokens
        What the source gave with the rows of the sample, to acknowledge them.
    since
        All samples later than this are wrong, and to be taken back before this one is taken: a
        clock has been wrong. None: all are right.
    """

    t: float
    values: dict[str, float]
    tokens: tuple[Any, ...]
    since: float | None = None


@dataclass
class IntakeOutcome:
    """What has become of a row: samples that are ready, remarks, tokens that are done with.

    `row` is the token of the row, which remarks are about unless they say so.
    """

    ready: list[Ready] = field(default_factory=list)
    remarks: list[Remark] = field(default_factory=list)
    spent: list[Any] = field(default_factory=list)
    row: Any = None

    def remark(self, kind: str, channel: str, message: str, row: Any = None) -> None:
        """Add a remark, about the row that was taken or another one."""
        about = self.row if row is None else row
        self.remarks.append(Remark(kind, channel, message, row=about))


class Past(Protocol):
    """The samples that were taken: they tell a row that is late from a clock that is wrong."""

    def between(self, low: float, high: float) -> Sequence[tuple[float, Mapping[str, float]]]:
        """Return some of the samples from one time to another, nothing where none is kept."""

    def returns_to(self, t: float) -> bool:
        """Return whether all samples later than a time can be taken back."""


@dataclass(frozen=True)
class _Held:
    """A row that waits until others have shown whether its time is right."""

    t: float
    row: Mapping[str, Any]
    token: Any


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
    dates
        Whether times are dates; default as in the first row.
    last
        Time of the last sample that was taken before, to go on after it.
    recent
        Times and values of the last samples that were taken before, for channels that are
        interpolated or screened.
    shift
        What is added to the times of rows: by so much the clock has been set back.

    Attributes
    ----------
    past
        The samples that were taken, to know a clock that is wrong; None: what is late is late.
    anchors
        Token of the first row for which another shift holds, and the shift; oldest first.
    """

    def __init__(
        self,
        columns: Mapping[str, Column],
        clock: Clock,
        policy: Policy | None = None,
        *,
        missing: Iterable[float] = (),
        origin: float | None = None,
        dates: bool | None = None,
        last: float = -math.inf,
        recent: Iterable[tuple[float, Mapping[str, float]]] = (),
        shift: float = 0.0,
    ) -> None:
        self.columns = dict(columns)
        self.clock = clock
        self.policy = policy or Policy()
        self.missing = frozenset(float(number) for number in missing)
        self.origin = origin
        self._dates = dates
        self._last = last
        self._newest = last
        self._doubted: _Held | None = None
        self._pending: list[_Held] = []
        self._steps: deque[float] = deque(maxlen=STEPS)  # from one row to a later one
        self._released: deque[float] = deque([last], maxlen=2 * INSIST)
        self._since: float | None = None
        self.shift = shift
        self.past: Past | None = None
        self.anchors: list[tuple[Any, float]] = []
        self._open: dict[float, _Open] = {}
        self._recent = deque(recent, maxlen=RECENT)

    @property
    def start(self) -> datetime | None:
        """The date of t = 0, if times are dates."""
        if self.origin is None or not self._dates:
            return None
        return origin_at(self.origin)

    @property
    def waiting(self) -> list[Any]:
        """Tokens of the rows that are in no sample yet."""
        held = [*self._pending, *([self._doubted] if self._doubted else [])]
        found = [token for sample in self._open.values() for token in sample.tokens]
        return found + [one.token for one in held]

    def take(self, row: Mapping[str, Any], token: Any = None) -> IntakeOutcome:
        """Take a row; return what becomes of it and of those before it."""
        found = IntakeOutcome(row=token)
        try:
            t = self._time(row)
        except DataError as error:
            found.remark("malformed", "", str(error))
        else:
            if t is None:
                found.remark("outside", "", "not between start and stop")
            elif self._judged(_Held(t, row, token), found):
                self._release(found)
                return found
        found.spent.append(token)
        self._release(found)
        return found

    def _judged(self, held: _Held, found: IntakeOutcome) -> bool:
        """Return whether a row is used or waits; a leap and what is too late wait for others."""
        if self._leaps(held.t):
            self._doubt(held, found)
            return True
        if self._doubted is not None:
            self._refuse_leap(found)
        if self.past is not None and self._late(held.t):
            return self._pends(held, self.past, found)
        self._give_up(found)
        return self._placed(held, found)

    def _leaps(self, t: float) -> bool:
        """Return whether a row is too far ahead of the newest one."""
        return t - self._newest > min(self.policy.leap, self._long) and math.isfinite(self._newest)

    @property
    def _long(self) -> float:
        """A hundred times the longest step but one; infinite if too few are known."""
        return LONG * sorted(self._steps)[-2] if len(self._steps) == STEPS else math.inf

    def _doubt(self, held: _Held, found: IntakeOutcome) -> None:
        """Take a row that is too far ahead if the one before said so, too; else let it wait."""
        self._give_up(found)
        before = self._doubted
        if before is not None and 0.0 <= held.t - before.t <= self.policy.leap:
            self._doubted = None
            for one in (before, held):
                if not self._placed(one, found):
                    found.spent.append(one.token)
            return
        if before is not None:
            self._refuse_leap(found)
        self._doubted = held

    def _refuse_leap(self, found: IntakeOutcome) -> None:
        held, self._doubted = self._doubted, None
        if held is not None:
            text = f"t = {held.t:g} is far ahead of the newest row at {self._newest:g}"
            found.remark("leap", "", text, held.token)
            found.spent.append(held.token)

    def _late(self, t: float) -> bool:
        return self._moment(t) is None

    def _pends(self, held: _Held, past: Past, found: IntakeOutcome) -> bool:
        """Return whether a row that is too late is used or waits for others that agree with it.

        One that has been taken before is known by time and values: a source says again what it
        has said. Others that follow one another say that the clock had been wrong, or was set
        back.
        """
        values = self._values(held.row, IntakeOutcome())
        near = past.between(held.t - self.policy.tolerance, held.t + self.policy.tolerance)
        if not values or any(_same(values, known) for _, known in near):
            self._give_up(found)
            if not values:
                return self._placed(held, found)
            text = f"t = {held.t:g} has been taken with the same values before"
            found.remark("repeated", "", text)
            return False
        if self._pending and not 0.0 <= held.t - self._pending[-1].t <= self._long:
            self._give_up(found)
        self._pending.append(held)
        if len({one.t for one in self._pending}) >= AGREE:
            self._anchor(past, found)
        return True

    def _give_up(self, found: IntakeOutcome) -> None:
        """Refuse the rows that were too late and have not convinced."""
        pending, self._pending = self._pending, []
        for held in pending:
            if not self._placed(held, found):
                found.spent.append(held.token)

    def _anchor(self, past: Past, found: IntakeOutcome) -> None:
        """Believe rows that agree with each other, if that is what they say."""
        first, count = self._pending[0].t, len({one.t for one in self._pending})
        earlier = [t for t in self._released if t < first]
        wrong = len(self._released) - len(earlier) + len(self._open)
        if wrong <= AGREE and earlier and past.returns_to(earlier[-1]):
            text = (
                f"{count} rows from t = {first:g} on agree with each other: the clock had been "
                f"wrong, and {wrong} samples later than t = {earlier[-1]:g} are taken back"
            )
            self._go_back(earlier, found)
        elif count >= INSIST or self._covered(past):
            shift = self._newest + self._usual - first
            self.shift += shift
            text = (
                f"{count} rows from t = {first:g} on repeat times that have been: the clock was "
                f"set back by {shift:g}, which is added to all times from now on"
            )
            self._pending = [replace(one, t=one.t + shift) for one in self._pending]
            self.anchors.append((self._pending[0].token, self.shift))
        else:
            return
        pending, self._pending = self._pending, []
        found.remark("clock", "", text)
        for held in pending:
            if not self._placed(held, found):
                found.spent.append(held.token)

    @property
    def _usual(self) -> float:
        """The usual step of the rows, as those that wait have it."""
        gaps = [b.t - a.t for a, b in pairwise(self._pending) if b.t > a.t]
        return float(median(gaps))

    def _covered(self, past: Past) -> bool:
        """Return whether samples with these channels are as late as the rows that wait."""
        named = {name for one in self._pending for name in self._values(one.row, IntakeOutcome())}
        return any(
            not all(math.isnan(known.get(name, NAN)) for name in named)
            for _, known in past.between(self._pending[0].t, self._pending[-1].t)
        )

    def _go_back(self, earlier: list[float], found: IntakeOutcome) -> None:
        """Forget all that is later than the first row that waits."""
        for sample in self._open.values():
            found.spent += sample.tokens
        self._open.clear()
        self._released = deque(earlier, maxlen=self._released.maxlen)
        self._since = self._last = self._newest = earlier[-1]

    def withdraw(self, last: float) -> None:
        """Hear that nothing could be made of samples later than this: others may still come."""
        self._last = self._newest = last
        while self._released and self._released[-1] > last:
            self._released.pop()

    def flush(self) -> IntakeOutcome:
        """Release all samples that are still open: nothing more will come."""
        found = IntakeOutcome()
        self._refuse_leap(found)
        self._give_up(found)
        self._newest = math.inf
        self._release(found)
        return found

    def _placed(self, held: _Held, found: IntakeOutcome) -> bool:
        """Return whether a row became part of a sample."""
        t, token, said = held.t, held.token, len(found.remarks)
        about, found.row = found.row, token
        values = self._values(held.row, found)
        if not values and len(found.remarks) == said:
            found.remark("malformed", "", "no value of any channel")
        moment = self._moment(t)
        if moment is None:
            text = f"t = {t:g} is not later than the last sample at {self._last:g}"
            for channel in values:
                found.remark("late", channel, text)
        elif values:
            if t < self._newest - self.policy.tolerance:
                text = f"t = {t:g} came after {self._newest:g}"
                found.remark("disordered", "", text)
            self._add(moment, values, token, found)
        if 0.0 < t - self._newest < math.inf:
            self._steps.append(t - self._newest)
        self._newest = max(self._newest, t)
        found.row = about
        return moment is not None and bool(values)

    def _values(self, row: Mapping[str, Any], found: IntakeOutcome) -> dict[str, float]:
        """Return the values of a row that can be used."""
        values: dict[str, float] = {}
        for channel, column in self.columns.items():
            if not all(name in row for name in column.names):
                continue
            try:
                value = channel_value(column, row, self.missing)
            except DataError as error:
                found.remark("malformed", channel, str(error))
                continue
            low, high = column.valid
            if value < low or value > high:
                text = f"{value:g} is not between {low:g} and {high:g}"
                found.remark("invalid", channel, text)
                value = math.nan
            values[channel] = value
        return values

    def _time(self, row: Mapping[str, Any]) -> float | None:
        """Return the time of a row, None if it is outside of what is used."""
        t, dates = row_time(row, self.clock, before=self._dates)
        low, high = self.clock.bounds(dates, "data")
        if not low <= t <= high:
            return None
        if self._dates not in (None, dates):
            was, is_now = ("number", "date") if dates else ("date", "number")
            raise SampleError(f"the time is a {is_now}; it was a {was} before")
        self._dates = dates
        if self.origin is None:
            self.origin = _microseconds(t / self.clock.second) if dates else 0.0
        if not dates:
            return t + self.shift
        moment = t - self.origin * self.clock.second + self.shift
        if moment <= self._last and is_naive(row.get(self.clock.name), self.clock):
            moment += self.clock.repeated_hour(t)  # the second time that the clocks show it
        return moment

    def _moment(self, t: float) -> float | None:
        """Return the moment that a time belongs to, None if that is past."""
        near = [s for s in self._open if abs(s - t) <= self.policy.tolerance]
        if near:
            return min(near, key=lambda s: abs(s - t))
        return t if t > self._last + self.policy.tolerance else None

    def _add(
        self, moment: float, values: Mapping[str, float], token: Any, found: IntakeOutcome
    ) -> None:
        sample = self._open.setdefault(moment, _Open())
        sample.tokens.append(token)
        for channel, value in values.items():
            known = sample.values.get(channel, math.nan)
            if not (math.isnan(known) or math.isnan(value)):
                text = f"a second value for t = {moment:g}: {value:g} after {known:g}"
                found.remark("repeated", channel, text)
                if self.policy.keeps(channel) == "first":
                    continue
            if math.isnan(known) or not math.isnan(value):
                sample.values[channel] = value

    def _release(self, found: IntakeOutcome) -> None:
        """Let go, in order, of the samples that are complete or have waited long enough."""
        for t in sorted(self._open):
            if not self._ripe(t):
                return
            sample = self._open.pop(t)
            self._last = t
            self._bridge(t, sample, found)
            for channel in without_noise(self.columns, sample.values):
                text = f"t = {t:g}: the noise of the reading is not positive"
                found.remark("invalid", channel, text, sample.tokens[-1])
            lacking = [c for c in self.columns if self._lacks(c, sample.values)]
            for channel in lacking:
                text = f"no value for t = {t:g}"
                text += "; that of the sensor is taken" if self.columns[channel].noise_of else ""
                found.remark("missing", channel, text, sample.tokens[-1])
            needed = [channel for channel in lacking if self.columns[channel].needed]
            if needed:
                found.remark("skipped", needed[0], f"t = {t:g} is left out", sample.tokens[-1])
                found.spent += sample.tokens
            else:
                self._recent.append((t, sample.values))
                self._released.append(t)
                since, self._since = self._since, None
                found.ready.append(Ready(t, sample.values, tuple(sample.tokens), since))

    def _lacks(self, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample has no value of a channel; noise belongs to a reading."""
        of = self.columns[channel].noise_of
        absent = math.isnan(values.get(channel, NAN))
        return absent and not (of and math.isnan(values.get(of, NAN)))

    def _bridge(self, t: float, sample: _Open, found: IntakeOutcome) -> None:
        """Interpolate gaps of a sample, and refuse its spikes, where later values are known."""
        for channel in self.columns:
            habit = self.policy.habit(channel)
            waited = max(self.policy.wait, habit.wait) > 0.0
            if not (waited and (habit.interpolated or habit.screened)):
                continue
            later = self._later(t, channel)
            past = [(s, v[channel]) for s, v in self._recent if math.isfinite(v.get(channel, NAN))]
            given = sample.values.get(channel, NAN)
            beyond = BEYOND if habit.screened else math.inf
            value, kinds = decided(t, given, past, later, beyond)
            if "spike" in kinds:
                text = f"t = {t:g}: {given:g} is far off the values before and after"
                found.remark("spike", channel, text, sample.tokens[-1])
            if "interpolated" in kinds and habit.interpolated:
                text = f"t = {t:g}: between the values before and after"
                found.remark("interpolated", channel, text, sample.tokens[-1])
            elif kinds:
                value = NAN
            if kinds:
                sample.values[channel] = value

    def _later(self, t: float, channel: str) -> Series:
        """Return the known values of a channel in samples that are still open."""
        values = ((s, self._open[s].values.get(channel, NAN)) for s in sorted(self._open) if s > t)
        return [pair for pair in values if math.isfinite(pair[1])]

    def _ripe(self, t: float) -> bool:
        """Return whether nothing that a sample may wait for can still come."""
        values, policy = self._open[t].values, self.policy
        absent = [channel for channel in self.columns if self._awaited(t, channel, values)]
        if policy.wait == 0.0 and not absent:
            return True
        waits = [policy.wait, *(policy.habit(channel).wait for channel in absent)]
        return t + policy.tolerance + max(waits) < self._newest

    def _awaited(self, t: float, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample lacks a channel that may still come, or be interpolated."""
        habit = self.policy.habit(channel)
        if not (habit.interpolated and max(self.policy.wait, habit.wait) > 0.0):
            return channel not in values
        return math.isnan(values.get(channel, NAN)) and not self._later(t, channel)


def _same(values: Mapping[str, float], known: Mapping[str, float]) -> bool:
    """Return whether a sample has these values, as far as it has any of them."""
    pairs = [(value, known.get(name, NAN)) for name, value in values.items()]
    both = [(a, b) for a, b in pairs if not (math.isnan(a) or math.isnan(b))]
    return bool(both) and all(a == b for a, b in both)


def _microseconds(stamp: float) -> float:
    """Return seconds since 1970 as a date has them, so that a date gives the same again."""
    try:
        return since_1970(origin_at(stamp))
    except (ValueError, OverflowError, OSError):
        raise SampleError("the first time is no date in UTC; its year must be 1 to 9999") from None
