"""The ways to solve a coupled stage have this in common: whole, by blocks, or on many ranks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from livepde.fem import Moment
from livepde.laws.equation import Equation
from livepde.laws.gains import Metric
from livepde.laws.warm import Kept, Misses
from livepde.linalg import Array, Factor
from livepde.stepping import Newton

if TYPE_CHECKING:
    from livepde.laws.coupled import CoupledStage

__all__ = ["Way"]


class Way(ABC):
    """How the equations of a stage are evaluated and solved.

    Attributes
    ----------
    iterations
        How many each linear system of this stage took; empty where none is iterated.
    rough
        True if a kept factor is that of an approximate Jacobian.
    equations, kind
        What evaluates the equation of a stage, and what compares misses.
    """

    rough = False
    equations: type[Equation]
    kind: type[Misses] = Misses

    def __init__(self, stage: CoupledStage) -> None:
        self.stage = stage
        self.iterations: list[int] = []
        self._last: tuple[Array, Factor] | None = None

    @property
    @abstractmethod
    def keeps(self) -> bool:
        """True if a factor is kept from stage to stage."""

    @property
    @abstractmethod
    def patience(self) -> int:
        """Updates and iterations, beyond one update for each stage, that renew a factor."""

    def equation(
        self, c: Array, h: float, moment: Moment, u_alpha: Array, metric: Metric | None = None
    ) -> Equation:
        """Return the equation of a stage; arguments as for `CoupledStage.solve`."""
        return self.equations(self, c, h, moment, u_alpha, metric)

    def newton(self, tunes: bool) -> Newton:
        """Return the nonlinear iteration, of a law that tunes itself or not."""
        return self.stage.newton

    def begin(self, kept: Kept, moment: Moment) -> None:
        """Begin a stage, with what the one before has kept."""
        self.iterations = []

    def factor(self, kept: Kept, moment: Moment) -> Factor:
        """Return the factor that is kept, made again if the last one is another."""
        if self._last is None or self._last[0] is not kept.y:
            equation = self.equation(np.zeros_like(kept.y), kept.h, moment, kept.u_alpha)
            equation.residual(kept.y)
            self._last = (kept.y, equation.factor(kept.y, False))
        return self._last[1]

    def fresh(self, equation: Equation, y: Array) -> Factor | None:
        """Return a factor of a good start y, where none is kept; None: Newton makes its own."""
        return None

    def made_at(self, equation: Equation) -> Array | None:
        """Return where a factor was made in this stage, to be kept; None: none was."""
        if equation.made is None:
            return None
        self._last = equation.made
        return equation.made[0]

    def wear(self, age: int) -> float:
        """Return how much more a factor of an age leaves of an error than a new one."""
        return float(age)

    def trusted(self, seen: float, missed: float) -> float:
        """Return how large a first update may be for the rate of the factor to be believed.

        Parameters
        ----------
        seen
            The first update when the rate was seen.
        missed
            The last one.
        """
        return min(seen, missed)
