"""What a run survives: kills at any moment, brokers and sources that go away, rows that are broken.

Kills: `livepde run --resume` takes a few thousand rows from a file that grows or from a broker, is
killed with SIGKILL again and again, and ends as a run does that nobody disturbed: bit by bit. The
moments are drawn at random: while it starts and resumes, while it steps, right when its journal
grows, and while it ends.

Broken rows: real and generated rows, mutated in every way that we could think of, between rows that
are right. Each is counted with a reason, and what is right arrives.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeAlias

import numpy as np

from livepde.errors import RunError
from livepde.progress import watched
from livepde.records import Record
from livepde.runs import JOURNAL, Check, Journal, Outcome, Table

__all__ = ["PARTS", "faults"]

KILLS, SAMPLES, MALFORMED = 200, 2000, 100_000
PATIENCE = 120.0  # seconds after which a run that does not go on is given up
STRIDE = 0.25  # seconds after a sign of life within which a kill falls
LEAD = (50, 400)  # rows that are there before they are asked for
SILENCE = 1.0  # seconds after which a source is said to be silent
BROKER = "/usr/sbin:/usr/bin:/usr/local/sbin:/usr/local/bin:/opt/homebrew/sbin"

Row: TypeAlias = Mapping[str, Any]

CASE = """title = "A rod beside its process"
equation = "heat"
initial = "interpolate"

[mesh]
from = "0 m"
to = "1 m"
cells = 20

[data]
time = "time"
{source}

[intake]
silence = "{silence} s"
leap = "1 d"

[unknowns.alpha]
prior = "2e-5 m^2/s"
std = "1e-5 m^2/s"
bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]

[channels]
left = {{ role = "boundary", column = "left", at = "left", unit = "degC" }}
T_3 = {{ role = "sensor", column = "T_3", at = "0.3 m", unit = "degC" }}
T_6 = {{ role = "sensor", column = "T_6", at = "0.6 m", unit = "degC" }}

[boundary]
right = "20 degC"

[law]
kind = "sensitivity"
noise = "0.2 K"

