"""The journal survives kills, full disks, and damaged or hostile files."""

import csv
import itertools
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections import Counter
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live_rod import CLOCK, COLUMNS, identifier, journal, live, rows, same, write
from patience import PATIENCE

import livepde as lp
from livepde import checkpoint, runs
from livepde.records import Record
from livepde.runs import RunWriter, database
from livepde.runs.backlog import Retention
from livepde.runs.database import in_use, log_of, written
from livepde.runs.feeds import SampleFeed
from livepde.runs.journal import KEPT_EVENTS, Event, Journal
from livepde.runs.live_loop import Live
from livepde.streams.csvfile import are_labels
from livepde.streams.intake import Intake
from livepde.streams.sources import Follow, Row, Rows, json_row

NAME = "journal.sqlite"
CHECKPOINT = 40  # samples between two checkpoints, few so that a short run has several
GROUP = 8  # samples per commit


@pytest.fixture(autouse=True)
def often(monkeypatch):
    monkeypatch.setattr("livepde.runs.live_loop.CHECKPOINT", CHECKPOINT)
    monkeypatch.setattr("livepde.runs.live_loop.GROUP", GROUP)


def samples(count: int, after: float = -np.inf) -> SampleFeed:
    return SampleFeed((lp.Sample(row.pop("t"), row) for row in rows(count)), after=after)


def started(folder: Path, count: int, **options) -> Live:
    path = folder / NAME
    kept = Journal.open(path, write=True) if path.exists() else journal(path)
    return Live(identifier(), samples(count, kept.last), kept, fields_every=10, **options)


def halved(some, two) -> list:
    """Return all pairs of two axes, with every other pair marked as a long test."""
    pairs = enumerate(itertools.product(some, two))
    rest = (1, 2)  # positions of long tests among four, so that usual tests cover each value
    return [pytest.param(*pair, marks=[pytest.mark.long] * (k % 4 in rest)) for k, pair in pairs]


def ran(folder: Path, count: int, **options) -> Live:
    """Begin or resume a run, and return it after `samples` samples."""
    run = started(folder, count, **options)
    run.resume()
    run.run()
    run.journal.close()
    return run


def same_runs(one: Path, other: Path) -> int:
    """Assert that two folders have equal estimates; return the number of accepted samples."""
    with Journal.open(one / NAME) as mine, Journal.open(other / NAME) as yours:
        same(mine, yours)
        assert mine.accepted == yours.accepted
        return mine.accepted


def altered(path: Path, script: str) -> None:
    with closing(sqlite3.connect(path)) as raw:
        raw.executescript(script)


class Available(Rows):
    """Source whose rows are all available at once."""

    def __init__(self, rows) -> None:
        self._found = [Row(values) for values in rows]

    @property
    def done(self) -> bool:
        return not self._found

    def poll(self, wait: float) -> list[Row]:
        found, self._found = self._found, []
        return found


@cache
def journal_bytes(count: int) -> bytes:
    """Return the journal file of a run of `samples` samples."""
    with TemporaryDirectory() as folder:
        ran(Path(folder), count)
        return (Path(folder) / NAME).read_bytes()


def finished(folder: Path, count: int = 30) -> Path:
    """Return the journal of a finished run."""
    path = folder / NAME
    path.write_bytes(journal_bytes(count))
    return path


def folders(parent: Path) -> tuple[Path, Path]:
    """Create a folder for the undisturbed run and one for the disturbed run."""
    whole, other = parent / "whole", parent / "other"
    whole.mkdir(), other.mkdir()
    return whole, other


def content(path: Path) -> dict[str, dict[int, tuple]]:
    """Return the full content of a journal, row by row."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as raw:
        tables = ("samples", "estimates", "fields", "events")
        return {name: {r[0]: r for r in raw.execute(f"SELECT * FROM {name}")} for name in tables}


# --- crashes -------------------------------------------------------------------------------------


class Crash(BaseException):
    """Error that ends a run as a kill would, within the process."""


class Listens:
    """Sink that stores the times of estimates."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def put(self, estimate) -> None:
        self.times.append(estimate.t)

    def close(self) -> None:
        pass


class Breaks:
    """Sink that crashes the run after a number of estimates."""

    def __init__(self, after: int) -> None:
        self.left = after

    def put(self, estimate) -> None:
        self.left -= 1
        if self.left < 0:
            raise Crash

    def close(self) -> None:
        pass


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "waits"), halved(["accept", "append", "commit", "checkpoint", "step"], [True, False])
)
def test_after_a_crash_within_a_step_the_run_resumes_bit_by_bit(
    tmp_path, monkeypatch, method, waits
):
    count = CHECKPOINT + 40
    whole, broken = folders(tmp_path)
    finished(whole, count)
    run = started(broken, count, waits=waits)
    owner, calls = (run.identifier if method == "step" else run.journal), []
    limit = {"checkpoint": 1, "commit": GROUP + 2}.get(method, CHECKPOINT + 5)
    real = getattr(owner, method)

    def breaks(*arguments):
        found = real(*arguments)
        calls.append(1)
        if len(calls) == limit:
            raise Crash
        return found

    monkeypatch.setattr(owner, method, breaks)
    with pytest.raises(Crash):
        run.run()
    run.journal.close()
    ran(broken, count)
    assert same_runs(broken, whole) == count


