"""Scatter maps of element matrices into sparse matrices, shared between equal ones."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import scipy.sparse as sp

from livepde.linalg import Array, IntArray, Pattern

Pairs = Sequence[tuple[IntArray, IntArray]]
# Forms on one mesh repeat the same connectivity many times; on large meshes it would dominate the
# memory. Weak references: entries vanish with their last user.
_arrays: WeakValueDictionary[bytes, IntArray] = WeakValueDictionary()
_known: WeakValueDictionary[bytes, Scatter] = WeakValueDictionary()


def shared(array: IntArray) -> IntArray:
    """Return a canonical array equal to this one: the same object for all equal arrays."""
    key = _digest(array)
    found = _arrays.get(key)
    if found is None:
        _arrays[key] = found = array
    return found


def scatter(pairs: Pairs, shape: tuple[int, int]) -> Scatter:
    """Return the canonical scatter map of element matrices: one object for equal arguments.

    Parameters
    ----------
    pairs
        Row and column numbers of local functions for each term, shapes (i, elements), (j,
        elements).
    shape
        Shape of the matrix.
    """
    key = _digest(np.array(shape), *(dofs for pair in pairs for dofs in pair))
    found = _known.get(key)
    if found is None:
        _known[key] = found = Scatter(pairs, shape)
    return found


def _digest(*arrays: Any) -> bytes:
    digest = blake2b()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}{array.strides}".encode())
        # A broadcast array has the stride zero: its first column represents it, and the large array
        # is never formed.
        repeated = array[:, :1] if array.ndim == 2 and array.strides[1] == 0 else array
        digest.update(np.ascontiguousarray(repeated).data)
    return digest.digest()


class Scatter:
    """Scatter map: adds element matrices, (i, j, elements), to the data of a sparse matrix.

    Attributes
    ----------
    pattern
        Pattern of the matrix: all entries of all element matrices.
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
        """Add the entries of some elements of a term, shape (i, j, elements), to data.

        Parameters
        ----------
        keep
            Cache the positions of this term's entries, for repeated assembly.
        """
        # Elements share positions: np.add.at sums repeated ones, which `data[at] += local` would
        # not.
        np.add.at(data, self._at(term, at, keep).ravel(), local.ravel())

    def places(self, term: int) -> IntArray:
        """Return the positions of a term's entries in the data, shape (i, j, elements)."""
        if term not in self._places:
            rows, cols = self.pairs[term]
            found = np.empty((len(rows), *cols.shape), dtype=np.int32)
            for i, row in enumerate(rows):
                for j, col in enumerate(cols):
                    found[i, j] = self.pattern.positions(row, col)
            self._places[term] = found
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
