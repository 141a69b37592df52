"""Lean reduced-order filter in NumPy and LAPACK, the reference for costs.

It is written as a user would write it for one problem, and shares no code with `livepde.laws`.
Matrices are assembled once for one time step, in an order with small bandwidth. Members are a
leading axis; their bands are concatenated, so that one factorisation serves all of them. There are
no safeguards, missing samples, bounds or substeps. If the process is linear in its unknowns, the
results equal `SensitivityLaw(guards=None, refit=None, shadows=None)` with implicit Euler.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.linalg import lapack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from livepde.errors import LinearAlgebraError
from livepde.fem import Moment
from livepde.linalg import Array, Assembler, IntArray, Pattern, compact
from livepde.model import Model

Factor: TypeAlias = tuple[Array, IntArray]


class NotAffineError(LinearAlgebraError):
    """The process has no constant matrices that can be assembled once."""


@dataclass(frozen=True, eq=False)
class Matrices:
    """Matrices of the implicit Euler step S(a) u+ = M u/h + f of an affine process.

    Members have states of shape (p, n) and reduced parameters a of shape (p, k). Rows of Dirichlet
    values are rows of the identity in S and zero in M.

    Attributes
    ----------
    model, order
        The process, and the permutation of its coefficients to the order of the band, shape (n,).
    M
        Mass matrix divided by the time step, shape (n, n).
    entries
        Reduced parameters, shape (p, k) -> entries of S, shape (p, nnz).
    slope
        Matrix that maps u to d(S u)/da, shape (n k, n); None if the process is not linear in a.
    width, where
        Half-bandwidth, and the indices of the entries in LAPACK's band storage, shape (nnz,).
    """

    model: Model
    order: IntArray
    M: sp.csr_array | Array
    entries: Callable[[Array], Array]
    slope: sp.csr_array | Array | None
    width: int
    where: IntArray

    @classmethod
    def of(cls, model: Model, Phi: Array, h: float) -> Matrices:
        """Assemble a process for one time step and the reduction q = prior + Phi a.

        Raises
        ------
        NotAffineError
            A or B is not affine in the state, or depends on time or inputs.
        """
        n = model.X.dim
        pattern, mass, base, T = _parts(model, h)
        structure = pattern.matrix(np.ones(pattern.nnz))
        order = reverse_cuthill_mckee(structure + structure.T, symmetric_mode=True)
        place = np.argsort(order)
        row, col = place[pattern.rows], place[pattern.indices]
        width = int(np.abs(row - col).max(initial=0))
        latent, slope = model.latent, None
        if latent.linear:
            parts = np.asarray(T @ latent.tangent(latent.prior, Phi)).T  # (k, nnz)
            base = base + T @ latent.value(latent.prior)
            entries = _linear(base, parts)
            k = len(parts)
            at = (np.add.outer(np.arange(k), row * k).ravel(), np.tile(col, k))
            slope = compact(sp.csr_array((parts.ravel(), at), shape=(n * k, n)))
        else:
            entries = _general(base, T, model, Phi)
        M = compact(sp.csr_array((mass, (row, col)), shape=(n, n)))
        where = col * (3 * width + 1) + 2 * width + row - col
        return cls(model, order, M, entries, slope, width, where)

    @property
    def place(self) -> IntArray:
        """Index of each coefficient in the order of the band, shape (n,)."""
        return np.argsort(self.order)

    def forcing(self, moment: Moment) -> Array:
        """Return f at a time, shape (n,), with the source and the Dirichlet values."""
        model = self.model
        f = model.F(moment) * model.X.free
        return model.impose(f, moment)[self.order]

    def factorise(self, a: Array) -> Factor:
        """Factorise S(a) of all members as one band matrix."""
        b, p, n = self.width, len(a), len(self.order)
        band = np.zeros((p, n * (3 * b + 1)))
        band[:, self.where] = self.entries(a)
        lu, pivots, info = lapack.dgbtrf(band.reshape(p * n, -1).T, b, b, overwrite_ab=1)
        if info != 0:
            raise LinearAlgebraError("the matrix of a step is singular")
        return lu, pivots

    def solve(self, factor: Factor, known: Array) -> Array:
        """Apply S^-1 to states, shape (p, n), or to columns, shape (p, n, c)."""
        lu, pivots = factor
        columns = known.reshape(lu.shape[1], -1)
        x, _ = lapack.dgbtrs(lu, self.width, self.width, columns, pivots)
        return np.asarray(x.reshape(known.shape))

    def mass(self, u: Array) -> Array:
        """Apply M/h to states, shape (p, n), or to columns, shape (p, n, c)."""
        rows = u.swapaxes(0, 1)
        moved = self.M @ rows.reshape(len(rows), -1)
        return np.asarray(moved.reshape(rows.shape).swapaxes(0, 1))

    def derivative(self, u: Array) -> Array:
        """Return d(S u)/da at states, shape (p, n, k)."""
        if self.slope is None:
            raise NotAffineError("the process is not linear in its unknowns")
        return np.asarray((self.slope @ u.T).T.reshape(*u.shape, -1))


def assembled(model: Model, a: Array, h: float) -> tuple[sp.csr_array, sp.csr_array]:
    """Return M/h and S for latent coefficients of shape (dim,), in the order of the model."""
    pattern, mass, base, T = _parts(model, h)
    return pattern.matrix(mass), pattern.matrix(base + T @ model.latent.value(a))


def _parts(model: Model, h: float) -> tuple[Pattern, Array, Array, sp.csr_array]:
    """Return the pattern of S, entries of M/h and of S at q = 0, and the map from q to the rest.

    Rows of Dirichlet values are rows of the identity in S and zero elsewhere.
    """
    form, n = model.physical_A, model.X.dim
    tensor = form.tensor("v", "u")
    if not (model.affine and model.steady) or not isinstance(tensor, sp.csr_array):
        raise NotAffineError("the process is not affine in its state with constant matrices")
    rows = sp.diags_array(model.X.free)
    whole = Assembler(n)
    whole.add("M", model.form_M.pattern("v", "u"), rows)
    whole.add("B", model.form_B.pattern("v", "u"), rows)
    whole.add("A", form.pattern("v", "u"), rows)
    whole.add("fixed", Pattern.of(sp.eye_array(n)))
    pattern, maps = whole.build()
    mass = maps["M"] @ (model.mass.data / h)
    base = mass + maps["B"] @ model.form_B.data("v", "u", Moment(0.0), u=np.zeros(n))
    base += maps["fixed"] @ (1.0 - model.X.free)
    return pattern, mass, base, sp.csr_array(maps["A"] @ tensor)


def _linear(base: Array, parts: Array) -> Callable[[Array], Array]:
    """Return a -> entries of S = base + a parts, with shapes (nnz,) and (k, nnz)."""
    return lambda a: base + a @ parts


def _general(base: Array, T: sp.csr_array, model: Model, Phi: Array) -> Callable[[Array], Array]:
    """Return a -> entries of S, which is affine in q(a)."""
    prior = model.latent.prior[:, None]

    def entries(a: Array) -> Array:
        return np.asarray(base + (T @ model.latent.value(prior + Phi @ a.T)).T)

    return entries


@dataclass(frozen=True, eq=False)
class Filter:
    """Estimates of p members, and the square roots [U; C] of their covariances.

    Attributes
    ----------
    x
        Columns [u, U] in the order of the band, shape (p, n, 1 + k).
    y
        Columns [a, C] of the reduced parameter, shape (p, k, 1 + k).
    """

    x: Array
    y: Array


def initial(matrices: Matrices, u0: Array, members: int, k: int) -> Filter:
    """Return the initial filter for a known state u0, shape (n,), and a ~ N(0, I)."""
    x, y = np.zeros((members, len(u0), 1 + k)), np.zeros((members, k, 1 + k))
    x[:, :, 0], y[:, :, 1:] = u0[matrices.order], np.eye(k)
    return Filter(x, y)


def step(matrices: Matrices, G: Array, state: Filter, f: Array, z: Array) -> Filter:
    """Predict to the time of f, and update with measurements z = G u + noise of unit variance.

    Parameters
    ----------
    G
        Observation operator in the order of the band, shape (sensors, n).
    f
        `Matrices.forcing` at the time of the sample.
    z
        Measurements, shape (p, sensors).
    """
    y, x = state.y, matrices.mass(state.x)
    members, k, _ = y.shape
    lu = matrices.factorise(y[:, :, 0])
    x[:, :, 0] = u = matrices.solve(lu, x[:, :, 0] + f)
    x[:, :, 1:] = matrices.solve(lu, x[:, :, 1:] - matrices.derivative(u) @ y[:, :, 1:])
    seen = G @ x
    # [U; C] W with W W^T = (I + Y^T Y)^-1, Y = G U; QR avoids forming the product Y^T Y.
    stacked, gain = np.empty((members, k + len(G), k)), np.zeros((members, 1 + k, 1 + k))
    stacked[:, :k], stacked[:, k:] = np.eye(k), seen[:, :, 1:]
    W = np.linalg.inv(np.linalg.qr(stacked, mode="r"))
    d = (z - seen[:, :, 0])[:, None] @ seen[:, :, 1:]
    gain[:, 0, 0], gain[:, 1:, 1:] = 1.0, W
    gain[:, 1:, 0] = (W @ (d @ W).swapaxes(1, 2))[:, :, 0]
    return Filter(x @ gain, y @ gain)
