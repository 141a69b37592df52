"""Three jumps of one unknown among several: found as well as if all may jump, the rest is kept."""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy.linalg as sla
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import livepde as lp
from benchmarks.refit.elements import interpolation
from livepde.models import advection_dispersion

Array = NDArray[Any]
AT = (80, 140, 200)  # samples before which the unknown v jumps
SAMPLES = 260
FINE = 120  # cells of the truths
SOON = 15  # samples within which an alarm is that of a jump
LEVELS = (0.6, 2.0)  # between which v is drawn
CHANGE = 1.3  # least factor of a jump


@dataclass(frozen=True, eq=False)
class JumpTrial:
    """Scores of one truth.

    Attributes
    ----------
    process, seed
        The process, and which of its truths.
    one, every
        Jumps that are found if v alone may jump, and if all unknowns may.
    shift
        Largest distance of the constant from its estimate before the first jump, once each jump has
        been learned, in standard deviations of that estimate.
    widest
        Largest standard deviation of the constant then over that before the first jump.
    """

    process: str
    seed: int
    one: int
    every: int
    shift: float
    widest: float


class Jumping(ABC):
    """A process with the unknown v, which jumps, and a constant.

    Attributes
    ----------
    constant
        Label of the unknown that stays as it is.
    step, noise
        Time between two samples, and the standard deviation of the readings.
    points
        Places of the sensors.
    u0
        Initial state.
    """

    constant: str
    step: float
    noise: float
    points: tuple[float, ...]
    u0 = 0.0

    @abstractmethod
    def system(self, v: float) -> tuple[Array, Array]:
        """Return A and B of the truth y' = A y + B g: finite volumes about nodes."""

    @abstractmethod
    def model(self) -> lp.Model:
        """Return the model as a user of livepde writes it."""

    @property
    @abstractmethod
    def length(self) -> float:
        """Length of the rod or column."""

    def signal(self, t: Array) -> Array:
        """Return the input g; it is straight between samples."""
        return np.ones_like(t)

    def inputs(self, t: float) -> Mapping[str, float]:
        """Return the input channels at a sample."""
        return {}

    def shown(self, levels: Array) -> Array:
        """Return what the sensors show, shape (samples, sensors), for v before each sample."""
        seen = interpolation(np.array(self.points), FINE, 0.0, self.length)[:, : self._nodes]
        y, found = np.full(self._nodes, self.u0), []
        g = self.signal(self.step * np.arange(len(levels) + 1))
        for n, v in enumerate(levels.tolist()):
            once, first, last = self._response(v)
            y = once @ y + first * g[n] + last * g[n + 1]
            found.append(seen @ y)
        return np.array(found)

    @property
    def _nodes(self) -> int:
        return FINE + 1

    @cache  # noqa: B019  as many processes as there are classes
    def _response(self, v: float) -> tuple[Array, Array, Array]:
        """Return the exact response of a step to the state and to the inputs at both ends."""
        A, B = self.system(v)
        n = len(A)
        block = np.zeros((n + 2, n + 2))
        block[:n, :n], block[:n, n], block[n, n + 1] = A * self.step, B * self.step, 1.0
        found = sla.expm(block)
        return found[:n, :n], found[:n, n] - found[:n, n + 1], found[:n, n + 1]


class Rod(Jumping):
    """u_t = k u_xx with the flux v on the left and u = 0 on the right."""

    constant, step, noise, points = "k", 0.05, 2e-3, (0.1, 0.3, 0.6)
    K = 0.2

    length = 1.0

    def system(self, v: float) -> tuple[Array, Array]:
        h, n = self.length / FINE, self._nodes
        A = self.K / h**2 * (np.eye(n, k=1) + np.eye(n, k=-1) - 2.0 * np.eye(n))
        A[0] *= 2.0  # half of a volume
        A[0, 0] /= 2.0
        A[-1] = 0.0
        B = np.zeros(n)
        B[0] = 2.0 * v / h
        return A, B

    def model(self) -> lp.Model:
        mesh = lp.interval(0.0, 1.0, 20)
        return lp.Model(
            lp.Field(mesh, lp.linear(mesh), dirichlet={"right": 0.0}),
            {"k": lp.LogNormal(0.3, 0.15), "v": lp.Normal(1.0, 1.0)},
            A=[
                lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
                lp.On("left", lambda q, u, v, x: -q.v * v),
            ],
        )


