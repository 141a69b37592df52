"""Cost of the journal relative to a step of the soil case, with fields and checkpoints.

Step and journal are timed within one run, sample by sample, so that other load on the machine
affects both.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np

from benchmarks.cases import find_cases
from livepde.cases import load
from livepde.errors import ConfigurationError
from livepde.runs import Check, Outcome, Table
from livepde.runs.feeds import SampleFeed
from livepde.runs.live_loop import Live

CASE = "soil_uniform"
REPETITIONS = 5
BOUND = 0.2  # largest time of the journal over the time of a step
WRITES = ("accept", "append", "keep", "checkpoint", "note", "count", "commit")


class Stopwatch:
    """Accumulates wall-clock and processor time of method calls, in s."""

    def __init__(self) -> None:
        self.wall, self.cpu, self.calls = 0.0, 0.0, 0

    def watch(self, thing: Any, *names: str) -> None:
        """Time all future calls of these methods of an object."""
        for name in names:
            setattr(thing, name, self._timed(getattr(thing, name)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            wall, cpu = perf_counter(), process_time()
            try:
                return method(*arguments, **options)
            finally:
                self.wall += perf_counter() - wall
                self.cpu += process_time() - cpu
                self.calls += 1

        return timed


def journal(folder: Path | None = None, *, repetitions: int | None = None) -> Outcome:
    """Time journal and steps of the soil case.

    Parameters
    ----------
    folder
        Folder of the cases.
    repetitions
        Runs of the case; default `REPETITIONS`.
    """
    count = repetitions or REPETITIONS
    path = next((path for path in find_cases(folder) if path.stem == CASE), None)
    if path is None:
        raise ConfigurationError(f"benchmark journal: there is no case {CASE}.toml.")
    runs = [_run(path) for _ in range(count)]
    ratios = [written.wall / stepped.wall for written, stepped, _, _ in runs]
    chosen = int(np.argsort(ratios)[len(ratios) // 2])
    written, stepped, samples, size = runs[chosen]
    rows = [
        (name, 1e3 * watch.wall / samples, 1e3 * watch.cpu / samples)
        for name, watch in (("step", stepped), ("journal", written))
    ]
    shown = Table(
        f"{CASE}: milliseconds for each of {samples} samples, median of {count} runs",
        ("", "clock", "processor"),
        rows,
    )
    spread = Table(
        "Journal over step, and its size",
        ("min", "median", "max", "bytes a sample"),
        [(min(ratios), ratios[chosen], max(ratios), size / samples)],
    )
    check = Check("journal / step of the soil case", ratios[chosen], BOUND, "<=")
    return Outcome(tables=[shown, spread], checks=[check])


def _run(case: Path) -> tuple[Stopwatch, Stopwatch, int, int]:
    """Return stopwatches of journal and steps, the number of samples, and the size in bytes."""
    loaded = load(case)
    prepared = loaded.prepare()
    identifier = prepared.identifier
    written, stepped = Stopwatch(), Stopwatch()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "journal.sqlite"
        with prepared.journal(file) as kept:
            written.watch(kept, *WRITES)
            stepped.watch(identifier, "step")
            feed = SampleFeed(prepared.stream, identifier.observed.names)
            Live(
                identifier, feed, kept, fields_every=loaded.spec.output.fields_every, strict=True
            ).run()
        return written, stepped, stepped.calls, file.stat().st_size
