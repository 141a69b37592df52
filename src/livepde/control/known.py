"""What an estimator hands to a controller."""

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
    """State and unknown numbers of a reduced model at one time.

    Attributes
    ----------
    x, q
        Coordinates of the state, shape (r,), and unknown numbers, shape (m,).
    factor
        Square root of the covariance of q, shape (m, k); no columns: q counts as known.
    offset
        What is added to each channel by something that nobody measures, shape (channels,); None:
        nothing. It acts on the state.
    model
        The reduced model about the estimate, where it depends on where it is taken: unknown fields,
        models that are not affine in u. None: that of the controller. Its basis is that of the
        controller's; a controller takes its own outputs.
    source, why
        "estimate", or "fallback" and why the estimate is not trusted.
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
        """Return q, and q +- kappa deviations along the leading directions, shape (k, m).

        Parameters
        ----------
        kappa
            Number of deviations.
        most
            Directions at most.
        """
        axes, sizes, _ = np.linalg.svd(self.factor, full_matrices=False)
        shifts = kappa * (axes * sizes).T[:most]
        return np.vstack([self.q[None], self.q + shifts, self.q - shifts])
