"""The gate: which readings are used, which sensors are excluded, and when they return.

Laws without a covariance cannot weigh an innovation: `ReadingRange` leaves out wild values, such as
9999, far outside all that has been measured. If the readings of the sensor stay there, the process
has moved. A fit of stored samples, which knows the readings before and after each, leaves out those
that are far from their neighbours.
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

MOVED = 20.0  # standard deviations of the noise: a smaller range does not show the process's size
LASTING = 100  # readings that misfit, after which constants have to explain them as well
CALM = 50  # samples without a correction of the state, after which a disturbance is over
SETTLED = 20  # readings used, before which a lasting misfit may come from a poor start
ABSURD = 10.0  # ranges outside of the past, as the runaway of `Guards`
PATIENCE = 3  # wild readings in a row, after which the process has moved
NEIGHBOURS = 3  # in time, to each side of a value
FEW = 2 * NEIGHBOURS  # values of a sensor up to which all count as near
NORMAL = 1.4826  # standard deviation of normal values over the median of their sizes


@dataclass(frozen=True, eq=False)
class Screened:
    """Memory of the gate, by sensor; arrays have the shape (members, sensors)."""

    # Refusals in a row, and how many of these readings differed from the one before.
    refused: IntArray
    changes: IntArray
    fits: IntArray  # readings in a row that fit, of a sensor of which too many did not
    taken: IntArray  # readings that were used, at most `SETTLED`
    aside: Mask  # sensors that are set aside
    apart: Mask  # sensors that are believed, and correct the state but not the unknowns
    # Time of the first refusal in a row, and the last innovation; NaN without a refusal.
    since: Array
    off: Array
    # Range of the readings that were used; NaN before.
    low: Array
    high: Array
    # The last reading, how often it has been repeated, and the longest repetition of a reading that
    # was used.
    last: Array
    run: IntArray
    longest: IntArray
    # Readings that misfit while they corrected the state, since a disturbance began.
    strain: IntArray
    # Samples of a disturbance since a sensor was `apart`, at most `CALM`, shape (members,).
    calm: IntArray

    @classmethod
    def start(cls, sensors: int, members: int = 1) -> Screened:
        none = np.zeros((members, sensors), np.int64)
        counts = ("refused", "changes", "fits", "taken", "run", "longest", "strain")
        same: dict[str, Any] = dict.fromkeys(counts, none)
        same |= dict.fromkeys(("since", "off", "low", "high", "last"), none + np.nan)
        same |= dict.fromkeys(("aside", "apart"), none > 0)
        return cls(calm=np.full(members, CALM), **same)

    def fitted(self, z: Array, present: Mask) -> Screened:
        """Return the value after a sample that all fit, of members that refuse nothing."""
        last, run, _ = self.shown(z, present)
        return changed(self, last=last, run=run, **self._used(z, run, present, present))

    def shown(self, z: Array, present: Mask) -> tuple[Array, IntArray, Mask]:
        """Return the last reading and its repetitions after a sample, and which ones it repeats."""
        same: Mask = present & (z == self.last)
        repeats = np.count_nonzero(same) or np.count_nonzero(self.run)
        run = np.where(same, self.run + 1, 0) if repeats else self.run
        if np.count_nonzero(present) == present.size:
            return z, run, same
        return np.where(present, z, self.last), np.where(present, run, self.run), same

    def used(self, z: Array, kept: Mask, learned: Mask) -> Screened:
        """Return the value with the readings that are used in the past of their sensors."""
        return changed(self, **self._used(z, self.run, kept, learned))

    def _used(self, z: Array, run: IntArray, kept: Mask, learned: Mask) -> dict[str, Any]:
        """Return the fields that readings change which are used; `run` is that after them."""
        if np.count_nonzero(kept) < kept.size:
            z = np.where(kept, z, np.nan)
        parts: dict[str, Any] = {"low": np.fmin(self.low, z), "high": np.fmax(self.high, z)}
        # Most samples repeat nothing, come after the first ones, and in no disturbance.
        if np.count_nonzero(run):
            parts["longest"] = np.maximum(self.longest, np.where(kept, run, 0))
        if self.taken.min() < SETTLED:
            parts["taken"] = np.minimum(self.taken + learned, SETTLED)
        if np.count_nonzero(self.strain):
            calm = np.where(self.apart.any(axis=1), 0, np.minimum(self.calm + 1, CALM))
            parts |= {"calm": calm, "strain": np.where(calm[:, None] < CALM, self.strain, 0)}
        return parts


class Gated(NamedTuple):
    """Outcome of the gate for a sample, each of shape (members, sensors)."""

    kept: Mask  # readings that are used
    anchored: Mask  # readings that correct the state alone
    counted: Mask  # readings that count in the test for jumps
    state: Screened  # memory of the gate


@dataclass(frozen=True)
class Gate:
    """Refuses readings that do not fit, and interprets a lasting misfit.

    A reading fits if its innovation is at most `beyond` expected standard deviations. After
    `patience` refusals in a row the sensor is believed if its readings are plausible and most of
    the sensors that can be believed misfit as well: then the process has changed. Else the sensor
    is set aside, until `patience` readings in a row fit again.

    If `anchors`, believed readings correct the state alone until `patience` of them in a row fit,
    or `LASTING` did not: a disturbance that passes says nothing on constants of the model. Sensors
    that were never used much are believed at once, because a poor start misfits as well.

    Readings are implausible if they repeat a value more often than the sensor ever did, if they
    repeat a value outside its past range by more than the largest range of all sensors, or if they
    lie outside by ten times that. The range counts once it shows how far the process moves.
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
        """Return the used part of a sample at time t.

        `z`, `d`, `noise`: readings, innovations and their noise, shapes (members, sensors). `far`,
        `used`: readings that do not fit, and those that are present. `pause`: members for which the
        sample follows a pause, shape (members,).
        """
        last, run, same = x.shown(z, used)
        outside, absurd = self._out_of_range(x, z, noise)
        stuck = run > x.longest
        implausible = absurd | (outside & (run > 0)) | stuck
        # A constant that the prediction crosses fits by chance.
        misfit = far | (used & same & stuck & (x.refused > 0))
        waiting = x.aside | x.apart
        over = used & ~misfit & ~waiting
        refused = np.where(misfit, x.refused + 1, np.where(over, 0, x.refused))
        changes = np.where(misfit & ~same, x.changes + 1, np.where(over, 0, x.changes))
        fits = np.where(misfit, 0, np.where(used & ~stuck & waiting, x.fits + 1, x.fits))
        voters = used & ~implausible
        most = 2 * (voters & misfit).sum(axis=1) > voters.sum(axis=1)
        together = most[:, None] & voters
        # What misfits after a pause shows that the state is wrong.
        sudden = misfit & together & pause[:, None] & (x.taken >= SETTLED) & self.anchors
        refused = np.where(sudden, np.maximum(refused, self.patience + 1), refused)
        late, first = misfit & (refused > self.patience), x.refused == self.patience
        believed = late & together & (sudden | (2 * changes >= self.patience))
        aside = np.where(late & ~believed, x.aside | first | implausible, x.aside & ~believed)
        back = waiting & used & ~misfit & (fits >= self.patience)
        aside = aside & ~back
        refused, changes = np.where(back, 0, refused), np.where(back, 0, changes)
        kept = used & ~aside & (~misfit | late)
        again = misfit & (refused > 1) & ~aside & ~implausible & (~outside | together)
        apart = (refused > self.patience) & ~aside & (x.taken >= SETTLED) & self.anchors
        strain = x.strain + (apart & misfit)
        lasting = (strain > LASTING).any(axis=1)[:, None]
        apart = apart & ~lasting
        state = changed(
            x,
            # Constants that have to explain what lasts begin again with a poor fit.
            taken=np.where(lasting, -LASTING, x.taken),
            refused=refused,
            changes=changes,
            fits=np.where(back, 0, fits),
            aside=aside,
            apart=apart,
            strain=np.where(lasting, 0, strain),
            since=np.where(refused > 0, np.where(x.refused > 0, x.since, t), np.nan),
            off=np.where(misfit, d, np.where(refused > 0, x.off, np.nan)),
            last=last,
            run=run,
        )
        # One value alone is no change of the process; a second one in a row may be.
        anchored = kept & apart.any(axis=1)[:, None]
        learned = kept & ~anchored
        return Gated(learned, anchored, learned | again, state.used(z, kept, learned))

    @staticmethod
    def _out_of_range(x: Screened, z: Array, noise: Array) -> tuple[Mask, Mask]:
        """Return which readings lie outside their past by more than one range, and by ten."""
        ranges, beyond = (x.high - x.low) / noise, np.fmax(x.low - z, z - x.high) / noise
        # That of the sensor that has varied most: others may lie where little has happened yet.
        span = np.fmax.reduce(ranges, axis=1, initial=0.0)[:, None]
        moved = span > MOVED
        return moved & (beyond > span), moved & (beyond > ABSURD * span)


