"""The implicit stage of the paper's method: u and q in one system."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
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
    theta depends on all of r; its derivative is a rank-one term of the Jacobian.
    """

    def __init__(self, model: Model, split: Split, gains: Gains, newton: Newton) -> None:
        self.model = model
        self.split = split
        self.gains = gains
        self.newton = newton
        self.n = model.X.dim
        self.blocks = (slice(0, self.n), slice(self.n, self.n + model.Q.dim))
        self.RT = sp.csr_array(split.R.T)
        self.RM = sp.csr_array(self.RT @ gains.M_op)
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
    def _data(self) -> dict[str, Array]:
        """Data of the whole for the blocks that never change: M, G, RMR, and the rest."""
        _, maps, _ = self._assembled
        model, g = self.model, self.gains
        gram = maps["G"] @ _stored(self.gram) / g.gain
        rest = maps["PNP"] @ (g.nu * _stored(self.PNP)) + g.sigma * gram
        rest += maps["fixed"] @ np.ones(self.n + model.Q.dim)
        if self._constant_B:
            rest += maps["B"] @ model.form_B.data("v", "u", u=np.zeros(self.n))
        return {
            "rate": maps["M"] @ model.mass.data + gram,
            "pull": maps["RMR"] @ _stored(self.RMR),
            "rest": rest,
        }

    @property
    def _constant_B(self) -> bool:
        return self.model.form_B.affine and self.model.form_B.constant

    @cached_property
    def bilinear(self) -> _Bilinear | None:
        """Precomputed products, if A is bilinear and B affine, both constant in time."""
        form = self.model.form_A
        tensors = [form.tensor(*pair) for pair in (("v", "q"), ("v", "u"), ("q", "u"))]
        if not self._constant_B or any(tensor is None for tensor in tensors):
            return None
        return _Bilinear(self, *tensors)

    def theta(self, r: Array, Mr: Array) -> float:
        """Return the damping for a residual r, with Mr = R^T M_op r given."""
        return self.gains.damping.theta(self.norms(r, Mr, self.model.mass @ r))

    def norms(self, r: Array, Mr: Array, mass_r: Array) -> Residual:
        """Return the norms of r that a damping rule may use."""

        def V() -> float:
            return float(Mr @ self.model.X.riesz(Mr))

        return Residual(float(r @ mass_r), float(r @ Mr), V)

    def slope(self, norms: Residual, Mr: Array, mass_r: Array) -> Array:
        """Return the derivative of theta in u, shape (n,)."""
        dX, dVX, dV = self.gains.damping.slopes(norms)
        row = (2.0 * dX) * mass_r + (2.0 * dVX) * Mr
        if dV:
            row += 2.0 * dV * (self.gains.M_op @ self.model.X.riesz(Mr))
        slope: Array = self.RT @ row
        return slope

    def solve(self, c: Array, h: float, moment: Moment, u_alpha: Array, shift: Array) -> Array:
        """Return y = (u, q) of one stage; raises `StepFailed`.

        Parameters
        ----------
        c
            (c_u, c_q), shape (n + m,).
        u_alpha
            G^+ z at the stage's time, shape (n,).
        shift
            Change of u_alpha during the stage: where the iteration starts, no more.
        """
        start = c.copy()
        start[: self.n] = self.model.impose(c[: self.n] + shift, moment)
        equation = _Equation(self, c, h, moment, u_alpha)
        return self.newton.solve(equation, start, self.blocks, sweeps=True)


