"""The implicit stage of the paper's method: u and q in one system."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Moment
from livepde.laws.damping import Damping, Residual
from livepde.laws.distributed import Distributed, distributed
from livepde.laws.schur import LARGE, Approximate, BlockSolver, Jacobian, narrow
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
from livepde.model import Model
from livepde.observation import Split
from livepde.stepping import TINY, Newton, Parts, Solution

RESOLVED = 1e-6  # share of the prior deviation of q below which q counts as this large

# Of what its start missed so much may be left of a stage by blocks. The next step goes on with it,
# but its start extrapolates it about threefold: more would grow from step to step.
SHARE = 0.3

AGES = 8.0  # stages in which what factors of blocks leave of an error doubles, as long as unseen

GROWN = 2.0  # times as large a first update as when the rate of a factor was seen: see again

PULL = 10.0  # theta h where the law tunes itself: r forgets within a step

__all__ = ["PULL", "BlockEquation", "CoupledStage", "Gains", "Kept", "Metric", "Warm"]


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
    at_estimate
        Evaluate B and A at w = u^ (Kügler 2010) instead of w = u_alpha + P u^.
    """

    gain: float
    damping: Damping
    nu: float
    sigma: float
    M_op: sp.csr_array
    N_op: sp.csr_array
    at_estimate: bool = False


@dataclass(frozen=True, eq=False)
class Metric:
    """What stands in the place of G_Q/gain where the law tunes itself (`livepde.laws.memory`).

    The second line of the stage becomes

        (spread G_Q + J) (q - c_q)/PULL + h shift/PULL - A(w)^T r = 0,    theta = PULL/h.

    Attributes
    ----------
    spread
        S, the spectral density of the equation error.
    information
        J, shape (m, m), and its data in the pattern given to the stage.
    shift
        The pull of a prior that has become heavier or lighter, per unit of time, shape (m,).
    """

    spread: float
    information: sp.csr_array
    data: Array
    shift: Array


@dataclass(frozen=True, eq=False)
class Kept:
    """A factor that goes from stage to stage: where it was made, and how it serves.

    The factor itself is made again from this where it is gone, after a restart say: the numbers
    that follow are the same.

    Attributes
    ----------
    y, u_alpha, h
        Point, data and step of its Jacobian, shapes (n + m,) and (n,); empty if none is kept.
    age
        Stages since then.
    spent
        Updates that these took beyond one each.
    ageing, seen
        By how much more each stage of age makes the second update, relative to the first, and how
        large the first was when that was seen, relative to y. Of the factor before, until it is
        seen again.
    spread, information
        Of its metric: S, and data of J; 0 and empty without one.
    """

    y: Array
    u_alpha: Array
    h: float
    age: int
    spent: int
    ageing: float
    seen: float
    spread: float
    information: Array

    @classmethod
    def none(cls, ageing: float = math.inf, seen: float = 0.0) -> Kept:
        """Return the value without a factor."""
        return cls(np.zeros(0), np.zeros(0), 0.0, 0, 0, ageing, seen, 0.0, np.zeros(0))

    @classmethod
    def made(cls, y: Array, equation: _Equation, ageing: float, seen: float) -> Kept:
        """Return the value for a factor made at y in a stage."""
        metric = equation.metric
        learned = (0.0, np.zeros(0)) if metric is None else (metric.spread, metric.data)
        return cls(y, equation.u_alpha, equation.h, 0, 0, ageing, seen, *learned)


