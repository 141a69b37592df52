"""Sources of rows of a live process: a growing file, standard input, any iterator."""

from __future__ import annotations

import csv
import json
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, Protocol, TypeVar

from livepde.errors import DataError
from livepde.streams.csvfile import UNDER, UTF_8, are_labels, is_title, rows_of, unlike
from livepde.streams.growing_file import LONGEST, UTF_16, FilePosition, GrowingFile, Line
from livepde.streams.table import JSON_LINES, no_file

T = TypeVar("T")

BATCH = 100  # largest number of rows per poll
HEADERS = 16  # largest number of stored headers
NAP = 0.05  # seconds between two checks of a file that does not grow


@dataclass(frozen=True)
class Row:
    """A row of a source.

    Attributes
    ----------
    values
        Column -> value.
    token
        Token by which the source identifies the row.
    broken
        Reason why there are no values; '' if there are values.
    kind
        Kind of the remark on a row without values: "malformed"; "rewritten": rows before it may be
        missing, since the file was replaced; "header": the columns have changed.
    """

    values: Mapping[str, Any]
    _: KW_ONLY
    token: Any = None
    broken: str = ""
    kind: str = "malformed"


class RowSource(Protocol):
    """A source of rows as they arrive; used from a single thread.

    The default methods suit a source without a position, acknowledgements or resources.
    """

    @property
    def done(self) -> bool:
        """True if there will be no more rows."""

    @property
    def steady(self) -> bool:
        """Whether unchanged values are sent too, so that a lack of rows is a fault."""
        return True

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the available rows, possibly none, after at most `wait` seconds."""

    def position(self, waiting: Iterable[Any]) -> str:
        """Return the position before the rows with these tokens, which are not yet processed.

        A source that is created with this position delivers these and all later rows. It is '' if
        the source itself stores its position, or cannot go back.
        """
        return ""

    def acknowledge(self, tokens: Iterable[Any]) -> None:
        """Acknowledge rows that are safely stored, by their tokens."""
        return

    def close(self) -> None:
        """Release the resources of the source."""
        return


def json_row(text: str | bytes, token: Any = None) -> Row:
    """Parse a row from a line of JSON, an object with column -> value."""
    if len(text) > LONGEST:
        return Row({}, token=token, broken=f"longer than {LONGEST} characters")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        return Row({}, token=token, broken=f"not JSON ({type(error).__name__})")
    if not isinstance(found, dict):
        return Row({}, token=token, broken="not an object, column -> value")
    return Row(found, token=token)


def drained(waiting: queue.Queue[T], wait: float) -> list[T]:
    """Return up to a batch of items from a queue, or none after `wait` seconds."""
    found: list[T] = []
    while len(found) < BATCH:
        try:
            found.append(waiting.get(timeout=wait) if not found and wait else waiting.get_nowait())
        except queue.Empty:
            break
    return found


class Follow(RowSource):
    """Rows of a CSV file with a header or of a file of JSON lines (.jsonl), which may grow.

    The title of a logger (TOA5), lines of units under the header and lines that begin with # are
    skipped. A line is read after its end has been written. If a header appears again, its columns
    apply to the following rows.

    Changes of the file are described in `livepde.streams.growing_file`: a renamed file is read to
    its end before the new file. A truncated or rewritten file is read from its start, so that known
    rows are repeated. If rows may be missing, a row without values reports it.

    Parameters
    ----------
    path
        Path of the file, which need not exist yet if `follow`.
    separator, encoding
        Format of a CSV file; ASCII characters must be single bytes in the encoding.
    skip
        Number of lines before the header.
    times
        Columns whose joined texts are the time, which gets the first of these names.
    follow
        Whether to wait for more rows at the end of the file.
    position
        Return value of the method `position`. A different file is read from its start.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        separator: str = ",",
        encoding: str = UTF_8,
        skip: int = 0,
        times: Sequence[str] = (),
        follow: bool = False,
        position: str = "",
    ) -> None:
        self.path = Path(path)
        self.follow = follow
        self._separator, self._encoding = separator, encoding
        self._json = self.path.suffix in JSON_LINES
        self._skip, self._times = 0 if self._json else skip, tuple(times)
        self._resumed = FilePosition.read(position)
        self._file = GrowingFile(self.path, follow, self._resumed)
        self._ready: deque[Line] = deque()
        self._number = 0  # number of the current file
        self._headers: dict[tuple[int, int], list[str]] = {}  # file number and offset -> columns
        self._header: list[str] | None = None
        self._above = 0  # number of lines left above the header
        self._labels = 0  # number of next lines that may be labels
        self._ended = False
        # Lines are separated as bytes, before they are decoded.
        if b"a\n".decode(encoding, "replace") != "a\n":
            raise DataError(
                f"{self.path}: a file in {encoding} cannot be read while it grows; write it in "
                "UTF-8, or run it without --realtime when it is complete."
            )
        if not follow and not self.path.exists():
            raise no_file(self.path)

    @property
    def done(self) -> bool:
        """True at the end of a file that is not followed."""
        return self._ended

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the rows of the complete lines, possibly none, after at most `wait` seconds."""
        until = time.monotonic() + wait
        while True:
            try:
                rows = self._rows()
            except OSError as error:
                text = f"{self.path} cannot be read: {error.strerror or error}."
                raise DataError(text) from error
            if rows or self._ended:
                return rows
            if not self.follow:
                self._ended = True
                self.close()
                return rows
            if time.monotonic() >= until:
                return rows
            time.sleep(min(NAP, wait))

    def position(self, waiting: Iterable[Any]) -> str:
        """Return the position of the first waiting line, else of the next line."""
        if self._resumed is not None:
            return str(self._resumed)  # no line was read yet
        following = [(line.number, line.start) for line in islice(self._ready, 1)]
        number, start = min(chain(waiting, following), default=self._file.here)
        headers = [at for of, at in self._headers if of == number and at <= start]
        return str(self._file.place_of(number, start, max(headers, default=0)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _rows(self) -> list[Row]:
        """Return the next rows, which may be none."""
        rows: list[Row] = []
        while len(rows) < BATCH and not self._ended:
            if not self._ready:
                self._ready.extend(self._file.lines())
            if not self._ready:
                break
            line = self._ready.popleft()
            if line.number != self._number:
                self._enter(line)
            row = self._row(line)
            if row is not None:
                rows.append(row)
        return rows

    def _enter(self, line: Line) -> None:
        """Begin with the lines of another file, after a resume with its header."""
        self._number, self._header = line.number, None
        self._above, self._labels = self._skip, 0
        resumed, self._resumed = self._resumed, None
        if any(number == line.number for number, _ in self._headers):
            # This line was added to an earlier file.
            self._header = self._headers[max(at for at in self._headers if at[0] == line.number)]
            self._above = 0
        elif line.start and not self._json:
            self._read_header(line, resumed.header if resumed is not None else 0)
        for place in list(self._headers)[:-HEADERS]:
            del self._headers[place]

    def _read_header(self, line: Line, at: int) -> None:
        """Read the header at an offset, and labels under it, from the content before a line."""
        self._above = 0 if at else self._skip
        for content in self._file.before(at):
            if at >= line.start or (self._header is not None and not self._labels):
                return
            self._row(Line(line.number, at, content))
            at += len(content)

    def _row(self, line: Line) -> Row | None:
        token = line.number, line.start
        if line.kind:
            return Row({}, token=token, broken=line.told, kind=line.kind)
        content = line.content
        if self._above:
            self._above -= 1
            return None
        if not content.strip():
            return None
        if b"\0" in content and self.follow and not content.startswith(UTF_16):
            return Row({}, token=token, broken="NUL bytes instead of a row")
        if self._json:
            return json_row(content, token)
        try:
            text = content.decode(self._encoding)
            found = rows_of([text], self._separator, headed=self._header is not None)
            cells = list(map(str.strip, next(found, [""])))
        except (UnicodeError, csv.Error) as error:
            self._labels = 0  # rows have begun
            why = f"not a line of a CSV file ({type(error).__name__})"
            if content.startswith(UTF_16):
                why = "the file is in UTF-16, not to be followed: write UTF-8"
            return Row({}, token=token, broken=why)
        return self._row_of(cells, token)

    def _row_of(self, cells: list[str], token: tuple[int, int]) -> Row | None:
        """Return the row of a line's cells; None for a header, labels or a comment."""
        if self._header is None:
            return None if is_title(cells) else self._headed(cells, token)
        if cells[0].startswith("#"):
            return None
        if self._labels and are_labels(cells):
            self._labels -= 1
            return None
        self._labels = 0
        if self._is_header(cells):
            return self._headed(cells, token)
        if unlike(cells, self._header, self._separator):
            text = f"{len(cells)} fields, the header has {len(self._header)}"
            return Row({}, token=token, broken=text)
        values = dict(zip(self._header, cells, strict=False))
        if len(self._times) > 1 and values.keys() >= {*self._times}:
            values[self._times[0]] = " ".join(map(values.__getitem__, self._times))
        return Row(values, token=token)

    def _is_header(self, cells: list[str]) -> bool:
        """Return whether a line contains most of the names in the header."""
        names = {name for name in self._header or () if name}
        found = len(names.intersection(cells))
        return 2 * found > len(names) or (found > 0 and found == len(names))

    def _headed(self, cells: list[str], token: tuple[int, int]) -> Row | None:
        """Use a line as header; return a row that reports an invalid or different header."""
        before, self._labels = self._header, UNDER
        # Two columns with the same name are both ignored.
        self._header = [name if cells.count(name) == 1 else "" for name in cells]
        self._headers[token] = self._header
        if twice := sorted(set(cells) - set(self._header)):
            text = f"two columns are called '{twice[0]}', and neither is used: rename one"
            return Row({}, token=token, broken=text)
        if before is None or before == self._header:
            return None
        text = f"the header appears again with other columns: {', '.join(cells)}"
        return Row({}, token=token, broken=text, kind="header")


