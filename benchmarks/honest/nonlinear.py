"""Stiff nonlinear systems with tridiagonal Jacobians, and their tangents, by TR-BDF2.

TR-BDF2 (Bank, Coughran, Fichtner, Grosse, Rose, Smith 1985) combines the trapezoidal rule and BDF2.
It is L-stable and of second order. Several steps are taken between two samples. The tangents are
exact derivatives of the discrete solution.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

Array = NDArray[Any]
SUBSTEPS = 4  # steps between two samples
GAMMA = 2.0 - np.sqrt(2.0)
TOLERANCE = 1e-5  # Newton update relative to the state; the remaining error is about its square
MOST = 12  # largest number of Newton steps


class Stiff(ABC):
    """System y' = f(t, y) whose parameters depend on coordinates theta."""

    @abstractmethod
    def rate(self, t: float, y: Array) -> Array:
        """Return f, shape (n,)."""

    @abstractmethod
    def jacobian(self, t: float, y: Array) -> Array:
        """Return df/dy as three bands in the format of `scipy.linalg.solve_banded`."""

    @abstractmethod
    def forcing(self, t: float, y: Array) -> Array:
        """Return df/dtheta, shape (n, coordinates)."""

    def solve(self, start: Array, times: Array, tangents: bool) -> tuple[Array, Array]:
        """Return y at the samples, (samples, n), and dy/dtheta, (samples, n, coordinates).

        The start does not depend on theta. Without tangents, dy/dtheta has shape (samples, n, 0).
        """
        y = np.asarray(start, dtype=float)
        width = self.forcing(float(times[0]), y).shape[1] if tangents else 0
        Y = np.zeros((len(y), width))
        states, derivatives = [y], [Y]
        for t0, t1 in zip(times[:-1].tolist(), times[1:].tolist(), strict=True):
            h = (t1 - t0) / SUBSTEPS
            for j in range(SUBSTEPS):
                y, Y = self._step(t0 + j * h, h, y, Y)
            states.append(y)
            derivatives.append(Y)
        return np.array(states), np.array(derivatives)

    def _step(self, t: float, h: float, y: Array, Y: Array) -> tuple[Array, Array]:
        a = 0.5 * GAMMA * h
        middle, end = t + GAMMA * h, t + h
        later = self._stage(y + a * self.rate(t, y), y, a, middle)
        old, new = (1 - GAMMA) ** 2 / (GAMMA * (2 - GAMMA)), 1 / (GAMMA * (2 - GAMMA))
        last = self._stage(new * later - old * y, later, a, end)
        if not Y.shape[1]:
            return last, Y
        slope = _times(self.jacobian(t, y), Y) + self.forcing(t, y)
        Y_later = self._tangent(Y + a * slope, later, a, middle)
        return last, self._tangent(new * Y_later - old * Y, last, a, end)

    def _stage(self, known: Array, guess: Array, a: float, t: float) -> Array:
        """Solve y - a f(t, y) = known."""
        y = guess
        for _ in range(MOST):
            update = solve_banded(
                (1, 1), self._matrix(y, a, t), known - y + a * self.rate(t, y), check_finite=False
            )
            y = y + update
            if np.abs(update).max() <= TOLERANCE * (1.0 + np.abs(y).max()):
                return y
        raise ArithmeticError(f"Newton's method did not converge at t = {t:g}.")

    def _matrix(self, y: Array, a: float, t: float) -> Array:
        bands = -a * self.jacobian(t, y)
        bands[1] += 1.0
        return bands

    def _tangent(self, known: Array, y: Array, a: float, t: float) -> Array:
        tangent: Array = solve_banded(
            (1, 1), self._matrix(y, a, t), known + a * self.forcing(t, y), check_finite=False
        )
        return tangent


def _times(bands: Array, Y: Array) -> Array:
    product = bands[1][:, None] * Y
    product[:-1] += bands[0][1:, None] * Y[1:]
    product[1:] += bands[2][:-1, None] * Y[:-1]
    return np.asarray(product)
