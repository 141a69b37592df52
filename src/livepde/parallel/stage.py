"""Coupled stage of the gradient law on many ranks: local computations of each rank.

All of the state is observed, so that A and B depend on the data w alone. A rank evaluates them on
its cells and one overlap layer, which gives its rows of the equation's terms and of the Jacobian

    K = [[S, A], [-A^T, H]],    S = M/h + theta M_op

completely. Ranks exchange values of u and q on the layer, inner products, and the messages of
PETSc's products and multigrid. K is solved by GMRES, preconditioned as in
`livepde.laws.coupled.blocks`: a multigrid cycle (GAMG) for S and one for C = H + A^T D^{-1} A.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array, IntArray, Pattern
from livepde.parallel.shares import Share, SharedModel
from livepde.parallel.solver import owned
from livepde.parallel.team import Team

__all__ = ["SharedEquation", "SharedJacobian", "SharedStage"]

# Residual of GMRES in the norm of Newton's residual. Newton's method corrects the rest (inexact
# Newton method).
TOLERANCE = 1e-2
# Maximum number of iterations, each of which stores a vector.
ITERATIONS = 60
# Hierarchies are rebuilt when GMRES needs this multiple of the iterations with new ones.
MORE = 2
REMEDY = "take a smaller gain or a smaller time step."


class SharedStage:
    """Local part of a stage: forms on the cells of a rank, and rows of constant matrices.

    Parameters
    ----------
    model
        Key of the `SharedModel`.
    free_u, free_q
        Masks of free coefficients, shapes (n,) and (m,).
    dual_weights
        Weights of the squared dual norms of a residual, zero at fixed coefficients, shape (n + m,).
    rows
        For each rank its rows of M, R^T M_op R and G_Q; on rank 0 only.
    """

    def __init__(
        self,
        team: Team,
        model: int,
        free_u: Array,
        free_q: Array,
        dual_weights: Array,
        rows: list[tuple[sp.csr_array, ...]] | None,
    ) -> None:
        shared: SharedModel = team.part(model)
        self.team = team
        self.u, self.q = shared.u, shared.q
        self.A, self.B = shared.A, shared.B
        self.linear: bool = self.A.linear_in_parameter
        self.mass, self.pull, self.gram = team.comm.scatter(rows)
        self.free_u, self.free_q = free_u, free_q
        roots = np.where(dual_weights > 0.0, np.sqrt(dual_weights), 1.0)
        self.roots = roots[self.u.rows], roots[self.u.dim + self.q.rows]
        free = sp.diags_array(free_u)
        lumped = np.asarray(abs(self.mass @ free).sum(axis=1)).ravel()
        lumped *= free_u[self.u.rows]
        self.lumped = np.where(lumped > 0.0, lumped, 1.0)
        self.hierarchies: _Hierarchies | None = None

    def close(self) -> None:
        """Free the PETSc objects."""
        self.renew()

    def prepare(self) -> None:
        """Set up the blocks of K."""
        for block in self.blocks.values():
            block.data({})

    def renew(self) -> None:
        """Discard the multigrid hierarchies, so that the next solve builds new ones."""
        if self.hierarchies is not None:
            self.hierarchies.close()
        self.hierarchies = None

    def spread(self, values: Array) -> tuple[Array, Array]:
        """Return u and q with all coefficients, zero outside of the reach of this rank."""
        many = len(self.u.reach)
        return _spread(values[:many], self.u), _spread(values[many:], self.q)

    @cached_property
    def blocks(self) -> dict[str, _Block]:
        """The four blocks of K, as sums of their parts."""
        u, q, A = self.u, self.q, self.A
        ones_u, ones_q = np.ones(u.dim), np.ones(q.dim)
        free_u, free_q = self.free_u, self.free_q
        uu, uq, qu, qq = (_Block(*pair) for pair in ((u, u), (u, q), (q, u), (q, q)))
        uu.add("M", *_own(self.mass, u), free_u, free_u)
        uu.add("pull", *_own(self.pull, u), free_u, free_u)
        uu.add("fixed", u.rows, u.rows, 1.0 - free_u, ones_u)
        rows, cols = _entries(A.pattern("v", "q"))
        uq.add("A", rows, cols, free_u, free_q)
        qu.add("A", cols, rows, -free_q, free_u)
        qq.add("G", *_own(self.gram, q), free_q, free_q)
        if not self.linear:
            qq.add("Aqq", *_entries(A.pattern("q", "q")), -free_q, free_q)
        qq.add("fixed", q.rows, q.rows, 1.0 - free_q, ones_q)
        return {"uu": uu, "uq": uq, "qu": qu, "qq": qq}


class _Block:
    """Rows of a block owned by this rank, as a sum of matrices of fixed pattern."""

    def __init__(self, rows: Share, cols: Share) -> None:
        self.rows = rows
        self.cols = cols
        self._parts: dict[str, tuple[IntArray, IntArray, sp.csr_array]] = {}

    def add(self, name: str, rows: IntArray, cols: IntArray, left: Array, right: Array) -> None:
        """Add diag(left) X diag(right), X given by its entries; drop entries of other rows."""
        place = np.full(self.rows.dim, -1)
        place[self.rows.rows] = np.arange(len(self.rows.rows))
        at = np.flatnonzero(place[rows] >= 0)
        weight = left[rows[at]] * right[cols[at]]
        kept = sp.csr_array((weight, (np.arange(len(at)), at)), shape=(len(at), len(rows)))
        self._parts[name] = (place[rows[at]], self.cols.number[cols[at]], kept)

    @cached_property
    def _built(self) -> tuple[Pattern, dict[str, sp.csr_array]]:
        parts = self._parts.values()
        shape = (len(self.rows.rows), self.cols.dim)
        pattern = Pattern.from_entries(
            np.concatenate([rows for rows, _, _ in parts]),
            np.concatenate([cols for _, cols, _ in parts]),
            shape,
        )
        maps = {
            name: sp.csr_array(pattern.gather(rows, cols) @ kept)
            for name, (rows, cols, kept) in self._parts.items()
        }
        self._parts.clear()
        return pattern, maps

    def data(self, parts: dict[str, Array]) -> Array:
        """Return the entries of the block for given data of its parts."""
        pattern, maps = self._built
        total = np.zeros(pattern.nnz)
        for name, values in parts.items():
            total += maps[name] @ values
        return total

    def matrix(self, team: Team, data: Array) -> Any:
        """Return the PETSc matrix with these entries."""
        pattern, _ = self._built
        csr = (pattern.indptr, pattern.indices, data)
        return owned(team.comm, pattern.shape[0], csr, int(self.cols.sizes[team.rank]))


def _entries(pattern: Pattern) -> tuple[IntArray, IntArray]:
    return pattern.rows, pattern.indices


def _own(matrix: sp.csr_array, rows: Share) -> tuple[IntArray, IntArray]:
    """Return the entries of a matrix of this rank's rows only, in the order of its data."""
    return np.repeat(rows.rows, np.diff(matrix.indptr)), matrix.indices


