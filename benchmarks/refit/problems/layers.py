"""Soil of three layers with model errors: a misplaced sensor and correlated noise."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

import livepde as lp
from benchmarks.honest.linear import fine_times
from benchmarks.refit.elements import interpolation, mass, stiffness
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import Process
from benchmarks.refit.truths import conduction
from benchmarks.refit.unknowns import Belief, Unknown

Array = NDArray[Any]
CELLS, FINE = 40, 200
DEPTH = 0.5  # m
ENDS = (0.1, 0.25)  # m, lower ends of the upper two layers
NAMES = ("a_1", "a_2", "a_3")  # m^2/h
OFF = 0.01  # m, true depth of the second sensor minus its configured depth
RHO = 0.3  # correlation of successive errors


class Layers(Problem):
    """u_t = (a(x) u_x)_x between two measured temperatures; each sensor has an unknown offset."""

    title = "soil of three layers with offsets and model errors"
    points = MappingProxyType({"T_5": 0.05, "T_15": 0.15, "T_25": 0.25, "T_35": 0.35})
    noise = 0.1
    times = np.arange(0.0, 73.0)
    unknowns = MappingProxyType(
        {
            **{n: Unknown(a) for n, a in zip(NAMES, (1.2e-3, 2.2e-3, 1.6e-3), strict=True)},
            **{
                f"offset_{name}": Unknown(offset, "normal", Belief(0.0, 0.3))
                for name, offset in zip(points, (0.2, -0.1, 0.0, 0.3), strict=True)
            },
        }
    )

    @property
    def u0(self) -> Any:
        return lambda x: 15.0 - 6.0 * x[0]

    @staticmethod
    def _inputs(t: Array) -> Array:
        day = 2 * np.pi * t / 24.0
        top = 15.0 + 8.0 * np.sin(day) + 2.0 * np.sin(2.7 * day)
        return np.column_stack([top, 12.0 + 0.5 * np.sin(0.35 * day)])

    @property
    def signals(self) -> Mapping[str, Array]:
        top, bottom = self._inputs(self.times).T
        return {"T_top": top, "T_bottom": bottom}

    def errors(self, rng: np.random.Generator) -> Array:
        white = rng.standard_normal(self.shown.shape)
        return np.asarray(lfilter([np.sqrt(1 - RHO**2)], [1.0, -RHO], white, axis=0))

    def truth(self) -> Array:
        layers = np.array([self.unknowns[name].truth for name in NAMES])
        at = np.array(list(self.points.values())) + np.array([0.0, OFF, 0.0, 0.0])
        inside = DEPTH / FINE * (1.0 + np.arange(FINE - 1))
        system = conduction(lambda x: layers[np.searchsorted(ENDS, x)], FINE, DEPTH, at)
        shown = system.respond(self._inputs(fine_times(self.times)), 1.0, 15.0 - 6.0 * inside)
        offsets = [self.unknowns[f"offset_{name}"].truth for name in self.points]
        return np.asarray(shown + np.array(offsets))

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, DEPTH, CELLS)
        ends = {"left": lp.Channel("T_top"), "right": lp.Channel("T_bottom")}

        def conducted(q: Any, u: Any, v: Any, x: Any) -> Any:
            upper, lower = x[0] < ENDS[0], x[0] > ENDS[1]
            a = q.a_1 * upper + q.a_2 * (1 - upper - lower * 1.0) + q.a_3 * lower
            return a * lp.dot(lp.grad(u), lp.grad(v))

        unknowns = {name: self.prior_of(name, priors) for name in self.unknowns}
        return lp.Model(lp.Field(mesh, lp.linear(mesh), dirichlet=ends), unknowns, A=conducted)

    def sensors(self, priors: Priors) -> lp.Points:
        def offset(name: str) -> Any:
            return lambda q, x: getattr(q, f"offset_{name}")

        direct = {name: offset(name) for name in self.points}
        return lp.Points(dict(self.points), noise=self.noise, direct=direct)

    @cached_property
    def process(self) -> Process:
        h, n = DEPTH / CELLS, CELLS + 1
        middles = h * (np.arange(CELLS) + 0.5)
        layer = np.searchsorted(ENDS, middles)
        return Process(
            M=mass(CELLS, h),
            K=[stiffness(CELLS, h, layer == k) for k in range(3)],
            F=[np.zeros((n, 2))] * 3,
            G=interpolation(np.array(list(self.points.values())), CELLS, 0.0, DEPTH),
            D=np.eye(4, 7, 3),
            u0=15.0 - 6.0 * np.linspace(0.0, DEPTH, n),
            times=self.times,
            longest=self.longest,
            inputs=np.column_stack(list(self.signals.values())),
            fixed=np.array([0, n - 1]),
            given=np.eye(2),
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        return q[:3], np.eye(3, 7)
