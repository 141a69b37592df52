"""The implicit stage of the paper's method: u and q in one system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.fem import Moment
from livepde.laws.damping import Damping, Residual
from livepde.linalg import Array, Assembler, Factor, Pattern, Solver, analyse
from livepde.model import Model
from livepde.observation import Split
from livepde.stepping import Newton

__all__ = ["CoupledStage", "Gains"]


@dataclass(frozen=True, eq=False)
class Gains:
    """The gains of the method and the operators they multiply.

    Attributes
    ----------
    gain
        Scale of the inner product of Q.
    damping
        Rule for theta.
    nu, sigma
        Weights of P N P u and of the stabilising term sigma q.
    M_op, N_op
        Matrices of M and N of (MN1), (MN2), shape (n, n).
    """

    gain: float
    damping: Damping
    nu: float
    sigma: float
    M_op: sp.csr_array
    N_op: sp.csr_array


class CoupledStage:
    """One implicit Euler stage of (est_exact_q), (est_exact_u), or (noisy_q), (noisy_u), coupled.

    With w = u_alpha + P u and r = R u - u_alpha, the unknowns y = (u, q) solve

        M (u - c_u)/h + B(w) + A(w) q + theta R^T M_op r + nu P^T N_op P u = F
        G_Q (q - c_q)/(gain h) + (sigma/gain) G_Q q - A(w)^T r             = 0

    together, so that the two terms with A cancel in the energy as in the paper (align:neplusnr).
    theta is taken from the iterate before.
    """

    def __init__(self, model: Model, split: Split, gains: Gains, newton: Newton) -> None:
        self.model = model
        self.split = split
        self.gains = gains
        self.newton = newton
        self.n = model.X.dim
        self.blocks = (slice(0, self.n), slice(self.n, self.n + model.Q.dim))
        self.RM = sp.csr_array(split.R.T @ gains.M_op)
        self.RMR = sp.csr_array(self.RM @ split.R)
        self.PNP = sp.csr_array(split.P.T @ gains.N_op @ split.P)
        self.free_q = model.Q.free
        self.gram = model.Q.gram

    @cached_property
    def _assembled(self) -> tuple[Pattern, dict[str, sp.csr_array], Solver]:
        model, n = self.model, self.n
        A, P, R = model.form_A, self.split.P, self.split.R
        free = sp.diags_array(model.X.free)
        free_q = sp.diags_array(self.free_q)
        P_free, R_free = sp.csr_array(P @ free), sp.csr_array(R @ free)
        whole = Assembler(n + model.Q.dim)
        whole.add("M", model.form_M.pattern("v", "u"), free, free)
        whole.add("B", model.form_B.pattern("v", "u"), free, P_free)
        whole.add("Au", A.pattern("v", "u"), free, P_free)
        whole.add("RMR", Pattern.of(self.RMR), free, free)
        whole.add("PNP", Pattern.of(self.PNP), free, free)
        whole.add("A", A.pattern("v", "q"), free, free_q, at=(0, n))
        minus = -free_q
        whole.add("A", A.pattern("v", "q"), minus, R_free, at=(n, 0), transposed=True)
        whole.add("Aq", A.pattern("q", "u"), minus, P_free, at=(n, 0))
        whole.add("G", Pattern.of(self.gram), free_q, free_q, at=(n, n))
        fixed = np.concatenate([1.0 - model.X.free, 1.0 - self.free_q])
        whole.add("fixed", Pattern.of(sp.eye_array(len(fixed))), sp.diags_array(fixed))
        pattern, maps = whole.build()
        return pattern, maps, analyse(pattern)

    @cached_property
    def _static(self) -> Callable[[float], Array]:
        """H -> data of the part of the Jacobian that no iterate changes, kept for the last h."""
        _, maps, _ = self._assembled
        model, g = self.model, self.gains
        rate_u = maps["M"] @ model.mass.data
        gram = maps["G"] @ _stored(self.gram)
        rest = maps["PNP"] @ (g.nu * _stored(self.PNP)) + maps["fixed"] @ np.ones(
            self.n + model.Q.dim
        )
        rest += (g.sigma / g.gain) * gram
        if model.form_B.affine and model.form_B.constant:
            rest += maps["B"] @ model.form_B.data("v", "u", u=np.zeros(self.n))

        kept: dict[float, Array] = {}

        def static(h: float) -> Array:
            if h not in kept:
                kept.clear()
                kept[h] = rate_u / h + gram / (g.gain * h) + rest
            return kept[h]

        return static

    @cached_property
    def _pull(self) -> Array:
        """Data of R^T M_op R in the whole."""
        _, maps, _ = self._assembled
        data: Array = maps["RMR"] @ _stored(self.RMR)
        return data

    def theta(self, r: Array, Mr: Array) -> float:
        """Return the damping for a residual r, with M r = M_op r given."""

        def V() -> float:
            return float(Mr @ self.model.X.riesz(Mr))

        square = float(r @ (self.model.mass @ r))
        return self.gains.damping.theta(Residual(square, float(r @ Mr), V))

    def solve(self, c: Array, h: float, moment: Moment, u_alpha: Array) -> Array:
        """Return y = (u, q) of one stage; raises `StepFailed`.

        Parameters
        ----------
        c
            (c_u, c_q), shape (n + m,).
        u_alpha
            G^+ z at the stage's time, shape (n,).
        """
        start = c.copy()
        start[: self.n] = self.model.impose(c[: self.n], moment)
        equation = _Equation(self, c, h, moment, u_alpha)
        return self.newton.solve(equation, start, self.blocks)


class _Equation:
    """Residual and Jacobian of one stage."""

    def __init__(
        self, stage: CoupledStage, c: Array, h: float, moment: Moment, u_alpha: Array
    ) -> None:
        self.stage = stage
        self.h = h
        self.moment = moment
        self.u_alpha = u_alpha
        model, g, n = stage.model, stage.gains, stage.n
        self.rate_q = 1.0 / (g.gain * h) + g.sigma / g.gain
        self.known_u = model.mass @ (c[:n] / h) + model.F(moment)
        self.known_q = (stage.gram @ c[n:]) / (g.gain * h)
        self.theta = 0.0

    def _parts(self, y: Array) -> tuple[Array, Array, Array, Array]:
        stage, n = self.stage, self.stage.n
        u, q = y[:n], y[n:]
        r = stage.split.R @ u - self.u_alpha
        w = u - r  # u_alpha + P u, since P = I - R
        return u, q, r, w

    def residual(self, y: Array) -> Array:
        stage, model = self.stage, self.stage.model
        u, q, r, w = self._parts(y)
        A = model.form_A.pattern("v", "q")
        data = model.form_A.data("v", "q", self.moment, u=w)
        Mr = stage.RM @ r
        self.theta = stage.theta(r, Mr)
        flux = model.B(w, self.moment) + A.matrix(data) @ q + self.theta * Mr
        if stage.gains.nu:
            flux += stage.gains.nu * (stage.PNP @ u)
        out = np.empty_like(y)
        out[: stage.n] = (model.mass @ (u / self.h) + flux - self.known_u) * model.X.free
        drive = self.rate_q * (stage.gram @ q) - self.known_q - A.transposed(data) @ r
        out[stage.n :] = drive * stage.free_q
        return out

    def factor(self, y: Array) -> Factor:
        stage, model = self.stage, self.stage.model
        _, maps, solver = stage._assembled
        _, q, r, w = self._parts(y)
        form = model.form_A
        data = stage._static(self.h) + self.theta * stage._pull
        data += maps["Au"] @ form.data("v", "u", self.moment, u=w, q=q)
        data += maps["A"] @ form.data("v", "q", self.moment, u=w)
        data += maps["Aq"] @ form.data("q", "u", self.moment, u=w, v=r)
        if not (model.form_B.affine and model.form_B.constant):
            data += maps["B"] @ model.form_B.data("v", "u", self.moment, u=w)
        return solver.factorise(data)


def _stored(matrix: sp.csr_array) -> Array:
    """Return the data of a matrix in the order of `Pattern.of(matrix)`."""
    coo = sp.coo_array(matrix)
    data: Array = Pattern.of(matrix).gather(coo.row, coo.col) @ coo.data
    return data
