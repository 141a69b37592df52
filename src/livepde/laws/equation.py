"""The nonlinear equation of one coupled stage: its residual, term by term."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from livepde.fem import Moment
from livepde.laws.gains import PULL, Metric
from livepde.linalg import Array, Factor

if TYPE_CHECKING:
    from livepde.laws.way import Way

__all__ = ["Equation"]


class Equation(ABC):
    """Residual and Jacobian of one stage; the equations are those of `CoupledStage`.

    `residual` leaves behind what the Jacobian and the damping rule need: r, w, A(w), and the dual
    vectors Mr = R^T M_op r and mass_r = R^T M r.

    Parameters
    ----------
    way
        How the stage is solved.
    c, h, moment, u_alpha, metric
        As for `CoupledStage.solve`.

    Attributes
    ----------
    made
        The last factor that may be kept, and the point where it was made.
    """

    def __init__(
        self,
        way: Way,
        c: Array,
        h: float,
        moment: Moment,
        u_alpha: Array,
        metric: Metric | None = None,
    ) -> None:
        self.way = way
        self.stage = way.stage
        self.c = c
        self.h = h
        self.moment = moment
        self.u_alpha = u_alpha
        self.metric = metric
        self.source = way.stage.model.F(moment)
        self.made: tuple[Array, Factor] | None = None

    def residual(self, y: Array) -> Array:
        """Return the residual at y = (u, q)."""
        stage, model, n, g = self.stage, self.stage.model, self.stage.n, self.stage.gains
        u, q = y[:n], y[n:]
        self.r = r = stage.split.project(u) - self.u_alpha
        self.w = w = u if g.at_estimate else u - r  # u_alpha + P u, since P = I - R
        self.Mr, self.mass_r = stage.RM @ r, stage.split.project_transposed(model.mass @ r)
        self.A = A = model.form_A.matrix("v", "q", self.moment, u=w, q=q)
        C = A @ q if stage.linear else model.form_A.vector("v", self.moment, u=w, q=q)
        flux = model.B(w, self.moment) + C + (g.nu and g.nu * (stage.PNP @ u)) - self.source
        rate = (u - self.c[:n]) / self.h
        drive = (q - self.c[n:]) / (g.gain * self.h) + (g.sigma / g.gain) * q
        if model.latent.generator.nnz:
            drive -= model.latent.generator @ (q - model.latent.prior) / g.gain
        out = np.empty_like(y)
        out[:n] = (model.mass @ rate + flux) * model.X.free + self.pull()
        out[n:] = (model.Q.dual(drive) - A.T @ r + self.learned(y)) * stage.free_q
        return out

    def learned(self, y: Array) -> Array | float:
        """Return what the metric adds to the second line; 0 without one."""
        metric = self.metric
        if metric is None:
            return 0.0
        change = y[self.stage.n :] - self.c[self.stage.n :]
        force = metric.spread * self.stage.model.Q.dual(change) + metric.information @ change
        learned: Array = (force + self.h * metric.shift) / PULL
        return learned

    def pull(self) -> Array:
        """Return theta R^T M_op r."""
        if self.metric is not None:
            self.theta = PULL / self.h
            return self.theta * self.Mr
        self.norms = self.stage.norms(self.r, self.Mr, self.mass_r)
        self.theta = self.stage.gains.damping.theta(self.norms)
        return self.theta * self.Mr

    def slope(self, sweep: bool) -> Array | None:
        """Return the derivative of theta in u, shape (n,); None where it is held or zero."""
        if sweep or self.metric is not None:
            return None
        row = self.stage.slope(self.norms, self.Mr, self.mass_r)
        return row if row.any() else None

    @abstractmethod
    def factor(self, y: Array, sweep: bool) -> Factor:
        """Return the factorised Jacobian at the y of the last `residual`.

        A sweep holds the coupling A(w)^T r and theta. It does not hold A(w) q: with an unknown in
        the principal part that would be an explicit iteration, which diverges or goes astray.
        """
