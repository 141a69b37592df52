"""Loop of a benchmark over its jobs, in one or several processes, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any, TypeVar

from livepde.progress import watched

Job = TypeVar("Job", bound=tuple[Any, ...])
T = TypeVar("T")


def each(
    run: Callable[..., T],
    jobs: Sequence[Job],
    what: str,
    *,
    workers: int = 1,
    progress: bool = False,
) -> Iterator[tuple[Job, T]]:
    """Yield each job with its result.

    Parameters
    ----------
    run
        Function that is called with the items of a job; for several workers, it must be picklable.
    jobs
        Arguments of the calls.
    what
        Label of the bar.
    workers
        Number of processes. With several, results are yielded as they complete, else in order.
    progress
        Show a bar on standard error.
    """
    done = _here(run, jobs) if workers == 1 else _in_processes(run, jobs, workers)
    yield from watched(done, len(jobs), what) if progress else done


def _here(run: Callable[..., T], jobs: Sequence[Job]) -> Iterator[tuple[Job, T]]:
    for job in jobs:
        yield job, run(*job)


def _in_processes(
    run: Callable[..., T], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[Job, T]]:
    # Workers start with a new interpreter, so that they inherit no threads from this process.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        waiting = {pool.submit(run, *job): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()
