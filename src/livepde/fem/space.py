"""Function spaces as products of blocks, as the weak forms and the laws see them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import SpaceError
from livepde.fem.blocks import FieldBlock, Measure, block_of
from livepde.fem.fields import Unknown
from livepde.fem.place import Moment
from livepde.linalg import Array, IntArray

__all__ = ["FunctionSpace", "LocalSpace", "Named"]


class Named(SimpleNamespace):
    """What forms and sensors see of several unknowns or components: q.D, u.c."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"there is no '{name}'; there are {sorted(vars(self))}")


class LocalSpace:
    """A function space on one measure: evaluation operators and local shape functions."""

    def __init__(self, space: FunctionSpace, measure: Measure) -> None:
        self.space = space
        self.locals = [block.local(measure) for block in space.blocks.values()]
        self.shape = measure.weights.shape
        counts = [len(local.phi) for local in self.locals]
        widths = [len(local.dofs) for local in self.locals]
        self.components = sum(counts)
        self.dofs: IntArray = np.concatenate(
            [local.dofs + start for local, start in zip(self.locals, space.starts, strict=True)]
        )
        self.phi = np.zeros((self.components, sum(widths), *self.shape))
        self._units: dict[tuple[int, int], Any] = {}
        first, left = 0, 0
        for local, count, width in zip(self.locals, counts, widths, strict=True):
            self.phi[first : first + count, left : left + width] = local.phi
            first, left = first + count, left + width

    @cached_property
    def evaluation(self) -> sp.csr_array:
        """Coefficients -> all components at all quadrature points (fact 10 of the design)."""
        components, _, elements, points = self.phi.shape
        c, i, e, p = np.nonzero(self.phi)
        rows = (c * elements + e) * points + p
        shape = (components * elements * points, self.space.dim)
        return sp.csr_array((self.phi[c, i, e, p], (rows, self.dofs[i, e])), shape=shape)

    @cached_property
    def evaluation_transposed(self) -> sp.csr_array:
        """Transpose of `evaluation`."""
        return sp.csr_array(self.evaluation.T)

    def values(self, coefficients: Array) -> Array:
        """Return the components of a function, shape (components, elements, points)."""
        values: Array = (self.evaluation @ coefficients).reshape(self.components, *self.shape)
        return values

    def zeros(self) -> Array:
        """Return the components of the zero function."""
        return np.zeros((self.components, *self.shape))

    def units(self, axis: int, axes: int) -> Array:
        """Return all unit jets at once, along batch axis `axis` of `axes`."""
        batch = [1] * axes
        batch[axis] = self.components
        return np.eye(self.components).reshape(self.components, *batch, 1, 1)

    def unit_jets(self, axis: int, axes: int) -> Any:
        """Return the jets of `units(axis, axes)`, kept: they never change."""
        if (axis, axes) not in self._units:
            self._units[axis, axes] = self.jets(self.units(axis, axes))
        return self._units[axis, axes]

    def jets(self, values: Array) -> Any:
        """Return what a form gets for component values of shape (components, ..., E, P)."""
        start, jets = 0, []
        for block, local in zip(self.space.blocks.values(), self.locals, strict=True):
            stop = start + len(local.phi)
            jets.append(block.jet(local, values[start:stop]))
            start = stop
        if self.space.single:
            return jets[0]
        return Named(**dict(zip(self.space.blocks, jets, strict=True)))


