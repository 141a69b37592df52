"""Inner products of Sobolev spaces H^s by sparse matrices, and smooth random fields."""

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
# Spacing of the quadrature points in log b. The trapezoidal rule has the error 2 exp(-2 pi^2 /
# SPACING) = 1e-4, since the integrand is analytic in a strip.
SPACING = 2.0
# Factor by which the quadrature points extend beyond the spectrum on each side.
REACH = 50.0


@dataclass(frozen=True)
class Sobolev:
    """The inner product of H^s: the paper's Q = H^s(Omega), which needs s > d/2.

        (q, xi)_s = (L^s q, xi)_{L^2},    L = I - length^2 Laplace,    s >= 0

    with natural boundary values, or zero ones where the field has a Dirichlet condition. In
    coefficients, with the mass matrix M and K that of L, G = M (M^{-1} K)^s:

    - s = 0 and 1 are M and K, sparse.
    - s = 2 with an element of class C^1 (Hermite on lines, Bogner-Fox-Schmit, Argyris) is the form
      q xi + 2 length^2 grad q . grad xi + length^4 hess q : hess xi, sparse.
    - All others are dense, but Schur complements of a sparse matrix, `border`: s = 2 is
      K M^{-1} K, with one auxiliary field; orders above 2 are reduced by 2 with two more; for
      fractional orders, lambda^sigma = c_0 + sum of w_i lambda/(lambda + b_i) by Balakrishnan's
      formula and the trapezoidal rule in log b, with one auxiliary field for each of the 10 to 15
      poles and a relative error of 1e-3 at most, which keeps the inner product symmetric, positive
      and equivalent to the exact one.

    Both laws use the border and never form G. The cost: a step of `GradientLaw` solves for the
    auxiliary fields too, about 15 times as many unknowns for fractional s. In `SensitivityLaw` they
    enter only once, when its modes are computed.

    For s > 3/2 a natural boundary value is part of the space (the normal derivative vanishes), so
    that parameters with a slope at the boundary are approximated less well there; the form of the
    C^1 elements does not impose it.

    Parameters
    ----------
    s
        Order.
    length
        Length over which q is correlated, in the unit of the mesh.
    factor
        Of the inner product; `pointwise` chooses it.

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
        """Return the inner product with `std` of a field as its pointwise standard deviation.

        The prior covariance std^2 G^{-1} is then the Whittle-Matern covariance with variance std^2
        in the interior; within about a length of a free boundary the standard deviation grows, to
        sqrt(2) std on it, and to 2 std at a corner.

        Raises
        ------
        SpaceError
            If s <= dimension/2, where point values have infinite variance.

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
        """Return the inner product as a weak form; None if the element admits none."""
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

        M is the mass matrix, K that of `operator`, shape (n, n); `free` is one for each free
        coefficient, zero for each fixed one, which is decoupled.
        """
        mask, fixed = sp.diags_array(free), sp.diags_array(1.0 - free)
        M, K = (sp.csr_array(mask @ matrix @ mask + fixed) for matrix in (M, K))
        return sp.csr_array(self.factor * _border(float(self.s), M, K))


def _border(s: float, M: Any, K: Any) -> Any:
    if s > 2:  # G_s = K M^-1 G_{s-2} M^-1 K: y = M^-1 K q, M p = G_{s-2} y, G_s q = K p
        n, inner = M.shape[0], _border(s - 2, M, K)
        rest = inner.shape[0] - n
        corner = sp.csr_array((n, inner.shape[0]))
        mass = sp.vstack([-M, sp.csr_array((rest, n))])
        return sp.block_array([[None, corner, K], [corner.T, inner, mass], [K, mass.T, None]])
    if s == 2:
        return sp.block_array([[None, K], [K, -M]])
    if s in (0.0, 1.0):
        return M if s == 0 else K
    return _fractional_border(s, M, K)


def _fractional_border(s: float, M: Any, K: Any) -> Any:
    # With one auxiliary field for each pole the Schur complement E - sum F H^{-1} F is
    # lambda^s = lambda^{s - sigma} (c + sum w lambda/(lambda + b)).
    largest = _largest(M, K)
    c, weights, poles = _balakrishnan(s % 1, largest)
    shifted = [(K + b * M) / w for w, b in zip(weights, poles, strict=True)]
    if s > 1:
        E, F, H = c * K, [K] * len(poles), [-matrix for matrix in shifted]
    else:  # lambda/(lambda + b) = 1 - b/(lambda + b) = lambda/b - lambda^2/b/(lambda + b)
        near = poles <= np.sqrt(largest)  # each where it cancels less
        E = (c + weights[near].sum()) * M + (weights / poles)[~near].sum() * K
        F = [M if close else K for close in near]
        H = [m / b if n else m * b for m, b, n in zip(shifted, poles, near, strict=True)]
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
    # The eigenvalue is computed to 5 % only; the margin of 20 % makes it an upper bound. The poles
    # depend on it logarithmically, so accuracy would not pay.
    return 1.2 * float(value[0])


def _balakrishnan(sigma: float, largest: float) -> tuple[float, Array, Array]:
    """Return c_0, w, b with lambda^sigma = c_0 + sum of w lambda/(lambda + b) on [1, largest].

    lambda^sigma = sin(pi sigma)/pi times the integral over y of b^sigma lambda/(lambda + b) with b
    = e^y. The terms beyond the outermost poles are geometric series, summed in c_0 and one far
    pole.
    """
    low, high = -np.log(REACH), np.log(REACH * largest)
    b = np.exp(low + SPACING * np.arange(int(np.ceil((high - low) / SPACING)) + 1))
    w = np.sin(np.pi * sigma) / np.pi * SPACING * b**sigma
    below, above = np.exp(-sigma * SPACING), np.exp(-(1 - sigma) * SPACING)
    c = w[0] * below / (1 - below)
    far = b[-1] * REACH
    return float(c), np.append(w, w[-1] * REACH * above / (1 - above)), np.append(b, far)


MOST = 8  # functions of a field at most
KEPT = 0.98  # share of the mean variance that they represent, if so many are enough
LEAST = 0.5  # share of it below which a stated deviation is not represented
CANDIDATES = 2000  # vertices that are looked at
LENGTH = 0.5  # correlation length, as a share of the largest side of the domain
NUGGET = 1e-10  # of the variance: places that are close to each other stay independent
ROUNDING = 100.0 * NUGGET  # of the variance: no more is left where a value is known

Known: TypeAlias = Mapping[Any, float]


@dataclass(frozen=True, eq=False)
class _Kernel:
    """Matern covariance of smoothness 3/2 on places (places, d), of a correlation length.

    The field is zero at the first `known` of the places.
    """

    places: Array
    length: float
    known: int

    def covariance(self, one: Array, other: Array) -> Array:
        """Return the covariance of the field at places (a, d) and (b, d), shape (a, b)."""
        d = np.linalg.norm(one[:, None] - other[None], axis=2) * (np.sqrt(3.0) / self.length)
        return np.asarray((1.0 + d) * np.exp(-d))

    def features(self, at: Array) -> Array:
        """Return functions whose squares sum to the conditional variance, (functions, points)."""
        own = self.covariance(self.places, self.places)
        root = cholesky(own + NUGGET * np.eye(len(own)), lower=True)
        found: Array = solve_triangular(root, self.covariance(self.places, at), lower=True)
        return found[self.known :]

    def mixed(self, mix: Array, x: Any) -> Array:
        """Return a mix of the functions at x, shape (d, ...)."""
        x = np.asarray(x, dtype=float)
        found: Array = mix @ self.features(x.reshape(len(x), -1).T)
        return found.reshape(x.shape[1:])


def random_field(
    mesh: Any,
    std: float | None = None,
    *,
    known: Known | None = None,
    length: float | None = None,
    most: int = MOST,
) -> tuple[Callable[[Any], Array], ...]:
    """Return independent functions of x, each one standard deviation of a smooth random field.

    The field has a Matern covariance of smoothness 3/2. It is zero where values are known, and
    grows between these places and beyond them (kriging): it is the error of an initial state that
    was interpolated from readings. The leading functions of its covariance are kept; on an interval
    they are straight lines between the vertices, so that elements of first order have them exactly.

    Parameters
    ----------
    mesh
        The mesh of the state.
    std
        Largest standard deviation of the field on the mesh. Default: from the spread of the known
        values, the estimate of ordinary kriging; a single value has none.
    known
        Position (a number, or coordinates) -> value that is known there.
    length
        Correlation length; default half of the largest side of the domain.
    most
        Number of functions at most.

    Raises
    ------
    SpaceError
        A length or deviation that is not positive, or a stated deviation of which the functions
        represent less than half of the variance, because the length is short.

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
    left = 1.0 - _explained(kernel, points)
    if left.max(initial=0.0) < ROUNDING:  # each vertex has a known value
        return ()
    kernel = _with_pivots(kernel, points, left, 3 * most)
    features = kernel.features(points)
    # Directions of the features by their share of the mean variance.
    square, vectors = np.linalg.eigh(features @ features.T)
    share = np.cumsum(square[::-1]) / left.sum()
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
    """Return mixes of the functions of a kernel; on an interval straight between the vertices."""
    if scale == 0.0:
        return ()
    functions = [partial(kernel.mixed, mix) for mix in scale * mixes]
    if vertices.shape[1] > 1:
        return tuple(functions)
    nodes = np.sort(vertices[:, 0])
    return tuple(partial(_straight, nodes, function(nodes[None])) for function in functions)


