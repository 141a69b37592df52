"""Norms and constants of the theory for a discretised model (Assumption ass:equation)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh

from livepde.diagnostics.theory.state_parts import DENSE, Border, Images, Part, lanczos
from livepde.errors import ConfigurationError
from livepde.fem import START, Moment
from livepde.laws.damping import Constants
from livepde.linalg import Array, IntArray
from livepde.model import Model, h1_form
from livepde.observation import Observed, Split
from livepde.spaces import HilbertSpace

Pair: TypeAlias = tuple[sp.csr_array, sp.csr_array]

# Largest number of unknowns for a dense basis, needed if R is not a selection.
LARGEST_DENSE_BASIS = 2000
# Largest m n^2 up to which the bound of A(v) is computed over all of Q.
LARGEST_TRACE = 2e7
NONLINEAR = (
    "The constants are those of C(q, u) = A(u) q + B(u) (ass:equation). This model is not linear "
    "in what is estimated (a transform, or a form nonlinear in q): the paper's theory is silent."
)


@dataclass(frozen=True, eq=False)
class Spaces:
    """Spaces V~, VX~ of the observed part and V^, VX^ of the unobserved part.

    Parameters
    ----------
    model, observed
        The process, and its bound observation (`identifier.observed`).
    M_op, N_op
        Integrands (u, v, x) of M and N, (MN1) and (MN2), as in the law.
    VX, V
        Integrands of other squared norms for both parts. The default norms are defined by M and N,
        so that c_M = C_M = c_N = C_N = 1.

    Examples
    --------
    >>> import livepde as lp
    >>> from skfem import ElementLineP2
    >>> mesh = lp.interval(0.0, 1.0, 8)
    >>> model = lp.Model(
    ...     lp.Field(mesh, ElementLineP2(), dirichlet={"boundary": 0.0}),
    ...     lp.Normal(),
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
        """Projections R, P and G^+ with all sensors present."""
        return self.observed.split()

    @cached_property
    def observed_part(self) -> Part:
        """Spaces V~ and VX~: functions on omega, or the range of R."""
        return self._parts[0]

    @cached_property
    def hidden_part(self) -> Part:
        """Spaces V^ and VX^: functions outside omega, or the range of P."""
        return self._parts[1]

    def images(self, jacobian: Callable[[IntArray | None], sp.csr_array]) -> tuple[Images, Images]:
        """Return the images of the two parts under C', for `Part.lipschitz`.

        `jacobian` returns the matrix of C' on some elements; None: on all.
        """
        if self._regions is None:
            whole = [(self.model.X, jacobian(None))]
            return whole, whole
        (inside, J), outside = (
            (self._on(mass), jacobian(cells))
            for cells, mass in zip(self._regions, self._masses, strict=True)
        )
        seen = [(inside, sp.csr_array(J @ self.split.R))]
        return seen, [(inside, sp.csr_array(J @ self._unseen)), outside]

    def observed_A(self, w: Array, moment: Moment = START, q: Array | None = None) -> sp.csr_array:
        """Return A(w) over omega, if it is a subdomain: dual vectors in columns, shape (n, m)."""
        model, form = self.model, self.model.form_A
        if self._regions is not None:
            form = form.on(self._regions[0])
        return form.matrix("v", "q", moment, u=w, q=model.latent.prior if q is None else q)

    # --- the two parts ---------------------------------------------------------------------------

    @cached_property
    def _parts(self) -> tuple[Part, Part]:
        operators = self._of(self.M_op), self._of(self.N_op)
        if operators[0] is None or operators[1] is None:
            raise ConfigurationError("Spaces: M_op and N_op must be integrands (u, v, x).")
        M, N = operators[0][0], operators[1][1]
        VX = self._of(self.VX) or (M, N)
        V = self._of(self.V) or (None, None)
        if self._regions is None:
            return self._projected(M, N, VX, V)
        return self._integrated(M, N, VX, V)

    def _of(self, form: Any) -> tuple[sp.csr_array, sp.csr_array] | None:
        """Return the matrices of an integrand for the observed and for the unobserved part."""
        if form is None:
            return None
        if self._regions is None:
            given: Any = form
            matrix = sp.csr_array(given) if sp.issparse(form) else self.model.bilinear(form)
            return matrix, matrix
        if sp.issparse(form):
            raise ConfigurationError(
                "Spaces: with a Subdomain norms are integrals over omega and over the rest: give "
                "an integrand (u, v, x) in place of a matrix."
            )
        inside, outside = (self.model.bilinear(form, cells) for cells in self._regions)
        return self._divided(inside, outside)

    def _projected(
        self, M: sp.csr_array, N: sp.csr_array, VX: Pair, V: tuple[Any, Any]
    ) -> tuple[Part, Part]:
        """Return the parts as ranges of R and P, for sensors without a subdomain."""
        X = self.model.X
        seen, hidden = self.bases
        free = sp.diags_array(X.free)
        R, P = (sp.csr_array(matrix @ free) for matrix in (self.split.R, self.split.P))
        return (
            Part(X, seen, hidden, sp.csr_array(R.T @ M), VX[0], V[0], R),
            Part(X, hidden, seen, sp.csr_array(P.T @ N), VX[1], V[1], P),
        )

    def _integrated(
        self, M: sp.csr_array, N: sp.csr_array, VX: Pair, V: tuple[Any, Any]
    ) -> tuple[Part, Part]:
        """Return the parts as functions on omega and on its complement; both own the interface."""
        X, regions = self.model.X, self._regions or ()
        inside, outside = self._masses
        masses = self._divided(inside, outside)
        spaces = [self._on(mass) for mass in masses]
        smooth = self._divided(*(self.model.bilinear(h1_form, cells) for cells in regions))
        parts = []
        for k, operator in enumerate((M, N)):
            own, other = spaces[k], spaces[1 - k]
            reach = np.flatnonzero((own.free < 1) | (other.free > 0))
            tests = HilbertSpace(X.gram, own.name, reach)
            basis = sp.csr_array(sp.eye_array(X.dim, format="csr")[:, own.free > 0])
            nothing = sp.csr_array((X.dim, 0))
            border = Border(own, tests, smooth[k])
            parts.append(Part(own, basis, nothing, operator, VX[k], V[k], border=border))
        return parts[0], parts[1]

    @cached_property
    def _regions(self) -> tuple[IntArray, IntArray] | None:
        """Elements of omega and the other elements; None without a subdomain."""
        omega = self.split.omega
        if omega is None:
            return None
        return omega, np.setdiff1d(np.arange(self.model.mesh.nelements), omega).astype(omega.dtype)

    @cached_property
    def _masses(self) -> tuple[sp.csr_array, ...]:
        """Mass matrices of the two regions."""
        form = self.model.form_M
        return tuple(form.on(cells).matrix("v", "u") for cells in self._regions or ())

    @cached_property
    def _unseen(self) -> sp.csr_array:
        """P on the free coefficients: components without a sensor, also within omega."""
        return sp.csr_array(self.split.P @ sp.diags_array(self.model.X.free))

    def _divided(self, inside: sp.csr_array, outside: sp.csr_array) -> Pair:
        """Return R^T inside R, and P^T inside P + outside."""
        R, P = self.split.R, self._unseen
        return sp.csr_array(R.T @ inside @ R), sp.csr_array(P.T @ inside @ P + outside)

    def _on(self, mass: sp.csr_array) -> HilbertSpace:
        """Return X with a mass matrix that is singular: it vanishes on some coefficients."""
        unseen = (mass.diagonal() <= 0.0) | (self.model.X.free == 0.0)
        return HilbertSpace(mass, "X", np.flatnonzero(unseen))

    @cached_property
    def bases(self) -> tuple[sp.csr_array, sp.csr_array]:
        """Bases of the ranges of R and P on the free coefficients, without a subdomain."""
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
                f"computed densely up to {LARGEST_DENSE_BASIS}. Use a coarser mesh: the constants "
                "barely depend on it."
            )
        free = np.flatnonzero(X.free)
        left, sizes, _ = np.linalg.svd(R.toarray()[np.ix_(free, free)])
        rank = int((sizes > 1e-10).sum())
        # The projection R has `left` as a basis of its range; that of I - R has its own singular
        # vectors.
        rest, rest_sizes, _ = np.linalg.svd((np.eye(X.dim) - R.toarray())[np.ix_(free, free)])
        hidden_rank = int((rest_sizes > 1e-10).sum())
        whole = np.zeros((X.dim, rank + hidden_rank))
        whole[free, :rank] = left[:, :rank]
        whole[free, rank:] = rest[:, :hidden_rank]
        return sp.csr_array(whole[:, :rank]), sp.csr_array(whole[:, rank:])


