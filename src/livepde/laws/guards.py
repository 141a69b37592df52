"""Safeguards of a filter against steps beyond its linearisation and runaway estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.errors import LawError
from livepde.linalg import Array, Mask

__all__ = ["Guards", "Scale"]


@dataclass(frozen=True)
class Guards:
    """What `SensitivityLaw` does when its own assumptions fail; inert as long as they hold.

    *Overconfident linearisation.* A sample that moves an unknown by more than `reach` prior
    deviations, and beyond half a standard deviation of what it leaves, is assimilated by
    Gauss-Newton steps over its interval, each at most one prior deviation long, until reference
    and estimate agree within that half (a law with a `Replay` does so anyway). Where they do not
    converge the sample counts with ten times its noise, and so on; after `temperings` of that it
    is not used. Notes: "iterated", "tempered", "held".

    *Runaway.* A step that fails, or a prediction that misses the data by more than `runaway` times
    all that any sensor has ever varied (each in units of its noise): the law goes back to before
    the last samples, adds one prior deviation to what is uncertain there, and carries the state on
    without those samples; if that fails as well, with the prior. Note: "restarted". If nothing
    helps a failed step is reported as such and changes nothing; "runaway" notes a prediction that
    stays away.

    Parameters
    ----------
    reach
        Prior deviations that a sample moves an unknown at most, unless iterated.
    iterations
        At most this many Gauss-Newton steps for a sample.
    temperings
        How often a sample whose steps do not converge is taken again with ten times its noise.
    runaway
        How many times the largest range of the sensors a prediction misses one at least.
    past
        A restart goes back by this many samples at least, if there are so many, and by less than
        twice as many.
    """

    reach: float = 1.0
    iterations: int = 10
    temperings: int = 2
    runaway: float = 10.0
    past: int = 32

    def __post_init__(self) -> None:
        for name in ("reach", "runaway"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise LawError(f"Guards: {name} must be a positive number; got {value}.")
        for name, least in (("iterations", 1), ("temperings", 0), ("past", 1)):
            value = getattr(self, name)
            if value < least:
                raise LawError(f"Guards: {name} must be at least {least}; got {value}.")

    def within_reach(self, change: Array) -> Mask:
        """Return which members a sample moves by so little, in prior deviations (members, k)."""
        near: Mask = np.abs(change).max(axis=1, initial=0.0) <= self.reach
        return near


@dataclass(frozen=True, eq=False)
class Scale:
    """How far the values of each sensor have been apart, and its first innovation.

    Attributes
    ----------
    low, high, first
        Least and largest value, and size of the first innovation, shapes (members, sensors); NaN
        before.
    """

    low: Array
    high: Array
    first: Array

    @classmethod
    def start(cls, sensors: int, members: int = 1) -> Scale:
        """Return the value before any sample."""
        never = np.full((members, sensors), np.nan)
        return cls(never, never, never)

    def add(self, z: Array, d: Array) -> Scale:
        """Return the value after a sample z with innovations d, NaN where missing."""
        first = np.where(np.isnan(self.first), np.abs(d), self.first)
        return Scale(np.fmin(self.low, z), np.fmax(self.high, z), first)

    def beyond(self, d: Array, noise: Array) -> Array:
        """Return the largest innovation as a multiple of what was there before, or of the noise.

        Counted in the noise of each sensor, against the sensor that has varied most: one that a
        wave has not reached yet knows nothing of its size. Shape (members,).
        """
        ranges = np.fmax(np.fmax(self.high - self.low, self.first), noise) / noise
        unseen = np.isnan(self.first) | np.isnan(self.low)
        missed = np.fmax.reduce(np.where(unseen, np.nan, np.abs(d) / noise), axis=1)
        largest = np.where(unseen, 0.0, ranges).max(axis=1)
        return np.where(np.isnan(missed), 0.0, missed / np.where(largest > 0.0, largest, np.inf))
