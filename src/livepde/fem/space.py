"""Function spaces as products of blocks, for weak forms and laws."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp
from skfem import Mesh
from skfem.helpers import dot

from livepde.errors import ModelError, SpaceError
from livepde.fem.field_blocks import FieldBlock, Local, NamesBlock, base_name, block_of
from livepde.fem.fields import (
    Declaration,
    Integrand,
    On,
    Piecewise,
    Scalar,
    Source,
    Unknown,
    declared,
    ignores,
)
from livepde.fem.measure import Measure, Moment, unweighted
from livepde.fem.sensor_states import SensorBlock, SensorMeasure, SensorState
from livepde.linalg import Array, IntArray, Mask, compact


class Named(SimpleNamespace):
    """Namespace for several unknowns or components in forms and sensors: q.D, u.c."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"there is no '{name}'; there are {sorted(vars(self))}")


class LocalSpace:
    """Function space on one measure: point values, and integrals times shape functions.

    On a cached measure, all operations are products with precomputed sparse or dense matrices. On a
    piece of a larger measure, nothing is precomputed, and derivatives that a form does not use are
    never evaluated.
    """

    def __init__(self, space: FunctionSpace, measure: Measure) -> None:
        self.space = space
        self.kept = measure.kept and measure.members is None and not measure.thin
        self.blocks = space.blocks_on(measure)
        self.locals = [block.local(measure) for block in self.blocks.values()]
        self.shape = measure.shape
        self.components = sum(local.components for local in self.locals)
        self.dofs: IntArray = space.dofs_on(measure)
        self._units: dict[tuple[int, int], Any] = {}

    @cached_property
    def _owners(self) -> list[tuple[Local, slice, str, int]]:
        """Block, slice of local functions, derivative, and index in it for each component."""
        owners, start = [], 0
        for local in self.locals:
            columns = slice(start, start + len(local.dofs))
            for (name, _), size in zip(local.parts, local.sizes, strict=True):
                owners += [(local, columns, name, k) for k in range(size)]
            start = columns.stop
        return owners

    @property
    def owners(self) -> list[tuple[int, str]]:
        """Index of the block, and name of the derivative, for each component."""
        return [(self.locals.index(local), name) for local, _, name, _ in self._owners]

    @cached_property
    def derivatives(self) -> Mask:
        """Mask of the components of fields that are derivatives, shape (components,)."""
        return np.array([name != "value" for _, _, name, _ in self._owners])

    def component(self, k: int) -> tuple[slice, Array]:
        """Return the slice of local functions of a component, and their values (local, E, P)."""
        local, columns, name, at = self._owners[k]
        return columns, local.part(name)[at]

    @cached_property
    def phi(self) -> Array:
        """All components of all local functions, shape (components, local, elements, points)."""
        phi = np.zeros((self.components, len(self.dofs), *self.shape))
        for k in range(self.components):
            columns, values = self.component(k)
            phi[k, columns] = values
        return phi

    @cached_property
    def evaluation(self) -> sp.csr_array:
        """Matrix from coefficients to all components at all points, (components * E * P, dim)."""
        components, _, elements, points = self.phi.shape
        c, i, e, p = np.nonzero(self.phi)
        rows = (c * elements + e) * points + p
        shape = (components * elements * points, self.space.dim)
        return sp.csr_array((self.phi[c, i, e, p], (rows, self.dofs[i, e])), shape=shape)

    @cached_property
    def _evaluation_transposed(self) -> sp.csr_array | Array:
        return compact(sp.csr_array(self.evaluation.T))

    def values(self, coefficients: Array) -> Array:
        """Return the components of a function, shape (components, elements, points)."""
        if self.kept:
            return (self.evaluation @ coefficients).reshape(self.components, *self.shape)
        local = coefficients[self.dofs]
        values = np.empty((self.components, *self.shape))
        for k in range(self.components):
            columns, phi = self.component(k)
            np.einsum("ie,iep->ep", local[columns], phi, out=values[k])
        return values

    def tested(self, density: Array, weights: Array) -> Array:
        """Return the integrals of a density, shape (components, E, P), times each function."""
        if self.kept:
            weighted = np.empty((self.components, *self.shape))
            np.multiply(density, weights, out=weighted)
            return self._evaluation_transposed @ weighted.ravel()
        local = np.zeros(self.dofs.shape)
        for (k,), part in _parts(density, (self.components,)):
            columns, phi = self.component(k)
            local[columns] += np.einsum("ep,iep->ie", part * weights, phi)
        result = np.zeros(self.space.dim)
        np.add.at(result, self.dofs.ravel(), local.ravel())
        return result

    def paired(self, density: Array, weights: Array, other: LocalSpace) -> Array:
        """Return the integrals of a density times each pair of functions, shape (i, j, E).

        The density has the shape (components, components of `other`, E, P).
        """
        shape = (self.components, other.components)
        if self.kept:
            weighted = np.broadcast_to(density * weights, (*shape, *self.shape))
            half = np.einsum("klep,kiep->liep", weighted, self.phi, optimize=False)
            paired: Array = np.einsum("liep,ljep->ije", half, other.phi, optimize=False)
            return paired
        result = np.zeros((len(self.dofs), *other.dofs.shape))
        for (k, m), part in _parts(density, shape):
            (rows, phi), (cols, psi) = self.component(k), other.component(m)
            result[rows, cols] += np.einsum("iep,jep->ije", part * weights * phi, psi)
        return result

    def tripled(
        self, density: Array, weights: Array, second: LocalSpace, third: LocalSpace
    ) -> Array:
        """Return the integrals of a density times each triple of functions, (i, j, n, E)."""
        shape = (self.components, second.components, third.components)
        if self.kept:
            weighted = np.broadcast_to(density * weights, (*shape, *self.shape))
            step = np.einsum("klmep,kiep->ilmep", weighted, self.phi, optimize=False)
            step = np.einsum("ilmep,ljep->ijmep", step, second.phi, optimize=False)
            tripled: Array = np.einsum("ijmep,mnep->ijne", step, third.phi, optimize=False)
            return tripled
        result = np.zeros((len(self.dofs), len(second.dofs), *third.dofs.shape))
        for (k, l, m), part in _parts(density, shape):
            at, phi = self.component(k)
            (rows, psi), (cols, chi) = second.component(l), third.component(m)
            product = np.einsum("iep,jep->ijep", part * weights * phi, psi)
            result[at, rows, cols] += np.einsum("ijep,nep->ijne", product, chi)
        return result

    def zeros(self) -> Array:
        """Return the components of the zero function."""
        return np.zeros((self.components, *self.shape))

    def units(self, axis: int, axes: int) -> Array:
        """Return all unit jets as one batch along the batch axis `axis` of `axes`."""
        batch = [1] * axes
        batch[axis] = self.components
        return np.eye(self.components).reshape(self.components, *batch, 1, 1)

    def unit_jets(self, axis: int, axes: int) -> Any:
        """Return the jets of `units(axis, axes)`, which are cached."""
        if (axis, axes) not in self._units:
            self._units[axis, axes] = self.jets(self.units(axis, axes))
        return self._units[axis, axes]

    def jets(self, values: Array) -> Any:
        """Return the argument of a form for component values of shape (components, ..., E, P)."""
        start, jets = 0, []
        for block, local in zip(self.blocks.values(), self.locals, strict=True):
            stop = start + local.components
            jets.append(block.jet(local, values[start:stop]))
            start = stop
        if self.space.single or any(name in self.space.sensors for name in self.blocks):
            return jets[0]
        # Regions with separate priors, such as k[soil], sum to q.k: each is zero elsewhere.
        by_name: dict[str, Any] = {}
        for name, jet in zip(map(base_name, self.blocks), jets, strict=True):
            by_name[name] = by_name[name] + jet if name in by_name else jet
        return Named(**by_name)


