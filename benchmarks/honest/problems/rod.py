"""Rods between two measured temperatures; the truths use Chebyshev collocation."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

import livepde as lp
from benchmarks.honest.linear import Array, Chebyshev, fine_times
from benchmarks.honest.problem import Problem, constant, waves

DEGREE = 40


class Rod(Problem):
    """u_t = k u_xx with an unknown k."""

    title = "heat in a rod: conductivity"
    length, intervals = 10.0, 250
    points = MappingProxyType({"T_1": 0.25, "T_2": 0.5, "T_3": 0.75})
    noise = 0.02
    coordinates = 1
    latents = MappingProxyType({"k": constant(0.1, 0.03, 0, 1)})
    channels = MappingProxyType(
        {
            "T_left": waves(10.0, (1.0, 3.0), (0.4, 11.0)),
            "T_right": waves(10.0, (0.5, 2.0), (0.3, 7.0)),
        }
    )

    def predict(self, theta: Array) -> Array:
        k = np.exp(self.latents["k"].value(theta, 0)).item()
        return self.respond(k, 0.0, 0.0)

    def respond(self, k: float, loss: float, source: float) -> Array:
        """Return the readings for u_t = k u_xx - loss u + source without noise."""
        space = Chebyshev(DEGREE)
        nodes = len(space.x)
        given = np.column_stack([np.eye(2), np.zeros(2)])
        heating = np.zeros((nodes, 3))
        heating[:, 2] = source
        operator = k * space.D2 - loss * np.eye(nodes)
        ends = np.eye(nodes)[[0, -1]]
        system = space.system(operator, ends, given, heating, list(self.points.values()))
        fine = fine_times(self.times)
        g = np.column_stack([self.inputs(fine), np.ones(len(fine))])
        return system.respond(g, self.length / self.intervals)

    def model(self, refine: int = 1) -> lp.Model:
        return lp.Model(
            self.state(refine),
            {"k": lp.LogNormal(0.1, std=0.03)},
            A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        )

    @staticmethod
    def state(refine: int = 1) -> lp.Field:
        """Return the temperature field with the two channels at its ends."""
        mesh = lp.interval(0.0, 1.0, 30 * refine)
        ends = {"left": lp.Channel("T_left"), "right": lp.Channel("T_right")}
        return lp.Field(mesh, lp.linear(mesh), dirichlet=ends)


class LossyRod(Rod):
    """u_t = k u_xx - loss u + source with unknown k, loss and source."""

    title = "heat in a rod: conductivity, loss and source"
    coordinates = 3
    latents = MappingProxyType(
        {
            "k": constant(0.1, 0.03, 0, 3),
            "loss": constant(0.3, 0.1, 1, 3),
            "source": constant(0.2, 0.3, 2, 3, log=False),
        }
    )

    def predict(self, theta: Array) -> Array:
        k, loss, source = (item.value(theta, 0).item() for item in self.latents.values())
        return self.respond(np.exp(k), np.exp(loss), source)

    def model(self, refine: int = 1) -> lp.Model:
        return lp.Model(
            self.state(refine),
            {
                "k": lp.LogNormal(0.1, std=0.03),
                "loss": lp.LogNormal(0.3, std=0.1),
                "source": lp.Normal(0.2, std=0.3),
            },
            A=lambda q, u, v, x: (
                q.k * lp.dot(lp.grad(u), lp.grad(v)) + q.loss * u * v - q.source * v
            ),
        )
