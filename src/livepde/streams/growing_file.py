"""The lines of a file that grows, whatever becomes of it: rotated, cut, copied, or written again.

A file is known by its device and inode numbers and by its first bytes. Before and after each look
the bytes before the place of reading are compared with those that were read: what has changed under
its name is another file, which is read from its start.
"""

from __future__ import annotations

import io
import os
import re
import stat
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

from livepde.errors import DataError

LONGEST = 1_000_000  # bytes of a line; longer ones are refused unread
CHUNK = 1 << 20  # bytes that are read at once
CHUNKS = 16  # of one look: a signal is heard between two looks
HEAD = 4096  # bytes at the start of a file that identify it
TAIL = 512  # bytes before the place of reading that are compared
NAP = 0.05  # seconds for which a file that was written again must not have changed
RESTLESS = 1.0  # seconds after which a file is read that changes at each look
HOLES = 60.0  # seconds after which NUL bytes amid a file are no longer expected to be filled
LINGER = 60.0  # seconds for which a file that was rotated is still looked at
MOST_KNOWN = 16  # files whose places are known
SIBLINGS = 1000  # files of a folder among which rotated ones are looked for
PACKED = (".gz", ".bz2", ".xz", ".zst", ".zip")
UTF_16 = (b"\xff\xfe", b"\xfe\xff")


class Line(NamedTuple):
    """A line of a file, or an event of it."""

    number: int  # of the file
    start: int  # first byte of the line in it
    content: bytes  # with its end
    kind: str = ""  # if there is no line: "malformed", or "rewritten" where rows may be missing
    told: str = ""


class FilePosition(NamedTuple):
    """A place in a file, and the mark of the file."""

    start: int = 0  # byte before which all was read
    crc: int = 0  # checksum of the first bytes before it
    inode: int = 0  # 0: unknown
    header: int = 0  # byte at which the header in effect begins

    @classmethod
    def read(cls, text: str) -> FilePosition | None:
        """Return the place in a text; None if there is none."""
        return cls(*map(int, text.split())) if text else None

    def __str__(self) -> str:
        return " ".join(map(str, self))


