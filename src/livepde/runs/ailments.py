"""Whether a live run is well, and why not: a full disk, a silent source, rows of no use."""

from __future__ import annotations

from collections.abc import Callable

from livepde.estimate import Estimate
from livepde.runs.feeds import Feed
from livepde.runs.journal import Journal
from livepde.streams.intake import Remark

# Without `intake.silence`: usual intervals and seconds after which a source without rows is silent.
SILENT, LEAST_SILENCE = 10.0, 60.0
REFUSED = 20  # rows and values refused in a row, after which a run is not well
UNUSED = frozenset(  # rows and values of no use
    {"malformed", "late", "conflict", "leap", "outside", "skipped"}
)


class Ailments:
    """Faults of a live run, from its events.

    A verdict is no ailment: the process is well while its model is not.

    Attributes
    ----------
    reasons
        Kind -> function that returns the reason why the run is not well, in one sentence, or an
        empty string; /health, the log and the page report the first reason, the metrics its kind.
    unwritten
        Why the journal cannot be written; empty if it can.
    busy
        Whether a step is taken.
    """

    def __init__(
        self,
        feed: Feed,
        journal: Journal,
        last: Callable[[], Estimate | None],
        silence: float | None,
        clock: Callable[[], float],
    ) -> None:
        self.feed, self.journal, self._last = feed, journal, last
        self._stated_silence, self._clock = silence, clock
        self.silent = self.busy = False
        self.unwritten = ""
        self._heard = self._taken = clock()
        self._longest = 0.0  # silence of the source that has ended
        self._refused = self._failed = 0  # in a row
        self._refusal = self._failure = ""
        self._told = "", ""  # kind and reason that were reported last
        self.reasons: dict[str, Callable[[], str]] = {
            "disk": lambda: self.unwritten,
            "journal": self._unlinked,
            "silent": self._silence,
            "clock": lambda: self.feed.doubt,
            "refused": self._refusing,
            "steps": self._failing,
        }

    @property
    def ill(self) -> tuple[str, str]:
        """Kind of the first active ailment and its sentence; empty if there is none.

        While the same ailment lasts, the sentence is that of its beginning.
        """
        kind, why = self._ailing()
        return self._told if kind == self._told[0] else (kind, why)

    def _ailing(self) -> tuple[str, str]:
        found = ((kind, why) for kind, ailment in self.reasons.items() if (why := ailment()))
        return next(found, ("", ""))

    def look(self) -> tuple[str, str] | None:
        """Return kind and sentence of an event if the run's health has changed, else None.

        The sentence is empty after a silence: its end is a separate event.
        """
        (kind, why), before = self._ailing(), self._told[0]
        if kind == before:
            return None
        self._told = kind, why
        if why:
            return "silent" if kind == "silent" else "unwell", why
        return "well", "" if before == "silent" else "recovered"

    def away(self, why: str) -> None:
        """Note that the journal cannot be written."""
        self.unwritten, self._told = why, ("disk", why)

    def back(self) -> None:
        """Note that it can be written again: the source was not polled meanwhile."""
        self.unwritten = ""
        self._heard = self._taken = self._clock()

    def listen(self, heard: bool) -> str:
        """Note whether a row has come; return the report on a silence that ends."""
        now, ended = self._clock(), ""
        if heard:
            if self.silent:
                ended = f"data source reconnected after {now - self._heard:.0f} s"
            self._longest = max(self._longest, now - self._heard)
            self._heard, self.silent = now, False
        elif now - self._heard > self.silence:
            self.silent = True
        return ended

    def remarked(self, remark: Remark) -> None:
        """Note a remark on irregular rows."""
        if remark.kind in UNUSED:
            self.refused(f"{remark.kind}: {remark.message}", remark.number)

    def refused(self, why: str, number: int = 1) -> None:
        """Note rows or values that were refused."""
        self._refused += number
        self._refusal = why

    def failed(self, why: str) -> None:
        """Note a step that has failed."""
        self._failed += 1
        self._failure = why

    def stepped(self, estimate: Estimate) -> None:
        """Note the status of a step."""
        if estimate.status.taken:
            self._taken, self._refused = self._clock(), 0
        if estimate.status.ok:
            self._failed = 0
        else:
            self.failed(str(estimate.status))

    @property
    def silence(self) -> float:
        """Seconds without a row after which the source is reported as silent."""
        if self._stated_silence is not None:
            return self._stated_silence
        # A source that brings a day of rows once a day is silent for a day.
        return max(LEAST_SILENCE, SILENT * self.feed.interval, 2.0 * self._longest)

    def _unlinked(self) -> str:
        if self.journal.in_place:
            return ""
        return (
            "the journal in the run directory was replaced, so new results will be lost when this "
            "process ends: stop it, and run the case into a new folder"
        )

    def _silence(self) -> str:
        if not self.silent:
            return ""
        return f"no data from the source for more than {self.silence:g} s"

    def _refusing(self) -> str:
        waits = not (self.busy or self.feed.done)
        long = waits and self._clock() - self._taken > self.silence
        if not (long or self._refused >= REFUSED):
            return ""
        if not self._refused:
            return f"no sample was accepted for more than {self.silence:g} s"
        return f"rows arrive, but none is accepted; the last one: {self._refusal}"

    def _failing(self) -> str:
        if self._failed > 1:
            return f"the last steps failed; the last one: {self._failure}"
        last = self._last()
        return "" if last is None or last.status.ok else f"the last step: {last.status}"
