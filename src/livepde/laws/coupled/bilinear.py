"""Coupled stages with a bilinear A and an affine B, both constant in time: products made ahead."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from livepde.fem import Moment
from livepde.laws.coupled.equation import Inside, StageData, StageIterate, StageTerms
from livepde.laws.coupled.monolithic import MonolithicSolver
from livepde.laws.coupled.split_forms import AnyForm
from livepde.linalg import Array, Pattern, compact


class BilinearSolver(MonolithicSolver):
    """A, B and the Jacobian by products with small or sparse matrices: no form is evaluated.

    The equation is that of `StageSolver.evaluate`.
    """

    @classmethod
    def of(cls, terms: StageTerms) -> BilinearSolver | None:
        """Return it for a stage; None where A or B is another, or the mesh is large."""
        forms = terms.forms
        B = forms.model.form_B
        if terms.auxiliary or not (B.affine and B.constant):
            return None
        parts = [form for form in (forms.A_in, forms.A_out) if form is not None]
        if not all(_is_bilinear(form) for form in parts):
            return None
        return cls(terms)

    @property
    def keeps(self) -> bool:
        return True

    def prepare(self) -> None:
        super().prepare()
        _ = self._coupling, self._slopes, self._offset, self._jacobian, self._fixed_data

    @cached_property
    def _coupling(self) -> tuple[_Coupling, _Coupling | None]:
        """A(w) over omega as a function of w, and outside it as one of u."""
        forms = self.terms.forms
        return _Coupling.of(forms.A_in), None if forms.A_out is None else _Coupling.of(forms.A_out)

    @cached_property
    def _jacobian(self) -> sp.csr_array:
        """Map of (w, u, q, r) to the data of the Jacobian that change."""
        forms, maps, m = self.terms.forms, self.maps, self.terms.size - self.terms.n
        vq, vu, qu = _tensors(forms.A_in)
        size, n = maps["M"].shape[0], self.terms.n
        by_w = maps["A_in"] @ vq
        by_u, by_q = sp.csr_array((size, n)), sp.csr_array((size, m))
        by_r = sp.csr_array((size, n))
        if forms.W is not None:
            by_q = by_q + maps["A_in u"] @ vu
            by_r = maps["A_in^T r, u"] @ qu
        if forms.A_out is not None:
            outside = _tensors(forms.A_out)
            by_u = by_u + maps["A_out"] @ outside[0]
            by_q = by_q + maps["A_out u"] @ outside[1]
        # Each block is linear in one of the four vectors, and so all of them are one product.
        return sp.csr_array(sp.hstack([by_w, by_u, by_q, by_r]))

    @cached_property
    def _slopes(self) -> tuple[Any, Any]:
        """B' over omega, and elsewhere."""
        forms, zero = self.terms.forms, np.zeros(self.terms.n)
        outside = None if forms.B_out is None else forms.B_out.matrix("v", "u", u=zero)
        inside = compact(forms.B_in.matrix("v", "u", u=zero))
        return inside, None if outside is None else compact(outside)

    @cached_property
    def _offset(self) -> Array:
        """B(0), shape (n,)."""
        return self.terms.forms.model.B(np.zeros(self.terms.n))

    @cached_property
    def _fixed_data(self) -> Array:
        """Data of the Jacobian that B adds."""
        forms, zero = self.terms.forms, np.zeros(self.terms.n)
        found = np.zeros(self.maps["M"].shape[0])
        if forms.W is not None:
            found += self.maps["B_in"] @ forms.B_in.data("v", "u", u=zero)
        if forms.B_out is not None:
            found += self.maps["B_out"] @ forms.B_out.data("v", "u", u=zero)
        return found

    def source(self, moment: Moment) -> Array:
        return super().source(moment) - self._offset

    def inside(self, moment: Moment, w: Array, q: Array | None = None) -> Inside:
        A, transposed = self._coupling[0].at(w)
        return Inside(A, transposed, self._slopes[0] @ w)

    def outside(self, moment: Moment, u: Array, q: Array) -> tuple[Array, Array]:
        coupling, slope = self._coupling[1], self._slopes[1]
        if coupling is None:
            return super().outside(moment, u, q)
        return coupling.at(u)[0] @ q, slope @ u

    def changing(self, data: StageData, at: StageIterate) -> Array:
        n = self.terms.n
        changing: Array = self._jacobian @ np.concatenate([at.w, at.y[:n], at.y[n:], at.r])
        return changing + self._fixed_data


@dataclass(frozen=True, eq=False)
class _Coupling:
    """A(w) as a matrix whose data are linear in w."""

    pattern: Pattern
    data: sp.csr_array | Array

    @classmethod
    def of(cls, form: AnyForm) -> _Coupling:
        return cls(form.pattern("v", "q"), compact(_tensors(form)[0]))

    def at(self, w: Array) -> tuple[Any, Any]:
        """Return A(w) and its transpose; small ones are dense."""
        data = self.data @ w
        if self.pattern.small:
            dense = self.pattern.compact(data)
            return dense, dense.T
        return self.pattern.matrix(data), self.pattern.transposed(data)


def _is_bilinear(form: AnyForm) -> bool:
    """Return whether all derivatives of a form are sparse matrices times coefficients."""
    pairs = ("v", "q"), ("v", "u"), ("q", "u")
    return all(isinstance(form.tensor(*pair), sp.csr_array) for pair in pairs)


def _tensors(form: AnyForm) -> tuple[sp.csr_array, sp.csr_array, sp.csr_array]:
    """Return the maps to the data of A(w), of d(A(w) q)/dw and of d(A(w)^T r)/dw."""
    pairs = ("v", "q"), ("v", "u"), ("q", "u")
    vq, vu, qu = (cast("sp.csr_array", form.tensor(*pair)) for pair in pairs)
    return vq, vu, qu
