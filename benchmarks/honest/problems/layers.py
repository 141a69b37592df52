"""Conductivity by layer, or as a field; the truth uses finite volumes."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

import livepde as lp
from benchmarks.honest.linear import Array, diffusion, fine_times
from benchmarks.honest.problem import Latent, Problem, constant, waves
from benchmarks.honest.problems.rod import Rod

CELLS = 160
ENDS = (0.0, 0.2, 0.5, 0.7, 1.0)
NAMES = ("a", "b", "c", "d")


class _Conduction(Problem):
    """u_t = (k(x) u_x)_x between two measured temperatures."""

    length, intervals = 10.0, 250
    noise = 0.02
    channels = MappingProxyType(
        {
            "T_left": waves(10.0, (1.0, 3.0), (0.4, 11.0)),
            "T_right": waves(10.0, (0.6, 2.0), (0.4, 7.0)),
        }
    )

    def conductivity(self, theta: Array, x: Array) -> Array:
        """Return k at the points x."""
        raise NotImplementedError

    def predict(self, theta: Array) -> Array:
        h = 1.0 / CELLS
        between = self.conductivity(theta, h * (np.arange(CELLS) + 0.5)) / h
        inner = CELLS - 1
        B, loss = np.zeros((inner, 2)), np.zeros(inner)
        B[0, 0], B[-1, 1] = between[0], between[-1]
        loss[0] += between[0]
        loss[-1] += between[-1]
        C = np.zeros((len(self.points), inner))
        C[np.arange(len(C)), [round(x * CELLS) - 1 for x in self.points.values()]] = 1.0
        system = diffusion(between[1:-1], np.full(inner, h), loss, B, C, np.zeros((len(C), 2)))
        return system.respond(self.inputs(fine_times(self.times)), self.length / self.intervals)


class Wall(_Conduction):
    """Wall of four layers with unknown conductivities."""

    title = "conductivities of four layers"
    points = MappingProxyType({"T_1": 0.1, "T_2": 0.3, "T_3": 0.4, "T_4": 0.6, "T_5": 0.85})
    coordinates = 4
    latents = MappingProxyType(
        {f"k[{name}]": constant(0.1, 0.04, n, 4) for n, name in enumerate(NAMES)}
    )

    def conductivity(self, theta: Array, x: Array) -> Array:
        layers = np.exp([item.value(theta, 0).item() for item in self.latents.values()])
        k: Array = layers[np.searchsorted(ENDS, x) - 1]
        return k

    def model(self, refine: int = 1) -> lp.Model:
        def layer(n: int) -> Any:
            return lambda x: (x[0] > ENDS[n]) & (x[0] < ENDS[n + 1])

        regions = {name: layer(n) for n, name in enumerate(NAMES)}
        return lp.Model(
            Rod.state(refine),
            {"k": lp.Piecewise(regions, lp.LogNormal(0.1, std=0.04))},
            A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        )


def cosines(count: int, length: float, factor: float) -> Array:
    """Return standard deviations of the cosine coefficients under the prior Sobolev(2, length).

    With natural boundary conditions, the cosines cos(j pi x) are eigenfunctions of
    (1 - length^2 Laplace)^2. They give the exact Karhunen-Loeve expansion of this prior on (0, 1),
    or in one direction of a square.
    """
    waves = (np.pi * length * np.arange(count)) ** 2
    return np.asarray(1.0 / (np.sqrt(factor) * (1.0 + waves)))


class Profile(_Conduction):
    """Log-normal conductivity k(x)."""

    title = "conductivity k(x), a field"
    points = MappingProxyType({f"T_{n}": n / 8 for n in range(1, 8)})
    coordinates = 16
    LENGTH, PRIOR, STD = 0.2, 0.1, 0.03

    def __init__(self) -> None:
        at_vertices = self._waves(self.mesh().p[0])
        self.latents = {"k": Latent(float(np.log(self.PRIOR)), lambda at: at_vertices)}

    @staticmethod
    def mesh(refine: int = 1) -> Any:
        """Return livepde's mesh."""
        return lp.interval(0.0, 1.0, 40 * refine)

    def _waves(self, x: Array) -> Array:
        factor = lp.Sobolev(2, self.LENGTH).pointwise(1).factor
        j = np.arange(self.coordinates)
        shapes = np.where(j == 0, 1.0, np.sqrt(2.0)) * np.cos(np.pi * j * x[:, None])
        scale = self.STD / self.PRIOR * cosines(self.coordinates, self.LENGTH, factor)
        return np.asarray(shapes * scale)

    def conductivity(self, theta: Array, x: Array) -> Array:
        return np.asarray(self.PRIOR * np.exp(self._waves(x) @ theta))

    def model(self, refine: int = 1) -> lp.Model:
        mesh = self.mesh(refine)
        prior = lp.Sobolev(2, self.LENGTH).pointwise(1)
        k = lp.Field(
            mesh, lp.linear(mesh), inner=prior, prior=lp.LogNormal(self.PRIOR, std=self.STD)
        )
        ends = {"left": lp.Channel("T_left"), "right": lp.Channel("T_right")}
        return lp.Model(
            lp.Field(mesh, lp.linear(mesh), dirichlet=ends),
            {"k": k},
            A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        )
