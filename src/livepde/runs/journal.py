"""The journal of a run: what was taken and what was found, in one file that survives a kill.

An SQLite file in write-ahead mode. A sample is in it before the identifier sees it, an estimate
with the next commit; a checkpoint of the identifier from time to time. After a crash at any moment
the last checkpoint and the samples after it give the same numbers as if nothing had happened. One
process writes, any number may read meanwhile.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from livepde.errors import RunError
from livepde.linalg import Array
from livepde.records import Layout, Record, Snapshot

__all__ = ["Event", "Journal", "Taken"]

FORMAT = 1
MEMORY = Path(":memory:")
KEPT_CHECKPOINTS = 2

SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE samples (
    id INTEGER PRIMARY KEY, t REAL NOT NULL, channels BLOB NOT NULL, position TEXT NOT NULL
);
CREATE TABLE estimates (
    id INTEGER PRIMARY KEY, t REAL NOT NULL, status INTEGER NOT NULL, steps INTEGER NOT NULL,
    numbers BLOB NOT NULL, notes TEXT NOT NULL
);
CREATE TABLE fields (id INTEGER PRIMARY KEY, content BLOB NOT NULL);
CREATE TABLE checkpoints (id INTEGER PRIMARY KEY, state BLOB NOT NULL);
CREATE TABLE events (
    id INTEGER PRIMARY KEY, t REAL, kind TEXT NOT NULL, channel TEXT NOT NULL, message TEXT NOT NULL
);
CREATE TABLE counts (
    kind TEXT, channel TEXT, number INTEGER NOT NULL, PRIMARY KEY (kind, channel)
) WITHOUT ROWID;
"""


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
    """The journal of one run.

    Parameters
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
        meta = self.meta
        self.channels: tuple[str, ...] = tuple(json.loads(meta["channels"]))
        self.layout = Layout.from_dict(json.loads(meta["layout"]))
        self._last = int(self._one("SELECT COALESCE(MAX(id), 0) FROM estimates"))
        self._current = self._last

    # --- opening -------------------------------------------------------------------------------

    @classmethod
    def create(cls, path: Path | None, channels: Sequence[str], layout: Layout) -> Journal:
        """Make a new journal and be its writer; without a path in memory only."""
        lock = None if path is None else _locked(path)
        path = path or MEMORY
        try:
            connection = _connect(path)
            with connection:
                connection.executescript(SCHEMA)
                rows = {
                    "format": str(FORMAT),
                    "channels": json.dumps(list(channels)),
                    "layout": json.dumps(layout.to_dict()),
                }
                connection.executemany("INSERT INTO meta VALUES (?, ?)", rows.items())
        except sqlite3.Error as error:
            if lock is not None:
                lock.release()
            raise _failed(path, error) from error
        return cls(path, connection, lock)

    @classmethod
    def open(cls, path: Path, *, write: bool = False) -> Journal:
        """Open a journal: to go on with it, or to read while another process writes."""
        if not path.is_file():
            raise RunError(f"{path}: there is no journal.")
        lock = _locked(path) if write else None
        try:
            connection = _connect(path, read_only=not write)
            found = dict(connection.execute("SELECT key, value FROM meta"))
        except sqlite3.Error as error:
            if lock is not None:
                lock.release()
            raise _failed(path, error) from error
        if found.get("format") != str(FORMAT):
            raise RunError(f"{path} is not a journal of this version of livepde.")
        return cls(path, connection, lock)

    def close(self) -> None:
        """Commit and let go."""
        try:
            self._run(self._db.commit)
        finally:
            with suppress(sqlite3.Error):
                self._db.close()
            if self._lock is not None:
                self._lock.release()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self, action: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return action(*arguments)
        except sqlite3.Error as error:
            with suppress(sqlite3.Error):
                self._db.rollback()
            raise _failed(self.path, error) from error

    def _execute(self, command: str, *values: Any) -> sqlite3.Cursor:
        cursor: sqlite3.Cursor = self._run(self._db.execute, command, values)
        return cursor

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
        row = np.array([values.get(name, np.nan) for name in self.channels])
        cursor = self._execute(
            "INSERT INTO samples (t, channels, position) VALUES (?, ?, ?)",
            t,
            row.tobytes(),
            position,
        )
        self._run(self._db.commit)
        self._current = int(cursor.lastrowid or 0)
        return Taken(self._current, t, dict(zip(self.channels, row.tolist(), strict=True)))

    def withdraw(self) -> None:
        """Forget the last sample, of which nothing could be made."""
        self._execute("DELETE FROM samples WHERE id = ?", self._current)
        self._run(self._db.commit)
        self._current = self._last

    def append(self, record: Record, /) -> None:
        """Keep the estimate of the last sample that `accept` or `samples` has returned."""
        number = self._current
        numbers = np.concatenate([record.numbers, record.innovation, record.withheld_error])
        self._execute(
            "INSERT INTO estimates VALUES (?, ?, ?, ?, ?, ?)",
            number,
            record.t,
            record.status,
            record.steps,
            numbers.tobytes(),
            json.dumps(dict(record.notes)),
        )
        if record.snapshot is not None:
            self.keep(record.snapshot)
        self._last = number

    def keep(self, snapshot: Snapshot) -> None:
        """Keep the fields of the last sample."""
        content = _packed(snapshot)
        self._execute("INSERT OR REPLACE INTO fields VALUES (?, ?)", self._current, content)

    def checkpoint(self, state: bytes) -> None:
        """Keep the identifier's state after the last sample."""
        self._execute("INSERT OR REPLACE INTO checkpoints VALUES (?, ?)", self._current, state)
        self._execute(
            "DELETE FROM checkpoints WHERE id NOT IN "
            "(SELECT id FROM checkpoints ORDER BY id DESC LIMIT ?)",
            KEPT_CHECKPOINTS,
        )
        self._run(self._db.commit)

    def commit(self) -> None:
        """Show readers what was written since the last sample was accepted."""
        self._run(self._db.commit)

    def note(self, event: Event) -> None:
        """Keep an event."""
        self._execute(
            "INSERT INTO events (t, kind, channel, message) VALUES (?, ?, ?, ?)",
            event.t,
            event.kind,
            event.channel,
            event.message,
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

    @property
    def meta(self) -> dict[str, str]:
        """What the journal says about itself."""
        return dict(self._execute("SELECT key, value FROM meta"))

    @property
    def accepted(self) -> int:
        """Number of the last accepted sample, 0 before any."""
        return int(self._one("SELECT COALESCE(MAX(id), 0) FROM samples"))

    @property
    def first(self) -> Taken | None:
        """The first accepted sample, which describes the start; None before any."""
        row = self._execute("SELECT id, t, channels FROM samples ORDER BY id LIMIT 1").fetchone()
        return None if row is None else self._taken(*row)

    @property
    def last(self) -> float:
        """Time of the last accepted sample, -inf before any."""
        found = self._execute("SELECT t FROM samples ORDER BY id DESC LIMIT 1").fetchone()
        return -np.inf if found is None else float(found[0])

    @property
    def position(self) -> str:
        """Where the source stood after the last accepted sample."""
        found = self._execute("SELECT position FROM samples ORDER BY id DESC LIMIT 1").fetchone()
        return "" if found is None else str(found[0])

    def rewind(self) -> bytes | None:
        """Return the last checkpoint, None if there is none, and forget what was found after it.

        `samples` then brings what has to be taken again.
        """
        found = self._execute("SELECT id, state FROM checkpoints ORDER BY id DESC LIMIT 1")
        number, state = found.fetchone() or (0, None)
        for table in ("estimates", "fields"):
            self._execute(f"DELETE FROM {table} WHERE id > ?", number)
        self._run(self._db.commit)
        self._last = self._current = int(number)
        return state

    def samples(self) -> Iterator[Taken]:
        """Iterate over the samples after the last one that was estimated."""
        while True:
            row = self._execute(
                "SELECT id, t, channels FROM samples WHERE id > ? ORDER BY id LIMIT 1",
                self._current,
            ).fetchone()
            if row is None:
                return
            self._current = int(row[0])
            yield self._taken(*row)

    def _taken(self, number: int, t: float, channels: bytes) -> Taken:
        values = np.frombuffer(channels).tolist()
        return Taken(number, t, dict(zip(self.channels, values, strict=True)))

    def __len__(self) -> int:
        return int(self._one("SELECT COUNT(*) FROM estimates"))

    def __iter__(self) -> Iterator[Record]:
        return (record for _, record in self.after(0))

    def after(self, number: int) -> Iterator[tuple[int, Record]]:
        """Iterate over the estimates of the samples after one, with their numbers."""
        layout = self.layout
        cuts = np.cumsum([len(layout.numbers), len(layout.sensors)])
        rows = self._execute(
            "SELECT id, t, status, steps, numbers, notes, content "
            "FROM estimates LEFT JOIN fields USING (id) WHERE id > ? ORDER BY id",
            number,
        )
        for sample, t, status, steps, numbers, notes, content in rows:
            values, innovation, error = np.split(np.frombuffer(numbers), cuts)
            snapshot = None if content is None else _unpacked(content)
            told = json.loads(notes)
            yield sample, Record(t, values, innovation, error, status, steps, told, snapshot)

    @property
    def events(self) -> list[Event]:
        """All events, in the order in which they happened."""
        rows = self._execute("SELECT t, kind, channel, message FROM events ORDER BY id")
        return [Event(*row) for row in rows]

    @property
    def counts(self) -> dict[tuple[str, str], int]:
        """(kind, channel) -> how often."""
        rows = self._execute("SELECT kind, channel, number FROM counts ORDER BY kind, channel")
        return {(kind, channel): number for kind, channel, number in rows}

    # --- bounded growth ------------------------------------------------------------------------

    def thin(self, before: float, every: int) -> None:
        """Keep one in `every` estimates, and no samples or fields, from before a time.

        What is needed to go on after a crash is kept: the first sample, and those that are not yet
        in a checkpoint.
        """
        safe = int(self._one("SELECT COALESCE(MIN(id), 0) FROM checkpoints"))
        first = "SELECT MIN(id) FROM samples"
        self._execute(
            f"DELETE FROM samples WHERE t < ? AND id < ? AND id > ({first})", before, safe
        )
        self._execute(
            "DELETE FROM fields WHERE id IN (SELECT id FROM estimates WHERE t < ?)", before
        )
        self._execute("DELETE FROM estimates WHERE t < ? AND id % ?", before, every)
        self._run(self._db.commit)

    def _one(self, command: str) -> Any:
        return self._execute(command).fetchone()[0]


def _packed(snapshot: Snapshot) -> bytes:
    """Return a snapshot as names and sizes in JSON, a zero byte, and the numbers."""
    arrays = dict(snapshot.profiles)
    head: dict[str, Any] = {"told": snapshot.told}
    head["profiles"] = {name: len(values) for name, values in arrays.items()}
    body = [values.tobytes() for values in arrays.values()]
    if snapshot.correlation is not None:
        head["correlation"] = len(snapshot.correlation)
        body.append(snapshot.correlation.tobytes())
    return json.dumps(head).encode() + b"\0" + b"".join(body)


def _unpacked(content: bytes) -> Snapshot:
    text, body = content.split(b"\0", 1)
    head = json.loads(text)
    sizes = head["profiles"]
    *parts, rest = np.split(np.frombuffer(body), np.cumsum([*sizes.values()]))
    told = {name: (told, count) for name, (told, count) in head["told"].items()}
    n = head.get("correlation")
    correlation: Array | None = None if n is None else rest.reshape(n, n)
    return Snapshot(dict(zip(sizes, parts, strict=True)), told, correlation)


def _connect(path: Path, *, read_only: bool = False) -> sqlite3.Connection:
    if path == MEMORY:
        return sqlite3.connect(":memory:")
    mode = "ro" if read_only else "rwc"
    connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True)
    if not read_only:
        connection.execute("PRAGMA journal_mode = WAL")
        # Without a sync for each commit: a killed process loses nothing, a power cut the last ones.
        connection.execute("PRAGMA synchronous = NORMAL")
    return connection


def _locked(path: Path) -> FileLock:
    lock = FileLock(path.with_name(path.name + ".lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise RunError(
            f"{path.parent} is being written by another process: stop it, or choose another folder."
        ) from None
    except OSError as error:
        raise RunError(f"{path.parent} cannot be written: {error.strerror or error}.") from error
    return lock


def _failed(path: Path, error: sqlite3.Error) -> RunError:
    return RunError(
        f"{path}: {error}. What was written before is safe; make room or mend the folder, and go "
        "on with --resume."
    )
