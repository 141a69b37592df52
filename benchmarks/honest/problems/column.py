"""Tracer in a column with an inlet on the left; the truth uses Chebyshev collocation."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

import livepde as lp
from benchmarks.honest.linear import Array, Chebyshev, fine_times
from benchmarks.honest.problem import Problem, constant, waves
from livepde.models import advection_dispersion

DEGREE = 56
DEPTH = 10.0


class Column(Problem):
    """c_t = D c_xx - v c_x with v c - D c_x = v c_in on the left and c_x = 0 on the right."""

    title = "advection and dispersion in a column"
    length, intervals = 40.0, 250
    points = MappingProxyType({"c_1": 2.0, "c_2": 5.0, "c_3": 8.0})
    noise = 0.02
    coordinates = 2
    latents = MappingProxyType({"D": constant(0.5, 0.2, 0, 2), "v": constant(1.0, 0.3, 1, 2)})
    channels = MappingProxyType({"c_in": waves(40.0, (0.7, 2.0), (0.5, 5.0), (0.3, 11.0))})

    def predict(self, theta: Array) -> Array:
        D, v = (np.exp(item.value(theta, 0)).item() for item in self.latents.values())
        space = Chebyshev(DEGREE, DEPTH)
        nodes = len(space.x)
        inflow = v * np.eye(nodes)[0] - D * space.D1[0]
        system = space.system(
            D * space.D2 - v * space.D1,
            np.vstack([inflow, space.D1[-1]]),
            np.array([[v], [0.0]]),
            np.zeros((nodes, 1)),
            list(self.points.values()),
        )
        return system.respond(self.inputs(fine_times(self.times)), self.length / self.intervals)

    def model(self, refine: int = 1) -> lp.Model:
        D = lp.LogNormal(0.5, std=0.2)
        v = lp.LogNormal(1.0, std=0.3)
        return advection_dispersion(lp.interval(0.0, DEPTH, 50 * refine), D, v)
