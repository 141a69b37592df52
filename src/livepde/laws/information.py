"""The metric of Q for the update of q: a constant gain, or the information in the data.

A rule returns the `Metric` of the second equation for each stage, and updates its statistics after
each sample. `GradientLaw(gain="auto")` uses the metric of the information.

On the observed part, a parameter q has the equation error

    eps(q) = M u_alpha' + B(w) + A(w) q - F,        eps(q) - eps(q*) = A(w) (q - q*).

Let eps(q*) be noise, white in time, with spectral density S D in X*, and q - q0 ~ N(0, G_Q^{-1})
the prior (G_Q is divided by the square of `std`). Then the best q given all data so far minimises

    S ||q - q0||_Q^2 + int ||R^T eps(q)||^2_{D^{-1}} dt.

Recursive least squares compute this minimum: they are the second equation of the method in the
metric of the information, H = S G_Q + J instead of G_Q/gain. J is the integral of
A^T R D^{-1} R^T A over time. With M_op = M and theta = PULL/h, r is about -h M^{-1} eps/PULL, and
depends on the current step alone. The stage solves

    H (q - c)/PULL = A(w)^T r + (b - J c - S G_Q (c - q0))/PULL

where c is q before the step. The normal equations J q = b of the data so far are exact: r gives the
equation error eps of a step, y = A q - eps is the value of A q according to the data, and

    J <- J + h A^T R D^{-1} R^T A,        b <- b + h A^T R D^{-1} R^T y.

So a step need not be exact: its residual is part of b - J c - S G_Q (c - q0), and the next step
corrects it. The drive A^T r alone would not: q and J disagree on rough functions by the ratio of D
to M, and q would jump when S decreases.

S is the power of the remaining equation error, measured by its effect on q,

    power(eps) = mean of h ||A^T D^{-1} eps||_{Q*}^2 / mean of trace(G_Q^{-1} A^T R D^{-1} R^T A),
    S          = (power(eps_k) power(eps_k - eps_{k-1})/2)^{1/2}.

For white noise both powers equal S. The slower a persistent error changes, the less it contributes.
Errors of mesh, time step, smoothing and P u slow the update of q like noise; an error of q has
little effect. A second S has the diagonal of G_Q instead of G_Q, and the larger S is used. The
first S measures the error against smooth functions. The second S measures it against rough
functions, where derivatives of noisy data are far larger. The means weight a sample at time t by
t^FORGETS. The first sample does not change q: it only initialises S.

J and b have two kinds of rows with different forgetting. Rows of tests within omega depend on the
data alone, and have a weight by the information up to the sample. Other rows contain fluxes of P u,
which is wrong at first, and have the weight t^4. Since P u keeps an error that the data do not
determine, S is at least a small share of the J of these rows.

H is updated when S or the trace of J has changed by more than `AGED`, or J along the last step has
grown by more than `STEEPER`. Between updates a step is a quasi-Newton step with cached factors.

All constants are dimensionless, and depend neither on the mesh nor on the sampling interval.

Under these assumptions ||q - q0||_Q^2 is a sum of chi-squares with weights of at most 1. The sum k
of the weights is at most m and at most trace(G_Q^{-1} J)/S, J without forgetting. The norm exceeds
k + 2 sqrt(k s) + 2 s with a probability below exp(-s) (Laurent and Massart 2000). Beyond this
bound the step holds q and reports "departed"; J, b and S are updated as usual. S does not contain a
bias that q absorbs, such as the bias of too strong smoothing (`livepde.laws.observed_part`).

If sensors select coefficients, a diagonal D >= M (Gershgorin; the lumped mass for P1) makes
A^T R D^{-1} R^T A as sparse as A^T A. Otherwise the rows belong to a basis of N(G)^perp, D is M,
and the matrix is dense.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, eigsh

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.coupled.equation import Metric, StageForms
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, Memo, Pattern
from livepde.model import Model
from livepde.spaces import HilbertSpace

HOLD = 1e12  # factor by which a constant gain is reduced to hold q

MetricStep = Callable[[float], Metric]
"""Function from the step h of a stage to its metric."""
PULL = 10.0  # theta h: r decays within a step
HELD = 1e6  # weight of the prior that holds q, relative to the information of a sample
LEADING, DRAWS = 4, 4  # modes and draws of the prior for traces, accurate to a few per cent
LANCZOS = 20  # steps for the square root of G_Q^{-1}, for traces accurate to 1 %
COARSE = 1e-3  # relative accuracy of the leading modes
ROUNDING = 1e-12  # relative size below which a Lanczos vector is zero
FORGETS = 2.0  # exponent of time in the weight of a sample in the means of S
FADES = np.array([1.0, 4.0])  # exponents of information and of time that weight the row kinds
AGED = 2.0  # relative change of S, or of the trace of J, that requires a new H
STEEPER = 0.5  # growth of J along a step that requires a new H; at 1 steps would oscillate
MOST_NORMAL = 8  # capacity of the cache of normal equations, by sets of sensors
MOST_DENSE = 4000  # largest dimension of a dense J
CHANCE = 1e-6  # probability that q exceeds its bound although the model is right
RESOLUTION = np.array([1e9, 1e5])  # largest ratio of information to prior, by kind of row


@dataclass(frozen=True)
class NoState:
    """Empty state of a rule without statistics."""


@dataclass(frozen=True, eq=False)
class StepBegin:
    """Data of a step that a rule needs before the step is computed."""

    # Parameter at the beginning, and w = u_alpha + P u with the data at the end.
    q: Array
    w: Array
    # Time and inputs at the end, and length of the step.
    moment: Moment
    length: float


@dataclass(frozen=True, eq=False)
class Transition:
    """Outcome of a step, from which a rule updates its statistics."""

    forms: StageForms  # forms of the stage
    # Parameter before clipping, and w = u_alpha + P u, at the end of the step.
    q: Array
    w: Array
    change: Array  # change of q in the step, shape (m,)
    # Function that returns the equation error of the data at the end of the step, shape (n,),
    # R^T eps = -theta R^T M_op r - R^T M r'.
    error: Callable[[], Array]
    # Time and inputs at the end, and length of the step.
    moment: Moment
    length: float


State = TypeVar("State")


class MetricRule(ABC, Generic[State]):
    """Abstract rule for the metric of Q."""

    @abstractmethod
    def init(self, q0: Array) -> State:
        """Return the state before the first sample."""

    @abstractmethod
    def step(self, state: State, forms: StageForms, begin: StepBegin) -> MetricStep:
        """Return the metric for the stages of a step."""

    @abstractmethod
    def frozen(self, state: State, forms: StageForms, begin: StepBegin) -> MetricStep:
        """Return the metric for the stages of a step in which q is held."""

    def learn(self, state: State, after: Transition) -> State:
        """Return the state after a step."""
        return state

    def doubt(self, state: State, q: Array) -> str:
        """Return the reason to reject an estimate; empty if it is plausible."""
        return ""

    def diagnostics(self, state: State, q: Array, length: float) -> Diagnostics[float]:
        """Return gain, information and departure after a step; NaN if the rule has none."""
        return Diagnostics()


@dataclass(frozen=True, eq=False)
class ConstantMetric(MetricRule[NoState]):
    """Constant metric G_Q/gain, with the stabilising term sigma q of (noisy_q)."""

    gain: float
    sigma: float

    def init(self, q0: Array) -> NoState:
        return NoState()

    def step(self, state: NoState, forms: StageForms, begin: StepBegin) -> MetricStep:
        return lambda _: Metric(1.0 / self.gain, self.sigma)

    def frozen(self, state: NoState, forms: StageForms, begin: StepBegin) -> MetricStep:
        return lambda _: Metric(HOLD / self.gain)


@dataclass(frozen=True, eq=False)
class Information:
    """Sums over the samples so far, and the quantities of the current metric H."""

    origin: Array  # q0, shape (m,)
    # For both kinds of rows: entries of J in its pattern, shape (2, entries), and b, shape (2, m).
    matrix: Array
    right: Array
    total: Array  # trace(G_Q^{-1} J) for both kinds of rows, shape (2,)
    given: float  # trace(G_Q^{-1} J) of all rows, without forgetting
    force: Array  # A^T D^{-1} eps of the last sample and its Riesz representative, shape (2, m)
    # Mean powers of the forces and half the mean powers of their changes, in both norms (smooth and
    # rough functions), shape (2, 2).
    power: Array
    seen: Array  # means of the traces in the denominator of S, in both norms, shape (2,)
    # Sum of the step lengths, and number of samples.
    elapsed: float
    samples: int
    # S, entries of J, and trace(G_Q^{-1} J) in the current H.
    spread: float
    held: Array
    weighed: float


def _diagonal(space: HilbertSpace) -> Array:
    """Return the diagonal of G, or its upper bound if G is a Schur complement; zeros become 1."""
    diagonal = space.augmented.diagonal()[: space.dim]
    return np.where(diagonal > 0.0, diagonal, 1.0)


def trace_probes(space: HilbertSpace) -> Array:
    """Return columns V, shape (m, k), with trace(V^T J V) close to trace(G^{-1} J) for every J.

    The columns are the leading modes of N(0, G^{-1}), which contain most of the trace, and fixed
    draws from the other modes. Each coefficient is scaled by the diagonal of G.
    """
    free, root = np.flatnonzero(space.free), np.sqrt(_diagonal(space))
    m, count = len(free), min(len(free), LEADING)

    def inverse(x: Array) -> Array:
        full = np.zeros(space.dim)
        full[free] = x
        # D^(1/2) G^-1 D^(1/2) with the diagonal D of G is dimensionless.
        return np.asarray((root * space.riesz(root * full))[free])

    if m <= LEADING + DRAWS:
        values, modes = np.linalg.eigh(np.stack([inverse(unit) for unit in np.eye(m)]))
    else:
        operator = LinearOperator((m, m), matvec=inverse, dtype=float)
        values, modes = eigsh(operator, k=count, v0=np.ones(m), tol=COARSE)
    columns = [modes * np.sqrt(values)]
    if m > LEADING + DRAWS:
        # Hutchinson's trace estimator: random signs, orthogonal to the modes.
        signs = 2.0 * np.random.default_rng(0).integers(0, 2, (DRAWS, m)) - 1.0
        rest = [sign - modes @ (modes.T @ sign) for sign in signs]
        columns += [_root(inverse, x, modes)[:, None] / math.sqrt(DRAWS) for x in rest]
    V = np.zeros((space.dim, sum(part.shape[1] for part in columns)))
    V[free] = np.hstack(columns) / root[free, None]
    return V


def _root(inverse: Callable[[Array], Array], x: Array, modes: Array) -> Array:
    """Return the square root of an operator times x, orthogonal to modes, by Lanczos' method."""
    size, basis, T = float(np.linalg.norm(x)), [], np.zeros((LANCZOS, LANCZOS))
    y = x / size
    for k in range(LANCZOS):
        basis.append(y)
        y = inverse(y)
        for _ in range(2):  # twice is enough against rounding
            y -= modes @ (modes.T @ y)
            parts = np.array(basis) @ y
            y -= parts @ np.array(basis)
            T[: k + 1, k] += parts
        left = float(np.linalg.norm(y))
        if left <= ROUNDING * T[0, 0]:
            break
        y /= left
    k = len(basis)
    # The root times x is about ||x|| V T^(1/2) e_1, with Lanczos basis V and tridiagonal matrix T.
    values, vectors = np.linalg.eigh(T[:k, :k], UPLO="U")
    powers = vectors @ (np.sqrt(np.maximum(values, 0.0)) * vectors[0])
    return np.asarray(size * (powers @ np.array(basis)))


