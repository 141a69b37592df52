"""The forms of the coupled stage, split into integrals over omega and over the rest.

The paper splits u into R u = chi_omega u and P u = chi_(Omega without omega) u. Both have a jump at
the boundary of omega, which no function of a finite-element space has. So the integrals are split,
and not the coefficients: over omega the forms see w = u_alpha + P u, outside of it the estimate u.
Selecting coefficients instead would let P u fall to zero over one element, with a gradient of size
u over the size of the element: M and N of (MN1), (MN2) would see that and diverge with the mesh.

Averages, points and matrices have no omega: R = G^+ G and P = I - R split the state in all of
Omega.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from livepde.fem import Composed, Form
from livepde.linalg import Array, IntArray
from livepde.model import Model
from livepde.observation import Split
from livepde.spaces import HilbertSpace

AnyForm: TypeAlias = Form | Composed


@dataclass(frozen=True, eq=False)
class StageForms:
    """Forms and matrices of a stage for one set of sensors; fixed, whatever the step."""

    # The process, and the split of its state into an observed and a hidden part.
    model: Model
    split: Split
    # Integrands (u, v, x) of M and N, integrated as in (MN1), (MN2); M_op None: that of M.
    M_op: Any
    N_op: Any
    nu: float  # weight of N

    @cached_property
    def _outside(self) -> IntArray | None:
        """The elements outside omega; None where there are none."""
        omega = self.split.omega
        if omega is None:
            return None
        return np.setdiff1d(np.arange(self.model.mesh.nelements), omega)

    def _inside(self, form: AnyForm) -> AnyForm:
        return form if self.split.omega is None else form.on(self.split.omega)

    @cached_property
    def A_in(self) -> AnyForm:
        """A over omega."""
        return self._inside(self.model.form_A)

    @cached_property
    def B_in(self) -> AnyForm:
        """B over omega."""
        return self._inside(self.model.form_B)

    @cached_property
    def A_out(self) -> AnyForm | None:
        """A outside omega; None where there is nothing."""
        return None if self._outside is None else self.model.form_A.on(self._outside)

    @cached_property
    def B_out(self) -> AnyForm | None:
        """B outside omega; None where there is nothing."""
        return None if self._outside is None else self.model.form_B.on(self._outside)

    def argument(self, u: Array, r: Array) -> Array:
        """Return w = u_alpha + P u, which A and B see over omega: u - r, since P = I - R."""
        return u - r

    @cached_property
    def W(self) -> sp.csr_array | None:
        """dw/du over omega, shape (n, n); None where w is known there: the data give all of it."""
        n = self.model.X.dim
        estimated = sp.csr_array(self.split.P @ sp.diags_array(self.model.X.free))
        if self.split.omega is not None:
            # Only coefficients that the forms over omega read can make w unknown.
            touched = np.zeros(n)
            touched[self.B_in.pattern("v", "u").indices] = 1.0
            touched[self.A_in.pattern("v", "u").indices] = 1.0
            estimated = sp.csr_array(sp.diags_array(touched) @ estimated)
        estimated.eliminate_zeros()
        return self.split.P if estimated.nnz else None

    @cached_property
    def mass(self) -> sp.csr_array:
        """Matrix of ||r||_X^2 = r^T mass r: R^T M R, integrated over omega."""
        form = self._inside(self.model.form_M)
        return self._observed(form.matrix("v", "u"))

    @cached_property
    def pull(self) -> sp.csr_array:
        """R^T M_op R, integrated over omega (MN1)."""
        if self.M_op is None:
            return self.mass
        return self._observed(self.model.bilinear(self.M_op, self.split.omega))

    @cached_property
    def hidden(self) -> sp.csr_array:
        """Matrix nu P^T N_op P over omega, and nu N_op outside it (MN2), shape (n, n)."""
        n, P = self.model.X.dim, self.split.P
        if not self.nu:
            return sp.csr_array((n, n))
        inside = P.T @ self.model.bilinear(self.N_op, self.split.omega) @ P
        if self._outside is not None:
            inside = inside + self.model.bilinear(self.N_op, self._outside)
        return sp.csr_array(self.nu * inside)

    def _observed(self, matrix: sp.csr_array) -> sp.csr_array:
        return sp.csr_array(self.split.R.T @ matrix @ self.split.R)

    @cached_property
    def tests(self) -> HilbertSpace:
        """X without the functions that reach out of omega: the test functions of ||r||_V~."""
        if self._outside is None:
            return self.model.X
        reach = np.zeros(self.model.X.dim, dtype=bool)
        for name, block in self.model.state_space.fields.items():
            start = self.model.state_space.part(name).start
            reach[start + block.element_dofs[:, self._outside]] = True
        reach[self.model.X.fixed] = True
        return HilbertSpace(self.model.mass, "V~", np.flatnonzero(reach))
