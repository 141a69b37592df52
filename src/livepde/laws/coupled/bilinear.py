"""Coupled stages with a bilinear A and an affine B, both constant in time: products made ahead."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from livepde.laws.coupled.equation import (
    Inside,
    StageData,
    StageIterate,
    StageProblem,
    StageTerms,
)
from livepde.laws.coupled.monolithic import MonolithicSolver
from livepde.laws.coupled.split_forms import AnyForm
from livepde.linalg import Array, Pattern, compact

__all__ = ["BilinearSolver"]


class BilinearSolver(MonolithicSolver):
    """A residual is a few products with small or sparse matrices, and no form is evaluated."""

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
        _ = self._products, self._coupling, self._jacobian, self._fixed_data

    @cached_property
    def _coupling(self) -> tuple[_Coupling, _Coupling | None]:
        """A(w) over omega as a function of w, and outside of it as one of u."""
        forms, terms = self.terms.forms, self.terms
        inside = _Coupling.of(forms.A_in, terms)
        return inside, None if forms.A_out is None else _Coupling.of(forms.A_out, terms)

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
    def _slopes(self) -> tuple[sp.csr_array, sp.csr_array, Array]:
        """B' over omega, and elsewhere with nu N; and B(0), on the free coefficients."""
        forms, free = self.terms.forms, sp.diags_array(self.terms.free)
        zero = np.zeros(self.terms.n)
        inside = free @ forms.B_in.matrix("v", "u", u=zero)
        outside = forms.hidden
        if forms.B_out is not None:
            outside = outside + forms.B_out.matrix("v", "u", u=zero)
        offset = self.terms.free * forms.model.B(zero)
        return sp.csr_array(inside), sp.csr_array(free @ outside), offset

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

    @cached_property
    def _products(self) -> dict[str, sp.csr_array | Array]:
        forms, free = self.terms.forms, sp.diags_array(self.terms.free)
        return {
            "M": compact(sp.csr_array(free @ forms.model.mass)),
            "r": compact(sp.csr_array(sp.vstack([forms.pull, forms.mass]))),
            "G": compact(sp.csr_array(sp.diags_array(self.terms.free_q) @ self.terms.gram)),
            "B_in": compact(self._slopes[0]),
            "B_out": compact(self._slopes[1]),
        }

    def data(self, problem: StageProblem, w: Array | None = None) -> StageData:
        forms, inside = self.terms.forms, None
        known = forms.model.F(problem.moment) * self.terms.free - self._slopes[2]
        if forms.W is None:
            w = forms.model.impose(problem.u_alpha, problem.moment) if w is None else w
            inside = Inside(self._coupling[0].at(w), self._products["B_in"] @ w)
        return self.terms.given(problem, known, inside)

    def evaluate(self, data: StageData, y: Array) -> StageIterate:
        terms, forms, n, products = self.terms, self.terms.forms, self.terms.n, self._products
        u, q, c = y[:n], y[n:], data.problem.c
        r = forms.split.project(u) - data.problem.u_alpha
        w = forms.argument(u, r)
        coupling_in, coupling_out = self._coupling
        if data.inside is not None:
            (A, transposed), flux = data.inside.A, data.inside.flux
        else:
            (A, transposed), flux = coupling_in.at(w), products["B_in"] @ w
        driven = A @ q
        if coupling_out is not None:
            driven = driven + coupling_out.matrix(u) @ q
        # R^T M_op r and R^T M r by one product.
        by_r = products["r"] @ r
        Mr, mass_r = by_r[:n], by_r[n:]
        norms = terms.norms(r, Mr, mass_r, data.observed)
        theta = terms.theta(data, norms)
        rate = products["M"] @ ((u - c[:n]) / data.problem.h)
        pull = (theta * terms.free) * Mr
        change, coupling = self.weighed(data, q - c[n:]), transposed @ r
        residual = np.empty_like(y)
        residual[:n] = rate + flux + products["B_out"] @ u + driven + pull - data.source
        residual[n:] = change - (coupling + data.load) * terms.free_q
        first = [residual[:n], rate, driven, pull]
        second = [residual[n:], change, coupling]
        accuracy = self.accuracy(data)
        size, resolved, scales = terms.measured(data, first, second, norms.X, theta, accuracy)
        return StageIterate(
            y, residual, size, resolved, scales, w, r, None, theta, norms, Mr, mass_r
        )

    def weighed(self, data: StageData, change: Array) -> Array:
        if data.problem.metric.drift:
            return super().weighed(data, change) * self.terms.free_q
        weighed: Array = self._products["G"] @ (data.problem.metric.scale * change)
        return weighed if data.J is None else weighed + (data.J @ change) * self.terms.free_q

    def changing(self, data: StageData, at: StageIterate) -> Array:
        n = self.terms.n
        changing: Array = self._jacobian @ np.concatenate([at.w, at.y[:n], at.y[n:], at.r])
        return changing + self._fixed_data


@dataclass(frozen=True, eq=False)
class _Coupling:
    """A(w) on the free coefficients, as a matrix whose data are linear in w."""

    pattern: Pattern
    data: sp.csr_array | Array

    @classmethod
    def of(cls, form: AnyForm, terms: StageTerms) -> _Coupling:
        pattern = form.pattern("v", "q")
        kept = terms.free[pattern.rows] * terms.free_q[pattern.indices]
        return cls(pattern, compact(sp.csr_array(sp.diags_array(kept) @ _tensors(form)[0])))

    def matrix(self, w: Array) -> Any:
        """Return A(w); a small one is dense."""
        return self.pattern.compact(self.data @ w)

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