def _pattern(model: Model, selects: bool) -> Pattern:
    """Return the pattern of J; raises `LawError` if J is dense and too large."""
    if selects:
        A = model.form_A.pattern("v", "q")
        ones = A.matrix(np.ones(A.nnz))
        # The pattern contains the diagonal also for coefficients without an entry of A^T A.
        return Pattern.of(sp.csr_array(ones.T @ ones + sp.eye_array(model.Q.dim)))
    if model.Q.dim > MOST_DENSE:
        raise LawError(
            "GradientLaw: gain='auto' keeps a dense matrix of all unknowns where sensors read no "
            f"coefficients; {model.Q.dim} are too many, up to {MOST_DENSE} are possible. Give a "
            "number for gain, observe a Subdomain, or use SensitivityLaw."
        )
    return Pattern.of(sp.csr_array(np.ones((model.Q.dim, model.Q.dim))))


class InformationMetric(MetricRule[Information]):
    """Metric H/PULL instead of G_Q/gain, with H = S G_Q + J.

    `model`: the process, with the prior of its unknowns. `selects`: True if sensors select
    coefficients, so that J is sparse. `pattern`: pattern of J.
    """

    def __init__(self, model: Model, selects: bool) -> None:
        self.model = model
        self.selects = selects
        self.pattern = _pattern(model, selects)
        self.probes = trace_probes(model.Q)
        self.diagonal = _diagonal(model.Q)
        every = np.arange(model.Q.dim)
        self.on_diagonal = self.pattern.positions(every, every)
        self._normal: Memo[bytes, SelectedRows | ProjectedRows] = Memo(MOST_NORMAL)

    def init(self, q0: Array) -> Information:
        J = np.zeros((2, self.pattern.nnz))
        return Information(
            origin=q0,
            matrix=J,
            right=np.zeros((2, len(q0))),
            total=np.zeros(2),
            given=0.0,
            force=np.zeros((2, len(q0))),
            power=np.zeros((2, 2)),
            seen=np.zeros(2),
            elapsed=0.0,
            samples=0,
            spread=0.0,
            held=J[0],
            weighed=0.0,
        )

    def step(self, state: Information, forms: StageForms, begin: StepBegin) -> MetricStep:
        if not state.samples:
            return self.frozen(state, forms, begin)
        J, held = self.pattern.compact(state.matrix.sum(axis=0)), state.held / PULL
        prior = state.spread * self.model.Q.dual(begin.q - state.origin)
        left = state.right.sum(axis=0) - J @ begin.q - prior
        load = left / (PULL * begin.length)
        weight = state.spread / PULL
        return lambda h: Metric(h * weight, 0.0, h * load, held, PULL / h)

    def frozen(self, state: Information, forms: StageForms, begin: StepBegin) -> MetricStep:
        A = forms.A_in.data("v", "q", begin.moment, u=begin.w, q=begin.q)
        trace = float(self.normal(forms).trace(A, self.probes).sum())
        spread = HELD * max(state.spread, begin.length * trace) or 1.0
        held, weight = state.held / PULL, spread / PULL
        return lambda h: Metric(h * weight, 0.0, None, held, PULL / h)

    def normal(self, forms: StageForms) -> SelectedRows | ProjectedRows:
        """Return the rows of the normal equations for the sensors of a stage, from a cache."""
        return self._normal.get(forms.split.present.tobytes(), lambda: self._rows(forms))

    def _rows(self, forms: StageForms) -> SelectedRows | ProjectedRows:
        X, Q, A = self.model.X, self.model.Q, forms.A_in.pattern("v", "q")
        if not self.selects:
            return ProjectedRows(A, forms.split.basis, forms.mass, X.free, Q.free)
        D = diagonal_bound(forms.mass)
        inverse = np.where(D > 0.0, X.free / np.where(D > 0.0, D, 1.0), 0.0)
        inner = inverse * forms.tests.free if forms.W is None else np.zeros_like(inverse)
        return SelectedRows(A, np.stack([inner, inverse - inner]), Q.free, self.pattern)

    def learn(self, state: Information, after: Transition) -> Information:
        Q, h = self.model.Q, after.length
        A = after.forms.A_in.data("v", "q", after.moment, u=after.w, q=after.q)
        gain = self.normal(after.forms).gain(A, after.q, after.error(), self.probes)
        rough = gain.matrix[:, self.on_diagonal] @ (1.0 / self.diagonal)
        seen = np.array([gain.trace.sum(), rough.sum()])
        if not state.samples and not np.all(seen > 0.0):
            return state  # the data do not depend on q yet: the next sample counts as the first
        force = np.stack([gain.force, Q.riesz(gain.force)])
        # The first sample has no predecessor: this factor makes both powers equal.
        change = force - state.force if state.samples else math.sqrt(2.0) * force
        power = np.stack([self._powers(force), self._powers(change) / 2.0])
        elapsed, information = state.elapsed + h, h * float(gain.trace.sum())
        given = state.given + information
        share = information / given if given > 0.0 else 0.0
        kept = max(0.0, 1.0 - FORGETS * h / elapsed)
        # Rows within omega are forgotten by information, rows with fluxes of P u by time.
        faded = np.maximum(0.0, 1.0 - FADES * np.array([share, h / elapsed]))
        matrix = h * gain.matrix
        for new, old, factor in zip(matrix, state.matrix, faded, strict=True):
            new += factor * old
        learned = replace(
            state,
            matrix=matrix,
            right=faded[:, None] * state.right + h * gain.right,
            total=faded * state.total + h * gain.trace,
            given=given,
            force=force,
            # One h is the weight of the sample in time, the other converts a squared force to a
            # spectral density.
            power=kept * state.power + h * h * power,
            seen=kept * state.seen + h * seen,
            elapsed=elapsed,
            samples=state.samples + 1,
        )
        return self._renewed(learned, after.change)

    def _powers(self, force: Array) -> Array:
        """Return the squared norms of a force, in Q* and by the diagonal of G_Q."""
        dual, primal = force
        return np.array([dual @ primal, dual @ (dual / self.diagonal)])

    def _renewed(self, state: Information, change: Array) -> Information:
        """Return the state, with a new H if the current H is outdated."""
        if not np.all(state.seen > 0.0):
            return state
        least = float((state.total / RESOLUTION).sum())
        powers = np.sqrt(np.maximum(state.power, 0.0).prod(axis=0)) / state.seen
        S, total = max(float(powers.max()), least), float(state.total.sum())
        J = state.matrix.sum(axis=0)
        old, most = (state.spread, state.weighed), 1.0 + AGED
        if all(new / most <= last <= new * most for new, last in zip((S, total), old, strict=True)):
            # J in the current H is compared with the latest J along the last step of q.
            prior = state.spread * float(change @ self.model.Q.dual(change))
            held, now = (self.pattern.compact(data) @ change @ change for data in (state.held, J))
            if prior + now <= (1.0 + STEEPER) * (prior + held):
                return state
        return replace(state, spread=S, held=J, weighed=total)

    def departure(self, state: Information, q: Array) -> float:
        """Return ||q - q0||_Q^2 over its critical value under the model, at the level `CHANCE`."""
        shift = q - state.origin
        # k of the module docstring: at most m, and at most trace(G_Q^-1 J)/S.
        k = float(self.model.Q.free.sum())
        if state.given < k * state.spread:
            k = state.given / state.spread
        s = -math.log(CHANCE)
        most = k + 2.0 * math.sqrt(k * s) + 2.0 * s
        return float(shift @ self.model.Q.dual(shift)) / most

    def doubt(self, state: Information, q: Array) -> str:
        ratio = self.departure(state, q) if state.samples else 0.0
        if not ratio > 1.0:
            return ""
        return (
            f"q was held: it would be {ratio:.1f} times as far from its prior (in square) as prior "
            "and data allow, so the model or the noise is not as the law must take it"
        )

    def diagnostics(self, state: Information, q: Array, length: float) -> Diagnostics[float]:
        spread = state.spread or 1.0
        return Diagnostics(
            gain=PULL / (spread * length),
            information=float(state.total.sum()) / spread,
            departure=self.departure(state, q),
        )


