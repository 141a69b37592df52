"""The SQLite file of a journal: tables, connections, locks, checksums and error messages."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from livepde.errors import RunError

LOG_SIZE = 16 * 2**20  # bytes to which a longer write-ahead log is truncated
MOMENT = 0.5  # seconds to wait for the lock, which `in_use` holds for a moment
# Exceptions that decoding the content of a damaged or hostile file may raise.
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
    sqlite3.SQLITE_FULL: "free disk space",
    sqlite3.SQLITE_IOERR: "free disk space or repair the disk",
    sqlite3.SQLITE_READONLY: "grant write access to the folder and its files",
    sqlite3.SQLITE_CANTOPEN: "grant read and write access to the folder and its files",
    sqlite3.SQLITE_PERM: "grant read and write access to the folder and its files",
    sqlite3.SQLITE_BUSY: "stop the other program that uses it",
    sqlite3.SQLITE_LOCKED: "stop the other program that uses it",
}
CORRUPT = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


SCHEMA = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, crc INTEGER NOT NULL) "
    "WITHOUT ROWID",
    "CREATE TABLE samples (id INTEGER PRIMARY KEY, t REAL NOT NULL, channels BLOB NOT NULL, "
    "position TEXT NOT NULL, crc INTEGER NOT NULL)",
    "CREATE TABLE estimates (id INTEGER PRIMARY KEY, t REAL NOT NULL, status INTEGER NOT NULL, "
    "steps INTEGER NOT NULL, numbers BLOB NOT NULL, notes TEXT NOT NULL, crc INTEGER NOT NULL)",
    "CREATE TABLE fields (id INTEGER PRIMARY KEY, last INTEGER NOT NULL, content BLOB NOT NULL, "
    "crc INTEGER NOT NULL)",
    "CREATE TABLE checkpoints (id INTEGER PRIMARY KEY, state BLOB NOT NULL, crc INTEGER NOT NULL)",
    "CREATE TABLE events (id INTEGER PRIMARY KEY, t REAL NOT NULL, kind TEXT NOT NULL, "
    "channel TEXT NOT NULL, message TEXT NOT NULL, crc INTEGER NOT NULL, "
    "UNIQUE (t, kind, channel, message))",
    "CREATE TABLE counts (kind TEXT, channel TEXT, number INTEGER NOT NULL, crc INTEGER NOT NULL, "
    "PRIMARY KEY (kind, channel)) WITHOUT ROWID",
    "CREATE TABLE verdicts (id INTEGER PRIMARY KEY, content TEXT NOT NULL, crc INTEGER NOT NULL)",
    "CREATE TABLE tries (id INTEGER PRIMARY KEY, number INTEGER NOT NULL)",
)


def writer(path: Path) -> sqlite3.Connection:
    """Open a file for writing."""
    connection = _connect(path, "mode=rw")
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")  # no sync at each commit: see `journal`
    connection.execute(f"PRAGMA journal_size_limit = {LOG_SIZE}")
    return connection


def reader(path: Path) -> sqlite3.Connection:
    """Open a file for reading, while another process may write."""
    connection = _connect(path, "mode=ro")
    try:
        connection.execute("SELECT 1 FROM sqlite_schema").close()
    except sqlite3.OperationalError as error:
        log = log_of(path)
        busy = error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
        if busy or (log.exists() and log.stat().st_size):
            raise
        # The folder is read-only, and no process writes the file.
        connection.close()
        connection = _connect(path, "immutable=1")
    return connection


def check_file(path: Path, connection: sqlite3.Connection) -> None:
    """Raise `RunError` if SQLite finds damaged pages in a file.

    A changed byte in a page may hide rows, which checksums of rows cannot detect. The check reads
    the file once and takes about a third of the time of reading all rows.
    """
    try:
        (found,), *_ = connection.execute("PRAGMA quick_check(1)").fetchall()
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise RunError(database_failure(path, error)) from error
    if found != "ok":
        raise RunError(damaged(path, str(found).splitlines()[-1]))


class Connection(sqlite3.Connection):
    """Connection that closes on garbage collection; Python 3.13 warns about unclosed ones."""

    def __del__(self) -> None:
        with suppress(sqlite3.Error):  # raised if another thread has made the connection
            self.close()


def _connect(path: Path, options: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{options}", uri=True, factory=Connection
    )
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    return connection


def log_of(path: Path) -> Path:
    """Return the write-ahead log of a journal; it need not exist."""
    return path.with_name(path.name + "-wal")


def written(path: Path) -> float:
    """Return the time of the last write to a journal, in seconds since 1970; 0 if there is none."""
    times = [0.0]
    for file in (path, log_of(path)):
        with suppress(OSError):  # the writer deletes its log when it closes
            times.append(file.stat().st_mtime)
    return max(times)


def in_use(path: Path) -> bool:
    """Return whether a process has a journal open for writing."""
    lock = _lock_of(path)
    try:
        lock.acquire(timeout=0)
    except (Timeout, OSError):
        return True
    lock.release()
    return False


def _lock_of(path: Path) -> FileLock:
    return FileLock(path.with_name(path.name + ".lock"))


def locked(path: Path) -> FileLock:
    """Acquire the lock of the single writer of a file; raise `RunError` if it is taken."""
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
def released(path: Path, lock: FileLock | None) -> Iterator[None]:
    """Release the lock and raise `RunError` with the reason if a journal cannot be opened."""
    try:
        yield
    except (OSError, sqlite3.Error, UnicodeDecodeError, RunError) as error:
        if lock is not None:
            lock.release()
        if isinstance(error, sqlite3.Error | UnicodeDecodeError):
            raise RunError(database_failure(path, error)) from error
        if not isinstance(error, RunError):
            raise RunError(f"{path} cannot be written: {error.strerror or error}.") from error
        raise


@contextmanager
def sound(path: Path) -> Iterator[None]:
    """Convert exceptions from decoding a damaged or hostile file to a `RunError`."""
    try:
        yield
    except DAMAGE as error:
        reason = str(error).split("\n", 1)[0] or type(error).__name__
        raise RunError(damaged(path, reason[:200])) from error


def database_failure(path: Path, error: sqlite3.Error | UnicodeDecodeError) -> str:
    """Return a message with the remedy for an error of SQLite."""
    code = getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT)
    if code & 0xFF in CORRUPT:
        return damaged(path, str(error))
    remedy = remedy_of(error) or "check the folder"
    return f"{path}: {error}. Earlier results are safe. To continue, {remedy}, then add --resume."


def remedy_of(error: Exception) -> str:
    """Return the remedy for an error of an intact file, or an empty string."""
    return REMEDIES.get(getattr(error, "sqlite_errorcode", sqlite3.SQLITE_CORRUPT) & 0xFF, "")


def damaged(path: Path, why: str) -> str:
    """Return a message with the remedy for a damaged journal."""
    return f"{path} is damaged ({why}): restore it from a copy, or {AGAIN}."


def checksum(table: str, *values: Any) -> int:
    """Return the CRC-32 checksum of a record: the name of its table and all its values."""
    total = zlib.crc32(table.encode())
    for value in values:
        if not isinstance(value, bytes):
            # SQLite does not store the sign of a zero.
            value = repr(value + 0.0 if isinstance(value, float) else value).encode()
        total = zlib.crc32(value, zlib.crc32(b"\0", total))
    return total


def fill(connection: sqlite3.Connection, meta: Mapping[str, str]) -> None:
    """Create the tables of a new journal, with its header `meta`, in one transaction."""
    with connection:
        connection.execute("BEGIN")
        for command in SCHEMA:
            connection.execute(command)
        rows = [(key, value, checksum("meta", key, value)) for key, value in meta.items()]
        connection.executemany("INSERT INTO meta VALUES (?, ?, ?)", rows)
