"""Samples from CSV files."""

from __future__ import annotations

import codecs
import csv
import io
import stat
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, filterfalse, islice
from operator import itemgetter
from pathlib import Path
from statistics import multimode
from typing import Any, TypeVar

import numpy as np

from livepde.errors import DataError, SampleError
from livepde.linalg import Array
from livepde.streams import table
from livepde.streams.cells import (
    POINT,
    Missing,
    cell_number,
    has_decimal_comma,
    is_missing,
    number_of,
)
from livepde.streams.clock import ELAPSED, Clock, date_formats, elapsed, read_times
from livepde.units import SCALES, in_si

T = TypeVar("T")

UTF_8 = "utf-8-sig"  # with or without a byte order mark, which Excel writes
SEPARATORS = ("\t", ";", ",")  # in the order in which they are tried
BLANK = " "  # separator of columns with any number of blanks between them
END = "end"  # line appended to the lines of a file
LOOK = 100_000  # characters from which the format of a file is detected
TOA5 = "TOA5"  # first cell of the title line in files of Campbell loggers
UNDER = 2  # largest number of label lines under a header: units and kinds of values
GZIP = b"\x1f\x8b"
BOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # first bytes of workbooks: .xlsx and .ods, .xls


@dataclass(frozen=True)
class Written:
    """The detected format of a CSV file, and the cells of its first rows.

    Dates that are not in ISO format have several possible formats if the order of day, month and
    year is ambiguous; `time_formats` lists them.
    """

    separator: str
    decimal: str
    encoding: str
    skip: int  # number of title lines before the header
    time_formats: tuple[str, ...]
    header: list[str]
    rows: list[list[str]]
    labels: list[str] = field(default_factory=list)  # first line under the header, without data

    def titled(self, name: str) -> str:
        """Return the name of a column with its unit in brackets, if the line of units has it."""
        label = dict(zip(self.header, self.labels, strict=False)).get(name, "")
        unit = label.strip().strip("[]()")
        return f"{name} [{unit}]" if unit and in_si(SCALES.get(unit, unit)) else name

    @property
    def time_format(self) -> str:
        """Format of the dates; empty if there are no dates, ISO dates or several formats."""
        return self.time_formats[0] if len(self.time_formats) == 1 else ""


def read_csv(
    path: str | Path,
    columns: Mapping[str, table.Column],
    clock: Clock,
    *,
    every: int = 1,
    missing: Missing = (),
    separator: str = ",",
    encoding: str = UTF_8,
    skip: int = 0,
) -> table.DataTable:
    """Read channels from a CSV file with one header line.

    Parameters
    ----------
    columns
        Channel -> its column.
    every
        Keep one in `every` rows.
    missing
        Numbers and texts for a missing value, such as -9999 or OVER, besides empty cells and NaN.
    separator
        Field separator, such as "," or ";".
    encoding
        Text encoding, such as "cp1252" or "utf-16".
    skip
        Number of lines before the header.

    Raises
    ------
    DataError
        The file or a column does not exist; a channel contains text or infinity; times do not
        increase. The message names file, row (the header is row 1) and column.
    """
    path = Path(path)
    needed = [*clock.names, *table.decimal_marks(columns)]
    rows, cells = texts_of(path, needed, separator, encoding, clock, skip)
    return _to_table(path, rows, cells, columns, clock, every, missing)


