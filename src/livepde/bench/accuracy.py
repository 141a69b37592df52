"""How close the laws come to what the data can tell: errors, intervals, and what a step costs.

Every contender is given the same model, samples and noise level. Below stands the prior, which has
seen nothing; above, the fit of all data with hindsight (`bench.offline`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from time import process_time
from typing import Any

import numpy as np

from livepde.bench.offline import Trajectory, fit
from livepde.bench.problems import PROBLEMS, Data, Problem
from livepde.errors import LivepdeError
from livepde.fem import FieldBlock, Inputs
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, Belief, GradientLaw, Replay, ResidualDamping, SensitivityLaw
from livepde.linalg import Array
from livepde.observation import Discrepancy, Observation, Tikhonov
from livepde.progress import watched
from livepde.runs.outcome import Outcome, Table
from livepde.stepping import Advance, ForwardStage, Interval, StepFailed, advance

__all__ = ["LAWS", "Contender", "Judge", "Score", "accuracy", "forward_seconds", "table_of"]

QUANTILE = 1.959964  # of the normal distribution, for 95 %
WARM_UP = 2  # samples in which matrices are built that are built once


@dataclass(frozen=True)
class Score:
    """What one contender reached on one data set.

    Attributes
    ----------
    error
        Relative error of the parameter; of a real process, error of the withheld sensor.
    covered
        Share of values whose 95 % interval holds the truth; NaN without intervals or truth.
    step
        Processor time of a step over that of a forward step.
    failed
        Steps that could not be taken.
    megabytes
        Largest memory that was allocated at once, where it was measured.
    note
        Why there is nothing, or what to know.
    """

    error: float = math.nan
    covered: float = math.nan
    step: float = math.nan
    failed: int = 0
    megabytes: float = math.nan
    note: str = ""


Contender = Callable[[Problem, Data], Score | None]
"""Runs on a data set; None where it does not apply."""

LawBuilder = Callable[[Problem, Data], tuple[Observation, AnyLaw] | None]


def _modes(problem: Problem, data: Data) -> dict[str, int]:
    return dict.fromkeys(data.process.model.parameter_space.fields, problem.modes)


def _sensitivity(problem: Problem, data: Data) -> tuple[Observation, AnyLaw]:
    return data.observation, SensitivityLaw(modes=_modes(problem, data))


def _replay(problem: Problem, data: Data) -> tuple[Observation, AnyLaw]:
    return data.observation, SensitivityLaw(modes=_modes(problem, data), replay=Replay())


def _gradient(problem: Problem, data: Data) -> tuple[Observation, AnyLaw] | None:
    if problem.gain is None:
        return None
    return data.observation, GradientLaw(problem.gain, ResidualDamping(1.0))


def _smoothed(problem: Problem, data: Data) -> tuple[Observation, AnyLaw] | None:
    if problem.gain is None:
        return None
    weights = data.process.weights
    gram = np.eye(len(data.noise)) if weights is None else weights
    delta = float(np.sqrt(data.noise @ (np.diag(gram) * data.noise)))
    smoothing = Tikhonov(alpha=Discrepancy(delta=delta))
    law = GradientLaw(problem.gain, ResidualDamping(1.0))
    return replace(data.observation, reconstruction=smoothing), law


LAWS: dict[str, LawBuilder] = {
    "sensitivity": _sensitivity,
    "sensitivity, replay": _replay,
    "gradient": _gradient,
    "gradient, smoothed": _smoothed,
}
"""Row -> observation and law for a data set; None where it is not meant for the sensors.

