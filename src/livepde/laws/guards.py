"""Safeguards of a filter against steps beyond its linearisation and runaway estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.errors import LawError
from livepde.linalg import Array, Mask


@dataclass(frozen=True)
class Guards:
    """Safeguards of `SensitivityLaw` against failure of its assumptions; inert while they hold.

    *Overconfident linearisation.* A sample that moves an unknown by more than `reach` prior
    standard deviations, and by more than half a posterior standard deviation, is assimilated by
    Gauss-Newton steps over its interval, each at most one prior standard deviation long, until
    reference and estimate agree within half a posterior standard deviation. Where the steps do not
    converge, the sample is taken again with ten times its noise, and so on; after `temperings` such
    attempts it is not used. Notes: "iterated", "tempered", "held".

    *Runaway.* A step fails, or a prediction misses the data by more than `runaway` times the
    largest range that any sensor has ever shown (each in units of its noise). The law then goes
    back to before the last samples, inflates the covariance there by one prior standard deviation,
    and propagates the state without those samples; if that fails as well, it starts again from the
    prior. Note: "restarted". If nothing helps, a failed step is reported as such and changes
    nothing; "runaway" notes a prediction that still misses the data.

    Parameters
    ----------
    reach
        Largest move of an unknown by one sample without iteration, in prior standard deviations.
    iterations
        At most this many Gauss-Newton steps for a sample.
    temperings
        How often a sample whose steps do not converge is taken again with ten times its noise.
    runaway
        Smallest innovation of a runaway, as a multiple of the largest range of the sensors.
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
        """Return which members a sample moves by at most `reach`, shape (members,).

        `change` is that of the reduced unknowns, in prior standard deviations, (members, k).
        """
        near: Mask = np.abs(change).max(axis=1, initial=0.0) <= self.reach
        return near