@dataclass(frozen=True, eq=False)
class Warm:
    """What a stage leaves to the next one: how good its start was, and its factor.

    Attributes
    ----------
    missed
        How far `near`, as it was used, was from the solution, relative to u and q.
    miss, trend
        By what `near`, as it was given, missed it, shape (n + m,); and how much of the miss before
        that is: in the unobserved and the observed part of u, and in q, shape (3,).
    h
        Step of that stage; 0 before any.
    kept
        The factor.
    """

    missed: float
    miss: Array
    trend: Array
    h: float
    kept: Kept

    @classmethod
    def none(cls) -> Warm:
        """Return the value before any stage."""
        return cls(math.inf, np.zeros(0), np.zeros(3), 0.0, Kept.none())


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
        self._constant: tuple[float, Array] | None = None
        self._made: tuple[Array, Factor] | None = None
        # G_Q, or where that is dense a sparse matrix of which it is the Schur complement: then
        # the Jacobian has auxiliary unknowns behind q.
        self.gram = model.Q.augmented
        self.auxiliary = self.gram.shape[0] - model.Q.dim
        self.size = self.n + model.Q.dim
        self.linear = model.form_A.linear_in_parameter

    @cached_property
    def _assembled(self) -> tuple[Solver, dict[str, sp.csr_array]]:
        model, n = self.model, self.n
        A, W, R = model.form_A, self.W, self.split.R
        free = sp.diags_array(model.X.free)
        free_q = sp.diags_array(self.free_q)
        W_free, R_free = sp.csr_array(W @ free), sp.csr_array(R @ free)
        whole = Assembler(self.size + self.auxiliary)
        whole.add("M", model.form_M.pattern("v", "u"), free, free)
        whole.add("B", model.form_B.pattern("v", "u"), free, W_free)
        whole.add("Au", A.pattern("v", "u"), free, W_free)
        whole.add("RMR", Pattern.of(self.RMR), free, free)
        whole.add("PNP", Pattern.of(self.PNP), free, free)
        whole.add("A", A.pattern("v", "q"), free, free_q, at=(0, n))
        minus = -free_q
        whole.add("A", A.pattern("v", "q"), minus, R_free, at=(n, 0), transposed=True)
        whole.add("Aq", A.pattern("q", "u"), minus, W_free, at=(n, 0))
        rest = np.zeros(self.auxiliary)
        if not self.linear:
            whole.add("Aqq", A.pattern("q", "q"), minus, free_q, at=(n, n))
        free_g = sp.diags_array(np.concatenate([self.free_q, 1.0 - rest]))
        whole.add("G", Pattern.of(self.gram), free_g, free_g, at=(n, n))
        if self.memory is not None:
            whole.add("J", self.memory, free_q, free_q, at=(n, n))
        if model.latent.generator.nnz:
            K = sp.block_diag([model.latent.generator, sp.csr_array((len(rest), len(rest)))])
            whole.add("K", Pattern.of(self.gram), -free_g, sp.csr_array(K @ free_g), at=(n, n))
        fixed = np.concatenate([1.0 - model.X.free, 1.0 - self.free_q, rest])
        whole.add("fixed", Pattern.of(sp.eye_array(len(fixed))), sp.diags_array(fixed))
        pattern, maps = whole.build()
        solver = analyse(pattern)
        if isinstance(solver, BandedSolver):
            solver = replace(solver, units=self._units)
        return solver, maps

    @property
    def _units(self) -> Array:
        """Powers of two in which the diagonal of the coupled matrix is about one, times 1/h."""
        gram = self.gram.diagonal()
        if np.isfinite(self.gains.gain):
            gram = gram / self.gains.gain
        diagonal = np.abs(np.concatenate([self.model.mass.diagonal(), gram]))
        fixed = np.concatenate([self.model.X.free, self.free_q, np.ones(self.auxiliary)]) == 0.0
        diagonal[fixed | (diagonal == 0.0)] = 1.0
        units: Array = np.exp2(np.round(-0.5 * np.log2(diagonal)))
        return units

    @property
    def solver(self) -> Solver:
        """The engine of the coupled matrix."""
        return self._assembled[0]

    @cached_property
    def distributed(self) -> Distributed | None:
        """The stage on several ranks; None: this process solves it."""
        return distributed(self)

    @cached_property
    def by_blocks(self) -> BlockSolver | None:
        """What solves a large system by blocks; None: the coupled matrix is factorised."""
        if self.size < LARGE or self.distributed is not None:
            return None
        if narrow(sp.csr_array(self.model.mass + self.RMR)):
            return None
        return BlockSolver(self)

    @property
    def maps(self) -> dict[str, sp.csr_array]:
        """Block -> map of its data into the data of the coupled matrix."""
        return self._assembled[1]

    @cached_property
    def gram_data(self) -> Array:
        """Data of `gram`, in the order of its pattern."""
        return stored(self.gram)

    @cached_property
    def constant_data(self) -> dict[str, Array]:
        """Data of the coupled matrix that never change: with 1/h, with theta, and the rest."""
        maps, model, g = self.maps, self.model, self.gains
        gram = maps["G"] @ self.gram_data / g.gain
        rest = maps["PNP"] @ (g.nu * stored(self.PNP)) + g.sigma * gram
        rest += maps["fixed"] @ np.ones(self.size + self.auxiliary)
        if "K" in maps:
            rest += maps["K"] @ stored(self.gram) / g.gain
        if self.constant_B:
            rest += maps["B"] @ model.form_B.data("v", "u", u=np.zeros(self.n))
        return {
            "rate": maps["M"] @ model.mass.data + gram,
            "pull": maps["RMR"] @ stored(self.RMR),
            "rest": rest,
        }

    def constant(self, h: float) -> Array:
        """Return the data that depend on h only, kept for the last h."""
        if self._constant is None or self._constant[0] != h:
            data = self.constant_data["rate"] / h + self.constant_data["rest"]
            self._constant = (h, data)
        return self._constant[1]

    @property
    def constant_B(self) -> bool:
        """True if the Jacobian of B never changes."""
        return self.model.form_B.affine and self.model.form_B.constant

    @cached_property
    def _bilinear(self) -> _Bilinear | None:
        form = self.model.form_A
        if self.model.latent.generator.nnz or self.distributed is not None:
            return None
        if self.by_blocks is not None:
            return None
        vq, vu, qu = form.tensor("v", "q"), form.tensor("v", "u"), form.tensor("q", "u")
        if self.auxiliary or not self.constant_B:
            return None
        if isinstance(vq, sp.csr_array) and isinstance(vu, sp.csr_array):
            return _Bilinear(self, vq, vu, qu) if isinstance(qu, sp.csr_array) else None
        return None

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

        def begin() -> Array:
            return self._imposed(start() if callable(start) else start, moment)

        if near is None:
            near = begin()
        elif not self.model.homogeneous:
            near = self._imposed(near, moment)
        equation = self._equation(c, h, moment, u_alpha)
        equation.metric = metric
        good, follows = warm.missed <= self.newton.basin, warm.h == h
        newton, blocks = self.newton, self.by_blocks
        if blocks is not None:
            blocks.begin(self._block(blocks, warm.kept, moment) if len(warm.kept.y) else None)
            if metric is None and newton.share:  # a law that tunes itself learns from what is left
                newton = replace(newton, share=max(newton.share, SHARE))
        used, factor, age, trusted = None, None, 1, warm.kept.seen
        if good:
            used = near + self._spread(warm.trend) * warm.miss if follows else near
            if warm.kept.h == h:
                factor, age = self._factor(warm.kept, moment), warm.kept.age + 1
            elif isinstance(equation, BlockEquation) and self.keeps:
                equation.residual(used)
                factor, age = equation.blocks.renew(equation.jacobian(used, False)), 0
        if blocks is None:
            trusted = min(trusted, warm.missed)
        solved = newton.solve(
            equation,
            begin,
            self.parts,
            lagged=True,
            near=used,
            kept=factor,
            # A metric changes from stage to stage, and with it how factors serve.
            expected=warm.kept.ageing * self._wear(age) if metric is None else math.inf,
            trusted=GROWN * trusted,
            shares=self._shares(warm.trend) if follows and blocks is None else None,
            rough=blocks is not None,
        )
        y = solved.y
        miss = y - near
        trend = self._trend(miss, warm.miss) if follows else np.zeros(3)
        missed = self.parts.relative(miss, y) if math.isnan(solved.missed) else solved.missed
        kept = self._keep(warm.kept, equation, solved, age) if self.keeps else warm.kept
        return y, Warm(missed, miss, trend, h, kept)

    @staticmethod
    def _shares(trend: Array) -> tuple[float, float, float]:
        """Return in which of `parts` misses are errors of the time step, and not noise."""
        unobserved, observed, q = trend.tolist()
        return max(unobserved, observed, 0.0), max(observed, 0.0), max(q, 0.0)

    def _imposed(self, y: Array, moment: Moment) -> Array:
        y[: self.n] = self.model.impose(y[: self.n], moment)
        return y

    def _wear(self, age: int) -> float:
        """Return how much more a factor of an age leaves of an error than a new one.

        One of blocks is approximate from the start.
        """
        return float(age) if self.by_blocks is None else 1.0 + age / AGES

    def _keep(self, kept: Kept, equation: _Equation, solved: Solution, age: int) -> Kept:
        """Return what becomes of the factor after a stage."""
        ageing, seen, blocks = kept.ageing, kept.seen, self.by_blocks
        if blocks is not None and blocks.made is not None:
            return Kept.made(blocks.made.at, equation, ageing, seen)
        if equation.made is not None:
            self._made = equation.made
            return Kept.made(equation.made[0], equation, ageing, seen)
        if not math.isnan(solved.rate):
            ageing, seen = solved.rate / self._wear(age), solved.missed
        spent = kept.spent + solved.updates - 1 + (sum(blocks.iterations) if blocks else 0)
        if spent > self.patience:
            return Kept.none(ageing, seen)
        return replace(kept, age=age, spent=spent, ageing=ageing, seen=seen)

    def _trend(self, miss: Array, before: Array) -> Array:
        """Return by how much two misses that follow each other agree, shape (3,)."""
        state, observed, q = self.parts.products(miss, before)
        state0, observed0, q0 = self.parts.products(before, before)
        pairs = (state - observed, state0 - observed0), (observed, observed0), (q, q0)
        return np.array([min(max(a / b, -1.0), 1.0) if b > 0.0 else 0.0 for a, b in pairs])

    @cached_property
    def members(self) -> Array:
        """How much each coefficient belongs to P u, R u and q, shape (3, n + m)."""
        members = np.zeros((3, self.size))
        members[1, : self.n] = self.split.R.diagonal()
        members[0, : self.n] = 1.0 - members[1, : self.n]
        members[2, self.n :] = 1.0
        return members

    def _spread(self, trend: Array) -> Array:
        """Return the number of its part for each coefficient: of P u, R u and q."""
        if self.by_blocks is None:
            return np.asarray(trend @ self.members)
        observed = self.split.R.diagonal()
        state = trend[0] + (trend[1] - trend[0]) * observed
        return np.concatenate([state, np.full(self.size - self.n, trend[2])])

    @cached_property
    def parts(self) -> Parts:
        """The state and what is observed of it, in L2 with lumped mass, and the parameter."""
        mass = self.model.state_mass.diagonal()
        state = np.stack([mass, mass * self.split.R.diagonal()], axis=1)
        floor = RESOLVED**2 * float((self.model.latent.deviations**2).sum())
        if self.by_blocks is not None:
            return _Lean(state, (TINY, floor))
        weights = np.zeros((self.size, 3))
        weights[: self.n, :2], weights[self.n :, 2] = state, 1.0
        return Parts(weights, (TINY, TINY, floor))

    def _equation(self, c: Array, h: float, moment: Moment, u_alpha: Array) -> _Equation:
        if self.distributed is not None:
            return _DistributedEquation(self, self.distributed, c, h, moment, u_alpha)
        if self.by_blocks is not None:
            return BlockEquation(self.by_blocks, c, h, moment, u_alpha)
        if self._bilinear is not None:
            return _BilinearEquation(self._bilinear, self, c, h, moment, u_alpha)
        return _Equation(self, c, h, moment, u_alpha)

    @cached_property
    def keeps(self) -> bool:
        """True if a factor is kept from stage to stage."""
        if self.distributed is not None:
            return self.model.constant
        return self._bilinear is not None if self.by_blocks is None else self.model.constant

    @cached_property
    def patience(self) -> int:
        """Updates beyond one for each stage that a factor may cost before it is made again."""
        if self.distributed is not None:
            return 3
        if self.by_blocks is not None:
            return self.by_blocks.patience
        return 2 if isinstance(self.solver, BandedSolver) else 12

    def _factor(self, kept: Kept, moment: Moment) -> Factor:
        """Return the factor that is kept, made again if this stage has another."""
        if self.by_blocks is not None:
            return self._block(self.by_blocks, kept, moment)
        if self._made is None or self._made[0] is not kept.y:
            equation = self._equation(np.zeros_like(kept.y), kept.h, moment, kept.u_alpha)
            equation.residual(kept.y)
            self._made = (kept.y, equation.factor(kept.y, False))
        return self._made[1]

    def _block(self, blocks: BlockSolver, kept: Kept, moment: Moment) -> Approximate:
        """Return the same of a stage by blocks."""
        if blocks.last is None or blocks.last.at is not kept.y:
            equation = BlockEquation(blocks, np.zeros_like(kept.y), kept.h, moment, kept.u_alpha)
            if self.memory is not None:
                J, data = self.memory.matrix(kept.information), kept.information
                equation.metric = Metric(kept.spread, J, data, np.zeros(self.model.Q.dim))
            equation.residual(kept.y)
            blocks.last = equation.jacobian(kept.y, False).approximate()
        return blocks.last


