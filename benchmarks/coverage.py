"""Coverage of intervals in twin experiments with true values drawn from the prior.

Each twin draws its unknowns from the prior, and simulates noisy data with the estimator's own
scheme. If prior, model and noise are right, the 68 % and 95 % intervals contain the truth with
these probabilities, and the normalised innovations are white. Then 95 of 100 twins have a mean
square within 1.96 standard errors of 1, and a lag-one correlation within 1.96 standard errors of 0.
In the last problems the model is wrong: it lacks a heat loss or a second layer of random size. Then
the interval must still contain the truth, or the run must report that the model does not explain
the data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.jobs import each
from livepde.diagnostics.check_report import Check, Table
from livepde.estimate import Estimate
from livepde.fem import (
    Field,
    Inputs,
    LogNormal,
    Moment,
    Normal,
    RandomWalk,
    Scalar,
    dot,
    grad,
    linear,
)
from livepde.fem import interval as line
from livepde.identifier import Identifier
from livepde.laws import Belief, Diagnostics, SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Points
from livepde.plots import NORMAL_95
from livepde.runs import Outcome, unexplained
from livepde.stepping import Advance, Alexander2, ForwardStage, Interval, advance

LEVELS = (0.68, 0.95)
WITHIN = {0.68: (0.60, 0.76), 0.95: (0.90, 0.98)}  # bounds on the coverage of 200 twins
AT_LEAST = 0.9  # smallest share of twins with white innovations, whose expectation is 0.95
HONEST = 0.9  # smallest share of wrong models with the truth in the interval, or doubted
FALSE_ALARM = 0.05  # largest share of right models that are doubted
NOISE = 0.05
MESH = line(0.0, 1.0, 20)


@dataclass(frozen=True)
class Problem:
    """A rod, heated at its left end, with point sensors.

    Attributes
    ----------
    title
        Description of the unknowns.
    unknowns
        Name -> prior.
    law
        Law of the estimator.
    sensors
        Positions of the sensors.
    loss, contrast
        rng -> term that only the truth has; None: no such term. `loss` is a heat loss, `contrast`
        the relative reduction of a in the second half; heat enters the first half.
    samples
        Number of samples, 0.1 apart.
    """

    title: str
    unknowns: Mapping[str, Any]
    law: SensitivityLaw = field(default_factory=SensitivityLaw)
    sensors: Sequence[float] = (0.25, 0.5, 0.75)
    loss: Callable[[np.random.Generator], float] | None = None
    contrast: Callable[[np.random.Generator], float] | None = None
    samples: int = 100

    @property
    def right(self) -> bool:
        """True if the estimator uses the model of the truth."""
        return self.loss is None and self.contrast is None

    def truth(self, rng: np.random.Generator) -> Model:
        """Return the model of the truth."""
        loss, contrast = (f(rng) if f else 0.0 for f in (self.loss, self.contrast))
        return self.model(loss, contrast)

    def model(self, loss: float = 0.0, contrast: float = 0.0) -> Model:
        """Return the model u_t - (c a u_x)_x + (b + loss) (u - 2) = 0; b = 0 if it is not unknown.

        c is 1 in the first half and 1 - contrast in the second.
        """

        def flux(q: Any, u: Any, v: Any, x: Any) -> Any:
            share = 1.0 - contrast * (x[0] > 0.5)
            form = share * q.a * dot(grad(u), grad(v))
            return form + q.b * (u - 2.0) * v if "b" in self.unknowns else form

        ends: dict[str, Any] = {"left": lambda x, t: 5.0 * np.sin(t) + 0.0 * x[0], "right": 0.0}
        return Model(
            Field(MESH, linear(MESH), dirichlet=ends),
            self.unknowns,
            A=flux,
            B=lambda u, v, x: loss * (u - 2.0) * v,
        )


A, B = Normal(0.3, 0.06), Normal(1.0, 0.4)
PROFILE = Field(MESH, linear(MESH), inner="H1", prior=LogNormal(0.3, std=0.1))
SPREAD = (0.1667, 0.3333, 0.5, 0.6667, 0.8333)


def _between(low: float, high: float) -> Callable[[np.random.Generator], float]:
    """Return a function that draws from the log-uniform distribution on (low, high)."""
    return lambda rng: float(np.exp(rng.uniform(np.log(low), np.log(high))))


PROBLEMS: Mapping[str, Problem] = {
    "two numbers": Problem("diffusivity and heat loss", {"a": A, "b": B}),
    "short run": Problem("diffusivity and heat loss, 20 samples", {"a": A, "b": B}, samples=20),
    "field": Problem(
        "diffusivity a(x), positive",
        {"a": PROFILE},
        SensitivityLaw(modes=15),
        SPREAD,
    ),
    "field, few modes": Problem(
        "diffusivity a(x), 6 modes", {"a": PROFILE}, SensitivityLaw(modes=6), SPREAD
    ),
    "field, seen in part": Problem(
        "diffusivity a(x), sensors from 0.1 to 0.4",
        {"a": PROFILE},
        SensitivityLaw(modes="auto"),
        (0.1, 0.175, 0.25, 0.325, 0.4),
    ),
    "random walk": Problem(
        "diffusivity that moves",
        {"a": Scalar(LogNormal(0.3, 0.06), evolution=RandomWalk(0.1))},
        SensitivityLaw(),
    ),
    "missing loss": Problem(
        "diffusivity; the model lacks a heat loss", {"a": A}, loss=_between(0.003, 1.0)
    ),
    "missing layer": Problem(
        "diffusivity of the heated half; the model lacks the other half's",
        {"a": A},
        contrast=_between(0.003, 0.9),
    ),
}


@dataclass(frozen=True)
class Twin:
    """Scores of one twin.

    Attributes
    ----------
    inside
        Level -> share of true values that lie in their interval: constants at the end of the run,
        fields at all vertices, moving constants at ten times.
    error
        Mean square error of latent values, in units of their variances.
    doubted
        True if the run reports that its model does not explain the data.
    white
        Whether the mean square of the normalised innovations, and their lag-one correlation, lie in
        the 95 % ranges of white noise.
    """

    inside: Mapping[float, float]
    error: float
    doubted: bool
    white: tuple[bool, bool]


def coverage(twins: int = 200, *, progress: bool = False) -> Outcome:
    """Run all problems, each with `twins` twins."""
    todo = [(name, seed) for name in PROBLEMS for seed in range(twins)]
    scores: dict[str, list[Twin]] = {name: [] for name in PROBLEMS}
    for (name, _), scored in each(_twin, todo, "twins", progress=progress):
        scores[name].append(scored)
    rows, checks = [], []
    for name, several in scores.items():
        inside = {level: _mean([one.inside[level] for one in several]) for level in LEVELS}
        doubted = _mean([one.doubted for one in several])
        honest = _mean([one.doubted or one.inside[0.95] == 1.0 for one in several])
        white = [_mean([one.white[k] for one in several]) for k in range(2)]
        rows.append(
            (
                name,
                PROBLEMS[name].title,
                *inside.values(),
                float(np.sqrt(_mean([one.error for one in several]))),
                doubted,
                *white,
            )
        )
        if PROBLEMS[name].right:
            checks += [
                Check(f"{name}: in the {level:.0%} interval", inside[level], WITHIN[level], "in")
                for level in LEVELS
            ]
            checks.append(Check(f"{name}: doubted", doubted, FALSE_ALARM, "<="))
            checks += [
                Check(f"{name}: {what} of innovations within chance", share, AT_LEAST, ">=")
                for what, share in zip(("mean square", "correlation"), white, strict=True)
            ]
        else:
            checks.append(Check(f"{name}: in the 95% interval, or doubted", honest, HONEST, ">="))
    columns = (
        "problem",
        "unknown",
        "68 %",
        "95 %",
        "error / deviation",
        "doubted",
        "innovations: square",
        "correlation",
    )
    note = (
        f"{twins} draws of true values from the prior, noise {NOISE:g}. error / deviation: root "
        "mean square, 1 for correct standard deviations. innovations: share of twins whose mean "
        "square and correlation lie in the 95 % ranges of white noise."
    )
    return Outcome([Table("Share of true values in the interval", columns, rows)], checks, [note])


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))


def _twin(name: str, seed: int) -> Twin:
    return twin(PROBLEMS[name], seed)


def twin(problem: Problem, seed: int) -> Twin:
    """Run one twin; a seed determines all numbers."""
    rng = np.random.default_rng(seed)
    model = problem.model()
    truth = model if problem.right else problem.truth(rng)
    points = Points(list(problem.sensors), noise=NOISE)
    identifier = Identifier(model, points, problem.law, u0=0.0)
    times = np.linspace(0.0, 0.1 * problem.samples, problem.samples + 1)
    path = _path(truth, times, rng)
    G = points.matrix(truth.state_space)
    compared = set(range(problem.samples, 0, -problem.samples // 20)[:10])
    moving = model.latent.moves
    samples, scores = [], []
    for k, u in enumerate(_states(truth, path, times)):
        z = G @ u + NOISE * rng.standard_normal(len(problem.sensors))
        estimate = identifier.step(times[k], z)
        samples.append(estimate)
        if (moving and k in compared) or k == problem.samples:
            scores.append(_score(model, estimate, identifier._latent_belief(), path[k]))
    inside, errors = zip(*scores, strict=True)
    result = identifier.run([])  # an empty result that collects the estimates for the verdict
    for estimate in samples:
        result.add(estimate)
    return Twin(
        {level: _mean([one[level] for one in inside]) for level in LEVELS},
        _mean(errors),
        unexplained(result.to_xarray()),
        _white(samples[-1].diagnostics, problem.samples * len(problem.sensors)),
    )


def _white(diagnostics: Diagnostics[float], values: int) -> tuple[bool, bool]:
    """Return whether mean square and correlation of `values` innovations fit white noise."""
    square, correlation = diagnostics.innovation_ratio - 1.0, diagnostics.innovation_correlation
    return (
        abs(square) <= NORMAL_95 * np.sqrt(2.0 / values),
        abs(correlation) <= NORMAL_95 * np.sqrt(1.0 / values),
    )


def _path(model: Model, times: Array, rng: np.random.Generator) -> Array:
    """Draw latent coefficients and their evolution from the prior, shape (times, m)."""
    latent = model.latent
    gram = model.Q.gram.toarray()
    # q ~ N(prior, G^{-1}): with G = L L^T, a draw is prior + L^{-T} times white noise.
    root = np.linalg.inv(np.linalg.cholesky(gram)).T
    a = latent.prior + root @ rng.standard_normal(latent.dim)
    path = [a]
    for t0, t1 in pairwise(times):
        a = latent.moved(a, t1 - t0)
        for item in latent.parts.values():
            grown = np.repeat(
                item.evolution.growth(t1 - t0, item.unknown.prior.latent_std), item.size
            )
            if grown.any():
                noise = root[item.part, item.part] @ rng.standard_normal(len(grown))
                a = a.copy()
                a[item.part] += np.sqrt(grown) * noise
        path.append(a)
    return np.array(path)


def _states(model: Model, path: Array, times: Array) -> Iterator[Array]:
    """Yield the states of the truth, whose parameter may change at each sample."""
    forward, control = ForwardStage(model), Advance(Alexander2())
    nothing, none = Inputs({}), np.zeros(0)
    u = model.initial(0.0, Moment(times[0], nothing))
    yield u
    for q, (t0, t1) in zip(path[1:], pairwise(times), strict=True):
        interval = Interval(t0=t0, t1=t1, inputs0=nothing, inputs1=nothing, z0=none, z1=none)

        def stage(c: Array, t: float, h: float, q: Array = q, at: Any = interval.at) -> Array:
            return forward.solve(c, q, h, at(t))

        u, _, failure = advance(control, stage, u, t0, t1)
        if failure is not None:
            raise failure
        yield u


def _score(
    model: Model, estimate: Estimate, belief: Belief, truth: Array
) -> tuple[dict[float, float], float]:
    """Return the coverage of each level, and the mean square of the normalised errors."""
    space, exact = model.parameter_space, model.latent.value(truth)
    inside = {}
    for level in LEVELS:
        hits = []
        for name in (*space.labels, *space.fields):
            part = space.labels[name] if name in space.labels else space.part(name)
            low, high = estimate[name].interval(level)
            hits.append(np.mean((low <= exact[part]) & (exact[part] <= high)))
        inside[level] = _mean(hits)
    errors = (belief.q - truth) / np.asarray(belief.q_std, dtype=float)
    return inside, float(np.mean(errors**2))