class Lines(RowSource):
    """Rows of JSON lines from standard input or any iterable, which is read in its own thread."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._queue: queue.Queue[str | bytes | None] = queue.Queue(BATCH)
        self._ended = False
        threading.Thread(target=self._pump, args=(lines,), daemon=True).start()

    def _pump(self, lines: Iterable[str]) -> None:
        stream: Any = getattr(lines, "buffer", lines)  # bytes: invalid text becomes a broken row
        try:
            pieces = stream
            if hasattr(stream, "readline"):  # a line that is too long is refused in pieces
                pieces = iter(lambda: stream.readline(LONGEST + 1) or None, None)
            for line in pieces:
                if line.strip():
                    self._queue.put(line)
        finally:
            self._queue.put(None)

    @property
    def done(self) -> bool:
        """True when the lines have ended."""
        return self._ended

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the rows of the lines that have arrived."""
        if self._ended:
            return []
        lines = drained(self._queue, wait)
        self._ended = None in lines
        return [json_row(line) for line in lines if line is not None]


class Rows(RowSource):
    """Rows from an iterable of mappings, column -> value."""

    def __init__(self, rows: Iterable[Mapping[str, Any]]) -> None:
        self._rows = iter(rows)
        self._ended = False

    @property
    def done(self) -> bool:
        """True when the iterator has ended."""
        return self._ended

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the next row."""
        for values in self._rows:
            return [Row(values)]
        self._ended = True
        return []