@pytest.mark.long
def test_a_stopped_and_resumed_run_has_the_fields_of_an_undisturbed_run(tmp_path):
    whole, stopped = folders(tmp_path)
    finished(whole, 60)
    finished(stopped, 37)
    for _ in range(2):  # the second run has nothing left to do
        ran(stopped, 60)
    same_runs(stopped, whole)
    with Journal.open(stopped / NAME) as kept:
        assert list(kept)[-1].snapshot is not None


@pytest.mark.slow
def test_an_event_of_a_refused_sample_comes_with_its_withdrawal(tmp_path):
    feed = Rows([{"t": 0.0, "a": 1.0, "b": 1.0, "left": 1.0}, {"t": 0.1, "a": 1.0}])
    run = live(tmp_path, feed)
    run.journal.accept(-1.0, {"a": 1.0})  # remains without its input
    run.resume()
    run.run()
    assert [event.kind for event in run.journal.events if event.kind == "refused"] == ["refused"]
    assert run.journal.accepted == 2


# --- groups of samples ----------------------------------------------------------------------------


class Watched(Available):
    """Source and sink that record what a reader of the journal sees when they are notified."""

    def __init__(self, path: Path, rows) -> None:
        super().__init__(rows)
        self._found = [Row(row.values, token=row.values["t"]) for row in self._found]
        self.path, self.acknowledged, self.told = path, [], []

    def acknowledge(self, tokens) -> None:
        with Journal.open(self.path) as kept:
            self.acknowledged += [(t, kept.accepted) for t in tokens]

    def put(self, estimate) -> None:
        with Journal.open(self.path) as kept:
            self.told.append((estimate.t, kept.estimated))


@pytest.mark.slow
def test_sources_and_sinks_are_notified_after_the_commit(tmp_path, monkeypatch):
    """They are notified of a whole group if several samples are available."""
    monkeypatch.setattr("livepde.runs.live_loop.AGE", np.inf)
    watched = Watched(tmp_path / NAME, rows(40))
    run = live(tmp_path, watched, sinks=[watched])
    run.run()
    times = [row["t"] for row in rows(40)]
    for told in (watched.acknowledged, watched.told):
        assert [t for t, _ in told] == times
        assert all(number >= k for k, (_, number) in enumerate(told, start=1))
    # First singly, because the last session may have crashed in one of these, then in groups.
    ends = [*range(1, GROUP + 1), 16, 24, 32, 40]
    assert sorted({number for _, number in watched.acknowledged}) == ends
    # The estimate of the last sample of a group comes with the next one.
    assert sorted({number for _, number in watched.told}) == [*range(1, GROUP), 15, 23, 31, 39, 40]


@pytest.mark.slow
def test_no_step_begins_before_old_samples_are_committed(tmp_path):
    now = itertools.count()
    watched = Watched(tmp_path / NAME, rows(30))
    run = live(tmp_path, watched, sinks=[watched], clock=lambda: float(next(now)))
    run.run()
    assert [number for _, number in watched.acknowledged] == [*range(1, 31)]


@pytest.mark.long
@pytest.mark.parametrize("error", [np.linalg.LinAlgError("no SVD"), TypeError("a defect")])
def test_a_failed_estimate_within_a_group_skips_only_its_sample(tmp_path, monkeypatch, error):
    """A numerical failure skips its sample, and the others continue, as with single samples."""
    monkeypatch.setattr("livepde.runs.live_loop.AGE", np.inf)
    found = []
    for name, source in (("one", Rows), ("group", Available)):
        folder = tmp_path / name
        folder.mkdir()
        sink = Listens()
        run = live(folder, source(rows(40)), sinks=[sink])
        step = run.identifier.step

        def unreadable(t, z, inputs=None, step=step):
            estimate = step(t, z, inputs)
            if 1.95 < t < 2.05:

                def read():
                    raise error

                estimate.__dict__.update(_read=read)
                estimate.__dict__.pop("belief", None)
            return estimate

        run.identifier.step = unreadable
        run.run()
        times = [record.t for record in run.journal]
        assert len(times) == 39
        assert sink.times == times
        events = [(event.kind, event.message) for event in run.journal.events]
        found.append((list(run.journal), run.journal.counts, events))
        run.journal.close()
    (one, counts, events), (group, *rest) = found
    assert rest == [counts, events]
    assert counts == {("aside", ""): 1}
    assert all(np.array_equal(a.numbers, b.numbers) for a, b in zip(one, group, strict=True))


# --- a journal that cannot be written ------------------------------------------------------------


