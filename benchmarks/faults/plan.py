"""How much harm is done, and whether that is shown."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

from livepde.progress import watched

__all__ = ["Plan"]

PAUSE = 30.0  # seconds between two lines that say how far it is, where there is no terminal


@dataclass(frozen=True)
class Plan:
    """What `python -m benchmarks faults` was asked for."""

    kills: int
    samples: int
    malformed: int
    flips: int
    seed: int
    progress: bool
    workers: int = 1

    def watched(self, count: int, what: str) -> Iterator[int]:
        """Yield so many numbers, and show how far that is."""
        if not self.progress:
            return iter(range(count))
        if sys.stderr.isatty():
            return watched(range(count), count, what)
        return _told(count, what)


def _told(count: int, what: str) -> Iterator[int]:
    """Yield so many numbers, and say from time to time on standard error how far that is."""
    begun = said = time.monotonic()
    for k in range(count):
        yield k
        now = time.monotonic()
        if now - said > PAUSE or k + 1 == count:
            said, each = now, (now - begun) / (k + 1)
            left = each * (count - k - 1)
            text = f"{what}: {k + 1} of {count}, {1.0 / each:.3g}/s, {left:.0f} s left"
            sys.stderr.write(text + "\n")