@dataclass(frozen=True, eq=False)
class ReadingRange:
    """Range of the readings of each sensor, shapes (sensors,)."""

    # Range of the readings that were used; NaN before any.
    low: Array
    high: Array
    count: IntArray  # number of readings that were used, at most `SETTLED`
    wild: IntArray  # wild readings in a row; of a sensor whose last reading was used 0

    @classmethod
    def start(cls, sensors: int) -> ReadingRange:
        never, none = np.full(sensors, np.nan), np.zeros(sensors, dtype=np.int64)
        return cls(low=never, high=never, count=none, wild=none)

    def screened(self, interval: Interval, noise: Array | None) -> tuple[Interval, ReadingRange]:
        """Return an interval without wild readings at both ends, and the value after it."""
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
        """Return which readings are far outside their past and that of the other sensors."""
        known = self.count >= SETTLED
        none: Mask = np.zeros(len(z), dtype=bool)
        if not known.any():
            return none
        # A process that begins to move is seen by one sensor first: the scale is that of all.
        scale = np.maximum(np.nanmax(self.high) - np.nanmin(self.low), least)
        with np.errstate(invalid="ignore"):
            far: Mask = (z > self.high + ABSURD * scale) | (z < self.low - ABSURD * scale)
        return known & far & (scale > 0.0)


