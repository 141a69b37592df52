"""Run of many months in which memory, step time and size of the journal must not grow.

The process is diffusion on 31 nodes with a constant and a moving unknown, three noisy sensors, and
a boundary value that is missing at times. It has all parts of a live run: intake of rows, journal,
estimates, checkpoints, retention, and a reader that always has the journal open. A row arrives
every minute, and each week has one fault of each kind.
"""

from __future__ import annotations

import os
import sqlite3
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import count, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, TypeAlias

import numpy as np

from benchmarks.progress import shown
from livepde.errors import RunError
from livepde.estimate import Estimate
from livepde.fem import (
    Channel,
    Field,
    Inputs,
    Normal,
    RandomWalk,
    Scalar,
    dot,
    grad,
    interval,
    linear,
)
from livepde.identifier import Identifier
from livepde.laws import Jumps, SensitivityLaw
from livepde.model import Model
from livepde.observation import Points
from livepde.runs import Check, Journal, Outcome, Table, journal_of
from livepde.runs.backlog import Retention
from livepde.runs.database import log_of
from livepde.runs.feeds import Gathered
from livepde.runs.live_loop import Live
from livepde.stepping import Advance, simulate
from livepde.streams.clock import Clock
from livepde.streams.intake import Intake, Policy
from livepde.streams.sources import Rows
from livepde.streams.table import Column

MONTH = 43_830  # rows, one per minute
WEEK = 7 * 1440  # rows; the last fault ends 2500 rows before the week does
WARM = 10_000  # steps before memory is measured
BLOCK = 1000  # steps of one measurement
FRESH = 24  # timed steps of a new identifier, between two of its refits
BEGUN = 36  # steps of the new identifier before the timed ones
GROWTH = 5.0  # MiB, largest growth of memory
SLOWER = 1.2  # largest step time of the last tenth over the first tenth
KEPT = 1.5  # largest growth of the journal over the size of the retained estimates
LOG = 32.0  # MiB, largest size of the write-ahead log
RETAINED = 20_000  # latest samples, of which everything is retained
EVERY = 24  # one of this many older estimates is retained
DT = 0.05
PERIOD = 200  # samples
NOISE = 0.01
K, LOSS = 0.05, 0.3
SENSORS = {"a": 0.2, "b": 0.5, "c": 0.8}
COLUMNS = {name: Column((name,)) for name in (*SENSORS, "left")}
MIB = 2.0**20


Row: TypeAlias = dict[str, Any]

# Name -> first minute in the week, number of rows, and function that replaces each of these rows.
FAULTS: Mapping[str, tuple[int, int, Callable[[Row], list[Row]]]] = {
    "ten years ahead": (500, 1, lambda row: [{**row, "t": row["t"] + 5_256_000}, row]),
    "three hours ahead": (1000, 8, lambda row: [{**row, "t": row["t"] + 180}, row]),
    "long ago": (1500, 1, lambda row: [{**row, "t": -1e7}, row]),
    "again": (2000, 1, lambda row: [row]),  # `_Plant` also repeats the rows before it
    "set back by an hour": (2500, 60, lambda row: [{**row, "t": row["t"] - 60}]),
    "set ahead by an hour": (3000, 10, lambda row: [{**row, "t": row["t"] + 60}]),
    "a pause": (3500, 600, lambda row: []),
    "no time": (4500, 5, lambda row: [{**row, "t": "noon"}, row]),
    "text": (5000, 5, lambda row: [{**row, "a": "x"}]),
    "a wild reading": (5500, 1, lambda row: [{**row, "a": 9999.0}]),
    "a sensor that is missing": (6000, 300, lambda row: [{**row, "b": None}]),
    "a sensor that is stuck": (6500, 60, lambda row: [{**row, "c": 0.1}]),
    "no boundary value": (7000, 30, lambda row: [{**row, "left": None}]),
    "late by a day": (7500, 20, lambda row: [row, {**row, "t": row["t"] - 1440.5}]),
}
LOST = ("set back by an hour", "set ahead by an hour", "a pause")
AGAIN = 100  # repeated rows


@dataclass
class _Plant:
    """Rows with the faults of each week, and the number of correct rows.

    Attributes
    ----------
    right
        Number of rows so far with their correct time and at least one value.
    """

    rows: Iterator[Row]
    right: int = 0

    def __iter__(self) -> Iterator[Row]:
        past: deque[Row] = deque(maxlen=AGAIN)
        for minute, row in enumerate(self.rows):
            past.append(row)
            name = next(
                (n for n, (at, count, _) in FAULTS.items() if 0 <= minute % WEEK - at < count), ""
            )
            self.right += name not in LOST
            yield from FAULTS[name][2](row) if name else [row]
            if name == "again":
                yield from past


