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
(`_Series`). S_ou is that of a differential operator, of the size of h/x^2 times S_oo with cells of
size x: a small error of u where it is not observed is a large one next to it. So, with q known,
S u = b_u - A q is solved again, with M_uo/h times the u at hand (`_Triangle.again`). What is left
then is large only where the two meet: a strip of a few nodes is solved as a whole (`_Seam`).

That serves Newton as a kept factor (`Approximate`): an update takes off all but 1e-2 to 1e-3 of the
error. Where it takes off too little, GMRES solves with K itself (`Jacobian`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from livepde.errors import LinearAlgebraError
from livepde.fem import Field
from livepde.linalg import (
    Array,
    BandedSolver,
    Factor,
    IntArray,
    Pattern,
    Solver,
    analyse,
    approximate_inverse,
    gmres,
)

if TYPE_CHECKING:
    from livepde.laws.coupled import BlockEquation, CoupledStage

__all__ = ["LARGE", "Approximate", "BlockSolver", "Jacobian", "narrow"]

LARGE = 4000  # unknowns u and q together, from which a matrix that is not banded goes by blocks
TOLERANCE = 1e-2  # of u and of q, relative to their first approximation: Newton goes on from there
ITERATIONS = 60  # each keeps a vector
PATIENCE = 12  # iterations of GMRES beyond which factors of another point are made again
SPENT = 24  # updates and iterations: about what new factors cost
ROUNDING = 1e-12  # asymmetry of a symmetric matrix, relative to its largest entry
ONE_SIGN = 1.1  # sum of sizes over size of sums, of entries that have one sign nearly everywhere
LAYERS = 4  # neighbours on either side of where observed coefficients meet others
POWERS = 20  # of a matrix, to estimate an eigenvalue
MARGIN = 0.8  # of that estimate
SPREAD = 16.0  # eigenvalues of a matrix near its diagonal, largest over smallest
SERIES = 3e-2  # bound on the error that Chebyshev's iteration leaves
REMEDY = "take a smaller gain or a smaller time step."


def narrow(matrix: sp.csr_array) -> bool:
    """Return true if a matrix of this pattern is solved as a banded one."""
    return isinstance(analyse(Pattern.of(matrix)), BandedSolver)


class BlockSolver:
    """Solves the coupled systems of a stage by blocks.

    Attributes
    ----------
    tolerance
        To which systems are solved by GMRES.
    iterations
        Of those of a stage.
    A
        A(w) at the last residual.
    made, last
        Factors made in a stage, and those of this stage or an earlier one.
    """

    def __init__(self, stage: CoupledStage) -> None:
        self.stage = stage
        self.tolerance = TOLERANCE
        self.iterations: list[int] = []
        self._solvers: dict[str, tuple[Solver, bool]] = {}
        self.made: Approximate | None = None
        self.last: Approximate | None = None
        self.A = sp.csr_array((stage.n, stage.model.Q.dim))

    @property
    def patience(self) -> int:
        """Updates and iterations, beyond one update for each stage, that renew the factors."""
        return SPENT

    def begin(self, kept: Approximate | None) -> None:
        """Begin a stage with the factors of an earlier one."""
        self.last, self.made, self.iterations = kept, None, []

    def renew(self, K: Jacobian) -> Approximate:
        """Make the factors of K those of the stage."""
        self.made = self.last = None  # its memory, first
        self.made = self.last = K.approximate()
        return self.last

    @cached_property
    def lumped(self) -> Array:
        """Lumped mass on the free coefficients, one on the fixed ones, shape (n,)."""
        free = self.stage.model.X.free
        rows = np.asarray(abs(masked(self.stage.model.mass, free, free)).sum(axis=1)).ravel()
        return np.where(rows > 0.0, rows, 1.0)

    @cached_property
    def parts(self) -> tuple[IntArray, IntArray] | None:
        """Coefficients that are not observed, and those that are; None: S is solved as a whole."""
        R, W = self.stage.split.R, self.stage.W
        observed, free = R.diagonal(), self.stage.model.X.free
        selects = R.nnz == np.count_nonzero(observed) and bool(np.isin(observed, (0, 1)).all())
        if not selects or not masked(W, np.ones(len(free)), free).data.any():
            return None
        return np.flatnonzero(observed == 0.0), np.flatnonzero(observed)

    def linearise(self, equation: BlockEquation, y: Array, sweep: bool) -> Jacobian:
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
        A = masked(form.matrix("v", "q", at, u=w, q=q), free, free_q)
        back, curved = None, None
        if not sweep:
            back = masked(form.matrix("q", "u", at, u=w, v=r, q=q), free_q, np.ones(n))
            if not stage.linear:
                curved = masked(form.matrix("q", "q", at, u=w, v=r, q=q), free_q, free_q)
        rate = 1.0 / h + equation.theta * np.abs(stage.split.R.diagonal())
        return Jacobian(self, y, S, A, self._metric(equation), self.lumped * rate, back, curved)

    def _metric(self, equation: BlockEquation) -> sp.csr_array:
        """Return G on the free coefficients, with its auxiliary unknowns."""
        stage, g = self.stage, self.stage.gains
        model, rest = stage.model, np.zeros(self.stage.auxiliary)
        free = np.concatenate([stage.free_q, 1.0 - rest])
        scale, information = equation.weights()
        G = stage.gram * scale
        if model.latent.generator.nnz:
            K = sp.block_diag([model.latent.generator, sp.csr_array((len(rest), len(rest)))])
            G = G - stage.gram @ (sp.csr_array(K) / g.gain)
        if information is not None:
            G = G + _widened(information, len(rest))
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

    def _seam(self, K: Jacobian) -> _Seam | None:
        if not len(self.strip):
            return None
        S = sp.csr_array(K.S[self.strip])
        factor = self._factorise("S, between", sp.csr_array(S[:, self.strip]))
        return _Seam(self.strip, factor, S, sp.csr_array(K.A[self.strip]))

    def _state(self, S: sp.csr_array) -> Factor:
        if self.parts is None:
            return self._factorise("S", S)
        unseen, seen = self.parts
        top, bottom = sp.csr_array(S[unseen]), sp.csr_array(S[seen])
        local = sp.csr_array(bottom[:, seen])
        return _Triangle(
            self.parts,
            self._factorise("S, not observed", sp.csr_array(top[:, unseen])),
            _Series.of(local) or self._factorise("S, observed", local),
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
        if _is_symmetric(matrix):
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


@dataclass(frozen=True, eq=False)
class Jacobian:
    """K at a point, as a `Factor`.

    Attributes
    ----------
    at
        The point y, shape (n + m,).
    S, A, G
        Its blocks on free coefficients; G with its auxiliary unknowns behind.
    rates
        Lumped mass times the rate of each equation of the state, shape (n,).
    back, curved
        Derivatives of A(w)^T r in w and in q; None if they are held or zero.
    border
        (b, a): b a^T is added to S.
    """

    solver: BlockSolver
    at: Array
    S: sp.csr_array
    A: sp.csr_array
    G: sp.csr_array
    rates: Array
    back: sp.csr_array | None
    curved: sp.csr_array | None
    border: tuple[Array, Array] | None = None

    def bordered(self, column: Array, row: Array) -> Jacobian:
        """Return K with column row^T, of shape (n, n), added to S."""
        return replace(self, border=(column, row))

    def apply(self, x: Array) -> Array:
        """Return K x, auxiliary unknowns behind (u, q)."""
        stage = self.solver.stage
        n, size = stage.n, stage.size
        u, q = x[:n], x[n:size]
        out = np.empty_like(x)
        out[:n] = self.S @ u + self.A @ q
        if self.border is not None:
            column, row = self.border
            out[:n] += column * float(row @ u)
        out[n:] = self.G @ x[n:]
        coupling: Array = self.A.T @ (stage.split.R @ u)
        if self.back is not None:
            coupling += np.asarray(self.back @ (stage.W @ (stage.model.X.free * u)))
        if self.curved is not None:
            coupling += self.curved @ q
        out[n:size] -= coupling
        return out

    def solve(self, b: Array) -> Array:
        """Return x with K x = b to the tolerance; raises `LinearAlgebraError`.

        The factors at hand precondition, made at another point perhaps; where they do not serve,
        new ones.
        """
        solver = self.solver
        if solver.last is not None:
            try:
                return self._solve(b, solver.last, PATIENCE)
            except LinearAlgebraError:
                pass  # and let go of the factors that did not serve, before others are made
        return self._solve(b, solver.renew(self), ITERATIONS)

    def approximate(self) -> Approximate:
        """Return K by factors of its blocks."""
        return self.solver.approximate(self)

    def _solve(self, b: Array, approximate: Approximate, limit: int) -> Array:
        solver, stage = self.solver, self.solver.stage
        n, size = stage.n, stage.size
        padded = np.zeros(size + stage.auxiliary)
        padded[:size] = b
        scale: Array | None = None

        def scaled(r: Array) -> Array:
            nonlocal scale
            z = approximate.whole(r)
            if scale is None:  # u and q count the same
                sizes = [float(np.linalg.norm(part)) or 1.0 for part in (z[:n], z[n:size])]
                counts = [n, len(z) - n]
                scale = np.repeat(1.0 / np.array(sizes), counts)
            z *= scale
            return z

        x, iterations = gmres(self.apply, scaled, padded, solver.tolerance, limit, REMEDY)
        solver.iterations.append(iterations)
        return x[:size]


@dataclass(frozen=True, eq=False)
class Approximate:
    """The approximate inverse of K by factors of S and C, as a `Factor`."""

    blocks: BlockSolver
    at: Array
    state: Factor
    schur: Factor
    rates: Array
    seam: _Seam | None

    def solve(self, b: Array) -> Array:
        """Return an approximate solution (u, q), shape (n + m,)."""
        stage = self.blocks.stage
        size = stage.size
        padded = np.zeros(size + stage.auxiliary)
        padded[:size] = b
        return self.whole(padded)[:size]

    def whole(self, b: Array) -> Array:
        """Return the same with auxiliary unknowns behind, of b and of the solution."""
        stage, A = self.blocks.stage, self.blocks.A
        n, size, split, free_q = stage.n, stage.size, stage.split, stage.free_q
        x = np.empty_like(b)
        u = approximate_inverse(self.state)(b[:n])
        right = b[n:].copy()
        right[: size - n] += free_q * np.asarray(A.T @ split.project(u))
        x[n:] = approximate_inverse(self.schur)(right)
        flux = np.asarray(A @ (free_q * x[n:size]))
        u -= split.project(split.project_transposed(flux) / self.rates)
        x[:n] = self.state.again(b[:n] - flux, u) if isinstance(self.state, _Triangle) else u
        if self.seam is not None:
            self.seam.mend(b[:n], x[:n], x[n:size])
        for fixed in (stage.model.X.fixed, n + stage.model.Q.fixed):
            x[fixed] = b[fixed]  # which factors that iterate would leave to their tolerance
        return x


@dataclass(frozen=True, eq=False)
class _Seam:
    """Where observed coefficients meet others: there S u + A q = b is solved once more."""

    at: IntArray
    factor: Factor
    S: sp.csr_array
    A: sp.csr_array

    def mend(self, b: Array, u: Array, q: Array) -> None:
        """Change u, in place."""
        u[self.at] += self.factor.solve(b[self.at] - self.S @ u - self.A @ q)


@dataclass(frozen=True, eq=False)
class _Triangle:
    """S without M_uo/h: the unobserved part first."""

    parts: tuple[IntArray, IntArray]
    unseen: Factor
    seen: Factor
    link: sp.csr_array
    back: sp.csr_array

    def solve(self, b: Array) -> Array:
        """Return x with S x = b."""
        return self._solve(b, b[self.parts[0]])

    def again(self, b: Array, x: Array) -> Array:
        """Return the same with M_uo/h, from an x that approximates the solution."""
        unseen, seen = self.parts
        return self._solve(b, b[unseen] - self.back @ x[seen])

    def _solve(self, b: Array, above: Array) -> Array:
        unseen, seen = self.parts
        x = np.empty_like(b)
        first = approximate_inverse(self.unseen)(above)
        x[unseen] = first
        x[seen] = approximate_inverse(self.seen)(b[seen] - self.link @ first)
        return x


@dataclass(frozen=True, eq=False)
class _Series:
    """Chebyshev's iteration for a matrix K near its diagonal D, as a mass matrix is.

    Attributes
    ----------
    matrix, inverse
        D^{-1} K and the diagonal of D^{-1}.
    low, high
        About its eigenvalues.
    degree
        Products with it, and one.
    """

    matrix: sp.csr_array
    inverse: Array
    low: float
    high: float
    degree: int

    @classmethod
    def of(cls, matrix: sp.csr_array) -> _Series | None:
        """Return it for a symmetric matrix K; None where it would take long."""
        diagonal = matrix.diagonal()
        if not (diagonal > 0.0).all() or not _is_symmetric(matrix):
            return None
        high = float((abs(matrix).sum(axis=1) / diagonal).max())  # Gershgorin's bound
        # The smallest eigenvalue of D^{-1} K, by the largest of high - D^{-1} K.
        x, size = np.random.default_rng(0).standard_normal(len(diagonal)), 1.0
        for _ in range(POWERS):
            x = high * x - (matrix @ x) / diagonal
            size = float(np.linalg.norm(x))
            x /= size
        low = (high - size) * MARGIN
        if not low * SPREAD >= high:
            return None
        root = np.sqrt(high / low)
        degree = math.ceil(math.log(2.0 / SERIES) / math.log((root + 1.0) / (root - 1.0)))
        scaled = masked(matrix, 1.0 / diagonal, np.ones(len(diagonal)))
        return cls(scaled, 1.0 / diagonal, low, high, degree)

    def solve(self, b: Array) -> Array:
        """Return x with K x = b, but for `SERIES`."""
        middle, half = 0.5 * (self.high + self.low), 0.5 * (self.high - self.low)
        ratio, scaled = half / middle, self.inverse * b
        step = scaled / middle
        x = step.copy()
        for _ in range(self.degree - 1):
            after = 1.0 / (2.0 * middle / half - ratio)
            left: Array = self.matrix @ x
            np.subtract(scaled, left, out=left)
            left *= 2.0 * after / half
            step *= after * ratio
            step += left
            x += step
            ratio = after
        return x


def masked(matrix: sp.csr_array, rows: Array, cols: Array) -> sp.csr_array:
    """Return diag(rows) matrix diag(cols), with the same pattern."""
    data = matrix.data * np.repeat(rows, np.diff(matrix.indptr)) * cols[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), matrix.shape)


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


def _is_symmetric(matrix: sp.csr_array) -> bool:
    return bool(abs(matrix - matrix.T).max() <= ROUNDING * abs(matrix).max())
