"""Parts of a fleet in worker processes of a joblib backend; parts of dead workers are retried."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import AbstractContextManager, ExitStack
from enum import StrEnum
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from livepde.errors import ConfigurationError, RunError

Row = TypeVar("Row")
Found = TypeVar("Found")

LARGEST = 256  # members of a part: so many runs are interrupted if a worker dies
ATTEMPTS = 5  # without a part that comes back in between
DEAD_WORKER = {"KilledWorker", "ActorDiedError"}  # what Dask and Ray call it


class Backend(StrEnum):
    """Backends of joblib that livepde can set up by itself."""

    loky = "loky"
    dask = "dask"
    ray = "ray"


def in_parts(
    run: Callable[[Sequence[Row]], Found],
    rows: Sequence[Row],
    jobs: int,
    backend: Backend | None,
    told: list[str],
) -> Iterator[Found]:
    """Run rows in parts of bounded size, and iterate over their results, in any order.

    A part whose worker died is run again; `run` has to resume from its run directories.

    Parameters
    ----------
    run
        Function of the rows of a part; both are sent to workers, where their paths must be valid.
    jobs
        Number of parallel processes; -1 for one on each processor. Dask uses all workers of its
        cluster.
    backend
        Backend of joblib; None: that of the surrounding `joblib.parallel_config`, else loky.
    told
        List that receives a sentence for each loss of a worker.

    Raises
    ------
    ConfigurationError
        joblib or the backend is not installed.
    RunError
        Workers died `ATTEMPTS` times in a row without a finished part in between.
    """
    try:
        from joblib import Parallel, delayed, effective_n_jobs
        from joblib.parallel import get_active_backend
    except ImportError as error:
        raise ConfigurationError(
            "--jobs requires joblib: pip install 'livepde[fleet]'. Without --jobs, members run one "
            "after the other."
        ) from error
    with ExitStack() as stack:
        if backend is not None:
            _configure(backend, stack)
        jobs = min(effective_n_jobs(jobs), len(rows))
        count = max(jobs, -(-len(rows) // LARGEST))
        parts = {k: rows[k::count] for k in range(count)}
        lost = 0
        while parts:
            tasks = [delayed(_attempt)(run, k, part) for k, part in parts.items()]
            soon = get_active_backend()[0].supports_return_generator  # Ray gives all at the end
            how = "generator_unordered" if soon else "list"
            parallel = Parallel(n_jobs=jobs, batch_size=1, return_as=how)
            try:
                for k, found in parallel(tasks):
                    del parts[k]
                    lost = 0
                    yield found
            except Exception as error:
                if not _died(error):
                    raise
                lost += 1
                members = sum(map(len, parts.values()))
                what = (
                    f"A worker process died (killed or out of memory), {members} members unfinished"
                )
                if lost == ATTEMPTS:
                    raise RunError(f"{what}, {lost} times in a row without progress.") from error
                told.append(f"{what}. They were resumed from their run directories.")


def _attempt(
    run: Callable[[Sequence[Row]], Found], k: int, part: Sequence[Row]
) -> tuple[int, Found]:
    with threadpool_limits(1):
        return k, run(part)


def _died(error: Exception) -> bool:
    """Return whether an exception of a backend means a dead worker: killed, or out of memory."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ in DEAD_WORKER


def _configure(backend: Backend, stack: ExitStack) -> None:
    """Configure the backend of joblib until the stack is closed."""
    from joblib import parallel_config

    if backend is Backend.ray:
        try:
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise ConfigurationError(
                "--backend ray needs Ray: pip install ray, here and on its nodes."
            ) from error
        register_ray()  # type: ignore[no-untyped-call,unused-ignore]
    if backend is Backend.dask:
        try:
            import distributed
        except ImportError as error:
            raise ConfigurationError(
                "--backend dask needs Dask: pip install 'dask[distributed]', here and on its "
                "workers."
            ) from error
        dask: Any = distributed  # without types
        # Of DASK_SCHEDULER_ADDRESS, or of its own.
        client: AbstractContextManager[Any] = dask.Client()
        stack.enter_context(client)
    stack.enter_context(parallel_config(backend=backend.value))
