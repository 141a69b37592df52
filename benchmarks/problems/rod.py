"""Rods of four layers with conductivities drawn from the prior (see `benchmarks.layered`)."""

from __future__ import annotations

from functools import cache, partial

import numpy as np

from benchmarks.layered import POINTS, PRIOR, STD, STEP, ends_at, rod
from benchmarks.problems.data import Problem, Process
from livepde.linalg import Array
from livepde.observation import Points
from livepde.stepping import Advance, Alexander2, simulate

SAMPLES = 300
NODES, UNKNOWNS = 101, 4


@cache
def _process(ends: str, seed: int) -> Process:
    """Return the process with a truth by another scheme on a mesh three times as fine."""
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
ROD_SOURCE = _problem("rod-source", "source", "Rod of four layers with constant ends and source")
