"""What is affine in the reduced state and the channels: one step, and what is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

from livepde.linalg import Array

__all__ = ["Discrete", "Output"]


@dataclass(frozen=True, eq=False)
class Output:
    """What is seen of the reduced state: y = C x + D c + d for the channels c.

    Attributes
    ----------
    names
        Of the outputs.
    C, D, d
        Shapes (outputs, r), (outputs, channels) and (outputs,).
    noise
        Standard deviation of each as a measurement, shape (outputs,); None if it is not known.
    """

    names: tuple[str, ...]
    C: Array
    D: Array
    d: Array
    noise: Array | None = None

    def __call__(self, x: Array, c: Array) -> Array:
        """Return the outputs, shape (outputs,)."""
        y: Array = self.C @ x + self.D @ c + self.d
        return y


@dataclass(frozen=True, eq=False)
class Discrete:
    """One step x+ = A x + B c + f, with the channels c held in between."""

    A: Array
    B: Array
    f: Array

    def with_offset(self, offset: Array | None) -> Discrete:
        """Return the step with something added to the channels, shape (channels,)."""
        return self if offset is None else replace(self, f=self.f + self.B @ offset)

    def __call__(self, x: Array, c: Array) -> Array:
        """Return the state at the end of the step."""
        after: Array = self.A @ x + self.B @ c + self.f
        return after
