"""Lines of a growing file, which may also be rotated, truncated, copied or rewritten.

A file is identified by its device and inode numbers and by its first bytes. Before and after each
read, the bytes before the read position are compared with the bytes read earlier. If they have
changed, the file counts as a new file, which is read from its start.
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

LONGEST = 1_000_000  # bytes of a line; longer lines are refused
CHUNK = 1 << 20  # bytes read at a time
CHUNKS = 16  # largest number of chunks per call: signals are handled between two calls
HEAD = 4096  # bytes at the start of a file that identify it
TAIL = 512  # bytes before the read position that are compared
NAP = 0.05  # seconds without changes after which a rewritten file is read
RESTLESS = 1.0  # seconds after which a rewritten file is read even if it still changes
HOLES = 60.0  # seconds after which NUL bytes inside a file are no longer expected to be filled
LINGER = 60.0  # seconds for which a rotated file is still read
MOST_KNOWN = 16  # largest number of files whose identity is stored
SIBLINGS = 1000  # largest number of files in a folder that are searched for rotated files
PACKED = (".gz", ".bz2", ".xz", ".zst", ".zip")
UTF_16 = (b"\xff\xfe", b"\xfe\xff")


class Line(NamedTuple):
    """A line of a file, or a message about the file."""

    number: int  # number of the file
    start: int  # offset of the line in the file
    content: bytes  # with its line end
    kind: str = ""  # kind of a message: "malformed", or "rewritten" if rows may be missing
    told: str = ""  # text of a message


class FilePosition(NamedTuple):
    """A position in a file, and the identity of the file."""

    start: int = 0  # read position: offset of the first unread byte
    crc: int = 0  # checksum of the bytes before it, at most the first HEAD
    inode: int = 0  # 0: unknown
    header: int = 0  # offset of the valid header

    @classmethod
    def read(cls, text: str) -> FilePosition | None:
        """Return the position that a text contains; None if the text is empty."""
        return cls(*map(int, text.split())) if text else None

    def __str__(self) -> str:
        return " ".join(map(str, self))


@dataclass(eq=False)
class _Content:
    """An open file and its read position."""

    path: Path
    file: io.FileIO
    number: int = 0
    offset: int = 0
    head: bytes = b""
    tail: bytes = b""
    skipping: bool = False  # whether the read position is inside a line that is too long
    hole: tuple[int, float] = (-1, 0.0)  # offset of the first NUL byte, and when it was found
    # For a rewritten file: time of its discovery, time of its last change, and its state then.
    restless: tuple[float, float, tuple[int, int]] | None = None
    # Last line that was read before the file was rewritten, and the offset after it.
    follows: tuple[bytes, int] | None = None

    @classmethod
    def open(cls, path: Path) -> _Content | None:
        """Open a file; return None if it does not exist; raise `DataError` if it is not a file."""
        try:
            # Opening a pipe without a writer would block.
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
        """Return the time of the last modification, and the size."""
        found = self.stat
        return found.st_mtime_ns, found.st_size

    def close(self) -> None:
        self.file.close()

    def at(self, start: int, count: int) -> bytes:
        """Return `count` bytes from the offset `start`, or fewer at the end."""
        found = b""
        self.file.seek(start)
        while len(found) < count:
            piece = self.file.read(count - len(found))
            if not piece:
                break
            found += piece
        return found

    def known(self, head: bytes, tail: bytes, offset: int) -> bool:
        """Return whether the file begins with `head` and has `tail` before an offset."""
        return (
            self.stat.st_size >= offset
            and self.at(0, len(head)) == head
            and self.at(offset - len(tail), len(tail)) == tail
        )

    def is_unchanged(self) -> bool:
        """Return whether the content before the read position is unchanged."""
        return self.known(self.head, self.tail, self.offset)

    def fits(self, place: FilePosition) -> bool:
        """Return whether a position may be in this file."""
        head = self.at(0, min(place.start, HEAD))
        return self.stat.st_size >= place.start and zlib.crc32(head) == place.crc

    def go_to(self, start: int) -> None:
        """Set the read position."""
        self.offset = start
        self.head = self.at(0, min(start, HEAD))
        count = min(start, TAIL)
        self.tail = self.at(start - count, count)
        self.skipping = False

    def settled(self, now: float) -> bool:
        """Return whether a rewritten file may be read, since it has not changed recently."""
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
        """Return the next complete lines; None if earlier content has changed.

        `grows`: the last line is incomplete without a line end, and NUL bytes may be filled later.
        """
        if not self.is_unchanged():
            return None
        found: list[Line] = []
        for _ in range(CHUNKS):
            before = self._written()
            chunk = self.at(self.offset, CHUNK)
            lines, used = self._split(chunk, grows)
            # The file may have been rewritten during the read.
            if not self.is_unchanged():
                return found or None
            # At the start there is no earlier content to compare, so any write counts.
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
        """Return a message if rows may be missing between a rewritten file and its old content.

        No row is missing if the file still contains the last line, such as in a moving window.
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
        """Return the lines of a chunk, and the number of their bytes."""
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
        """Return the offset in a chunk of NUL bytes that may still be filled, or -1."""
        hole = chunk.find(b"\0")
        if hole < 0 or (self.head or chunk).startswith(UTF_16):
            return -1
        place, now = self.offset + hole, time.monotonic()
        if self.hole[0] != place:
            self.hole = place, now
        # If rows follow after a long time, the NUL bytes are from a crash and will not be filled.
        ended = bool(chunk[hole:].strip(b"\0")) and now - self.hole[1] >= HOLES
        return -1 if ended else hole


