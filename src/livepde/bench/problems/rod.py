"""A rod of layers whose conductivities are unknown, and a plate of quarters: sizes to be chosen.

The truth is drawn from the prior. The ends are held at constant temperatures beside a constant
source, or they follow input channels, as in README's rod.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from livepde.bench.problems.data import Problem, Process
from livepde.fem import Channel, Field, Piecewise, dot, grad, interval, linear, rectangle
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Points
from livepde.stepping import Advance, Alexander2, simulate

__all__ = ["ENDS", "POINTS", "ROD", "ROD_SOURCE", "STEP", "ends_at", "plate", "rod"]

ENDS = ("source", "channels")
POINTS = (0.2, 0.4, 0.6, 0.8)
STEP = 2.0**-8  # a binary number: the differences of all times are exactly this
PRIOR, STD = 1.0, 0.2
SAMPLES = 300
NODES, UNKNOWNS = 101, 4


def rod(nodes: int, unknowns: int, ends: str) -> Model:
    """Return u_t = (k u_x)_x + f on (0, 1) with an unknown k in each of so many layers.

    Parameters
    ----------
    ends
        "source": f = 10 and zero at both ends. "channels": f = 0, and the temperatures of both
        ends are the channels "T_left" and "T_right".
    """
    mesh = interval(0.0, 1.0, nodes - 1)
    channels = {"left": Channel("T_left"), "right": Channel("T_right")}
    held: Mapping[str, Any] = {"boundary": 0.0} if ends == "source" else channels
    return Model(
        Field(mesh, linear(mesh), dirichlet=held),
        {
            "k": Piecewise(
                {f"k_{i}": partial(_layer, i, unknowns) for i in range(unknowns)}, PRIOR, STD
            )
        },
        A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)),
        f=10.0 if ends == "source" else 0.0,
    )


def plate(nodes: int) -> Model:
    """Return the same on a square of about so many nodes, with four unknown quarters."""
    cells = round(np.sqrt(nodes)) - 1
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells))
    quarters = {f"k_{i}{j}": partial(_quarter, i, j) for i in range(2) for j in range(2)}
    return Model(
        Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}),
        {"k": Piecewise(quarters, PRIOR, STD)},
        A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)),
        f=10.0,
    )


def ends_at(ends: str, t: float) -> dict[str, float]:
    """Return the input channels of a rod at a time."""
    if ends == "source":
        return {}
    return {"T_left": float(np.sin(3.0 * t)), "T_right": float(np.sin(5.0 * t))}


def _layer(number: int, layers: int, x: Any) -> Any:
    return np.clip(np.floor(x[0] * layers), 0, layers - 1) == number


def _quarter(i: int, j: int, x: Any) -> Any:
    return ((x[0] > 0.5) == bool(i)) & ((x[1] > 0.5) == bool(j))


@cache
def _process(ends: str, seed: int) -> Process:
    """Return the process with a truth on a mesh three times as fine, by another scheme."""
    model, fine = rod(NODES, UNKNOWNS, ends), rod(3 * (NODES - 1) + 1, UNKNOWNS, ends)
    drawn = np.random.default_rng([seed, 0]).standard_normal(UNKNOWNS)
    q: Array = PRIOR + STD * drawn
    times: Array = STEP * np.arange(SAMPLES + 1, dtype=float)
    points = Points(list(POINTS))
    control, G = Advance(Alexander2(), dt_max=STEP / 8), points.matrix(fine.state_space)
    inputs = partial(ends_at, ends)
    run = simulate(fine, fine.initial_parameter(q), 0.0, times.tolist(), control, inputs)
    return Process(
        model=model,
        observation=points,
        times=times,
        exact=np.array([G @ u for _, u in run]),
        q_true=np.tile(q, (len(times), 1)),
        u0=0.0,
        inputs=[inputs(t) for t in times.tolist()],
    )


def _problem(name: str, ends: str, summary: str) -> Problem:
    return Problem(name=name, summary=summary, make=partial(_process, ends), floor=3e-3)


ROD = _problem("rod", "channels", "Rod of four layers between two channels, four point sensors")
ROD_SOURCE = _problem("rod-source", "source", "The same with constant ends and a constant source")
