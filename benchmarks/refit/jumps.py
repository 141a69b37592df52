"""Three jumps of one unknown among several: found as well as if all may jump, the rest is kept."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg as sla
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import livepde as lp

__all__ = ["JumpTrial", "jump_trial"]

Array = NDArray[Any]
AT = (80, 140, 200)  # samples before which the flux jumps
SAMPLES = 260
STEP = 0.05
CELLS, FINE = 20, 120
K = 0.2
NOISE = 2e-3
POINTS = (0.1, 0.3, 0.6)
SOON = 15  # samples within which an alarm is that of a jump
LEVELS = (0.6, 3.0)  # of the flux
CHANGE = 1.3  # least factor of a jump


@dataclass(frozen=True, eq=False)
class JumpTrial:
    """Scores of one truth.

    Attributes
    ----------
    seed
        Of the truth.
    one, every
        Jumps that are found if the flux alone may jump, and if all unknowns may.
    shift
        Largest distance of the constant from its estimate before the first jump, while later jumps
        are learned, in standard deviations of that estimate.
    widest
        Largest standard deviation of the constant after the first jump over that before.
    """

    seed: int
    one: int
    every: int
    shift: float
    widest: float


class _Rod:
    """u_t = k u_xx with the flux v on the left and u = 0 on the right, by finite volumes."""

    @cached_property
    def _step(self) -> tuple[Array, Array]:
        """Exact response of a step to the state and to a constant flux."""
        h = 1.0 / FINE
        A = K / h**2 * (np.eye(FINE, k=1) + np.eye(FINE, k=-1) - 2.0 * np.eye(FINE))
        # Volumes about the nodes; the first one is half of the others.
        A[0] = K / h**2 * (2.0 * np.eye(FINE)[1] - 2.0 * np.eye(FINE)[0])
        block = np.zeros((FINE + 1, FINE + 1))
        block[:FINE, :FINE], block[0, FINE] = A * STEP, 2.0 / h * STEP
        found = sla.expm(block)
        return found[:FINE, :FINE], found[:FINE, FINE]

    def shown(self, levels: Array) -> Array:
        """Return what the sensors show, shape (samples, sensors), for the flux before each."""
        once, response = self._step
        u, found = np.zeros(FINE), []
        for level in levels:
            u = once @ u + response * level
            found.append(u[[round(x * FINE) for x in POINTS]])
        return np.array(found)


ROD = _Rod()


def _flux(rng: np.random.Generator) -> Array:
    """Return the flux before each sample: four levels, each well apart from the one before."""
    levels = [1.0]
    while len(levels) <= len(AT):
        level = float(np.exp(rng.uniform(*np.log(LEVELS))))
        if abs(np.log(level / levels[-1])) > np.log(CHANGE):
            levels.append(level)
    return np.array(levels)[np.searchsorted(AT, np.arange(SAMPLES), side="right")]


def _identifier(jumps: lp.Jumps) -> lp.Identifier:
    mesh = lp.interval(0.0, 1.0, CELLS)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"right": 0.0}),
        {"k": lp.LogNormal(0.3, 0.15), "v": lp.Normal(1.0, 1.0)},
        A=[
            lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("left", lambda q, u, v, x: -q.v * v),
        ],
    )
    law = lp.SensitivityLaw(jumps=jumps)
    return lp.Identifier(model, lp.Points(list(POINTS), noise=NOISE), law, u0=0.0)


def jump_trial(seed: int) -> JumpTrial:
    """Run one truth; the same seed gives the same numbers."""
    rng = np.random.default_rng([zlib.crc32(b"jumps"), seed])
    shown = ROD.shown(_flux(rng))
    z = shown + NOISE * rng.standard_normal(shown.shape)
    with threadpool_limits(1):
        one, k, std = _run(lp.Jumps(unknowns=("v",)), z)
        every, *_ = _run(lp.Jumps(), z)
    before = AT[0] - 1
    shift = float(np.abs(k[AT[0] :] - k[before]).max() / std[before])
    return JumpTrial(seed, one, every, shift, float(std[AT[0] :].max() / std[before]))


def _run(jumps: lp.Jumps, z: Array) -> tuple[int, Array, Array]:
    """Return how many jumps are found, and estimates of k with their standard deviations."""
    alarms, k = [], []
    identifier = _identifier(jumps)
    for n, row in enumerate(z):
        estimate = identifier.step((n + 1) * STEP, row)
        alarms.append(bool(estimate.diagnostics.jump > 0.0))
        k.append(estimate.parameters["k"])
    found = sum(any(alarms[at : at + SOON]) for at in AT)
    return found, *np.array(k).T
