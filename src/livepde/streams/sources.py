"""Sources of rows of a live process: a growing file, standard input, any iterator."""

from __future__ import annotations

import codecs
import csv
import io
import json
import os
import queue
import threading
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from livepde.errors import DataError
from livepde.streams.csvfile import UNDER, UTF_8, are_labels, is_title, too_wide
from livepde.streams.table import JSON_LINES, no_file

__all__ = ["Follow", "Lines", "Row", "RowSource", "Rows", "drained", "json_row"]

T = TypeVar("T")

LONGEST = 1_000_000  # characters of a line or message; longer ones are refused unread
BATCH = 100  # most rows of one poll
HEAD = 4096  # bytes at the start of a file that identify it
NAP = 0.05  # seconds between looks at a file that does not grow


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
        Reason why there are no values; '' if there are.
    """

    values: Mapping[str, Any]
    _: KW_ONLY
    token: Any = None
    broken: str = ""


class RowSource(Protocol):
    """A source of rows as they arrive; used from one thread.

    A subclass without a position, acknowledgements or resources takes the methods as they are here.
    """

    @property
    def done(self) -> bool:
        """True if nothing more will come."""

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the rows that are there, or after at most `wait` seconds none."""

    def position(self, waiting: Iterable[Any]) -> str:
        """Return the position before the rows with these tokens, which are still to be taken.

        A source created with it delivers those rows and all later ones; '' if the source itself
        remembers, or cannot go back.
        """
        return ""

    def acknowledge(self, tokens: Iterable[Any]) -> None:
        """Acknowledge rows that have been kept for good, by their tokens."""
        return

    def close(self) -> None:
        """Release its resources."""
        return


def json_row(text: str | bytes, token: Any = None) -> Row:
    """Return the row in a line of JSON: an object, column -> value."""
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
    """Return the items in a queue, at most a batch, or none after `wait` seconds."""
    found: list[T] = []
    while len(found) < BATCH:
        try:
            found.append(waiting.get(timeout=wait) if not found and wait else waiting.get_nowait())
        except queue.Empty:
            break
    return found


def _line(file: io.BufferedReader) -> bytes:
    """Return the next line; a line that is too long is cut after its limit."""
    line = piece = file.readline(LONGEST + 1)
    while len(piece) > LONGEST and not piece.endswith(b"\n"):
        piece = file.readline(LONGEST + 1)
    return line if piece is line else line + piece[-1:]


def _names(cells: list[str]) -> list[str]:
    """Return the header; of two columns with one name neither is taken: both are missing."""
    return [name if cells.count(name) == 1 else "" for name in cells]


