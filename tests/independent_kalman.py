"""A Kalman filter and a fixed-interval smoother of a rod in NumPy, without code of livepde.

The rod is u_t = 0.3 u_xx - 0.4 u + s + c x + Q on (0, 1) with u(0) = T_0 and linear elements. The
numbers s and c and a common offset of all sensors are unknown.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

DIFFUSION, DECAY = 0.3, 0.4
STAGES = {"euler": 1.0, "alexander": 1.0 - math.sqrt(0.5)}


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """Boundary value T_0 and source Q at one time."""

    T_0: float
    Q: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """Readings at one time, NaN if missing, with the standard deviation of each reading.

    `unread`: standard deviation of the error of a held T_0, constant over the interval before.
    """

    t: float
    inputs: Inputs
    z: np.ndarray
    std: np.ndarray
    unread: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Gaussian:
    """Mean and covariance of (u, s, c, offset)."""

    mean: np.ndarray
    cov: np.ndarray

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.maximum(np.diag(self.cov), 0.0))


@dataclass(frozen=True, kw_only=True)
class Rod:
    """The rod with its time discretisation.

    `between`: how T_0 and Q behave in an interval: linear, or constant with the value at its start
    (hold) or its end (next). `input_std`: standard deviation of the error of T_0, which is constant
    over an interval and independent between intervals.
    """

    cells: int
    scheme: str = "alexander"
    dt_max: float = math.inf
    between: tuple[str, str] = ("line", "line")
    input_std: float = 0.0

    @property
    def nodes(self) -> np.ndarray:
        return np.linspace(0.0, 1.0, self.cells + 1)

    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mass matrix, the matrix of diffusion and decay, and the loads of 1 and x."""
        n, h, x = self.cells + 1, 1.0 / self.cells, self.nodes
        M, B, loads = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, 2))
        for k in range(self.cells):
            mass = h / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
            part = np.ix_([k, k + 1], [k, k + 1])
            M[part] += mass
            B[part] += DIFFUSION / h * np.array([[1.0, -1.0], [-1.0, 1.0]]) + DECAY * mass
            loads[k : k + 2, 0] += h / 2.0
            loads[k : k + 2, 1] += mass @ x[k : k + 2]
        return M, B, loads

    def step(
        self, state: np.ndarray, t0: float, t1: float, first: Inputs, last: Inputs
    ) -> np.ndarray:
        """Return (u, s, c, offset) at the end of an interval."""
        M, B, loads = self.matrices()
        n = self.cells + 1
        u, (s, c) = state[:n].copy(), state[n : n + 2]
        count = 1 if t1 - t0 <= self.dt_max else math.ceil((t1 - t0) / self.dt_max - 1e-9)
        h = (t1 - t0) / count
        ends = {"line": (first, last), "hold": (first, first), "next": (last, last)}

        def stage(before: np.ndarray, t: float, length: float) -> np.ndarray:
            share = (t - t0) / (t1 - t0)
            T_0, Q = (
                (1.0 - share) * getattr(ends[own][0], name) + share * getattr(ends[own][1], name)
                for name, own in zip(("T_0", "Q"), self.between, strict=True)
            )
            S = M / length + B
            right = M @ before / length + (s + Q) * loads[:, 0] + c * loads[:, 1]
            after = np.empty(n)
            after[0] = T_0
            after[1:] = np.linalg.solve(S[1:, 1:], right[1:] - S[1:, 0] * T_0)
            return after

        g = STAGES[self.scheme]
        for k in range(count):
            t = t0 + k * h
            if self.scheme == "euler":
                u = stage(u, t + h, h)
            else:
                inner = stage(u, t + g * h, g * h)
                u = stage(u + (1.0 - g) / g * (inner - u), t + h, g * h)
        return np.concatenate([u, state[n:]])

    def linear(
        self, t0: float, t1: float, first: Inputs, last: Inputs, unread: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F, g and Q of the transition state -> F state + g + N(0, Q)."""
        size = self.cells + 4
        g = self.step(np.zeros(size), t0, t1, first, last)
        F = np.column_stack([self.step(e, t0, t1, first, last) - g for e in np.eye(size)])
        Q = np.zeros((size, size))
        for std in (self.input_std, unread):
            ends = (replace(end, T_0=end.T_0 + std) for end in (first, last))
            shift = self.step(np.zeros(size), t0, t1, *ends) - g
            Q += np.outer(shift, shift)
        return F, g, Q


@dataclass(frozen=True, kw_only=True, eq=False)
class Filtered:
    """Beliefs after each row, and the matrices that the smoother needs."""

    beliefs: list[Gaussian]
    steps: list[tuple[np.ndarray, np.ndarray]]  # F and I - K H
    weights: list[tuple[np.ndarray, np.ndarray]]  # H' S^-1 H and H' S^-1 d
    log_evidence: float  # sum of log densities of the innovations


def updated(
    belief: Gaussian, row: Row, H: np.ndarray
) -> tuple[Gaussian, np.ndarray, np.ndarray, np.ndarray]:
    """Update a belief with a row; return it with I - K H, H' S^-1 H and H' S^-1 d."""
    seen = np.isfinite(row.z)
    H, R = H[seen], np.diag(row.std[seen] ** 2)
    S = H @ belief.cov @ H.T + R
    d = row.z[seen] - H @ belief.mean
    K = np.linalg.solve(S, H @ belief.cov).T
    I_KH = np.eye(len(belief.mean)) - K @ H
    cov = I_KH @ belief.cov @ I_KH.T + K @ R @ K.T
    after = Gaussian(mean=belief.mean + K @ d, cov=cov)
    return after, I_KH, H.T @ np.linalg.solve(S, H), H.T @ np.linalg.solve(S, d)


def filtered(
    rod: Rod, rows: Sequence[Row], H: np.ndarray, start: Gaussian, t0: float, inputs: Inputs
) -> Filtered:
    """Run the filter over all rows; `start` and `inputs` are the belief and the inputs at t0."""
    belief, beliefs, steps, weights, evidence = start, [], [], [], 0.0
    for row in rows:
        F = np.eye(len(start.mean))
        if row.t > t0:
            F, g, Q = rod.linear(t0, row.t, inputs, row.inputs, row.unread)
            belief = Gaussian(mean=F @ belief.mean + g, cov=F @ belief.cov @ F.T + Q)
        evidence += log_density(belief, row, H)
        belief, I_KH, information, score = updated(belief, row, H)
        beliefs.append(belief)
        steps.append((F, I_KH))
        weights.append((information, score))
        t0, inputs = row.t, row.inputs
    return Filtered(beliefs=beliefs, steps=steps, weights=weights, log_evidence=evidence)


def log_density(belief: Gaussian, row: Row, H: np.ndarray) -> float:
    """Return the log density of the readings of a row, given all readings before."""
    seen = np.isfinite(row.z)
    S = H[seen] @ belief.cov @ H[seen].T + np.diag(row.std[seen] ** 2)
    d = row.z[seen] - H[seen] @ belief.mean
    size = np.linalg.slogdet(2.0 * np.pi * S)[1]
    return float(-0.5 * (d @ np.linalg.solve(S, d) + size))


def smoothed(run: Filtered) -> list[Gaussian]:
    """Return the beliefs at each row given all rows.

    The smoother of Rauch, Tung and Striebel in the form of Bryson and Frazier, which does not
    invert covariances of the state. They are singular if the initial state is known.
    """
    size = len(run.beliefs[0].mean)
    r, L, beliefs = np.zeros(size), np.zeros((size, size)), []
    rounds = zip(run.beliefs, run.steps, run.weights, strict=True)
    for belief, (F, I_KH), (information, score) in reversed(list(rounds)):
        mean, cov = belief.mean + belief.cov @ r, belief.cov - belief.cov @ L @ belief.cov
        beliefs.append(Gaussian(mean=mean, cov=cov))
        r = F.T @ (score + I_KH.T @ r)
        L = F.T @ (information + I_KH.T @ L @ I_KH) @ F
    return beliefs[::-1]
