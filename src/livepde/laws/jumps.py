"""Has the process changed? A test on the innovations, with a stated rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from livepde.errors import LawError
from livepde.laws.consistency import Consistency
from livepde.linalg import Array, IntArray

__all__ = ["Jumps", "Watch"]


@dataclass(frozen=True, eq=False)
class Watch:
    """Innovations of the last samples.

    Attributes
    ----------
    squares, counts
        Sum of e^2 and number of innovations e of each of the last samples, newest first.
    seen
        Samples since the start or the last alarm.
    """

    squares: Array
    counts: Array
    seen: int

    def add(self, e: Array) -> Watch:
        """Return the value after a sample of normalised innovations, NaN where missing."""
        seen = np.isfinite(e)
        squares = np.concatenate([[float((e[seen] ** 2).sum())], self.squares[:-1]])
        counts = np.concatenate([[float(seen.sum())], self.counts[:-1]])
        return Watch(squares, counts, self.seen + 1)


@dataclass(frozen=True)
class Jumps:
    """Watch for sudden changes of the unknowns, and let them move when there is one.

    The innovations of the last 1, 2, 4, ... samples, normalised by what is expected of them and by
    their usual size and correlation, are compared with the chi-square distribution. After an alarm
    the law goes back to where the innovations most likely became too large, adds `size` prior
    deviations to the uncertainty of every unknown there, and takes the samples since again: so it
    learns anew without a restart, and what was known of the state before the jump is kept.

    Parameters
    ----------
    probability
        Of a false alarm, in each sample.
    window
        Longest number of samples, a power of two.
    size
        What an alarm adds, in prior deviations.
    settle
        So many samples after the start, and after an alarm, are not looked at.
    """

    probability: float = 1e-5
    window: int = 32
    size: float = 1.0
    settle: int = 50

    def __post_init__(self) -> None:
        if not 0 < self.probability < 1:
            raise LawError(f"Jumps: probability must lie between 0 and 1; got {self.probability}.")
        if self.window < 1 or self.window & (self.window - 1):
            raise LawError(f"Jumps: window must be a power of two; got {self.window}.")
        if not (np.isfinite(self.size) and self.size > 0):
            raise LawError(f"Jumps: size must be a positive number; got {self.size}.")
        if self.settle < 0:
            raise LawError(f"Jumps: settle must be at least 0; got {self.settle}.")

    @cached_property
    def _lengths(self) -> IntArray:
        """Numbers of samples that are looked at, less one."""
        return 2 ** np.arange(int(np.log2(self.window)) + 1) - 1

    def start(self) -> Watch:
        """Return the value before any innovation."""
        return Watch(np.zeros(self.window), np.zeros(self.window), 0)

    def add(self, watch: Watch, e: Array, usual: Consistency) -> tuple[Watch, bool]:
        """Return the value after a sample, and whether there is an alarm.

        Parameters
        ----------
        e
            Normalised innovations, shape (sensors,), NaN where missing.
        usual
            Their statistics before this sample.
        """
        if watch.seen < self.settle:  # the first linearisations are poor: what they miss is no jump
            return replace(watch, seen=watch.seen + 1), False
        new = watch.add(e)
        if not new.counts[0]:
            return new, False
        lengths = self._lengths
        sums, freedom = np.cumsum(new.squares)[lengths], np.cumsum(new.counts)[lengths]
        chance = scipy.special.gammaincc(0.5 * freedom, 0.5 * sums / usual.scatter**2)
        if float(chance.min()) * len(lengths) >= self.probability:
            return new, False
        return self.start(), True

    def onset(self, watch: Watch, e: Array, usual: Consistency) -> int:
        """Return of how many samples, up to this one, the innovations are most likely too large.

        The number n that maximises the likelihood ratio n (r - 1 - log r)/2 of innovations of mean
        square r > 1 since n samples against 1. Parameters as for `add`.
        """
        new = watch.add(e)
        freedom = np.cumsum(new.counts)
        ratio = np.cumsum(new.squares) / usual.scatter**2 / np.maximum(freedom, 1.0)
        ratio = np.maximum(ratio, 1.0)
        return 1 + int(np.argmax(freedom * (ratio - 1.0 - np.log(ratio))))
