"""Tracer in soil with mobile and immobile water; the truth uses finite volumes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import livepde as lp
from benchmarks.honest.linear import Linear, fine_times
from benchmarks.refit.elements import advection, interpolation, mass, stiffness
from benchmarks.refit.problem import Priors, Problem
from benchmarks.refit.process import Process
from benchmarks.refit.unknowns import Unknown

Array = NDArray[Any]
CELLS, FINE = 40, 200
DEPTH = 20.0  # cm
V = 0.5  # cm/h, known mean pore velocity


class Immobile(Problem):
    """Concentrations c in mobile and s in immobile water, washed out from c = s = 1.

    phi c_t = phi D c_xx - v c_x - omega (c - s),    (1 - phi) s_t = omega (c - s)
    """

    title = "mobile and immobile water"
    unknowns = MappingProxyType(
        {"D": Unknown(0.3), "phi": Unknown(0.6, "logit"), "omega": Unknown(0.02)}
    )
    points = MappingProxyType({"c_6": 6.0, "c_11": 11.0})
    noise = 0.01
    times = np.linspace(0.0, 80.0, 65)
    converging = 0.90
    most_passes = 18.0

    @property
    def u0(self) -> Any:
        return 1.0

    def truth(self) -> Array:
        D, phi, omega = self.q_true
        h, one = DEPTH / FINE, np.eye(FINE)
        # Fluxes through the faces, per volume of mobile water. No tracer enters on the left; on the
        # right it leaves by advection.
        inner = (one[1:] + one[:-1]) * (0.5 * V / phi) - (one[1:] - one[:-1]) * (D / h)
        flux = np.vstack([0.0 * one[:1], inner, one[-1:] * (V / phi)])
        exchange = omega * one
        A = np.block(
            [
                [-(flux[1:] - flux[:-1]) / h - exchange / phi, exchange / phi],
                [exchange / (1 - phi), -exchange / (1 - phi)],
            ]
        )
        # Values of volumes are at their midpoints.
        at = np.array(list(self.points.values()))
        seen = interpolation(at, FINE - 1, 0.5 * h, DEPTH - 0.5 * h)
        C = np.hstack([seen, 0.0 * seen])
        nothing = np.zeros((len(A), 1)), np.zeros((len(C), 1))
        system = Linear(A, nothing[0], C, nothing[1])
        g = np.zeros((len(fine_times(self.times)), 1))
        return system.respond(g, float(self.times[1]), np.ones(len(A)))

    def model(self, priors: Priors) -> lp.Model:
        mesh = lp.interval(0.0, DEPTH, CELLS)
        element = lp.linear(mesh)

        def transport(q: Any, u: Any, w: Any, x: Any) -> Any:
            return (q.D * lp.grad(u.c)[0] - V / q.phi * u.c) * lp.grad(w.c)[0]

        def exchange(q: Any, u: Any, w: Any, x: Any) -> Any:
            return q.omega * (u.c - u.s) * (w.c / q.phi - w.s / (1 - q.phi))

        outflow = lp.On("right", lambda q, u, w, x: V / q.phi * u.c * w.c)
        return lp.Model(
            {"c": lp.Field(mesh, element), "s": lp.Field(mesh, element)},
            {name: self.prior_of(name, priors) for name in self.unknowns},
            A=[transport, exchange, outflow],
        )

    def sensors(self, priors: Priors) -> lp.Points:
        return lp.Points(dict(self.points), noise=self.noise, of="c")

    @cached_property
    def process(self) -> Process:
        h, n = DEPTH / CELLS, CELLS + 1
        M, nodes = mass(CELLS, h), np.eye(2)

        def both(matrix: Any, block: Any) -> sp.csr_array:
            # c and s of a node are adjacent, so that the bandwidth is small.
            return sp.csr_array(sp.kron(matrix, np.array(block)))

        points: Mapping[str, float] = self.points
        seen = interpolation(np.array(list(points.values())), CELLS, 0.0, DEPTH)
        return Process(
            M=both(M, nodes),
            K=[
                both(stiffness(CELLS, h), [[1, 0], [0, 0]]),
                both(advection(CELLS), [[1, 0], [0, 0]]),
                both(M, [[1, -1], [0, 0]]),
                both(M, [[0, 0], [-1, 1]]),
            ],
            F=[np.zeros((2 * n, 0))] * 4,
            G=np.kron(seen, nodes[:1]),
            D=np.zeros((len(points), 3)),
            u0=np.ones(2 * n),
            times=self.times,
            longest=self.longest,
            inputs=np.zeros((len(self.times), 0)),
            fixed=np.zeros(0, dtype=int),
            given=np.zeros((0, 0)),
        )

    def theta(self, q: Array) -> tuple[Array, Array]:
        D, phi, omega = q
        rest = 1.0 - phi
        theta = np.array([D, V / phi, omega / phi, omega / rest])
        by_phi = [0.0, -V / phi**2, -omega / phi**2, omega / rest**2]
        by_omega = [0.0, 0.0, 1.0 / phi, 1.0 / rest]
        return theta, np.array([[1.0, 0.0, 0.0, 0.0], by_phi, by_omega]).T
