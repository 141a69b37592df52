"""Conversion of times, given as numbers or dates, and checks of the clocks of a source.

Times of a source are never corrected automatically. A row far ahead waits until later rows confirm
it, and a row that goes back in time is not used. Both are reported, with the key that corrects a
wrong clock.
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
# Format of elapsed times -> seconds in each part. The first part may be large: 48:00:00 is two days
ELAPSED = {"h:mm:ss": (3600.0, 60.0, 1.0), "h:mm": (3600.0, 60.0), "mm:ss": (60.0, 1.0)}
FIRST_CELLS = 5  # a format of dates must fit at least one of so many first cells of a column
MOST = 0.8  # share of cells that a format of dates must fit
ORDERS = ("%d-%m-%Y", "%m-%d-%Y", "%Y-%m-%d", "%d-%m-%y", "%m-%d-%y", "%y-%m-%d", "%d-%b-%Y")
POINTED = ("%d-%m-%Y", "%d-%m-%y", "%Y-%m-%d")  # with points, a month never comes first
HOURS = ("", *(f" {h}" for h in ("%H:%M", "%H:%M:%S", "%H:%M:%S.%f")))
HOURS += tuple(f" {h}{p}" for h in ("%I:%M", "%I:%M:%S") for p in (" %p", "%p"))
FORMATS = tuple(  # formats of dates in files of loggers and spreadsheets, except ISO
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
        In CSV files, the column of the times of day if `name` contains only days.
    factor
        Factor that converts numbers to model time.
    start, stop
        First and last time used, in the same form as the column: a number in the model's unit, or a
        date in ISO format.
    second
        One second in the model's unit of time, which converts dates.
    zone
        Time zone of dates without a zone.
    format
        Format of dates as text, such as "%d.%m.%Y %H:%M", or a format of `ELAPSED`; empty: ISO.
    since
        Date from which numbers count, so that they are dates; None: numbers are not dates.
    decimal
        Decimal mark of numbers as text: "." or ",".
    margin
        Time after `stop` up to which rows are also read, for times that are corrected later.
    doubt
        Unit in the name of the column if it differs from the assumed unit, which was not specified.
        Numbers are then refused. Empty: no conflict.
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
        """Columns of the times: one column, or one for days and one for times of day."""
        return (self.name, self.hour) if self.hour else (self.name,)

    def bounds(self, dates: bool, where: str) -> tuple[float, float]:
        """Return start and stop in model time, for dates since 1970."""
        low, high = -math.inf, math.inf
        if self.start is not None:
            low = self._bound(self.start, dates, f"{where}: start")
        if self.stop is not None:
            high = self._bound(self.stop, dates, f"{where}: stop")
            if dates and (next_day := _day_after(self.stop)) is not None:
                # A day as `stop` includes all its hours, up to the last float before the next day.
                high = math.nextafter(self._bound(next_day, dates, f"{where}: stop"), low)
        return low, high + self.margin

    def repeated_hour(self, t: float) -> float:
        """Return the time until clocks show a time, given since 1970, again; 0 if they do not.

        In the second pass of an hour that clocks repeat, they do not show it again.
        """
        try:
            here = datetime.fromtimestamp(t / self.second, self.zone)
        except (ValueError, OverflowError, OSError):
            return 0.0
        # A repeated time has a different UTC offset in the second pass (fold = 1).
        first, again = here.replace(fold=0).utcoffset(), here.replace(fold=1).utcoffset()
        if first is None or again is None or here.fold:
            return 0.0
        return (first - again).total_seconds() * self.second

    def moment(self, cell: Any, dates: bool) -> float | None:
        """Return the time in a cell as a number, for dates in seconds since 1970, or None."""
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
        """Return a date, or a date as text, in seconds since 1970; None for anything else."""
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
    """Convert cells to times in the model's unit; return the times and whether they are dates.

    `where`: function that returns the name of a cell for messages.
    `before`: whether earlier times were dates; None: there are no earlier times.
    Raises `SampleError`: a time cannot be read. The message contains the likely remedy.
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
    """Return the times of dates, corrected in the second pass of an hour that clocks repeat.

    A date without a zone that is not later than all earlier dates is in the second pass of such an
    hour, unless its row repeats an earlier row. A row at the usual interval after the row before is
    in the second pass even then: a coarse reading may be the same an hour later.

    `times`: in the model's unit since 1970, assuming the first pass.
    `cells`: the dates as text or date objects.
    `repeats`: function that returns whether two rows have the same values.
    """
    steps = np.diff(times)
    if not (steps <= 0.0).any():
        return times
    found, last = times.copy(), -math.inf
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    first: dict[float, int] = {}  # time in the first pass -> its row
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
    """Return whether a cell is a date and time without a zone."""
    if clock.since is not None:
        return clock.since.tzinfo is None
    try:
        cell = _parsed(cell, clock.format)
    except ValueError:
        return False
    return isinstance(cell, datetime) and cell.tzinfo is None


