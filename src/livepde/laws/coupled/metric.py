"""The metric of the parameter in one stage: the operator on q in the second line."""

from __future__ import annotations

from dataclasses import dataclass

from livepde.linalg import Array

__all__ = ["Metric"]


@dataclass(frozen=True, eq=False)
class Metric:
    """The second line of a stage, H (q - c_q) = load + A(w)^T r, a dual vector of Q.

        H = scale G_Q - drift G_Q K + J

    with the Gram matrix G_Q and the generator K of unknowns that move by themselves.

    Attributes
    ----------
    scale
        Weight of G_Q, > 0: 1/(gain h) + sigma/gain for a constant gain.
    drift
        Weight of G_Q K, 1/gain.
    load
        Terms of the right-hand side that do not depend on q, shape (m,).
    information
        Data of J, in the pattern that the stage was made with; None: zero.
    theta
        Weight of R^T M_op r in the stage, where the metric sets it; None: by the damping rule.
    """

    scale: float
    drift: float
    load: Array
    information: Array | None = None
    theta: float | None = None
