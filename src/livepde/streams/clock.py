"""Conversion of the times of data, numbers or dates, and the times of each channel of a source.

The program never changes a time of a source. A row far ahead waits until the rows that follow agree
with it; a row that went back is not used. Both are reported, with the key that corrects a wrong
clock.
"""

from __future__ import annotations

import math
import re
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta, tzinfo
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from livepde.errors import SampleError
from livepde.linalg import Array
from livepde.streams.cells import COMMA, NO_POINT, has_decimal_comma, number_of

Instant: TypeAlias = float | str | date | datetime
CALLED_TIME = re.compile(r"(t|time|timestamp|date|datetime|elapsed|zeit|temps)\b|.*time", re.I)
# Formats of elapsed times, which are numbers: seconds of each part. 48:00:00 is two days.
ELAPSED = {"h:mm:ss": (3600.0, 60.0, 1.0), "h:mm": (3600.0, 60.0), "mm:ss": (60.0, 1.0)}
FIRST_CELLS = 5  # of a column, in one of which a format of dates has to fit
MOST = 0.8  # share of cells that a format of dates has to fit
ORDERS = ("%d-%m-%Y", "%m-%d-%Y", "%Y-%m-%d", "%d-%m-%y", "%m-%d-%y", "%y-%m-%d", "%d-%b-%Y")
POINTED = ("%d-%m-%Y", "%d-%m-%y", "%Y-%m-%d")  # with points the day is always before the month
HOURS = ("", *(f" {h}" for h in ("%H:%M", "%H:%M:%S", "%H:%M:%S.%f")))
HOURS += tuple(f" {h}{p}" for h in ("%I:%M", "%I:%M:%S") for p in (" %p", "%p"))
FORMATS = tuple(  # of dates that loggers and spreadsheets write, except ISO
    order.replace("-", mark) + hour
    for mark, hour in product("/-. ", HOURS)
    for order in (ORDERS if mark != "." else POINTED)
)


