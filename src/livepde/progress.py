"""A progress bar with rate and time left; silent where standard error is not a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Console


def watched(
    stream: Iterable[Any], total: int | None = None, what: str = "samples"
) -> Iterator[Any]:
    """Yield the items of a stream behind a bar on standard error; `total`: default its length."""
    if total is None:
        total = getattr(stream, "__len__", lambda: None)()
    console = Console(stderr=True)
    if not console.is_terminal:
        yield from stream
        return
    from rich import progress  # not before somebody looks

    class Rate(progress.ProgressColumn):
        def render(self, task: progress.Task) -> str:
            return f"{task.speed:.0f}/s" if task.speed else ""

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        Rate(),
        progress.TimeRemainingColumn(),
    )
    with progress.Progress(*columns, console=console, transient=True) as bar:
        yield from bar.track(stream, total=total, description=what)
