"""Estimators for a controller (a Kalman filter, or an identifier), and when to trust them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from scipy.linalg import block_diag

from livepde.checkpoint import packed, unpacked
from livepde.control.controllers import Known
from livepde.control.reduction import Discrete, ReducedModel
from livepde.errors import ConfigurationError, RunError, SampleError, TimeOrderError
from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.linalg import Array
from livepde.samples import Channels, number

# Standard deviation of the isotropic process noise, relative to the noise of the channels.
FLOOR = 1e-6
# Relative difference of two sampling intervals that is attributed to rounding.
SAME = 1e-6


class Kalman:
    """Kalman filter for the state of a reduced model with given unknown numbers.

    Process noise enters through the channels: unmeasured disturbances and actuator errors.
    Nonlinear sensors are linearised at the estimate.

    Parameters
    ----------
    model
        Reduced model; the noise of its sensors must be known.
    period
        Usual sampling period.
    drive
        Mapping from channel to the standard deviation of its noise, held over a period, in its
        unit.
    offset
        Mapping from channel to the standard deviation, per period, of the random walk of an unknown
        constant added to it. Such a disturbance model gives offset-free control of measured outputs
        in spite of model errors.
    q
        Unknown numbers by label; default the prior.
    x
        Initial state, shape (r,); default the linearisation point of the reduction.
    """

    def __init__(
        self,
        model: ReducedModel,
        period: float,
        *,
        drive: Mapping[str, float],
        offset: Mapping[str, float] | None = None,
        q: Mapping[str, float] | None = None,
        x: Array | None = None,
    ) -> None:
        if model.sensors.noise is None:
            raise ConfigurationError(
                "Kalman needs the noise of the sensors: give noise= to the observation."
            )
        offset = offset or {}
        for name, size in {**drive, **offset}.items():
            if name not in model.channels:
                raise ConfigurationError(
                    f"Kalman: there is no channel '{name}'; the model has {list(model.channels)}."
                )
            if not 0.0 <= size < np.inf:
                raise ConfigurationError(
                    f"Kalman: the standard deviation of '{name}' must be a number, at least 0; "
                    f"got {size}."
                )
        if not 0.0 < period < np.inf:
            raise ConfigurationError(f"Kalman: period must be a positive number; got {period}.")
        self.model = model
        self.period = period
        self.drive = np.array([float(drive.get(name, 0.0)) for name in model.channels])
        self._moving = model.columns(list(offset))
        self._walk = np.array(list(offset.values()))
        self._noise = np.asarray(model.sensors.noise)
        self._channels = Channels((), model.frame.sensors, None)
        self._t = np.nan
        self.set(q)
        x = model.start if x is None else np.asarray(x, dtype=float)
        if x.shape != (model.size,):
            raise ConfigurationError(
                f"Kalman: x has shape {x.shape}; the reduced model needs ({model.size},)."
            )
        self._x = np.concatenate([x, np.zeros(len(self._moving))])
        self._P = self._usual[2]

    @property
    def q(self) -> Array:
        """Unknown numbers of the model, shape (m,)."""
        return self._q

    def set(self, q: Mapping[str, float] | None) -> None:
        """Change the unknown numbers; numbers without a value are set to the prior."""
        self._q = self.model.given(q)
        self._usual = self._over(self.period)

    def _over(self, h: float) -> tuple[Discrete, Array, Array]:
        """Return model, transition matrix of state and offset, and process noise over a time h."""
        move = self.model.matrices(self._q, h)
        driven = move.B * self.drive
        gained = driven @ driven.T
        # A small isotropic noise keeps the covariance regular: the channels drive fewer directions
        # than there are coordinates.
        floor = FLOOR**2 * float(np.trace(gained))
        gained = gained + floor * np.eye(len(gained))
        noise: Array = block_diag(gained, np.diag(self._walk**2 * (h / self.period)))
        r, count = self.model.size, len(self._moving)
        added = move.B[:, self._moving]
        A = np.block([[move.A, added], [np.zeros((count, r)), np.eye(count)]])
        return move, A, noise

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        """Process a sample, as in `Estimator.step`; the first one defines the initial time.

        Early and late samples are predicted over their actual interval.

        Raises `SampleError`: wrong shape, text, infinity, a date, or a sensor that does not exist.
        Raises `TimeOrderError`: t is not later than the previous sample.
        """
        t = number(t, "time t")
        if not math.isfinite(t):
            raise SampleError(f"time t must be a finite number; got {t}.")
        measured, stated, *_ = self._channels.parse(z, None)
        noise = self._noise if stated is None else np.where(np.isnan(stated), self._noise, stated)
        if not np.isnan(self._t):
            h = t - self._t
            if not h > 0.0:
                raise TimeOrderError(
                    f"the sample at t = {t!r} is not later than the last one at t = {self._t!r}."
                )
            self._predict(h, inputs)
        self._t = t
        self._update(measured, noise, inputs)
        r, offset = self.model.size, np.zeros(len(self.model.channels))
        offset[self._moving] = self._x[r:]
        return Known(
            self._x[:r],
            self._q,
            np.zeros((len(self._q), 0)),
            offset=offset if r < len(self._x) else None,
        )

    def _predict(self, h: float, inputs: Mapping[str, float]) -> None:
        """Propagate the mean (x, offset) and its covariance P over a time h."""
        usual = abs(h - self.period) <= SAME * self.period
        move, A, gained = self._usual if usual else self._over(h)
        self._x = A @ self._x
        self._x[: self.model.size] += move.B @ self.model.values(inputs) + move.f
        self._P = A @ self._P @ A.T + gained

    def _update(self, seen: Array, noise: Array, inputs: Mapping[str, float]) -> None:
        """Correct mean and covariance by the readings of a sample; NaN: missing."""
        expected, H = self.model.seen(self._x[: self.model.size], self._q, inputs)
        # Sensors see an offset only through the state that it drives.
        H = np.hstack([H, np.zeros((len(H), len(self._moving)))])
        used = np.isfinite(seen) & np.isfinite(expected)
        H, innovation = H[used], (seen - expected)[used]
        S = H @ self._P @ H.T + np.diag(noise[used] ** 2)
        gain = np.linalg.solve(S, H @ self._P).T
        self._x = self._x + gain @ innovation
        # Joseph's form (I - K H) P (I - K H)^T + K R K^T stays symmetric and positive.
        remaining = np.eye(len(self._x)) - gain @ H
        self._P = remaining @ self._P @ remaining.T + (gain * noise[used] ** 2) @ gain.T

    def dump(self) -> bytes:
        """Return the state as bytes."""
        leaves = {"x": self._x, "P": self._P, "q": self._q, "t": self._t}
        return packed({"kind": "kalman"}, leaves)

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Restore a state returned by `dump`."""
        header, leaves = unpacked(content, where)
        if header.get("kind") != "kalman" or leaves["x"].shape != self._x.shape:
            raise RunError(f"{where} is of another reduced model: build it as it was then.")
        self.set(dict(zip(self.model.unknowns, leaves["q"].tolist(), strict=True)))
        self._x, self._P, self._t = leaves["x"], leaves["P"], float(leaves["t"])


