"""Time schemes as sequences of implicit Euler stages.

A *stage* solves M (y - c)/h + R(t, y) = 0 for y; every scheme here is a recipe of such stages, so a
law writes its implicit equations once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from livepde.linalg import Array

__all__ = ["Alexander2", "ImplicitEuler", "Scheme", "Stage"]

Stage: TypeAlias = Callable[[Array, float, float], Array]
"""(c, t, h) -> y with M (y - c)/h + R(t, y) = 0."""


@dataclass(frozen=True)
class Scheme(ABC):
    """A one-step method built of implicit stages."""

    order: ClassVar[int]

    @abstractmethod
    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        """Return the solution at t + h from y at t."""


@dataclass(frozen=True)
class ImplicitEuler(Scheme):
    """The paper's scheme: one stage, first order, L-stable."""

    order: ClassVar[int] = 1

    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        return stage(y, t + h, h)


@dataclass(frozen=True)
class Alexander2(Scheme):
    """Alexander's two-stage SDIRK: second order, L-stable, stiffly accurate (1977).

    Both stages have the same matrix; gamma = 1 - 1/sqrt(2).
    """

    order: ClassVar[int] = 2
    gamma: ClassVar[float] = 1.0 - np.sqrt(0.5)

    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        g = self.gamma
        first = stage(y, t + g * h, g * h)
        # The second stage begins at y + (1 - gamma) h k_1, where h k_1 = (first - y)/gamma.
        return stage(y + (1 - g) / g * (first - y), t + h, g * h)
