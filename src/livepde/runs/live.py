"""The loop beside a running process: rows in, samples into the journal, estimates out."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from livepde.errors import DataError
from livepde.identifier import Identifier, Sample
from livepde.result import Estimate, Result
from livepde.runs.journal import Event, Journal, Taken
from livepde.streams.intake import Intake, Ready, Refused
from livepde.streams.sources import Row, Source

__all__ = ["Backlog", "Feed", "Gathered", "Live", "Samples", "Sink"]

CHECKPOINT = 256  # samples between two checkpoints
LOOK = 0.5  # seconds between two looks at whether to stop


class Feed(Protocol):
    """Brings samples in time order, complete and checked."""

    @property
    def done(self) -> bool:
        """True if nothing more will come."""

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return the samples that are there, or after at most `wait` seconds none."""

    def heard(self) -> bool:
        """Return whether anything has come since this was asked last, be it of no use."""

    def refused(self) -> Sequence[Refused]:
        """Return what has come since this was asked last and is not used."""

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return from where to go on if these samples are still to be taken."""

    def acknowledge(self, ready: Ready) -> None:
        """Hear that a sample has been taken for good, or never will be."""

    def close(self) -> None:
        """Let go of what it holds."""


class Gathered:
    """Samples from the rows of a source, as an `Intake` puts them in order.

    Parameters
    ----------
    source, intake
        Where rows come from, and how they become samples.
    """

    def __init__(self, source: Source, intake: Intake) -> None:
        self.source = source
        self.intake = intake
        self._heard = False
        self._refused: list[Refused] = []
        self._flushed = False

    @property
    def done(self) -> bool:
        """True when the source has ended and all its samples are out."""
        return self._flushed

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return the samples that are ready."""
        rows = self.source.poll(wait)
        self._heard |= bool(rows)
        found: list[Ready] = []
        for row in rows:
            found += self._taken(row)
        if self.source.done and not self._flushed:
            self._flushed = True
            found += self.intake.flush()
        return found

    def _taken(self, row: Row) -> list[Ready]:
        ready: list[Ready] = []
        refused = [Refused("malformed", "", row.broken)]
        if not row.broken:
            ready, refused = self.intake.take(row.values, row.token)
        self._refused += refused
        waiting = [*self.intake.waiting, *(t for one in ready for t in one.tokens)]
        if refused and row.token not in waiting:
            self.source.acknowledge([row.token])  # it is not needed again
        return ready

    def heard(self) -> bool:
        """Return whether a row has come since this was asked last."""
        heard, self._heard = self._heard, False
        return heard

    def refused(self) -> Sequence[Refused]:
        """Return the rows and values that are not used."""
        found, self._refused = self._refused, []
        return found

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return where the source stands if these samples are still to be taken."""
        tokens = [token for ready in waiting for token in ready.tokens]
        return self.source.position([*tokens, *self.intake.waiting])

    def acknowledge(self, ready: Ready) -> None:
        """Tell the source."""
        self.source.acknowledge(ready.tokens)

    def close(self) -> None:
        """Close the source."""
        self.source.close()


class Samples:
    """Samples that are in order already: a table, or any iterable that raises `DataError`.

    Parameters
    ----------
    samples
        The samples.
    names
        Sensors whose values an array z holds.
    after
        Time of the last one that was taken before; those up to it are passed over.
    """

    def __init__(
        self, samples: Iterable[Sample], names: Sequence[str] = (), after: float = -np.inf
    ) -> None:
        self._samples = iter(samples)
        self._names = names
        self._after = after
        self._done = False

    @property
    def done(self) -> bool:
        """True when there are no more."""
        return self._done

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return the next sample."""
        for sample in self._samples:
            if sample.t > self._after:
                return [Ready(sample.t, self._values(sample), ())]
        self._done = True
        return []

    def _values(self, sample: Sample) -> dict[str, float]:
        values = sample.z
        if not isinstance(values, Mapping):
            values = dict(zip(self._names, np.atleast_1d(values).tolist(), strict=True))
        return {**values, **(sample.inputs or {})}

    def heard(self) -> bool:
        """Samples that are there are never silent."""
        return True

    def refused(self) -> Sequence[Refused]:
        """Nothing is refused: what is wrong raises."""
        return ()

    def position(self, waiting: Sequence[Ready]) -> str:
        """The time of the last sample is enough to go on."""
        return ""

    def acknowledge(self, ready: Ready) -> None:
        """Nobody waits to hear it."""

    def close(self) -> None:
        """Nothing is held."""


class Sink(Protocol):
    """Where estimates go."""

    def put(self, estimate: Estimate) -> None:
        """Take one estimate."""

    def close(self) -> None:
        """Let go of what it holds."""


@dataclass(frozen=True)
class Backlog:
    """What happens when samples come faster than steps.

    Parameters
    ----------
    overflow
        "queue": all wait; "merge": those beyond `length` become one sample, with the mean of each
        channel at the last time; "drop": the oldest are left out. Both are counted.
    length
        Samples that may wait.
    """

    overflow: Literal["queue", "merge", "drop"] = "queue"
    length: int = 1000

    def relieved(self, waiting: deque[Ready]) -> list[Ready]:
        """Shorten what waits, and return the samples that were merged with others or dropped."""
        excess = len(waiting) - self.length
        if self.overflow == "queue" or excess <= 0:
            return []
        oldest = [waiting.popleft() for _ in range(excess)]
        if self.overflow == "merge":
            waiting.appendleft(_merged([*oldest, waiting.popleft()]))
        return oldest


