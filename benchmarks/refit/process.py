"""Lean forward model with exact sensitivities, for the fits of SciPy and for all costs.

    M u' + sum over j of theta_j(q) (K_j u + Q_j(u) - F_j g(t)) = 0,    z = G u + D q

with rows of given values, inputs g that are linear between samples, and the scheme of Alexander
(1977), whose first steps are graded as in `livepde.Advance`. It shares no code with livepde. Band
matrices are assembled once. For a linear process, they are factorised once for each theta and step
length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[Any]
Factor: TypeAlias = tuple[Array, Array]

GAMMA = 1.0 - np.sqrt(0.5)
GRADES = 3  # largest number of halvings of a step near the start
NEWTON = 30  # largest number of Newton updates of a stage
SMALL = 1e-6  # last update of a stage relative to the state; the error is about its square


class LostError(ArithmeticError):
    """The forward model has no finite solution."""


def stages_of(times: Array, longest: float) -> tuple[Array, Array, Array]:
    """Return starts and lengths of all steps, and the index of the last step of each interval.

    A step h that begins less than 2 h after the start is halved, at most three times, to a dyadic
    grid of its interval.
    """
    starts, lengths, last = [], [], []
    for t0, t1 in pairwise(times.tolist()):
        count = max(1, int(np.ceil((t1 - t0) / longest * (1 - 1e-12))))
        h = (t1 - t0) / count
        tick, finest = 0, 2**GRADES
        while tick < count * finest:
            t = t0 + h * tick / finest
            since = 0.5 * (t - times[0]) * (1 + 1e-9)
            stride = finest >> sum(since < h / 2**k for k in range(GRADES))
            while tick % stride:
                stride //= 2
            starts.append(t)
            lengths.append(h * stride / finest)
            tick += stride
        last.append(len(starts) - 1)
    return np.array(starts), np.array(lengths), np.array(last)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States of one forward run.

    Attributes
    ----------
    theta
        Coefficients, shape (J,).
    u
        State at the end of each stage, two for each step, shape (2 steps, n).
    factors
        Factorisation for each step length; empty if the process is not linear.
    """

    theta: Array
    u: Array
    factors: Sequence[Factor]