def usual_size(values: Array) -> float:
    """Return the standard deviation by the median of the sizes of values, at least 1."""
    return max(1.0, NORMAL * float(np.median(np.abs(values)))) if len(values) else 1.0


def near_neighbours(values: Array, limit: float) -> Mask:
    """Return which values lie within `limit` usual distances from the median of their neighbours.

    A model error, which changes slowly, stays. Values that are near tell about the others: among
    several wild ones in a row the neighbours of one are no measure.
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
    """Return which values lie within `limit` usual distances from the median of all of a sensor.

    A sensor that shows a wrong constant for some time has neighbours that agree with it.
    """
    return _near(values, limit, np.median)


def _near(values: Array, limit: float, centre: Callable[[Array], Array]) -> Mask:
    """Return which values lie within `limit` usual distances from the centre of their sensor."""
    near = np.isfinite(values)
    for k, column in enumerate(values.T):
        (places,) = near[:, k].nonzero()
        if len(places) > FEW:
            away = column[places] - centre(column[places])
            near[places, k] = np.abs(away) <= limit * usual_size(away)
    return near


def _of_neighbours(values: Array) -> Array:
    """Return the median of the neighbours of each value, itself left out, shape (count,)."""
    count, reach = len(values), NEIGHBOURS
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * reach + 1)
    inner = np.median(np.delete(windows, reach, axis=1), axis=1)
    edges = {k: np.r_[0:k, k + 1 : 2 * reach + 1] for k in range(reach)}
    first = [np.median(values[which]) for which in edges.values()]
    last = [np.median(values[count - 1 - which]) for which in edges.values()]
    return np.concatenate([first, inner, last[::-1]])
