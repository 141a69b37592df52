"""Evaluation points of weak forms, with time and inputs, and quadrature on cells and facets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, NamedTuple, NoReturn

import numpy as np
from skfem import (
    ElementLineHermite,
    FacetBasis,
    MappingAffine,
    Mesh,
    MeshHex,
    MeshLine,
    MeshQuad,
    MeshTet,
    MeshTri,
)
from skfem.element import DiscreteField, Element, ElementH1
from skfem.element.element_global import ElementGlobal
from skfem.generic_utils import OrientedBoundary
from skfem.quadrature import get_quadrature

from livepde.errors import MissingInputError, SpaceError
from livepde.linalg import Array, IntArray


class Inputs(dict[str, float]):
    """Immutable values of the input channels at a time; a missing name is an error."""

    def __missing__(self, name: str) -> float:
        channels = ", ".join(sorted(self)) or "none"
        raise MissingInputError(
            f"Input channel '{name}' has no value; channels with one: {channels}. "
            "Name it in inputs= of the model and send it with every sample."
        )

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("Inputs of a moment never change: several states share them.")

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return Inputs, (dict(self),)  # the default would set items, which is an error


NO_INPUTS = Inputs({})


@dataclass(frozen=True)
class Moment:
    """A time and the values of the input channels at that time."""

    t: float = 0.0
    inputs: Mapping[str, float] = field(default_factory=lambda: NO_INPUTS)


START = Moment()


class Place:
    """The argument `x` of a weak form.

    `x[0], x[1], ...` are coordinates of the quadrature points, `x.t` is the time, and
    `x.inputs["Q"]` the value of an input channel. `x.normal` is the outward normal on boundaries,
    and on oriented facets inside the mesh. `x.h` is the diameter of the cell (on boundaries, the
    adjacent cell), shape (elements, 1). The use of time and inputs is recorded: a form that uses
    neither is assembled once.
    """

    def __init__(
        self,
        x: Array,
        normal: Array | None,
        moment: Moment,
        diameter: Callable[[], Array] | None = None,
    ) -> None:
        self._x = x
        self._diameter = diameter
        self._normal = normal
        self._moment = moment
        self.used: set[str] = set()

    def __getitem__(self, axis: int) -> Array:
        coordinate: Array = self._x[axis]
        return coordinate

    @property
    def t(self) -> float:
        """Time."""
        self.used.add("t")
        return self._moment.t

    @property
    def inputs(self) -> Mapping[str, float]:
        """Values of the input channels."""
        self.used.add("inputs")
        return self._moment.inputs

    @property
    def h(self) -> Array:
        """Diameter of each cell, shape (elements, 1): for stabilisation and penalties."""
        if self._diameter is None:
            raise AttributeError("x.h exists where a form is integrated over cells or boundaries.")
        return self._diameter()

    @property
    def normal(self) -> Array:
        """Outward normal on a boundary, shape (d, facets, points)."""
        if self._normal is None:
            raise AttributeError(
                "x.normal exists on boundaries only: wrap the form in lp.On(...). On a line inside "
                "the mesh it has no side: write the direction, such as lp.grad(u)[0], or name "
                "oriented facets, mesh.with_boundaries({NAME: mesh.facets_around(SUBDOMAIN)})."
            )
        return self._normal


class _Constants(Mapping[str, float]):
    """Inputs of a place with additional constants, whose use is not recorded."""

    def __init__(self, place: Place, constants: Mapping[str, float]) -> None:
        self._place = place
        self._constants = constants

    def __getitem__(self, name: str) -> float:
        # A form that uses only constants is constant in time, so the use is not recorded.
        return self._constants[name] if name in self._constants else self._place.inputs[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._place.inputs, **self._constants})

    def __len__(self) -> int:
        return len({**self._place.inputs, **self._constants})


class _PlaceWithConstants:
    """A place x with additional constants among its inputs."""

    def __init__(self, place: Place, constants: Mapping[str, float]) -> None:
        self._place = place
        self.inputs = _Constants(place, constants)

    def __getitem__(self, axis: int) -> Array:
        return self._place[axis]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._place, name)


def with_constants(form: Callable[..., Any], constants: Mapping[str, float]) -> Callable[..., Any]:
    """Return a form with the given constants among the inputs of its place."""
    if not constants:
        return form

    @wraps(form)
    def bound(*given: Any) -> Any:
        places = (
            _PlaceWithConstants(item, constants) if isinstance(item, Place) else item
            for item in given
        )
        return form(*places)

    return bound


class _LineHermite(ElementLineHermite):  # type: ignore[misc]
    """Cubic Hermite functions from their formula on the reference element.

    scikit-fem inverts the Vandermonde matrix of global monomials. The error of its values is 1e-10
    on 30 cells of (0, 1), 1e-5 on 1000 cells, and 1e-4 on 30 cells of (100, 101).
    """

    def gbasis(
        self, mapping: Any, X: Array, i: int, tind: IntArray | None = None
    ) -> tuple[DiscreteField]:
        mesh = mapping.mesh
        ends = mesh.t if tind is None else mesh.t[:, tind]
        h = (mesh.p[0, ends[1]] - mesh.p[0, ends[0]])[:, None]
        s = np.broadcast_to(X[0], (len(h), X.shape[-1]))
        value, slope, bend = (
            (1 - 3 * s**2 + 2 * s**3, 6 * s**2 - 6 * s, 12 * s - 6),
            (s - 2 * s**2 + s**3, 1 - 4 * s + 3 * s**2, 6 * s - 4),
            (3 * s**2 - 2 * s**3, 6 * s - 6 * s**2, 6 - 12 * s),
            (s**3 - s**2, 3 * s**2 - 2 * s, 6 * s - 2),
        )[i]
        unit = h if i % 2 else 1.0  # coefficients of odd functions are du/dx
        return (
            DiscreteField(
                value=value * unit,
                grad=(slope * unit / h)[None],
                hess=(bend * unit / h**2)[None, None],
            ),
        )


def own(element: Element) -> Element:
    """Return a private copy of an element.

    Elements with global degrees of freedom cache data of their first mesh and are wrong on others.
    """
    if type(element) is ElementLineHermite:
        return _LineHermite()
    if isinstance(element, ElementGlobal):
        copied = copy(element)
        copied.V = None
        return copied
    return element


def unweighted(x: Any) -> float:
    """Return the volume element of Cartesian coordinates: 1."""
    return 1.0


# Largest number of quadrature points for which values of shape functions are cached.
KEPT = 300_000
# Number of quadrature points of a piece of a larger measure, which bounds the size of temporary
# arrays.
PIECE = 30_000


@dataclass(frozen=True, eq=False)
class Measure:
    """Integration domain (whole mesh, subdomain or boundary) with a quadrature order.

    `members`: indices of its cells, or of its facets on a boundary; default all.
    `thin`: whether to use only the first quadrature point of each, for tests of an integrand.
    `weight`: volume element of the coordinates, a function of points.
    """

    mesh: Mesh
    order: int
    name: str | None = None
    members: IntArray | None = None
    thin: bool = False
    weight: Callable[[Array], Any] = unweighted

    @property
    def on_boundary(self) -> bool:
        """Whether the measure is on a boundary."""
        return self.name is not None and self.name in (self.mesh.boundaries or {})

    @cached_property
    def _whole(self) -> IntArray | None:
        """All cells or facets with the name; None for all cells of the mesh."""
        if self.name is None:
            return None
        for named in (self.mesh.boundaries or {}, self.mesh.subdomains or {}):
            if self.name in named:
                elements: IntArray = named[self.name]
                return elements
        names = [*(self.mesh.boundaries or {}), *(self.mesh.subdomains or {})]
        raise SpaceError(f"On('{self.name}', ...): the mesh names {names or 'nothing'}.")

    @property
    def _where(self) -> IntArray | None:
        return self._whole if self.members is None else self.members

    def on(self, cells: IntArray) -> Measure:
        """Return the restriction to given cells of the mesh, or to their facets."""
        own_cells = self.cells
        own_cells = np.arange(self.mesh.nelements) if own_cells is None else own_cells
        at = np.flatnonzero(np.isin(own_cells, cells))
        where = self._where
        return replace(self, members=own_cells[at] if where is None else _chosen(where, at))

    @property
    def kept(self) -> bool:
        """Whether it is small enough to cache values of shape functions."""
        elements, points = self.shape
        return elements * points <= KEPT

    def pieces(self) -> Iterator[tuple[slice, Measure]]:
        """Yield (slice of elements, part), with parts that are small enough to evaluate at once."""
        elements, points = self.shape
        if self.kept:
            yield slice(0, elements), self
            return
        where, width = self._where, max(1, PIECE // points)
        for start in range(0, elements, width):
            at = slice(start, min(start + width, elements))
            members = np.arange(at.start, at.stop) if where is None else _chosen(where, at)
            yield at, replace(self, members=members)

    @cached_property
    def _rule(self) -> tuple[Array, Array]:
        """Quadrature points and weights on the reference cell or facet."""
        mesh = self.mesh
        X, W = get_quadrature(mesh.brefdom if self.on_boundary else mesh.refdom, self.order)
        return (X[:, :1], W[:1]) if self.thin else (X, W)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Number of elements, and number of quadrature points on each."""
        where = self._where
        return self.mesh.nelements if where is None else len(where), len(self._rule[1])

    @cached_property
    def mapping(self) -> Any:
        """Mapping of scikit-fem; for a part, a separate mapping without caches for other cells."""
        where = self._where
        if where is None and self.kept and not self.thin:
            return self.mesh._mapping()
        if self.mesh.affine and where is not None:
            return MappingAffine(self.mesh, where)
        return self._empty_mapping()

    def _empty_mapping(self) -> Any:
        """Return a copy of scikit-fem's mapping for all cells with empty caches."""
        mapping = copy(self.mesh._mapping())
        # scikit-fem caches Jacobians of all cells in the mapping of the mesh, for the lifetime of
        # the mesh.
        for name in [name for name in vars(mapping) if name.startswith("_")]:
            delattr(mapping, name)
        return mapping

    def facets(self, element: Any, dofs: Any) -> FacetBasis:
        """Return scikit-fem's basis of an element on a boundary."""
        options = {"mapping": self._empty_mapping(), "dofs": dofs, "disable_doflocs": True}
        return FacetBasis(self.mesh, element, facets=self._where, quadrature=self._rule, **options)

    @cached_property
    def _sides(self) -> _Sides:
        """Geometric data of the facets of a boundary."""
        basis = self.facets(own(self.mesh.elem()), self.mesh.dofs)
        x, normals, where = basis.global_coordinates(), np.asarray(basis.normals), self._where
        # Inside the mesh, the sides of facets without orientation change along a line.
        inside = (self.mesh.f2t[1, np.asarray(where)] >= 0).any()
        sided = isinstance(where, OrientedBoundary) or not inside
        return _Sides(basis.tind, np.asarray(x), np.asarray(basis.dx), normals if sided else None)

    @property
    def cells(self) -> IntArray | None:
        """Indices of the cells, or of cells adjacent to boundary facets; None for all cells."""
        return self._sides.cells if self.on_boundary else self._where

    @cached_property
    def points(self) -> Array:
        """Coordinates of the quadrature points, shape (d, elements, points)."""
        return self._sides.points if self.on_boundary else self.mapped(self._rule[0])

    @cached_property
    def weights(self) -> Array:
        """Quadrature weights with the volume element, shape (elements, points)."""
        if self.on_boundary:
            dx = self._sides.weights
        else:
            X, W = self._rule
            dx = np.abs(self.mapping.detDF(X, tind=self._where)) * W
        return dx if self.weight is unweighted else dx * self.weight(self.points)

    @property
    def normal(self) -> Array | None:
        """Outward normals on a boundary; None inside the mesh, unless facets are oriented."""
        return self._sides.normals if self.on_boundary else None

    @cached_property
    def diameter(self) -> Array:
        """Diameter of each cell, shape (elements, 1)."""
        cells = slice(None) if self.cells is None else self.cells
        corners = self.mesh.p[:, self.mesh.t[:, cells]]
        distances = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=0)
        largest: Array = distances.max(axis=(0, 1))[:, None]
        return largest

    def gbasis(self, element: Any, i: int) -> DiscreteField:
        """Return a shape function of an element at the quadrature points of cells."""
        return element.gbasis(self.mapping, self._rule[0], i, tind=self._where)[0]

    def lbasis(self, element: Any, count: int) -> Array | None:
        """Return the values of shape functions, (local, points), if identical in all cells."""
        if self.on_boundary or not isinstance(element, ElementH1):
            return None
        X = self._rule[0]
        values = [element.lbasis(X, i)[0] for i in range(count)]
        return np.array([np.broadcast_to(value, X.shape[1:]) for value in values])

    def mapped(self, X: Array) -> Array:
        """Return the images of points of the reference cell, shape (d, elements, points)."""
        x: Array = self.mapping.F(X, tind=self._where)
        return x

    def place(self, moment: Moment) -> Place:
        """Return the argument x of an integrand at a moment."""
        return Place(self.points, self.normal, moment, lambda: self.diameter)


