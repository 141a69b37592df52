"""Smooth random fields as a few functions of x, such as the error of an initial state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from livepde.errors import SpaceError
from livepde.linalg import Array

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
    """Matern covariance of smoothness 3/2, conditioned on the first `known` of some places.

    Attributes
    ----------
    places
        Shape (places, d).
    length
        Correlation length.
    known
        How many of the places, the first ones, are those where the field is zero.
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
    vertices = np.asarray(mesh.p, dtype=float).T
    side = float(np.ptp(vertices, axis=0).max())
    length = LENGTH * side if length is None else length
    if std is None and len(known or ()) < 2:
        return ()
    for name, value in (("std", std), ("length", length)):
        if value is not None and not (np.isfinite(value) and value > 0.0):
            raise SpaceError(f"random_field: {name} must be a positive number; got {value!r}.")
    at = np.array([np.atleast_1d(place) for place in known or ()]).reshape(-1, vertices.shape[1])
    points = vertices[:: -(-len(vertices) // CANDIDATES)]
    kernel = _Kernel(at, length, len(at))
    left = np.ones(len(points)) - (_explained(kernel, points) if kernel.known else 0.0)
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
        scale = _spread(kernel, np.array([*(known or {}).values()], dtype=float))
        if scale == 0.0:
            return ()
    else:
        if share[count - 1] < LEAST:
            raise SpaceError(
                f"random_field: {count} functions represent {share[count - 1]:.0%} of the variance "
                f"with length {length:g} and {len(at)} known values; expected {LEAST:.0%} or more: "
                "use a larger length, or fewer known values."
            )
        scale = std / float(np.sqrt(((mixes @ features) ** 2).sum(axis=0).max()))
    mixes = scale * mixes
    functions = [_Function(kernel, mix) for mix in mixes]
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
    whole = _Kernel(kernel.places, kernel.length, 0)
    return np.asarray((whole.features(points) ** 2).sum(axis=0))


def _spread(kernel: _Kernel, values: Array) -> float:
    """Return the standard deviation of a field of unknown mean with these values."""
    places = kernel.places[: kernel.known]
    weights = np.linalg.inv(kernel.covariance(places, places) + NUGGET * np.eye(len(values)))
    off = values - (weights @ values).sum() / weights.sum()
    return float(np.sqrt(max(off @ weights @ off, 0.0) / (len(values) - 1)))


@dataclass(frozen=True, eq=False)
class _Function:
    """A function of the field, as a mix of its features."""

    kernel: _Kernel
    mix: Array

    def __call__(self, x: Any) -> Array:
        x = np.asarray(x, dtype=float)
        found: Array = self.mix @ self.kernel.features(x.reshape(len(x), -1).T)
        return found.reshape(x.shape[1:])
