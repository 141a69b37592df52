"""Predicted readings and their Jacobians for the states of several members."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.laws.filter_state import FilterState
from livepde.laws.law import Problem
from livepde.laws.reduction import Reduction
from livepde.linalg import Array, RowProduct, row_product
from livepde.observation import Observed
from livepde.stepping import Moments


class MemberSensors:
    """Predicted readings of each member and their derivatives, linear about its point."""

    def __init__(self, problem: Problem, reduction: Reduction) -> None:
        self.problem = problem
        self.reduction = reduction
        observed = problem.observed
        # Others may read the unknowns, inputs or the time, or bend at the state.
        self.fixed = (
            type(observed) is Observed
            and not observed.observation.directs
            and not observed.observation.inputs
        )

    @cached_property
    def _read(self) -> RowProduct:
        return row_product(sp.csr_array(self.problem.observed.G))

    def observe(self, x: FilterState, at: Moments) -> tuple[Array, Array]:
        """Return predicted readings, (members, sensors), and Y = [U C] H^T, (members, r, sensors).

        Linear about the linearisation point.
        """
        if self.fixed:
            return self._read(x.u + x.du), self.rows(x, x.U, x.C, at)
        predicted, rows = [], []
        for k in range(len(x)):
            deviates = bool(x.du[k].any() or x.da[k].any())
            U, C = x.U[k], x.C[k]
            if not len(U) and not deviates:
                predicted.append(self._predicted(x.u[k], x.q[k], at, k))
                rows.append(np.zeros((0, self.problem.observed.size)))
                continue
            # The offset of the estimate is one more row: so predictions stay linear about the
            # point.
            if deviates:
                U, C = np.vstack([U, x.du[k]]), np.vstack([C, x.da[k]])
            z, Y = self._of_one(x.u[k], x.q[k], U, C, at, k)
            predicted.append(z + Y[-1] if deviates else z)
            rows.append(Y[: len(x.U[k])])
        return np.array(predicted), np.array(rows)

    def rows(self, x: FilterState, U: Array, C: Array, at: Moments) -> Array:
        """Return [U C] H^T for rows of each member, (members, rows, sensors), about its point."""
        if self.fixed:
            seen = self._read(U.reshape(-1, U.shape[2]))
            return seen.reshape(*U.shape[:2], seen.shape[1])
        each = (self._of_one(x.u[k], x.q[k], U[k], C[k], at, k)[1] for k in range(len(x)))
        return np.array(list(each))

    def _predicted(self, u: Array, q: Array, at: Moments, k: int) -> Array:
        """Return the readings of one member."""
        observed, latent = self.problem.observed, self.problem.model.latent
        return observed.predict(u, latent.value(q), at.member(k))

    def _of_one(
        self, u: Array, q: Array, U: Array, C: Array, at: Moments, k: int
    ) -> tuple[Array, Array]:
        """Return the readings of one member, and those of rows [U C]."""
        observed, latent, moment = self.problem.observed, self.problem.model.latent, at.member(k)
        physical = latent.value(q)
        H_u, H_q = observed.jacobian(u, physical, moment)
        Y: Array = np.asarray((H_u @ U.T).T)
        if H_q is not None:
            Y = Y + self.reduction.directions(q[None], C[None])[0] @ H_q.T
        return self._predicted(u, q, at, k), Y
