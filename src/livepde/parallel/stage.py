"""The coupled stage of the gradient law on many ranks: what each of them does.

A rank evaluates the forms on its cells and one layer beyond, and so has its rows of the residual
and of the Jacobian

    K = [[S, A], [-A^T R - ..., G]]

complete. What crosses ranks are values of u and q on the layer, inner products, and what PETSc's
products and multigrid exchange. K is solved by GMRES, preconditioned as in `livepde.laws.schur`: a
cycle of multigrid (GAMG) for S and one for C = G + A^T R D^{-1} R^T A.
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

__all__ = ["SharedEquation", "SharedJacobian", "SharedStage", "Weights"]

TOLERANCE = 1e-2  # of u and of q, relative to their first approximation: Newton goes on from there
ITERATIONS = 60  # each keeps a vector
MORE = 2  # times as many iterations as with new multigrid hierarchies: then they are made again
REMEDY = "take a smaller gain or a smaller time step."


@dataclass(frozen=True)
class Weights:
    """Numbers of the law; see `livepde.laws.gains.Gains`."""

    gain: float
    nu: float
    sigma: float
    at_estimate: bool


class SharedStage:
    """What a rank keeps of a stage: forms on its cells, its rows of what is constant.

    Parameters
    ----------
    model
        Key of the `SharedModel`.
    observed
        Diagonal of R, shape (n,).
    free_u, free_q
        Ones at free coefficients, shapes (n,) and (m,).
    rows
        Of each rank: its rows of M, R^T M_op, P^T N_op P and G_Q; on rank 0.
    """

    def __init__(
        self,
        team: Team,
        model: int,
        weights: Weights,
        observed: Array,
        free_u: Array,
        free_q: Array,
        rows: list[tuple[sp.csr_array, ...]] | None,
    ) -> None:
        shared: SharedModel = team.part(model)
        self.team = team
        self.weights = weights
        self.u, self.q = shared.u, shared.q
        self.A, self.B = shared.A, shared.B
        self.linear: bool = self.A.linear_in_parameter
        self.mass, self.RM, self.PNP, self.gram = team.comm.scatter(rows)
        self.observed, self.free_u, self.free_q = observed, free_u, free_q
        self.W = np.ones_like(observed) if weights.at_estimate else 1.0 - observed
        free = sp.diags_array(free_u)
        lumped = np.asarray(abs(self.mass @ free).sum(axis=1)).ravel()
        lumped *= free_u[self.u.rows]
        self.lumped = np.where(lumped > 0.0, lumped, 1.0)
        self.hierarchies: _Hierarchies | None = None

    def close(self) -> None:
        """Free what PETSc holds."""
        self.renew()

    def renew(self) -> None:
        """Let the next solve make new hierarchies."""
        if self.hierarchies is not None:
            self.hierarchies.close()
        self.hierarchies = None

    @cached_property
    def blocks(self) -> dict[str, _Block]:
        """The four blocks of K, and what they are made of."""
        u, q, A = self.u, self.q, self.A
        ones_u, ones_q = np.ones(u.dim), np.ones(q.dim)
        free_u, free_q = self.free_u, self.free_q
        seen, unseen = self.observed * free_u, self.W * free_u
        uu, uq, qu, qq = (_Block(*pair) for pair in ((u, u), (u, q), (q, u), (q, q)))
        uu.add("M", *_own(self.mass, u), free_u, free_u)
        uu.add("B", *_entries(self.B.pattern("v", "u")), free_u, unseen)
        uu.add("Au", *_entries(A.pattern("v", "u")), free_u, unseen)
        uu.add("RMR", *_own(self.RM, u), free_u, seen)
        uu.add("PNP", *_own(self.PNP, u), free_u, free_u)
        uu.add("fixed", u.rows, u.rows, 1.0 - free_u, ones_u)
        uq.add("A", *_entries(A.pattern("v", "q")), free_u, free_q)
        rows, cols = _entries(A.pattern("v", "q"))
        qu.add("A", cols, rows, -free_q, seen)
        qu.add("Aq", *_entries(A.pattern("q", "u")), -free_q, unseen)
        qq.add("G", *_own(self.gram, q), free_q, free_q)
        if not self.linear:
            qq.add("Aqq", *_entries(A.pattern("q", "q")), -free_q, free_q)
        qq.add("fixed", q.rows, q.rows, 1.0 - free_q, ones_q)
        return {"uu": uu, "uq": uq, "qu": qu, "qq": qq}


class _Block:
    """The rows that this rank owns of a block, as a sum of matrices of fixed pattern."""

    def __init__(self, rows: Share, cols: Share) -> None:
        self.rows = rows
        self.cols = cols
        self._parts: dict[str, tuple[IntArray, IntArray, sp.csr_array]] = {}

    def add(self, name: str, rows: IntArray, cols: IntArray, left: Array, right: Array) -> None:
        """Add diag(left) X diag(right), X given by its entries; those of other rows are left."""
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
        """Return the entries that belong to these data of its parts."""
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
    """Return the entries of a matrix that holds this rank's rows only, in the order of its data."""
    return np.repeat(rows.rows, np.diff(matrix.indptr)), matrix.indices


