"""What sensors will show later, if nothing more is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.errors import SampleError
from livepde.fem import Moment
from livepde.laws import AnyLaw, Belief, Problem, Status
from livepde.linalg import Array
from livepde.observation import Observed
from livepde.stepping import Interval

__all__ = ["Forecast", "ahead"]


@dataclass(frozen=True, eq=False)
class Forecast:
    """What the model expects sensors to show at some times.

    Attributes
    ----------
    t
        Times, shape (times,).
    names
        The assimilated sensors, then the withheld ones.
    z
        What they will show, shape (times, sensors); NaN for a sensor whose position is not known.
    z_std
        Standard deviation of z for what is not known of state and unknowns, without the noise of
        the sensors; NaN for a law without covariance.
    status
        How the first step went that failed; from there on all is NaN.
    """

    t: Array
    names: tuple[str, ...]
    z: Array
    z_std: Array
    status: Status

    def __getitem__(self, name: str) -> Array:
        """Return what one sensor will show, shape (times,); `SampleError` if there is none."""
        if name not in self.names:
            raise SampleError(
                f"forecast: no sensor is called '{name}'; there are {list(self.names)}."
            )
        column: Array = self.z[:, self.names.index(name)]
        return column


def ahead(
    law: AnyLaw,
    work: Any,
    problem: Problem,
    sensors: Sequence[Observed],
    state: Any,
    intervals: Sequence[Interval],
) -> Forecast:
    """Return what sensors show at the ends of intervals, from the state of a law on.

    Parameters
    ----------
    intervals
        Each begins where the one before ends; the first may have no length.
    """
    names = tuple(name for each in sensors for name in each.names)
    z, std = np.full((2, len(intervals), len(names)), np.nan)
    status, state = Status(), law.suspended(work, state)
    for k, interval in enumerate(intervals):
        if interval.t1 > interval.t0:
            state, report = law.step(work, state, interval.silent)
            status = report.status
        if not status.ok:
            break
        belief = problem.physical(law.belief(work, state))
        seen = [_seen(each, belief, interval.end) for each in sensors]
        z[k], std[k] = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    times = np.array([interval.t1 for interval in intervals])
    return Forecast(times, names, z, std, status)


def _seen(sensors: Observed, belief: Belief, moment: Moment) -> tuple[Array, Array]:
    """Return what sensors show of a belief, and its standard deviation."""
    z = sensors.predict(belief.u, belief.q, moment)
    if belief.u_factor is None or belief.q_factor is None:
        return z, np.full_like(z, np.nan)
    H_u, H_q = sensors.jacobian(belief.u, belief.q, moment)
    factor = H_u @ belief.u_factor
    if H_q is not None:
        factor = factor + H_q @ belief.q_factor
    std = np.linalg.norm(factor, axis=1)
    return z, np.where(np.isnan(z), np.nan, std)
