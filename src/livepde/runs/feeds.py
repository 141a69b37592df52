"""Feeds of samples into a run: rows of a source, sorted samples, or replay in real time."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from livepde.samples import Sample, by_name
from livepde.streams.intake import Intake, IntakeOutcome, Ready, Remark, gather
from livepde.streams.sources import RowSource


class Feed(Protocol):
    """Source of complete, checked samples in time order.

    The defaults of all methods except `done` and `poll` suit a feed that is never silent, refuses
    no row, and has no position to return to, rows to acknowledge or resources to release.
    """

    @property
    def done(self) -> bool:
        """True if there will be no more samples."""

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return the available samples, possibly none, after at most `wait` seconds."""

    def heard(self) -> bool:
        """Return whether a row, usable or not, has arrived since the last call."""
        return True

    @property
    def interval(self) -> float:
        """Usual interval between two samples in seconds; infinite if it is not known."""
        return math.inf

    @property
    def doubt(self) -> str:
        """Reason to doubt the times of rows, in one sentence, or an empty string."""
        return ""

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        """Return the remarks since the last call, merged with their counts.

        Only remarks on rows before `position(waiting)` are returned: later rows are read again
        after a crash, and their remarks would be counted twice.
        """
        return ()

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return the position of the source before the `waiting` samples, not yet processed."""
        return ""

    def acknowledge(self, ready: Ready) -> None:
        """Acknowledge a sample that was committed or dropped."""
        return

    def withdraw(self, last: float) -> None:
        """Accept samples later than the time `last` again, after later ones were withdrawn."""
        return

    def close(self) -> None:
        """Close the source and release its resources."""
        return


@dataclass(eq=False)
class Gathered(Feed):
    """Feed of the rows of a source, sorted and merged into samples by an `Intake`."""

    source: RowSource
    intake: Intake
    done: bool = field(default=False, init=False)
    _heard: bool = field(default=False, init=False)
    _remarks: list[Remark] = field(default_factory=list, init=False)
    # Number of rows so far. A token here is the number of a row and the token of the source.
    _rows: int = field(default=0, init=False)

    def poll(self, wait: float) -> Sequence[Ready]:
        rows = self.source.poll(wait)
        received = time.monotonic()
        self._heard |= bool(rows)
        found: list[Ready] = []
        for row in rows:
            self._rows += 1
            token = self._rows, row.token
            outcome = IntakeOutcome(spent=[token])
            if row.broken:
                outcome.remark(row.kind, "", row.broken, token)
            else:
                outcome = self.intake.take(row.values, token, received)
            found += self._used(outcome)
        if self.source.done and not self.done:
            self.done = True
            found += self._used(self.intake.flush())
        return found

    def _used(self, outcome: IntakeOutcome) -> list[Ready]:
        self._remarks += outcome.remarks
        self.source.acknowledge(_given(outcome.spent))
        return outcome.ready

    def _waiting(self, waiting: Sequence[Ready]) -> list[Any]:
        """Return the tokens of all rows that are not yet processed."""
        return [*(token for ready in waiting for token in ready.tokens), *self.intake.waiting]

    def heard(self) -> bool:
        heard, self._heard = self._heard, False
        return heard

    @property
    def interval(self) -> float:
        return self.intake.interval if self.source.steady else math.inf

    @property
    def doubt(self) -> str:
        return self.intake.why

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
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
        return self.source.position(_given(self._waiting(waiting)))

    def acknowledge(self, ready: Ready) -> None:
        self.source.acknowledge(_given(ready.tokens))

    def withdraw(self, last: float) -> None:
        self.intake.withdraw(last)

    def close(self) -> None:
        self.source.close()


def _given(tokens: Iterable[Any]) -> list[Any]:
    """Return the tokens of the source without the row numbers."""
    return [token for _, token in tokens]


@dataclass(eq=False)
class SampleFeed(Feed):
    """Feed of samples in time order: a table, or any iterable of samples."""

    samples: Iterable[Sample]
    names: Sequence[str] = ()  # names of the sensors, in the order of their values in an array z
    after: float = -math.inf  # samples up to this time are skipped, since an earlier run took them
    irregular: Sequence[Remark] = ()  # remarks from reading the samples
    done: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._left = iter(self.samples)

    def poll(self, wait: float) -> Sequence[Ready]:
        for sample in self._left:
            if sample.t > self.after:
                values = {**by_name(sample.z, self.names), **(sample.inputs or {})}
                return [Ready(t=sample.t, values=values)]
        self.done = True
        return []

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        found, self.irregular = self.irregular, ()
        return found


@dataclass(eq=False)
class Paced(Feed):
    """Feed that replays past samples at the pace of their times."""

    feed: Feed  # feed of the samples
    pace: float  # model time per second
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    _held: deque[Ready] = field(default_factory=deque, init=False)  # samples that are not due yet
    _begun: tuple[float, float] | None = field(default=None, init=False)

    @property
    def done(self) -> bool:
        return self.feed.done and not self._held

    def poll(self, wait: float) -> Sequence[Ready]:
        if not self._held:
            self._held.extend(self.feed.poll(wait))
        if not self._held:
            return []
        now, first = self.clock(), self._held[0].t
        begun = self._begun or (now, first)
        self._begun = begun
        # A sample at time t is due (t - t_0) / pace seconds after the first sample.
        due = begun[0] + (first - begun[1]) / self.pace
        if due > now:
            self.sleep(min(wait, due - now))
        passed = begun[1] + (self.clock() - begun[0]) * self.pace
        found = []
        while self._held and self._held[0].t <= passed:
            found.append(self._held.popleft())
        return found

    def heard(self) -> bool:
        return self.feed.heard() or bool(self._held)

    @property
    def doubt(self) -> str:
        return self.feed.doubt

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        return self.feed.remarks([*waiting, *self._held])

    def position(self, waiting: Sequence[Ready]) -> str:
        return self.feed.position([*waiting, *self._held])

    def acknowledge(self, ready: Ready) -> None:
        self.feed.acknowledge(ready)

    def withdraw(self, last: float) -> None:
        self.feed.withdraw(self._held[-1].t if self._held else last)

    def close(self) -> None:
        self.feed.close()
