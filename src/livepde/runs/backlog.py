"""Policies of a live run for excess samples and old records, and the interface of sinks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from livepde.estimate import Estimate
from livepde.streams.intake import Ready


class Sink(Protocol):
    """A destination of estimates."""

    def put(self, estimate: Estimate) -> None:
        """Accept an estimate."""

    def close(self) -> None:
        """Release the resources of the sink."""
        return


@dataclass(frozen=True)
class Backlog:
    """Policy for samples that arrive faster than they are processed.

    Parameters
    ----------
    overflow
        "queue": all samples wait, and samples beyond `length` stay at the source. "merge": the
        oldest samples are merged into one, with the mean of each channel and the last time.
        "drop": the oldest samples are dropped. Merged and dropped samples are counted.
    length
        Maximum number of waiting samples.
    """

    overflow: Literal["queue", "merge", "drop"] = "queue"
    length: int = 1000

    def relieved(self, waiting: deque[Ready]) -> list[Ready]:
        """Shorten the queue to `length`; return the samples that were merged or dropped."""
        excess = len(waiting) - self.length
        if self.overflow == "queue" or excess <= 0:
            return []
        oldest = [waiting.popleft() for _ in range(excess)]
        if self.overflow == "merge":
            waiting.appendleft(_merged([*oldest, waiting.popleft()]))
        return oldest

    def has_room(self, waiting: deque[Ready]) -> bool:
        """Return whether more rows should be polled from the source."""
        return self.overflow != "queue" or len(waiting) < self.length


@dataclass(frozen=True)
class Retention:
    """Retention policy of a journal.

    Parameters
    ----------
    span
        Duration, in model time, for which all records are kept.
    every
        One in `every` older estimates is kept; older samples and fields are deleted.
    """

    span: float = math.inf
    every: int = 1


def _merged(samples: Sequence[Ready]) -> Ready:
    values: dict[str, list[float]] = {}
    for sample in samples:
        for channel, value in sample.values.items():
            if np.isfinite(value):
                values.setdefault(channel, []).append(value)
    mean = {channel: float(np.mean(several)) for channel, several in values.items()}
    tokens = [token for sample in samples for token in sample.tokens]
    return Ready(t=samples[-1].t, values=mean, tokens=tokens)
