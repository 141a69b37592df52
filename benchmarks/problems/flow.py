"""Burgers' equation with a viscosity that is a random walk."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.problems.data import Problem, Process
from livepde.fem import Field, LogNormal, Normal, RandomWalk, Scalar, dot, grad, hermite, interval
from livepde.model import Model
from livepde.models import burgers
from livepde.observation import Points
from livepde.stepping import Advance, Alexander2, simulate

TIMES = np.linspace(0.0, 20.0, 401)
RATE = 0.1  # rate of the random walk of the logarithm, per square root of time
POINTS = [0.25, 0.5, 0.75]
SIDES: dict[str, Any] = {
    "left": lambda x, t: 0.5 + 0.5 * np.sin(2.0 * t) + 0.0 * x[0],
    "right": 0.0,
}


def _u0(x: Any) -> Any:
    return 0.5 * (1.0 - x[0])


@cache
def _process(seed: int) -> Process:
    nu = Scalar(LogNormal(0.1, 0.05), evolution=RandomWalk(RATE))
    model = burgers(interval(0.0, 1.0, 32), nu, dirichlet=SIDES)
    rng = np.random.default_rng([seed, 0])
    gained = RATE * np.sqrt(np.diff(TIMES, prepend=TIMES[0]))
    gained[0] = 0.5  # prior standard deviation of the logarithm
    path = 0.1 * np.exp(np.cumsum(gained * rng.standard_normal(len(TIMES))))
    mesh = interval(0.0, 1.0, 96)
    fine = Model(
        Field(mesh, hermite(mesh), dirichlet=SIDES),
        {"a": Normal(1.0, 1.0)},
        A=lambda q, u, v, x: q.a * u * grad(u)[0] * v + x.inputs["nu"] * dot(grad(u), grad(v)),
        inputs=["nu"],
    )
    points = Points(POINTS)
    G = points.matrix(fine.state_space)

    def inputs(t: float) -> dict[str, float]:
        return {"nu": float(np.interp(t, TIMES, path))}

    control = Advance(Alexander2(), dt_max=0.0125)
    run = simulate(fine, np.ones(1), _u0, TIMES.tolist(), control, inputs)
    return Process(
        model=model,
        observation=points,
        times=TIMES,
        exact=np.array([G @ u for _, u in run]),
        q_true=path[:, None],
        u0=_u0,
        scheme=Alexander2(),
    )


FLOW = Problem(
    name="burgers-varying",
    summary="Burgers' equation with a moving viscosity, three point sensors",
    make=_process,
    floor=3e-3,
    varying=True,
)
