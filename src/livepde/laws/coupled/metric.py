"""The metric of the parameter in one stage: how the second line weighs a change of q."""

from __future__ import annotations

from dataclasses import dataclass

from livepde.linalg import Array


@dataclass(frozen=True, eq=False)
class Metric:
    """Weights of the second line of a stage, an equation of dual vectors of Q.

        weight G_Q (q_t + sigma q - K (q - prior)) + J (q - c_q) = A(w)^T r + load

    with q_t = (q - c_q)/h, the Gram matrix G_Q, and the generator K of unknowns that move by
    themselves. With J = 0 and without load it is (noisy_q), and with sigma = 0 (est_exact_q), for
    weight = 1/gain.
    """

    weight: float  # 1/gain, >= 0
    sigma: float = 0.0  # stabilising term of (noisy_q), >= 0
    # Terms of the right-hand side besides A(w)^T r, shape (m,); None: zero.
    load: Array | None = None
    # Data of J, in the pattern that the stage was made with; None: zero.
    information: Array | None = None
    # Weight of R^T M_op r in the stage, where the metric sets it; None: by the damping rule.
    theta: float | None = None

    def scale(self, h: float) -> float:
        """Return the weight of G_Q q in a stage with step h."""
        return self.weight * (1.0 / h + self.sigma)
