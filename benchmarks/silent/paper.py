"""Checks of the paper's law: roots far from the start, the figure's shift, reduced models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.control import reduce
from livepde.diagnostics.check_report import Check
from livepde.errors import ConfigurationError, ModelError
from livepde.fem import Channel, Field, Normal, dot, grad, interval, linear
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Points
from livepde.reproduce import boiger2016, seed

FAR = (3, 106)  # seed of the noise, and samples up to a stage whose root is 1.7e6 from its start
DENSE = 1e-7  # bound on the residual in dense equations over their largest term; measured 3e-9
STATIC = 0.01  # relative error of a static response, on 16 cells


def checks() -> list[Check]:
    """Return the checks of the paper's law."""
    return [*_far(), *_shift(), *_reduced()]


# --- a stage of (est_exact_u), (est_exact_q) in NumPy --------------------------------------------


@dataclass(frozen=True)
class Dense:
    """Cubic Hermite functions of section 4 on (0, 1) as dense matrices; value, slope per node."""

    cells: int = seed.N - 1

    def rows(self) -> tuple[Array, Array, Array, Array]:
        """Return quadrature points and weights, and values and slopes of all basis functions."""
        xi, w = np.polynomial.legendre.leggauss(6)
        s, h = 0.5 * (xi + 1.0), 1.0 / self.cells
        local = [
            (1 - 3 * s**2 + 2 * s**3, (-6 * s + 6 * s**2) / h),
            (h * (s - 2 * s**2 + s**3), 1 - 4 * s + 3 * s**2),
            (3 * s**2 - 2 * s**3, (6 * s - 6 * s**2) / h),
            (h * (s**3 - s**2), 3 * s**2 - 2 * s),
        ]
        size, count = 2 * self.cells + 2, len(s)
        v, dv = np.zeros((2, self.cells * count, size))
        for cell in range(self.cells):
            at = slice(cell * count, (cell + 1) * count)
            for k, (value, slope) in enumerate(local):
                v[at, 2 * cell + k], dv[at, 2 * cell + k] = value, slope
        x = (np.arange(self.cells)[:, None] + s).ravel() * h
        return x, np.tile(0.5 * h * w, self.cells), v, dv

    def residual(self, before: tuple[Any, Any], after: tuple[Any, Any], z: Any, t: float) -> float:
        """Return the residual of a step of size 0.6 with gain 100 and constant mu = 1.

        Parameters
        ----------
        before, after
            (u, q) at the start and at the end of the step.
        z
            Measured coefficients on omega, zero elsewhere.
        """
        (x, weights, v, dv), h, gain, mu, floor = self.rows(), 0.6, 100.0, 1.0, 1e-3
        # omega is the union of the cells within (0.3, 0.87).
        cell = np.floor(x * self.cells) / self.cells
        inside = (cell > 0.3 - 1e-9) & (cell + 1.0 / self.cells < 0.87 + 1e-9)
        free = np.ones(v.shape[1], dtype=bool)
        free[[0, 1, -2, -1]] = False

        def form(left: Any, density: Any, right: Any) -> Any:
            return np.asarray(left.T @ ((weights * density)[:, None] * right))

        one, own, rest = np.ones(len(x)), 1.0 * inside, 1.0 * ~inside
        seen, (u, q) = np.abs(v[inside]).max(axis=0) > 0.0, after
        M = form(v, one, v)
        M_op = form(v, own, v) + form(dv, own, dv)
        r = np.where(seen, u, 0.0) - z
        w = np.where(seen, z, u)
        tests = free & ~(np.abs(v[~inside]).max(axis=0) > 0.0)
        part = np.ix_(tests, tests)

        def squared(a: Array) -> float:
            functional = (M_op @ a)[tests]
            return float(functional @ np.linalg.solve(M[part], functional))

        theta = mu / np.sqrt(squared(r) + floor**2 * squared(z))
        value = v @ q
        first = [
            M @ (u - before[0]) / h,
            form(dv, own, dv) @ w + form(dv, rest, dv) @ u,
            form(v, own * value, v) @ w + form(v, rest * value, v) @ u,
            np.where(seen, theta * (M_op @ r), 0.0),
            -v.T @ (weights * seed.f([x], t)),
        ]
        G = form(v, one, v) + form(dv, one, dv)
        second = [G @ (q - before[1]) / (gain * h), -form(v, own * (v @ w), v) @ r]
        left = (
            np.abs(np.sum(line, axis=0)[free]).max()
            / max(np.abs(term[free]).max() for term in line)
            for line in (first, second)
        )
        return float(max(left))


