"""Kalman filter of a reduced model with given unknown numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from livepde.checkpoint import packed, unpacked
from livepde.control.goal import Known
from livepde.control.linear import Discrete
from livepde.control.reduced import ReducedModel
from livepde.errors import ConfigurationError, RunError, SampleError, TimeOrderError
from livepde.linalg import Array
from livepde.samples import labelled, number, readings

# Standard deviation of the isotropic process noise, relative to that of the channels.
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
        _check_noise({**drive, **offset}, model.channels)
        if not (np.isfinite(period) and period > 0.0):
            raise ConfigurationError(f"Kalman: period must be a positive number; got {period}.")
        self.model = model
        self.period = period
        self.drive = np.array([float(drive.get(name, 0.0)) for name in model.channels])
        self._moving = model.columns(list(offset))
        self._walk = np.array(list(offset.values()))
        self._noise = np.asarray(model.sensors.noise)
        self._t = np.nan
        self.set(q or {})
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

    def set(self, q: Mapping[str, float]) -> None:
        """Change the unknown numbers; those that are not named are set to the prior."""
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

        Raises
        ------
        SampleError
            Wrong shape, text, infinity, or a sensor that does not exist.
        TimeOrderError
            t is not later than the sample before.
        """
        sensors, r, z = self.model.sensors.names, self.model.size, labelled(z)
        if isinstance(z, Mapping):
            unknown = [name for name in z if name not in sensors]
            if unknown:
                raise SampleError(f"unknown sensor '{unknown[0]}'; there are {list(sensors)}.")
            z = [number(z.get(name), f"sensor '{name}'") for name in sensors]
        seen, own = readings(z, self.model.frame.sensors)
        noise = self._noise if own is None else np.where(np.isnan(own), self._noise, own)
        if not np.isnan(self._t):
            h = t - self._t
            if not h > 0.0:
                raise TimeOrderError(
                    f"the sample at t = {t!r} is not later than the last one at t = {self._t!r}."
                )
            self._predict(h, inputs)
        self._t = t
        self._update(seen, noise, inputs)
        offset = np.zeros(len(self.model.channels))
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
        H, missed = H[used], (seen - expected)[used]
        S = H @ self._P @ H.T + np.diag(noise[used] ** 2)
        gain = np.linalg.solve(S, H @ self._P).T
        self._x = self._x + gain @ missed
        # Joseph's form (I - K H) P (I - K H)^T + K R K^T stays symmetric and positive.
        left = np.eye(len(self._x)) - gain @ H
        self._P = left @ self._P @ left.T + (gain * noise[used] ** 2) @ gain.T

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


def _check_noise(sizes: Mapping[str, float], channels: Sequence[str]) -> None:
    for name, size in sizes.items():
        if name not in channels:
            raise ConfigurationError(
                f"Kalman: there is no channel '{name}'; the model has {list(channels)}."
            )
        if not (np.isfinite(size) and size >= 0.0):
            raise ConfigurationError(
                f"Kalman: the standard deviation of '{name}' must be a number, at least 0; "
                f"got {size}."
            )
