"""The loop beside a running process: rows in, samples into the journal, estimates out."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np

from livepde.errors import DataError, LivepdeError, RunError
from livepde.identifier import Identifier
from livepde.laws import numerical
from livepde.result import Estimate, Result
from livepde.runs.feeds import Feed
from livepde.runs.journal import Event, Journal, Taken
from livepde.runs.outcome import attempted
from livepde.streams.intake import Ready, Remark
from livepde.verdict import LEVELS

__all__ = ["LOOK", "Backlog", "Live", "Retention", "Sink"]

CHECKPOINT = 256  # samples between two checkpoints
JUDGED = 50  # samples between two looks at the verdict, of which a change is an event
LOOK = 0.5  # seconds between two looks at whether to stop
LONGEST = 500  # characters of an event
RECENT = 1000  # events that are written again when a journal has lost them
TRIES = 2  # times that a sample in whose step the process has ended is tried again
REFUSED = 20  # rows and values refused in a row, after which a run is not well
UNUSED = frozenset({"malformed", "late", "leap", "outside", "skipped"})  # rows of no use
HARMLESS = frozenset({"heard", "well", "missing", "disordered", "outside"})
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
        elif waiting:
            waiting[0] = replace(waiting[0], since=_since([*oldest, waiting[0]]))
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
    tokens = tuple(t for sample in samples for t in sample.tokens)
    return Ready(samples[-1].t, mean, tokens, _since(samples))


def _since(samples: Iterable[Ready]) -> float | None:
    """Return the earliest time after which samples are to be taken back, None for none."""
    return min((s.since for s in samples if s.since is not None), default=None)


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
    patient
        A journal that cannot be written (a full disk) is waited for, and the run is not well
        meanwhile; else the journal's `RunError` ends the run.
    stopping
        Ends the run when it is set; it may be set already.
    clock
        Seconds that pass.

    Attributes
    ----------
    ailments
        Each returns why the run is not well, in one sentence, or nothing; the first that does is
        what /health, the metrics, the log and the page say. The last is a verdict of "do not
        trust", which is looked at every 50 samples.
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
        patient: bool = False,
        stopping: threading.Event | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.identifier = identifier
        self._begun = identifier.dump()
        self.feed = feed
        self.journal = journal
        self.sinks = list(sinks)
        self.backlog = backlog or Backlog()
        self.retention = retention or Retention()
        self.silence = silence
        self.strict = strict
        self.waits = waits
        self.patient = patient
        self.silent = False
        self.stopping = stopping or threading.Event()
        self.busy = False  # a step is taken
        self._clock = clock
        self._heard = self._taken = clock()
        self._refused = self._failed = 0  # in a row
        self._refusal = self._failure = ""
        self._unwell, self._told, self._doubt = "", (-1, "well"), ""
        self._unwritten = ""  # why the journal cannot be written
        self._put_last = -math.inf  # time of the last estimate that sinks were given
        self.ailments: list[Callable[[], str]] = [
            lambda: self._unwritten,
            self._unlinked,
            self._silence,
            self._refusing,
            self._failing,
            self._doubted,
        ]
        self._waiting = deque(begun)
        self._counts = Counter(journal.counts)
        self._remarked = set(self._counts)
        self._uncounted: deque[Remark] = deque()
        self._events: deque[Event] = deque(maxlen=RECENT)
        self._steps = 0
        told = [event for event in journal.events if event.kind == "verdict"]
        self._level = told[-1].message.partition(":")[0] if told else LEVELS[0]
        self._seconds = 0.0  # spent in steps
        self.fields_every = fields_every
        self.result = self._read()
        self._count(irregular)

    def resume(self) -> int:
        """Take again what the journal holds after its last checkpoint; return how many samples.

        A sample with which the process has ended again and again is set aside.
        """
        try:
            again = self._again(self.journal.estimated)
        except RunError as error:
            again = self._mend(error)
        if again and self.result.last is not None:
            self._put(self.result.last)
        return again

    def _mend(self, error: RunError) -> int:
        """Wait until the journal can be written again; return how many samples were taken again.

        What it has lost is written again: estimates are computed from the last checkpoint on,
        counts and events are still known. Raises the error where nothing helps, or nobody waits.
        """
        begun, again = self._clock(), None
        while again is None:
            if not (self.patient and self.journal.remedy):
                raise error
            why = f"the journal cannot be written ({error.__cause__}): {self.journal.remedy}"
            if not self._unwritten:
                about = {"kind": "disk", "channel": "", "t": self.identifier.t}
                LOG.warning("disk: %s, and the run goes on", why, extra=about)
            self._unwritten = self._unwell = why
            self._told = 0, "unwell"
            if self.stopping.wait(LOOK):
                raise error
            try:
                self.journal.reopen()
                self.journal.say_health(why)  # something is written before steps are taken again
                again = self._again(math.inf)  # not marked: it was not the samples' fault
                self.journal.commit()
                self._restore()
            except RunError as still:
                error, again = still, None
        self._unwritten = ""
        self._heard = self._taken = now = self._clock()  # meanwhile nobody has listened
        self._tell("disk", f"nothing could be written for {now - begun:.1f} s ({error.__cause__})")
        return again

    def _restore(self) -> None:
        """Write again the events and counts that the journal has lost."""
        for event in self._events:
            self.journal.note(event)
        written = Counter(self.journal.counts)
        lost = self._counts - written
        lost.pop(("aside", ""), None)  # counted when it was set aside again
        self._counts = written + lost
        for key, number in lost.items():
            self.journal.count(*key, number)
        self._count(())
        while self._waiting and self._waiting[0].since is None:
            if self._waiting[0].t > self.journal.last:
                return  # the next sample is kept together with this
            self.feed.acknowledge(self._waiting.popleft())  # kept although that was not said
        if not self._waiting:
            self.journal.commit(self.feed.position(()))

    def _again(self, reached: float) -> int:
        """Go back to the last checkpoint and take again what came after it, `reached` at most."""
        state = self.journal.rewind()
        self.identifier.restore(self._begun if state is None else state, str(self.journal.path))
        self.result = self._read()
        again = 0
        for taken in self.journal.samples():
            new = taken.id > reached
            if new and self.journal.mark() > TRIES:
                self._set_aside(taken.t, f"the process has ended {TRIES + 1} times in its step")
                continue
            self._step(taken, again=True)
            if new:
                self.journal.commit()  # its step did end
            again += 1
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
        notes: list[str] = []
        attempted("What is under way at the end", self._settled, None, notes)
        for note in notes:
            self._tell("unfinished", note)
        self.journal.checkpoint(self.identifier.dump())

    def _settled(self) -> None:
        """Keep the estimate and the fields of the end."""
        last = self.result.last
        if last is not None:
            self.result.settle(last := self.identifier.settled(last))
            self.journal.judge(last.verdict.to_dict())
        if self.journal.estimated:
            self.journal.keep(self.result.snapshot(last or self.identifier.estimate()))

    def _run(self) -> None:
        ended = False
        while not ended:
            try:
                self._go_on()
                ended = True
            except RunError as error:
                self._mend(error)
                last = self.result.last
                if last is not None and last.t > self._put_last:
                    self._put(last)

    def _go_on(self) -> None:
        """Take samples until the source ends or `stopping` is set."""
        while not self.stopping.is_set():
            if self.waits and not self._waiting:
                self._settle()  # who reads the journal sees all before it is waited for more
            if self.backlog.has_room(self._waiting):
                self._waiting.extend(self.feed.poll(0.0 if self._waiting else LOOK))
                self._listen(self.feed.heard())
            self._relieve()
            if self._waiting:
                self._take()
            elif self.feed.done:
                break
            self._look()
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
        self._uncounted.extend(remarks)
        while self._uncounted:
            remark = self._uncounted.popleft()
            if remark.kind in UNUSED:
                self._refused += remark.number
                self._refusal = f"{remark.kind}: {remark.message}"
            self._counts[remark.kind, remark.channel] += remark.number
            if remark.kind == "clock" or (remark.kind, remark.channel) not in self._remarked:
                self._remarked.add((remark.kind, remark.channel))
                self._tell(remark.kind, remark.message, remark.channel)
            self.journal.count(remark.kind, remark.channel, remark.number)

    def _tell(self, kind: str, message: str, channel: str = "") -> None:
        if len(message) > LONGEST:  # it may repeat what has come
            message = message[:LONGEST] + "..."
        event = Event(self.identifier.t, kind, channel, message)
        self._events.append(event)
        level = logging.INFO if kind in HARMLESS else logging.WARNING
        about = {"kind": kind, "channel": channel, "t": event.t}  # fields of a log in JSON
        LOG.log(level, "%s%s: %s", kind, f" ({channel})" if channel else "", message, extra=about)
        self.journal.note(event)

    @property
    def health(self) -> dict[str, Any]:
        """What a watchdog should know: ok, or why not, in one sentence."""
        last = self.result.last
        counts = self._counts.copy()  # who asks does so from another thread
        why, verdict = self.why, None if last is None else last.verdict
        return {
            "ok": not why,
            "why": why,
            "t": self.identifier.t,
            "samples": len(self.result),
            "waiting": len(self._waiting),
            "silent": self.silent,
            "status": "" if last is None else last.status.code,
            "seconds": self._seconds,
            "verdict": "" if verdict is None else verdict.level,
            "findings": [] if verdict is None else verdict.sentences,
            "counts": [[*key, number] for key, number in sorted(counts.items())],
        }

    @property
    def why(self) -> str:
        """Why the run is not well, in one sentence; empty if it is.

        As long as it ails of the same the sentence stays as it was when that began.
        """
        ailing, why = self._ailing()
        return self._unwell if ailing == self._told[0] else why

    def _ailing(self) -> tuple[int, str]:
        """Return the number of the first ailment that there is, -1 for none, and what it says."""
        found = ((k, why) for k, ailment in enumerate(self.ailments) if (why := ailment()))
        return next(found, (-1, ""))

    def _unlinked(self) -> str:
        if self.journal.in_place:
            return ""
        return (
            "the journal's file is no longer the one in the run directory, and what is written "
            "ends with this process: stop it, and run the case into a new folder"
        )

    def _silence(self) -> str:
        if not self.silent:
            return ""
        return f"nothing has come from the source for more than {self.silence:g} s"

    def _refusing(self) -> str:
        long = self._clock() - self._taken > self.silence
        if not (long or self._refused >= REFUSED):
            return ""
        if not self._refused:
            return f"no sample has been taken for more than {self.silence:g} s"
        return f"rows come and none is taken; the last one: {self._refusal}"

    def _failing(self) -> str:
        last = self.result.last
        if self._failed > 1:
            return f"the last steps have failed; the last one: {self._failure}"
        return "" if last is None or last.status.ok else f"the last step: {last.status}"

    def _doubted(self) -> str:
        return self._doubt

    def _look(self) -> None:
        """Say in the log, and to who reads the journal, what has changed of the run's health."""
        ailing, why = self._ailing()
        before, kind = self._told
        if ailing == before:
            return
        self._unwell = why
        self._told = ailing, "silent" if self.silent else "unwell" if why else "well"
        self.journal.say_health(why)
        if why:
            self._tell(self._told[1], why)
        elif kind == "unwell":  # of the end of a silence it has been said that it is heard
            self._tell("well", "all is well again")

    def _take(self) -> None:
        """Take the first of the samples that wait; it waits on if it cannot be kept."""
        ready = self._waiting.popleft()
        try:
            if ready.since is not None:
                self._go_back(ready.since)
            position = self.feed.position(self._waiting)
            self._count(self.feed.remarks(self._waiting))
            taken = self.journal.accept(ready.t, ready.values, position)
        except RunError:
            self._waiting.appendleft(ready)
            raise
        self.feed.acknowledge(ready)
        self._step(taken)

    def _go_back(self, t: float) -> None:
        """Take back the samples later than a time, and stand where they had not come yet."""
        self.journal.go_back(t)
        self._again(self.journal.estimated)

    def _step(self, taken: Taken, *, again: bool = False) -> None:
        self.busy = True
        try:
            estimate = self._estimate(taken)
            if estimate is not None:
                self._hand_on(estimate, again)
        finally:
            self.busy = False

    def _estimate(self, taken: Taken) -> Estimate | None:
        """Take a step; return None where the sample was refused or set aside."""
        before, begun = self.identifier.place, time.monotonic()
        try:
            estimate = self.identifier.step(taken.t, taken.values)
            self._seconds += time.monotonic() - begun
            self.result.add(estimate)
        except DataError as error:
            if not self.strict:
                self._tell("refused", str(error))
                self._refused += 1
                self._refusal = str(error)
            self._withdraw()
            if self.strict:
                raise
        except RunError:  # of the journal
            raise
        except Exception as error:
            if self.strict and numerical(error) is None:
                raise
            self.identifier.return_to(before)
            self._set_aside(taken.t, f"{type(error).__name__}: {error}")
        else:
            return estimate
        return None

    def _withdraw(self) -> None:
        """Forget the last sample; those that wait are later, and taken or refused in their turn."""
        self.journal.withdraw()
        self.feed.withdraw(self._waiting[-1].t if self._waiting else self.journal.last)

    def _set_aside(self, t: float, why: str) -> None:
        """Forget a sample with which a step cannot end; the stream goes on."""
        self._failed += 1
        self._failure = f"t = {t:g} was set aside: {why}"
        self._tell("aside", self._failure)
        self._counts["aside", ""] += 1
        self.journal.count("aside")
        self._withdraw()

    def _hand_on(self, estimate: Estimate, again: bool) -> None:
        """Tell of an estimate, and keep a checkpoint from time to time."""
        if not again:
            self._put(estimate)
        if estimate.status.taken:
            self._taken, self._refused = self._clock(), 0
        self._failed = 0 if estimate.status.ok else self._failed + 1
        if not estimate.status.ok:
            self._failure = str(estimate.status)
            self._tell(estimate.status.code, self._failure)
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
        grave = verdict.level == LEVELS[-1]
        self._doubt = f"the verdict on the estimates is {verdict.level!r}" if grave else ""
        if verdict.level != self._level:
            self._level = verdict.level
            said = verdict.sentences[0] if verdict.sentences else "nothing speaks against it"
            self._tell("verdict", f"{verdict.level}: {said}")

    def _put(self, estimate: Estimate) -> None:
        """Hand an estimate to all sinks; one that fails is given up, the run goes on."""
        self._put_last = estimate.t
        for sink in list(self.sinks):
            try:
                sink.put(estimate)
            except (OSError, LivepdeError) as error:
                self.sinks.remove(sink)
                self._tell("sink", f"{type(sink).__name__} is given up: {error}")

    def _listen(self, heard: bool) -> None:
        now = self._clock()
        if heard:
            if self.silent:
                self._tell("heard", f"the source is heard again after {now - self._heard:.0f} s")
            self._heard, self.silent = now, False
        elif now - self._heard > self.silence:
            self.silent = True