@pytest.mark.slow
def test_after_a_failed_write_no_checkpoint_skips_lost_samples(tmp_path):
    run = started(tmp_path, 100)
    with closing(sqlite3.connect(tmp_path / NAME)) as raw:
        (pages,) = raw.execute("PRAGMA page_count").fetchone()
    run.journal._db.execute(f"PRAGMA max_page_count = {pages + 10}")
    with pytest.raises(lp.errors.RunError):
        run.run()
    run.journal._db.execute("PRAGMA max_page_count = 100000")  # space is available again, too late
    with pytest.raises(lp.errors.RunError, match="full"):
        run.journal.checkpoint(run.identifier.dump())
    run.journal.close()
    with Journal.open(tmp_path / NAME) as kept:
        assert kept.accepted - len(kept) in (0, 1)  # the last one may lack its estimate
        assert kept.estimated == len(kept)


class Failing:
    """Connection whose writes fail on request, as on a full disk."""

    def __init__(self, path: Path, failing) -> None:
        self._raw, self._failing = database.writer(path), failing

    def _refuse(self):
        if self._failing():
            error = sqlite3.OperationalError("disk I/O error")
            error.sqlite_errorcode = sqlite3.SQLITE_IOERR_WRITE
            raise error

    def execute(self, command, values=()):
        if not command.startswith(("SELECT", "PRAGMA", "BEGIN")):
            self._refuse()
        return self._raw.execute(command, values)

    def commit(self):
        self._refuse()
        self._raw.commit()

    def __getattr__(self, name):
        return getattr(self._raw, name)


@pytest.mark.slow
@pytest.mark.parametrize(("first", "source"), halved([2, 40, 43, 73], [Rows, Available]))
def test_a_run_that_waits_for_its_disk_is_the_same_in_the_end(tmp_path, monkeypatch, first, source):
    whole, failing = folders(tmp_path)
    broken = [*rows(40)]
    broken[20:20] = [{"t": 0.1, "a": "none", "left": 1.0}, {"t": -1.0, "a": 1.0, "left": 1.0}] * 3
    calm = live(whole, source(broken), verdict=False)
    calm.run()
    calm.journal.close()
    writes = itertools.count(1)
    bad = {first, first + 1, first + 9, first + 80}  # also while the journal recovers
    monkeypatch.setattr("livepde.runs.live_loop.LOOK", 0.0)
    monkeypatch.setattr(
        "livepde.runs.journal.writer", lambda path: Failing(path, lambda: next(writes) in bad)
    )

    sink = Listens()
    run = live(failing, source(broken), verdict=False, patient=True, sinks=[sink])
    run.run()
    assert run.health["ok"]
    assert run.journal.health == ""
    run.journal.close()
    assert sink.times == [0.1 * k for k in range(40)]
    with Journal.open(whole / NAME) as one, Journal.open(failing / NAME) as other:
        same(other, one)
        assert other.counts == one.counts
        assert other.accepted == one.accepted == 40
        # Count events, because rows that go back make the undisturbed run unhealthy, too.
        told, found = (
            Counter((event.kind, event.channel, event.message) for event in kept.events)
            for kept in (one, other)
        )
        assert told <= found
        assert {kind for kind, *_ in found - told} == {"disk", "well"}


@pytest.mark.slow
def test_a_disk_that_stays_full_is_unhealthy_until_the_run_is_stopped(tmp_path, monkeypatch):
    away = []
    monkeypatch.setattr(
        "livepde.runs.journal.writer", lambda path: Failing(path, lambda: bool(away))
    )
    looks = itertools.count()

    class Stopping(threading.Event):
        def wait(self, timeout=None):
            said.append(run.health)
            if next(looks) == 2:
                self.set()
            return self.is_set()

    class Leaving(Rows):
        def poll(self, wait):
            if wait == 0.0:
                return []  # without a new row, waiting samples are processed and committed
            if run.journal.accepted == 10:
                away.append(True)
            return super().poll(wait)

    said: list[dict] = []
    run = live(tmp_path, Leaving(rows(40)), patient=True, stopping=Stopping())
    with pytest.raises(
        lp.errors.RunError,
        match=r"Earlier results are safe. To continue, free disk space or repair",
    ):
        run.run()
    run.journal.close()
    why = "the journal cannot be written (disk I/O error): free disk space or repair the disk"
    assert [(health["ok"], health["why"]) for health in said] == [(False, why)] * 3
    away.clear()
    with Journal.open(tmp_path / NAME) as kept:
        assert kept.accepted == 10


FULL = """
import resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
sys.path.insert(0, sys.argv[2])
import livepde
from test_journal import started
run = started(Path(sys.argv[1]), 400)
run.resume()
try:
    run.run()
except livepde.errors.RunError as error:
    print(error)
"""


