"""Conductivity that grows with the temperature; the truth uses vertex-centred finite volumes."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

import livepde as lp
from benchmarks.honest.nonlinear import Array, Stiff
from benchmarks.honest.problem import Problem, Signal, constant, waves
from benchmarks.honest.problems.rod import Rod

CELLS = 80


class Conduction(Stiff):
    """u_t = (k (1 + m u) u_x)_x on (0, 1) with exact fluxes between two nodes.

    Parameters
    ----------
    cells
        Number of cells of equal width.
    k, m
        Conductivity at u = 0, and its relative growth with u.
    left, right
        Temperatures of the ends; None on the left for the flux `into`.
    """

    def __init__(self, cells: int, k: float, m: float, left: Signal | None, right: Signal) -> None:
        self.h, self.k, self.m = 1.0 / cells, k, m
        self.left, self.right = left, right
        self.nodes = cells if left is None else cells - 1
        self.capacity = np.full(self.nodes, self.h)
        if left is None:
            self.capacity[0] = 0.5 * self.h

    def into(self, t: float) -> float:
        """Return the flux into the left end."""
        return 0.0

    def inflow(self, flux: float) -> Array:
        """Return the rate of change of y due to a flux into the left end."""
        rate = np.zeros(self.nodes)
        if self.left is None:
            rate[0] = flux / self.capacity[0]
        return rate

    def _all(self, t: float, y: Array) -> Array:
        at = np.array(t)
        left = [] if self.left is None else [self.left(at)]
        return np.concatenate([left, y, [self.right(at)]])

    def _flows(self, t: float, y: Array) -> Array:
        u = self._all(t, y)
        mean = self.k * (1 + 0.5 * self.m * (u[1:] + u[:-1]))
        return np.asarray(mean * np.diff(u) / self.h)

    def rate(self, t: float, y: Array) -> Array:
        flows = self._flows(t, y)
        if self.left is None:
            flows = np.append(self.into(t), flows)
            flows[0] *= -1.0  # the flux into the left end flows to the right
        return np.asarray((flows[1:] - flows[:-1]) / self.capacity)

    def jacobian(self, t: float, y: Array) -> Array:
        u = self._all(t, y)
        # The flow from i+1 to i is (k/h) (u + m u^2/2) at i+1 minus its value at i.
        slope = self.k / self.h * (1 + self.m * u)
        inner = slope[:-1] if self.left is None else slope[1:-1]
        bands = np.zeros((3, self.nodes))
        bands[1] = -2.0 * inner / self.capacity
        if self.left is None:
            bands[1, 0] = -inner[0] / self.capacity[0]
        bands[0, 1:] = inner[1:] / self.capacity[:-1]
        bands[2, :-1] = inner[:-1] / self.capacity[1:]
        return bands

    def forcing(self, t: float, y: Array) -> Array:
        u = self._all(t, y)
        squares = self.k * 0.5 * (u[1:] ** 2 - u[:-1] ** 2) / self.h
        by_m = (squares[1:] - squares[:-1]) / self.capacity
        return np.column_stack([self.rate(t, y) * (0.03 / 0.1), by_m * 0.15])


class WarmRod(Problem):
    """u_t = (k (1 + m u) u_x)_x between two measured temperatures, with unknown k and m."""

    title = "conductivity k(1 + m u)"
    length, intervals = 10.0, 200
    points = MappingProxyType({"T_1": 0.25, "T_2": 0.5, "T_3": 0.75})
    noise = 0.02
    coordinates = 2
    latents = MappingProxyType(
        {"k": constant(0.1, 0.03, 0, 2), "m": constant(0.3, 0.15, 1, 2, log=False)}
    )
    channels = MappingProxyType(
        {
            "T_left": waves(10.0, (0.8, 3.0), (0.2, 9.0)),
            "T_right": waves(10.0, (0.5, 2.0), (0.2, 7.0)),
        }
    )

    def process(self, theta: Array) -> Conduction:
        """Return the finite-volume system."""
        k, m = (item.value(theta, 0).item() for item in self.latents.values())
        return Conduction(CELLS, float(np.exp(k)), m, *self.channels.values())

    def _solved(self, theta: Array, tangents: bool) -> tuple[Array, Array]:
        at = [round(x * CELLS) - 1 for x in self.points.values()]
        process = self.process(theta)
        y, Y = process.solve(np.zeros(process.nodes), self.times, tangents)
        return y[:, at], Y[:, at]

    def predict(self, theta: Array) -> Array:
        return self._solved(theta, False)[0]

    def jacobian(self, theta: Array) -> Array:
        return self._solved(theta, True)[1]

    def model(self, refine: int = 1) -> lp.Model:
        return lp.Model(
            Rod.state(refine),
            {"k": lp.LogNormal(0.1, std=0.03), "m": lp.Normal(0.3, std=0.15)},
            A=lambda q, u, v, x: q.k * (1.0 + q.m * u) * lp.dot(lp.grad(u), lp.grad(v)),
        )
