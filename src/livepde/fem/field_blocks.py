"""Blocks: coefficients and local shape functions for each kind of unknown on a measure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
import scipy.sparse as sp
from skfem import Basis, Dofs, Mesh
from skfem.element import DiscreteField, ElementQuadBFS

from livepde.errors import ObservationError, SpaceError
from livepde.fem.elementwise import scatter, shared
from livepde.fem.fields import Channel, Declaration, Field, Piecewise, Scalar, Scalars, is_nodal
from livepde.fem.measure import Measure, Moment, Place, own
from livepde.fem.meshes import tied
from livepde.fem.priors import Normal
from livepde.linalg import Array, Factor, IntArray, Pattern, analyse, conjugate_gradients

JETS = ("value", "grad", "hess")
# Relative residual of an L2 projection on a large mesh, which uses conjugate gradients.
PROJECTED = 1e-13
ITERATIONS = 1000
# Number of pairs of a point and a cell that are searched at once, which bounds the size of
# temporary arrays.
SEARCHED = 5_000_000
FINER = "give coefficients, or an element of first order."


class Local:
    """Shape functions of a block on a measure.

    `dofs` are the coefficients of the local shape functions, shape (local, elements). `parts` are
    the derivatives that a form receives, as (name, tensor shape), such as ("value", ()) and
    ("grad", (d,)). They have `components` numbers in total.
    """

    def __init__(
        self,
        dofs: IntArray,
        parts: Sequence[tuple[str, tuple[int, ...]]],
        evaluate: Callable[[str], Array],
    ) -> None:
        self.dofs = dofs
        self.parts = tuple(parts)
        self.sizes = [int(np.prod(tensor, dtype=int)) for _, tensor in parts]
        self.components = sum(self.sizes)
        self._evaluate = evaluate  # part -> array (its components, local, elements, points)
        self._known: dict[str, Array] = {}

    def part(self, name: str) -> Array:
        """Return the components of a derivative, shape (components, local, elements, points)."""
        if name not in self._known:
            self._known[name] = self._evaluate(name)
        return self._known[name]


class Block(ABC):
    """One unknown of a function space."""

    size: int
    unknown: Any

    def dofs_on(self, measure: Measure) -> IntArray:
        """Return the coefficient of each local shape function, shape (local, elements)."""
        numbers = np.arange(self.size, dtype=np.int32)[:, None]
        return np.broadcast_to(numbers, (self.size, measure.shape[0]))

    @abstractmethod
    def local(self, measure: Measure) -> Local:
        """Return the local shape functions on a measure."""

    @abstractmethod
    def jet(self, parts: Local, values: Array) -> Any:
        """Return the argument of a form for component values of shape (components, ..., E, P)."""

    def prolongation(self, finer: Any) -> sp.csr_array:
        """Return the matrix that maps coefficients to coefficients on a finer mesh."""
        return sp.csr_array(sp.eye_array(self.size))

    def prior(self) -> Array:
        """Return the prior mean as coefficients, shape (size,)."""
        return np.full(self.size, float(self.unknown.prior.centre))

    @abstractmethod
    def labels(self, name: str) -> tuple[str, ...]:
        """Return a label for each coefficient that is a scalar unknown (none for fields)."""


class ScalarBlock(Block):
    """Numbers that are constant in the domain (`Scalar`) or in each region (`Piecewise`)."""

    def __init__(self, unknown: Scalar | Piecewise) -> None:
        self.unknown = unknown
        self.regions = unknown.regions if isinstance(unknown, Piecewise) else {}
        self.size = len(self.regions) or 1

    def local(self, measure: Measure) -> Local:
        for name, region in self.regions.items():
            if not callable(region) and region not in (measure.mesh.subdomains or {}):
                raise SpaceError(
                    f"Region '{name}': the mesh has no subdomain '{region}'; give a predicate on x."
                )

        def indicators(_: str) -> Array:
            masks = np.zeros((1, self.size, *measure.shape))
            if not self.regions:
                return masks + 1.0
            cells = np.arange(measure.mesh.nelements) if measure.cells is None else measure.cells
            for mask, region in zip(masks[0], self.regions.values(), strict=True):
                if callable(region):
                    mask[:] = region(measure.points)
                else:
                    mask[np.isin(cells, measure.mesh.subdomains[region])] = 1.0
            return masks

        return Local(self.dofs_on(measure), [("value", ())], indicators)

    def jet(self, parts: Local, values: Array) -> Any:
        return values[0]

    def labels(self, name: str) -> tuple[str, ...]:
        return tuple(f"{base_name(name)}[{region}]" for region in self.regions) or (name,)


class NamesBlock(Block):
    """Named numbers (`Scalars`), constant in the domain."""

    def __init__(self, unknown: Scalars) -> None:
        self.unknown = unknown
        self.names = tuple(unknown.names)
        self.size = len(self.names)

    def local(self, measure: Measure) -> Local:
        def evaluate(name: str) -> Array:
            phi = np.zeros((1, self.size, *measure.shape))
            phi[0, self.names.index(name)] = 1.0
            return phi

        return Local(self.dofs_on(measure), [(name, ()) for name in self.names], evaluate)

    def jet(self, parts: Local, values: Array) -> dict[str, Array]:
        return dict(zip(self.names, values, strict=True))

    def labels(self, name: str) -> tuple[str, ...]:
        return tuple(f"{name}[{item}]" for item in self.names)


def _values(function: Callable[[Array], Any], x: Array) -> Array:
    """Return the values of a function of x at points of shape (d, ...)."""
    given = np.asarray(function(x))
    try:
        if given.dtype.kind not in "biuf":
            raise ValueError
        values_at: Array = given + 0.0 * x[0]
    except ValueError:
        raise SpaceError(
            f"a function of x returned an array of type {given.dtype} and shape {given.shape}; "
            f"expected one real number for each point, {x[0].shape}. x[0] is the first coordinate."
        ) from None
    return values_at


class FieldBlock(Block):
    """A finite-element function."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.element = own(field.element)
        self.dofs = Dofs(field.mesh, self.element)
        self.dofs.element_dofs = shared(self.dofs.element_dofs)
        self._tie = tied(field, self)
        self.size = int(self.dofs.N if self._tie is None else self._tie.max() + 1)

    def _tied(self, dofs: IntArray) -> IntArray:
        """Return coefficients for scikit-fem's degrees of freedom; periodic ones coincide."""
        return dofs if self._tie is None else self._tie[dofs]

    @cached_property
    def element_dofs(self) -> IntArray:
        """Coefficient of each local shape function, shape (local, elements)."""
        return self._tied(self.dofs.element_dofs)

    def dofs_on(self, measure: Measure) -> IntArray:
        cells = measure.cells
        return self.element_dofs if cells is None else self.element_dofs[:, cells]

    @cached_property
    def places(self) -> Array:
        """Position of each of scikit-fem's degrees of freedom, shape (d, degrees of freedom)."""
        mesh, element = self.field.mesh, self.element
        places = np.zeros((mesh.dim(), int(self.dofs.N)))
        for at, piece in Measure(mesh, 1).pieces():
            x = piece.mapped(element.doflocs.T)
            for i, dofs in enumerate(self.dofs.element_dofs[:, at]):
                places[:, dofs] = x[:, :, i]
        return places

    @cached_property
    def doflocs(self) -> Array:
        """Position of each coefficient, shape (d, size)."""
        if self._tie is None:
            return self.places
        _, first = np.unique(self._tie, return_index=True)
        return self.places[:, first]

    def at(self, facets: Any = None, names: Sequence[str] | None = None) -> IntArray:
        """Return scikit-fem's degrees of freedom on facets, by default on the whole boundary."""
        facets = self.field.mesh.normalize_facets(facets)
        dofs: IntArray = self.dofs.get_facet_dofs(facets).all(names)
        return dofs

    @cached_property
    def boundary(self) -> IntArray:
        """Coefficients on the boundary of the mesh, without periodic sides."""
        mesh = self.field.mesh
        free = mesh.boundary_facets()
        for name in chain(*self.field.periodic):
            free = np.setdiff1d(free, mesh.boundaries[name])
        return np.unique(self._tied(self.at(free)))

    @cached_property
    def basis(self) -> Any:
        """Basis of scikit-fem on the whole mesh, with the quadrature points of `measure`."""
        return Basis(self.field.mesh, self.element, dofs=self.dofs)

    @cached_property
    def _first_function(self) -> DiscreteField:
        """First shape function in the first cell, to inspect ranks and derivatives."""
        first = Measure(self.field.mesh, 1, members=np.zeros(1, dtype=np.int64), thin=True)
        return first.gbasis(self.element, 0)

    @property
    def vector(self) -> bool:
        """Whether the function has values in R^d."""
        return np.ndim(self._first_function) > 2

    def variables(self, name: str) -> list[str]:
        """Return the names of the components: the given name, or one for each axis of a vector."""
        axes = "xyz"[: self.field.mesh.dim()]
        return [f"{name}_{axis}" for axis in axes] if self.vector else [name]

    @property
    def bends(self) -> bool:
        """Whether the element provides second derivatives."""
        return self._first_function.hess is not None

    def local(self, measure: Measure) -> Local:
        if measure.mesh is not self.field.mesh:
            raise SpaceError(
                "State and parameter fields must share one mesh object; their elements may differ."
            )
        jets = {name: _jet(self._first_function, name) for name in JETS}
        parts = [(name, np.shape(jet)[:-2]) for name, jet in jets.items() if jet is not None]
        dofs = self.dofs_on(measure)
        functions: list[DiscreteField] = []

        def evaluate(part: str) -> Array:
            shape = (len(dofs), *measure.shape)
            if part == "value" and not functions:
                values = measure.lbasis(self.element, len(dofs))
                if values is not None:
                    return np.broadcast_to(values[:, None], shape)[None]
            if not functions:
                if measure.on_boundary:
                    basis = measure.facets(self.element, self.dofs).basis
                    functions.extend(function for (function,) in basis)
                else:
                    functions.extend(measure.gbasis(self.element, i) for i in range(len(dofs)))
            stack = np.stack([_jet(function, part) for function in functions], axis=-3)
            return stack.reshape(int(np.prod(stack.shape[:-3])), *shape)

        return Local(dofs, parts, evaluate)

    def jet(self, parts: Local, values: Array) -> DiscreteField:
        arrays, start = {}, 0
        for name, tensor in parts.parts:
            stop = start + int(np.prod(tensor, dtype=int))
            arrays[name] = values[start:stop].reshape(tensor + values.shape[1:])
            start = stop
        return DiscreteField(**arrays)

    def prior(self) -> Array:
        return self.interpolate(self.field.prior.centre)

    def labels(self, name: str) -> tuple[str, ...]:
        return ()

    @property
    def nodal(self) -> bool:
        """Whether coefficients are nodal values: elements of first order."""
        return is_nodal(self.field.element)

    def interpolate(self, value: Any) -> Array:
        """Return coefficients of a number, or the L2 projection of a function of x."""
        if not callable(value):
            try:
                level = float(value)
            except (TypeError, ValueError):
                text = f"got {value!r}; expected a number, or a function of x."
                raise SpaceError(text) from None
            # Only for nodal elements, all coefficients of a constant equal its value.
            if level == 0.0 or self.nodal:
                return np.full(self.size, level)
            value = lambda x: np.full(np.shape(x[0]), level)  # noqa: E731
        if not isinstance(self.field.prior, Normal):  # a projection could exceed the bounds
            return _values(value, self.doflocs)
        return self._projected(lambda at, piece: _values(value, piece.points))

    @cached_property
    def measure(self) -> Measure:
        """The whole mesh with the quadrature order of the mass matrix."""
        return Measure(self.field.mesh, 2 * int(self.element.maxdeg))

    def project(self, values: Array) -> Array:
        """Return the coefficients of the L2 projection of a function.

        `values`: values at the quadrature points of `measure`, one or several for each point.
        """
        grid = values.reshape(-1, *self.measure.shape)
        return self._projected(lambda at, piece: grid[:, at])

    def _projected(self, values: Callable[[slice, Measure], Array]) -> Array:
        functional = self._tested(self.measure, values)
        if self.measure.kept:
            return self._mass_factor.solve(functional)
        mass = self._mass(self.measure)
        scale = mass.diagonal()
        coefficients, _ = conjugate_gradients(
            mass.__matmul__, lambda r: r / scale, functional, PROJECTED, ITERATIONS, FINER
        )
        return coefficients

    def fitted(self, cells: IntArray) -> tuple[Array, Callable[[Array], Array]]:
        """Return evaluation points for a function on given cells, and its fit.

        Returns
        -------
        points
            Shape (d, points): nodes for an element of first order, otherwise quadrature points.
        fit
            Function from values at the points, shape (components, points), to coefficients, shape
            (size,), which are zero outside the cells: interpolation at the nodes, otherwise the L2
            projection on the cells.
        """
        used = np.unique(self.element_dofs[:, cells])
        zeros = np.zeros(self.size)
        if self.nodal:

            def at_nodes(values: Array) -> Array:
                coefficients = zeros.copy()
                coefficients[used] = values[0]
                return coefficients

            return self.doflocs[:, used], at_nodes
        measure = self.measure.on(cells)
        factor = _factor(sp.csr_array(self._mass(measure)[used][:, used]))

        def projected(values: Array) -> Array:
            grid = values.reshape(-1, *measure.shape)
            functional = self._tested(measure, lambda at, piece: grid[:, at])
            coefficients = zeros.copy()
            coefficients[used] = factor.solve(functional[used])
            return coefficients

        return measure.points.reshape(len(measure.points), -1), projected

    def _tested(self, measure: Measure, values: Callable[[slice, Measure], Array]) -> Array:
        """Return the integrals of a function times each shape function on a measure, (size,)."""
        functional = np.zeros(self.size)
        for at, piece in measure.pieces():
            local = self.local(piece)
            density = (values(at, piece) * piece.weights).reshape(-1, *piece.shape)
            tested = np.einsum("kep,kiep->ie", density, local.part("value"))
            np.add.at(functional, local.dofs.ravel(), tested.ravel())
        return functional

    def _mass(self, measure: Measure) -> sp.csr_array:
        """Return the mass matrix on a measure, shape (size, size)."""
        dofs = self.dofs_on(measure)
        places = scatter([(dofs, dofs)], (self.size, self.size))
        data = np.zeros(places.pattern.nnz)
        for at, piece in measure.pieces():
            phi = self.local(piece).part("value")
            places.add(data, 0, at, np.einsum("kiep,kjep->ije", phi * piece.weights, phi))
        return places.pattern.matrix(data)

    @cached_property
    def _mass_factor(self) -> Factor:
        return _factor(self._mass(self.measure))

    def _dofs_on(self, name: str, names: list[str] | None) -> IntArray:
        """Return the coefficients on a boundary with given names; None: all coefficients."""
        dofs = self.at(None if name == "boundary" else name, names)
        return np.unique(self._tied(dofs))

    def _values_on(self, name: str) -> IntArray:
        """Return the coefficients that an essential condition fixes.

        Derivatives (u_x, u_n, ...) are free unless the field is clamped.
        """
        values = [n for n in (self.field.element.dofnames or []) if "_" not in n]
        return self._dofs_on(name, None if self.field.clamped else values)

    def _axes(self, where: str) -> list[int]:
        """Return the axes for which the component of a vector is a coefficient."""
        names = self.field.element.dofnames or []
        axes = [k for k in range(3) if f"u^{k + 1}" in names]
        if not (self.vector and axes):
            reason = "has no components" if self.vector else "is not a vector"
            raise SpaceError(
                f"{where} has a value for each component, and the field {reason}: give a number."
            )
        return axes

    def _valued(self, name: str, value: Any) -> list[tuple[IntArray, Any]]:
        """Return the Dirichlet conditions on a boundary, possibly one for each component."""
        if not (isinstance(value, tuple) or (callable(value) and self.vector)):
            return [(self._values_on(name), value)]
        where = f"dirichlet: '{name}'"
        axes = self._axes(where)
        if callable(value):
            value = [_component(value, k, len(axes), where) for k in axes]
        if len(value) != len(axes):
            raise SpaceError(
                f"{where} has {len(value)} values; expected {len(axes)}, one for each component, "
                "None where it is free."
            )
        return [
            (self._dofs_on(name, [f"u^{k + 1}"]), part)
            for k, part in zip(axes, value, strict=True)
            if part is not None
        ]

    def _slope_dofs(self, name: str, axis: int) -> IntArray:
        """Return the coefficients of tangential derivatives on boundary sides along an axis."""
        if not isinstance(self.field.element, ElementQuadBFS):
            return np.zeros(0, dtype=np.int64)
        mesh = self.field.mesh
        sides = mesh.boundary_facets() if name == "boundary" else mesh.boundaries[name]
        ends = mesh.p[:, mesh.facets[:, sides]]
        height = np.abs(ends[1 - axis, 1] - ends[1 - axis, 0])
        length = np.abs(ends[axis, 1] - ends[axis, 0])
        sides = np.asarray(sides)[height <= 1e-9 * length]
        names = [("u_x", "u_y")[axis]]
        return np.unique(self._tied(self.at(sides, names)))

    @cached_property
    def conditions(self) -> tuple[tuple[IntArray, Any], ...]:
        """Dirichlet conditions in the given order: (coefficients, value).

        To interpolate g along the sides, Bogner-Fox-Schmit functions require the tangential
        derivative of g at the vertices in addition to its values.
        """
        conditions: list[tuple[IntArray, Any]] = []
        for name, value in self.field.dirichlet.items():
            conditions += self._valued(name, value)
            for axis in range(0 if self.field.clamped else self.field.mesh.dim()):
                dofs = self._slope_dofs(name, axis)
                if len(dofs):
                    slope = _slope(value, axis, self.width) if callable(value) else 0.0
                    conditions.append((dofs, slope))
        return tuple(conditions)

    @cached_property
    def width(self) -> float:
        """Length of the shortest edge of the mesh."""
        ends = self.field.mesh.p[:, self.field.mesh.facets]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=0).min())

    @cached_property
    def fixed(self) -> IntArray:
        """Coefficients fixed by Dirichlet conditions."""
        parts = [dofs for dofs, _ in self.conditions]
        return np.unique(np.concatenate(parts)) if parts else np.zeros(0, dtype=np.int64)

    def impose(self, coefficients: Array, moment: Moment) -> Array:
        """Return a copy of the coefficients with the Dirichlet values at a moment."""
        u = coefficients.copy()
        for dofs, value in self.conditions:
            if isinstance(value, Channel):
                u[dofs] = Place(u, None, moment).inputs[value.name]
            elif callable(value):
                try:
                    u[dofs] = value(self.doflocs[:, dofs], moment.t)
                except TypeError as error:
                    raise SpaceError(
                        f"dirichlet: a boundary value failed: {error}. "
                        "Expected a function g(x, t) with a number for each point."
                    ) from error
            else:
                u[dofs] = value
        return u

    def traces(self, value: Any, coefficients: Array) -> Iterator[tuple[str, Array]]:
        """Yield each channel of a Dirichlet condition, and the values of a function there."""
        # At the boundary, a projection differs from the given function of x.
        exact = callable(value) and not self.vector
        for k, (dofs, condition) in enumerate(self.conditions):
            if not isinstance(condition, Channel):
                continue
            # Exclude coefficients that another condition also fixes, where two boundaries meet.
            others = [item for j, (item, _) in enumerate(self.conditions) if j != k]
            separate = np.setdiff1d(dofs, np.concatenate([[], *others]))
            separate = separate if len(separate) else dofs
            x = self.doflocs[:, separate]
            yield condition.name, value(x) + 0.0 * x[0] if exact else coefficients[separate]

    def prolongation(self, finer: FieldBlock) -> sp.csr_array:
        """Return the matrix that maps coefficients to coefficients on a finer mesh.

        Raises
        ------
        SpaceError
            The element is not of first order, so its coefficients are not nodal values.
        """
        if not self.nodal:
            raise SpaceError(
                f"{type(self.field.element).__name__} is not an element of first order, whose "
                "coefficients are values."
            )
        return self.probe(finer.doflocs)

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Bounding box of the mesh: lowest and highest coordinates, each of shape (d,)."""
        p: Array = self.field.mesh.p
        return p.min(axis=1), p.max(axis=1)

    def contains(self, point: Array) -> bool:
        """Return whether a point, shape (d,), is inside the mesh."""
        return self._located(point[:, None])[1] is None

    def widths(self, point: Array) -> Array:
        """Return the widths along the axes of the cell that contains a point, shape (d,)."""
        (cell,), _ = self._located(point[:, None])
        mesh = self.field.mesh
        return np.asarray(np.ptp(mesh.p[:, mesh.t[:, cell]], axis=1))

    def _located(self, points: Array) -> tuple[IntArray, int | None]:
        """Return the cells of points of shape (d, k), and the index of the first point outside.

        If a point is outside, there are no cells; otherwise the index is None.
        """
        low, high = (corner[:, None] for corner in self.box)
        slack, nowhere = 1e-12 * (high - low), np.zeros(0, dtype=np.int64)
        out = ~((points >= low - slack) & (points <= high + slack)).all(axis=0)
        if out.any():
            return nowhere, int(out.argmax())
        try:
            return self._cells(np.clip(points, low, high)), None
        except ValueError:
            count = points.shape[1]
            alone = (k for k in range(count) if self._located(points[:, [k]])[1] is not None)
            return nowhere, 0 if count == 1 else next(alone)

    @cached_property
    def _unnamed(self) -> Mesh:
        """The mesh without boundaries and subdomains.

        To find a cell, scikit-fem splits quadrilaterals into triangles, and then searches all
        facets for each facet of a boundary.
        """
        return replace(self.field.mesh, _boundaries=None, _subdomains=None)

    def _cells(self, points: Array) -> IntArray:
        """Return the cell of each point, shape (k,); raise ValueError for a point outside."""
        mesh, measure = self._unnamed, Measure(self.field.mesh, 1)
        if not measure.kept:  # scikit-fem would store its search tree on the mesh permanently
            mesh = copy(mesh)
        finder = mesh.element_finder(mapping=measure.mapping)
        width = max(1, SEARCHED // mesh.nelements)  # number of points that are searched at once
        starts = range(0, points.shape[1], width)
        parts = [finder(*points[:, k : k + width]) for k in starts]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    def probe(self, points: Array, what: str = "point") -> sp.csr_array:
        """Return the matrix that evaluates the function at points of shape (d, k)."""
        points = np.atleast_2d(np.asarray(points, dtype=float))
        low, high = self.box
        if points.shape[0] != len(low):
            raise ObservationError(
                f"{what}: coordinates of dimension {points.shape[0]}; the mesh has {len(low)}."
            )
        cells, outside = self._located(points)
        if outside is not None:
            raise ObservationError(
                f"{what} {outside} at {points[:, outside].tolist()} lies outside the mesh, which "
                f"spans {low.tolist()} to {high.tolist()}: check its coordinates and their unit."
            )
        points = np.clip(points.T, low, high).T
        mapping = Measure(self.field.mesh, 1, members=cells).mapping
        X = mapping.invF(points[:, :, None], tind=cells)
        count = len(self.element_dofs)
        phi = np.array([self.element.gbasis(mapping, X, i, tind=cells)[0] for i in range(count)])
        rows = phi[0].size
        dofs = self.element_dofs[:, np.tile(cells, rows // max(len(cells), 1))]
        entries = (phi.ravel(), (np.tile(np.arange(rows), count), dofs.ravel()))
        return sp.csr_array(entries, shape=(rows, self.size))

    @cached_property
    def at_vertices(self) -> sp.csr_array:
        """Matrix that evaluates the function at the vertices of the mesh."""
        element, mesh = self.field.element, self.field.mesh
        names = element.dofnames or []
        if element.nodal_dofs and names and names[0] == "u":  # the first coefficient is the value
            dofs = self._tied(self.dofs.nodal_dofs[0])
            entries = (np.ones(len(dofs)), (np.arange(len(dofs)), dofs))
            return sp.csr_array(entries, shape=(len(dofs), self.size))
        return self.probe(mesh.p, "vertex")


def _component(g: Any, axis: int, count: int, where: str) -> Any:
    """Return a component of g(x, t); if g returns one row, it is the value of all components."""

    def component(x: Array, t: float) -> Any:
        values = g(x, t)
        if not isinstance(values, list | tuple) and np.ndim(values) < 2:
            return values
        if len(values) != count:
            raise SpaceError(
                f"{where}: g(x, t) has {len(values)} components; expected {count}, as in "
                "lambda x, t: (t * x[1], 0.0)."
            )
        return values[axis]

    return component


def _factor(mass: sp.csr_array) -> Factor:
    return analyse(Pattern.of(mass), symmetric=True).factorise(mass.sorted_indices().data)


def _jet(function: DiscreteField, name: str) -> Any:
    """Return a derivative of a function by name; None if the element does not provide it."""
    return np.asarray(function) if name == "value" else getattr(function, name)


def _slope(g: Any, axis: int, width: float) -> Any:
    """Return the derivative of g(x, t) along an axis, by a sixth-order central difference."""
    # For functions that the mesh resolves, the truncation error is (1/100)^6 = 1e-12, which is
    # about the rounding error of the difference.
    step = 0.01 * width

    def slope(x: Array, t: float) -> Array:
        shift = np.zeros((len(x), 1))
        shift[axis] = step
        pairs = ((1, 45.0), (2, -9.0), (3, 1.0))
        total = sum(c * (g(x + k * shift, t) - g(x - k * shift, t)) for k, c in pairs)
        return np.asarray(total / (60.0 * step) + 0.0 * x[0])

    return slope


def base_name(name: str) -> str:
    """Return the name of an unknown in forms, without its region: "k" for "k[soil]"."""
    return name.partition("[")[0]


def block_of(unknown: Declaration) -> Block:
    """Return the block of an unknown."""
    if isinstance(unknown, Field):
        return FieldBlock(unknown)
    return NamesBlock(unknown) if isinstance(unknown, Scalars) else ScalarBlock(unknown)
