"""The nonlinear equation of one coupled stage: its residual, term by term, and when it is solved.

With w = u_alpha + P u and r = R u - u_alpha, the unknowns y = (u, q) of one implicit Euler stage of
(est_exact_q), (est_exact_u), or (noisy_q), (noisy_u), with u_t = (u - c_u)/h, q_t = (q - c_q)/h,
solve

    M u_t + B(w) + A(w) q + theta R^T M_op r + nu P^T N_op P u = F
    G_Q (q_t + sigma q)/gain                                   = A(w)^T r

together, so that with full data the two terms with A cancel in the energy, as in the paper
(align:neplusnr). Over omega w is the data, elsewhere the estimate. `StageSolver.evaluate` has both
lines. `Metric` lists what may stand in the second one besides.
The remaining residual of the stage before, times the ratio of its step to this one, is subtracted
from both right-hand sides: so the residuals of a run of stages do not add up.

theta depends on all of r; its derivative is a rank-one term of the Jacobian. Where A is nonlinear
in q, A(w) in the second line is its derivative.

*Forms.* The paper splits u into R u = chi_omega u and P u = chi_(Omega without omega) u. Both have
a jump at the boundary of omega, which no function of a finite-element space has. So the integrals
are split, and not the coefficients: over omega the forms see w = u_alpha + P u, outside of it the
estimate u. Selecting coefficients instead would let P u fall to zero over one element, with a
gradient of size u over the size of the element: M and N of (MN1), (MN2) would see that and diverge
with the mesh.

Averages, points and matrices have no omega: R = G^+ G and P = I - R split the state in all of
Omega.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp

from livepde.fem import Composed, Form, Moment
from livepde.laws.damping import Damping, Residual
from livepde.linalg import Array, Factor, IntArray, Pattern, compact
from livepde.model import Model
from livepde.observation import Split
from livepde.spaces import HilbertSpace
from livepde.stepping import TINY

AnyForm: TypeAlias = Form | Composed
FLOOR = 1e-6  # of ||u_alpha||: what is smaller of r counts as zero
RESOLVED = 1e-3  # relative accuracy of r, as far as it is above the floor
CARRIED = 1e-2  # the same where the next stage makes up for the remaining residual
STIFFEST = 1e12  # times 1/h, of theta: then a step takes all but this part of r away
RESTING = 1e-6  # of u and q: residuals of smaller changes in a step are relative to it
OWED = 0.1  # weight of the second line's residual, where a later step makes up for it
ROUNDING = 4e-16  # times the sizes of all terms of a row: what their sum is exact to


@dataclass(frozen=True, eq=False)
class StageForms:
    """Forms and matrices of a stage for one set of sensors; fixed, whatever the step."""

    # The process, and the split of its state into an observed and a hidden part.
    model: Model
    split: Split
    # Integrands (u, v, x) of M and N, integrated as in (MN1), (MN2); M_op None: that of M.
    M_op: Any
    N_op: Any
    nu: float  # weight of N

    @cached_property
    def _outside(self) -> IntArray | None:
        """The elements outside omega; None where there are none."""
        omega = self.split.omega
        if omega is None:
            return None
        return np.setdiff1d(np.arange(self.model.mesh.nelements), omega)

    def _inside(self, form: AnyForm) -> AnyForm:
        return form if self.split.omega is None else form.on(self.split.omega)

    @cached_property
    def A_in(self) -> AnyForm:
        """A over omega."""
        return self._inside(self.model.form_A)

    @cached_property
    def B_in(self) -> AnyForm:
        """B over omega."""
        return self._inside(self.model.form_B)

    @cached_property
    def A_out(self) -> AnyForm | None:
        """A outside omega; None where there is nothing."""
        return None if self._outside is None else self.model.form_A.on(self._outside)

    @cached_property
    def B_out(self) -> AnyForm | None:
        """B outside omega; None where there is nothing."""
        return None if self._outside is None else self.model.form_B.on(self._outside)

    def argument(self, u: Array, r: Array) -> Array:
        """Return w = u_alpha + P u, which A and B see over omega: u - r, since P = I - R."""
        return u - r

    @cached_property
    def W(self) -> sp.csr_array | None:
        """dw/du over omega, shape (n, n); None where w is known there: the data give all of it."""
        n = self.model.X.dim
        estimated = sp.csr_array(self.split.P @ sp.diags_array(self.model.X.free))
        if self.split.omega is not None:
            # Only coefficients that the forms over omega read can make w unknown.
            touched = np.zeros(n)
            touched[self.B_in.pattern("v", "u").indices] = 1.0
            touched[self.A_in.pattern("v", "u").indices] = 1.0
            estimated = sp.csr_array(sp.diags_array(touched) @ estimated)
        estimated.eliminate_zeros()
        return self.split.P if estimated.nnz else None

    @cached_property
    def mass(self) -> sp.csr_array:
        """Matrix of ||r||_X^2 = r^T mass r: R^T M R, integrated over omega."""
        form = self._inside(self.model.form_M)
        return self._observed(form.matrix("v", "u"))

    @cached_property
    def pull(self) -> sp.csr_array:
        """R^T M_op R, integrated over omega (MN1)."""
        if self.M_op is None:
            return self.mass
        return self._observed(self.model.bilinear(self.M_op, self.split.omega))

    @cached_property
    def hidden(self) -> sp.csr_array:
        """Matrix nu P^T N_op P over omega, and nu N_op outside it (MN2), shape (n, n)."""
        n, P = self.model.X.dim, self.split.P
        if not self.nu:
            return sp.csr_array((n, n))
        inside = P.T @ self.model.bilinear(self.N_op, self.split.omega) @ P
        if self._outside is not None:
            inside = inside + self.model.bilinear(self.N_op, self._outside)
        return sp.csr_array(self.nu * inside)

    def _observed(self, matrix: sp.csr_array) -> sp.csr_array:
        return sp.csr_array(self.split.R.T @ matrix @ self.split.R)

    @cached_property
    def tests(self) -> HilbertSpace:
        """X without the functions that reach out of omega: the test functions of ||r||_V~."""
        if self._outside is None:
            return self.model.X
        reach = np.zeros(self.model.X.dim, dtype=bool)
        for name, block in self.model.state_space.fields.items():
            start = self.model.state_space.part(name).start
            reach[start + block.element_dofs[:, self._outside]] = True
        reach[self.model.X.fixed] = True
        return HilbertSpace(self.model.mass, "V~", np.flatnonzero(reach))


@dataclass(frozen=True, eq=False)
class Metric:
    """Weights of the second line of a stage, an equation of dual vectors of Q.

        weight G_Q (q_t + sigma (q - q_0) - K (q - prior)) + J (q - c_q) = A(w)^T r + load

    with q_t = (q - c_q)/h, the Gram matrix G_Q, the generator K of unknowns that move by
    themselves, and q_0 = 0 (`Latent.origin`). With J = 0 and without load it is (noisy_q), and with
    sigma = 0 (est_exact_q), for weight = 1/gain.
    """

    weight: float  # 1/gain, >= 0
    sigma: float = 0.0  # stabilising term of (noisy_q), >= 0
    # Terms of the right-hand side besides A(w)^T r, shape (m,); None: zero.
    load: Array | None = None
    # Data of J, in the pattern that the stage was made with; None: zero.
    information: Array | None = None
    # Weight of R^T M_op r in the stage, where the metric sets it; None: by the damping rule.
    theta: float | None = None

    def scale(self, h: float) -> float:
        """Return the weight of G_Q q in a stage with step h."""
        return self.weight * (1.0 / h + self.sigma)


@dataclass(frozen=True, eq=False)
class Inside:
    """Terms over omega: A(w) and its transpose, dense if small, and B(w), shape (n,)."""

    A: Any
    transposed: Any
    B: Array


@dataclass(frozen=True, eq=False)
class StageProblem:
    """One stage to be solved."""

    c: Array  # (c_u, c_q), shape (n + m,)
    # Step, and time and inputs at its end.
    h: float
    moment: Moment
    u_alpha: Array  # observed part of the state, shape (n,)
    metric: Metric  # weights of the second line
    # Remaining residual of the stage before, for which this one makes up, a dual vector, shape (n +
    # m,); None: residuals are not carried from stage to stage.
    left: Array | None = None


@dataclass(frozen=True, eq=False)
class StageData:
    """A stage with the data that are computed once for it."""

    problem: StageProblem  # the stage
    # F and the load, less the remaining residual of the stage before, shapes (n,) and (m,).
    source: Array
    load: Array
    rest: Array  # left side of the second line for a q that does not change, shape (m,)
    inside: Inside | None  # A and B over omega, where the data give all of w there
    # Least scales of the residuals of both lines, and ||u_alpha||_X. Scales are the dual norms of F
    # and of the load less `rest`, or of changes by `RESTING` of c if these are larger.
    sizes: tuple[float, float, float]
    # Function that returns the squared norms of u_alpha, computed once.
    observed: Callable[[], Residual]
    J: Any = None  # information in the metric, a matrix of shape (m, m); None: zero


@dataclass(frozen=True, eq=False)
class StageIterate:
    """The stage at a point y = (u, q)."""

    # Shape (n + m,).
    y: Array
    residual: Array
    # See `livepde.stepping.newton.StagePoint`.
    size: float
    resolved: bool
    scales: tuple[float, float]  # dual norms of the largest terms of the two lines
    # Argument of A and B over omega, and the observed residual, shape (n,).
    w: Array
    r: Array
    A_in: Any  # A(w) over omega, shape (n, m)
    theta: float  # weight of R^T M_op r
    norms: Residual  # squared norms of r
    # R^T M_op r and R^T M r over omega, shape (n,).
    Mr: Array
    mass_r: Array


class StageTerms:
    """Terms of a stage that all solvers share: its forms, gains and norms.

    `memory` is the pattern of `Metric.information`; None: there is none.
    """

    def __init__(self, forms: StageForms, damping: Damping, memory: Pattern | None = None) -> None:
        model = forms.model
        self.forms, self.damping, self.memory = forms, damping, memory
        self.n, self.size = model.X.dim, model.X.dim + model.Q.dim
        self.parts = slice(0, self.n), slice(self.n, self.size)  # of u and q in y
        # One for each free coefficient of the state, (n,), and of the parameter, (m,).
        self.free, self.free_q = model.X.free, model.Q.free
        # G_Q, or where that is dense a sparse matrix of which it is the Schur complement, with
        # auxiliary unknowns behind q.
        self.gram: sp.csr_array = model.Q.augmented
        self.auxiliary = self.gram.shape[0] - model.Q.dim
        self.linear = model.form_A.linear_in_parameter  # in q
        self.moves = bool(model.latent.generator.nnz)  # whether an unknown moves by itself
        self.observes = bool(forms.split.present.any())  # whether a sensor is present
        # M, R^T M_op R and R^T M R over omega; dense if small.
        self.mass, self.pull = compact(model.mass), compact(forms.pull)
        self.observed_mass = compact(forms.mass)
        # Diagonal of the mass: the norm by it is equivalent to that of X.
        self.lumped: Array = np.abs(model.mass.diagonal())
        self.dual_weights = self._dual_weights()
        weights = self.dual_weights
        # Diagonals of M and G_Q on the free coefficients, shape (n + m,).
        self.diagonal = np.divide(1.0, weights, out=np.zeros_like(weights), where=weights > 0.0)

    def _dual_weights(self) -> Array:
        """Return weights of squared dual norms, (n + m,): the inverse diagonals of M and G_Q.

        For functionals of the same kind, as a residual and the terms that it is the sum of, the
        ratio of these norms is that of the dual norms, and larger where a residual is rough.
        """
        parts, Q = [], self.forms.model.Q
        grams = self.forms.model.mass, self.gram if self.auxiliary else Q.gram
        for gram, free in zip(grams, (self.free, self.free_q), strict=True):
            diagonal = np.abs(gram.diagonal())[: len(free)]
            floor = diagonal.max(initial=0.0) or 1.0
            parts.append(free / np.where(diagonal > 0.0, diagonal, floor))
        return np.concatenate(parts)

    def duals(self, functionals: Sequence[Array], part: slice) -> list[float]:
        """Return the dual norms of functionals on u or q."""
        squares = np.square(np.array(functionals)) @ self.dual_weights[part]
        found: list[float] = np.sqrt(squares).tolist()
        return found

    def measured(
        self,
        data: StageData,
        first: list[Array],
        second: list[Array],
        X: float,
        theta: float,
        accuracy: float,
    ) -> tuple[float, bool, tuple[float, float]]:
        """Return the relative size of a residual, whether it resolves r, and the scales of both."""
        state, *terms = self.duals(first, self.parts[0])
        other, *terms_q = self.duals(second, self.parts[1])
        scales = max(data.sizes[0], *terms), max(data.sizes[1], *terms_q)
        own, own_q = state / max(scales[0], TINY), other / max(scales[1], TINY)
        if data.problem.metric.theta is not None:
            # With such a metric the next step makes up for the remaining residuals of this one.
            return max(own, OWED * own_q), True, scales
        # S >= M (1/h + theta) on the observed part, which bounds the error of u by the residual.
        least = 1.0 / data.problem.h + theta
        r = math.sqrt(max(X, 0.0)) + FLOOR * data.sizes[2]
        return max(own, own_q), state <= accuracy * r * least or not self.observes, scales

    def given(self, problem: StageProblem, source: Array, inside: Inside | None) -> StageData:
        """Return a stage, from its F and the terms of the data on omega."""
        metric, left, c_q = problem.metric, problem.left, problem.c[self.n :]
        load = np.zeros_like(c_q) if metric.load is None else metric.load
        if left is not None:
            source, load = source - left[: self.n], load - left[self.n :]
        J = None
        if metric.information is not None and self.memory is not None:
            J = self.memory.compact(metric.information)
        still = not (metric.sigma or self.moves)
        rest = np.zeros_like(c_q) if still else self.learned(problem, c_q)
        sizes, observed = self.sizes(problem, source, load - rest), self.observed(problem.u_alpha)
        return StageData(problem, source, load, rest, inside, sizes, observed, J)

    def learned(self, problem: StageProblem, q: Array, J: Any = None) -> Array:
        """Return the left side of (est_exact_q), (noisy_q) over the gain, G_Q (q_t + sigma q)/gain.

        Of unknowns that move by themselves less G_Q K (q - prior)/gain, and with the information
        J (q - c_q). A dual vector, shape (m,).
        """
        metric, latent = problem.metric, self.forms.model.latent
        change = q - problem.c[self.n :]
        rate = change / problem.h + metric.sigma * (q - latent.origin)
        if self.moves:
            rate = rate - latent.generator @ (q - latent.prior)
        learned: Array = metric.weight * self.dual(rate)
        return learned if J is None else learned + J @ change

    def dual(self, q: Array) -> Array:
        return self.forms.model.Q.dual(q) if self.auxiliary else self._small_gram @ q

    @cached_property
    def _small_gram(self) -> Any:
        return compact(self.gram)

    def sizes(
        self, problem: StageProblem, source: Array, load: Array
    ) -> tuple[float, float, float]:
        """Return `StageData.sizes`: scales of both residuals, and the norm of u_alpha."""
        # Where nothing moves, all terms of a line are rounding errors, and none is a scale.
        unchanged = np.square(problem.c) * self.diagonal
        least = math.sqrt(float(unchanged[: self.n].sum())) / problem.h
        least_q = math.sqrt(float(unchanged[self.n :].sum())) * problem.metric.scale(problem.h)
        (own,) = self.duals([source], self.parts[0])
        (other,) = self.duals([load], self.parts[1])
        known = math.sqrt(float(self.lumped @ np.square(problem.u_alpha)))
        return max(own, RESTING * least), max(other, RESTING * least_q), known

    def observed(self, u_alpha: Array) -> Callable[[], Residual]:
        """Return a function that computes the norms of u_alpha when it is called first."""

        @cache
        def norms() -> Residual:
            return self.norms(u_alpha, self.pull @ u_alpha, self.observed_mass @ u_alpha)

        return norms

    def norms(
        self, r: Array, Mr: Array, mass_r: Array, observed: Callable[[], Residual] | None = None
    ) -> Residual:
        """Return the norms of r that a damping rule may use."""
        tests = self.forms.tests

        def V() -> float:
            return float(Mr @ tests.riesz(Mr))

        return Residual(float(r @ mass_r), float(r @ Mr), V, observed)

    def damped(self, data: StageData, norms: Residual) -> float:
        """Return the theta of the rule, with a bound that keeps the stage solvable.

        A rule with a pull that does not vanish with r has no bound of its own while u_alpha is
        zero, or tiny.
        """
        return min(self.damping.theta(norms), STIFFEST / data.problem.h)

    def bracket(self, data: StageData) -> tuple[float, float]:
        """Return two ends between which the theta of a solved stage lies."""
        h = data.problem.h
        return 1.0 / (STIFFEST * h), min(self.damping.most(data.observed()), STIFFEST / h)

    def slope(self, data: StageData, at: StageIterate) -> Array | None:
        """Return the derivative of theta in u, shape (n,); None if it is zero."""
        if data.problem.metric.theta is not None or at.theta >= STIFFEST / data.problem.h:
            return None
        # Chain rule: the squared norms of r in X, VX~ and V~ have the derivatives 2 R^T M r, 2 R^T
        # M_op r and 2 M_op^T times the representative of M_op r.
        dX, dVX, dV = self.damping.slopes(at.norms)
        row = (2.0 * dX) * at.mass_r + (2.0 * dVX) * at.Mr
        if dV:
            row = row + self.forms.pull.T @ ((2.0 * dV) * self.forms.tests.riesz(at.Mr))
        return row if row.any() else None

    def limited(self, data: StageData, at: StageIterate, allowed: float) -> bool:
        """Return true if the residual of each line is as small as allowed or as its rounding error.

        Line by line: one that is small beside the rounding errors of the other is not solved.
        """
        left = (at.residual[part] for part in self.parts)
        own = [self.duals([line], part)[0] for line, part in zip(left, self.parts, strict=True)]
        sizes = zip(own, at.scales, self.rounding(data, at), strict=True)
        return all(line <= max(allowed * scale, rounding) for line, scale, rounding in sizes)

    def rounding(self, data: StageData, at: StageIterate) -> tuple[float, float]:
        """Return bounds of the rounding errors of both lines at a point, in dual norms."""
        forms, model, n = self.forms, self.forms.model, self.n
        u, q = np.abs(at.y[:n]), np.abs(at.y[n:])
        problem, moment = data.problem, data.problem.moment
        c, v = np.abs(problem.c), np.abs(at.w) + np.abs(problem.u_alpha)
        w, own = {"u": at.w}, {"u": at.y[:n]}
        # Row by row the sum of the sizes of all terms; differences count with both operands.
        A = abs(forms.A_in.matrix("v", "q", moment, q=at.y[n:], **w))
        first = abs(model.mass) @ ((u + c[:n]) / problem.h) + A @ q + np.abs(data.source)
        first += abs(forms.B_in.matrix("v", "u", moment, **w)) @ np.abs(at.w)
        first += at.theta * (abs(forms.pull) @ (u + v)) + abs(forms.hidden) @ u
        if forms.A_out is not None and forms.B_out is not None:
            first += abs(forms.A_out.matrix("v", "q", moment, q=at.y[n:], **own)) @ q
            first += abs(forms.B_out.matrix("v", "u", moment, **own)) @ u
        gram = abs(self.gram)[: len(q), : len(q)]
        second = problem.metric.scale(problem.h) * (gram @ (q + c[n:]))
        second += A.T @ (forms.split.R @ (u + v))
        (state,) = self.duals([first], self.parts[0])
        (other,) = self.duals([second], self.parts[1])
        return ROUNDING * state, ROUNDING * other


class StageSolver(ABC):
    """Abstract solver of coupled stages: evaluates their equation and factorises its Jacobian."""

    keeps: bool  # whether a factor is worth keeping from stage to stage
    patience: int  # updates, beyond one for each stage, after which a kept factor is made again
    refresh = 0.2  # share of the residual that an update by a kept factor may leave
    ceiling = 0.0  # relative residual up to which a predicted stage is not solved further
    carried = CARRIED  # relative accuracy of r where the next stage makes up for the residual

    def __init__(self, terms: StageTerms) -> None:
        self.terms = terms

    @abstractmethod
    def factor(self, data: StageData, at: StageIterate) -> Factor:
        """Return the factorised Jacobian at a point."""

    def kept(self, factor: Factor) -> Factor:
        """Return the part of a factor that is kept for later stages."""
        return factor

    @abstractmethod
    def prepare(self) -> None:
        """Compute the parts that do not depend on the samples."""

    def data(self, problem: StageProblem, w: Array | None = None) -> StageData:
        """Return a stage, with the terms that do not depend on its solution."""
        forms, moment, inside = self.terms.forms, problem.moment, None
        if forms.W is None and self.terms.linear:
            w = forms.model.impose(problem.u_alpha, moment) if w is None else w
            inside = self.inside(moment, w)
        return self.terms.given(problem, self.source(moment), inside)

    def evaluate(self, data: StageData, y: Array) -> StageIterate:
        """Return the stage at y = (u, q): (est_exact_u), (est_exact_q), or (noisy_u), (noisy_q).

        These are the only lines that state the method. How A, B and F are computed is the matter of
        `inside`, `outside` and `source`.
        """
        terms, forms, stage, n = self.terms, self.terms.forms, data.problem, self.terms.n
        u, q = y[:n], y[n:]
        r = forms.split.project(u) - stage.u_alpha
        w = forms.argument(u, r)
        inside = data.inside or self.inside(stage.moment, w, q)
        A, B = inside.A, inside.B
        Aq = A @ q if terms.linear else forms.A_in.vector("v", stage.moment, u=w, q=q)
        if forms.A_out is not None:
            more, flux = self.outside(stage.moment, u, q)
            Aq, B = Aq + more, B + flux
        if forms.nu:
            B = B + forms.hidden @ u
        Mr, mass_r = terms.pull @ r, terms.observed_mass @ r
        norms = terms.norms(r, Mr, mass_r, data.observed)
        theta = stage.metric.theta
        theta = terms.damped(data, norms) if theta is None else theta

        u_t = terms.mass @ ((u - stage.c[:n]) / stage.h)
        pull, coupling = theta * Mr, inside.transposed @ r
        learned = terms.learned(stage, q, data.J)
        residual = np.empty_like(y)
        # u' + A(w) q + B(w) + theta R^T M r + nu P^T N P u = f, and (q' + sigma q)/gain = A(w)* r;
        # rows of fixed coefficients are zero.
        residual[:n] = (u_t + Aq + B + pull - data.source) * terms.free
        residual[n:] = (learned - coupling - data.load) * terms.free_q

        first, second = [residual[:n], u_t, Aq, pull], [residual[n:], learned - data.rest, coupling]
        accuracy = RESOLVED if stage.left is None else self.carried
        size, resolved, scales = terms.measured(data, first, second, norms.X, theta, accuracy)
        return StageIterate(y, residual, size, resolved, scales, w, r, A, theta, norms, Mr, mass_r)

    def source(self, moment: Moment) -> Array:
        """Return F, less a constant part of B, shape (n,)."""
        return self.terms.forms.model.F(moment)

    def inside(self, moment: Moment, w: Array, q: Array | None = None) -> Inside:
        """Return A(w) and B(w) over omega; q where A is not linear in it."""
        forms = self.terms.forms
        A = forms.A_in.matrix("v", "q", moment, **({"u": w} if q is None else {"u": w, "q": q}))
        return Inside(A, A.T, forms.B_in.vector("v", moment, u=w))

    def outside(self, moment: Moment, u: Array, q: Array) -> tuple[Array, Array]:
        """Return A(u) q and B(u) outside omega, shape (n,)."""
        forms = self.terms.forms
        if forms.A_out is None or forms.B_out is None:
            return np.zeros_like(u), np.zeros_like(u)
        driven = forms.A_out.vector("v", moment, u=u, q=q)
        return driven, forms.B_out.vector("v", moment, u=u)
