"""Large coupled stages by blocks: factors of the state block and of a sparse Schur block.

The Jacobian of a stage is

    K = [[S, A], [-A_in^T R - ..., H]],    S = M/h + B' + d(A q)/du + theta R^T M_op R + nu N,

and no matrix of all of it is ever formed: its blocks have the patterns of the forms. The Schur
complement H + A_in^T R S^{-1} A is dense; C = H + (a sparse matrix of the size of the product)
stands for it. For a field q that A does not differentiate this matrix is diagonal and agrees with
the product on constants: for smooth functions the difference is small, and rough ones are ruled by
G_Q. Else it is A_in^T R D^{-1} R^T A with D, the lumped mass times 1/h + theta, in the place of S.
An approximate solution with K is then

    u = S^{-1} b_u,    q = C^{-1} (b_q + A_in^T R u),    u = S^{-1} (b_u - A q).

It serves Newton as a kept factor; where it reduces the residual too little, GMRES solves with K.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Field
from livepde.laws.coupled.equation import (
    StageData,
    StageIterate,
    StageSolver,
    StageTerms,
)
from livepde.linalg import (
    Array,
    BandedSolver,
    Factor,
    Pattern,
    Solver,
    analyse,
    approximate_inverse,
    gmres,
)
from livepde.linalg.solvers import check_finite

LARGE = 4000  # unknowns u and q together, from which a matrix that is not banded goes by blocks
TOLERANCE = 1e-4  # of GMRES, relative to the first approximation: Newton goes on from there
ITERATIONS = 60  # each keeps a vector
RESOLVED = 1e-10  # of u and q: smaller updates by GMRES are as good as none
ONE_SIGN = 1.1  # sum of sizes over size of sums, of entries that have one sign nearly everywhere
ROUNDING = 1e-12  # asymmetry of a symmetric matrix, relative to its largest entry
REMEDY = "take a smaller gain or a smaller time step."


class BlockSolver(StageSolver):
    """Solves the coupled systems of a stage by blocks."""

    refresh = 0.5  # an update costs a twentieth of new factors
    ceiling = 5e-3  # one more update costs as much as a forward step
    carried = 3e-2  # for the same reason
    patience = 12  # updates and iterations: about what new factors cost

    def __init__(self, terms: StageTerms) -> None:
        super().__init__(terms)
        self.keeps = terms.forms.model.constant
        self._solvers: dict[str, tuple[Solver, bool]] = {}

    @classmethod
    def of(cls, terms: StageTerms) -> BlockSolver | None:
        """Return it for a stage; None where that is small, or its matrix is banded."""
        if terms.size < LARGE:
            return None
        pattern = Pattern.of(terms.forms.model.mass + terms.forms.pull)
        return None if isinstance(analyse(pattern), BandedSolver) else cls(terms)

    def kept(self, factor: Factor) -> Factor:
        return factor.approximate if isinstance(factor, BlockJacobian) else factor

    def prepare(self) -> None:
        forms = self.terms.forms
        _ = self.lumped, forms.pull, forms.mass, forms.hidden
        for form in (forms.A_in, forms.A_out):
            if form is not None:
                form.tensor("v", "q"), form.tensor("v", "u")

    @cached_property
    def lumped(self) -> Array:
        """Lumped mass on the free coefficients, one on the fixed ones, shape (n,)."""
        terms = self.terms
        mass = masked(terms.forms.model.mass, terms.free, terms.free)
        rows = np.asarray(abs(mass).sum(axis=1)).ravel()
        return np.where(rows > 0.0, rows, 1.0)

    def factor(self, data: StageData, at: StageIterate) -> BlockJacobian:
        terms, forms = self.terms, self.terms.forms
        form, moment, h, n = forms.A_in, data.problem.moment, data.problem.h, terms.n
        u, q, free, free_q = at.y[:n], at.y[n:], terms.free, terms.free_q
        S = masked(sp.csr_array(forms.model.mass / h), free, free)
        A = masked(at.A_in, free, free_q)
        back, curved = None, None
        if forms.W is not None:
            flux = forms.B_in.matrix("v", "u", moment, u=at.w)
            flux = flux + form.matrix("v", "u", moment, u=at.w, q=q)
            S = S + masked(sp.csr_array(flux @ forms.W), free, free)
            # The derivative of A(w)^T r in w; W = dw/du makes it one in u.
            seen = form.matrix("q", "u", moment, u=at.w, v=at.r, q=q)
            back = sp.csr_array(masked(seen, free_q, np.ones(n)) @ forms.W)
        if not terms.linear:
            curved = masked(form.matrix("q", "q", moment, u=at.w, v=at.r, q=q), free_q, free_q)
        forward = A
        if forms.A_out is not None and forms.B_out is not None:
            flux = forms.B_out.matrix("v", "u", moment, u=u)
            flux = flux + forms.A_out.matrix("v", "u", moment, u=u, q=q)
            S = S + masked(sp.csr_array(flux), free, free)
            outside = masked(forms.A_out.matrix("v", "q", moment, u=u, q=q), free, free_q)
            forward = sp.csr_array(A + outside)
        S = S + masked(sp.csr_array(at.theta * forms.pull + forms.hidden), free, free)
        S = sp.csr_array(S + sp.diags_array(1.0 - free))
        # S without its stiffness: on the observed part the pull adds theta to 1/h.
        rates = self.lumped * (1.0 / h + at.theta * np.abs(forms.split.R.diagonal()))
        row = terms.slope(data, at)
        border = None if row is None else (at.Mr * free, row * free)
        blocks = S, forward, A, self._metric(data), rates
        least = tuple(RESOLVED * float(np.linalg.norm(part)) for part in (u, q))
        return BlockJacobian(self, *blocks, least, back, curved, border)

    def _metric(self, data: StageData) -> sp.csr_array:
        """Return H on the free coefficients, with its auxiliary unknowns."""
        terms, metric = self.terms, data.problem.metric
        rest = np.zeros(terms.auxiliary)
        free = np.concatenate([terms.free_q, 1.0 - rest])
        H = terms.gram * metric.scale(data.problem.h)
        generator = terms.forms.model.latent.generator
        if generator.nnz:
            K = sp.block_diag([generator, sp.csr_array((len(rest), len(rest)))])
            H = H - terms.gram @ (sp.csr_array(K) * metric.weight)
        if metric.information is not None and terms.memory is not None:
            H = H + _widened(terms.memory.matrix(metric.information), len(rest))
        return sp.csr_array(masked(sp.csr_array(H), free, free) + sp.diags_array(1.0 - free))

    def factorise(self, name: str, matrix: sp.csr_array, approximate: bool = False) -> Factor:
        """Return the factor of a matrix, by an engine for symmetric ones if it is positive."""
        matrix.sort_indices()
        check_finite(matrix.data)
        if abs(matrix - matrix.T).max() <= ROUNDING * abs(matrix).max():
            try:
                return self._engine(name, matrix, True, approximate).factorise(matrix.data)
            except LinearAlgebraError:  # it is indefinite
                pass
        return self._engine(name, matrix, False, approximate).factorise(matrix.data)

    def _engine(
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


@dataclass(frozen=True, eq=False)
class BlockJacobian:
    """K at a point, as a `Factor`: GMRES, preconditioned by its approximate inverse."""

    solver: BlockSolver
    # Its blocks on free coefficients: `forward` is A(w) over omega and elsewhere, `A` over omega
    # only; H with its auxiliary unknowns behind.
    S: sp.csr_array
    forward: sp.csr_array
    A: sp.csr_array
    H: sp.csr_array
    rates: Array  # lumped mass times the rate of each equation of the state, shape (n,)
    least: tuple[float, ...]  # sizes of updates of u and q that are not resolved further
    # Derivatives of A(w)^T r in u and in q; None if they are held or zero.
    back: sp.csr_array | None
    curved: sp.csr_array | None
    border: tuple[Array, Array] | None = None  # (b, a): b a^T is added to S

    def apply(self, x: Array) -> Array:
        """Return K x, auxiliary unknowns behind (u, q)."""
        terms = self.solver.terms
        n, size = terms.n, terms.size
        u, q = x[:n], x[n:size]
        out = np.empty_like(x)
        out[:n] = self.S @ u + self.forward @ q
        if self.border is not None:
            column, row = self.border
            out[:n] += column * float(row @ u)
        out[n:] = self.H @ x[n:]
        coupling: Array = self.A.T @ terms.forms.split.project(u)
        if self.back is not None:
            coupling += np.asarray(self.back @ (terms.free * u))
        if self.curved is not None:
            coupling += self.curved @ q
        out[n:size] -= coupling
        return out

    @cached_property
    def approximate(self) -> ApproximateFactor:
        """The approximate inverse."""
        solver, terms = self.solver, self.solver.terms
        state = solver.factorise("S", self.S)
        C = sp.csr_array(self.H + _widened(self._information(state), terms.auxiliary))
        schur = solver.factorise("C", C, approximate=True)
        return ApproximateFactor(solver, state, schur, self.forward, self.A)

    def _information(self, state: Factor) -> sp.csr_array:
        """Return the term of C that approximates A_in^T R S^{-1} A."""
        terms = self.solver.terms
        split = terms.forms.split
        parts = list(terms.forms.model.latent.parts.values())
        if len(parts) == 1 and isinstance(parts[0].unknown, Field):
            # Entries of one sign show that A does not differentiate q: then a diagonal stands for
            # the product, with the same image of a constant q.
            image = self.forward @ terms.free_q
            if np.abs(self.forward.data).sum() <= ONE_SIGN * np.abs(image).sum():
                seen = self.A.T @ split.project(state.solve(image))
                return sp.csr_array(sp.diags_array(np.maximum(seen, 0.0)))
        forces = sp.csr_array(split.R.T @ self.A)
        return sp.csr_array(forces.T @ sp.diags_array(1.0 / self.rates) @ forces)

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`."""
        return self.iterate(b, TOLERANCE)[0]

    def iterate(self, b: Array, tolerance: float) -> tuple[Array, int]:
        """Return x with K x = b, and the iterations of GMRES that took."""
        terms, approximate = self.solver.terms, self.approximate
        n, size = terms.n, terms.size
        padded = np.zeros(size + terms.auxiliary)
        padded[:size] = b
        first = approximate.whole(padded)
        # u and q count the same, unless one of them hardly moves: that is rounding.
        found = (float(np.linalg.norm(part)) for part in (first[:n], first[n:size]))
        sizes = [max(pair) or 1.0 for pair in zip(found, self.least, strict=True)]
        scale = np.repeat(1.0 / np.array(sizes), [n, len(first) - n])

        def scaled(r: Array) -> Array:
            return (first if r is padded else approximate.whole(r)) * scale

        x, count = gmres(self.apply, scaled, padded, tolerance, ITERATIONS, REMEDY)
        return x[:size], count


