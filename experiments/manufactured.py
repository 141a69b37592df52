"""Manufactured solutions, whose source makes a given state the exact discrete solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from livepde.fem import START, Moment
from livepde.linalg import Array
from livepde.model import Model


class Manufactured(Model):
    """Model with the discrete source F_k = M (U_k - U_{k-1})/h + B(U_k) + A(U_k) q*.

    U_k are the coefficients of u*(t_k). For q = q*, implicit Euler with step h has exactly U as its
    solution, even if the process is ill-posed: a process with D < 0 cannot be simulated, but it can
    be observed.

    Parameters
    ----------
    q_true, u_true
        Exact parameter and state, functions of x and of (x, t).
    h
        Time step of the estimator.
    forms
        Weak forms as in `Model`, without f.
    """

    def __init__(
        self, q_true: Any, u_true: Callable[[Any, float], Any], h: float, **forms: Any
    ) -> None:
        super().__init__(**forms)
        self.h = h
        self._u_true = u_true
        self._q = self.latent.inverse(self.parameter_space.interpolate(q_true))

    def exact(self, t: float) -> Array:
        """Return the coefficients of the exact state at a time."""
        return self.initial(lambda x: self._u_true(x, t), Moment(t))

    def F(self, moment: Moment = START) -> Array:
        """Return the discrete source in X*, shape (n,)."""
        u = self.exact(moment.t)
        rate = self.mass @ ((u - self.exact(moment.t - self.h)) / self.h)
        source: Array = rate + self.B(u, moment)
        return np.asarray(source + self.form_A.vector("v", moment, q=self._q, u=u))
