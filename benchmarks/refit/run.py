"""Runs of all priors, in several processes."""

from __future__ import annotations

import os
from collections.abc import Sequence

from benchmarks.jobs import each
from benchmarks.refit.jumps import JumpTrial, jump_trials
from benchmarks.refit.problems import PROBLEMS
from benchmarks.refit.report import outcome
from benchmarks.refit.trial import Trial, trial
from livepde.runs import Outcome

JUMPS = "jumps"
PARTS = (*PROBLEMS, JUMPS)
"""Parts of the benchmark: the problems, and jumps of one unknown."""


def refit(
    only: Sequence[str] = (),
    *,
    seeds: int,
    workers: int | None = None,
    progress: bool = False,
) -> Outcome:
    """Run `seeds` priors of each problem, default all of `PARTS`.

    Parameters
    ----------
    seeds
        Priors of each problem; the number of truths with jumps is half of it.
    workers
        Processes; default one for each processor. With 1, fits run in this process.
    """
    # Fewer truths with jumps, since each has two processes, which are run twice.
    jobs = [
        (name, seed)
        for seed in range(seeds)
        for name in (only or PARTS)
        if name != JUMPS or seed % 2 == 0
    ]
    workers = workers or os.cpu_count() or 1
    several = each(_job, jobs, "fits", workers=workers, progress=progress)
    done = [run for _, runs in several for run in runs]
    trials = sorted((r for r in done if isinstance(r, Trial)), key=lambda r: (r.problem, r.seed))
    jumps = sorted((r for r in done if isinstance(r, JumpTrial)), key=lambda r: (r.process, r.seed))
    return outcome(trials, jumps)


def _job(name: str, seed: int) -> Sequence[Trial | JumpTrial]:
    return jump_trials(seed) if name == JUMPS else [trial(name, seed)]
