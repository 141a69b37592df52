"""Sample intervals: linear interpolation of inputs, substeps, and step halving after a failure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array
from livepde.stepping.newton import StepFailed
from livepde.stepping.schemes import Scheme, Stage

__all__ = ["Advance", "Interval", "advance", "own_noise"]

# Beyond this number of halvings a substep would be shorter than the resolution of usual times.
MOST_HALVINGS = 30
# With three halvings a tenth is left of the error of the first steps of a solution that goes with
# the square root of time, for the work of six more substeps.
MOST_GRADES = 3


@dataclass(frozen=True, eq=False)
class Interval:
    """A sample interval, with inputs and measurements interpolated linearly.

    Attributes
    ----------
    t0, t1
        Times of the last accepted sample and of this one.
    inputs0, inputs1
        Input channels at both ends.
    z0, z1
        Measurements at both ends, shape (sensors,), NaN where missing.
    noise
        Standard deviation of each value of z1, shape (sensors,), NaN for the default of the sensor;
        None if all are defaults.
    gaps
        Channel held at either end -> duration of the gap before, and whether it lasts at the end.
    """

    t0: float
    t1: float
    inputs0: Mapping[str, float]
    inputs1: Mapping[str, float]
    z0: Array
    z1: Array
    noise: Array | None = None
    gaps: Mapping[str, tuple[float, bool]] = field(default_factory=dict)

    def _weight(self, t: float) -> float:
        return (t - self.t0) / (self.t1 - self.t0)

    def at(self, t: float) -> Moment:
        """Return time and inputs at t."""
        if t == self.t1:
            return self.end
        if self.inputs0 is self.inputs1:
            return Moment(t, self.end.inputs)
        s = self._weight(t)
        mixed = {k: (1 - s) * self.inputs0[k] + s * v for k, v in self.inputs1.items()}
        return Moment(t, Inputs(mixed))

    @cached_property
    def end(self) -> Moment:
        """Time and inputs at the end."""
        return Moment(self.t1, Inputs(self.inputs1))

    @property
    def silent(self) -> Interval:
        """Copy of the interval without a measurement at the end."""
        return replace(self, z1=np.full_like(self.z1, np.nan))

    def divided(self, count: int) -> list[Interval]:
        """Return equal subintervals, in time order."""
        if count == 1:
            return [self]
        share = [k / count for k in range(count + 1)]
        # The ends are the given values, not interpolated ones, so that dividing an interval does
        # not change a digit there.
        times = [self.t0, *(self.t0 + s * (self.t1 - self.t0) for s in share[1:-1]), self.t1]
        inputs = [self.inputs0, *(self.at(t).inputs for t in times[1:-1]), self.inputs1]
        z = [self.z0, *(self.z(t) for t in times[1:-1]), self.z1]
        return [
            Interval(times[k], times[k + 1], inputs[k], inputs[k + 1], z[k], z[k + 1])
            for k in range(count)
        ]

    @cached_property
    def present(self) -> Array:
        """Mask of the sensors with a value at the end, shape (sensors,)."""
        return np.isfinite(self.z1)

    def z(self, t: float) -> Array:
        """Return measurements interpolated at t; where the value at t0 is missing, those of t1."""
        if t == self.t1:
            return self.z1
        s = self._weight(t)
        start = np.where(np.isfinite(self.z0), self.z0, self.z1)
        return (1 - s) * start + s * self.z1

    def change(self, start: float, stop: float) -> Array:
        """Return the change of z between two times; zero where z is missing at t0."""
        share = (stop - start) / (self.t1 - self.t0)
        change: Array = share * (self.z1 - self.z0)
        change[np.isnan(change)] = 0.0
        return change


def own_noise(noise: ArrayLike) -> Array | None:
    """Return noise standard deviations of readings; None if all are sensor defaults (NaN)."""
    found: Array = np.asarray(noise, dtype=float)
    return None if np.isnan(found).all() else found


@dataclass(frozen=True)
class Advance:
    """Step control: time scheme, substeps, and halving after a failure.

    Parameters
    ----------
    scheme
        Time scheme.
    dt_max
        Longest substep; a longer interval is divided evenly.
    halvings
        Maximum number of successive halvings of a failed substep; 0: no retry.
    hold
        True for zero-order hold: inputs have the value of the later sample over the whole interval,
        as with an actuator that is set at each sample. False for linear interpolation.
    parts
        Number of parts of every substep, to repeat an interval with shorter steps.
    start
        Initial time. Substeps h near it are graded: halved, at most three times, where they are
        longer than half of the time since then, unless `halvings` is 0. Data that do not fit the
        initial state, as a heat flux that sets in, leave a boundary layer that goes with the
        square root of time.
    """

    scheme: Scheme
    dt_max: float = np.inf
    halvings: int = 8
    hold: bool = False
    parts: int = 1
    start: float = math.nan

    def __post_init__(self) -> None:
        given: Any = self.halvings
        whole = isinstance(given, int | np.integer) and not isinstance(given, bool)
        if not (whole and 0 <= given <= MOST_HALVINGS):
            raise ConfigurationError(
                f"halvings must be a whole number from 0 to {MOST_HALVINGS}; got {given!r}."
            )

    def over(self, interval: Interval) -> Interval:
        """Return an interval with inputs held or interpolated, as configured."""
        if not self.hold or interval.inputs0 is interval.inputs1:
            return interval
        return replace(interval, inputs0=interval.inputs1)

    def count(self, length: float) -> int:
        """Return the number of equal substeps of an interval of that length."""
        ratio = length / self.dt_max
        # The factor keeps rounding of the length from adding a substep when dt_max divides it.
        return self.parts * max(1, math.ceil(ratio * (1 - 1e-12)))

    def grade(self, t: float, h: float) -> int:
        """Return how often a substep h from t is halved because it is near the start."""
        since = t - self.start
        if not (self.halvings and since >= 0.0):
            return 0
        # The factor keeps rounding of the times from halving a step that is half of `since`.
        return sum(0.5 * since * (1 + 1e-9) < h / 2**k for k in range(MOST_GRADES))


def _width(t: float, stop: float) -> float:
    """Return stop - t, rounded to the resolution of both times.

    Differences of equidistant times differ in their last digits. Rounding makes them identical, so
    that a matrix factorised for one step length serves all equal steps.
    """
    # The unit is 16 units in the last place of the larger time. Very short widths are not rounded,
    # as that would change more than their last digits.
    unit = math.ldexp(1.0, math.frexp(max(abs(t), abs(stop)))[1] - 49)
    width = stop - t
    return round(width / unit) * unit if width > 1e6 * unit else width


def advance(
    control: Advance, stage: Stage, y: Array, t0: float, t1: float
) -> tuple[Array, int, StepFailed | None]:
    """Advance y from t0 to t1.

    Times are computed from integer counts, never accumulated.

    Returns
    -------
    y
        State at the end of the interval, or after the last successful substep if halving failed.
    steps
        Number of substeps taken.
    failure
        None, or the failure of the shortest substep.
    """
    h = control.parts * (t1 - t0) / control.count(t1 - t0)
    grades = control.grade(t0, h)
    # A substep has 2^k ticks, where k is the number of halvings that may be needed.
    whole = 1 << (control.halvings + grades)  # ticks of a substep
    finest = control.count(t1 - t0) * whole
    width = (t1 - t0) / finest

    def longest(tick: int) -> int:
        """Return the ticks of a substep that begins at a tick."""
        return whole >> control.grade(t0 + tick * width, h) if grades else whole

    # Time is counted in ticks of the finest halving: all times are integer multiples of one width,
    # and a stride can grow again at every multiple of its double.
    tick, stride, steps = 0, longest(0), 0
    while tick < finest:
        t = t0 + tick * width
        stop = t1 if tick + stride == finest else t0 + (tick + stride) * width
        try:
            y = control.scheme.advance(stage, y, t, _width(t, stop))
        except StepFailed as failure:
            if stride << control.halvings <= longest(tick):
                return y, steps, failure
            stride >>= 1
            continue
        steps += 1
        tick += stride
        # A stride is doubled only at a multiple of its double, so that substeps stay on the grid of
        # halvings.
        if 2 * stride <= longest(tick) and tick % (2 * stride) == 0:
            stride <<= 1
    return y, steps, None
