"""Progress of a benchmark: a bar on a terminal, and periodic lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from livepde.progress import watched

T = TypeVar("T")

PAUSE = 30.0  # seconds between two lines


def shown(stream: Iterable[T], total: int, what: str) -> Iterator[T]:
    """Yield the items of a stream, and show progress on standard error."""
    return watched(stream, total, what) if sys.stderr.isatty() else _lines(stream, total, what)


def _lines(stream: Iterable[T], total: int, what: str) -> Iterator[T]:
    begun = printed = time.monotonic()
    for k, item in enumerate(stream, 1):
        yield item
        now = time.monotonic()
        if now - printed > PAUSE or k == total:
            printed, each = now, (now - begun) / k
            text = f"{what}: {k} of {total}, {1.0 / each:.3g}/s, {each * (total - k):.0f} s left"
            sys.stderr.write(text + "\n")
