"""The journal of a run: what was taken and what was found, in one file that survives a kill.

An SQLite file in write-ahead mode. A sample is in it before the identifier sees it, an estimate
with the next commit; a checkpoint of the identifier from time to time. After a crash at any moment
the last checkpoint and the samples after it give the same numbers as if nothing had happened. One
process writes, any number may read meanwhile.

It is append-only: what was written is never changed, and only `thin` takes something away. Freed
room is used again, so that a journal that is thinned stops growing.

A process that is killed loses nothing. A power cut leaves the file whole, but may take the samples
of the last moments: a sync for each of them would cost more than the step. A file that is followed
brings them again; a broker that was told of them does not.

A write that fails (a full disk) is the end of a journal's writer: it takes nothing more, so that no
checkpoint can pass over what was lost. What was written before is there, and a new one goes on.
"""

from __future__ import annotations

import json
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

from livepde.errors import RunError
from livepde.linalg import Array
from livepde.records import STATUS_CODES, Layout, Record, RecordArrays, Snapshot
from livepde.runs.database import AGAIN, in_memory, locked, reader, released, sound, told, writer
from livepde.runs.packing import layout_from, packed, unpacked

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["Event", "Journal", "Taken"]

FORMAT = 1
MEMORY = Path(":memory:")
KEPT_CHECKPOINTS = 2
KEPT_EVENTS = 10_000
TOGETHER = 1000  # estimates that are read at once: a slow reader must not hold up the writer
LONGEST = 2000  # characters of the message of an event

SCHEMA = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE samples (id INTEGER PRIMARY KEY, t REAL NOT NULL, channels BLOB NOT NULL, "
    "position TEXT NOT NULL)",
    "CREATE TABLE estimates (id INTEGER PRIMARY KEY, t REAL NOT NULL, status INTEGER NOT NULL, "
    "steps INTEGER NOT NULL, numbers BLOB NOT NULL, notes TEXT NOT NULL)",
    "CREATE TABLE fields (id INTEGER PRIMARY KEY, last INTEGER NOT NULL, content BLOB NOT NULL)",
    "CREATE TABLE checkpoints (id INTEGER PRIMARY KEY, state BLOB NOT NULL)",
    "CREATE TABLE events (id INTEGER PRIMARY KEY, t REAL NOT NULL, kind TEXT NOT NULL, "
    "channel TEXT NOT NULL, message TEXT NOT NULL, UNIQUE (t, kind, channel, message))",
    "CREATE TABLE counts (kind TEXT, channel TEXT, number INTEGER NOT NULL, "
    "PRIMARY KEY (kind, channel)) WITHOUT ROWID",
)


@dataclass(frozen=True, eq=False)
class Taken:
    """An accepted sample: its number, time, the values of all channels (NaN: missing)."""

    id: int
    t: float
    values: dict[str, float]


@dataclass(frozen=True)
class Event:
    """Something that happened: kind, channel ('' for none), in words, and when (model time)."""

    t: float
    kind: str
    channel: str
    message: str


