"""The implicit stage of the paper's method: u and q in one system."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.fem import Moment
from livepde.laws.bilinear import Bilinear
from livepde.laws.damping import Residual
from livepde.laws.distributed import Distributed
from livepde.laws.equation import Equation
from livepde.laws.gains import Gains, Metric
from livepde.laws.schur import BlockSolver
from livepde.laws.warm import Kept, Misses, Warm
from livepde.laws.way import Way
from livepde.laws.whole import Whole
from livepde.linalg import Array, Factor, Pattern
from livepde.model import Model
from livepde.observation import Split
from livepde.stepping import Near, Newton, Solution

RESOLVED = 1e-6  # share of the prior deviation of q below which q counts as this large

GROWN = 2.0  # times as large a first update as when the rate of a factor was seen: see again

__all__ = ["CoupledStage"]


class CoupledStage:
    """One implicit Euler stage of (est_exact_q), (est_exact_u), or (noisy_q), (noisy_u), coupled.

    With w = u_alpha + P u and r = R u - u_alpha, the unknowns y = (u, q) solve

        M (u - c_u)/h + B(w) + A(w) q + theta R^T M_op r + nu P^T N_op P u = F
        G_Q (q - c_q)/(gain h) + (sigma/gain) G_Q q - A(w)^T r             = 0

    together (with w = u if `Gains.at_estimate`), so that the two terms with A cancel in the energy
    as in the paper (align:neplusnr). theta depends on all of r; its derivative is a rank-one
    term of the Jacobian. Where A is nonlinear in q, A(w) in the second line is its derivative; an
    unknown that moves by itself adds -G_Q K (q - prior)/gain there.
    """

    def __init__(
        self,
        model: Model,
        split: Split,
        gains: Gains,
        newton: Newton,
        memory: Pattern | None = None,
    ) -> None:
        self.model = model
        self.split = split
        self.memory = memory  # pattern of `Metric.information`
        self.gains = gains
        self.newton = newton
        self.n = model.X.dim
        self.RT = sp.csr_array(split.R.T)
        self.RM = sp.csr_array(self.RT @ gains.M_op)
        self.RMR = sp.csr_array(self.RM @ split.R)
        N_op = gains.N_op if gains.nu else sp.csr_array(gains.N_op.shape)
        self.PNP = sp.csr_array(split.P.T @ N_op @ split.P)
        # dw/du: the part of w that is estimated.
        self.W = sp.csr_array(sp.eye_array(self.n)) if gains.at_estimate else split.P
        self.free_q = model.Q.free
        # G_Q, or where that is dense a sparse matrix of which it is the Schur complement: then
        # the Jacobian has auxiliary unknowns behind q.
        self.gram = model.Q.augmented
        self.auxiliary = self.gram.shape[0] - model.Q.dim
        self.size = self.n + model.Q.dim
        self.linear = model.form_A.linear_in_parameter

    @property
    def constant_B(self) -> bool:
        """True if the Jacobian of B never changes."""
        return self.model.form_B.affine and self.model.form_B.constant

    @cached_property
    def way(self) -> Way:
        """How it is solved: on several ranks, by blocks, or as a whole."""
        found: Way | None = Distributed.of(self) or BlockSolver.of(self) or Bilinear.of(self)
        return found or Whole(self)

    @cached_property
    def misses(self) -> Misses:
        """Compares what starts have missed."""
        observed, mass = self.split.R.diagonal(), self.model.state_mass.diagonal()
        floor = RESOLVED**2 * float((self.model.latent.deviations**2).sum())
        return self.way.kind(mass, observed, floor, self.size)

    def norms(self, r: Array, Mr: Array, mass_r: Array) -> Residual:
        """Return the norms of r that a damping rule may use; r lies in the range of R."""

        def V() -> float:
            return float(Mr @ self.model.X.riesz(Mr))

        return Residual(float(r @ mass_r), float(r @ Mr), V)

    def slope(self, norms: Residual, Mr: Array, mass_r: Array) -> Array:
        """Return the derivative of theta in u, shape (n,)."""
        dX, dVX, dV = self.gains.damping.slopes(norms)
        row = (2.0 * dX) * mass_r + (2.0 * dVX) * Mr
        if dV:
            row += self.RMR.T @ ((2.0 * dV) * self.model.X.riesz(Mr))
        return row

    def solve(
        self,
        c: Array,
        h: float,
        moment: Moment,
        u_alpha: Array,
        start: Array | Callable[[], Array],
        metric: Metric | None = None,
        near: Array | None = None,
        warm: Warm | None = None,
    ) -> tuple[Array, Warm]:
        """Return y = (u, q) of one stage, and what it leaves to the next; raises `StepFailed`.

        Parameters
        ----------
        c
            (c_u, c_q), shape (n + m,).
        u_alpha
            G^+ z at the stage's time, shape (n,).
        start
            Where the iteration starts, shape (n + m,), or a function that returns it; it does not
            change the result.
        metric
            In the place of G_Q/gain (with gain = inf) and of the damping rule.
        near
            A start that follows the steps before more closely, shape (n + m,); zero where all
            Dirichlet values are. If it was good at the stage before, Newton begins there without
            sweeps, moved by what it is expected to miss.
        warm
            What the stage before has left.
        """
        warm = warm or Warm.none()
        way, misses = self.way, self.misses

        def begin() -> Array:
            return self._imposed(start() if callable(start) else start, moment)

        if near is None:
            near = begin()
        elif not self.model.homogeneous:
            near = self._imposed(near, moment)
        equation = way.equation(c, h, moment, u_alpha, metric)
        way.begin(warm.kept, moment)
        newton = way.newton(tunes=metric is not None)
        good, age = None, 1
        if warm.missed <= newton.basin:
            good, age = self._good(near, equation, warm)
        solved = newton.solve(equation, begin, misses.parts, lagged=True, near=good)
        y = solved.y
        miss = y - near
        trend = misses.trend(miss, warm.miss) if warm.h == h else np.zeros(3)
        missed = misses.parts.relative(miss, y) if math.isnan(solved.missed) else solved.missed
        return y, Warm(missed, miss, trend, h, self._kept(warm.kept, equation, solved, age))

    def _good(self, near: Array, equation: Equation, warm: Warm) -> tuple[Near, int]:
        """Return where Newton may begin, and how old the factor for it is."""
        way, kept, follows = self.way, warm.kept, warm.h == equation.h
        y = near + self.misses.spread(warm.trend) * warm.miss if follows else near
        if kept.h == equation.h:
            factor: Factor | None = way.factor(kept, equation.moment)
            age = kept.age + 1
        else:
            factor = way.fresh(equation, y)
            age = 1 if factor is None else 0
        found = Near(
            y,
            factor,
            # A metric changes from stage to stage, and with it how factors serve.
            expected=kept.ageing * way.wear(age) if equation.metric is None else math.inf,
            trusted=GROWN * way.trusted(kept.seen, warm.missed),
            shares=self.misses.shares(warm.trend) if follows else None,
            rough=way.rough,
        )
        return found, age

    def _imposed(self, y: Array, moment: Moment) -> Array:
        y[: self.n] = self.model.impose(y[: self.n], moment)
        return y

    def _kept(self, kept: Kept, equation: Equation, solved: Solution, age: int) -> Kept:
        """Return what becomes of the factor after a stage."""
        way = self.way
        if not way.keeps:
            return kept
        ageing, seen, made = kept.ageing, kept.seen, way.made_at(equation)
        if made is not None:
            return Kept.made(made, equation, ageing, seen)
        if not math.isnan(solved.rate):
            ageing, seen = solved.rate / way.wear(age), solved.missed
        spent = kept.spent + solved.updates - 1 + sum(way.iterations)
        if spent > way.patience:
            return Kept.none(ageing, seen)
        return replace(kept, age=age, spent=spent, ageing=ageing, seen=seen)
