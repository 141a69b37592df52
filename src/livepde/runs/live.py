"""The loop beside a running process: rows in, samples into the journal, estimates out."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np

from livepde.errors import DataError, LivepdeError
from livepde.identifier import Identifier, Sample
from livepde.result import Estimate, Result
from livepde.runs.journal import Event, Journal, Taken
from livepde.streams.intake import Intake, Outcome, Ready, Remark, gather
from livepde.streams.sources import Row, Source

__all__ = ["Backlog", "Feed", "Gathered", "Live", "Paced", "Retention", "Samples", "Sink"]

CHECKPOINT = 256  # samples between two checkpoints
LOOK = 0.5  # seconds between two looks at whether to stop
LONGEST = 500  # characters of an event
HARMLESS = frozenset({"heard", "missing", "disordered", "outside"})
LOG = logging.getLogger("livepde.run")


class Feed(Protocol):
    """Brings samples in time order, complete and checked."""

    @property
    def done(self) -> bool:
        """True if nothing more will come."""

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return the samples that are there, or after at most `wait` seconds none."""

    def heard(self) -> bool:
        """Return whether anything has come since this was asked last, be it of no use."""

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        """Return what has been worth counting since this was asked last.

        Only of what would not be read again from `position(waiting)`: so nothing is counted twice
        after a crash.
        """

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return from where to go on if these samples are still to be taken."""

    def acknowledge(self, ready: Ready) -> None:
        """Hear that a sample has been taken for good, or never will be."""

    def withdraw(self, last: float) -> None:
        """Hear that nothing could be made of the last sample; `last`: time of the one before."""

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
        self._remarks: list[Remark] = []
        self._rows = 0  # a token is the number of the row, and what the source gave with it
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
            self._rows += 1
            found += self._used(self._outcome(row, (self._rows, row.token)))
        if self.source.done and not self._flushed:
            self._flushed = True
            found += self._used(self.intake.flush())
        return found

    def _outcome(self, row: Row, token: Any) -> Outcome:
        if row.broken:
            return Outcome(remarks=[Remark("malformed", "", row.broken, row=token)], spent=[token])
        return self.intake.take(row.values, token)

    def _used(self, outcome: Outcome) -> list[Ready]:
        self._remarks += outcome.remarks
        self.source.acknowledge(_given(outcome.spent))
        return outcome.ready

    def _waiting(self, waiting: Sequence[Ready]) -> list[Any]:
        """Return the tokens of all rows that are still to be taken."""
        return [*(token for ready in waiting for token in ready.tokens), *self.intake.waiting]

    def heard(self) -> bool:
        """Return whether a row has come since this was asked last."""
        heard, self._heard = self._heard, False
        return heard

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        """Return what was refused, missing or out of order, each kind and channel once."""
        if not self._remarks:
            return ()
        first = min((number for number, _ in self._waiting(waiting)), default=math.inf)
        found: dict[tuple[str, str], Remark] = {}
        later: list[Remark] = []
        for remark in self._remarks:
            if remark.row[0] < first:
                gather(found, remark)
            else:
                later.append(remark)
        self._remarks = later
        return list(found.values())

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return where the source stands if these samples are still to be taken."""
        return self.source.position(_given(self._waiting(waiting)))

    def acknowledge(self, ready: Ready) -> None:
        """Tell the source."""
        self.source.acknowledge(_given(ready.tokens))

    def withdraw(self, last: float) -> None:
        """Tell the intake."""
        self.intake.withdraw(last)

    def close(self) -> None:
        """Close the source."""
        self.source.close()


def _given(tokens: Iterable[Any]) -> list[Any]:
    """Return what the source gave, without the numbers of rows."""
    return [token for _, token in tokens]


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

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        """Nothing is refused: what is wrong raises."""
        return ()

    def position(self, waiting: Sequence[Ready]) -> str:
        """The time of the last sample is enough to go on."""
        return ""

    def acknowledge(self, ready: Ready) -> None:
        """Nobody waits to hear it."""

    def withdraw(self, last: float) -> None:
        """The next one is later anyway."""

    def close(self) -> None:
        """Nothing is held."""


class Paced:
    """Samples of the past, replayed at the pace of their times.

    Parameters
    ----------
    feed
        Where they come from.
    pace
        Model time that passes in one second.
    clock, sleep
        Seconds that pass, and how to let them pass.
    """

    def __init__(
        self,
        feed: Feed,
        pace: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.feed = feed
        self.pace = pace
        self._clock = clock
        self._sleep = sleep
        self._held: deque[Ready] = deque()
        self._begun: tuple[float, float] | None = None

    @property
    def done(self) -> bool:
        """True when the last sample is out."""
        return self.feed.done and not self._held

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return the samples whose time has come."""
        if not self._held:
            self._held.extend(self.feed.poll(wait))
        if not self._held:
            return []
        now, first = self._clock(), self._held[0].t
        begun = self._begun or (now, first)
        self._begun = begun
        due = begun[0] + (first - begun[1]) / self.pace
        if due > now:
            self._sleep(min(wait, due - now))
        passed = begun[1] + (self._clock() - begun[0]) * self.pace
        found = []
        while self._held and self._held[0].t <= passed:
            found.append(self._held.popleft())
        return found

    def heard(self) -> bool:
        """A replay is heard as long as it holds samples."""
        return self.feed.heard() or bool(self._held)

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        """Return what was worth counting."""
        return self.feed.remarks([*waiting, *self._held])

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return from where to go on if these samples, and those held, are still to be taken."""
        return self.feed.position([*waiting, *self._held])

    def acknowledge(self, ready: Ready) -> None:
        """Tell the feed."""
        self.feed.acknowledge(ready)

    def withdraw(self, last: float) -> None:
        """Tell the feed."""
        self.feed.withdraw(last)

    def close(self) -> None:
        """Close the feed."""
        self.feed.close()


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
        self.silent = False
        self.stopping = threading.Event()
        self.busy = False  # a step is taken
        self._clock = clock
        self._heard = clock()
        self._waiting = deque(begun)
        self._counts = Counter(journal.counts)
        self._remarked = set(self._counts)
        self._steps = 0
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
        if self.journal.estimated:
            self.journal.keep(self.result.snapshot(self.identifier.estimate()))
        self.journal.checkpoint(self.identifier.dump())

    def _run(self) -> None:
        while not self.stopping.is_set():
            if not self._waiting:
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
            self.feed.withdraw(self.journal.last)
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
        if self._steps % CHECKPOINT == 0:
            self.journal.checkpoint(self.identifier.dump())
            if math.isfinite(self.retention.span):
                self.journal.thin(estimate.t - self.retention.span, self.retention.every)

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
