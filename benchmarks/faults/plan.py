"""How much harm is done, and whether that is shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.progress import shown


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
        numbers = range(count)
        return shown(numbers, count, what) if self.progress else iter(numbers)
