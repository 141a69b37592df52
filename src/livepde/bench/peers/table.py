"""The table of peers: who they are, each run in a process of its own, what is promised of them."""

from __future__ import annotations

import contextlib
import io
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path

from livepde.bench import accuracy
from livepde.bench.peers.filters import ensemble, unscented
from livepde.bench.peers.horizon import moving_horizon
from livepde.bench.peers.network import network
from livepde.bench.problems import PROBLEMS, Problem
from livepde.bench.scoring import (
    Contender,
    Found,
    Score,
    error_ratio,
    scored,
    step_ratio,
    table_of,
)
from livepde.errors import LivepdeError
from livepde.progress import watched
from livepde.runs.outcome import Check, Outcome

__all__ = ["PEERS", "Peer", "peers"]


@dataclass(frozen=True)
class Peer:
    """Another package's estimator.

    Attributes
    ----------
    packages
        What has to be installed: names to import.
    run
        Its contender.
    """

    packages: tuple[str, ...]
    run: Contender

    @property
    def missing(self) -> tuple[str, ...]:
        """Packages that are not installed."""
        return tuple(name for name in self.packages if find_spec(name) is None)


PEERS: dict[str, Peer] = {
    **{
        f"DAPPER: EnKF, {members} members": Peer(("dapper",), partial(ensemble, members))
        for members in (20, 50, 100)
    },
    "filterpy: unscented filter": Peer(("filterpy",), unscented),
    "do-mpc: moving horizon": Peer(("do_mpc", "casadi"), moving_horizon),
    "DeepXDE: network": Peer(("deepxde", "torch"), network),
}
"""Row -> peer."""

OURS = (
    "prior",
    "sensitivity",
    "sensitivity, replay",
    "sensitivity, auto",
    accuracy.ALL_DATA,
    accuracy.EACH_SAMPLE,
)
LEVEL = 0.01
MINE = "sensitivity"  # the row of which the promises below are checked
LEAST_WORK = {"DAPPER: EnKF, 50 members": 20.0, "do-mpc: moving horizon": 50.0}
"""Peer -> how many times the work of our step it takes."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what packages print and warn of at import to themselves."""
    os.environ.setdefault("MPLBACKEND", "agg")
    os.environ.setdefault("DDE_BACKEND", "pytorch")
    nowhere = io.StringIO()
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        warnings.simplefilter("ignore")
        yield


def _peak(reset: bool = False) -> float:
    """Return the largest memory of this process so far in MB, or since a reset; NaN if unknown."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    return next((int(row.split()[1]) / 1024 for row in lines if row.startswith("VmHWM")), math.nan)


def run_row(problem: Problem, level: float | None, seed: int, row: str) -> Score | None:
    """Run one row on one data set, in the process that calls."""
    peer = PEERS.get(row)
    if peer is not None and peer.missing:
        return Score(note=f"not installed: {', '.join(peer.missing)}")
    data = problem.data(level, seed)
    data.forward  # noqa: B018 (what it needs is not the contender's memory)
    with _quiet():
        for package in peer.packages if peer is not None else ():
            __import__(package)
        before = _peak(reset=True)
        score = scored(accuracy.ROWS[row] if peer is None else peer.run, data)
    return None if score is None else replace(score, megabytes=_peak() - before)


def _job(name: str, level: float | None, seed: int, row: str) -> Score | None:
    return run_row(PROBLEMS[name], level, seed, row)


def peers(
    only: Sequence[str] = (),
    seeds: int = 1,
    *,
    levels: Sequence[float] = (LEVEL,),
    progress: bool = False,
) -> Outcome:
    """Run our sensitivity law and the peers on the same data, each row in a fresh process.

    Parameters
    ----------
    only
        Names of problems; default all that have a known truth.
    seeds
        Data sets for each noise level.
    levels
        Noise levels.
    progress
        Show a bar on standard error.
    """
    names = list(only) or [name for name, item in PROBLEMS.items() if None not in item.levels]
    jobs = [
        (name, level, seed, row)
        for name in names
        for level in PROBLEMS[name].chosen(levels)
        for seed in range(seeds)
        for row in (*OURS, *PEERS)
    ]
    found: Found = {}
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        waiting = [pool.submit(_job, *job) for job in jobs]
        pairs = list(zip(jobs, waiting, strict=True))
        for (name, level, _, row), future in (
            watched(pairs, len(pairs), "runs") if progress else pairs
        ):
            try:
                score = future.result()
            except (LivepdeError, ArithmeticError, RuntimeError, ValueError) as error:
                score = Score(note=f"{type(error).__name__}: {error}")
            if score is not None:
                found.setdefault((name, level, row), []).append(score)
    tables = table_of(found, limit=accuracy.EACH_SAMPLE, memory=True)
    return Outcome(tables=tables, checks=_checks(found), notes=NOTES)


def _checks(found: Found) -> list[Check]:
    """Return the promises: less work than the peers, at equal or better accuracy."""
    checks = []
    for problem, level, peer in found:
        work = step_ratio(found, (problem, level), peer, MINE)
        if peer not in LEAST_WORK or math.isnan(work):
            continue
        error = error_ratio(found, (problem, level), MINE, peer)
        at = problem if level is None else f"{problem}, {level:.0%} noise"
        checks.append(Check(f"{at}: error of '{MINE}' over '{peer}'", error, 1.0, "<="))
        checks.append(Check(f"{at}: work of '{peer}' over '{MINE}'", work, LEAST_WORK[peer], ">="))
    return checks


NOTES = (
    "Same model, samples, prior, reduced coordinates and noise level for all; knobs of peers are "
    "set to the best of those tried, with the truth of the very data set (see note).",
    "step: processor time of a step over that of a forward step with the matrix kept, at the best "
    "setting. MB: memory needed on top of what data and imported packages take.",
    "The ensemble filters use DAPPER's analysis in a plain loop, without its statistics.",
)
