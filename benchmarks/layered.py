"""Models of a layered rod and of a plate with four quarters, with unknown conductivities.

The ends have constant temperatures, with a constant source, or follow input channels, such as the
rod of the README. `benchmarks.earlier` builds these models with the sources of an earlier version.
Therefore this module imports only names that exist in both versions.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from livepde.fem import Channel, Field, Normal, Piecewise, dot, grad, interval, linear, rectangle
from livepde.model import Model

ENDS = ("source", "channels")
POINTS = (0.2, 0.4, 0.6, 0.8)
STEP = 2.0**-8  # time step; a power of two, so that differences of times are exact
PRIOR, STD = 1.0, 0.2


def rod(nodes: int, unknowns: int, ends: str) -> Model:
    """Return the model u_t = (k u_x)_x + f on (0, 1) with an unknown k in each layer.

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
                {f"k_{i}": partial(_layer, i, unknowns) for i in range(unknowns)},
                Normal(PRIOR, STD),
            )
        },
        A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)),
        f=10.0 if ends == "source" else 0.0,
    )


def plate(nodes: int) -> Model:
    """Return u_t = div(k grad u) + 10 on a square with u = 0 around it and k unknown by quarter."""
    cells = round(np.sqrt(nodes)) - 1
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells))
    quarters = {f"k_{i}{j}": partial(_quarter, i, j) for i in range(2) for j in range(2)}
    return Model(
        Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}),
        {"k": Piecewise(quarters, Normal(PRIOR, STD))},
        A=lambda q, u, v, x: q.k * dot(grad(u), grad(v)),
        f=10.0,
    )


def ends_at(ends: str, t: float) -> dict[str, float]:
    """Return the values of a rod's input channels at a time."""
    if ends == "source":
        return {}
    return {"T_left": float(np.sin(3.0 * t)), "T_right": float(np.sin(5.0 * t))}


def _layer(number: int, layers: int, x: Any) -> Any:
    return np.clip(np.floor(x[0] * layers), 0, layers - 1) == number


def _quarter(i: int, j: int, x: Any) -> Any:
    return ((x[0] > 0.5) == bool(i)) & ((x[1] > 0.5) == bool(j))
