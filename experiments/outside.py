"""How well the laws estimate a field outside the observed part of the domain.

Two processes on [0, 1] are observed at the nodes in omega = (0.3, 0.87) with 1 % noise: a reaction
q(x) in the paper's equation, excited by its source, and a positive diffusivity a(x), heated at both
ends. For each seed the true field is drawn from the prior, on a separate mesh with its own steps.

Prints medians over the seeds of the relative error of the field inside and outside omega. For each
range of the distance from omega, it prints the share of true values in 95 % intervals and the mean
interval width as a share of the prior's. Rows named "informed" use the same number of directions,
but the directions best determined by all data instead of the leading modes of the prior; they come
from the posterior of a run with all modes, in hindsight.

    python -m experiments.outside 20

runs seeds 0 to 19.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from experiments.failed_steps import FailedSteps
from livepde.fem import Field, LogNormal, Normal, Sobolev, dot, grad, interval, linear
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, Belief, GradientLaw, Problem, SensitivityLaw
from livepde.laws.member_sensors import MemberSensors
from livepde.laws.reduction import Reduction
from livepde.laws.sensitivity_state import SensitivityWork
from livepde.laws.shadows import ShadowSet
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Points, Subdomain
from livepde.reproduce import seed_excited
from livepde.stepping import Advance, Alexander2, simulate

OMEGA = (0.3, 0.87)
TIMES = 0.05 * np.arange(401)
LEVEL = 0.01
CELLS, FINE = 60, 180
STEPS = FailedSteps()
BINS = (0.0, 0.1, 0.2, 0.3)  # distances from omega


def reaction(cells: int) -> Model:
    """Return u_t - u_xx + q u = f with the source of `seed-excited`."""
    mesh = interval(0.0, 1.0, cells)
    q = Field(mesh, linear(mesh), inner=Sobolev(1.0, 0.3).pointwise(1), prior=Normal(3.0, std=1.5))
    return Model(
        Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}),
        {"q": q},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: dot(grad(u), grad(v)),
        f=seed_excited.f,
    )


def rod(cells: int) -> Model:
    """Return u_t = (a u_x)_x, heated at both ends."""
    mesh = interval(0.0, 1.0, cells)
    ends: dict[str, Any] = {
        "left": lambda x, t: np.sin(1.1 * t) + 0.0 * x[0],
        "right": lambda x, t: np.sin(0.7 * t) + 0.0 * x[0],
    }
    smooth = Sobolev(2.0, 0.3).pointwise(1)
    a = Field(mesh, linear(mesh), inner=smooth, prior=LogNormal(0.1, std=0.04))
    return Model(
        Field(mesh, linear(mesh), dirichlet=ends),
        {"a": a},
        A=lambda q, u, v, x: q.a * dot(grad(u), grad(v)),
    )


PROCESSES: Mapping[str, Callable[[int], Model]] = {"reaction": reaction, "rod": rod}


@dataclass(frozen=True, eq=False)
class Data:
    """True field and its samples.

    Attributes
    ----------
    model
        Model of the estimator.
    x, true
        Sorted vertices, and the true field at the vertices.
    exact, z, noise
        Readings without and with noise, shape (times, sensors), and the noise standard deviation.
    """

    model: Model
    x: Array
    true: Array
    exact: Array
    z: Array
    noise: float

    @property
    def distance(self) -> Array:
        """Distance of the vertices from omega."""
        return np.maximum(np.maximum(OMEGA[0] - self.x, self.x - OMEGA[1]), 0.0)

    def error(self, values: Array) -> list[float]:
        """Return the relative error inside and outside omega."""
        wrong, inside = values - self.true, self.distance == 0.0
        return [
            float(np.linalg.norm(wrong[part]) / np.linalg.norm(self.true[part]))
            for part in (inside, ~inside)
        ]


def omega(x: Any) -> Any:
    """Return whether x is in the observed part of the domain."""
    return (x[0] > OMEGA[0]) & (x[0] < OMEGA[1])


def draw(build: Callable[[int], Model], seed: int) -> Data:
    """Simulate a field drawn from the prior, on a finer mesh and with shorter steps."""
    rng = np.random.default_rng(seed)
    model, fine = build(CELLS), build(FINE)
    root = np.linalg.inv(np.linalg.cholesky(fine.Q.gram.toarray())).T
    a = fine.latent.prior + root @ rng.standard_normal(fine.latent.dim)
    nodes = np.sort(model.mesh.p[0])
    # Sensors of the estimator: nodes of the elements within omega, including nodes at its ends.
    block, _ = model.state_space.component()
    sensors = block.doflocs[0, Subdomain(omega).selected(block)]
    G = Points(sensors.tolist()).matrix(fine.state_space)
    control = Advance(Alexander2(), dt_max=0.025)
    exact = np.array([G @ u for _, u in simulate(fine, a, 0.0, TIMES.tolist(), control)])
    noise = LEVEL * float(np.sqrt((exact**2).mean()))
    z = exact + noise * rng.standard_normal(exact.shape)
    values = _shown(fine, fine.latent.value(a))
    true = np.interp(nodes, np.sort(fine.mesh.p[0]), values)
    return Data(model, nodes, true, exact, z, noise)


def _shown(model: Model, q: Array) -> Array:
    """Return the values of the field at the sorted vertices."""
    (block,) = model.parameter_space.fields.values()
    return np.asarray(block.at_vertices @ q)[np.argsort(model.mesh.p[0])]


@dataclass(frozen=True)
class Informed(SensitivityLaw):
    """Sensitivity law in given directions, Q-orthonormal columns of shape (m, k)."""

    directions: Any = None

    def prepare(self, problem: Problem) -> SensitivityWork:
        work, k = super().prepare(problem), self.directions.shape[1]
        (evolution,) = work.filter.reduction.evolutions
        reduction = Reduction(problem, self.directions, (replace(evolution, part=slice(0, k)),))
        sensors = MemberSensors(problem, reduction)
        filter_ = replace(work.filter, reduction=reduction, sensors=sensors, rank=k, judge=None)
        if self.shadows is not None:
            parts = problem, reduction, sensors.rows, filter_.noise, filter_.stage, self.shadows
            filter_ = replace(filter_, shadows=ShadowSet.of(*parts, moves=filter_.moves))
        return replace(work, filter=filter_)


def informed(belief: Belief, model: Model, count: int) -> Array:
    """Return the directions that a belief in all modes knows best relative to its prior."""
    prior, posterior = np.asarray(belief.prior_factor), np.asarray(belief.q_factor)
    directions, _, _ = np.linalg.svd(prior.T @ model.Q.dual(posterior))  # most uncertain first
    return np.asarray(prior @ directions[:, ::-1][:, :count])


def run(data: Data, law: AnyLaw, noisy: bool = True) -> Identifier:
    """Process all samples, refit, and return the identifier."""
    seen = Subdomain(omega, noise=data.noise)
    identifier = Identifier(data.model, seen, law, u0=0.0, scheme=Alexander2())
    for t, z in zip(TIMES, data.z if noisy else data.exact, strict=True):
        STEPS.seen(identifier.step(float(t), z))
    identifier.refit()
    return identifier


@dataclass(frozen=True, eq=False)
class Score:
    """Errors inside and outside omega, hits, and widths as a share of the prior's per vertex."""

    error: list[float]
    hit: Array
    width: Array


