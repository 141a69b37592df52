"""Affine maps of reduced state and channels: output equation and discrete time step."""

from __future__ import annotations

from dataclasses import dataclass, replace

from livepde.linalg import Array

__all__ = ["Discrete", "Output"]


@dataclass(frozen=True, eq=False)
class Output:
    """Output equation of a reduced model: y = C x + D c + d for the channels c.

    Attributes
    ----------
    names
        Names of the outputs.
    C, D, d
        Shapes (outputs, r), (outputs, channels) and (outputs,).
    noise
        Measurement noise of each output as a standard deviation, shape (outputs,); None if unknown.
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
    """Discrete-time model x+ = A x + B c + f with a zero-order hold of the channels c."""

    A: Array
    B: Array
    f: Array

    def with_offset(self, offset: Array | None) -> Discrete:
        """Return the model with a constant added to the channels, shape (channels,)."""
        return self if offset is None else replace(self, f=self.f + self.B @ offset)

    def __call__(self, x: Array, c: Array) -> Array:
        """Return the state at the end of the step."""
        after: Array = self.A @ x + self.B @ c + self.f
        return after