def read_long_csv(
    path: str | Path,
    columns: Mapping[str, table.Column],
    clock: Clock,
    long: tuple[str, str],
    *,
    every: int = 1,
    missing: Missing = (),
    separator: str = ",",
    encoding: str = UTF_8,
    skip: int = 0,
) -> list[table.DataTable]:
    """Read a CSV file with a row for each reading (long format); return a table per channel.

    Parameters
    ----------
    columns
        Channel -> its sensor, as a column with the name of the sensor.
    long
        Column of the names of the sensors, and column of their values.
    clock, every, missing, separator, encoding, skip
        See `read_csv`.

    Raises
    ------
    DataError
        A sensor has no row; and the errors of `read_csv`.
    """
    path, (named, valued) = Path(path), long
    rows, cells = texts_of(path, [*clock.names, named, valued], separator, encoding, clock, skip)
    places: defaultdict[str, list[int]] = defaultdict(list)
    for k, name in enumerate(cells[named]):
        places[name.strip()].append(k)
    found = []
    for channel, column in columns.items():
        (name,) = column.names
        if name not in places:
            text = f"{path}, column '{named}': there is no sensor '{name}'"
            raise SampleError(f"{text}{table.hint(name, list(places))}")
        own = places[name]
        texts = {time: tuple(cells[time][k] for k in own) for time in clock.names}
        texts[name] = tuple(cells[valued][k] for k in own)
        lines = [rows[k] for k in own]
        found.append(_to_table(path, lines, texts, {channel: column}, clock, every, missing))
    return found


def texts_of(
    path: Path, needed: Sequence[str], separator: str, encoding: str, clock: Clock, skip: int
) -> tuple[list[int], dict[str, tuple[str, ...]]]:
    """Return the row numbers of a CSV file and the texts in the `needed` columns.

    Raises `DataError`.
    """
    try:
        _check_text(path)
        rows, cells = _cells(path, [*dict.fromkeys(needed)], separator, encoding, clock, skip)
    except FileNotFoundError:
        raise table.no_file(path) from None
    except UnicodeError as error:
        raise _not_text(path, separator, encoding, clock, skip) from error
    except (OSError, csv.Error) as error:
        raise DataError(f"{path} cannot be read as a CSV file: {error}.") from error
    if not rows:
        raise DataError(f"{path}: has no rows below its header.")
    return rows, cells


def _to_table(
    path: Path,
    rows: Sequence[int],
    cells: Mapping[str, Sequence[str]],
    columns: Mapping[str, table.Column],
    clock: Clock,
    every: int,
    missing: Missing,
) -> table.DataTable:
    """Return a table of the channels from the texts of numbered rows."""
    decimals = table.decimal_marks(columns)
    stamps = [" ".join(parts) for parts in zip(*(cells[name] for name in clock.names), strict=True)]
    times, dates = read_times(stamps, clock, lambda k: f"{path}, row {rows[k]}, column")

    def numbers(name: str, use: Any) -> Array:
        chosen = use.tolist()
        texts, places = [cells[name][k] for k in chosen], [rows[k] for k in chosen]
        return _numbers(texts, places, f"{path}", name, decimals[name], missing)

    def where(k: int) -> str:
        return f"{path}, row {rows[k]}, column '{clock.name}'"

    written = stamps if dates else None
    return table.to_table(
        times, written, numbers, columns, clock, every, missing, (f"{path}", where)
    )


def rows_of(lines: Iterable[str], separator: str, *, headed: bool = False) -> Iterator[list[str]]:
    """Yield the rows of a text as lists of fields; `headed`: the header was already read.

    >>> list(rows_of(["# time (d), head (m)", " 0.1  -0.040", "# end"], " "))
    [['time (d)', 'head (m)'], ['0.1', '-0.040'], ['# end']]
    """
    if separator != BLANK:
        yield from csv.reader(lines, delimiter=separator, skipinitialspace=True)
        return
    for line in lines:
        text = " ".join(line.split())
        if not text.startswith("#"):  # names with blanks have quotes
            yield from csv.reader([text], delimiter=BLANK) if text else [[]]
        elif headed:
            yield [text]
        else:  # a header that is a comment, perhaps with commas between names
            names = text.lstrip("# ")
            mark = next((mark for mark in SEPARATORS if mark in names), None)
            yield [name.strip() for name in names.split(mark)]
        headed = headed or bool(text)


def is_title(cells: Sequence[str]) -> bool:
    """Return whether a line is the title that Campbell loggers write above the header."""
    return bool(cells) and cells[0].strip() == TOA5


def are_labels(cells: Sequence[str]) -> bool:
    """Return whether a line under the header contains units or other words, but no data.

    >>> are_labels(["TS", "RN", "Deg C"]), are_labels(["2025-01-01 00:00", "", "NAN"])
    (True, False)
    """
    texts = [text for cell in cells if (text := cell.strip())]
    return bool(texts) and not any(
        not text.isprintable()
        or text[0].isdigit()
        or is_missing(text)
        or number_of(text, ",") is not None
        for text in texts
    )


