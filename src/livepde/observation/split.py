"""Orthogonal splitting of the state into its observed and its unobserved part."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.linalg import Array, IntArray


@dataclass(frozen=True, eq=False)
class Split:
    """Projections R = G^+ G on N(G)^perp and P = I - R on N(G), and G^+ itself.

    Attributes
    ----------
    R, P
        Sparse, shape (n, n); idempotent to rounding. Fixed (Dirichlet) coefficients are known, and
        belong to P.
    inverse
        G^+ on the present sensors, shape (n, present).
    present
        Mask of the sensors used, shape (sensors,).
    G
        Rows of G of these sensors, shape (present, n).
    vectors
        Basis of N(G)^perp, shape (n, k); None if the columns of `inverse` are one.
    omega
        Elements on which the data determine the state, for sensors on a subdomain: there the
        paper's chi_omega is one, and integrals over Omega are split into those over `omega`, with
        the data, and those over the other elements, with the estimate. None: all elements, with the
        state split by R and P alone.
    """

    R: sp.csr_array
    P: sp.csr_array
    inverse: sp.csr_array
    present: Array
    G: sp.csr_array
    vectors: Array | None = None
    omega: IntArray | None = None

    @property
    def basis(self) -> Array:
        """Basis of N(G)^perp, shape (n, k)."""
        return self.inverse.toarray() if self.vectors is None else self.vectors

    @cached_property
    def _diagonal(self) -> Array | None:
        """Diagonal of R if R is diagonal, else None."""
        alone = bool(np.array_equal(self.R.indices, np.flatnonzero(np.diff(self.R.indptr))))
        return self.R.diagonal() if alone else None

    @cached_property
    def _complete(self) -> bool:
        """True if all sensors are present."""
        return bool(self.present.all())

    @cached_property
    def _selected(self) -> IntArray | None:
        """Coefficient read by each present sensor, if each reads a single one; else None."""
        selects = self.vectors is None and is_selection(sp.csr_array(self.inverse.T))
        return sp.csr_array(self.inverse.T).indices if selects else None

    def project(self, u: Array) -> Array:
        """Return R u."""
        projected: Array = self.R @ u if self._diagonal is None else self._diagonal * u
        return projected

    def reconstruct(self, z: Array, boundary: Array | None) -> Array:
        """Return the observed part R u* = G^+ z of the state in X, shape (n,).

        Parameters
        ----------
        z
            Measurements, shape (sensors,); missing ones (NaN) are ignored.
        boundary
            Coefficient vector with the Dirichlet values, zero elsewhere; None: zero.
        """
        known = z if self._complete else z[self.present]
        if boundary is not None and boundary.any():
            known = known - self.G @ boundary
        if self._selected is None:
            part: Array = self.inverse @ known
            return part
        part = np.zeros(self.R.shape[0])
        part[self._selected] = known
        return part


def is_selection(G: sp.csr_array) -> bool:
    """Return True if every row selects one coefficient, and no two rows the same."""
    one_each = bool(np.all(np.diff(G.indptr) == 1) and np.all(G.data == 1.0))
    return one_each and len(np.unique(G.indices)) == len(G.indices)
