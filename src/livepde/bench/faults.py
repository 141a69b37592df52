"""What a run survives: kills at any moment, brokers and sources that go away, rows that are broken.

Kills: `livepde run --resume` takes a few thousand rows from a file that grows or from a broker, is
killed with SIGKILL again and again, and ends as a run does that nobody disturbed: bit by bit. The
moments are drawn at random: while it starts and resumes, while it steps, right when its journal
grows, and while it ends.

Broken rows: real and generated rows, mutated in every way that we could think of, between rows that
are right. Each is counted with a reason, and what is right arrives.
"""

from __future__ import annotations

import csv
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
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol, TypeAlias

import numpy as np

from livepde.bench.cases import find_cases
from livepde.cases import Case, load
from livepde.cases.data import data_file
from livepde.cases.sources import policy_of, source_of
from livepde.errors import LivepdeError, RunError
from livepde.identifier import Sample
from livepde.progress import watched
from livepde.records import Record
from livepde.runs import JOURNAL, Check, Journal, Outcome, Table
from livepde.runs.feeds import Gathered
from livepde.runs.journal import log_of
from livepde.runs.live import Live
from livepde.streams.intake import Intake, Ready
from livepde.streams.intake import Outcome as RowOutcome
from livepde.streams.sources import Row as SourceRow
from livepde.streams.sources import Source

__all__ = ["PARTS", "faults"]

KILLS, SAMPLES, MALFORMED = 200, 2000, 100_000
ALPHA = 2e-5  # m^2/s, of the rod
PATIENCE = 120.0  # seconds after which a run that does not go on is given up
STRIDE = 0.25  # seconds after a sign of life within which a kill falls
LONG_ONES = 0.02  # share of the lines of 2 MB that are written
LEAD = (20, 400)  # rows that are there before they are asked for
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
prior = "3e-5 m^2/s"
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
replay = true

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
    x, rate = np.array([0.0, 0.3, 0.6]), 0.04  # places, and the phase that passes in a minute
    decay = x / math.sqrt(2.0 * ALPHA / (rate / 60.0))  # of a wave that goes into the rod
    found = []
    for k in range(count):
        wave = np.exp(-decay) * np.cos(rate * k - decay)
        T = 20.0 + 5.0 * (1.0 - x - wave) + [0.0, *0.2 * rng.standard_normal(2)]
        names = ("left", "T_3", "T_6")
        values = dict(zip(names, T.tolist(), strict=True))
        found.append({"time": str(start + timedelta(minutes=k)), **values})
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
        log = log_of(self.out / JOURNAL)
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


