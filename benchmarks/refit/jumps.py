"""Detection of three jumps of one unknown while a second unknown remains constant."""

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
AT = (80, 140, 200)  # the unknown v jumps before these samples
SAMPLES = 260
FINE = 120  # cells of the truths
SOON = 15  # samples within which an alarm is attributed to a jump
LEVELS = (0.6, 2.0)  # range of v
CHANGE = 1.3  # smallest factor of a jump


@dataclass(frozen=True, eq=False)
class JumpTrial:
    """Scores of one truth.

    Attributes
    ----------
    process, seed
        Name of the process, and seed of the truth.
    one, every
        Number of detected jumps if only v may jump, and if all unknowns may jump.
    shift
        Largest distance between the estimates of the constant after and before the first jump, in
        standard deviations of the latter. Estimates after a jump are from before the next jump.
    widest
        Largest standard deviation of these later estimates over the one before the first jump.
    """

    process: str
    seed: int
    one: int
    every: int
    shift: float
    widest: float


class Jumping(ABC):
    """Process with an unknown v that jumps, and a constant unknown.

    Attributes
    ----------
    constant
        Label of the constant unknown.
    step, noise
        Time between two samples, and standard deviation of the readings.
    points
        Positions of the sensors.
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
        """Return A and B of the truth y' = A y + B g, by vertex-centred finite volumes."""

    @abstractmethod
    def model(self) -> lp.Model:
        """Return the model as a user of livepde would write it."""

    @property
    @abstractmethod
    def length(self) -> float:
        """Length of the rod or column."""

    def signal(self, t: Array) -> Array:
        """Return the input g, which is linear between samples."""
        return np.ones_like(t)

    def inputs(self, t: float) -> Mapping[str, float]:
        """Return the input channels at a sample."""
        return {}

    def shown(self, levels: Array) -> Array:
        """Return the readings without noise, shape (samples, sensors), for v before each sample."""
        seen = interpolation(np.array(self.points), FINE, 0.0, self.length)[:, : self._nodes]
        y, shown = np.full(self._nodes, self.u0), []
        g = self.signal(self.step * np.arange(len(levels) + 1))
        for n, v in enumerate(levels.tolist()):
            once, first, last = self._response(v)
            y = once @ y + first * g[n] + last * g[n + 1]
            shown.append(seen @ y)
        return np.array(shown)

    @property
    def _nodes(self) -> int:
        return FINE + 1

    @cache  # noqa: B019  as many processes as there are classes
    def _response(self, v: float) -> tuple[Array, Array, Array]:
        """Return the exact responses of a step to the state and to the inputs at its two ends."""
        A, B = self.system(v)
        n = len(A)
        block = np.zeros((n + 2, n + 2))
        block[:n, :n], block[:n, n], block[n, n + 1] = A * self.step, B * self.step, 1.0
        E = sla.expm(block)
        return E[:n, :n], E[:n, n] - E[:n, n + 1], E[:n, n + 1]


class Rod(Jumping):
    """u_t = k u_xx with the flux v on the left and u = 0 on the right."""

    constant, step, noise, points = "k", 0.05, 2e-3, (0.1, 0.3, 0.6)
    K = 0.2

    length = 1.0

    def system(self, v: float) -> tuple[Array, Array]:
        h, n = self.length / FINE, self._nodes
        A = self.K / h**2 * (np.eye(n, k=1) + np.eye(n, k=-1) - 2.0 * np.eye(n))
        A[0] *= 2.0  # half a volume
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
    """c_t = D c_xx - v c_x with an inlet on the left."""

    constant, step, noise, points = "D", 0.16, 0.02, (2.0, 5.0, 8.0)
    D = 0.5

    length = 10.0

    def system(self, v: float) -> tuple[Array, Array]:
        h, n = self.length / FINE, self._nodes
        one = np.eye(n)
        # Fluxes through the faces between nodes, and advection through the right end.
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
    """Draw v before each sample: four levels that differ by at least a factor `CHANGE`."""
    levels = [1.0]
    while len(levels) <= len(AT):
        level = float(np.exp(rng.uniform(*np.log(LEVELS))))
        if abs(np.log(level / levels[-1])) > np.log(CHANGE):
            levels.append(level)
    return np.array(levels)[np.searchsorted(AT, np.arange(SAMPLES), side="right")]


def jump_trials(seed: int) -> list[JumpTrial]:
    """Run one truth of each process; a seed determines all numbers."""
    trials = []
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
        trials.append(JumpTrial(name, seed, one, every, shift, widest))
    return trials


def _run(process: Jumping, jumps: lp.Jumps, z: Array) -> tuple[int, Array, Array]:
    """Return the number of detected jumps, and estimates and deviations of the constant."""
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
    detected = sum(any(alarms[at : at + SOON]) for at in AT)
    return detected, *np.array(known).T
