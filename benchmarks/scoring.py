"""Scores of contenders: errors and coverage relative to the truth, and costs of steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from time import process_time
from typing import TypeAlias

import numpy as np

from benchmarks.offline import Trajectory
from benchmarks.problems import WARM_UP, Data
from livepde.diagnostics.check_report import Table
from livepde.errors import LivepdeError
from livepde.fem import FieldBlock
from livepde.linalg import Array
from livepde.plots import NORMAL_95
from livepde.stepping import StepFailed

QUICK = 1.0  # s; shorter runs are repeated
TIMES = 11  # times in the second half at which a varying parameter is scored


@dataclass(frozen=True)
class Score:
    """Score of one contender on one data set.

    Attributes
    ----------
    error
        Relative error of the parameter, or for a real process the error of the validation sensor.
    covered
        Share of values whose 95 % interval contains the truth; NaN without intervals or truth.
    step
        Processor time of a step over a forward step, mean without the first samples.
    whole, median
        Processor time of a step over a forward step, mean and median over all samples.
    failed
        Number of failed steps.
    megabytes
        Peak of allocated memory; NaN if it was not measured.
    note
        Reason for missing values, or a remark.
    """

    error: float = math.nan
    covered: float = math.nan
    step: float = math.nan
    whole: float = math.nan
    median: float = math.nan
    failed: int = 0
    megabytes: float = math.nan
    note: str = ""


Contender: TypeAlias = Callable[[Data], Score | None]
"""Data set -> score, or None if the contender does not apply."""

Known: TypeAlias = tuple[Array, Array | None]
"""Latent coefficients of the parameter, and a square root of their covariance (None: unknown)."""

Results: TypeAlias = dict[tuple[str, float | None, str], list[Score]]
"""Problem, noise level, row -> a score for each data set."""


class Judge:
    """Scorer of beliefs relative to the truth of a data set."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.model = data.process.model
        last = len(data) - 1
        first, count = (last // 2, TIMES) if data.problem.varying else (last, 1)
        self.scored: list[int] = np.linspace(first, last, count).round().astype(int).tolist()

    @cached_property
    def probe(self) -> Array:
        """Matrix that evaluates latent coefficients: constants, and fields at vertices."""
        latent = self.model.latent
        rows = []
        for part in latent.parts.values():
            size = part.size
            local = part.block.at_vertices if isinstance(part.block, FieldBlock) else np.eye(size)
            local = local.toarray() if hasattr(local, "toarray") else np.asarray(local)
            row = np.zeros((len(local), latent.dim))
            row[:, part.part.start : part.part.start + size] = local
            # Known boundary values have no interval.
            rows.append(row[(np.abs(np.delete(row, latent.fixed, axis=1)) > 0).any(axis=1)])
        return np.vstack(rows)

    @cached_property
    def rest(self) -> Array:
        """Standard deviation of the probed values in modes beyond all estimators, shape (rows,)."""
        rest: Array = np.abs(self.probe) @ Trajectory(self.data).rest
        return rest

    def error(self, q: Array, at: int) -> float:
        """Return the relative error of latent coefficients at a time index."""
        return self.data.problem.error(self.data.process, self.model.latent.value(q), at)

    def covered(self, q: Array, factor: Array | None, at: int) -> float:
        """Return the coverage of the 95 % intervals at a time index; NaN without intervals."""
        true = self.data.process.q_true
        if factor is None or true is None:
            return math.nan
        distance = np.abs(self.probe @ (q - self.model.latent.inverse(true[at])))
        std = np.sqrt(((self.probe @ factor) ** 2).sum(axis=1) + self.rest**2)
        return float(np.mean(distance <= NORMAL_95 * std))

    def judged(self, beliefs: Iterable[tuple[int, Array, Array | None]]) -> tuple[float, float]:
        """Return the root mean square error and the mean coverage over the scored times."""
        errors, shares = [], []
        for at, q, factor in beliefs:
            errors.append(self.error(q, at))
            shares.append(self.covered(q, factor, at))
        return float(np.sqrt(np.mean(np.square(errors)))), float(np.mean(shares))


def measured(data: Data, step: Callable[[int], None], known: Callable[[], Known]) -> Score:
    """Process all samples except the first, and return the score without failed steps.

    Parameters
    ----------
    step
        Function that processes the sample with an index; only its calls are timed.
    known
        Function that returns the current belief.
    """
    judge, beliefs = Judge(data), []
    seconds: list[float] = []
    for at in range(1, len(data)):
        start = process_time()
        step(at)
        seconds.append(process_time() - start)
        if at in judge.scored:
            beliefs.append((at, *known()))
    error, covered = judge.judged(beliefs)
    costs = np.array(seconds) / data.forward
    settled, whole, median = costs[WARM_UP:].mean(), costs.mean(), np.median(costs)
    return Score(error, covered, float(settled), float(whole), float(median))


def scored(contender: Contender, data: Data) -> Score | None:
    """Run a contender, and return its score; a failure becomes the note of the score.

    Quick contenders are run three times, and the median times count.
    """
    start = process_time()
    try:
        score = contender(data)
        runs = [score]
        for _ in range(2 if score is not None and process_time() - start < QUICK else 0):
            runs.append(contender(data))
    except (LivepdeError, StepFailed, np.linalg.LinAlgError) as error:
        return Score(note=f"{type(error).__name__}: {error}")
    if score is None:
        return None
    times = [(run.step, run.whole, run.median) for run in runs if run is not None]
    step, whole, median = np.median(times, axis=0).tolist()
    return replace(score, step=step, whole=whole, median=median)


def error_ratio(results: Results, at: tuple[str, float | None], row: str, other: str) -> float:
    """Return the ratio of the median errors of two rows; NaN if an error is unknown."""
    return _median(results, (*at, row)) / _median(results, (*at, other))


def step_ratio(results: Results, at: tuple[str, float | None], row: str, other: str) -> float:
    """Return the ratio of the mean costs of two rows; NaN if a cost is unknown."""
    mine, others = ([score.step for score in results.get((*at, key), ())] for key in (row, other))
    return _mean(mine) / _mean(others)


def _median(results: Results, key: tuple[str, float | None, str]) -> float:
    errors = [score.error for score in results.get(key, ())]
    return float(np.nanmedian(errors)) if np.isfinite(errors).any() else math.nan


def table_of(results: Results, limit: str) -> list[Table]:
    """Return a table for each problem, with a row for each noise level and contender.

    Parameters
    ----------
    limit
        Row whose error is the unit of the column `limit`.
    """
    tables = []
    for name in dict.fromkeys(key[0] for key in results):
        rows, most = [], 0
        for (problem, level, row), scores in results.items():
            if problem != name:
                continue
            most = max(most, len(scores))
            known = [score.error for score in scores if math.isfinite(score.error)] or [math.nan]
            cells = [
                float(np.median(known)),
                min(known),
                max(known),
                error_ratio(results, (problem, level), row, limit),
                _mean([score.covered for score in scores]),
                _mean([score.step for score in scores]),
            ]
            rows.append(
                [
                    "as measured" if level is None else f"{level:.0%}",
                    row,
                    *("–" if math.isnan(cell) else cell for cell in cells),
                    sum(score.failed for score in scores),
                    "; ".join(dict.fromkeys(score.note for score in scores if score.note)),
                ]
            )
        columns = ["noise", "estimator", "error", "least", "largest", "limit", "covered", "step"]
        columns += ["failed steps", "note"]
        tables.append(Table(f"{name}, {most} seed{'s' if most > 1 else ''}", columns, rows))
    return tables


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan
