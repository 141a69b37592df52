"""Thermal response test; the truth uses finite volumes, evenly spaced in the logarithm of r."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

import livepde as lp
from benchmarks.honest.linear import Array, diffusion, fine_times
from benchmarks.honest.problem import Problem, constant, waves
from livepde.models import borehole, fluid

CELLS = 200
WALL, FAR = 0.075, 8.0  # m
DEPTH = 100.0  # m
RHO_C = 2.3e6  # J/(m^3 K)


class Borehole(Problem):
    """rho_c r T_t = (k r T_r)_r with a heated wall; the fluid is R_b Q/H warmer than the wall."""

    title = "thermal response test: conductivity and resistance"
    length, intervals = 60 * 3600.0, 240
    points = MappingProxyType({"T": WALL})
    noise = 0.05
    coordinates = 2
    latents = MappingProxyType({"k": constant(2.0, 0.6, 0, 2), "R_b": constant(0.1, 0.03, 1, 2)})
    channels = MappingProxyType(
        {"Q": lambda t: 6000.0 + waves(60 * 3600.0, (600.0, 2.5), (300.0, 11.0))(t)}
    )
    u0 = 10.0
    direct = MappingProxyType({"T": fluid(DEPTH)})

    def predict(self, theta: Array) -> Array:
        k, R_b = (np.exp(item.value(theta, 0)).item() for item in self.latents.values())
        s = np.linspace(np.log(WALL), np.log(FAR), CELLS + 1)
        faces = np.exp(np.concatenate([s[:1], 0.5 * (s[1:] + s[:-1])]))
        capacity = RHO_C * np.pi * np.diff(faces**2)
        between = np.full(CELLS, 2 * np.pi * k / (s[1] - s[0]))
        loss, B, C = np.zeros(CELLS), np.zeros((CELLS, 1)), np.zeros((1, CELLS))
        loss[-1], B[0, 0], C[0, 0] = between[-1], 1.0 / DEPTH, 1.0
        system = diffusion(between[:-1], capacity, loss, B, C, np.array([[R_b / DEPTH]]))
        g = self.inputs(fine_times(self.times))
        return self.u0 + system.respond(g, self.length / self.intervals)

    def model(self, refine: int = 1) -> lp.Model:
        return borehole(
            lp.interval(WALL, FAR, 40 * refine, geometric=True),
            lp.LogNormal(2.0, std=0.6),
            lp.LogNormal(0.1, std=0.03),
            H=DEPTH,
            rho_c=RHO_C,
            T0=self.u0,
        )
