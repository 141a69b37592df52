"""The journal of a run: samples, estimates and checkpoints in one file that survives a kill.

The file is an SQLite database in write-ahead mode. Samples, each with the position of its source,
and estimates are committed in groups, which the run determines (`Live`). Checkpoints store the
state of the identifier at intervals. After a crash at any time, the last checkpoint, the samples
after it and the rows from the last position on reproduce the same numbers. One process writes, and
any number of processes may read at the same time.

The journal is append-only: only `thin` and withdrawals remove samples and estimates. If the process
is killed, no record is lost. A power cut leaves the file intact, but may lose the most recent
samples: a sync to disk for each sample would take longer than its step.

Each record has a checksum, which is verified on each read. SQLite checks the pages of the file when
a writer opens it, and when estimates are read from the first one on. Damage raises `RunError`.
After a failed write (a full disk) a journal accepts no further records, so that no checkpoint can
skip lost samples; `reopen` or a new writer continues from the last commit.
"""

from __future__ import annotations

import json
import logging
import math
import sqlite3
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from filelock import FileLock

from livepde.atomic_write import replacing
from livepde.errors import RunError
from livepde.linalg import Array
from livepde.records import STATUS_CODES, Layout, Record, RecordArrays, Snapshot
from livepde.runs.database import (
    AGAIN,
    SCHEMA,
    Connection,
    check_file,
    checksum,
    damaged,
    database_failure,
    fill,
    locked,
    reader,
    released,
    remedy_of,
    sound,
    writer,
)
from livepde.samples import noise_channel

if TYPE_CHECKING:
    import xarray as xr

LOG = logging.getLogger("livepde.run")
FORMAT = 4
MEMORY = Path(":memory:")
KEPT_CHECKPOINTS = 2
KEPT_EVENTS = 10_000
FEW = 64  # largest number of samples that are compared to recognise a repeated row
TOGETHER = 1000  # records per query: a slow reader must not block the writer
LONGEST = 2000  # characters of the message of an event
UNLESS_KNOWN = "INSERT OR IGNORE"  # keeps an existing record with the same key

