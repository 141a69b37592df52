"""Accuracy of the laws relative to an offline fit, coverage of their intervals, and their costs.

Every contender receives the same model, samples and noise level. The prior, which uses no data, is
the lower limit of accuracy, and the offline fit of all data the upper (`benchmarks.offline`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import TypeAlias

import numpy as np

from benchmarks.jobs import each
from benchmarks.offline import Fit, Trajectory, fit
from benchmarks.problems import PROBLEMS, Data, Problem
from benchmarks.scoring import (
    Contender,
    Judge,
    Known,
    Results,
    Score,
    error_ratio,
    measured,
    scored,
    step_ratio,
    table_of,
)
from livepde.diagnostics.check_report import Check
from livepde.errors import LivepdeError
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, GradientLaw, Refit, ResidualDamping, SensitivityLaw
from livepde.linalg import Array
from livepde.observation import Discrepancy, Observation, Tikhonov
from livepde.runs import Outcome
from livepde.stepping import StepFailed

LawBuilder: TypeAlias = Callable[[Data], tuple[Observation, AnyLaw] | None]

PROMISED = "sensitivity"  # row whose promises below are checked
ALL_DATA = "offline fit of all data"
EACH_SAMPLE = "offline fit, again at each sample"
LARGEST_ERROR = 1.3  # largest ratio of the errors of the promised row and the offline fit
LARGEST_TIME = 1 / 20
SAMPLES = 1000  # run length for which that time is promised


# --- our laws ------------------------------------------------------------------------------------


def _sensitivity(refit: Refit | None, data: Data) -> tuple[Observation, AnyLaw]:
    return data.observation, SensitivityLaw(modes=data.modes, refit=refit)


def _gradient(auto: bool, smooth: bool, data: Data) -> tuple[Observation, AnyLaw] | None:
    gain, observation = data.problem.gain, data.observation
    if gain is None:
        return None
    law = GradientLaw(gain="auto") if auto else GradientLaw(gain, ResidualDamping(1.0))
    if smooth:
        weights = data.process.weights
        gram = np.eye(len(data.noise)) if weights is None else weights
        delta = float(np.sqrt(data.noise @ (np.diag(gram) * data.noise)))
        observation = replace(observation, reconstruction=Tikhonov(alpha=Discrepancy(delta=delta)))
    return observation, law


LAWS: dict[str, LawBuilder] = {
    "sensitivity": partial(_sensitivity, Refit()),
    "sensitivity, no refit": partial(_sensitivity, None),
    "gradient": partial(_gradient, False, False),
    "gradient, smoothed": partial(_gradient, False, True),
    "gradient, auto": partial(_gradient, True, False),
    "gradient, auto, smoothed": partial(_gradient, True, True),
}
"""Row -> observation and law for a data set; None if the law does not support its sensors.

