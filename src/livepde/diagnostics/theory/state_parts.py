"""Observed and unobserved part of the state: their norms, and extreme quotients of norms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from livepde.laws.damping import Norms
from livepde.linalg import Array, IntArray
from livepde.spaces import HilbertSpace

Map: TypeAlias = Callable[[Array], Array]
Images: TypeAlias = Sequence[tuple[HilbertSpace, sp.csr_array]]  # regions of X, operators there

# Size up to which eigenproblems are solved densely; larger ones by Lanczos.
DENSE = 400


def _columns(apply: Map) -> Map:
    """Return a linear map of vectors extended to matrices, column by column."""

    def mapped(x: Array) -> Array:
        if x.ndim == 1:
            return apply(x)
        return np.column_stack([apply(column) for column in x.T])

    return mapped


def lanczos(
    top: Map, bottom: Map, bottom_inverse: Map, size: int, count: int = 1, tolerance: float = 0.0
) -> tuple[Array, Array]:
    """Return the largest eigenvalues of top x = lambda bottom x, ascending, and their vectors.

    Both are symmetric, bottom > 0. From a fixed start vector, so that every run has the same
    numbers.
    """
    operators = [
        LinearOperator((size, size), matvec=f, dtype=float) for f in (top, bottom, bottom_inverse)
    ]
    start = np.random.default_rng(0).standard_normal(size)
    values, vectors = eigsh(
        operators[0], k=count, M=operators[1], Minv=operators[2], v0=start, tol=tolerance
    )
    return values, vectors


def largest_eigenvalue(top: Map, bottom: Map, bottom_inverse: Map | None, size: int) -> float:
    """Return the largest eigenvalue of top x = lambda bottom x, both symmetric, bottom > 0.

    By functions of vectors and of matrices; the inverse is needed for Lanczos only, in large
    problems.
    """
    if size == 0:
        return 0.0
    if size <= DENSE or bottom_inverse is None:
        one = np.eye(size)
        A, B = top(one), bottom(one)
        values = eigh(0.5 * (A + A.T), 0.5 * (B + B.T), eigvals_only=True)
    else:
        values, _ = lanczos(top, bottom, bottom_inverse, size, tolerance=1e-8)
    return max(float(values[-1]), 0.0)


def _root(x: Array, y: Array) -> float:
    """Return the square root of a product that may be negative by rounding."""
    return float(np.sqrt(max(float(x @ y), 0.0)))


@dataclass(frozen=True, eq=False)
class Border:
    """Interface of omega in the norms of one part of the state.

    `space` is X on the part, `tests` X on the functions with support in the part, the test
    functions of the law's own ||r||_V~, and `smoothness` the Gram matrix of H^1 on the part, (n,
    n).
    """

    space: HilbertSpace
    tests: HilbertSpace
    smoothness: sp.csr_array

    @cached_property
    def _system(self) -> tuple[IntArray, IntArray, Map]:
        """Coefficients of the part and of its tests, and the solver of `continued`."""
        # Saddle point system: least H^1 norm with given products with all tests.
        own, inner = np.flatnonzero(self.space.free), np.flatnonzero(self.tests.free)
        smoothness = self.smoothness[own][:, own]
        tested = self.space.gram[inner][:, own]
        system = sp.block_array([[smoothness, tested.T], [tested, None]], format="csc")
        return own, inner, splu(sp.csc_matrix(system)).solve

    def continued(self, dual: Array) -> Array:
        """Return the smoothest function whose products with all tests equal a functional."""
        own, inner, solve = self._system
        known = np.zeros((len(own) + len(inner), *dual.shape[1:]))
        known[len(own) :] = dual[inner]
        function = np.zeros(dual.shape)
        function[own] = solve(known)[: len(own)]
        return function


class Part:
    """One part of the state, observed or unobserved, with its norms.

    ||v||_VX^2 = (M v, v), and ||v||_V is the norm in X of the function M v, for M of (MN1) ||D v''
    - v|| over omega, unless other forms are given.

    On a subdomain the functional M v has a second part: the flux D grad v through the boundary of
    omega, which is not represented by a function of X. An element of the paper's V~ has no flux.
    Therefore the constants refer to the discrete V~, where M v is tested with all functions of the
    part, and the norm of a function with flux increases with mesh refinement. The flux of a given
    v, such as an error r or p, may be nonzero: its norm is the norm of the smoothest function that
    agrees with M v on all tests within the part. The law (`stage_norms`) uses the function of least
    norm instead, which vanishes at the boundary of omega. Both norms have the same limit.

    Parameters
    ----------
    space
        X on this part, with the Gram matrix integrated over the part.
    basis, rest
        Bases of this part, on the free coefficients, (n, k), and of the other one, (n, l); `rest`
        has no columns if the two are orthogonal in X.
    operator
        Matrix of M, or N, from coefficients to dual vectors, shape (n, n).
    VX, V
        Matrices of the squared norms; V None: the norm of M.
    projection
        R, or P, for sensors without a subdomain: it maps a state to this part.
    border
        Interface of a subdomain.
    """

    def __init__(
        self,
        space: HilbertSpace,
        basis: sp.csr_array,
        rest: sp.csr_array,
        operator: sp.csr_array,
        VX: sp.csr_array,
        V: sp.csr_array | None,
        projection: sp.csr_array | None = None,
        border: Border | None = None,
    ) -> None:
        self.space = space
        self.basis = basis
        self.rest = rest
        self.size = int(basis.shape[1])
        self._tested = operator
        self._VX = VX
        self._V = V
        self._projection = projection
        self._border = border

    def norms(self, v: Array) -> Norms:
        """Return the three norms of this part of a state, coefficients of shape (n,)."""
        own = self._own(v)
        if not self.size:
            return Norms()
        if self._V is not None:
            V = _root(own, self._V @ own)
        else:
            image = self._represented(self._tested @ own)
            V = _root(image, self.space.gram @ image)
        return Norms(self._X(own), _root(own, self._VX @ own), V)

    def stage_norms(self, v: Array) -> Norms:
        """Return the norms used by a damping rule within a stage, in the order of `norms`."""
        own = self._own(v)
        if not self.size:
            return Norms()
        dual = self._tested @ own
        tests = self.space if self._border is None else self._border.tests
        return Norms(self._X(own), _root(own, self._VX @ own), _root(dual, tests.riesz(dual)))

    def root_mean_square(self, factor: Array) -> Norms:
        """Return sqrt(E ||v||^2) in the three norms, for v of covariance factor @ factor.T."""
        own, gram = self._own(factor), self.space.gram
        left = own if self._V is not None else self._represented(self._tested @ own)
        V = gram @ left if self._V is None else self._V @ own
        pairs = ((own, gram @ own), (own, self._VX @ own), (left, V))
        return Norms(*(_root(np.ravel(a), np.ravel(b)) for a, b in pairs))

    def projected(self, dual: Array) -> Array:
        """Return R* R of the Riesz representatives of dual vectors, shape (n,) or (n, k)."""
        image = self._own(self.space.riesz(dual))
        if self._projection is None:
            return image
        return self.space.riesz(self._projection.T @ (self.space.gram @ image))

    def _own(self, v: Array) -> Array:
        return v if self._projection is None else self._projection @ v

    def _X(self, v: Array) -> float:
        return _root(v, self.space.gram @ v)

    def _represented(self, dual: Array) -> Array:
        """Return the Riesz representative of a functional on the part, without the flux."""
        if self._border is None:
            return self.space.riesz(dual)
        return self._border.continued(dual)

    # --- matrices on the basis -------------------------------------------------------------------

    def _on_basis(self, matrix: sp.csr_array) -> sp.csr_array:
        return sp.csr_array(self.basis.T @ matrix @ self.basis)

    @cached_property
    def gram_X(self) -> sp.csr_array:
        """Gram matrix of (v, w)_X on the basis."""
        return self._on_basis(self.space.gram)

    @cached_property
    def gram_VX(self) -> sp.csr_array:
        """Gram matrix of (v, w)_VX on the basis."""
        return self._on_basis(self._VX)

    @cached_property
    def operator(self) -> sp.csr_array:
        """Symmetric part of (M v, w)_X on the basis."""
        image = sp.csr_array(self.basis.T @ (self._tested @ self.basis))
        return sp.csr_array(0.5 * (image + image.T))

    def image(self, x: Array) -> Array:
        """Return the X-Gram product of M: x -> E^T M^T X^{-1} M E x."""
        dual = self._tested @ (self.basis @ x)
        return np.asarray(self.basis.T @ (self._tested.T @ self.space.riesz(dual)))

    def gram_V(self, x: Array) -> Array:
        if self._V is not None:
            result: Array = self.basis.T @ (self._V @ (self.basis @ x))
            return result
        return self.image(x)

    @cached_property
    def schur(self) -> Map:
        """Schur complement S of the other part: x^T S x = min over w of ||E x + w||_X^2."""
        if not self.rest.shape[1]:
            return lambda x: self.gram_X @ x
        other = HilbertSpace(sp.csr_array(self.rest.T @ self.space.gram @ self.rest))
        mixed = sp.csr_array(self.rest.T @ self.space.gram @ self.basis)
        return lambda x: self.gram_X @ x - mixed.T @ other.riesz(mixed @ x)

    @cached_property
    def inverse_V(self) -> Map:
        if self._V is not None:
            return HilbertSpace(self._on_basis(self._V)).riesz
        # On the basis gram_V is M S^{-1} M with the Schur complement S of X.
        own = HilbertSpace(self.operator)
        return lambda x: own.riesz(self.schur(own.riesz(x)))

    # --- constants -------------------------------------------------------------------------------

    def embedding_V_VX(self) -> float:
        """Constant C of ||v||_VX <= C ||v||_V."""
        top = self._largest(lambda x: self.gram_VX @ x, self.gram_V, self.inverse_V)
        return float(np.sqrt(top))

    def embedding_VX_X(self) -> float:
        """Constant C of ||v||_X <= C ||v||_VX."""
        return float(np.sqrt(self._sparse(self.gram_X, self.gram_VX)))

    def coercivity(self) -> float:
        """Constant c of (M v, v)_X >= c ||v||_VX^2; 1 if VX is the norm of M itself."""
        return 1.0 / self._sparse(self.gram_VX, self.operator) if self.size else 1.0

    def boundedness(self) -> float:
        """Constant C of ||R M v||_X <= C ||v||_V; 1 if V is the norm of M itself."""
        if not self.size:
            return 1.0
        return float(np.sqrt(self._largest(self.image, self.gram_V, self.inverse_V)))

    def lipschitz(self, images: Images) -> float:
        """Largest ||J v||_X / ||v||_V for the Jacobian J of C(q, .).

        `images` are pairs of X and J on the regions of J v; the squared norms are summed.
        """

        def image(x: Array) -> Array:
            v = self.basis @ x
            total = np.zeros(v.shape)
            for space, jacobian in images:
                total += jacobian.T @ space.riesz(jacobian @ v)
            return self.basis.T @ total

        return float(np.sqrt(self._largest(image, self.gram_V, self.inverse_V)))

    def ratio(self) -> float:
        """Upper bound of ||v||_V ||v||_X / ||v||_VX^2, which is 1/c_int of (interpol).

        By Kantorovich's inequality: with M x = lambda S x on this part the quotient is at most
        (a + b)/(2 sqrt(a b)) for the extreme lambdas a and b. The ratio of the norms of X and S is
        at most the factor of the mass that couples the two parts.
        """
        if not self.size:
            return 1.0
        own = HilbertSpace(self.operator)

        def inverse_schur(x: Array) -> Array:
            return self.basis.T @ self.space.riesz(self.basis @ x)

        top = self._largest(lambda x: self.operator @ x, self.schur, inverse_schur)
        least = 1.0 / self._largest(self.schur, lambda x: self.operator @ x, own.riesz)
        coupling = self._largest(lambda x: self.gram_X @ x, self.schur, inverse_schur)
        bound = np.sqrt(coupling) * (least + top) / (2.0 * np.sqrt(least * top))
        if self._V is not None:
            image_inverse = _columns(lambda x: own.riesz(self.schur(own.riesz(x))))
            bound *= np.sqrt(self._largest(self.gram_V, self.image, image_inverse))
        # The last factor is the reciprocal of the least quotient ||v||_VX^2 / (M v, v)_X.
        return float(bound / (1.0 / self._sparse(self.operator, self.gram_VX)))

    def _largest(self, top: Map, bottom: Map, bottom_inverse: Map | None) -> float:
        return largest_eigenvalue(top, bottom, bottom_inverse, self.size)

    def _sparse(self, top: sp.csr_array, bottom: sp.csr_array) -> float:
        inverse = HilbertSpace(bottom) if self.size else None
        return self._largest(
            lambda x: top @ x, lambda x: bottom @ x, inverse.riesz if inverse else None
        )