def _far() -> list[Check]:
    """Check a run with 1 % nodal noise and constant mu, whose last root is far from its start."""
    number, count = FAR
    case, variant = boiger2016.paper_case(), boiger2016.PAPER["nodal, mu = 1"]
    twin = case.twin
    identifier = Identifier(
        twin.model, twin.observation, variant.law, q0=0.0, u0=case.start, halvings=0
    )
    samples = list(case.samples(variant.noise, boiger2016.LEVELS[0], number))[:count]
    estimates = [identifier.step(sample.t, np.asarray(sample.z)) for sample in samples]
    before, after = ((np.asarray(e.u), np.asarray(e.q)) for e in estimates[-2:])
    z = np.asarray(twin.observed.G.T @ np.asarray(samples[-1].z))
    size = Dense().residual(before, after, z, samples[-1].t)
    failed = sum(not estimate.status.ok for estimate in estimates)
    return [
        Check(f"paper, nodal noise 1 %: failed steps of {count}", float(failed), 0.0, "<="),
        Check("paper, root 1.7e6 from the start: residual in dense equations", size, DENSE, "<="),
    ]


def _shift() -> list[Check]:
    """Check that q = 0, q* and a small shifted q* fail the test of the paper's figure."""
    x, (low, high) = np.linspace(0.0, 1.0, 61), seed.SHIFTED
    nothing, exact = np.zeros(61), seed.q_true([x])
    passed = [low <= seed.shift(x, q) <= high for q in (nothing, exact, 1e-3 * (exact - x * exact))]
    # The first moment about 1/2 of a parabola with zeros 0.06 and 1 is known.
    moved = 0.025 * (x - 0.06) * (x - 1.0)
    integral = 0.025 * np.array([(1 / 4 - 1.06 / 3 + 0.03), (1 / 3 - 1.06 / 2 + 0.06)])
    right = (integral[0] - 0.5 * integral[1]) / (-0.025 / 6)
    return [
        Check(
            "paper, shift of q: estimates that learned nothing and pass",
            float(sum(passed)),
            0.0,
            "<=",
        ),
        Check("paper, shift of a moved parabola", seed.shift(x, moved) / right, (0.99, 1.01), "in"),
    ]


def _reduced() -> list[Check]:
    """Check a reduced model of u_t = (D0 (1 + b u) u_x)_x about its steady state.

    In the steady state with u = hot at the left and u = 0 at the right, u + b u^2/2 is linear in x.
    """
    mesh, D0, b, hot = interval(0.0, 1.0, 16), 0.1, 0.5, 1.0
    model = Model(
        Field(mesh, linear(mesh), dirichlet={"left": Channel("hot"), "right": 0.0}),
        {"b": Normal(b, 0.2)},
        A=lambda q, u, v, x: D0 * q.b * u * dot(grad(u), grad(v)),
        B=lambda u, v, x: D0 * dot(grad(u), grad(v)),
    )

    def steady(x: Array) -> Array:
        theta = (hot + b * hot**2 / 2) * (1.0 - x)
        return np.asarray((np.sqrt(1.0 + 2.0 * b * theta) - 1.0) / b)

    refusals = 0
    for u in (None, 0.0):
        try:
            reduce(model, Points({"middle": 0.5}), ["hot"], u=u)
        except (ConfigurationError, ModelError):
            refusals += 1
    small = reduce(
        model,
        Points({"middle": 0.5}),
        ["hot"],
        u=lambda x: steady(x[0]),
        inputs={"hot": hot},
    )
    K, E, f = small.system(np.array([b]))
    response = (small.outputs.C @ np.linalg.solve(K, E) + small.outputs.D)[0, 0]
    middle = float(steady(np.array(0.5)))
    # Derivatives of u + b u^2/2 = (hot + b hot^2/2)/2 with respect to hot and b.
    by_hot = 0.5 * (1.0 + b * hot) / (1.0 + b * middle)
    by_b = (hot**2 / 4 - middle**2 / 2) / (1.0 + b * middle)
    c, change = np.array([hot]), 1e-3
    ends = []
    for value in (b - change, b + change):
        K, E, f = small.system(np.array([value]))
        ends.append(small.outputs(np.linalg.solve(K, E @ c + f), c)[0])
    slope = (ends[1] - ends[0]) / (2 * change)
    return [
        Check(
            "reduce: models linearised without an operating point, or where b vanishes",
            2.0 - refusals,
            0.0,
            "<=",
        ),
        Check(
            "reduce: static response to the control / exact",
            response / by_hot,
            (1 - STATIC, 1 + STATIC),
            "in",
        ),
        Check("reduce: static response to b / exact", slope / by_b, (1 - STATIC, 1 + STATIC), "in"),
    ]
