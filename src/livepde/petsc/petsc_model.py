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
RESTING = 1e-6  # relative change of u in a step to which residuals of smaller changes are relative
TINY = 1e-300
SAME = 1e-9  # relative difference of equal steps, up to rounding
REBUILD = 1.5  # growth of the iterations after which the preconditioner is rebuilt
SHORTEST = 64  # largest number of steps in an interval
STEP = 1e-6  # relative step of central differences in checks
CLOSE = 1e-5  # relative error of these central differences
ROUNDING = 1e-10
MISSING = (
    "livepde.petsc needs petsc4py, mpi4py and, for UFL, DOLFINx; deploy/petsc.sh sets up an "
    "environment with Debian's packages: see docs/parallel.md."
)


def petsc_module(name: str = "petsc4py.PETSc") -> Any:
    """Import a module, by default PETSc, which starts MPI; raises `ConfigurationError`."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ConfigurationError(MISSING) from error


@runtime_checkable
class PetscModel(Protocol):
    """A process M u' + F(u, q, t) = 0 on PETSc vectors and matrices.

    F contains all terms without a time derivative, B(u) + A(u) q - f in the notation of the paper,
    as a dual vector of X. u in X has n coefficients and q in Q has m. Both are vectors of type
    "standard", distributed over the ranks. Matrices may be shells with `mult` and `multTranspose`,
    unless they must be "assembled". A matrix is owned by the model and valid until the next call of
    the same method.

    `w` in the methods below contains data of the state on the observed subdomain omega, shape (n,):
    F is evaluated at w on omega and at u elsewhere, as in the paper. Without w, F is evaluated at u
    everywhere. F, its derivatives and the matrices need not treat Dirichlet values, since the laws
    eliminate the rows and columns `fixed`.

    Attributes
    ----------
    mass
        M, assembled, shape (n, n); symmetric positive definite.
    gram, mass_q
        G_Q, the inner product of Q, assembled, and the L2 inner product, for modes; shape (m, m).
    sensors
        G of point sensors or averages, shape (sensors, n).
    mass_observed, pull
        M and M_op of (MN1), both integrated over omega, assembled, shape (n, n).
    push
        N_op of (MN2), integrated outside omega, assembled, shape (n, n); None: omega is the domain.
    fixed
        Global numbers of owned coefficients of u with Dirichlet values.
    linear
        Whether F is affine in u, so that one Newton update solves an implicit step.
    symmetric
        Whether M/h + dF/du is symmetric positive definite, for conjugate gradients.
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
        """Number of each owned coefficient of u, independent of the number of ranks."""

    @property
    def numbers_q(self) -> IntArray:
        """Number of each owned coefficient of q, independent of the number of ranks."""

    def impose(self, u: Any, t: float) -> None:
        """Set the Dirichlet values of a time in u."""

    def residual(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return F(u, q, t), a new dual vector, shape (n,)."""

    def jacobian_u(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return dF/du, assembled, shape (n, n), or None if zero: with w and all of u observed."""

    def jacobian_q(self, u: Any, q: Any, t: float, w: Any = None) -> Any:
        """Return dF/dq, shape (n, m); a `PetscObserver` requires that it is assembled."""

    def coupling(self, w: Any, q: Any, t: float) -> Any:
        """Return A(w), the derivative of F in q integrated over omega, assembled, shape (n, m).

        If all of u is observed, it equals `jacobian_q` at w.
        """


def combined(weights: Array, vectors: Sequence[Any], onto: Any = None) -> Any:
    """Return the weighted sum of vectors, plus `onto`, as a new vector."""
    total = zeros(vectors[0]) if onto is None else onto.copy()
    total.maxpy(weights, list(vectors))
    return total


def inner(x: Any, vectors: Sequence[Any]) -> Array:
    """Return the inner products of x with vectors, on every rank, with a single reduction."""
    own = x.getArray(readonly=True)
    local = np.array([one.getArray(readonly=True) @ own for one in vectors])
    total: Array = x.comm.tompi4py().allreduce(local)
    return total


def gathered(small: Any) -> Array:
    """Return all values of a small vector, such as readings, on every rank."""
    return np.concatenate(small.comm.tompi4py().allgather(small.getArray(readonly=True).copy()))


def free_mask(x: Any, fixed: IntArray) -> Any:
    """Return a vector like x with zeros at the owned global numbers `fixed`, and ones elsewhere."""
    mask = x.duplicate()
    mask.set(1.0)
    mask.getArray()[fixed - x.getOwnershipRange()[0]] = 0.0
    return mask


def random_vector(like: Any, numbers: IntArray, seed: int) -> Any:
    """Return a vector of values in (-1, 1) that depend only on `numbers` and the seed."""
    vector = like.duplicate()
    # The fractional part of a large sine is a hash function of shaders, equal on all ranks.
    hashed = 43758.5453 * np.sin(12.9898 * (np.asarray(numbers) + 1.0) + 78.233 * seed)
    vector.getArray()[:] = 2.0 * (hashed - np.floor(hashed)) - 1.0
    return vector


def zeros(like: Any) -> Any:
    """Return a zero vector with the layout of `like`."""
    vector = like.duplicate()
    vector.set(0.0)
    return vector


def linear_solver(matrix: Any, accuracy: float, kind: str = "cg", prefix: str = RIESZ) -> Any:
    """Return a solver with algebraic multigrid; PETSc's options with the prefix apply to it."""
    solver = petsc_module().KSP().create(matrix.comm)
    solver.setOptionsPrefix(prefix)
    solver.setOperators(matrix)
    solver.setType(kind)
    solver.getPC().setType(multigrid())
    solver.setTolerances(rtol=accuracy, atol=0.0, max_it=500)
    solver.setFromOptions()
    return solver


def multigrid() -> str:
    """Return the name of the algebraic multigrid: hypre (BoomerAMG) if available, else gamg."""
    return "hypre" if petsc_module().Sys.hasExternalPackage("hypre") else "gamg"


def standard_vector(comm: Any, local: int) -> Any:
    """Return a zero vector of PETSc's standard type with `local` owned values."""
    vector = petsc_module().Vec().create(comm)
    vector.setSizes((local, None))
    vector.setType("standard")
    vector.set(0.0)
    return vector


def advance(stage: Callable[..., Any], state: Any, t0: float, t1: float) -> tuple[Any, Status]:
    """Return the state at t1 and a status; steps [t, t + h] are halved after a failure.

    With a status other than "ok", the state is unchanged.
    """
    count, done, now = 1, 0, state
    while done < count:
        h = (t1 - t0) / count
        try:
            now = stage(now, t0 + done * h, h)
        except StepFailed as failure:
            if count >= SHORTEST:
                return state, Status.of(failure)
            # With half the step, completed steps count twice.
            count, done = 2 * count, 2 * done
        else:
            done += 1
    return now, Status()


def require_order(who: str, lower: float, upper: float) -> None:
    """Raise `LawError` unless lower < upper."""
    if not lower < upper:
        raise LawError(f"{who}: lower must be less than upper; got {lower} and {upper}.")


@dataclass(eq=False)
class ImplicitStep:
    """Newton's method for M (u+ - u)/h + F(u+, q, t + h) = 0, and S^{-1} with S = M/h + dF/du.

    The preconditioner is algebraic multigrid, which is rebuilt if the number of iterations exceeds
    `REBUILD` times that of a new one. PETSc's options with the prefix `livepde_state_` apply.

    `tolerance` bounds the residual relative to its terms, in the dual norm with the diagonal of M.
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
        # At rest all terms vanish. The residual is then relative to that of a small change of u.
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
                # All updates of a linear process have the same operator.
                stale = not model.linear
            u.axpy(-1.0, self.back(force))
        if stale:
            self.linearise(u, q, t + h, h)
        return u

    def dual(self, functional: Any) -> float:
        """Return the dual norm of a functional on free coefficients, with the diagonal of M."""
        free = functional * self.free
        return math.sqrt(abs(float(free.dot(free * self.weights))))

    def linearise(self, u: Any, q: Any, t: float, h: float) -> None:
        """Assemble S = M/h + dF/du at a point, with fixed coefficients eliminated."""
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
        petsc_module().garbage_cleanup(b.comm)  # frees vectors that no rank uses any more
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
    """Check the assumptions of the laws at a point (u, q, t) in random directions.

    With data w on omega, the assumptions are those of `PetscObserver`, else of `PetscFilter`.
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
