"""The process on PETSc vectors: protocol, check, vectors, and one implicit Euler step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np

from livepde.diagnostics import Check, CheckReport
from livepde.errors import ConfigurationError, LawError, ModelError
from livepde.laws.law import Status
from livepde.linalg import Array, IntArray
from livepde.stepping import StepFailed

RIESZ, PREFIX = "livepde_riesz_", "livepde_state_"  # prefixes of PETSc's options
RESTING = 1e-6  # of u: residuals of smaller changes in a step are relative to it
TINY = 1e-300
SAME = 1e-9  # of a step: steps that are the same but for rounding
REBUILD = 1.5  # times the iterations with a new preconditioner: then it is built again
SHORTEST = 64  # steps that an interval is divided into at the most
STEP = 1e-6  # of the differences of a check, relative
CLOSE = 1e-5  # to a derivative, of a central difference with such a step
ROUNDING = 1e-10
MISSING = (
    "livepde.petsc needs petsc4py, mpi4py and, for UFL, DOLFINx; deploy/petsc.sh sets up an "
    "environment with Debian's packages: see docs/parallel.md."
)


def petsc_module(name: str = "petsc4py.PETSc") -> Any:
    """Return a module, by default that of PETSc, which starts MPI; raises `ConfigurationError`."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ConfigurationError(MISSING) from error


