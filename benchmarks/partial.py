"""`GradientLaw(gain="auto")` on partial data, where A is algebraic in u: a reaction.

    u_t - D Laplace(u) + q u = f   on the line or the square,   u = 0 on the boundary

with u observed for 0.2 < x < 0.8. The true q, a field or a constant, is drawn from the prior. Data
come from finite elements of this module, on a mesh four times as fine and with shorter steps of
second order. Errors are L2 errors of q relative to the error of the prior mean. They are compared
with the smallest error of eight constant gains.

The law refuses diffusivities and velocities, which fluxes at the border of u would determine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse.linalg import splu

from benchmarks.jobs import each
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import LawError
from livepde.fem import Field, Normal, Scalar, Sobolev, dot, grad, interval, linear, rectangle
from livepde.identifier import Identifier
from livepde.laws import GradientLaw, ResidualDamping
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Subdomain

D = 0.1
END, STEP = 10.0, 0.05
FINER, SUBSTEPS = 4, 5  # cells and steps of the truth per cell and step of the estimator
MEAN, STD = 3.0, 1.5  # prior of q
LEVELS = (0.0, 1e-3, 1e-2)  # noise relative to the root mean square of the readings
GAINS, DAMPINGS = (1.0, 1e2, 1e4, 1e6), (0.1, 1.0)
RATIO = 1.3  # bound on the error over the error of the best constant gain
GROWTH = 1.1  # bound on the final error over the error at half time
WORST = 1.1  # bound on the relative error of samples with status ok


def omega(x: Any) -> Any:
    """Return whether x is observed."""
    return (x[0] > 0.2) & (x[0] < 0.8)


@dataclass(frozen=True)
class Reaction:
    """Reaction process: dimension, cells of the estimator per side, and whether q is a field."""

    d: int
    cells: int
    field: bool = True

    def source(self, x: Any, t: float) -> Any:
        """Return the source f."""
        y = 1.0 if self.d == 1 else np.sin(np.pi * x[1])
        y2 = 1.0 if self.d == 1 else np.sin(2 * np.pi * x[1])
        first = 3.0 * np.sin(np.pi * x[0]) * (1.0 + 0.6 * np.sin(2.0 * t)) * y
        second = 4.0 * np.sin(2 * np.pi * x[0]) * np.cos(3.1 * t) * y
        return first + second + 3.0 * np.sin(np.pi * x[0]) * np.sin(1.3 * t + 0.5) * y2

    def start(self, x: Any) -> Any:
        """Return u at t = 0."""
        return np.sin(np.pi * x[0]) * (1.0 if self.d == 1 else np.sin(np.pi * x[1]))

    def model(self, A: Callable[..., Any] | None = None) -> Model:
        """Return the estimator's model, with the form A, default the reaction."""
        n = self.cells
        mesh = interval(0.0, 1.0, n) if self.d == 1 else rectangle((0.0, 1.0), (0.0, 1.0), (n, n))
        q: Any = Scalar(Normal(MEAN, STD))
        if self.field:
            inner = Sobolev(float(self.d), 0.3).pointwise(self.d)
            q = Field(mesh, linear(mesh), inner=inner, prior=Normal(MEAN, STD))
        return Model(
            Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}),
            q,
            A=(lambda q, u, v, x: q * u * v) if A is None else A,
            B=lambda u, v, x: D * dot(grad(u), grad(v)),
            f=self.source,
        )

    def states(self, q: Any, times: Any) -> Array:
        """Return the states at the estimator's nodes, x slowest, shape (times, nodes).

        Uses linear elements on a finer grid and the Crank-Nicolson scheme, without livepde.

        Parameters
        ----------
        q
            Values at the estimator's nodes, shape (nodes,), interpolated linearly.
        """
        n = self.cells * FINER
        grid, off = np.linspace(0.0, 1.0, n + 1), np.ones(n)
        ends = np.where((grid > 0.0) & (grid < 1.0), 2.0, 1.0)
        mass: Any = [off / 6, ends / 3, off / 6]
        stiffness: Any = [-off, ends, -off]
        M: Any = sp.diags_array(mass, offsets=[-1, 0, 1]).tocsr() / n
        K: Any = sp.diags_array(stiffness, offsets=[-1, 0, 1]).tocsr() * n
        axes = np.meshgrid(*[grid] * self.d, indexing="ij")
        x = np.array([axis.ravel() for axis in axes])
        if self.d == 2:
            M, K = sp.kron(M, M).tocsr(), (sp.kron(K, M) + sp.kron(M, K)).tocsr()
        sides = (np.linspace(0.0, 1.0, self.cells + 1),) * self.d
        rate = RegularGridInterpolator(sides, q.reshape((self.cells + 1,) * self.d))(x.T)
        weights = sp.diags_array(rate)
        L: Any = sp.csr_array(D * K + 0.5 * (weights @ M + M @ weights))
        free = np.flatnonzero(((x > 0.0) & (x < 1.0)).all(axis=0))
        shown = np.flatnonzero(np.isclose(x * self.cells, np.rint(x * self.cells)).all(axis=0))
        k, m, stiff = STEP / SUBSTEPS, M[free][:, free], L[free][:, free]
        factor, other = splu(sp.csc_matrix(m + 0.5 * k * stiff)), m - 0.5 * k * stiff
        u = self.start(x) + np.zeros(x.shape[1])
        v, states = u[free], [u[shown]]
        for t in times[:-1]:
            for part in range(SUBSTEPS):
                load = (M @ self.source(x, t + (part + 0.5) * k))[free]
                v = factor.solve(other @ v + k * load)
            u = np.zeros(x.shape[1])
            u[free] = v
            states.append(u[shown])
        return np.array(states)