@dataclass(frozen=True, eq=False)
class Gain:
    """Contribution of one sample to the normal equations, per unit of time."""

    # For both kinds of rows: entries of A^T R D^{-1} R^T A in the pattern of J, (2, entries), and
    # A^T R D^{-1} R^T y with y = A q - eps, shape (2, m).
    matrix: Array
    right: Array
    force: Array  # A^T R D^{-1} R^T eps of all rows, shape (m,)
    trace: Array  # trace(G_Q^{-1} matrix), shape (2,)


class SelectedRows:
    """Normal equations for sensors that select coefficients: J is as sparse as A^T A.

    `pattern`: pattern of A, shape (n, m). `inverse`: diagonal of D^{-1} for each kind of rows, zero
    in the other rows, shape (2, n). `free`: 1 for free and 0 for fixed coefficients of q, shape
    (m,). `J`: pattern of J.
    """

    def __init__(self, pattern: Pattern, inverse: Array, free: Array, J: Pattern) -> None:
        self.pattern = pattern
        self.inverse = inverse
        self.free = free
        self.shape = (2, J.nnz)
        rows, cols = pattern.rows, pattern.indices
        whole = inverse.sum(axis=0)
        # Each pair of entries in a row of A is a term of J; terms above the diagonal are mirrored.
        entry = np.flatnonzero((whole[rows] > 0.0) & (free[cols] > 0.0))
        # All pairs of entries in a row: `left` repeats each entry by their number in its row, and
        # `right` enumerates the entries of the row.
        row = rows[entry]
        counts = np.bincount(row, minlength=pattern.shape[0])
        first = (np.cumsum(counts) - counts)[row]
        before = np.cumsum(counts[row]) - counts[row]
        rank = np.arange(counts[row].sum()) - np.repeat(before, counts[row])
        left = np.repeat(entry, counts[row])
        right = entry[np.repeat(first, counts[row]) + rank]
        upper = cols[left] <= cols[right]
        left, right = left[upper], right[upper]
        kind = (inverse[1] > 0.0)[rows[left]].astype(np.intp)
        at = J.positions(cols[left], cols[right]) + J.nnz * kind
        order = np.argsort(at, kind="stable")
        self.left, self.right = left[order].astype(np.intp), right[order].astype(np.intp)
        self.weights = whole[rows[self.left]]
        self.places, self.starts = np.unique(at[order], return_index=True)
        entries = self.places % J.nnz
        mirrored = J.positions(J.indices[entries], J.rows[entries])
        self.mirrored = mirrored + (self.places - entries)

    def _matrix(self, A: Array) -> Array:
        data = np.zeros(self.shape)
        if len(self.starts):
            # Terms are sorted by position in J, so that each entry of J is the sum of a segment.
            terms = A[self.left]
            terms *= A[self.right]
            terms *= self.weights
            flat, sums = data.ravel(), np.add.reduceat(terms, self.starts)
            flat[self.places] = sums
            flat[self.mirrored] = sums
        return data

    def gain(self, A: Array, q: Array, error: Array, probes: Array) -> Gain:
        matrix = self.pattern.compact(A)
        images = matrix @ np.column_stack([self.free * q, probes])
        y = images[:, 0] - error
        columns = np.column_stack([*(self.inverse * y), self.inverse.sum(axis=0) * error])
        products = (matrix.T @ columns).T * self.free
        trace = self.inverse @ np.square(images[:, 1:]).sum(axis=1)
        return Gain(self._matrix(A), products[:2], products[2], trace)

    def trace(self, A: Array, probes: Array) -> Array:
        images = self.pattern.compact(A) @ probes
        return np.asarray(self.inverse @ np.square(images).sum(axis=1))


