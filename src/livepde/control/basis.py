"""Projection basis of a reduced model: static responses and slowest eigenmodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import eigs, eigsh, splu

from livepde.control.linear import Linear
from livepde.linalg import Array, IntArray

# Shift of static responses relative to the fastest rate, for processes without a steady state.
SHIFT = 1e-9
# Relative size below which a direction of the snapshots is dropped.
KEPT = 1e-4
# Relative asymmetry that is attributed to rounding.
SYMMETRIC = 1e-10


def basis(
    mass: sp.csr_array,
    free: IntArray,
    systems: Sequence[Linear],
    drives: Array,
    modes: int,
    rates: Sequence[float] = (),
) -> Array:
    """Return an M-orthonormal basis V, V^T M V = I, zero on fixed coefficients, shape (n, r).

    Parameters
    ----------
    mass
        Mass matrix M, shape (n, n).
    free
        Numbers of the coefficients that are not fixed.
    systems
        Linear systems for several values of the unknowns, the first at the prior mean. The basis
        contains the static responses of each.
    drives
        Lifting of boundary channels and of known boundary values, shape (n, channels + 1).
    modes
        Number of slowest eigenmodes of the first system to be added.
    rates
        Rates of the exponential inputs exp(rate t) whose responses are added.
    """
    M = sp.csc_array(mass[free][:, free])
    static, slowest = [], np.zeros((len(free), 0))
    for system in systems:
        K = sp.csc_array(system.K[free][:, free])
        # A small multiple of M makes K + rate M regular: a process with insulated boundaries has no
        # steady state, and its static response would be infinite.
        shift = SHIFT * float(abs(K).sum(axis=1).max() / M.sum(axis=1).max())
        loads = np.column_stack([system.E, system.f]) - system.K @ drives
        for rate in (shift, *rates):
            static.append(splu(sp.csc_array(K + rate * M)).solve(np.ascontiguousarray(loads[free])))
        if system is systems[0] and modes:
            slowest = _modes(K, M, modes, shift)
    responses = np.hstack(static)
    size = np.sqrt(np.maximum(np.einsum("ik,ik->k", responses, M @ responses), 0.0))
    responses = responses[:, size > 0.0] / size[size > 0.0]
    found = _orthonormal(np.hstack([_orthonormal(responses, M), slowest]), M)
    V = np.zeros((mass.shape[0], found.shape[1]))
    V[free] = found
    return V


def _modes(K: sp.csc_array, M: sp.csc_array, count: int, shift: float) -> Array:
    """Return the slowest eigenmodes; real and imaginary parts for a nonsymmetric K."""
    n = K.shape[0]
    start, count = np.ones(n), min(count, n - 2)
    if count < 1:  # the static responses are all there is
        return np.zeros((n, 0))
    if abs(K - K.T).max() <= SYMMETRIC * abs(K).max():
        return np.asarray(eigsh(K, count, M, sigma=-shift, v0=start)[1])
    _, vectors = eigs(K, count, M, sigma=-shift, v0=start)
    both = np.hstack([vectors.real, vectors.imag])
    return np.asarray(both[:, np.linalg.norm(both, axis=0) > 0.0])


def _orthonormal(columns: Array, M: sp.csc_array) -> Array:
    """Return the dominant directions of columns, orthonormal in M."""
    if not columns.shape[1]:
        return columns
    weights, axes = np.linalg.eigh(columns.T @ (M @ columns))
    kept = weights > KEPT**2 * weights.max()
    found = columns @ (axes[:, kept][:, ::-1] / np.sqrt(weights[kept][::-1]))
    root = np.linalg.cholesky(found.T @ (M @ found))  # once more: squares have lost digits
    return np.asarray(np.linalg.solve(root, found.T).T)
