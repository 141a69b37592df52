"""Fields on a grid of x and t from .mat files, with noise on request: for the discovery cases."""

from pathlib import Path

import numpy as np
from scipy.io import loadmat


def field(folder: Path, file: str, noise: float = 0.0, seed: int = 0, share: float = 1.0):
    """Return times and columns u_0, u_1, ... in the order of x.

    Parameters
    ----------
    noise
        Standard deviation of the noise, as a share of that of u; on every sample.
    share
        Share of all points that are observed, chosen at random; the others are missing.
    """
    data = loadmat(folder / file)
    t = np.ravel(data["t"] if "t" in data else data["tt"])
    u = np.real(data["usol"] if "usol" in data else data["uu"])
    rng = np.random.default_rng(seed)
    u = u + noise * u.std() * rng.standard_normal(u.shape)
    u[rng.random(u.shape) >= share] = np.nan
    return t, {f"u_{k}": row for k, row in enumerate(u)}