@dataclass(eq=False)
class GrowingFile:
    """Lines of a file and of the files that replace it.

    A renamed file (rotated logs) is read to its end before the new file with its name, even if it
    was renamed twice between two reads, or while the program was not running. It is still read for
    a minute after that. A copy that was made before the file was emptied is treated likewise.
    """

    path: Path  # it need not exist yet
    grows: bool  # whether lines may be added
    place: FilePosition | None = None  # position at the end of an earlier session
    _now: _Content | None = field(default=None, init=False)
    _next: deque[_Content] = field(default_factory=deque, init=False)  # rotated files, unread
    _older: list[tuple[_Content, float]] = field(default_factory=list, init=False)
    # Number of each recent file -> its first bytes and inode number.
    _known: dict[int, tuple[bytes, int]] = field(default_factory=dict, init=False)
    _number: int = field(default=0, init=False)
    _left: tuple[int, int] = field(default=(0, 0), init=False)  # `here` when it was closed

    def lines(self) -> list[Line]:
        """Return the next lines, which may be none."""
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
        """Number of the current file and read position in it; (0, 0) before the first file."""
        return self._left if self._now is None else (self._now.number, self._now.offset)

    def place_of(self, number: int, start: int, header: int) -> FilePosition:
        """Return the position `start` in the file with a number."""
        head, inode = self._known.get(number, (b"", 0))
        if self._now is not None and self._now.number == number:
            head = self._now.head
        return FilePosition(start, zlib.crc32(head[:start]), inode, header)

    def before(self, start: int) -> list[bytes]:
        """Return the lines of the current file from an offset to the read position."""
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
        """Make a file the current file."""
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
        """Return whether a file was read: inode numbers are reused, so its content also counts."""
        inode = content.stat.st_ino
        heads = [head for head, number in self._known.values() if number == inode and head]
        return any(content.at(0, len(head)) == head for head in heads)

    def _opened(self) -> list[Line]:
        """Open the file at the position of an earlier session, else at its start."""
        place = self.place
        if place is not None and place.start and self._resumed(place):
            return []
        content = _Content.open(self.path)
        if content is None:
            return []  # it may be created later
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
        """Open the file of a position, which may be renamed; return whether it was found."""
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
        """Continue after the content of the current file has changed."""
        copy = self._copy_of(now)
        if copy is not None:
            self._begin(copy)
            now.close()
            return []
        again = _Content.open(now.path)
        if again is None:
            return []
        moment = time.monotonic()
        if now.stat.st_size >= now.offset:  # not truncated, so rewriting may be in progress
            again.restless = moment, moment, (0, 0)
        again.follows = now.follows
        if now.offset:
            again.follows = now.tail[now.tail.rstrip(b"\n").rfind(b"\n") + 1 :], now.offset
        self._begin(again)
        now.close()
        return []

    def _copy_of(self, now: _Content) -> _Content | None:
        """Return the copy of a file from before it was emptied, at the same read position."""

        def fits(copy: _Content) -> bool:
            return not self._was_read(copy) and copy.known(now.head, now.tail, now.offset)

        copy = _first(reversed(self._rotated()), fits) if now.offset else None
        if copy is not None:
            copy.go_to(now.offset)
        return copy

    def _ended(self, now: _Content) -> bool:
        """Switch to the next file if the current one was renamed; return whether it did."""
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
        """Yield the files that were rotated after a file, oldest first."""
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
        """Return lines that were added to files after they were renamed."""
        found: list[Line] = []
        for content, until in list(self._older):
            found += content.lines(True) or []
            if time.monotonic() >= until:
                content.close()
                self._older.remove((content, until))
        return found

    def _folder(self) -> list[Path]:
        """Return the other files in the folder of the file, oldest first."""
        found = []
        with os.scandir(self.path.parent) as entries:
            for entry in islice(entries, SIBLINGS):
                with suppress(OSError):
                    if entry.is_file(follow_symlinks=False) and entry.name != self.path.name:
                        found.append((entry.stat().st_mtime_ns, self.path.parent / entry.name))
        return [path for _, path in sorted(found)]

    def _rotated(self) -> list[Path]:
        """Return the files with names of rotated files, oldest first."""
        return [path for path in self._folder() if self._is_rotated(path)]

    def _is_rotated(self, path: Path) -> bool:
        """Return whether a name is like rows.csv.1, rows.csv-20260101, rows.1.csv, rows-26.csv."""
        stem, suffix = re.escape(self.path.stem), re.escape(self.path.suffix)
        dated = rf"{stem}[.\-_~][0-9T:.\-_]+{suffix}"
        after = rf"{re.escape(self.path.name)}[.\-_~].*"
        fits = re.fullmatch(f"{dated}|{after}", path.name)
        return fits is not None and not path.name.endswith(PACKED)


def _first(paths: Iterable[Path], fits: Callable[[_Content], bool]) -> _Content | None:
    """Open the first file that fits, or return None."""
    for path in paths:
        content = _Content.open(path)
        if content is not None:
            if fits(content):
                return content
            content.close()
    return None


def _inode(path: Path) -> int:
    """Return the inode number of a file, or -1 if it does not exist."""
    try:
        return path.stat().st_ino
    except OSError:
        return -1


def _begin_alike(one: _Content, other: _Content) -> bool:
    """Return whether two files have the same first line (a header), or contain JSON."""
    first, second = (content.at(0, HEAD) for content in (one, other))
    return first.startswith(b"{") or first.partition(b"\n")[0] == second.partition(b"\n")[0]
