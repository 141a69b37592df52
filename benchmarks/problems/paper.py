"""Example of the paper, original and with persistent excitation."""

from __future__ import annotations

from functools import cache
from types import ModuleType

import numpy as np

from benchmarks.problems.data import Problem, Process
from livepde.reproduce import seed, seed_excited
from livepde.streams import Twin


@cache
def _twin(experiment: ModuleType, std: float) -> Process:
    """Return the twin of an experiment, with a prior standard deviation of q."""
    twin: Twin = experiment.twin_of(std)
    return Process(
        model=twin.model,
        observation=twin.observation,
        times=np.asarray(twin.times, dtype=float),
        exact=twin.exact_data,
        q_true=np.tile(twin.q, (len(twin.times), 1)),
        u0=twin.states[0],
        scheme=twin.scheme,
        halvings=0,  # the data come from whole steps, which must not be halved
        weights=twin.weights,
    )


SEED = Problem(
    name="seed",
    summary="Paper's example: q(x) from u on (0.3, 0.87), data of the same scheme",
    make=lambda _: _twin(seed, 0.01),
    floor=1e-5,
    gain=1e8,
)

SEED_EXCITED = Problem(
    name="seed-excited",
    summary="Paper's equation, excited and fully observed, data of the same scheme",
    make=lambda _: _twin(seed_excited, 3.0),
    gain=1e2,
)