@dataclass(frozen=True, eq=False)
class _Lean(Parts):
    """The state and the parameter, without an array for each part; weights of shape (n, 2).

    What may be left is a share of the larger of the relative misses, in both parts: q is not known
    better than the time step lets u be known.
    """

    def squares(self, x: Array) -> list[float]:
        state, _, q = self.products(x, x)
        return [state, q]

    def products(self, x: Array, y: Array) -> list[float]:
        n = len(self.weights)
        state, observed = ((x[:n] * y[:n]) @ self.weights).tolist()
        return [state, observed, float(x[n:] @ y[n:])]

    def allowed(self, shares: list[float], missed: list[float], scales: list[float]) -> list[float]:
        floored = [max(scale, floor) for scale, floor in zip(scales, self.floors, strict=True)]
        worst = max(square / scale for square, scale in zip(missed, floored, strict=True))
        return [share**2 * worst * scale for share, scale in zip(shares, floored, strict=True)]


class _Equation:
    """Residual and Jacobian of one stage.

    `residual` leaves behind what the Jacobian and the damping rule need: r, w, and the dual vectors
    Mr = R^T M_op r and mass_r = R^T M r.
    """

    def __init__(
        self, stage: CoupledStage, c: Array, h: float, moment: Moment, u_alpha: Array
    ) -> None:
        self.stage = stage
        self.c = c
        self.h = h
        self.moment = moment
        self.u_alpha = u_alpha
        self.source = stage.model.F(moment)
        self.metric: Metric | None = None
        self.count = 0  # residuals
        self.made: tuple[Array, Factor] | None = None  # Newton's last factor, and where

    def residual(self, y: Array) -> Array:
        """Return the residual at y = (u, q)."""
        stage, model, n, g = self.stage, self.stage.model, self.stage.n, self.stage.gains
        u, q = y[:n], y[n:]
        self.count += 1
        self.r = r = stage.split.project(u) - self.u_alpha
        self.w = w = u if g.at_estimate else u - r  # u_alpha + P u, since P = I - R
        self.Mr, self.mass_r = stage.RM @ r, stage.split.project_transposed(model.mass @ r)
        self.A = A = model.form_A.matrix("v", "q", self.moment, u=w, q=q)
        C = A @ q if stage.linear else model.form_A.vector("v", self.moment, u=w, q=q)
        flux = model.B(w, self.moment) + C + (g.nu and g.nu * (stage.PNP @ u)) - self.source
        rate = (u - self.c[:n]) / self.h
        drive = (q - self.c[n:]) / (g.gain * self.h) + (g.sigma / g.gain) * q
        if model.latent.generator.nnz:
            drive -= model.latent.generator @ (q - model.latent.prior) / g.gain
        out = np.empty_like(y)
        out[:n] = (model.mass @ rate + flux) * model.X.free + self.pull()
        out[n:] = (model.Q.dual(drive) - A.T @ r + self.learned(y)) * stage.free_q
        return out

    def learned(self, y: Array) -> Array | float:
        """Return what the metric adds to the second line; 0 without one."""
        metric = self.metric
        if metric is None:
            return 0.0
        change = y[self.stage.n :] - self.c[self.stage.n :]
        force = metric.spread * self.stage.model.Q.dual(change) + metric.information @ change
        learned: Array = (force + self.h * metric.shift) / PULL
        return learned

    def pull(self) -> Array:
        """Return theta R^T M_op r."""
        if self.metric is not None:
            self.theta = PULL / self.h
            return self.theta * self.Mr
        self.norms = self.stage.norms(self.r, self.Mr, self.mass_r)
        self.theta = self.stage.gains.damping.theta(self.norms)
        return self.theta * self.Mr

    def changing(self, y: Array, sweep: bool) -> Array:
        """Return the data of the Jacobian that depend on y.

        A sweep holds the coupling A(w)^T r and theta. It does not hold A(w) q: with an unknown in
        the principal part that would be an explicit iteration, which diverges or goes astray.
        """
        stage, form = self.stage, self.stage.model.form_A
        maps, q, r, w = stage.maps, y[stage.n :], self.r, self.w
        data: Array = maps["A"] @ form.data("v", "q", self.moment, u=w, q=q)
        data += maps["Au"] @ form.data("v", "u", self.moment, u=w, q=q)
        if not sweep:
            data += maps["Aq"] @ form.data("q", "u", self.moment, u=w, v=r, q=q)
            if not stage.linear:
                data += maps["Aqq"] @ form.data("q", "q", self.moment, u=w, v=r, q=q)
        if not stage.constant_B:
            data += maps["B"] @ stage.model.form_B.data("v", "u", self.moment, u=w)
        return data

    def factor(self, y: Array, sweep: bool) -> Factor:
        """Return the factorised Jacobian at the y of the last `residual`.

        In a sweep, the coupling to r and theta are held.
        """
        stage = self.stage
        data = self.changing(y, sweep)
        data += stage.constant(self.h)
        data += self.theta * stage.constant_data["pull"]
        metric = self.metric
        if metric is not None:
            data += stage.maps["G"] @ ((metric.spread / PULL) * stage.gram_data)
            data += stage.maps["J"] @ (metric.data / PULL)
        factor: Factor = stage.solver.factorise(data)
        if stage.auxiliary:
            factor = Leading(factor, stage.size, stage.size + stage.auxiliary)
        if sweep or metric is not None:
            return factor
        row = stage.slope(self.norms, self.Mr, self.mass_r)
        if row.any():
            column = np.zeros_like(y)
            column[: stage.n] = self.Mr
            factor = _Bordered(factor, factor.solve(column), row)
        self.made = (y, factor)
        return factor