def _parsed(cell: Any, form: str) -> Any:
    """Parse a date if the cell is a text; return any other cell unchanged."""
    if not isinstance(cell, str):
        return cell
    text = cell.strip()
    return datetime.strptime(text, form) if form else datetime.fromisoformat(text)


def elapsed(cell: Any, form: str) -> float | None:
    """Return an elapsed time in seconds, or None if it does not have the format.

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
    """Return the formats of elapsed times that fit all cells, such that times never decrease.

    >>> elapsed_formats(["0:00:00", "26:00:30"]), elapsed_formats(["0:10", "0:20"])
    (['h:mm:ss'], ['h:mm', 'mm:ss'])
    """
    read = {form: [elapsed(cell, form) for cell in cells] for form in ELAPSED}
    times = {form: np.array(found, dtype=float) for form, found in read.items()}  # None is NaN
    # A comparison with NaN is false.
    return [form for form, x in times.items() if (np.diff(x, prepend=0.0) >= 0.0).all()]


def date_formats(cells: Sequence[str]) -> list[str]:
    """Return the formats of dates that fit most cells of a column; "" is ISO.

    If the order of day, month and year is ambiguous, several formats remain. Formats are excluded
    if times would decrease, or if they have uneven steps and exactly one format has even steps.

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
    """Return whether there are several steps, the longest at most 1.5 times their median."""
    return len(steps) > 1 and bool(0 < steps.max() <= 1.5 * np.median(steps))


def _stamps(cells: Sequence[str], form: str) -> Array:
    """Return the dates in cells in seconds since 1970, or none unless the format fits most."""
    clock = Clock("")
    # Most formats do not fit the first cells. For these, no other cells are parsed.
    if all(clock.stamp(cell, form) is None for cell in cells[:FIRST_CELLS]):
        return np.empty(0)
    stamps = (clock.stamp(cell, form) for cell in cells)
    given = np.array([stamp for stamp in stamps if stamp is not None])
    return given if len(given) > MOST * len(cells) else np.empty(0)


def guessed_format(text: str) -> str:
    """Return a likely format of a date as text, or an empty string.

    >>> guessed_format("01.04.2025 12:00"), guessed_format("noon")
    ('%d.%m.%Y %H:%M', '')
    """
    from pandas.tseries.api import guess_datetime_format

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings on the order of day and month
        # With points, the day comes first, as in 01.04.2025.
        return guess_datetime_format(text.strip(), dayfirst="." in text[:5]) or ""


def _are_dates(cells: list[Any], clock: Clock, before: bool | None) -> bool:
    """Decide by the first time whether times are dates, else by earlier times or the majority."""
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
    """Return the end of the message about a text that may be a time in another format."""
    if forms := elapsed_formats([text]):
        return f"; if it is an elapsed time, set time_format = {' or '.join(map(repr, forms))}."
    format = guessed_format(text)
    return f"; set time_format, perhaps {format!r}." if format else "."


def _day_after(value: Any) -> date | None:
    """Return the day after a date without a time of day, or None; a day may have 23 to 25 h."""
    if isinstance(value, str) and len(value.strip()) == len("2025-04-01"):
        value = date.fromisoformat(value.strip())
    if not isinstance(value, date) or isinstance(value, datetime):
        return None
    return value + timedelta(days=1)


