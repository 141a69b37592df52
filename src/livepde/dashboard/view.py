"""View of a run directory, which is read incrementally during the run and afterwards."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import xarray as xr

from livepde import runs
from livepde.errors import RunError
from livepde.linalg import Array
from livepde.records import Layout, Record
from livepde.runs import Check, Journal
from livepde.runs.database import in_use, written
from livepde.runs.directory import JOURNAL
from livepde.runs.journal import Event

T = TypeVar("T")

# Variable of errors -> name of the readings in the dataset of a view, which no unknown can have.
READINGS = {
    "innovation": "readings of sensors",
    "validation_error": "readings of validation sensors",
}
ROWS = 2000  # largest number of estimates in memory
NOTABLE = 500  # largest number of additional failed steps and jumps
FIELDS = 400  # largest number of snapshots
SHOWN = 500  # largest number of events
BYTES = 64 * 2**20  # largest size of all snapshots
AT_ONCE = 20_000  # largest number of estimates per update
OFTEN = 0.5  # seconds within which a journal is not read again
HEARING = ("silent", "heard")  # kinds of events of the source
QUIET = 10.0  # seconds without a write after which the lock of the writer is checked


class Spread(Generic[T]):
    """At most `most` evenly spread items by number, including the first and the newest."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.gap = 1
        self._items: dict[int, T] = {}
        self._settled = 0  # number of the last permanent item

    def add(self, number: int, item: T) -> None:
        """Add an item with a larger number than all before, or replace the last item."""
        newest = next(reversed(self._items), number)
        if newest > self._settled and newest != number:
            # The newest item is dropped if it is less than a gap after the last permanent item.
            if newest - self._settled < self.gap and len(self._items) > 1:
                del self._items[newest]
            else:
                self._settled = newest
        self._items[number] = item
        while len(self._items) > self.most:
            self.gap *= 2
            numbers = [*self._items]
            kept, last = [], -self.gap
            for number in numbers[:-1]:
                if number - last >= self.gap:
                    kept.append(number)
                    last = number
            self._settled = kept[-1]
            self._items = {number: self._items[number] for number in [*kept, numbers[-1]]}

    def __iter__(self) -> Iterator[tuple[int, T]]:
        return iter(self._items.items())


@dataclass(frozen=True, eq=False)
class RunView:
    """Contents of the live page of a run."""

    version: int = 0  # changes with the contents
    title: str = ""
    # "waiting" (for the first sample), "running", "silent" (source), "stopped" (unfinished, without
    # a writer), "finished", "interrupted", "failed", or "unreadable" (see `problem`).
    status: str = "waiting"
    dataset: xr.Dataset | None = None  # thinned estimates; None before the first
    samples: int = 0  # number of estimates
    gap: int = 1  # the dataset contains one in `gap` estimates
    reading: bool = False  # whether there are more records to read
    events: Sequence[Event] = ()  # events and counts of the journal
    counts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    unhealthy: str = ""  # reason why the run is unhealthy, as in /health; empty if it is healthy
    doubts: Sequence[str] = ()  # findings against the estimates
    notes: Sequence[str] = ()  # further notes of the run
    checks: Sequence[Check] = ()
    written: float = 0.0  # time of the last write, in seconds since 1970
    ended: str = ""  # date of the end of the run; empty before
    problem: str = ""

    @property
    def estimates(self) -> xr.Dataset | None:
        """The dataset if it contains an estimate, else None."""
        return None if self.dataset is None or not self.dataset.sizes["time"] else self.dataset


def with_readings(data: xr.Dataset, readings: Array) -> xr.Dataset:
    """Add the variables `READINGS`, readings of sensors and validation sensors, to a dataset.

    `readings`: shape (time, sensors), with validation sensors last.
    """
    parts = np.split(readings, [data.sizes["sensor"]], axis=1)
    return data.assign(
        {
            name: (data[error].dims, part)
            for (error, name), part in zip(READINGS.items(), parts, strict=True)
            if error in data
        }
    )