@dataclass(eq=False)
class _Content:
    """An open file, read up to an offset."""

    path: Path
    file: io.FileIO
    number: int = 0
    offset: int = 0
    head: bytes = b""
    tail: bytes = b""
    skipping: bool = False  # inside a line that is too long
    hole: tuple[int, float] = (-1, 0.0)  # where NUL bytes were seen first, and when
    # Of a file that was written again: when it was seen first, last as it is, and how it was.
    restless: tuple[float, float, tuple[int, int]] | None = None
    # Last line that was read before the file was written again, and the byte after it.
    follows: tuple[bytes, int] | None = None

    @classmethod
    def open(cls, path: Path) -> _Content | None:
        """Open a file, None if there is none; raises `DataError` if it is not a file."""
        try:
            # To open a pipe without a writer would hold the program up.
            if not stat.S_ISREG(path.stat().st_mode):
                raise DataError(
                    f"{path} is a device, a pipe or a folder, not a file: name a file, or send "
                    "lines of JSON to standard input with --data -."
                )
            return cls(path, path.open("rb", buffering=0))
        except FileNotFoundError:
            return None

    @property
    def stat(self) -> os.stat_result:
        return os.fstat(self.file.fileno())

    def _written(self) -> tuple[int, int]:
        """Return when the file was written last, and its size."""
        found = self.stat
        return found.st_mtime_ns, found.st_size

    def close(self) -> None:
        self.file.close()

    def at(self, start: int, count: int) -> bytes:
        """Return some bytes from a place on."""
        found = b""
        self.file.seek(start)
        while len(found) < count:
            piece = self.file.read(count - len(found))
            if not piece:
                break
            found += piece
        return found

    def known(self, head: bytes, tail: bytes, offset: int) -> bool:
        """Return whether the file has these bytes before an offset."""
        return (
            self.stat.st_size >= offset
            and self.at(0, len(head)) == head
            and self.at(offset - len(tail), len(tail)) == tail
        )

    def is_unchanged(self) -> bool:
        """Return whether the lines that were read are still there."""
        return self.known(self.head, self.tail, self.offset)

    def fits(self, place: FilePosition) -> bool:
        """Return whether a place may be in this file."""
        head = self.at(0, min(place.start, HEAD))
        return self.stat.st_size >= place.start and zlib.crc32(head) == place.crc

    def go_to(self, start: int) -> None:
        """Continue from a place."""
        self.offset = start
        self.head = self.at(0, min(start, HEAD))
        count = min(start, TAIL)
        self.tail = self.at(start - count, count)
        self.skipping = False

    def settled(self, now: float) -> bool:
        """Return whether a file that was written again may be read: it has not changed lately."""
        if self.restless is None:
            return True
        begun, since, before = self.restless
        seen = self._written()
        if seen != before:
            since = now
        self.restless = begun, since, seen
        if now - since < NAP and now - begun < RESTLESS:
            return False
        self.restless = None
        return True

    def lines(self, grows: bool) -> list[Line] | None:
        """Return the next lines that are ended; None if the file was changed.

        `grows`: the last line needs its end, and NUL bytes may still be filled.
        """
        if not self.is_unchanged():
            return None
        found: list[Line] = []
        for _ in range(CHUNKS):
            before = self._written()
            chunk = self.at(self.offset, CHUNK)
            lines, used = self._split(chunk, grows)
            # What was written meanwhile may have changed the bytes that were just read.
            if not self.is_unchanged():
                return found or None
            # Nothing was read before, so nothing shows that.
            if not self.offset and self._written() != before:
                break
            if used:
                found += self._missed(chunk)
            read = chunk[:used]
            self.offset += used
            self.head += read[: HEAD - len(self.head)]
            self.tail = (self.tail + read[-TAIL:])[-TAIL:]
            found += lines
            if found or not used:
                break
        return found

    def _missed(self, chunk: bytes) -> list[Line]:
        """Return a report if rows may be missing between a file and its earlier content.

        Where the last line is still there, as in a window of rows that moves on, none is missing.
        """
        last, offset = self.follows or (b"", 0)
        self.follows = None
        if not last or last in chunk:
            return []
        text = (
            f"{self.path.name} was rewritten; rows that appeared and disappeared after byte "
            f"{offset} between two reads are lost"
        )
        return [Line(self.number, 0, b"", "rewritten", text)]

    def _split(self, chunk: bytes, grows: bool) -> tuple[list[Line], int]:
        """Return the lines of a chunk, and how many of its bytes they are."""
        end, start, found = len(chunk), 0, list[Line]()
        if grows and (hole := self._hole(chunk)) >= 0:
            end = hole
        if self.skipping:
            start = chunk.find(b"\n", 0, end) + 1
            if not start:
                return [], end
            self.skipping = False
        while (stop := chunk.find(b"\n", start, end) + 1) > 0:
            found.append(self._line(start, chunk[start:stop]))
            start = stop
        if end - start > LONGEST:
            found.append(self._line(start, chunk[start:end]))
            self.skipping, start = True, end
        elif not grows and end < CHUNK and start < end:  # the last line of a complete file
            found.append(self._line(start, chunk[start:end]))
            start = end
        return found, start

    def _line(self, start: int, content: bytes) -> Line:
        if len(content) > LONGEST:
            told = f"longer than {LONGEST} characters"
            return Line(self.number, self.offset + start, b"", "malformed", told)
        return Line(self.number, self.offset + start, content)

    def _hole(self, chunk: bytes) -> int:
        """Return where NUL bytes begin that are still to be filled; -1 without."""
        hole = chunk.find(b"\0")
        if hole < 0 or (self.head or chunk).startswith(UTF_16):
            return -1
        place, now = self.offset + hole, time.monotonic()
        if self.hole[0] != place:
            self.hole = place, now
        # Rows are written after what was lost in a crash: it will not be filled.
        ended = bool(chunk[hole:].strip(b"\0")) and now - self.hole[1] >= HOLES
        return -1 if ended else hole


