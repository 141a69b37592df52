"""Table of peers, each of which runs in a separate process, and checks of the comparison."""

from __future__ import annotations

import contextlib
import io
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context

import numpy as np

from benchmarks import accuracy
from benchmarks.peers import arrays
from benchmarks.peers.filters import ensemble, unscented
from benchmarks.peers.horizon import moving_horizon
from benchmarks.peers.network import network
from benchmarks.problems import PROBLEMS as ALL
from benchmarks.problems import Data, Problem
from benchmarks.problems.rod import ROD, ROD_SOURCE
from benchmarks.processes import peak_memory
from benchmarks.scoring import Contender, Results, Score, scored
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import LivepdeError
from livepde.laws import SensitivityLaw
from livepde.progress import watched
from livepde.runs import Outcome

PROBLEMS: Mapping[str, Problem] = {
    **{problem.name: problem for problem in (ROD, ROD_SOURCE)},
    **{name: problem for name, problem in ALL.items() if None not in problem.levels},
}
"""Problems with a known truth."""


@dataclass(frozen=True)
class Peer:
    """Estimator of another package.

    Attributes
    ----------
    packages
        Import names of the required packages.
    run
        Contender that runs the estimator.
    """

    packages: tuple[str, ...]
    run: Contender

    @property
    def missing(self) -> tuple[str, ...]:
        """Required packages that are not installed."""
        return tuple(name for name in self.packages if find_spec(name) is None)


def _filter_alone(data: Data) -> Score | None:
    law = SensitivityLaw(modes=data.modes, refit=None, shadows=None, verdict=False)
    return accuracy.run_law(data, data.observation, law)


PEERS: dict[str, Peer] = {
    # Comparable with the filters below: no verdict, no refit, no discretisation errors.
    "sensitivity, filter alone": Peer((), _filter_alone),
    **{
        f"EnKF as arrays, {members} members": Peer((), partial(arrays.ensemble, members))
        for members in (20, 50)
    },
    "unscented filter as arrays": Peer((), arrays.unscented),
    "lean reference": Peer((), arrays.reference),
    **{
        f"DAPPER, one by one: EnKF, {members} members": Peer(
            ("dapper",), partial(ensemble, members)
        )
        for members in (20, 50, 100)
    },
    "filterpy, one by one: unscented filter": Peer(("filterpy",), unscented),
    "do-mpc: moving horizon": Peer(("do_mpc", "casadi"), moving_horizon),
    "DeepXDE: network": Peer(("deepxde", "torch"), network),
}
"""Row -> peer. Filters "as arrays" are written in this project, as a user would write them."""


OURS = (
    "prior",
    "sensitivity",
    "gradient, auto",
    accuracy.ALL_DATA,
    accuracy.EACH_SAMPLE,
)
ROWS = (*OURS, *PEERS)
LEVEL = 0.01
MINE = "sensitivity"  # row whose promises are checked
RIVAL = "EnKF as arrays, 20 members"  # must cost more than `MINE` if it is not more accurate
LEAST_WORK = {"do-mpc: moving horizon": 50.0}
"""Peer -> smallest ratio of its cost to the cost of `MINE`."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress output and warnings of packages at import."""
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


def run_row(problem: Problem, level: float | None, seed: int, row: str) -> Score | None:
    """Run one row on one data set in this process."""
    peer = PEERS.get(row)
    if peer is not None and peer.missing:
        return Score(note=f"not installed: {', '.join(peer.missing)}")
    data = problem.data(level, seed)
    data.forward  # noqa: B018 (its memory does not count as the contender's)
    with _quiet():
        for package in peer.packages if peer is not None else ():
            __import__(package)
        before = peak_memory(reset=True)
        score = scored(accuracy.ROWS[row] if peer is None else peer.run, data)
    return None if score is None else replace(score, megabytes=(peak_memory() - before) / 2**20)


def _job(name: str, level: float | None, seed: int, row: str) -> Score | None:
    return run_row(PROBLEMS[name], level, seed, row)


