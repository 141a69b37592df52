"""Each kind of unknown as coefficients with local shape functions on a measure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve
from skfem import Basis, BilinearForm, FacetBasis, LinearForm, Mesh
from skfem.element import DiscreteField, ElementQuadBFS
from skfem.helpers import inner

from livepde.errors import ObservationError, SpaceError
from livepde.fem.elements import own
from livepde.fem.fields import Channel, Field, Piecewise, Scalar, Scalars, Unknown, is_nodal
from livepde.fem.periodic import tied
from livepde.fem.place import Moment, Place
from livepde.linalg import Array, IntArray

__all__ = ["Block", "FieldBlock", "Local", "Measure", "ScalarBlock", "block_of"]

JETS = ("value", "grad", "hess")


@dataclass(frozen=True)
class Measure:
    """Where a form is integrated: the whole mesh, a subdomain, or a boundary; with its order."""

    mesh: Mesh
    order: int
    name: str | None = None

    @property
    def on_boundary(self) -> bool:
        """True if the name is one of a boundary."""
        return self.name is not None and self.name in (self.mesh.boundaries or {})

    def basis(self, element: Any) -> Any:
        """Return scikit-fem's basis of an element on this measure."""
        element = own(element)
        if self.name is None:
            return Basis(self.mesh, element, intorder=self.order)
        if self.on_boundary:
            return FacetBasis(self.mesh, element, facets=self.name, intorder=self.order)
        if self.name in (self.mesh.subdomains or {}):
            return Basis(self.mesh, element, elements=self.name, intorder=self.order)
        known = [*(self.mesh.boundaries or {}), *(self.mesh.subdomains or {})]
        raise SpaceError(f"On('{self.name}', ...): the mesh names {known or 'nothing'}.")

    @cached_property
    def _base(self) -> Any:
        return self.basis(self.mesh.elem())

    @cached_property
    def points(self) -> Array:
        """Coordinates of the quadrature points, shape (d, elements, points)."""
        x: Array = np.asarray(self._base.global_coordinates())
        return x

    @cached_property
    def weights(self) -> Array:
        """Quadrature weights, shape (elements, points)."""
        return np.asarray(self._base.dx)

    @cached_property
    def normal(self) -> Array | None:
        """Outward normals on a boundary."""
        return np.asarray(self._base.normals) if self.on_boundary else None

    @cached_property
    def diameter(self) -> Array:
        """Largest distance of two vertices of each cell, shape (elements, 1)."""
        cells = slice(None) if self._base.tind is None else self._base.tind
        corners = self.mesh.p[:, self.mesh.t[:, cells]]
        distances = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=0)
        found: Array = distances.max(axis=(0, 1))[:, None]
        return found

    def place(self, moment: Moment) -> Place:
        """Return what an integrand sees as x at a moment."""
        return Place(self.points, self.normal, moment, self.diameter)


@dataclass(frozen=True)
class Local:
    """Shape functions of a block on a measure.

    Attributes
    ----------
    dofs
        Coefficient of each local shape function, shape (local, elements).
    parts
        What a form sees: (jet, tensor shape) in order, such as ("value", ()), ("grad", (d,)).
    phi
        Components of all parts, shape (components, local, elements, points).
    """

    dofs: IntArray
    parts: tuple[tuple[str, tuple[int, ...]], ...]
    phi: Array


class Block(ABC):
    """One unknown of a function space."""

    size: int

    @abstractmethod
    def local(self, measure: Measure) -> Local:
        """Return the local shape functions on a measure."""

    @abstractmethod
    def jet(self, parts: Local, values: Array) -> Any:
        """Return what a form gets for component values of shape (components, ..., E, P)."""

    @abstractmethod
    def prior(self) -> Array:
        """Return the prior mean as coefficients, shape (size,)."""

    @abstractmethod
    def labels(self, name: str) -> tuple[str, ...]:
        """Return a label for each coefficient that stands for itself (none for fields)."""