def judge(data: Data, identifier: Identifier) -> Score:
    """Score the final estimate against the truth."""
    estimate, model = identifier.estimate(), data.model
    (name,) = model.parameter_space.fields
    low, high = (_shown(model, end) for end in estimate[name].interval())
    hit = np.where(np.isfinite(low), (low <= data.true) & (data.true <= high), np.nan)
    latent = identifier._latent_belief()
    std = np.full(latent.q.shape, np.nan) if latent.q_std is None else latent.q_std
    share = _shown(model, std) / _shown(model, np.sqrt(model.Q.variance))
    return Score(data.error(_shown(model, estimate.q)), hit, share)


def rows(data: Data) -> dict[str, Score]:
    """Return the scores of the prior and of each law for one truth."""
    model = data.model
    prior = model.latent.value(model.latent.prior)
    nothing = np.full(len(data.x), np.nan)
    scores = {"prior": Score(data.error(_shown(model, prior)), nothing, nothing)}
    if not model.form_A.differentiates("u"):  # otherwise the law refuses partial data
        gradient = GradientLaw(gain="auto")
        scores["gradient, auto, no noise"] = judge(data, run(data, gradient, noisy=False))
        scores["gradient, auto"] = judge(data, run(data, gradient))
    whole = run(data, SensitivityLaw(modes=CELLS + 1))
    for count in (6, 12):
        law = SensitivityLaw(modes=count)
        scores[f"sensitivity, {count} modes"] = judge(data, run(data, law))
        directions = informed(whole._latent_belief(), model, count)
        law = Informed(directions=directions)
        scores[f"sensitivity, {count} informed"] = judge(data, run(data, law))
    auto = SensitivityLaw(modes="auto")
    scores["sensitivity, auto"] = judge(data, run(data, auto))
    scores["sensitivity, all modes"] = judge(data, whole)
    return scores


def main(seeds: int) -> None:
    """Print one table for each process."""
    for process, build in PROCESSES.items():
        scores: dict[str, list[Score]] = {}
        for seed in range(seeds):
            data = draw(build, seed)
            for name, score in rows(data).items():
                scores.setdefault(name, []).append(score)
        far = data.distance
        parts = {"omega": far == 0.0} | {
            f"{low:g}-{high:g}": (far > low) & (far <= high + 1e-9) for low, high in pairwise(BINS)
        }
        print(f"{process}, {seeds} seeds; in each part: share in the 95 % interval, width")
        print(f"{'':26s}{'error':>8s}{'outside':>8s}" + "".join(f"{p:>14s}" for p in parts))
        for name, several in scores.items():
            errors = np.median([score.error for score in several], axis=0)
            shares = [np.mean([score.hit[at] for score in several]) for at in parts.values()]
            widths = [np.mean([score.width[at] for score in several]) for at in parts.values()]
            pairs = zip(shares, widths, strict=True)
            cells = "".join(
                f"{s:8.2f}{w:6.2f}" if np.isfinite(w) else f"{'–':>14s}" for s, w in pairs
            )
            print(f"{name:26s}{errors[0]:8.3f}{errors[1]:8.3f}{cells}", flush=True)
    STEPS.report()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