# Dimension -> number of bisections of the reference cell of a `FineMeasure`, which result in 128,
# 256 and 64 parts.
BISECTIONS = {1: 7, 2: 4, 3: 2}
MESHES = {kind.elem.refdom: kind for kind in (MeshLine, MeshTri, MeshQuad, MeshTet, MeshHex)}
# Share by which corners of a cell are moved inwards, because a corner on a border is ambiguous.
INWARDS = 1e-6


@dataclass(frozen=True, eq=False)
class FineMeasure(Measure):
    """Measure that splits cells into many parts, for integrands that jump inside cells."""

    @cached_property
    def _rule(self) -> tuple[Array, Array]:
        X: Array
        W: Array
        X, W = get_quadrature(self.mesh.refdom, self.order)
        if self.mesh.refdom not in MESHES:  # wedges, which scikit-fem cannot refine
            return X, W
        parts = MESHES[self.mesh.refdom].init_refdom().refined(BISECTIONS[self.mesh.dim()])
        mapping = parts.mapping()
        points, weights = mapping.F(X), np.abs(mapping.detDF(X)) * W
        return points.reshape(len(points), -1), weights.ravel()


@dataclass(frozen=True, eq=False)
class _Corners(Measure):
    """Measure with the corners of cells as points, without weights."""

    @cached_property
    def _rule(self) -> tuple[Array, Array]:
        if self.mesh.refdom not in MESHES:
            inner: tuple[Array, Array] = get_quadrature(self.mesh.refdom, self.order)
            return inner
        X = MESHES[self.mesh.refdom].init_refdom().p
        middle = X.mean(axis=1, keepdims=True)
        return middle + (1.0 - INWARDS) * (X - middle), np.full(X.shape[1], np.nan)