def _straight(nodes: Array, values: Array, x: Any) -> Array:
    return np.asarray(np.interp(x[0], nodes, values))


def _with_pivots(kernel: _Kernel, points: Array, left: Array, most: int) -> _Kernel:
    """Return the kernel with places added, each where the most variance is left."""
    first = float(left.max())
    while len(kernel.places) - kernel.known < most and left.max() > 1e-3 * first:
        places = np.vstack([kernel.places, points[int(left.argmax())]])
        kernel = _Kernel(places, kernel.length, kernel.known)
        left = 1.0 - _explained(kernel, points)
    return kernel


def _explained(kernel: _Kernel, points: Array) -> Array:
    """Return the share of the variance at points that all places of a kernel explain."""
    if not len(kernel.places):
        return np.zeros(len(points))
    whole = _Kernel(kernel.places, kernel.length, 0)
    return np.asarray((whole.features(points) ** 2).sum(axis=0))


def _spread(kernel: _Kernel, values: Array) -> float:
    """Return the standard deviation of a field of unknown mean with these values."""
    places = kernel.places[: kernel.known]
    weights = np.linalg.inv(kernel.covariance(places, places) + NUGGET * np.eye(len(values)))
    off = values - (weights @ values).sum() / weights.sum()
    return float(np.sqrt(max(off @ weights @ off, 0.0) / (len(values) - 1)))
