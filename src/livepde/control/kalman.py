"""A fixed model with its steady Kalman filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from livepde.checkpoint import packed, unpacked
from livepde.control.known import Known
from livepde.control.reduced import Discrete, ReducedModel
from livepde.errors import ConfigurationError, RunError
from livepde.linalg import Array

__all__ = ["Kalman"]

FLOOR = 1e-6  # process noise of each coordinate, relative to the largest: the equation has a root


class Kalman:
    """The state of a reduced model with given unknown numbers, from the sensors.

    The filter is the steady one. Its process noise enters as noise of the channels: what the
    surroundings and the actuator do that nobody measures.

    Parameters
    ----------
    model
        With the noise of its sensors.
    period, steps
        Time between two samples, and implicit Euler steps that it is divided into.
    drive
        Channel -> standard deviation of its noise over a period, in its unit.
    q
        Unknown numbers by label; default the prior.
    x
        State at the start, shape (r,); default that about which the model was reduced.
    """

    def __init__(
        self,
        model: ReducedModel,
        period: float,
        *,
        drive: Mapping[str, float],
        steps: int = 1,
        q: Mapping[str, float] | None = None,
        x: Array | None = None,
    ) -> None:
        if model.sensors.noise is None:
            raise ConfigurationError(
                "Kalman needs the noise of the sensors: give noise= to the observation."
            )
        for name in drive:
            if name not in model.channels:
                raise ConfigurationError(
                    f"Kalman: drive names '{name}'; the channels are {list(model.channels)}."
                )
        self.model = model
        self.period = period
        self.steps = steps
        self.drive = np.array([float(drive.get(name, 0.0)) for name in model.channels])
        self._x = model.start if x is None else np.asarray(x, dtype=float)
        self._begun = False
        self.set(q or {})

    def set(self, q: Mapping[str, float]) -> None:
        """Take other unknown numbers; those that are not named are the prior's."""
        values = zip(self.model.unknowns, self.model.prior, strict=True)
        self.q = np.array([float(q.get(label, prior)) for label, prior in values])
        self.step_of = self.model.matrices(self.q, self.period, self.steps)
        self.gain = gain(self.model, self.step_of, self.drive)

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        """Take a sample, as an `Estimator` does; the first one describes the start."""
        c, seen = self.model.values(inputs), np.asarray(z, dtype=float)
        if self._begun:
            self._x = self.step_of(self._x, c)
        self._begun = True
        missed = seen - self.model.sensors(self._x, c)
        self._x = self._x + self.gain @ np.where(np.isfinite(missed), missed, 0.0)
        return Known(self._x, self.q, np.zeros((len(self.q), 0)))

    def dump(self) -> bytes:
        """Return the state."""
        return packed({"kind": "kalman"}, {"x": self._x, "q": self.q, "begun": self._begun})

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        """Continue from what `dump` returned."""
        _, leaves = unpacked(content, where)
        if leaves["x"].shape != self._x.shape or leaves["q"].shape != self.q.shape:
            raise RunError(
                f"{where} was saved with another reduced model: build it as it was then."
            )
        self.set(dict(zip(self.model.unknowns, leaves["q"].tolist(), strict=True)))
        self._x, self._begun = leaves["x"], bool(leaves["begun"])


def gain(model: ReducedModel, step: Discrete, drive: Array) -> Array:
    """Return the gain of the steady filter, shape (r, sensors)."""
    noise = np.asarray(model.sensors.noise)
    C, driven = model.sensors.C, step.B * drive
    Q = driven @ driven.T
    Q += FLOOR**2 * max(float(np.trace(Q)), 1e-300) * np.eye(len(Q))
    P = solve_discrete_are(step.A.T, C.T, Q, np.diag(noise**2))
    return np.asarray(np.linalg.solve(C @ P @ C.T + np.diag(noise**2), C @ P).T)
