"""Fit of stored samples by livepde at the end of a batch run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.refit.objective import Objective
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.unknowns import Belief
from livepde.errors import LivepdeError
from livepde.result import Result
from livepde.stepping import StepFailed

Array = NDArray[Any]
PLAIN = {"refit": None}
"""Options of a filter that processes each sample once."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Fit of one data set.

    Attributes
    ----------
    a
        Coordinates of the final estimate, shape (k,); NaN without an estimate.
    cost, claimed
        Cost by the lean forward model, and cost that livepde reports; the latter is NaN if livepde
        refused a reading.
    passes
        Passes over all samples that livepde reports; NaN without a report.
    converged, level
        Whether livepde reports convergence, and the level of its verdict.
    seconds
        Processor time of the run.
    failure
        Error that ended the run; empty without one.
    """

    a: Array
    cost: float
    claimed: float
    passes: float
    converged: bool
    level: str
    seconds: float
    failure: str = ""


def livepde_fit(problem: Problem, priors: Priors, z: Array) -> Fit:
    """Return livepde's fit of readings z, shape (samples, sensors), with default options."""
    objective = Objective(problem, priors, z)
    begun = process_time()
    try:
        result = problem.identifier(priors).run(problem.stream(z))
    except (LivepdeError, StepFailed, ArithmeticError, np.linalg.LinAlgError) as error:
        lost = np.full(objective.coordinates.size, np.nan)
        text = f"{type(error).__name__}: {error}"
        # A run that ends with an error counts as "do not trust".
        spent = process_time() - begun
        return Fit(lost, np.inf, np.nan, np.nan, False, "do not trust", spent, text)
    seconds = process_time() - begun
    return _judged(objective, result, seconds)


def _judged(objective: Objective, result: Result, seconds: float) -> Fit:
    last: Any = result.last
    with np.errstate(all="ignore"):
        a = objective.coordinates.inverse(np.asarray(last.q))
    cost = objective.cost(a) if np.isfinite(a).all() else np.inf
    fit = last.fit
    if fit is None:
        return Fit(a, cost, np.nan, np.nan, True, last.verdict.level, seconds)
    claimed = np.nan if fit.refused else fit.cost  # `fit.cost` excludes refused readings
    return Fit(a, cost, claimed, fit.passes, fit.converged, last.verdict.level, seconds)


@lru_cache(maxsize=64)
def plain_seconds(problem: Problem) -> float:
    """Return the processor time of a filter that processes each sample once.

    Its prior is centred at the truth, so that no safeguard acts. Fits add the time of refits.
    """
    near = {
        name: item.prior or Belief(item.truth, 0.1 * float(item.slope(item.latent(item.truth))))
        for name, item in problem.unknowns.items()
    }
    z = problem.readings(0)
    begun = process_time()
    problem.identifier(near, **PLAIN).run(problem.stream(z))
    return process_time() - begun