[output]
fields_every = 20
"""


def faults(
    kills: int = KILLS,
    samples: int = SAMPLES,
    malformed: int = MALFORMED,
    seed: int = 0,
    only: Sequence[str] = (),
    progress: bool = False,
) -> Outcome:
    """Do harm to runs, and count what was lost.

    Parameters
    ----------
    kills, samples
        Kills of runs with so many samples, for a file and for a broker.
    malformed
        Rows and messages that are broken.
    only
        Some of `PARTS`.
    """
    tables: list[Table] = []
    checks: list[Check] = []
    for name in only or PARTS:
        outcome = PARTS[name](_Plan(kills, samples, malformed, seed, progress))
        tables += outcome.tables
        checks += outcome.checks
    return Outcome(tables=tables, checks=checks)


@dataclass(frozen=True)
class _Plan:
    kills: int
    samples: int
    malformed: int
    seed: int
    progress: bool

    def watched(self, count: int, what: str) -> Iterator[int]:
        return watched(range(count), count, what) if self.progress else iter(range(count))


# --- rows and where they come from ---------------------------------------------------------------


def _rows(count: int) -> list[dict[str, Any]]:
    """Return rows of a rod whose end is warmed and cooled, with noise."""
    rng, start = np.random.default_rng(0), datetime(2026, 1, 1)
    found = []
    for k in range(count):
        left = 20.0 + 10.0 * math.sin(0.02 * k) ** 2
        a, b = 20.0 + np.array([0.4, 0.1]) * (left - 20.0) + 0.2 * rng.standard_normal(2)
        moment = str(start + timedelta(minutes=k))
        found.append({"time": moment, "left": left, "T_3": float(a), "T_6": float(b)})
    return found


class _Plant(Protocol):
    """Brings rows to a run."""

    source: str

    def supply(self, count: int) -> None:
        """Have the first so many rows there."""


class _File:
    """A file that grows, not always by whole lines."""

    source = 'file = "rows.csv"\nfollow = true'

    def __init__(self, folder: Path, rows: Sequence[Row], seed: int) -> None:
        self.path = folder / "rows.csv"
        self._rng = np.random.default_rng(seed)
        self._lines = [",".join(map(str, row.values())) + "\n" for row in rows]
        self._text = ",".join(rows[0]) + "\n"
        self._count = 0
        self._written = 0

    def supply(self, count: int) -> None:
        whole = len(self._lines) <= count
        self._text += "".join(self._lines[self._count : count])
        self._count = max(count, self._count)
        cut = 0 if whole else int(self._rng.integers(0, 40))
        end = max(len(self._text) - cut, self._written)
        with self.path.open("a") as file:
            file.write(self._text[self._written : end])
        self._written = end


class _Topic:
    """Messages of a broker that keeps them for who is away."""

    def __init__(self, broker: Mosquitto, rows: Sequence[Row], name: str) -> None:
        from livepde.streams.mqtt import Broker, MqttSource

        self._topic, self._count = f"{name}/rows", 0
        self._messages = [json.dumps(row) for row in rows]
        self.source = (
            f'[data.mqtt]\nhost = "127.0.0.1"\nport = {broker.port}\nclient_id = "{name}"\n'
            f'rows = ["{self._topic}"]'
        )
        place = ("127.0.0.1", broker.port)
        MqttSource(Broker(*place, name), {self._topic: None}, "time").close()  # a session
        self._client = Broker(*place, f"{name}-plant").client()
        Broker(*place, f"{name}-plant").connect(self._client)

    def supply(self, count: int) -> None:
        _wait(self.connected, "the plant does not reach its broker")
        sent = [self.send(text) for text in self._messages[self._count : count]]
        for message in sent:
            message.wait_for_publish(PATIENCE)
        self._count = max(count, self._count)

    def connected(self) -> bool:
        """Return whether it reaches the broker."""
        return bool(self._client.is_connected())

    def send(self, message: str | bytes) -> Any:
        return self._client.publish(self._topic, message, qos=1)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


class Mosquitto:
    """A broker of its own, with sessions that survive its restart."""

    def __init__(self, folder: Path) -> None:
        program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:{BROKER}")
        if program is None:
            raise RunError(
                "there is no MQTT broker: install mosquitto (Debian's package of that name), or "
                "leave it out with --only file --only malformed."
            )
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        config = folder / "mosquitto.conf"
        user = "user root\n" if os.geteuid() == 0 else ""
        config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_location {folder}/\nautosave_interval 1\nautosave_on_changes true\n"
            f"max_queued_messages 0\n{user}"
        )
        self._command = [program, "-c", str(config)]
        self.start()

    def start(self) -> None:
        """Start it and wait until it listens."""
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

        def listens() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.port)) == 0

        _wait(listens, "mosquitto does not listen")

    def stop(self) -> None:
        """Stop it; what it keeps is on disk."""
        self._process.terminate()
        self._process.wait()


def _wait(what: Callable[[], bool], why: str, patience: float = PATIENCE) -> None:
    end = time.monotonic() + patience
    while not what():
        if time.monotonic() > end:
            raise RunError(f"bench faults: {why}.")
        time.sleep(0.002)


# --- one run -------------------------------------------------------------------------------------


class _Run:
    """`livepde run` of the case in a folder, as a process that can be killed."""

    def __init__(self, folder: Path, source: str) -> None:
        self.folder = folder
        self.out = folder / "run"
        self._journal: Journal | None = None
        self._process: subprocess.Popen[bytes] | None = None
        text = CASE.format(source=source, silence=SILENCE)
        (folder / "case.toml").write_text(text)

    def start(self) -> None:
        command = [sys.executable, "-m", "livepde", "run", "case.toml", "--out", "run", "--resume"]
        with (self.folder / "log.txt").open("ab") as log:
            self._process = subprocess.Popen(
                command, cwd=self.folder, stdout=subprocess.DEVNULL, stderr=log
            )

    def look(self) -> int:
        """Return how many samples are accepted; a reader is open all the time."""
        if self._journal is None and (self.out / JOURNAL).exists():
            self._journal = Journal.open(self.out / JOURNAL)
        return 0 if self._journal is None else self._journal.accepted

    @property
    def log_size(self) -> int:
        """Bytes of the journal's write-ahead log."""
        log = self.out / f"{JOURNAL}-wal"
        return log.stat().st_size if log.exists() else 0

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process that was started last."""
        if self._process is None:
            raise RunError("bench faults: nothing was started.")
        return self._process

    def alive(self) -> bool:
        """Return whether it runs; one that has ended by itself is an error."""
        code = self.process.poll()
        if code is not None and code not in (0, -signal.SIGKILL):
            told = (self.folder / "log.txt").read_text()[-2000:]
            raise RunError(f"bench faults: a run ended with code {code}:\n{told}")
        return code is None

    def signal(self, number: int) -> bool:
        """Send a signal; return whether there was still somebody to hear it."""
        if not self.alive():
            return False
        self.process.send_signal(number)
        return True

    def kill(self) -> bool:
        """Kill it; return whether it was still there."""
        there = self.signal(signal.SIGKILL)
        return self.process.wait() == -signal.SIGKILL and there

    def wait_for(self, samples: int) -> None:
        """Wait until so many samples have been estimated."""

        def estimated() -> bool:
            self.alive()
            self.look()
            return self._journal is not None and len(self._journal) >= samples

        _wait(estimated, f"a run did not take {samples} samples")

    def wait_for_event(self, kind: str, number: int) -> None:
        """Wait until something has happened so often."""

        def happened() -> bool:
            self.alive()
            self.look()
            events = () if self._journal is None else self._journal.events
            return sum(event.kind == kind for event in events) >= number

        _wait(happened, f"a run did not say {kind!r}")

    def end(self, samples: int) -> None:
        """Let it take all samples, and end it as a service is ended."""
        self.wait_for(samples)
        self.signal(signal.SIGTERM)
        self.process.wait(PATIENCE)
        self.alive()

    def close(self) -> None:
        """Leave nothing behind."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._journal is not None:
            self._journal.close()


