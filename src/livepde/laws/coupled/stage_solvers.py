"""Solvers of coupled stages: one sparse matrix of u and q together, and large ones by blocks.

If A is bilinear, B affine, and both are constant in time, their products are made ahead.

The Jacobian of a stage is

    K = [[S, A], [-A_in^T R - ..., H]],    S = M/h + B' + d(A q)/du + theta R^T M_op R + nu N,

of which the blocks have the patterns of the forms. By blocks no matrix of all of it is formed. The
Schur complement H + A_in^T R S^{-1} A is dense; C = H + (a sparse matrix of the size of the
product) stands for it. For a field q that A does not differentiate this matrix is diagonal and
agrees with the product on constants: for smooth functions the difference is small, and rough ones
are ruled by G_Q. Else it is A_in^T R D^{-1} R^T A with D, the lumped mass times 1/h + theta, in the
place of S. An approximate solution with K is then

    u = S^{-1} b_u,    q = C^{-1} (b_q + A_in^T R u),    u = S^{-1} (b_u - A q).

It serves Newton as a kept factor; where it reduces the residual too little, GMRES solves with K.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Field, Moment
from livepde.laws.coupled.equation import (
    AnyForm,
    Inside,
    StageData,
    StageIterate,
    StageSolver,
    StageTerms,
)
from livepde.linalg import (
    Array,
    Assembler,
    BandedSolver,
    Factor,
    Leading,
    Pattern,
    Solver,
    analyse,
    approximate_inverse,
    compact,
    gmres,
)
from livepde.linalg.solvers import check_finite

LARGE = 4000  # unknowns u and q together, from which a matrix that is not banded goes by blocks
TOLERANCE = 1e-4  # of GMRES, relative to the first approximation, which Newton then improves
ITERATIONS = 60  # each keeps a vector
RESOLVED = 1e-10  # of u and q: smaller updates by GMRES are as good as none
ONE_SIGN = 1.1  # sum of sizes over size of sums, of entries that have one sign nearly everywhere
ROUNDING = 1e-12  # asymmetry of a symmetric matrix, relative to its largest entry
REMEDY = "take a smaller gain or a smaller time step."


class MonolithicSolver(StageSolver):
    """Factorises the matrix of u and q, with auxiliary unknowns behind."""

    keeps = False

    def __init__(self, terms: StageTerms) -> None:
        super().__init__(terms)
        # The engine of the coupled matrix, and for each block the map of its data into that matrix.
        self.solver, self.maps = self._assembled()
        self.patience = 2 if isinstance(self.solver, BandedSolver) else 12
        self._constant: tuple[tuple[float, float, float], Array] | None = None

    def changing(self, data: StageData, at: StageIterate) -> Array:
        """Return the data of the Jacobian that depend on the iterate."""
        terms, forms, maps = self.terms, self.terms.forms, self.maps
        A, moment, n = forms.A_in, data.problem.moment, self.terms.n
        u, q = at.y[:n], at.y[n:]
        found: Array = maps["A_in"] @ at.A_in.data
        if forms.W is not None:
            found += maps["A_in u"] @ A.data("v", "u", moment, u=at.w, q=q)
            found += maps["B_in"] @ forms.B_in.data("v", "u", moment, u=at.w)
            back = A.data("q", "u", moment, u=at.w, v=at.r, q=q)
            found += maps["A_in^T r, u"] @ back
        if not terms.linear:
            back = A.data("q", "q", moment, u=at.w, v=at.r, q=q)
            found += maps["A_in^T r, q"] @ back
        if forms.A_out is not None and forms.B_out is not None:
            found += maps["A_out"] @ forms.A_out.data("v", "q", moment, u=u, q=q)
            found += maps["A_out u"] @ forms.A_out.data("v", "u", moment, u=u, q=q)
            found += maps["B_out"] @ forms.B_out.data("v", "u", moment, u=u)
        return found

    def prepare(self) -> None:
        _ = self._parts, self._pull

    def factor(self, data: StageData, at: StageIterate) -> Factor:
        terms, metric = self.terms, data.problem.metric
        found = self.changing(data, at)
        found += self._fixed(data)
        found += at.theta * self._pull
        if metric.information is not None:
            found += self.maps["J"] @ metric.information
        factor: Factor = self.solver.factorise(found)
        if terms.auxiliary:
            factor = Leading(factor, terms.size, terms.size + terms.auxiliary)
        row = terms.slope(data, at)
        if row is not None:
            column = np.zeros(terms.size)
            column[: terms.n] = at.Mr * terms.free
            factor = _Bordered(factor, factor.solve(column), row * terms.free)
        return factor

    def _fixed(self, data: StageData) -> Array:
        """Return the data that depend on the step and on weight and sigma of the metric only."""
        h, metric = data.problem.h, data.problem.metric
        key = (h, metric.weight, metric.sigma)
        # Copies of an identifier share this, maybe in threads: the pair is read once, and replaced
        # as a whole, so that the data are those of their key.
        known = self._constant
        if known is None or known[0] != key:
            parts = self._parts
            found = parts["M"] / h + metric.scale(h) * parts["G"] + parts["rest"]
            if "GK" in parts:
                found = found - metric.weight * parts["GK"]
            self._constant = known = (key, found)
        return known[1]

    def _assembled(self) -> tuple[Solver, dict[str, sp.csr_array]]:
        terms, forms = self.terms, self.terms.forms
        model, n, A = forms.model, self.terms.n, forms.A_in
        free, free_q = sp.diags_array(terms.free), sp.diags_array(terms.free_q)
        minus, R = -free_q, sp.csr_array(forms.split.R @ free)
        whole = Assembler(terms.size + terms.auxiliary)
        whole.add("M", model.form_M.pattern("v", "u"), free, free)
        whole.add("pull", Pattern.of(forms.pull), free, free)
        whole.add("N", Pattern.of(forms.hidden), free, free)
        whole.add("A_in", A.pattern("v", "q"), free, free_q, at=(0, n))
        # The same data a second time: -A^T R in the second line.
        whole.add("A_in", A.pattern("v", "q"), minus, R, at=(n, 0), transposed=True)
        if forms.W is not None:
            W = sp.csr_array(forms.W @ free)
            whole.add("B_in", forms.B_in.pattern("v", "u"), free, W)
            whole.add("A_in u", A.pattern("v", "u"), free, W)
            whole.add("A_in^T r, u", A.pattern("q", "u"), minus, W, at=(n, 0))
        if not terms.linear:
            whole.add("A_in^T r, q", A.pattern("q", "q"), minus, free_q, at=(n, n))
        if forms.A_out is not None and forms.B_out is not None:
            whole.add("A_out", forms.A_out.pattern("v", "q"), free, free_q, at=(0, n))
            whole.add("A_out u", forms.A_out.pattern("v", "u"), free, free)
            whole.add("B_out", forms.B_out.pattern("v", "u"), free, free)
        rest = np.zeros(terms.auxiliary)
        free_g = sp.diags_array(np.concatenate([terms.free_q, 1.0 - rest]))
        whole.add("G", Pattern.of(terms.gram), free_g, free_g, at=(n, n))
        if terms.memory is not None:
            whole.add("J", terms.memory, free_q, free_q, at=(n, n))
        if model.latent.generator.nnz:
            K = sp.block_diag([model.latent.generator, sp.csr_array((len(rest), len(rest)))])
            whole.add("GK", Pattern.of(terms.gram), free_g, sp.csr_array(K @ free_g), at=(n, n))
        fixed = np.concatenate([1.0 - terms.free, 1.0 - terms.free_q, rest])
        whole.add("fixed", Pattern.of(sp.eye_array(len(fixed))), sp.diags_array(fixed))
        pattern, maps = whole.build()
        solver = analyse(pattern)
        if isinstance(solver, BandedSolver):
            solver = replace(solver, units=self._units)
        return solver, maps

    @property
    def _units(self) -> Array:
        """Powers of two in which the blocks M and G_Q of the diagonal are about one."""
        terms = self.terms
        diagonal = np.abs(
            np.concatenate([terms.forms.model.mass.diagonal(), terms.gram.diagonal()])
        )
        free = np.concatenate([terms.free, terms.free_q, np.ones(terms.auxiliary)])
        diagonal[(free == 0.0) | (diagonal == 0.0)] = 1.0
        return np.asarray(np.exp2(np.round(-0.5 * np.log2(diagonal))))

    @cached_property
    def _pull(self) -> Array:
        return self.maps["pull"] @ _stored(self.terms.forms.pull)

    @cached_property
    def _parts(self) -> dict[str, Array]:
        """Data that never change: of M, of G_Q and G_Q K, and the rest."""
        terms, forms, maps = self.terms, self.terms.forms, self.maps
        gram = _stored(terms.gram)
        rest = maps["N"] @ _stored(forms.hidden)
        rest += maps["fixed"] @ np.ones(terms.size + terms.auxiliary)
        parts = {"M": maps["M"] @ forms.model.mass.data, "G": maps["G"] @ gram, "rest": rest}
        if "GK" in maps:
            parts["GK"] = maps["GK"] @ gram
        return parts


@dataclass(frozen=True, eq=False)
class _Bordered:
    """K + b a^T by Sherman and Morrison, from the factor of K: theta depends on all of r."""

    inner: Factor
    column: Array
    row: Array

    @cached_property
    def _scaled(self) -> Array:
        # (K + b a^T)^-1 = K^-1 - K^-1 b a^T K^-1/(1 + a^T K^-1 b); `column` is K^-1 b.
        pivot = 1.0 + float(self.row @ self.column[: len(self.row)])
        if pivot == 0.0:
            raise LinearAlgebraError("The damped system is singular: take less damping.")
        return self.row / pivot

    def solve(self, b: Array) -> Array:
        """Return the solution for a right-hand side."""
        x = self.inner.solve(b)
        return x - self.column * (self._scaled @ x[: len(self.row)])


def _stored(matrix: sp.csr_array) -> Array:
    """Return the data of a matrix in the order of its pattern."""
    coo = sp.coo_array(matrix)
    return np.asarray(Pattern.of(matrix).gather(coo.row, coo.col) @ coo.data)


class BilinearSolver(MonolithicSolver):
    """A, B and the Jacobian by products with small or sparse matrices: no form is evaluated."""

    keeps = True

    @classmethod
    def of(cls, terms: StageTerms) -> BilinearSolver | None:
        """Return it for a stage; None where A or B is another, or the mesh is large."""
        forms = terms.forms
        B = forms.model.form_B
        if terms.auxiliary or not (B.affine and B.constant):
            return None
        parts = [form for form in (forms.A_in, forms.A_out) if form is not None]
        # All derivatives are sparse matrices times coefficients.
        bilinear = all(isinstance(one, sp.csr_array) for form in parts for one in _tensors(form))
        return cls(terms) if bilinear else None

    def prepare(self) -> None:
        super().prepare()
        _ = self._coupling, self._slopes, self._offset, self._jacobian, self._fixed_data

    @cached_property
    def _coupling(self) -> tuple[_Coupling, _Coupling | None]:
        """A(w) over omega as a function of w, and outside it as one of u."""
        forms = self.terms.forms
        return _Coupling.of(forms.A_in), None if forms.A_out is None else _Coupling.of(forms.A_out)

    @cached_property
    def _jacobian(self) -> sp.csr_array:
        """Map of (w, u, q, r) to the data of the Jacobian that change."""
        forms, maps, m = self.terms.forms, self.maps, self.terms.size - self.terms.n
        vq, vu, qu = _tensors(forms.A_in)
        size, n = maps["M"].shape[0], self.terms.n
        by_w = maps["A_in"] @ vq
        by_u, by_q = sp.csr_array((size, n)), sp.csr_array((size, m))
        by_r = sp.csr_array((size, n))
        if forms.W is not None:
            by_q = by_q + maps["A_in u"] @ vu
            by_r = maps["A_in^T r, u"] @ qu
        if forms.A_out is not None:
            outside = _tensors(forms.A_out)
            by_u = by_u + maps["A_out"] @ outside[0]
            by_q = by_q + maps["A_out u"] @ outside[1]
        # Each block is linear in one of the four vectors, and so all of them are one product.
        return sp.csr_array(sp.hstack([by_w, by_u, by_q, by_r]))

    @cached_property
    def _slopes(self) -> tuple[Any, Any]:
        """B' over omega, and elsewhere."""
        forms, zero = self.terms.forms, np.zeros(self.terms.n)
        outside = None if forms.B_out is None else forms.B_out.matrix("v", "u", u=zero)
        inside = compact(forms.B_in.matrix("v", "u", u=zero))
        return inside, None if outside is None else compact(outside)

    @cached_property
    def _offset(self) -> Array:
        return self.terms.forms.model.B(np.zeros(self.terms.n))

    @cached_property
    def _fixed_data(self) -> Array:
        """Data of the Jacobian that B adds."""
        forms, zero = self.terms.forms, np.zeros(self.terms.n)
        found = np.zeros(self.maps["M"].shape[0])
        if forms.W is not None:
            found += self.maps["B_in"] @ forms.B_in.data("v", "u", u=zero)
        if forms.B_out is not None:
            found += self.maps["B_out"] @ forms.B_out.data("v", "u", u=zero)
        return found

    def source(self, moment: Moment) -> Array:
        return super().source(moment) - self._offset

    def inside(self, moment: Moment, w: Array, q: Array | None = None) -> Inside:
        A, transposed = self._coupling[0].at(w)
        return Inside(A, transposed, self._slopes[0] @ w)

    def outside(self, moment: Moment, u: Array, q: Array) -> tuple[Array, Array]:
        coupling, slope = self._coupling[1], self._slopes[1]
        if coupling is None:
            return super().outside(moment, u, q)
        return coupling.at(u)[0] @ q, slope @ u

    def changing(self, data: StageData, at: StageIterate) -> Array:
        n = self.terms.n
        changing: Array = self._jacobian @ np.concatenate([at.w, at.y[:n], at.y[n:], at.r])
        return changing + self._fixed_data


@dataclass(frozen=True, eq=False)
class _Coupling:
    """A(w) as a matrix whose data are linear in w."""

    pattern: Pattern
    data: sp.csr_array | Array

    @classmethod
    def of(cls, form: AnyForm) -> _Coupling:
        return cls(form.pattern("v", "q"), compact(_tensors(form)[0]))

    def at(self, w: Array) -> tuple[Any, Any]:
        """Return A(w) and its transpose; small ones are dense."""
        data = self.data @ w
        if self.pattern.small:
            dense = self.pattern.compact(data)
            return dense, dense.T
        return self.pattern.matrix(data), self.pattern.transposed(data)


def _tensors(form: AnyForm) -> tuple[sp.csr_array, sp.csr_array, sp.csr_array]:
    """Return the maps to the data of A(w), of d(A(w) q)/dw and of d(A(w)^T r)/dw."""
    pairs = ("v", "q"), ("v", "u"), ("q", "u")
    vq, vu, qu = (cast("sp.csr_array", form.tensor(*pair)) for pair in pairs)
    return vq, vu, qu


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
        # u and q count the same, unless the change of one is rounding.
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
