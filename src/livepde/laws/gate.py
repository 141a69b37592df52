"""The gate: selection of readings, exclusion of sensors, and their return.

Laws without a covariance cannot test an innovation. For them, `ReadingRange` removes outliers such
as 9999, far outside the range of all earlier readings, unless the readings of the sensor stay
there. A fit of stored samples has the readings before and after each reading, and removes readings
far from their neighbours in time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.stepping import Interval

MOVED = 20.0  # standard deviations of the noise: least range that shows the scale of the process
LASTING = 100  # misfitting readings after which a disturbance must be explained by the constants
CALM = 50  # samples without a correction of the state alone, after which a disturbance is over
SETTLED = 20  # used readings after which a lasting misfit is not due to a poor start
ABSURD = 10.0  # ranges outside the range so far, as for the runaway of `Guards`
PATIENCE = 3  # outliers in a row, after which they count as a change of the process
NEIGHBOURS = 3  # neighbours in time on each side of a value
FEW = 2 * NEIGHBOURS  # largest number of values of a sensor for which all count as near
NORMAL = 1.4826  # standard deviation of a normal variable over the median of its absolute value


@dataclass(frozen=True, eq=False)
class Screened:
    """Memory of the gate, by sensor; arrays have the shape (members, sensors)."""

    # Misfitting readings in a row, and how many of them differed from the reading before.
    refused: IntArray
    changes: IntArray
    fits: IntArray  # fitting readings in a row of a sensor that is `excluded` or `state_only`
    taken: IntArray  # number of readings used, at most `SETTLED`
    excluded: Mask  # excluded sensors
    state_only: Mask  # sensors that correct the state but not the unknowns
    # Time of the first misfit in a row, and last misfitting innovation; NaN without a misfit.
    since: Array
    deviation: Array
    # Range of the readings used; NaN before the first.
    low: Array
    high: Array
    # Last reading, number of its repetitions, and largest number of repetitions of a reading used.
    last: Array
    run: IntArray
    longest: IntArray
    strain: IntArray  # misfitting readings of `state_only` sensors since a disturbance began
    # Samples of a disturbance without a `state_only` sensor, at most `CALM`, shape (members,).
    calm: IntArray

    @classmethod
    def start(cls, sensors: int, members: int = 1) -> Screened:
        none = np.zeros((members, sensors), np.int64)
        counts = ("refused", "changes", "fits", "taken", "run", "longest", "strain")
        same: dict[str, Any] = dict.fromkeys(counts, none)
        same |= dict.fromkeys(("since", "deviation", "low", "high", "last"), none + np.nan)
        same |= dict.fromkeys(("excluded", "state_only"), none > 0)
        return cls(calm=np.full(members, CALM), **same)

    def fitted(self, z: Array, present: Mask) -> Screened:
        """Return the memory after a sample without misfit, for members without refusals."""
        last, run, _ = self.shown(z, present)
        return changed(self, last=last, run=run, **self._used(z, run, present, present))

    def shown(self, z: Array, present: Mask) -> tuple[Array, IntArray, Mask]:
        """Return the last reading, its repetitions, and a mask of repetitions, after a sample."""
        same: Mask = present & (z == self.last)
        repeats = np.count_nonzero(same) or np.count_nonzero(self.run)
        run = np.where(same, self.run + 1, 0) if repeats else self.run
        if np.count_nonzero(present) == present.size:
            return z, run, same
        return np.where(present, z, self.last), np.where(present, run, self.run), same

    def used(self, z: Array, kept: Mask, learned: Mask) -> Screened:
        """Return the memory with `kept` readings in the ranges and `learned` ones in the count."""
        return changed(self, **self._used(z, self.run, kept, learned))

    def _used(self, z: Array, run: IntArray, kept: Mask, learned: Mask) -> dict[str, Any]:
        """Return the fields that used readings change; `run`: repetitions after the sample."""
        if np.count_nonzero(kept) < kept.size:
            z = np.where(kept, z, np.nan)
        parts: dict[str, Any] = {"low": np.fmin(self.low, z), "high": np.fmax(self.high, z)}
        # The conditions save time: most samples repeat nothing and are not part of a disturbance.
        if np.count_nonzero(run):
            parts["longest"] = np.maximum(self.longest, np.where(kept, run, 0))
        if self.taken.min() < SETTLED:
            parts["taken"] = np.minimum(self.taken + learned, SETTLED)
        if np.count_nonzero(self.strain):
            calm = np.where(self.state_only.any(axis=1), 0, np.minimum(self.calm + 1, CALM))
            parts |= {"calm": calm, "strain": np.where(calm[:, None] < CALM, self.strain, 0)}
        return parts


class Gated(NamedTuple):
    """Outcome of the gate for a sample, each of shape (members, sensors)."""

    kept: Mask  # readings that correct state and unknowns
    anchored: Mask  # readings that correct the state alone
    counted: Mask  # readings that count in the test for jumps
    state: Screened  # memory of the gate


@dataclass(frozen=True)
class Gate:
    """Refuse readings that do not fit, and interpret a lasting misfit.

    A reading fits if its innovation is at most `beyond` expected standard deviations. After
    `patience` refusals in a row, the readings of a sensor are accepted if they are plausible and
    most sensors with plausible readings misfit too: then the process has changed. Otherwise the
    sensor is excluded, until `patience` readings in a row fit.

    With `anchors`, accepted readings correct the state alone, until `patience` of them in a row fit
    or more than `LASTING` do not: a passing disturbance has no information about constants. Sensors
    with fewer than `SETTLED` used readings also correct the unknowns: their start may be poor.

    Readings are implausible if they repeat a value more often than any earlier reading. So are
    readings beyond the earlier range by more than the largest range of all sensors if they repeat a
    value, and by ten times that range otherwise. Ranges below `MOVED` times the noise do not count.
    """

    beyond: float = math.inf
    patience: int = 10
    anchors: bool = False

    def __call__(
        self,
        x: Screened,
        z: Array,
        d: Array,
        noise: Array,
        far: Mask,
        used: Mask,
        t: float,
        pause: Mask,
    ) -> Gated:
        """Return the decision on a sample at time t, and the memory after it.

        `z`, `d`, `noise`: readings, innovations and their noise, shapes (members, sensors). `far`,
        `used`: masks of misfitting readings and of present readings. `pause`: members for which the
        sample follows a pause, shape (members,).
        """
        last, run, same = x.shown(z, used)
        outside, absurd = self._out_of_range(x, z, noise)
        stuck = run > x.longest
        implausible = absurd | (outside & (run > 0)) | stuck
        # A stuck sensor fits by chance while the prediction crosses its value.
        misfit = far | (used & same & stuck & (x.refused > 0))
        waiting = x.excluded | x.state_only
        over = used & ~misfit & ~waiting
        refused = np.where(misfit, x.refused + 1, np.where(over, 0, x.refused))
        changes = np.where(misfit & ~same, x.changes + 1, np.where(over, 0, x.changes))
        fits = np.where(misfit, 0, np.where(used & ~stuck & waiting, x.fits + 1, x.fits))
        voters = used & ~implausible
        most = 2 * (voters & misfit).sum(axis=1) > voters.sum(axis=1)
        together = most[:, None] & voters
        # A misfit after a pause shows that the state is wrong.
        sudden = misfit & together & pause[:, None] & (x.taken >= SETTLED) & self.anchors
        refused = np.where(sudden, np.maximum(refused, self.patience + 1), refused)
        late, first = misfit & (refused > self.patience), x.refused == self.patience
        believed = late & together & (sudden | (2 * changes >= self.patience))
        excluded = x.excluded & ~believed
        excluded = np.where(late & ~believed, x.excluded | first | implausible, excluded)
        back = waiting & used & ~misfit & (fits >= self.patience)
        excluded = excluded & ~back
        refused, changes = np.where(back, 0, refused), np.where(back, 0, changes)
        kept = used & ~excluded & (~misfit | late)
        repeated = misfit & (refused > 1) & ~excluded & ~implausible & (~outside | together)
        state_only = (refused > self.patience) & ~excluded & (x.taken >= SETTLED) & self.anchors
        strain = x.strain + (state_only & misfit)
        lasting = (strain > LASTING).any(axis=1)[:, None]
        state_only = state_only & ~lasting
        state = changed(
            x,
            # Constants that must explain a lasting misfit start again with a poor fit.
            taken=np.where(lasting, -LASTING, x.taken),
            refused=refused,
            changes=changes,
            fits=np.where(back, 0, fits),
            excluded=excluded,
            state_only=state_only,
            strain=np.where(lasting, 0, strain),
            since=np.where(refused > 0, np.where(x.refused > 0, x.since, t), np.nan),
            deviation=np.where(misfit, d, np.where(refused > 0, x.deviation, np.nan)),
            last=last,
            run=run,
        )
        # A single misfit does not count as a change of the process; a second in a row may.
        anchored = kept & state_only.any(axis=1)[:, None]
        learned = kept & ~anchored
        return Gated(learned, anchored, learned | repeated, state.used(z, kept, learned))

    @staticmethod
    def _out_of_range(x: Screened, z: Array, noise: Array) -> tuple[Mask, Mask]:
        """Return which readings are outside the earlier range by more than 1 and 10 ranges."""
        ranges, beyond = (x.high - x.low) / noise, np.fmax(x.low - z, z - x.high) / noise
        # The sensor that varied most sets the scale: others may not have been affected yet.
        span = np.fmax.reduce(ranges, axis=1, initial=0.0)[:, None]
        moved = span > MOVED
        return moved & (beyond > span), moved & (beyond > ABSURD * span)


@dataclass(frozen=True, eq=False)
class ReadingRange:
    """Range of the readings of each sensor, shapes (sensors,)."""

    # Range of the readings used; NaN before the first.
    low: Array
    high: Array
    count: IntArray  # number of readings used, at most `SETTLED`
    wild: IntArray  # outliers in a row; 0 if the last reading was used

    @classmethod
    def start(cls, sensors: int) -> ReadingRange:
        never, none = np.full(sensors, np.nan), np.zeros(sensors, dtype=np.int64)
        return cls(low=never, high=never, count=none, wild=none)

    def screened(self, interval: Interval, noise: Array | None) -> tuple[Interval, ReadingRange]:
        """Return an interval without outliers at both ends, and the ranges after it."""
        z = interval.z1
        wild = self._wild(z, 0.0 if noise is None else MOVED * noise)
        before = self.wild > 0
        lasting = wild & (self.wild >= PATIENCE)
        wild &= ~lasting
        used = np.where(wild, np.nan, z)
        present = np.isfinite(used)
        after = ReadingRange(
            low=np.fmin(self.low, used),
            high=np.fmax(self.high, used),
            count=np.minimum(self.count + present, SETTLED),
            wild=np.where(wild, self.wild + 1, np.where(present, 0, self.wild)),
        )
        if not (wild.any() or before.any()):
            return interval, after
        z0 = np.where(before, np.nan, interval.z0)
        return replace(interval, z0=z0, z1=used), after

    def _wild(self, z: Array, least: float | Array) -> Mask:
        """Return which readings are far outside the earlier range, on the scale of all sensors."""
        known = self.count >= SETTLED
        none: Mask = np.zeros(len(z), dtype=bool)
        if not known.any():
            return none
        # A change of the process reaches one sensor first, so that all sensors set the scale.
        scale = np.maximum(np.nanmax(self.high) - np.nanmin(self.low), least)
        with np.errstate(invalid="ignore"):
            far: Mask = (z > self.high + ABSURD * scale) | (z < self.low - ABSURD * scale)
        return known & far & (scale > 0.0)


def usual_size(values: Array) -> float:
    """Return a robust standard deviation from the median of absolute values, at least 1."""
    return max(1.0, NORMAL * float(np.median(np.abs(values)))) if len(values) else 1.0


def near_neighbours(values: Array, limit: float) -> Mask:
    """Return which values are within `limit` usual distances from the median of their neighbours.

    Slow changes, such as a model error, pass. Values that fail a first test are compared with
    neighbours that pass it, because the neighbours of an outlier may be outliers too.
    """
    first = _near(values, limit, _of_neighbours)
    near = first.copy()
    for k, column in enumerate(values.T):
        (kept,) = first[:, k].nonzero()
        if len(kept) <= FEW:
            continue
        (others,) = (np.isfinite(column) & ~first[:, k]).nonzero()
        away = np.full(len(column), np.nan)
        away[kept] = column[kept] - _of_neighbours(column[kept])
        begin = np.searchsorted(kept, others) - NEIGHBOURS
        begin = np.clip(begin, 0, len(kept) - 2 * NEIGHBOURS)
        around = kept[begin[:, None] + np.arange(2 * NEIGHBOURS)]
        away[others] = column[others] - np.median(column[around], axis=1)
        near[:, k] = np.abs(away) <= limit * usual_size(away[kept])
    return near


def near_most(values: Array, limit: float) -> Mask:
    """Return which values are within `limit` usual distances from the median of their sensor.

    This detects a constant wrong value, whose neighbours in time agree with it.
    """
    return _near(values, limit, np.median)


def _near(values: Array, limit: float, centre: Callable[[Array], Array]) -> Mask:
    """Return which values are within `limit` usual distances from the centre of their sensor."""
    near = np.isfinite(values)
    for k, column in enumerate(values.T):
        (places,) = near[:, k].nonzero()
        if len(places) > FEW:
            away = column[places] - centre(column[places])
            near[places, k] = np.abs(away) <= limit * usual_size(away)
    return near


def _of_neighbours(values: Array) -> Array:
    """Return the median of the neighbours of each value, without the value, shape (count,)."""
    places = np.arange(len(values))
    first = np.clip(places - NEIGHBOURS, 0, len(values) - 1 - 2 * NEIGHBOURS)
    which = first[:, None] + np.arange(2 * NEIGHBOURS)
    which += which >= places[:, None]
    return np.asarray(np.median(values[which], axis=1))
