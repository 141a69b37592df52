"""Heat in a plate with a log-normal diffusivity and nine point sensors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from benchmarks.problems.data import Problem, Process
from livepde.fem import Field, LogNormal, Sobolev, dot, grad, linear, rectangle
from livepde.model import Model
from livepde.observation import Points
from livepde.stepping import Advance, Alexander2, simulate

TIMES = np.linspace(0.0, 20.0, 401)
POINTS = [(x, y) for x in (0.2, 0.5, 0.8) for y in (0.2, 0.5, 0.8)]
STD = 0.06
WAVES = 13  # largest j^2 + k^2 of the cosines in the exact logarithm


def _model(cells: int) -> Model:
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells))
    sides = {
        "left": lambda x, t: np.sin(1.1 * t) + 0.0 * x[0],
        "right": lambda x, t: np.sin(0.7 * t) * x[1],
        "bottom": lambda x, t: np.sin(1.1 * t) * (1 - x[0]),
        "top": lambda x, t: np.sin(1.1 * t) * (1 - x[0]) + np.sin(0.7 * t) * x[0],
    }
    a = Field(mesh, linear(mesh), inner=Sobolev(2.0, 0.3), prior=LogNormal(0.1, std=STD))
    return Model(
        Field(mesh, linear(mesh), dirichlet=sides),
        {"a": a},
        A=lambda q, u, v, x: q.a * dot(grad(u), grad(v)),
    )


def _field(seed: int) -> Callable[[Any], Any]:
    """Return a log-normal diffusivity with the covariance of the prior, as a sum of cosines."""
    rng = np.random.default_rng([seed, 0])
    waves = [(j, k) for j in range(4) for k in range(4) if j**2 + k**2 <= WAVES]
    weights = {wave: rng.standard_normal() for wave in waves}

    def value(x: Any) -> Any:
        log = 0.0 * x[0]
        for (j, k), weight in weights.items():
            norm = np.sqrt((2.0 if j else 1.0) * (2.0 if k else 1.0))
            scale = STD / 0.1 * norm / (1 + (0.3 * np.pi) ** 2 * (j**2 + k**2))
            log = log + scale * weight * np.cos(j * np.pi * x[0]) * np.cos(k * np.pi * x[1])
        return 0.1 * np.exp(log)

    return value


@cache
def _process(seed: int) -> Process:
    model, fine = _model(12), _model(24)
    points, true = Points(POINTS), {"a": _field(seed)}
    G = points.matrix(fine.state_space)
    q = fine.latent.inverse(fine.parameter_space.interpolate(true))
    control = Advance(Alexander2(), dt_max=0.025)
    run = simulate(fine, q, 0.0, TIMES.tolist(), control)
    return Process(
        model=model,
        observation=points,
        times=TIMES,
        exact=np.array([G @ u for _, u in run]),
        q_true=np.tile(model.parameter_space.interpolate(true), (len(TIMES), 1)),
        u0=0.0,
        scheme=Alexander2(),
    )


PLATE = Problem(
    name="heat2d",
    summary="Heat in a plate: log-normal diffusivity, nine point sensors",
    make=_process,
    floor=5e-3,
    modes=15,
)