@dataclass(frozen=True)
class Reading:
    """Measurement after `steps` steps: CPU seconds per step, and bytes of memory and files.

    `fresh` is the CPU time per step of a new identifier, measured at the same time, because other
    load on the machine slows both.
    """

    steps: int
    seconds: float
    fresh: float
    private: float
    resident: float
    file: float
    log: float


@dataclass
class Meter:
    """Sink that measures every `BLOCK` steps, and reads the journal like the dashboard."""

    reader: Journal
    fresh: Callable[[], float]
    readings: list[Reading] = field(default_factory=list)
    failed: int = 0
    _steps: int = 0
    _read: int = 0
    _since: float = field(default_factory=process_time)

    def put(self, estimate: Estimate) -> None:
        """Count an estimate, and measure after every `BLOCK` of them."""
        self._steps += 1
        self.failed += not estimate.status.ok
        if self._steps % BLOCK:
            return
        seconds = (process_time() - self._since) / BLOCK
        for number, _ in self.reader.after(self._read):
            self._read = number
        file = self.reader.path
        sizes = [_size(path) for path in (file, log_of(file))]
        self.readings.append(Reading(self._steps, seconds, self.fresh(), *_memory(), *sizes))
        self._since = process_time()

    def close(self) -> None:
        """Do nothing: the owner of the reader closes it."""


def soak(steps: int, *, share: float = 1.0, progress: bool = False) -> Outcome:
    """Run `steps` rows, and compare the end of the run with its beginning.

    Parameters
    ----------
    share
        Factor on `WARM` and `RETAINED`, less than 1 for short runs.
    """
    warm, retained = round(share * WARM), round(share * RETAINED)
    if steps < 2 * warm:
        raise RunError(f"benchmark soak: expected at least {2 * warm} rows; got {steps}.")
    identifier = _identifier()
    plant = _Plant(islice(_rows(identifier.model), steps))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "journal.sqlite"
        journal = journal_of(identifier, path)
        with journal, Journal.open(path) as reader:
            meter = Meter(reader, _fresh())
            intake = Intake(COLUMNS, Clock("t", factor=DT), Policy(leap=30 * 1440 * DT), origin=0.0)
            intake.past = journal
            given = iter(plant)
            live = Live(
                identifier,
                Gathered(Rows(shown(given, steps, "rows") if progress else given), intake),
                journal,
                sinks=[meter],
                fields_every=EVERY,
                retention=Retention(retained * DT, EVERY),
                strict=True,
            )
            live.run()
            kept, accepted, counts = len(journal), journal.accepted, journal.counts
        with Journal.open(path) as after:
            read = sum(1 for _ in after)
        record = _record_size(path)
    last = identifier.estimate().parameters
    error = max(abs(last[name][0] / true - 1.0) for name, true in (("k", K), ("loss", LOSS)))
    lost = abs(plant.right - accepted)
    outcome = _outcome(meter, steps, kept - read, error, record=record, lost=lost, share=share)
    rows = [(kind, channel, number) for (kind, channel), number in sorted(counts.items())]
    table = Table("Counts of the intake", ("kind", "channel", "number"), rows)
    return replace(outcome, tables=[*outcome.tables, table])