@pytest.mark.process
@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of POSIX")
def test_a_run_whose_file_cannot_grow_reports_it_and_resumes(tmp_path):
    whole, full = folders(tmp_path)
    finished(whole, 400)
    for size in (150_000, 300_000):
        found = subprocess.run(
            [sys.executable, "-c", FULL, str(full), str(Path(__file__).parent), str(size)],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
        assert not found.stderr
        assert "free disk space" in found.stdout
    ran(full, 400)
    same_runs(full, whole)


def as_nobody(code: str, *arguments: object) -> str:
    """Run code as a user without write permission here; return its output."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    # The user cannot write coverage data either.
    env = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}
    found = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=env)
    assert not found.stderr
    return found.stdout


READ = """
import os, sys
from pathlib import Path
sys.modules["dask"] = None  # xarray looks for it late, and nobody may read packages of root
import livepde, pydantic, xarray
from livepde.runs import Journal
with Journal.create(None, (), livepde.records.Layout("", "", {}, {}, [], None, {}, {}, [], [], [])):
    pass
if os.getuid() == 0:
    os.setuid(65534)
for write in (False, True):
    try:
        with Journal.open(Path(sys.argv[1]), write=write) as kept:
            print(len(kept), len(kept.dataset().time))
    except livepde.errors.RunError as error:
        print(error)
"""


@pytest.fixture
def shared():
    """Provide a folder that all users can read and only its owner can write."""
    import tempfile

    folder = Path(tempfile.mkdtemp())  # only its owner can read tmp_path
    folder.chmod(0o755)
    yield folder
    folder.chmod(0o755)
    shutil.rmtree(folder)


@pytest.mark.process
@pytest.mark.skipif(sys.platform == "win32", reason="needs permissions of POSIX")
@pytest.mark.parametrize("killed", [False, True])
def test_a_journal_in_a_read_only_folder_can_be_read(shared, killed):
    run = started(shared, 30)
    run.run()
    if killed:  # the write-ahead log remains
        copy = shared / "copy"
        copy.mkdir()
        for path in shared.glob(f"{NAME}*"):
            shutil.copy(path, copy / path.name)
        run.journal.close()
        shared = copy
    else:
        run.journal.close()
    for path in shared.glob("*"):
        path.chmod(0o644 if path.is_file() else 0o755)
    shared.chmod(0o555)
    read, write = as_nobody(READ, shared / NAME).splitlines()
    assert read == "30 30"
    assert "cannot be written" in write
    shared.chmod(0o755)


@pytest.mark.slow
def test_a_journal_appears_whole_or_not_at_all(tmp_path):
    path = tmp_path / NAME
    partial = tmp_path / f"{NAME}.0.partial"
    partial.write_bytes(b"SQLite format 3\0 and then it was killed")
    kept = journal(path)
    assert [*kept] == []
    kept.close()
    with pytest.raises(lp.errors.RunError, match="already; go on with it"):
        journal(path)
    Journal.open(path, write=True).close()  # the lock is released


@pytest.mark.slow
def test_the_last_write_and_the_writer_of_a_journal_are_known(tmp_path):
    path = tmp_path / NAME
    assert written(path) == 0.0
    run = started(tmp_path, 5)
    run.run()
    assert in_use(path)
    assert written(path) >= log_of(path).stat().st_mtime > 0.0
    run.journal.close()
    assert not log_of(path).exists()
    assert written(path) == path.stat().st_mtime
    assert not in_use(path)


@pytest.mark.slow
def test_asking_whether_a_journal_is_written_does_not_block_a_writer(tmp_path, monkeypatch):
    """The query holds the lock only for a moment."""
    monkeypatch.setattr("livepde.runs.database.MOMENT", PATIENCE)
    journal(tmp_path / NAME).close()
    asked = FileLock(tmp_path / f"{NAME}.lock", thread_local=False)
    asked.acquire()
    threading.Timer(0.2, asked.release).start()
    Journal.open(tmp_path / NAME, write=True).close()


@pytest.mark.slow
def test_a_locked_journal_is_refused_with_a_remedy(tmp_path, monkeypatch):
    path = finished(tmp_path)
    connect = database._connect

    def hasty(path, options):
        connection = connect(path, options)
        connection.execute("PRAGMA busy_timeout = 0")
        return connection

    monkeypatch.setattr(database, "_connect", hasty)
    with closing(sqlite3.connect(path)) as holder:
        holder.execute("PRAGMA journal_mode = DELETE")
        holder.execute("BEGIN EXCLUSIVE")
        with pytest.raises(
            lp.errors.RunError, match=r"locked.*stop the other program that uses it"
        ):
            Journal.open(path)


# --- damaged and hostile files -------------------------------------------------------------------


def reads(path: Path) -> None:
    """Read a whole journal, and resume it."""
    with Journal.open(path) as kept:
        kept.dataset()
        _ = kept.events, kept.counts, kept.position, kept.last, kept.first, len(kept)
    with Journal.open(path, write=True) as kept:
        Live(identifier(), samples(35, kept.last), kept).resume()


def refused(path: Path, match: str = "damaged|not a journal|malformed|not a database") -> None:
    """Assert that reading fails with one sentence that names the file."""
    with pytest.raises(lp.errors.RunError, match=match) as caught:
        reads(path)
    text = str(caught.value)
    assert str(path.parent) in text
    assert "\n" not in text
    assert len(text) < 700
    for other in path.parent.glob(f"{path.name}-*"):
        other.unlink()


@pytest.mark.long
@pytest.mark.parametrize("keep", [0, 1, 50, 99, 4096, 5000, 20000])
def test_a_truncated_journal_is_refused_with_one_sentence(tmp_path, keep):
    path = finished(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    refused(path)


@pytest.mark.long
@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)
@given(seed=st.integers(0, 2**32), share=st.sampled_from([1e-5, 1e-4, 1e-3, 1e-2, 0.3]))
def test_a_journal_with_wrong_bytes_is_read_or_refused_with_one_sentence(
    tmp_path_factory, seed, share
):
    folder = tmp_path_factory.mktemp("bytes")
    path = folder / NAME
    rng = np.random.default_rng(seed)
    data = np.frombuffer(journal_bytes(12), dtype=np.uint8).copy()
    where = rng.integers(0, len(data), max(int(share * len(data)), 1))
    data[where] = rng.integers(0, 256, len(where))
    path.write_bytes(data.tobytes())
    with suppress(lp.LivepdeError):  # no other exception is allowed
        reads(path)
    shutil.rmtree(folder)


HOSTILE = [
    "UPDATE meta SET value = '1' WHERE key = 'format'",
    "DELETE FROM meta",
    "UPDATE meta SET value = '[' || replace(hex(zeroblob(50000)), '00', '[')",
    "UPDATE meta SET value = replace(hex(zeroblob(50000)), '00', '[') WHERE key = 'layout'",
    "UPDATE meta SET value = '{}' WHERE key = 'layout'",
    "UPDATE meta SET value = '[\"a\"]' WHERE key = 'channels'",
    "UPDATE meta SET value = replace(value, '\"a\"', '3') WHERE key = 'layout'",
    "UPDATE meta SET value = x'ff00' WHERE key = 'layout'",
    "UPDATE samples SET t = 'late'",
    "UPDATE samples SET channels = x'00'",
    "UPDATE samples SET channels = zeroblob(80000000) WHERE id = 1",
    "UPDATE estimates SET numbers = x'0011'",
    'UPDATE estimates SET notes = \'{"a": "b"}\'',
    "UPDATE estimates SET notes = '{\"a\": ' || hex(zeroblob(3000)) || '}'",
    "UPDATE estimates SET notes = replace(hex(zeroblob(50000)), '00', '[')",
    "UPDATE estimates SET status = 99",
    "UPDATE estimates SET steps = x'ff'",
    "UPDATE fields SET content = x''",
    "UPDATE fields SET content = '{}' || x'00'",
    'UPDATE fields SET content = CAST(\'{"told": {}, "profiles": {"u": -1}}\' AS BLOB) || x\'00\'',
    'UPDATE fields SET content = CAST(\'{"told":{},"profiles":{"u":1e99}}\' AS BLOB) || x\'00\'',
    "UPDATE checkpoints SET state = x'504b0304'",
    "DROP TABLE samples",
    "DROP TABLE fields; CREATE VIEW fields AS SELECT 1 AS id, 0 AS last, x'' AS content",
    "DROP TABLE counts; CREATE VIEW counts AS WITH RECURSIVE n(number) AS (SELECT 1 UNION ALL "
    "SELECT number + 1 FROM n) SELECT 'a' AS kind, 'b' AS channel, number FROM n",
    "CREATE TRIGGER x AFTER INSERT ON samples BEGIN DELETE FROM estimates; END",
    "ALTER TABLE samples ADD COLUMN more TEXT",
    "INSERT INTO events (t, kind, channel, message, crc) VALUES ('x', 1, 2, 3, 4)",
    "INSERT INTO counts VALUES ('a', 'b', 'many', 0)",
]


@pytest.mark.long
@pytest.mark.parametrize("command", HOSTILE)
def test_a_hostile_journal_is_refused_with_one_sentence(tmp_path, command):
    path = finished(tmp_path)
    altered(path, command)
    with suppress(sqlite3.Error):  # the table may no longer be a table of a journal
        signed(path)
    refused(path)


def signed(path: Path) -> None:
    """Recompute the checksums of all records, which only protect against accidents."""
    with sqlite3.connect(path) as raw:
        for (table,) in raw.execute(
            "SELECT name FROM sqlite_schema WHERE type = 'table'"
        ).fetchall():
            names = [row[1] for row in raw.execute(f"PRAGMA table_info({table})")]
            if "crc" not in names:
                continue
            for row in raw.execute(f"SELECT * FROM {table}").fetchall():
                values = row[1:-1] if table == "events" else row[:-1]
                key = " AND ".join(f"{name} IS ?" for name in names)
                total = database.checksum(table, *values)
                raw.execute(f"UPDATE {table} SET crc = ? WHERE {key}", (total, *row))
    raw.close()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["text", "complex", "shape"])
def test_a_hostile_checkpoint_is_refused_with_one_sentence(tmp_path, kind):
    path = finished(tmp_path)
    good = identifier()
    good.step(0.0, {"a": 1.0, "b": 1.0, "left": 1.0})
    header, leaves = checkpoint.unpacked(good.dump(), "here")
    other = {
        "text": {name: np.array("x") for name in leaves},
        "complex": {**leaves, "z": leaves["z"].astype(complex)},
        "shape": {**leaves, "z": np.zeros((2, 2))},
    }
    with sqlite3.connect(path) as raw:
        state = checkpoint.packed(header, other[kind])
        raw.execute("UPDATE checkpoints SET state = ?", (state,))
    raw.close()
    signed(path)
    with pytest.raises(lp.errors.RunError) as caught:
        reads(path)
    assert "\n" not in str(caught.value)


# --- readers -------------------------------------------------------------------------------------

WRITER = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_journal import started
run = started(Path(sys.argv[1]), 100_000)
run.resume()
run.run()
"""


@pytest.mark.process
def test_readers_see_whole_estimates_while_another_process_writes_and_is_killed(tmp_path):
    path, seen = tmp_path / NAME, 0
    for _ in range(2):
        child = subprocess.Popen([sys.executable, "-c", WRITER, tmp_path, Path(__file__).parent])
        goal = seen + 50
        while child.poll() is None and seen < goal:
            if path.exists():
                with Journal.open(path) as kept:
                    records = list(kept)
                    assert all(isinstance(record, Record) for record in records)
                    assert len(records) >= seen  # no record disappears
                    seen = len(records)
        child.kill()
        child.wait()
        with Journal.open(path) as kept:
            assert len(list(kept)) >= seen
    assert seen >= 100


@pytest.mark.long
def test_an_open_reader_does_not_let_the_log_grow(tmp_path):
    run = started(tmp_path, 1500)
    with Journal.open(tmp_path / NAME) as reader:
        slow = reader.after(0)
        run.sinks.append(First(slow))
        run.run()
        assert (tmp_path / f"{NAME}-wal").stat().st_size < 8e6
    run.journal.close()


class First:
    """Reader that reads one estimate and stays open."""

    def __init__(self, slow) -> None:
        self.slow, self.begun = slow, False

    def put(self, estimate) -> None:
        if not self.begun and estimate.t > 0.5:
            self.begun = next(self.slow) is not None

    def close(self) -> None:
        pass


# --- retention -----------------------------------------------------------------------------------


@pytest.mark.long
def test_thinning_keeps_what_a_resume_needs_and_the_phase_of_the_fields(tmp_path):
    count, retention = 10 * CHECKPOINT, Retention(10.0, 7)
    whole, broken = folders(tmp_path)
    ran(whole, count, retention=retention)
    for after in (CHECKPOINT + 3, CHECKPOINT + 10, 2):
        run = started(broken, count, retention=retention, sinks=[Breaks(after)])
        run.resume()
        with pytest.raises(Crash):
            run._run()
        run.journal.close()
    run = started(broken, count, retention=retention)
    run.resume()
    run.run()
    run.journal.thin(run.identifier.t - 10.0, 7)
    run.journal.close()
    with Journal.open(whole / NAME) as one, Journal.open(broken / NAME) as other:
        assert other.accepted == one.accepted == count
        assert other.first is not None
        assert other.first.id == 1
        old = [record.t for record in one if record.t < 30.0]
        assert 0 < len(old) < 300 / 6
        mine, yours = ({r.t: r for r in kept} for kept in (other, one))
        shared = mine.keys() & yours.keys()
        assert len(shared) > CHECKPOINT
        for t in shared:
            assert np.array_equal(mine[t].numbers, yours[t].numbers)
            if t > count * 0.1 - 10.0:
                assert (mine[t].snapshot is None) == (yours[t].snapshot is None)


@pytest.mark.long
def test_thinning_does_not_disturb_an_open_iteration(tmp_path):
    run = started(tmp_path, 3 * CHECKPOINT)
    run.run()
    seen = []
    for number, record in run.journal.after(0):
        if number == 10:
            run.journal.thin(60.0, 5)
        seen.append(record.t)
    assert seen == sorted(set(seen))
    assert seen[-1] == run.identifier.t
    run.journal.close()


@pytest.mark.long
def test_a_thinned_journal_stops_growing(tmp_path):
    run = started(tmp_path, 1)
    run.run()
    kept, sizes = run.journal, []
    record = next(iter(kept))
    state = run.identifier.dump()
    for k in range(1, 12001):
        kept.accept(float(k), {"a": 1.0})
        kept.append(record)
        kept.note(Event(float(k), "odd", "", "x" * 10))
        if k % 500 == 0:
            kept.checkpoint(state)
            kept.thin(k - 1000.0, 1000)
            sizes.append((tmp_path / NAME).stat().st_size)
    assert len(kept.events) == KEPT_EVENTS
    assert sizes[-1] < 1.1 * sizes[-4]
    kept.close()


# --- rows of any kind ----------------------------------------------------------------------------

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=8,
)
NUMBERS = st.floats() | st.integers() | st.sampled_from(["1", "1e999", "nan", "", "9" * 400, "1 K"])
TIMES = st.one_of(
    st.floats(),
    st.datetimes().map(str),
    st.sampled_from(["0001-01-01T00:00+23:59", "9999-12-31T23:59-23:59", "2026-02-30", "", "now"]),
    st.integers(min_value=-(10**400), max_value=10**400),
    VALUES,
)
ROWS = st.fixed_dictionaries(
    {}, optional={"t": TIMES, "a": NUMBERS | VALUES, "b": NUMBERS | VALUES, "left": VALUES}
) | st.dictionaries(st.text(max_size=5), VALUES, max_size=4)


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(st.lists(ROWS, max_size=20))
def test_any_row_becomes_part_of_a_sample_or_has_a_reason(found):
    intake = Intake(COLUMNS, CLOCK)
    out = []
    for token, row in enumerate(found):
        outcome = intake.take(row, token)
        used = token in intake.waiting or any(token in ready.tokens for ready in outcome.ready)
        assert used or outcome.remarks
        assert used or token in outcome.spent
        out += outcome.ready
    out += intake.flush().ready
    times = [ready.t for ready in out]
    assert times == sorted(set(times))
    assert all(np.isfinite(t) for t in times)
    assert all(not np.isinf(value) for ready in out for value in ready.values.values())


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200) | st.text(max_size=100) | ROWS.map(json.dumps))
def test_any_line_of_json_is_a_row_or_has_a_reason(line):
    row = json_row(line)
    assert row.broken or isinstance(row.values, dict)


