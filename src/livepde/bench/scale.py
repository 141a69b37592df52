"""How the coupled step of large problems scales: iterations of its systems by blocks.

One stage of the paper's law on a square, u observed everywhere and q a field of the same mesh, with
linear systems solved to 1e-8. Counted are the iterations of the first of them, with new factors,
without damping and with c_1 = 1: they grow with the gain, and with theta M_op, and hardly with the
mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from livepde.errors import ConfigurationError
from livepde.fem import Field, Moment, dot, grad, linear, rectangle
from livepde.laws import ResidualDamping
from livepde.laws.coupled import CoupledStage, Gains
from livepde.model import Model, h1_form
from livepde.observation import Full
from livepde.runs.outcome import Check, Outcome, Table
from livepde.stepping import Newton
from livepde.stepping.newton import StepFailed

__all__ = ["SIZES", "scale"]

SIZES = (2_500, 10_000)  # nodes
TOLERANCE = 1e-8
STEP = 0.05
# (c_1, gain) -> iterations that the first system may take
BOUNDS = {
    (0.0, 1.0): 4,
    (0.0, 1e2): 5,
    (0.0, 1e4): 8,
    (0.0, 1e6): 14,
    (1.0, 1.0): 5,
    (1.0, 1e2): 6,
    (1.0, 1e4): 17,
    (1.0, 1e6): 45,
}


def scale(sizes: Sequence[int] = SIZES) -> Outcome:
    """Count iterations at several gains.

    Parameters
    ----------
    sizes
        Numbers of nodes of the square: each has a value of u and one of q.
    """
    rows, checks = [], []
    for size in sizes:
        model = _square(size)
        for (c1, gain), bound in BOUNDS.items():
            count, engines = _iterations(model, c1, gain)
            rows.append((model.X.dim, c1, gain, count, *engines))
            name = f"{model.X.dim} nodes, c1 {c1:g}, gain {gain:g}: iterations"
            checks.append(Check(name, count, bound, "<="))
    title = f"The first system of a coupled stage by blocks, to {TOLERANCE:.0e}"
    columns = ("nodes", "c1", "gain", "iterations", "engine of S", "engine of C")
    return Outcome(tables=[Table(title, columns, rows)], checks=checks)


def _square(size: int) -> Model:
    cells = round(np.sqrt(size)) - 1
    mesh = rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells)).to_meshtri()
    return Model(
        state=Field(mesh, linear(mesh), dirichlet={"boundary": 2.0}),
        parameter=Field(mesh, linear(mesh), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: dot(grad(u), grad(v)),
        f=lambda x, t: 10.0 * (1.0 + x[0]),
    )


def _bump(x: Any) -> Any:
    return 2.0 + x[0] * (1.0 - x[0]) * x[1] * (1.0 - x[1])


def _iterations(model: Model, c1: float, gain: float) -> tuple[int, tuple[str, str]]:
    """Return the iterations of a stage's first system, and the names of the engines."""
    observed = Full().bind(model.state_space, model.X, model.parameter_space)
    M_op = model.bilinear(h1_form)
    gains = Gains(gain, ResidualDamping(c1), 0.0, 0.0, M_op, M_op)
    stage = CoupledStage(model, observed.split(), gains, Newton(iterations=1))
    blocks = stage.by_blocks
    if blocks is None:
        raise ConfigurationError(
            f"bench scale: a problem with {model.X.dim} nodes is not solved by blocks; take more."
        )
    blocks.tolerance = TOLERANCE
    u = model.initial(_bump)
    c = np.concatenate([u, model.initial_parameter(0.5)])
    with suppress(StepFailed):  # one update is all that is wanted
        stage.solve(c, STEP, Moment(STEP), observed.split().R @ u, c.copy())
    return blocks.iterations[0], blocks.engines
