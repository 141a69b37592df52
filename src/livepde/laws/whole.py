"""Coupled stages solved as a whole: one sparse matrix of u and q together, and its factor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.laws.equation import Equation
from livepde.laws.gains import PULL
from livepde.laws.way import Way
from livepde.linalg import Array, Assembler, BandedSolver, Factor, Leading, Pattern, Solver, analyse

if TYPE_CHECKING:
    from livepde.laws.coupled import CoupledStage

__all__ = ["Whole", "WholeEquation"]


class WholeEquation(Equation):
    """The equation of a stage, its Jacobian as one matrix."""

    way: Whole

    def changing(self, y: Array, sweep: bool) -> Array:
        """Return the data of the Jacobian that depend on y."""
        stage, form, maps = self.stage, self.stage.model.form_A, self.way.maps
        q, r, w = y[stage.n :], self.r, self.w
        data: Array = maps["A"] @ self.A.data
        data += maps["Au"] @ form.data("v", "u", self.moment, u=w, q=q)
        if not sweep:
            data += maps["Aq"] @ form.data("q", "u", self.moment, u=w, v=r, q=q)
            if not stage.linear:
                data += maps["Aqq"] @ form.data("q", "q", self.moment, u=w, v=r, q=q)
        if not stage.constant_B:
            data += maps["B"] @ stage.model.form_B.data("v", "u", self.moment, u=w)
        return data

    def factor(self, y: Array, sweep: bool) -> Factor:
        stage, way, metric = self.stage, self.way, self.metric
        data = self.changing(y, sweep)
        data += way.constant(self.h)
        data += self.theta * way.constant_data["pull"]
        if metric is not None:
            data += way.maps["G"] @ ((metric.spread / PULL) * way.gram_data)
            data += way.maps["J"] @ (metric.data / PULL)
        factor: Factor = way.solver.factorise(data)
        if stage.auxiliary:
            factor = Leading(factor, stage.size, stage.size + stage.auxiliary)
        row = self.slope(sweep)
        if row is not None:
            column = np.zeros_like(y)
            column[: stage.n] = self.Mr
            factor = _Bordered(factor, factor.solve(column), row)
        if metric is None and not sweep:
            self.made = (y, factor)
        return factor


class Whole(Way):
    """Factorises the matrix of u and q, with auxiliary unknowns behind."""

    equations = WholeEquation

    def __init__(self, stage: CoupledStage) -> None:
        super().__init__(stage)
        self._constant: tuple[float, Array] | None = None

    @cached_property
    def _assembled(self) -> tuple[Solver, dict[str, sp.csr_array]]:
        stage, model, n = self.stage, self.stage.model, self.stage.n
        A, W, R = model.form_A, stage.W, stage.split.R
        free = sp.diags_array(model.X.free)
        free_q = sp.diags_array(stage.free_q)
        W_free, R_free = sp.csr_array(W @ free), sp.csr_array(R @ free)
        whole = Assembler(stage.size + stage.auxiliary)
        whole.add("M", model.form_M.pattern("v", "u"), free, free)
        whole.add("B", model.form_B.pattern("v", "u"), free, W_free)
        whole.add("Au", A.pattern("v", "u"), free, W_free)
        whole.add("RMR", Pattern.of(stage.RMR), free, free)
        whole.add("PNP", Pattern.of(stage.PNP), free, free)
        whole.add("A", A.pattern("v", "q"), free, free_q, at=(0, n))
        minus = -free_q
        whole.add("A", A.pattern("v", "q"), minus, R_free, at=(n, 0), transposed=True)
        whole.add("Aq", A.pattern("q", "u"), minus, W_free, at=(n, 0))
        rest = np.zeros(stage.auxiliary)
        if not stage.linear:
            whole.add("Aqq", A.pattern("q", "q"), minus, free_q, at=(n, n))
        free_g = sp.diags_array(np.concatenate([stage.free_q, 1.0 - rest]))
        whole.add("G", Pattern.of(stage.gram), free_g, free_g, at=(n, n))
        if stage.memory is not None:
            whole.add("J", stage.memory, free_q, free_q, at=(n, n))
        if model.latent.generator.nnz:
            K = sp.block_diag([model.latent.generator, sp.csr_array((len(rest), len(rest)))])
            whole.add("K", Pattern.of(stage.gram), -free_g, sp.csr_array(K @ free_g), at=(n, n))
        fixed = np.concatenate([1.0 - model.X.free, 1.0 - stage.free_q, rest])
        whole.add("fixed", Pattern.of(sp.eye_array(len(fixed))), sp.diags_array(fixed))
        pattern, maps = whole.build()
        solver = analyse(pattern)
        if isinstance(solver, BandedSolver):
            solver = replace(solver, units=self._units)
        return solver, maps

    @property
    def _units(self) -> Array:
        """Powers of two in which the diagonal of the coupled matrix is about one, times 1/h."""
        stage = self.stage
        gram = stage.gram.diagonal()
        if np.isfinite(stage.gains.gain):
            gram = gram / stage.gains.gain
        diagonal = np.abs(np.concatenate([stage.model.mass.diagonal(), gram]))
        free = np.concatenate([stage.model.X.free, stage.free_q, np.ones(stage.auxiliary)])
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
    def gram_data(self) -> Array:
        """Data of G_Q, in the order of its pattern."""
        return _stored(self.stage.gram)

    @cached_property
    def constant_data(self) -> dict[str, Array]:
        """Data of the coupled matrix that never change: with 1/h, with theta, and the rest."""
        stage, maps, model, g = self.stage, self.maps, self.stage.model, self.stage.gains
        gram = maps["G"] @ self.gram_data / g.gain
        rest = maps["PNP"] @ (g.nu * _stored(stage.PNP)) + g.sigma * gram
        rest += maps["fixed"] @ np.ones(stage.size + stage.auxiliary)
        if "K" in maps:
            rest += maps["K"] @ self.gram_data / g.gain
        if stage.constant_B:
            rest += maps["B"] @ model.form_B.data("v", "u", u=np.zeros(stage.n))
        return {
            "rate": maps["M"] @ model.mass.data + gram,
            "pull": maps["RMR"] @ _stored(stage.RMR),
            "rest": rest,
        }

    def constant(self, h: float) -> Array:
        """Return the data that depend on h only, kept for the last h."""
        if self._constant is None or self._constant[0] != h:
            data = self.constant_data["rate"] / h + self.constant_data["rest"]
            self._constant = (h, data)
        return self._constant[1]

    @property
    def keeps(self) -> bool:
        return False

    @property
    def patience(self) -> int:
        return 2 if isinstance(self.solver, BandedSolver) else 12


@dataclass(frozen=True, eq=False)
class _Bordered:
    """K + b a^T by Sherman and Morrison, from the factor of K: theta depends on all of r."""

    inner: Factor
    column: Array
    row: Array

    @cached_property
    def _scaled(self) -> Array:
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