def _labels(line: bytes) -> bool:
    """Return whether a line of a CSV file has labels instead of values."""
    try:
        cells = next(csv.reader([line.decode()], skipinitialspace=True), [])
    except (UnicodeError, csv.Error):
        return False
    return are_labels(cells)


@pytest.mark.slow
@settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    lines=st.lists(st.binary(max_size=60), max_size=12), suffix=st.sampled_from(["csv", "jsonl"])
)
def test_any_line_of_a_file_is_a_row_or_has_a_reason(tmp_path, lines, suffix):
    lines = [line.replace(b"\n", b"?") for line in lines]
    path = tmp_path / f"rows.{suffix}"
    path.write_bytes(b"t,a,b,left\n" * (suffix == "csv") + b"".join(x + b"\n" for x in lines))
    follow, found = Follow(path), []
    while not follow.done:
        found += follow.poll(0.0)
    shown = [line for line in lines if line.strip()]
    if suffix == "csv":
        shown = [line for line in shown if not line.lstrip(b' "').startswith(b"#")]
    # The first two lines below a header may be labels, such as units.
    under = itertools.takewhile(_labels, shown[:2] if suffix == "csv" else [])
    assert len(found) == len(shown) - len(list(under))
    intake = Intake(COLUMNS, CLOCK)
    for row in found:
        if not row.broken:
            intake.take(row.values, row.token)


