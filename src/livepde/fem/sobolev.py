"""Inner products of Sobolev spaces H^s from sparse matrices, and smooth random fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import scipy
import scipy.sparse as sp
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse.linalg import LinearOperator, eigsh
from skfem.element import ElementLineHermite, ElementQuadBFS, ElementTriArgyris
from skfem.helpers import dd as hess
from skfem.helpers import ddot, dot, grad

from livepde.errors import SpaceError, require_positive
from livepde.linalg import Array, Pattern, analyse

SMOOTH = (ElementLineHermite, ElementQuadBFS, ElementTriArgyris)  # of class C^1
# Spacing of the quadrature points in log b. The error of the trapezoidal rule is 2 exp(-2 pi^2 /
# SPACING) = 1e-4, because the integrand is analytic in a strip.
SPACING = 2.0
# Factor by which the quadrature points extend beyond the spectrum on each side.
REACH = 50.0


@dataclass(frozen=True)
class Sobolev:
    """Inner product of H^s, for Q = H^s(Omega) as in the paper, which requires s > d/2.

        (q, xi)_s = (L^s q, xi)_{L^2},    L = I - length^2 Laplace,    s >= 0

    with natural boundary conditions, or zero values on boundaries with a Dirichlet condition. In
    coefficients, with the mass matrix M and the matrix K of L, G = M (M^{-1} K)^s:

    - For s = 0 and 1, it is M or K, sparse.
    - For s = 2 and an element of class C^1 (Hermite on lines, Bogner-Fox-Schmit, Argyris), it is
      the form q xi + 2 length^2 grad q . grad xi + length^4 hess q : hess xi, sparse.
    - Otherwise it is dense, but the Schur complement of a sparse matrix, `border`. s = 2 is
      K M^{-1} K, with one auxiliary field. Orders above 2 are reduced by 2 with two more fields.
      For fractional orders, lambda^sigma = c_0 + sum of w_i lambda/(lambda + b_i) follows from
      Balakrishnan's formula and the trapezoidal rule in log b, with one auxiliary field for each
      of 10 to 15 poles. Its relative error is at most 1e-3. The inner product remains symmetric,
      positive and equivalent to the exact one.

    Both laws use the border and never form G. A step of `GradientLaw` also solves for the auxiliary
    fields, about 15 times as many unknowns for fractional s. `SensitivityLaw` uses them only once,
    to compute its modes.

    For s > 3/2, the natural boundary condition (a vanishing normal derivative) is part of the
    space, so that parameters with a slope at the boundary are approximated less well there. The
    form for C^1 elements does not impose it.

    Parameters
    ----------
    s
        Order.
    length
        Correlation length of q, in the unit of the mesh.
    factor
        Factor of the inner product, see `pointwise`.

    Examples
    --------
    >>> import livepde as lp
    >>> from skfem import ElementLineP1
    >>> q = lp.Field(lp.interval(0, 1, 20), ElementLineP1(), inner=Sobolev(0.75, length=0.2))
    """

    s: float
    length: float = 1.0
    factor: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.s) and self.s >= 0):
            raise SpaceError(f"Sobolev: the order s must be a number >= 0; got {self.s}.")
        require_positive("Sobolev: length", self.length, SpaceError)

    def pointwise(self, dimension: int) -> Sobolev:
        """Return the inner product for which `std` of a field is its pointwise standard deviation.

        The prior covariance std^2 G^{-1} is then the Whittle-Matern covariance with variance std^2
        in the interior. Within about a length of a free boundary, the standard deviation increases,
        to sqrt(2) std at the boundary and to 2 std at a corner.

        Raises
        ------
        SpaceError
            s <= dimension/2, for which point values have infinite variance.

        Examples
        --------
        >>> round(Sobolev(1, length=0.25).pointwise(1).factor, 12)  # 1/(2 length)
        2.0
        """
        half = dimension / 2
        if not self.s > half:
            raise SpaceError(
                f"Sobolev({self.s:g}).pointwise({dimension}): values at points have a finite "
                f"standard deviation for s > {half:g} only; take a larger s."
            )
        gamma = scipy.special.gamma
        volume = (4.0 * np.pi) ** half * self.length**dimension
        return replace(self, factor=float(gamma(self.s - half) / gamma(self.s) / volume))

    def form(self, element: Any) -> Any:
        """Return the inner product as a weak form; None if there is none for the element."""
        c, l2 = self.factor, self.length**2
        if self.s == 0:
            return lambda u, v, x: c * (u * v)
        if self.s == 1:
            return lambda u, v, x: c * (u * v + l2 * dot(grad(u), grad(v)))
        if self.s == 2 and isinstance(element, SMOOTH):
            return lambda u, v, x: (
                c * (u * v + 2 * l2 * dot(grad(u), grad(v)) + l2**2 * ddot(hess(u), hess(v)))
            )
        return None

    def operator(self, u: Any, v: Any, x: Any) -> Any:
        """Weak form of L = I - length^2 Laplace."""
        return u * v + self.length**2 * dot(grad(u), grad(v))

    def border(self, M: sp.csr_array, K: sp.csr_array, free: Array) -> sp.csr_array:
        """Return the sparse matrix whose Schur complement on the first n unknowns is G.

        M is the mass matrix and K the matrix of `operator`, shape (n, n). `free` is one for free
        and zero for fixed coefficients, which are decoupled.
        """
        mask, fixed = sp.diags_array(free), sp.diags_array(1.0 - free)
        M, K = (sp.csr_array(mask @ matrix @ mask + fixed) for matrix in (M, K))
        return sp.csr_array(self.factor * _border(float(self.s), M, K))


def _border(s: float, M: Any, K: Any) -> Any:
    if s > 2:  # G_s = K M^-1 G_{s-2} M^-1 K: y = M^-1 K q, M p = G_{s-2} y, G_s q = K p
        n, inner = M.shape[0], _border(s - 2, M, K)
        auxiliary = inner.shape[0] - n
        corner = sp.csr_array((n, inner.shape[0]))
        mass = sp.vstack([-M, sp.csr_array((auxiliary, n))])
        return sp.block_array([[None, corner, K], [corner.T, inner, mass], [K, mass.T, None]])
    if s == 2:
        return sp.block_array([[None, K], [K, -M]])
    if s in (0.0, 1.0):
        return M if s == 0 else K
    return _fractional_border(s, M, K)


def _fractional_border(s: float, M: Any, K: Any) -> Any:
    # With one auxiliary field for each pole, the Schur complement E - sum F H^{-1} F is
    # lambda^s = lambda^{s - sigma} (c + sum w lambda/(lambda + b)).
    largest = _largest(M, K)
    c, weights, poles = _balakrishnan(s % 1, largest)
    shifted = [(K + b * M) / w for w, b in zip(weights, poles, strict=True)]
    if s > 1:
        E, F, H = c * K, [K] * len(poles), [-matrix for matrix in shifted]
    else:  # lambda/(lambda + b) = 1 - b/(lambda + b) = lambda/b - lambda^2/b/(lambda + b)
        small = poles <= np.sqrt(largest)  # choose the form with less cancellation
        E = (c + weights[small].sum()) * M + (weights / poles)[~small].sum() * K
        F = [M if is_small else K for is_small in small]
        H = [m / b if n else m * b for m, b, n in zip(shifted, poles, small, strict=True)]
    side = sp.hstack(F)
    return sp.block_array([[E, side], [side.T, sp.block_diag(H)]])


def _largest(M: sp.csr_array, K: sp.csr_array) -> float:
    """Return an upper estimate of the largest eigenvalue of M^{-1} K."""
    if M.shape[0] < 3:
        return float(np.linalg.eigvals(np.linalg.solve(M.toarray(), K.toarray())).real.max())
    start = np.random.default_rng(0).standard_normal(M.shape[0])
    factor = analyse(Pattern.of(M), symmetric=True).factorise(sp.csr_array(M).sorted_indices().data)
    inverse = LinearOperator(M.shape, matvec=factor.solve, dtype=float)
    value = eigsh(K, k=1, M=M, Minv=inverse, v0=start, tol=0.05, return_eigenvectors=False)
    # The tolerance is 5 %, and the margin of 20 % makes the result an upper bound. The poles depend
    # on it only logarithmically.
    return 1.2 * float(value[0])


def _balakrishnan(sigma: float, largest: float) -> tuple[float, Array, Array]:
    """Return c_0, w, b with lambda^sigma = c_0 + sum of w lambda/(lambda + b) on [1, largest].

    lambda^sigma = sin(pi sigma)/pi times the integral over y of b^sigma lambda/(lambda + b) with b
    = e^y. The terms beyond the outermost poles are geometric series, whose sums are c_0 and one far
    pole.
    """
    low, high = -np.log(REACH), np.log(REACH * largest)
    b = np.exp(low + SPACING * np.arange(int(np.ceil((high - low) / SPACING)) + 1))
    w = np.sin(np.pi * sigma) / np.pi * SPACING * b**sigma
    below, above = np.exp(-sigma * SPACING), np.exp(-(1 - sigma) * SPACING)
    c = w[0] * below / (1 - below)
    last_pole = b[-1] * REACH
    return float(c), np.append(w, w[-1] * REACH * above / (1 - above)), np.append(b, last_pole)


MOST = 8  # most functions of a field
KEPT = 0.98  # share of the mean variance that the functions represent, unless `MOST` limits them
LEAST = 0.5  # share of the mean variance below which a given deviation is an error
CANDIDATES = 2000  # most vertices that are candidates for pivots
LENGTH = 0.5  # default correlation length over the largest side of the domain
NUGGET = 1e-10  # added variance, which regularises covariances of close positions
ROUNDING = 100.0 * NUGGET  # remaining variance below which a value counts as known

Known: TypeAlias = Mapping[Any, float]


@dataclass(frozen=True, eq=False)
class _Kernel:
    """Matern covariance of smoothness 3/2 with a correlation length, at positions (places, d).

    The field is zero at the first `known` positions.
    """

    places: Array
    length: float
    known: int

    def covariance(self, one: Array, other: Array) -> Array:
        """Return the covariance of the field between positions (a, d) and (b, d), shape (a, b)."""
        d = np.linalg.norm(one[:, None] - other[None], axis=2) * (np.sqrt(3.0) / self.length)
        return np.asarray((1.0 + d) * np.exp(-d))

    def features(self, at: Array) -> Array:
        """Return functions whose squares sum to the conditional variance, (functions, points)."""
        covariance = self.covariance(self.places, self.places)
        root = cholesky(covariance + NUGGET * np.eye(len(covariance)), lower=True)
        features: Array = solve_triangular(root, self.covariance(self.places, at), lower=True)
        return features[self.known :]

    def mixed(self, mix: Array, x: Any) -> Array:
        """Return a linear combination of the functions at x of shape (d, ...)."""
        x = np.asarray(x, dtype=float)
        values: Array = mix @ self.features(x.reshape(len(x), -1).T)
        return values.reshape(x.shape[1:])


def random_field(
    mesh: Any,
    std: float | None = None,
    *,
    known: Known | None = None,
    length: float | None = None,
    most: int = MOST,
) -> tuple[Callable[[Any], Array], ...]:
    """Return independent functions of x, each one standard deviation of a smooth random field.

    The field has a Matern covariance of smoothness 3/2. It is zero at positions with known values,
    and its variance grows between and beyond them (kriging). It models the error of an initial
    state that is interpolated from readings. The leading functions of its covariance are returned.
    On an interval they are linear between vertices, so elements of first order are exact.

    Parameters
    ----------
    mesh
        The mesh of the state.
    std
        Largest standard deviation of the field on the mesh. The default is an estimate from the
        spread of at least two known values by ordinary kriging.
    known
        Position (a number, or coordinates) -> known value.
    length
        Correlation length; default half of the largest side of the domain.
    most
        Maximum number of functions.

    Raises
    ------
    SpaceError
        A length or deviation is not positive; or `std` is given, and the functions represent less
        than half of the variance because the length is short.

    Examples
    --------
    >>> import livepde as lp
    >>> wall = lp.interval(0.0, 0.2, 20)
    >>> field = lp.random_field(wall, std=2.0, known={0.0: 20.0, 0.2: 4.0})
    >>> x = np.array([[0.0, 0.1, 0.2]])
    >>> np.sqrt(sum(function(x) ** 2 for function in field)).round(2)
    array([0., 2., 0.])
    """
    vertices, known = np.asarray(mesh.p, dtype=float).T, known or {}
    length = LENGTH * float(np.ptp(vertices, axis=0).max()) if length is None else length
    if std is None and len(known) < 2:
        return ()
    if std is not None:
        require_positive("random_field: std", std, SpaceError)
    require_positive("random_field: length", length, SpaceError)
    at = np.array([np.atleast_1d(place) for place in known]).reshape(-1, vertices.shape[1])
    points = vertices[:: -(-len(vertices) // CANDIDATES)]
    kernel = _Kernel(at, length, len(at))
    variance = 1.0 - _explained(kernel, points)
    if variance.max(initial=0.0) < ROUNDING:  # each vertex has a known value
        return ()
    kernel = _with_pivots(kernel, points, variance, 3 * most)
    features = kernel.features(points)
    # Order the directions of the features by their share of the mean variance.
    square, vectors = np.linalg.eigh(features @ features.T)
    share = np.cumsum(square[::-1]) / variance.sum()
    count = min(int(np.searchsorted(share, KEPT)) + 1, most, len(share))
    mixes = vectors[:, ::-1][:, :count].T
    if std is None:
        scale = _spread(kernel, np.array([*known.values()], dtype=float))
    elif share[count - 1] >= LEAST:
        scale = std / float(np.sqrt(((mixes @ features) ** 2).sum(axis=0).max()))
    else:
        raise SpaceError(
            f"random_field: {count} functions represent {share[count - 1]:.0%} of the variance "
            f"with length {length:g} and {len(at)} known values; expected {LEAST:.0%} or more: "
            "use a larger length, or fewer known values."
        )
    return _functions(kernel, scale, mixes, vertices)


def _functions(
    kernel: _Kernel, scale: float, mixes: Array, vertices: Array
) -> tuple[Callable[..., Array], ...]:
    """Return combinations of functions of a kernel; on an interval, linear between vertices."""
    if scale == 0.0:
        return ()
    functions = [partial(kernel.mixed, mix) for mix in scale * mixes]
    if vertices.shape[1] > 1:
        return tuple(functions)
    nodes = np.sort(vertices[:, 0])
    return tuple(partial(_straight, nodes, function(nodes[None])) for function in functions)


def _straight(nodes: Array, values: Array, x: Any) -> Array:
    return np.asarray(np.interp(x[0], nodes, values))


def _with_pivots(kernel: _Kernel, points: Array, variance: Array, largest: int) -> _Kernel:
    """Return the kernel with added positions, each at the largest remaining variance."""
    first = float(variance.max())
    while len(kernel.places) - kernel.known < largest and variance.max() > 1e-3 * first:
        places = np.vstack([kernel.places, points[int(variance.argmax())]])
        kernel = _Kernel(places, kernel.length, kernel.known)
        variance = 1.0 - _explained(kernel, points)
    return kernel


def _explained(kernel: _Kernel, points: Array) -> Array:
    """Return the share of the variance at points that the positions of a kernel explain."""
    if not len(kernel.places):
        return np.zeros(len(points))
    unconditioned = _Kernel(kernel.places, kernel.length, 0)
    return np.asarray((unconditioned.features(points) ** 2).sum(axis=0))


def _spread(kernel: _Kernel, values: Array) -> float:
    """Return the estimated standard deviation of a field with unknown mean and given values."""
    places = kernel.places[: kernel.known]
    weights = np.linalg.inv(kernel.covariance(places, places) + NUGGET * np.eye(len(values)))
    deviations = values - (weights @ values).sum() / weights.sum()
    return float(np.sqrt(max(deviations @ weights @ deviations, 0.0) / (len(values) - 1)))