class SharedEquation:
    """A rank's rows of one stage: its residual.

    Parameters
    ----------
    stage
        Key of the `SharedStage`.
    h, t, inputs
        Length and time of the step, and the input channels then.
    known
        Of each rank: c_u, u_alpha and c_q where it reaches, and its rows of the source; on rank 0.
    """

    def __init__(
        self,
        team: Team,
        stage: int,
        h: float,
        t: float,
        inputs: dict[str, float],
        known: list[Array] | None,
    ) -> None:
        self.team = team
        self.stage: SharedStage = team.part(stage)
        self.h = h
        self.moment = Moment(t, Inputs(inputs))
        u, q = self.stage.u, self.stage.q
        many, some = len(u.reach), len(q.reach)
        got = np.empty(2 * many + some + len(u.rows))
        team.scatter(known, got)
        c_u, alpha, c_q, self.source = np.split(got, np.cumsum([many, many, some]))
        self.c_u, self.u_alpha = _spread(c_u, u), _spread(alpha, u)
        self.c_q = _spread(c_q, q)

    def close(self) -> None:
        """Nothing of PETSc is held."""

    def residual(self, values: list[Array] | None) -> list[Array] | None:
        """Return, of each rank, its rows of the first line, of R^T M_op r, R^T M r and the second.

        The first line is without theta R^T M_op r: theta depends on all of r.
        """
        stage, weights = self.stage, self.stage.weights
        got = np.empty(len(stage.u.reach) + len(stage.q.reach))
        self.team.scatter(values, got)
        u = _spread(got[: len(stage.u.reach)], stage.u)
        self.at_q = q = _spread(got[len(stage.u.reach) :], stage.q)
        self.r = r = stage.observed * u - self.u_alpha
        self.w = w = u if weights.at_estimate else u - r
        rows, rows_q = stage.u.rows, stage.q.rows
        A = stage.A.matrix("v", "q", self.moment, u=w, q=q)
        C = A @ q if stage.linear else stage.A.vector("v", self.moment, u=w, q=q)
        flux = stage.B.vector("v", self.moment, u=w) + C
        rate = stage.mass @ ((u - self.c_u) / self.h)
        first = rate + flux[rows] + weights.nu * (stage.PNP @ u) - self.source
        gain = weights.gain
        drive = (q - self.c_q) / (gain * self.h) + (weights.sigma / gain) * q
        second = stage.gram @ drive - (A.T @ r)[rows_q]
        mine = [
            first * stage.free_u[rows],
            stage.RM @ r,
            stage.observed[rows] * (stage.mass @ r),
            second * stage.free_q[rows_q],
        ]
        sizes = 3 * stage.u.sizes + stage.q.sizes
        return self.team.gather(np.concatenate(mine), sizes)


