"""The norms and constants of the theory, for a discretised model (Assumption ass:equation)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, eigsh

from livepde.errors import ConfigurationError
from livepde.fem import START, Moment
from livepde.laws.bounds import Constants, Norms
from livepde.linalg import Array
from livepde.model import Model, h1_form
from livepde.observation import Observed, Split
from livepde.spaces import HilbertSpace

__all__ = ["Part", "Spaces", "constants"]

DENSE = 400  # eigenproblems up to this size are solved densely, larger ones by Lanczos
LARGEST_DENSE_BASIS = 2000  # unknowns, where R is not a selection
LARGEST_TRACE = 2e7  # m n^2 up to which the bound of A(v) is computed over all of Q
NONLINEAR = (
    "The constants are those of C(q, u) = A(u) q + B(u) (ass:equation). This model is not linear "
    "in what is estimated (a transform, or a form nonlinear in q): the paper's theory is silent."
)
Map = Callable[[Array], Array]


def _columns(apply: Map) -> Map:
    """Return a linear map of vectors that takes matrices, too."""

    def mapped(x: Array) -> Array:
        if x.ndim == 1:
            return apply(x)
        return np.column_stack([apply(column) for column in x.T])

    return mapped


def largest(top: Map, bottom: Map, bottom_inverse: Map | None, size: int) -> float:
    """Return the largest eigenvalue of top x = lambda bottom x, both symmetric, bottom > 0.

    Dense for small problems, else Lanczos from a fixed start (the same number in every run).

    Parameters
    ----------
    top, bottom, bottom_inverse
        Functions of vectors and of matrices; the inverse is needed for Lanczos alone.
    """
    if size == 0:
        return 0.0
    if size <= DENSE or bottom_inverse is None:
        one = np.eye(size)
        A, B = top(one), bottom(one)
        values = eigh(0.5 * (A + A.T), 0.5 * (B + B.T), eigvals_only=True)
        return max(float(values[-1]), 0.0)
    shape = (size, size)
    operators = [
        LinearOperator(shape, matvec=f, dtype=float) for f in (top, bottom, bottom_inverse)
    ]
    start = np.random.default_rng(0).standard_normal(size)
    found = eigsh(
        operators[0],
        k=1,
        M=operators[1],
        Minv=operators[2],
        v0=start,
        tol=1e-8,
        return_eigenvectors=False,
    )
    return max(float(found[0]), 0.0)


def _root(x: Array, y: Array) -> float:
    """Return the square root of a product that is negative by rounding at most."""
    return float(np.sqrt(max(float(x @ y), 0.0)))


class Part:
    """One part of the state, observed (range of R) or unobserved (of P), with its norms.

    ||v||_VX^2 = (M_op v, v) and ||v||_V = ||R^T M_op v|| in the dual of X, as in the damping rules,
    unless other forms are given; for M of (MN1) that is the paper's choice.

    Parameters
    ----------
    model
        The process.
    projection
        R, or P; shape (n, n).
    basis
        Of its range on the free coefficients, shape (n, k).
    rest
        Of the range of the other projection, shape (n, l).
    operator
        Matrix of M, or N, shape (n, n).
    VX, V
        Matrices of other norms, or None.
    """

    def __init__(
        self,
        model: Model,
        projection: sp.csr_array,
        basis: sp.csr_array,
        rest: sp.csr_array,
        operator: sp.csr_array,
        VX: sp.csr_array | None,
        V: sp.csr_array | None,
    ) -> None:
        self.model = model
        self.basis = basis
        self.rest = rest
        self.size = int(basis.shape[1])
        self._tested = sp.csr_array(projection.T @ operator)
        self._VX = operator if VX is None else VX
        self._V = V

    def norms(self, v: Array) -> Norms:
        """Return the three norms of an element of this part, coefficients of shape (n,)."""
        X = self.model.X
        if self._V is not None:
            return Norms(X.norm(v), _root(v, self._VX @ v), _root(v, self._V @ v))
        dual = self._tested @ v
        return Norms(X.norm(v), _root(v, self._VX @ v), _root(dual, X.riesz(dual)))

    def root_mean_square(self, factor: Array) -> Norms:
        """Return sqrt(E ||v||^2) in the three norms, for v of covariance factor @ factor.T."""
        X, mass = self.model.X, self.model.mass
        dual = self._tested @ factor
        V = X.riesz(dual) if self._V is None else self._V @ factor
        left = dual if self._V is None else factor
        pairs = ((factor, mass @ factor), (factor, self._VX @ factor), (left, V))
        return Norms(*(_root(np.ravel(a), np.ravel(b)) for a, b in pairs))

    # --- matrices on the basis -------------------------------------------------------------------

    def _on_basis(self, matrix: sp.csr_array) -> sp.csr_array:
        return sp.csr_array(self.basis.T @ matrix @ self.basis)

    @cached_property
    def gram_X(self) -> sp.csr_array:
        """(v, w)_X on the basis."""
        return self._on_basis(self.model.mass)

    @cached_property
    def gram_VX(self) -> sp.csr_array:
        """(v, w)_VX on the basis."""
        return self._on_basis(self._VX)

    @cached_property
    def operator(self) -> sp.csr_array:
        """The symmetric part of (M v, w)_X on the basis."""
        image = sp.csr_array(self.basis.T @ (self._tested @ self.basis))
        return sp.csr_array(0.5 * (image + image.T))

    def image(self, x: Array) -> Array:
        """Return the X-gram of M: x -> E^T M^T X^{-1} M E x."""
        dual = self._tested @ (self.basis @ x)
        result: Array = self.basis.T @ (self._tested.T @ self.model.X.riesz(dual))
        return result

    def gram_V(self, x: Array) -> Array:
        """Return (x, .)_V on the basis."""
        if self._V is not None:
            result: Array = self.basis.T @ (self._V @ (self.basis @ x))
            return result
        return self.image(x)

    @cached_property
    def schur(self) -> Map:
        """S with x^T S x = min over the other part w of ||E x + w||_X^2; S^{-1} = E^T X^{-1} E."""
        if not self.rest.shape[1]:
            return lambda x: self.gram_X @ x
        other = HilbertSpace(sp.csr_array(self.rest.T @ self.model.mass @ self.rest))
        mixed = sp.csr_array(self.rest.T @ self.model.mass @ self.basis)
        return lambda x: self.gram_X @ x - mixed.T @ other.riesz(mixed @ x)

    @cached_property
    def inverse_V(self) -> Map:
        """Inverse of `gram_V`."""
        if self._V is not None:
            return HilbertSpace(self._on_basis(self._V)).riesz
        own = HilbertSpace(self.operator)
        return lambda x: own.riesz(self.schur(own.riesz(x)))

    # --- constants -------------------------------------------------------------------------------

    def embedding_V_VX(self) -> float:
        """C with ||v||_VX <= C ||v||_V."""
        top = largest(lambda x: self.gram_VX @ x, self.gram_V, self.inverse_V, self.size)
        return float(np.sqrt(top))

    def embedding_VX_X(self) -> float:
        """C with ||v||_X <= C ||v||_VX."""
        return float(np.sqrt(self._sparse(self.gram_X, self.gram_VX)))

    def coercivity(self) -> float:
        """The c of (M v, v)_X >= c ||v||_VX^2; 1 if VX is the norm of M itself."""
        return 1.0 / self._sparse(self.gram_VX, self.operator) if self.size else 1.0

    def boundedness(self) -> float:
        """The C of ||R M v||_X <= C ||v||_V; 1 if V is the norm of M itself."""
        if not self.size:
            return 1.0
        return float(np.sqrt(largest(self.image, self.gram_V, self.inverse_V, self.size)))

    def lipschitz(self, jacobian: sp.csr_array) -> float:
        """Largest ||J v||_X / ||v||_V for the Jacobian J of C(q, .)."""

        def image(x: Array) -> Array:
            dual = jacobian @ (self.basis @ x)
            result: Array = self.basis.T @ (jacobian.T @ self.model.X.riesz(dual))
            return result

        return float(np.sqrt(largest(image, self.gram_V, self.inverse_V, self.size)))

    def ratio(self) -> float:
        """A bound of ||v||_V ||v||_X / ||v||_VX^2, 1/c_int of (interpol).

        By Kantorovich's inequality: with M x = lambda S x on this part the quotient is at most
        (a + b)/(2 sqrt(a b)) for the extreme lambdas a and b; the norm of X exceeds that of S by at
        most the factor of the mass that couples the two parts.
        """
        if not self.size:
            return 1.0
        own = HilbertSpace(self.operator)

        def inverse_schur(x: Array) -> Array:
            result: Array = self.basis.T @ self.model.X.riesz(self.basis @ x)
            return result

        top = largest(lambda x: self.operator @ x, self.schur, inverse_schur, self.size)
        least = 1.0 / largest(self.schur, lambda x: self.operator @ x, own.riesz, self.size)
        coupling = largest(lambda x: self.gram_X @ x, self.schur, inverse_schur, self.size)
        bound = np.sqrt(coupling) * (least + top) / (2.0 * np.sqrt(least * top))
        if self._V is not None:
            image_inverse = _columns(lambda x: own.riesz(self.schur(own.riesz(x))))
            bound *= np.sqrt(largest(self.gram_V, self.image, image_inverse, self.size))
        return float(bound / self.coercivity_reversed())

    def coercivity_reversed(self) -> float:
        """The least ||v||_VX^2 / (M v, v)_X."""
        return 1.0 / self._sparse(self.operator, self.gram_VX)

    def _sparse(self, top: sp.csr_array, bottom: sp.csr_array) -> float:
        inverse = HilbertSpace(bottom) if self.size else None
        return largest(
            lambda x: top @ x, lambda x: bottom @ x, inverse.riesz if inverse else None, self.size
        )


@dataclass(frozen=True, eq=False)
class Spaces:
    """The spaces V~, VX~ of the observed part and V^, VX^ of the unobserved one.

    Parameters
    ----------
    model, observed
        The process, and what is seen of it (`identifier.observed`).
    M_op, N_op
        Integrands (u, v, x) of M and N, (MN1) and (MN2), as the law has them.
    VX, V
        Integrands of other squared norms for both parts; default those of M and N themselves, for
        which c_M = C_M = c_N = C_N = 1.

    Examples
    --------
    >>> import livepde as lp
    >>> from skfem import ElementLineP2
    >>> mesh = lp.interval(0.0, 1.0, 8)
    >>> model = lp.Model(
    ...     lp.Field(mesh, ElementLineP2(), dirichlet={"boundary": 0.0}),
    ...     lp.Scalar(),
    ...     A=lambda q, u, v, x: q * u * v,
    ... )
    >>> full = lp.Full().bind(model.state_space, model.X, model.parameter_space)
    >>> round(Spaces(model, full).observed_part.embedding_VX_X(), 4)  # 1/sqrt(1 + pi^2)
    0.3033
    """

    model: Model
    observed: Observed
    M_op: Any = h1_form
    N_op: Any = h1_form
    VX: Any = None
    V: Any = None

    @classmethod
    def of(cls, model: Model, observed: Observed, law: Any) -> Spaces:
        """Return the spaces of a law's operators M_op and N_op."""
        forms = [getattr(law, name, None) for name in ("M_op", "N_op")]
        M, N = (h1_form if form is None else form for form in forms)
        return cls(model, observed, M, N)

    @cached_property
    def split(self) -> Split:
        """R, P and G^+ with all sensors present."""
        return self.observed.split()

    def _matrix(self, form: Any) -> sp.csr_array | None:
        if form is None:
            return None
        if sp.issparse(form):
            given: Any = form
            return sp.csr_array(given)
        return self.model.bilinear(form)

    @cached_property
    def bases(self) -> tuple[sp.csr_array, sp.csr_array]:
        """Bases of the ranges of R and P on the free coefficients."""
        X, R = self.model.X, self.split.R
        diagonal = R.diagonal()
        if abs(R - sp.diags_array(diagonal)).nnz == 0 and set(np.unique(diagonal)) <= {0.0, 1.0}:
            unit = sp.csr_array(sp.eye_array(X.dim))
            seen = diagonal == 1.0
            hidden = (diagonal == 0.0) & (X.free == 1.0)
            return sp.csr_array(unit[:, seen]), sp.csr_array(unit[:, hidden])
        if X.dim > LARGEST_DENSE_BASIS:
            raise ConfigurationError(
                f"Spaces: {X.dim} unknowns; for sensors other than a Subdomain the constants are "
                f"computed densely up to {LARGEST_DENSE_BASIS}. Take a coarser mesh: they belong "
                "to the problem and change little."
            )
        free = np.flatnonzero(X.free)
        left, sizes, _ = np.linalg.svd(R.toarray()[np.ix_(free, free)])
        rank = int((sizes > 1e-10).sum())
        # R is a projection: its range is spanned by `left`, that of I - R by its own singular ones.
        rest, rest_sizes, _ = np.linalg.svd((np.eye(X.dim) - R.toarray())[np.ix_(free, free)])
        hidden_rank = int((rest_sizes > 1e-10).sum())
        whole = np.zeros((X.dim, rank + hidden_rank))
        whole[free, :rank] = left[:, :rank]
        whole[free, rank:] = rest[:, :hidden_rank]
        return sp.csr_array(whole[:, :rank]), sp.csr_array(whole[:, rank:])

    @cached_property
    def observed_part(self) -> Part:
        """Range of R with V~ and VX~."""
        return self._part(self.split.R, self.bases, self.M_op)

    @cached_property
    def hidden_part(self) -> Part:
        """Range of P with V^ and VX^."""
        seen, hidden = self.bases
        return self._part(self.split.P, (hidden, seen), self.N_op)

    def _part(
        self, projection: sp.csr_array, bases: tuple[sp.csr_array, sp.csr_array], form: Any
    ) -> Part:
        operator = self._matrix(form)
        if operator is None:
            raise ConfigurationError("Spaces: M_op and N_op must be integrands (u, v, x).")
        free = sp.diags_array(self.model.X.free)
        tangent = sp.csr_array(projection @ free)
        VX, V = self._matrix(self.VX), self._matrix(self.V)
        return Part(self.model, tangent, *bases, operator, VX, V)