All options are defaults, except the number of modes and the constant gain of each problem.
"""


def _law(builder: LawBuilder, data: Data) -> Score | None:
    built = builder(data)
    return None if built is None else run_law(data, *built)


def run_law(data: Data, observation: Observation, law: AnyLaw) -> Score:
    """Run a law with an observation operator over a data set, and return its score."""
    process, samples = data.process, list(data)
    identifier = Identifier(
        process.model,
        observation,
        law,
        u0=process.u0,
        t0=float(process.times[0]),
        validation=process.validation,
        scheme=process.scheme,
        dt_max=process.dt_max,
        halvings=process.halvings,
        assimilate_from=process.assimilate_from,
    )
    failed, missed = 0, []

    def step(at: int) -> None:
        nonlocal failed
        sample = samples[at]
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        failed += not estimate.status.ok
        missed.append(estimate.validation_error)
        if at == len(samples) - 1:
            identifier.refit()  # as at the end of a batch run

    def known() -> Known:
        belief = identifier._latent_belief()
        factor = belief.q_factor
        return belief.q, factor

    step(0)
    score = measured(data, step, known)
    error = score.error if process.q_true is not None else _hidden(data, np.array(missed))
    return replace(score, error=error, failed=failed)


def _hidden(data: Data, missed: Array) -> float:
    """Return the root mean square of validation errors of shape (times, validation)."""
    late = data.process.times >= data.process.assimilate_from
    return float(np.sqrt(np.nanmean(missed[late][1:] ** 2)))


# --- references ----------------------------------------------------------------------------------


def _prior(data: Data) -> Score:
    """Return the score of the prior, which uses no sample."""
    judge, trajectory = Judge(data), Trajectory(data)
    nothing = np.zeros(trajectory.size)
    error, covered = judge.judged(
        (k, trajectory.latent(nothing, k), trajectory.directions(k)) for k in judge.scored
    )
    if data.process.hidden is not None:
        shown = trajectory.run(nothing, sensitivities=False)[1]
        error = _hidden(data, data.process.hidden - shown)
    return Score(error, covered, 1.0, 1.0, 1.0)


@lru_cache(maxsize=1)
def _fitted(data: Data) -> Fit:
    return fit(data)


def _all_data(data: Data) -> Score:
    """Return the score of the offline fit; its time is divided by the number of samples."""
    fitted, judge = _fitted(data), Judge(data)
    error, covered = judge.judged((k, fitted.q[k], fitted.factor(k)) for k in judge.scored)
    if data.process.hidden is not None:
        error = _hidden(data, data.process.hidden - fitted.hidden)
    cut = "" if fitted.converged else ", cut off"
    note = f"{fitted.evaluations} runs over {len(data)} samples{cut}"
    return Score(error, covered, fitted.seconds / len(data) / data.forward, note=note)


def _each_sample(data: Data) -> Score:
    """Return the score of an offline fit that is repeated at each sample with the data so far.

    Its cost is a lower bound, one Gauss-Newton step per sample: a run with sensitivities over the
    samples so far, on average half of `SAMPLES`. If the number of unknowns grows with the samples,
    it is a third, since later runs have more unknowns.
    """
    fitted, judge = _fitted(data), Judge(data)
    run = fitted.seconds / fitted.evaluations / len(data) * SAMPLES
    cost = run / data.forward * (1 / 3 if data.problem.varying else 1 / 2)

    def fits() -> Iterator[tuple[int, Array, Array | None]]:
        start = None
        for at in judge.scored:
            now = fitted if at == len(data) - 1 else fit(data.until(at), start)
            start = now.coordinates
            yield at, now.q[at], now.factor(at)

    error, covered = judge.judged(fits())
    return Score(error, covered, cost, note=f"one run for each of {SAMPLES} samples")


ROWS: Mapping[str, Contender] = {
    "prior": _prior,
    **{name: partial(_law, builder) for name, builder in LAWS.items()},
    ALL_DATA: _all_data,
    EACH_SAMPLE: _each_sample,
}
"""Name of the row -> contender."""


# --- the benchmark -------------------------------------------------------------------------------


def accuracy(
    only: Sequence[str] = (),
    seeds: int = 3,
    *,
    levels: Sequence[float] | None = None,
    problems: Mapping[str, Problem] = PROBLEMS,
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
        Noise levels; default the levels of each problem.
    problems
        Known problems by name.
    progress
        Show a bar on standard error.
    """
    results: Results = {}
    notes = []
    jobs = [
        (problem, level, seed)
        for problem in (problems[name] for name in only or problems)
        for level in problem.chosen(levels)
        for seed in range(seeds if level is not None else 1)
    ]
    for (problem, level, _), scores in each(_scores, jobs, "data sets", progress=progress):
        if isinstance(scores, str):
            notes.append(scores)
            continue
        for name, score in scores.items():
            results.setdefault((problem.name, level, name), []).append(score)
    tables = table_of(results, limit=EACH_SAMPLE)
    return Outcome(tables=tables, checks=_checks(results), notes=[*dict.fromkeys(notes), *NOTES])


def _scores(problem: Problem, level: float | None, seed: int) -> dict[str, Score] | str:
    """Return the score of each row on a data set, or why the data set is unavailable."""
    try:
        data = problem.data(level, seed)
    except (LivepdeError, StepFailed) as error:
        return f"{problem.name}: not run, {error}"
    results = {name: scored(contender, data) for name, contender in ROWS.items()}
    return {name: score for name, score in results.items() if score is not None}


def _checks(results: Results) -> list[Check]:
    """Return the checks: error ratios at each noise level, and cost ratios for each problem."""
    checks = []
    for problem, level, row in results:
        if row != PROMISED or level is None:
            continue
        error = error_ratio(results, (problem, level), PROMISED, EACH_SAMPLE)
        time = step_ratio(results, (problem, level), PROMISED, EACH_SAMPLE)
        name = f"{problem}, {level:.0%} noise: {{}} of '{PROMISED}' over '{EACH_SAMPLE}'"
        checks.append(Check(name.format("error"), error, LARGEST_ERROR, "<="))
        checks.append(Check(name.format("time"), time, LARGEST_TIME, "<="))
    return checks


NOTES = (
    "error: relative error of the parameter at the end, or its root mean square over the second "
    "half if the parameter varies; median, minimum and maximum over seeds. soil: error in K at the "
    "validation sensor, one step ahead (prior and offline fit: free run).",
    f"limit: error over the error of '{EACH_SAMPLE}', which uses all data up to the scored time. "
    f"'{ALL_DATA}' is equal for constant parameters. For varying ones it is a smoother, which also "
    "uses later data.",
    "covered: share of values whose 95 % interval contains the truth, mean over seeds.",
    "step: processor time of a step over a forward step with a stored factorisation, mean over "
    f"seeds. '{ALL_DATA}': its total time divided by the number of samples. '{EACH_SAMPLE}': "
    "computed for one run with sensitivities over the samples so far.",
)
