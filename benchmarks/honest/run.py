"""All twins, in several processes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from benchmarks.honest.noise import KINDS
from benchmarks.honest.problems import PROBLEMS
from benchmarks.honest.report import outcome
from benchmarks.honest.twin import Run, twins
from livepde.progress import watched
from livepde.runs.outcome import Outcome

__all__ = ["QUICK", "honest"]

QUICK = ("rod", "flux", "column", "borehole")
"""Problems of the quick run."""


def honest(
    only: Sequence[str] = (),
    kinds: Sequence[str] = (),
    *,
    seeds: int,
    workers: int | None = None,
    progress: bool = False,
) -> Outcome:
    """Run the twins of problems and kinds, default all of them.

    Parameters
    ----------
    seeds
        Twins of each problem.
    workers
        Processes; default one for each processor. One runs in this process.
    """
    kinds = [kind for kind in KINDS if kind in (kinds or KINDS)]
    todo = [(name, seed) for seed in range(seeds) for name in (only or PROBLEMS)]
    stream = _all(todo, kinds, workers or os.cpu_count() or 1)
    found = watched(stream, len(todo), "twins") if progress else stream
    runs = [run for several in found for run in several]
    return outcome(sorted(runs, key=lambda run: (run.problem, run.kind, run.seed)))


def _all(
    todo: Sequence[tuple[str, int]], kinds: Sequence[str], workers: int
) -> Iterator[list[Run]]:
    if workers == 1:
        for name, seed in todo:
            yield twins(name, seed, kinds)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(twins, *item, kinds) for item in todo]):
            yield future.result()
