"""Intake of rows into ordered samples; late, missing, repeated and malformed rows are counted.

A source delivers rows, column -> value, each with a time; one row need not hold all channels. Rows
of one moment make one sample. A sample is ready when a row has come that is later by more than
`wait`; within that time rows may come in any order.
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
    """Arrival of one channel: waiting time, repeated values, interpolation and spikes.

    Parameters
    ----------
    wait
        Time for which a sample waits for this channel, if longer than `Policy.wait`.
    repeated
        Which of two values for one moment is kept; default that of the policy.
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
    """Policy for rows that are late, incomplete, repeated, or ahead of the others.

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
        Which of two values of a channel for one moment is kept.
    channels
        Channel -> its own options.
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
        """Return which of two values of a channel is kept."""
        return self.habit(channel).repeated or self.repeated

    def longest(self, habit: Habit) -> float:
        """Return the time for which a sample waits for a channel of this habit."""
        return max(self.wait, habit.wait)

    def habit(self, channel: str) -> Habit:
        """Return the options of a channel."""
        return self.channels.get(channel, PLAIN)


STEPS = 16  # between rows, from which the usual step is known
LONG = 100.0  # usual steps, after which a row is far ahead
AGREE = 5  # late rows that agree with each other outweigh the clock before
INSIST = (
    50  # of them, where no sample was taken at their times: they may be the backlog of a logger
)
PLAIN = Habit()
NAN = math.nan


@dataclass(frozen=True)
class Remark:
    """A countable irregularity of a row, a value or a sample.

    Attributes
    ----------
    kind
        Not used: "malformed" (unreadable, or without a value), "invalid" (outside of the valid
        range), "spike", "late", "leap" (a time too far ahead), "repeated", "outside" (not between
        start and stop), "skipped" (a sample without a needed channel); a whole row is "repeated" if
        it was taken before, with the same values. "clock": rows have shown that the clock was wrong
        or set back. Used all the same: "disordered" (came after a later row), "missing" (a sample
        without this channel), "interpolated" (the same, with a value between known ones).
    channel
        Channel of the value; '' for a whole row.
    message
        Description; of several remarks that of the first.
    number
        Number of occurrences.
    row
        Token of its row; for a sample that of the last row.
    """

    kind: str
    channel: str
    message: str
    number: int = 1
    row: Any = None


def gather(found: dict[tuple[str, str], Remark], remark: Remark) -> None:
    """Merge a remark into those of its kind and channel: first message, total number."""
    key = remark.kind, remark.channel
    same = found.get(key)
    found[key] = remark if same is None else replace(same, number=same.number + remark.number)


@dataclass(frozen=True, kw_only=True)
class Ready:
    """A sample that is complete.

    Attributes
    ----------
    t, values
        Time, and values of the channels that have come.
    tokens
        Tokens of the source for the rows of the sample, to acknowledge them.
    since
        Samples taken before that are later than this have wrong times, and must be withdrawn before
        this one is taken. None: there are none.
    """

    t: float
    values: dict[str, float]
    tokens: tuple[Any, ...]
    since: float | None = None


@dataclass
class IntakeOutcome:
    """Outcome of a row: ready samples, remarks, and tokens of rows that no sample uses.

    `row` is the token of the row, to which remarks refer by default.
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
    """The samples taken so far, which distinguish a late row from a wrong clock."""

    def between(self, low: float, high: float) -> Sequence[tuple[float, Mapping[str, float]]]:
        """Return some of the samples between two times, none where they were thinned."""

    def returns_to(self, t: float) -> bool:
        """Return whether all samples later than a time can be withdrawn."""


@dataclass(frozen=True, kw_only=True)
class _Held:
    """A row that waits until later rows have confirmed or refuted its time."""

    t: float
    row: Mapping[str, Any]
    token: Any


@dataclass
class _Open:
    values: dict[str, float] = field(default_factory=dict)
    tokens: list[Any] = field(default_factory=list)


