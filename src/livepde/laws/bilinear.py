"""Coupled stages with a bilinear A and an affine B, both constant in time: products made ahead."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from livepde.laws.whole import Whole, WholeEquation
from livepde.linalg import Array, Pattern

if TYPE_CHECKING:
    from livepde.laws.coupled import CoupledStage

__all__ = ["Bilinear", "BilinearEquation"]


class BilinearEquation(WholeEquation):
    """The equation of a stage by products made ahead."""

    way: Bilinear

    @cached_property
    def _known(self) -> Array:
        """F - B(0), shape (n,)."""
        known: Array = self.source * self.stage.model.X.free - self.way.offset
        return known

    def residual(self, y: Array) -> Array:
        n, way = self.stage.n, self.way
        u, q = y[:n], y[n:]
        self.r = r = self.stage.split.project(u) - self.u_alpha
        self.w = w = u if self.stage.gains.at_estimate else u - r
        made: Array = way.products @ np.concatenate((w, (y - self.c) / self.h, y, r))
        out, self.Mr, self.mass_r = made[: len(y)], made[-2 * n : -n], made[-n:]
        A = way.operator
        A.set(made[len(y) : -2 * n])
        out[:n] += A.apply(q) + self.pull() - self._known
        out[n:] -= A.apply_transposed(r)
        if self.metric is not None:
            out[n:] += self.learned(y) * self.stage.free_q
        return out

    def changing(self, y: Array, sweep: bool) -> Array:
        known = [self.w, y[self.stage.n :]]
        data: Array
        if sweep:
            data = self.way.lagged @ np.concatenate(known)
        else:
            data = self.way.jacobian @ np.concatenate([*known, self.r])
        return data


class Bilinear(Whole):
    """A residual is one product with a sparse matrix, and one each with A(w) and its transpose.

    Attributes
    ----------
    products, operator
        (w, (y - c)/h, y, r) -> the linear part of the residual, the data of A(w) on the free
        coefficients, R^T M_op r, and R^T M r; and the operator that takes the data of A(w).
    lagged, jacobian
        w, and (w, q, r) -> data of the part of the stage's Jacobian that changes.
    offset
        B(0) on the free coefficients.
    """

    equations = BilinearEquation

    def __init__(
        self, stage: CoupledStage, vq: sp.csr_array, vu: sp.csr_array, qu: sp.csr_array
    ) -> None:
        super().__init__(stage)
        model, g, maps, n, m = stage.model, stage.gains, self.maps, stage.n, stage.model.Q.dim
        free, free_q = sp.diags_array(model.X.free), sp.diags_array(stage.free_q)
        pattern = model.form_A.pattern("v", "q")
        kept = model.X.free[pattern.rows] * stage.free_q[pattern.indices]
        coupling = sp.csr_array(sp.diags_array(kept) @ vq)
        self.operator = pattern.operator()
        self.lagged = sp.csr_array(sp.hstack([maps["A"] @ vq, maps["Au"] @ vu]))
        self.jacobian = sp.csr_array(sp.hstack([self.lagged, maps["Aq"] @ qu]))
        zero = np.zeros(n)
        B = model.form_B.matrix("v", "u", u=zero)
        self.offset = model.B(zero) * model.X.free
        gram = sp.csr_array(free_q @ stage.gram / g.gain)
        wide = sp.csr_array((n, m))
        rows = [
            [free @ B, free @ model.mass, wide, g.nu * free @ stage.PNP, wide, None],
            [wide.T, wide.T, gram, wide.T, g.sigma * gram, None],
            [coupling, None, None, None, None, None],
            [None, None, None, None, None, stage.RM],
            [None, None, None, None, None, stage.RT @ model.mass],
        ]
        products = sp.csr_array(sp.block_array(rows))
        products.eliminate_zeros()
        products.sum_duplicates()
        self.products = Pattern.of(products).matrix(products.data)  # with short indices

    @classmethod
    def of(cls, stage: CoupledStage) -> Bilinear | None:
        """Return it for a stage; None where A or B is another, or a small mesh is a large one."""
        form = stage.model.form_A
        if stage.model.latent.generator.nnz or stage.auxiliary or not stage.constant_B:
            return None
        tensors = form.tensor("v", "q"), form.tensor("v", "u"), form.tensor("q", "u")
        vq, vu, qu = (T if isinstance(T, sp.csr_array) else None for T in tensors)
        if vq is None or vu is None or qu is None:
            return None
        return cls(stage, vq, vu, qu)

    @property
    def keeps(self) -> bool:
        return True
