"""Stopping time T* for noisy data, (cond_d) and (Tast): with the truth, and online."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.constants import Spaces
from livepde.diagnostics.error_bounds import Errors
from livepde.errors import ConfigurationError
from livepde.laws.damping import Constants, Norms
from livepde.linalg import Array
from livepde.observation import Observed, Tikhonov

# Number of sensors up to which the error norms are computed exactly, sensor by sensor.
MOST_SENSORS = 2000
# Number of random vectors beyond that: the relative standard error is at most sqrt(2/(4 PROBES)) =
# 1/8.
PROBES = 32
# Number of sensors up to which the matrix of G_alpha is formed.
MOST_COLUMNS = 10_000


def stopping_time(errors: Sequence[Errors], c: Constants) -> float:
    """Return T*: the first sample time that violates (cond_d); infinity if none does.

    ||d||_V~ > c_M/(2 C_M) ||r||_VX~^2/||r||_X, with the true d and r of a `TwinTracker`.
    """
    for item in errors:
        if item.margin < 2.0 * c.C_M / c.c_M:
            return item.t
    return np.inf


def noise_size(
    spaces: Spaces,
    std: Array,
    reconstruction: Array | sp.csr_array | None = None,
    u_alpha: Array | None = None,
) -> Norms:
    """Return the root mean square of the data error d in X, VX~ and V~ from a noise level.

    d = G_alpha eta + (G_alpha G - R) u*: the propagated noise, and the regularisation error of the
    exact state. The second part is estimated by applying G_alpha G - R to u_alpha. Beyond 2000
    sensors the first is the mean over 32 fixed random vectors, with a relative standard error of at
    most 1/8, which decreases with the number of independent coefficients that contribute.

    Parameters
    ----------
    spaces
        Norms.
    std
        Standard deviation of each sensor, shape (sensors,); errors are independent.
    reconstruction
        Matrix of G_alpha, shape (n, sensors); default G^+. Raw nodal noise is about 1/h^2 times
        larger in V~ than in X, so without smoothing T* is reached immediately.
    u_alpha
        Reconstruction of the sample, shape (n,); None: omit the second part.
    """
    matrix = spaces.split.inverse if reconstruction is None else reconstruction
    if matrix.shape[1] != len(std):
        raise ConfigurationError(
            f"noise_size: {len(std)} standard deviations for {matrix.shape[1]} sensors."
        )
    std = np.asarray(std, dtype=float)
    if len(std) > MOST_SENSORS:
        signs = 2.0 * np.random.default_rng(0).integers(0, 2, (len(std), PROBES)) - 1.0
        factor = matrix @ (std[:, None] * signs) / np.sqrt(PROBES)
    else:
        factor = (matrix.toarray() if sp.issparse(matrix) else np.asarray(matrix)) * std
    if u_alpha is not None:
        lost = matrix @ (spaces.observed.G @ u_alpha) - u_alpha
        factor = np.column_stack([factor, lost])
    return spaces.observed_part.root_mean_square(factor)


def reconstruction_matrix(observed: Observed, alpha: float | None = None) -> Array:
    """Return the matrix of z -> u_alpha with all sensors present, shape (n, sensors).

    Parameters
    ----------
    observed
        Bound observation with its reconstruction rule.
    alpha
        Regularisation parameter if the rule has one; for the discrepancy principle that of the
        sample (`observed.reconstruct(z).alpha`), at which the map is linearised.
    """
    rule = observed.observation.reconstruction
    if not rule.regularises:
        inverse = observed.split().inverse
        if inverse.shape[1] > MOST_COLUMNS:
            raise ConfigurationError(
                f"reconstruction_matrix: {inverse.shape[1]} sensors, up to {MOST_COLUMNS} are "
                "possible; G^+ as a sparse matrix is observed.split().inverse."
            )
        matrix: Array = inverse.toarray()
        return matrix
    if alpha is not None and isinstance(rule, Tikhonov):
        rule = replace(rule, alpha=float(alpha))
    apply = rule.prepare(observed, np.ones(observed.size, dtype=bool))
    nothing = np.zeros(observed.X.dim)
    return np.column_stack([apply(unit, nothing).u for unit in np.eye(observed.size)])


@dataclass(frozen=True)
class StoppingState:
    """State of `OnlineStopping`.

    Attributes
    ----------
    t
        Time of the last sample.
    T
        Time of the first sample that violated the surrogate condition; infinity if none yet.
    margin
        Ratio of right to left side of (cond_d) at the last sample; below 1 it is violated.
    """

    t: float = -np.inf
    T: float = np.inf
    margin: float = np.inf


@dataclass(frozen=True)
class OnlineStopping:
    """Online surrogate of T* without truth.

    (cond_d) contains the unknown d and r. Here ||d||_V~ is replaced by its root mean square for the
    noise level (`noise_size`), and the true residual by the observed one minus the noise: r_alpha =
    r - d, so for noise that the estimate does not follow yet ||r||^2 = ||r_alpha||^2 - ||d||^2 in
    the mean, in X as in VX~.

    Parameters
    ----------
    constants
        Constants of the model; only C_M/c_M is used.

    Examples
    --------
    >>> stop = OnlineStopping(Constants(1.0, 1.0))
    >>> state = stop.add(stop.init(), 0.0, Norms(1.0, 3.0, 9.0), Norms(0.01, 0.1, 1.0))
    >>> stop.add(state, 1.0, Norms(0.1, 0.3, 0.9), Norms(0.01, 0.1, 1.0)).T
    1.0
    """

    constants: Constants

    def init(self) -> StoppingState:
        """Return the state before the first sample."""
        return StoppingState()

    def margin(self, r_alpha: Norms, d: Norms) -> float:
        """Return c_M/(2 C_M) ||r||_VX~^2/(||r||_X ||d||_V~), with estimated r."""
        VX = max(r_alpha.VX**2 - d.VX**2, 0.0)
        X = np.sqrt(max(r_alpha.X**2 - d.X**2, 0.0))
        if d.V == 0.0:
            return np.inf
        # ||r||_X = 0 means that r does not exceed the noise.
        if X == 0.0:
            return 0.0
        c = self.constants
        return float(c.c_M / (2.0 * c.C_M) * VX / (X * d.V))

    def add(self, state: StoppingState, t: float, r_alpha: Norms, d: Norms) -> StoppingState:
        """Take one sample's residual and noise size; return the new state."""
        margin = self.margin(r_alpha, d)
        T = t if margin < 1.0 and not np.isfinite(state.T) else state.T
        return replace(state, t=t, T=T, margin=margin)
