"""Heated rod with nearly collinear unknowns, and cooling square; truths are series."""

from __future__ import annotations

from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import livepde as lp
from benchmarks.refit.elements import interpolation, mass, projected, stiffness
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import Process
from benchmarks.refit.unknowns import Unknown

Array = NDArray[Any]
CELLS, SIDE = 30, 14
SINES = 399


class Collinear(Problem):
    """u_t = k u_xx - h u + p with u = 0 at both ends, observed close to its steady state."""

    title = "three nearly collinear unknowns"
    unknowns = MappingProxyType({"k": Unknown(0.1), "h": Unknown(0.8), "p": Unknown(2.0)})
    points = MappingProxyType({"T_1": 0.2, "T_2": 0.5})
    noise = 0.02
    times = np.append(0.0, np.linspace(0.8, 3.0, 60))
    longest = 0.05

    def truth(self) -> Array:
        k, h, p = self.q_true
        n = np.arange(1, SINES + 1, 2)
        rate = k * (np.pi * n) ** 2 + h
        rising = -np.expm1(-rate * self.times[:, None]) * (4.0 * p / (np.pi * n) / rate)
        return np.asarray(rising @ np.sin(np.pi * n[:, None] * np.array([*self.points.values()])))

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, 1.0, CELLS)
        state = lp.Field(mesh, lp.linear(mesh), dirichlet={"left": 0.0, "right": 0.0})
        unknowns = {name: self.prior_of(name, priors) for name in self.unknowns}

        def balance(q: Any, u: Any, v: Any, x: Any) -> Any:
            return q.k * lp.dot(lp.grad(u), lp.grad(v)) + q.h * u * v - q.p * v

        return lp.Model(state, unknowns, A=balance)

    @cached_property
    def process(self) -> Process:
        h, n = 1.0 / CELLS, CELLS + 1
        M, zero = mass(CELLS, h), np.zeros((n, 1))
        return Process(
            M=M,
            K=[stiffness(CELLS, h), M, 0.0 * M],
            F=[zero, zero, M @ np.ones((n, 1))],
            G=interpolation(np.array(list(self.points.values())), CELLS, 0.0, 1.0),
            D=np.zeros((2, 3)),
            u0=np.zeros(n),
            times=self.times,
            longest=self.longest,
            inputs=np.ones((len(self.times), 1)),
            fixed=np.array([0, n - 1]),
            given=np.zeros((2, 1)),
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        return q, np.eye(3)


class Plate(Problem):
    """u_t = kx u_xx + ky u_yy - loss u on a square with zero flux at its sides."""

    title = "cooling square: two conductivities and a loss"
    unknowns = MappingProxyType({"kx": Unknown(0.05), "ky": Unknown(0.02), "loss": Unknown(0.3)})
    points = MappingProxyType(
        {
            "T_1": (0.125, 0.125),
            "T_2": (0.5, 0.25),
            "T_3": (0.875, 0.125),
            "T_4": (0.25, 0.75),
            "T_5": (0.75, 0.875),
        }
    )
    noise = 0.02
    times = np.linspace(0.0, 5.0, 41)
    # Initial amplitudes of cos(i pi x) cos(j pi y).
    WAVES = MappingProxyType(
        {(0, 0): 1.0, (1, 0): 0.8, (0, 1): 0.6, (1, 1): 0.5, (2, 0): 0.4, (0, 2): 0.4}
    )

    def _start(self, x: Any, y: Any) -> Any:
        waves = self.WAVES.items()
        return sum(w * np.cos(i * np.pi * x) * np.cos(j * np.pi * y) for (i, j), w in waves)

    @property
    def u0(self) -> Any:
        return lambda x: self._start(x[0], x[1])

    def truth(self) -> Array:
        kx, ky, loss = self.q_true
        x, y = np.array(list(self.points.values())).T
        shown = np.zeros((len(self.times), len(x)))
        for (i, j), w in self.WAVES.items():
            rate = np.pi**2 * (kx * i**2 + ky * j**2) + loss
            wave = w * np.cos(i * np.pi * x) * np.cos(j * np.pi * y)
            shown += np.exp(-rate * self.times[:, None]) * wave
        return shown

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (SIDE, SIDE))

        def balance(q: Any, u: Any, v: Any, x: Any) -> Any:
            du, dv = lp.grad(u), lp.grad(v)
            return q.kx * du[0] * dv[0] + q.ky * du[1] * dv[1] + q.loss * u * v

        unknowns = {name: self.prior_of(name, priors) for name in self.unknowns}
        return lp.Model(lp.Field(mesh, lp.linear(mesh)), unknowns, A=balance)

    @staticmethod
    def _wave(i: int) -> Array:
        # livepde projects with a quadrature that is exact for the mass matrix of these elements.
        return projected(lambda x: np.cos(i * np.pi * x), SIDE, 1.0, points=3)

    @cached_property
    def process(self) -> Process:
        h = 1.0 / SIDE
        M, K = mass(SIDE, h), stiffness(SIDE, h)

        def product(along_x: Any, along_y: Any) -> sp.csr_array:
            return sp.csr_array(sp.kron(along_x, along_y))

        n = (SIDE + 1) ** 2
        waves, given = [self._wave(i) for i in range(3)], self.WAVES.items()
        at = np.array(list(self.points.values()))
        x, y = (interpolation(line, SIDE, 0.0, 1.0) for line in at.T)
        return Process(
            M=product(M, M),
            K=[product(K, M), product(M, K), product(M, M)],
            F=[np.zeros((n, 0))] * 3,
            G=np.einsum("si,sj->sij", x, y).reshape(len(x), n),
            D=np.zeros((len(x), 3)),
            u0=np.sum([w * np.outer(waves[i], waves[j]).ravel() for (i, j), w in given], axis=0),
            times=self.times,
            longest=self.longest,
            inputs=np.zeros((len(self.times), 0)),
            fixed=np.zeros(0, dtype=int),
            given=np.zeros((0, 0)),
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        return q, np.eye(3)
