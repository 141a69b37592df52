"""Intake of rows into ordered samples; late, missing, repeated and malformed rows are counted.

A source delivers rows, column -> value, each with a time and some of the channels. Rows with the
same time are merged into one sample. A sample is ready when a row has arrived that is later by more
than `wait`; within that time, rows may arrive in any order.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass, field, replace
from datetime import datetime
from itertools import chain, pairwise
from typing import Any, Literal, Protocol, TypeAlias

from livepde.dates import origin_at, since_1970
from livepde.errors import DataError, SampleError
from livepde.stepping import Between
from livepde.streams.cells import Missing
from livepde.streams.clock import FAR, ChannelTimes, Clock, is_naive, present, usual_of
from livepde.streams.gaps import BEYOND, RECENT, Series, decided
from livepde.streams.table import Column, channel_value, row_time, without_noise


@dataclass(frozen=True)
class Habit:
    """Options of a channel: waiting time, repeated values, interpolation and spikes."""

    wait: float = 0.0  # time to wait for this channel, if longer than `Policy.wait`
    repeated: Literal["first", "last"] | None = None  # see `Policy`; None: the value there
    # If a sample lacks this channel, it is interpolated once the next value has arrived, which also
    # ends the wait for this channel.
    interpolated: bool = False
    screened: bool = False  # a spike is refused if two later values arrive during the wait
    between: Between = "line"  # behaviour of the channel between two readings

    @property
    def bridged(self) -> bool:
        """Whether values of samples may differ from the values of rows."""
        return self.interpolated or self.screened


@dataclass(frozen=True)
class Policy:
    """Policy for rows that are late, incomplete, repeated, or ahead of other rows."""

    wait: float = 0.0  # largest delay after a later row up to which a row is accepted
    tolerance: float = 0.0  # rows whose times differ by at most this are one sample
    # A row later than the newest one by more than this, or by more than ten usual steps of its
    # channels, waits for later rows to confirm it; a row that continues the old times refutes it.
    leap: float = math.inf
    # Which of two different values of a channel in one sample is used.
    repeated: Literal["first", "last"] = "first"
    shift: float = 0.0  # user's correction of a wrong clock, added to all times
    channels: Mapping[str, Habit] = field(default_factory=dict)  # channel -> its options

    def __post_init__(self) -> None:
        waits = {f"wait of '{name}'": habit.wait for name, habit in self.channels.items()}
        for name, value in {"wait": self.wait, "tolerance": self.tolerance, **waits}.items():
            if not (math.isfinite(value) and value >= 0):
                raise DataError(f"intake: {name} must be a time >= 0; got {value}.")
        if not math.isfinite(self.shift):
            raise DataError(f"intake: shift must be a finite time; got {self.shift}.")

    def keeps(self, channel: str) -> Literal["first", "last"]:
        """Return which of two different values of a channel is used."""
        return self.habit(channel).repeated or self.repeated

    def longest(self, habit: Habit) -> float:
        """Return the time for which a sample waits for a channel with these options."""
        return max(self.wait, habit.wait)

    def habit(self, channel: str) -> Habit:
        """Return the options of a channel."""
        return self.channels.get(channel, PLAIN)


AGREE = 16.0  # usual steps over which rows far ahead must continue before they are used
FEWEST = 3  # smallest number of distinct times of waiting rows before they are used
MOST_AHEAD = 1000  # largest number of waiting rows; more are used unless refuted
REMEMBERED = 1024  # accepted samples kept in memory, even if the journal has them
PLAIN = Habit()
NO_VALUE = "no value of any channel"
NAN = math.nan
Known: TypeAlias = tuple[float, Mapping[str, float]]  # time and values of an accepted sample


@dataclass(frozen=True)
class Remark:
    """A countable irregularity of a row, a value or a sample.

    `kind`, for data that are not used: "malformed" (unreadable, or without a value), "invalid" (out
    of the valid range), "spike", "late", "conflict" (differs from the value accepted for this
    time), "leap" (a time too far ahead), "repeated" (a row with the same time and values was
    accepted before), "outside" (not between start and stop), "skipped" (a sample that lacks a
    needed channel), "clock" (consecutive late rows: a clock went back). For data that are used:
    "shifted" (continues late rows: the clock was set back), "disordered" (arrived after a later
    row), "missing" (a sample that lacks this channel), "interpolated" (filled in such a sample).
    """

    kind: str
    channel: str  # channel of the value; '' for a whole row
    message: str  # for merged remarks, the message of the first
    number: int = 1  # number of occurrences
    row: Any = None  # token of the row; for a sample, of its last row


def gather(found: dict[tuple[str, str], Remark], remark: Remark) -> None:
    """Add a remark; remarks of one kind and channel are merged, with their total number."""
    key = remark.kind, remark.channel
    same = found.get(key)
    found[key] = remark if same is None else replace(same, number=same.number + remark.number)


@dataclass(kw_only=True)
class Ready:
    """A sample, which is open while rows may be added to it."""

    t: float
    values: dict[str, float] = field(default_factory=dict)  # values of the channels so far
    tokens: list[Any] = field(default_factory=list)  # tokens of its rows, for acknowledgement


@dataclass
class IntakeOutcome:
    """Outcome of a row: ready samples, remarks, and tokens of rows not used in a sample."""

    ready: list[Ready] = field(default_factory=list)
    remarks: list[Remark] = field(default_factory=list)
    spent: list[Any] = field(default_factory=list)

    def remark(self, kind: str, channel: str, message: str, row: Any) -> None:
        """Add a remark about the row with the token `row`."""
        self.remarks.append(Remark(kind, channel, message, row=row))


class Past(Protocol):
    """The samples in the journal, which are searched for repeated rows."""

    @property
    def last(self) -> float:
        """Time of the last sample, or -inf."""

    def between(self, low: float, high: float) -> Sequence[Known]:
        """Return some of the samples between two times, none if they were thinned."""


@dataclass(frozen=True, kw_only=True)
class _Held:
    """A row with its time and values, and remarks on them, which are made if the row is used."""

    t: float
    values: dict[str, float]
    token: Any
    remarks: list[Remark]


@dataclass(eq=False)
class Intake:
    """Merges rows into samples in order of time."""

    columns: Mapping[str, Column]  # channel -> its column
    clock: Clock  # conversion of the time column
    policy: Policy = field(default_factory=Policy)  # policy for irregular rows
    _: KW_ONLY
    missing: Missing = ()  # numbers and texts that stand for a missing value
    origin: float | None = None  # for dates, t = 0 in seconds since 1970; None: the first time used
    dates: bool | None = None  # whether times are dates; None: determined by the first row
    last: float = -math.inf  # time of the last sample, perhaps of an earlier session
    # Last samples of an earlier session, for interpolation, spikes and usual steps.
    recent: InitVar[Iterable[Known]] = ()
    # Samples in the journal, to recognise rows that are older than the samples in memory.
    past: Past | None = field(default=None, init=False)

    def __post_init__(self, recent: Iterable[Known]) -> None:
        self._newest = self.last
        self._received = math.nan  # time at which the newest row was received
        self._open: dict[float, Ready] = {}
        self._recent = deque(recent, maxlen=RECENT)
        self._before: dict[str, float] = {}  # held inputs of rows before the first sample
        self._times = ChannelTimes(self._recent)
        self._ahead: list[_Held] = []  # waiting rows: rows far ahead, or the first rows
        self._accepted: deque[tuple[float, dict[str, float]]] = deque()  # samples with raw values

    @property
    def start(self) -> datetime | None:
        """Date of t = 0 if times are dates, else None."""
        if self.origin is None or not self.dates:
            return None
        return origin_at(self.origin)

    @property
    def waiting(self) -> list[Any]:
        """Tokens of the rows in open samples, and of the rows that wait for confirmation."""
        found = [token for sample in self._open.values() for token in sample.tokens]
        return found + [one.token for one in self._ahead]

    @property
    def interval(self) -> float:
        """Usual interval in seconds until the next sample is ready; infinite if not known."""
        seconds = (self._times.slowest + self._longest) / self.clock.second
        return math.inf if math.isnan(seconds) else seconds

    @property
    def _longest(self) -> float:
        """Longest time for which a sample waits for a channel."""
        waits = (self.policy.longest(self.policy.habit(channel)) for channel in self.columns)
        return max(waits, default=0.0)

    @property
    def why(self) -> str:
        """Reason to doubt the clocks of the source, in one sentence, or an empty string."""
        remedy = "if a clock is wrong, specify its correction with `intake.shift`"
        for name, late in self._times.went_back.items():
            return (
                f"the times of {name} went back to t = {late:g}, and its rows count as late up to "
                f"t = {self.last:g}; {remedy}"
            )
        if unsteady := self._times.unsteady:
            return (
                f"the clock of {', '.join(unsteady)} goes back again and again, so the time "
                f"between samples is unknown; {remedy}, and synchronise it gradually"
            )
        if self._begun and self._ahead:
            return (
                f"rows from t = {self._ahead[0].t:g} on are far ahead of t = {self._newest:g}, and "
                f"wait until later rows confirm them; {remedy}"
            )
        return ""

    @property
    def _begun(self) -> bool:
        """Whether any row has been used."""
        return self._newest > -math.inf

    def take(
        self, row: Mapping[str, Any], token: Any = None, received: float = math.nan
    ) -> IntakeOutcome:
        """Process a row; return the outcome of this row and of waiting rows.

        `received`: monotonic arrival time in s; a row may be ahead by the time since the last one.
        """
        found = IntakeOutcome()
        held = self._read(row, token, found)
        if held is None or not self._judged(held, received, found):
            found.spent.append(token)
        self._release(found)
        return found

    def _read(self, row: Mapping[str, Any], token: Any, found: IntakeOutcome) -> _Held | None:
        """Return a row with its time and values; None if it is unreadable or out of range."""
        try:
            times = self._time(row)
        except DataError as error:
            found.remark("malformed", "", str(error), token)
            return None
        values, remarks = self._values(row, token)
        if math.isinf(times[0]):
            found.remark("outside", "", "not between start and stop", token)
            if times[0] < 0.0:
                self._hold_first(values)
            return None
        if not values:
            found.remarks += remarks or [Remark("malformed", "", NO_VALUE, row=token)]
            return None
        t, again = times
        # In an hour that clocks repeat, a row is in the second pass unless it repeats an old row.
        if again and self._passed(t, again, values) and not self._repeats(t, values):
            t += again
        return _Held(t=t, values=values, token=token, remarks=remarks)

    def _passed(self, t: float, hour: float, values: Mapping[str, float]) -> bool:
        """Return whether rows with the same channels at this time or later have arrived."""
        if t <= self.last:
            return True
        mine = set(present(values))
        waiting = (one for one in self._ahead if t <= one.t <= t + hour)
        return any(not mine.isdisjoint(present(one.values)) for one in waiting)

    def _judged(self, held: _Held, received: float, found: IntakeOutcome) -> bool:
        """Return whether a row is used or waits for confirmation."""
        if self._repeats(held.t, held.values):
            text = f"t = {held.t:g} has been accepted with the same values before"
            found.remark("repeated", "", text, held.token)
            return False
        if self._is_ahead(held, received):
            self._wait(held, received, found)
            return True
        if held.t > self._newest:
            # A row that continues the old times refutes later waiting rows, confirms earlier ones.
            self._refuse([one for one in self._ahead if one.t > held.t], found)
            self._use_ahead(found)
            self._received = received
        return self._placed(held, found)

    def _is_ahead(self, held: _Held, received: float) -> bool:
        """Return whether a row must wait: if it is one of the first rows, or far ahead."""
        if not self._begun:
            return True
        passed = (received - self._received) * self.clock.second
        reach = self._reach(self._times.usual(held.values))
        return held.t - self._newest > (max(reach, passed) if passed > 0.0 else reach)

    def _reach(self, usual: float) -> float:
        """Return the time by which a row may be ahead of the row before it."""
        return self.policy.leap if math.isnan(usual) else min(self.policy.leap, FAR * usual)

    def _wait(self, held: _Held, received: float, found: IntakeOutcome) -> None:
        """Add a row to the waiting rows, and use all waiting rows if they agree."""
        latest = held.t + self.policy.tolerance + self._longest
        # A row with an earlier time refutes waiting rows with much later times. The first rows do
        # not refute each other: the longest run that agrees is used.
        if self._begun:
            self._refuse([one for one in self._ahead if one.t > latest], found)
        self._ahead.append(held)
        run = self._agreed()
        if run or len(self._ahead) > MOST_AHEAD:
            if run and not self._begun:
                low, high = run[0], run[-1]
                self._refuse([one for one in self._ahead if not low <= one.t <= high], found)
            self._received = received
            self._use_ahead(found)

    def _agreed(self) -> list[float]:
        """Return the times of a run of waiting rows with usual steps that is long enough, or none.

        The run is the latest one, or for the first rows of a source the longest one.
        """
        times = sorted({one.t for one in self._ahead})
        steps = [b - a for a, b in pairwise(times)]
        usual, own = self._times.usual(self._ahead[-1].values), usual_of(steps)
        span = AGREE * usual
        if math.isnan(usual):
            usual, span = own, 0.0
        reach = self._reach(max(usual, own))
        # A step that is itself far ahead ends a run.
        breaks = [k for k, step in enumerate(steps, start=1) if step > reach]
        runs = [times[k:stop] for k, stop in pairwise([0, *breaks, len(times)])]
        last = runs[-1] if self._begun else max(runs, key=len)
        return last if len(last) >= FEWEST and last[-1] - last[0] >= span else []

    def _use_ahead(self, found: IntakeOutcome) -> None:
        """Use all waiting rows."""
        waiting, self._ahead = self._ahead, []
        if self.origin is None:
            # The first used row defines t = 0.
            first = waiting[0].t if waiting else 0.0
            self.origin = _microseconds(first / self.clock.second) if self.dates else 0.0
            zero = self.origin * self.clock.second
            waiting = [replace(one, t=one.t - zero) for one in waiting]
        for one in waiting:
            if not self._placed(one, found):
                found.spent.append(one.token)

    def _refuse(self, rows: Sequence[_Held], found: IntakeOutcome) -> None:
        """Refuse waiting rows as too far ahead."""
        refused = {id(one) for one in rows}
        for one in rows:
            far = f"ahead of the newest row at {self._newest:g}" if self._begun else "from others"
            found.remark("leap", "", f"t = {one.t:g} is far {far}", one.token)
            found.spent.append(one.token)
        self._ahead = [one for one in self._ahead if id(one) not in refused]

    def _repeats(self, t: float, values: Mapping[str, float]) -> bool:
        """Return whether a row with the same time and values was accepted or waits."""
        waiting = [one.values for one in self._ahead if one.t == t]
        remembered, journaled = self._known(t)
        if any(_same(values, known) for known in (*waiting, *(one for _, one in remembered))):
            return True
        # The journal contains interpolated values, not raw ones, so these channels do not count.
        firm = {n: value for n, value in values.items() if not self.policy.habit(n).bridged}
        return any(_same(firm or values, known) for _, known in journaled)

    def _known(self, t: float) -> tuple[list[Known], list[Known]]:
        """Return the accepted samples at a time: with raw values, and in the journal."""
        low, high = t - self.policy.tolerance, t + self.policy.tolerance
        found: list[Known] = [
            (s, sample.values) for s, sample in self._open.items() if low <= s <= high
        ]
        if low > self.last:
            return found, []
        for s, values in reversed(self._accepted):
            if s < low:
                return found, []  # all samples since then are in memory
            if s <= high:
                found.append((s, values))
        return found, [*self.past.between(low, high)] if self.past is not None else []

    def withdraw(self, last: float) -> None:
        """Accept rows later than the time `last` again, after later samples were withdrawn."""
        self.last = self._newest = last
        self._times.withdraw(last)
        while self._accepted and self._accepted[-1][0] > last:
            self._accepted.pop()

    def flush(self) -> IntakeOutcome:
        """Release all open samples at the end of the source."""
        found = IntakeOutcome()
        # Without further rows, a single time far ahead is refused; several confirm each other.
        if self._begun and len({one.t for one in self._ahead}) == 1:
            self._refuse(self._ahead, found)
        self._use_ahead(found)
        # With an infinite newest time, no sample waits.
        self._newest = math.inf
        self._release(found)
        return found

    def _placed(self, held: _Held, found: IntakeOutcome) -> bool:
        """Add a row to a sample; return whether it was not too late."""
        t, values = held.t, held.values
        found.remarks += held.remarks
        moment = self._moment(t)
        if moment is None:
            self._refuse_late(held, found)
        else:
            if t < self._newest - self.policy.tolerance:
                text = f"t = {t:g} came after {self._newest:g}"
                found.remark("disordered", "", text, held.token)
            self._add(moment, values, held.token, found)
            if self._times.use(t, values):
                text = f"times that went back continue at t = {t:g}: the clock was set back before"
                found.remark("shifted", "", text, held.token)
        self._newest = max(self._newest, t)
        return moment is not None

    def _refuse_late(self, held: _Held, found: IntakeOutcome) -> None:
        """Count the values of a late row that are new, or differ from accepted values."""
        both = chain(*self._known(held.t))
        near = sorted(both, key=lambda sample: abs(sample[0] - held.t))
        known = near[0][1] if near else {}
        for name in present(held.values):
            value, before = held.values[name], known.get(name, NAN)
            if math.isnan(before):
                text = f"t = {held.t:g} is not later than the last sample at {self.last:g}"
                found.remark("late", name, text, held.token)
            elif value != before:
                text = f"t = {held.t:g} was accepted with {before:g}, and came again with {value:g}"
                found.remark("conflict", name, text, held.token)
        if self._times.refuse(held.t, held.values):
            text = (
                f"times went back from t = {self._newest:g} to {held.t:g}: these rows count as late"
            )
            found.remark("clock", "", text, held.token)

    def _values(self, row: Mapping[str, Any], token: Any) -> tuple[dict[str, float], list[Remark]]:
        """Return the valid values of a row, NaN for missing and invalid ones, and remarks."""
        values: dict[str, float] = {}
        found = IntakeOutcome()
        for channel, column in self.columns.items():
            if not all(name in row for name in column.names):
                continue
            try:
                value = channel_value(column, row, self.missing)
            except DataError as error:
                found.remark("malformed", channel, str(error), token)
                continue
            low, high = column.valid
            if value < low or value > high:
                text = f"{value:g} is not between {low:g} and {high:g}"
                found.remark("invalid", channel, text, token)
                # Missing, not absent: the sample must not wait for this channel.
                value = math.nan
            values[channel] = value
        return values, found.remarks

    def _time(self, row: Mapping[str, Any]) -> tuple[float, float]:
        """Return the time of a row, and the time until clocks show it again (0: never).

        It is the model time if t = 0 is known, else for dates the time since 1970. It is -inf
        before start and inf after stop.
        """
        stated, dates = row_time(row, self.clock, before=self.dates)
        t = stated + self.policy.shift
        low, high = self.clock.bounds(dates, "data")
        if not low <= t <= high:
            return (-math.inf if t < low else math.inf), 0.0
        if self.dates not in (None, dates):
            was, is_now = ("number", "date") if dates else ("date", "number")
            raise SampleError(f"the time is a {is_now}; it was a {was} before")
        self.dates = dates
        if not dates:
            return t, 0.0
        if self.origin is None:
            _microseconds(t / self.clock.second)  # raises an error if there is no such date in UTC
        naive = is_naive(row.get(self.clock.name), self.clock)
        again = self.clock.repeated_hour(stated) if naive else 0.0
        return t - (self.origin or 0.0) * self.clock.second, again

    def _moment(self, t: float) -> float | None:
        """Return the time of the sample for a row at time t, None if it was released."""
        near = [s for s in self._open if abs(s - t) <= self.policy.tolerance]
        if near:
            return min(near, key=lambda s: abs(s - t))
        return t if t > self.last + self.policy.tolerance else None

    def _add(
        self, moment: float, values: Mapping[str, float], token: Any, found: IntakeOutcome
    ) -> None:
        sample = self._open.setdefault(moment, Ready(t=moment))
        sample.tokens.append(token)
        for channel, value in values.items():
            known = sample.values.get(channel, math.nan)
            if not (math.isnan(known) or math.isnan(value)) and value != known:
                text = f"a second value for t = {moment:g}: {value:g} after {known:g}"
                found.remark("conflict", channel, text, token)
                if self.policy.keeps(channel) == "first":
                    continue
            # An empty cell of a second row must not delete a value.
            if math.isnan(known) or not math.isnan(value):
                sample.values[channel] = value

    def _release(self, found: IntakeOutcome) -> None:
        """Release the samples that are complete or have waited long enough, in order."""
        for t in sorted(self._open):
            # Samples are released in order, so a waiting sample delays all later ones.
            if not self._ripe(t):
                return
            self.last = t
            self._complete(self._open.pop(t), found)

    def _complete(self, sample: Ready, found: IntakeOutcome) -> None:
        """Release a sample, or skip it if a needed channel is missing."""
        t, came, needed = sample.t, dict(sample.values), list[str]()
        self._fill(sample, found)
        for channel, column in self.columns.items():
            if self._lacks(channel, sample.values):
                text = f"no value for t = {t:g}"
                text += "; the noise of the sensor is used" if column.noise_of else ""
                found.remark("missing", channel, text, sample.tokens[-1])
                needed += [channel] * column.needed
        if needed:
            text = f"the sample at t = {t:g} was skipped"
            found.remark("skipped", needed[0], text, sample.tokens[-1])
            sample.values = self._held(sample.values)
            self._hold_first(sample.values)
            news = any(self._is_news(channel, value) for channel, value in sample.values.items())
            if not (self._recent and news):
                found.spent += sample.tokens
                return
        self._before.clear()
        self._recent.append((t, sample.values))
        self._remember(t, came)
        found.ready.append(sample)

    def _fill(self, sample: Ready, found: IntakeOutcome) -> None:
        """Interpolate gaps of a sample; refuse spikes and readings with an invalid noise."""
        for channel in self.columns:
            self._bridge(channel, sample, found)
            if channel in self._before and math.isnan(sample.values.get(channel, NAN)):
                sample.values[channel] = self._before[channel]
        for channel in without_noise(self.columns, sample.values):
            text = f"t = {sample.t:g}: the noise of the reading is not positive"
            found.remark("invalid", channel, text, sample.tokens[-1])

    def _remember(self, t: float, came: dict[str, float]) -> None:
        """Keep an accepted sample in memory, at least until it is in the journal."""
        self._accepted.append((t, came))
        if len(self._accepted) > 2 * REMEMBERED:
            kept = math.inf if self.past is None else self.past.last
            while len(self._accepted) > REMEMBERED and self._accepted[0][0] <= kept:
                self._accepted.popleft()

    def _held(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the known inputs of a skipped sample: held, mean or interpolated ones."""
        habits = {channel: self.policy.habit(channel) for channel in values}
        return {
            channel: value
            for channel, value in values.items()
            if (habits[channel].between != "line" or habits[channel].interpolated)
            and not math.isnan(value)
        }

    def _is_news(self, channel: str, value: float) -> bool:
        """Return whether a value of an input is a mean, or differs from the held value."""
        if (between := self.policy.habit(channel).between) != "hold":
            return between == "next"
        before = (one.get(channel, NAN) for _, one in reversed(self._recent))
        return value != next(filter(math.isfinite, before), NAN)

    def _hold_first(self, values: Mapping[str, float]) -> None:
        """Store values of rows before the first sample that hold until the next reading."""
        if not self._recent:
            self._before |= {
                channel: value
                for channel, value in self._held(values).items()
                if self.policy.habit(channel).between == "hold"
            }

    def _lacks(self, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample lacks a value of a channel; noise is only due with a reading."""
        if self.policy.habit(channel).between == "hold" and self._recent:  # the last value holds
            return False
        of = self.columns[channel].noise_of
        absent = math.isnan(values.get(channel, NAN))
        return absent and not (of and math.isnan(values.get(of, NAN)))

    def _bridge(self, channel: str, sample: Ready, found: IntakeOutcome) -> None:
        """Interpolate a gap of a sample, or refuse a spike, if later values are known."""
        t, habit = sample.t, self.policy.habit(channel)
        # A sample that does not wait is released before any later value arrives.
        if not (habit.bridged and self.policy.longest(habit) > 0.0):
            return
        later = self._later(t, channel)
        past = [(s, v[channel]) for s, v in self._recent if math.isfinite(v.get(channel, NAN))]
        given = sample.values.get(channel, NAN)
        beyond = BEYOND if habit.screened else math.inf
        value, kinds = decided(t, given, past, later, beyond, habit.between)
        if not kinds:
            return
        if "spike" in kinds:
            text = f"t = {t:g}: {given:g} is far from the values before and after"
            found.remark("spike", channel, text, sample.tokens[-1])
        if "interpolated" in kinds and habit.interpolated:
            text = f"t = {t:g}: interpolated between the values before and after"
            found.remark("interpolated", channel, text, sample.tokens[-1])
        else:  # a spike of a channel that is not interpolated leaves a gap
            value = NAN
        sample.values[channel] = value

    def _later(self, t: float, channel: str) -> Series:
        """Return the known values of a channel in later open samples."""
        values = ((s, self._open[s].values.get(channel, NAN)) for s in sorted(self._open) if s > t)
        return [pair for pair in values if math.isfinite(pair[1])]

    def _ripe(self, t: float) -> bool:
        """Return whether a sample is complete, or has waited long enough for absent channels."""
        values, policy = self._open[t].values, self.policy
        absent = [channel for channel in self.columns if self._awaited(t, channel, values)]
        if policy.wait == 0.0 and not absent:
            return True
        waits = [policy.wait, *(policy.habit(channel).wait for channel in absent)]
        # Times of rows decide, not elapsed seconds, so that a replay gives the same samples.
        return t + policy.tolerance + max(waits) < self._newest

    def _awaited(self, t: float, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample waits for a channel, or for the next value to interpolate it."""
        habit = self.policy.habit(channel)
        if not (habit.interpolated and self.policy.longest(habit) > 0.0):
            return channel not in values
        return math.isnan(values.get(channel, NAN)) and not self._later(t, channel)


def _same(values: Mapping[str, float], known: Mapping[str, float]) -> bool:
    """Return whether a sample has all values of a row."""
    return all(
        known.get(name, NAN) == value or (math.isnan(value) and name in known)
        for name, value in values.items()
    )


def _microseconds(stamp: float) -> float:
    """Round seconds since 1970 to microseconds, the resolution of dates."""
    try:
        return since_1970(origin_at(stamp))
    except (ValueError, OverflowError, OSError):
        raise SampleError(
            "the first time is not a date in UTC; its year must be 1 to 9999"
        ) from None
