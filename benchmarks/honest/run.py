"""Runs of all twins, in several processes."""

from __future__ import annotations

import os
from collections.abc import Sequence

from benchmarks.honest.noise import KINDS
from benchmarks.honest.problems import PROBLEMS
from benchmarks.honest.report import outcome
from benchmarks.honest.twin import twins
from benchmarks.jobs import each
from livepde.runs import Outcome

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
        Number of twins of each problem.
    workers
        Processes; default one for each processor. With 1, twins run in this process.
    """
    kinds = [kind for kind in KINDS if kind in (kinds or KINDS)]
    todo = [(name, seed, kinds) for seed in range(seeds) for name in (only or PROBLEMS)]
    done = each(twins, todo, "twins", workers=workers or os.cpu_count() or 1, progress=progress)
    runs = [run for _, several in done for run in several]
    return outcome(sorted(runs, key=lambda run: (run.problem, run.kind, run.seed)))
