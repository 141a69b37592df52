"""The first guess of the noise, where nobody states it: from differences of samples."""

from __future__ import annotations

from math import comb

import numpy as np

from livepde.linalg import Array

__all__ = ["GUESSED", "PATIENCE", "first_guess"]

ORDERS = (1, 2, 3, 4, 5)  # of differences
MEDIAN = 0.6745  # of the absolute value of a normal variable of standard deviation 1
ROUNDING = 1e-12  # of the size of readings: no noise
SCATTER = 0.5  # of the logarithm of such a guess
GUESSED = 12  # samples from which the noise is guessed where nobody states it
PATIENCE = 48  # samples after which a sensor that shows nothing new is guessed by the others


def first_guess(z: Array) -> Array | None:
    """Return a first guess of the noise of each sensor, or None as long as there is none.

    Differences of order p of white noise of size 1 have the size sqrt(binomial(2 p, p)), while
    those of a smooth signal fade with the order: the order with the smallest result counts. Medians
    are taken, because signals change most at the start. The remainder of the signal makes the guess
    too large, which the law corrects.

    Parameters
    ----------
    z
        Samples, shape (samples, sensors), NaN where missing.
    """
    if len(z) <= GUESSED:
        return None
    guesses = []
    rounding = ROUNDING * np.nanmax(np.abs(z), axis=0, initial=0.0)
    for order in ORDERS:
        bends = np.abs(np.diff(z, order, axis=0))
        seen = np.isfinite(bends).sum(axis=0) >= GUESSED // 2
        bends = np.where(seen, bends, 0.0)
        size = np.nanmedian(bends, axis=0) / MEDIAN
        if len(z) >= PATIENCE:  # readings of a coarse resolution repeat most of the time
            size = np.where(size > rounding, size, np.sqrt(np.nanmean(bends**2, axis=0)))
        guesses.append(np.where(size > rounding, size / np.sqrt(comb(2 * order, order)), np.inf))
    # Orders are compared by the sensors for which each of them has a result.
    known = np.isfinite(guesses).all(axis=0)
    sizes = [float(np.log(guess[known]).sum()) for guess in guesses]
    noise: Array = guesses[int(np.argmin(sizes))].copy()
    good = np.isfinite(noise)
    if not good.any() or not (good.all() or len(z) >= PATIENCE):
        return None
    # Sensors that differ by chance alone are alike.
    logs, usual = np.log(noise[good]), float(np.median(np.log(noise[good])))
    # Logarithms shrink to their median by the share of their scatter that chance explains.
    chance = min(1.0, SCATTER**2 / max(float(((logs - usual) ** 2).mean()), SCATTER**2))
    noise[good] = np.exp(usual + (1.0 - chance) * (logs - usual))
    noise[~good] = np.exp(usual)
    return noise
