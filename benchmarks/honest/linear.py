"""Linear systems y' = A y + B g(t), solved by matrix exponentials without a time scheme.

The inputs g are linear between substeps. The response to them is exact (Van Loan 1978). The only
errors are the interpolation of g on substeps, which are much shorter than the sampling interval,
and the space discretisation of A.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as sla
from numpy.typing import NDArray

Array = NDArray[Any]
SUBSTEPS = 8  # substeps between two samples
SMALL = 1e-3  # |z| below which exp(z) - 1 - z is evaluated by its series


def fine_times(times: Array, substeps: int = SUBSTEPS) -> Array:
    """Return the times of the substeps of evenly spaced samples."""
    return np.linspace(times[0], times[-1], substeps * (len(times) - 1) + 1)


@dataclass(frozen=True, eq=False)
class Linear:
    """Linear system y' = A y + B g, z = C y + D g.

    Parameters
    ----------
    A
        Shape (n, n), or (n,) if A is diagonal.
    B, C, D
        Shapes (n, inputs), (sensors, n) and (sensors, inputs).
    """

    A: Array
    B: Array
    C: Array
    D: Array

    @classmethod
    def symmetric(cls, main: Array, off: Array, B: Array, C: Array, D: Array) -> Linear:
        """Diagonalise a system with a symmetric tridiagonal A."""
        values, V = sla.eigh_tridiagonal(main, off)
        return cls(values, V.T @ B, C @ V, D)

    def respond(self, g: Array, step: float, start: Array | None = None) -> Array:
        """Return the outputs z at the samples, shape (samples, sensors).

        Parameters
        ----------
        g
            Inputs at the substeps, shape (SUBSTEPS * intervals + 1, inputs).
        step
            Time between two samples.
        start
            y at the first sample; default zero.
        """
        delta, intervals = step / SUBSTEPS, (len(g) - 1) // SUBSTEPS
        diagonal = self.A.ndim == 1
        once, B0, B1 = self._diagonal_step(delta) if diagonal else self._dense_step(delta)
        # B0 and B1 act at the ends of a substep, followed by the rest of the sampling interval.
        weights = np.zeros((SUBSTEPS + 1, *self.B.shape))
        power = np.ones_like(once) if diagonal else np.eye(len(once))
        for j in reversed(range(SUBSTEPS)):
            now = power[:, None] if diagonal else power
            weights[j] += now * B0 if diagonal else now @ B0
            weights[j + 1] += now * B1 if diagonal else now @ B1
            power = power * once if diagonal else power @ once
        windows = np.stack(
            [g[j : j + SUBSTEPS * (intervals - 1) + 1 : SUBSTEPS] for j in range(SUBSTEPS + 1)]
        )
        forced = np.einsum("jni,jki->kn", weights, windows)
        y = np.zeros((intervals + 1, len(self.B)))
        y[0] = 0.0 if start is None else start
        for k in range(intervals):
            y[k + 1] = (power * y[k] if diagonal else power @ y[k]) + forced[k]
        z: Array = y @ self.C.T + g[::SUBSTEPS] @ self.D.T
        return z

    def _dense_step(self, delta: float) -> tuple[Array, Array, Array]:
        n, m = self.B.shape
        block = np.zeros((n + 2 * m, n + 2 * m))
        block[:n, :n], block[:n, n : n + m] = self.A * delta, self.B * delta
        block[n : n + m, n + m :] = np.eye(m)
        E = sla.expm(block)
        last = E[:n, n + m :]
        return E[:n, :n], E[:n, n : n + m] - last, last

    def _diagonal_step(self, delta: float) -> tuple[Array, Array, Array]:
        z = self.A * delta
        safe = np.where(np.abs(z) < SMALL, 1.0, z)
        first = np.where(np.abs(z) < SMALL, 1 + z / 2 + z**2 / 6, np.expm1(safe) / safe)
        second = np.where(
            np.abs(z) < SMALL, 0.5 + z / 6 + z**2 / 24, (np.expm1(safe) - safe) / safe**2
        )
        B1 = delta * second[:, None] * self.B
        return np.exp(z), delta * first[:, None] * self.B - B1, B1


class Chebyshev:
    """Collocation and interpolation with the Chebyshev points of (0, length).

    Parameters
    ----------
    count
        Polynomial degree.
    length
        Length of the interval.
    """

    def __init__(self, count: int, length: float = 1.0) -> None:
        k = np.arange(count + 1)
        self.x = 0.5 * length * (1.0 - np.cos(np.pi * k / count))
        self._weights = (-1.0) ** k
        self._weights[[0, -1]] *= 0.5
        distance = self.x[:, None] - self.x[None, :] + np.eye(count + 1)
        D = self._weights[None, :] / self._weights[:, None] / distance
        D -= np.diag(D.sum(axis=1))  # the derivative of a constant is zero
        self.D1 = D
        self.D2 = D @ D

    def rows(self, points: Sequence[float]) -> Array:
        """Return the matrix of barycentric interpolation to points, shape (points, nodes)."""
        rows = np.zeros((len(points), len(self.x)))
        for row, point in zip(rows, points, strict=True):
            gap = point - self.x
            hit = np.abs(gap) < 1e-14
            if hit.any():
                row[hit] = 1.0
            else:
                row[:] = self._weights / gap
                row /= row.sum()
        return rows

    def system(
        self, operator: Array, ends: Array, given: Array, source: Array, points: Sequence[float]
    ) -> Linear:
        """Return the system u_t = operator u + source g with boundary conditions ends u = given g.

        Parameters
        ----------
        operator
            Operator on all nodes, shape (nodes, nodes).
        ends
            Rows of the two boundary conditions, shape (2, nodes).
        given
            Right-hand sides of the boundary conditions, shape (2, inputs).
        source
            Shape (nodes, inputs).
        points
            Positions of the sensors.
        """
        outer, inner = [0, -1], slice(1, -1)
        inverse = np.linalg.inv(ends[:, outer])
        from_inner, from_inputs = -inverse @ ends[:, inner], inverse @ given
        rows = self.rows(points)
        return Linear(
            operator[inner, inner] + operator[inner][:, outer] @ from_inner,
            operator[inner][:, outer] @ from_inputs + source[inner],
            rows[:, inner] + rows[:, outer] @ from_inner,
            rows[:, outer] @ from_inputs,
        )


def diffusion(
    conductance: Array, capacity: Array, loss: Array, B: Array, C: Array, D: Array
) -> Linear:
    """Return the finite-volume system capacity y' = -(differences of fluxes) - loss y + B g.

    Parameters
    ----------
    conductance
        Conductance between neighbouring volumes, shape (volumes - 1,).
    capacity, loss
        Capacity of each volume, and its conductance to inputs, shape (volumes,).
    """
    root = np.sqrt(capacity)
    main = -loss.astype(float)
    main[:-1] -= conductance
    main[1:] -= conductance
    off = conductance / (root[:-1] * root[1:])
    return Linear.symmetric(main / capacity, off, B / root[:, None], C / root, D)