@dataclass(frozen=True, eq=False)
class FunctionSpace:
    """A product of unknowns, each a field, a scalar, or values per region.

    Parameters
    ----------
    unknowns
        Name -> unknown. `single` says that forms get the unknown itself, not a namespace.
    """

    unknowns: Mapping[str, Unknown]
    single: bool

    @classmethod
    def of(cls, unknown: Unknown | Mapping[str, Unknown], name: str) -> FunctionSpace:
        """Return the space of one unknown, called `name`, or of a mapping of several."""
        if isinstance(unknown, Mapping):
            if not unknown:
                raise SpaceError("parameter={}: name at least one unknown.")
            for key in unknown:
                if not key.isidentifier():
                    raise SpaceError(f"unknown '{key}': the name must be a Python identifier.")
            return cls(dict(unknown), single=False)
        return cls({getattr(unknown, "name", "") or name: unknown}, single=True)

    @cached_property
    def blocks(self) -> dict[str, Any]:
        """Name -> block."""
        return {name: block_of(unknown) for name, unknown in self.unknowns.items()}

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """First coefficient of each block."""
        sizes = [block.size for block in self.blocks.values()]
        return tuple(int(s) for s in np.concatenate(([0], np.cumsum(sizes)[:-1])))

    @cached_property
    def dim(self) -> int:
        """Number of coefficients."""
        return sum(block.size for block in self.blocks.values())

    def part(self, name: str) -> slice:
        """Return where the coefficients of one block stand."""
        start = self.starts[list(self.blocks).index(name)]
        return slice(start, start + self.blocks[name].size)

    @cached_property
    def fixed(self) -> IntArray:
        """Coefficients fixed by Dirichlet conditions."""
        parts = [
            block.fixed + start
            for block, start in zip(self.blocks.values(), self.starts, strict=True)
            if isinstance(block, FieldBlock)
        ]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    @cached_property
    def prior(self) -> Array:
        """Prior mean as coefficients, shape (dim,)."""
        return np.concatenate([block.prior() for block in self.blocks.values()])

    @cached_property
    def labels(self) -> dict[str, int]:
        """Label of each scalar unknown -> its coefficient."""
        found: dict[str, int] = {}
        for (name, block), start in zip(self.blocks.items(), self.starts, strict=True):
            for k, label in enumerate(block.labels(name)):
                found[label] = start + k
        return found

    @cached_property
    def fields(self) -> dict[str, FieldBlock]:
        """Name -> block of each unknown that is a field."""
        return {n: block for n, block in self.blocks.items() if isinstance(block, FieldBlock)}

    def component(self, of: str = "") -> tuple[FieldBlock, slice]:
        """Return a component of the state and where its coefficients stand.

        Parameters
        ----------
        of
            Its name; empty stands for the only one.

        Raises
        ------
        SpaceError
            There is no such component, or several and none is named.
        """
        if not of and len(self.fields) == 1:
            of = next(iter(self.fields))
        if not of:
            raise SpaceError(
                f"the state has the components {list(self.fields)}: say which one is meant, as in "
                f'of="{next(iter(self.fields), "u")}".'
            )
        if of not in self.fields:
            raise SpaceError(f"of='{of}': the components of the state are {list(self.fields)}.")
        return self.fields[of], self.part(of)

    def widen(self, matrix: sp.csr_array, of: str = "") -> sp.csr_array:
        """Return a matrix on the coefficients of one component as one on all, (k, dim)."""
        _, part = self.component(of)
        entries = (matrix.data, matrix.indices + part.start, matrix.indptr)
        return sp.csr_array(entries, shape=(matrix.shape[0], self.dim))

    def probe(self, points: Array, what: str = "point", of: str = "") -> sp.csr_array:
        """Return the matrix (k, dim) that evaluates a component at points of shape (d, k)."""
        return self.widen(self.component(of)[0].probe(points, what), of)

    def impose(self, coefficients: Array, moment: Moment) -> Array:
        """Return a copy of the coefficients with the Dirichlet values of all components."""
        if len(self.blocks) == 1:
            (block,) = self.fields.values()
            return block.impose(coefficients, moment)
        u = coefficients.copy()
        for name, block in self.fields.items():
            u[self.part(name)] = block.impose(u[self.part(name)], moment)
        return u

    def local(self, measure: Measure) -> LocalSpace:
        """Return the space on a measure, built once: all forms share it."""
        key = (id(measure.mesh), measure.order, measure.name)
        if key not in self._locals:
            self._locals[key] = LocalSpace(self, measure)
        return self._locals[key]

    @cached_property
    def _locals(self) -> dict[tuple[int, int, str | None], LocalSpace]:
        return {}

    def interpolate(self, value: Any) -> Array:
        """Return coefficients of a number, a function of x, coefficients, or a mapping by name.

        For several fields a number stands for all of them.
        """
        if isinstance(value, Mapping):
            unknown = set(value) - set(self.blocks)
            if unknown:
                raise SpaceError(
                    f"no unknown is called {sorted(unknown)}; {list(self.blocks)} are."
                )
            result = self.prior.copy()
            for name, item in value.items():
                result[self.part(name)] = self._interpolate(name, item)
            return result
        if self.single:
            return self._interpolate(next(iter(self.blocks)), value)
        if len(self.fields) == len(self.blocks) and np.ndim(value) == 0 and not callable(value):
            return np.concatenate([block.interpolate(value) for block in self.blocks.values()])
        if callable(value):
            raise SpaceError(
                f"a function of x for {list(self.blocks)}: give a mapping, a function for each."
            )
        array = np.asarray(value, dtype=float)
        if array.shape != (self.dim,):
            raise SpaceError(f"coefficients of shape {array.shape}; expected ({self.dim},).")
        return array.copy()

    def _interpolate(self, name: str, value: Any) -> Array:
        block = self.blocks[name]
        if isinstance(block, FieldBlock) and (callable(value) or np.ndim(value) == 0):
            return block.interpolate(value)
        array = np.asarray(value, dtype=float)
        if array.ndim == 0:
            return np.full(block.size, float(array))
        if array.shape != (block.size,):
            raise SpaceError(
                f"'{name}': coefficients of shape {array.shape}; expected ({block.size},)."
            )
        return array.copy()