@pytest.mark.slow
def test_valid_lines_arrive_between_arbitrary_lines(tmp_path):
    write(tmp_path, 40)
    path = tmp_path / "data.csv"
    head, *right = path.read_bytes().splitlines()
    rng = np.random.default_rng(3)
    mixed = [head]
    for line in right:
        mixed += [line, rng.bytes(30).replace(b"\n", b"?"), line[:4], b"\xff" + line]
    path.write_bytes(b"\n".join(mixed) + b"\n")
    run = live(tmp_path)
    run.run()
    assert len(run.journal) == 40
    run.journal.close()


# --- the folder around it ------------------------------------------------------------------------


def test_a_partly_created_run_folder_is_created_again(tmp_path):
    def create():
        return RunWriter.create(
            tmp_path / "run", version="1", command=["x"], title="A run", case="abc = 1\n"
        )

    folder = tmp_path / "run"
    for text in ("", "abc", "abc = 1\n"):
        folder.mkdir()
        (folder / "case.toml").write_text(text)
        (folder / "run.json.partial").write_text("{")
        create()
        assert (folder / "case.toml").read_text() == "abc = 1\n"
        with pytest.raises(lp.errors.RunError, match="already contains a run"):
            create()
        shutil.rmtree(folder)
    for name, text in (("case.toml", "other"), ("mine.txt", "")):
        folder.mkdir()
        (folder / name).write_text(text)
        with pytest.raises(lp.errors.RunError, match="is not empty"):
            create()
        shutil.rmtree(folder)


