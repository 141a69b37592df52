"""A run beside a process: it waits for the first sample, and goes on until it is stopped."""

from __future__ import annotations

import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from livepde.errors import DataError

if TYPE_CHECKING:
    from livepde.cases import Case, Prepared
    from livepde.cases.live import Wiring
    from livepde.result import Estimate
    from livepde.runs import Driven, Journal, RunWriter
    from livepde.runs.live import Live, Sink
    from livepde.streams.intake import Ready

__all__ = ["Beside", "beside"]

LOG = logging.getLogger("livepde.run")
BEAT = 60.0  # seconds between two lines of the log that say how far a run is
LOOK = 0.5  # seconds between two looks at whether to stop
METRICS_PORT = 9100


@dataclass(frozen=True)
class Beside:
    """How a run goes on beside a process.

    Attributes
    ----------
    data
        A file, or lines of JSON, instead of the case's own source.
    speed
        How many times faster than they happened the samples of a finished file are taken.
    listen, page
        Where /health and /metrics, and the page, are served; None: nowhere.
    token
        What visitors have to know.
    estimates
        Print each estimate as a line of JSON.
    """

    data: str | Iterable[str] | None = None
    speed: float = math.inf
    listen: str | None = None
    page: str | None = None
    token: str = ""
    estimates: bool = False


def beside(
    case: Case, how: Beside, folder: Path, write: Callable[[], RunWriter], stack: ExitStack
) -> tuple[RunWriter, tuple[Prepared, Driven] | None]:
    """Run a case in its run directory until its source ends or a signal comes.

    Parameters
    ----------
    write
        Makes the run directory, when the source has been reached.
    stack
        Closes what was opened: the journal, from which the result reads, among it.

    Returns
    -------
    writer, taken
        Of the directory; the case and how far it came, None if it ended before the first sample.
    """
    from livepde.cases.live import Wiring
    from livepde.runs import JOURNAL, Journal, conduct, stopped_by_signals
    from livepde.runs.live import Live

    path, journal = folder / JOURNAL, None
    if path.exists():
        journal = stack.enter_context(Journal.open(path, write=True))
    wiring = Wiring(case, how.data, pace=how.speed, journal=journal)
    stack.callback(wiring.feed.close)
    writer, health = write(), _Health()
    sinks = [*wiring.publishers(), *_observers(case, how, folder, stack, health)]
    for sink in sinks:
        stack.callback(sink.close)
    stopping = threading.Event()
    with stopped_by_signals(stopping, lambda: True):
        begun = _begun(wiring, journal, stopping)
    if begun is None:
        return writer, None
    prepared, waiting = begun
    if journal is None:
        journal = stack.enter_context(prepared.journal(path))
    live = Live(
        prepared.identifier,
        wiring.feed,
        journal,
        sinks=sinks,
        fields_every=case.fields_every,
        backlog=wiring.backlog,
        retention=wiring.retention,
        silence=wiring.silence,
        begun=waiting,
    )
    health.live = live
    again = live.resume()
    if len(live.result):
        LOG.info("goes on after %d samples, %d of them taken again", len(live.result), again)
    return writer, (prepared, conduct(live, patient=True))


def _begun(
    wiring: Wiring, journal: Journal | None, stopping: threading.Event
) -> tuple[Prepared, Sequence[Ready]] | None:
    """Return the case as its first sample finds it, and the samples that wait."""
    from livepde.identifier import Sample

    if journal is not None and journal.first is not None:
        first = journal.first
        return wiring.case.begin(Sample(first.t, first.values), wiring.origin), ()
    LOG.info("waits for the first sample")
    why, told = DataError(f"{wiring.case.frame.path}: no sample came."), ""
    while not (stopping.is_set() or wiring.feed.done):
        found = list(wiring.feed.poll(LOOK))
        while found:
            values = dict.fromkeys(wiring.case.columns, math.nan) | found[0].values
            try:
                return wiring.case.begin(Sample(found[0].t, values), wiring.origin), found
            except DataError as error:
                why = error
            if str(why) != told:
                told = str(why)
                LOG.warning("cannot begin yet: %s", why)
            wiring.feed.acknowledge(found.pop(0))
    if stopping.is_set():
        return None
    raise why


class _Health:
    """What /health says, also before there is a run."""

    live: Live | None = None

    def __call__(self) -> Mapping[str, Any]:
        if self.live is None:
            return {"ok": True, "samples": 0, "status": "waits for the first sample"}
        return self.live.health


class _Heartbeat:
    """Says in the log from time to time how far a run is; a sink."""

    def __init__(self) -> None:
        self._said = -math.inf

    def put(self, estimate: Estimate) -> None:
        now = time.monotonic()
        if now - self._said < BEAT:
            return
        self._said = now
        numbers = estimate.parameters.items()
        shown = ", ".join(f"{label} = {value:.6g} +- {std:.2g}" for label, (value, std) in numbers)
        LOG.info("t = %g: %s", estimate.t, shown or estimate.status.code)

    def close(self) -> None:
        """Nothing is held."""


def _observers(
    case: Case, how: Beside, folder: Path, stack: ExitStack, health: Callable[[], Mapping[str, Any]]
) -> list[Sink]:
    """Start what looks at the run, and return the sinks that it needs."""
    sinks: list[Sink] = [_Heartbeat()]
    if how.estimates:
        from livepde.runs.sinks import JsonLinesSink

        sinks.append(JsonLinesSink(sys.stdout))
    if how.listen is not None:
        from livepde.runs.monitor import Metrics, Monitor
        from livepde.runs.web import Address

        metrics = Metrics(case.sensors)
        monitor = Monitor(Address.read(how.listen, METRICS_PORT, how.token), health, metrics)
        stack.callback(monitor.close)
        LOG.info("health and metrics at %s", monitor.shown)
        sinks.append(metrics)
    if how.page is not None:
        # A process of its own: drawing must not delay steps.
        command = [sys.executable, "-m", "livepde", "watch", str(folder), "--address", how.page]
        secret = {"LIVEPDE_TOKEN": how.token} if how.token else {}
        page = subprocess.Popen(command, stdout=sys.stderr, env={**os.environ, **secret})
        stack.callback(page.wait)
        stack.callback(page.terminate)
    return sinks
