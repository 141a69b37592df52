"""When a factor that outlives its matrix has cost as much as a new one."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Costs"]


@dataclass
class Costs:
    """The rule of when a kept factor is made again.

    Iterations beyond those with a new factor take time. Once it adds up to that of the
    factorisation, a new one is due: all in all that costs at most twice as much as if one had known
    what would come.

    Attributes
    ----------
    factor
        Measured seconds of the factorisation.
    least
        Fewest iterations of a solve so far; at first, what it takes with a new factor, or more.
    extra
        Seconds of what iterations there were beyond `least`.

    >>> costs = Costs(factor=1.0, least=1)
    >>> for _ in range(3):
    ...     costs.add(iterations=5, seconds=0.5)
    >>> round(costs.extra, 3), costs.due
    (1.2, True)
    """

    factor: float
    least: int
    extra: float = 0.0

    @property
    def due(self) -> bool:
        """True if keeping the factor has cost more than a new one."""
        return self.extra > self.factor

    def add(self, iterations: int, seconds: float) -> None:
        """Account for a solve."""
        if iterations:
            self.least = min(self.least, iterations)
            self.extra += seconds * (1.0 - self.least / iterations)
