"""Damping rules: how strongly the estimate is pulled to the observed state.

The paper writes mu R M (r / ||r||_V~). At r = 0 that is 0/0, so a rule returns
theta = mu / ||r||_V~, which multiplies R M r. A rule may use only quantities known online.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from livepde.errors import LawError


class Residual:
    """Squared norms of the observed residual r = R u - u_alpha, and of u_alpha to compare it with.

    Parameters
    ----------
    X, VX
        ||r||_X^2 and ||r||_VX~^2 = (M_op r, r).
    V
        Function that returns ||r||_V~^2, the squared dual norm of M_op r.
    observed
        Function that returns the squared norms of u_alpha; None: nothing is observed.
    """

    def __init__(
        self,
        X: float,
        VX: float,
        V: Callable[[], float],
        observed: Callable[[], Residual] | None = None,
    ) -> None:
        self.X = X
        self.VX = VX
        self._V = V
        self._observed = observed

    @cached_property
    def V(self) -> float:
        """||r||_V~^2."""
        return self._V()

    @cached_property
    def observed(self) -> Residual:
        """Squared norms of u_alpha: the size of the state, to which floors are relative."""
        return Residual(0.0, 0.0, lambda: 0.0) if self._observed is None else self._observed()

    def replaced(self, X: float, VX: float, V: Callable[[], float]) -> Residual:
        """Return other norms of r, with the same norms of u_alpha."""
        return Residual(X, VX, V, lambda: self.observed)


class Damping(ABC):
    """A rule for theta = mu / ||r||_V~."""

    @abstractmethod
    def theta(self, r: Residual) -> float:
        """Return theta >= 0, in 1/time."""

    def most(self, observed: Residual) -> float:
        """Return a bound of theta for all r, from the norms of u_alpha; infinity without one."""
        return math.inf

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        """Return the derivatives of theta in r.X, r.VX and r.V, for the Newton iteration.

        By difference quotients, good enough for any rule: they change the number of iterations,
        not the result.
        """
        reads: list[bool] = []

        def norm() -> float:
            reads.append(True)
            return r.V

        theta = self.theta(r.replaced(r.X, r.VX, norm))
        step = 1.0 + 1e-6
        dX = dVX = dV = 0.0
        if r.X > 0:
            dX = self.theta(r.replaced(step * r.X, r.VX, lambda: r.V)) - theta
        if r.VX > 0:
            dVX = self.theta(r.replaced(r.X, step * r.VX, lambda: r.V)) - theta
        # ||r||_V~ costs a solve, so it is varied only if the rule has read it.
        if reads and r.V > 0:
            dV = (self.theta(r.replaced(r.X, r.VX, lambda: step * r.V)) - theta) / (1e-6 * r.V)
        return dX / (1e-6 * r.X or 1.0), dVX / (1e-6 * r.VX or 1.0), dV


@dataclass(frozen=True)
class ResidualDamping(Damping):
    """The lower bound on mu with c_1 (Assumption cond:mu02).

    mu = c_1 ||r||_X^2 ||r||_V~ / ||r||_VX~^2, hence
    theta = c_1 ||r||_X^2 / ||r||_VX~^2 is smooth and bounded by c_1. The other part of the bound
    needs the unknown ||p||_V^ and does not enter.
    """

    c1: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.c1) and self.c1 >= 0):
            raise LawError(f"ResidualDamping: c1 must be a number >= 0; got {self.c1}.")

    def theta(self, r: Residual) -> float:
        return self.c1 * r.X / r.VX if r.VX > 0.0 else self.c1

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        if r.VX <= 0.0:
            return 0.0, 0.0, 0.0
        return self.c1 / r.VX, -self.c1 * r.X / r.VX**2, 0.0


@dataclass(frozen=True)
class ConstantDamping(Damping):
    """A constant mu, as in the paper's noisy experiments.

    theta = mu / sqrt(||r||_V~^2 + (floor ||u_alpha||_V~)^2): for a residual that is smaller than
    `floor` times the state the pull is linear instead of 0/0. Where u_alpha = 0, theta is
    mu / ||r||_V~, and 0 at r = 0.

    Parameters
    ----------
    mu
        In the unit of ||u||_V~ per time.
    floor
        A share of ||u_alpha||_V~, so without unit: the run is the same in every unit of u.
    """

    mu: float = 1.0
    floor: float = 1e-3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mu) and self.mu >= 0 and self.floor > 0):
            raise LawError("ConstantDamping: needs mu >= 0 and floor > 0.")

    def theta(self, r: Residual) -> float:
        size = math.sqrt(r.V + self.floor**2 * r.observed.V)
        return self.mu / size if size > 0.0 else 0.0

    def most(self, observed: Residual) -> float:
        least = self.floor * math.sqrt(observed.V)
        return self.mu / least if least > 0.0 else math.inf

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        squared = r.V + self.floor**2 * r.observed.V
        return 0.0, 0.0, -0.5 * self.mu * squared**-1.5 if squared > 0.0 else 0.0