def _parts(density: Array, axes: tuple[int, ...]) -> Iterator[tuple[tuple[int, ...], Array]]:
    """Yield index and values of each non-zero component of a density."""
    density = np.asarray(density)
    density = density.reshape((1,) * (len(axes) + 2 - density.ndim) + density.shape)
    density = np.broadcast_to(density, axes + density.shape[len(axes) :])
    for index in np.ndindex(axes):
        # Most components of a density are exactly zero, because a form uses few derivatives.
        if density[index].any():
            yield index, density[index]


@dataclass(frozen=True, kw_only=True)
class NamedUnknowns:
    """Names of unknowns, their indices among the coefficients, and their priors.

    Estimates contain this instead of a `FunctionSpace`, because functions of regions and boundary
    values cannot be pickled. Each of `unknowns` is a `Scalar` with the prior, evolution and unit of
    an unknown; `fields` has the names of fields as keys.
    """

    labels: Mapping[str, int]
    parts: Mapping[str, slice]
    fields: Mapping[str, None]
    unknowns: Mapping[str, Scalar]

    @property
    def described(self) -> NamedUnknowns:
        """The object itself, see `FunctionSpace.described`."""
        return self

    def part(self, name: str) -> slice:
        return self.parts[name]

    def unknown_of(self, label: str) -> Scalar:
        return self.unknowns[label if label in self.unknowns else base_name(label)]


