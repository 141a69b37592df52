"""Reference fits by SciPy's methods "lm" and "trf", from the prior and from the truth."""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.refit.objective import Objective
from benchmarks.refit.problem import Priors, Problem

Array = NDArray[Any]
METHODS: tuple[Literal["lm", "trf"], ...] = ("lm", "trf")
EVALUATIONS = 200  # largest number of evaluations
TOLERANCE = 1e-8  # tolerance of steps and costs, SciPy's default


def enough(best: float) -> float:
    """Return the largest cost that counts as equal to the best known cost."""
    return max(1.001 * best, best + 0.5)


@dataclass(frozen=True, eq=False)
class Reference:
    """Fits by SciPy.

    Attributes
    ----------
    a, cost
        Coordinates of the best fit, shape (k,), and its cost.
    reached
        Cost that each method reached from the prior.
    seconds
        Processor time of each method from the prior.
    """

    a: Array
    cost: float
    reached: dict[str, float]
    seconds: dict[str, float]


def reference(problem: Problem, priors: Priors, z: Array) -> Reference:
    """Fit readings z from both starts with both methods."""
    prior = Objective(problem, priors, z)
    starts = {
        "prior": np.zeros(prior.coordinates.size),
        "truth": prior.coordinates.inverse(problem.q_true),
    }
    reached, seconds = dict[str, float](), dict[str, float]()
    best: tuple[float, Array] = (np.inf, starts["prior"])
    for name, start in starts.items():
        for method in METHODS:
            objective = Objective(problem, priors, z)
            begun = process_time()
            a = _fitted(objective, start, method)
            spent = process_time() - begun
            cost = objective.cost(a)
            if name == "prior":
                reached[method], seconds[method] = cost, spent
            if cost < best[0]:
                best = (cost, a)
    return Reference(best[1], best[0], reached, seconds)


def _fitted(objective: Objective, start: Array, method: Literal["lm", "trf"]) -> Array:
    minimum = least_squares(
        objective.residual,
        start,
        jac=objective.jacobian,
        method=method,
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
        max_nfev=EVALUATIONS,
    )
    return np.asarray(minimum.x)