class _Bilinear:
    """Precomputed products for a bilinear A and an affine B, both constant in time.

    A residual is then five products with sparse matrices of fixed structure.

    Attributes
    ----------
    coupling, operator
        w -> data of A(w) on the free coefficients, and the operator that takes them.
    lagged, jacobian
        w, and (w, q, r) -> data of the part of the stage's Jacobian that changes.
    linear
        (w, (y - c)/h, y) -> the linear part of the residual.
    observed
        r -> R^T M_op r above R^T M r.
    offset
        B(0) on the free coefficients.
    """

    def __init__(
        self, stage: CoupledStage, vq: sp.csr_array, vu: sp.csr_array, qu: sp.csr_array
    ) -> None:
        model, g, maps, n, m = stage.model, stage.gains, stage.maps, stage.n, stage.model.Q.dim
        free, free_q = sp.diags_array(model.X.free), sp.diags_array(stage.free_q)
        pattern = model.form_A.pattern("v", "q")
        kept = model.X.free[pattern.rows] * stage.free_q[pattern.indices]
        self.coupling = sp.csr_array(sp.diags_array(kept) @ vq)
        self.operator = pattern.operator()
        self.lagged = sp.csr_array(sp.hstack([maps["A"] @ vq, maps["Au"] @ vu]))
        self.jacobian = sp.csr_array(sp.hstack([self.lagged, maps["Aq"] @ qu]))
        zero = np.zeros(n)
        B = model.form_B.matrix("v", "u", u=zero)
        self.offset = model.B(zero) * model.X.free
        gram = sp.csr_array(free_q @ stage.gram / g.gain)
        wide = sp.csr_array((n, m))
        rows = [
            [free @ B, free @ model.mass, wide, g.nu * free @ stage.PNP, wide],
            [wide.T, wide.T, gram, wide.T, g.sigma * gram],
        ]
        linear = sp.csr_array(sp.block_array(rows))
        linear.eliminate_zeros()
        linear.sum_duplicates()
        self.linear = Pattern.of(linear).matrix(linear.data)  # with short indices
        self.observed = compact(sp.csr_array(sp.vstack([stage.RM, stage.RT @ model.mass])))


