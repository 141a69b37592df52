"""The paper's equation, as it is there and excited."""

from __future__ import annotations

from functools import cache

import numpy as np

from livepde.bench.problems.data import Problem, Process
from livepde.reproduce import seed, seed_excited
from livepde.streams import Twin

__all__ = ["SEED", "SEED_EXCITED"]


def _twin(twin: Twin) -> Process:
    return Process(
        model=twin.model,
        observation=twin.observation,
        times=np.asarray(twin.times, dtype=float),
        exact=twin.exact_data,
        q_true=np.tile(twin.q, (len(twin.times), 1)),
        u0=twin.states[0],
        scheme=twin.scheme,
        weights=twin.weights,
    )


@cache
def _seed(_: int) -> Process:
    model, omega = seed.build(std=0.01)
    return _twin(
        Twin(
            model=model,
            observation=omega,
            q_true=seed.q_true,
            u_true=seed.u_true,
            times=seed.TIMES,
        )
    )


@cache
def _seed_excited(_: int) -> Process:
    model, full = seed_excited.build(std=3.0)
    return _twin(
        Twin(
            model=model,
            observation=full,
            q_true=seed_excited.q_true,
            u_true=seed_excited.u_true,
            times=seed_excited.TIMES,
        )
    )


SEED = Problem(
    name="seed",
    summary="Paper's example: q(x) from u on (0.3, 0.87), data of the same scheme",
    make=_seed,
    floor=1e-5,
    gain=1e8,
)

SEED_EXCITED = Problem(
    name="seed-excited",
    summary="The same equation, excited and fully observed, data of the same scheme",
    make=_seed_excited,
    gain=1e2,
)
