"""Checks of `GradientLaw(gain="auto")`: refused partial data, near-best gain, full data."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.partial import (
    GROWTH,
    LEVELS,
    PROCESSES,
    RATIO,
    STEP,
    Reaction,
    Readings,
    best,
    follow,
    refused,
)
from livepde.diagnostics.check_report import Check
from livepde.fem import Field, LogNormal, Scalar, dot, grad, interval, linear
from livepde.identifier import Identifier
from livepde.laws import GradientLaw
from livepde.model import Model
from livepde.observation import Full
from livepde.stepping import Alexander2

DIFFUSIVITY = 0.1  # of the data that `benchmarks.partial` generates for q = 0
CLOSE = 0.05  # bound on its relative error from full data; measured 0.027


def checks() -> list[Check]:
    """Return the checks of the self-tuning gradient law."""
    return [*refused(), *_reaction(), _full()]


def _reaction() -> list[Check]:
    """Check that a noisy run is close to the best gain, does not drift, and is not smoothed."""
    data, level = Readings.drawn(PROCESSES["line, field"], 0), LEVELS[-1]
    states = data.noisy(level, 0)
    run = follow(data, states, GradientLaw(gain="auto"))
    return [
        Check(
            "partial, 1 % noise: error / best constant gain",
            run.last / best(data, states),
            RATIO,
            "<=",
        ),
        Check("partial, 1 % noise: error at the end / at half", run.last / run.half, GROWTH, "<="),
        Check("partial, 1 % noise: error / that of the prior mean", run.last, 1.0, "<="),
        Check("partial, 1 % noise: failed steps", float(run.failed), 0.0, "<="),
        Check("partial, 1 % noise: largest alpha of a smoothing", run.alpha, 0.0, "<="),
    ]


def _full() -> Check:
    """Check that the law estimates a diffusivity from full data."""
    process = Reaction(1, 40)
    mesh = interval(0.0, 1.0, process.cells)

    def diffusion(q: Any, u: Any, v: Any, x: Any) -> Any:
        return q * dot(grad(u), grad(v))

    model = Model(
        Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}),
        Scalar(LogNormal(0.06, std=0.04)),
        A=diffusion,
        f=process.source,
    )
    times = STEP * np.arange(101)
    nodes = np.argsort(mesh.p[0])
    states = np.empty((len(times), len(nodes)))
    states[:, nodes] = process.states(np.zeros(len(nodes)), times)
    law, scheme = GradientLaw(gain="auto"), Alexander2()
    identifier = Identifier(model, Full(), law, u0=process.start, scheme=scheme)
    for t, u in zip(times, states, strict=True):
        estimate = identifier.step(float(t), identifier.observed.G @ u)
    miss = abs(float(np.squeeze(estimate.q)) / DIFFUSIVITY - 1.0)
    return Check("full data: relative error of a diffusivity", miss, CLOSE, "<=")
