"""Drifting flux with an unknown conductivity k or k (1 + u/2).

The true flux is a random walk on the substeps of the samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

import livepde as lp
from benchmarks.honest.linear import SUBSTEPS, Array, Chebyshev, Linear, fine_times
from benchmarks.honest.problem import DIFFERENCE, Latent, Problem, constant, waves
from benchmarks.honest.problems.warm import Conduction

DEGREE = 40
CELLS = 80
PRIOR, STD, RATE = 0.15, 0.03, 0.02
GROWTH = 0.5  # relative growth of the conductivity with u in the nonlinear problem


class _Drifting(Problem):
    """Unknown k and J(t); theta consists of k, the initial flux, and increments between samples."""

    length, intervals = 10.0, 200
    noise = 0.02
    channels = MappingProxyType({"T_right": waves(10.0, (0.3, 2.0), (0.2, 7.0))})
    moving = ("J",)

    def __init__(self) -> None:
        self.coordinates = 2 + self.intervals
        self.latents: Mapping[str, Latent] = {
            "k": constant(0.1, 0.03, 0, self.coordinates),
            "J": Latent(PRIOR, self._flux_directions, log=False),
        }

    @property
    def increment(self) -> float:
        """Standard deviation of the increment of the flux between two samples."""
        return RATE * float(np.sqrt(self.length / self.intervals))

    def _flux_directions(self, at: int) -> Array:
        row = np.zeros((1, self.coordinates))
        row[0, 1] = STD
        row[0, 2 : 2 + at] = self.increment
        return row

    def k(self, theta: Array) -> float:
        """Return the conductivity."""
        return float(np.exp(self.latents["k"].value(theta, 0)).item())

    def path(self, theta: Array) -> Array:
        """Return the flux at the substeps, linear between the samples."""
        flux = PRIOR + STD * theta[1] + self.increment * self.walk(theta)
        return np.asarray(np.interp(fine_times(self.times), self.times, flux))

    def walk(self, theta: Array) -> Array:
        """Return the cumulative increments at the samples of a possibly shortened problem."""
        return np.append(0.0, np.cumsum(theta[2 : 2 + self.intervals]))

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        theta = np.zeros(self.coordinates)
        theta[:2] = rng.standard_normal(2)
        # Brownian path on the substeps, of which livepde and the batch fit know only the law.
        steps = rng.standard_normal((self.intervals, SUBSTEPS)) / np.sqrt(SUBSTEPS)
        theta[2 : 2 + self.intervals] = steps.sum(axis=1)
        walk = self.increment * np.append(0.0, np.cumsum(steps))
        return theta, self.shown(self.k(theta), PRIOR + STD * theta[1] + walk)

    def predict(self, theta: Array) -> Array:
        return self.shown(self.k(theta), self.path(theta))

    def shown(self, k: float, flux: Array) -> Array:
        """Return the readings for a conductivity and a flux at the substeps."""
        raise NotImplementedError

    def model(self, refine: int = 1) -> lp.Model:
        mesh = lp.interval(0.0, 1.0, 30 * refine)
        growth = self.growth
        return lp.Model(
            lp.Field(mesh, lp.linear(mesh), dirichlet={"right": lp.Channel("T_right")}),
            {
                "k": lp.LogNormal(0.1, std=0.03),
                "J": lp.Scalar(lp.Normal(PRIOR, std=STD), evolution=lp.RandomWalk(RATE)),
            },
            A=[
                lambda q, u, v, x: q.k * (1.0 + growth * u) * lp.dot(lp.grad(u), lp.grad(v)),
                lp.On("left", lambda q, u, v, x: -q.J * v),
            ],
        )

    growth = 0.0


class RodFlux(_Drifting):
    """u_t = k u_xx with the flux J(t) on the left; the truth uses collocation."""

    title = "heat in a rod: conductivity and a drifting flux"
    points = MappingProxyType({"T_1": 0.1, "T_2": 0.35, "T_3": 0.65})

    def system(self, k: float) -> Linear:
        """Return the system with the inputs T_right and J."""
        space = Chebyshev(DEGREE)
        nodes = len(space.x)
        ends = np.vstack([-k * space.D1[0], np.eye(nodes)[-1]])
        given = np.array([[0.0, 1.0], [1.0, 0.0]])
        nothing = np.zeros((nodes, 2))
        return space.system(k * space.D2, ends, given, nothing, list(self.points.values()))

    def shown(self, k: float, flux: Array) -> Array:
        g = np.column_stack([self.inputs(fine_times(self.times)), flux])
        return self.system(k).respond(g, self.length / self.intervals)

    def jacobian(self, theta: Array) -> Array:
        step = np.zeros(self.coordinates)
        step[0] = DIFFERENCE
        J = np.zeros((self.intervals + 1, len(self.points), self.coordinates))
        J[:, :, 0] = (self.predict(theta + step) - self.predict(theta)) / DIFFERENCE
        # Responses to a flux that rises from 0 to 1 in the first interval, and to a constant flux.
        fine = fine_times(self.times)
        h = self.length / self.intervals
        system = self.system(self.k(theta))
        rising = system.respond(np.column_stack([0 * fine, np.minimum(fine / h, 1.0)]), h)
        constant_one = system.respond(np.column_stack([0 * fine, 1.0 + 0 * fine]), h)
        J[:, :, 1] = STD * constant_one
        for n in range(self.intervals):
            J[n:, :, 2 + n] = self.increment * rising[: self.intervals + 1 - n]
        return J


class _DrivenRod(Conduction):
    """Conduction with a flux on the left that depends on the coordinates theta."""

    def __init__(self, problem: NonlinearFlux, k: float, flux: Array) -> None:
        super().__init__(CELLS, k, GROWTH, None, problem.channels["T_right"])
        self.fine, self.path, self.problem = fine_times(problem.times), flux, problem

    def into(self, t: float) -> float:
        return float(np.interp(t, self.fine, self.path))

    def forcing(self, t: float, y: Array) -> Array:
        problem = self.problem
        forcing = np.zeros((len(y), problem.coordinates))
        flux = self.into(t)
        forcing[:, 0] = (self.rate(t, y) - self.inflow(flux)) * (0.03 / 0.1)
        place = t / problem.length * problem.intervals
        share = np.clip(place - np.arange(problem.intervals), 0.0, 1.0)
        forcing[0, 1] = STD
        forcing[0, 2:] = problem.increment * share
        forcing[0, 1:] /= self.capacity[0]
        return forcing


class NonlinearFlux(_Drifting):
    """u_t = (k (1 + u/2) u_x)_x with the flux J(t) on the left; the truth uses finite volumes."""

    title = "conductivity k(1 + u/2) and a drifting flux"
    points = MappingProxyType({"T_1": 0.1, "T_2": 0.25, "T_3": 0.4, "T_4": 0.6, "T_5": 0.8})
    growth = GROWTH

    def shown(self, k: float, flux: Array) -> Array:
        states, _ = _DrivenRod(self, k, flux).solve(np.zeros(CELLS), self.times, False)
        return np.asarray(states @ self._sensors.T)

    def jacobian(self, theta: Array) -> Array:
        rod = _DrivenRod(self, self.k(theta), self.path(theta))
        _, tangents = rod.solve(np.zeros(CELLS), self.times, True)
        return np.asarray(np.einsum("sn,tnc->tsc", self._sensors, tangents))

    @property
    def _sensors(self) -> Array:
        """Matrix that selects the nodes of the sensors, shape (sensors, nodes)."""
        rows = np.zeros((len(self.points), CELLS))
        rows[np.arange(len(self.points)), [round(x * CELLS) for x in self.points.values()]] = 1.0
        return rows
