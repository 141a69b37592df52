"""Observation of the state on a subdomain omega, or on the whole domain, as in the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Predicate
from livepde.fem.measure import Measure
from livepde.linalg import IntArray, Mask
from livepde.observation.operator import Observation

__all__ = ["Full", "Subdomain"]

# Quadrature order of the points at which the predicate is evaluated. All are inside of the element,
# so that its boundary nodes do not decide.
INTERIOR = 3


@dataclass(frozen=True, eq=False)
class Subdomain(Observation):
    """Observation of the state on omega, z = u|_omega (obsdiff), a union of elements.

    An element belongs to omega if the predicate holds at its inner quadrature points. The data z
    are the free coefficients of these elements in their order (values and slopes for Hermite
    elements), including those of nodes on the boundary of omega. Coefficients on the Dirichlet
    boundary are known and not part of z.

    Elements cut by the boundary of omega are excluded. If that strip matters, place mesh nodes at
    the ends of omega: `interval(0, 1, 30, through=(0.3, 0.87))`.

    Parameters
    ----------
    omega
        Predicate on x of shape (d, points).
    """

    omega: Predicate

    def elements(self, state: FieldBlock) -> IntArray:
        """Return the elements that lie in omega."""
        inside = np.zeros(state.field.mesh.nelements, dtype=bool)
        for at, piece in Measure(state.field.mesh, INTERIOR).pieces():
            x = piece.points
            found = np.broadcast_to(self.omega(x.reshape(len(x), -1)), x[0].size)
            inside[at] = found.reshape(x.shape[1:]).all(axis=1)
        return np.flatnonzero(inside)

    def region(self, state: FunctionSpace) -> Mask:
        block, _ = state.component(self.of)
        inside = np.zeros(block.field.mesh.nelements, dtype=bool)
        inside[self.elements(block)] = True
        return inside

    def selected(self, state: FieldBlock) -> IntArray:
        """Return the free coefficients of the elements that lie in omega."""
        inside = np.zeros(state.size, dtype=bool)
        inside[state.element_dofs[:, self.elements(state)]] = True
        inside[state.fixed] = False
        found: IntArray = np.flatnonzero(inside)
        if not len(found):
            raise ObservationError(
                "Subdomain: no element of the mesh with a free coefficient lies in omega; check "
                "the predicate and the unit of its coordinates, or refine the mesh."
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
    """Observation of the whole state, omega = Omega: P is zero except on the Dirichlet boundary."""

    omega: Predicate = _everywhere