@cache
def _undisturbed(count: int) -> tuple[_Found, float]:
    """Return what a run finds that nobody disturbs, and the seconds until its first sample."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        plant = _File(folder, _rows(count), 0)
        plant.supply(count)
        with _running(folder, plant.source) as run:
            begun = time.monotonic()
            run.start()
            _wait(lambda: run.alive() and run.look() > 0, "a run did not begin")
            start = time.monotonic() - begun
            run.end(count)
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
    expected, start = _undisturbed(plan.samples)
    damage, fallen = _Damage(), Counter[str]()
    bar = plan.watched(plan.kills, f"kills, {name}")
    next(bar, None)
    while fallen.total() < plan.kills:
        here = folder / f"{name}-{damage.runs}"
        here.mkdir()
        plant = plants(here, rows, plan.seed + damage.runs)
        with _running(here, plant.source) as run:
            while run.look() < len(rows) - LEAD[0] and fallen.total() < plan.kills:
                moment = str(rng.choice([*MOMENTS], p=[*MOMENTS.values()]))
                if _kill(run, plant, len(rows) - 1, moment, start, rng):
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


def _kill(
    run: _Run, plant: _Plant, rows: int, moment: str, start: float, rng: np.random.Generator
) -> bool:
    """Start a run and kill it at such a moment; return whether it was still there."""
    seen = run.look()
    plant.supply(min(seen + int(rng.integers(*LEAD)), rows))
    run.start()
    if moment == "start":  # also while it resumes
        time.sleep(float(rng.uniform(0.0, 1.2 * start)))
        return run.kill()
    _wait(lambda: not run.alive() or run.look() > seen, "a run does not go on")
    plant.supply(min(run.look() + int(rng.integers(*LEAD)), rows))
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
        folders = {key: Path(name) / key for key in ("broker", "mqtt", "file")}
        for folder in folders.values():
            folder.mkdir()
        expected, _ = _undisturbed(len(rows))
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


# --- rows that are broken ------------------------------------------------------------------------


def _malformed(plan: _Plan) -> Outcome:
    rng = np.random.default_rng(plan.seed)
    tables, checks = [], []
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "case.toml").write_text(CASE.format(source="", silence=SILENCE))
        rod = load(folder / "case.toml")
        rows = _rows(min(plan.samples, 1000))
        feeds = {
            "generated, JSON": (rod, rows, "rows.jsonl"),
            "generated, CSV": (rod, rows, "rows.csv"),
        }
        soil = _soil()
        if soil is not None:
            feeds["soil, CSV"] = (soil[0], soil[1], "soil.csv")
            feeds["soil, JSON"] = (soil[0], soil[1], "soil.jsonl")
        sent, each = 0, math.ceil(plan.malformed / len(feeds))
        for title, (case, chosen, file) in feeds.items():
            fed = _fed(case, chosen, folder / file, each, rng)
            tables.append(fed.table(title))
            checks += fed.checks(title)
            sent += fed.sent.total()
    return Outcome(
        tables=tables, checks=[Check("broken rows", sent, plan.malformed, ">="), *checks]
    )


def _messages(plan: _Plan) -> Outcome:
    """Send broken messages to the real command, between right ones."""
    rng = np.random.default_rng(plan.seed)
    rows, count = _rows(min(plan.samples, 600)), max(plan.malformed // 20, 1)
    damage = _Damage()
    with TemporaryDirectory() as name, ExitStack() as stack:
        folders = {key: Path(name) / key for key in ("broker", "mqtt")}
        for folder in folders.values():
            folder.mkdir()
        expected, _ = _undisturbed(len(rows))
        broker = Mosquitto(folders["broker"])
        stack.callback(broker.stop)
        topic = _Topic(broker, rows, "rod")
        stack.callback(topic.close)
        run = stack.enter_context(_running(folders["mqtt"], topic.source))
        run.start()
        per_row = np.bincount(rng.integers(0, len(rows), count), minlength=len(rows))
        for k, times in enumerate(per_row.tolist()):
            topic.supply(k + 1)
            for _ in range(times):
                _, line = _broken(JSON | BYTES, rows[k], _json_line, rng)
                topic.send(line).wait_for_publish(PATIENCE)
        run.end(len(rows))
        found = _Found.of(run.out)
    damage.compare(found, expected)
    reasons = ", ".join(f"{kind} {number}" for kind, number in sorted(found.counts.items()))
    table = Table(
        f"Broken messages between {len(rows)} right ones, from a broker to livepde run",
        ("sent", "reasons", "lost", "doubled", "different"),
        [(count, reasons, damage.lost, damage.doubled, damage.different)],
    )
    counted = Check("broken messages: counted", found.counts.total(), count, ">=")
    return Outcome(tables=[table], checks=[counted, *damage.checks("broken messages")])


def _soil() -> tuple[Case, list[dict[str, Any]]] | None:
    """Return the soil case and its real rows, if they are here."""
    try:
        path = next(path for path in find_cases() if path.stem == "soil_uniform")
        case = load(path, settings={"intake.leap": "10 d"})
        with data_file(case.frame).open(newline="", encoding="utf-8") as file:
            rows = [dict(row) for row in csv.DictReader(file)]
        return case, [row for row in rows if row[case.clock.name] >= str(case.clock.start)]
    except (StopIteration, LivepdeError, OSError):
        return None


class _Audited(Gathered):
    """Remembers what became of each row, by the place where its line begins."""

    def __init__(self, source: Source, intake: Intake) -> None:
        super().__init__(source, intake)
        self.reasons: dict[int, set[str]] = {}

    def _outcome(self, row: SourceRow, token: Any) -> RowOutcome:
        found = super()._outcome(row, token)
        self.reasons[row.token[1]] = {remark.kind for remark in found.remarks}
        return found


@dataclass(frozen=True)
class _Fed:
    """What became of a file with broken rows between the right ones."""

    sent: Counter[str]
    reasons: Counter[str]
    silent: int
    right: int
    arrived: int
    different: int

    def table(self, title: str) -> Table:
        """Return what was sent and what was said of it."""
        rows = [("sent", kind, number) for kind, number in sorted(self.sent.items())]
        rows += [("counted", kind, number) for kind, number in sorted(self.reasons.items())]
        rows += [("right rows", "sent", self.right), ("right rows", "arrived", self.arrived)]
        return Table(f"Broken rows, {title}", ("", "kind", "number"), rows)

    def checks(self, title: str) -> list[Check]:
        """Every broken row has a reason, every right one arrives, nothing else does."""
        return [
            Check(f"{title}: broken rows without a reason", self.silent, 0, "<="),
            Check(f"{title}: right rows that are missing", self.right - self.arrived, 0, "<="),
            Check(f"{title}: estimates that differ in a bit", self.different, 0, "<="),
        ]


def _fed(case: Case, rows: Sequence[Row], path: Path, count: int, rng: np.random.Generator) -> _Fed:
    """Feed right rows with so many broken ones between them, and the right ones alone."""
    write = _json_line if path.suffix == ".jsonl" else _csv_line
    head = b"" if path.suffix == ".jsonl" else ",".join(rows[0]).encode() + b"\n"
    clean = path.with_stem("clean")
    clean.write_bytes(head + b"".join(write(row) + b"\n" for row in rows))
    expected, _ = _taken(case, clean)
    breaks = (JSON if path.suffix == ".jsonl" else CSV) | BYTES
    sent, broken = Counter[str](), set[int]()
    per_row = np.bincount(rng.integers(0, len(rows), count), minlength=len(rows))
    with path.open("wb") as file:
        file.write(head)
        for row, times in zip(rows, per_row.tolist(), strict=True):
            file.write(write(row) + b"\n")
            for _ in range(times):
                kind, line = _broken(breaks, row, write, rng)
                sent[kind] += 1
                broken.add(file.tell())
                file.write(line + b"\n")
    found, reasons = _taken(case, path)
    told = Counter(kind for place in broken for kind in sorted(reasons.get(place, ()))[:1])
    return _Fed(
        sent,
        told,
        sum(not reasons.get(place) for place in broken),
        len(expected),
        len(found),
        sum(not _same(one, other) for one, other in zip(found, expected, strict=False)),
    )


def _broken(
    breaks: Mapping[str, Break],
    row: Row,
    write: Callable[[Row], bytes],
    rng: np.random.Generator,
) -> tuple[str, bytes]:
    """Return a kind and one line of it, which is never blank; the very long are rare."""
    kind = _one_of([*breaks])(rng)
    if kind == "very long" and rng.random() > LONG_ONES:
        kind = "truncated"
    line = breaks[kind](row, write, rng).replace(b"\n", b"?")
    return kind, line if line.strip() else b"?"


def _taken(case: Case, path: Path) -> tuple[list[Record], dict[int, set[str]]]:
    """Return what a live run of a file finds, and what it said of each line."""
    spec = case.frame.spec.data
    intake = Intake(case.columns, case.clock, policy_of(case.frame), missing=spec.missing)
    feed = _Audited(source_of(case.frame, str(path), ""), intake)
    begun: list[Ready] = []
    while not begun:
        begun += feed.poll(0.0)
    prepared = case.begin(Sample(begun[0].t, begun[0].values), intake.start)
    with prepared.journal() as journal:
        Live(prepared.identifier, feed, journal, fields_every=100, begun=begun).run()
        return list(journal), feed.reasons


def _json_line(row: Row) -> bytes:
    return json.dumps(dict(row)).encode()


def _csv_line(row: Row) -> bytes:
    return ",".join(map(str, row.values())).encode()


Break: TypeAlias = Callable[[Row, Callable[[Row], bytes], np.random.Generator], bytes]


def _one_of(options: Sequence[Any]) -> Callable[[np.random.Generator], Any]:
    return lambda rng: options[int(rng.integers(len(options)))]


def _value(*options: Any) -> Break:
    """Put something else where a number should be: in one column, or in all."""
    choose = _one_of(options)

    def broken(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
        _, *names = row
        chosen = names if rng.random() < 0.3 else [_one_of(names)(rng)]
        return write({**row, **{name: choose(rng) for name in chosen}})

    return broken


def _time(*options: Any) -> Break:
    """Put something else where the time should be."""
    choose = _one_of(options)

    def broken(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
        return write({**row, next(iter(row)): choose(rng)})

    return broken


def _ahead(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    """A clock that is wrong by a hundred to some thousand years."""
    name = next(iter(row))
    moment = datetime.fromisoformat(row[name])
    years = float(10.0 ** rng.uniform(2.0, 3.8))
    return write({**row, name: str(moment + timedelta(days=365.0 * years))})


def _truncated(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    text = write(row)
    return text[: int(rng.integers(1, len(text)))]


def _spoilt(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    """Invalid UTF-8 somewhere."""
    text = write(row)
    k = int(rng.integers(0, len(text)))
    wrong: bytes = _one_of((b"\xff", b"\xc3\x28", b"\xed\xa0\x80", b"\xfe"))(rng)
    return text[:k] + wrong + text[k:]


def _noise(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    return rng.bytes(int(rng.integers(1, 300)))


def _long(row: Row, write: Callable[[Row], bytes], rng: np.random.Generator) -> bytes:
    return write({**row, [*row][-1]: "9" * 2_000_000})


BYTES: dict[str, Break] = {
    "truncated": _truncated,
    "invalid UTF-8": _spoilt,
    "binary": _noise,
    "very long": _long,
    "text": _value("warm", "?", "nan K", "1,5", "--", "None of it", "0x1F", "1e", "[]"),
    "unit": _value("12.5 K", "3 m/s", "20 degC", "1e-3bar"),
    "infinite": _value("inf", "-Infinity", "1e400", "9" * 400),
    "time": _time("", "?", "now", "2026-13-45 00:00", "25:61", "nan", "inf", "2026-01-01T"),
    "far ahead": _ahead,
    "long ago": _time("1970-01-01", "0001-01-01 00:00:00", "1999-12-31 23:59:59+14:00"),
}
CSV: dict[str, Break] = {
    "too many fields": lambda row, write, rng: write(row) + b"," * int(rng.integers(1, 50)) + b"1",
    "other separator": lambda row, write, rng: write(row).replace(b",", b";"),
    "quotes": lambda row, write, rng: write(row).replace(b",", b',"', int(rng.integers(1, 4))),
    "zero bytes": lambda row, write, rng: write(row).replace(b",", b"\0,"),
    "nested": _value('"{""a"": [1, {""b"": 2}]}"'),
}
JSON: dict[str, Break] = {
    "types": _value([], {}, True, False, [1.5], {"value": 1.5}, [[[]]]),
    "huge": _value(10**400, -(10**4000), int("9" * 4200)),
    "time types": _time(None, True, [], {}, 1e300, -5.0, 10**400, ["2026-01-01"]),
    "no time": lambda row, write, rng: write(dict([*row.items()][1:])),
    "no values": lambda row, write, rng: write(dict([*row.items()][:1])),
    "not finite": lambda row, write, rng: write(row).replace(b": ", b': -Infinity, "x": ', 9),
    "duplicate keys": lambda row, write, rng: write(row)[:-1] + b", " + write(row)[1:],
    "nested object": lambda row, write, rng: write({"row": dict(row)}),
    "deep": lambda row, write, rng: _one_of((b"[", b'{"a":'))(rng) * int(rng.integers(1, 5000)),
    "no object": lambda row, write, rng: _one_of((b"[]", b"1", b"null", b'"a"', b"{}", b"NaN"))(
        rng
    ),
    "surrogates": lambda row, write, rng: write({**row, [*row][-1]: "\ud800", "\udfff": 1}),
}


PARTS: Mapping[str, Callable[[_Plan], Outcome]] = {
    "file": _kills_of_files,
    "mqtt": _kills_of_topics,
    "restart": _outages,
    "malformed": _malformed,
    "messages": _messages,
}
