"""The loop of a run: every sample through the identifier, until the stream or the user ends it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from livepde.errors import DataError
from livepde.identifier import Identifier, Sample
from livepde.result import Result

__all__ = ["Driven", "drive"]


@dataclass
class Driven:
    """How far a run came.

    Attributes
    ----------
    result
        Estimates so far.
    status
        "finished", "interrupted" (Ctrl-C) or "failed" (a sample that cannot be used).
    error
        Why it failed.
    """

    result: Result
    status: str = "finished"
    error: DataError | None = None


@dataclass
class _Breaker:
    """Ctrl-C ends a run between two samples: a step is never cut in half."""

    asked: bool = False
    busy: bool = False

    def handle(self, number: int, frame: FrameType | None) -> None:
        if self.asked or not self.busy:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def _breaker() -> Iterator[_Breaker]:
    breaker = _Breaker()
    if threading.current_thread() is not threading.main_thread():
        yield breaker
        return
    previous = signal.signal(signal.SIGINT, breaker.handle)
    try:
        yield breaker
    finally:
        signal.signal(signal.SIGINT, previous)


def drive(
    identifier: Identifier,
    stream: Iterable[Sample],
    *,
    progress: bool = False,
    total: int | None = None,
    fields_every: int = 1,
) -> Driven:
    """Run an identifier on a stream; what was reached is returned also if it ends early.

    Parameters
    ----------
    progress
        Show a bar with rate and time left, on a terminal.
    total
        Number of samples, for the time left.
    fields_every
        Keep fields of every so many samples.
    """
    from livepde.progress import watched

    result = Result.empty(identifier.model, identifier.observed, identifier.withheld, fields_every)
    driven = Driven(result)
    with _breaker() as breaker:
        try:
            for sample in watched(stream, total) if progress else stream:
                breaker.busy = True
                result.add(identifier.step(sample.t, sample.z, sample.inputs))
                breaker.busy = False
                if breaker.asked:
                    driven.status = "interrupted"
                    break
        except KeyboardInterrupt:
            driven.status = "interrupted"
        except DataError as error:
            driven.status, driven.error = "failed", error
    return driven