class _BilinearEquation(_Equation):
    """The same equation by the precomputed products."""

    def __init__(
        self,
        products: _Bilinear,
        stage: CoupledStage,
        c: Array,
        h: float,
        moment: Moment,
        u_alpha: Array,
    ) -> None:
        super().__init__(stage, c, h, moment, u_alpha)
        self.products = products
        self.known = self.source * stage.model.X.free - products.offset

    def residual(self, y: Array) -> Array:
        n, products = self.stage.n, self.products
        self.count += 1
        u, q = y[:n], y[n:]
        self.r = r = self.stage.split.project(u) - self.u_alpha
        self.w = w = u if self.stage.gains.at_estimate else u - r
        out: Array = products.linear @ np.concatenate((w, (y - self.c) / self.h, y))
        observed = products.observed @ r
        self.Mr, self.mass_r = observed[:n], observed[n:]
        A = products.operator
        A.set(products.coupling @ w)
        out[:n] += A.apply(q) + self.pull() - self.known
        out[n:] -= A.apply_transposed(r)
        if self.metric is not None:
            out[n:] += self.learned(y) * self.stage.free_q
        return out

    def changing(self, y: Array, sweep: bool) -> Array:
        if sweep:
            known = np.concatenate([self.w, y[self.stage.n :]])
            lagged: Array = self.products.lagged @ known
            return lagged
        data: Array = self.products.jacobian @ np.concatenate([self.w, y[self.stage.n :], self.r])
        return data


