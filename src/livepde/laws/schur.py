"""Large coupled stages by blocks: factors of the state block and of a sparse Schur block.

The Jacobian of a stage of `livepde.laws.coupled` is

    K = [[S, A], [-A^T R - ..., G]],    G = G_Q/(gain h) + ...,

and no matrix of all of it is ever formed: its blocks have the patterns of the forms. The Schur
complement G + A^T R S^{-1} A is dense. With D, the lumped mass times 1/h + theta, in the place of S
it is sparse,

    C = G + A^T R D^{-1} R^T A,

and an approximate solution with K is one solve with S and one with C,

    u = S^{-1} b_u,    q = C^{-1} (b_q + A^T R u),    u - R D^{-1} R^T A q.

D^{-1} is the better in the place of S^{-1} the smoother what it is applied to and the shorter h;
the larger the gain, the more this counts. Of a field q that A does not differentiate, the diagonal
matrix that does to constants what A^T R S^{-1} A does takes the place of that product: smooth
functions hardly miss the difference, and rough ones are ruled by G_Q.

Where sensors see coefficients, R selects some of them, and only the others take part in B(w) and
A(w) q:

    S = [[S_uu, M_uo/h], [S_ou, S_oo]]        u: not observed, o: observed

is not symmetric, but S_uu and S_oo are, if B and A(.) q are. Without M_uo/h the two solve S.
With small theta S_oo is little more than a mass matrix, and a few products replace its factor
(`Series`). S_ou is that of a differential operator, of the size of h/x^2 times S_oo with cells of
size x: a small error of u where it is not observed is a large one next to it. So, with q known,
S u = b_u - A q is solved again, with M_uo/h times the u at hand (`Triangle.again`). What is left
then is large only where the two meet: a strip of a few nodes is solved as a whole (`Seam`); all
three are in `livepde.laws.triangle`.

That serves Newton as a kept factor (`livepde.laws.jacobian.Approximate`): an update takes off all
but 1e-2 to 1e-3 of the error. Where it takes off too little, GMRES solves with K itself
(`Jacobian`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Field, Moment
from livepde.laws.equation import Equation
from livepde.laws.gains import PULL, Metric
from livepde.laws.jacobian import Approximate, Jacobian
from livepde.laws.triangle import Seam, Series, Triangle, is_symmetric, masked
from livepde.laws.warm import Kept, LeanMisses
from livepde.laws.way import Way
from livepde.linalg import Array, BandedSolver, Factor, IntArray, Pattern, Solver, analyse
from livepde.stepping import Newton

if TYPE_CHECKING:
    from livepde.laws.coupled import CoupledStage

__all__ = ["LARGE", "BlockEquation", "BlockSolver"]

LARGE = 4000  # unknowns u and q together, from which a matrix that is not banded goes by blocks
TOLERANCE = 1e-2  # of u and of q, relative to their first approximation: Newton goes on from there
SHARE = 0.3  # of what its start missed may be left of a stage; see `BlockSolver.newton`
AGES = 8.0  # stages in which what factors leave of an error doubles, as long as unseen
SPENT = 24  # updates and iterations: about what new factors cost
ONE_SIGN = 1.1  # sum of sizes over size of sums, of entries that have one sign nearly everywhere
LAYERS = 4  # neighbours on either side of where observed coefficients meet others


class BlockEquation(Equation):
    """The equation of a stage, its Jacobian by blocks."""

    way: BlockSolver

    def residual(self, y: Array) -> Array:
        out = super().residual(y)
        self.way.A = self.A
        return out

    def factor(self, y: Array, sweep: bool) -> Jacobian:
        return self.way.jacobian(self, y, sweep)


class BlockSolver(Way):
    """Solves the coupled systems of a stage by blocks.

    Attributes
    ----------
    tolerance
        To which systems are solved by GMRES.
    A
        A(w) at the last residual.
    made, last
        Factors made in a stage, and those of this stage or an earlier one.
    """

    rough = True
    equations = BlockEquation
    kind = LeanMisses

    def __init__(self, stage: CoupledStage) -> None:
        super().__init__(stage)
        self.tolerance = TOLERANCE
        self._solvers: dict[str, tuple[Solver, bool]] = {}
        self.made: Approximate | None = None
        self.last: Approximate | None = None
        self.A = sp.csr_array((stage.n, stage.model.Q.dim))

    @classmethod
    def of(cls, stage: CoupledStage) -> BlockSolver | None:
        """Return it for a stage; None where that is small, or its matrix is banded."""
        if stage.size < LARGE:
            return None
        banded = isinstance(analyse(Pattern.of(stage.model.mass + stage.RMR)), BandedSolver)
        return None if banded else cls(stage)

    @property
    def keeps(self) -> bool:
        return self.stage.model.constant

    @property
    def patience(self) -> int:
        return SPENT

    def newton(self, tunes: bool) -> Newton:
        """Return the nonlinear iteration.

        A stage may leave more of what its start missed. The next step goes on with it, but its
        start extrapolates it about threefold: more would grow from step to step. A law that tunes
        itself learns from what is left.
        """
        newton = super().newton(tunes)
        if tunes or not newton.share:
            return newton
        return replace(newton, share=max(newton.share, SHARE))

    def begin(self, kept: Kept, moment: Moment) -> None:
        self.resume(self.factor(kept, moment) if len(kept.y) else None)

    def resume(self, kept: Approximate | None) -> None:
        """Begin a stage with the factors of an earlier one."""
        self.last, self.made, self.iterations = kept, None, []

    def factor(self, kept: Kept, moment: Moment) -> Approximate:
        if self.last is None or self.last.at is not kept.y:
            metric, memory = None, self.stage.memory
            if memory is not None:
                J, data = memory.matrix(kept.information), kept.information
                metric = Metric(kept.spread, J, data, np.zeros(self.stage.model.Q.dim))
            zero = np.zeros_like(kept.y)
            equation = self.equation(zero, kept.h, moment, kept.u_alpha, metric)
            equation.residual(kept.y)
            self.last = self.approximate(self.jacobian(equation, kept.y, False))
        return self.last

    def fresh(self, equation: Equation, y: Array) -> Factor | None:
        if not self.keeps:
            return None
        equation.residual(y)
        return self.renew(self.jacobian(equation, y, False))

    def made_at(self, equation: Equation) -> Array | None:
        return None if self.made is None else self.made.at

    def wear(self, age: int) -> float:
        """Return how much more a factor of an age leaves; it is approximate from the start."""
        return 1.0 + age / AGES

    def trusted(self, seen: float, missed: float) -> float:
        return seen

    def renew(self, K: Jacobian) -> Approximate:
        """Make the factors of K those of the stage."""
        self.made = self.last = None  # its memory, first
        self.made = self.last = self.approximate(K)
        return self.last

    @cached_property
    def lumped(self) -> Array:
        """Lumped mass on the free coefficients, one on the fixed ones, shape (n,)."""
        free = self.stage.model.X.free
        rows = np.asarray(abs(masked(self.stage.model.mass, free, free)).sum(axis=1)).ravel()
        return np.where(rows > 0.0, rows, 1.0)

    @cached_property
    def parts(self) -> tuple[IntArray, IntArray] | None:
        """Coefficients that are not observed, and those that are; None: S is solved as a whole.

        So it is where a sample is missing and nothing is observed.
        """
        R, W = self.stage.split.R, self.stage.W
        observed, free = R.diagonal(), self.stage.model.X.free
        selects = R.nnz == np.count_nonzero(observed) and bool(np.isin(observed, (0, 1)).all())
        if not selects or not observed.any() or not masked(W, np.ones(len(free)), free).data.any():
            return None
        return np.flatnonzero(observed == 0.0), np.flatnonzero(observed)

    def jacobian(self, equation: Equation, y: Array, sweep: bool) -> Jacobian:
        """Return K at the y of the last residual; in a sweep without what r adds to it."""
        stage, form = self.stage, self.stage.model.form_A
        model, g, n, h = stage.model, stage.gains, stage.n, equation.h
        w, r, q, at = equation.w, equation.r, y[n:], equation.moment
        free, free_q = model.X.free, stage.free_q
        flux = model.form_B.matrix("v", "u", at, u=w) + form.matrix("v", "u", at, u=w, q=q)
        S = masked(sp.csr_array(model.mass / h), free, free) + masked(
            _product(flux, stage.W), free, free
        )
        if equation.theta:
            S = S + equation.theta * stage.RMR
        if g.nu:
            S = S + masked(g.nu * stage.PNP, free, free)
        S = sp.csr_array(S + sp.diags_array(1.0 - free))
        A = masked(equation.A, free, free_q)
        back, curved = None, None
        if not sweep:
            back = masked(form.matrix("q", "u", at, u=w, v=r, q=q), free_q, np.ones(n))
            if not stage.linear:
                curved = masked(form.matrix("q", "q", at, u=w, v=r, q=q), free_q, free_q)
        rate = 1.0 / h + equation.theta * np.abs(stage.split.R.diagonal())
        K = Jacobian(self, y, S, A, self._metric(equation), self.lumped * rate, back, curved)
        row = equation.slope(sweep)
        return K if row is None else K.bordered(equation.Mr, row)

    def _metric(self, equation: Equation) -> sp.csr_array:
        """Return G on the free coefficients, with its auxiliary unknowns."""
        stage, g = self.stage, self.stage.gains
        model, rest = stage.model, np.zeros(self.stage.auxiliary)
        free = np.concatenate([stage.free_q, 1.0 - rest])
        metric = equation.metric
        scale = (1.0 / equation.h + g.sigma) / g.gain if metric is None else metric.spread / PULL
        G = stage.gram * scale
        if model.latent.generator.nnz:
            K = sp.block_diag([model.latent.generator, sp.csr_array((len(rest), len(rest)))])
            G = G - stage.gram @ (sp.csr_array(K) / g.gain)
        if metric is not None:
            G = G + _widened(sp.csr_array(metric.information / PULL), len(rest))
        return sp.csr_array(masked(sp.csr_array(G), free, free) + sp.diags_array(1.0 - free))

    def approximate(self, K: Jacobian) -> Approximate:
        """Factorise S and C."""
        state = self._state(K.S)
        C = sp.csr_array(K.G + _widened(self._information(K, state), self.stage.auxiliary))
        schur = self._factorise("C", C, approximate=True)
        return Approximate(self, K.at, state, schur, K.rates, self._seam(K))

    def _information(self, K: Jacobian, state: Factor) -> sp.csr_array:
        """Return what stands for A^T R S^{-1} A in C."""
        stage, R = self.stage, self.stage.split.R
        parts = list(stage.model.latent.parts.values())
        if len(parts) == 1 and isinstance(parts[0].unknown, Field):
            image = K.A @ stage.free_q
            if np.abs(K.A.data).sum() <= ONE_SIGN * np.abs(image).sum():
                seen = K.A.T @ (R @ state.solve(image))
                return sp.csr_array(sp.diags_array(np.maximum(seen, 0.0)))
        forces = sp.csr_array(R.T @ K.A)
        return sp.csr_array(forces.T @ sp.diags_array(1.0 / K.rates) @ forces)

    def _seam(self, K: Jacobian) -> Seam | None:
        if not len(self.strip):
            return None
        S = sp.csr_array(K.S[self.strip])
        factor = self._factorise("S, between", sp.csr_array(S[:, self.strip]))
        return Seam(self.strip, factor, S, sp.csr_array(K.A[self.strip]))

    def _state(self, S: sp.csr_array) -> Factor:
        if self.parts is None:
            return self._factorise("S", S)
        unseen, seen = self.parts
        top, bottom = sp.csr_array(S[unseen]), sp.csr_array(S[seen])
        local = sp.csr_array(bottom[:, seen])
        return Triangle(
            self.parts,
            self._factorise("S, not observed", sp.csr_array(top[:, unseen])),
            Series.of(local) or self._factorise("S, observed", local),
            sp.csr_array(bottom[:, unseen]),
            sp.csr_array(top[:, seen]),
        )

    @cached_property
    def strip(self) -> IntArray:
        """Coefficients less than so many neighbours away from where observed ones meet others."""
        if self.parts is None:
            return np.zeros(0, dtype=np.int64)
        unseen, _ = self.parts
        links = abs(self.stage.model.mass)
        free = self.stage.model.X.free
        other = np.zeros(len(free))
        other[unseen] = free[unseen]
        near = (links @ other) * self.stage.split.R.diagonal()
        for _ in range(LAYERS):
            near = links @ (near > 0.0)
        return np.flatnonzero((near > 0.0) & (free > 0.0))

    def _factorise(self, name: str, matrix: sp.csr_array, approximate: bool = False) -> Factor:
        """Return the factor of a matrix, by an engine for symmetric ones if it is positive."""
        matrix.sort_indices()
        if not np.isfinite(matrix.data).all():
            raise LinearAlgebraError("The matrix holds values that are not finite.")
        if is_symmetric(matrix):
            try:
                return self._solver(name, matrix, True, approximate).factorise(matrix.data)
            except LinearAlgebraError:  # it is indefinite
                pass
        return self._solver(name, matrix, False, approximate).factorise(matrix.data)

    def _solver(
        self, name: str, matrix: sp.csr_array, symmetric: bool, approximate: bool
    ) -> Solver:
        """Return the engine of a matrix, analysed again only where its pattern has changed."""
        solver, kind = self._solvers.get(name, (None, symmetric))
        if (
            solver is None
            or kind != symmetric
            or not np.array_equal(solver.pattern.indptr, matrix.indptr)
            or not np.array_equal(solver.pattern.indices, matrix.indices)
        ):
            pattern = Pattern(matrix.shape, matrix.indptr, matrix.indices)
            solver = analyse(pattern, symmetric=symmetric, approximate=approximate)
            self._solvers[name] = solver, symmetric
        return solver

    @property
    def engines(self) -> dict[str, str]:
        """Names of the engines of the blocks that were factorised."""
        return {name: solver.name for name, (solver, _) in self._solvers.items()}


def _product(matrix: sp.csr_array, W: sp.csr_array) -> sp.csr_array:
    """Return matrix W; with the same pattern if W is diagonal."""
    diagonal = W.diagonal()
    if W.nnz == np.count_nonzero(diagonal):
        return masked(matrix, np.ones(len(diagonal)), diagonal)
    return sp.csr_array(matrix @ W)


def _widened(matrix: sp.csr_array, more: int) -> sp.csr_array:
    """Return a square matrix with zero rows and columns behind."""
    if not more:
        return matrix
    return sp.csr_array(sp.block_diag([matrix, sp.csr_array((more, more))]))