class Intake:
    """Ordering of rows into samples.

    Parameters
    ----------
    columns
        Channel -> its column.
    clock
        Conversion of the time column.
    policy
        Policy for rows out of order.
    missing
        Numbers that mean a missing value.
    origin
        Seconds since 1970 of t = 0 where times are dates; default the first row's.
    dates
        Whether times are dates; default as in the first row.
    last
        Time of the last sample taken in an earlier session; earlier rows are late.
    recent
        Times and values of the last samples of an earlier session, for channels that are
        interpolated or screened.
    shift
        Offset that is added to the times of rows, because the clock was set back by it.

    Attributes
    ----------
    past
        The samples taken so far, to detect a wrong clock; None: all late rows are refused.
    anchors
        Token of the first row with a new shift, and the shift; oldest first.
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
        """Take a row; return the outcome of it and of rows that waited."""
        found = IntakeOutcome(row=token)
        try:
            t = self._time(row)
        except DataError as error:
            found.remark("malformed", "", str(error))
        else:
            if t is None:
                found.remark("outside", "", "not between start and stop")
            elif self._judged(_Held(t=t, row=row, token=token), found):
                self._release(found)
                return found
        found.spent.append(token)
        self._release(found)
        return found

    def _judged(self, held: _Held, found: IntakeOutcome) -> bool:
        """Return whether a row is used or waits; a leap and late rows wait for others."""
        if self._leaps(held.t):
            self._doubt(held, found)
            return True
        # A row at the old pace shows that the one far ahead before it was wrong.
        if self._doubted is not None:
            self._refuse_leap(found)
        if self.past is not None and self._late(held.t):
            return self._pends(held, self.past, found)
        # A row in order interrupts a sequence of late ones, which is too short to be believed.
        self._place_pending(found)
        return self._placed(held, found)

    def _leaps(self, t: float) -> bool:
        """Return whether a row is too far ahead of the newest one."""
        return t - self._newest > min(self.policy.leap, self._long) and math.isfinite(self._newest)

    @property
    def _long(self) -> float:
        """A hundred times the second longest step; infinite if too few steps are known."""
        # The longest step may be a pause of the source, which must not count as usual.
        return LONG * sorted(self._steps)[-2] if len(self._steps) == STEPS else math.inf

    def _doubt(self, held: _Held, found: IntakeOutcome) -> None:
        """Take a row that is far ahead if the row before confirms it; else let it wait."""
        self._place_pending(found)
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

        A row with time and values of a taken sample is a repetition, as a source sends after a
        reconnect. Other late rows that follow one another show that the clock was wrong, or was set
        back.
        """
        # Remarks on the values are made once the row is placed, so these are dropped.
        values = self._values(held.row, IntakeOutcome())
        near = past.between(held.t - self.policy.tolerance, held.t + self.policy.tolerance)
        if not values or any(_same(values, known) for _, known in near):
            self._place_pending(found)
            if not values:
                return self._placed(held, found)
            text = f"t = {held.t:g} has been taken with the same values before"
            found.remark("repeated", "", text)
            return False
        if self._pending and not 0.0 <= held.t - self._pending[-1].t <= self._long:
            self._place_pending(found)
        self._pending.append(held)
        # Several rows of one moment are no more evidence than one.
        if len({one.t for one in self._pending}) >= AGREE:
            self._anchor(past, found)
        return True

    def _place_pending(self, found: IntakeOutcome) -> None:
        """Place the late rows that wait: they are refused unless the clock was corrected."""
        pending, self._pending = self._pending, []
        for held in pending:
            if not self._placed(held, found):
                found.spent.append(held.token)

    def _anchor(self, past: Past, found: IntakeOutcome) -> None:
        """Correct the clock by late rows that agree: withdraw samples, or shift times."""
        first, count = self._pending[0].t, len({one.t for one in self._pending})
        earlier = [t for t in self._released if t < first]
        # A clock that was wrong for a moment has spoilt few samples, which can be withdrawn. Before
        # one that was set back all samples are right, and so times are shifted instead.
        wrong = len(self._released) - len(earlier) + len(self._open)
        if wrong <= AGREE and earlier and past.returns_to(earlier[-1]):
            text = (
                f"{count} rows from t = {first:g} on agree with each other: the clock had been "
                f"wrong, and {wrong} samples later than t = {earlier[-1]:g} are taken back"
            )
            self._go_back(earlier, found)
        elif count >= INSIST or self._covered(past):
            # The true length of the pause is unknown, so the rows go on after one usual step.
            shift = self._newest + self._usual - first
            self.shift += shift
            text = (
                f"{count} rows from t = {first:g} on repeat times that have been: the clock was "
                f"set back by {shift:g}, which is added to all times from now on"
            )
            self._pending = [replace(one, t=one.t + shift) for one in self._pending]
            # A position before this row belongs to the old shift, and one after it to the new one.
            self.anchors.append((self._pending[0].token, self.shift))
        else:
            return
        found.remark("clock", "", text)
        self._place_pending(found)

    @property
    def _usual(self) -> float:
        """The median step of the late rows that wait."""
        gaps = [b.t - a.t for a, b in pairwise(self._pending) if b.t > a.t]
        return float(median(gaps))

    def _covered(self, past: Past) -> bool:
        """Return whether samples with their channels were taken in the span of the waiting rows."""
        named = {name for one in self._pending for name in self._values(one.row, IntakeOutcome())}
        return any(
            not all(math.isnan(known.get(name, NAN)) for name in named)
            for _, known in past.between(self._pending[0].t, self._pending[-1].t)
        )

    def _go_back(self, earlier: list[float], found: IntakeOutcome) -> None:
        """Drop open samples, and mark released ones later than the first waiting row as wrong."""
        # Open samples are later than the late rows, so they have times of the wrong clock, too.
        for sample in self._open.values():
            found.spent += sample.tokens
        self._open.clear()
        self._released = deque(earlier, maxlen=self._released.maxlen)
        self._since = self._last = self._newest = earlier[-1]

    def withdraw(self, last: float) -> None:
        """Accept rows later than this time again: the samples after it were withdrawn."""
        self._last = self._newest = last
        while self._released and self._released[-1] > last:
            self._released.pop()

    def flush(self) -> IntakeOutcome:
        """Release all open samples at the end of the source."""
        found = IntakeOutcome()
        self._refuse_leap(found)
        self._place_pending(found)
        # With an infinite newest time no sample waits any longer.
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
        """Return the valid values of a row, NaN for missing and invalid ones."""
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
                # Missing, not absent: the channel has come, and the sample must not wait for it.
                value = math.nan
            values[channel] = value
        return values

    def _time(self, row: Mapping[str, Any]) -> float | None:
        """Return the model time of a row, None if it is not between start and stop."""
        t, dates = row_time(row, self.clock, before=self._dates)
        low, high = self.clock.bounds(dates, "data")
        if not low <= t <= high:
            return None
        if self._dates not in (None, dates):
            was, is_now = ("number", "date") if dates else ("date", "number")
            raise SampleError(f"the time is a {is_now}; it was a {was} before")
        self._dates = dates
        # The first row within the bounds sets t = 0 for all later ones.
        if self.origin is None:
            self.origin = _microseconds(t / self.clock.second) if dates else 0.0
        if not dates:
            return t + self.shift
        moment = t - self.origin * self.clock.second + self.shift
        if moment <= self._last and is_naive(row.get(self.clock.name), self.clock):
            moment += self.clock.repeated_hour(t)  # the second pass at the end of summer time
        return moment

    def _moment(self, t: float) -> float | None:
        """Return the moment that a time belongs to, None if its sample was released."""
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
            # An empty cell of a second row must not erase a value that has come.
            if math.isnan(known) or not math.isnan(value):
                sample.values[channel] = value

    def _release(self, found: IntakeOutcome) -> None:
        """Release, in order, the samples that are complete or have waited long enough."""
        for t in sorted(self._open):
            # Samples leave in order, so one that still waits holds back those after it.
            if not self._ripe(t):
                return
            self._last = t
            self._complete(t, self._open.pop(t), found)

    def _complete(self, t: float, sample: _Open, found: IntakeOutcome) -> None:
        """Release a sample, or leave it out if a channel is missing that it needs."""
        for channel in self.columns:
            self._bridge(channel, t, sample, found)
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
            return
        self._recent.append((t, sample.values))
        self._released.append(t)
        since, self._since = self._since, None
        found.ready.append(
            Ready(t=t, values=sample.values, tokens=tuple(sample.tokens), since=since)
        )

    def _lacks(self, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample has no value of a channel; noise belongs to a reading."""
        of = self.columns[channel].noise_of
        absent = math.isnan(values.get(channel, NAN))
        return absent and not (of and math.isnan(values.get(of, NAN)))

    def _bridge(self, channel: str, t: float, sample: _Open, found: IntakeOutcome) -> None:
        """Interpolate a gap of a sample, or refuse a spike, where later values are known."""
        habit = self.policy.habit(channel)
        # A sample that does not wait is released before any later value has come.
        waited = self.policy.longest(habit) > 0.0
        if not (waited and (habit.interpolated or habit.screened)):
            return
        later = self._later(t, channel)
        past = [(s, v[channel]) for s, v in self._recent if math.isfinite(v.get(channel, NAN))]
        given = sample.values.get(channel, NAN)
        beyond = BEYOND if habit.screened else math.inf
        value, kinds = decided(t, given, past, later, beyond)
        if not kinds:
            return
        if "spike" in kinds:
            text = f"t = {t:g}: {given:g} is far off the values before and after"
            found.remark("spike", channel, text, sample.tokens[-1])
        if "interpolated" in kinds and habit.interpolated:
            text = f"t = {t:g}: between the values before and after"
            found.remark("interpolated", channel, text, sample.tokens[-1])
        else:  # a spike of a channel that is not interpolated leaves a gap
            value = NAN
        sample.values[channel] = value

    def _later(self, t: float, channel: str) -> Series:
        """Return the known values of a channel in samples that are still open."""
        values = ((s, self._open[s].values.get(channel, NAN)) for s in sorted(self._open) if s > t)
        return [pair for pair in values if math.isfinite(pair[1])]

    def _ripe(self, t: float) -> bool:
        """Return whether a sample is complete, or has waited long enough for the rest."""
        values, policy = self._open[t].values, self.policy
        absent = [channel for channel in self.columns if self._awaited(t, channel, values)]
        if policy.wait == 0.0 and not absent:
            return True
        waits = [policy.wait, *(policy.habit(channel).wait for channel in absent)]
        # The times of rows decide, not the seconds that pass: a replay gives the same samples.
        return t + policy.tolerance + max(waits) < self._newest

    def _awaited(self, t: float, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample waits for a channel that may still come, or be interpolated."""
        habit = self.policy.habit(channel)
        if not (habit.interpolated and self.policy.longest(habit) > 0.0):
            return channel not in values
        return math.isnan(values.get(channel, NAN)) and not self._later(t, channel)


def _same(values: Mapping[str, float], known: Mapping[str, float]) -> bool:
    """Return whether a sample has the same values in all channels that both have, if any."""
    pairs = [(value, known.get(name, NAN)) for name, value in values.items()]
    both = [(a, b) for a, b in pairs if not (math.isnan(a) or math.isnan(b))]
    return bool(both) and all(a == b for a, b in both)


def _microseconds(stamp: float) -> float:
    """Return seconds since 1970 rounded to microseconds, as a date stores them."""
    try:
        return since_1970(origin_at(stamp))
    except (ValueError, OverflowError, OSError):
        raise SampleError("the first time is no date in UTC; its year must be 1 to 9999") from None
