"""State corrected by readings without the unknowns: after a stretch that the model did not explain.

Readings that misfit after a pause, a leap or a disturbance show first that the state is wrong. With
the Riesz representers R of the sensors H the correction u += K d, K = R (H R)^-1, is the smoothest
one that meets the readings. The unknowns and their covariance stay as they are. The square root of
the state becomes U - (H U + D C) K: what the readings determine depends no longer on the unknowns.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.laws.filter_state import FilterState
from livepde.laws.law import Problem
from livepde.laws.member_arrays import changed
from livepde.laws.member_sensors import MemberSensors
from livepde.linalg import Array, Mask
from livepde.model import Model, h1_form
from livepde.spaces import HilbertSpace
from livepde.stepping import Moments


class Anchor:
    """Corrects the state of members by their readings alone."""

    def __init__(self, problem: Problem, sensors: MemberSensors) -> None:
        self.problem, self.sensors = problem, sensors

    @cached_property
    def _space(self) -> HilbertSpace:
        """The state with the inner product u v + L^2 grad u . grad v, L the size of the domain."""
        model: Model = self.problem.model
        points = next(iter(model.state_space.fields.values())).field.mesh.p
        size = float(np.ptp(points, axis=1).max())
        # The length makes the product independent of the unit of length.
        mass, whole = model.state_mass, model.bilinear(h1_form)
        gram = sp.csr_array(mass + size**2 * (whole - mass))
        return HilbertSpace(gram, "X", model.state_space.fixed)

    def corrected(self, x: FilterState, d: Array, used: Mask, at: Moments) -> FilterState:
        """Return the state of members after readings that correct u only.

        `d`, `used`: innovations, and which of them correct the state, (members, sensors).
        """
        problem, du, U = self.problem, x.du.copy(), x.U.copy()
        errors = x.shadows.u.copy()  # of the discretisation, which the correction removes, too
        _, Y = self.sensors.observe(x, at)
        for k in np.flatnonzero(used.any(axis=1)).tolist():
            some = np.flatnonzero(used[k])
            q = problem.model.latent.value(x.q[k])
            H = problem.observed.jacobian(x.u[k], q, at.member(k))[0][some].toarray()
            R = self._space.riesz(H.T)
            # Two sensors at one place have the same representer: the pseudoinverse averages them.
            K = R @ np.linalg.pinv(H @ R, rcond=1e-9, hermitian=True)
            du[k] += K @ d[k, some]
            U[k] -= Y[k][:, some] @ K.T
            errors[k] -= (errors[k] @ H.T) @ K.T
        return changed(x, du=du, U=U, shadows=changed(x.shadows, u=errors))