@runtime_checkable
class PetscModel(Protocol):
    """A process M u' + F(u, q, t) = 0 on PETSc vectors and matrices.

    F holds all terms without a time derivative, B(u) + A(u) q - f in the letters of the paper, as a
    dual vector of X. u in X has n coefficients and q in Q has m; both are vectors of type
    "standard", of which every rank owns a part. An action is the product with a matrix (`mult`),
    its transpose `multTranspose`: a matrix may be a shell, except where "assembled" is said. A
    matrix belongs to the model, and holds until the same method is called again.

    `w` in the methods below is data of the state on the observed subdomain omega, shape (n,): there
    F sees w, and u elsewhere, as the paper splits its integrals. Without w, F sees u everywhere.
    Coefficients with Dirichlet values need no treatment in F, its derivatives and the matrices: the
    laws eliminate the rows and columns `fixed`.

    Attributes
    ----------
    mass
        M, assembled, shape (n, n); symmetric positive definite.
    gram, mass_q
        G_Q, the inner product of Q, assembled, and that of L2, for modes; shape (m, m).
    sensors
        G of point sensors or averages, shape (sensors, n).
    mass_observed, pull
        Integrals over omega: M, and M_op of (MN1), assembled, shape (n, n).
    push
        N_op of (MN2), integrated over the rest, assembled, shape (n, n); None: omega is everything.
    fixed
        Global numbers of owned coefficients of u with Dirichlet values.
    linear
        True if F is affine in u: one Newton update solves an implicit step.
    symmetric
        True if M/h + dF/du is symmetric positive definite: conjugate gradients serve.
    """

    mass: Any
    gram: Any
    mass_q: Any
    sensors: Any
    mass_observed: Any
    pull: Any
    push: Any
    fixed: IntArray
    linear: bool
    symmetric: bool

    @property
    def numbers_u(self) -> IntArray:
        """Number of each owned coefficient of u in an order that no number of ranks changes."""

    @property
    def numbers_q(self) -> IntArray:
        """The same for q."""

    def impose(self, u: Any, t: float) -> None:
        """Set the Dirichlet values of a time in u."""

    def residual(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return F(u, q, t), a new dual vector, shape (n,)."""

    def jacobian_u(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return dF/du, assembled, shape (n, n); None: zero, as for w with all of u observed."""

    def jacobian_q(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return dF/dq, shape (n, m); assembled if a `PetscObserver` uses it."""

    def coupling(self, w: Any, q: Any, t: float) -> Any:
        """Return A(w), the derivative of F in q integrated over omega, assembled, shape (n, m).

        With all of u observed it is `jacobian_q` at w.
        """


def combined(weights: Array, vectors: Sequence[Any], onto: Any = None) -> Any:
    """Return the weighted sum of vectors, plus `onto`, as a new vector."""
    total = zeros(vectors[0]) if onto is None else onto.copy()
    total.maxpy(weights, list(vectors))
    return total


def inner(x: Any, vectors: Sequence[Any]) -> Array:
    """Return the inner products of x with several vectors, by one reduction, on every rank."""
    own = x.getArray(readonly=True)
    local = np.array([one.getArray(readonly=True) @ own for one in vectors])
    total: Array = x.comm.tompi4py().allreduce(local)
    return total


def gathered(small: Any) -> Array:
    """Return all values of a small vector, such as readings, on every rank."""
    return np.concatenate(small.comm.tompi4py().allgather(small.getArray(readonly=True).copy()))


def free_mask(x: Any, fixed: IntArray) -> Any:
    """Return a vector like x with ones, and zeros at owned global numbers."""
    mask = x.duplicate()
    mask.set(1.0)
    mask.getArray()[fixed - x.getOwnershipRange()[0]] = 0.0
    return mask


def random_vector(like: Any, numbers: IntArray, seed: int) -> Any:
    """Return a vector of values in (-1, 1) that depend on `numbers` and the seed alone."""
    vector = like.duplicate()
    # The fractional part of a large sine: a hash as shaders use, equal on all ranks.
    hashed = 43758.5453 * np.sin(12.9898 * (np.asarray(numbers) + 1.0) + 78.233 * seed)
    vector.getArray()[:] = 2.0 * (hashed - np.floor(hashed)) - 1.0
    return vector


def zeros(like: Any) -> Any:
    """Return a zero vector like another one."""
    vector = like.duplicate()
    vector.set(0.0)
    return vector


def linear_solver(matrix: Any, accuracy: float, kind: str = "cg", prefix: str = RIESZ) -> Any:
    """Return a solver with algebraic multigrid, which PETSc's options with the prefix change."""
    solver = petsc_module().KSP().create(matrix.comm)
    solver.setOptionsPrefix(prefix)
    solver.setOperators(matrix)
    solver.setType(kind)
    solver.getPC().setType(multigrid())
    solver.setTolerances(rtol=accuracy, atol=0.0, max_it=500)
    solver.setFromOptions()
    return solver


def multigrid() -> str:
    """Return the algebraic multigrid of this PETSc: BoomerAMG if it was built with hypre."""
    return "hypre" if petsc_module().Sys.hasExternalPackage("hypre") else "gamg"


def standard_vector(comm: Any, local: int) -> Any:
    """Return a zero vector of PETSc's standard type with so many owned values."""
    vector = petsc_module().Vec().create(comm)
    vector.setSizes((local, None))
    vector.setType("standard")
    vector.set(0.0)
    return vector


def advance(stage: Callable[..., Any], state: Any, t0: float, t1: float) -> tuple[Any, Status]:
    """Return the state at t1 by stages over [t, t + h], halved where one fails, and a status.

    With a status other than "ok" the state is that of t0.
    """
    count, done, now = 1, 0, state
    while done < count:
        h = (t1 - t0) / count
        try:
            now = stage(now, t0 + done * h, h)
        except StepFailed as failure:
            if count >= SHORTEST:
                return state, Status.of(failure)
            # Steps half as long: those that are done count twice.
            count, done = 2 * count, 2 * done
        else:
            done += 1
    return now, Status()


def require_order(who: str, lower: float, upper: float) -> None:
    """Raise `LawError` if bounds are not in order."""
    if not lower < upper:
        raise LawError(f"{who}: lower must be less than upper; got {lower} and {upper}.")


@dataclass(eq=False)
class ImplicitStep:
    """Newton's iteration for M (u+ - u)/h + F(u+, q, t + h) = 0, and S^{-1}, S = M/h + dF/du.

    The preconditioner is algebraic multigrid, kept until it needs `REBUILD` times the iterations
    that it took when new. PETSc's options with the prefix `livepde_state_` replace both.

    `tolerance` bounds the residual relative to its terms, in the dual norm by the diagonal of M.
    """

    model: PetscModel
    tolerance: float = 1e-9
    accuracy: float = 1e-11
    iterations: int = 20

    def __post_init__(self) -> None:
        mass = self.model.mass
        self.free = free_mask(mass.createVecRight(), self.model.fixed)
        self.ksp: Any = None
        self.weights = mass.getDiagonal()
        self.weights.reciprocal()
        self._best, self._last, self._width = 0, 0, 0.0

    def solve(self, u: Any, q: Any, t: float, h: float) -> Any:
        """Return u at t + h, a new vector; raises `StepFailed`."""
        model, begin = self.model, u
        u = begin.copy()
        model.impose(u, t + h)
        rate = begin.duplicate()
        # At rest all terms vanish: then the residual is relative to that of a small change of u.
        least = RESTING * self.dual(model.mass * begin) / h
        stale = True
        for count in range(self.iterations + 1):
            model.mass.mult((u - begin) / h, rate)
            force = model.residual(u, q, t + h)
            size = max(self.dual(rate), self.dual(force), least, TINY)
            force.axpy(1.0, rate)
            found = self.dual(force) / size
            if not math.isfinite(found):
                raise StepFailed("not_finite", "the iteration left the range of finite numbers")
            if count and found <= self.tolerance:
                break
            if count == self.iterations:
                left = f"{count} updates left a relative residual of {found:.1e}"
                raise StepFailed("not_converged", left)
            if stale:
                self.linearise(u, q, t + h, h)
                # One operator serves all updates of a linear process.
                stale = not model.linear
            u.axpy(-1.0, self.back(force))
        if stale:
            self.linearise(u, q, t + h, h)
        return u

    def dual(self, functional: Any) -> float:
        """Return the dual norm of a functional on the free coefficients, by the diagonal of M."""
        free = functional * self.free
        return math.sqrt(abs(float(free.dot(free * self.weights))))

    def linearise(self, u: Any, q: Any, t: float, h: float) -> None:
        """Assemble S = M/h + dF/du at a point, fixed coefficients eliminated."""
        model, S = self.model, self.model.mass.copy()
        S.scale(1.0 / h)
        slope = model.jacobian_u(u, q, t)
        if slope is not None:
            S.axpy(1.0, slope, petsc_module().Mat.Structure.UNKNOWN_NONZERO_PATTERN)
        S.zeroRowsColumns(model.fixed, 1.0)
        if self.ksp is None:
            kind = "cg" if model.symmetric else "gmres"
            self.ksp = linear_solver(S, self.accuracy, kind, PREFIX)
        rebuild = abs(h - self._width) > SAME * h or self._last > REBUILD * self._best + 1
        self.ksp.getPC().setReusePreconditioner(not rebuild)
        self.ksp.setOperators(S)
        if rebuild:
            self._best, self._width = 0, h

    def back(self, b: Any) -> Any:
        """Return S^{-1} b, zero at fixed coefficients; raises `StepFailed`."""
        petsc_module().garbage_cleanup(b.comm)  # vectors that all ranks have dropped
        x = b.duplicate()
        self.ksp.solve(b * self.free, x)
        reason, self._last = self.ksp.getConvergedReason(), self.ksp.getIterationNumber()
        if reason < 0:
            raise StepFailed("singular", f"PETSc's solver stopped with reason {reason}")
        self._best = self._best or self._last
        return x


def check_petsc_model(
    model: PetscModel, u: Any, q: Any, t: float = 0.0, w: Any = None, *, seed: int = 1
) -> CheckReport:
    """Check the assumptions of the laws at a point u, q, t, in random directions.

    With data w on omega it is what `PetscObserver` relies on, without what `PetscFilter` does.
    """
    du = random_vector(u, model.numbers_u, seed) * free_mask(u, model.fixed)
    dq = random_vector(q, model.numbers_q, seed + 1)
    # Directions as large as u and q keep relative differences well scaled.
    for direction, at in ((du, u), (dq, q)):
        direction.scale((at.norm() or 1.0) / (direction.norm() or 1.0))
    v = random_vector(u, model.numbers_u, seed + 2)
    S, A = model.jacobian_u(u, q, t, w), model.jacobian_q(u, q, t, w)
    slope, driven, back = zeros(u) if S is None else S * du, A * dq, zeros(q)
    A.multTranspose(v, back)
    by_u = model.residual(u + du * STEP, q, t, w) - model.residual(u - du * STEP, q, t, w)
    by_q = model.residual(u, q + dq * STEP, t, w) - model.residual(u, q - dq * STEP, t, w)
    wrong = "The matrix has to be the derivative of the residual."
    exchanged = "An inner product must be symmetric and positive."
    transposed = "multTranspose has to be the transpose of mult."
    odd = abs(driven.dot(v) - dq.dot(back)) / (driven.norm() * v.norm() or 1.0)
    found = [
        ("dF/du as differences", _apart(by_u / (2.0 * STEP), slope), CLOSE, wrong),
        ("dF/dq as differences", _apart(by_q / (2.0 * STEP), driven), CLOSE, wrong),
        ("(A q, v) = (q, A^T v)", odd, ROUNDING, transposed),
    ]
    named = (("M", model.mass, du, v), ("M_op", model.pull, du, v), ("G_Q", model.gram, dq, back))
    for name, matrix, a, b in named:
        size = (matrix * a).norm() * b.norm() or 1.0
        odd = abs((matrix * a).dot(b) - (matrix * b).dot(a)) / size
        found.append((f"{name} = {name}^T", odd, ROUNDING, exchanged))
        found.append((f"-(x, {name} x)", -float((matrix * a).dot(a)), 0.0, exchanged))
    if w is not None:
        once = model.residual(u, q + dq, t, w) - model.residual(u, q, t, w)
        twice = model.residual(u, q + dq * 2.0, t, w) - model.residual(u, q + dq, t, w)
        remedy = "The paper's law needs F affine in q: use PetscFilter."
        found.append(("F affine in q", _apart(once, twice), ROUNDING, remedy))
    lines = tuple(Check.at_most(*line) for line in found)
    return CheckReport("PETSc model", lines, ModelError)


def _apart(a: Any, b: Any) -> float:
    """Return the relative difference of two vectors."""
    return float((a - b).norm()) / (max(float(a.norm()), float(b.norm())) or 1.0)
