"""Tracer that is washed out of a soil column; the truth is the analytic solution."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc, erfcx

import livepde as lp
from benchmarks.refit.elements import advection, interpolation, mass, stiffness
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import Process
from benchmarks.refit.unknowns import Belief, Unknown
from livepde.models import advection_dispersion

Array = NDArray[Any]
CELLS = 40
DEPTH = 16.0  # cm
SENSOR = 11.0


class Column(Problem):
    """c_t = D c_xx - v c_x with c = 1 initially and an inflow of c = 0."""

    title = "advection and dispersion in a column"
    unknowns: Mapping[str, Unknown] = MappingProxyType({"D": Unknown(0.0357), "v": Unknown(0.258)})
    points: Mapping[str, Any] = MappingProxyType({"c": SENSOR})
    noise = 0.01
    times = np.append(0.0, 28.0 + 0.75 * np.arange(60))
    longest = 0.75
    # A user reported that a fit from this prior stopped at a plateau.
    REPORTED: tuple[Priors, ...] = (
        {"D": Belief(0.1, 0.1), "v": Belief(0.7, 0.5)},
        {"D": Belief(0.01, 0.01), "v": Belief(0.1, 0.1)},
    )

    def priors(self, seed: int) -> Priors:
        known = super().priors(seed)
        return {**known, **self.REPORTED[seed]} if seed < len(self.REPORTED) else known

    @property
    def u0(self) -> Any:
        return 1.0

    @property
    def signals(self) -> Mapping[str, Array]:
        return {"c_in": 0.0 * self.times}

    def truth(self) -> Array:
        D, v = self.unknowns["D"].truth, self.unknowns["v"].truth
        shown = np.ones((len(self.times), 1))
        shown[1:, 0] = 1.0 - _risen(SENSOR, self.times[1:], D, v)
        return shown

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, DEPTH, CELLS)
        return advection_dispersion(mesh, self.prior_of("D", priors), self.prior_of("v", priors))

    @cached_property
    def process(self) -> Process:
        h, n = DEPTH / CELLS, CELLS + 1
        return Process(
            M=mass(CELLS, h),
            K=[stiffness(CELLS, h), advection(CELLS)],
            F=[np.zeros((n, 1)), np.eye(n)[:, :1]],
            G=interpolation(np.array([SENSOR]), CELLS, 0.0, DEPTH),
            D=self._direct,
            u0=np.ones(n),
            times=self.times,
            longest=self.longest,
            inputs=np.zeros((len(self.times), 1)),
            fixed=np.zeros(0, dtype=int),
            given=np.zeros((0, 1)),
        )

    _direct = np.zeros((1, 2))

    def theta(self, q: Array) -> tuple[Array, Array]:
        return q[:2], np.eye(2, len(q))


def _risen(x: float, t: Array, D: float, v: float) -> Array:
    """Return c at x after a step of the inflow, third-type inlet (van Genuchten and Alves 1982)."""
    near, far = (x - v * t) / (2 * np.sqrt(D * t)), (x + v * t) / (2 * np.sqrt(D * t))
    bell = np.exp(-(near**2))
    return np.asarray(
        0.5 * erfc(near)
        + np.sqrt(v**2 * t / (np.pi * D)) * bell
        - 0.5 * (1 + v * x / D + v**2 * t / D) * bell * erfcx(far)
    )


class OffsetColumn(Column):
    """Column with an unknown offset of the sensor."""

    title = "column with an unknown offset of the sensor"
    unknowns = MappingProxyType(
        {**Column.unknowns, "offset": Unknown(0.03, "normal", Belief(0.0, 0.05))}
    )
    _direct = np.array([[0.0, 0.0, 1.0]])

    def truth(self) -> Array:
        return super().truth() + self.unknowns["offset"].truth

    def model(self, priors: Priors) -> lp.Model:
        return super().model(priors).with_unknowns({"offset": self.prior_of("offset", priors)})

    def sensors(self, priors: Priors) -> lp.Points:
        offsets = {"c": lambda q, x: q.offset}
        return lp.Points(dict(self.points), noise=self.noise, direct=offsets)


class Few(Column):
    """Column with 2 to 8 samples, depending on the seed."""

    title = "column, 2 to 8 samples only"

    def __init__(self, samples: int = 8) -> None:
        self.times = np.append(0.0, np.linspace(36.0, 52.0, samples))

    def at(self, seed: int) -> Problem:
        return _few(2 + seed % 7)


@lru_cache
def _few(samples: int) -> Few:
    return Few(samples)