@dataclass(frozen=True, eq=False)
class _Found:
    """What a run leaves behind."""

    records: Sequence[Record]
    samples: int
    state: bytes
    events: Counter[str]
    counts: Counter[str]

    @classmethod
    def of(cls, folder: Path) -> _Found:
        with Journal.open(folder / JOURNAL) as journal:
            counts: Counter[str] = Counter()
            for (kind, _), number in journal.counts.items():
                counts[kind] += number
            events = Counter(event.kind for event in journal.events)
            records = list(journal)
            state = (folder / "checkpoint.npz").read_bytes()
            return cls(records, journal.accepted, state, events, counts)


@dataclass
class _Damage:
    """What has become of runs that were disturbed."""

    runs: int = 0
    lost: int = 0
    doubled: int = 0
    different: int = 0

    def compare(self, found: _Found, expected: _Found) -> None:
        """Hold a run against the one that nobody disturbed."""
        times = Counter(record.t for record in found.records)
        wanted = {record.t for record in expected.records}
        self.runs += 1
        self.lost += len(wanted - set(times)) + max(len(wanted) - found.samples, 0)
        self.doubled += sum(times.values()) - len(times) + max(found.samples - len(wanted), 0)
        pairs = zip(found.records, expected.records, strict=False)
        self.different += sum(not _same(mine, yours) for mine, yours in pairs)
        self.different += found.state != expected.state

    def checks(self, name: str) -> list[Check]:
        """Nothing may be lost, doubled or different."""
        return [
            Check(f"{name}: samples lost", self.lost, 0, "<="),
            Check(f"{name}: samples doubled", self.doubled, 0, "<="),
            Check(f"{name}: estimates and states that differ in a bit", self.different, 0, "<="),
        ]


def _same(one: Record, other: Record) -> bool:
    """Return whether two records agree in every bit."""
    names = ("numbers", "innovation", "withheld_error")
    if any(getattr(one, name).tobytes() != getattr(other, name).tobytes() for name in names):
        return False
    if (one.t, one.status, one.steps) != (other.t, other.status, other.steps):
        return False
    if json.dumps(dict(one.notes)) != json.dumps(dict(other.notes)):  # NaN is NaN here
        return False
    mine, yours = one.snapshot, other.snapshot
    if mine is None or yours is None:
        return mine is yours
    return mine.told == yours.told and all(
        values.tobytes() == yours.profiles[name].tobytes() for name, values in mine.profiles.items()
    )


@contextmanager
def _running(folder: Path, source: str) -> Iterator[_Run]:
    run = _Run(folder, source)
    try:
        yield run
    finally:
        run.close()


def _undisturbed(folder: Path, rows: Sequence[Row]) -> tuple[_Found, float]:
    """Return what a run finds that nobody disturbs, and the seconds until its first sample."""
    plant = _File(folder, rows, 0)
    plant.supply(len(rows))
    with _running(folder, plant.source) as run:
        begun = time.monotonic()
        run.start()
        _wait(lambda: run.alive() and run.look() > 0, "a run did not begin")
        start = time.monotonic() - begun
        run.end(len(rows))
    return _Found.of(folder / "run"), start


# --- kills ---------------------------------------------------------------------------------------

MOMENTS = {"start": 0.25, "step": 0.4, "write": 0.25, "end": 0.1}  # share of the kills


def _kills_of_files(plan: _Plan) -> Outcome:
    with TemporaryDirectory() as folder:
        return _killed(plan, Path(folder), "file", _File)


def _kills_of_topics(plan: _Plan) -> Outcome:
    with TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        place = folder / "broker"
        place.mkdir()
        broker = Mosquitto(place)
        stack.callback(broker.stop)

        def plant(here: Path, rows: Sequence[Row], seed: int) -> _Topic:
            topic = _Topic(broker, rows, here.name)
            stack.callback(topic.close)
            return topic

        return _killed(plan, folder, "mqtt", plant)