def constants(
    spaces: Spaces,
    q: Array,
    states: Sequence[Array],
    *,
    moment: Moment = START,
    gain: float = 1.0,
) -> Constants:
    """Return the constants of Assumption ass:equation for the discretised model.

    L_C (LipschitzC)
        Largest ||C'(q, u)(v + w)||_X / (||v||_V~ + ||w||_V^). That is the larger one of the two
        parts' own quotients, each an extreme generalised eigenvalue: exact for a C that is affine
        in u, else the largest over `states`, a value from sampling.
    C_A (AbdX), and with the embeddings (AbdV) and (AbdVV)
        The larger of max ||A(u)||_{Q -> X} over `states` (an eigenvalue for each) and
        K = sup ||A(v) q||_X / (||v||_X ||q||_Q). K is bounded by the largest eigenvalue of
        sum_i A(.)q_i over a Q-orthonormal basis; for A(u)q = qu that is the embedding constant of
        Q in L-infinity, the paper's choice. For large models it is found by alternating
        maximisation from random starts, a value from sampling.
    c_M, C_M, c_N, C_N
        Extreme eigenvalues of M and N in VX and V.
    embeddings, ratios
        See `Constants`; the ratios are Kantorovich's bounds.

    Parameters
    ----------
    spaces
        Norms.
    q
        Coefficients of the (physical) parameter at which C is taken, q* in a twin, shape (m,).
    states
        Coefficients of states along the run, at least one.
    gain
        That of the law: it divides the inner product of Q, so C_A grows with its square root.

    Raises
    ------
    ConfigurationError
        No state is given, or C is not linear in the (latent) parameter.
    """
    if not len(states):
        raise ConfigurationError("constants: give at least one state.")
    if not spaces.model.form_A.linear_in_parameter:
        raise ConfigurationError(NONLINEAR)
    q = spaces.model.latent.inverse(q)
    model, seen, hidden = spaces.model, spaces.observed_part, spaces.hidden_part
    sampled = []
    lipschitz = 0.0
    affine = model.affine
    for u in states[:1] if affine else states:
        jacobian = model.form_A.matrix("v", "u", moment, u=u, q=q)
        jacobian = sp.csr_array(jacobian + model.form_B.matrix("v", "u", moment, u=u))
        lipschitz = max(lipschitz, seen.lipschitz(jacobian), hidden.lipschitz(jacobian))
    if not affine:
        sampled.append("L_C")
    norms = [_norm_of_A(model, u, moment)[0] for u in states]
    bound, is_bound = _trilinear(model, states[0], moment)
    if not (is_bound and model.form_A.affine):
        sampled.append("C_A")
    embedded = {
        "observed_V_VX": seen.embedding_V_VX(),
        "observed_VX_X": seen.embedding_VX_X(),
        "hidden_V_VX": hidden.embedding_V_VX(),
        "hidden_VX_X": hidden.embedding_VX_X(),
    }
    reach = max(
        1.0,
        embedded["observed_V_VX"] * embedded["observed_VX_X"],
        embedded["hidden_V_VX"] * embedded["hidden_VX_X"],
    )
    return Constants(
        L_C=lipschitz,
        C_A=float(np.sqrt(gain)) * max(*norms, reach * bound),
        c_M=seen.coercivity(),
        C_M=seen.boundedness(),
        c_N=hidden.coercivity(),
        C_N=hidden.boundedness(),
        observed_ratio=seen.ratio(),
        hidden_ratio=hidden.ratio(),
        sampled=tuple(sampled),
        **embedded,
    )