Everything as it comes, but for the number of modes and the hand-set gain that the problem states.
"""


# --- judging -------------------------------------------------------------------------------------


class Judge:
    """Compares beliefs with the truth of a data set."""

    def __init__(self, problem: Problem, data: Data) -> None:
        self.problem = problem
        self.data = data
        self.model = data.process.model
        count = len(data)
        self.scored = range(count // 2, count) if problem.varying else range(count - 1, count)

    @cached_property
    def probe(self) -> Array:
        """Rows that evaluate the latent coefficients: numbers, and fields at vertices."""
        latent = self.model.latent
        rows = []
        for part in latent.parts.values():
            size = part.size
            local = part.block.at_vertices if isinstance(part.block, FieldBlock) else np.eye(size)
            local = local.toarray() if hasattr(local, "toarray") else np.asarray(local)
            row = np.zeros((len(local), latent.dim))
            row[:, part.part.start : part.part.start + size] = local
            # Where a boundary value is known there is nothing to cover.
            rows.append(row[(np.abs(np.delete(row, latent.fixed, axis=1)) > 0).any(axis=1)])
        return np.vstack(rows)

    @cached_property
    def rest(self) -> Array:
        """Deviation of what `probe` evaluates in the modes that no estimator has, (rows,)."""
        rest: Array = np.abs(self.probe) @ Trajectory(self.data, self.problem.modes).rest
        return rest

    def error(self, q: Array, at: int) -> float:
        """Return the relative error of latent coefficients at a time."""
        return self.problem.error(self.data.process, self.model.latent.value(q), at)

    def covered(self, q: Array, factor: Array | None, at: int) -> float:
        """Return the share of 95 % intervals that hold the truth, NaN if there are none."""
        true = self.data.process.q_true
        if factor is None or true is None:
            return math.nan
        distance = np.abs(self.probe @ (q - self.model.latent.inverse(true[at])))
        std = np.sqrt(((self.probe @ factor) ** 2).sum(axis=1) + self.rest**2)
        return float(np.mean(distance <= QUANTILE * std))

    def judged(self, beliefs: Iterable[tuple[int, Array, Array | None]]) -> tuple[float, float]:
        """Return error (root mean square over the scored times) and coverage."""
        errors, shares = [], []
        for at, q, factor in beliefs:
            errors.append(self.error(q, at))
            shares.append(self.covered(q, factor, at))
        return float(np.sqrt(np.mean(np.square(errors)))), float(np.mean(shares))


def forward_seconds(data: Data) -> float:
    """Return the processor time of a forward step with the parameter at its prior."""
    process, model = data.process, data.process.model
    stage_of, control = ForwardStage(model), Advance(process.scheme, process.dt_max)
    q, none = model.latent.prior, np.zeros(0)
    rows = [Inputs(dict(row)) for row in process.inputs or [{}] * len(data)]
    times = process.times.tolist()
    at = Interval(times[0], times[0], rows[0], rows[0], none, none)
    u = model.initial(process.u0, at.end)
    start, steps = process_time(), 0
    for k in range(1, len(times)):
        interval = Interval(times[k - 1], times[k], rows[k - 1], rows[k], none, none)

        def stage(c: Array, t: float, h: float, of: Interval = interval) -> Array:
            return stage_of.solve(c, q, h, of.at(t))

        u, _, failure = advance(control, stage, u, interval)
        if failure is not None:
            raise failure
        steps += 1
        if k == WARM_UP:
            start, steps = process_time(), 0
    return (process_time() - start) / steps


def run_law(
    problem: Problem, data: Data, built: tuple[Observation, AnyLaw], forward: float
) -> Score:
    """Run a law over a data set."""
    observation, law = built
    process, judge = data.process, Judge(problem, data)
    identifier = Identifier(
        process.model,
        observation,
        law,
        u0=process.u0,
        t0=float(process.times[0]),
        withheld=process.withheld,
        scheme=process.scheme,
        dt_max=process.dt_max,
        assimilate_from=process.assimilate_from,
    )
    beliefs: list[tuple[int, Belief]] = []
    seconds, steps, failed, missed = 0.0, 0, 0, []
    for k, sample in enumerate(data):
        start = process_time()
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        seconds += process_time() - start
        steps += 1
        if k == WARM_UP:
            seconds, steps = 0.0, 0
        failed += not estimate.status.ok
        if sample.t >= process.assimilate_from and k > 0:
            missed.append(estimate.withheld_error)
        if k in judge.scored:
            beliefs.append((k, identifier.latent_belief()))
    error, covered = judge.judged(
        (k, b.q, None if b.q_factor is None else b.inflation * b.q_factor) for k, b in beliefs
    )
    if process.q_true is None:
        error = _rmse(np.array(missed))
    return Score(error, covered, seconds / steps / forward, failed)


def _rmse(missed: Array) -> float:
    return float(np.sqrt(np.nanmean(missed**2)))


def _law(builder: LawBuilder, forward: float) -> Contender:
    def contender(problem: Problem, data: Data) -> Score | None:
        built = builder(problem, data)
        return None if built is None else run_law(problem, data, built, forward)

    return contender


def _prior(problem: Problem, data: Data) -> Score:
    """Judge the prior: what is known without any sample."""
    judge, trajectory = Judge(problem, data), Trajectory(data, problem.modes)
    nothing = np.zeros(trajectory.size)
    error, covered = judge.judged(
        (k, trajectory.latent(nothing, k), trajectory.directions(k)) for k in judge.scored
    )
    if data.process.q_true is None:
        error = _hidden(data, trajectory.run(nothing, sensitivities=False)[1])
    return Score(error, covered, 1.0)


def _hidden(data: Data, shown: Array) -> float:
    """Return the error of the withheld sensors of a free run."""
    process = data.process
    late = process.times >= process.assimilate_from
    return _rmse((np.asarray(process.hidden) - shown)[late][1:])


def _offline(forward: float) -> Contender:
    def contender(problem: Problem, data: Data) -> Score:
        found, judge = fit(data, problem.modes), Judge(problem, data)
        error, covered = judge.judged((k, found.q[k], found.factor(k)) for k in judge.scored)
        if data.process.q_true is None:
            error = _hidden(data, found.hidden)
        note = "" if found.converged else "not converged"
        return Score(error, covered, found.seconds / len(data) / forward, note=note)

    return contender


# --- the table -----------------------------------------------------------------------------------


def contenders(laws: Mapping[str, LawBuilder], forward: float) -> dict[str, Contender]:
    """Return all rows: the prior, our laws, the offline fit."""
    rows: dict[str, Contender] = {"prior": _prior}
    rows |= {name: _law(builder, forward) for name, builder in laws.items()}
    rows["offline fit of all data"] = _offline(forward)
    return rows


def scored(contender: Contender, problem: Problem, data: Data) -> Score | None:
    """Run a contender; one that fails is a score with a reason."""
    try:
        return contender(problem, data)
    except (LivepdeError, StepFailed, np.linalg.LinAlgError) as error:
        return Score(note=f"{type(error).__name__}: {error}")


def accuracy(
    only: Sequence[str] = (),
    seeds: int = 3,
    *,
    levels: Sequence[float] | None = None,
    problems: Mapping[str, Problem] = PROBLEMS,
    laws: Mapping[str, LawBuilder] = LAWS,
    progress: bool = False,
) -> Outcome:
    """Run our laws, the prior and the offline fit on all problems and noise levels.

    Parameters
    ----------
    only
        Names of problems; default all.
    seeds
        Data sets for each noise level.
    levels
        Noise levels; default those of each problem.
    problems, laws
        What there is to choose from.
    progress
        Show a bar on standard error.
    """
    chosen = [problems[name] for name in only or problems]
    found: dict[tuple[str, float | None, str], list[Score]] = {}
    notes = []
    jobs = [
        (problem, level, seed)
        for problem in chosen
        for level in (problem.levels if levels is None or None in problem.levels else levels)
        for seed in range(seeds if level is not None else 1)
    ]
    for problem, level, seed in watched(jobs, len(jobs), "data sets") if progress else jobs:
        try:
            data = problem.data(level, seed)
            forward = forward_seconds(data)
        except (LivepdeError, StepFailed) as error:
            notes.append(f"{problem.name}: not run, {error}")
            continue
        for name, contender in contenders(laws, forward).items():
            score = scored(contender, problem, data)
            if score is not None:
                found.setdefault((problem.name, level, name), []).append(score)
    return Outcome(tables=table_of(found, seeds), notes=[*dict.fromkeys(notes), *NOTES])


NOTES = (
    "error: relative, of the parameter, median over seeds at the end (root mean square over the "
    "second half where it moves); soil: K, at the withheld sensor, one step ahead (prior and "
    "offline fit: in a free run).",
    "covered: share of values whose 95 % interval holds the truth, mean over seeds.",
    "step: processor time of a step over that of a forward step with the matrix kept; of the "
    "offline fit all of its time, divided by the samples.",
    "limit: error over that of the offline fit, which has seen all data at once; of the viscosity "
    "that wanders it is a smoother, which no filter can reach.",
)


def table_of(
    found: Mapping[tuple[str, float | None, str], Sequence[Score]],
    seeds: int,
    limit: str = "offline fit of all data",
    memory: bool = False,
) -> list[Table]:
    """Return a table for each problem: rows are noise level and contender."""
    tables = []
    for name in dict.fromkeys(key[0] for key in found):
        rows = []
        for (problem, level, row), scores in found.items():
            if problem != name:
                continue
            errors = np.array([score.error for score in scores])
            best = [score.error for score in found.get((name, level, limit), ())]
            low, middle, high = (
                np.nanquantile(errors, (0.0, 0.5, 1.0))
                if np.isfinite(errors).any()
                else (math.nan,) * 3
            )
            rows.append(
                [
                    "as measured" if level is None else f"{level:.0%}",
                    row,
                    *(_cell(value) for value in (middle, low, high)),
                    _cell(middle / float(np.median(best)) if best else math.nan),
                    _cell(_mean([score.covered for score in scores])),
                    _cell(_mean([score.step for score in scores])),
                    *([_cell(_mean([score.megabytes for score in scores]))] if memory else []),
                    sum(score.failed for score in scores),
                    "; ".join(dict.fromkeys(score.note for score in scores if score.note)),
                ]
            )
        columns = ["noise", "estimator", "error", "least", "largest", "limit", "covered", "step"]
        columns += [*(["MB"] if memory else []), "failed steps", "note"]
        tables.append(Table(f"{name}, {seeds} seed{'s' if seeds > 1 else ''}", columns, rows))
    return tables


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def _cell(value: Any) -> Any:
    """Return a number for a table; what is not known is a dash."""
    return "–" if math.isnan(value) else float(value)
