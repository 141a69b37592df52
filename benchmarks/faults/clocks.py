"""Clocks that jump ahead or back, and repeated rows, in live runs over every transport.

`livepde run` runs the rod with rows from a file, standard input, a broker and an OPC UA server. The
plant waits for `/health` after the first wrong rows, and again at the end.
"""

from __future__ import annotations

import json
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np

from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import (
    PATIENCE,
    Feeder,
    GrowingFile,
    Mosquitto,
    Nodes,
    Plant,
    Topic,
    wait,
)
from benchmarks.faults.rod import STEP, Row, case_text, rod_rows
from benchmarks.faults.run import Run
from livepde.records import interval_95
from livepde.runs import JOURNAL, Check, Journal, Outcome, Table
from livepde.runs import open as open_run

COUNT, AT = 500, 200  # number of rows, and the row at which most faults begin
AFTER = 50  # correct samples between the end of a fault and the comparison of estimates
NEAR = 1.2  # largest difference of estimates, in half-widths of the 95 % interval
SOON = 20.0  # time limit for `/health` to change, in seconds
DAY, HOUR = timedelta(days=1), timedelta(hours=1)
CHANNELS = ("left", "T_3", "T_6")

Change: TypeAlias = Callable[[Sequence[Row]], list[Row]]
Values: TypeAlias = Mapping[tuple[float, str], float]  # (time, channel) -> value


@dataclass(frozen=True)
class Fault:
    """A clock fault.

    Attributes
    ----------
    change
        Function that turns the correct rows into the rows that arrive.
    look
        Number of rows after which `/health` must be false; None if no row waits or is late.
    end
        First row from which all rows are correct; None if the fault does not end.
    moved
        If True, times of rows are changed; otherwise wrong rows are inserted.
    doubted
        If True, the run must end with "do not trust".
    """

    change: Change
    look: int | None = None
    end: int | None = AT
    moved: bool = False
    doubted: bool = False


def _moved(rows: Sequence[Row], by: timedelta) -> list[Row]:
    return [{**row, "time": str(datetime.fromisoformat(row["time"]) + by)} for row in rows]


def _inserted(by: timedelta, count: int = 1, names: Sequence[str] = CHANNELS) -> Change:
    """Return a change that inserts rows with values of earlier rows at later times."""

    def change(rows: Sequence[Row]) -> list[Row]:
        # An OPC UA server does not send an unchanged value, so these are not values of row AT.
        wrong = _moved(rows[AT - count - 1 : AT - 1], by)
        few = [{name: row[name] for name in ("time", *names)} for row in wrong]
        return [*rows[:AT], *few, *rows[AT:]]

    return change


def _set(by: timedelta, stop: int | None = None) -> Change:
    """Return a change that shifts the times of rows AT to `stop`."""
    return lambda rows: [
        *rows[:AT], *_moved(rows[AT:stop], by), *(rows[stop:] if stop is not None else ()),
    ]  # fmt: skip


def _every_25th(rows: Sequence[Row]) -> list[Row]:
    wrong = [_moved(rows[k - 2 : k - 1], HOUR) if k % 25 == 24 else [] for k in range(450)]
    pairs = zip_longest(wrong, rows, fillvalue=())
    return [item for ahead, row in pairs for item in (*ahead, row)]


