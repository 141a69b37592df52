"""The implicit stage of many members of one model that is affine in state, unknowns and inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.fem import START, Composed, Inputs, Moment
from livepde.linalg import Array, Assembler, BandedBlocks, BandedSolver, BlockFactor, analyse
from livepde.model import Model

__all__ = ["AffineStage"]

SCALES = (1e-3, 1.0, 1e3, 1e6)  # of random inputs that tell whether a vector is affine in them
ROUNDING = 1e-11  # relative: less is no curvature

Vector = Callable[[Moment], Array]


@dataclass(frozen=True, eq=False)
class _Known:
    """A vector that is affine in the inputs, as all boundary values and most sources are."""

    vector: Vector
    channels: tuple[str, ...]
    constant: bool

    def _at(self, t: float, inputs: Sequence[float] | Array) -> Array:
        named = dict(zip(self.channels, map(float, inputs), strict=True))
        return self.vector(Moment(t, Inputs(named)))

    @cached_property
    def _fixed(self) -> Array:
        return self.vector(START)

    @cached_property
    def affine(self) -> bool:
        """True if it is affine in the inputs, probed at several magnitudes."""
        if self.constant:
            return True
        rng = np.random.default_rng(2)
        for scale in SCALES:
            a, b = scale * rng.standard_normal((2, len(self.channels)))
            with np.errstate(all="ignore"):
                parts = [self._at(0.3, x) for x in (a, b, a + b, 0.0 * a)]
            change = parts[0] + parts[1] - parts[2] - parts[3]
            size = max(np.abs(part).max(initial=0.0) for part in parts)
            if not np.abs(change).max(initial=0.0) <= ROUNDING * size:
                return False
        return True

    def __call__(self, t: float, inputs: Array) -> Array:
        """Return the vector of each member at a time, shape (members, n) or (1, n)."""
        if self.constant:
            return self._fixed[None]
        zero = np.zeros(len(self.channels))
        base = self._at(t, zero)
        total = base[None]
        for c, largest in enumerate(np.abs(inputs).max(axis=0)):
            if largest > 0.0:  # a difference at the size of the values: no digits are lost
                unit = zero.copy()
                unit[c] = largest
                total = total + (inputs[:, c] / largest)[:, None] * (self._at(t, unit) - base)
        return total


class AffineStage:
    """Solves M (u - c)/h + B u + sum_j q_j A_j u + ... = F for all members, and its tangents.

    The matrices of the members differ by their q alone: each is a sum of common matrices, and all
    are factorised and solved by one LAPACK call.

    Columns of members have the shape (columns, members, n).
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        form = model.form_A
        self._form = form.form if isinstance(form, Composed) else form
        self.channels = model.channels
        zero = np.zeros(model.X.dim)
        self._boundary = self._known(lambda moment: model.impose(zero, moment), False)
        constant = model.form_F.constant and model.form_B.constant
        self._load = self._known(lambda moment: model.F(moment) - model.B(zero, moment), constant)
        units = np.eye(model.parameter_space.dim)

        def at_zero(q: Array) -> Vector:
            return lambda moment: self._form.vector("v", moment, q=q, u=zero)

        self._at_zero = [self._known(at_zero(q), self._form.constant) for q in units]
        whole = Assembler(model.X.dim)
        whole.add("M", model.form_M.pattern("v", "u"))
        whole.add("B", model.form_B.pattern("v", "u"))
        whole.add("A", self._form.pattern("v", "u"))
        self.pattern, maps = whole.build()
        self._mass = maps["M"] @ model.mass.data
        # What depends on time or inputs is none of the matrices, but is evaluated with them.
        some = Moment(0.0, Inputs(dict.fromkeys(self.channels, 0.0)))
        self._rest = maps["B"] @ model.form_B.data("v", "u", some, u=zero)
        slopes = [maps["A"] @ self._form.data("v", "u", some, u=zero, q=q) for q in units]
        self._slopes = np.array(slopes)

    def _known(self, vector: Vector, constant: bool) -> _Known:
        return _Known(vector, self.channels, constant)

    @staticmethod
    def refuses(model: Model) -> str:
        """Return why a model cannot be stepped so; empty if it can."""
        form = model.form_A
        form = form.form if isinstance(form, Composed) else form
        if not (form.linear_in_parameter and model.affine):
            return "the model is not affine in its state and its unknowns"
        if not model.steady:
            return "the matrices of the model depend on time or inputs"
        return ""

    @property
    def refusal(self) -> str:
        """Why inputs or mesh keep members from being stepped together; empty if they do not."""
        known = [self._boundary, self._load, *self._at_zero]
        if not all(item.affine for item in known):
            return "the model is not affine in its input channels"
        if not isinstance(analyse(self.pattern), BandedSolver):
            return "the matrices of the model are not banded: the mesh has more than one dimension"
        return ""

    @cached_property
    def _blocks(self) -> BandedBlocks:
        return BandedBlocks(BandedSolver(self.pattern))

    @cached_property
    def _free(self) -> tuple[Array, Array]:
        """Which entries couple free coefficients, and the ones of the fixed."""
        free, rows, cols = self.model.X.free, self.pattern.rows, self.pattern.indices
        inner: Array = free[rows] * free[cols]
        return inner, np.where(rows == cols, 1.0 - free[rows], 0.0)

    @cached_property
    def _moving(self) -> sp.csr_array:
        """B' and every A_j, one below the other, shape ((1 + m) n, n)."""
        blocks = [self.pattern.matrix(data) for data in (self._rest, *self._slopes)]
        return sp.csr_array(sp.vstack(blocks, format="csr"))

    def _moved(self, u: Array) -> tuple[Array, Array]:
        """Return B' u, (members, n), and A_j u, (members, n, m), for u of shape (members, n)."""
        members, n = u.shape
        product = (self._moving @ u.T).reshape(-1, n, members)
        return product[0].T, product[1:].transpose(2, 1, 0)

    def factor(self, q: Array, h: float) -> BlockFactor:
        """Factorise the matrix of every member, for q of shape (members, m)."""
        inner, fixed = self._free
        common = (self._mass / h + self._rest) * inner + fixed
        return self._blocks.factorise(common + q @ (self._slopes * inner))

    def solve(
        self, columns: Array, q: Array, slopes: Array, factor: BlockFactor, at: Moments, h: float
    ) -> Array:
        """Return state and tangents at the end of a stage, shape (1 + r, members, n).

        Parameters
        ----------
        columns
            The state c of each member, and the columns that follow it.
        q, slopes
            Unknowns, (members, m), and how they change along each column, (members, m, r).
        factor
            Of this q and h.
        at
            When, and with which inputs.
        """
        free, mass = self.model.X.free, self.model.mass
        members = columns.shape[1]
        boundary = self._boundary(at.t, at.inputs)
        at_zero = np.stack([known(at.t, at.inputs) for known in self._at_zero], axis=-1)
        c = columns[0]
        u = c * free + boundary
        rest, moved = self._moved(u)
        force = ((moved + at_zero) @ q[:, :, None])[:, :, 0]
        residual = (mass @ ((u - c) / h).T).T + rest + force - self._load(at.t, at.inputs)
        u = u - factor.solve((residual * free)[None])[0]
        _, moved = self._moved(u)
        forcing = ((moved + at_zero) @ slopes).transpose(2, 0, 1)
        kept = (mass @ columns[1:].reshape(-1, len(free)).T).T.reshape(-1, members, len(free))
        tangents = factor.solve((kept / h - forcing) * free)
        return np.concatenate([u[None], tangents])


@dataclass(frozen=True, eq=False)
class Moments:
    """One time, and the inputs of each member at that time, shape (members, channels)."""

    t: float
    inputs: Array
