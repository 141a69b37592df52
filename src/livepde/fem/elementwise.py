"""Scatter maps of element matrices, and matrix-free trilinear forms.

The integrals of all products of local functions over an element form a small tensor. Up to
rounding, the tensors of all elements are linear combinations of a few basis tensors. For example,
the tensors of q u v on triangles with straight sides are multiples of a single tensor. Therefore
only r basis tensors, r coefficients for each element, and the positions of element matrices are
stored: for P1 functions in 2D, about 200 bytes per node for all three matrices of a form.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import scipy.sparse as sp

from livepde.linalg import Array, IntArray, Pattern

Pairs = Sequence[tuple[IntArray, IntArray]]
# Forms on one mesh have equal connectivity arrays, whose copies would dominate the memory on large
# meshes. They are weakly referenced, so that entries are deleted with their last user.
_arrays: WeakValueDictionary[bytes, IntArray] = WeakValueDictionary()
_known: WeakValueDictionary[bytes, Scatter] = WeakValueDictionary()


def shared(array: IntArray) -> IntArray:
    """Return a canonical array: the same object for all equal arrays."""
    return _arrays.setdefault(_digest(array), array)


def scatter(pairs: Pairs, shape: tuple[int, int]) -> Scatter:
    """Return the canonical scatter map of element matrices: one object for equal arguments.

    `pairs` are row and column indices of local functions for each term, shapes (i, elements) and
    (j, elements).
    """
    key = _digest(np.array(shape), *(dofs for pair in pairs for dofs in pair))
    known = _known.get(key)
    if known is None:
        _known[key] = known = Scatter(pairs, shape)
    return known


def _digest(*arrays: Any) -> bytes:
    digest = blake2b()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}{array.strides}".encode())
        # A broadcast array has stride zero. Its first column represents it, so that the large array
        # is not formed.
        repeated = array[:, :1] if array.ndim == 2 and array.strides[1] == 0 else array
        digest.update(np.ascontiguousarray(repeated).data)
    return digest.digest()


class Scatter:
    """Scatter map: adds element matrices, (i, j, elements), to the data of a sparse matrix.

    Its `pattern` has all entries of all element matrices.
    """

    def __init__(self, pairs: Pairs, shape: tuple[int, int]) -> None:
        self.pairs = list(pairs)
        total = sp.csr_array(shape, dtype=bool)
        for rows, cols in pairs:
            left, right = _members(rows, shape[0]), _members(cols, shape[1])
            total = total + sp.csr_array(left.T @ right)
        self.pattern = Pattern.of(total)
        self._places: dict[int, IntArray] = {}

    def add(self, data: Array, term: int, at: slice, local: Array, keep: bool = True) -> None:
        """Add the entries of a slice of elements of a term, shape (i, j, elements), to data.

        `keep` caches the positions of this term's entries, for repeated assembly.
        """
        # Elements share positions. np.add.at sums repeated positions, unlike `data[at] += local`.
        np.add.at(data, self._at(term, at, keep).ravel(), local.ravel())

    def places(self, term: int) -> IntArray:
        """Return the positions of a term's entries in the data, shape (i, j, elements)."""
        if term not in self._places:
            rows, cols = self.pairs[term]
            places = np.empty((len(rows), *cols.shape), dtype=np.int32)
            for i, row in enumerate(rows):
                for j, col in enumerate(cols):
                    places[i, j] = self.pattern.positions(row, col)
            self._places[term] = places
        return self._places[term]

    def _at(self, term: int, at: slice, keep: bool) -> IntArray:
        if keep or term in self._places:
            return self.places(term)[:, :, at]
        rows, cols = (dofs[:, at] for dofs in self.pairs[term])
        shape = (len(rows), *cols.shape)
        i, j = np.broadcast_to(rows[:, None], shape), np.broadcast_to(cols, shape)
        return self.pattern.positions(i.ravel(), j.ravel()).reshape(shape)


def _members(dofs: IntArray, count: int) -> sp.csr_array:
    """Return the incidence matrix of elements and coefficients, shape (elements, count)."""
    width, elements = dofs.shape
    flat = np.ascontiguousarray(dofs.T, dtype=np.int32).ravel()
    starts = np.arange(0, width * elements + 1, width, dtype=np.int32)
    return sp.csr_array((np.ones(len(flat), dtype=bool), flat, starts), shape=(elements, count))


# Relative error of an element tensor in the common basis, at rounding level.
EXACT = 1e-13
# Number of elements that are processed at once, which bounds the size of temporary arrays.
BLOCK = 8_000


@dataclass(frozen=True, eq=False)
class TensorTerm:
    """Basis tensors, shape (i, j, n, r), and coefficients of each element, shape (r, elements).

    `dofs` are the coefficient indices of the three arguments, each of shape (local, elements).
    """

    tensors: Array
    shares: Array
    dofs: Sequence[IntArray]

    @classmethod
    def of(cls, dofs: Sequence[IntArray], parts: Iterable[tuple[slice, Array]]) -> TensorTerm:
        """Return the term for tensors of slices of elements, each of shape (i, j, n, elements)."""
        shape: tuple[int, ...] = ()
        basis = np.zeros((0, 0))
        shares: list[Array] = []
        for _, local in parts:
            shape, flat = local.shape[:-1], local.reshape(-1, local.shape[-1])
            basis = basis if basis.size else np.zeros((len(flat), 0))
            # Only tensors outside the current span extend the basis. Their leading singular vectors
            # keep it as small as possible.
            remainder = flat - basis @ (basis.T @ flat)
            size = np.linalg.norm(flat, axis=0)
            outside = np.linalg.norm(remainder, axis=0) > EXACT * size
            if outside.any():
                vectors, values, _ = np.linalg.svd(
                    remainder[:, outside] / size[outside], full_matrices=False
                )
                rank = basis.shape[1]
                extended = np.hstack([basis, vectors[:, values > EXACT * values.max()]])
                # QR preserves the span of the known vectors but may flip their signs. They are
                # restored, because shares of earlier parts depend on them.
                basis = np.linalg.qr(extended)[0]
                basis[:, :rank] *= np.sign((basis[:, :rank] * extended[:, :rank]).sum(axis=0))
            shares.append(basis.T @ flat)
        coefficients = np.zeros((basis.shape[1], sum(part.shape[1] for part in shares)))
        stop = 0
        for part in shares:
            start, stop = stop, stop + part.shape[1]
            coefficients[: len(part), start:stop] = part
        return cls(basis.reshape(*shape, -1), coefficients, dofs)


@dataclass(frozen=True, eq=False)
class ElementTensor:
    """Matrix-free T such that T @ w is the data of a matrix that is linear in the coefficients w.

    `slots` are the indices of the arguments for rows, columns, and w; `places` are the positions of
    the entries of element matrices in the data.
    """

    terms: Sequence[TensorTerm]
    slots: tuple[int, int, int]
    places: Scatter

    def _blocks(self) -> Iterator[tuple[int, slice, Array, list[IntArray], Array]]:
        """Yield term, elements, tensors with axes in the order of `slots`, coefficients, shares."""
        for number, term in enumerate(self.terms):
            tensors = np.ascontiguousarray(term.tensors.transpose(*self.slots, 3))
            for start in range(0, term.shares.shape[1], BLOCK):
                at = slice(start, start + BLOCK)
                dofs = [term.dofs[slot][:, at] for slot in self.slots]
                yield number, at, tensors, dofs, term.shares[:, at]

    def __matmul__(self, w: Array) -> Array:
        """Return the data of the matrix in the order of the pattern."""
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