def crossed(measure: Measure, region: Callable[[Array], Any]) -> IntArray:
    """Return the cells of a mesh that the border of a region crosses.

    A crossing is not detected if all corners and quadrature points of the cell are on one side.
    """
    crossed_cells = []
    for at, piece in measure.pieces():
        corners = _Corners(measure.mesh, 1, members=np.arange(at.start, at.stop))
        points = np.concatenate([piece.points, corners.points], axis=2)
        inside = np.broadcast_to(np.asarray(region(points), dtype=bool), points.shape[1:])
        crossed_cells.append(at.start + np.flatnonzero(inside.any(axis=1) & ~inside.all(axis=1)))
    return np.concatenate(crossed_cells)


def sizes(measure: Measure, region: Callable[[Array], Any]) -> tuple[float, float]:
    """Return the size of a region from a measure, and from finer parts of cells at its border."""
    cut = crossed(measure, region)
    plain, exact = 0.0, 0.0
    for at, piece in measure.pieces():
        inside = piece.weights * region(piece.points)
        plain += float(inside.sum())
        uncut = np.isin(np.arange(at.start, at.stop), cut, invert=True)
        exact += float(inside[uncut].sum())
    if len(cut):
        fine = FineMeasure(measure.mesh, measure.order, members=cut, weight=measure.weight)
        exact += sum(float((x.weights * region(x.points)).sum()) for _, x in fine.pieces())
    return plain, exact


class _Sides(NamedTuple):
    """Facets of a boundary: adjacent cells, quadrature points, weights, normals."""

    cells: IntArray
    points: Array
    weights: Array
    normals: Array | None


def _chosen(members: IntArray, at: Any) -> IntArray:
    """Return selected members of a measure; facets keep their orientation."""
    chosen: IntArray = np.asarray(members)[at]
    if isinstance(members, OrientedBoundary):
        chosen = OrientedBoundary(chosen, members.ori[at])
    return chosen