class SharedEquation:
    """Rows of the equation of one stage owned by a rank, term by term.

    Parameters
    ----------
    stage
        Key of the `SharedStage`.
    h, t, inputs
        Length of the step, time at its end, and input channels at that time.
    scale
        Factor of G_Q.
    known
        For each rank w, c_u and c_q in its reach; on rank 0 only.
    """

    def __init__(
        self,
        team: Team,
        stage: int,
        h: float,
        t: float,
        inputs: dict[str, float],
        scale: float,
        known: list[Array] | None,
    ) -> None:
        self.team = team
        self.stage: SharedStage = team.part(stage)
        self.h = h
        self.moment = Moment(t, Inputs(inputs))
        self.scale = scale
        u, q = self.stage.u, self.stage.q
        got = np.empty(2 * len(u.reach) + len(q.reach))
        team.scatter(known, got)
        self.w = _spread(got[: len(u.reach)], u)
        self.c_u, self.c_q = self.stage.spread(got[len(u.reach) :])

    def close(self) -> None:
        """Do nothing: no PETSc object is held."""

    @cached_property
    def _linear_A(self) -> sp.csr_array:
        return self.stage.A.matrix("v", "q", self.moment, u=self.w)

    def A(self, q: Array) -> sp.csr_array:
        """Return A(w) on the cells of this rank, or its derivative at q, shape (n, m)."""
        if self.stage.linear:
            return self._linear_A
        return self.stage.A.matrix("v", "q", self.moment, u=self.w, q=q)

    def flux(self) -> list[Array] | None:
        """Return B(w), the rows of each rank."""
        u = self.stage.u
        return self.team.gather(self.stage.B.vector("v", self.moment, u=self.w)[u.rows], u.sizes)

    def terms(self, values: list[Array] | None) -> list[Array] | None:
        """Return M (u - c_u)/h, A(w) q, R^T M_op r, M r, scale G_Q (q - c_q) and A(w)^T r.

        Parameters
        ----------
        values
            For each rank u and q in its reach; on rank 0 only.
        """
        stage = self.stage
        got = np.empty(len(stage.u.reach) + len(stage.q.reach))
        self.team.scatter(values, got)
        u, q = stage.spread(got)
        r = stage.free_u * (u - self.w)
        rows, rows_q = stage.u.rows, stage.q.rows
        A = self.A(q)
        driven = A @ q if stage.linear else stage.A.vector("v", self.moment, u=self.w, q=q)
        mine = [
            stage.mass @ ((u - self.c_u) / self.h),
            driven[rows],
            stage.pull @ r,
            stage.free_u[rows] * (stage.mass @ r),
            self.scale * (stage.gram @ (q - self.c_q)),
            (A.T @ r)[rows_q],
        ]
        return self.team.gather(np.concatenate(mine), 4 * stage.u.sizes + 2 * stage.q.sizes)