@dataclass(frozen=True, eq=False)
class Readings:
    """Truth drawn from the prior, and its exact data.

    Attributes
    ----------
    model
        Model of the estimator.
    truth
        Exact parameter, shape (m,).
    times, states
        Times, and exact states in the order of the estimator's coefficients.
    """

    process: Reaction
    model: Model
    truth: Array
    times: Array
    states: Array

    @classmethod
    def drawn(cls, process: Reaction, seed: int, end: float | None = None) -> Readings:
        """Draw a truth, and simulate its data."""
        model, end = process.model(), END if end is None else end
        times: Any = STEP * np.arange(round(end / STEP) + 1)
        rng = np.random.default_rng(seed)
        root = np.linalg.inv(np.linalg.cholesky(model.Q.gram.toarray())).T
        q: Array = model.latent.prior + root @ rng.standard_normal(model.Q.dim)
        # Coefficients of linear elements have the order of the vertices, sorted by x, then y.
        order = np.lexsort(model.mesh.p[::-1])
        values = q[order] if process.field else np.full(len(order), q[0])
        states = np.empty((len(times), len(order)))
        states[:, order] = process.states(values, times)
        return cls(process, model, q, times, states)

    def noisy(self, level: float, seed: int) -> Array:
        """Return states with white noise, relative to their root mean square."""
        rng = np.random.default_rng(1000 + seed)
        size = level * float(np.sqrt((self.states**2).mean()))
        return self.states + size * rng.standard_normal(self.states.shape)

    def error(self, q: Array) -> float:
        """Return the L2 error of q relative to the error of the prior mean."""
        mass, (miss, away) = self.model.parameter_mass, (q - self.truth, self._away)
        return float(np.sqrt((miss @ (mass @ miss)) / (away @ (mass @ away))))

    @cached_property
    def _away(self) -> Array:
        return self.model.latent.prior - self.truth


@dataclass(frozen=True)
class Course:
    """Errors of q along a run: at half time, at the end, and the largest with status ok.

    Attributes
    ----------
    failed
        Number of samples with another status.
    alpha
        Largest regularisation of u_alpha; 0 without smoothing.
    """

    half: float
    last: float
    worst: float
    failed: int
    alpha: float