class Column(Jumping):
    """c_t = D c_xx - v c_x, fed on the left."""

    constant, step, noise, points = "D", 0.16, 0.02, (2.0, 5.0, 8.0)
    D = 0.5

    length = 10.0

    def system(self, v: float) -> tuple[Array, Array]:
        h, n = self.length / FINE, self._nodes
        one = np.eye(n)
        # Fluxes through the faces between nodes, and on the right, where c goes with the water.
        flux = 0.5 * v * (one[1:] + one[:-1]) - self.D / h * (one[1:] - one[:-1])
        flux = np.vstack([0.0 * one[:1], flux, v * one[-1:]])
        volume = np.full(n, h)
        volume[[0, -1]] = 0.5 * h
        return -np.diff(flux, axis=0) / volume[:, None], v / volume[0] * one[0]

    def signal(self, t: Array) -> Array:
        turn = 2 * np.pi * t / 40.0
        return np.asarray(0.7 * np.sin(2 * turn) + 0.5 * np.sin(5 * turn) + 0.3 * np.sin(11 * turn))

    def inputs(self, t: float) -> Mapping[str, float]:
        return {"c_in": float(self.signal(np.array(t)))}

    def model(self) -> lp.Model:
        mesh = lp.interval(0.0, self.length, 40)
        return advection_dispersion(mesh, lp.LogNormal(0.4, std=0.2), lp.LogNormal(1.0, std=0.4))


PROCESSES: Mapping[str, Jumping] = {"rod": Rod(), "column": Column()}


def _levels(rng: np.random.Generator) -> Array:
    """Return v before each sample: four levels, each well apart from the one before."""
    levels = [1.0]
    while len(levels) <= len(AT):
        level = float(np.exp(rng.uniform(*np.log(LEVELS))))
        if abs(np.log(level / levels[-1])) > np.log(CHANGE):
            levels.append(level)
    return np.array(levels)[np.searchsorted(AT, np.arange(SAMPLES), side="right")]


def jump_trials(seed: int) -> list[JumpTrial]:
    """Run one truth of each process; the same seed gives the same numbers."""
    found = []
    for name, process in PROCESSES.items():
        rng = np.random.default_rng([zlib.crc32(f"jumps {name}".encode()), seed])
        shown = process.shown(_levels(rng))
        z = shown + process.noise * rng.standard_normal(shown.shape)
        with threadpool_limits(1):
            one, constant, std = _run(process, lp.Jumps(unknowns=("v",)), z)
            every, *_ = _run(process, lp.Jumps(), z)
        before, *later = [at - 1 for at in (*AT, SAMPLES)]
        shift = float(np.abs(constant[later] - constant[before]).max() / std[before])
        widest = float(std[later].max() / std[before])
        found.append(JumpTrial(name, seed, one, every, shift, widest))
    return found


def _run(process: Jumping, jumps: lp.Jumps, z: Array) -> tuple[int, Array, Array]:
    """Return how many jumps are found, and estimates of the constant with standard deviations."""
    sensors = lp.Points(list(process.points), noise=process.noise)
    law = lp.SensitivityLaw(jumps=jumps)
    identifier = lp.Identifier(process.model(), sensors, law, u0=process.u0)
    if identifier.inputs:
        identifier.step(0.0, np.full(len(process.points), np.nan), process.inputs(0.0))
    alarms, known = [], []
    for n, row in enumerate(z, start=1):
        t = n * process.step
        estimate = identifier.step(t, row, process.inputs(t))
        alarms.append(bool(estimate.diagnostics.jump > 0.0))
        known.append(estimate.parameters[process.constant])
    found = sum(any(alarms[at : at + SOON]) for at in AT)
    return found, *np.array(known).T