def _norm_of_A(model: Model, u: Array, moment: Moment) -> tuple[float, Array]:
    """Return ||A(u)||_{Q -> X} and the q that attains it."""
    A, Q = model.A(u, moment), model.Q
    free = np.flatnonzero(Q.free)

    def image(x: Array) -> Array:
        full = np.zeros((Q.dim, *x.shape[1:]))
        full[free] = x
        result: Array = A.transposed(model.X.riesz(A(full)))[free]
        return result

    gram = Q.tangent_gram[free][:, free]
    if len(free) <= DENSE:
        values, vectors = eigh(image(np.eye(len(free))), gram.toarray())
    else:
        shape = (len(free), len(free))
        inverse = LinearOperator(shape, matvec=HilbertSpace(sp.csr_array(gram)).riesz, dtype=float)
        start = np.random.default_rng(0).standard_normal(len(free))
        operator = LinearOperator(shape, matvec=image, dtype=float)
        values, vectors = eigsh(operator, k=1, M=gram, Minv=inverse, v0=start)
    q = np.zeros(Q.dim)
    q[free] = vectors[:, -1]
    return float(np.sqrt(max(values[-1], 0.0))), q


def _trilinear(model: Model, u: Array, moment: Moment) -> tuple[float, bool]:
    """Return K of `constants`, and whether it is a bound (else it comes from sampling)."""
    n, free = model.X.dim, np.flatnonzero(model.X.free)
    free_q = np.flatnonzero(model.Q.free)

    def slope(q: Array) -> sp.csr_array:
        return model.form_A.matrix("v", "u", moment, u=u, q=q)

    mass = sp.csr_array(model.mass[free][:, free])
    if len(free_q) * n**2 <= LARGEST_TRACE:
        gram = model.Q.tangent_gram[free_q][:, free_q].toarray()
        basis = np.linalg.inv(np.linalg.cholesky(gram)).T
        total = np.zeros((len(free), len(free)))
        for column in basis.T:
            q = np.zeros(model.Q.dim)
            q[free_q] = column
            columns: Array = slope(q)[:, free].toarray()
            total += columns.T @ model.X.riesz(columns)
        values = eigh(total, mass.toarray(), eigvals_only=True)
        return float(np.sqrt(max(values[-1], 0.0))), True
    rng, best = np.random.default_rng(0), 0.0
    for _ in range(2):
        v = rng.standard_normal(n) * model.X.free
        for _ in range(4):
            size, q = _norm_of_A(model, v / model.X.norm(v), moment)
            best = max(best, size)
            # One power step for v; the next norm of A sees how good it is.
            image = slope(q)
            for _ in range(3):
                v = model.X.riesz(image.T @ model.X.riesz(image @ v))
                v /= model.X.norm(v)
    return best, False
