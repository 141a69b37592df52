"""Trial of one prior: livepde's fit, without and with outliers, and the best known fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.refit.estimator import Fit, livepde_fit, plain_seconds
from benchmarks.refit.objective import Objective
from benchmarks.refit.problem import Array, Priors, Problem
from benchmarks.refit.problems import PROBLEMS
from benchmarks.refit.reference import Reference, enough, reference

OUTLIERS = 0.2  # share of outliers among the readings
SIZES = (10.0, 100.0)  # range of their errors, in standard deviations of the noise
LEAST = 10  # number of samples above which outliers can be detected


@dataclass(frozen=True, eq=False)
class Trial:
    """Scores of one prior.

    Attributes
    ----------
    problem, seed
        Name of the problem, and seed of the prior.
    best
        Best known cost.
    fit, plain
        livepde's fit, and the processor time of a filter that processes each sample once.
    scipy
        Fits by SciPy.
    shifted
        Root mean square distance between the fit with outliers and the best fit without, in
        standard deviations of the posterior without outliers; NaN if it was not run.
    """

    problem: str
    seed: int
    best: float
    fit: Fit
    plain: float
    scipy: Reference
    shifted: float

    @property
    def reached(self) -> bool:
        """Whether livepde reached the best known cost."""
        return self.fit.cost <= enough(self.best)

    @property
    def silent(self) -> bool:
        """Whether livepde missed the best known cost without reporting it."""
        return not self.reached and self.fit.converged and self.fit.level != "do not trust"

    @property
    def scipy_seconds(self) -> float:
        """Time of SciPy's fastest fit from the prior that reached the best cost; NaN if none."""
        each = [
            self.scipy.seconds[method]
            for method, cost in self.scipy.reached.items()
            if cost <= enough(self.best)
        ]
        return min(each, default=np.nan)

    @property
    def ratio(self) -> float:
        """Processor time of livepde's refits over SciPy's; NaN if SciPy misses the best cost."""
        return max(self.fit.seconds - self.plain, 0.0) / self.scipy_seconds


def trial(name: str, seed: int) -> Trial:
    """Run one prior; a seed determines all numbers except processor times."""
    problem = PROBLEMS[name].at(seed)
    with threadpool_limits(1):
        priors, z = problem.priors(seed), problem.readings(seed)
        fit = livepde_fit(problem, priors, z)
        scipy = reference(problem, priors, z)
        best = min(scipy.cost, fit.cost)
        a = fit.a if fit.cost < scipy.cost else scipy.a
        # Every second prior suffices to check a share of nine in ten.
        wild = len(z) > LEAST and seed % 2 == 1
        shifted = _shifted(problem, priors, z, a, seed) if wild else np.nan
        return Trial(name, seed, best, fit, plain_seconds(problem), scipy, shifted)


def with_outliers(z: Array, noise: float, rng: np.random.Generator) -> Array:
    """Return readings with large errors of either sign in a share `OUTLIERS` of them."""
    wild = rng.uniform(size=z.shape) < OUTLIERS
    size = np.exp(rng.uniform(np.log(SIZES[0]), np.log(SIZES[1]), z.shape)) * rng.choice(
        [-1.0, 1.0], z.shape
    )
    return np.asarray(z + noise * np.where(wild, size, 0.0))


def _shifted(problem: Problem, priors: Priors, z: Array, a: Array, seed: int) -> float:
    wild = with_outliers(z, problem.noise, problem.random("outliers", seed))
    moved = livepde_fit(problem, priors, wild).a
    steps = Objective(problem, priors, z).root(a) @ (moved - a)
    distance = float(np.sqrt(np.mean(steps**2)))
    return distance if np.isfinite(distance) else np.inf
