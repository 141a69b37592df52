"""Constant trilinear forms on large meshes: element by element, in place of a sparse matrix.

The integrals of all products of local functions over an element are a small tensor. Those of all
elements are combinations of few, to rounding: of q u v on triangles with straight sides, whatever
their size and shape, of a single one. So r numbers for each element are kept, the r tensors, and
where the entries of an element matrix stand: of P1 functions in the plane about 200 bytes for each
node, for all three matrices of a form.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from livepde.fem.scatter import Scatter
from livepde.linalg import Array, IntArray

__all__ = ["ElementProducts", "ElementTensor"]

EXACT = 1e-13  # what combinations may leave of an element's tensor, relative to it
BLOCK = 8_000  # elements that are multiplied at once


@dataclass(frozen=True, eq=False)
class _Term:
    """Tensors of shape (i, j, n, r), and how much of each an element has, shape (r, elements)."""

    tensors: Array
    shares: Array
    dofs: Mapping[str, IntArray]


@dataclass(frozen=True, eq=False)
class ElementProducts:
    """The integrals of all products of local functions of three arguments over each element."""

    order: tuple[str, ...]
    terms: tuple[_Term, ...]

    @classmethod
    def of(
        cls,
        order: tuple[str, ...],
        terms: Iterable[tuple[Mapping[str, IntArray], Iterable[tuple[slice, Array]]]],
    ) -> ElementProducts:
        """Collect them from parts of the elements.

        Parameters
        ----------
        order
            The three arguments.
        terms
            For each term the coefficients of each argument, shape (local, elements), and the parts:
            which elements, and their tensors, shape (i, j, n, elements).
        """
        return cls(order, tuple(_Term(*_combined(parts), dofs) for dofs, parts in terms))

    def tensor(self, rows: str, cols: str, third: str, places: Scatter) -> ElementTensor:
        """Return the tensor of the matrices in two of the arguments."""
        return ElementTensor(self, (rows, cols, third), places)


def _combined(parts: Iterable[tuple[slice, Array]]) -> tuple[Array, Array]:
    """Return few tensors, and the shares with which they make up those of all elements."""
    shape: tuple[int, ...] = ()
    basis = np.zeros((0, 0))
    shares: list[Array] = []
    for _, local in parts:
        shape, flat = local.shape[:-1], local.reshape(-1, local.shape[-1])
        basis = basis if basis.size else np.zeros((len(flat), 0))
        left = flat - basis @ (basis.T @ flat)
        size = np.linalg.norm(flat, axis=0)
        missed = np.linalg.norm(left, axis=0) > EXACT * size
        if missed.any():
            vectors, values, _ = np.linalg.svd(left[:, missed] / size[missed], full_matrices=False)
            known = basis.shape[1]
            more = np.hstack([basis, vectors[:, values > EXACT * values.max()]])
            basis = np.linalg.qr(more)[0]
            basis[:, :known] *= np.sign((basis[:, :known] * more[:, :known]).sum(axis=0))
        shares.append(basis.T @ flat)
    whole = np.zeros((basis.shape[1], sum(part.shape[1] for part in shares)))
    stop = 0
    for part in shares:
        start, stop = stop, stop + part.shape[1]
        whole[: len(part), start:stop] = part
    return basis.reshape(*shape, -1), whole


@dataclass(frozen=True, eq=False)
class ElementTensor:
    """T with T @ w = the data of a matrix that depends linearly on the coefficients w.

    Parameters
    ----------
    products
        Of the form.
    slots
        Rows, columns, and the argument that w stands for.
    places
        Where the entries of the element matrices stand.
    """

    products: ElementProducts
    slots: tuple[str, str, str]
    places: Scatter

    def _blocks(self) -> Iterator[tuple[int, slice, Array, list[IntArray], Array]]:
        """Yield term, elements, tensors with their axes as `slots`, coefficients, and shares."""
        axes = [self.products.order.index(slot) for slot in self.slots]
        for number, term in enumerate(self.products.terms):
            tensors = np.ascontiguousarray(term.tensors.transpose(*axes, 3))
            for start in range(0, term.shares.shape[1], BLOCK):
                at = slice(start, start + BLOCK)
                dofs = [term.dofs[slot][:, at] for slot in self.slots]
                yield number, at, tensors, dofs, term.shares[:, at]

    def __matmul__(self, w: Array) -> Array:
        """Return the data, in the order of the pattern."""
        data = np.zeros(self.places.pattern.nnz)
        for number, at, tensors, (_, _, third), shares in self._blocks():
            i, j, n, r = tensors.shape
            mixed = (w[third][:, None] * shares).reshape(n * r, shares.shape[1])
            local = tensors.reshape(i * j, n * r) @ mixed
            self.places.add(data, number, at, local.reshape(i, j, -1))
        return data

    def apply(self, w: Array, x: Array) -> Array:
        """Return the product of the matrix and x, shape (rows,), without the matrix."""
        result = np.zeros(self.places.pattern.shape[0])
        for _, _, tensors, (rows, cols, third), shares in self._blocks():
            i, j, n, r = tensors.shape
            mixed = x[cols][:, None, None] * w[third][:, None] * shares
            local = tensors.reshape(i, j * n * r) @ mixed.reshape(j * n * r, shares.shape[1])
            np.add.at(result, rows.ravel(), local.ravel())
        return result
