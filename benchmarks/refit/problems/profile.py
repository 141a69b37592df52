"""Conductivity k(x) in 14 modes; the truth uses finite volumes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.linalg as sla
from numpy.typing import NDArray

import livepde as lp
from benchmarks.honest.linear import fine_times
from benchmarks.refit.elements import cell_stiffness, interpolation, mass, stiffness
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import Process
from benchmarks.refit.truths import conduction
from benchmarks.refit.unknowns import Coordinates, Unknown

Array = NDArray[Any]
CELLS, FINE = 40, 160
MODES = 14
CORRELATED = 0.3  # correlation length of k


class Profile(Problem):
    """u_t = (k(x) u_x)_x between two measured temperatures."""

    title = "a field: conductivity k(x) in 14 modes"
    unknowns = MappingProxyType({"k": Unknown(0.1)})
    points = MappingProxyType({f"T_{n}": n / 8 for n in range(1, 8)})
    noise = 0.02
    times = np.linspace(0.0, 7.0, 71)
    law = MappingProxyType({"modes": MODES})

    @staticmethod
    def _conductivity(x: Array) -> Array:
        return np.asarray(0.1 * np.exp(0.4 * np.sin(5.0 * x + 0.5) + 0.3 * x))

    @staticmethod
    def _inputs(t: Array) -> Array:
        left = np.sin(0.6 * np.pi * t) + 0.4 * np.sin(1.4 * np.pi * t)
        return np.column_stack([left, 0.6 * np.sin(0.4 * np.pi * t)])

    @property
    def signals(self) -> Mapping[str, Array]:
        left, right = self._inputs(self.times).T
        return {"T_left": left, "T_right": right}

    def truth(self) -> Array:
        system = conduction(self._conductivity, FINE, 1.0, np.array([*self.points.values()]))
        return system.respond(self._inputs(fine_times(self.times)), float(self.times[1]))

    @property
    def q_true(self) -> Array:
        return self._conductivity(np.linspace(0.0, 1.0, CELLS + 1))

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, 1.0, CELLS)
        ends = {"left": lp.Channel("T_left"), "right": lp.Channel("T_right")}
        inner = lp.Sobolev(2, CORRELATED).pointwise(1)
        k = lp.Field(mesh, lp.linear(mesh), inner=inner, prior=self.prior_of("k", priors))
        return lp.Model(
            lp.Field(mesh, lp.linear(mesh), dirichlet=ends),
            {"k": k},
            A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        )

    @cached_property
    def _modes(self) -> Array:
        """Leading modes of a prior with standard deviation 1, shape (nodes, modes)."""
        h = 1.0 / CELLS
        M, L = mass(CELLS, h).toarray(), stiffness(CELLS, h).toarray()
        L = M + CORRELATED**2 * L
        # Whittle-Matern field: |L q|^2 over 4 lengths gives a pointwise standard deviation of 1.
        G = L @ np.linalg.solve(M, L) / (4.0 * CORRELATED)
        values, modes = sla.eigh(M, G)
        return np.asarray(modes[:, np.argsort(-values)[:MODES]])

    def coordinates(self, priors: Priors) -> Coordinates:
        one, (prior,) = Coordinates.of(self.unknowns, priors), priors.values()
        alike = (self.unknowns["k"],) * (CELLS + 1)
        Phi = self._modes * (prior.std / prior.median)
        return Coordinates(alike, np.repeat(one.centre, CELLS + 1), Phi)

    @cached_property
    def process(self) -> Process:
        h, n = 1.0 / CELLS, CELLS + 1
        return Process(
            M=mass(CELLS, h),
            K=cell_stiffness(CELLS, h),
            F=[np.zeros((n, 2))] * CELLS,
            G=interpolation(np.array(list(self.points.values())), CELLS, 0.0, 1.0),
            D=np.zeros((len(self.points), n)),
            u0=np.zeros(n),
            times=self.times,
            longest=self.longest,
            inputs=np.column_stack(list(self.signals.values())),
            fixed=np.array([0, n - 1]),
            given=np.eye(2),
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        # k of a cell is the mean of its end values.
        mean = 0.5 * (np.eye(CELLS, CELLS + 1) + np.eye(CELLS, CELLS + 1, 1))
        return mean @ q, mean
