"""Options of the fault benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.progress import shown


@dataclass(frozen=True)
class Plan:
    """Amount of each fault, and options of `python -m benchmarks faults`."""

    kills: int
    samples: int
    malformed: int
    flips: int
    seed: int
    progress: bool
    workers: int = 1

    def watched(self, count: int, what: str) -> Iterator[int]:
        """Iterate over range(count), with a progress bar if requested."""
        numbers = range(count)
        return shown(numbers, count, what) if self.progress else iter(numbers)
