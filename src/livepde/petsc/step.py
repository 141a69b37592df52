"""One implicit Euler step on PETSc, and its tangents with the same operator and preconditioner."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from livepde.errors import LawError
from livepde.laws.law import Status
from livepde.petsc.petsc_model import PetscModel, petsc_module
from livepde.petsc.vectors import free_mask, linear_solver
from livepde.stepping import StepFailed

RESTING = 1e-6  # of u: residuals of smaller changes in a step are relative to it
TINY = 1e-300
SAME = 1e-9  # of a step: steps that are the same but for rounding
REBUILD = 1.5  # times the iterations with a new preconditioner: then it is built again
PREFIX = "livepde_state_"
SHORTEST = 64  # steps that an interval is divided into at the most


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