def constants(
    spaces: Spaces, q: Array, states: Sequence[Array], *, moment: Moment = START, gain: float = 1.0
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

    C is taken at the (physical) parameter q, q* in a twin, shape (m,), and at states along the run,
    at least one. The gain of the law divides the inner product of Q: C_A grows with its root.

    Raises `ConfigurationError`: no state is given, or C is not linear in the latent parameter.
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

        def jacobian(cells: IntArray | None, u: Array = u) -> sp.csr_array:
            A, B = model.form_A, model.form_B
            if cells is not None:
                A, B = A.on(cells), B.on(cells)
            slope = A.matrix("v", "u", moment, u=u, q=q) + B.matrix("v", "u", moment, u=u)
            return sp.csr_array(slope)

        of_seen, of_hidden = spaces.images(jacobian)
        lipschitz = max(lipschitz, seen.lipschitz(of_seen), hidden.lipschitz(of_hidden))
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
    # ||v||_X <= (embedding) ||v||_V: (AbdV) and (AbdVV) follow from the bound in X.
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
    """Return ||A(u)||_{Q -> X} and the q at which it is attained."""
    # ||A||^2 is the largest eigenvalue of A* A in the inner product of Q.
    A, Q = model.A(u, moment), model.Q
    free = np.flatnonzero(Q.free)

    def image(x: Array) -> Array:
        full = np.zeros((Q.dim, *x.shape[1:]))
        full[free] = x
        return A.transposed(model.X.riesz(A(full)))[free]

    gram = Q.tangent_gram[free][:, free]
    if len(free) <= DENSE:
        values, vectors = eigh(image(np.eye(len(free))), gram.toarray())
    else:
        space = HilbertSpace(sp.csr_array(gram))
        values, vectors = lanczos(image, space.dual, space.riesz, len(free))
    q = np.zeros(Q.dim)
    q[free] = vectors[:, -1]
    return float(np.sqrt(max(values[-1], 0.0))), q


def _trilinear(model: Model, u: Array, moment: Moment) -> tuple[float, bool]:
    """Return K of `constants`, and True if it is a bound (False: a value from sampling)."""
    n, free = model.X.dim, np.flatnonzero(model.X.free)
    free_q = np.flatnonzero(model.Q.free)

    def slope(q: Array) -> sp.csr_array:
        return model.form_A.matrix("v", "u", moment, u=u, q=q)

    mass = sp.csr_array(model.mass[free][:, free])
    if len(free_q) * n**2 <= LARGEST_TRACE:
        # With G_Q = L L^T the columns of L^{-T} are an orthonormal basis of Q.
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
            # A few power iterations for v alternate with the exact maximisation over q. They need
            # not converge, since every norm of A is a lower bound of K.
            image = slope(q)
            for _ in range(3):
                v = model.X.riesz(image.T @ model.X.riesz(image @ v))
                v /= model.X.norm(v)
    return best, False