def _outcome(
    meter: Meter,
    steps: int,
    unread: int,
    error: float,
    *,
    record: float,
    lost: int = 0,
    share: float = 1.0,
) -> Outcome:
    """Return the outcome; `record` is the size of an estimate in the journal, in bytes."""
    warm, retained = round(share * WARM), round(share * RETAINED)
    readings = [reading for reading in meter.readings if reading.steps >= warm]
    tenth = max(len(readings) // 10, 1)
    first, last = readings[0], readings[-1]
    middle = readings[len(readings) // 2]
    early, late = (
        float(np.median([r.seconds / r.fresh for r in part]))
        for part in (readings[:tenth], readings[-tenth:])
    )
    shown = [*readings[:: max(len(readings) // 10, 1)][:10], last]
    table = Table(
        f"{steps / MONTH:.3g} months on 31 nodes; the last {retained} samples and 1 of {EVERY} "
        "older estimates are retained",
        (
            "steps",
            "ms of a step (CPU)",
            "of a fresh one",
            "private MiB",
            "resident MiB",
            "journal MiB",
            "log MiB",
        ),
        [
            (
                r.steps,
                1e3 * r.seconds,
                1e3 * r.fresh,
                *(size / MIB for size in (r.private, r.resident, r.file, r.log)),
            )
            for r in shown
        ],
    )
    kept = (last.file - middle.file) / (last.steps - middle.steps) / (record / EVERY)
    checks = [
        Check(
            f"memory: growth after {warm} steps (MiB)",
            (max(r.private for r in readings) - first.private) / MIB,
            GROWTH,
            "<=",
        ),
        Check(
            "time of a step over a fresh one: last tenth / first tenth", late / early, SLOWER, "<="
        ),
        Check("journal: growth in the second half over the estimates that stay", kept, KEPT, "<="),
        Check("write-ahead log: largest (MiB)", max(r.log for r in readings) / MIB, LOG, "<="),
        Check("steps that failed", meter.failed, 0, "<="),
        Check("estimates that a reader does not find", unread, 0, "<="),
        Check("samples lost or doubled", lost, 0, "<="),
        Check("largest relative error of an unknown at the end", error, 0.02, "<="),
    ]
    return Outcome(tables=[table], checks=checks)


def _identifier() -> Identifier:
    mesh = interval(0.0, 1.0, 30)
    model = Model(
        state=Field(mesh, linear(mesh), dirichlet={"left": Channel("left"), "right": 0.0}),
        parameter={
            "k": Normal(0.04, std=0.02),
            "loss": Scalar(Normal(0.2, std=0.1), evolution=RandomWalk(0.001)),
        },
        A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)) + q.loss * u * v,
    )
    return Identifier(model, Points(SENSORS, noise=NOISE), SensitivityLaw(jumps=Jumps()))


def _fresh() -> Callable[[], float]:
    """Return a function that measures the CPU time per step of a new identifier, in s."""
    identifier = _identifier()
    rows = list(islice(_rows(identifier.model), BEGUN + FRESH))

    def take(row: Row) -> None:
        identifier.step(DT * row["t"], {name: row[name] for name in COLUMNS})

    for row in rows[:BEGUN]:
        take(row)
    begun = identifier.dump()

    def measure() -> float:
        identifier.restore(begun)
        since = process_time()
        for row in rows[BEGUN:]:
            take(row)
        return (process_time() - since) / FRESH

    return measure


def _rows(model: Model) -> Iterator[Row]:
    """Yield rows without end, from a periodic truth of the estimator's scheme with noise."""
    run_up = 6 * PERIOD  # the effect of the initial state decays within five periods
    phase = 2 * np.pi * np.arange(run_up + 1) / PERIOD
    times, left = DT * np.arange(run_up + 1), 1.0 + np.sin(phase)

    def inputs(t: float) -> Inputs:
        return Inputs({"left": float(left[round(t / DT)])})

    q = np.array([K, LOSS])
    states = simulate(model, q, 0.0, times.tolist(), Advance(SensitivityLaw.scheme), inputs)
    G = Points(SENSORS).matrix(model.state_space)
    seen = [(G @ u).tolist() for _, u in states][-PERIOD:]
    rng = np.random.default_rng(0)
    for k in count():
        noise = NOISE * rng.standard_normal(len(SENSORS))
        z = {n: x + e for n, x, e in zip(SENSORS, seen[k % PERIOD], noise.tolist(), strict=True)}
        yield {"t": k, **z, "left": float(left[1 + k % PERIOD])}


def _record_size(path: Path) -> float:
    """Return the mean size of an estimate in a journal, in bytes."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as journal:
        columns = [name for _, name, *_ in journal.execute("PRAGMA table_info(estimates)")]
        sizes = " + ".join(f"LENGTH(CAST({name} AS BLOB))" for name in columns)
        ((mean,),) = journal.execute(f"SELECT AVG({sizes}) FROM estimates")
    return float(mean)


def _memory() -> tuple[float, float]:
    """Return the private and the resident memory of this process, in bytes."""
    try:
        _, resident, shared, *_ = Path("/proc/self/statm").read_text().split()
    except OSError:
        raise RunError("benchmark soak reads /proc/self/statm and requires Linux.") from None
    page = os.sysconf("SC_PAGE_SIZE")
    return page * (int(resident) - int(shared)), page * int(resident)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
