"""Has the process changed? A test on the innovations, with a stated rate of false alarms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from livepde.errors import LawError
from livepde.laws.innovations import Innovations
from livepde.linalg import Array, IntArray, Mask

__all__ = ["Jumps", "Watch"]


@dataclass(frozen=True, eq=False)
class Watch:
    """Innovations of the last samples of each member.

    Attributes
    ----------
    squares, counts
        Sum of e^2 and number of innovations e of each of the last samples, newest first, shapes
        (members, samples).
    seen
        Samples since the start or the last alarm, shape (members,).
    """

    squares: Array
    counts: Array
    seen: IntArray

    def add(self, e: Array) -> Watch:
        """Return the value after normalised innovations (members, sensors), NaN where missing."""
        seen = np.isfinite(e)
        square = (np.where(seen, e, 0.0) ** 2).sum(axis=1)
        squares = np.concatenate([square[:, None], self.squares[:, :-1]], axis=1)
        count = seen.sum(axis=1).astype(float)
        counts = np.concatenate([count[:, None], self.counts[:, :-1]], axis=1)
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

    def start(self, members: int = 1) -> Watch:
        """Return the value before any innovation."""
        zero = np.zeros((members, self.window))
        return Watch(zero, zero, np.zeros(members, dtype=np.int64))

    def add(self, watch: Watch, e: Array, usual: Innovations) -> tuple[Watch, Mask]:
        """Return the value after a sample, and for which members there is an alarm.

        Parameters
        ----------
        e
            Normalised innovations, shape (members, sensors), NaN where missing.
        usual
            Their statistics before this sample.
        """
        early = watch.seen < self.settle  # the first linearisations are poor: what they miss
        new = watch.add(e)  # is no jump
        if early.any():
            kept = early[:, None]
            squares = np.where(kept, watch.squares, new.squares)
            counts = np.where(kept, watch.counts, new.counts)
            new = Watch(squares, counts, new.seen)
            if early.all():
                return new, np.zeros(len(e), dtype=bool)
        lengths = self._lengths
        sums = np.cumsum(new.squares, axis=1)[:, lengths]
        freedom = np.cumsum(new.counts, axis=1)[:, lengths]
        scatter = usual.scatter[:, None]
        with np.errstate(invalid="ignore"):  # no freedom, no chance
            chance = scipy.special.gammaincc(0.5 * freedom, 0.5 * sums / scatter**2)
        chance = np.where(freedom > 0.0, chance, 1.0).min(axis=1)
        unlikely = chance * len(lengths) < self.probability
        alarm: Mask = ~early & (new.counts[:, 0] > 0.0) & unlikely
        if alarm.any():
            again, clear = self.start(len(e)), alarm[:, None]
            new = Watch(
                np.where(clear, again.squares, new.squares),
                np.where(clear, again.counts, new.counts),
                np.where(alarm, again.seen, new.seen),
            )
        return new, alarm

    def onset(self, watch: Watch, e: Array, usual: Innovations) -> int:
        """Return of how many samples, up to this one, innovations are most likely too large.

        The number n that maximises the likelihood ratio n (r - 1 - log r)/2 of innovations of mean
        square r > 1 since n samples against 1. Parameters as for `add`, of one member.
        """
        new = watch.add(e)
        freedom = np.cumsum(new.counts[0])
        ratio = np.cumsum(new.squares[0]) / usual.scatter[0] ** 2 / np.maximum(freedom, 1.0)
        ratio = np.maximum(ratio, 1.0)
        return 1 + int(np.argmax(freedom * (ratio - 1.0 - np.log(ratio))))