def _killed(
    plan: _Plan, folder: Path, name: str, plants: Callable[[Path, Sequence[Row], int], _Plant]
) -> Outcome:
    rows, rng = _rows(plan.samples), np.random.default_rng(plan.seed)
    calm = folder / "calm"
    calm.mkdir()
    expected, start = _undisturbed(calm, rows)
    damage, fallen = _Damage(), Counter[str]()
    bar = plan.watched(plan.kills, f"kills, {name}")
    next(bar, None)
    while fallen.total() < plan.kills:
        here = folder / f"{name}-{damage.runs}"
        here.mkdir()
        plant = plants(here, rows, plan.seed + damage.runs)
        with _running(here, plant.source) as run:
            while run.look() < len(rows) and fallen.total() < plan.kills:
                moment = str(rng.choice([*MOMENTS], p=[*MOMENTS.values()]))
                if _kill(run, plant, moment, start, rng):
                    fallen[moment] += 1
                    next(bar, None)
            plant.supply(len(rows))
            run.start()
            run.end(len(rows))
        damage.compare(_Found.of(here / "run"), expected)
        shutil.rmtree(here)
    table = Table(
        f"Kills, {name}: {plan.samples} samples a run",
        ("runs", *(f"at {moment}" for moment in MOMENTS), "lost", "doubled", "different"),
        [
            (
                damage.runs,
                *(fallen[moment] for moment in MOMENTS),
                damage.lost,
                damage.doubled,
                damage.different,
            )
        ],
    )
    enough = Check(f"{name}: kills", fallen.total(), plan.kills, ">=")
    return Outcome(tables=[table], checks=[enough, *damage.checks(name)])


def _kill(run: _Run, plant: _Plant, moment: str, start: float, rng: np.random.Generator) -> bool:
    """Start a run and kill it at such a moment; return whether it was still there."""
    seen = run.look()
    plant.supply(seen + int(rng.integers(*LEAD)))
    run.start()
    if moment == "start":  # also while it resumes
        time.sleep(float(rng.uniform(0.0, 1.2 * start)))
        return run.kill()
    _wait(lambda: not run.alive() or run.look() > seen, "a run does not go on")
    plant.supply(run.look() + int(rng.integers(*LEAD)))
    until = time.monotonic() + float(rng.uniform(0.0, STRIDE))
    if moment == "write":  # while its log grows, if it does
        size = run.log_size
        while run.log_size == size and time.monotonic() < until:
            pass
        return run.kill()
    time.sleep(max(until - time.monotonic(), 0.0))
    if moment == "end":
        run.signal(signal.SIGTERM)
        time.sleep(float(rng.uniform(0.0, STRIDE)))
    return run.kill()


# --- sources that go away ------------------------------------------------------------------------


def _outages(plan: _Plan) -> Outcome:
    rows = _rows(min(plan.samples, 600))
    third, rest = len(rows) // 3, 2 * len(rows) // 3
    damage, restarts = _Damage(), 2
    with TemporaryDirectory() as name, ExitStack() as stack:
        folders = {key: Path(name) / key for key in ("broker", "calm", "mqtt", "file")}
        for folder in folders.values():
            folder.mkdir()
        expected, _ = _undisturbed(folders["calm"], rows)
        broker = Mosquitto(folders["broker"])
        stack.callback(broker.stop)
        topic = _Topic(broker, rows, "rod")
        stack.callback(topic.close)
        run = stack.enter_context(_running(folders["mqtt"], topic.source))
        run.start()
        for part in np.linspace(0, third, restarts + 1, dtype=int).tolist()[1:]:
            topic.supply(part)
            run.wait_for(part // 2)  # the others are on their way
            broker.stop()
            _wait(lambda: not topic.connected(), "a broker that was stopped answers")
            broker.start()
        topic.supply(rest)
        run.wait_for_event("silent", 1)  # nothing is sent
        topic.supply(len(rows))
        run.end(len(rows))
        heard = [_Found.of(run.out)]

        file = _File(folders["file"], rows, plan.seed)
        run = stack.enter_context(_running(folders["file"], file.source))
        file.supply(third)
        run.start()
        run.wait_for(third // 2)
        away = file.path.rename(file.path.with_name("away"))
        run.wait_for_event("silent", 1)
        away.rename(file.path)
        file.supply(len(rows))
        run.end(len(rows))
        heard.append(_Found.of(run.out))
    for found in heard:
        damage.compare(found, expected)
    outages = sum(min(found.events["silent"], found.events["heard"]) for found in heard)
    table = Table(
        f"Sources that go away: {len(rows)} samples",
        ("broker restarts", "outages noticed", "lost", "doubled", "different"),
        [(restarts, outages, damage.lost, damage.doubled, damage.different)],
    )
    noticed = Check("outages: noticed, and their end", outages, len(heard), ">=")
    return Outcome(tables=[table], checks=[noticed, *damage.checks("outages")])


PARTS: Mapping[str, Callable[[_Plan], Outcome]] = {
    "file": _kills_of_files,
    "mqtt": _kills_of_topics,
    "restart": _outages,
}