def below_title(rows: Iterator[T], cells: Callable[[T], Sequence[str]]) -> Iterator[T]:
    """Yield the rows of a file from its header on, without the label lines under it."""
    header = next(rows, None)
    if header is not None and is_title(cells(header)):
        header = next(rows, None)
    if header is None:
        return
    yield header
    for _ in range(UNDER):
        row = next(rows, None)
        if row is None:
            return
        if not are_labels(cells(row)):
            yield row
            break
    yield from rows


def header_of(path: Path, separator: str, encoding: str, skip: int) -> list[str]:
    """Return the column names of a CSV file; raises `DataError`."""
    _check_text(path)
    try:
        with path.open(newline="", encoding=encoding) as file:
            rows = rows_of(islice(file, skip, None), separator)
            return next(below_title(filter(None, rows), list), [])
    except (OSError, UnicodeError, csv.Error) as error:
        raise DataError(f"{path} cannot be read as a CSV file: {error}.") from error


def _check_text(path: Path) -> None:
    """Refuse workbooks and compressed files, and devices, which have no end."""
    if stat.S_ISCHR(path.stat().st_mode):
        raise DataError(f"{path} is a device, not a file. Specify a file.")
    with path.open("rb") as file:
        first = file.read(4)
    if first.startswith(BOOKS):
        raise DataError(f"{path} is a workbook, not text: save its sheet as 'CSV UTF-8'.")
    if first.startswith(GZIP):
        raise DataError(f"{path} is compressed: unpack it first, as with 'gunzip'.")


def _check_header(
    path: Path, header: list[str], separator: str, encoding: str, clock: Clock, skip: int
) -> None:
    """Refuse a title instead of a header, and a header that another separator would divide."""
    if not header:
        raise csv.Error("it is empty")
    if len(header) > 1:
        return
    others = [other for other in SEPARATORS if other != separator and other in header[0]]
    seems = how_written(path, encoding)
    if seems.skip > skip and seems.separator == separator:
        raise SampleError(
            f"{path}: line {skip + 1} is a title, not a header: set "
            f"{_as_written(path, separator, encoding, clock, '', skip)}."
        )
    if others:
        raise SampleError(
            f"{path}: the header is one field with {separator!r} between fields, and "
            f"{header[0].count(others[0]) + 1} with {others[0]!r}: set "
            f"{_as_written(path, others[0], encoding, clock, f'separator = {others[0]!r}', skip)}."
        )


def how_written(path: str | Path, encoding: str = "", skip: int | None = None) -> Written:
    """Detect the format of a CSV file from its first rows.

    `encoding` and `skip` are not detected if they are given.
    """
    path = Path(path)
    try:
        _check_text(path)
        encoding = encoding or _likely(path.read_bytes(), UTF_8)
        with path.open(newline="", encoding=encoding, errors="replace") as file:
            text = file.read(LOOK)
    except FileNotFoundError:
        raise table.no_file(path) from None
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}.") from error
    # The last line may be incomplete.
    whole = text if len(text) < LOOK else text.rpartition("\n")[0]
    # `splitlines` would also split at form feeds and Unicode line separators in a cell.
    lines = [line.rstrip("\n") for line in io.StringIO(whole, newline=None)]
    separator = _separator(lines[skip:])
    if skip is None:
        skip = _titles(lines, separator)
    found = [row for row in rows_of(lines[skip:], separator) if row]
    header, *rows = [*below_title(iter(found), list)] or [[]]
    under = found[found.index(header) + 1 : len(found) - len(rows)] if found else []
    decimal = "," if any(map(has_decimal_comma, chain.from_iterable(rows))) else "."
    formats = _time_formats(header, rows, decimal)
    return Written(separator, decimal, encoding, skip, formats, header, rows, *under[:1])


