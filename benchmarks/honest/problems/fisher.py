"""Growing and spreading population (Fisher-KPP); the truth uses vertex-centred finite volumes."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

import livepde as lp
from benchmarks.honest.nonlinear import Array, Stiff
from benchmarks.honest.problem import Problem, constant
from livepde.models import fisher_kpp

CELLS = 160
WIDTH = 2.0


class Population(Stiff):
    """u_t = D u_xx + r u (1 - u) with zero flux at the ends."""

    def __init__(self, D: float, r: float) -> None:
        self.D, self.r = D, r
        self.h = WIDTH / CELLS
        self.volume = np.full(CELLS + 1, 1.0)
        self.volume[[0, -1]] = 0.5

    def _spread(self, y: Array) -> Array:
        flows = np.diff(y)
        change = np.append(flows, 0.0) - np.append(0.0, flows)
        return np.asarray(change / self.volume / self.h**2)

    def rate(self, t: float, y: Array) -> Array:
        return np.asarray(self.D * self._spread(y) + self.r * y * (1 - y))

    def jacobian(self, t: float, y: Array) -> Array:
        bands = np.zeros((3, len(y)))
        c = self.D / self.h**2
        bands[0, 1:] = c / self.volume[:-1]
        bands[2, :-1] = c / self.volume[1:]
        bands[1] = -2.0 * c + self.r * (1 - 2 * y)
        return bands

    def forcing(self, t: float, y: Array) -> Array:
        return np.column_stack(
            [self.D * self._spread(y) * (0.008 / 0.02), self.r * y * (1 - y) * 0.3]
        )


def _beginning(x: Any) -> Any:
    return 0.6 * np.exp(-((x / 0.3) ** 2))


class Fisher(Problem):
    """u_t = D u_xx + r u (1 - u) with unknown D and r."""

    title = "Fisher-KPP: diffusivity and growth rate"
    length, intervals = 8.0, 200
    points = MappingProxyType({"u_1": 0.2, "u_2": 0.6, "u_3": 1.0, "u_4": 1.5})
    noise = 0.02
    coordinates = 2
    latents = MappingProxyType({"D": constant(0.02, 0.008, 0, 2), "r": constant(1.0, 0.3, 1, 2)})
    channels = MappingProxyType({})
    u0 = staticmethod(lambda x: _beginning(x[0]))  # type: ignore[assignment]

    def process(self, theta: Array) -> Population:
        """Return the finite-volume system."""
        return Population(*(np.exp(item.value(theta, 0)).item() for item in self.latents.values()))

    def _solved(self, theta: Array, tangents: bool) -> tuple[Array, Array]:
        at = [round(x / WIDTH * CELLS) for x in self.points.values()]
        start = _beginning(np.linspace(0.0, WIDTH, CELLS + 1))
        y, Y = self.process(theta).solve(start, self.times, tangents)
        return y[:, at], Y[:, at]

    def predict(self, theta: Array) -> Array:
        return self._solved(theta, False)[0]

    def jacobian(self, theta: Array) -> Array:
        return self._solved(theta, True)[1]

    def model(self, refine: int = 1) -> lp.Model:
        D = lp.LogNormal(0.02, std=0.008)
        r = lp.LogNormal(1.0, std=0.3)
        return fisher_kpp(lp.interval(0.0, WIDTH, 50 * refine), D, r)
