"""Hilbert spaces by their Gram matrix, and linear operators between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError, SpaceError
from livepde.linalg import (
    Array,
    Factor,
    IntArray,
    Inverse,
    Leading,
    Pattern,
    analyse,
    conjugate_gradients,
    positive_definite,
)

__all__ = ["BorderedSpace", "DualOperator", "HilbertSpace", "product"]

# Beyond this condition number of the scaled Gram matrix a space counts as singular: fewer than two
# digits of a Riesz representative would be correct.
LARGEST_CONDITION = 1e14
# Number of coefficients up to which the Gram matrix of a bordered space is formed.
LARGEST_EXPLICIT = 2000
# Number of coefficients from which modes and traces are approximated, with a stated error.
LARGE = 20_000
# Number of coefficients with a computed prior variance; the others are interpolated.
SOLVED = 1000
# Smallest number of computed variances in a large space.
FEWEST_SOLVED = 64
# Number of right-hand sides solved at once, and largest number of their entries.
BLOCK = 250
ENTRIES = 2_500_000
# Relative residual of the Riesz map of a large space by conjugate gradients, which are used if they
# converge within the following number of iterations.
ITERATED = 1e-12
FEW = 50
# Number of random vectors of Hutchinson's trace estimate.
PROBES = 16
# Share of a variance that is attributed to rounding.
ROUNDING = 1e-9
# Relative error of the modes of a large space.
PRECISE = 1e-8


@dataclass(frozen=True, eq=False)
class HilbertSpace:
    """Coefficient vectors with the inner product (x, y) = x^T G y.

    Parameters
    ----------
    gram
        Symmetric positive definite Gram matrix G, shape (n, n).
    name
        Letter of the space: X, Q, V~, ...
    fixed
        Coefficients that essential boundary conditions fix. Elements of the *tangent* space are
        zero there: `riesz` returns zero for them, and their rows and columns of G do not count.

    Raises
    ------
    SpaceError
        G is not square, not symmetric, or singular on the tangent space.
    """

    gram: sp.csr_array
    name: str = "X"
    fixed: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        rows, cols = self.gram.shape
        if rows != cols:
            raise SpaceError(f"Gram matrix of {self.name}: got shape {rows, cols}, needs a square.")
        scale = abs(self.gram).max() if self.gram.nnz else 0.0
        if not np.isfinite(scale):
            raise SpaceError(f"Gram matrix of {self.name}: holds values that are not finite.")
        if self.gram.nnz and abs(self.gram - self.gram.T).max() > 1e-10 * scale:
            raise SpaceError(
                f"Gram matrix of {self.name} is not symmetric: write the inner product (of X, the "
                "form M) as a form that does not change when its two arguments are exchanged."
            )

    @property
    def dim(self) -> int:
        """Number of coefficients n."""
        return int(self.gram.shape[0])

    @property
    def augmented(self) -> sp.csr_array:
        """Sparse matrix whose Schur complement on the first `dim` unknowns is G; here G itself."""
        return self.gram

    @cached_property
    def free(self) -> Array:
        """Mask of free coefficients: one if free, zero if fixed, shape (n,)."""
        mask = np.ones(self.dim)
        mask[self.fixed] = 0.0
        return mask

    @cached_property
    def tangent_gram(self) -> sp.csr_array:
        """G on the free coefficients, the identity on the fixed ones."""
        if not len(self.fixed):
            return self.gram
        free = sp.diags_array(self.free)
        return sp.csr_array(free @ self.gram @ free + sp.diags_array(1.0 - self.free))

    @cached_property
    def factor(self) -> Factor:
        """Factorised `tangent_gram`; conjugate gradients for a large, well-conditioned one (L2)."""
        if (iterated := self._iterated()) is not None:
            return iterated
        pattern = Pattern.of(self.tangent_gram)
        singular = (
            f"The Gram matrix of {self.name} is singular: its inner product does not see every "
            "element. Add a zero-order term (inner='H1' has one) or fix boundary values."
        )
        solver = analyse(pattern, symmetric=True)
        try:
            factor = solver.factorise(_data(self.tangent_gram))
        except LinearAlgebraError as error:
            raise SpaceError(singular) from error
        # Two steps of inverse iteration find a nearly zero eigenvalue that the pivots do not show.
        # The matrix is scaled to a unit diagonal, since unknowns of a product have different units.
        scale = np.sqrt(np.abs(self.tangent_gram.diagonal()))
        if not scale.all():
            raise SpaceError(singular)
        x = np.random.default_rng(0).standard_normal(self.dim)
        try:
            for _ in range(2):
                x = scale * factor.solve(scale * x / np.linalg.norm(x))
        except LinearAlgebraError as error:
            raise SpaceError(f"The Gram matrix of {self.name}: {error}") from error
        unit = sp.diags_array(1.0 / scale)
        largest = abs(unit @ self.tangent_gram @ unit).sum(axis=1).max()
        if not np.isfinite(x).all() or np.linalg.norm(x) * largest > LARGEST_CONDITION:
            raise SpaceError(singular)
        # An LU solver factorises indefinite matrices as well, so their definiteness is tested
        # separately.
        if not (solver.definite or positive_definite(self.tangent_gram)):
            raise SpaceError(
                f"The Gram matrix of {self.name} is not positive definite: check the sign of the "
                "terms of its inner product (of X, the form M)."
            )
        return factor

    def _iterated(self) -> Factor | None:
        """Return diagonally preconditioned conjugate gradients if few iterations suffice."""
        diagonal = self.tangent_gram.diagonal()
        if self.dim <= LARGE or not np.all(diagonal > 0.0):
            return None
        # A trial solve decides: the condition number of the scaled matrix is not known otherwise. A
        # mass matrix needs few iterations on any mesh, a stiffness matrix more on finer ones.
        probe = np.random.default_rng(0).standard_normal(self.dim) * np.sqrt(diagonal)
        matrix, remedy = self.tangent_gram, "take a mesh whose cells differ less in size and shape."

        def solve(b: Array, limit: int = 10 * FEW) -> Array:
            scale = diagonal if b.ndim == 1 else diagonal[:, None]
            product = matrix.__matmul__
            return conjugate_gradients(product, lambda r: r / scale, b, ITERATED, limit, remedy)[0]

        try:
            solve(probe, FEW)
        except LinearAlgebraError:
            return None
        return Inverse(solve)

    def inner(self, x: Array, y: Array) -> float:
        """Return (x, y) = x^T G y for coefficient vectors of shape (n,)."""
        return float(x @ (self.gram @ y))

    def norm(self, x: Array) -> float:
        """Return the norm of a coefficient vector, sqrt((x, x))."""
        return float(np.sqrt(max(self.inner(x, x), 0.0)))

    def dual(self, x: Array) -> Array:
        """Return the functional (x, ·) as a dual vector G x."""
        dual: Array = self.gram @ x
        return dual

    def riesz(self, functional: Array) -> Array:
        """Return the Riesz representative of a dual vector, of shape (n,) or (n, k).

        That is the x of the tangent space with (x, xi) = functional(xi) for every xi of it.
        """
        free = self.free if functional.ndim == 1 else self.free[:, None]
        return self.factor.solve(functional * free)

    def restricted(self, part: slice, fixed: IntArray) -> HilbertSpace:
        """Return the subspace of the coefficients in `part`; `fixed`: those it fixes."""
        return HilbertSpace(sp.csr_array(self.gram[part, part]), self.name, fixed)

    def _form(self, free: IntArray) -> Any:
        """Return G on the free coefficients, in the form that an eigensolver needs."""
        return self.tangent_gram[free][:, free]

    @cached_property
    def variance(self) -> Array:
        """Prior variance of each coefficient: the diagonal of G^{-1}, shape (n,); 0 where fixed.

        Computed by Riesz solves for at most 1000 coefficients, evenly spaced; in spaces of more
        than 40 000 coefficients for fewer, in inverse proportion to their number and at least 64,
        chosen at random. For the other coefficients v_i G_ii, or v_i if G is not explicit, is
        interpolated harmonically on the graph of G: each value is the mean of its neighbours.
        """
        return self._between(*self._sampled_variances)

    def beyond(self, modes: Array) -> Array:
        """Return the prior variance of each coefficient outside given modes, shape (n,).

        Computed like `variance`, except that beyond 20 000 coefficients only the remainder outside
        the modes is interpolated. Values at rounding level are set to zero. `modes`: G-orthonormal
        columns, (n, k).
        """
        variance_of_modes = (modes**2).sum(axis=1)
        if self.dim <= LARGE:
            # Differences at rounding level are set to zero, since a negative variance has no root.
            remainder = self.variance - variance_of_modes
            return np.where(remainder > ROUNDING * self.variance, remainder, 0.0)
        sampled, variance = self._sampled_variances
        remainder = variance - variance_of_modes[sampled]
        # Only the remainder is interpolated: the part of the modes is known at every coefficient.
        # The tolerance is larger than above because modes of large spaces are less accurate.
        return self._between(sampled, np.where(remainder > 10 * PRECISE * variance, remainder, 0.0))

    @cached_property
    def _sampled_variances(self) -> tuple[IntArray, Array]:
        """Sampled coefficients and their prior variances, computed by Riesz solves."""
        free = np.flatnonzero(self.free)
        if len(free) > LARGE:
            count = max(min(SOLVED, 2 * SOLVED * LARGE // len(free)), FEWEST_SOLVED)
            sampled = np.sort(np.random.default_rng(0).choice(free, count, replace=False))
        else:
            sampled = free[np.unique(np.linspace(0, len(free) - 1, SOLVED).astype(int))]
        variance = np.zeros(len(sampled))
        # Unit vectors are solved in blocks, which bounds the memory of large spaces.
        block = max(1, min(BLOCK, ENTRIES // max(self.dim, 1)))
        for start in range(0, len(sampled), block):
            indices = sampled[start : start + block]
            unit = np.zeros((self.dim, len(indices)))
            unit[indices, np.arange(len(indices))] = 1.0
            values = self.factor.solve(unit)[indices, np.arange(len(indices))]
            variance[start : start + block] = values
        return sampled, variance

    def _between(self, sampled: IntArray, values: Array) -> Array:
        """Return values at all free coefficients by harmonic interpolation from `sampled`."""
        result = np.zeros(self.dim)
        result[sampled] = values
        others = np.setdiff1d(np.flatnonzero(self.free), sampled)
        if len(others):
            gram, links = self.augmented, self._links
            # The product v_i G_ii is dimensionless, so that neighbouring values and slopes can be
            # averaged.
            scale = gram.diagonal() if gram.shape[0] == self.dim else np.ones(self.dim)
            graph = sp.csr_array(sp.diags_array(links.sum(axis=1)) - links)
            inner = sp.csr_array(graph[others][:, others])
            pattern = Pattern.of(inner)
            factor = analyse(pattern, symmetric=True).factorise(_data(inner))
            right_side = graph[others][:, sampled] @ (result * scale)[sampled]
            result[others] = -factor.solve(right_side) / scale[others]
        return result

    @property
    def _links(self) -> sp.csr_array:
        """Adjacency matrix of the coefficients coupled by G, directly or by auxiliary unknowns."""
        gram = sp.csr_array(self.augmented)
        pattern = sp.csr_array((np.ones(gram.nnz), gram.indices, gram.indptr), gram.shape)
        n = self.dim
        links = sp.csr_array(pattern[:n, :n] + pattern[:n, n:] @ pattern[n:, :n])
        return sp.csr_array((np.ones(links.nnz), links.indices, links.indptr), links.shape)

    def spread(self, weights: Array, modes: Array) -> float:
        """Return the trace of diag(weights) G^{-1}: the weighted sum of prior variances.

        Beyond 20 000 coefficients the part of `modes`, G-orthonormal columns, is exact, and the
        remainder is Hutchinson's estimate with 16 fixed random vectors: its relative standard error
        is at most 0.35, and decreases with the number of modes that contribute. `weights` are
        nonnegative, shape (n,).
        """
        if self.dim <= LARGE:
            return float(weights @ self.variance)
        # Random signs (Rademacher vectors) have the smallest variance in Hutchinson's estimate.
        # Their fixed seed makes runs reproducible.
        signs = 2.0 * np.random.default_rng(0).integers(0, 2, (self.dim, PROBES)) - 1.0
        total = float((weights @ modes**2).sum())
        for sign in signs.T:
            probe = np.sqrt(weights) * self.free * sign
            coordinates = modes.T @ probe
            total += max(float(probe @ self.riesz(probe) - coordinates @ coordinates), 0.0) / PROBES
        return total

    def modes(self, count: int, mass: sp.csr_array) -> tuple[Array, Array]:
        """Return the leading modes of the Gaussian measure with covariance G^{-1}.

        Solves mass phi = lambda G phi for the `count` largest lambda; the columns of phi, (n,
        count), are G-orthonormal, so q = Phi a with a ~ N(0, I) has covariance Phi Phi^T, the best
        approximation of G^{-1} of that rank in the norm of `mass`. The lambda, descending, are the
        variances.

        Beyond 400 coefficients Lanczos' method is used, with one Riesz solve per iteration and a
        fixed start vector, so that results are reproducible. Each lambda is exact to rounding;
        beyond 20 000 coefficients its relative error is 1e-8. The variance outside the modes is the
        total variance (`spread`) minus their sum.
        """
        from scipy.linalg import eigh
        from scipy.sparse.linalg import LinearOperator, eigsh

        free = np.flatnonzero(self.free)
        if not 1 <= count <= len(free):
            raise SpaceError(f"{self.name} has {len(free)} free coefficients; got modes={count}.")
        mass = sp.csr_array(mass)[free][:, free]
        if len(free) <= 400 or count >= len(free) - 1:
            n, gram = len(free), self.tangent_gram[free][:, free]
            values, vectors = eigh(
                mass.toarray(), gram.toarray(), subset_by_index=(n - count, n - 1)
            )
        else:
            gram = self._form(free)

            def solve(b: Array) -> Array:
                full = np.zeros(self.dim)
                full[free] = b
                return self.factor.solve(full)[free]

            inverse = LinearOperator(gram.shape, matvec=solve, dtype=float)
            large = len(free) > LARGE
            rough = np.random.default_rng(0).standard_normal(len(free))
            start = rough if large else np.ones(len(free))
            values, vectors = eigsh(
                mass, k=count, M=gram, Minv=inverse, v0=start, tol=PRECISE if large else 0.0
            )
        order = np.argsort(values)[::-1]
        phi = np.zeros((self.dim, count))
        phi[free] = vectors[:, order]
        # The sign of an eigenvector is arbitrary: it is fixed so that runs can be compared.
        phi *= np.sign(phi[np.abs(phi).argmax(axis=0), np.arange(count)])
        return phi, values[order]


class BorderedSpace(HilbertSpace):
    """A space whose dense Gram matrix is a Schur complement of a sparse matrix.

        K = [[E, F], [F^T, H]],    G = E - F H^{-1} F^T

    A product with G costs one sparse solve with H, the Riesz map costs one sparse solve with K, and
    a law that needs a system with G solves one with K and auxiliary unknowns instead. H^s of
    fractional order and powers of operators have this form (`livepde.fem.Sobolev`).

    `gram` and `tangent_gram` form the dense G, which is possible up to 2000 coefficients. `border`
    is K, symmetric; G, of shape (dim, dim), must be positive definite. Fixed coefficients may not
    be coupled with others in K.
    """

    def __init__(
        self, border: sp.csr_array, dim: int, name: str = "Q", fixed: IntArray | None = None
    ) -> None:
        fixed = np.zeros(0, dtype=np.int64) if fixed is None else fixed
        # The base is frozen and has a field `gram`, which here is computed when it is read.
        for key, value in (("border", border), ("count", dim), ("name", name), ("fixed", fixed)):
            object.__setattr__(self, key, value)
        scale = abs(border).max() if border.nnz else 0.0
        if not np.isfinite(scale) or abs(border - border.T).max() > 1e-10 * scale:
            raise SpaceError(f"Gram matrix of {name}: its bordered form is not symmetric.")

    border: sp.csr_array
    count: int

    @property
    def dim(self) -> int:
        return self.count

    @property
    def augmented(self) -> sp.csr_array:
        return self.border

    @cached_property
    def gram(self) -> sp.csr_array:
        """Explicit Gram matrix G."""
        if self.dim > LARGEST_EXPLICIT:
            raise SpaceError(
                f"The Gram matrix of {self.name} is dense and has {self.dim} rows; it is written "
                f"out up to {LARGEST_EXPLICIT}. Use inner, dual, riesz and augmented, which are "
                "sparse."
            )
        gram = self.dual(np.eye(self.dim))
        return sp.csr_array((gram + gram.T) / 2)

    @cached_property
    def _inner_factor(self) -> tuple[sp.csr_array, sp.csr_array, Factor]:
        E, F, H = self._parts
        if self.dim > LARGEST_EXPLICIT and np.all(H.diagonal() < 0.0):
            try:  # for powers of an operator, -H is a mass matrix
                negative = self._factorised(sp.csr_array(-H), symmetric=True)
                return E, F, Inverse(lambda b: -negative.solve(b))
            except SpaceError:
                pass
        return E, F, self._factorised(H)

    @property
    def _parts(self) -> tuple[sp.csr_array, sp.csr_array, sp.csr_array]:
        """Blocks E, F and H of the border matrix."""
        n, K = self.dim, self.border
        return sp.csr_array(K[:n, :n]), sp.csr_array(K[:n, n:]), sp.csr_array(K[n:, n:])

    @cached_property
    def factor(self) -> Factor:
        """Factorised G on the free coefficients, by the factor of K."""
        if (root := self._root()) is not None:
            return root
        free = sp.diags_array(np.concatenate([self.free, np.ones(self.border.shape[0] - self.dim)]))
        fixed = sp.diags_array(1.0 - free.diagonal())
        factor = self._factorised(sp.csr_array(free @ self.border @ free + fixed))
        return Leading(factor, self.dim, self.border.shape[0])

    def _root(self) -> Factor | None:
        """Return G^{-1} for a large G = -F H^{-1} F with symmetric F, as for H^2; else None.

        F admits Cholesky or multigrid; the indefinite K does not.
        """
        n, (E, F, H) = self.dim, self._parts
        if n <= LARGEST_EXPLICIT or E.count_nonzero() or F.shape != (n, n):
            return None
        if abs(F - F.T).max() > 1e-10 * abs(F).max():
            return None
        root = self._factorised(F, symmetric=True)
        return Inverse(lambda b: -root.solve(H @ root.solve(b)))  # G^-1 = -F^-1 H F^-1

    def _factorised(self, matrix: sp.csr_array, symmetric: bool = False) -> Factor:
        pattern = Pattern.of(matrix)
        try:
            return analyse(pattern, symmetric=symmetric).factorise(_data(matrix))
        except LinearAlgebraError as error:
            raise SpaceError(f"The Gram matrix of {self.name} is singular.") from error

    def dual(self, x: Array) -> Array:
        E, F, factor = self._inner_factor
        dual: Array = E @ x - F @ factor.solve(F.T @ x)
        return dual

    def inner(self, x: Array, y: Array) -> float:
        return float(x @ self.dual(y))

    def restricted(self, part: slice, fixed: IntArray) -> HilbertSpace:
        n = self.dim
        inner = np.arange(n)[part]
        F = sp.csr_array(self.border[inner][:, n:])
        if not F.nnz:
            return HilbertSpace(sp.csr_array(self.border[inner][:, inner]), self.name, fixed)
        both = np.concatenate([inner, np.arange(n, self.border.shape[0])])
        return BorderedSpace(sp.csr_array(self.border[both][:, both]), len(inner), self.name, fixed)

    def _form(self, free: IntArray) -> Any:
        from scipy.sparse.linalg import LinearOperator

        def apply(x: Array) -> Array:
            full = np.zeros(self.dim)
            full[free] = x.ravel()
            return self.dual(full)[free]

        return LinearOperator((len(free), len(free)), matvec=apply, dtype=float)


def product(spaces: Sequence[HilbertSpace], name: str, fixed: IntArray) -> HilbertSpace:
    """Return the product space, with a given name and fixed coefficients."""
    gram = sp.csr_array(sp.block_diag([s.augmented for s in spaces], format="csr"))
    sizes = [s.augmented.shape[0] for s in spaces]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    leading = [np.arange(k, k + s.dim) for k, s in zip(starts, spaces, strict=True)]
    auxiliary = [
        np.arange(k + s.dim, k + size) for k, s, size in zip(starts, spaces, sizes, strict=True)
    ]
    dim = sum(s.dim for s in spaces)
    if dim == gram.shape[0]:
        return HilbertSpace(gram, name, fixed)
    # A Schur complement needs the coefficients of all spaces first, auxiliary unknowns last.
    order = np.concatenate([*leading, *auxiliary])
    return BorderedSpace(sp.csr_array(gram[order][:, order]), dim, name, fixed)


@dataclass(frozen=True, eq=False)
class DualOperator:
    """A linear operator T: source -> target*, given by a weak form.

    Row i of `matrix`, (target.dim, source.dim), is the functional tested with basis function i: the
    values of the operator are *dual* vectors of `target`.
    """

    matrix: sp.csr_array
    source: HilbertSpace
    target: HilbertSpace

    def __post_init__(self) -> None:
        expected = (self.target.dim, self.source.dim)
        if self.matrix.shape != expected:
            raise SpaceError(
                f"Operator {self.source.name} -> {self.target.name}*: matrix of shape "
                f"{self.matrix.shape}, the spaces need {expected}."
            )

    def __call__(self, x: Array) -> Array:
        """Return T x, a dual vector of the target, shape (target.dim,)."""
        value: Array = self.matrix @ x
        return value

    def transposed(self, y: Array) -> Array:
        """Return T^T y, a dual vector of the source, for y in the target."""
        value: Array = self.matrix.T @ y
        return value

    def adjoint(self, y: Array) -> Array:
        """Return T* y in the source: (T* y, xi)_source = <T xi, y> for every tangent xi.

        The paper's A(u)^*: Q <- X of (est_exact_q), a transpose and one Riesz solve.
        """
        return self.source.riesz(self.transposed(y))


def _data(matrix: sp.csr_array) -> Array:
    """Return the data of a matrix in the order of its pattern."""
    merged = sp.csr_array(matrix, copy=True)
    merged.sum_duplicates()
    return merged.data