class BlockEquation(_Equation):
    """The same equation, its Jacobian by blocks."""

    def __init__(
        self, blocks: BlockSolver, c: Array, h: float, moment: Moment, u_alpha: Array
    ) -> None:
        super().__init__(blocks.stage, c, h, moment, u_alpha)
        self.blocks = blocks

    def weights(self) -> tuple[float, sp.csr_array | None]:
        """Return what multiplies G_Q in the Jacobian, and what is added to it."""
        g, metric = self.stage.gains, self.metric
        if metric is None:
            return (1.0 / self.h + g.sigma) / g.gain, None
        return metric.spread / PULL, sp.csr_array(metric.information / PULL)

    def residual(self, y: Array) -> Array:
        out = super().residual(y)
        self.blocks.A = self.A
        return out

    def factor(self, y: Array, sweep: bool) -> Factor:
        return self.jacobian(y, sweep)

    def jacobian(self, y: Array, sweep: bool) -> Jacobian:
        """Return the Jacobian at the y of the last `residual`."""
        K = self.blocks.linearise(self, y, sweep)
        if sweep or self.metric is not None:
            return K
        row = self.stage.slope(self.norms, self.Mr, self.mass_r)
        return K.bordered(self.Mr, row) if row.any() else K


class _DistributedEquation(_Equation):
    """The same equation, its residual and Jacobian on several ranks."""

    def __init__(
        self,
        stage: CoupledStage,
        shared: Distributed,
        c: Array,
        h: float,
        moment: Moment,
        u_alpha: Array,
    ) -> None:
        super().__init__(stage, c, h, moment, u_alpha)
        self.shared = shared.equation(c, h, moment, u_alpha, self.source)

    def residual(self, y: Array) -> Array:
        n, u = self.stage.n, y[: self.stage.n]
        self.count += 1
        self.r = self.stage.split.R @ u - self.u_alpha
        first, self.Mr, self.mass_r, second = self.shared.residual(u, y[n:])
        return np.concatenate([first + self.pull(), second])

    def factor(self, y: Array, sweep: bool) -> Factor:
        row = np.zeros(self.stage.n)
        if not sweep:
            row = self.stage.slope(self.norms, self.Mr, self.mass_r)
        factor: Factor = self.shared.jacobian(self.theta, sweep, self.Mr, row)
        if not sweep:
            self.made = (y, factor)
        return factor


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


def stored(matrix: sp.csr_array) -> Array:
    """Return the data of a matrix in the order of its pattern."""
    coo = sp.coo_array(matrix)
    data: Array = Pattern.of(matrix).gather(coo.row, coo.col) @ coo.data
    return data