class ProjectedRows:
    """Normal equations for other sensors: D = M, the rows belong to a basis V of N(G)^perp.

    J is dense, and all rows depend on the unobserved part.

    `pattern`: pattern of A, shape (n, m). `basis`: V, shape (n, k). `mass`: M, shape (n, n).
    `free`, `free_q`: 1 for free and 0 for fixed coefficients of u and q.
    """

    def __init__(
        self, pattern: Pattern, basis: Array, mass: sp.csr_array, free: Array, free_q: Array
    ) -> None:
        self.pattern = pattern
        values, vectors = np.linalg.eigh(basis.T @ (mass @ basis))
        # Columns V C with (V C)^T M (V C) = I, so that R M^{-1} R^T = (V C) (V C)^T.
        self.basis = free[:, None] * (basis @ (vectors / np.sqrt(values)))
        self.free = free_q

    def gain(self, A: Array, q: Array, error: Array, probes: Array) -> Gain:
        rows = (self.pattern.matrix(A).T @ self.basis).T * self.free
        eps = self.basis.T @ error
        matrix, right = (rows.T @ rows).ravel(), rows.T @ (rows @ q - eps)
        return Gain(
            np.stack([np.zeros_like(matrix), matrix]),
            np.stack([np.zeros_like(right), right]),
            rows.T @ eps,
            np.array([0.0, ((rows @ probes) ** 2).sum()]),
        )

    def trace(self, A: Array, probes: Array) -> Array:
        images = self.basis.T @ (self.pattern.matrix(A) @ probes)
        return np.array([0.0, (images**2).sum()])


def diagonal_bound(mass: sp.csr_array) -> Array:
    """Return a diagonal D >= M by Gershgorin's circles, after scaling M to a unit diagonal."""
    diagonal = mass.diagonal()
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scale = sp.diags_array(1.0 / root)
    rows = abs(scale @ mass @ scale).sum(axis=1)
    # diag(row sums) minus the scaled M is diagonally dominant, so it has no negative eigenvalue.
    return np.where(diagonal > 0.0, root**2 * np.maximum(rows, 1.0), 0.0)
