"""Health of a live run: detects a full disk, a silent source and unusable rows."""

from __future__ import annotations

from collections.abc import Callable

from livepde.estimate import Estimate
from livepde.runs.feeds import Feed
from livepde.runs.journal import Journal
from livepde.streams.intake import Remark

# Defaults for `intake.silence`: a source is silent after 10 usual intervals, at least 60 s.
SILENT, LEAST_SILENCE = 10.0, 60.0
REFUSED = 20  # consecutive refused rows and values after which a run is unhealthy
UNUSED = frozenset(  # kinds of remarks on unusable rows and values
    {"malformed", "late", "conflict", "leap", "outside", "skipped"}
)


class Ailments:
    """Faults of a live run, detected from its events.

    A verdict is not an ailment: a healthy run may have a poor model.

    Attributes
    ----------
    reasons
        Kind -> function that returns why the run is unhealthy, in one sentence, or an empty string.
        /health, the log and the page report the first reason, the metrics its kind.
    unwritten
        Why the journal cannot be written; empty if it can be written.
    busy
        Whether a step is in progress.
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
        self._longest = 0.0  # longest interval between rows so far
        self._refused = self._failed = 0  # consecutive refusals and failures
        self._refusal = self._failure = ""
        self._told = "", ""  # kind and reason of the last report
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
        """Kind and sentence of the first active ailment; both are empty in a healthy run.

        The sentence does not change while the same ailment lasts.
        """
        kind, why = self._ailing()
        return self._told if kind == self._told[0] else (kind, why)

    def _ailing(self) -> tuple[str, str]:
        found = ((kind, why) for kind, ailment in self.reasons.items() if (why := ailment()))
        return next(found, ("", ""))

    def look(self) -> tuple[str, str] | None:
        """Return the kind and sentence of an event if the health has changed, else None.

        The sentence is empty at the end of a silence, which has a separate event.
        """
        (kind, why), before = self._ailing(), self._told[0]
        if kind == before:
            return None
        self._told = kind, why
        if why:
            return "silent" if kind == "silent" else "unwell", why
        return "well", "" if before == "silent" else "recovered"

    def away(self, why: str) -> None:
        """Record that the journal cannot be written."""
        self.unwritten, self._told = why, ("disk", why)

    def back(self) -> None:
        """Record that the journal can be written again, and restart the timers of the source."""
        self.unwritten = ""
        self._heard = self._taken = self._clock()

    def listen(self, heard: bool) -> str:
        """Record whether a row has arrived; return the message at the end of a silence."""
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
        """Record a remark on irregular rows."""
        if remark.kind in UNUSED:
            self.refused(f"{remark.kind}: {remark.message}", remark.number)

    def refused(self, why: str, number: int = 1) -> None:
        """Record refused rows or values."""
        self._refused += number
        self._refusal = why

    def failed(self, why: str) -> None:
        """Record a failed step."""
        self._failed += 1
        self._failure = why

    def stepped(self, estimate: Estimate) -> None:
        """Record the status of a step."""
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
        # A source that delivers its rows in daily batches is silent for a day each time.
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