class ScalarBlock(Block):
    """Numbers: constant on the domain (`Scalar`) or on each region (`Piecewise`)."""

    def __init__(self, unknown: Scalar | Piecewise) -> None:
        self.unknown = unknown
        self.size = 1 if isinstance(unknown, Scalar) else len(unknown.regions)

    def _indicators(self, measure: Measure) -> Array:
        _, elements, points = measure.points.shape
        if isinstance(self.unknown, Scalar):
            return np.ones((1, elements, points))
        masks = np.zeros((self.size, elements, points))
        for mask, (name, region) in zip(masks, self.unknown.regions.items(), strict=True):
            if callable(region):
                mask[:] = region(measure.points)
            elif region in (measure.mesh.subdomains or {}):
                members = measure.basis(measure.mesh.elem()).tind
                if members is None:
                    members = np.arange(measure.mesh.nelements)
                mask[np.isin(members, measure.mesh.subdomains[region])] = 1.0
            else:
                raise SpaceError(
                    f"Region '{name}': the mesh has no subdomain '{region}'; give a predicate on x."
                )
        return masks

    def local(self, measure: Measure) -> Local:
        phi = self._indicators(measure)[None]
        dofs = np.repeat(np.arange(self.size)[:, None], phi.shape[2], axis=1)
        return Local(dofs, (("value", ()),), phi)

    def jet(self, parts: Local, values: Array) -> Any:
        return values[0]

    def prior(self) -> Array:
        return np.full(self.size, float(self.unknown.prior))

    def labels(self, name: str) -> tuple[str, ...]:
        if isinstance(self.unknown, Scalar):
            return (name,)
        return tuple(f"{name}[{region}]" for region in self.unknown.regions)


class NamesBlock(Block):
    """Numbers by name (`Scalars`), the same everywhere."""

    def __init__(self, unknown: Scalars) -> None:
        self.unknown = unknown
        self.names = tuple(unknown.names)
        self.size = len(self.names)

    def local(self, measure: Measure) -> Local:
        phi = np.zeros((self.size, self.size, *measure.weights.shape))
        phi[np.arange(self.size), np.arange(self.size)] = 1.0
        dofs = np.repeat(np.arange(self.size)[:, None], phi.shape[2], axis=1)
        return Local(dofs, tuple((name, ()) for name in self.names), phi)

    def jet(self, parts: Local, values: Array) -> dict[str, Array]:
        return dict(zip(self.names, values, strict=True))

    def prior(self) -> Array:
        return np.full(self.size, float(self.unknown.prior))

    def labels(self, name: str) -> tuple[str, ...]:
        return tuple(f"{name}[{item}]" for item in self.names)


