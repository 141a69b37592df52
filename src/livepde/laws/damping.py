"""Damping rules: how strongly the estimate is pulled to the observed state.

The paper writes mu R M (r / ||r||_V~). At r = 0 that is 0/0, so a rule returns
theta = mu / ||r||_V~, which multiplies R M r. A rule may use only what is known online.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from livepde.errors import LawError

__all__ = ["ConstantDamping", "Damping", "Residual", "ResidualDamping"]


class Residual:
    """Squared norms of the observed residual r = R u - u_alpha, each computed when asked for.

    Parameters
    ----------
    X, VX
        ||r||_X^2 and ||r||_VX~^2 = (M_op r, r).
    V
        Function that returns ||r||_V~^2, discretised as the X-norm of the operator M_op r.
    """

    def __init__(self, X: float, VX: float, V: Callable[[], float]) -> None:
        self.X = X
        self.VX = VX
        self._V = V

    @property
    def V(self) -> float:
        """||r||_V~^2."""
        return self._V()


class Damping(ABC):
    """A rule for theta = mu / ||r||_V~."""

    @abstractmethod
    def theta(self, r: Residual) -> float:
        """Return theta >= 0, in 1/time."""

    def slopes(self, r: Residual) -> tuple[float, float, float]:
        """Return the derivatives of theta in r.X, r.VX and r.V, for the Newton iteration.

        By difference quotients, good enough for any rule: they change the number of iterations,
        not the result.
        """
        reads: list[bool] = []

        def norm() -> float:
            reads.append(True)
            return r.V

        theta = self.theta(Residual(r.X, r.VX, norm))
        step = 1.0 + 1e-6
        dX = (self.theta(Residual(step * r.X, r.VX, lambda: r.V)) - theta) if r.X > 0 else 0.0
        dVX = (self.theta(Residual(r.X, step * r.VX, lambda: r.V)) - theta) if r.VX > 0 else 0.0
        dV = 0.0
        if reads and r.V > 0:
            dV = (self.theta(Residual(r.X, r.VX, lambda: step * r.V)) - theta) / (1e-6 * r.V)
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

    theta = mu / sqrt(||r||_V~^2 + floor^2): below `floor` the pull is linear instead of 0/0.
    """

    mu: float = 1.0
    floor: float = 1e-3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mu) and self.mu >= 0 and self.floor > 0):
            raise LawError("ConstantDamping: needs mu >= 0 and floor > 0.")

    def theta(self, r: Residual) -> float:
        return float(self.mu / np.sqrt(r.V + self.floor**2))