class Follow(RowSource):
    """A CSV file with a header, or a file of JSON lines (.jsonl), also while it grows.

    The title of a logger (TOA5) and lines of units under the header are skipped.

    A line is read once its end has been written. A file that is replaced by another (rotated logs)
    is read to its end before the new one; one that has become shorter is read again from its start,
    where known rows are repeated. Unread rows of a file that was renamed are lost after a crash.

    Parameters
    ----------
    path
        The file; it need not exist yet if `follow`.
    separator, encoding
        Of a CSV file; an encoding in which the letters of English are single bytes.
    follow
        Wait for more at the end of the file.
    position
        Return value of the method `position`. Another file is read from its start.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        separator: str = ",",
        encoding: str = UTF_8,
        follow: bool = False,
        position: str = "",
    ) -> None:
        self.path = Path(path)
        self.follow = follow
        self._separator, self._encoding = separator, encoding
        self._json = self.path.suffix in JSON_LINES
        self._resumed = tuple(map(int, position.split())) if position else None
        self._file: io.BufferedReader | None = None
        self._number = 0  # of the file: 1 for the first, 2 for that which replaced it
        self._head = b""  # how the file begins, to know it again
        self._header: list[str] | None = None
        self._labels = 0  # lines under the header that may be labels
        self._offset = 0
        self._ended = False
        # Lines are told apart as bytes, before they are decoded.
        if b"a\n".decode(encoding, "replace") != "a\n":
            raise DataError(
                f"{self.path}: a file in {encoding} cannot be read while it grows; write it in "
                "UTF-8, or run it without --realtime when it is complete."
            )
        if not follow and not self.path.is_file():
            raise no_file(self.path)

    @property
    def done(self) -> bool:
        """True at the end of a file that is not followed."""
        return self._ended

    def poll(self, wait: float) -> Sequence[Row]:
        """Return the complete lines that are there."""
        until = time.monotonic() + wait
        while True:
            try:
                rows = self._read()
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
        """Return the place of the first line that still waits, or of the next one, and the file."""
        here = (start for number, start in waiting if number == self._number)
        start = min(here, default=self._offset)
        return f"{start} {zlib.crc32(self._head[:start])}"

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _read(self) -> list[Row]:
        if self._ended or (self._file is None and not self._opened()):
            return []
        rows = self._lines()
        if not rows and self._replaced() and self._opened():
            rows = self._lines()
        return rows

    def _opened(self) -> bool:
        """Open the file that is there now, at its start or where an earlier run has left it."""
        try:
            file = self.path.open("rb")
        except FileNotFoundError:
            return False
        self.close()
        self._file, self._header, self._head, self._offset = file, None, b"", 0
        self._labels = 0
        self._number += 1
        start, known = self._resumed or (0, 0)
        self._resumed = None
        # The same file if its beginning up to the position has the same checksum.
        head = file.read(HEAD)
        if start <= os.fstat(file.fileno()).st_size and zlib.crc32(head[:start]) == known:
            if not self._json and start:
                self._read_header(file, start)
            self._head, self._offset = head[:start], start
        return True

    def _read_header(self, file: io.BufferedReader, start: int) -> None:
        """Read the header, and labels under it, from the lines before a position."""
        file.seek(0)
        while file.tell() < start and (self._header is None or self._labels):
            self._row(_line(file), None)

    def _replaced(self) -> bool:
        """Return whether another file has the name now, or this one has become shorter."""
        try:
            named = self.path.stat()
        except FileNotFoundError:
            return False
        if self._file is None:
            return False
        mine = os.fstat(self._file.fileno())
        return (named.st_dev, named.st_ino) != (mine.st_dev, mine.st_ino) or (
            named.st_size < self._offset
        )

    def _lines(self) -> list[Row]:
        """Return the rows of the next lines that are ended."""
        rows: list[Row] = []
        if self._file is None:
            return rows
        self._file.seek(self._offset)
        while len(rows) < BATCH:
            start = self._offset
            # A line without its end is still being written.
            line = _line(self._file)
            if not line or (self.follow and not line.endswith(b"\n")):
                break
            self._offset = self._file.tell()
            self._head += line[: HEAD - len(self._head)]
            row = self._row(line, (self._number, start))
            if row is not None:
                rows.append(row)
        return rows

    def _row(self, line: bytes, token: Any) -> Row | None:
        if not line.strip():
            return None
        if self._json:
            return json_row(line, token)
        if len(line) > LONGEST:
            return Row({}, token=token, broken=f"longer than {LONGEST} characters")
        try:
            cells = self._cells(line)
        except (UnicodeError, csv.Error) as error:
            self._labels = 0  # rows have begun
            if self._head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
                return Row(
                    {}, token=token, broken="the file is in UTF-16, not to be followed: write UTF-8"
                )
            return Row({}, token=token, broken=f"not a line of a CSV file ({type(error).__name__})")
        if self._header is None:
            if is_title(cells):
                return None
            self._header, self._labels = _names(cells), UNDER
            twice = sorted(set(cells) - set(self._header))
            text = "two columns are called '{}', and none of them is taken: rename one"
            return Row({}, token=token, broken=text.format(twice[0])) if twice else None
        if self._labels:
            labels = are_labels(cells)
            self._labels = self._labels - 1 if labels else 0
            if labels:
                return None
        if too_wide(cells, self._header):
            text = f"{len(cells)} fields, the header has {len(self._header)}"
            return Row({}, token=token, broken=text)
        return Row(dict(zip(self._header, cells, strict=False)), token=token)

    def _cells(self, line: bytes) -> list[str]:
        text = line.decode(self._encoding)
        found = csv.reader([text], delimiter=self._separator, skipinitialspace=True)
        return [cell.strip() for cell in next(found, [])]


class Lines(RowSource):
    """JSON lines from standard input, or whatever gives lines; read in a thread of its own."""

    def __init__(self, lines: Iterable[str]) -> None:
        self._queue: queue.Queue[str | bytes | None] = queue.Queue(BATCH)
        self._ended = False
        threading.Thread(target=self._pump, args=(lines,), daemon=True).start()

    def _pump(self, lines: Iterable[str]) -> None:
        stream: Any = getattr(lines, "buffer", lines)  # bytes: what is no text is a broken row
        try:
            pieces = stream
            if hasattr(stream, "readline"):  # an endless line comes in pieces, refused one by one
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
        """Return the lines that have come."""
        if self._ended:
            return []
        lines = drained(self._queue, wait)
        self._ended = None in lines
        return [json_row(line) for line in lines if line is not None]


class Rows(RowSource):
    """Rows from a Python iterator of mappings, column -> value."""

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