def _time_formats(
    header: Sequence[str], rows: Sequence[Sequence[str]], decimal: str
) -> tuple[str, ...]:
    """Return the date formats of the first named column with dates that are not in ISO format."""

    def is_dated(text: str) -> bool:
        timed = any(elapsed(text, form) is not None for form in ELAPSED)
        return not timed and number_of(text, decimal) is None

    for k in (k for k, name in enumerate(header) if name):
        cells = (row[k].strip() for row in rows if k < len(row))
        texts = list(filterfalse(is_missing, cells))
        if not texts or not is_dated(texts[0]):
            continue
        if formats := tuple(filter(None, date_formats(texts))):  # "" is ISO
            return formats
    return ()


def _separator(lines: Sequence[str]) -> str:
    """Return the separator of most lines: tab, semicolon, comma, or blanks between numbers."""
    # Tabs and semicolons come first, because commas may also be decimal marks.
    for mark in SEPARATORS:
        if max(multimode(line.count(mark) for line in lines if line.strip()), default=0):
            return mark
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    numbers = list(map(len, filter(_all_numbers, rows)))
    return BLANK if 2 * len(numbers) > len(rows) and min(numbers) > 1 else ","


def _all_numbers(cells: Sequence[str]) -> bool:
    return bool(cells) and all(map(_is_number, cells))


def _titles(lines: Sequence[str], separator: str) -> int:
    """Return the number of title lines at the start, which have fewer cells than most lines."""
    rows = [next(rows_of([line], separator), []) for line in lines]
    widths = list(map(_width, rows))
    # If several widths are equally frequent, the smallest one counts.
    usual = min(multimode(filter(None, widths)), default=0)
    start = next((k for k, found in enumerate(widths) if found >= usual), 0)
    names = rows[start] if rows else []
    above = zip(widths[:start], lines, strict=False)
    plain = all(found <= 1 or line.startswith("#") for found, line in above)
    titled = plain or are_labels(names)
    if not titled or any(number_of(name.strip(), ",") is not None for name in names):
        return 0  # the header itself is short
    return start + _is_comment_above(lines, rows, start)


def _is_comment_above(lines: Sequence[str], rows: Sequence[Sequence[str]], start: int) -> bool:
    """Return whether a line with as many cells as a row is a comment, with names below it."""
    below = rows[start + 1 : start + 2]
    return bool(below) and lines[start].startswith("#") and not any(map(_is_number, below[0]))


def _is_number(cell: str) -> bool:
    return number_of(cell.strip().replace(",", "."), ".") is not None


def _likely(content: bytes, encoding: str) -> str:
    """Return an encoding that can decode a text: the given one if possible."""
    try:
        content.decode(encoding)
        return encoding
    except UnicodeError:
        # Text that is not UTF-8 is usually from Windows; cp1252 decodes almost any bytes.
        wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return "utf-16" if wide else "cp1252" if encoding == UTF_8 else "utf-8"


def _as_written(
    path: Path, separator: str, encoding: str, clock: Clock, known: str, skip: int
) -> str:
    """Return the options that a file seems to require as text, beginning with a `known` option."""
    seems = how_written(path, encoding)
    divided = "separator" not in known and len(seems.header) > 1
    unlike = seems.separator != separator and separator not in "".join(seems.header)
    options = (
        (known, known),
        (f"skip = {seems.skip}", seems.skip > skip),
        (f"separator = {seems.separator!r}", divided and unlike),
        ("decimal = ','", clock.decimal == "." and seems.decimal == ","),
        (f"time_format = {seems.time_format!r}", seems.time_format and not clock.format),
    )
    said = [option for option, needed in options if needed]
    return " and ".join(filter(None, (", ".join(said[:-1]), said[-1])))


def _width(cells: Sequence[str]) -> int:
    """Return the number of cells up to the last nonempty cell."""
    return max((k for k, cell in enumerate(cells, start=1) if cell.strip()), default=0)


def unlike(cells: list[str], header: list[str], separator: str) -> bool:
    """Return whether the number of fields in a row does not fit the header.

    Empty fields at the end do not count. Fields between blanks cannot be empty, so that a shorter
    row lacks a field, or a name contains blanks.
    """
    if separator == BLANK and len(cells) < len(header):
        return True
    return len(cells) > len(header) and _width(cells) > _width(header)


