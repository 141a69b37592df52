"""The loop of a run: every sample through the identifier, until the stream or the user ends it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from livepde.errors import DataError
from livepde.frames import layout_of
from livepde.identifier import Identifier
from livepde.result import Result
from livepde.runs.feeds import SampleFeed
from livepde.runs.journal import Journal
from livepde.runs.live_loop import Live
from livepde.samples import Sample


@dataclass
class Driven:
    """Result, journal and status of a run.

    Attributes
    ----------
    result
        Estimates so far.
    journal
        The journal that holds samples and estimates.
    status
        "finished", "interrupted" (Ctrl-C) or "failed" (a sample that cannot be used).
    error
        Reason of the failure.
    """

    result: Result
    journal: Journal
    status: str = "finished"
    error: DataError | None = None


@contextmanager
def stopped_by_signals(stopping: threading.Event, busy: Callable[[], bool]) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM set an event; when idle, or the second time, raise at once.

    Raises `KeyboardInterrupt`: while no step is computed, or at the second signal.
    """
    # Python allows handlers of signals in the main thread only.
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        if stopping.is_set() or not busy():
            raise KeyboardInterrupt
        stopping.set()

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def conduct(live: Live, *, patient: bool = False) -> Driven:
    """Run until the source or a signal ends it; samples and estimates are kept in any case.

    Parameters
    ----------
    patient
        The source never blocks for long: a signal is heard when it has answered.
    """
    driven = Driven(live.result, live.journal)
    with stopped_by_signals(live.stopping, lambda: patient or live.ailments.busy):
        try:
            live.run()
            if live.stopping.is_set():
                driven.status = "interrupted"
        except KeyboardInterrupt:
            driven.status = "interrupted"
        except DataError as error:
            driven.status, driven.error = "failed", error
        finally:
            driven.result = live.result
    return driven


def drive(
    identifier: Identifier,
    stream: Iterable[Sample],
    *,
    progress: bool = False,
    total: int | None = None,
    fields_every: int = 1,
    journal: Journal | None = None,
) -> Driven:
    """Run an identifier on a stream; return the estimates so far also if it ends early.

    Parameters
    ----------
    progress
        Show a bar with rate and time left, on a terminal.
    total
        Number of samples, for the time left.
    fields_every
        Keep fields of every so many samples.
    journal
        The journal to write, and to continue if it holds samples; default: a new one in memory.
    """
    from livepde.progress import watched

    journal = journal_of(identifier) if journal is None else journal
    feed = SampleFeed(
        watched(stream, total) if progress else stream, identifier.observed.names, journal.last
    )
    live = Live(
        identifier, feed, journal, fields_every=fields_every, strict=True, waits=not _ends(stream)
    )
    with stopped_by_signals(live.stopping, lambda: True):
        live.resume()
    return conduct(live)


def journal_of(identifier: Identifier, path: Path | None = None) -> Journal:
    """Return a new journal for the samples and estimates of an identifier; no path: in memory."""
    model, observed = identifier.model, identifier.observed
    layout = layout_of(model, observed, identifier.validation, identifier.ignored)
    return Journal.create(path, identifier.channels, layout)


def _ends(stream: Any) -> bool:
    """Return whether a stream is finite: a live one has no length."""
    try:
        len(stream)
    except TypeError:  # of it, or of a stream that it wraps
        return False
    return True
