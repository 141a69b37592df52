"""Solvers of coupled stages: one sparse matrix for u and q, or blocks for large problems.

If A is bilinear, B affine, and both are constant in time, their tensors are precomputed.

The Jacobian of a stage is

    K = [[S, A], [-A_in^T R - ..., H]],    S = M/h + B' + d(A q)/du + theta R^T M_op R + nu N,

whose blocks have the patterns of the forms. The block solver does not assemble K. The Schur
complement H + A_in^T R S^{-1} A is dense; a sparse matrix C approximates it. If q is one field that
A does not differentiate, C - H is diagonal and agrees with the product on constants: the error is
small for smooth functions, and G_Q dominates for rough ones. Otherwise C - H is
A_in^T R D^{-1} R^T A, where D, the lumped mass times 1/h + theta, replaces S. An approximate
solution with K is then

    u = S^{-1} b_u,    q = C^{-1} (b_q + A_in^T R u),    u = S^{-1} (b_u - A q).

Newton uses it as a cached factor. If it does not reduce the residual enough, GMRES solves with K.
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

LARGE = 4000  # least number of unknowns in (u, q) to solve by blocks if the matrix is not banded
TOLERANCE = 1e-4  # of GMRES, relative to the preconditioned right-hand side; Newton corrects it
ITERATIONS = 60  # of GMRES, which stores a vector for each
RESOLVED = 1e-10  # size of an update of u or q, relative to it, below which it is negligible
ONE_SIGN = 1.1  # largest ratio of sum |a| to |sum a| for entries a of nearly constant sign
ROUNDING = 1e-12  # asymmetry of a symmetric matrix, relative to its largest entry
REMEDY = "take a smaller gain or a smaller time step."


class MonolithicSolver(StageSolver):
    """Factorises the matrix of (u, q, auxiliary unknowns) with a direct solver."""

    keeps = False

    def __init__(self, terms: StageTerms) -> None:
        super().__init__(terms)
        # Engine of the coupled matrix, and for each block the map of its data to the matrix data.
        self.solver, self.maps = self._assembled()
        self.patience = 2 if isinstance(self.solver, BandedSolver) else 12
        self._constant: tuple[tuple[float, float, float], Array] | None = None

    def changing(self, data: StageData, at: StageIterate) -> Array:
        """Return the part of the Jacobian data that depends on the iterate."""
        terms, forms, maps = self.terms, self.terms.forms, self.maps
        A, moment, n = forms.A_in, data.problem.moment, self.terms.n
        u, q = at.y[:n], at.y[n:]
        entries: Array = maps["A_in"] @ at.A_in.data
        if forms.W is not None:
            entries += maps["A_in u"] @ A.data("v", "u", moment, u=at.w, q=q)
            entries += maps["B_in"] @ forms.B_in.data("v", "u", moment, u=at.w)
            back = A.data("q", "u", moment, u=at.w, v=at.r, q=q)
            entries += maps["A_in^T r, u"] @ back
        if not terms.linear:
            back = A.data("q", "q", moment, u=at.w, v=at.r, q=q)
            entries += maps["A_in^T r, q"] @ back
        if forms.A_out is not None and forms.B_out is not None:
            entries += maps["A_out"] @ forms.A_out.data("v", "q", moment, u=u, q=q)
            entries += maps["A_out u"] @ forms.A_out.data("v", "u", moment, u=u, q=q)
            entries += maps["B_out"] @ forms.B_out.data("v", "u", moment, u=u)
        return entries

    def prepare(self) -> None:
        _ = self._parts, self._pull

    def factor(self, data: StageData, at: StageIterate) -> Factor:
        terms, metric = self.terms, data.problem.metric
        entries = self.changing(data, at)
        entries += self._fixed(data)
        entries += at.theta * self._pull
        if metric.information is not None:
            entries += self.maps["J"] @ metric.information
        factor: Factor = self.solver.factorise(entries)
        if terms.auxiliary:
            factor = Leading(factor, terms.size, terms.size + terms.auxiliary)
        row = terms.slope(data, at)
        if row is not None:
            column = np.zeros(terms.size)
            column[: terms.n] = at.Mr * terms.free
            factor = _Bordered(factor, factor.solve(column), row * terms.free)
        return factor

    def _fixed(self, data: StageData) -> Array:
        """Return the part of the data that depends only on the step, `weight` and `sigma`."""
        h, metric = data.problem.h, data.problem.metric
        key = (h, metric.weight, metric.sigma)
        # Copies of an identifier may share this cache between threads: key and data are read once,
        # and replaced as a pair, so that the data always match their key.
        known = self._constant
        if known is None or known[0] != key:
            parts = self._parts
            entries = parts["M"] / h + metric.scale(h) * parts["G"] + parts["rest"]
            if "GK" in parts:
                entries = entries - metric.weight * parts["GK"]
            self._constant = known = (key, entries)
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
        # -A^T R in the second equation has the same data.
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
        """Scales, powers of two, by which the diagonals of M and G_Q become about one."""
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
        """Constant data: M, G_Q, G_Q K, and the sum of the other constant blocks."""
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
    """Factor of K + b a^T by the Sherman-Morrison formula: theta depends on all of r."""

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
    """Computes A, B and the Jacobian as products with precomputed tensors, not from forms."""

    keeps = True

    @classmethod
    def of(cls, terms: StageTerms) -> BilinearSolver | None:
        """Return the solver; None if A is not bilinear, B not affine, or the mesh is too large."""
        forms = terms.forms
        B = forms.model.form_B
        if terms.auxiliary or not (B.affine and B.constant):
            return None
        parts = [form for form in (forms.A_in, forms.A_out) if form is not None]
        # All derivatives are sparse matrices times coefficients.
        bilinear = all(isinstance(each, sp.csr_array) for form in parts for each in _tensors(form))
        return cls(terms) if bilinear else None

    def prepare(self) -> None:
        super().prepare()
        _ = self._coupling, self._slopes, self._offset, self._jacobian, self._fixed_data

    @cached_property
    def _coupling(self) -> tuple[_Coupling, _Coupling | None]:
        """A(w) over omega as a function of w, and A(u) outside omega as a function of u."""
        forms = self.terms.forms
        return _Coupling.of(forms.A_in), None if forms.A_out is None else _Coupling.of(forms.A_out)

    @cached_property
    def _jacobian(self) -> sp.csr_array:
        """Map from (w, u, q, r) to the part of the Jacobian data that depends on the iterate."""
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
        # Each block is linear in one of the four vectors: one product computes all blocks.
        return sp.csr_array(sp.hstack([by_w, by_u, by_q, by_r]))

    @cached_property
    def _slopes(self) -> tuple[Any, Any]:
        """B' over omega, and B' outside omega or None."""
        forms, zero = self.terms.forms, np.zeros(self.terms.n)
        outside = None if forms.B_out is None else forms.B_out.matrix("v", "u", u=zero)
        inside = compact(forms.B_in.matrix("v", "u", u=zero))
        return inside, None if outside is None else compact(outside)

    @cached_property
    def _offset(self) -> Array:
        return self.terms.forms.model.B(np.zeros(self.terms.n))

    @cached_property
    def _fixed_data(self) -> Array:
        """Contribution of B to the data of the Jacobian."""
        forms, zero = self.terms.forms, np.zeros(self.terms.n)
        entries = np.zeros(self.maps["M"].shape[0])
        if forms.W is not None:
            entries += self.maps["B_in"] @ forms.B_in.data("v", "u", u=zero)
        if forms.B_out is not None:
            entries += self.maps["B_out"] @ forms.B_out.data("v", "u", u=zero)
        return entries

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
    """Matrix A(w), whose data are linear in w."""

    pattern: Pattern
    data: sp.csr_array | Array

    @classmethod
    def of(cls, form: AnyForm) -> _Coupling:
        return cls(form.pattern("v", "q"), compact(_tensors(form)[0]))

    def at(self, w: Array) -> tuple[Any, Any]:
        """Return A(w) and its transpose, dense if small."""
        data = self.data @ w
        if self.pattern.small:
            dense = self.pattern.compact(data)
            return dense, dense.T
        return self.pattern.matrix(data), self.pattern.transposed(data)


def _tensors(form: AnyForm) -> tuple[sp.csr_array, sp.csr_array, sp.csr_array]:
    """Return the maps to the data of A(w), d(A(w) q)/dw and d(A(w)^T r)/dw."""
    pairs = ("v", "q"), ("v", "u"), ("q", "u")
    vq, vu, qu = (cast("sp.csr_array", form.tensor(*pair)) for pair in pairs)
    return vq, vu, qu


class BlockSolver(StageSolver):
    """Solves the coupled systems of a stage by blocks."""

    refresh = 0.5  # an update costs a twentieth of new factors
    ceiling = 5e-3  # large, since each update costs as much as a forward step
    carried = 3e-2  # large for the same reason
    patience = 12  # so many updates cost about as much as new factors

    def __init__(self, terms: StageTerms) -> None:
        super().__init__(terms)
        self.keeps = terms.forms.model.constant
        self._solvers: dict[str, tuple[Solver, bool]] = {}

    @classmethod
    def of(cls, terms: StageTerms) -> BlockSolver | None:
        """Return the solver; None if the stage is small or its matrix is banded."""
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
            # The derivative of A(w)^T r in w, times W = dw/du, is the derivative in u.
            by_w = form.matrix("q", "u", moment, u=at.w, v=at.r, q=q)
            back = sp.csr_array(masked(by_w, free_q, np.ones(n)) @ forms.W)
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
        # Diagonal approximation of S without stiffness: the pull adds theta to 1/h where observed.
        rates = self.lumped * (1.0 / h + at.theta * np.abs(forms.split.R.diagonal()))
        row = terms.slope(data, at)
        border = None if row is None else (at.Mr * free, row * free)
        blocks = S, forward, A, self._metric(data), rates
        least = tuple(RESOLVED * float(np.linalg.norm(part)) for part in (u, q))
        return BlockJacobian(self, *blocks, least, back, curved, border)

    def _metric(self, data: StageData) -> sp.csr_array:
        """Return H on the free coefficients and the auxiliary unknowns."""
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
        """Return the factor of a matrix; a symmetric engine is used for positive definite ones."""
        matrix.sort_indices()
        check_finite(matrix.data)
        if abs(matrix - matrix.T).max() <= ROUNDING * abs(matrix).max():
            try:
                return self._engine(name, matrix, True, approximate).factorise(matrix.data)
            except LinearAlgebraError:  # the matrix is indefinite
                pass
        return self._engine(name, matrix, False, approximate).factorise(matrix.data)

    def _engine(
        self, name: str, matrix: sp.csr_array, symmetric: bool, approximate: bool
    ) -> Solver:
        """Return the cached engine of a matrix; a new pattern or symmetry requires a new engine."""
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
        """Names of the engines of the factorised blocks."""
        return {name: solver.name for name, (solver, _) in self._solvers.items()}


@dataclass(frozen=True, eq=False)
class BlockJacobian:
    """`Factor` of K at a point by GMRES, preconditioned by an approximate inverse."""

    solver: BlockSolver
    # Blocks on the free coefficients: `forward` is A over the whole domain, `A` is A over omega;
    # the auxiliary unknowns of H follow q.
    S: sp.csr_array
    forward: sp.csr_array
    A: sp.csr_array
    H: sp.csr_array
    rates: Array  # diagonal of D, the lumped mass times 1/h + theta, shape (n,)
    least: tuple[float, ...]  # norms of negligible updates of u and q
    # Derivatives of A(w)^T r in u and in q; None: zero.
    back: sp.csr_array | None
    curved: sp.csr_array | None
    border: tuple[Array, Array] | None = None  # (b, a) of the term b a^T of S; None: zero

    def apply(self, x: Array) -> Array:
        """Return K x for x = (u, q, auxiliary unknowns)."""
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
        """Return C - H, the approximation of A_in^T R S^{-1} A."""
        terms = self.solver.terms
        split = terms.forms.split
        parts = list(terms.forms.model.latent.parts.values())
        if len(parts) == 1 and isinstance(parts[0].unknown, Field):
            # Entries of one sign indicate that A does not differentiate q: then a diagonal matrix
            # with the same image of a constant q replaces the product.
            image = self.forward @ terms.free_q
            if np.abs(self.forward.data).sum() <= ONE_SIGN * np.abs(image).sum():
                diagonal = self.A.T @ split.project(state.solve(image))
                return sp.csr_array(sp.diags_array(np.maximum(diagonal, 0.0)))
        forces = sp.csr_array(split.R.T @ self.A)
        return sp.csr_array(forces.T @ sp.diags_array(1.0 / self.rates) @ forces)

    def solve(self, b: Array) -> Array:
        """Return the solution of K x = b within `TOLERANCE`; raises `LinearAlgebraError`."""
        return self.iterate(b, TOLERANCE)[0]

    def iterate(self, b: Array, tolerance: float) -> tuple[Array, int]:
        """Return the solution of K x = b, and the number of GMRES iterations."""
        terms, approximate = self.solver.terms, self.approximate
        n, size = terms.n, terms.size
        padded = np.zeros(size + terms.auxiliary)
        padded[:size] = b
        first = approximate.whole(padded)
        # u and q have equal weight in the norm, unless one update is rounding.
        norms = (float(np.linalg.norm(part)) for part in (first[:n], first[n:size]))
        sizes = [max(pair) or 1.0 for pair in zip(norms, self.least, strict=True)]
        scale = np.repeat(1.0 / np.array(sizes), [n, len(first) - n])

        def scaled(r: Array) -> Array:
            return (first if r is padded else approximate.whole(r)) * scale

        x, count = gmres(self.apply, scaled, padded, tolerance, ITERATIONS, REMEDY)
        return x[:size], count


@dataclass(frozen=True, eq=False)
class ApproximateFactor:
    """Approximate `Factor` of K, from the factors of S and C."""

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
        """Return an approximate solution; it and b include the auxiliary unknowns."""
        terms = self.solver.terms
        n, size, split = terms.n, terms.size, terms.forms.split
        x, right = np.empty_like(b), b[n:].copy()
        u = approximate_inverse(self.state)(b[:n])
        right[: size - n] += self.A.T @ split.project(u)
        x[n:] = approximate_inverse(self.schur)(right)
        x[:n] = approximate_inverse(self.state)(b[:n] - self.forward @ x[n:size])
        for fixed in (terms.forms.model.X.fixed, n + terms.forms.model.Q.fixed):
            x[fixed] = b[fixed]  # exact: iterative factors are accurate to a tolerance only
        return x


def masked(matrix: sp.csr_array, rows: Array, cols: Array) -> sp.csr_array:
    """Return diag(rows) matrix diag(cols) in the pattern of the matrix."""
    data = matrix.data * np.repeat(rows, np.diff(matrix.indptr)) * cols[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), matrix.shape)


def _widened(matrix: sp.csr_array, more: int) -> sp.csr_array:
    if not more:
        return matrix
    return sp.csr_array(sp.block_diag([matrix, sp.csr_array((more, more))]))