@dataclass(frozen=True)
class Trust:
    """Conditions for using an estimate in control; otherwise the nominal model is used.

    *The rule*: while any of these tests fails, and until `patience` consecutive samples have passed
    them, the controller uses state and unknown numbers of the nominal model, with the unknown
    numbers at the prior and its own filter, exactly as without learning.

    - The step of the identifier succeeded (status ok).
    - The model explains the data: the mean square of the normalised innovations is at most
      `misfit`.
    - Each unknown number is well determined: its standard deviation is at most `spread` times its
      value or, if it may be negative, times the prior standard deviation where that is larger.
    - Each unknown number lies inside its bounds, not at a bound.
    - The estimate was tested, by these innovations or by the verdict of the run. Estimates of a law
      without tests are not used.

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
    """Identifier with a nominal model in parallel, as a fallback for the controller.

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
        for kind, own, reduced in (
            ("sensors", identifier.observed.names, nominal.model.sensors.names),
            ("unknown numbers", identifier.model.parameter_space.labels, nominal.model.unknowns),
        ):
            if list(own) != list(reduced):
                raise ConfigurationError(
                    f"Learned: the identifier has the {kind} {list(own)}, the reduced model "
                    f"{list(reduced)}: reduce the identifier's model, with its sensors."
                )
        self.identifier = identifier
        self.nominal = nominal
        self.trust = trust or Trust()
        self.estimate: Estimate | None = None
        self._trusted_samples = 0

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        identifier, model = self.identifier, self.nominal.model
        self.estimate = estimate = identifier.step(t, z, inputs)  # a bad sample changes nothing
        # The nominal filter uses only the assimilated sensors.
        measured, noise, *_ = identifier._channels.parse(z, inputs)
        pairs = measured if noise is None else np.column_stack([measured, noise])
        # The nominal filter runs at every sample, trusted or not, so that a fallback starts from a
        # converged state.
        nominal = self.nominal.step(estimate.t, pairs, inputs)  # a date as a number
        doubt = self.trust.doubt(estimate, model)
        self._trusted_samples = 0 if doubt else min(self._trusted_samples + 1, self.trust.patience)
        if self._trusted_samples < self.trust.patience:
            reason = doubt or f"trusted only after {self.trust.patience} good samples in a row"
            return replace(nominal, source="fallback", why=reason)
        belief = estimate.belief
        root = belief.q_factor if belief.q_factor is not None else np.zeros((len(belief.q), 0))
        factor = model.numbers(root)
        x, q = model.project(estimate.u), model.numbers(estimate.q)
        local = model.about(estimate.u, estimate.q, inputs) if model.frame.moves else None
        return Known(x, q, factor, model=local)

    def dump(self) -> bytes:
        leaves = {
            "identifier": np.frombuffer(self.identifier.dump(), dtype=np.uint8),
            "nominal": np.frombuffer(self.nominal.dump(), dtype=np.uint8),
            "good": self._trusted_samples,
        }
        return packed({"kind": "learned"}, leaves)

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        header, leaves = unpacked(content, where)
        if header.get("kind") != "learned":
            raise RunError(f"{where} is of another estimator: build it as it was then.")
        self.identifier.restore(leaves["identifier"].tobytes(), where)
        self.nominal.restore(leaves["nominal"].tobytes(), where)
        self._trusted_samples = int(leaves["good"])