class Journal:
    """The journal of one run; `create` makes a new one, `open` takes one that is there.

    Attributes
    ----------
    path
        The SQLite file.
    channels
        Names of all channels of a sample, in the order in which they are kept.
    layout
        What the numbers of the records mean.

    Raises
    ------
    RunError
        Another process writes; the file is of another run, damaged, or cannot be written.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: FileLock | None) -> None:
        self.path = path
        self._db = connection
        self._lock = lock
        self._failure = ""
        meta = self._meta()
        with sound(path):
            self.channels = tuple(map(str, json.loads(meta["channels"])))
            self.layout = layout_from(meta["layout"])
        self._vertices = max(map(len, self.layout.coordinates.values()), default=0)
        self._last = int(self._one("SELECT COALESCE(MAX(id), 0) FROM estimates"))
        self._current = self._last
        self._thinned = 0

    # --- opening -------------------------------------------------------------------------------

    @classmethod
    def create(cls, path: Path | None, channels: Sequence[str], layout: Layout) -> Journal:
        """Make a new journal and be its writer; without a path in memory only.

        The file appears whole or not at all: where it is, `open` can go on with it.
        """
        meta = {
            "format": str(FORMAT),
            "channels": json.dumps(list(channels)),
            "layout": json.dumps(layout.to_dict()),
        }
        if path is None:
            connection = in_memory()
            _fill(connection, meta)
            return cls(MEMORY, connection, None)
        lock = locked(path)
        with released(path, lock):
            if path.exists():
                raise RunError(
                    f"{path}: there is a journal already; go on with it (--resume), or choose "
                    "another folder."
                )
            partial = path.with_name(path.name + ".partial")
            partial.unlink(missing_ok=True)
            with closing(sqlite3.connect(partial)) as new:
                new.execute("PRAGMA journal_mode = MEMORY")  # no second file beside it
                _fill(new, meta)
            partial.replace(path)
            return cls(path, writer(path), lock)

    @classmethod
    def open(cls, path: Path, *, write: bool = False) -> Journal:
        """Open a journal: to go on with it, or to read while another process writes."""
        if not path.is_file():
            raise RunError(f"{path}: there is no journal.")
        lock = locked(path) if write else None
        with released(path, lock):
            return cls(path, writer(path) if write else reader(path), lock)

    def close(self) -> None:
        """Commit and let go."""
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

    def _write(self, action: Callable[..., Any], *arguments: Any) -> Any:
        if self._failure:
            raise RunError(self._failure)
        try:
            return action(*arguments)
        except sqlite3.Error as error:
            with suppress(sqlite3.Error):
                self._db.rollback()
            self._failure = told(self.path, error)
            raise RunError(self._failure) from error

    def _execute(self, command: str, *values: Any) -> sqlite3.Cursor:
        cursor: sqlite3.Cursor = self._write(self._db.execute, command, values)
        return cursor

    def _read(self, command: str, *values: Any) -> list[Any]:
        try:
            return self._db.execute(command, values).fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter of a damaged file
            raise RunError(told(self.path, error)) from error

    def _one(self, command: str, *values: Any) -> Any:
        return self._read(command, *values)[0][0]

    # --- writing -------------------------------------------------------------------------------

    def accept(self, t: float, values: Mapping[str, float], position: str = "") -> Taken:
        """Keep a sample, for good: it is on disk when this returns.

        Parameters
        ----------
        t, values
            Time and values of the channels; NaN or absent: missing.
        position
            Where its source stands after it, to go on from there.
        """
        row = array("d", [values.get(name, math.nan) for name in self.channels])
        self._enter(t, row.tobytes(), position)
        self._write(self._db.commit)
        return Taken(self._current, t, dict(zip(self.channels, row, strict=True)))

    def _enter(self, t: float, channels: bytes, position: str) -> None:
        cursor = self._execute(
            "INSERT INTO samples (t, channels, position) VALUES (?, ?, ?)", t, channels, position
        )
        self._current = int(cursor.lastrowid or 0)

    def extend(self, rows: Iterable[tuple[Array, Record]], state: bytes) -> None:
        """Keep samples with their estimates and the state after them: all of it, or nothing.

        Parameters
        ----------
        rows
            Values of the channels of each sample, and its estimate.
        state
            The identifier's.
        """
        for row, record in rows:
            self._enter(record.t, row.tobytes(), "")
            self.append(record)
        self.checkpoint(state)  # commits

    def withdraw(self) -> None:
        """Forget the last sample, of which nothing could be made."""
        self._execute("DELETE FROM samples WHERE id = ?", self._current)
        self._write(self._db.commit)
        self._current = self._last

    def append(self, record: Record, /) -> None:
        """Keep the estimate of the last sample that `accept` or `samples` has returned.

        One that was kept before a crash is found again, and stays as it is.
        """
        found = (record.numbers, record.innovation, record.withheld_error)
        self._execute(
            "INSERT INTO estimates VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO NOTHING",
            self._current,
            record.t,
            record.status,
            record.steps,
            b"".join(np.asarray(values, dtype=float).tobytes() for values in found),
            json.dumps(dict(record.notes)),
        )
        if record.snapshot is not None:
            self._keep(record.snapshot)
        self._last = self._current

    def keep(self, snapshot: Snapshot) -> None:
        """Keep the fields of the last sample, as long as it is the last."""
        self._keep(snapshot, last=True)

    def _keep(self, snapshot: Snapshot, last: bool = False) -> None:
        self._execute(
            "INSERT INTO fields VALUES (?, ?, ?) ON CONFLICT (id) DO UPDATE SET last = "
            "min(last, excluded.last)",
            self._last if last else self._current,
            int(last),
            packed(snapshot),
        )

    def checkpoint(self, state: bytes) -> None:
        """Keep the identifier's state after the last sample that was estimated."""
        self._execute(
            "INSERT INTO checkpoints VALUES (?, ?) ON CONFLICT (id) DO NOTHING", self._last, state
        )
        self._execute(
            "DELETE FROM checkpoints WHERE id NOT IN "
            "(SELECT id FROM checkpoints ORDER BY id DESC LIMIT ?)",
            KEPT_CHECKPOINTS,
        )
        self._write(self._db.commit)

    def commit(self, position: str | None = None) -> None:
        """Show readers what was written since the last sample was accepted.

        Parameters
        ----------
        position
            Where the source stands now, if it has brought anything but samples since then.
        """
        if position is not None:
            stands = json.dumps([self.accepted, position])
            self._execute("INSERT OR REPLACE INTO meta VALUES ('position', ?)", stands)
        self._write(self._db.commit)

    def judge(self, verdict: Mapping[str, Any]) -> None:
        """Keep the verdict on the run so far, as `Verdict.to_dict` gives it."""
        self._execute("INSERT OR REPLACE INTO meta VALUES ('verdict', ?)", json.dumps(verdict))

    @property
    def verdict(self) -> str:
        """The verdict that was kept last, as JSON; empty before any."""
        return self._meta().get("verdict", "")

    def note(self, event: Event) -> None:
        """Keep an event; one that was kept before a crash is not kept twice."""
        self._execute(
            "INSERT INTO events (t, kind, channel, message) VALUES (?, ?, ?, ?) "
            "ON CONFLICT DO NOTHING",
            event.t,
            event.kind,
            event.channel,
            event.message[:LONGEST].encode(errors="replace").decode(),
        )

    def count(self, kind: str, channel: str = "", number: int = 1) -> None:
        """Count something that is not worth an event each."""
        self._execute(
            "INSERT INTO counts VALUES (?, ?, ?) "
            "ON CONFLICT (kind, channel) DO UPDATE SET number = number + excluded.number",
            kind,
            channel,
            number,
        )

    # --- reading -------------------------------------------------------------------------------

    def _meta(self) -> dict[str, str]:
        """Return what the journal says about itself, if it is one."""
        found = self._read("SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL")
        if {str(sql) for (sql,) in found} == set(SCHEMA):
            meta = dict(self._read("SELECT key, value FROM meta"))
            if meta.get("format") == str(FORMAT):
                return meta
        raise RunError(f"{self.path} is not a journal of this version of livepde: {AGAIN}.")

    @property
    def accepted(self) -> int:
        """Number of the last accepted sample, 0 before any."""
        return int(self._one("SELECT COALESCE(MAX(id), 0) FROM samples"))

    @property
    def estimated(self) -> int:
        """Number of the last sample with an estimate; all before have one, or had it."""
        return self._last

    @property
    def first(self) -> Taken | None:
        """The first accepted sample, which describes the start; None before any."""
        rows = self._read("SELECT id, t, channels FROM samples ORDER BY id LIMIT 1")
        return self._taken(*rows[0]) if rows else None

    @property
    def last(self) -> float:
        """Time of the last accepted sample, -inf before any."""
        rows = self._read("SELECT t FROM samples ORDER BY id DESC LIMIT 1")
        with sound(self.path):
            return float(rows[0][0]) if rows else -np.inf

    def recent(self, count: int) -> list[Taken]:
        """Return the last accepted samples, oldest first."""
        rows = self._read("SELECT id, t, channels FROM samples ORDER BY id DESC LIMIT ?", count)
        return [self._taken(*row) for row in reversed(rows)]

    @property
    def position(self) -> str:
        """Where the source stood after the last accepted sample, or what came after it."""
        rows = self._read("SELECT id, position FROM samples ORDER BY id DESC LIMIT 1")
        last, position = rows[0] if rows else (0, "")
        with sound(self.path):
            after, later = json.loads(self._meta().get("position", '[-1, ""]'))
            return str(later if after == last else position)

    def rewind(self) -> bytes | None:
        """Return the last checkpoint, None if there is none.

        `samples` then brings what has to be taken again.
        """
        rows = self._read("SELECT id, state FROM checkpoints ORDER BY id DESC LIMIT 1")
        number, state = rows[0] if rows else (0, None)
        if not isinstance(state, bytes | None):
            raise RunError(f"{self.path} is damaged (a checkpoint is no archive): {AGAIN}.")
        self._execute("DELETE FROM fields WHERE last")  # there will be later ones
        self._write(self._db.commit)
        self._last = self._current = int(number)
        return state

    def samples(self) -> Iterator[Taken]:
        """Iterate over the samples after the last one that was estimated."""
        while True:
            rows = self._read(
                "SELECT id, t, channels FROM samples WHERE id > ? ORDER BY id LIMIT 1",
                self._current,
            )
            if not rows:
                return
            self._current = int(rows[0][0])
            yield self._taken(*rows[0])

    def _taken(self, number: int, t: float, channels: bytes) -> Taken:
        with sound(self.path):
            if len(channels) != 8 * len(self.channels):
                raise ValueError(f"sample {number} has not the size of the others")
            values = np.frombuffer(channels).tolist()
            return Taken(number, float(t), dict(zip(self.channels, values, strict=True)))

    def __len__(self) -> int:
        return int(self._one("SELECT COUNT(*) FROM estimates"))

    def __iter__(self) -> Iterator[Record]:
        return (record for _, record in self.after(0))

    def after(self, number: int) -> Iterator[tuple[int, Record]]:
        """Iterate over the estimates of the samples after one, with their numbers."""
        while True:
            rows = self._read(
                "SELECT id, t, status, steps, numbers, notes, content "
                "FROM estimates LEFT JOIN fields USING (id) WHERE id > ? ORDER BY id LIMIT ?",
                number,
                TOGETHER,
            )
            for number, *content in rows:
                with sound(self.path):
                    record = self._record(*content)
                yield number, record
            if len(rows) < TOGETHER:
                return

    def _record(
        self, t: float, status: int, steps: int, numbers: bytes, notes: str, content: bytes | None
    ) -> Record:
        layout = self.layout
        sizes = [len(layout.numbers), len(layout.sensors), len(layout.withheld or ())]
        values = np.frombuffer(numbers)
        snapshot = None if content is None else unpacked(content)
        lengths = set() if snapshot is None else {len(x) for x in snapshot.profiles.values()}
        if len(values) != sum(sizes) or lengths - {self._vertices}:
            raise ValueError(f"the estimate at t = {t} has not the size of the others")
        found, innovation, error, _ = np.split(values, np.cumsum(sizes))
        said = {str(name): float(number) for name, number in json.loads(notes).items()}
        code = STATUS_CODES.index(STATUS_CODES[status])
        return Record(float(t), found, innovation, error, code, int(steps), said, snapshot)

    def dataset(self) -> xr.Dataset:
        """Return the estimates as a dataset; see `Result.to_xarray`."""
        records = RecordArrays.of(self)
        with sound(self.path):
            data = self.layout.dataset(records)
        if verdict := self.verdict:
            data.attrs["verdict"] = verdict
        return data

    @property
    def events(self) -> list[Event]:
        """All events, in the order in which they happened."""
        rows = self._read("SELECT t, kind, channel, message FROM events ORDER BY id")
        with sound(self.path):
            return [Event(float(t), *map(str, words)) for t, *words in rows]

    @property
    def counts(self) -> dict[tuple[str, str], int]:
        """(kind, channel) -> how often."""
        rows = self._read("SELECT kind, channel, number FROM counts ORDER BY kind, channel")
        with sound(self.path):
            return {(str(kind), str(channel)): int(number) for kind, channel, number in rows}

    # --- bounded growth ------------------------------------------------------------------------

    def thin(self, before: float, every: int) -> None:
        """Keep one in `every` estimates, and no samples or fields, from before a time.

        What is needed to go on after a crash is kept: the first sample, and all from the older
        checkpoint on. Of events the last ones are kept.
        """
        safe = self._one("SELECT COALESCE(MIN(id), 0) FROM checkpoints")
        recent = self._read("SELECT id FROM samples WHERE t >= ? ORDER BY id LIMIT 1", before)
        end = min(safe, recent[0][0]) if recent else safe
        first = "(SELECT MIN(id) FROM samples)"
        self._execute(f"DELETE FROM samples WHERE id < ? AND id > {first}", end)
        self._execute("DELETE FROM fields WHERE id < ?", end)
        self._execute(
            "DELETE FROM estimates WHERE id >= ? AND id < ? AND id % ?", self._thinned, end, every
        )
        self._execute(
            "DELETE FROM events WHERE id <= (SELECT MAX(id) FROM events) - ?", KEPT_EVENTS
        )
        self._write(self._db.commit)
        self._thinned = max(self._thinned, end)


def _fill(connection: sqlite3.Connection, meta: Mapping[str, str]) -> None:
    """Make the tables of a new journal."""
    with connection:
        connection.execute("BEGIN")  # one commit for all
        for command in SCHEMA:
            connection.execute(command)
        connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