def test_a_record_that_cannot_be_written_is_refused_with_one_sentence(tmp_path, monkeypatch):
    options = {"version": "1", "case": "a = 1\n"}
    path = tmp_path / "run"
    RunWriter.create(path, command=["x"], title="A run", **options)
    monkeypatch.setattr("livepde.atomic_write.secrets.token_hex", lambda size: "0")
    (path / "run.json.0.partial").mkdir()
    with pytest.raises(lp.errors.RunError, match="cannot be written: File exists; free disk space"):
        RunWriter.reopen(path, command=["x"], settings=(), **options)


def test_an_error_while_a_journal_is_opened_is_reported_once(tmp_path, monkeypatch):
    def full(path):
        raise lp.errors.RunError("the disk is full; make room.")

    monkeypatch.setattr("livepde.runs.journal.writer", full)
    with pytest.raises(lp.errors.RunError, match=r"^the disk is full; make room\.$"):
        journal(tmp_path / NAME)


def test_estimates_that_are_deleted_are_read_from_the_journal(tmp_path):
    writer = RunWriter.create(tmp_path / "run", version="1", command=["x"], title="A run")
    with Journal.open(finished(tmp_path / "run")) as kept:
        data = kept.dataset()
    writer.finish(status="ok", dataset=data, shown=[], checks=[], notes=[])
    (tmp_path / "run" / "estimates.nc").unlink()
    assert runs.open(tmp_path / "run").dataset.equals(data)