@dataclass(frozen=True)
class Clock:
    """Conversion of the time column to model time, and the range of times used.

    Attributes
    ----------
    name
        The time column: numbers, or dates and times.
    hour
        The column of the times of day, where `name` holds days only; of CSV files.
    factor
        Multiplies numbers to give the model's time; dates become seconds divided by `second`.
    start, stop
        First and last time used, in the terms of the column: a number (in the model's unit) or
        a date in ISO format.
    second
        One second in the model's unit of time.
    zone
        Time zone of dates that name none.
    format
        Format of dates as text, as "%d.%m.%Y %H:%M"; empty: ISO format. Or a format of `ELAPSED`.
    since
        Date from which numbers count, so that they are dates; None: numbers are no dates.
    decimal
        Decimal mark of numbers as text: "." or ",".
    margin
        How much later than stop rows are read, for times that are corrected.
    doubt
        Unit of numbers that the name of the column states, if they are to be read in another one
        that nobody has stated. Such numbers are refused; empty: none.
    """

    name: str
    factor: float = 1.0
    start: Instant | None = None
    stop: Instant | None = None
    second: float = 1.0
    zone: tzinfo = UTC
    format: str = ""
    decimal: str = "."
    hour: str = ""
    margin: float = 0.0
    doubt: str = ""
    since: datetime | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The columns that hold the times: one, or days and times of day."""
        return (self.name, self.hour) if self.hour else (self.name,)

    def bounds(self, dates: bool, where: str) -> tuple[float, float]:
        """Return start and stop in model time (dates: since 1970)."""
        low, high = -math.inf, math.inf
        if self.start is not None:
            low = self._bound(self.start, dates, f"{where}: start")
        if self.stop is not None:
            high = self._bound(self.stop, dates, f"{where}: stop")
            if dates and (next_day := _day_after(self.stop)) is not None:
                # A day as stop includes its hours: up to the last number before the next day.
                high = math.nextafter(self._bound(next_day, dates, f"{where}: stop"), low)
        return low, high + self.margin

    def repeated_hour(self, t: float) -> float:
        """Return how much later the clocks show a time again, given since 1970, or 0."""
        try:
            here = datetime.fromtimestamp(t / self.second, self.zone)
        except (ValueError, OverflowError, OSError):
            return 0.0
        # A time that is shown twice has another offset at its second pass (fold = 1).
        first, again = here.replace(fold=0).utcoffset(), here.replace(fold=1).utcoffset()
        if first is None or again is None:
            return 0.0
        return (first - again).total_seconds() * self.second

    def moment(self, cell: Any, dates: bool) -> float | None:
        """Return a cell as a number; of dates in seconds since 1970. None if it is neither."""
        if self.format in ELAPSED:
            return elapsed(cell, self.format)
        if not dates:
            return number_of(cell, self.decimal)
        if self.since is None:
            return self.stamp(cell, self.format)
        count = number_of(cell, self.decimal)
        try:
            seconds = math.nan if count is None else count * self.factor / self.second
            return self.stamp(self.since + timedelta(seconds=seconds))
        except (ValueError, OverflowError):
            return None

    def stamp(self, value: Any, form: str = "") -> float | None:
        """Return seconds since 1970 of a date or a date as text, None if it is neither."""
        try:
            value = _parsed(value, form)
            if isinstance(value, date) and not isinstance(value, datetime):
                value = datetime(value.year, value.month, value.day)
            if not isinstance(value, datetime):
                return None
            return (value if value.tzinfo else value.replace(tzinfo=self.zone)).timestamp()
        except (ValueError, OverflowError):
            return None

    def _bound(self, value: Instant, dates: bool, what: str) -> float:
        if dates:
            stamp = self.stamp(value)
            if stamp is None:
                raise SampleError(
                    f"{what}: got {value!r}; the times are dates, such as 2025-04-01."
                )
            return stamp * self.second
        if isinstance(value, str | date):
            raise SampleError(f"{what}: got {str(value)!r}; the times are numbers, not dates.")
        return float(value)


def read_times(
    cells: list[Any], clock: Clock, where: Callable[[int], str], before: bool | None = None
) -> tuple[Array, bool]:
    """Return times in the model's unit, and whether they are dates.

    `where`: names a cell.
    `before`: whether earlier ones were dates, if there were any.
    Raises `SampleError`: a time that cannot be read, with the likely remedy.
    """
    dates = _are_dates(cells, clock, before)
    if clock.doubt and not dates and clock.format not in ELAPSED:
        raise SampleError(
            f"{where(0)} '{clock.name}': the name states the unit '{clock.doubt}', which is not "
            f"that of the model: set time_unit = '{clock.doubt}', or the unit of these times."
        )
    times = np.empty(len(cells))
    for k, cell in enumerate(cells):
        value = clock.moment(cell, dates)
        if value is None or not math.isfinite(value):
            raise SampleError(
                f"{where(k)} '{clock.name}': got {cell!r}; {_remedy(cell, clock, dates)}"
            )
        times[k] = value
    in_seconds = dates or clock.format in ELAPSED
    return times * (clock.second if in_seconds else clock.factor), dates


def with_second_passes(
    times: Array, cells: Sequence[Any], clock: Clock, repeats: Callable[[int, int], bool]
) -> Array:
    """Return times of dates; hours that clocks show twice are distinguished.

    A date without a zone of its own that is not later than those before it belongs to the second
    pass of such an hour, unless its row repeats an earlier one. One that follows the row before at
    the usual interval belongs to it even then: a coarse reading may well be the same an hour later.

    `times`: in the model's unit since 1970, as of the first pass.
    `cells`: the dates as they are written.
    `repeats`: whether a row has the values of another row.
    """
    steps = np.diff(times)
    if not (steps <= 0.0).any():
        return times
    found, last = times.copy(), -math.inf
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    first: dict[float, int] = {}  # row of each time of the first pass
    for k, t in enumerate(times.tolist()):
        if t <= last and is_naive(cells[k], clock) and (again := clock.repeated_hour(t)):
            follows = math.isclose(t + again - last, usual, rel_tol=0.01)
            if follows or not (t in first and repeats(first[t], k)):
                found[k] = t + again
        else:
            first[t] = k
        last = max(last, float(found[k]))
    return found


def is_naive(cell: Any, clock: Clock) -> bool:
    """Return whether a cell is a date without a zone."""
    if clock.since is not None:
        return clock.since.tzinfo is None
    try:
        cell = _parsed(cell, clock.format)
    except ValueError:
        return False
    return isinstance(cell, datetime) and cell.tzinfo is None


def _parsed(cell: Any, form: str) -> Any:
    """Return the date that a text holds, and anything else as it is."""
    if not isinstance(cell, str):
        return cell
    text = cell.strip()
    return datetime.strptime(text, form) if form else datetime.fromisoformat(text)


def elapsed(cell: Any, form: str) -> float | None:
    """Return the seconds of an elapsed time, None if it does not have the format.

    >>> elapsed("26:00:30", "h:mm:ss"), elapsed("0:07.5", "mm:ss"), elapsed("0:75", "h:mm")
    (93630.0, 7.5, None)
    """
    parts = str(cell).strip().split(":")
    whole = [part.isdecimal() for part in parts[:-1]]
    last = number_of(parts[-1]) if parts[-1][:1].isdecimal() else None
    if len(parts) != len(ELAPSED[form]) or not all(whole) or last is None:
        return None
    numbers = [*map(float, parts[:-1]), last]
    if max(numbers[1:]) >= 60.0:
        return None
    return sum(n * seconds for n, seconds in zip(numbers, ELAPSED[form], strict=True))


def elapsed_formats(cells: Sequence[str]) -> list[str]:
    """Return the formats of elapsed times that all cells have, if they never go back.

    >>> elapsed_formats(["0:00:00", "26:00:30"]), elapsed_formats(["0:10", "0:20"])
    (['h:mm:ss'], ['h:mm', 'mm:ss'])
    """
    read = {form: [elapsed(cell, form) for cell in cells] for form in ELAPSED}
    times = {form: np.array(found, dtype=float) for form, found in read.items()}  # None is NaN
    # A comparison with NaN is false.
    return [form for form, x in times.items() if (np.diff(x, prepend=0.0) >= 0.0).all()]


def date_formats(cells: Sequence[str]) -> list[str]:
    """Return the formats in which the cells of a column may be dates; "" is ISO.

    A format has to fit most cells. More than one is left where the order of day, month and year
    cannot be known: formats in which time goes back are dropped, and those with uneven steps where
    exactly one gives even ones.

    >>> date_formats(["16/06/28 06:45", "16/06/28 07:00"])
    ['%d/%m/%y %H:%M', '%y/%m/%d %H:%M']
    >>> date_formats(["06/28/2016 11:45 PM", "06/29/2016 12:00 AM"])
    ['%m/%d/%Y %I:%M %p']
    """
    forms = dict.fromkeys(["", *FORMATS, *map(guessed_format, cells[:FIRST_CELLS])])
    steps = {form: np.diff(given) for form in forms if len(given := _stamps(cells, form))}
    if "" in steps:
        return [""]
    steps = {form: step for form, step in steps.items() if (step >= 0).all()} or steps
    even = [form for form, step in steps.items() if _are_even(step)]
    return even if len(even) == 1 else list(steps)


def _are_even(steps: Array) -> bool:
    """Return whether the longest of several steps is barely longer than their median."""
    return len(steps) > 1 and bool(0 < steps.max() <= 1.5 * np.median(steps))


def _stamps(cells: Sequence[str], form: str) -> Array:
    """Return the dates among cells in seconds since 1970; none unless most cells fit a format."""
    clock = Clock("")
    # Hardly any of the formats fits the first cells; for the others, no more cells are parsed.
    if all(clock.stamp(cell, form) is None for cell in cells[:FIRST_CELLS]):
        return np.empty(0)
    stamps = (clock.stamp(cell, form) for cell in cells)
    given = np.array([stamp for stamp in stamps if stamp is not None])
    return given if len(given) > MOST * len(cells) else np.empty(0)


def guessed_format(text: str) -> str:
    """Return the format in which a text may be a date; empty if none is known.

    >>> guessed_format("01.04.2025 12:00"), guessed_format("noon")
    ('%d.%m.%Y %H:%M', '')
    """
    from pandas.tseries.api import guess_datetime_format

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says which comes first, day or month: so do we
        # With points the day comes first, as in 01.04.2025.
        return guess_datetime_format(text.strip(), dayfirst="." in text[:5]) or ""


def _are_dates(cells: list[Any], clock: Clock, before: bool | None) -> bool:
    """Return whether times are dates: by the first; if it is neither, by those before, or most."""
    first = cells[0]
    if clock.since is not None or clock.format in ELAPSED:
        return clock.since is not None
    if not isinstance(first, str):
        return isinstance(first, date)
    if clock.format:
        return True
    if number_of(first, clock.decimal) is not None:
        return False
    if clock.stamp(first) is not None:
        return True
    if before is not None:
        return before
    return 2 * sum(number_of(cell, clock.decimal) is not None for cell in cells) < len(cells)


def _remedy(cell: Any, clock: Clock, dates: bool) -> str:
    if clock.decimal == "." and not clock.format and has_decimal_comma(cell):
        return COMMA
    if clock.format in ELAPSED:
        return f"expected an elapsed time as time_format has it, {clock.format!r}."
    if not dates or clock.since is not None:
        marked = clock.decimal != "." and number_of(cell) is not None
        return NO_POINT if marked else "expected a number, as in the other rows."
    if clock.format:
        return f"expected a date as time_format has it, {clock.format!r}."
    expected = "expected a date and time such as 2025-04-01 12:00"
    return expected + (_other_format(cell) if isinstance(cell, str) else ".")


def _other_format(text: str) -> str:
    """Return the end of a sentence about a text that may be a time in another format."""
    if forms := elapsed_formats([text]):
        return f"; if it is an elapsed time, set time_format = {' or '.join(map(repr, forms))}."
    format = guessed_format(text)
    return f"; set time_format, perhaps {format!r}." if format else "."


def _day_after(value: Any) -> date | None:
    """Return the day after one without a time, which includes its hours: 23 to 25; else None."""
    if isinstance(value, str) and len(value.strip()) == len("2025-04-01"):
        value = date.fromisoformat(value.strip())
    if not isinstance(value, date) or isinstance(value, datetime):
        return None
    return value + timedelta(days=1)


STEPS = 16  # last steps of a channel, of which the longest but one is the usual step
NEXT = 1.5  # usual steps up to which a time is the next one
CALM = 1.5  # intervals between two times that went back, after which a clock is steady again
FAR = 10.0  # usual steps: a row that is farther ahead waits. It costs a delay, and no row
NAN = math.nan


def usual_of(steps: Sequence[float]) -> float:
    """Return the longest but one of several steps, NaN of none."""
    # The longest step may be a pause of the source, which is not usual.
    return sorted(steps)[-2:][0] if steps else NAN


@dataclass
class _Times:
    """Times of one channel: the newest used one, steps, and late times since then."""

    newest: float = -math.inf
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS))
    late: float = NAN
    went_back: bool = False
    backs: deque[float] = field(default_factory=lambda: deque(maxlen=2))  # newest times then

    def use(self, t: float) -> bool:
        """Note a time that is used; return whether it shows that the clock was set back."""
        # Late times that lead on to this one: the clock stays as it is. Else it was wrong for a
        # while, or a source has sent its past.
        shifted = self.went_back and t - self.late <= NEXT * usual_of(self.steps)
        if 0.0 < t - self.newest < math.inf:
            self.steps.append(t - self.newest)
        self.newest = max(self.newest, t)
        self.late, self.went_back = NAN, False
        return shifted

    @property
    def unsteady(self) -> bool:
        """Whether the clock has gone back repeatedly, and not been right for long since then."""
        if len(self.backs) < 2:
            return False
        return self.newest - self.backs[-1] < CALM * (self.backs[-1] - self.backs[0])

    def refuse(self, t: float) -> bool:
        """Note a late time; return whether it is the first that shows that the clock went back."""
        # One late row is a row that was delayed. Two that follow one another, with no row in order
        # between them, show a clock that went back or a source that sends its past.
        begins = t > self.late and not self.went_back
        self.went_back |= begins
        if begins:
            self.backs.append(self.newest)
        self.late = t
        return begins


class ChannelTimes:
    """Times of the channels of a source, each by its own steps.

    `recent`: times and values of the last samples of an earlier session.
    """

    def __init__(self, recent: Iterable[tuple[float, Mapping[str, float]]]) -> None:
        self._known: defaultdict[str, _Times] = defaultdict(_Times)
        for t, values in recent:
            self.use(t, values)

    def usual(self, values: Mapping[str, float]) -> float:
        """Return the usual step of the slowest channel with a value in a row; NaN if unknown."""
        known = (self._known[name] for name in present(values) if name in self._known)
        return max((usual_of(times.steps) for times in known if times.steps), default=NAN)

    @property
    def slowest(self) -> float:
        """Usual step of the slowest channel; NaN if unknown."""
        return self.usual(dict.fromkeys(self._known, 0.0))

    def use(self, t: float, values: Mapping[str, float]) -> bool:
        """Note the time of a row that is used; return whether its clock was set back before."""
        shown = [self._known[name].use(t) for name in present(values)]
        return any(shown)

    def refuse(self, t: float, values: Mapping[str, float]) -> bool:
        """Note the time of a late row; return whether it shows first that its clock went back."""
        shown = [self._known[name].refuse(t) for name in present(values)]
        return any(shown)

    def withdraw(self, last: float) -> None:
        """Forget that times later than this one were used."""
        for times in self._known.values():
            times.newest = min(times.newest, last)

    @property
    def unsteady(self) -> list[str]:
        """Channels whose clock goes back again and again."""
        return [name for name, times in self._known.items() if times.unsteady]

    @property
    def went_back(self) -> dict[str, float]:
        """Channels whose clock went back, with the time of their last late row."""
        return {name: times.late for name, times in self._known.items() if times.went_back}


def present(values: Mapping[str, float]) -> list[str]:
    """Return the channels with a value, or all channels of a row without any."""
    return [name for name, value in values.items() if not math.isnan(value)] or list(values)
