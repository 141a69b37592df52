"""Trust in an estimate: tests that decide between the estimate and the nominal model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError
from livepde.result import Estimate

__all__ = ["Trust"]


@dataclass(frozen=True)
class Trust:
    """Conditions for using an estimate in control; otherwise the nominal model is used.

    *The rule*: while any of these tests fails, and until `patience` samples in a row have passed
    them, the controller gets state and unknown numbers from the nominal model, which has the
    unknown numbers at the prior and a filter of its own, exactly as without learning.

    - The step of the identifier was taken (status ok).
    - The model explains the data: the mean square of the normalised innovations is at most
      `misfit`.
    - Each unknown number is well determined: its standard deviation is at most `spread` times its
      value or, if it may be negative, times the prior standard deviation where that is larger.
    - Each lies inside of its bounds, not at one.

    Parameters
    ----------
    spread
        Largest standard deviation of an unknown number, relative to its value.
    misfit
        Largest innovation ratio, which is 1 if model and noise are correct (note
        "innovation_ratio").
    patience
        Number of consecutive samples that must pass before the estimate is used.
    """

    spread: float = 0.3
    misfit: float = 4.0
    patience: int = 3

    def __post_init__(self) -> None:
        for name in ("spread", "misfit"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(
                    f"Trust: {name} must be a positive number; got {getattr(self, name)}."
                )
        if self.patience != int(self.patience) or self.patience < 1:
            raise ConfigurationError(
                f"Trust: patience must be a whole number, at least 1; got {self.patience}."
            )

    def doubt(self, estimate: Estimate, model: ReducedModel) -> str:
        """Return the reason why an estimate is not trusted; empty if it is."""
        if not estimate.status.ok:
            return f"the step failed ({estimate.status})"
        misfit = estimate.diagnostics.innovation_ratio  # NaN: a law without innovations
        if misfit > self.misfit:
            return (
                f"the model does not explain the data: innovations are {math.sqrt(misfit):.1f} "
                "times as large as expected; look at dt_max, the noise, and what it lacks"
            )
        if estimate.q_std is None:
            return "the law has no covariance: take SensitivityLaw"
        q, std = model.numbers(estimate.q), model.numbers(estimate.q_std)
        size = np.where(model.lower < 0.0, np.maximum(np.abs(q), model.std), np.abs(q))
        for label, value, deviation, scale, low, high in zip(
            model.unknowns, q, std, size, model.lower, model.upper, strict=True
        ):
            if not np.isfinite(value) or not deviation <= self.spread * scale:
                return f"{label} = {value:.4g} is known to {deviation:.2g} only"
            if not low < value < high:
                return f"{label} = {value:.4g} lies at its bound"
        return ""
