"""Intake of rows into ordered samples; late, missing, repeated and malformed rows are counted.

A source delivers rows, column -> value, each with a time; one row need not hold all channels. Rows
of one moment make one sample. A sample is ready when a row has come that is later by more than
`wait`; within that time rows may come in any order.
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
    """Arrival of one channel: waiting time, repeated values, interpolation and spikes."""

    wait: float = 0.0  # for which a sample waits for this channel, if longer than `Policy.wait`
    repeated: Literal["first", "last"] | None = None  # as in the policy; None: as the policy says
    # A sample without this channel takes a value interpolated from the next one, if that comes
    # while the sample waits; it waits no longer then.
    interpolated: bool = False
    screened: bool = False  # a spike is refused, if two later values come while the sample waits
    between: Between = "line"  # how the channel behaves between two readings

    @property
    def bridged(self) -> bool:
        """Whether values of samples may be others than those of rows."""
        return self.interpolated or self.screened


@dataclass(frozen=True)
class Policy:
    """Policy for rows that are late, incomplete, repeated, or ahead of the others."""

    wait: float = 0.0  # for which a row may come after a later one, before it is refused
    tolerance: float = 0.0  # rows whose times differ by at most this are of one moment, the first
    # A row that is later than the newest one by more than this, or by more than ten usual steps of
    # its channels, waits until the rows after it agree with it; a row at the old times refutes it.
    leap: float = math.inf
    # Which of two values of a channel for one moment is kept, while the sample waits.
    repeated: Literal["first", "last"] = "first"
    shift: float = 0.0  # correction of a wrong clock by the user: added to all times that come
    channels: Mapping[str, Habit] = field(default_factory=dict)  # channel -> its own options

    def __post_init__(self) -> None:
        waits = {f"wait of '{name}'": habit.wait for name, habit in self.channels.items()}
        for name, value in {"wait": self.wait, "tolerance": self.tolerance, **waits}.items():
            if not (math.isfinite(value) and value >= 0):
                raise DataError(f"intake: {name} must be a time >= 0; got {value}.")
        if not math.isfinite(self.shift):
            raise DataError(f"intake: shift must be a finite time; got {self.shift}.")

    def keeps(self, channel: str) -> Literal["first", "last"]:
        """Return which of two values of a channel is kept."""
        return self.habit(channel).repeated or self.repeated

    def longest(self, habit: Habit) -> float:
        """Return the time for which a sample waits for a channel of this habit."""
        return max(self.wait, habit.wait)

    def habit(self, channel: str) -> Habit:
        """Return the options of a channel."""
        return self.channels.get(channel, PLAIN)


AGREE = 16.0  # usual steps for which rows far ahead have to continue before they are used
FEWEST = 3  # times of rows that are far ahead, or first, before they are used
MOST_AHEAD = 1000  # rows that wait so; more than these are used without a contradiction
REMEMBERED = 1024  # accepted samples that are remembered though the journal has them
PLAIN = Habit()
NO_VALUE = "no value of any channel"
NAN = math.nan
Known: TypeAlias = tuple[float, Mapping[str, float]]  # time and values of an accepted sample


@dataclass(frozen=True)
class Remark:
    """A countable irregularity of a row, a value or a sample.

    `kind`: not used: "malformed" (unreadable, or without a value), "invalid" (outside of the valid
    range), "spike", "late", "conflict" (another value than the one accepted for this time), "leap"
    (a time too far ahead), "repeated" (a row that was accepted before with the same values),
    "outside" (not between start and stop), "skipped" (a sample without a needed channel). "clock":
    late rows follow one another, so that a clock went back. Used all the same: "shifted" (late rows
    lead on to it: the clock was set back), "disordered" (came after a later row), "missing" (a
    sample without this channel), "interpolated" (the same, with a value between known ones).
    """

    kind: str
    channel: str  # of the value; '' for a whole row
    message: str  # of several remarks that of the first
    number: int = 1  # of occurrences
    row: Any = None  # token of its row; for a sample that of the last row


def gather(found: dict[tuple[str, str], Remark], remark: Remark) -> None:
    """Merge a remark into those of its kind and channel: first message, total number."""
    key = remark.kind, remark.channel
    same = found.get(key)
    found[key] = remark if same is None else replace(same, number=same.number + remark.number)


@dataclass(kw_only=True)
class Ready:
    """A sample: open as long as rows may add to it, then complete."""

    t: float
    values: dict[str, float] = field(default_factory=dict)  # of the channels that have come
    tokens: list[Any] = field(default_factory=list)  # of its rows, to acknowledge them


@dataclass
class IntakeOutcome:
    """Outcome of a row: ready samples, remarks, and tokens of rows that no sample uses."""

    ready: list[Ready] = field(default_factory=list)
    remarks: list[Remark] = field(default_factory=list)
    spent: list[Any] = field(default_factory=list)

    def remark(self, kind: str, channel: str, message: str, row: Any) -> None:
        """Add a remark about the row with a token."""
        self.remarks.append(Remark(kind, channel, message, row=row))


class Past(Protocol):
    """The samples in the journal, among which repeated rows are looked for."""

    @property
    def last(self) -> float:
        """Time of the last sample, -inf before any."""

    def between(self, low: float, high: float) -> Sequence[Known]:
        """Return some of the samples between two times, none where they were thinned."""


@dataclass(frozen=True, kw_only=True)
class _Held:
    """A row as it was read: its time, its values, and remarks on them, made once it is used."""

    t: float
    values: dict[str, float]
    token: Any
    remarks: list[Remark]


@dataclass(eq=False)
class Intake:
    """Ordering of rows into samples."""

    columns: Mapping[str, Column]  # channel -> its column
    clock: Clock  # conversion of the time column
    policy: Policy = field(default_factory=Policy)  # for rows out of order
    _: KW_ONLY
    missing: Missing = ()  # numbers and texts that mean a missing value
    origin: float | None = None  # t = 0 in seconds since 1970, of dates; None: the first row's time
    dates: bool | None = None  # whether times are dates; None: as in the first row
    last: float = -math.inf  # time of the last sample, also of an earlier session
    # Last samples of an earlier session, for channels that are interpolated or screened.
    recent: InitVar[Iterable[Known]] = ()
    # Samples in the journal, to recognise rows that were accepted before it had them all.
    past: Past | None = field(default=None, init=False)

    def __post_init__(self, recent: Iterable[Known]) -> None:
        self._newest = self.last
        self._received = math.nan  # when the newest row was received
        self._open: dict[float, Ready] = {}
        self._recent = deque(recent, maxlen=RECENT)
        self._before: dict[str, float] = {}  # held inputs of rows before the first sample
        self._times = ChannelTimes(self._recent)
        self._ahead: list[_Held] = []  # rows far ahead, or the first rows, that wait for others
        self._accepted: deque[tuple[float, dict[str, float]]] = deque()  # values as they came

    @property
    def start(self) -> datetime | None:
        """The date of t = 0, if times are dates."""
        if self.origin is None or not self.dates:
            return None
        return origin_at(self.origin)

    @property
    def waiting(self) -> list[Any]:
        """Tokens of the rows that are in no sample yet."""
        found = [token for sample in self._open.values() for token in sample.tokens]
        return found + [one.token for one in self._ahead]

    @property
    def interval(self) -> float:
        """Seconds between two samples as they usually come; infinite if that is not known."""
        seconds = (self._times.slowest + self._longest) / self.clock.second
        return math.inf if math.isnan(seconds) else seconds

    @property
    def _longest(self) -> float:
        """Longest time for which a sample waits for a channel."""
        waits = (self.policy.longest(self.policy.habit(channel)) for channel in self.columns)
        return max(waits, default=0.0)

    @property
    def why(self) -> str:
        """Reason to doubt the clocks of the source, in one sentence; empty if there is none."""
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
        """Take a row; return the outcome of it and of rows that waited.

        `received`: seconds of a clock of this machine; a row may be ahead by the time that passed.
        """
        found = IntakeOutcome()
        held = self._read(row, token, found)
        if held is None or not self._judged(held, received, found):
            found.spent.append(token)
        self._release(found)
        return found

    def _read(self, row: Mapping[str, Any], token: Any, found: IntakeOutcome) -> _Held | None:
        """Return a row with its time and values, None if it is unreadable or outside."""
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
        # An hour that clocks show twice: its second pass, unless these values came in the first.
        if again and self._passed(t, again, values) and not self._repeats(t, values):
            t += again
        return _Held(t=t, values=values, token=token, remarks=remarks)

    def _passed(self, t: float, hour: float, values: Mapping[str, float]) -> bool:
        """Return whether rows of a time or later ones have come, of the same channels."""
        if t <= self.last:
            return True
        mine = set(present(values))
        waiting = (one for one in self._ahead if t <= one.t <= t + hour)
        return any(not mine.isdisjoint(present(one.values)) for one in waiting)

    def _judged(self, held: _Held, received: float, found: IntakeOutcome) -> bool:
        """Return whether a row is used or waits for others."""
        if self._repeats(held.t, held.values):
            text = f"t = {held.t:g} has been accepted with the same values before"
            found.remark("repeated", "", text, held.token)
            return False
        if self._is_ahead(held, received):
            self._wait(held, received, found)
            return True
        if held.t > self._newest:
            # A row that continues the old times refutes those far ahead, and confirms earlier ones.
            self._refuse([one for one in self._ahead if one.t > held.t], found)
            self._use_ahead(found)
            self._received = received
        return self._placed(held, found)

    def _is_ahead(self, held: _Held, received: float) -> bool:
        """Return whether a row has to wait for others: the first rows, and rows far ahead."""
        if not self._begun:
            return True
        passed = (received - self._received) * self.clock.second
        reach = self._reach(self._times.usual(held.values))
        return held.t - self._newest > (max(reach, passed) if passed > 0.0 else reach)

    def _reach(self, usual: float) -> float:
        """Return by how much a row may be ahead of the one before it."""
        return self.policy.leap if math.isnan(usual) else min(self.policy.leap, FAR * usual)

    def _wait(self, held: _Held, received: float, found: IntakeOutcome) -> None:
        """Let a row wait for others, and use all rows that wait if they agree."""
        latest = held.t + self.policy.tolerance + self._longest
        # A row of an earlier time refutes those that have come before it; of the first rows none
        # has privilege, and those that agree decide.
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
        """Return the times of waiting rows that continue at a usual pace for long enough, or none.

        Rows far ahead have to be the last ones; of the first rows the longest run counts.
        """
        times = sorted({one.t for one in self._ahead})
        steps = [b - a for a, b in pairwise(times)]
        usual, own = self._times.usual(self._ahead[-1].values), usual_of(steps)
        span = AGREE * usual
        if math.isnan(usual):
            usual, span = own, 0.0
        reach = self._reach(max(usual, own))
        # The last rows of them, without a step that would be far ahead itself.
        breaks = [k for k, step in enumerate(steps, start=1) if step > reach]
        runs = [times[k:stop] for k, stop in pairwise([0, *breaks, len(times)])]
        last = runs[-1] if self._begun else max(runs, key=len)
        return last if len(last) >= FEWEST and last[-1] - last[0] >= span else []

    def _use_ahead(self, found: IntakeOutcome) -> None:
        """Use the rows that wait."""
        waiting, self._ahead = self._ahead, []
        if self.origin is None:
            # The first row that is used sets t = 0 for all later ones.
            first = waiting[0].t if waiting else 0.0
            self.origin = _microseconds(first / self.clock.second) if self.dates else 0.0
            zero = self.origin * self.clock.second
            waiting = [replace(one, t=one.t - zero) for one in waiting]
        for one in waiting:
            if not self._placed(one, found):
                found.spent.append(one.token)

    def _refuse(self, rows: Sequence[_Held], found: IntakeOutcome) -> None:
        """Refuse rows that have waited, as too far ahead."""
        refused = {id(one) for one in rows}
        for one in rows:
            far = f"ahead of the newest row at {self._newest:g}" if self._begun else "from others"
            found.remark("leap", "", f"t = {one.t:g} is far {far}", one.token)
            found.spent.append(one.token)
        self._ahead = [one for one in self._ahead if id(one) not in refused]

    def _repeats(self, t: float, values: Mapping[str, float]) -> bool:
        """Return whether a row was accepted before, or waits, with the same values."""
        waiting = [one.values for one in self._ahead if one.t == t]
        remembered, journaled = self._known(t)
        if any(_same(values, known) for known in (*waiting, *(one for _, one in remembered))):
            return True
        # The journal has other values than the rows where gaps and spikes were bridged.
        firm = {n: value for n, value in values.items() if not self.policy.habit(n).bridged}
        return any(_same(firm or values, known) for _, known in journaled)

    def _known(self, t: float) -> tuple[list[Known], list[Known]]:
        """Return the accepted samples of a moment: as they came, and in the journal."""
        low, high = t - self.policy.tolerance, t + self.policy.tolerance
        found: list[Known] = [
            (s, sample.values) for s, sample in self._open.items() if low <= s <= high
        ]
        if low > self.last:
            return found, []
        for s, values in reversed(self._accepted):
            if s < low:
                return found, []  # all samples since then are remembered
            if s <= high:
                found.append((s, values))
        return found, [*self.past.between(low, high)] if self.past is not None else []

    def withdraw(self, last: float) -> None:
        """Accept rows later than this time again: the samples after it were withdrawn."""
        self.last = self._newest = last
        self._times.withdraw(last)
        while self._accepted and self._accepted[-1][0] > last:
            self._accepted.pop()

    def flush(self) -> IntakeOutcome:
        """Release all open samples at the end of the source."""
        found = IntakeOutcome()
        # Nothing can confirm a single row far ahead any more; several confirm each other.
        if self._begun and len({one.t for one in self._ahead}) == 1:
            self._refuse(self._ahead, found)
        self._use_ahead(found)
        # With an infinite newest time no sample waits any longer.
        self._newest = math.inf
        self._release(found)
        return found

    def _placed(self, held: _Held, found: IntakeOutcome) -> bool:
        """Return whether a row became part of a sample."""
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
        """Count the values of a row that is too late: other values than known ones, or new ones."""
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
                # Missing, not absent: the channel has come, and the sample must not wait for it.
                value = math.nan
            values[channel] = value
        return values, found.remarks

    def _time(self, row: Mapping[str, Any]) -> tuple[float, float]:
        """Return the time of a row, and how much later the clocks show it again.

        It is the model time once t = 0 is known, else seconds since 1970 if times are dates; -inf
        before start, inf after stop.
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
            _microseconds(t / self.clock.second)  # raises for a time that is no date in UTC
        naive = is_naive(row.get(self.clock.name), self.clock)
        again = self.clock.repeated_hour(stated) if naive else 0.0
        return t - (self.origin or 0.0) * self.clock.second, again

    def _moment(self, t: float) -> float | None:
        """Return the moment of a time, None if its sample was released."""
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
            # An empty cell of a second row must not erase a value that has come.
            if math.isnan(known) or not math.isnan(value):
                sample.values[channel] = value

    def _release(self, found: IntakeOutcome) -> None:
        """Release, in order, the samples that are complete or have waited long enough."""
        for t in sorted(self._open):
            # Samples leave in order, so one that still waits holds back those after it.
            if not self._ripe(t):
                return
            self.last = t
            self._complete(self._open.pop(t), found)

    def _complete(self, sample: Ready, found: IntakeOutcome) -> None:
        """Release a sample, or leave it out if a channel is missing that it needs."""
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
        """Interpolate gaps of a sample, refuse its spikes and readings with a wrong noise."""
        for channel in self.columns:
            self._bridge(channel, sample, found)
            if channel in self._before and math.isnan(sample.values.get(channel, NAN)):
                sample.values[channel] = self._before[channel]
        for channel in without_noise(self.columns, sample.values):
            text = f"t = {sample.t:g}: the noise of the reading is not positive"
            found.remark("invalid", channel, text, sample.tokens[-1])

    def _remember(self, t: float, came: dict[str, float]) -> None:
        """Remember an accepted sample, at least until the journal has it."""
        self._accepted.append((t, came))
        if len(self._accepted) > 2 * REMEMBERED:
            kept = math.inf if self.past is None else self.past.last
            while len(self._accepted) > REMEMBERED and self._accepted[0][0] <= kept:
                self._accepted.popleft()

    def _held(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the held inputs that an omitted sample states."""
        habits = {channel: self.policy.habit(channel) for channel in values}
        return {
            channel: value
            for channel, value in values.items()
            if (habits[channel].between != "line" or habits[channel].interpolated)
            and not math.isnan(value)
        }

    def _is_news(self, channel: str, value: float) -> bool:
        """Return whether a value of an input is a mean, or not the one that holds already."""
        if (between := self.policy.habit(channel).between) != "hold":
            return between == "next"
        before = (one.get(channel, NAN) for _, one in reversed(self._recent))
        return value != next(filter(math.isfinite, before), NAN)

    def _hold_first(self, values: Mapping[str, float]) -> None:
        """Remember values of rows before the first sample that hold until the next reading."""
        if not self._recent:
            self._before |= {
                channel: value
                for channel, value in self._held(values).items()
                if self.policy.habit(channel).between == "hold"
            }

    def _lacks(self, channel: str, values: Mapping[str, float]) -> bool:
        """Return whether a sample has no value of a channel; noise requires a reading."""
        if self.policy.habit(channel).between == "hold" and self._recent:  # it holds until the next
            return False
        of = self.columns[channel].noise_of
        absent = math.isnan(values.get(channel, NAN))
        return absent and not (of and math.isnan(values.get(of, NAN)))

    def _bridge(self, channel: str, sample: Ready, found: IntakeOutcome) -> None:
        """Interpolate a gap of a sample, or refuse a spike, where later values are known."""
        t, habit = sample.t, self.policy.habit(channel)
        # A sample that does not wait is released before any later value has come.
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
    """Return whether the values of a row are those of a sample."""
    return all(
        known.get(name, NAN) == value or (math.isnan(value) and name in known)
        for name, value in values.items()
    )


def _microseconds(stamp: float) -> float:
    """Return seconds since 1970 rounded to microseconds, as a date stores them."""
    try:
        return since_1970(origin_at(stamp))
    except (ValueError, OverflowError, OSError):
        raise SampleError(
            "the first time is not a date in UTC; its year must be 1 to 9999"
        ) from None
