"""The loop beside a running process: rows in, samples into the journal, estimates out."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from livepde.errors import DataError
from livepde.identifier import Identifier
from livepde.result import Estimate, Result
from livepde.runs.journal import Event, Journal, Taken
from livepde.streams.intake import Intake, Ready, Refused
from livepde.streams.sources import Row, Source

__all__ = ["Backlog", "Live", "Sink"]

CHECKPOINT = 256  # samples between two checkpoints
LOOK = 0.5  # seconds between two looks at whether to stop


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
    source, intake, journal, sinks
        Where rows come from, how they become samples, what is kept, and where estimates go.
    fields_every
        Fields of every so many samples are kept.
    backlog
        What happens when samples come faster than steps.
    silence
        Seconds without a row after which the source is said to be silent.
    """

    def __init__(
        self,
        identifier: Identifier,
        source: Source,
        intake: Intake,
        journal: Journal,
        *,
        sinks: Sequence[Sink] = (),
        fields_every: int = 1,
        backlog: Backlog | None = None,
        silence: float = np.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.identifier = identifier
        self.source = source
        self.intake = intake
        self.journal = journal
        self.sinks = sinks
        self.backlog = backlog or Backlog()
        self.silence = silence
        self.silent = False
        self.stopping = threading.Event()
        self._clock = clock
        self._heard = clock()
        self._waiting: deque[Ready] = deque()
        self._steps = 0
        self.result = Result(
            identifier.model, identifier.observed, identifier.withheld, fields_every, journal
        )

    def resume(self) -> int:
        """Take again what the journal holds after its last checkpoint; return how many samples."""
        state = self.journal.rewind()
        if state is not None:
            self.identifier.restore(state, str(self.journal.path))
        self.result = Result(
            self.identifier.model,
            self.identifier.observed,
            self.identifier.withheld,
            self.result.fields_every,
            self.journal,
        )
        again = 0
        for taken in self.journal.samples():
            self._step(taken, again=True)
            again += 1
        return again

    def run(self) -> None:
        """Go on until the source ends or `stopping` is set; what was taken is kept then."""
        while not self.stopping.is_set():
            rows = self.source.poll(0.0 if self._waiting else LOOK)
            self._watch(bool(rows))
            for row in rows:
                self._hear(row)
            if self.source.done:
                self._waiting.extend(self.intake.flush())
            relieved = self.backlog.relieved(self._waiting)
            if relieved:
                self.journal.count(self.backlog.overflow, "", len(relieved))
            if self.backlog.overflow == "drop":
                self.source.acknowledge(token for ready in relieved for token in ready.tokens)
            if self._waiting:
                self._take(self._waiting.popleft())
            elif self.source.done:
                break
        if self.result.last is not None:
            self.journal.keep(self.result.snapshot(self.result.last))
        self.journal.checkpoint(self.identifier.dump())

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

    def _hear(self, row: Row) -> None:
        if row.broken:
            ready: list[Ready] = []
            refused = [Refused("malformed", "", row.broken)]
        else:
            ready, refused = self.intake.take(row.values, row.token)
        for item in refused:
            self.journal.count(item.kind, item.channel)
        self._waiting.extend(ready)
        if refused and row.token not in self._tokens():
            self.source.acknowledge([row.token])  # it is not needed again

    def _tokens(self) -> list[Any]:
        """Return the tokens of all rows that are not taken for good yet."""
        return [*self.intake.waiting, *(t for ready in self._waiting for t in ready.tokens)]

    def _take(self, ready: Ready) -> None:
        position = self.source.position(self._tokens())
        taken = self.journal.accept(ready.t, ready.values, position)
        self.source.acknowledge(ready.tokens)
        self._step(taken)

    def _step(self, taken: Taken, *, again: bool = False) -> None:
        try:
            estimate = self.identifier.step(taken.t, taken.values)
        except DataError as error:
            self.journal.note(Event(taken.t, "refused", "", str(error)))
            return
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