class FieldBlock(Block):
    """A finite-element function."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.basis = Basis(field.mesh, own(field.element))
        self._tie = tied(field, self.basis)
        self.size = int(self._tie.max()) + 1

    @cached_property
    def element_dofs(self) -> IntArray:
        """Coefficient of each local shape function, shape (local, elements)."""
        found: IntArray = self._tie[self.basis.element_dofs]
        return found

    @cached_property
    def doflocs(self) -> Array:
        """Where each coefficient sits, shape (d, size)."""
        _, first = np.unique(self._tie, return_index=True)
        found: Array = self.basis.doflocs[:, first]
        return found

    @cached_property
    def boundary(self) -> IntArray:
        """The coefficients on the boundary of the mesh, without sides that are tied."""
        mesh = self.field.mesh
        free = mesh.boundary_facets()
        for name in chain(*self.field.periodic):
            free = np.setdiff1d(free, mesh.boundaries[name])
        found: IntArray = np.unique(self._tie[self.basis.get_dofs(facets=free).all()])
        return found

    @cached_property
    def _spread(self) -> sp.csr_array:
        """The matrix from coefficients to those of scikit-fem, where sides are not tied."""
        n = len(self._tie)
        return sp.csr_array((np.ones(n), (np.arange(n), self._tie)), shape=(n, self.size))

    @cached_property
    def vector(self) -> bool:
        """True if the function has values in R^d."""
        return np.ndim(self.basis.basis[0][0]) > 2

    def local(self, measure: Measure) -> Local:
        if measure.mesh is not self.field.mesh:
            raise SpaceError(
                "State and parameter fields must share one mesh object; their elements may differ."
            )
        basis = measure.basis(self.field.element)
        elements, points = measure.weights.shape
        first = basis.basis[0][0]
        parts, shapes = [], []
        for jet in JETS:
            part = np.asarray(first) if jet == "value" else getattr(first, jet)
            if part is None:
                continue
            tensor = np.shape(part)[:-2]
            parts.append((jet, tensor))
            stack = np.empty((*tensor, basis.Nbfun, elements, points))
            for i in range(basis.Nbfun):
                phi = basis.basis[i][0]
                array = np.asarray(phi) if jet == "value" else getattr(phi, jet)
                stack[..., i, :, :] = array
            shapes.append(stack.reshape(-1, basis.Nbfun, elements, points))
        dofs: IntArray = self._tie[basis.element_dofs]
        return Local(dofs, tuple(parts), np.concatenate(shapes))

    def jet(self, parts: Local, values: Array) -> DiscreteField:
        arrays, start = {}, 0
        for name, tensor in parts.parts:
            stop = start + int(np.prod(tensor, dtype=int))
            arrays[name] = values[start:stop].reshape(tensor + values.shape[1:])
            start = stop
        return DiscreteField(**arrays)

    def prior(self) -> Array:
        return self.interpolate(self.field.prior)

    def labels(self, name: str) -> tuple[str, ...]:
        return ()

    @property
    def nodal(self) -> bool:
        """True if coefficients are values at nodes: elements of first order."""
        return is_nodal(self.field.element)

    def interpolate(self, value: Any) -> Array:
        """Return coefficients of a number, or the L2 projection of a function of x."""
        if not callable(value):
            level = float(value)
            if level == 0.0 or self.nodal:
                return np.full(self.size, level)
            value = lambda x: np.full(np.shape(x[0]), level)  # noqa: E731
        if self.field.transform is not None:  # a projection need not stay within the bounds
            nodes = self.doflocs
            return np.asarray(value(nodes) + 0.0 * nodes[0])
        mass = BilinearForm(lambda u, v, w: inner(u, v)).assemble(self.basis)
        rhs = LinearForm(lambda v, w: inner(value(w.x) + 0.0 * w.x[0], v)).assemble(self.basis)
        tie = self._spread
        found: Array = spsolve(sp.csc_array(tie.T @ mass @ tie), tie.T @ rhs)
        return found

    def _value_dofs(self, name: str) -> IntArray:
        dofs = self.basis.get_dofs() if name == "boundary" else self.basis.get_dofs(name)
        # Essential conditions fix values; derivative unknowns (u_x, u_n, ...) stay free.
        names = [n for n in (self.field.element.dofnames or []) if "_" not in n]
        found: IntArray = np.unique(self._tie[dofs.all(names)])
        return found

    def _slope_dofs(self, name: str, axis: int) -> IntArray:
        """Return the unknowns of the derivative along a boundary, on its sides along an axis."""
        if not isinstance(self.field.element, ElementQuadBFS):
            return np.zeros(0, dtype=np.int64)
        mesh = self.field.mesh
        sides = mesh.boundary_facets() if name == "boundary" else mesh.boundaries[name]
        ends = mesh.p[:, mesh.facets[:, sides]]
        across = np.abs(ends[1 - axis, 1] - ends[1 - axis, 0])
        along = np.abs(ends[axis, 1] - ends[axis, 0])
        sides = np.asarray(sides)[across <= 1e-9 * along]
        names = [("u_x", "u_y")[axis]]
        found: IntArray = np.unique(self._tie[self.basis.get_dofs(facets=sides).all(names)])
        return found

    @cached_property
    def conditions(self) -> tuple[tuple[IntArray, Any], ...]:
        """The Dirichlet conditions, in the order given: (coefficients, value).

        Bogner-Fox-Schmit functions with the values of g at the vertices need its derivative along
        the boundary, too, to be g on the sides between them.
        """
        found: list[tuple[IntArray, Any]] = []
        for name, value in self.field.dirichlet.items():
            found.append((self._value_dofs(name), value))
            for axis in range(self.field.mesh.dim()):
                dofs = self._slope_dofs(name, axis)
                if len(dofs):
                    slope = _slope(value, axis, self.width) if callable(value) else 0.0
                    found.append((dofs, slope))
        return tuple(found)

    @cached_property
    def width(self) -> float:
        """Length of the shortest side of the mesh."""
        ends = self.field.mesh.p[:, self.field.mesh.facets]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=0).min())

    @cached_property
    def fixed(self) -> IntArray:
        """Coefficients fixed by Dirichlet conditions."""
        parts = [dofs for dofs, _ in self.conditions]
        return np.unique(np.concatenate(parts)) if parts else np.zeros(0, dtype=np.int64)

    def impose(self, coefficients: Array, moment: Moment) -> Array:
        """Return a copy of the coefficients with the Dirichlet values of this moment."""
        u = coefficients.copy()
        for dofs, value in self.conditions:
            if isinstance(value, Channel):
                u[dofs] = Place(u, None, moment).inputs[value.name]
            elif callable(value):
                u[dofs] = value(self.doflocs[:, dofs], moment.t)
            else:
                u[dofs] = value
        return u

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates of the mesh, each of shape (d,)."""
        p: Array = self.field.mesh.p
        return p.min(axis=1), p.max(axis=1)

    def contains(self, point: Array) -> bool:
        """Return true if a point, shape (d,), lies in the mesh."""
        low, high = self.box
        slack = 1e-12 * (high - low)
        inside = bool(np.all(point >= low - slack) and np.all(point <= high + slack))
        if inside and len(low) > 1:
            try:
                self.basis.mesh.element_finder()(*point[:, None])
            except ValueError:
                return False
        return inside

    def probe(self, points: Array, what: str = "point") -> sp.csr_array:
        """Return the matrix that evaluates the function at points of shape (d, k)."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        low, high = self.box
        if points.shape[0] != len(low):
            raise ObservationError(
                f"{what}: coordinates of dimension {points.shape[0]}; the mesh has {len(low)}."
            )
        for k, point in enumerate(points.T):
            if not self.contains(point):
                raise ObservationError(
                    f"{what} {k} at {point.tolist()} lies outside of the mesh, which spans "
                    f"{low.tolist()} to {high.tolist()}: check its coordinates and their unit."
                )
        return sp.csr_array(self.basis.probes(np.clip(points.T, low, high).T) @ self._spread)

    @cached_property
    def at_vertices(self) -> sp.csr_array:
        """Matrix that evaluates the function at the vertices of the mesh."""
        element, mesh = self.field.element, self.field.mesh
        names = element.dofnames or []
        if element.nodal_dofs and names and names[0] == "u":  # a coefficient is the value there
            dofs = self.basis.nodal_dofs[0]
            entries = (np.ones(len(dofs)), (np.arange(len(dofs)), dofs))
            values = sp.csr_array(entries, shape=(len(dofs), int(self.basis.N)))
            return sp.csr_array(values @ self._spread)
        return self.probe(mesh.p, "vertex")


def _slope(g: Any, axis: int, width: float) -> Any:
    """Return the derivative of g(x, t) along an axis, by a difference of sixth order."""
    step = 0.01 * width

    def slope(x: Array, t: float) -> Array:
        shift = np.zeros((len(x), 1))
        shift[axis] = step
        pairs = ((1, 45.0), (2, -9.0), (3, 1.0))
        total = sum(c * (g(x + k * shift, t) - g(x - k * shift, t)) for k, c in pairs)
        return np.asarray(total / (60.0 * step) + 0.0 * x[0])

    return slope


def block_of(unknown: Unknown) -> Block:
    """Return the block of an unknown."""
    if isinstance(unknown, Field):
        return FieldBlock(unknown)
    return NamesBlock(unknown) if isinstance(unknown, Scalars) else ScalarBlock(unknown)
