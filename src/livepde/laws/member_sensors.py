"""Predicted readings of several members, their Jacobians, and corrections of the state alone.

A misfit after a pause or a disturbance is most likely due to a wrong state. Let R be the Riesz
representers of the sensors H, and K = R (H R)^-1. Then u += K d is the smoothest correction that
matches the readings. The unknowns and their covariance do not change. The square root of the state
becomes U - (H U + D C) K: the observed part no longer depends on the unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.laws.filter_state import FilterState
from livepde.laws.law import Problem
from livepde.laws.reduction import Reduction
from livepde.linalg import Array, Mask, RowProduct, row_product
from livepde.linalg.member_arrays import changed
from livepde.model import Model, h1_form, mass_form
from livepde.observation import Observed
from livepde.spaces import HilbertSpace
from livepde.stepping import Moments


@dataclass(frozen=True, eq=False)
class MemberSensors:
    """Predicted readings of each member and their derivatives at its linearisation point."""

    problem: Problem
    reduction: Reduction

    @cached_property
    def fixed(self) -> bool:
        """True if readings are a fixed linear function of the state alone."""
        observed, observation = self.problem.observed, self.problem.observed.observation
        return type(observed) is Observed and not (observation.directs or observation.inputs)

    @cached_property
    def _read(self) -> RowProduct:
        return row_product(sp.csr_array(self.problem.observed.steady_matrix))

    def _observed(self, columns: Array) -> Array:
        """Return G times states, (..., sensors) for (..., n)."""
        readings = self._read(columns.reshape(-1, columns.shape[-1]))
        return readings.reshape(*columns.shape[:-1], readings.shape[1])

    def _direct(self, at: Moments) -> Array | None:
        """Return D of time-independent sensors z = G u + D q; None for other sensors."""
        return None if self.fixed else self.problem.observed.steady_direct(at.member(0))

    def _direct_part(self, x: FilterState, D: Array) -> Array:
        """Return D q of each member, (members, sensors)."""
        return np.array([D @ self.problem.model.latent.value(q) for q in x.q])

    def observe(self, x: FilterState, at: Moments) -> tuple[Array, Array]:
        """Return predictions, (members, sensors), and Y = [U C] H^T, (members, r, sensors)."""
        D = self._direct(at)
        if self.fixed or D is not None:
            seen = self._observed(x.u + x.du)
            if D is not None:
                shift = self.reduction.directions(x.q, x.da[:, None])[:, 0]
                seen = seen + self._direct_part(x, D) + shift @ D.T
            return seen, self.rows(x, x.U, x.C, at)
        predicted, rows = [], []
        for k in range(len(x)):
            deviates = bool(x.du[k].any() or x.da[k].any())
            U, C = x.U[k], x.C[k]
            if not len(U) and not deviates:
                predicted.append(self._predicted(x.u[k], x.q[k], at, k))
                rows.append(np.zeros((0, self.problem.observed.size)))
                continue
            # The deviation of the estimate is one more row, which keeps predictions linear.
            if deviates:
                U, C = np.vstack([U, x.du[k]]), np.vstack([C, x.da[k]])
            z, Y = self._observe_member(x.u[k], x.q[k], U, C, at, k)
            predicted.append(z + Y[-1] if deviates else z)
            rows.append(Y[: len(x.U[k])])
        return np.array(predicted), np.array(rows)

    def observe_each(
        self, x: FilterState, columns: Array, end: Callable[[int], Moments]
    ) -> tuple[Array, Array]:
        """Return predictions and observed rows at moments `end(0)`, ..., for states and rows U.

        `columns`: states followed by rows U, (moments, 1 + r, members, n); `x.du` and `x.da` must
        be zero. Shapes: (moments, members, sensors) and (moments, members, r, sensors).
        """
        D = None if self.fixed or not len(columns) else self._direct(end(0))
        if self.fixed or D is not None:
            seen = self._observed(columns)
            predicted, Y = seen[:, 0], seen[:, 1:].swapaxes(1, 2)
            if D is None:
                return predicted, Y
            slopes = self.reduction.directions(x.q, x.C[:, : Y.shape[2]]) @ D.T
            return predicted + self._direct_part(x, D), Y + slopes
        shape, sensors = columns.shape, self.problem.observed.size
        predicted = np.empty((shape[0], shape[2], sensors))
        Y = np.empty((shape[0], shape[2], shape[1] - 1, sensors))
        for k, column in enumerate(columns):
            now = changed(x, u=column[0], U=column[1:].swapaxes(0, 1))
            predicted[k], Y[k] = self.observe(now, end(k))
        return predicted, Y

    def rows(self, x: FilterState, U: Array, C: Array, at: Moments) -> Array:
        """Return [U C] H^T for rows of each member, (members, rows, sensors)."""
        D = self._direct(at)
        if self.fixed or D is not None:
            seen = self._observed(U)
            return seen if D is None else seen + self.reduction.directions(x.q, C) @ D.T
        each = (self._observe_member(x.u[k], x.q[k], U[k], C[k], at, k)[1] for k in range(len(x)))
        return np.array(list(each))

    def _predicted(self, u: Array, q: Array, at: Moments, k: int) -> Array:
        observed, latent = self.problem.observed, self.problem.model.latent
        return observed.predict(u, latent.value(q), at.member(k))

    def _observe_member(
        self, u: Array, q: Array, U: Array, C: Array, at: Moments, k: int
    ) -> tuple[Array, Array]:
        """Return the predicted readings of member `k`, and [U C] H^T for its rows."""
        observed, latent, moment = self.problem.observed, self.problem.model.latent, at.member(k)
        physical = latent.value(q)
        H_u, H_q = observed.jacobian(u, physical, moment)
        Y: Array = np.asarray((H_u @ U.T).T)
        if H_q is not None:
            Y = Y + self.reduction.directions(q[None], C[None])[0] @ H_q.T
        return self._predicted(u, q, at, k), Y


@dataclass(frozen=True, eq=False)
class Anchor:
    """Correct the state of members, but not their unknowns, by readings."""

    problem: Problem
    sensors: MemberSensors

    @cached_property
    def _space(self) -> HilbertSpace:
        """State space with the inner product u v + L^2 grad u . grad v, L the domain size."""
        model: Model = self.problem.model
        points = next(iter(model.state_space.fields.values())).field.mesh.p
        size = float(np.ptp(points, axis=1).max())
        # With L, the smoothness of the representers does not depend on the unit of length.
        stiffness = model.bilinear(h1_form) - model.bilinear(mass_form)
        gram = sp.csr_array(model.state_mass + size**2 * stiffness)
        return HilbertSpace(gram, "X", model.state_space.fixed)

    def corrected(self, x: FilterState, d: Array, used: Mask, at: Moments) -> FilterState:
        """Return the filter after the readings `used`, (members, sensors), have corrected u."""
        problem, du, U = self.problem, x.du.copy(), x.U.copy()
        errors = x.shadows.u.copy()  # discretisation errors, which the correction also reduces
        _, Y = self.sensors.observe(x, at)
        for k in np.flatnonzero(used.any(axis=1)).tolist():
            read = np.flatnonzero(used[k])
            q = problem.model.latent.value(x.q[k])
            H = problem.observed.jacobian(x.u[k], q, at.member(k))[0][read].toarray()
            R = self._space.riesz(H.T)
            # Sensors at the same place have one representer: the pseudoinverse averages them.
            K = R @ np.linalg.pinv(H @ R, rcond=1e-9, hermitian=True)
            du[k] += K @ d[k, read]
            U[k] -= Y[k][:, read] @ K.T
            errors[k] -= (errors[k] @ H.T) @ K.T
        return changed(x, du=du, U=U, shadows=changed(x.shadows, u=errors))