# --- checksums -----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "UPDATE estimates SET numbers = zeroblob(length(numbers)) WHERE id = 7",
        "UPDATE estimates SET t = t + 1e-9 WHERE id = 7",
        "UPDATE estimates SET id = 99 WHERE id = 30",
        "UPDATE fields SET content = content || x'00' WHERE id = 1",
        "UPDATE meta SET value = replace(value, 'a', 'b')",
        "UPDATE samples SET position = position || ' ' WHERE id = 30",
        "INSERT INTO counts VALUES ('late', '', 3, 0)",
    ],
)
def test_a_changed_record_is_reported(tmp_path, command):
    path = finished(tmp_path)
    altered(path, command)
    refused(path, match="damaged.*restore it from a copy, or run the case again")


@pytest.mark.long
@pytest.mark.parametrize("rest", [1, 0])
def test_the_older_checkpoint_is_used_if_the_newest_is_damaged(tmp_path, rest):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for folder in (whole, broken):
        folder.mkdir()
        ran(folder, 2 * CHECKPOINT + 40)
    with sqlite3.connect(broken / NAME) as raw:
        numbers = [n for (n,) in raw.execute("SELECT id FROM checkpoints ORDER BY id DESC")]
        assert len(numbers) == 2
        for number in numbers[: 2 - rest]:
            wrong = "x'00' || substr(state, 2)"
            raw.execute(f"UPDATE checkpoints SET state = {wrong} WHERE id = ?", (number,))
    raw.close()
    ends = []
    for folder in (whole, broken):
        run = started(folder, 2 * CHECKPOINT + 60)
        again = run.resume()
        run.run()
        ends.append((again, run.identifier.dump()))
        run.journal.close()
    assert ends[0][0] == 0
    assert ends[1][0] == (40 if rest else 2 * CHECKPOINT + 40)
    assert ends[0][1] == ends[1][1]
    same_runs(whole, broken)


@pytest.mark.long
def test_a_missing_checkpoint_is_reported(tmp_path):
    ran(tmp_path, 3 * CHECKPOINT, retention=Retention(span=1.0))
    altered(tmp_path / NAME, "UPDATE checkpoints SET crc = crc + 1")
    with (
        Journal.open(tmp_path / NAME, write=True) as kept,
        pytest.raises(lp.errors.RunError, match="no checkpoint is as it was"),
    ):
        kept.rewind()


@pytest.mark.slow
def test_a_page_that_hides_rows_is_detected(tmp_path):
    """Checksums of the remaining rows do not show it; the pages do."""
    path = finished(tmp_path, 200)
    with sqlite3.connect(path) as raw:
        (size,) = raw.execute("PRAGMA page_size").fetchone()
    raw.close()
    content, hidden = bytearray(path.read_bytes()), 0
    for page in range(size, len(content), size):
        count = int.from_bytes(content[page + 3 : page + 5])
        if content[page] != 13 or count < 2:  # not a leaf page of a table
            continue
        damaged = bytearray(content)
        damaged[page + 3 : page + 5] = (count - 1).to_bytes(2)
        path.write_bytes(damaged)
        with pytest.raises(lp.errors.RunError, match="is damaged"), Journal.open(path) as kept:
            list(kept)
        hidden += 1
    assert hidden > 10
    path.write_bytes(damaged)
    with pytest.raises(lp.errors.RunError, match="is damaged"):
        Journal.open(path, write=True)