def _merged(samples: Sequence[Ready]) -> Ready:
    values: dict[str, list[float]] = {}
    for sample in samples:
        for channel, value in sample.values.items():
            if np.isfinite(value):
                values.setdefault(channel, []).append(value)
    mean = {channel: float(np.mean(several)) for channel, several in values.items()}
    return Ready(samples[-1].t, mean, tuple(t for sample in samples for t in sample.tokens))


class Live:
    """A run that goes on until its source ends or it is told to stop.

    Parameters
    ----------
    identifier
        As it was when the run began; `resume` brings it to where it was.
    feed, journal, sinks
        Where samples come from, what is kept, and where estimates go.
    fields_every
        Fields of every so many samples are kept.
    backlog
        What happens when samples come faster than steps.
    silence
        Seconds without a row after which the source is said to be silent.
    strict
        A sample that the identifier cannot use ends the run with its `DataError`; otherwise it is
        an event.
    """

    def __init__(
        self,
        identifier: Identifier,
        feed: Feed,
        journal: Journal,
        *,
        sinks: Sequence[Sink] = (),
        fields_every: int = 1,
        backlog: Backlog | None = None,
        silence: float = np.inf,
        strict: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.identifier = identifier
        self.feed = feed
        self.journal = journal
        self.sinks = sinks
        self.backlog = backlog or Backlog()
        self.silence = silence
        self.strict = strict
        self.silent = False
        self.stopping = threading.Event()
        self.busy = False  # a step is taken
        self._clock = clock
        self._heard = clock()
        self._waiting: deque[Ready] = deque()
        self._steps = 0
        self.fields_every = fields_every
        self.result = self._read()

    def resume(self) -> int:
        """Take again what the journal holds after its last checkpoint; return how many samples."""
        state = self.journal.rewind()
        if state is not None:
            self.identifier.restore(state, str(self.journal.path))
        self.result = self._read()
        again = 0
        for taken in self.journal.samples():
            self._step(taken, again=True)
            again += 1
        return again

    def _read(self) -> Result:
        """Return the result of what the journal holds."""
        who, kept = self.identifier, self.journal
        return Result(
            who.model, who.observed, who.withheld, self.fields_every, kept, layout=kept.layout
        )

    def run(self) -> None:
        """Go on until the source ends or `stopping` is set; what was taken is kept then."""
        try:
            self._run()
        finally:
            if self.result.last is not None:
                self.journal.keep(self.result.snapshot(self.result.last))
            self.journal.checkpoint(self.identifier.dump())

    def _run(self) -> None:
        while not self.stopping.is_set():
            self._waiting.extend(self.feed.poll(0.0 if self._waiting else LOOK))
            self._watch(self.feed.heard())
            for item in self.feed.refused():
                self.journal.count(item.kind, item.channel)
            relieved = self.backlog.relieved(self._waiting)
            if relieved:
                self.journal.count(self.backlog.overflow, "", len(relieved))
            if self.backlog.overflow == "drop":
                for ready in relieved:
                    self.feed.acknowledge(ready)
            if self._waiting:
                self._take(self._waiting.popleft())
            elif self.feed.done:
                break

    @property
    def health(self) -> dict[str, Any]:
        """What a watchdog should know: ok, unless the source is silent or steps fail."""
        last = self.result.last
        failed = last is not None and not last.status.ok
        return {
            "ok": not (self.silent or failed),
            "t": self.identifier.t,
            "samples": len(self.result),
            "waiting": len(self._waiting),
            "silent": self.silent,
            "status": "" if last is None else last.status.code,
        }

    def _take(self, ready: Ready) -> None:
        position = self.feed.position(self._waiting)
        taken = self.journal.accept(ready.t, ready.values, position)
        self.feed.acknowledge(ready)
        self._step(taken)

    def _step(self, taken: Taken, *, again: bool = False) -> None:
        self.busy = True
        try:
            self._estimate(taken, again)
        except DataError as error:
            self.journal.withdraw()
            if self.strict:
                raise
            self.journal.note(Event(taken.t, "refused", "", str(error)))
        finally:
            self.busy = False

    def _estimate(self, taken: Taken, again: bool) -> None:
        estimate = self.identifier.step(taken.t, taken.values)
        self.result.add(estimate)
        if not again:
            for sink in self.sinks:
                sink.put(estimate)
        if not estimate.status.ok:
            self.journal.note(Event(taken.t, estimate.status.code, "", str(estimate.status)))
        self._steps += 1
        if self._steps % CHECKPOINT == 0:
            self.journal.checkpoint(self.identifier.dump())

    def _watch(self, heard: bool) -> None:
        now = self._clock()
        if heard:
            if self.silent:
                text = f"the source is heard again after {now - self._heard:.0f} s"
                self.journal.note(Event(self.identifier.t, "heard", "", text))
            self._heard, self.silent = now, False
        elif not self.silent and now - self._heard > self.silence:
            self.silent = True
            text = f"nothing from the source for {now - self._heard:.0f} s"
            self.journal.note(Event(self.identifier.t, "silent", "", text))
