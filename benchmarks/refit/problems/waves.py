"""Nonlinear processes: a growing and spreading population, and a steepening wave."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import livepde as lp
from benchmarks.honest.problems.fisher import CELLS as FINE
from benchmarks.honest.problems.fisher import WIDTH, Population
from benchmarks.refit.elements import (
    interpolation,
    mass,
    projected,
    self_advection,
    square,
    stiffness,
)
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import Process
from benchmarks.refit.unknowns import Unknown
from livepde.models import burgers, fisher_kpp

Array = NDArray[Any]
CELLS = 40


def _two(q: Array) -> tuple[Array, Array]:
    return q, np.eye(2)


class Source(Problem):
    """u_t = D u_xx + r u (1 - u) with zero flux at the ends."""

    title = "nonlinear source r u (1 - u)"
    unknowns = MappingProxyType({"D": Unknown(0.02), "r": Unknown(1.0)})
    points = MappingProxyType({"u_1": 0.2, "u_2": 0.6, "u_3": 1.0, "u_4": 1.5})
    noise = 0.02
    times = np.linspace(0.0, 8.0, 61)

    @staticmethod
    def _start(x: Any) -> Any:
        return 0.6 * np.exp(-((x / 0.3) ** 2))

    @property
    def u0(self) -> Any:
        return lambda x: self._start(x[0])

    def truth(self) -> Array:
        at = [round(x / WIDTH * FINE) for x in self.points.values()]
        start = self._start(np.linspace(0.0, WIDTH, FINE + 1))
        population = Population(self.unknowns["D"].truth, self.unknowns["r"].truth)
        return np.asarray(population.solve(start, self.times, tangents=False)[0][:, at])

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, WIDTH, CELLS)
        return fisher_kpp(mesh, self.prior_of("D", priors), self.prior_of("r", priors))

    @cached_property
    def process(self) -> Process:
        h, n = WIDTH / CELLS, CELLS + 1
        return Process(
            M=mass(CELLS, h),
            K=[stiffness(CELLS, h), -mass(CELLS, h)],
            F=[np.zeros((n, 0))] * 2,
            G=interpolation(np.array(list(self.points.values())), CELLS, 0.0, WIDTH),
            D=np.zeros((len(self.points), 2)),
            u0=projected(self._start, CELLS, WIDTH),
            times=self.times,
            longest=self.longest,
            inputs=np.zeros((len(self.times), 0)),
            fixed=np.zeros(0, dtype=int),
            given=np.zeros((0, 0)),
            quadratic=square(CELLS, h),
            scale=1,
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        return _two(q)


class Burgers(Problem):
    """u_t + a u u_x = nu u_xx with u = 0 at both ends."""

    title = "Burgers: viscosity and speed"
    unknowns = MappingProxyType({"advection": Unknown(1.0), "nu": Unknown(0.04)})
    points = MappingProxyType({"u_1": 0.2, "u_2": 0.45, "u_3": 0.7, "u_4": 0.9})
    noise = 0.01
    times = np.linspace(0.0, 1.5, 61)
    WAVES = (1.0, 0.5)  # initial amplitudes of sin(j pi x)
    POINTS, COSINES = 4000, 60  # quadrature points and cosines of the truth

    @property
    def u0(self) -> Any:
        return lambda x: self._start(x[0])

    def _start(self, x: Any) -> Any:
        return sum(w * np.sin(j * np.pi * x) for j, w in enumerate(self.WAVES, 1))

    def truth(self) -> Array:
        """Return the solution of Cole (1951) and Hopf (1950), u = -(2 nu/a) phi_x/phi."""
        a, nu = self.unknowns["advection"].truth, self.unknowns["nu"].truth
        x = (np.arange(self.POINTS) + 0.5) / self.POINTS
        parts = ((w / (j * np.pi), j) for j, w in enumerate(self.WAVES, 1))
        area = sum(w * (1.0 - np.cos(j * np.pi * x)) for w, j in parts)
        n = np.arange(self.COSINES)
        cosines = np.cos(np.pi * n * x[:, None]).T @ np.exp(-a * area / (2 * nu)) / len(x)
        cosines[1:] *= 2.0
        decay = np.exp(-nu * (np.pi * n) ** 2 * self.times[:, None]) * cosines
        at = np.array(list(self.points.values()))
        phi = decay @ np.cos(np.pi * n[:, None] * at)
        slope = decay @ (-np.pi * n[:, None] * np.sin(np.pi * n[:, None] * at))
        return np.asarray(-2.0 * nu / a * slope / phi)

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, 1.0, CELLS)
        nu, advection = self.prior_of("nu", priors), self.prior_of("advection", priors)
        ends: Mapping[str, float] = {"left": 0.0, "right": 0.0}
        return burgers(mesh, nu, advection, dirichlet=ends, element=lp.linear(mesh))

    @cached_property
    def process(self) -> Process:
        h, n = 1.0 / CELLS, CELLS + 1
        return Process(
            M=mass(CELLS, h),
            K=[0.0 * stiffness(CELLS, h), stiffness(CELLS, h)],
            F=[np.zeros((n, 0))] * 2,
            G=interpolation(np.array(list(self.points.values())), CELLS, 0.0, 1.0),
            D=np.zeros((len(self.points), 2)),
            u0=projected(self._start, CELLS, 1.0) * (np.arange(n) % CELLS > 0),
            times=self.times,
            longest=self.longest,
            inputs=np.zeros((len(self.times), 0)),
            fixed=np.array([0, n - 1]),
            given=np.zeros((2, 0)),
            quadratic=self_advection(CELLS),
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        return _two(q)