class _Bilinear:
    """What a stage needs if A(u) q is bilinear and everything else linear: a few sparse products.

    Attributes
    ----------
    lagged
        w -> data of A(w) in the whole, for sweeps.
    jacobian
        (w, q, r) -> data of the part of the Jacobian that changes.
    """

    def __init__(
        self, stage: CoupledStage, vq: sp.csr_array, vu: sp.csr_array, qu: sp.csr_array
    ) -> None:
        _, maps, _ = stage._assembled
        self.stage = stage
        self.tensor = vq
        self.A = stage.model.form_A.pattern("v", "q").operator()
        self.lagged = sp.csr_array(maps["A"] @ vq)
        self.jacobian = sp.csr_array(sp.hstack([self.lagged, maps["Au"] @ vu, maps["Aq"] @ qu]))
        self.B = stage.model.form_B.matrix("v", "u", u=np.zeros(stage.n))
        self.norms = sp.csr_array(sp.vstack([stage.RM, stage.model.mass]))
        self._rate, self._rest = self._linear(rate=True), self._linear(rate=False)
        self._pattern = Pattern.of(abs(self._rate) + abs(self._rest))
        self._rate_data = _stored(self._rate, self._pattern)
        self._rest_data = _stored(self._rest, self._pattern)

    def _linear(self, *, rate: bool) -> sp.csr_array:
        """Return the part of the linear rows that goes with 1/h, or the part that stays."""
        stage, g = self.stage, self.stage.gains
        free, free_q = sp.diags_array(stage.model.X.free), sp.diags_array(stage.free_q)
        state = stage.model.mass if rate else self.B @ stage.split.P + g.nu * stage.PNP
        weight = (1.0 if rate else g.sigma) / g.gain
        observed = 0.0 * stage.split.R if rate else stage.split.R
        blocks = [[free @ state, None], [None, weight * (free_q @ stage.gram)], [observed, None]]
        return sp.csr_array(sp.block_array(blocks))

    def system(self, h: float) -> sp.csr_array:
        """Return the linear part of the residual above R for a step h."""
        return self._pattern.matrix(self._rate_data / h + self._rest_data)


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
        self.fast = stage.bilinear
        self.known_u = model.mass @ (c[:n] / h) + model.F(moment)
        self.known_q = (stage.gram @ c[n:]) / (g.gain * h)
        if self.fast is not None:
            self.system = self.fast.system(h)
            self.known_u = (self.known_u - model.B(u_alpha, moment)) * model.X.free
            self.known_q = self.known_q * stage.free_q

    def residual(self, y: Array) -> Array:
        stage, model, n = self.stage, self.stage.model, self.stage.n
        u, q = y[:n], y[n:]
        out = np.empty_like(y)
        if self.fast is not None:
            linear = self.system @ y
            self.r = r = linear[len(y) :] - self.u_alpha
            self.w = w = u - r  # u_alpha + P u, since P = I - R
            products = self.fast.norms @ r
            self.Mr, self.mass_r = products[:n], products[n:]
            A = self.fast.A
            A.set(self.fast.tensor @ w)
            self.norms = stage.norms(r, self.Mr, self.mass_r)
            self.theta = stage.gains.damping.theta(self.norms)
            flux = A.apply(q) + self.theta * self.Mr
            out[:n] = linear[:n] + flux * model.X.free - self.known_u
            out[n:] = linear[n : len(y)] - self.known_q - A.apply_transposed(r) * stage.free_q
            return out
        self.r = r = stage.split.R @ u - self.u_alpha
        self.w = w = u - r
        self.Mr, self.mass_r = stage.RM @ r, model.mass @ r
        self.norms = stage.norms(r, self.Mr, self.mass_r)
        self.theta = stage.gains.damping.theta(self.norms)
        g = stage.gains
        A_w = model.form_A.matrix("v", "q", self.moment, u=w)
        flux = model.B(w, self.moment) + A_w @ q + self.theta * self.Mr + g.nu * (stage.PNP @ u)
        rate = 1.0 / (g.gain * self.h) + g.sigma / g.gain
        out[:n] = (model.mass @ (u / self.h) + flux - self.known_u) * model.X.free
        out[n:] = (rate * (stage.gram @ q) - self.known_q - A_w.T @ r) * stage.free_q
        return out

    def factor(self, y: Array, sweep: bool) -> Factor:
        """Return the factorised Jacobian at the y of the last `residual`.

        In a sweep, A(w), theta and the Jacobian of B are held.
        """
        stage, n = self.stage, self.stage.n
        _, maps, solver = stage._assembled
        q, r, w = y[n:], self.r, self.w
        fixed = stage._data
        data = fixed["rate"] / self.h + fixed["rest"] + self.theta * fixed["pull"]
        if self.fast is not None:
            data += (
                self.fast.lagged @ w if sweep else self.fast.jacobian @ np.concatenate([w, q, r])
            )
        else:
            form = stage.model.form_A
            data += maps["A"] @ form.data("v", "q", self.moment, u=w)
            if not sweep:
                data += maps["Au"] @ form.data("v", "u", self.moment, u=w, q=q)
                data += maps["Aq"] @ form.data("q", "u", self.moment, u=w, v=r)
            if not stage._constant_B:
                data += maps["B"] @ stage.model.form_B.data("v", "u", self.moment, u=w)
        factor = solver.factorise(data)
        if sweep:
            return factor
        free = stage.model.X.free
        row = stage.slope(self.norms, self.Mr, self.mass_r) * free
        if not row.any():
            return factor
        column = np.zeros_like(y)
        column[:n] = self.Mr * free
        return _Bordered(factor, factor.solve(column), row)


@dataclass(frozen=True, eq=False)
class _Bordered:
    """K + b a^T by Sherman and Morrison, from the factor of K: theta depends on all of r."""

    inner: Factor
    column: Array
    row: Array

    def solve(self, b: Array) -> Array:
        """Return the solution for a right-hand side."""
        x = self.inner.solve(b)
        n = len(self.row)
        pivot = 1.0 + float(self.row @ self.column[:n])
        if pivot == 0.0:
            raise LinearAlgebraError("The damped system is singular: take less damping.")
        return x - self.column * (float(self.row @ x[:n]) / pivot)

    def solve_transposed(self, b: Array) -> Array:
        """Return the solution with the transpose."""
        x = self.inner.solve_transposed(b)
        n = len(self.row)
        border = np.zeros_like(b)
        border[:n] = self.row
        border = self.inner.solve_transposed(border)
        pivot = 1.0 + float(self.row @ self.column[:n])
        return x - border * (float(self.column @ b) / pivot)


def _stored(matrix: sp.csr_array, pattern: Pattern | None = None) -> Array:
    """Return the data of a matrix in the order of a pattern, by default its own."""
    coo = sp.coo_array(matrix)
    data: Array = (pattern or Pattern.of(matrix)).gather(coo.row, coo.col) @ coo.data
    return data