def _spread(values: Array, share: Share) -> Array:
    """Return a vector of all coefficients, zero where this rank does not reach."""
    whole = np.zeros(share.dim)
    whole[share.reach] = values
    return whole


class SharedJacobian:
    """A rank's rows of K at the point of the last residual of an equation.

    Parameters
    ----------
    equation
        Key of the `SharedEquation`.
    theta
        Of the damping.
    sweep
        Without what r adds to K.
    border
        Of each rank: its rows of b and a where b a^T is added to S; on rank 0. Empty: nothing is.
    """

    def __init__(
        self, team: Team, equation: int, theta: float, sweep: bool, border: list[Array] | None
    ) -> None:
        at: SharedEquation = team.part(equation)
        self.stage = stage = at.stage
        self.team = team
        self.tolerance = TOLERANCE
        blocks, weights, form = stage.blocks, stage.weights, stage.A
        point = {"u": at.w, "q": at.at_q}
        flux = form.data("v", "q", at.moment, **point)
        forward = {
            "M": stage.mass.data / at.h,
            "B": stage.B.data("v", "u", at.moment, u=at.w),
            "Au": form.data("v", "u", at.moment, **point),
            "RMR": theta * stage.RM.data,
            "PNP": weights.nu * stage.PNP.data,
            "fixed": np.ones(len(stage.u.rows)),
        }
        back = {"A": flux}
        metric = {
            "G": (1.0 / at.h + weights.sigma) / weights.gain * stage.gram.data,
            "fixed": np.ones(len(stage.q.rows)),
        }
        if not sweep:
            back["Aq"] = form.data("q", "u", at.moment, v=at.r, **point)
            if not stage.linear:
                metric["Aqq"] = form.data("q", "q", at.moment, v=at.r, **point)
        parts = {"uu": forward, "uq": {"A": flux}, "qu": back, "qq": metric}
        data = {name: blocks[name].data(part) for name, part in parts.items()}
        finite = all(np.isfinite(values).all() for values in data.values())
        if not all(team.comm.allgather(finite)):
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        self.S, self.A, self.Back, self.G = (
            blocks[name].matrix(team, values) for name, values in data.items()
        )
        self.rate = stage.lumped * (1.0 / at.h + theta * stage.observed[stage.u.rows])
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
        """Free what PETSc holds, on all ranks at once."""
        vectors = (self.u, self.v, self.q, self.p, self.column, self.row)
        for item in (self.S, self.A, self.Back, self.G, *vectors):
            item.destroy()

    def schur(self) -> Any:
        """Return C."""
        from petsc4py import PETSc

        scaled = self.A.copy()
        scale = self.S.createVecLeft()
        scale.setArray(self.stage.observed[self.stage.u.rows] / np.sqrt(self.rate))
        scaled.diagonalScale(L=scale)
        C = scaled.transposeMatMult(scaled)
        C.axpy(1.0, self.G, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        scaled.destroy()
        scale.destroy()
        return C

    def split(self, x: Any) -> tuple[Any, Any]:
        """Return the parts of a vector as vectors of their own."""
        values, n = x.getArray(readonly=True), len(self.stage.u.rows)
        self.u.setArray(values[:n])
        self.q.setArray(values[n:])
        return self.u, self.q

    def mult(self, matrix: Any, x: Any, y: Any) -> None:
        """Set y = K x; PETSc calls this."""
        u, q = self.split(x)
        self.S.mult(u, self.v)
        self.A.multAdd(q, self.v, self.v)
        self.v.axpy(self.row.dot(u), self.column)
        self.G.mult(q, self.p)
        self.Back.multAdd(u, self.p, self.p)
        y.setArray(np.concatenate([self.v.getArray(readonly=True), self.p.getArray(readonly=True)]))

    def solve(self, pieces: list[Array] | None) -> list[Array] | None:
        """Return the rows of each rank of x with K x = b, to the tolerance."""
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
        # Their rows are those of the identity: what is not exactly so, no residual would ever see.
        known = np.concatenate([stage.free_u[stage.u.rows], stage.free_q[stage.q.rows]]) == 0.0
        self.found[known] = mine[known]
        return self.team.gather(self.found, stage.u.sizes + stage.q.sizes)

    def _gmres(self, mine: Array) -> int | None:
        """Solve with the hierarchies at hand; return the number of iterations, None: too many."""
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
        ksp.setTolerances(rtol=self.tolerance, atol=0.0, max_it=ITERATIONS)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(_Preconditioner(self, stage.hierarchies))
        x, b = K.createVecs()
        b.setArray(mine)
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
    """Multigrid for S and for C of a point, kept while they serve.

    Attributes
    ----------
    first
        Iterations of the first solve with them.
    """

    def __init__(self, at: SharedJacobian) -> None:
        self.first = 0
        self.S = at.S.copy()
        self.C = at.schur()
        self.state, self.metric = self._state(at.stage), self._cycle(self.C)

    def _state(self, stage: SharedStage) -> Any:
        """Return what solves with S: where R selects coefficients, the unobserved ones first.

        Only they take part in B(w) and A(w) q, so that S without M_uo/h is a block triangle, and
        its diagonal blocks are what multigrid is made for.
        """
        from petsc4py import PETSc

        unseen, seen = stage.W * stage.free_u, stage.observed
        if not (unseen.any() and seen.any()) or stage.weights.at_estimate:
            return self._cycle(self.S)
        pc = PETSc.PC().create(self.S.getComm())
        pc.setOperators(self.S)
        pc.setType(PETSc.PC.Type.FIELDSPLIT)
        pc.setFieldSplitType(PETSc.PC.CompositeType.MULTIPLICATIVE)
        mine = stage.u.number[stage.u.rows]
        second = seen[stage.u.rows] != 0.0
        for name, at in (("unseen", ~second), ("seen", second)):
            rows = np.asarray(mine[at], dtype=PETSc.IntType)
            members = PETSc.IS().createGeneral(rows, comm=self.S.getComm())
            pc.setFieldSplitIS((name, members))
            members.destroy()
        pc.setUp()
        for ksp in pc.getFieldSplitSubKSP():
            ksp.setType(PETSc.KSP.Type.PREONLY)
            ksp.getPC().setType(PETSc.PC.Type.GAMG)
        return pc

    @staticmethod
    def _cycle(matrix: Any) -> Any:
        from petsc4py import PETSc

        pc = PETSc.PC().create(matrix.getComm())
        pc.setOperators(matrix)
        pc.setType(PETSc.PC.Type.GAMG)
        pc.setUp()
        return pc

    def close(self) -> None:
        """Free what PETSc holds."""
        for item in (self.state, self.metric, self.S, self.C):
            item.destroy()


class _Preconditioner:
    """The block triangle of S and C, scaled so that u and q count the same; PETSc calls it."""

    def __init__(self, at: SharedJacobian, hierarchies: _Hierarchies) -> None:
        self.at = at
        self.hierarchies = hierarchies
        self.scale: tuple[float, float] | None = None

    def apply(self, pc: Any, x: Any, y: Any) -> None:
        """Set y to the approximate solution for x."""
        at = self.at
        u, q = at.split(x)
        self.hierarchies.state.apply(u, at.v)
        at.Back.mult(at.v, at.p)
        at.p.aypx(-1.0, q)
        self.hierarchies.metric.apply(at.p, at.q)
        if self.scale is None:
            self.scale = (at.v.norm() or 1.0, at.q.norm() or 1.0)
        first, second = self.scale
        values = (at.v.getArray(readonly=True) / first, at.q.getArray(readonly=True) / second)
        y.setArray(np.concatenate(values))