def _spread(values: Array, share: Share) -> Array:
    """Return a vector of all coefficients, zero outside of the reach of this rank."""
    whole = np.zeros(share.dim)
    whole[share.reach] = values
    return whole


class SharedJacobian:
    """Rows of the Jacobian K owned by a rank.

    Parameters
    ----------
    equation
        Key of the `SharedEquation`.
    theta
        Damping coefficient.
    scales
        Dual norms by which the residuals of the two equations are scaled.
    values
        For each rank u and q in its reach; on rank 0 only.
    border
        For each rank its rows of b and a, for the rank-one term b a^T of S; on rank 0 only.
    """

    def __init__(
        self,
        team: Team,
        equation: int,
        theta: float,
        scales: tuple[float, float],
        values: list[Array] | None,
        border: list[Array] | None,
    ) -> None:
        at: SharedEquation = team.part(equation)
        self.stage = stage = at.stage
        self.team = team
        got = np.empty(len(stage.u.reach) + len(stage.q.reach))
        team.scatter(values, got)
        u, q = stage.spread(got)
        A = at.A(q).data
        state = {
            "M": stage.mass.data / at.h,
            "pull": theta * stage.pull.data,
            "fixed": np.ones(len(stage.u.rows)),
        }
        metric = {"G": at.scale * stage.gram.data, "fixed": np.ones(len(stage.q.rows))}
        if not stage.linear:
            r = stage.free_u * (u - at.w)
            metric["Aqq"] = stage.A.data("q", "q", at.moment, u=at.w, v=r, q=q)
        parts = {"uu": state, "uq": {"A": A}, "qu": {"A": A}, "qq": metric}
        data = {name: stage.blocks[name].data(part) for name, part in parts.items()}
        finite = all(np.isfinite(values).all() for values in data.values())
        if not all(team.comm.allgather(finite)):
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        self.S, self.A, self.Back, self.G = (
            stage.blocks[name].matrix(team, values) for name, values in data.items()
        )
        pairs = zip(stage.roots, scales, strict=True)
        self.weights = np.concatenate([roots / (scale or 1.0) for roots, scale in pairs])
        self.rate = stage.lumped * (1.0 / at.h + theta * stage.free_u[stage.u.rows])
        self.u, self.v = self.S.createVecs()
        self.q, self.p = self.G.createVecs()
        self.column, self.row = self._bordered(border)

    def _bordered(self, border: list[Array] | None) -> tuple[Any, Any]:
        mine = np.empty(2 * len(self.stage.u.rows))
        self.team.scatter(border, mine)
        column, row = self.S.createVecs()
        half = len(self.stage.u.rows)
        column.setArray(mine[:half])
        row.setArray(mine[half:])
        return column, row

    def close(self) -> None:
        """Free the PETSc objects, collectively on all ranks."""
        vectors = (self.u, self.v, self.q, self.p, self.column, self.row)
        for item in (self.S, self.A, self.Back, self.G, *vectors):
            item.destroy()

    def schur(self) -> Any:
        """Return the approximate Schur complement C."""
        from petsc4py import PETSc

        scaled = self.A.copy()
        scale = self.S.createVecLeft()
        scale.setArray(self.stage.free_u[self.stage.u.rows] / np.sqrt(self.rate))
        scaled.diagonalScale(L=scale)
        C = scaled.transposeMatMult(scaled)
        C.axpy(1.0, self.G, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        scaled.destroy()
        scale.destroy()
        return C

    def split(self, values: Array) -> tuple[Any, Any]:
        """Return the rows of u and of q as PETSc vectors."""
        n = len(self.stage.u.rows)
        self.u.setArray(values[:n])
        self.q.setArray(values[n:])
        return self.u, self.q

    def mult(self, matrix: Any, x: Any, y: Any) -> None:
        """Set y = D K x with the row weights D; called by PETSc."""
        u, q = self.split(x.getArray(readonly=True))
        self.S.mult(u, self.v)
        self.A.multAdd(q, self.v, self.v)
        self.v.axpy(self.row.dot(u), self.column)
        self.G.mult(q, self.p)
        self.Back.multAdd(u, self.p, self.p)
        parts = [self.v.getArray(readonly=True), self.p.getArray(readonly=True)]
        y.setArray(self.weights * np.concatenate(parts))

    def solve(self, pieces: list[Array] | None) -> list[Array] | None:
        """Return x with K x = b to the tolerance, the rows of each rank."""
        stage = self.stage
        mine = np.empty(len(stage.u.rows) + len(stage.q.rows))
        self.team.scatter(pieces, mine)
        fresh = stage.hierarchies is None
        count = self._gmres(mine)
        if count is None and not fresh:
            stage.renew()
            count = self._gmres(mine)
        if count is None:
            raise LinearAlgebraError(f"{ITERATIONS} iterations of GMRES did not suffice: {REMEDY}")
        # Rows of fixed coefficients are rows of the identity. Their solution is set exactly, since
        # the weighted residual does not contain them.
        known = np.concatenate([stage.free_u[stage.u.rows], stage.free_q[stage.q.rows]]) == 0.0
        self.found[known] = mine[known]
        return self.team.gather(self.found, stage.u.sizes + stage.q.sizes)

    def _gmres(self, mine: Array) -> int | None:
        """Solve with the present hierarchies; return the number of iterations, None: too many."""
        from petsc4py import PETSc

        stage = self.stage
        if stage.hierarchies is None:
            stage.hierarchies = _Hierarchies(self)
        layout = (len(mine), PETSc.DETERMINE)
        K = PETSc.Mat().createPython((layout, layout), self, comm=self.team.comm)
        K.setUp()
        ksp = PETSc.KSP().create(self.team.comm)
        ksp.setOperators(K)
        ksp.setType(PETSc.KSP.Type.GMRES)
        ksp.setGMRESRestart(ITERATIONS)
        ksp.setPCSide(PETSc.PC.Side.RIGHT)  # so that the residual is Newton's
        ksp.setTolerances(rtol=TOLERANCE, atol=0.0, max_it=ITERATIONS)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(_Preconditioner(self, stage.hierarchies))
        x, b = K.createVecs()
        b.setArray(self.weights * mine)
        ksp.solve(b, x)
        self.found: Array = x.getArray().copy()
        count, good = ksp.getIterationNumber(), ksp.getConvergedReason() > 0
        for item in (ksp, K, x, b):
            item.destroy()
        if not good:
            return None
        first = stage.hierarchies.first = stage.hierarchies.first or count
        if count > MORE * max(first, 2):
            stage.renew()
        return int(count)


class _Hierarchies:
    """Multigrid hierarchies for S and C, reused while they converge well.

    Attributes
    ----------
    first
        Number of iterations of the first solve with them.
    """

    def __init__(self, at: SharedJacobian) -> None:
        self.first = 0
        self.S = at.S.copy()
        self.C = at.schur()
        self.state, self.metric = self._cycle(self.S), self._cycle(self.C)

    @staticmethod
    def _cycle(matrix: Any) -> Any:
        from petsc4py import PETSc

        pc = PETSc.PC().create(matrix.getComm())
        pc.setOperators(matrix)
        pc.setType(PETSc.PC.Type.GAMG)
        pc.setUp()
        return pc

    def close(self) -> None:
        """Free the PETSc objects."""
        for item in (self.state, self.metric, self.S, self.C):
            item.destroy()


@dataclass(frozen=True, eq=False)
class _Preconditioner:
    """Block-triangular preconditioner from S and C for K; called by PETSc."""

    at: SharedJacobian
    hierarchies: _Hierarchies

    def apply(self, pc: Any, x: Any, y: Any) -> None:
        """Set y to the approximate solution for x."""
        at = self.at
        u, q = at.split(x.getArray(readonly=True) / at.weights)
        self.hierarchies.state.apply(u, at.v)
        at.Back.mult(at.v, at.p)
        at.p.aypx(-1.0, q)
        self.hierarchies.metric.apply(at.p, at.q)
        y.setArray(np.concatenate([at.v.getArray(readonly=True), at.q.getArray(readonly=True)]))
