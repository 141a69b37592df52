"""View of a run directory: read bit by bit during the run, and afterwards."""

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

# Errors of sensors -> name of their readings in the dataset of a view, which no unknown has.
READINGS = {
    "innovation": "readings of sensors",
    "validation_error": "readings of validation sensors",
}
ROWS = 2000  # estimates that are kept to be drawn
NOTABLE = 500  # failed steps and jumps that are kept beside them
FIELDS = 400  # snapshots
SHOWN = 500  # events
BYTES = 64 * 2**20  # of snapshots
AT_ONCE = 20_000  # estimates read in one go
OFTEN = 0.5  # seconds within which a journal is not read again
HEARING = ("silent", "heard")  # events of the source
QUIET = 10.0  # seconds without news after which it is asked whether anyone still writes


class Spread(Generic[T]):
    """Items by number, at most `most`, spread evenly; the first and the newest are among them."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.gap = 1
        self._items: dict[int, T] = {}
        self._settled = 0  # the number up to which items stay

    def add(self, number: int, item: T) -> None:
        """Take one, with a number that is larger than those before, or the last one again."""
        newest = next(reversed(self._items), number)
        if newest > self._settled and newest != number:
            # The newest item is dropped if it is less than a gap after the last one that stays.
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

    version: int = 0  # number that changes with the contents
    title: str = ""
    # "waiting" (for the first sample), "running", "silent" (its source), "stopped" (unfinished, but
    # without a writer), "finished", "interrupted" or "failed"; "unreadable" with a `problem`
    status: str = "waiting"
    dataset: xr.Dataset | None = None  # estimates, thinned; None before the first
    samples: int = 0  # number of estimates
    gap: int = 1  # one in so many estimates is in the dataset
    reading: bool = False  # true while there is more to read
    events: Sequence[Event] = ()  # of the journal, as the next
    counts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    unwell: str = ""  # reason why the run is not well, as in /health; empty if it is
    doubts: Sequence[str] = ()  # findings against the estimates
    notes: Sequence[str] = ()  # further notes of the run
    checks: Sequence[Check] = ()
    written: float = 0.0  # time of the last write, in seconds since 1970
    ended: str = ""  # date when the run ended, "" before
    problem: str = ""

    @property
    def estimates(self) -> xr.Dataset | None:
        """The dataset if it has an estimate."""
        return None if self.dataset is None or not self.dataset.sizes["time"] else self.dataset


def with_readings(data: xr.Dataset, readings: Array) -> xr.Dataset:
    """Return a dataset with the readings of its sensors and validation sensors, `READINGS`.

    `readings`: shape (time, sensors), those for validation last.
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

    Memory and the cost of each update are bounded, whatever the length of the run: only new records
    of a journal are read, and those in memory are thinned.

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
                if self._failures > 1:  # the first time it may be just being made
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
        self._readings: dict[int, Array] = {}  # of the records that are kept

    def _read(self) -> RunView:
        run = runs.open(self.path)
        if run.record.get("started") != self._started:  # another run in the same place
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
        self._mark = mark  # last, so that after an error all is read again
        return seen

    def _follow(self, seen: RunView, path: Path) -> RunView:
        with Journal.open(path) as journal:
            # The last one again: its fields may have been kept after it.
            new = [*islice(journal.after(max(self._number - 1, 0)), AT_ONCE)]
            readings = dict(journal.values(new[0][0], new[-1][0])) if new else {}
            layout, count = journal.layout, journal.estimated
            events, counts, unwell = journal.events, journal.counts, journal.health
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
            unwell=unwell if status == "running" else "",
        )

    def _add(
        self, number: int, record: Record, names: Sequence[str], values: Mapping[str, float]
    ) -> None:
        self._number = number
        self._readings[number] = np.array([values.get(name, np.nan) for name in names])
        if record.snapshot is not None:
            # Fields take most of the memory, so that their number depends on their size.
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
    """Return the contents with findings; of an ended run with its notes and checks."""
    found = [] if seen.dataset is None else runs.doubts(seen.dataset)
    if run.status == "running":
        return replace(seen, doubts=found, notes=[], checks=[], ended="")
    # The dataset is thinned, while what the run itself has said is of all its samples.
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