@dataclass(eq=False)
class GrowingFile:
    """The lines of a file, and of those that replace it.

    A file that is renamed (rotated logs) is read to its end before the new one of its name, also
    where it was renamed twice between two looks, or while the program was away; for a minute it is
    still looked at. A copy that was made before the file was emptied is found in the same way.
    """

    path: Path  # it need not exist yet
    grows: bool  # whether lines may be added
    place: FilePosition | None = None  # where an earlier session has stopped
    _now: _Content | None = field(default=None, init=False)
    _next: deque[_Content] = field(default_factory=deque, init=False)  # rotated, to be read
    _older: list[tuple[_Content, float]] = field(default_factory=list, init=False)
    # Number -> first bytes and inode number of the last files.
    _known: dict[int, tuple[bytes, int]] = field(default_factory=dict, init=False)
    _number: int = field(default=0, init=False)
    _left: tuple[int, int] = field(default=(0, 0), init=False)  # where it was closed

    def lines(self) -> list[Line]:
        """Return the next lines, or none."""
        told = self._opened() if self._now is None else []
        now = self._now
        if told or now is None:
            return told
        if found := self._older_lines():
            return found
        if not now.settled(time.monotonic()):
            return []
        lines = now.lines(self.grows)
        if lines is None:
            return self._changed(now)
        if not lines and self._ended(now):
            return self.lines()
        return lines

    @property
    def here(self) -> tuple[int, int]:
        """Number of the file that is read, and the offset in it; (0, 0) before any."""
        return self._left if self._now is None else (self._now.number, self._now.offset)

    def place_of(self, number: int, start: int, header: int) -> FilePosition:
        """Return a place in one of the files."""
        head, inode = self._known.get(number, (b"", 0))
        if self._now is not None and self._now.number == number:
            head = self._now.head
        return FilePosition(start, zlib.crc32(head[:start]), inode, header)

    def before(self, start: int) -> list[bytes]:
        """Return the lines of the file that is read from a place to where it is read."""
        if self._now is None:
            return []
        count = min(self._now.offset - start, CHUNK)
        return self._now.at(start, count).splitlines(keepends=True)

    def close(self) -> None:
        """Close all files."""
        if self._now is not None:
            self._remember(self._now)
            self._left = self.here
        for content in (self._now, *self._next, *(older for older, _ in self._older)):
            if content is not None:
                content.close()
        self._now = None
        self._next.clear()
        self._older.clear()

    def _begin(self, content: _Content) -> None:
        """Read a file from now on."""
        if self._now is not None:
            self._remember(self._now)
        self._number += 1
        content.number, self._now = self._number, content
        self._remember(content)
        while len(self._known) > MOST_KNOWN:
            del self._known[min(self._known)]

    def _remember(self, content: _Content) -> None:
        self._known[content.number] = content.head, content.stat.st_ino

    def _was_read(self, content: _Content) -> bool:
        """Return whether a file has been read; its number alone may be that of a deleted one."""
        inode = content.stat.st_ino
        heads = [head for head, number in self._known.values() if number == inode and head]
        return any(content.at(0, len(head)) == head for head in heads)

    def _opened(self) -> list[Line]:
        """Open the file that is there now, at its start or where an earlier session has left it."""
        place = self.place
        if place is not None and place.start and self._resumed(place):
            return []
        content = _Content.open(self.path)
        if content is None:
            return []  # it may still come
        self._begin(content)
        self.place = None
        if place is None or not place.start:
            return []
        text = (
            f"{self.path.name} was replaced by another file; rows after byte {place.start} of the "
            "earlier file are lost"
        )
        return [Line(content.number, 0, b"", "rewritten", text)]

    def _resumed(self, place: FilePosition) -> bool:
        """Open the file of a place, under its name or another one; return whether it is there."""
        others = (
            path for path in self._folder() if _inode(path) == place.inode or self._is_rotated(path)
        )
        content = _first(chain([self.path], others), lambda each: each.fits(place))
        if content is None:
            return False
        content.go_to(place.start)
        self._begin(content)
        return True

    def _changed(self, now: _Content) -> list[Line]:
        """Continue with a file whose content was changed."""
        copy = self._copy_of(now)
        if copy is not None:
            self._begin(copy)
            now.close()
            return []
        again = _Content.open(now.path)
        if again is None:
            return []
        moment = time.monotonic()
        if now.stat.st_size >= now.offset:  # it was not cut, so old rows may still be replaced
            again.restless = moment, moment, (0, 0)
        again.follows = now.follows
        if now.offset:
            again.follows = now.tail[now.tail.rstrip(b"\n").rfind(b"\n") + 1 :], now.offset
        self._begin(again)
        now.close()
        return []

    def _copy_of(self, now: _Content) -> _Content | None:
        """Return the copy of a file that was made before it was emptied, where it was read to."""

        def fits(copy: _Content) -> bool:
            return not self._was_read(copy) and copy.known(now.head, now.tail, now.offset)

        copy = _first(reversed(self._rotated()), fits) if now.offset else None
        if copy is not None:
            copy.go_to(now.offset)
        return copy

    def _ended(self, now: _Content) -> bool:
        """Go over to the next file if this one has another name now; return whether it did."""
        try:
            named = self.path.stat()
        except FileNotFoundError:
            return False
        if os.path.samestat(named, now.stat):
            return False
        if not self._next:
            self._remember(now)
            self._next.extend(self._between(now))
        following = self._next.popleft() if self._next else _Content.open(self.path)
        if following is None:
            return False
        self._begin(following)
        self._older.append((now, time.monotonic() + LINGER))
        return True

    def _between(self, now: _Content) -> Iterator[_Content]:
        """Iterate over the files that were rotated after a file, the oldest first."""
        since = now.stat.st_mtime_ns
        for path in self._rotated():
            found = _Content.open(path)
            if found is None:
                continue
            later = found.stat.st_mtime_ns >= since and not self._was_read(found)
            if later and _begin_alike(now, found):
                yield found
            else:
                found.close()

    def _older_lines(self) -> list[Line]:
        """Return lines that a writer has added to a file after it was renamed."""
        found: list[Line] = []
        for content, until in list(self._older):
            found += content.lines(True) or []
            if time.monotonic() >= until:
                content.close()
                self._older.remove((content, until))
        return found

    def _folder(self) -> list[Path]:
        """Return the other files in the folder of this one, the oldest first."""
        found = []
        with os.scandir(self.path.parent) as entries:
            for entry in islice(entries, SIBLINGS):
                with suppress(OSError):
                    if entry.is_file(follow_symlinks=False) and entry.name != self.path.name:
                        found.append((entry.stat().st_mtime_ns, self.path.parent / entry.name))
        return [path for _, path in sorted(found)]

    def _rotated(self) -> list[Path]:
        """Return the files whose names are those of rotated ones, the oldest first."""
        return [path for path in self._folder() if self._is_rotated(path)]

    def _is_rotated(self, path: Path) -> bool:
        """Return whether a name is as rows.csv.1, rows.csv-20260101, rows.1.csv, rows-2026.csv."""
        stem, suffix = re.escape(self.path.stem), re.escape(self.path.suffix)
        dated = rf"{stem}[.\-_~][0-9T:.\-_]+{suffix}"
        after = rf"{re.escape(self.path.name)}[.\-_~].*"
        fits = re.fullmatch(f"{dated}|{after}", path.name)
        return fits is not None and not path.name.endswith(PACKED)


def _first(paths: Iterable[Path], fits: Callable[[_Content], bool]) -> _Content | None:
    """Open the first file that fits, None if there is none."""
    for path in paths:
        content = _Content.open(path)
        if content is not None:
            if fits(content):
                return content
            content.close()
    return None


def _inode(path: Path) -> int:
    """Return the inode number of a file, -1 if it is gone."""
    try:
        return path.stat().st_ino
    except OSError:
        return -1


def _begin_alike(one: _Content, other: _Content) -> bool:
    """Return whether two files have the same first line, as a header, or are JSON."""
    first, second = (content.at(0, HEAD) for content in (one, other))
    return first.startswith(b"{") or first.partition(b"\n")[0] == second.partition(b"\n")[0]
