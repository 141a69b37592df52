"""Disturbances of data: kinds of noise, a spike, gaps in channels, and an offset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.honest.problem import Problem

Array = NDArray[Any]
MISSING = 0.3  # share of missing readings of each channel
SPIKES = (9999.0, 50.0)  # value, or distance in standard deviations, with equal probability
SPIKE_AT = (0.2, 0.8)  # range of the spike, in shares of the run
OFFSET = 2.0  # standard deviations


@dataclass(frozen=True, eq=False)
class Data:
    """Data of a run.

    Attributes
    ----------
    z
        Readings, shape (samples, sensors).
    right
        Readings without the spike, for the batch fit, shape (samples, sensors).
    inputs
        Channels, shape (samples, channels); NaN if missing.
    spike
        Index of the sample with the spike, or None.
    biased
        Name of the sensor with an offset, or None.
    """

    z: Array
    right: Array
    inputs: Array
    spike: int | None = None
    biased: str | None = None


@dataclass(frozen=True)
class Kind:
    """Kind of disturbance.

    Attributes
    ----------
    title
        Description.
    coverage
        Bounds on the coverage of 95 % intervals; None: no bounds.
    freed
        Whether the offset of the sensor is an unknown of the identifier.
    right
        Whether the noise is white and Gaussian, as the estimator assumes.
    channels
        Whether the kind requires channels.
    """

    title: str
    coverage: tuple[float, float] | None
    freed: bool = False
    right: bool = False
    channels: bool = False


USUAL = (0.90, 0.98)

KINDS: Mapping[str, Kind] = {
    "white": Kind("white Gaussian noise", USUAL, right=True),
    "ar100": Kind("AR(1), time constant a hundredth of the run", USUAL),
    "ar10": Kind("AR(1), time constant a tenth of the run", (0.88, 1.0)),
    "student": Kind("Student t_3 with the configured standard deviation", USUAL),
    "spike": Kind("white, one reading of 9999 or 50 standard deviations off", USUAL),
    "gaps": Kind("white, 30 % of the readings of channels missing", USUAL, channels=True),
    "bias": Kind("white, one sensor two standard deviations off", None),
    "bias-freed": Kind("white, one sensor off, its offset unknown", (0.90, 1.0), freed=True),
}


def disturbed(name: str, problem: Problem, shown: Array, rng: np.random.Generator) -> Data:
    """Return data with a kind of disturbance.

    All kinds with white noise draw the same noise from the same generator state.

    Parameters
    ----------
    shown
        Readings without noise, shape (samples, sensors).
    """
    white = rng.standard_normal(shown.shape)
    inputs = problem.inputs(problem.times)
    z = shown + problem.noise * NOISES.get(name, _as_drawn)(white, rng)
    sensor = int(rng.integers(shown.shape[1]))
    if name == "spike":
        low, high = (round(share * problem.intervals) for share in SPIKE_AT)
        at, how = int(rng.integers(low, high)), int(rng.integers(2))
        right = z.copy()
        z[at, sensor] = SPIKES[0] if how == 0 else shown[at, sensor] + SPIKES[1] * problem.noise
        return Data(z, right, inputs, spike=at)
    if name == "gaps":
        gone = rng.random(inputs.shape) < MISSING
        gone[0] = False  # all channels have a value at the start
        return Data(z, z, np.where(gone, np.nan, inputs))
    if name in ("bias", "bias-freed"):
        z[:, sensor] += OFFSET * problem.noise * rng.choice([-1.0, 1.0])
        return Data(z, z, inputs, biased=list(problem.points)[sensor])
    return Data(z, z, inputs)


def _as_drawn(white: Array, rng: np.random.Generator) -> Array:
    return white


def _autoregressive(share: float) -> Callable[[Array, np.random.Generator], Array]:
    """Return AR(1) noise of unit variance; `share` is its time constant over the run's length."""

    def noise(white: Array, rng: np.random.Generator) -> Array:
        rho = np.exp(-1.0 / (share * (len(white) - 1)))
        errors = white.copy()
        for k in range(1, len(white)):
            errors[k] = rho * errors[k - 1] + np.sqrt(1 - rho**2) * white[k]
        return errors

    return noise


def _student(white: Array, rng: np.random.Generator) -> Array:
    return np.asarray(rng.standard_t(3, white.shape) / np.sqrt(3.0))


NOISES: Mapping[str, Callable[[Array, np.random.Generator], Array]] = {
    "ar100": _autoregressive(0.01),
    "ar10": _autoregressive(0.1),
    "student": _student,
}
