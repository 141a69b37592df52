"""Knowledge handed from an estimator to a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from livepde.control.reduced import ReducedModel
from livepde.linalg import Array

__all__ = ["Known", "Source"]

Source: TypeAlias = Literal["estimate", "fallback"]


@dataclass(frozen=True, eq=False)
class Known:
    """Estimated state and unknown numbers of a reduced model at one time.

    Attributes
    ----------
    x, q
        Coordinates of the state, shape (r,), and unknown numbers, shape (m,).
    factor
        Square root of the covariance of q, shape (m, k); without columns q counts as exact.
    offset
        Estimated unmeasured disturbance added to each channel, shape (channels,); None: zero. It
        acts on the state equation.
    model
        Reduced model relinearised at the estimate, for unknown fields and models that are not
        affine in u. None: the model of the controller. Its basis is that of the controller's model;
        a controller uses its own outputs.
    source, why
        "estimate", or "fallback" with the reason why the estimate is not trusted.
    """

    x: Array
    q: Array
    factor: Array
    source: Source = "estimate"
    why: str = ""
    offset: Array | None = None
    model: ReducedModel | None = None

    @property
    def std(self) -> Array:
        """Standard deviation of each unknown number, shape (m,)."""
        return np.asarray(np.linalg.norm(self.factor, axis=1))

    def scenarios(self, kappa: float, most: int) -> Array:
        """Return q, and q +- kappa standard deviations along principal directions, shape (k, m).

        Parameters
        ----------
        kappa
            Number of standard deviations.
        most
            Maximum number of directions.
        """
        axes, sizes, _ = np.linalg.svd(self.factor, full_matrices=False)
        shifts = kappa * (axes * sizes).T[:most]
        return np.vstack([self.q[None], self.q + shifts, self.q - shifts])