class View:
    """The current contents of a run directory, for any number of clients.

    Memory and cost of each update are bounded independently of the length of the run: only new
    records of a journal are read, and records in memory are thinned.

    Raises `RunError`: there is no run.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._looked = -np.inf
        self._mark: object = None
        self._failures = 0
        self._begin(runs.open(path))
        self._seen = RunView(title=runs.open(path).title)

    def look(self) -> RunView:
        """Return the current contents."""
        with self._lock:
            if time.monotonic() - self._looked < OFTEN and not self._seen.reading:
                return self._seen
            try:
                self._seen = self._read()
                self._failures = 0
            except (RunError, ValueError, TypeError, KeyError, IndexError) as error:
                self._failures += 1
                if self._failures > 1:  # at first, its creation may be in progress
                    why = error if isinstance(error, RunError) else f"it is damaged ({error})."
                    problem, self._mark = f"The run cannot be read: {why}", None
                    self._seen = replace(
                        self._seen,
                        version=self._seen.version + (self._seen.problem != problem),
                        status="unreadable",
                        problem=problem,
                        reading=False,
                    )
            self._looked = time.monotonic()
            return self._seen

    def _begin(self, run: runs.Run) -> None:
        self._started = run.record.get("started")
        self._rows: Spread[Record] = Spread(ROWS)
        self._notable: Spread[Record] = Spread(NOTABLE)
        self._fields: Spread[Record] = Spread(FIELDS)
        self._number = 0
        self._readings: dict[int, Array] = {}  # readings of the records in memory

    def _read(self) -> RunView:
        run = runs.open(self.path)
        if run.record.get("started") != self._started:  # a new run at the same path
            self._begin(run)
        journal = self.path / JOURNAL
        live = journal.is_file()
        latest = written(journal) if live else 0.0
        status = _status(run, journal if live else None, latest)
        mark = (latest, status, str(run.record))
        if mark == self._mark and not self._seen.reading:
            return self._seen
        seen = replace(
            self._seen,
            version=self._seen.version + 1,
            title=run.title,
            status=status,
            written=latest,
            problem="",
        )
        if live:
            seen = self._follow(seen, journal)
        elif run.status == "running":
            seen = replace(seen, dataset=None)
        else:
            seen = replace(seen, dataset=run.dataset, samples=run.dataset.sizes["time"])
        seen = _judged(seen, run)
        self._mark = mark  # set last, so that everything is read again after an error
        return seen

    def _follow(self, seen: RunView, path: Path) -> RunView:
        with Journal.open(path) as journal:
            # The last record is read again, since its fields may have been stored later.
            new = [*islice(journal.after(max(self._number - 1, 0)), AT_ONCE)]
            readings = dict(journal.values(new[0][0], new[-1][0])) if new else {}
            layout, count = journal.layout, journal.estimated
            events, counts, unhealthy = journal.events, journal.counts, journal.health
            verdict = journal.verdict
        names = [*layout.sensors, *(layout.validation or ())]
        for number, record in new:
            self._add(number, record, names, readings.get(number, {}))
        status = seen.status
        if status == "running":
            heard = ["heard", *(event.kind for event in events if event.kind in HEARING)]
            status = "waiting" if not count else "silent" if heard[-1] == "silent" else "running"
        return replace(
            seen,
            status=status,
            dataset=self._dataset(layout, verdict),
            samples=count,
            gap=self._rows.gap,
            reading=len(new) == AT_ONCE,
            events=events[-SHOWN:],
            counts=counts,
            unhealthy=unhealthy if status == "running" else "",
        )

    def _add(
        self, number: int, record: Record, names: Sequence[str], values: Mapping[str, float]
    ) -> None:
        self._number = number
        self._readings[number] = np.array([values.get(name, np.nan) for name in names])
        if record.snapshot is not None:
            # Fields need most of the memory, so that their number depends on their size.
            size = 8 * sum(values.size for values in record.snapshot.profiles.values())
            self._fields.most = max(2, min(FIELDS, BYTES // max(size, 1)))
            self._fields.add(number, record)
        plain = replace(record, snapshot=None)
        if record.status or record.notes.get("jump", 0.0) > 0.0:
            self._notable.add(number, plain)
        self._rows.add(number, plain)

    def _dataset(self, layout: Layout, verdict: str) -> xr.Dataset | None:
        kept = dict(
            sorted({**dict(self._rows), **dict(self._notable), **dict(self._fields)}.items())
        )
        if not kept:
            return None
        data = layout.dataset([*kept.values()])
        self._readings = {number: self._readings[number] for number in kept}
        data = with_readings(data, np.array([*self._readings.values()]))
        if verdict:
            data.attrs["verdict"] = verdict
        return data


def _judged(seen: RunView, run: runs.Run) -> RunView:
    """Return the contents with findings, and for an ended run with its notes and checks."""
    found = [] if seen.dataset is None else runs.doubts(seen.dataset)
    if run.status == "running":
        return replace(seen, doubts=found, notes=[], checks=[], ended="")
    # The dataset is thinned, while the findings of the run itself use all its samples.
    if found and seen.gap > 1:
        found = run.notes
    notes = [note for note in run.notes if note not in found]
    ended = str(run.record.get("ended", ""))
    return replace(seen, doubts=found, notes=notes, checks=run.checks, ended=ended)


def _status(run: runs.Run, journal: Path | None, latest: float) -> str:
    if run.status != "running":
        return run.status
    if journal is None:
        return "waiting"
    stopped = time.time() - latest > QUIET and not in_use(journal)
    return "stopped" if stopped else "running"