ESTIMATES = (
    "SELECT id, t, status, steps, numbers, notes, estimates.crc, last, content, fields.crc "
    "FROM estimates LEFT JOIN fields USING (id) WHERE "
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Taken:
    """An accepted sample: its number, its time and the values of all channels (NaN: missing).

    If its readings have a noise, `values` also contains it, under the names of `noise_channel`.
    """

    id: int
    t: float
    values: dict[str, float]


@dataclass(frozen=True)
class Event:
    """An event of a run: model time, kind, channel (may be empty) and message."""

    t: float
    kind: str
    channel: str
    message: str


class Journal:
    """The journal of a run; `create` makes a new journal, `open` opens an existing one.

    Attributes
    ----------
    path
        The SQLite file.
    channels
        Names of all channels of a sample, in storage order.
    noise
        Names of the noise of each channel; samples with noise store it after their channels.
    layout
        Names, units and coordinates of the numbers of the records.

    Raises
    ------
    RunError
        Another process writes the file; it is of another version, damaged, or not writable.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: FileLock | None) -> None:
        self.path = path
        self._db = connection
        self._lock = lock
        self._failure = self._remedy = ""
        meta = self._meta()
        with sound(path):
            self.channels = tuple(map(str, json.loads(meta["channels"])))
            self.layout = Layout.from_json(meta["layout"])
        self.noise = tuple(map(noise_channel, self.channels))
        self._vertices = max(map(len, self.layout.coordinates.values()), default=0)
        self._thinned = 0
        # Device and inode identify the file independently of its name.
        found = None if path is MEMORY else path.stat()
        self._file = None if found is None else (found.st_dev, found.st_ino)
        self._stand()

    def _stand(self) -> None:
        """Reload the numbers of the last estimate and sample."""
        self._last = self._current = self._highest("estimates")
        self._newest = self.accepted

    # --- opening -------------------------------------------------------------------------------

    @classmethod
    def create(cls, path: Path | None, channels: Sequence[str], layout: Layout) -> Journal:
        """Create a journal and return its writer; without a path, it is in memory only.

        The file is created atomically: if it exists, `open` can continue it.
        """
        meta = {
            "format": str(FORMAT),
            "channels": json.dumps(list(channels)),
            "layout": json.dumps(layout.to_dict()),
        }
        if path is None:
            connection = sqlite3.connect(":memory:", factory=Connection)
            fill(connection, meta)
            return cls(MEMORY, connection, None)
        lock = locked(path)
        with released(path, lock):
            if path.exists():
                raise RunError(
                    f"{path}: there is a journal already; go on with it (--resume), or choose "
                    "another folder."
                )
            with replacing(path) as partial, closing(sqlite3.connect(partial)) as new:
                new.execute("PRAGMA journal_mode = MEMORY")  # no temporary second file
                fill(new, meta)
            return cls(path, writer(path), lock)

    @classmethod
    def open(cls, path: Path, *, write: bool = False) -> Journal:
        """Open a journal to continue it (`write`), or to read it while another process writes."""
        if not path.is_file():
            raise RunError(f"{path}: there is no journal.")
        lock = locked(path) if write else None
        with released(path, lock):
            found = cls(path, writer(path) if write else reader(path), lock)
            if write:
                check_file(path, found._db)
            return found

    def close(self) -> None:
        """Commit, close the file and release its lock."""
        try:
            if not self._failure:
                self._write(self._db.commit)
        finally:
            with suppress(sqlite3.Error):
                self._db.close()
            if self._lock is not None:
                self._lock.release()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, action: Callable[..., object], *arguments: Any) -> None:
        if self._failure:
            raise RunError(self._failure)
        try:
            action(*arguments)
        except sqlite3.Error as error:
            self._fail(error)
            raise RunError(self._failure) from error

    def _fail(self, error: sqlite3.Error) -> None:
        """Roll back uncommitted records, and refuse further writes."""
        with suppress(sqlite3.Error):
            self._db.rollback()
        self._failure = database_failure(self.path, error)
        self._remedy = "" if self.path is MEMORY else remedy_of(error)

    @property
    def remedy(self) -> str:
        """Remedy after which `reopen` may succeed; empty if there is no failure or no remedy."""
        return self._remedy if self._failure and self.in_place else ""

    def reopen(self) -> None:
        """Continue after a failed write, from the last commit.

        Raises `RunError`: the file still cannot be written, or its records are damaged.
        """
        with suppress(sqlite3.Error):
            self._db.close()
        try:
            self._db = writer(self.path)
            # An immediate transaction acquires the write lock, so that a file that cannot be locked
            # raises an error here, not at the next sample.
            self._db.execute("BEGIN IMMEDIATE")
            self._db.rollback()
        except sqlite3.Error as error:
            self._fail(error)
            raise RunError(self._failure) from error
        self._failure = self._remedy = ""
        self._stand()

    def _execute(self, command: str, *values: Any) -> None:
        self._write(self._db.execute, command, values)

    def _read(self, command: str, *values: Any) -> list[Any]:
        try:
            return self._db.execute(command, values).fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:  # latter: damaged file
            disk = self._lock is not None and remedy_of(error)
            if disk and isinstance(error, sqlite3.OperationalError):
                self._fail(error)  # SQLite may have rolled back uncommitted records
            raise RunError(database_failure(self.path, error)) from error

    def _one(self, command: str, *values: Any) -> Any:
        return self._read(command, *values)[0][0]

    def _highest(self, table: str) -> int:
        """Return the largest number of a record in a table, 0 if the table is empty."""
        return int(self._one(f"SELECT COALESCE(MAX(id), 0) FROM {table}"))

    # --- writing -------------------------------------------------------------------------------

    def accept(self, t: float, values: Mapping[str, float], position: str = "") -> Taken:
        """Insert a sample, which survives a kill of the process from the next commit on.

        Values that are NaN or absent are missing. `position` is the position of the source after
        the sample, from which the run resumes.
        """
        # Most samples have no noise. Readers recognise noise by the length of the row.
        names = self.channels
        if not values.keys().isdisjoint(self.noise):
            names += self.noise
        row = array("d", [values.get(name, math.nan) for name in names])
        self._enter(t, row.tobytes(), position)
        return Taken(id=self._current, t=t, values=self._named(row.tolist()))

    def _enter(self, t: float, channels: bytes, position: str) -> None:
        self._newest += 1
        self._insert("samples", self._newest, float(t), channels, position)
        self._current = self._newest

    def _insert(self, table: str, *values: Any, verb: str = "INSERT", conflict: str = "") -> None:
        places = ", ".join("?" * (len(values) + 1))
        command = f"{verb} INTO {table} VALUES ({places}) {conflict}"
        self._execute(command, *values, checksum(table, *values))

    def extend(self, rows: Iterable[tuple[Array, Record]], state: bytes) -> None:
        """Insert samples, their estimates and the final state in one transaction.

        A row contains the values of all channels, and may contain their noise after them.
        """
        for row, record in rows:
            self._enter(record.t, row.tobytes(), "")
            self.append(record)
        self.checkpoint(state)  # commits

    def withdraw(self) -> None:
        """Delete the last sample, which the identifier could not use."""
        for table in ("samples", "estimates", "fields", "checkpoints", "tries"):
            self._execute(f"DELETE FROM {table} WHERE id = ?", self._current)
        # The number of the newest sample is reused. An older sample leaves a gap.
        if self._current == self._newest:
            self._newest -= 1
        self._write(self._db.commit)
        self._current = self._last

    def mark(self) -> int:
        """Increment and commit the number of tries of the last sample, and return it."""
        self._execute(
            "INSERT INTO tries VALUES (?, 1) ON CONFLICT (id) DO UPDATE SET number = number + 1",
            self._current,
        )
        self._write(self._db.commit)
        return int(self._one("SELECT number FROM tries WHERE id = ?", self._current))

    def unmark(self) -> None:
        """Decrement the tries of the last sample: its step was interrupted, without a crash."""
        self._execute("UPDATE tries SET number = number - 1 WHERE id = ?", self._current)
        self._write(self._db.commit)

    def append(self, record: Record, /, number: int | None = None) -> None:
        """Store the estimate of a sample; default: the last sample of `accept` or `samples`.

        An estimate that was stored before a crash is left unchanged.
        """
        number = self._current if number is None else number
        found = (record.numbers, record.innovation, record.validation_error)
        self._insert(
            "estimates",
            number,
            float(record.t),
            record.status,
            record.steps,
            b"".join(np.asarray(values, dtype=float).tobytes() for values in found),
            json.dumps(dict(record.notes)),
            verb=UNLESS_KNOWN,
        )
        if record.snapshot is not None:
            self.keep(record.snapshot, number)
        self._last = number

    def keep(self, snapshot: Snapshot, number: int | None = None) -> None:
        """Store the fields of a sample; without a number, of the last one, until `rewind`."""
        last, number = number is None, self._last if number is None else number
        # Permanent fields must not become temporary because they are also the last fields.
        conflict = "ON CONFLICT (id) DO UPDATE SET last = excluded.last, "
        conflict += "content = excluded.content, crc = excluded.crc WHERE last > excluded.last"
        self._insert("fields", number, int(last), snapshot.to_bytes(), conflict=conflict)

    def checkpoint(self, state: bytes) -> None:
        """Store the identifier's state after the last estimated sample, and commit."""
        self._insert("checkpoints", self._last, state, verb=UNLESS_KNOWN)
        # The older checkpoint is kept because `rewind` needs it if the newer one is damaged.
        self._execute(
            "DELETE FROM checkpoints WHERE id NOT IN "
            "(SELECT id FROM checkpoints ORDER BY id DESC LIMIT ?)",
            KEPT_CHECKPOINTS,
        )
        self._write(self._db.commit)

    def commit(self, position: str | None = None) -> None:
        """Commit, so that readers see all records and these survive a kill of the process.

        `position`: position of the source, if it has delivered unusable rows since the last sample.
        """
        if position is not None:
            # The number of the sample is stored too, since a later sample supersedes the position.
            self._say("position", json.dumps([self.accepted, position]))
        self._write(self._db.commit)

    def rollback(self) -> None:
        """Discard all records since the last commit."""
        self._write(self._db.rollback)
        self._stand()

    def _say(self, key: str, value: str) -> None:
        """Set a value of the header."""
        self._insert("meta", key, value, verb="REPLACE")

    def say_health(self, why: str) -> None:
        """Store and commit the reason why the run is unhealthy; empty if it is healthy."""
        self._say("health", why[:LONGEST].encode(errors="replace").decode())
        self._write(self._db.commit)

    def judge(self, verdict: Mapping[str, Any]) -> None:
        """Store the verdict on the run so far, see `Verdict.to_dict`."""
        self._insert("verdicts", 1, json.dumps(verdict), verb="REPLACE")

    @property
    def verdict(self) -> str:
        """The last stored verdict as JSON, or an empty string."""
        rows = self._sound("verdicts", self._read("SELECT * FROM verdicts"))
        return str(rows[0][1]) if rows else ""

    def note(self, event: Event) -> None:
        """Store an event unless it was stored before a crash."""
        message = event.message[:LONGEST].encode(errors="replace").decode()
        row = (float(event.t), event.kind, event.channel, message)
        self._execute(
            f"{UNLESS_KNOWN} INTO events (t, kind, channel, message, crc) VALUES (?, ?, ?, ?, ?)",
            *row,
            checksum("events", *row),
        )

    def count(self, kind: str, channel: str = "", number: int = 1) -> None:
        """Increase the count of a kind of remark that is too frequent for an event each time."""
        known = "SELECT number FROM counts WHERE kind = ? AND channel = ?"
        before = self._read(known, kind, channel)
        total = number + (int(before[0][0]) if before else 0)
        self._insert("counts", kind, channel, total, verb="REPLACE")

    # --- reading -------------------------------------------------------------------------------

    def _meta(self) -> dict[str, str]:
        """Return the header; raise `RunError` if the file is not a journal of this version."""
        found = self._read("SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL")
        if {str(sql) for (sql,) in found} == set(SCHEMA):
            meta = dict(self._sound("meta", self._read("SELECT * FROM meta")))
            if meta.get("format") == str(FORMAT):
                return meta
        raise RunError(f"{self.path} is not a journal of this version of livepde: {AGAIN}.")

    def _sound(self, table: str, rows: Iterable[Sequence[Any]]) -> list[Any]:
        """Verify the checksums of records; return the records without their checksums."""
        found = []
        for *values, crc in rows:
            if checksum(table, *values) != crc:
                raise RunError(damaged(self.path, f"{table}: {values[0]!r:.40} is not as it was"))
            found.append(values)
        return found

    @property
    def health(self) -> str:
        """Reason why the run is unhealthy, as last stored by its writer; empty if healthy."""
        return self._meta().get("health", "")

    @property
    def in_place(self) -> bool:
        """Whether the path still refers to the opened file, which was not deleted or replaced."""
        if self._file is None:
            return True
        try:
            named = self.path.stat()
        except OSError:
            return False
        return (named.st_dev, named.st_ino) == self._file

    @property
    def accepted(self) -> int:
        """Number of the last accepted sample, or 0."""
        return self._highest("samples")

    @property
    def estimated(self) -> int:
        """Number of the last estimated sample; earlier estimates may have been thinned."""
        return self._last

    @property
    def pending(self) -> int:
        """Number of accepted samples after the last estimated sample."""
        return int(self._one("SELECT COUNT(*) FROM samples WHERE id > ?", self._last))

    @property
    def first(self) -> Taken | None:
        """The first accepted sample, with which the run begins, or None."""
        return next(self._samples("ORDER BY id LIMIT 1"), None)

    @property
    def last(self) -> float:
        """Time of the last accepted sample, or -inf."""
        last = next(self._samples("ORDER BY id DESC LIMIT 1"), None)
        return -np.inf if last is None else last.t

    def recent(self, count: int) -> list[Taken]:
        """Return the last `count` accepted samples, oldest first."""
        return [*self._samples("ORDER BY id DESC LIMIT ?", count)][::-1]

    def between(self, low: float, high: float) -> list[tuple[float, dict[str, float]]]:
        """Return times and values of the samples between two times, at most `FEW`."""
        start = self._number_at(low)
        found = self._samples("WHERE id >= ? ORDER BY id LIMIT ?", start, FEW)
        return [(one.t, one.values) for one in found if one.t <= high]

    def readings(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Return times and values of channels in all samples, (samples,), (samples, channels)."""
        found = [*self._samples("ORDER BY id")]
        values = np.array([[one.values.get(name, math.nan) for name in names] for one in found])
        return np.array([one.t for one in found]), values.reshape(len(found), len(names))

    def values(self, first: int, last: int) -> Iterator[tuple[int, dict[str, float]]]:
        """Iterate over the samples numbered `first` to `last`, with their numbers and values."""
        for one in self._samples("WHERE id BETWEEN ? AND ? ORDER BY id", first, last):
            yield one.id, one.values

    def _number_at(self, t: float) -> int:
        """Return the number of the first sample not earlier than a time, by bisection."""
        # Times are sorted but have no index, so bisection over the primary key is fastest.
        low, high = 0, self._newest + 1
        while low < high:
            middle = (low + high) // 2
            rows = self._read("SELECT id, t FROM samples WHERE id >= ? ORDER BY id LIMIT 1", middle)
            if not rows or rows[0][1] >= t:
                high = middle
            else:
                low = rows[0][0] + 1
        return low

    @property
    def position(self) -> str:
        """Position of the source after the last accepted sample and any unusable rows after it."""
        rows = self._sound("samples", self._read("SELECT * FROM samples ORDER BY id DESC LIMIT 1"))
        last, _, _, position = rows[0] if rows else (0, 0.0, b"", "")
        with sound(self.path):
            after, later = json.loads(self._meta().get("position", '[-1, ""]'))
            return str(later if after == last else position)

    def rewind(self) -> bytes | None:
        """Return the state of the last intact checkpoint, or None.

        `samples` then yields the samples after the checkpoint, which have to be processed again.
        """
        numbers = [n for (n,) in self._read("SELECT id FROM checkpoints ORDER BY id DESC")]
        number, state = 0, None  # defaults: all samples are processed again
        for one in numbers:
            state = self._state(one)
            if state is not None:
                number = one
                break
            # A damaged checkpoint is deleted, since its number may be needed for a new one.
            self._execute("DELETE FROM checkpoints WHERE id = ?", one)
        if state is None and numbers and ("thinned" in self._meta() or self.first is None):
            raise RunError(damaged(self.path, "no checkpoint is as it was"))
        if numbers and number < numbers[0]:
            LOG.warning("%s: the newest checkpoint is damaged: went back further", self.path)
        self._execute("DELETE FROM fields WHERE last")  # fields of the last sample
        self._write(self._db.commit)
        self._last = self._current = int(number)
        return state

    def _state(self, number: int) -> bytes | None:
        """Return the state of a checkpoint, or None if it is damaged."""
        try:
            rows = self._read("SELECT * FROM checkpoints WHERE id = ?", number)
            ((_, state),) = self._sound("checkpoints", rows)
        except (RunError, ValueError):
            return None
        return state if isinstance(state, bytes) else None

    def samples(self) -> Iterator[Taken]:
        """Iterate over the samples after the last estimated one."""
        # One query for each sample, since the caller writes estimates between two samples, and may
        # withdraw a sample.
        next_one = "WHERE id > ? ORDER BY id LIMIT 1"
        while found := next(self._samples(next_one, self._current), None):
            self._current = found.id
            yield found

    def taken(self) -> Iterator[Taken]:
        """Iterate over all stored samples."""
        number = 0
        while found := [*self._samples("WHERE id > ? ORDER BY id LIMIT ?", number, TOGETHER)]:
            yield from found
            number = found[-1].id

    def _samples(self, which: str, *values: Any) -> Iterator[Taken]:
        rows = self._read(f"SELECT * FROM samples {which}", *values)
        for number, t, channels, _ in self._sound("samples", rows):
            with sound(self.path):
                if len(channels) not in (8 * len(self.channels), 16 * len(self.channels)):
                    raise ValueError(f"sample {number} has not the size of the others")
                named = self._named(np.frombuffer(channels).tolist())
                taken = Taken(id=number, t=float(t), values=named)
            yield taken

    def _named(self, row: Sequence[float]) -> dict[str, float]:
        """Return the values of a sample by name: of all channels, and noise where it is known."""
        values = dict(zip(self.channels, row, strict=False))
        noise = zip(self.noise, row[len(self.channels) :], strict=False)
        return values | {name: std for name, std in noise if not math.isnan(std)}

    def __len__(self) -> int:
        return int(self._one("SELECT COUNT(*) FROM estimates"))

    def __iter__(self) -> Iterator[Record]:
        return (record for _, record in self.after(0))

    def after(self, number: int) -> Iterator[tuple[int, Record]]:
        """Iterate over the estimates after the sample `number`, with the numbers of samples."""
        if not number:
            check_file(self.path, self._db)
        while True:
            rows = self._read(f"{ESTIMATES} id > ? ORDER BY id LIMIT ?", number, TOGETHER)
            for row in rows:
                number = row[0]
                yield number, self._estimate(row)
            if len(rows) < TOGETHER:
                return

    def _estimate(self, row: Sequence[Any]) -> Record:
        """Return an estimate with its fields, after verification of both checksums."""
        ((number, t, status, steps, numbers, notes),) = self._sound("estimates", [row[:7]])
        content = None
        if row[9] is not None:
            ((_, _, content),) = self._sound("fields", [(number, *row[7:])])
        layout = self.layout
        sizes = [len(layout.numbers), len(layout.sensors), len(layout.validation or ())]
        with sound(self.path):
            values = np.frombuffer(numbers)
            snapshot = None if content is None else Snapshot.from_bytes(content)
            lengths = set() if snapshot is None else {len(x) for x in snapshot.profiles.values()}
            if len(values) != sum(sizes) or lengths - {self._vertices}:
                raise ValueError(f"the estimate at t = {t} has not the size of the others")
            found, innovation, error, _ = np.split(values, np.cumsum(sizes))
            return Record(
                t=float(t),
                numbers=found,
                innovation=innovation,
                validation_error=error,
                status=STATUS_CODES.index(STATUS_CODES[status]),
                steps=int(steps),
                notes={str(name): float(value) for name, value in json.loads(notes).items()},
                snapshot=snapshot,
            )

    def dataset(self) -> xr.Dataset:
        """Return the estimates as a dataset, see `Result.to_xarray`."""
        records = RecordArrays.of(self)
        with sound(self.path):
            data = self.layout.dataset(records)
        if verdict := self.verdict:
            data.attrs["verdict"] = verdict
        return data

    @property
    def events(self) -> list[Event]:
        """All events in chronological order."""
        rows = self._read("SELECT t, kind, channel, message, crc FROM events ORDER BY id")
        with sound(self.path):
            return [Event(float(t), *map(str, words)) for t, *words in self._sound("events", rows)]

    @property
    def counts(self) -> dict[tuple[str, str], int]:
        """Number of remarks for each (kind, channel)."""
        rows = self._sound("counts", self._read("SELECT * FROM counts ORDER BY kind, channel"))
        with sound(self.path):
            return {(str(kind), str(channel)): int(number) for kind, channel, number in rows}

    # --- bounded growth ------------------------------------------------------------------------

    def thin(self, before: float, every: int) -> None:
        """Delete old samples and fields, and keep one in `every` estimates before a time.

        All records needed for recovery after a crash are kept: the first sample, and all records
        from the older checkpoint on. The last 10 000 events are kept.
        """
        # If the newer checkpoint is damaged, the run restarts from the older one.
        safe = self._one("SELECT COALESCE(MIN(id), 0) FROM checkpoints")
        recent = self._read("SELECT id FROM samples WHERE t >= ? ORDER BY id LIMIT 1", before)
        end = min(safe, recent[0][0]) if recent else safe
        first = "(SELECT MIN(id) FROM samples)"
        self._execute(f"DELETE FROM samples WHERE id < ? AND id > {first}", end)
        self._execute("DELETE FROM fields WHERE id < ?", end)
        self._execute(
            "DELETE FROM estimates WHERE id >= ? AND id < ? AND id % ?", self._thinned, end, every
        )
        self._execute("DELETE FROM tries WHERE id < ?", end)
        self._execute(
            "DELETE FROM events WHERE id <= (SELECT MAX(id) FROM events) - ?", KEPT_EVENTS
        )
        if end:  # the run cannot be repeated from its first sample: it needs an intact checkpoint
            self._say("thinned", str(end))
        self._write(self._db.commit)
        self._thinned = max(self._thinned, end)
