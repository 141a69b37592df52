"""Vectors of a stage that depend on inputs; if they are affine in them, they are assembled once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from livepde.fem import Inputs, Moment
from livepde.linalg import Array
from livepde.stepping.interval import Moments

# Magnitudes of the random inputs in the test for affinity: the threshold of a kink or saturation
# may be far from one.
SCALES = (1e-3, 1.0, 1e3, 1e6)
# Relative deviation from affinity that is attributed to rounding in the assembly.
ROUNDING = 1e-11
# Inputs at which responses are evaluated: large, so that subtracting the vector without inputs
# cancels no digits, and a power of two, so that the division is exact.
LARGE = 2.0**20


@dataclass(frozen=True, eq=False)
class DrivenVector:
    """A vector v(t, inputs), (n,), usually affine in the inputs and independent of time.

    If it is, it is assembled once, and its evaluation is a small matrix product. `timed` returns
    whether evaluations of the vector so far have used the time.
    """

    vector: Callable[[Moment], Array]
    channels: tuple[str, ...]
    timed: Callable[[], bool]

    def _at(self, t: float, inputs: Array) -> Array:
        named = dict(zip(self.channels, inputs.tolist(), strict=True))
        return self.vector(Moment(t, Inputs(named)))

    @cached_property
    def affine(self) -> bool:
        """Whether the vector is affine in the inputs, tested at several magnitudes."""
        if not self.channels:
            return True
        # The fixed seed makes the result reproducible between runs.
        rng = np.random.default_rng(2)
        for scale in SCALES:
            a, b = scale * rng.standard_normal((2, len(self.channels)))
            with np.errstate(all="ignore"):
                parts = [self._at(0.3, x) for x in (a, b, a + b, 0.0 * a)]
            defect = parts[0] + parts[1] - parts[2] - parts[3]
            size = max(np.abs(part).max(initial=0.0) for part in parts)
            if not np.abs(defect).max(initial=0.0) <= ROUNDING * size:
                return False
        return True

    @cached_property
    def responses(self) -> tuple[Array, Array] | None:
        """Vector without inputs, (1, n), and its derivative by each input, (channels, n).

        None if the vector depends on time or is not affine.
        """
        if not self.affine:
            return None
        base, changes = self.assembled()
        return None if self.timed() else (base[None], changes)

    def without_inputs(self) -> Array:
        return self._at(0.0, np.zeros(len(self.channels)))

    def assembled(self) -> tuple[Array, Array]:
        """Return vector without inputs, (n,), and derivative, (channels, n), assuming affinity."""
        base, units = self.without_inputs(), LARGE * np.eye(len(self.channels))
        changes = [(self._at(0.0, unit) - base) / LARGE for unit in units]
        return base, np.reshape(changes, (len(units), len(base)))

    @cached_property
    def zero(self) -> bool:
        return self.responses is not None and not any(part.any() for part in self.responses)

    @cached_property
    def constant(self) -> bool:
        """Whether the vector depends on neither time nor inputs."""
        return self.responses is not None and not self.responses[1].any()

    def __call__(self, at: Moments) -> Array:
        """Return the vector of each member, shape (members, n); (1, n) if equal for all."""
        if self.responses is not None:
            base, changes = self.responses
            return base if self.constant else base + at.inputs[:, : len(changes)].dot(changes)
        if len(at.inputs) == 1:
            return self.vector(at.member(0))[None]
        base = self._at(at.t, np.zeros(len(self.channels)))
        total = base[None]
        # Affine in the inputs but time-dependent: evaluate once per channel for all members.
        largest_inputs = np.abs(at.inputs[:, : len(self.channels)]).max(axis=0)
        for c, largest in enumerate(largest_inputs):
            if largest > 0.0:  # a difference at the magnitude of the inputs loses no digits
                unit = np.zeros(len(self.channels))
                unit[c] = largest
                total = total + (at.inputs[:, c] / largest)[:, None] * (self._at(at.t, unit) - base)
        return total