@dataclass(frozen=True, eq=False)
class FunctionSpace:
    """A product of unknowns, each a field, a scalar, or values per region.

    With `single`, the argument of forms is the unknown itself instead of a namespace. Regions with
    separate priors are unknowns, such as "k[soil]", whose sum is q.k in forms. A state may also
    have slow `sensors`: name -> row of the input on the fields, (1, n).
    """

    unknowns: Mapping[str, Declaration]
    single: bool
    sensors: Mapping[str, sp.csr_array] = field(default_factory=dict)

    @classmethod
    def of(cls, unknown: Unknown | Mapping[str, Unknown], name: str) -> FunctionSpace:
        """Return the space of one unknown with the given name, or of a mapping of unknowns."""
        if isinstance(unknown, Mapping):
            if not unknown:
                raise SpaceError("parameter={}: name at least one unknown.")
            for key in unknown:
                if not key.isidentifier():
                    raise SpaceError(f"unknown '{key}': the name must be a Python identifier.")
            separated: dict[str, Declaration] = {}
            for key, value in unknown.items():
                item = declared(value)
                separated |= item.separated(key) if isinstance(item, Piecewise) else {key: item}
            return cls(separated, single=False)
        single = declared(unknown)
        if isinstance(single, Piecewise) and single.own:
            raise SpaceError(
                "Piecewise: with own= it needs a name: parameter={'k': Piecewise(...)}."
            )
        return cls({getattr(single, "name", "") or name: single}, single=True)

    @cached_property
    def blocks(self) -> dict[str, Any]:
        """Name -> block, for all unknowns and slow sensors."""
        blocks: dict[str, Any] = {name: block_of(item) for name, item in self.unknowns.items()}
        size = sum(block.size for block in blocks.values())
        rows = enumerate(self.sensors.items(), size)
        return blocks | {name: SensorBlock(number, row) for number, (name, row) in rows}

    def blocks_on(self, measure: Measure) -> dict[str, Any]:
        """Return name -> block, for the arguments of forms on a measure."""
        if not isinstance(measure, SensorMeasure):
            return {name: block for name, block in self.blocks.items() if name not in self.sensors}
        if self.sensors:
            return {measure.sensor: self.blocks[measure.sensor]}
        # In a space of unknowns, only blocks with named numbers are available.
        return {name: block for name, block in self.blocks.items() if isinstance(block, NamesBlock)}

    def with_sensors(self, sensors: Mapping[str, SensorState]) -> FunctionSpace:
        """Return the space with additional states of slow sensors."""
        if not sensors:
            return self
        if clashes := sorted(set(sensors) & set(self.parts)):
            raise ModelError(f"sensor and component are both called '{clashes[0]}': rename one.")
        return replace(self, sensors={name: state.row(self) for name, state in sensors.items()})

    @property
    def seen(self) -> int:
        """Number of coefficients of fields; the states of slow sensors follow."""
        return self.dim - len(self.sensors)

    @cached_property
    def of_fields(self) -> Array:
        """Ones for coefficients of fields, and zeros for states of sensors, shape (dim,)."""
        return np.repeat([1.0, 0.0], [self.seen, len(self.sensors)])

    def completed(self, u: Array) -> Array:
        """Return states, (dim,) or (dim, k), with outputs of slow sensors equal to their inputs."""
        if not self.sensors:
            return u
        completed = u.copy()
        for name, row in self.sensors.items():
            completed[self.part(name)] = row @ u[: row.shape[1]]
        return completed

    @cached_property
    def mesh(self) -> Mesh:
        """Common mesh of the components of a state."""
        if len(self.fields) < len(self.unknowns):
            numbers = sorted(set(self.unknowns) - set(self.fields))
            raise ModelError(f"state: {numbers} must be a Field, on the mesh of the others.")
        meshes = [block.field.mesh for block in self.fields.values()]
        if any(mesh is not meshes[0] for mesh in meshes):
            raise ModelError(
                f"state: the components {list(self.fields)} must share one mesh object; their "
                "elements may differ."
            )
        return meshes[0]

    @cached_property
    def weight(self) -> Callable[[Array], Any]:
        """Volume element of the coordinates of a state.

        Raises `ModelError`: it differs between components, or is negative at a vertex.
        """
        points = self.mesh.p
        weights = [block.field.weight for block in self.fields.values()]
        first, *others = (np.broadcast_to(weight(points), points.shape[1:]) for weight in weights)
        if not (np.isfinite(first).all() and (first >= 0.0).all() and first.any()):
            raise ModelError(
                "state: weight must be 0 or more at each vertex of the mesh, and not 0 everywhere; "
                f"got {first.min():g} to {first.max():g}."
            )
        if any(not np.array_equal(first, other) for other in others):
            raise ModelError(
                f"state: the components {list(self.fields)} must have one weight in common."
            )
        return weights[0]

    def product(self, u: Any, v: Any, x: Any) -> Any:
        """Return the integrand of the L2 inner product of a state: a sum over components."""
        products = {name: _product(block) for name, block in self.fields.items()}
        if self.single:
            (single,) = products.values()
            return single(u, v)
        return sum(form(getattr(u, name), getattr(v, name)) for name, form in products.items())

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """First coefficient of each block."""
        sizes = [block.size for block in self.blocks.values()]
        return tuple(int(s) for s in np.concatenate(([0], np.cumsum(sizes)[:-1])))

    @cached_property
    def dim(self) -> int:
        """Number of coefficients."""
        return sum(block.size for block in self.blocks.values())

    @cached_property
    def parts(self) -> dict[str, slice]:
        """Slice of coefficients for each block, and for each name in forms."""
        parts: dict[str, slice] = {}
        for (name, block), start in zip(self.blocks.items(), self.starts, strict=True):
            parts[name] = slice(start, start + block.size)
            first = parts.get(base_name(name), parts[name])
            parts[base_name(name)] = slice(first.start, start + block.size)
        return parts

    def part(self, name: str) -> slice:
        """Return the slice of coefficients of a block, or of all regions of an unknown."""
        return self.parts[name]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of unknowns in forms."""
        return tuple(dict.fromkeys(map(base_name, self.blocks)))

    def unknown_of(self, label: str) -> Declaration:
        """Return the unknown with a scalar label."""
        return self.unknowns[label if label in self.unknowns else base_name(label)]

    @cached_property
    def fixed(self) -> IntArray:
        """Coefficients fixed by Dirichlet conditions."""
        parts = [block.fixed + self.part(name).start for name, block in self.fields.items()]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    @cached_property
    def prior(self) -> Array:
        """Prior mean as coefficients, shape (dim,)."""
        return self.completed(np.concatenate([block.prior() for block in self.blocks.values()]))

    @cached_property
    def labels(self) -> dict[str, int]:
        """Label of a scalar unknown -> index of its coefficient."""
        labels: dict[str, int] = {}
        for (name, block), start in zip(self.blocks.items(), self.starts, strict=True):
            labels |= {label: start + k for k, label in enumerate(block.labels(name))}
        return labels

    @cached_property
    def described(self) -> NamedUnknowns:
        """Names and priors of the space, without functions and meshes, for estimates."""
        return NamedUnknowns(
            labels=self.labels,
            parts=self.parts,
            fields=dict.fromkeys(self.fields),
            unknowns={
                name: Scalar(unknown.prior, unknown.unit, unknown.evolution, unknown.within)
                for name, unknown in self.unknowns.items()
            },
        )

    @cached_property
    def fields(self) -> dict[str, FieldBlock]:
        """Name -> block, for unknowns that are fields."""
        return {n: block for n, block in self.blocks.items() if isinstance(block, FieldBlock)}

    def component(self, of: str = "") -> tuple[FieldBlock, slice]:
        """Return the component `of` the state and the slice of its coefficients.

        Raises
        ------
        SpaceError
            There is no such component, or there are several and `of` is empty.
        """
        if not of and len(self.fields) == 1:
            of = next(iter(self.fields))
        if not of:
            raise SpaceError(
                f"the state has the components {list(self.fields)}: specify one, as in "
                f'of="{next(iter(self.fields), "u")}".'
            )
        if of not in self.fields:
            raise SpaceError(f"of='{of}': the components of the state are {list(self.fields)}.")
        return self.fields[of], self.part(of)

    def widen(self, matrix: sp.csr_array, of: str = "") -> sp.csr_array:
        """Return a matrix on one component, padded to act on all coefficients, (k, dim)."""
        _, part = self.component(of)
        entries = (matrix.data, matrix.indices + part.start, matrix.indptr)
        return sp.csr_array(entries, shape=(matrix.shape[0], self.dim))

    def probe(self, points: Array, what: str = "point", of: str = "") -> sp.csr_array:
        """Return the matrix (k, dim) that evaluates a component at points of shape (d, k)."""
        return self.widen(self.component(of)[0].probe(points, what), of)

    def prolongation(self, finer: FunctionSpace) -> sp.csr_array:
        """Return the matrix that maps coefficients to coefficients on a finer mesh."""
        pairs = zip(self.blocks.values(), finer.blocks.values(), strict=True)
        parts = [block.prolongation(other) for block, other in pairs]
        return sp.csr_array(sp.block_diag(parts, format="csr"))

    def impose(self, coefficients: Array, moment: Moment) -> Array:
        """Return a copy of the coefficients with the Dirichlet values of all components."""
        if len(self.blocks) == 1:
            (block,) = self.fields.values()
            return block.impose(coefficients, moment)
        u = coefficients.copy()
        for name, block in self.fields.items():
            u[self.part(name)] = block.impose(u[self.part(name)], moment)
        return u

    def dofs_on(self, measure: Measure) -> IntArray:
        """Return the coefficient of each local function on a measure, shape (local, elements)."""
        starts = dict(zip(self.blocks, self.starts, strict=True))
        dofs: list[IntArray] = [
            block.dofs_on(measure) if starts[name] == 0 else block.dofs_on(measure) + starts[name]
            for name, block in self.blocks_on(measure).items()
        ]
        return dofs[0] if len(dofs) == 1 else np.concatenate(dofs)

    def local(self, measure: Measure) -> LocalSpace:
        """Return the local space on a measure; all forms share cached ones."""
        if measure.members is not None or measure.thin or not measure.kept:
            return LocalSpace(self, measure)
        key = (id(measure.mesh), measure.order, measure.name)
        if key not in self._locals:
            self._locals[key] = LocalSpace(self, measure)
        return self._locals[key]

    @cached_property
    def _locals(self) -> dict[tuple[int, int, str | None], LocalSpace]:
        return {}

    def interpolate(self, value: Any) -> Array:
        """Return coefficients from a number, a function of x, coefficients, or a mapping by name.

        With several fields, a number is the value of all of them. The outputs of slow sensors equal
        their inputs, unless the given coefficients include them.
        """
        if isinstance(value, Mapping):  # other unknowns have the coefficients of the prior
            if unknown := set(value) - set(self.parts):
                raise SpaceError(f"no unknown is called {sorted(unknown)}; {list(self.parts)} are.")
            result = self.prior.copy()
            for name, item in value.items():
                result[self.part(name)] = self._interpolate(name, item)
            return self.completed(result)
        if np.shape(value) == (self.dim,):
            return _coefficients(value, self.dim)
        size = self.dim - len(self.sensors)
        return self.completed(np.append(self._all(value, size), np.zeros(self.dim - size)))

    def _all(self, value: Any, size: int) -> Array:
        """Return the coefficients of all unknowns, without states of sensors."""
        if self.single:
            return self._interpolate(next(iter(self.blocks)), value)
        if callable(value):
            raise SpaceError(
                f"a function of x for {list(self.blocks)}: give a mapping, a function for each."
            )
        if len(self.fields) == len(self.unknowns) and np.ndim(value) == 0:
            return np.concatenate([block.interpolate(value) for block in self.fields.values()])
        return _coefficients(value, size)

    def _interpolate(self, name: str, value: Any) -> Array:
        block, part = self.blocks.get(name), self.part(name)
        if isinstance(block, FieldBlock) and (callable(value) or np.ndim(value) == 0):
            return block.interpolate(value)
        size = part.stop - part.start
        return _coefficients(np.full(size, value) if np.ndim(value) == 0 else value, size, name)


def _coefficients(value: Any, size: int, name: str = "") -> Array:
    array = np.array(value, dtype=float)
    if array.shape != (size,):
        whose = f"'{name}': " if name else ""
        raise SpaceError(f"{whose}coefficients of shape {array.shape}; expected ({size},).")
    return array


def _product(block: FieldBlock) -> Callable[[Any, Any], Any]:
    """Return the pointwise product of two functions: u v, or u . v for vectors."""
    return dot if block.vector else lambda u, v: u * v


def source_density(source: Source | On, state: FunctionSpace) -> Integrand | On:
    """Return a source density as an integrand (v, x)."""
    if isinstance(source, On):
        return On(source.name, _density(source.form, state))
    return _density(source, state)


def _density(source: Source, state: FunctionSpace) -> Integrand:
    if isinstance(source, Mapping):
        parts = {
            name: _single_density(item, state.component(name)[0]) for name, item in source.items()
        }
        if state.single:
            raise ModelError("f: a mapping is for a state of several components.")
        return lambda v, x: sum(form(getattr(v, name), x) for name, form in parts.items())
    if not callable(source) and float(source) == 0.0:
        return lambda v, x: 0.0 * x[0]
    if not state.single:
        raise ModelError(
            f"f: the state has the components {list(state.fields)}; give a mapping, such as "
            f'f={{"{next(iter(state.fields))}": ...}}.'
        )
    return _single_density(source, state.component()[0])


def _single_density(source: Any, block: FieldBlock) -> Integrand:
    product = _product(block)
    if callable(source):
        timed = not ignores(source, 1)  # otherwise the form would count as time-dependent
        return lambda v, x: product(source(x, x.t if timed else 0.0), v)
    level = float(source)
    return lambda v, x: level * v


def volume_element(spaces: Iterable[FunctionSpace]) -> Callable[[Array], Any]:
    """Return the volume element of the coordinates from the first weighted field in the spaces."""
    blocks = [block for space in spaces for block in space.fields.values()]
    stated = [block.field.weight for block in blocks if block.field.weight is not unweighted]
    return stated[0] if stated else unweighted
