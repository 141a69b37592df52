"""Estimators of state and unknown numbers for a controller, and tests whether to trust them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from livepde.checkpoint import packed, unpacked
from livepde.control.goal import Known
from livepde.control.kalman import Kalman
from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError, RunError
from livepde.identifier import Identifier
from livepde.result import Estimate


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
    - It was tested at all: by these innovations, or by the verdict of the run. A law that makes no
      tests gives no estimate to control by.

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
                f"model misfit: innovations are {math.sqrt(misfit):.1f} "
                "times as large as expected; check `dt_max`, the noise and the model"
            )
        if estimate.q_std is None:
            return "the law has no covariance: use SensitivityLaw"
        q, std = model.numbers(estimate.q), model.numbers(estimate.q_std)
        size = np.where(model.lower < 0.0, np.maximum(np.abs(q), model.std), np.abs(q))
        for label, value, deviation, scale, low, high in zip(
            model.unknowns, q, std, size, model.lower, model.upper, strict=True
        ):
            if not np.isfinite(value) or not deviation <= self.spread * scale:
                return f"{label} = {value:.4g} is known to {deviation:.2g} only"
            if not low < value < high:
                return f"{label} = {value:.4g} lies at its bound"
        tested = math.isfinite(misfit) or estimate.verdict.judged
        return "" if tested else estimate.verdict.sentences[0]


class Estimator(Protocol):
    """Protocol of estimators of the state and the unknown numbers of a reduced model.

    Inputs are held between samples: a sample at t contains the inputs applied since the previous
    one.
    """

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        """Process a sample: measurements of the sensors, shape (sensors,), NaN where missing."""

    def dump(self) -> bytes:
        """Return the state as bytes."""

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Restore a state returned by `dump`; `where` names it in messages."""


class Learned:
    """An identifier with a nominal model in parallel, as a fallback for the controller.

    Parameters
    ----------
    identifier
        The identifier, built with `between={...: "next"}` for all of its inputs; its model may have
        any size.
    nominal
        Kalman filter of the nominal model, updated with every sample.
    trust
        Conditions for using the estimate.

    Attributes
    ----------
    estimate
        Last estimate of the identifier.
    """

    def __init__(self, identifier: Identifier, nominal: Kalman, trust: Trust | None = None) -> None:
        missing = [c for c in identifier.inputs if c not in nominal.model.channels]
        if missing:
            raise ConfigurationError(
                f"Learned: the sensors of the identifier read {missing}, which the reduced model "
                "does not have; give positions of sensors in another way."
            )
        lines = [c for c in identifier.inputs if c not in identifier.problem.control.held.next]
        if lines:
            raise ConfigurationError(
                "Learned: a sample of a loop contains the inputs applied since the last one; build "
                f"the identifier with between={dict.fromkeys(lines, 'next')}."
            )
        for what, mine, theirs in (
            ("sensors", identifier.observed.names, nominal.model.sensors.names),
            ("unknown numbers", identifier.model.parameter_space.labels, nominal.model.unknowns),
        ):
            if list(mine) != list(theirs):
                raise ConfigurationError(
                    f"Learned: the identifier has the {what} {list(mine)}, the reduced model "
                    f"{list(theirs)}: reduce the identifier's model, with its sensors."
                )
        self.identifier = identifier
        self.nominal = nominal
        self.trust = trust or Trust()
        self.estimate: Estimate | None = None
        self._good = 0

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        identifier, model = self.identifier, self.nominal.model
        self.estimate = estimate = identifier.step(t, z, inputs)  # a bad sample changes nothing
        if isinstance(z, Mapping):  # with what is withheld, perhaps
            z = {name: z[name] for name in model.sensors.names if name in z}
        # The nominal filter runs at every sample, trusted or not, so that a fallback starts from a
        # converged state.
        nominal = self.nominal.step(t, z, inputs)
        doubt = self.trust.doubt(estimate, model)
        self._good = 0 if doubt else min(self._good + 1, self.trust.patience)
        if self._good < self.trust.patience:
            why = doubt or f"trusted only after {self.trust.patience} good samples in a row"
            return replace(nominal, source="fallback", why=why)
        belief = estimate.belief
        root = belief.q_factor if belief.q_factor is not None else np.zeros((len(belief.q), 0))
        factor = model.numbers(root)
        x, q = model.project(estimate.u), model.numbers(estimate.q)
        here = model.about(estimate.u, estimate.q, inputs) if model.frame.moves else None
        return Known(x, q, factor, model=here)

    def dump(self) -> bytes:
        leaves = {
            "identifier": np.frombuffer(self.identifier.dump(), dtype=np.uint8),
            "nominal": np.frombuffer(self.nominal.dump(), dtype=np.uint8),
            "good": self._good,
        }
        return packed({"kind": "learned"}, leaves)

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        header, leaves = unpacked(content, where)
        if header.get("kind") != "learned":
            raise RunError(f"{where} is of another estimator: build it as it was then.")
        self.identifier.restore(leaves["identifier"].tobytes(), where)
        self.nominal.restore(leaves["nominal"].tobytes(), where)
        self._good = int(leaves["good"])
