"""Matrix-free trilinear forms: element tensors compressed to a common basis.

The integrals of all products of local functions over an element form a small tensor. The tensors of
all elements are, to rounding, linear combinations of few: on triangles with straight sides,
whatever their size and shape, those of q u v are multiples of a single one. So only the r basis
tensors, r coefficients of each element, and the positions of element matrices are stored: with P1
functions in the plane about 200 bytes per node, for all three matrices of a form.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from livepde.fem.scatter import Scatter
from livepde.linalg import Array, IntArray

# Relative error of an element tensor in the common basis: rounding level.
EXACT = 1e-13
# Number of elements multiplied at once, which bounds the size of temporary arrays.
BLOCK = 8_000


@dataclass(frozen=True, eq=False)
class _TensorTerm:
    """Basis tensors, shape (i, j, n, r), and coefficients of each element, shape (r, elements)."""

    tensors: Array
    shares: Array
    dofs: Mapping[str, IntArray]


@dataclass(frozen=True, eq=False)
class ElementProducts:
    """Integrals over each element of all products of local functions of three arguments."""

    order: tuple[str, ...]
    terms: tuple[_TensorTerm, ...]

    @classmethod
    def of(
        cls,
        order: tuple[str, ...],
        terms: Iterable[tuple[Mapping[str, IntArray], Iterable[tuple[slice, Array]]]],
    ) -> ElementProducts:
        """Collect the element tensors from parts of the mesh.

        Parameters
        ----------
        order
            Names of the three arguments.
        terms
            For each term the coefficient numbers of each argument, shape (local, elements), and the
            parts: slice of the elements, and their tensors, shape (i, j, n, elements).
        """
        return cls(order, tuple(_TensorTerm(*_combined(parts), dofs) for dofs, parts in terms))

    def tensor(self, rows: str, cols: str, third: str, places: Scatter) -> ElementTensor:
        """Return the tensor of the matrices in two of the arguments."""
        return ElementTensor(self, (rows, cols, third), places)


def _combined(parts: Iterable[tuple[slice, Array]]) -> tuple[Array, Array]:
    """Return a basis of the tensors, and the coefficients of each element in it."""
    shape: tuple[int, ...] = ()
    basis = np.zeros((0, 0))
    shares: list[Array] = []
    for _, local in parts:
        shape, flat = local.shape[:-1], local.reshape(-1, local.shape[-1])
        basis = basis if basis.size else np.zeros((len(flat), 0))
        # Only tensors outside of the present span extend the basis. Their leading singular vectors
        # are added, so the basis stays as small as possible.
        left = flat - basis @ (basis.T @ flat)
        size = np.linalg.norm(flat, axis=0)
        missed = np.linalg.norm(left, axis=0) > EXACT * size
        if missed.any():
            vectors, values, _ = np.linalg.svd(left[:, missed] / size[missed], full_matrices=False)
            known = basis.shape[1]
            more = np.hstack([basis, vectors[:, values > EXACT * values.max()]])
            # QR keeps the span of the known vectors but may flip their signs, and shares of earlier
            # parts refer to them: the signs are restored.
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
    """Matrix-free T such that T @ w is the data of a matrix linear in the coefficients w.

    Parameters
    ----------
    products
        Element tensors of the form.
    slots
        Arguments of the rows, of the columns, and of w.
    places
        Positions of the entries of element matrices in the data.
    """

    products: ElementProducts
    slots: tuple[str, str, str]
    places: Scatter

    def _blocks(self) -> Iterator[tuple[int, slice, Array, list[IntArray], Array]]:
        """Yield term, elements, tensors with axes in order of `slots`, coefficients, shares."""
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
        """Return the product of the matrix with x, shape (rows,), without assembling the matrix."""
        result = np.zeros(self.places.pattern.shape[0])
        for _, _, tensors, (rows, cols, third), shares in self._blocks():
            i, j, n, r = tensors.shape
            mixed = x[cols][:, None, None] * w[third][:, None] * shares
            local = tensors.reshape(i, j * n * r) @ mixed.reshape(j * n * r, shares.shape[1])
            np.add.at(result, rows.ravel(), local.ravel())
        return result