def _back_again(rows: Sequence[Row]) -> list[Row]:
    lags = [timedelta(seconds=3.5 * STEP * (k // 30)) for k in range(len(rows))]
    return [_moved([row], -lag)[0] for row, lag in zip(rows, lags, strict=True)]


FAULTS: Mapping[str, Fault] = {
    "none": Fault(list),
    # The run waits, because there is no sample yet.
    "the first row 10 years ahead": Fault(lambda rows: [*_moved(rows[2:3], 3650 * DAY), *rows]),
    "one row 29 days ahead": Fault(_inserted(29 * DAY), AT + 1),
    "one row 10 years ahead": Fault(_inserted(3650 * DAY), AT + 1),
    "one reading of T_3 90 steps ahead": Fault(_inserted(1.5 * HOUR, 1, ["T_3"]), AT + 1),
    "two rows 10 years ahead": Fault(_inserted(3650 * DAY, 2), AT + 2),
    "eight rows 3 hours ahead": Fault(_inserted(3 * HOUR, 8), AT + 8),
    "every 25th row an hour ahead": Fault(_every_25th, 25, 450),
    # Rows of the past, which are counted and change nothing.
    "one row of 1970": Fault(_inserted(-20454 * DAY)),
    "100 rows again": Fault(lambda rows: [*rows[: AT + 100], *rows[AT:]], None, AT + 100),
    "set back by an hour": Fault(_set(-HOUR), AT + 5, AT + 60, True),
    "set back by a day": Fault(_set(-DAY), AT + 5, None, True),
    "set ahead by an hour": Fault(_set(HOUR), AT + 5, AT, True),
    "set ahead by 10 years": Fault(_set(3650 * DAY), AT + 5, AT, True),
    "an hour ahead for 100 rows": Fault(_set(HOUR, AT + 100), AT + 5, AT + 160, True),
    "back by 3.5 steps every 30 rows": Fault(_back_again, 65, None, True, True),
}


def _seconds(rows: Sequence[Row]) -> list[float]:
    """Return the times of rows in seconds after the first row."""
    times = [datetime.fromisoformat(row["time"]) for row in rows]
    return [(time - times[0]).total_seconds() for time in times]


def _right(fault: Fault, rows: Sequence[Row]) -> Values:
    """Return the values that a run must use: of rows that are later than all rows before."""
    arriving = fault.change(rows) if fault.moved else rows
    values: dict[tuple[float, str], float] = {}
    newest = -1.0
    for t, row in zip(_seconds(arriving), arriving, strict=True):
        if t > newest:
            values |= {(t, name): float(row[name]) for name in CHANNELS}
            newest = t
    return values


@dataclass(frozen=True)
class _Seen:
    """Outcome of a run: used values, health during and after the fault, verdict, estimates."""

    values: Values
    counts: Mapping[str, int]
    during: Mapping[str, Any]
    after: Mapping[str, Any]
    verdict: str
    estimates: Mapping[float, tuple[float, float]]  # time -> alpha, half-width of its interval

    def moved_from(self, other: _Seen, fault: Fault, rows: Sequence[Row]) -> tuple[float, float]:
        """Compare alpha with a run without the fault, `AFTER` samples after the fault.

        Return the difference in half-widths of the interval, and the ratio of the half-widths.
        """
        if fault.end is None:
            return np.nan, np.nan
        k = fault.end + AFTER - 1
        t = _seconds(fault.change(rows) if fault.moved else rows)[k]
        alpha, half = self.estimates.get(t, (np.inf, 1.0))
        expected, usual = other.estimates[k * STEP]
        return abs(alpha - expected) / half, half / usual


def _health(run: Run) -> Mapping[str, Any]:
    """Return the content of `/health`; empty before the server of the run has started."""
    server = re.search(r"health and metrics at (\S+)", (run.folder / "log.txt").read_text())
    if server is None:
        return {}
    try:
        with urllib.request.urlopen(f"{server[1]}/health", timeout=SOON) as answer:
            content = answer.read()
    except urllib.error.HTTPError as error:
        content = error.read()
    health: Mapping[str, Any] = json.loads(content)
    return health


def _awaited(run: Run, ok: bool) -> Mapping[str, Any]:
    """Wait up to `SOON` until `/health` has the given state, and return its last content."""
    until = time.monotonic() + SOON
    while (health := _health(run))["ok"] != ok and time.monotonic() < until:
        time.sleep(0.05)
    return health


def _seen(folder: Path, plant: Plant, fault: Fault, rows: Sequence[Row]) -> _Seen:
    count, right = len(fault.change(rows)), _right(fault, rows)
    options = ["--listen", "0"]
    with closing(Run(folder, plant.source, plant.launch, options=options)) as run:
        text = case_text(plant.source, silence=600.0, leap="30 d")
        if isinstance(plant, Nodes):  # the values of a row arrive one by one, in any order
            text = text.replace('"degC" }', '"degC", wait = "20 min" }')
        (folder / "case.toml").write_text(text)
        (folder / "log.txt").touch()
        run.start()
        wait(lambda: run.alive() and bool(_health(run)), "a run does not begin")
        during: Mapping[str, Any] = {}
        if fault.look is not None:
            plant.supply(fault.look)
            during = _awaited(run, False)
        plant.supply(count)
        samples = len({t for t, _ in right})
        so_far, until = 0, time.monotonic() + PATIENCE
        while run.alive() and so_far < samples and time.monotonic() < until:
            time.sleep(0.05)
            if run.estimated() > so_far:
                so_far, until = run.estimated(), time.monotonic() + PATIENCE
        after = _awaited(run, fault.end is not None)
        run.end(0)
    data = open_run(run.out).dataset
    low, high = interval_95(data, "alpha")
    times = [round(t, 6) for t in data["time"].values.tolist()]
    pairs = zip(data["alpha"].values.tolist(), (0.5 * (high - low)).tolist(), strict=True)
    with Journal.open(run.out / JOURNAL) as journal:
        values = {
            (sample.t, name): value
            for sample in journal.taken()
            for name, value in sample.values.items()
            if not np.isnan(value)
        }
        counts: dict[str, int] = {}
        for (kind, _), number in journal.counts.items():
            counts[kind] = counts.get(kind, 0) + number
    verdict = json.loads(data.attrs["verdict"])["level"]
    return _Seen(values, counts, during, after, verdict, dict(zip(times, pairs, strict=True)))


TRANSPORTS = ("file", "standard input", "MQTT", "OPC UA")


@contextmanager
def _plants(name: str, folder: Path) -> Iterator[Callable[[Path, Sequence[Row]], Plant]]:
    """Yield a function that creates a plant of the named transport for a run in a folder."""
    with ExitStack() as stack:
        if name == "MQTT":
            broker = stack.enter_context(closing(Mosquitto(folder)))

        def plant(here: Path, rows: Sequence[Row]) -> Plant:
            if name == "file":
                return GrowingFile(here, rows, whole=True)
            if name == "standard input":
                return stack.enter_context(closing(Feeder(here, rows, 0)))
            if name == "MQTT":
                return stack.enter_context(closing(Topic(broker, rows, here.name)))
            return stack.enter_context(closing(Nodes(rows)))

        yield plant


def clock_faults(plan: Plan) -> Outcome:
    """Inject clock faults into runs of the rod, and compare their samples with the correct ones."""
    rows, table, tally = rod_rows(COUNT), [], _Tally()
    cases = [(name, fault) for name in TRANSPORTS for fault in FAULTS]
    numbers = iter(plan.watched(len(cases), "clocks"))
    for name in TRANSPORTS:
        with TemporaryDirectory() as folder, _plants(name, Path(folder)) as plants:
            for k, (about, fault) in enumerate(FAULTS.items()):
                next(numbers)
                here = Path(folder) / f"run-{k}"
                here.mkdir()
                seen = _seen(here, plants(here, fault.change(rows)), fault, rows)
                table.append((name, about, *tally.add(f"{about}, {name}", seen, fault, rows)))
    head = (
        *("transport", "fault", "lost", "wrong", "half-widths", "wider by"),
        *("health during", "after", "verdict", "told"),
    )
    return Outcome(tables=[Table(f"Clocks of {COUNT} rows", head, table)], checks=tally.checks())


class _Tally:
    """Totals over all runs: lost and wrong values, and names of runs with wrong health."""

    def __init__(self) -> None:
        self.lost = self.wrong = 0
        self.moved = 0.0
        self.silent: list[str] = []
        self.ill: list[str] = []
        self.trusted: list[str] = []
        self._plain: _Seen | None = None

    def add(self, about: str, seen: _Seen, fault: Fault, rows: Sequence[Row]) -> tuple[Any, ...]:
        """Add a run, and return its table row."""
        right = _right(fault, rows)
        lost = len(right.keys() - seen.values.keys())
        wrong = sum(right.get(key) != value for key, value in seen.values.items())
        self._plain = self._plain or seen
        moved, wider = seen.moved_from(self._plain, fault, rows)
        self.lost, self.wrong = self.lost + lost, self.wrong + wrong
        self.moved = float(np.fmax(self.moved, moved))
        if fault.look is not None and (seen.during["ok"] or seen.during["ailment"] != "clock"):
            self.silent.append(about)
        if seen.after["ok"] != (fault.end is not None):
            self.ill.append(about)
        if fault.doubted and seen.verdict != "do not trust":
            self.trusted.append(about)
        counts = ", ".join(f"{kind} {number}" for kind, number in sorted(seen.counts.items()))
        during = seen.during.get("ailment", "–")
        after = "ok" if seen.after["ok"] else seen.after["ailment"]
        return lost, wrong, moved, wider, during, after, seen.verdict, counts or "–"

    def checks(self) -> list[Check]:
        """Return the checks of the totals."""
        return [
            Check("clock faults: right values lost", self.lost, 0, "<="),
            Check("clock faults: values at times that were never measured", self.wrong, 0, "<="),
            Check(f"clock faults: half-widths {AFTER} samples later", self.moved, NEAR, "<="),
            Check("clock faults with /health true during them", len(self.silent), 0, "<="),
            Check("clock faults after which /health is wrong", len(self.ill), 0, "<="),
            Check("clocks that are never steady, and are trusted", len(self.trusted), 0, "<="),
        ]
