"""Normal equations of A(w) q = y in the metric D^{-1} of the equation error, sample by sample.

A diagonal D >= M (Gershgorin; the lumped mass for P1) makes A^T R D^{-1} R^T A as sparse as A^T A
where sensors select coefficients. Else the rows are those of a basis of N(G)^perp, D is M, and the
matrix is dense.

Rows are of two kinds, which are kept apart: those of tests within omega, which see nothing but the
data, and the others, which hold fluxes of the unobserved part.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from livepde.linalg import Array, Pattern


@dataclass(frozen=True, eq=False)
class Gain:
    """Contribution of one sample to the normal equations, per unit of time."""

    # A^T R D^{-1} R^T A of both kinds of rows, data in the pattern of J, shape (2, entries).
    matrix: Array
    right: Array  # A^T R D^{-1} R^T y of the same, y = A q - eps, shape (2, m)
    force: Array  # A^T R D^{-1} R^T eps of all rows, shape (m,)
    trace: Array  # trace(G_Q^{-1} matrix), shape (2,)


class NormalEquations(ABC):
    """Abstract contributions of samples of one set of sensors to the normal equations."""

    @abstractmethod
    def gain(self, A: Array, q: Array, error: Array, probes: Array) -> Gain:
        """Return the contribution of a sample."""

    @abstractmethod
    def trace(self, A: Array, probes: Array) -> Array:
        """Return `Gain.trace` alone."""


class SelectedRows(NormalEquations):
    """Sensors that select coefficients: D is diagonal and J as sparse as A^T A.

    `pattern`: of A, shape (n, m). `inverse`: D^{-1} of the rows of both kinds, zero elsewhere,
    shape (2, n). `free`: one for each free coefficient of q, shape (m,). `J`: pattern of J.
    """

    def __init__(self, pattern: Pattern, inverse: Array, free: Array, J: Pattern) -> None:
        self.pattern = pattern
        self.inverse = inverse
        self.free = free
        self.shape = (2, J.nnz)
        rows, cols = pattern.rows, pattern.indices
        whole = inverse.sum(axis=0)
        # Each pair of entries of a row is a term of J; those above the diagonal are mirrored.
        entry = np.flatnonzero((whole[rows] > 0.0) & (free[cols] > 0.0))
        # Each entry of A, numbered by `entry`, meets all of those in its row: `left` repeats it as
        # often, and `right` counts through them from the first of the row.
        own = rows[entry]
        counts = np.bincount(own, minlength=pattern.shape[0])
        first = (np.cumsum(counts) - counts)[own]
        before = np.cumsum(counts[own]) - counts[own]
        rank = np.arange(counts[own].sum()) - np.repeat(before, counts[own])
        left = np.repeat(entry, counts[own])
        right = entry[np.repeat(first, counts[own]) + rank]
        upper = cols[left] <= cols[right]
        left, right = left[upper], right[upper]
        kind = (inverse[1] > 0.0)[rows[left]].astype(np.intp)
        at = J.positions(cols[left], cols[right]) + J.nnz * kind
        order = np.argsort(at, kind="stable")
        self.left, self.right = left[order].astype(np.intp), right[order].astype(np.intp)
        self.weights = whole[rows[self.left]]
        self.places, self.starts = np.unique(at[order], return_index=True)
        entries = self.places % J.nnz
        mirrored = J.positions(J.indices[entries], J.rows[entries])
        self.mirrored = mirrored + (self.places - entries)

    def _matrix(self, A: Array) -> Array:
        data = np.zeros(self.shape)
        if len(self.starts):
            # Terms are sorted by their place in J, so that each entry of J is the sum of a segment.
            terms = A[self.left]
            terms *= A[self.right]
            terms *= self.weights
            flat, sums = data.ravel(), np.add.reduceat(terms, self.starts)
            flat[self.places] = sums
            flat[self.mirrored] = sums
        return data

    def gain(self, A: Array, q: Array, error: Array, probes: Array) -> Gain:
        matrix = self.pattern.compact(A)
        images = matrix @ np.column_stack([self.free * q, probes])
        y = images[:, 0] - error
        columns = np.column_stack([*(self.inverse * y), self.inverse.sum(axis=0) * error])
        products = (matrix.T @ columns).T * self.free
        trace = self.inverse @ np.square(images[:, 1:]).sum(axis=1)
        return Gain(self._matrix(A), products[:2], products[2], trace)

    def trace(self, A: Array, probes: Array) -> Array:
        images = self.pattern.compact(A) @ probes
        trace: Array = self.inverse @ np.square(images).sum(axis=1)
        return trace


class ProjectedRows(NormalEquations):
    """Sensors of any other kind: rows of a basis V of N(G)^perp, D = M, and J dense.

    All of them see the unobserved part.

    `pattern`: of A, shape (n, m). `basis`: V, shape (n, k). `mass`: M, shape (n, n). `free`,
    `free_q`: one for each free coefficient of u and q.
    """

    def __init__(
        self, pattern: Pattern, basis: Array, mass: sp.csr_array, free: Array, free_q: Array
    ) -> None:
        self.pattern = pattern
        values, vectors = np.linalg.eigh(basis.T @ (mass @ basis))
        # Columns V C with (V C)^T M (V C) = I, so that R M^{-1} R^T = (V C) (V C)^T.
        self.basis = free[:, None] * (basis @ (vectors / np.sqrt(values)))
        self.free = free_q

    def gain(self, A: Array, q: Array, error: Array, probes: Array) -> Gain:
        rows = (self.pattern.matrix(A).T @ self.basis).T * self.free
        eps = self.basis.T @ error
        matrix, right = (rows.T @ rows).ravel(), rows.T @ (rows @ q - eps)
        return Gain(
            np.stack([np.zeros_like(matrix), matrix]),
            np.stack([np.zeros_like(right), right]),
            rows.T @ eps,
            np.array([0.0, ((rows @ probes) ** 2).sum()]),
        )

    def trace(self, A: Array, probes: Array) -> Array:
        images = self.basis.T @ (self.pattern.matrix(A) @ probes)
        return np.array([0.0, (images**2).sum()])


def diagonal_bound(mass: sp.csr_array) -> Array:
    """Return the diagonal D >= M of Gershgorin's circles, scaled to a unit diagonal of M."""
    diagonal = mass.diagonal()
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scale = sp.diags_array(1.0 / root)
    rows = abs(scale @ mass @ scale).sum(axis=1)
    # diag(row sums) less the scaled M is diagonally dominant, and so has no negative eigenvalue.
    bound: Array = np.where(diagonal > 0.0, root**2 * np.maximum(rows, 1.0), 0.0)
    return bound