def _cells(
    path: Path, needed: list[str], separator: str, encoding: str, clock: Clock, skip: int
) -> tuple[list[int], dict[str, tuple[str, ...]]]:
    """Return the numbers of the nonempty rows, and the texts in the needed columns.

    Refuses repeated column names, rows with more fields than names, and unclosed quotes.
    """
    with path.open(newline="", encoding=encoding) as file:
        whole = chain(islice(file, skip, None), [f"{END}\n"])
        lines = rows_of(whole, separator)
        written = (one for one in _whole(lines, skip + 1) if one[1])
        numbered = below_title(written, itemgetter(1))
        _, header = next(numbered, (0, []))
        _check_header(path, header, separator, encoding, clock, skip)
        _check_names(path, header, needed)
        places = [header.index(name) for name in needed]
        rows, found = list[int](), list[list[str]]()
        for number, row in numbered:
            if row[0].startswith("#"):  # a comment
                continue
            if unlike(row, header, separator):
                raise SampleError(
                    f"{path}, row {number}: {len(row)} fields, but the header has "
                    f"{len(header)}; decimals need a point, and fields with a "
                    f"{'blank' if separator == BLANK else 'comma'} in them quotes."
                )
            # Cells that are absent at the end of a row are empty.
            row += [""] * (len(header) - len(row))
            texts = [row[place] for place in places]
            if any(texts):
                rows.append(number)
                found.append(texts)
    return rows, dict(zip(needed, zip(*found, strict=True), strict=bool(found)))


def _check_names(path: Path, header: list[str], needed: list[str]) -> None:
    """Refuse a header that lacks a needed column or contains it twice."""
    table.check_columns(str(path), needed, header, told=path.suffix.lower() in table.SHOWN)
    for name in needed:
        if header.count(name) > 1:
            raise SampleError(f"{path}: two columns are called '{name}'; rename one.")


def _whole(lines: Iterable[list[str]], begin: int) -> Iterator[tuple[int, list[str]]]:
    """Yield row numbers and rows, without the line END that follows the last line.

    Raises `csv.Error` if END is not a separate row, since an unclosed quote includes it.
    """
    before: tuple[int, list[str]] | None = None
    for item in enumerate(lines, start=begin):
        if before is not None:
            yield before
        before = item
    if before is None or before[1] != [END]:
        raise csv.Error("a quote is not closed")


def _not_text(path: Path, separator: str, encoding: str, clock: Clock, skip: int) -> DataError:
    """Return the error for a file that is not text in this encoding."""
    content, row, byte = path.read_bytes(), 1, ""
    try:
        content.decode(encoding)
    except UnicodeDecodeError as error:
        row, byte = content.count(b"\n", 0, error.start) + 1, f"byte 0x{content[error.start]:02x} "
    likely = _likely(content, encoding)
    options = _as_written(path, separator, likely, clock, f"encoding = {likely!r}", skip)
    return DataError(
        f"{path} is not text in {encoding.removesuffix('-sig').upper()} ({byte}in row {row}): set "
        f"{options}, or save it as 'CSV UTF-8'."
    )


def _numbers(
    cells: Sequence[str],
    rows: Sequence[int],
    where: str,
    name: str,
    decimal: str,
    missing: Missing,
) -> Array:
    """Convert a column of texts to numbers; `rows` are needed for error messages only."""
    try:
        plain = cells if decimal == "." else [cell.translate(POINT) for cell in cells]
        # Converting all cells at once is fast. If it fails, single cells name the wrong one.
        found: Array = np.array([c if c else "nan" for c in plain], dtype=float)
        if any("_" in cell for cell in plain):
            raise ValueError("digits with a line between them")
    except ValueError:
        found = np.full(len(cells), np.inf)
    if np.isinf(found).any():
        found = np.array(
            [
                cell_number(cell, f"{where}, row {row}, column '{name}'", decimal, missing, cells)
                for cell, row in zip(cells, rows, strict=True)
            ]
        )
    return found
