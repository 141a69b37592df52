"""The reduced-order filter on PETSc vectors.

The filter of Moireau, Chapelle and Le Tallec (2008) in `livepde.laws.filter`, for one process. Let
q = q_prior + Phi a, a ~ N(0, I), S the Jacobian of a step, A = dF/dq and P = [U C]^T [U C] the
joint covariance of u and a. Then

    predict   one implicit step for u;   S U+_i = M U_i/h - A(u+) Phi C_i        for each row i
    update    d = z - G u+,  Y = U G^T,  W W^T = (I + Y N^-1 Y^T)^-1
              [u; a] += [U C]^T W W^T Y N^-1 d,   [U C] <- W^T [U C]

u and the rows of U are PETSc vectors. C, W and Y are small and equal on every rank, since they are
computed only from sums over all ranks. Each row of U costs one linear solve per step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh

from livepde.errors import LawError
from livepde.laws.filter import contraction
from livepde.laws.law import Status
from livepde.linalg import Array, IntArray, Mask
from livepde.petsc.petsc_model import (
    ImplicitStep,
    PetscModel,
    advance,
    combined,
    gathered,
    inner,
    linear_solver,
    random_vector,
    require_order,
    zeros,
)

ACCURATE = 1e-14  # relative change of the variances of modes at which their iteration ends


@dataclass(frozen=True, eq=False)
class PetscFilterState:
    """Estimate and square root of the joint covariance after a sample, for k unknowns a.

    The state u and the k rows U of the square root are vectors of shape (n,). The unknowns a, shape
    (k,), are in prior standard deviations, and C, shape (k, k), is their square root. `refused` has
    the number of consecutive refused readings of each sensor. `modes` has the k columns of Phi.
    """

    t: float
    u: Any
    U: tuple[Any, ...]
    a: Array
    C: Array
    refused: IntArray
    modes: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class FilterReport:
    """Status of a sample; innovation z - G u, its expected size and used readings, (sensors,)."""

    status: Status
    innovation: Array
    expected: Array
    used: Mask


@dataclass(frozen=True, eq=False)
class PetscFilter:
    """State and parameter from point sensors or averages, with a covariance.

    Parameters
    ----------
    model
        The process; `sensors` is its observation.
    prior
        Prior mean of q, shape (m,).
    modes
        The k columns of Phi, vectors of shape (m,): `number_modes` or `leading_modes`.
    noise
        Standard deviation of a reading: a number, or one for each sensor.
    lower, upper
        Bounds of each coefficient of q. An estimate outside is projected onto them, and the state
        is corrected by its covariance with the unknowns.
    gate, patience
        Readings with an innovation of more than `gate` expected standard deviations are refused,
        unless the last `patience` readings were refused: then the process has really changed.
    """

    model: PetscModel
    prior: Any
    modes: Sequence[Any]
    noise: Any
    lower: float = -np.inf
    upper: float = np.inf
    gate: float = 6.0
    patience: int = 10
    stepper: ImplicitStep = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not len(self.modes):
            raise LawError("PetscFilter: needs at least one mode: see number_modes, leading_modes.")
        noise = np.asarray(self.noise, dtype=float)
        if not (np.isfinite(noise).all() and (noise > 0.0).all()):
            raise LawError(f"PetscFilter: noise must be positive; got {self.noise}.")
        require_order("PetscFilter", self.lower, self.upper)
        object.__setattr__(self, "stepper", ImplicitStep(self.model))

    def init(self, u0: Any, t0: float = 0.0) -> PetscFilterState:
        """Return the initial state, in which u0 is exact and the unknowns have their prior."""
        k, u = len(self.modes), u0.copy()
        self.model.impose(u, t0)
        rows = [zeros(u) for _ in range(k)]
        none = np.zeros(self.model.sensors.getSize()[0], dtype=int)
        return PetscFilterState(t0, u, tuple(rows), np.zeros(k), np.eye(k), none, tuple(self.modes))

    def step(
        self, state: PetscFilterState, t: float, z: Any
    ) -> tuple[PetscFilterState, FilterReport]:
        """Return the state after a sample z at t, shape (sensors,), NaN for missing readings.

        Raises `LawError` if z has a different shape, or t is not later than the last sample.
        """
        z = np.asarray(z, dtype=float)
        if z.shape != state.refused.shape:
            raise LawError(f"PetscFilter: z needs shape {state.refused.shape}; got {z.shape}.")
        if not t > state.t:
            raise LawError(f"PetscFilter: t must be later than {state.t}; got {t}.")
        new, status = advance(self.predict, state, state.t, t)
        if not status.ok:
            lost = np.full(z.shape, np.nan)
            return state, FilterReport(status, lost, lost, np.zeros(z.shape, dtype=bool))
        return self.update(new, z)

    def parameter(self, state: PetscFilterState) -> Any:
        """Return the estimate of q within its bounds as a new vector."""
        return self._bounded(combined(state.a, state.modes, self.prior))

    def deviation(self, state: PetscFilterState) -> Any:
        """Return the standard deviation of each coefficient of q as a new vector."""
        # The diagonal of Phi C^T C Phi^T.
        square = zeros(self.prior)
        for row in state.C:
            direction = combined(row, state.modes)
            square.axpy(1.0, direction * direction)
        square.sqrtabs()
        return square

    def predict(self, state: PetscFilterState, t: float, h: float) -> PetscFilterState:
        """Return the predicted state after a step h; raises `StepFailed`."""
        q = self.parameter(state)
        u = self.stepper.solve(state.u, q, t, h)
        A, rows = self.model.jacobian_q(u, q, t + h), []
        for row, c in zip(state.U, state.C, strict=True):
            # Right-hand side M U_i/h - A(u+) Phi C_i.
            b = self.model.mass * row
            b.scale(1.0 / h)
            b.axpy(-1.0, A * combined(c, state.modes))
            rows.append(self.stepper.back(b))
        return replace(state, t=t + h, u=u, U=tuple(rows))

    def update(self, state: PetscFilterState, z: Array) -> tuple[PetscFilterState, FilterReport]:
        """Return the state updated by the readings z, and a report."""
        d = z - self.read(state.u)
        noise = np.broadcast_to(np.asarray(self.noise, dtype=float), z.shape)
        # Y N^(-1/2), shape (k, sensors), and the square root of the diagonal of N + Y^T Y.
        Y = np.array([self.read(row) for row in state.U]) / noise
        expected = noise * np.sqrt(1.0 + (Y**2).sum(axis=0))
        # After `patience` consecutive refusals, the readings of a sensor are used again.
        present = np.isfinite(d)
        far = present & (np.abs(np.where(present, d, 0.0)) > self.gate * expected)
        used = present & (~far | (state.refused >= self.patience))
        (W,), (half,), _ = contraction((Y * used)[None], np.where(used, d / noise, 0.0)[None])
        # W is upper triangular: row i of W^T U needs the first i + 1 rows of U.
        U = [combined(W[: i + 1, i], state.U[: i + 1]) for i in range(len(W))]
        C = W.T @ state.C
        u, a = combined(half, U, state.u), state.a + half @ C
        refused = np.where(used, 0, state.refused + far)
        new = replace(state, u=u, U=tuple(U), a=a, C=C, refused=refused)
        return self._projected(new), FilterReport(Status(), d, expected, used)

    def read(self, u: Any) -> Array:
        """Return G u, shape (sensors,), on every rank."""
        return gathered(self.model.sensors * u)

    def _bounded(self, q: Any) -> Any:
        values = q.getArray()
        np.clip(values, self.lower, self.upper, out=values)
        return q

    def _projected(self, state: PetscFilterState) -> PetscFilterState:
        """Return the state with an estimate beyond the bounds projected onto them."""
        if np.isinf(self.lower) and np.isinf(self.upper):
            return state
        q = combined(state.a, state.modes, self.prior)
        excess = self._bounded(q.copy()) - q
        if excess.norm() == 0.0:
            return state
        # Least squares in the span of the modes: Phi^T Phi shift = Phi^T excess. The correction of
        # the state is U^T C^-T shift, by its covariance with a.
        square = np.array([inner(one, state.modes) for one in state.modes])
        shift = np.linalg.solve(square, inner(excess, state.modes))
        weights = np.asarray(np.linalg.solve(state.C.T, shift), dtype=float)
        return replace(state, u=combined(weights, state.U, state.u), a=state.a + shift)


def number_modes(like: Any, std: Any) -> list[Any]:
    """Return the columns of Phi for numbers, from prior standard deviations, shape (m,)."""
    start, end = like.getOwnershipRange()
    found = []
    for k, value in enumerate(np.broadcast_to(np.asarray(std, dtype=float), like.getSize())):
        mode = zeros(like)
        if start <= k < end:
            mode.getArray()[k - start] = value
        found.append(mode)
    return found


def leading_modes(model: PetscModel, count: int, *, iterations: int = 60) -> list[Any]:
    """Return the leading modes of the prior N(0, G_Q^-1) of a field, as columns of Phi.

    Eigenvectors of M_Q x = lambda G_Q x, largest lambda first, x^T G_Q x = 1, by subspace iteration
    with twice as many vectors. Their initial values are independent of the number of ranks. Signs
    and modes of equal variance (on a square) may differ between runs, so a state stores its modes.
    """
    solver = linear_solver(model.gram, 1e-12)
    like = model.gram.createVecRight()
    basis = [random_vector(like, model.numbers_q, seed) for seed in range(1, 2 * count + 3)]
    values = np.zeros(len(basis))
    for _ in range(iterations):
        for vector in basis:
            solver.solve(model.mass_q * vector, vector)
        # Rayleigh-Ritz: the eigenproblem in the span of the basis, a small dense one.
        G = np.array([inner(model.gram * x, basis) for x in basis])
        M = np.array([inner(model.mass_q * x, basis) for x in basis])
        found, axes = eigh((M + M.T) / 2.0, (G + G.T) / 2.0)
        basis = [combined(column, basis) for column in axes.T[::-1]]
        settled = np.abs(found[::-1] - values)[:count].max() <= ACCURATE * found[-1]
        values = found[::-1]
        if settled:
            break
    return basis[:count]