@dataclass(frozen=True, eq=False)
class ApproximateFactor:
    """The approximate inverse of K by factors of S and C, as a `Factor`."""

    solver: BlockSolver
    state: Factor
    schur: Factor
    forward: sp.csr_array
    A: sp.csr_array

    def solve(self, b: Array) -> Array:
        """Return an approximate solution (u, q), shape (n + m,)."""
        terms = self.solver.terms
        padded = np.zeros(terms.size + terms.auxiliary)
        padded[: terms.size] = b
        return self.whole(padded)[: terms.size]

    def whole(self, b: Array) -> Array:
        """Return the same with auxiliary unknowns behind, of b and of the solution."""
        terms = self.solver.terms
        n, size, split = terms.n, terms.size, terms.forms.split
        x, right = np.empty_like(b), b[n:].copy()
        u = approximate_inverse(self.state)(b[:n])
        right[: size - n] += self.A.T @ split.project(u)
        x[n:] = approximate_inverse(self.schur)(right)
        x[:n] = approximate_inverse(self.state)(b[:n] - self.forward @ x[n:size])
        for fixed in (terms.forms.model.X.fixed, n + terms.forms.model.Q.fixed):
            x[fixed] = b[fixed]  # which factors that iterate would leave to their tolerance
        return x


def masked(matrix: sp.csr_array, rows: Array, cols: Array) -> sp.csr_array:
    """Return diag(rows) matrix diag(cols), with the same pattern."""
    data = matrix.data * np.repeat(rows, np.diff(matrix.indptr)) * cols[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), matrix.shape)


def _widened(matrix: sp.csr_array, more: int) -> sp.csr_array:
    if not more:
        return matrix
    return sp.csr_array(sp.block_diag([matrix, sp.csr_array((more, more))]))
