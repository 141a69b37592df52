"""Feeds of samples into a run: put in order, as they are, or at the pace of their times."""

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
    """Brings samples in time order, complete and checked.

    Other methods than `done` and `poll` are those of a feed that is never silent, refuses no row
    and has nothing to go back to, acknowledge or close.
    """

    @property
    def done(self) -> bool:
        """True if no more samples will come."""

    def poll(self, wait: float) -> Sequence[Ready]:
        """Return available samples, waiting for them at most `wait` seconds; may be empty."""

    def heard(self) -> bool:
        """Return whether any row has come since the last call, usable or not."""
        return True

    @property
    def interval(self) -> float:
        """Seconds between two samples as they usually come; infinite if that is not known."""
        return math.inf

    @property
    def doubt(self) -> str:
        """Reason to doubt the times of rows, in one sentence; empty if there is none."""
        return ""

    def remarks(self, waiting: Sequence[Ready]) -> Sequence[Remark]:
        """Return the counts of remarks since the last call.

        Only remarks on rows before `position(waiting)`: later rows are read again after a crash,
        and their remarks would be counted twice.
        """
        return ()

    def position(self, waiting: Sequence[Ready]) -> str:
        """Return the position of the source before these samples, which are still to be taken."""
        return ""

    def acknowledge(self, ready: Ready) -> None:
        """Acknowledge a sample that has been kept for good, or dropped."""
        return

    def withdraw(self, last: float) -> None:
        """Accept samples later than this time again: those taken since then were withdrawn."""
        return

    def close(self) -> None:
        """Close the source and release its resources."""
        return


@dataclass(eq=False)
class Gathered(Feed):
    """Samples from the rows of a source, as an `Intake` puts them in order."""

    source: RowSource
    intake: Intake
    done: bool = field(default=False, init=False)
    _heard: bool = field(default=False, init=False)
    _remarks: list[Remark] = field(default_factory=list, init=False)
    # Number of rows so far; a token is the number of the row, and what the source gave with it.
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
        """Return the tokens of all rows that are still to be taken."""
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
    """Return the tokens of the source, without the numbers of their rows."""
    return [token for _, token in tokens]


@dataclass(eq=False)
class SampleFeed(Feed):
    """Feed of samples that are in order already: a table, or any iterable of samples."""

    samples: Iterable[Sample]
    names: Sequence[str] = ()  # sensors whose values an array z holds
    after: float = -math.inf  # time of the last sample taken before; samples up to it are skipped
    irregular: Sequence[Remark] = ()  # what was found as the samples were read
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
    """Samples of the past, replayed at the pace of their times."""

    feed: Feed  # whose samples are replayed
    pace: float  # model time that passes in one second
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    _held: deque[Ready] = field(default_factory=deque, init=False)  # until they are due
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
        # A sample of time t is due (t - t_0) / pace seconds after the first one.
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
