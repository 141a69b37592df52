"""The loop beside a running process: rows in, samples into the journal, estimates out."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from livepde.errors import DataError, LivepdeError
from livepde.identifier import Identifier
from livepde.result import Estimate, Result
from livepde.runs.feeds import Feed
from livepde.runs.journal import Event, Journal, Taken
from livepde.streams.intake import Ready, Remark
from livepde.verdict import LEVELS

__all__ = ["LOOK", "Backlog", "Live", "Retention", "Sink"]

CHECKPOINT = 256  # samples between two checkpoints
JUDGED = 50  # samples between two looks at the verdict, of which a change is an event
LOOK = 0.5  # seconds between two looks at whether to stop
LONGEST = 500  # characters of an event
HARMLESS = frozenset({"heard", "missing", "disordered", "outside"})
LOG = logging.getLogger("livepde.run")


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
        "queue": all wait, those beyond `length` where they come from; "merge": those beyond it
        become one sample, with the mean of each channel at the last time; "drop": the oldest are
        left out. What is merged or left out is counted.
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

    def has_room(self, waiting: deque[Ready]) -> bool:
        """Return whether more should be taken from the source."""
        return self.overflow != "queue" or len(waiting) < self.length


@dataclass(frozen=True)
class Retention:
    """How much of the past a journal keeps.

    Parameters
    ----------
    span
        Model time for which all is kept.
    every
        Of older estimates one in so many is kept, of older samples and fields none.
    """

    span: float = math.inf
    every: int = 1


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
    retention
        How much of the past is kept.
    silence
        Seconds without a row after which the source is said to be silent.
    strict
        A sample that the identifier cannot use ends the run with its `DataError`; otherwise it is
        an event.
    begun, irregular
        Samples that the feed has brought already, and what was worth counting until then.
    waits
        The feed may wait for samples: who reads the journal is shown the last estimate before.
        Else it is shown with the next sample, in one transaction.
    stopping
        Ends the run when it is set; it may be set already.
    clock
        Seconds that pass.
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
        retention: Retention | None = None,
        silence: float = math.inf,
        strict: bool = False,
        begun: Iterable[Ready] = (),
        irregular: Iterable[Remark] = (),
        waits: bool = True,
        stopping: threading.Event | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.identifier = identifier
        self.feed = feed
        self.journal = journal
        self.sinks = list(sinks)
        self.backlog = backlog or Backlog()
        self.retention = retention or Retention()
        self.silence = silence
        self.strict = strict
        self.waits = waits
        self.silent = False
        self.stopping = stopping or threading.Event()
        self.busy = False  # a step is taken
        self._clock = clock
        self._heard = clock()
        self._waiting = deque(begun)
        self._counts = Counter(journal.counts)
        self._remarked = set(self._counts)
        self._steps = 0
        told = [event for event in journal.events if event.kind == "verdict"]
        self._level = told[-1].message.partition(":")[0] if told else LEVELS[0]
        self._seconds = 0.0  # spent in steps
        self.fields_every = fields_every
        self.result = self._read()
        self._count(irregular)

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
        if again and self.result.last is not None:
            self._put(self.result.last)
        return again

    def _read(self) -> Result:
        """Return the result of what the journal holds."""
        who, kept = self.identifier, self.journal
        return Result(
            who.model,
            who.observed,
            who.withheld,
            self.fields_every,
            kept,
            layout=kept.layout,
            count=kept.estimated,
        )

    def run(self) -> None:
        """Go on until the source ends or `stopping` is set; what was taken is kept then."""
        try:
            self._run()
        except BaseException:
            with suppress(LivepdeError):  # what went wrong first is what is told
                self._conclude()
            raise
        self._conclude()

    def _conclude(self) -> None:
        if self.journal.accepted > self.journal.estimated:
            return  # stopped within a step: from the checkpoint before, it is taken again
        last = self.result.last
        if last is not None:
            self.result.settle(last := self.identifier.settled(last))
            self.journal.judge(last.verdict.to_dict())
        if self.journal.estimated:
            self.journal.keep(self.result.snapshot(last or self.identifier.estimate()))
        self.journal.checkpoint(self.identifier.dump())

    def _run(self) -> None:
        while not self.stopping.is_set():
            if self.waits and not self._waiting:
                self._settle()  # who reads the journal sees all before it is waited for more
            if self.backlog.has_room(self._waiting):
                self._waiting.extend(self.feed.poll(0.0 if self._waiting else LOOK))
                self._watch(self.feed.heard())
            self._relieve()
            if self._waiting:
                self._take(self._waiting.popleft())
            elif self.feed.done:
                break
        self._settle()

    def _settle(self) -> None:
        """Keep what was irregular, and where the source stands, for good."""
        remarks = self.feed.remarks(self._waiting)
        self._count(remarks)
        self.journal.commit(self.feed.position(self._waiting) if remarks else None)

    def _relieve(self) -> None:
        relieved = self.backlog.relieved(self._waiting)
        if relieved:
            self._counts[self.backlog.overflow, ""] += len(relieved)
            self.journal.count(self.backlog.overflow, "", len(relieved))
        if self.backlog.overflow == "drop":
            for ready in relieved:
                self.feed.acknowledge(ready)

    def _count(self, remarks: Iterable[Remark]) -> None:
        """Count remarks; the first of each kind and channel is an event, with its words."""
        for remark in remarks:
            self._counts[remark.kind, remark.channel] += remark.number
            self.journal.count(remark.kind, remark.channel, remark.number)
            if (remark.kind, remark.channel) not in self._remarked:
                self._remarked.add((remark.kind, remark.channel))
                self._tell(remark.kind, remark.message, remark.channel)

    def _tell(self, kind: str, message: str, channel: str = "") -> None:
        if len(message) > LONGEST:  # it may repeat what has come
            message = message[:LONGEST] + "..."
        event = Event(self.identifier.t, kind, channel, message)
        self.journal.note(event)
        level = logging.INFO if kind in HARMLESS else logging.WARNING
        about = {"kind": kind, "channel": channel, "t": event.t}  # fields of a log in JSON
        LOG.log(level, "%s%s: %s", kind, f" ({channel})" if channel else "", message, extra=about)

    @property
    def health(self) -> dict[str, Any]:
        """What a watchdog should know: ok, unless the source is silent or steps fail."""
        last = self.result.last
        counts = self._counts.copy()  # who asks does so from another thread
        failed = last is not None and not last.status.ok
        return {
            "ok": not (self.silent or failed),
            "t": self.identifier.t,
            "samples": len(self.result),
            "waiting": len(self._waiting),
            "silent": self.silent,
            "status": "" if last is None else last.status.code,
            "seconds": self._seconds,
            "verdict": "" if last is None else last.verdict.level,
            "findings": [] if last is None else last.verdict.sentences,
            "counts": [[*key, number] for key, number in sorted(counts.items())],
        }

    def _take(self, ready: Ready) -> None:
        position = self.feed.position(self._waiting)
        self._count(self.feed.remarks(self._waiting))
        taken = self.journal.accept(ready.t, ready.values, position)
        self.feed.acknowledge(ready)
        self._step(taken)

    def _step(self, taken: Taken, *, again: bool = False) -> None:
        self.busy = True
        try:
            self._estimate(taken, again)
        except DataError as error:
            if not self.strict:
                self._tell("refused", str(error))
            self.journal.withdraw()
            # Those that wait are later: they are taken, or refused in their turn.
            self.feed.withdraw(self._waiting[-1].t if self._waiting else self.journal.last)
            if self.strict:
                raise
        finally:
            self.busy = False

    def _estimate(self, taken: Taken, again: bool) -> None:
        begun = time.monotonic()
        estimate = self.identifier.step(taken.t, taken.values)
        self._seconds += time.monotonic() - begun
        self.result.add(estimate)
        if not again:
            self._put(estimate)
        if not estimate.status.ok:
            self._tell(estimate.status.code, str(estimate.status))
        self._steps += 1
        if len(self.result) % JUDGED == 0:
            self._judge(estimate)
        if self._steps % CHECKPOINT == 0:
            self.journal.checkpoint(self.identifier.dump())
            if math.isfinite(self.retention.span):
                self.journal.thin(estimate.t - self.retention.span, self.retention.every)

    def _judge(self, estimate: Estimate) -> None:
        """Tell of a verdict that is another one than before."""
        verdict = estimate.verdict
        self.journal.judge(verdict.to_dict())
        if verdict.level != self._level:
            self._level = verdict.level
            said = verdict.sentences[0] if verdict.sentences else "nothing speaks against it"
            self._tell("verdict", f"{verdict.level}: {said}")

    def _put(self, estimate: Estimate) -> None:
        """Hand an estimate to all sinks; one that fails is given up, the run goes on."""
        for sink in list(self.sinks):
            try:
                sink.put(estimate)
            except (OSError, LivepdeError) as error:
                self.sinks.remove(sink)
                self._tell("sink", f"{type(sink).__name__} is given up: {error}")

    def _watch(self, heard: bool) -> None:
        now = self._clock()
        if heard:
            if self.silent:
                self._tell("heard", f"the source is heard again after {now - self._heard:.0f} s")
            self._heard, self.silent = now, False
        elif not self.silent and now - self._heard > self.silence:
            self.silent = True
            self._tell("silent", f"nothing from the source for {now - self._heard:.0f} s")
