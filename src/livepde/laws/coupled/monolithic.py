"""Coupled stages solved as a whole: one sparse matrix of u and q together, and its factor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.laws.coupled.equation import StageData, StageIterate, StageSolver, StageTerms
from livepde.linalg import Array, Assembler, BandedSolver, Factor, Leading, Pattern, Solver, analyse


class MonolithicSolver(StageSolver):
    """Factorises the matrix of u and q, with auxiliary unknowns behind."""

    def __init__(self, terms: StageTerms) -> None:
        super().__init__(terms)
        self._constant: tuple[tuple[float, float, float], Array] | None = None

    @property
    def keeps(self) -> bool:
        return False

    @property
    def patience(self) -> int:
        return 2 if isinstance(self.solver, BandedSolver) else 12

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

    @cached_property
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

    @property
    def solver(self) -> Solver:
        """The engine of the coupled matrix."""
        return self._assembled[0]

    @property
    def maps(self) -> dict[str, sp.csr_array]:
        """Block -> map of its data into the data of the coupled matrix."""
        return self._assembled[1]

    @cached_property
    def _pull(self) -> Array:
        """Data of R^T M_op R."""
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
