"""Anisotropic plate, and reaction field on a square; the truths use cosine series."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

import livepde as lp
from benchmarks.honest.linear import Array, Linear, fine_times
from benchmarks.honest.problem import Latent, Problem, constant, waves


def _waves(count: int, x: Array) -> Array:
    """Return orthonormal cosines on (0, 1) at points, shape (points, count)."""
    j = np.arange(count)
    return np.asarray(np.where(j == 0, 1.0, np.sqrt(2.0)) * np.cos(np.pi * j * x[:, None]))


def _products(count: int, x: Array, y: Array) -> Array:
    """Return products of cosines at points (x, y), shape (points, count^2)."""
    both = _waves(count, x)[:, :, None] * _waves(count, y)[:, None, :]
    return both.reshape(len(x), -1)


def _midpoints(count: int) -> tuple[Array, Array]:
    line = (np.arange(count) + 0.5) / count
    x, y = np.meshgrid(line, line, indexing="ij")
    return x.ravel(), y.ravel()


class Plate(Problem):
    """u_t = kx u_xx + ky u_yy - loss u + P(t) bump(x, y) with zero flux at the sides."""

    title = "heat in an anisotropic plate: two conductivities and a loss"
    length, intervals = 10.0, 200
    points = MappingProxyType(
        {
            f"T_{3 * i + j}": (x, y)
            for i, x in enumerate((0.2, 0.5, 0.8))
            for j, y in enumerate((0.2, 0.5, 0.8))
        }
    )
    noise = 0.02
    coordinates = 3
    latents = MappingProxyType(
        {
            "kx": constant(0.05, 0.02, 0, 3),
            "ky": constant(0.05, 0.02, 1, 3),
            "loss": constant(0.3, 0.15, 2, 3),
        }
    )
    channels = MappingProxyType({"P": waves(10.0, (3.0, 2.0), (3.0, 5.0))})
    COUNT = 24

    @staticmethod
    def _bump(x: Any, y: Any) -> Any:
        return np.exp(-((x - 0.3) ** 2 + (y - 0.4) ** 2) / (2 * 0.2**2))

    def predict(self, theta: Array) -> Array:
        kx, ky, loss = (np.exp(item.value(theta, 0)).item() for item in self.latents.values())
        x, y = _midpoints(4 * self.COUNT)
        heat = _products(self.COUNT, x, y).T @ self._bump(x, y) / len(x)
        squares = (np.pi * np.arange(self.COUNT)) ** 2
        decay = -(kx * squares[:, None] + ky * squares[None, :] + loss).ravel()
        at = np.array(list(self.points.values()))
        C = _products(self.COUNT, at[:, 0], at[:, 1])
        system = Linear(decay, heat[:, None], C, np.zeros((len(C), 1)))
        return system.respond(self.inputs(fine_times(self.times)), self.length / self.intervals)

    def model(self, refine: int = 1) -> lp.Model:
        mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (14 * refine, 14 * refine))
        bump = self._bump
        return lp.Model(
            lp.Field(mesh, lp.linear(mesh)),
            {
                "kx": lp.LogNormal(0.05, std=0.02),
                "ky": lp.LogNormal(0.05, std=0.02),
                "loss": lp.LogNormal(0.3, std=0.15),
            },
            A=lambda q, u, v, x: (
                q.kx * lp.grad(u)[0] * lp.grad(v)[0]
                + q.ky * lp.grad(u)[1] * lp.grad(v)[1]
                + q.loss * u * v
            ),
            f=lambda x, _: x.inputs["P"] * bump(x[0], x[1]),
            inputs=["P"],
        )


class Reaction(Problem):
    """u_t = D Laplace u - q(x, y) u + S(t) shape(x, y), with 30 sensors."""

    title = "reaction field on a square, 30 sensors"
    length, intervals = 20.0, 200
    points = MappingProxyType(
        {
            f"u_{5 * i + j}": (x, y)
            for i, x in enumerate(np.linspace(0.1, 0.9, 6).tolist())
            for j, y in enumerate(np.linspace(0.1, 0.9, 5).tolist())
        }
    )
    noise = 0.02
    channels = MappingProxyType({"S": lambda t: 1.0 + waves(20.0, (0.5, 3.0), (0.3, 7.0))(t)})
    u0 = 1.0
    D = 0.05
    COUNT, GRID = 10, 24  # cosines of the state, and quadrature points, in each direction
    LENGTH, PRIOR, STD = 0.3, 1.0, 0.4
    # The field has all cosines that livepde's mesh of 12 x 12 cells resolves. Most of them are not
    # identifiable, but they contribute considerably to the posterior's width.
    FIELD = tuple((j, k) for j in range(13) for k in range(13) if j**2 + k**2 <= 12**2)
    coordinates = len(FIELD)

    def __init__(self) -> None:
        x, y = self.mesh().p
        at_vertices = self._expansion(x, y)
        self.latents = {"q": Latent(float(np.log(self.PRIOR)), lambda at: at_vertices)}
        x, y = _midpoints(self.GRID)
        self._basis = _products(self.COUNT, x, y) / np.sqrt(len(x))
        self._field = self._expansion(x, y)
        self._shape_coefficients = self._basis.T @ self._shape(x, y) / np.sqrt(len(x))
        at = np.array(list(self.points.values()))
        self._sensors = _products(self.COUNT, at[:, 0], at[:, 1])

    @staticmethod
    def mesh(refine: int = 1) -> Any:
        """Return livepde's mesh."""
        return lp.rectangle((0.0, 1.0), (0.0, 1.0), (12 * refine, 12 * refine))

    @staticmethod
    def _shape(x: Any, y: Any) -> Any:
        return 1.0 + 0.5 * np.cos(np.pi * x) * np.cos(np.pi * y)

    def _expansion(self, x: Array, y: Array) -> Array:
        """Return the cosines times their standard deviations under the prior Sobolev(2, length)."""
        factor = lp.Sobolev(2, self.LENGTH).pointwise(2).factor
        j, k = np.array(self.FIELD).T
        shapes = _waves(13, x)[:, j] * _waves(13, y)[:, k]
        scale = 1.0 / (1.0 + (np.pi * self.LENGTH) ** 2 * (j**2 + k**2)) / np.sqrt(factor)
        return np.asarray(shapes * scale * self.STD / self.PRIOR)

    def reaction(self, theta: Array, x: Array, y: Array) -> Array:
        """Return q at the points (x, y)."""
        return np.asarray(self.PRIOR * np.exp(self._expansion(x, y) @ theta))

    def predict(self, theta: Array) -> Array:
        q = self.PRIOR * np.exp(self._field @ theta)
        squares = (np.pi * np.arange(self.COUNT)) ** 2
        A = -(self._basis.T * q) @ self._basis
        A -= self.D * np.diag((squares[:, None] + squares[None, :]).ravel())
        values, V = np.linalg.eigh(A)
        start = np.zeros(len(A))
        start[0] = self.u0
        C = self._sensors @ V
        B = (V.T @ self._shape_coefficients)[:, None]
        system = Linear(values, B, C, np.zeros((len(C), 1)))
        g = self.inputs(fine_times(self.times))
        return system.respond(g, self.length / self.intervals, V.T @ start)

    def model(self, refine: int = 1) -> lp.Model:
        mesh, D, shape = self.mesh(refine), self.D, self._shape
        prior = lp.Sobolev(2, self.LENGTH).pointwise(2)
        q = lp.Field(
            mesh, lp.linear(mesh), inner=prior, prior=lp.LogNormal(self.PRIOR, std=self.STD)
        )
        return lp.Model(
            lp.Field(mesh, lp.linear(mesh)),
            {"q": q},
            A=lambda q, u, v, x: q.q * u * v,
            B=lambda u, v, x: D * lp.dot(lp.grad(u), lp.grad(v)),
            f=lambda x, _: x.inputs["S"] * shape(x[0], x[1]),
            inputs=["S"],
        )
