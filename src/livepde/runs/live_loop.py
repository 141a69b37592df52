"""The loop of a live run: rows from a source, samples into the journal, estimates to sinks."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from livepde.errors import DataError, LivepdeError, RunError
from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.laws import numerical
from livepde.result import Result
from livepde.runs.ailments import Ailments
from livepde.runs.backlog import Backlog, Retention, Sink
from livepde.runs.directory import attempted
from livepde.runs.feeds import Feed
from livepde.runs.journal import Event, Journal, Taken
from livepde.runs.looks import JUDGED, Looks, is_due
from livepde.stepping import LONG_SUBSTEPS, interruptible
from livepde.streams.intake import Ready, Remark
from livepde.verdict import LEVELS

GROUP = 64  # largest number of samples in a commit
AGE = 0.25  # seconds since the last commit after which a step begins with a commit
CHECKPOINT = 256  # largest number of samples between two checkpoints
# Checkpoints also depend on the time spent in steps, so that a run that is killed every few seconds
# makes progress: one follows each second of steps, or less often to cost at most 5 % of that time.
APART, COST = 1.0, 0.05
# Seconds after a signal until a step, or the last fit, is interrupted.
GRACE, LAST_GRACE = 0.5, 1.0
LOOK = 0.5  # seconds between two checks of `stopping`
LONGEST = 500  # characters of an event
RECENT = 1000  # events kept in memory, which are written again if the journal loses them
TRIES = 2  # crashes of the process in the step of a sample before the sample is skipped
HARMLESS = frozenset({"heard", "well", "missing", "disordered", "outside"})
LOG = logging.getLogger("livepde.run")


class Interrupted(KeyboardInterrupt):
    """A step was interrupted between two substeps to stop the run; the state is unchanged."""


class Live:
    """A live run, which continues until its source ends or it is stopped.

    Samples that are available together are committed in groups. Sources are acknowledged, and sinks
    receive estimates, only after the commit of their group. A group ends before the run waits for
    its source, and before a step if it has 64 samples or the last commit is 0.25 s ago. The first
    64 samples of a session are committed one by one, each before its step: if a step crashed the
    last session, its sample is among them. Beliefs and diagnostics of a group's estimates are
    computed together at its end, which uses the caches of the processor well. If one of these
    computations fails, the samples are processed again one by one.

    Parameters
    ----------
    identifier
        The identifier in its initial state; `resume` restores the state from the journal.
    feed, journal, sinks
        Source of samples, store of samples and estimates, and destinations of estimates.
    fields_every
        Interval, in samples, at which fields are kept.
    backlog
        Policy for samples that arrive faster than they are processed.
    retention
        Retention policy of the journal.
    silence
        Seconds without a row after which the source is reported as silent. None: the largest of ten
        usual intervals of its rows, twice its longest silence so far, and a minute.
    strict
        Whether a sample that the identifier cannot use ends the run with its `DataError`; otherwise
        it is recorded as an event.
    begun, irregular
        Samples that the feed has already delivered, and the remarks on irregular rows so far.
    waits
        Whether the feed may wait for samples; then the run commits before each wait.
    patient
        Whether to wait while the journal cannot be written (a full disk) and report the run as
        unhealthy; otherwise the journal's `RunError` ends the run.
    stopping
        Event that ends the run; it may already be set.
    clock
        Function that returns the time in seconds.

    Attributes
    ----------
    ailments
        Faults of the run.
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
        silence: float | None = None,
        strict: bool = False,
        begun: Iterable[Ready] = (),
        irregular: Iterable[Remark] = (),
        waits: bool = True,
        patient: bool = False,
        stopping: threading.Event | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.identifier = identifier
        # Without an intact checkpoint, all samples are processed again from this state.
        self._begun = identifier.dump()
        self.feed = feed
        self.journal = journal
        self.sinks = list(sinks)
        self.backlog = backlog or Backlog()
        self.retention = retention or Retention()
        self.strict = strict
        self.waits = waits
        self.patient = patient
        self.stopping = stopping or threading.Event()
        self._clock = clock
        self.ailments = Ailments(feed, journal, lambda: self.result.last, silence, clock)
        self._group: deque[Ready] = deque()  # samples to acknowledge after the next commit
        # Estimates of the group, stored at its end: sample number, estimate, whether to keep fields
        self._unread: deque[tuple[int, Estimate, bool]] = deque()
        self._untold: deque[Estimate] = deque()  # estimates for the sinks after the next commit
        self._committed = clock()
        self._one_by_one = journal.accepted + GROUP  # number of the last sample with its own commit
        self._put_last = -math.inf  # time of the last estimate that sinks have received
        self._waiting = deque(begun)
        self._counts = Counter(journal.counts)
        self._uncounted: deque[Remark] = deque()
        self._events: deque[Event] = deque(maxlen=RECENT)
        self._steps = 0
        self._stopped_at = math.inf  # time at which a step first found `stopping` set
        self._kept_at = self._cost = 0.0  # `_seconds` at the last checkpoint, and its duration
        self._wild = False  # whether outliers have been reported
        self._replay = (0, 0)  # number of replayed samples, and of samples to replay
        self.looks = Looks.stored(journal.verdict)
        self._seconds = 0.0  # time spent in steps
        self.fields_every = fields_every
        self.result = self._read()
        self._count(irregular)

    def resume(self) -> int:
        """Replay the samples after the journal's last checkpoint; return their number.

        A sample whose step has crashed the process three times is skipped. If `stopping` is set
        during the replay, a checkpoint is written, and the next session replays the other samples.
        """
        try:
            again = self._again(self.journal.estimated)
        except RunError as error:
            again = self._mend(error)
        if again and self.result.last is not None:
            self._put(self.result.last)
        return again

    def _mend(self, error: RunError) -> int:
        """Wait until the journal can be written again; return the number of replayed samples.

        Lost records are restored: estimates are recomputed from the last checkpoint on, counts and
        events are still in memory. Raises the error if it has no remedy, the run is not patient, or
        `stopping` is set.
        """
        begun, again = self._clock(), None
        self._put_back()  # the journal has rolled back uncommitted samples
        while again is None:
            if not (self.patient and self.journal.remedy):
                raise error
            why = f"the journal cannot be written ({error.__cause__}): {self.journal.remedy}"
            if not self.ailments.unwritten:
                about = {"kind": "disk", "channel": "", "t": self.identifier.t}
                LOG.warning("disk: %s; the run continues", why, extra=about)
            self.ailments.away(why)
            if self.stopping.wait(LOOK):
                raise error
            try:
                self.journal.reopen()
                # This write comes first: if it fails, the replay would be wasted.
                self.journal.say_health(why)
                again = self._recover()
                # This write may fail too, if the disk has become unavailable again.
                away = f"{self._clock() - begun:.1f} s ({error.__cause__})"
                self._tell("disk", f"the disk was not writable for {away}")
            except RunError as still:
                error, again = still, None
        self.ailments.back()
        return again

    def _one_at_a_time(self) -> None:
        """Return to the last commit, and process the samples of the group again one by one."""
        self._put_back()
        self.journal.rollback()
        self._one_by_one = self.journal.accepted + GROUP
        self._recover()

    def _put_back(self) -> None:
        """Put uncommitted samples back at the start of the queue."""
        self._waiting.extendleft(reversed(self._group))
        self._group.clear()
        self._unread.clear()

    def _recover(self) -> int:
        """Continue from the last commit; return the number of replayed samples."""
        # The tries of samples are not counted, since the process has not crashed.
        again = self._again(math.inf)
        self.journal.commit()
        self._restore()
        # Sinks still receive committed estimates. The other samples are processed again.
        self._untold = deque(one for one in self._untold if one.t <= self.identifier.t)
        return again

    def _restore(self) -> None:
        """Restore the events and counts that the journal has lost."""
        for event in self._events:
            self.journal.note(event)
        self._keep_verdict(self.looks)
        written = Counter(self.journal.counts)
        # Committed counts have survived, so only the difference is added.
        lost = self._counts - written
        lost.pop(("aside", ""), None)  # counted in the replay, where samples are skipped again
        self._counts = written + lost
        for key, number in lost.items():
            self.journal.count(*key, number)
        self._count(())
        while self._waiting:
            if self._waiting[0].t > self.journal.last:
                return  # the next sample commits the counts and the position
            # The sample was committed although its write was reported as failed.
            self.feed.acknowledge(self._waiting.popleft())
        if not self._waiting:
            self.journal.commit(self.feed.position(()))

    def _again(self, reached: float) -> int:
        """Restore the last checkpoint and replay all samples after it; return their number.

        Tries are counted for samples with numbers above `reached`, which have no estimate yet.
        """
        state = self.journal.rewind()
        self.identifier.restore(self._begun if state is None else state, str(self.journal.path))
        self.result = self._read()
        again, total = 0, self.journal.pending
        for taken in self.journal.samples():
            self._replay = again, total
            new = taken.id > reached
            if self.stopping.is_set() or not self._taken_again(taken, new):
                # The next session continues from here.
                self._keep_state()
                break
            again += 1
        self._replay = 0, 0
        return again

    def _taken_again(self, taken: Taken, new: bool) -> bool:
        """Replay a sample; return whether its step was completed, not interrupted.

        `new`: whether the sample has no estimate yet, so that its tries are counted.
        """
        if new and self.journal.mark() > TRIES:
            self._set_aside(taken.t, f"processing it ended the program {TRIES + 1} times")
            return True
        try:
            self._step(taken, again=True)
        except Interrupted:
            if new:
                self.journal.unmark()
            return False
        if new:
            # The step is complete, so that a later crash must not count as one of its tries.
            self.journal.commit()
        return True

    def _read(self) -> Result:
        """Return a result that reads estimates from the journal."""
        who, kept = self.identifier, self.journal
        parts = who.model, who.observed, who.validation
        return Result(*parts, self.fields_every, kept, layout=kept.layout, count=kept.estimated)

    def run(self) -> None:
        """Run until the source ends or `stopping` is set, then write a final checkpoint."""
        try:
            self._run()
        except Interrupted:
            self._commit()
            self._keep_state()
            return
        except BaseException:
            # The first error is reported, not an error that follows from it.
            with suppress(LivepdeError):
                self._conclude()
            raise
        self._conclude()

    def _conclude(self) -> None:
        self._commit()
        if self.journal.accepted > self.journal.estimated:
            return  # interrupted in a step: the next session replays from an earlier checkpoint
        notes: list[str] = []
        attempted("The final fit", self._settled, None, notes)
        for note in notes:
            self._tell("unfinished", note)
        self._keep_state()

    def _settled(self) -> None:
        """Store the verdict and the fields of the final estimate."""
        if not self.journal.estimated:
            return
        # A session without samples does this too, since an earlier session may have been killed.
        last = self.result.last or self.identifier.estimate()
        try:
            with interruptible(self._check):
                settled = self.identifier._settled(last)
                verdict = settled.verdict
            last = settled
            self.result._settle(last)
            self._keep_verdict(replace(self.looks, verdict=verdict))
        except Interrupted:
            self._tell("unfinished", "the final fit was skipped, because the run was stopped")
        self.journal.keep(self.result._snapshot(last))

    def _run(self) -> None:
        ended = False
        while not ended:
            try:
                self._go_on()
                ended = True
            except RunError as error:
                self._mend(error)
                # Sinks receive no estimates of replayed samples, except the last if it is new.
                last = self.result.last
                known = self._untold[-1].t if self._untold else self._put_last
                if last is not None and last.t > known:
                    self._untold.append(last)
            except Exception:  # laws and sensors of a user may raise anything
                if not self._unread:
                    raise
                # If samples are processed one by one, only the sample with the error is skipped.
                self._one_at_a_time()

    def _go_on(self) -> None:
        """Process samples until the source ends or `stopping` is set."""
        while not self.stopping.is_set():
            if self.waits and not self._waiting:
                self._settle()  # readers see all estimates before the run waits for rows
            if self.backlog.has_room(self._waiting):
                # Waiting samples must not wait for the source. An idle run still checks `stopping`.
                self._waiting.extend(self.feed.poll(0.0 if self._waiting else LOOK))
                ended = self.ailments.listen(self.feed.heard())
                if ended:
                    self._tell("heard", ended)
            self._relieve()
            if self._waiting:
                self._take()
            elif self.feed.done:
                break
            self._look()
        self._settle()

    def _settle(self) -> None:
        """Commit the counts of irregular rows, and the position of the source."""
        # The position is committed with the counts: after a crash between two transactions, the
        # same rows would be read and counted again.
        remarks = self.feed.remarks(self._waiting)
        self._count(remarks)
        self._commit(self.feed.position(self._waiting) if remarks else None)

    def _commit(self, position: str | None = None) -> None:
        """Commit, then acknowledge the samples of the group and pass their estimates to sinks."""
        self._record()
        self.journal.commit(position)
        self._committed = self._clock()
        while self._group:
            self.feed.acknowledge(self._group.popleft())
        while self._untold:
            self._put(self._untold.popleft())

    def _record(self) -> None:
        """Store the estimates of the group."""
        group, before, self.ailments.busy = [*self._unread], self.ailments.busy, True
        try:
            records = self.result._records([(estimate, keeps) for _, estimate, keeps in group])
            for (number, *_), record in zip(group, records, strict=True):
                self.journal.append(record, number)
            self._unread.clear()
        finally:
            self.ailments.busy = before

    def _tell_wild(self, estimate: Estimate) -> None:
        """Report the first readings that were rejected by a law without a covariance."""
        if self._wild or self.identifier.law.weighs_readings():
            return
        refused = estimate.diagnostics.refused
        if refused > 0.0:
            self._wild = True
            text = (
                f"t = {estimate.t:g}: {refused:g} outliers, far outside the range so far, were "
                "rejected; the report lists later ones"
            )
            self._tell("wild", text)

    def _is_due(self, taken: Taken) -> bool:
        """Return whether a sample must be committed before its step, see the class."""
        return (
            taken.id <= self._one_by_one
            or (self.waits and not self._waiting)
            or len(self._group) >= GROUP
            or self._clock() - self._committed >= AGE
        )

    def _relieve(self) -> None:
        relieved = self.backlog.relieved(self._waiting)
        if relieved:
            self._counts[self.backlog.overflow, ""] += len(relieved)
            self.journal.count(self.backlog.overflow, "", len(relieved))
        # Merged samples are acknowledged with the sample that has the tokens of all their rows.
        if self.backlog.overflow == "drop":
            for ready in relieved:
                self.feed.acknowledge(ready)

    def _count(self, remarks: Iterable[Remark]) -> None:
        """Count remarks; the first of each kind and channel is also recorded as an event."""
        self._uncounted.extend(remarks)
        while self._uncounted:
            remark = self._uncounted.popleft()
            self.ailments.remarked(remark)
            first = (remark.kind, remark.channel) not in self._counts
            self._counts[remark.kind, remark.channel] += remark.number
            if first or remark.kind == "clock":
                self._tell(remark.kind, remark.message, remark.channel)
            self.journal.count(remark.kind, remark.channel, remark.number)

    def _tell(self, kind: str, message: str, channel: str = "", *, harmless: bool = False) -> None:
        if len(message) > LONGEST:  # a message may quote a whole row
            message = message[:LONGEST] + "..."
        event = Event(self.identifier.t, kind, channel, message)
        self._events.append(event)
        level = logging.INFO if harmless or kind in HARMLESS else logging.WARNING
        about = {"kind": kind, "channel": channel, "t": event.t}  # fields of a log in JSON
        LOG.log(level, "%s%s: %s", kind, f" ({channel})" if channel else "", message, extra=about)
        self.journal.note(event)

    @property
    def health(self) -> dict[str, Any]:
        """State of the run for a watchdog: "ok", the reason if not, and counters."""
        last = self.result.last
        counts = self._counts.copy()  # other threads call this
        (ailment, why), verdict = self.ailments.ill, self.looks.verdict
        return {
            "ok": not why,
            "why": why,
            "ailment": ailment,
            "t": self.identifier.t,
            "samples": len(self.result),
            "waiting": len(self._waiting),
            "silent": self.ailments.silent,
            "status": self.replaying or ("" if last is None else last.status.code),
            "replaying": self.replaying,
            "seconds": self._seconds,
            "verdict": verdict.level,
            "findings": verdict.sentences,
            "counts": [[*key, number] for key, number in sorted(counts.items())],
        }

    @property
    def replaying(self) -> str:
        """Progress of the replay of samples since the checkpoint, or an empty string."""
        again, total = self._replay
        return f"replaying {again} of {total} since the checkpoint" if total else ""

    def _look(self) -> None:
        """Log a change of the run's health, and store it for the readers of the journal."""
        event = self.ailments.look()
        if event is not None:
            self.journal.say_health(self.ailments.ill[1])
            if event[1]:
                self._tell(*event)

    def _take(self) -> None:
        """Process the first waiting sample; it remains in the queue if it cannot be stored."""
        ready = self._waiting.popleft()
        try:
            # Counts, position and sample are one transaction, so that a crash loses all or none.
            position = self.feed.position(self._waiting)
            self._count(self.feed.remarks(self._waiting))
            taken = self.journal.accept(ready.t, ready.values, position)
        except RunError:
            self._waiting.appendleft(ready)
            raise
        self._group.append(ready)
        if self._is_due(taken):
            self._commit()
        self._step(taken)

    def _step(self, taken: Taken, *, again: bool = False) -> None:
        self.ailments.busy = True
        try:
            with interruptible(self._check):
                estimate = self._estimate(taken)
                if estimate is not None:
                    self._hand_on(estimate, again)
        finally:
            self.ailments.busy = False

    def _check(self) -> None:
        """Raise `Interrupted` if `stopping` was set a while ago; called between substeps."""
        if self.stopping.is_set():
            now = self._clock()
            self._stopped_at = min(self._stopped_at, now)
            if now - self._stopped_at >= (GRACE if self.ailments.busy else LAST_GRACE):
                raise Interrupted

    def _estimate(self, taken: Taken) -> Estimate | None:
        """Take a step and return the estimate, or None if the sample was rejected or skipped."""
        before, begun = self.identifier._place, time.monotonic()
        self._tell_pause(taken.t)
        try:
            estimate = self.identifier.step(taken.t, taken.values)
            self._seconds += time.monotonic() - begun
            if self._group:
                self._unread.append((taken.id, estimate, self.result._announce(estimate)))
            else:
                self.result.add(estimate)
        except DataError as error:
            if self.strict:
                self._withdraw()
                raise
            self._tell("refused", str(error))
            self.ailments.refused(str(error))
            self._withdraw()
        except RunError:  # from the journal
            raise
        except Interrupted:
            self.identifier._return_to(before)
            raise
        except Exception as error:
            # A numerical failure is due to this sample, any other failure to the code.
            if self.strict and numerical(error) is None:
                raise
            # A step that failed midway may have changed a part of the identifier.
            self.identifier._return_to(before)
            self._set_aside(taken.t, f"{type(error).__name__}: {error}")
        else:
            return estimate
        return None

    def _tell_pause(self, t: float) -> None:
        """Report an interval so long that its substeps are longer than `dt_max`."""
        control, length = self.identifier.problem.control, t - self.identifier.t
        if control.stretches(length):
            text = (
                f"no sample for {length:g} until t = {t:g}: the interval was divided into "
                f"{LONG_SUBSTEPS} substeps longer than dt_max = {control.dt_max:g}; check the "
                "time, or increase `steps.dt_max`"
            )
            self._tell("pause", text)

    def _withdraw(self) -> None:
        """Withdraw the last sample; samples in the queue are later and not affected."""
        self._record()
        self.journal.withdraw()
        self.feed.withdraw(self._waiting[-1].t if self._waiting else self.journal.last)

    def _set_aside(self, t: float, why: str) -> None:
        """Withdraw and report a sample whose step failed; the run continues."""
        failure = f"the sample at t = {t:g} was skipped: {why}"
        self.ailments.failed(failure)
        self._tell("aside", failure)
        self._counts["aside", ""] += 1
        self.journal.count("aside")
        self._withdraw()

    def _hand_on(self, estimate: Estimate, again: bool) -> None:
        """Queue an estimate for the sinks, and update the verdict at intervals."""
        if self.sinks and not again:
            self._untold.append(estimate)
        self.ailments.stepped(estimate)
        if not estimate.status.ok:
            self._tell(estimate.status.code, str(estimate.status))
        self._tell_wild(estimate)
        self._steps += 1
        # Samples count from the start of the run, so that a resumed run judges the same samples.
        look, others = divmod(len(self.result), JUDGED)
        # A batch run ends with a verdict and is rarely judged before.
        if not others and (self.waits or is_due(look)):
            self._judge(estimate)
        self._checkpoint(estimate)

    def _checkpoint(self, estimate: Estimate) -> None:
        """Write a checkpoint at intervals, and thin the journal."""
        by_count = self._steps % CHECKPOINT == 0
        if by_count or self._seconds - self._kept_at >= max(APART, self._cost / COST):
            self._record()
            self._keep_state()
            if by_count and math.isfinite(self.retention.span):
                self.journal.thin(estimate.t - self.retention.span, self.retention.every)

    def _keep_state(self) -> None:
        """Write a checkpoint of the state after the last estimated sample."""
        begun = time.monotonic()
        self.journal.checkpoint(self.identifier.dump())
        self._cost, self._kept_at = time.monotonic() - begun, self._seconds

    def _judge(self, estimate: Estimate) -> None:
        """Update the verdict, and report a change of its level."""
        before = self.looks
        looked = before.after(self.identifier, estimate, len(self.result), live=self.waits)
        if looked is None:  # replayed samples have already been judged
            return
        self._keep_verdict(looked)
        level, verdict = looked.level, looked.verdict
        if level != before.level:
            first = verdict.sentences[0] if verdict.sentences else "no problems detected"
            message = f"{level}: {first.removeprefix('Not judged: ')}"
            # The change from not judged to trusted is normal, thus not a warning. A batch run ends
            # with another verdict, on all data.
            self._tell("verdict", message, harmless=level == LEVELS[0] or not self.waits)

    def _keep_verdict(self, looked: Looks) -> None:
        """Set the current verdict, and store it for the readers of the journal."""
        self.looks = looked
        self.journal.judge(looked.to_dict())

    def _put(self, estimate: Estimate) -> None:
        """Pass an estimate to all sinks; a sink that fails is removed, and the run continues."""
        self._put_last = estimate.t
        for sink in list(self.sinks):
            try:
                sink.put(estimate)
            except (OSError, LivepdeError) as error:
                self.sinks.remove(sink)
                self._tell("sink", f"{type(sink).__name__} failed and was removed: {error}")
