"""The nonlinear equation of one coupled stage: residual, scales and stopping criterion.

With w = u_alpha + P u, r = R u - u_alpha, u_t = (u - c_u)/h and q_t = (q - c_q)/h, the unknowns
y = (u, q) of one implicit Euler stage of (est_exact_q), (est_exact_u), or (noisy_q), (noisy_u),
solve

    M u_t + B(w) + A(w) q + theta R^T M_op r + nu P^T N_op P u = F
    G_Q (q_t + sigma q)/gain                                   = A(w)^T r

as one system, so that with full data the two terms with A cancel in the energy, as in the paper
(align:neplusnr). Over omega, w is the data; elsewhere it is the estimate. `StageSolver.evaluate`
computes both equations, and `Metric` lists further terms of the second equation.
Both right-hand sides subtract the residual of the previous stage, times the ratio of its step to
the current step. So the residuals of consecutive stages do not accumulate.

theta depends on all of r: its derivative is a rank-one term of the Jacobian. If A is nonlinear in
q, A(w) in the second equation is the derivative in q.

*Forms.* The paper splits u into R u = chi_omega u and P u = chi_(Omega without omega) u. Both jump
at the boundary of omega, which a function in a finite-element space cannot. Therefore the integrals
are split, not the coefficients: the forms use w = u_alpha + P u over omega, and the estimate u
outside omega. If coefficients were selected, P u would fall to zero over one element, with a
gradient of size u over the element size: M and N of (MN1), (MN2) would diverge with the mesh.

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
FLOOR = 1e-6  # norm of r, relative to ||u_alpha||, below which r counts as zero
RESOLVED = 1e-3  # relative accuracy of r above the floor
CARRIED = 1e-2  # relative accuracy of r if the next stage corrects the residual of this one
STIFFEST = 1e12  # largest theta h: one step then reduces r by about this factor
RESTING = 1e-6  # least change of u and q in a step, relative to them, that scales a residual
OWED = 0.1  # weight of the residual of the second equation if the next step corrects it
ROUNDING = 4e-16  # rounding error of a row, relative to the sum of the sizes of its terms


@dataclass(frozen=True, eq=False)
class StageForms:
    """Forms and matrices of a stage for one set of sensors; they do not depend on the step."""

    # The process, and the split of its state into an observed and a hidden part.
    model: Model
    split: Split
    # Integrands (u, v, x) of M and N, integrated as in (MN1), (MN2); M_op None: the mass form.
    M_op: Any
    N_op: Any
    nu: float  # weight of N

    @cached_property
    def _outside(self) -> IntArray | None:
        """The elements outside omega; None without omega."""
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
        """A outside omega; None without omega."""
        return None if self._outside is None else self.model.form_A.on(self._outside)

    @cached_property
    def B_out(self) -> AnyForm | None:
        """B outside omega; None without omega."""
        return None if self._outside is None else self.model.form_B.on(self._outside)

    def argument(self, u: Array, r: Array) -> Array:
        """Return w = u_alpha + P u = u - r, the argument of A and B over omega."""
        return u - r

    @cached_property
    def W(self) -> sp.csr_array | None:
        """dw/du over omega, shape (n, n); None if the data determine w over omega."""
        n = self.model.X.dim
        estimated = sp.csr_array(self.split.P @ sp.diags_array(self.model.X.free))
        if self.split.omega is not None:
            # w is needed only for the coefficients that the forms over omega use.
            touched = np.zeros(n)
            touched[self.B_in.pattern("v", "u").indices] = 1.0
            touched[self.A_in.pattern("v", "u").indices] = 1.0
            estimated = sp.csr_array(sp.diags_array(touched) @ estimated)
        estimated.eliminate_zeros()
        return self.split.P if estimated.nnz else None

    @cached_property
    def mass(self) -> sp.csr_array:
        """Matrix R^T M R of ||r||_X^2 = r^T mass r, integrated over omega."""
        form = self._inside(self.model.form_M)
        return self._observed(form.matrix("v", "u"))

    @cached_property
    def pull(self) -> sp.csr_array:
        """Matrix R^T M_op R, integrated over omega (MN1)."""
        if self.M_op is None:
            return self.mass
        return self._observed(self.model.bilinear(self.M_op, self.split.omega))

    @cached_property
    def hidden(self) -> sp.csr_array:
        """Sum of nu P^T N_op P over omega and nu N_op outside omega (MN2), shape (n, n)."""
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
        """Test functions of ||r||_V~: the functions of X with support in omega."""
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
    """Weights of the second equation of a stage, an equation of dual vectors of Q.

        weight G_Q (q_t + sigma (q - q_0) - K (q - prior)) + J (q - c_q) = A(w)^T r + load

    with q_t = (q - c_q)/h, the Gram matrix G_Q, the generator K of the evolution of unknowns, and
    the origin q_0 (`Latent.origin`). If weight = 1/gain, J = 0 and load = 0, this is (noisy_q); if
    also sigma = 0, it is (est_exact_q).
    """

    weight: float  # 1/gain, >= 0
    sigma: float = 0.0  # stabilising term of (noisy_q), >= 0
    # Further terms of the right-hand side, shape (m,); None: zero.
    load: Array | None = None
    # Entries of J in the pattern `StageTerms.memory`; None: zero.
    information: Array | None = None
    # Weight of R^T M_op r in the stage; None: the damping rule determines it.
    theta: float | None = None

    def scale(self, h: float) -> float:
        """Return the coefficient of G_Q q in a stage with step h."""
        return self.weight * (1.0 / h + self.sigma)


@dataclass(frozen=True, eq=False)
class Inside:
    """Terms over omega: A(w) and its transpose, dense if small, and B(w), shape (n,)."""

    A: Any
    transposed: Any
    B: Array


@dataclass(frozen=True, eq=False)
class StageProblem:
    """Data that define one stage."""

    c: Array  # (c_u, c_q), shape (n + m,)
    # Step, and time and inputs at its end.
    h: float
    moment: Moment
    u_alpha: Array  # observed part of the state, shape (n,)
    metric: Metric  # weights of the second equation
    # Residual of the previous stage that this stage corrects, a dual vector of shape (n + m,);
    # None: residuals are not carried over.
    left: Array | None = None


@dataclass(frozen=True, eq=False)
class StageData:
    """A stage with the quantities that do not depend on its iterate."""

    problem: StageProblem  # definition of the stage
    # F and the load, less the residual of the previous stage, shapes (n,) and (m,).
    source: Array
    load: Array
    rest: Array  # left-hand side of the second equation for a constant q, shape (m,)
    inside: Inside | None  # A and B over omega; None if they depend on the iterate
    # Least scales of the residuals of both equations, and ||u_alpha||_X. The scales are the dual
    # norms of F and of the load less `rest`, or of changes by `RESTING` of c if these are larger.
    sizes: tuple[float, float, float]
    # Function that returns the squared norms of u_alpha, with a cached result.
    observed: Callable[[], Residual]
    J: Any = None  # information matrix of the metric, shape (m, m); None: zero


@dataclass(frozen=True, eq=False)
class StageIterate:
    """The stage at a point y = (u, q)."""

    # The iterate and its residual, shape (n + m,).
    y: Array
    residual: Array
    # See `livepde.stepping.newton.StagePoint`.
    size: float
    resolved: bool
    scales: tuple[float, float]  # dual norms of the largest terms of the two equations
    # Argument of A and B over omega, and the residual of the data, shape (n,).
    w: Array
    r: Array
    A_in: Any  # A(w) over omega, shape (n, m)
    theta: float  # weight of R^T M_op r
    norms: Residual  # squared norms of r
    # R^T M_op r and R^T M r over omega, shape (n,).
    Mr: Array
    mass_r: Array


class StageTerms:
    """Terms and norms of a stage that all solvers share.

    `memory` is the pattern of `Metric.information`; None: the metric has no information matrix.
    """

    def __init__(self, forms: StageForms, damping: Damping, memory: Pattern | None = None) -> None:
        model = forms.model
        self.forms, self.damping, self.memory = forms, damping, memory
        self.n, self.size = model.X.dim, model.X.dim + model.Q.dim
        self.parts = slice(0, self.n), slice(self.n, self.size)  # of u and q in y
        # 1 for free and 0 for fixed coefficients of the state, (n,), and the parameter, (m,).
        self.free, self.free_q = model.X.free, model.Q.free
        # G_Q; if G_Q is dense, a sparse matrix with auxiliary unknowns after q, of which G_Q is the
        # Schur complement.
        self.gram: sp.csr_array = model.Q.augmented
        self.auxiliary = self.gram.shape[0] - model.Q.dim
        self.linear = model.form_A.linear_in_parameter  # whether A is linear in q
        self.moves = bool(model.latent.generator.nnz)  # whether an unknown has an evolution
        self.observes = bool(forms.split.present.any())  # whether a sensor is present
        # M, R^T M_op R and R^T M R over omega; dense if small.
        self.mass, self.pull = compact(model.mass), compact(forms.pull)
        self.observed_mass = compact(forms.mass)
        # Diagonal of M: its norm is equivalent to the norm of X.
        self.lumped: Array = np.abs(model.mass.diagonal())
        self.dual_weights = self._dual_weights()
        weights = self.dual_weights
        # Diagonals of M and G_Q on the free coefficients, shape (n + m,).
        self.diagonal = np.divide(1.0, weights, out=np.zeros_like(weights), where=weights > 0.0)

    def _dual_weights(self) -> Array:
        """Return weights of squared dual norms, (n + m,): the inverse diagonals of M and G_Q.

        For functionals of one kind, such as a residual and its terms, the ratio of the weighted
        norms approximates the ratio of the dual norms. For rough residuals it is larger.
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
        norms: list[float] = np.sqrt(squares).tolist()
        return norms

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
            # With the metric of the information, the next step corrects the residuals of this one.
            return max(own, OWED * own_q), True, scales
        # S >= M (1/h + theta) on the observed part: the residual bounds the error of u.
        least = 1.0 / data.problem.h + theta
        r = math.sqrt(max(X, 0.0)) + FLOOR * data.sizes[2]
        return max(own, own_q), state <= accuracy * r * least or not self.observes, scales

    def given(self, problem: StageProblem, source: Array, inside: Inside | None) -> StageData:
        """Return the data of a stage, from F and from A and B over omega if they are known."""
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
        """Return the left-hand side of (est_exact_q) or (noisy_q), G_Q (q_t + sigma q)/gain.

        An evolution of the unknowns adds -G_Q K (q - prior)/gain, and an information matrix adds
        J (q - c_q). The result is a dual vector of shape (m,).
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
        # At rest all terms of an equation are rounding errors, which cannot serve as a scale.
        unchanged = np.square(problem.c) * self.diagonal
        least = math.sqrt(float(unchanged[: self.n].sum())) / problem.h
        least_q = math.sqrt(float(unchanged[self.n :].sum())) * problem.metric.scale(problem.h)
        (own,) = self.duals([source], self.parts[0])
        (other,) = self.duals([load], self.parts[1])
        known = math.sqrt(float(self.lumped @ np.square(problem.u_alpha)))
        return max(own, RESTING * least), max(other, RESTING * least_q), known

    def observed(self, u_alpha: Array) -> Callable[[], Residual]:
        """Return a function that computes the norms of u_alpha at its first call."""

        @cache
        def norms() -> Residual:
            return self.norms(u_alpha, self.pull @ u_alpha, self.observed_mass @ u_alpha)

        return norms

    def norms(
        self, r: Array, Mr: Array, mass_r: Array, observed: Callable[[], Residual] | None = None
    ) -> Residual:
        """Return the norms of r for a damping rule."""
        tests = self.forms.tests

        def V() -> float:
            return float(Mr @ tests.riesz(Mr))

        return Residual(float(r @ mass_r), float(r @ Mr), V, observed)

    def damped(self, data: StageData, norms: Residual) -> float:
        """Return theta by the damping rule, with an upper bound that keeps the stage solvable.

        A rule whose pull does not vanish with r is unbounded if u_alpha is zero or tiny.
        """
        return min(self.damping.theta(norms), STIFFEST / data.problem.h)

    def bracket(self, data: StageData) -> tuple[float, float]:
        """Return lower and upper bounds for the theta of a solved stage."""
        h = data.problem.h
        return 1.0 / (STIFFEST * h), min(self.damping.most(data.observed()), STIFFEST / h)

    def slope(self, data: StageData, at: StageIterate) -> Array | None:
        """Return the derivative of theta in u, shape (n,); None if it is zero."""
        if data.problem.metric.theta is not None or at.theta >= STIFFEST / data.problem.h:
            return None
        # Chain rule: the squared norms of r in X, VX~ and V~ have the derivatives 2 R^T M r,
        # 2 R^T M_op r and 2 M_op^T times the Riesz representative of M_op r.
        dX, dVX, dV = self.damping.slopes(at.norms)
        row = (2.0 * dX) * at.mass_r + (2.0 * dVX) * at.Mr
        if dV:
            row = row + self.forms.pull.T @ ((2.0 * dV) * self.forms.tests.riesz(at.Mr))
        return row if row.any() else None

    def limited(self, data: StageData, at: StageIterate, allowed: float) -> bool:
        """Return True if the residual of each equation is within `allowed` or its rounding error.

        The bounds are separate: a large rounding error in one must not relax the other.
        """
        left = (at.residual[part] for part in self.parts)
        own = [self.duals([line], part)[0] for line, part in zip(left, self.parts, strict=True)]
        sizes = zip(own, at.scales, self.rounding(data, at), strict=True)
        return all(line <= max(allowed * scale, rounding) for line, scale, rounding in sizes)

    def rounding(self, data: StageData, at: StageIterate) -> tuple[float, float]:
        """Return bounds for the rounding errors of both equations at a point, in dual norms."""
        forms, model, n = self.forms, self.forms.model, self.n
        u, q = np.abs(at.y[:n]), np.abs(at.y[n:])
        problem, moment = data.problem, data.problem.moment
        c, v = np.abs(problem.c), np.abs(at.w) + np.abs(problem.u_alpha)
        w, own = {"u": at.w}, {"u": at.y[:n]}
        # Sum of the sizes of all terms of each row; a difference counts with both operands.
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

    keeps: bool  # whether a factor is reused in later stages
    patience: int  # updates, beyond one for each stage, after which a cached factor is recomputed
    refresh = 0.2  # largest contraction factor of the residual by a cached factor
    ceiling = 0.0  # accepted relative residual of a predicted stage
    carried = CARRIED  # relative accuracy of r if the next stage corrects the residual

    def __init__(self, terms: StageTerms) -> None:
        self.terms = terms

    @abstractmethod
    def factor(self, data: StageData, at: StageIterate) -> Factor:
        """Return the factorised Jacobian at a point."""

    def kept(self, factor: Factor) -> Factor:
        """Return the part of a factor that is cached for later stages."""
        return factor

    @abstractmethod
    def prepare(self) -> None:
        """Compute the quantities that do not depend on the samples."""

    def data(self, problem: StageProblem, w: Array | None = None) -> StageData:
        """Return a stage with the quantities that do not depend on its iterate.

        `w`: argument of A and B over omega if the data determine it; None: from u_alpha.
        """
        forms, moment, inside = self.terms.forms, problem.moment, None
        if forms.W is None and self.terms.linear:
            w = forms.model.impose(problem.u_alpha, moment) if w is None else w
            inside = self.inside(moment, w)
        return self.terms.given(problem, self.source(moment), inside)

    def evaluate(self, data: StageData, y: Array) -> StageIterate:
        """Return the stage at y = (u, q): (est_exact_u), (est_exact_q), or (noisy_u), (noisy_q).

        Only this function defines the method; `inside`, `outside` and `source` compute A, B and F.
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
        # u' + A(w) q + B(w) + theta R^T M r + nu P^T N P u = f, and (q' + sigma q)/gain = A(w)* r.
        # Rows of fixed coefficients are zero.
        residual[:n] = (u_t + Aq + B + pull - data.source) * terms.free
        residual[n:] = (learned - coupling - data.load) * terms.free_q

        first, second = [residual[:n], u_t, Aq, pull], [residual[n:], learned - data.rest, coupling]
        accuracy = RESOLVED if stage.left is None else self.carried
        size, resolved, scales = terms.measured(data, first, second, norms.X, theta, accuracy)
        return StageIterate(y, residual, size, resolved, scales, w, r, A, theta, norms, Mr, mass_r)

    def source(self, moment: Moment) -> Array:
        """Return F, shape (n,); a subclass may subtract the constant part of B."""
        return self.terms.forms.model.F(moment)

    def inside(self, moment: Moment, w: Array, q: Array | None = None) -> Inside:
        """Return A(w) and B(w) over omega; `q` is required if A is nonlinear in q."""
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
