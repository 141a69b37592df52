"""Forecast of sensor readings without further measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.errors import SampleError, TimeOrderError
from livepde.fem import Moment
from livepde.laws import AnyLaw, Belief, Problem, Status
from livepde.linalg import Array
from livepde.observation import Observed
from livepde.stepping import MOST_SUBSTEPS, Advance, Interval

__all__ = ["Forecast", "ahead", "future_times", "seen_rows"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Forecast:
    """Predicted sensor readings at given times, with their standard deviations.

    Attributes
    ----------
    t
        Times, shape (times,).
    names
        The assimilated sensors, then those for validation.
    z
        Predicted readings, shape (times, sensors); NaN for a sensor whose position is not known.
    z_std
        Standard deviation of z due to the uncertainty of state and unknowns, without sensor noise;
        NaN for a law without covariance.
    status
        Status of the first failed step, after which all values are NaN; else of the last step.
    """

    t: Array
    names: tuple[str, ...]
    z: Array
    z_std: Array
    status: Status

    def __getitem__(self, name: str) -> Array:
        """Return the prediction of one sensor, shape (times,); raise `SampleError` if unknown."""
        if name not in self.names:
            raise SampleError(
                f"forecast: no sensor is called '{name}'; there are {list(self.names)}."
            )
        return self.z[:, self.names.index(name)]


def future_times(times: Array, given: object, t: float, control: Advance) -> list[float]:
    """Return validated times of a forecast after the last sample at t; `given` is for messages."""
    if times.ndim != 1 or not np.isfinite(times).all():
        raise SampleError(f"forecast: times must be finite numbers; got {given!r}.")
    if not len(times) or times[0] < t or np.any(np.diff(times) <= 0.0):
        raise TimeOrderError(
            f"forecast: times must increase from the last sample at t = {t!r} on; got "
            f"{times.tolist()}."
        )
    if any(map(control.stretches, np.diff(times, prepend=t).tolist())):
        raise SampleError(
            f"forecast: two times are more than {MOST_SUBSTEPS} substeps of dt_max = "
            f"{control.dt_max:g} apart; give times in between, or a longer dt_max."
        )
    return [float(time) for time in times]


def ahead(
    law: AnyLaw,
    work: Any,
    problem: Problem,
    sensors: Sequence[Observed],
    state: Any,
    intervals: Sequence[Interval],
) -> Forecast:
    """Return predicted readings at the ends of intervals, starting from the state of a law.

    The intervals are consecutive; the first may have zero length.
    """
    names = tuple(name for observed in sensors for name in observed.names)
    z, std = np.full((2, len(intervals), len(names)), np.nan)
    status = Status()
    for k, interval in enumerate(intervals):
        if interval.t1 > interval.t0:
            state, report = law.step(work, state, interval.silent)
            status = report.status
        if not status.ok:
            break
        belief = problem.physical(law.belief(work, state))
        readings = [_predicted(observed, belief, interval.end) for observed in sensors]
        z[k], std[k] = (np.concatenate(parts) for parts in zip(*readings, strict=True))
    times = np.array([interval.t1 for interval in intervals])
    return Forecast(t=times, names=names, z=z, z_std=std, status=status)


def _predicted(sensors: Observed, belief: Belief, moment: Moment) -> tuple[Array, Array]:
    """Return the predicted readings of a belief, and their standard deviations."""
    z = sensors.predict(belief.u, belief.q, moment)
    rows = seen_rows(sensors, belief, moment)
    if rows is None:
        return z, np.full_like(z, np.nan)
    return z, np.where(np.isnan(z), np.nan, np.linalg.norm(rows, axis=1))


def seen_rows(sensors: Observed, belief: Belief, moment: Moment) -> Array | None:
    """Return the square root of the covariance of predicted readings, shape (sensors, r).

    Its columns correspond to columns of the factors of the belief; None if there are no factors.
    """
    if belief.u_factor is None or belief.q_factor is None:
        return None
    H_u, H_q = sensors.jacobian(belief.u, belief.q, moment)
    rows: Array = np.asarray(H_u @ belief.u_factor)
    return rows if H_q is None else rows + H_q @ belief.q_factor
