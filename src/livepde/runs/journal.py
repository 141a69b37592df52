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
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from filelock import FileLock, Timeout

from livepde.errors import RunError
from livepde.linalg import Array
from livepde.records import STATUS_CODES, Layout, Record, Snapshot

if TYPE_CHECKING:
    from pydantic import TypeAdapter

__all__ = ["Event", "Journal", "Taken", "in_use", "log_of", "written"]

FORMAT = 1
MEMORY = Path(":memory:")
KEPT_CHECKPOINTS = 2
KEPT_EVENTS = 10_000
TOGETHER = 1000  # estimates that are read at once: a slow reader must not hold up the writer
LOG_SIZE = 16 * 2**20  # bytes of the write-ahead log that are kept when it was longer
LONGEST = 2000  # characters of the message of an event
MOMENT = 0.5  # seconds for which who only asks whether a journal is written may hold its lock

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
# What a file of somebody else may make of reading it.
DAMAGE = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
AGAIN = "run the case again into another folder"
REMEDIES = {  # primary result code of SQLite -> what to do
    sqlite3.SQLITE_FULL: "make room, and go on with --resume",
    sqlite3.SQLITE_IOERR: "make room or mend the disk, and go on with --resume",
    sqlite3.SQLITE_READONLY: "let the folder and its files be written, and go on with --resume",
    sqlite3.SQLITE_CANTOPEN: "let the folder and its files be read and written",
    sqlite3.SQLITE_PERM: "let the folder and its files be read and written",
    sqlite3.SQLITE_BUSY: "stop the other program that holds it, and go on with --resume",
    sqlite3.SQLITE_LOCKED: "stop the other program that holds it, and go on with --resume",
    sqlite3.SQLITE_CORRUPT: f"the file is damaged: {AGAIN}",
    sqlite3.SQLITE_NOTADB: f"the file is damaged: {AGAIN}",
}


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
        with _sound(path):
            self.channels = tuple(map(str, json.loads(meta["channels"])))
            self.layout = _layout(meta["layout"])
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
            connection = sqlite3.connect(MEMORY, factory=_Connection)
            _fill(connection, meta)
            return cls(MEMORY, connection, None)
        lock = _locked(path)
        with _released(path, lock):
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
            return cls(path, _writer(path), lock)

    @classmethod
    def open(cls, path: Path, *, write: bool = False) -> Journal:
        """Open a journal: to go on with it, or to read while another process writes."""
        if not path.is_file():
            raise RunError(f"{path}: there is no journal.")
        lock = _locked(path) if write else None
        with _released(path, lock):
            return cls(path, _writer(path) if write else _reader(path), lock)

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
            self._failure = _told(self.path, error)
            raise RunError(self._failure) from error

    def _execute(self, command: str, *values: Any) -> sqlite3.Cursor:
        cursor: sqlite3.Cursor = self._write(self._db.execute, command, values)
        return cursor

    def _read(self, command: str, *values: Any) -> list[Any]:
        try:
            return self._db.execute(command, values).fetchall()
        except (sqlite3.Error, UnicodeDecodeError) as error:  # the latter of a damaged file
            raise RunError(_told(self.path, error)) from error

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
        row = np.array([values.get(name, np.nan) for name in self.channels])
        self._enter(t, row, position)
        self._write(self._db.commit)
        return Taken(self._current, t, dict(zip(self.channels, row.tolist(), strict=True)))

    def _enter(self, t: float, row: Array, position: str) -> None:
        cursor = self._execute(
            "INSERT INTO samples (t, channels, position) VALUES (?, ?, ?)",
            t,
            row.tobytes(),
            position,
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
            self._enter(record.t, row, "")
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
        numbers = np.concatenate([record.numbers, record.innovation, record.withheld_error])
        self._execute(
            "INSERT INTO estimates VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO NOTHING",
            self._current,
            record.t,
            record.status,
            record.steps,
            numbers.tobytes(),
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
            _packed(snapshot),
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
        with _sound(self.path):
            return float(rows[0][0]) if rows else -np.inf

    @property
    def position(self) -> str:
        """Where the source stood after the last accepted sample, or what came after it."""
        rows = self._read("SELECT id, position FROM samples ORDER BY id DESC LIMIT 1")
        last, position = rows[0] if rows else (0, "")
        with _sound(self.path):
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
        with _sound(self.path):
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
                with _sound(self.path):
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
        snapshot = None if content is None else _unpacked(content)
        lengths = set() if snapshot is None else {len(x) for x in snapshot.profiles.values()}
        if len(values) != sum(sizes) or lengths - {self._vertices}:
            raise ValueError(f"the estimate at t = {t} has not the size of the others")
        found, innovation, error, _ = np.split(values, np.cumsum(sizes))
        told = {str(name): float(number) for name, number in json.loads(notes).items()}
        code = STATUS_CODES.index(STATUS_CODES[status])
        return Record(float(t), found, innovation, error, code, int(steps), told, snapshot)

    def dataset(self) -> xr.Dataset:
        """Return the estimates as a dataset; see `Result.to_xarray`."""
        records = list(self)
        with _sound(self.path):
            return self.layout.dataset(records)

    @property
    def events(self) -> list[Event]:
        """All events, in the order in which they happened."""
        rows = self._read("SELECT t, kind, channel, message FROM events ORDER BY id")
        with _sound(self.path):
            return [Event(float(t), *map(str, words)) for t, *words in rows]

    @property
    def counts(self) -> dict[tuple[str, str], int]:
        """(kind, channel) -> how often."""
        rows = self._read("SELECT kind, channel, number FROM counts ORDER BY kind, channel")
        with _sound(self.path):
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
    sizes = [*head["profiles"].values()]
    n = head.get("correlation")
    numbers = np.frombuffer(body)
    if len(numbers) != sum(sizes) + (n or 0) ** 2:
        raise ValueError("fields of another size than they say")
    *parts, rest = np.split(numbers, np.cumsum(sizes))
    told = {name: (float(told), int(count)) for name, (told, count) in head["told"].items()}
    correlation: Array | None = None if n is None else rest.reshape(n, n)
    return Snapshot(dict(zip(head["profiles"], parts, strict=True)), told, correlation)


def _layout(text: str) -> Layout:
    """Return a layout from JSON, its types checked."""
    return _reader_of_layouts().validate_json(text)


@cache
def _reader_of_layouts() -> TypeAdapter[Layout]:
    from pydantic import TypeAdapter

    return TypeAdapter(Layout)


def _fill(connection: sqlite3.Connection, meta: Mapping[str, str]) -> None:
    """Make the tables of a new journal."""
    with connection:
        connection.execute("BEGIN")  # one commit for all
        for command in SCHEMA:
            connection.execute(command)
        connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())


def _writer(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "mode=rw")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")  # no sync for each commit, see above
    connection.execute(f"PRAGMA journal_size_limit = {LOG_SIZE}")
    return connection


def _reader(path: Path) -> sqlite3.Connection:
    connection = _connect(path, "mode=ro")
    try:
        connection.execute("SELECT 1 FROM sqlite_schema").close()
    except sqlite3.OperationalError as error:
        log = log_of(path)
        busy = error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
        if busy or (log.exists() and log.stat().st_size):
            raise
        # A folder in which nothing can be made, and nobody writes.
        connection.close()
        connection = _connect(path, "immutable=1")
    return connection


class _Connection(sqlite3.Connection):
    """Closed when nobody holds it any more; Python 3.13 warns of others."""

    def __del__(self) -> None:
        with suppress(sqlite3.Error):  # of another thread
            self.close()


def _connect(path: Path, options: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{options}", uri=True, factory=_Connection
    )
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    return connection


def log_of(path: Path) -> Path:
    """Return the write-ahead log beside a journal; it need not be there."""
    return path.with_name(path.name + "-wal")


def written(path: Path) -> float:
    """Return when a journal was written last, in seconds since 1970; 0 if there is none."""
    times = [0.0]
    for file in (path, log_of(path)):
        with suppress(OSError):  # the log goes away with its writer
            times.append(file.stat().st_mtime)
    return max(times)


def in_use(path: Path) -> bool:
    """Return whether a process holds a journal to write it."""
    lock = _lock_of(path)
    try:
        lock.acquire(timeout=0)
    except (Timeout, OSError):
        return True
    lock.release()
    return False


def _lock_of(path: Path) -> FileLock:
    return FileLock(path.with_name(path.name + ".lock"))


def _locked(path: Path) -> FileLock:
    lock = _lock_of(path)
    try:
        lock.acquire(timeout=MOMENT)
    except Timeout:
        raise RunError(
            f"{path.parent} is being written by another process: stop it, or choose another folder."
        ) from None
    except OSError as error:
        raise RunError(f"{path.parent} cannot be written: {error.strerror or error}.") from error
    return lock


@contextmanager
def _released(path: Path, lock: FileLock | None) -> Iterator[None]:
    """Let go of a journal that cannot be opened, and say why in one sentence."""
    try:
        yield
    except (OSError, sqlite3.Error, UnicodeDecodeError, RunError) as error:
        if lock is not None:
            lock.release()
        if isinstance(error, sqlite3.Error | UnicodeDecodeError):
            raise RunError(_told(path, error)) from error
        if not isinstance(error, RunError):
            raise RunError(f"{path} cannot be written: {error.strerror or error}.") from error
        raise


@contextmanager
def _sound(path: Path) -> Iterator[None]:
    """What a damaged file, or one made to do harm, makes of its content is one sentence."""
    try:
        yield
    except DAMAGE as error:
        reason = str(error).split("\n", 1)[0] or type(error).__name__
        raise RunError(f"{path} is damaged ({reason[:200]}): {AGAIN}.") from error


def _told(path: Path, error: sqlite3.Error | UnicodeDecodeError) -> str:
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT)
    remedy = REMEDIES.get(code & 0xFF, "mend the folder, and go on with --resume")
    return f"{path}: {error}. What was written before is safe; {remedy}."
