"""Progress bars on standard error, if it is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from time import monotonic
from typing import Any

from rich.console import Console


def watched(
    stream: Iterable[Any], total: int | None = None, what: str = "samples"
) -> Iterator[Any]:
    """Yield the items of a stream and show a progress bar; `total` defaults to its length."""
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


@contextmanager
def timed(
    names: Sequence[str], quiet: bool = False
) -> Iterator[Callable[[int], AbstractContextManager[None]]]:
    """Show a line with a clock for each name; yield a function: index -> context that runs it.

    Several clocks may run at once, each in its own thread. If standard error is no terminal, as in
    a batch job, a line is written for each name that has ended. With `quiet` nothing is shown.
    """
    console = Console(stderr=True)
    if quiet:
        yield lambda _: nullcontext()
        return
    if not console.is_terminal:
        yield lambda index: _logged(console, names[index])
        return
    from rich import progress  # not before somebody looks

    columns = (
        progress.SpinnerColumn(finished_text="✓"),
        progress.TextColumn("{task.description}", markup=False),
        progress.TimeElapsedColumn(),
    )
    with progress.Progress(*columns, console=console, transient=True) as shown:
        tasks = [shown.add_task(name, start=False, total=1) for name in names]

        @contextmanager
        def running(index: int) -> Iterator[None]:
            shown.start_task(tasks[index])
            try:
                yield
            finally:
                shown.advance(tasks[index])

        yield running


@contextmanager
def _logged(console: Console, name: str) -> Iterator[None]:
    """Write a line with a name and the time that the context took."""
    begun = monotonic()
    yield
    text = f"{name}: {monotonic() - begun:.0f} s"
    console.print(text, markup=False, highlight=False, soft_wrap=True)
