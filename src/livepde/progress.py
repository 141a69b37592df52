"""A progress bar with rate and time left; silent where standard error is not a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

__all__ = ["watched"]


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.0f}/s" if task.speed else "")


def watched(stream: Iterable[Any], total: int | None, what: str = "samples") -> Iterator[Any]:
    """Yield the items of a stream behind a bar on standard error."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
    )
    if not console.is_terminal:
        yield from stream
        return
    with Progress(*columns, console=console, transient=True) as bar:
        yield from bar.track(stream, total=total, description=what)
