"""Coupled stages solved as a whole: one sparse matrix of u and q together, and its factor.

If A is bilinear, B affine, and both are constant in time, their products are made ahead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Moment
from livepde.laws.coupled.equation import (
    AnyForm,
    Inside,
    StageData,
    StageIterate,
    StageSolver,
    StageTerms,
)
from livepde.linalg import (
    Array,
    Assembler,
    BandedSolver,
    Factor,
    Leading,
    Pattern,
    Solver,
    analyse,
    compact,
)


class MonolithicSolver(StageSolver):
    """Factorises the matrix of u and q, with auxiliary unknowns behind."""

    keeps = False

    def __init__(self, terms: StageTerms) -> None:
        super().__init__(terms)
        # The engine of the coupled matrix, and for each block the map of its data into that matrix.
        self.solver, self.maps = self._assembled()
        self.patience = 2 if isinstance(self.solver, BandedSolver) else 12
        self._constant: tuple[tuple[float, float, float], Array] | None = None

    def changing(self, data: StageData, at: StageIterate) -> Array:
        """Return the data of the Jacobian that depend on the iterate."""
        terms, forms, maps = self.terms, self.terms.forms, self.maps
        A, moment, n = forms.A_in, data.problem.moment, self.terms.n
        u, q = at.y[:n], at.y[n:]
        found: Array = maps["A_in"] @ at.A_in.data
        if forms.W is not None:
            found += maps["A_in u"] @ A.data("v", "u", moment, u=at.w, q=q)
            found += maps["B_in"] @ forms.B_in.data("v", "u", moment, u=at.w)
            back = A.data("q", "u", moment, u=at.w, v=at.r, q=q)
            found += maps["A_in^T r, u"] @ back
        if not terms.linear:
            back = A.data("q", "q", moment, u=at.w, v=at.r, q=q)
            found += maps["A_in^T r, q"] @ back
        if forms.A_out is not None and forms.B_out is not None:
            found += maps["A_out"] @ forms.A_out.data("v", "q", moment, u=u, q=q)
            found += maps["A_out u"] @ forms.A_out.data("v", "u", moment, u=u, q=q)
            found += maps["B_out"] @ forms.B_out.data("v", "u", moment, u=u)
        return found

    def prepare(self) -> None:
        _ = self._parts, self._pull

    def factor(self, data: StageData, at: StageIterate) -> Factor:
        terms, metric = self.terms, data.problem.metric
        found = self.changing(data, at)
        found += self._fixed(data)
        found += at.theta * self._pull
        if metric.information is not None:
            found += self.maps["J"] @ metric.information
        factor: Factor = self.solver.factorise(found)
        if terms.auxiliary:
            factor = Leading(factor, terms.size, terms.size + terms.auxiliary)
        row = terms.slope(data, at)
        if row is not None:
            column = np.zeros(terms.size)
            column[: terms.n] = at.Mr * terms.free
            factor = _Bordered(factor, factor.solve(column), row * terms.free)
        return factor

    def _fixed(self, data: StageData) -> Array:
        """Return the data that depend on the step and on weight and sigma of the metric only."""
        h, metric = data.problem.h, data.problem.metric
        key = (h, metric.weight, metric.sigma)
        # Copies of an identifier share this, maybe in threads: the pair is read once, and replaced
        # as a whole, so that the data are those of their key.
        known = self._constant
        if known is None or known[0] != key:
            parts = self._parts
            found = parts["M"] / h + metric.scale(h) * parts["G"] + parts["rest"]
            if "GK" in parts:
                found = found - metric.weight * parts["GK"]
            self._constant = known = (key, found)
        return known[1]

    def _assembled(self) -> tuple[Solver, dict[str, sp.csr_array]]:
        terms, forms = self.terms, self.terms.forms
        model, n, A = forms.model, self.terms.n, forms.A_in
        free, free_q = sp.diags_array(terms.free), sp.diags_array(terms.free_q)
        minus, R = -free_q, sp.csr_array(forms.split.R @ free)
        whole = Assembler(terms.size + terms.auxiliary)
        whole.add("M", model.form_M.pattern("v", "u"), free, free)
        whole.add("pull", Pattern.of(forms.pull), free, free)
        whole.add("N", Pattern.of(forms.hidden), free, free)
        whole.add("A_in", A.pattern("v", "q"), free, free_q, at=(0, n))
        # The same data a second time: -A^T R in the second line.
        whole.add("A_in", A.pattern("v", "q"), minus, R, at=(n, 0), transposed=True)
        if forms.W is not None:
            W = sp.csr_array(forms.W @ free)
            whole.add("B_in", forms.B_in.pattern("v", "u"), free, W)
            whole.add("A_in u", A.pattern("v", "u"), free, W)
            whole.add("A_in^T r, u", A.pattern("q", "u"), minus, W, at=(n, 0))
        if not terms.linear:
            whole.add("A_in^T r, q", A.pattern("q", "q"), minus, free_q, at=(n, n))
        if forms.A_out is not None and forms.B_out is not None:
            whole.add("A_out", forms.A_out.pattern("v", "q"), free, free_q, at=(0, n))
            whole.add("A_out u", forms.A_out.pattern("v", "u"), free, free)
            whole.add("B_out", forms.B_out.pattern("v", "u"), free, free)
        rest = np.zeros(terms.auxiliary)
        free_g = sp.diags_array(np.concatenate([terms.free_q, 1.0 - rest]))
        whole.add("G", Pattern.of(terms.gram), free_g, free_g, at=(n, n))
        if terms.memory is not None:
            whole.add("J", terms.memory, free_q, free_q, at=(n, n))
        if model.latent.generator.nnz:
            K = sp.block_diag([model.latent.generator, sp.csr_array((len(rest), len(rest)))])
            whole.add("GK", Pattern.of(terms.gram), free_g, sp.csr_array(K @ free_g), at=(n, n))
        fixed = np.concatenate([1.0 - terms.free, 1.0 - terms.free_q, rest])
        whole.add("fixed", Pattern.of(sp.eye_array(len(fixed))), sp.diags_array(fixed))
        pattern, maps = whole.build()
        solver = analyse(pattern)
        if isinstance(solver, BandedSolver):
            solver = replace(solver, units=self._units)
        return solver, maps

    @property
    def _units(self) -> Array:
        """Powers of two in which the blocks M and G_Q of the diagonal are about one."""
        terms = self.terms
        diagonal = np.abs(
            np.concatenate([terms.forms.model.mass.diagonal(), terms.gram.diagonal()])
        )
        free = np.concatenate([terms.free, terms.free_q, np.ones(terms.auxiliary)])
        diagonal[(free == 0.0) | (diagonal == 0.0)] = 1.0
        units: Array = np.exp2(np.round(-0.5 * np.log2(diagonal)))
        return units

    @cached_property
    def _pull(self) -> Array:
        found: Array = self.maps["pull"] @ _stored(self.terms.forms.pull)
        return found

    @cached_property
    def _parts(self) -> dict[str, Array]:
        """Data that never change: of M, of G_Q and G_Q K, and the rest."""
        terms, forms, maps = self.terms, self.terms.forms, self.maps
        gram = _stored(terms.gram)
        rest = maps["N"] @ _stored(forms.hidden)
        rest += maps["fixed"] @ np.ones(terms.size + terms.auxiliary)
        parts = {"M": maps["M"] @ forms.model.mass.data, "G": maps["G"] @ gram, "rest": rest}
        if "GK" in maps:
            parts["GK"] = maps["GK"] @ gram
        return parts


@dataclass(frozen=True, eq=False)
class _Bordered:
    """K + b a^T by Sherman and Morrison, from the factor of K: theta depends on all of r."""

    inner: Factor
    column: Array
    row: Array

    @cached_property
    def _scaled(self) -> Array:
        # (K + b a^T)^-1 = K^-1 - K^-1 b a^T K^-1/(1 + a^T K^-1 b); `column` is K^-1 b.
        pivot = 1.0 + float(self.row @ self.column[: len(self.row)])
        if pivot == 0.0:
            raise LinearAlgebraError("The damped system is singular: take less damping.")
        return self.row / pivot

    def solve(self, b: Array) -> Array:
        """Return the solution for a right-hand side."""
        x = self.inner.solve(b)
        return x - self.column * (self._scaled @ x[: len(self.row)])


def _stored(matrix: sp.csr_array) -> Array:
    """Return the data of a matrix in the order of its pattern."""
    coo = sp.coo_array(matrix)
    data: Array = Pattern.of(matrix).gather(coo.row, coo.col) @ coo.data
    return data


class BilinearSolver(MonolithicSolver):
    """A, B and the Jacobian by products with small or sparse matrices: no form is evaluated."""

    keeps = True

    @classmethod
    def of(cls, terms: StageTerms) -> BilinearSolver | None:
        """Return it for a stage; None where A or B is another, or the mesh is large."""
        forms = terms.forms
        B = forms.model.form_B
        if terms.auxiliary or not (B.affine and B.constant):
            return None
        parts = [form for form in (forms.A_in, forms.A_out) if form is not None]
        # All derivatives are sparse matrices times coefficients.
        bilinear = all(isinstance(one, sp.csr_array) for form in parts for one in _tensors(form))
        return cls(terms) if bilinear else None

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


def _tensors(form: AnyForm) -> tuple[sp.csr_array, sp.csr_array, sp.csr_array]:
    """Return the maps to the data of A(w), of d(A(w) q)/dw and of d(A(w)^T r)/dw."""
    pairs = ("v", "q"), ("v", "u"), ("q", "u")
    vq, vu, qu = (cast("sp.csr_array", form.tensor(*pair)) for pair in pairs)
    return vq, vu, qu
