"""The paper's law on PETSc vectors: u and q in one coupled implicit step.

Boiger and Kaltenbacher (2016), (est_exact_q) and (est_exact_u), or (noisy_q) and (noisy_u) for a
smoothed u_alpha; u_alpha is known on omega. Let w = u_alpha on omega and u elsewhere, and
r = u - u_alpha on omega. Then y = (u, q) solves the coupled equations

    M (u - c_u)/h + F(u, q, t; w) + theta M_op r + nu N_op u    = 0
    G_Q ((q - c_q)/h + sigma q)/gain - A(w)^T r                 = 0

For full data, the terms with A cancel in the energy, as in (align:neplusnr). theta = mu/||r||_V~ is
defined by a damping rule, such as Assumption cond:mu02. Newton's linear systems

    K = [[M/h + dF/du + theta M_op + nu N_op + b a^T,  A], [-A(w)^T,  G_Q (1/h + sigma)/gain]]

are solved by GMRES with PETSc's field split as preconditioner: a lower Schur factorisation, with
algebraic multigrid for the first block and for the second block plus A^T D^-1 A, where D has the
row sums of the first (`selfp`). The preconditioner omits b a^T, the derivative of theta.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from livepde.errors import LawError
from livepde.laws.coupled.coupled_stage import nearest_root
from livepde.laws.coupled.equation import STIFFEST
from livepde.laws.damping import Damping, Residual, ResidualDamping
from livepde.laws.equation_tests import PROBES, ExcitationGate, ExcitationLevel
from livepde.laws.law import Status
from livepde.petsc.petsc_model import (
    RESTING,
    SAME,
    TINY,
    PetscModel,
    advance,
    free_mask,
    linear_solver,
    multigrid,
    petsc_module,
    random_vector,
    require_order,
    zeros,
)
from livepde.stepping import StepFailed

PREFIX = "livepde_coupled_"
OPTIONS = """
ksp_type fgmres, ksp_gmres_restart 60, pc_type fieldsplit, pc_fieldsplit_type schur,
pc_fieldsplit_schur_fact_type lower, pc_fieldsplit_schur_precondition selfp,
fieldsplit_0_ksp_type preonly, fieldsplit_1_ksp_type preonly, fieldsplit_0_pc_type {multigrid},
fieldsplit_1_pc_type {multigrid}, fieldsplit_1_mat_schur_complement_ainv_type lump
"""  # defaults of PETSc's options, which do not replace options of the user
ITERATIONS = 120  # largest number of GMRES iterations for an update
REBUILD = 2.0  # growth of the iterations per digit after which the preconditioner is rebuilt
FORCING = 1e-2  # relative accuracy of an update in inexact Newton iterations
HOLD = 1e12  # factor of the weight of G_Q that holds q
SHORTEST = 1e-3  # smallest fraction of an update in the line search


@dataclass(frozen=True, eq=False)
class ObserverState:
    """Estimates u and q, and data u_alpha, at time t; u_alpha is None before the first sample.

    `rate_u` and `rate_q`, the last rates of u - u_alpha and q, predict the next step.
    """

    t: float
    u: Any
    q: Any
    u_alpha: Any
    rate_u: Any
    rate_q: Any
    excitation: ExcitationLevel


@dataclass(frozen=True, eq=False)
class ObserverReport:
    """Status of a sample, whether the gate held q, and numbers of Newton and GMRES iterations."""

    status: Status
    held: bool
    updates: int
    iterations: int


@dataclass(frozen=True, eq=False)
class PetscObserver:
    """The online method of Boiger and Kaltenbacher, for a field q and u observed on a subdomain.

    Parameters
    ----------
    model
        The process; F must be affine in q.
    gain, damping, nu, sigma, gate
        See `GradientLaw`.
    lower, upper
        Bounds of each coefficient of q.
    tolerance, iterations
        Bound on the residuals of both equations relative to their terms, in dual norms with the
        diagonals of M and G_Q; largest number of Newton updates in a step.
    """

    model: PetscModel
    gain: float = 1.0
    damping: Damping = field(default_factory=ResidualDamping)
    nu: float = 0.0
    sigma: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    gate: ExcitationGate | None = field(default_factory=ExcitationGate)
    tolerance: float = 1e-6
    iterations: int = 20
    solver: CoupledSolver = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name, low in (("gain", TINY), ("nu", 0.0), ("sigma", 0.0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= low):
                kind = ">" if low else ">="
                raise LawError(f"PetscObserver: {name} must be a number {kind} 0; got {value}.")
        require_order("PetscObserver", self.lower, self.upper)
        object.__setattr__(self, "solver", CoupledSolver(self))

    def init(self, q0: Any, u0: Any, t0: float = 0.0) -> ObserverState:
        """Return the initial state."""
        u = u0.copy()
        self.model.impose(u, t0)
        rates = zeros(u), zeros(q0)
        return ObserverState(t0, u, q0.copy(), None, *rates, ExcitationLevel.none())

    def step(
        self, state: ObserverState, t: float, u_alpha: Any
    ) -> tuple[ObserverState, ObserverReport]:
        """Return the state after a sample u_alpha at t, whose values outside omega are not used."""
        if not t > state.t:
            raise LawError(f"PetscObserver: t must be later than {state.t}; got {t}.")
        solver, data = self.solver, u_alpha.copy()
        data.getArray()[solver.unseen] = 0.0
        self.model.impose(data, t)
        old = data if state.u_alpha is None else state.u_alpha
        held = self.gate is not None and self.gate.closed(state.excitation)
        solver.path, solver.rates = (state.t, old, t, data), (state.rate_u, state.rate_q)
        solver.held, solver.updates, solver.iterations = held, 0, 0
        (u, q), status = advance(solver.solve, (state.u, state.q), state.t, t)
        report = ObserverReport(status, held, solver.updates, solver.iterations)
        if not status.ok:
            return state, report
        np.clip(q.getArray(), self.lower, self.upper, out=q.getArray())
        excitation, rates = state.excitation, (state.rate_u, state.rate_q)
        if self.gate is not None:
            excitation = self.gate.add(excitation, *solver.probed(u, data, q, t))
        if state.u_alpha is not None:
            change = u - state.u - (data - old)
            rates = change / (t - state.t), (q - state.q) / (t - state.t)
        return ObserverState(t, u, q, data, *rates, excitation), report


class CoupledSolver:
    """Newton's method for coupled steps; also K as a Python matrix for PETSc's GMRES."""

    def __init__(self, law: PetscObserver) -> None:
        self.law, self.model = law, law.model
        mass, gram = self.model.mass, self.model.gram
        self.free = free_mask(mass.createVecRight(), self.model.fixed)
        self.weights = mass.getDiagonal(), gram.getDiagonal()
        for diagonal in self.weights:
            diagonal.reciprocal()
        self.unseen = self.model.mass_observed.getDiagonal().getArray() <= 0.0
        self.ksp: Any = None
        self.path: tuple[float, Any, float, Any]
        self.rates: tuple[Any, Any]
        self.held, self.updates, self.iterations = False, 0, 0
        self._best, self._slow, self._width = 0.0, False, 0.0  # iterations per digit; step size
        self._pairs: list[tuple[Any, Any]] = []
        self._tests: tuple[Any, Any] | None = None

    def data(self, t: float) -> Any:
        """Return u_alpha at a time in the interval by linear interpolation."""
        t0, old, t1, new = self.path
        return new if t == t1 else old + (new - old) * ((t - t0) / (t1 - t0))

    def solve(self, y: tuple[Any, Any], t: float, h: float) -> tuple[Any, Any]:
        """Return (u, q) at t + h, given y = (u, q) at t; raises `StepFailed`."""
        stage = Stage(self, y, t + h, h, self.data(t + h))
        u = y[0] + self.data(t + h) - self.data(t) + self.rates[0] * h
        q = y[1] + self.rates[1] * (0.0 if self.held else h)
        self.model.impose(u, t + h)
        try:
            return self._newton(stage, u.copy(), q.copy())
        except StepFailed:
            return self._by_theta(stage, u, q)
        finally:  # breaks reference cycles, which ranks would collect at different times
            vars(stage).clear()

    def _newton(self, stage: Stage, u: Any, q: Any) -> tuple[Any, Any]:
        """Return the solution; the initial values are overwritten; raises `StepFailed`."""
        found = stage.evaluate(u, q)
        for _ in range(self.law.iterations):
            if found <= self.law.tolerance:
                return u, q
            du, dq = self._update(stage, found)
            before, sizes, part = found, stage.sizes, 1.0
            u.axpy(-1.0, du)
            q.axpy(-1.0, dq)
            found = stage.evaluate(u, q)
            # Armijo's line search: halve the update until the decrease is sufficient.
            while not stage.relative(sizes) <= (1.0 - 0.1 * part) * before and part > SHORTEST:
                part *= 0.5
                u.axpy(part, du)
                q.axpy(part, dq)
                found = stage.evaluate(u, q)
            if not math.isfinite(found):
                raise StepFailed("not_finite", "the iteration left the range of finite numbers")
            if stage.relative(sizes) >= before:
                break
        if found <= self.law.tolerance:
            return u, q
        raise StepFailed("not_converged", f"the updates left a relative residual of {found:.1e}")

    def _by_theta(self, stage: Stage, u: Any, q: Any) -> tuple[Any, Any]:
        """Return the solution with theta nearest to its initial value; raises `StepFailed`.

        For fixed theta the step is almost linear, and theta is the root of a scalar function.
        """
        stage.evaluate(u, q)

        def gap(theta: float) -> float:
            nonlocal u, q
            stage.given = theta
            u, q = self._newton(stage, u, q)
            return stage.rule() - theta

        most = min(self.law.damping.most(stage.seen), STIFFEST / stage.h)
        root = nearest_root(gap, stage.theta, 1.0 / (STIFFEST * stage.h), most)
        if root is None:
            raise StepFailed("not_converged", "no weight theta of the damping solves the step")
        gap(root)
        return u, q

    def _update(self, stage: Stage, found: float) -> tuple[Any, Any]:
        """Solve K x = residual, to the accuracy that Newton's method requires."""
        PETSc = petsc_module()
        self.stage = stage
        stage.linearise()
        if abs(stage.h - self._width) > SAME * stage.h or self._slow:
            self._build(stage)
            self._best, self._width = 0.0, stage.h
        b = PETSc.Vec().createNest([stage.first, stage.second], comm=self.free.comm)
        x = PETSc.Vec().createNest([zeros(stage.first), zeros(stage.second)], comm=self.free.comm)
        # Inexact Newton: an update is not more accurate than the tolerance requires.
        accuracy = min(max(0.3 * self.law.tolerance / found, FORCING), 0.3)
        self.ksp.setTolerances(rtol=accuracy, atol=0.0, max_it=ITERATIONS)
        self.ksp.solve(b, x)
        reason, count = self.ksp.getConvergedReason(), self.ksp.getIterationNumber()
        if reason < 0 and reason != PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT:
            raise StepFailed("singular", f"PETSc's solver stopped with reason {reason}")
        # The preconditioner is outdated if the number of iterations per digit has grown.
        digits = -math.log10(accuracy)
        self._best = self._best or count / digits
        self._slow = count > REBUILD * self._best * digits + 2
        self.updates += 1
        self.iterations += count
        du, dq = x.getNestSubVecs()
        return du, dq

    def _build(self, stage: Stage) -> None:
        """Create the solver, with a preconditioner from the current blocks."""
        PETSc = petsc_module()
        options = PETSc.Options(PREFIX)
        for name, value in map(str.split, OPTIONS.format(multigrid=multigrid()).split(",")):
            if not options.hasName(name):
                options[name] = value
        nest = stage.nested()
        sizes = nest.getSizes()[0]
        shell = PETSc.Mat().createPython((sizes, sizes), self, comm=nest.comm)
        shell.setUp()
        self.ksp = PETSc.KSP().create(nest.comm)
        self.ksp.setOptionsPrefix(PREFIX)
        self.ksp.setOperators(shell, nest)
        self.ksp.setFromOptions()
        parts = ((str(k), part) for k, part in enumerate(nest.getNestISs()[0]))
        self.ksp.getPC().setFieldSplitIS(*parts)
        self.ksp.getPC().setReusePreconditioner(True)

    def mult(self, matrix: Any, x: Any, y: Any) -> None:
        """Set y = K x; called by PETSc."""
        stage, (u, q), (first, second) = self.stage, x.getNestSubVecs(), y.getNestSubVecs()
        # First equation: (S + b a^T) u + A q, with the border (b, a).
        stage.S.mult(u, first)
        first.axpy(1.0, (stage.A * q) * self.free)
        if stage.border is not None:
            first.axpy(stage.border[1].dot(u), stage.border[0])
        # Second equation: G_Q (1/h + sigma)/gain q - A(w)^T u.
        self.model.gram.mult(q, second)
        second.scale(stage.weight)
        back = zeros(second)
        stage.A_in.multTranspose(u * self.free, back)
        second.axpy(-1.0, back)

    def dual(self, functional: Any, line: int) -> float:
        """Return the dual norm of a functional on u (line 0) or q (line 1), with a diagonal."""
        return math.sqrt(abs(float(functional.dot(functional * self.weights[line]))))

    def riesz(self, functional: Any) -> Any:
        """Return the Riesz representative in X among the functions with support in omega."""
        if self._tests is None:
            model, inside = self.model, self.free.copy()
            hidden = (model.mass - model.mass_observed).getDiagonal().getArray()
            size = model.mass.getDiagonal().getArray()
            # M - M_omega is positive for test functions with support in cells outside omega, which
            # are excluded.
            inside.getArray()[np.abs(hidden) > 1e-12 * size] = 0.0
            rows = inside.getOwnershipRange()[0] + np.flatnonzero(inside.getArray() == 0.0)
            matrix = model.mass.copy()
            matrix.zeroRowsColumns(rows.astype(petsc_module().IntType), 1.0)
            self._tests = inside, linear_solver(matrix, 1e-10)
        inside, solver = self._tests
        x = zeros(functional)
        solver.solve(functional * inside, x)
        return x

    def probed(self, u: Any, u_alpha: Any, q: Any, t: float) -> tuple[Any, Any]:
        """Return (A(w) e_k, p_k) and (A(u) e_k, p_k) for the gate, each of shape (PROBES,)."""
        self._pairs = self._pairs or probes(self.model, self.free)
        found = []
        for w in (u_alpha, u):
            A = self.model.coupling(w, q, t)
            found.append(np.array([(A * e).dot(p) for e, p in self._pairs]))
        return found[0], found[1]