@dataclass(frozen=True, eq=False)
class Process:
    """Lean forward model.

    Attributes
    ----------
    M, K, F
        Mass matrix (n, n); a matrix (n, n) and an array (n, inputs) for each theta.
    G, D
        Sensor matrices, shapes (sensors, n) and (sensors, unknowns).
    u0
        Initial state, shape (n,).
    times, longest
        Times of the samples from the start on, shape (samples,), and longest step.
    inputs
        Inputs at the samples, shape (samples, inputs).
    fixed, given
        Rows with given values of u, shape (f,), and matrix from inputs to values, (f, inputs).
    quadratic, scale
        Array T of the quadratic form (see `elements`), None for a linear process, and index of the
        theta that multiplies it.
    """

    M: sp.csr_array
    K: Sequence[sp.csr_array]
    F: Sequence[Array]
    G: Array
    D: Array
    u0: Array
    times: Array
    longest: float
    inputs: Array
    fixed: Array
    given: Array
    quadratic: sp.csr_array | None = None
    scale: int = 0

    @cached_property
    def _grid(self) -> tuple[Array, Array, Array, Array]:
        """Step lengths, index of each among the distinct lengths, these, last step of a sample."""
        _, lengths, last = stages_of(self.times, self.longest)
        # Equal steps differ by rounding errors of the times.
        _, first, number = np.unique(
            np.round(lengths / lengths.max(), 11), return_index=True, return_inverse=True
        )
        return lengths, number.ravel(), lengths[first], last

    @cached_property
    def _signals(self) -> Array:
        """Inputs at the stages, shape (2 steps, inputs)."""
        starts, lengths, _ = stages_of(self.times, self.longest)
        stages = np.column_stack([starts + GAMMA * lengths, starts + lengths]).ravel()
        columns = [np.interp(stages, self.times, column) for column in self.inputs.T]
        return np.column_stack(columns) if columns else np.zeros((len(stages), 0))

    @cached_property
    def _free(self) -> Array:
        free = np.ones(len(self.u0))
        free[self.fixed] = 0.0
        return free

    @cached_property
    def _mass(self) -> sp.csr_array:
        return sp.csr_array(sp.diags_array(self._free) @ self.M)

    @cached_property
    def _stack(self) -> sp.csr_array:
        """All K stacked vertically, with zero rows for given values of u."""
        rows = sp.diags_array(self._free)
        return sp.csr_array(sp.vstack([rows @ K for K in self.K]))

    @cached_property
    def width(self) -> int:
        """Half-bandwidth."""
        coords = [matrix.tocoo().coords for matrix in (self.M, *self.K)]
        return max(int(np.abs(i - j).max(initial=0)) for i, j in coords)

    def _band(self, matrix: Any) -> Array:
        """Return the bands of a matrix's free rows, shape (2 width + 1, n), upper bands first."""
        entries = sp.csr_array(sp.diags_array(self._free) @ matrix).tocoo()
        band = np.zeros((2 * self.width + 1, entries.shape[1]))
        i, j = entries.coords
        band[self.width + i - j, j] = entries.data
        return band

    @cached_property
    def _bands(self) -> tuple[Array, Array, Array]:
        """Bands of the mass, of all K, shape (J, bands, n), and of the rows of given values."""
        fixed = np.zeros((2 * self.width + 1, len(self.u0)))
        fixed[self.width, self.fixed] = 1.0
        return self._band(self.M), np.array([self._band(K) for K in self.K]), fixed

    @cached_property
    def _slope(self) -> sp.csr_array:
        """Matrix from a state to the bands of the Jacobian of the quadratic form."""
        n, b = len(self.u0), self.width
        T = (sp.csr_array((n * n, n)) if self.quadratic is None else self.quadratic).tocoo()
        i, j = np.divmod(T.coords[0], n)
        kept = self._free[i] > 0.0
        rows = (b + i - j) * n + j
        shape = ((2 * b + 1) * n, n)
        return sp.csr_array((T.data[kept], (rows[kept], T.coords[1][kept])), shape=shape)

    def _forcing(self, theta: Array) -> Array:
        """Return sources and given values at all stages, shape (2 steps, n)."""
        F = np.tensordot(theta, np.array(self.F), 1) * self._free[:, None]
        F[self.fixed] = self.given
        return np.ascontiguousarray(self._signals @ F.T)

    def _factorise(self, band: Array) -> Factor:
        b = self.width
        room = np.zeros((3 * b + 1, band.shape[1]), order="F")
        room[b:] = band
        lu, pivots, info = lapack.dgbtrf(room, b, b, overwrite_ab=1)
        if info != 0:
            raise LostError("the matrix of a stage is singular")
        return lu, pivots

    def _solve(self, factor: Factor, known: Array) -> Array:
        x, _ = lapack.dgbtrs(factor[0], self.width, self.width, known, factor[1])
        return np.asarray(x)

    def states(self, theta: Array) -> Trajectory:
        """Run the model for coefficients theta; raise `LostError` if states are not finite."""
        lengths, number, unequal, _ = self._grid
        mass, K, fixed = self._bands
        if not np.isfinite(theta).all():
            raise LostError("coefficients are not finite")
        base = np.tensordot(theta, K, 1) + fixed
        linear = self.quadratic is None
        factors = [self._factorise(mass / (GAMMA * h) + base) for h in unequal if linear]
        forcing, M = self._forcing(theta), self._mass
        u, states = self.u0, np.empty((2 * len(lengths), len(self.u0)))
        ratio = (1.0 - GAMMA) / GAMMA
        for step, (h, k) in enumerate(zip(lengths.tolist(), number.tolist(), strict=True)):
            begin = u
            for stage in (2 * step, 2 * step + 1):
                known = (M @ begin) / (GAMMA * h) + forcing[stage]
                if linear:
                    states[stage] = self._solve(factors[k], known)
                else:
                    bands = mass / (GAMMA * h) + base
                    states[stage] = self._newton(begin, known, bands, theta)
                begin = u + ratio * (states[stage] - u)
            u = states[2 * step + 1]
        if not np.isfinite(states).all():
            raise LostError("states are not finite")
        return Trajectory(theta, states, factors)

    def _newton(self, u: Array, known: Array, bands: Array, theta: Array) -> Array:
        """Solve (bands + theta_k T u/2) u = known."""
        weight = theta[self.scale]
        for _ in range(NEWTON):
            slope = weight * (self._slope @ u).reshape(bands.shape)
            residual = _times(bands + 0.5 * slope, u) - known
            if not np.isfinite(residual).all():
                break
            update = self._solve(self._factorise(bands + slope), residual)
            u = u - update
            if np.abs(update).max() <= SMALL * (1.0 + np.abs(u).max()):
                return u
        raise LostError("Newton's method did not converge")

    def tangents(self, path: Trajectory, along: Array) -> Array:
        """Return the derivative of the states at the samples, shape (samples, n, p).

        Parameters
        ----------
        along
            Derivative of theta by p coordinates, shape (J, p).
        """
        lengths, number, _, last = self._grid
        n, p = len(self.u0), along.shape[1]
        driven = self._driven(path, along)
        linear, (mass, K, fixed) = self.quadratic is None, self._bands
        base = np.tensordot(path.theta, K, 1) + fixed
        if not linear:
            slopes = path.theta[self.scale] * (self._slope @ path.u.T).T
        U, M, ratio = np.zeros((n, p)), self._mass, (1.0 - GAMMA) / GAMMA
        ends = np.zeros((len(lengths), n, p))
        for step, (h, k) in enumerate(zip(lengths.tolist(), number.tolist(), strict=True)):
            begin = U
            for stage in (2 * step, 2 * step + 1):
                known = (M @ begin) / (GAMMA * h) - driven[stage]
                if linear:
                    factor = path.factors[k]
                else:
                    bands = mass / (GAMMA * h) + base + slopes[stage].reshape(base.shape)
                    factor = self._factorise(bands)
                new = self._solve(factor, known)
                begin = U + ratio * (new - U)
            U = ends[step] = new
        return ends[last]

    def _driven(self, path: Trajectory, along: Array) -> Array:
        """Return the derivative of the equation by the coordinates, shape (2 steps, n, p)."""
        stages, n = path.u.shape
        each = (self._stack @ path.u.T).reshape(len(self.K), n, stages)
        if self.quadratic is not None:
            slope = (self._slope @ path.u.T).reshape(2 * self.width + 1, n, stages)
            each[self.scale] += 0.5 * _times(slope, path.u.T)
        each -= (np.array(self.F) * self._free[:, None]) @ self._signals.T
        return np.ascontiguousarray(np.tensordot(along, each, (0, 0)).transpose(2, 1, 0))

    def predicted(self, path: Trajectory, q: Array) -> Array:
        """Return the readings at the samples after the first, shape (samples, sensors)."""
        ends = path.u[2 * self._grid[3] + 1]
        return np.asarray(ends @ self.G.T + self.D @ q)

    def shown_tangents(self, path: Trajectory, along: Array, dq: Array) -> Array:
        """Return the derivative of `predicted`, shape (samples, sensors, p)."""
        return np.asarray(self.G @ self.tangents(path, along) + self.D @ dq)


def _times(bands: Array, u: Array) -> Array:
    """Return the product of a banded matrix (bands, n, ...) and u (n, ...)."""
    width = len(bands) // 2
    product = bands[width] * u
    for k in range(1, width + 1):
        product[:-k] += bands[width - k][k:] * u[k:]
        product[k:] += bands[width + k][:-k] * u[:-k]
    return np.asarray(product)