STEPS = 16  # number of last steps of a channel; the second longest is its usual step
NEXT = 1.5  # largest step between consecutive times, in usual steps
CALM = 1.5  # a clock is steady again after so many intervals between its last two setbacks
FAR = 10.0  # usual steps beyond which a row waits for confirmation: a delay, but no loss of rows
NAN = math.nan


def usual_of(steps: Sequence[float]) -> float:
    """Return the second longest step (a single step itself), or NaN without steps."""
    # The longest step may be a pause of the source.
    return sorted(steps)[-2:][0] if steps else NAN


@dataclass
class _Times:
    """Times of a channel: newest used time, last steps, and late times since then."""

    newest: float = -math.inf
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS))
    late: float = NAN
    went_back: bool = False
    # Newest times at the last two setbacks of the clock.
    backs: deque[float] = field(default_factory=lambda: deque(maxlen=2))

    def use(self, t: float) -> bool:
        """Record a time that is used; return whether it shows that the clock was set back."""
        # If late times continue up to this one, the clock was set back permanently. Otherwise it
        # was wrong for a while, or the source has sent old rows.
        shifted = self.went_back and t - self.late <= NEXT * usual_of(self.steps)
        if 0.0 < t - self.newest < math.inf:
            self.steps.append(t - self.newest)
        self.newest = max(self.newest, t)
        self.late, self.went_back = NAN, False
        return shifted

    @property
    def unsteady(self) -> bool:
        """Whether the clock went back repeatedly and has not been steady for long since then."""
        if len(self.backs) < 2:
            return False
        return self.newest - self.backs[-1] < CALM * (self.backs[-1] - self.backs[0])

    def refuse(self, t: float) -> bool:
        """Record a late time; return whether it is the first sign that the clock went back."""
        # A single late row was delayed. Two consecutive late rows in order indicate a clock that
        # went back, or a source that sends old rows.
        begins = t > self.late and not self.went_back
        self.went_back |= begins
        if begins:
            self.backs.append(self.newest)
        self.late = t
        return begins


class ChannelTimes:
    """Times of the channels of a source, each with its own steps.

    `recent`: times and values of the last samples of an earlier session.
    """

    def __init__(self, recent: Iterable[tuple[float, Mapping[str, float]]]) -> None:
        self._known: defaultdict[str, _Times] = defaultdict(_Times)
        for t, values in recent:
            self.use(t, values)

    def usual(self, values: Mapping[str, float]) -> float:
        """Return the usual step of the slowest channel with a value in a row, or NaN."""
        known = (self._known[name] for name in present(values) if name in self._known)
        return max((usual_of(times.steps) for times in known if times.steps), default=NAN)

    @property
    def slowest(self) -> float:
        """Usual step of the slowest channel, or NaN."""
        return self.usual(dict.fromkeys(self._known, 0.0))

    def use(self, t: float, values: Mapping[str, float]) -> bool:
        """Record the time of a used row; return whether it shows that a clock was set back."""
        shown = [self._known[name].use(t) for name in present(values)]
        return any(shown)

    def refuse(self, t: float, values: Mapping[str, float]) -> bool:
        """Record the time of a late row; return whether it is the first sign of a setback."""
        shown = [self._known[name].refuse(t) for name in present(values)]
        return any(shown)

    def withdraw(self, last: float) -> None:
        """Discard used times later than `last`."""
        for times in self._known.values():
            times.newest = min(times.newest, last)

    @property
    def unsteady(self) -> list[str]:
        """Channels whose clock goes back repeatedly."""
        return [name for name, times in self._known.items() if times.unsteady]

    @property
    def went_back(self) -> dict[str, float]:
        """Channels whose clock went back -> time of their last late row."""
        return {name: times.late for name, times in self._known.items() if times.went_back}


def present(values: Mapping[str, float]) -> list[str]:
    """Return the channels with a value; if a row has no value, all its channels."""
    return [name for name, value in values.items() if not math.isnan(value)] or list(values)
