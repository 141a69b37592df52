"""Exact Kalman filter and smoother of u' = s - decay u, with s a random walk or mean-reverting.

Uses no code of livepde. Transition and process noise between two samples come from van Loan's block
exponential (1978), so that they are exact for any spacing of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm


def mean_and_end(rate: float, h: float, gained: float) -> np.ndarray:
    """Return the covariance of the mean over h and the end value of a walk's or relaxation's noise.

    Uses van Loan's block exponential of (integral, value); `gained` is the variance at the end.
    """
    A, Q = np.array([[0.0, 1.0], [0.0, -rate]]), np.diag([0.0, 1.0])
    block = expm(h * np.block([[-A, Q], [np.zeros((2, 2)), A.T]]))
    P = block[2:, 2:].T @ block[:2, 2:]
    scale = np.diag([1.0 / h, 1.0])
    covariance: np.ndarray = gained / P[1, 1] * scale @ (P + P.T) @ scale / 2
    return covariance


@dataclass(frozen=True)
class Exact:
    """The process with one reading of u at each sample.

    Attributes
    ----------
    decay
        Decay rate of u.
    std
        Prior standard deviation of s; u is known at the start.
    noise
        Standard deviation of the noise of a reading.
    rate
        Rate of the random walk of s; None: s is mean-reverting, its prior is stationary.
    time
        Relaxation time of a mean-reverting s.
    """

    decay: float
    std: float
    noise: float
    rate: float | None = None
    time: float = np.inf

    def interval(self, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the transition matrix and process noise of (u, s) over a time h."""
        A = np.array([[-self.decay, 1.0], [0.0, -1.0 / self.time]])
        spread = self.rate**2 if self.rate else 2.0 * self.std**2 / self.time
        # Double a short interval, because the block exponential of a stiff process overflows.
        doublings = max(int(np.ceil(np.log2(np.abs(A).max() * h))), 0) if h else 0
        Q, zero = np.diag([0.0, spread]), np.zeros((2, 2))
        block = expm(np.block([[-A, Q], [zero, A.T]]) * (h / 2**doublings))
        F = block[2:, 2:].T
        gained = F @ block[:2, 2:]
        for _ in range(doublings):
            F, gained = F @ F, F @ gained @ F.T + gained
        return F, (gained + gained.T) / 2

    def drawn(self, h: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw a path of (u, s) at equidistant samples from the prior, shape (count, 2)."""
        F, Q = self.interval(h)
        root, x = np.linalg.cholesky(Q), np.array([0.0, self.std * rng.standard_normal()])
        path = [x]
        for _ in range(count - 1):
            x = F @ x + root @ rng.standard_normal(2)
            path.append(x)
        return np.array(path)

    def read(self, path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return noisy readings of u along a path."""
        return path[:, 0] + self.noise * rng.standard_normal(len(path))

    def filtered(self, h: float, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return filtered means and covariances of (u, s); a NaN in z is a missing reading."""
        F, Q = self.interval(h)
        x, P, means, spreads = np.zeros(2), np.diag([0.0, self.std**2]), [], []
        for k, value in enumerate(z):
            if k:
                x, P = F @ x, F @ P @ F.T + Q
            if np.isfinite(value):
                K = P[:, 0] / (P[0, 0] + self.noise**2)
                x, P = x + K * (value - x[0]), P - np.outer(K, P[0])
            means.append(x)
            spreads.append(P)
        return np.array(means), np.array(spreads)

    def smoothed(self, h: float, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return smoothed means and covariances of (u, s) at each sample, given all readings."""
        F, Q = self.interval(h)
        means, spreads = self.filtered(h, z)
        for k in range(len(z) - 2, -1, -1):
            x, P = F @ means[k], F @ spreads[k] @ F.T + Q
            G = np.linalg.solve(P, F @ spreads[k]).T
            means[k] = means[k] + G @ (means[k + 1] - x)
            spreads[k] = spreads[k] + G @ (spreads[k + 1] - P) @ G.T
        return means, spreads