class Stage:
    """The equations of a coupled step from y = (u, q): residual and Jacobian.

    The blocks of K are S without b a^T, A and A_in, whose rows must be masked, and G_Q times a
    weight. The border is (b, a).
    """

    def __init__(self, solver: CoupledSolver, y: Any, t: float, h: float, w: Any) -> None:
        self.solver, self.law, self.model = solver, solver.law, solver.model
        (self.begin_u, self.begin_q), self.t, self.h, self.w = y, t, h, w
        self.weight = (1.0 / h + self.law.sigma) / self.law.gain * (HOLD if solver.held else 1.0)
        self.given: float | None = None  # fixed theta; None: theta of the damping rule
        self.A_in = self.model.coupling(w, y[1], t)
        # If known, F depends on q only and is affine, so that it is evaluated once.
        self.known = self.model.push is None and self.model.jacobian_u(y[0], y[1], t, w) is None
        self.least = RESTING * solver.dual(self.model.mass * y[0], 0) / h
        self.least_q = RESTING * solver.dual(self.model.gram * y[1], 1) * self.weight
        self._start: tuple[Any, Any] | None = None

    def evaluate(self, u: Any, q: Any) -> float:
        """Evaluate the residuals of both equations, and return the relative size."""
        model, law, dual, free = self.model, self.law, self.solver.dual, self.solver.free
        self.at = u, q
        petsc_module().garbage_cleanup(u.comm)  # frees vectors that no rank uses any more
        r = (u - self.w) * free
        self.Mr, self.mass_r = Mr, mass_r = model.pull * r, model.mass_observed * r
        self.norms = Residual(*self.squares(r, mass_r, Mr), lambda: self.seen)
        self.theta = self.rule() if self.given is None else self.given
        # First equation: mass term, F with nu N_op u, and theta M_op r.
        terms = model.mass * ((u - self.begin_u) / self.h), self.force(u, q), Mr * self.theta
        self.first = (terms[0] + terms[1] + terms[2]) * free
        size = max(self.least, TINY, *(dual(term * free, 0) for term in terms))
        back = zeros(q)
        self.A_in.multTranspose(r, back)
        # Second equation: sigma q = sigma (q - c_q) + sigma c_q, where the weight contains the
        # first term. A very large weight of G_Q holds q.
        drift = 0.0 if self.solver.held else law.sigma / law.gain
        change = model.gram * ((q - self.begin_q) * self.weight + self.begin_q * drift)
        self.second = change - back
        self.sizes = size, max(self.least_q, TINY, dual(change, 1), dual(back, 1))
        return self.relative(self.sizes)

    def relative(self, sizes: tuple[float, float]) -> float:
        """Return the larger residual of both equations, relative to the sizes of their terms."""
        pairs = zip((self.first, self.second), (0, 1), sizes, strict=True)
        return max(self.solver.dual(line, k) / size for line, k, size in pairs)

    def rule(self) -> float:
        """Return theta of the damping rule at the last iterate."""
        return min(self.law.damping.theta(self.norms), STIFFEST / self.h)

    def force(self, u: Any, q: Any) -> Any:
        """Return F(u, q, t; w) + nu N_op u."""
        if self.known:
            if self._start is None:
                self._start = self.model.residual(u, q, self.t, self.w), q.copy()
            return self._start[0] + self.A_in * (q - self._start[1])
        force = self.model.residual(u, q, self.t, self.w)
        if self.model.push is not None:
            force.axpy(self.law.nu, self.model.push * u)
        return force

    @cached_property
    def seen(self) -> Residual:
        """Norms of u_alpha."""
        z = self.w * self.solver.free
        return Residual(*self.squares(z, self.model.mass_observed * z, self.model.pull * z))

    def squares(self, r: Any, Mr: Any, pulled: Any) -> tuple[float, float, Callable[[], float]]:
        """Return the squared norms of r in X, VX~ and V~, the last as a function."""
        X, VX = abs(float(r.dot(Mr))), abs(float(r.dot(pulled)))
        return X, VX, lambda: abs(float(pulled.dot(self.solver.riesz(pulled))))

    def linearise(self) -> None:
        """Assemble the blocks of K at the last iterate."""
        model, other = self.model, petsc_module().Mat.Structure.UNKNOWN_NONZERO_PATTERN
        self.S = S = model.mass.copy()
        S.scale(1.0 / self.h)
        S.axpy(self.theta, model.pull, other)
        self.A, self.border = self.A_in, self._slope()
        if model.push is not None:
            S.axpy(self.law.nu, model.push, other)
        if not self.known:
            S.axpy(1.0, model.jacobian_u(*self.at, self.t, self.w), other)
            self.A = model.jacobian_q(*self.at, self.t, self.w)
        S.zeroRowsColumns(model.fixed, 1.0)

    def _slope(self) -> tuple[Any, Any] | None:
        """Return b and a of the derivative b a^T of theta in theta M_op r, or None if zero."""
        if self.given is not None or self.theta >= STIFFEST / self.h:
            return None
        dX, dVX, dV = self.law.damping.slopes(self.norms)
        row = self.mass_r * (2.0 * dX) + self.Mr * (2.0 * dVX)
        if dV:
            row.axpy(2.0 * dV, self.model.pull * self.solver.riesz(self.Mr))
        return self.Mr * self.solver.free, row * self.solver.free

    def nested(self) -> Any:
        """Return copies of the blocks of K without the border."""
        A, A_in, H = self.A.copy(), self.A_in.copy(), self.model.gram.copy()
        A.diagonalScale(L=self.solver.free)
        A_in.diagonalScale(L=self.solver.free)
        back = A_in.transpose()
        back.scale(-1.0)
        H.scale(self.weight)
        nest = petsc_module().Mat().createNest([[self.S, A], [back, H]], comm=self.S.comm)
        nest.assemble()
        return nest


def probes(model: PetscModel, free: Any) -> list[tuple[Any, Any]]:
    """Return pairs (e_k, p_k) for the gate: e_k in the unit ball of Q, p_k smooth on omega."""
    # M_op is integrated over omega only. A small multiple of the mass makes it definite elsewhere.
    stiff = model.pull.copy()
    stiff.axpy(1e-6, model.mass, petsc_module().Mat.Structure.UNKNOWN_NONZERO_PATTERN)
    stiff.zeroRowsColumns(model.fixed, 1.0)
    of_q, of_u = linear_solver(model.gram, 1e-8), linear_solver(stiff, 1e-8)
    q, u = model.gram.createVecRight(), model.mass.createVecRight()
    found = []
    for seed in range(101, 101 + PROBES):
        e, p = zeros(q), zeros(u)
        of_q.solve(random_vector(q, model.numbers_q, seed), e)
        e.scale(1.0 / math.sqrt(abs(float(e.dot(model.gram * e)))))
        # e and p have different seeds.
        load = model.mass_observed * random_vector(u, model.numbers_u, PROBES + seed)
        of_u.solve(load * free, p)
        found.append((e, p))
    return found
