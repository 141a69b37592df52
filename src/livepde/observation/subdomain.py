"""The paper's observation: the state on a subdomain omega, or on all of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Predicate
from livepde.linalg import IntArray
from livepde.observation.base import Observation

__all__ = ["Full", "Subdomain"]


@dataclass(frozen=True, eq=False)
class Subdomain(Observation):
    """The state on omega, z = u|_omega (obsdiff): its coefficients located in omega.

    z holds the selected coefficients in their order (for Hermite elements values and slopes).
    G selects, so R and P are exact projections; the coefficients on the Dirichlet boundary are
    known and not part of z. `coordinates` of the bound observation tells where each one sits.

    Parameters
    ----------
    omega
        Predicate on x of shape (d, points).
    of
        Component of the state; may be left out if it has only one.
    """

    omega: Predicate
    of: str = ""

    def selected(self, state: FieldBlock) -> IntArray:
        """Return the free coefficients located in omega."""
        inside = np.broadcast_to(self.omega(state.doflocs), (state.size,)).copy()
        inside[state.fixed] = False
        found: IntArray = np.flatnonzero(inside)
        if not len(found):
            raise ObservationError(
                "Subdomain: no free coefficient of the state lies in omega; check the predicate "
                "and the unit of its coordinates, or refine the mesh."
            )
        return found

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        block, _ = state.component(self.of)
        found = self.selected(block)
        entries = (np.ones(len(found)), (np.arange(len(found)), found))
        return state.widen(sp.csr_array(entries, shape=(len(found), block.size)), self.of)

    @property
    def nodal(self) -> bool:
        return True


def _everywhere(x: object) -> bool:
    return True


@dataclass(frozen=True, eq=False)
class Full(Subdomain):
    """The whole state, omega = Omega: P is zero except on the Dirichlet boundary."""

    omega: Predicate = _everywhere