def follow(data: Readings, states: Array, law: GradientLaw) -> Course:
    """Run a law, and return its errors of q."""
    identifier = Identifier(data.model, Subdomain(omega), law, u0=data.process.start)
    G = identifier.observed.G
    estimates = [
        identifier.step(float(t), np.asarray(G @ u))
        for t, u in zip(data.times, states, strict=True)
    ]
    errors = [data.error(np.atleast_1d(estimate.q)) for estimate in estimates]
    ok = [estimate.status.ok for estimate in estimates]
    worst = max(error for error, good in zip(errors, ok, strict=True) if good)
    alpha = max(float(np.nan_to_num(estimate.diagnostics.alpha)) for estimate in estimates)
    return Course(errors[len(errors) // 2], errors[-1], worst, len(ok) - sum(ok), alpha)


def best(data: Readings, states: Array) -> float:
    """Return the smallest final error of the constant gains."""
    laws = (GradientLaw(gain, ResidualDamping(c1)) for gain, c1 in product(GAINS, DAMPINGS))
    return min(follow(data, states, law).last for law in laws)


PROCESSES: Mapping[str, Reaction] = {
    "line, field": Reaction(1, 40),
    "square, field": Reaction(2, 10),
    "line, number": Reaction(1, 40, field=False),
    "square, number": Reaction(2, 10, field=False),
}


def _tried(name: str, level: float, seed: int) -> tuple[Course, float]:
    """Return the errors with automatic gain, and the error of the best constant gain."""
    data = Readings.drawn(PROCESSES[name], seed)
    states = data.noisy(level, seed)
    return follow(data, states, GradientLaw(gain="auto")), best(data, states)


def partial(
    names: Sequence[str] = tuple(PROCESSES),
    levels: Sequence[float] = LEVELS,
    seeds: int = 5,
    workers: int = 2,
) -> tuple[Table, list[Check]]:
    """Return errors and checks of the law with automatic gain on partial data.

    Parameters
    ----------
    names
        Names of processes in `PROCESSES`.
    levels, seeds
        Noise levels, and number of truths for each level.
    workers
        Number of worker processes.
    """
    jobs = list(product(names, levels, range(seeds)))
    done = dict(each(_tried, jobs, "partial data", workers=workers))
    rows, checks = [], []
    for name, level in product(names, levels):
        runs = [done[name, level, seed] for seed in range(seeds)]
        courses = [course for course, _ in runs]
        ratio = max(course.last / least for course, least in runs)
        growth = max(course.last / course.half for course in courses)
        worst, failed = max(c.worst for c in courses), sum(c.failed for c in courses)
        last = [course.last for course in courses]
        rows.append((name, level, min(last), max(last), ratio, growth, worst, failed))
        where = f"partial, {name}, noise {level:g}"
        checks += [
            Check(f"{where}: error / best constant gain", ratio, RATIO, "<="),
            Check(f"{where}: error at the end / at half of the time", growth, GROWTH, "<="),
            Check(f"{where}: largest error with status ok", worst, WORST, "<="),
        ]
    columns = ("process", "noise", "least", "largest", "ratio", "growth", "worst", "failed")
    title = "Partial data, reaction: final error of q (prior mean: 1), minimum and maximum"
    return Table(title, columns, rows), [*checks, *refused()]


def refused() -> list[Check]:
    """Check that the law refuses operators with derivatives of u, and accepts reactions."""
    operators: dict[str, tuple[bool, Callable[..., Any]]] = {
        "diffusivity": (True, lambda q, u, v, x: q * dot(grad(u), grad(v))),
        "velocity": (True, lambda q, u, v, x: q * grad(u)[0] * v),
        "velocity, conservative": (True, lambda q, u, v, x: -q * u * grad(v)[0]),
        "mixed": (True, lambda q, u, v, x: q * u * v + q * dot(grad(u), grad(v))),
        "reaction": (False, lambda q, u, v, x: q * u * v),
        "bistable reaction": (False, lambda q, u, v, x: q * (u - u**3) * v),
        "source": (False, lambda q, u, v, x: -q * v),
    }
    cases = list(product(operators.values(), (False, True), (1, 2)))
    wrong = sum(_refuses(A, field, d) != expected for (expected, A), field, d in cases)
    name = f"partial: operators of {len(cases)} refused or accepted wrongly"
    return [Check(name, float(wrong), 0.0, "<=")]


def _refuses(A: Callable[..., Any], field: bool, d: int) -> bool:
    """Return whether the law refuses an operator with a message that names the other law."""
    model = Reaction(d, 8, field=field).model(A)
    try:
        Identifier(model, Subdomain(omega), GradientLaw(gain="auto"), u0=0.0)
    except LawError as error:
        return "SensitivityLaw" in str(error) and "Subdomain" in str(error)
    return False
