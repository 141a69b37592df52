"""Run an identifier on a stream until the stream ends or the user interrupts it."""

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
        Journal of the samples and estimates.
    status
        "finished", "interrupted" (Ctrl-C) or "failed" (a sample that cannot be used).
    error
        Error that made the run fail.
    """

    result: Result
    journal: Journal
    status: str = "finished"
    error: DataError | None = None


@contextmanager
def stopped_by_signals(stopping: threading.Event, busy: Callable[[], bool]) -> Iterator[None]:
    """Set an event on Ctrl-C or SIGTERM, so that the current step is completed.

    Raises `KeyboardInterrupt`: at a signal while `busy()` is false, or at the second signal.
    """
    # Python allows signal handlers in the main thread only.
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
    """Run until the source ends or a signal arrives; samples and estimates are kept in any case.

    Parameters
    ----------
    patient
        The source never blocks for long, so a signal may wait until a poll of it has ended.
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
    """Run an identifier on a stream; estimates are returned even if the run ends early.

    Parameters
    ----------
    progress
        Show a progress bar with rate and remaining time on a terminal.
    total
        Number of samples, from which the remaining time is estimated.
    fields_every
        Interval, in samples, at which fields are kept.
    journal
        Journal to write, continued if it contains samples; default: a new journal in memory.
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
    """Return a new journal for an identifier, in a file or, without a path, in memory."""
    model, observed = identifier.model, identifier.observed
    layout = layout_of(model, observed, identifier.validation, identifier.ignored)
    return Journal.create(path, identifier.channels, layout)


def _ends(stream: Any) -> bool:
    """Return whether a stream is finite: a live stream has no length."""
    try:
        len(stream)
    except TypeError:  # raised by the stream, or by a stream that it wraps
        return False
    return True
