"""How much harm is done, and whether that is shown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from livepde.progress import watched

__all__ = ["Plan"]


@dataclass(frozen=True)
class Plan:
    """What `python -m benchmarks faults` was asked for."""

    kills: int
    samples: int
    malformed: int
    flips: int
    seed: int
    progress: bool

    def watched(self, count: int, what: str) -> Iterator[int]:
        return watched(range(count), count, what) if self.progress else iter(range(count))