def peers(
    only: Sequence[str] = (),
    seeds: int = 1,
    *,
    levels: Sequence[float] = (LEVEL,),
    rows: Sequence[str] = (),
    progress: bool = False,
) -> Outcome:
    """Run our laws and the peers on the same data, each row in a new process.

    Parameters
    ----------
    only
        Names of problems; default all with a known truth.
    seeds
        Data sets for each noise level.
    levels
        Noise levels.
    rows
        Names of rows; default all. The prior always runs, because its error is the unit of errors.
    progress
        Show a bar on standard error.
    """
    chosen = [row for row in ROWS if not rows or row in ("prior", *rows)]
    jobs = [
        (name, level, seed, row)
        for name in only or PROBLEMS
        for level in PROBLEMS[name].chosen(levels)
        for seed in range(seeds)
        for row in chosen
    ]
    results: Results = {}
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
                results.setdefault((name, level, row), []).append(score)
    return Outcome(tables=_tables(results), checks=_checks(results), notes=NOTES)


def _relative(results: Results, at: tuple[str, float | None], row: str) -> list[float]:
    """Return the error of a row over the error of the prior, for each data set with an error."""
    scores, priors = results.get((*at, row), []), results.get((*at, "prior"), [])
    if not scores:
        return []
    pairs = zip(scores, priors, strict=True)
    shares = [score.error / prior.error for score, prior in pairs]
    return [share for share in shares if math.isfinite(share)]


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _tables(results: Results) -> list[Table]:
    """Return a table for each problem, with a row for each noise level and contender."""
    tables = []
    for name in dict.fromkeys(key[0] for key in results):
        lines, most = [], 0
        for (problem, level, row), scores in results.items():
            if problem != name:
                continue
            shares, most = _relative(results, (problem, level), row), max(most, len(scores))
            cells = [
                _mean(shares),
                float(np.std(shares)) if shares else math.nan,
                _mean([score.covered for score in scores]),
                _mean([score.whole for score in scores]),
                _mean([score.median for score in scores]),
                _mean([score.megabytes for score in scores]),
            ]
            notes = "; ".join(dict.fromkeys(score.note for score in scores if score.note))
            shown = ["–" if math.isnan(cell) else cell for cell in cells]
            lines.append([f"{level:.0%}", row, *shown, sum(s.failed for s in scores), notes])
        columns = ["noise", "estimator", "error", "spread", "covered", "mean", "median", "MB"]
        title = f"{name}, {most} seed{'s' if most > 1 else ''}"
        tables.append(Table(title, [*columns, "failed steps", "note"], lines))
    return tables


def _checks(results: Results) -> list[Check]:
    """Return the checks: our cost is smaller than a peer's if our error is not larger."""
    checks = []
    for problem, level, peer in results:
        at = (problem, level)
        mine, other = (_mean(_relative(results, at, row)) for row in (MINE, peer))
        costs = [_mean([s.whole for s in results.get((*at, row), ())]) for row in (MINE, peer)]
        name = f"{problem}, {level:.0%} noise"
        if peer == RIVAL and mine <= other:
            work = f"{name}: cost of '{MINE}' over '{peer}'"
            checks.append(Check(work, costs[0] / costs[1], 1.0, "<="))
        if peer in LEAST_WORK and math.isfinite(mine / other):
            error = f"{name}: error of '{MINE}' over '{peer}'"
            work = f"{name}: cost of '{peer}' over '{MINE}'"
            checks.append(Check(error, mine / other, 1.0, "<="))
            checks.append(Check(work, costs[1] / costs[0], LEAST_WORK[peer], ">="))
    return checks


NOTES = (
    "All estimators have the same model, samples, prior, reduced coordinates and noise level. "
    "Peers use the setting with the smallest true error on the same data set (see note).",
    "error: error of the parameter over the error of the prior; mean and standard deviation "
    "(spread) over data sets.",
    "mean, median: processor time of a sample over a forward step with a stored factorisation; the "
    "mean includes the first sample. MB: peak memory in addition to data and imported packages.",
    "as arrays: all members are stepped as one block with NumPy and LAPACK. one by one: a Python "
    "loop over members calls our forward model, which costs more than the method itself.",
)
