"""What weighs the terms of a coupled stage: the gains of the law, or what it has learned."""

from __future__ import annotations

from dataclasses import dataclass

import scipy.sparse as sp

from livepde.laws.damping import Damping
from livepde.linalg import Array

__all__ = ["PULL", "Gains", "Metric"]

PULL = 10.0  # theta h where the law tunes itself: r forgets within a step


@dataclass(frozen=True, eq=False)
class Gains:
    """The gains of the method and the operators they multiply.

    Attributes
    ----------
    gain
        Scale of the inner product of Q.
    damping
        Rule for theta.
    nu, sigma
        Weights of P N P u and of the stabilising term sigma q.
    M_op, N_op
        Matrices of M and N of (MN1), (MN2), shape (n, n).
    at_estimate
        Evaluate B and A at w = u^ (Kügler 2010) instead of w = u_alpha + P u^.
    """

    gain: float
    damping: Damping
    nu: float
    sigma: float
    M_op: sp.csr_array
    N_op: sp.csr_array
    at_estimate: bool = False


@dataclass(frozen=True, eq=False)
class Metric:
    """What stands in the place of G_Q/gain where the law tunes itself (`livepde.laws.memory`).

    The second line of the stage becomes

        (spread G_Q + J) (q - c_q)/PULL + h shift/PULL - A(w)^T r = 0,    theta = PULL/h.

    Attributes
    ----------
    spread
        S, the spectral density of the equation error.
    information
        J, shape (m, m), and its data in the pattern given to the stage.
    shift
        The pull of a prior that has become heavier or lighter, per unit of time, shape (m,).
    """

    spread: float
    information: sp.csr_array
    data: Array
    shift: Array
