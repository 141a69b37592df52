"""Exact Kalman filter and smoother of u' = s - decay u, with s a random walk or mean-reverting.

No code of livepde: transition and process noise between two samples are those of van Loan's block
exponential (1978), so that they are exact whatever the distance of the samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm


def mean_and_end(rate: float, h: float, gained: float) -> np.ndarray:
    """Return the covariance of mean and end value of the noise of a walk or a relaxation in h.

    By van Loan's block exponential of (integral, value); `gained` is the variance at the end.
    """
    A, Q = np.array([[0.0, 1.0], [0.0, -rate]]), np.diag([0.0, 1.0])
    block = expm(h * np.block([[-A, Q], [np.zeros((2, 2)), A.T]]))
    P = block[2:, 2:].T @ block[:2, 2:]
    scale = np.diag([1.0 / h, 1.0])
    found: np.ndarray = gained / P[1, 1] * scale @ (P + P.T) @ scale / 2
    return found


@dataclass(frozen=True)
class Exact:
    """The process, and one reading of u at each sample.

    Attributes
    ----------
    decay
        Rate at which u forgets.
    std
        Prior standard deviation of s; u is known at the start.
    noise
        Standard deviation of a reading.
    rate
        Of a random walk of s; None: s is mean-reverting with the prior as stationary law.
    time
        Relaxation time of a mean-reverting s.
    """

    decay: float
    std: float
    noise: float
    rate: float | None = None
    time: float = np.inf

    def interval(self, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Return transition and process noise of (u, s) in a time h."""
        A = np.array([[-self.decay, 1.0], [0.0, -1.0 / self.time]])
        spread = self.rate**2 if self.rate else 2.0 * self.std**2 / self.time
        # In short parts: the block exponential of a stiff process overflows.
        parts = int(np.ceil(np.abs(A).max() * h)) or 1
        Q, zero = np.diag([0.0, spread]), np.zeros((2, 2))
        block = expm(np.block([[-A, Q], [zero, A.T]]) * (h / parts))
        step = block[2:, 2:].T
        noise = step @ block[:2, 2:]
        F, gained = np.eye(2), np.zeros((2, 2))
        for _ in range(parts):
            F, gained = step @ F, step @ gained @ step.T + noise
        return F, (gained + gained.T) / 2

    def drawn(self, h: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return a path of (u, s) at equidistant samples, from the prior, shape (count, 2)."""
        F, Q = self.interval(h)
        root, x = np.linalg.cholesky(Q), np.array([0.0, self.std * rng.standard_normal()])
        path = [x]
        for _ in range(count - 1):
            x = F @ x + root @ rng.standard_normal(2)
            path.append(x)
        return np.array(path)

    def read(self, path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the readings of a path."""
        return path[:, 0] + self.noise * rng.standard_normal(len(path))

    def filtered(self, h: float, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return means and covariances of (u, s) after each sample; NaN is no reading."""
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
        """Return means and covariances of (u, s) at each sample given all of them."""
        F, Q = self.interval(h)
        means, spreads = self.filtered(h, z)
        for k in range(len(z) - 2, -1, -1):
            x, P = F @ means[k], F @ spreads[k] @ F.T + Q
            G = np.linalg.solve(P, F @ spreads[k]).T
            means[k] = means[k] + G @ (means[k + 1] - x)
            spreads[k] = spreads[k] + G @ (spreads[k + 1] - P) @ G.T
        return means, spreads
