"""Ledger of running sums over the innovations: the data of a verdict, in constant memory.

Every array has the members as its leading axis. A *direction* is a possible cause of misfit with
an amplitude of one: an offset of a sensor, a wrong boundary value, a jump of an unknown. If it is
there with the amplitude theta, the whitened innovation r_k of a linear filter is white noise plus
theta g_k, and the sums of g r and g g hold all that the samples tell of theta (Rao 1948).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.verdict.findings import FEWEST, Cause, Finding, Severity, Shifts, channel_setting
from livepde.verdict.model_errors import FAILED, OF_SIGNAL
from livepde.verdict.sentences import FINDINGS, LIKELY, table_of

WINDOWS = (0, 64, 512)
"""Samples after which a window begins anew; 0: the window of all samples. The faults of a window
begin with it, so that an old, sound record does not hide a fault that is new."""

LENGTHS = np.array([length or np.inf for length in WINDOWS])
BATCH = 16  # samples at most that wait until they are summed together
ROOM = 2**16  # numbers at most that they take while they wait
BLOCKS = 16  # of the record of an unknown that stays; they double in length, and pairs merge
CLIP = 4.0  # times the usual size: no whitened innovation counts for more (Huber)
HELD = 0.02  # share of the samples in which the last value of an input was held
CHANCE = 5e-4  # probability of a false alarm of all validation sensors of a run
SIMILAR = 0.05  # relative difference of a slope to that of a unit
UNITS = (
    ("degF", "degC", 1.8, 32.0),
    ("degC", "degF", 1.0 / 1.8, -32.0 / 1.8),
    ("K", "degC", 1.0, 273.15),
    ("degC", "K", 1.0, -273.15),
)
"""Unit that a sensor may have, the one that it is taken for, slope and intercept of that."""


@dataclass(frozen=True, eq=False)
class Ledger:
    """Running sums of each member over the samples so far."""

    # seen, waiting: number of samples, and of those that wait to be summed, shape (members,)
    seen: IntArray
    waiting: IntArray
    rows: Array  # samples that wait, (members, batch, numbers); see `livepde.verdict.judge`
    # Coordinates of all directions in all windows on the rows of the square root as they were when
    # the first of these came, (members, rank, windows times directions)
    w: Array
    times: Array  # time of the last sample that was summed, and the usual interval, (members, 2)
    # first, last: first prediction of each sensor, and the last that was summed, (members,
    # sensors); NaN before
    first: Array
    last: Array
    # age, epoch: samples in each window, and how often it has begun anew, (members, windows)
    age: IntArray
    epoch: IntArray
    # Sums of g r, g g, g_k r_(k-1) + g_(k-1) r_k and g_k g_(k-1) of each window, direction and
    # sensor, shape (members, 4, windows, directions, sensors)
    sums: Array
    # Number of r, and sums of r, r r, r_k r_(k-1) and the number of such pairs, of each window and
    # sensor, shape (members, 5, windows, sensors); r_(k-1) is the last value of the same sensor,
    # however many samples were without one
    noise: Array
    # Whitened innovation and responses of the last value of each sensor, (members, 1 + windows
    # times directions, sensors)
    before: Array
    present: Array  # 1 where a sensor has had a value, shape (members, sensors)
    # score, information: of each block and sensor, about the prior mean: sums of Y r, (members,
    # blocks, sensors, k), and of Y Y^T, (members, blocks, sensors, k, k); k = 0 where they are not
    # kept
    score: Array
    information: Array
    length: IntArray  # samples in a block, shape (members,)
    process: Array  # states by which the process answers a missing term, (members, terms, n)
    # readings, reached: readings due to those states at the first of two times, and their change
    # per unit of time up to the second one, (members, 2, terms, sensors), and these times,
    # (members, 2)
    readings: Array
    reached: Array
    # Whether nothing spoke against the model in the longest window that ended last, (members,)
    sound: Mask
    # How many readings each sensor has shown, and how many of them a gate has refused, (members, 2,
    # sensors)
    shown: IntArray
    # stuck, value: how often in a row each sensor has shown the same value, and that value, shapes
    # (members, sensors)
    stuck: IntArray
    value: Array

    @classmethod
    def start(
        cls,
        sensors: int,
        directions: int,
        followed: int,
        terms: int,
        n: int,
        windows: int,
        rank: int,
        batch: int,
        numbers: int,
    ) -> Ledger:
        """Return the value of one member before any sample.

        `followed`: number k of unknown coordinates of which the record is kept.
        `terms`, `n`: number of missing terms, and of coefficients of the state.
        `rank`, `batch`, `numbers`: rows of the square root, samples that are summed together, and
        numbers of each.
        """
        never, zero = np.full((1, sensors), np.nan), np.zeros(1, dtype=np.int64)
        return cls(
            seen=zero,
            waiting=zero,
            rows=np.zeros((1, batch, numbers)),
            w=np.zeros((1, rank, windows * directions)),
            times=np.full((1, 2), np.nan),
            first=never,
            last=never,
            age=np.zeros((1, windows), dtype=np.int64),
            epoch=np.zeros((1, windows), dtype=np.int64),
            sums=np.zeros((1, 4, windows, directions, sensors)),
            noise=np.zeros((1, 5, windows, sensors)),
            before=np.zeros((1, 1 + windows * directions, sensors)),
            present=np.zeros((1, sensors)),
            score=np.zeros((1, BLOCKS, sensors, followed)),
            information=np.zeros((1, BLOCKS, sensors, followed, followed)),
            length=zero + batch,
            process=np.zeros((1, terms, n)),
            readings=np.zeros((1, 2, terms, sensors)),
            reached=np.full((1, 2), np.nan),
            sound=np.zeros(1, dtype=bool),
            shown=np.zeros((1, 2, sensors), dtype=np.int64),
            stuck=np.zeros((1, sensors), dtype=np.int64),
            value=never,
        )

    def of_member(self, k: int) -> Ledger:
        """Return the ledger of one member, whose arrays have no axis of members."""
        return changed(self, **{name: value[k] for name, value in vars(self).items()})

    @property
    def due(self) -> Mask:
        """Windows that restart with the next sample, shape (members, windows)."""
        return np.asarray((self.age >= LENGTHS[: self.age.shape[1]]) | (self.age == 0))

    def clipped(self, r: Array) -> Array:
        """Return whitened innovations, (members, batch, sensors), none far beyond usual."""
        count, squares = self.noise[:, 0, 0], self.noise[:, 2, 0]
        # Ten samples of the stated noise count beforehand: the first ones are not clipped by
        # chance.
        usual = np.sqrt(np.maximum((squares + 10.0) / (count + 10.0), 1.0))
        limit = CLIP * usual[:, None]
        return np.minimum(np.maximum(r, -limit), limit)


def batch_of(numbers: int) -> int:
    """Return how many samples of so many numbers are summed together: a power of two."""
    batch = BATCH
    while batch > 1 and batch * numbers > ROOM:
        batch //= 2
    return batch


def summed(old: Ledger, due: Mask, whitened: Array, used: Array) -> dict[str, Array]:
    """Return `sums`, `noise`, `before` and `present` after a batch of samples.

    `due`: windows that begin with this batch, (members, windows).
    `whitened`: innovations r, and responses g of each direction in each window, (members, batch,
    sensors, 1 + windows * directions); zero where no value is.
    `used`: 1 where there is a value, (members, batch, sensors).
    """
    members, _, sensors, _ = whitened.shape
    windows, directions = old.sums.shape[2:4]
    # Sums of windows that begin anew start from nothing.
    kept = ~(due & (old.age > 0))
    # The last value before the batch comes first: products of successive values need it.
    before = old.before.copy()
    before[:, 1:].reshape(members, windows, -1)[~kept] = 0.0
    row = np.concatenate([before.swapaxes(1, 2)[:, None], whitened], axis=1)
    present = np.concatenate([old.present[:, None], used], axis=1)
    # Row of the last value of each sensor: sensors need not have values in the same samples.
    place = np.arange(row.shape[1])[:, None]
    newest = np.maximum.accumulate(np.where(present > 0.0, place, 0), axis=1)
    now, earlier = row[:, 1:], row[:, :-1]
    if not (present > 0.0).all():
        earlier = np.take_along_axis(row, newest[:, :-1, :, None], axis=1)
    pair = used * np.maximum.accumulate(present, axis=1)[:, :-1]
    # Weights of g in two sums: of g_k r_k, and of g_k r_(k-1) + g_(k-1) r_k.
    weights = np.zeros((2, *row.shape[:3]))
    weights[0, :, 1:], weights[1, :, 1:] = now[..., 0], earlier[..., 0]
    each = np.arange(members)[:, None, None], newest[:, :-1], np.arange(sensors)
    np.add.at(weights[1], each, now[..., 0])
    crossed = weights.transpose(1, 3, 0, 2) @ row.swapaxes(1, 2)  # (members, sensors, 2, columns)
    squares = np.einsum("mbsc,mbsc->msc", now, now)
    lagged = np.einsum("mbsc,mbsc->msc", now, earlier)
    found = np.stack([crossed[:, :, 0], squares, crossed[:, :, 1], lagged], axis=1)
    sums = found[..., 1:].reshape(members, 4, sensors, windows, directions)
    r = now[..., 0].sum(axis=1)
    parts = [used.sum(axis=1), r, squares[..., 0], lagged[..., 0], pair.sum(axis=1)]
    return {
        "sums": old.sums * kept[:, None, :, None, None] + sums.transpose(0, 1, 3, 4, 2),
        "noise": old.noise * kept[:, None, :, None] + np.stack(parts, axis=1)[:, :, None],
        "before": np.take_along_axis(row, newest[:, -1:, :, None], axis=1)[:, 0].swapaxes(1, 2),
        "present": np.maximum(old.present, used.max(axis=1)),
    }


def blocked(old: Ledger, Y: Array, r: Array) -> dict[str, Any]:
    """Return `score`, `information` and `length` after a batch of samples.

    `Y`, `r`: sensitivities to the followed unknowns, (members, batch, k, sensors), and residuals at
    the prior mean, (members, batch, sensors), in units of the noise; zero where no value is.
    """
    score, information, length = old.score, old.information, old.length
    # All blocks are in use: neighbours merge, and each holds twice as many samples from now on.
    before = old.seen - old.waiting
    full = before // length >= BLOCKS
    if full.any():
        score, information = _merged(score, full), _merged(information, full)
        length = np.where(full, 2 * length, length)
    at = np.arange(len(length)), before // length
    score, information = score.copy(), information.copy()
    Y = Y.transpose(0, 3, 2, 1)  # (members, sensors, k, batch)
    score[at] += (Y @ r.swapaxes(1, 2)[..., None])[..., 0]
    information[at] += Y @ Y.swapaxes(2, 3)
    return {"score": score, "information": information, "length": length}


def _merged(values: Array, full: Mask) -> Array:
    """Return blocks of which neighbours are merged, for some members."""
    merged = np.zeros_like(values)
    merged[:, : BLOCKS // 2] = values[:, ::2] + values[:, 1::2]
    chosen = full.reshape(-1, *(1,) * (values.ndim - 1))
    return np.where(chosen, merged, values)


@dataclass(frozen=True, eq=False)
class InputLedger:
    """Gaps of the input channels so far."""

    # Number of samples, and of those in which each channel was held, shape (1 + channels,)
    counts: IntArray
    # Time for which each channel has been held by now, shape (channels,); 0 if it has a value
    held: Array
    # 1 for each channel without a value at the initial time, whose first one was held over the
    # first interval, shape (channels,)
    unstated: Array

    @classmethod
    def start(cls, channels: int) -> InputLedger:
        none = np.zeros(channels)
        return cls(counts=np.zeros(1 + channels, dtype=np.int64), held=none, unstated=none)

    def add(self, length: float, missing: Array) -> InputLedger:
        """Return the value after an interval; `missing`: 1 for channels that are held at its end.

        The interval in which a channel has a value again is no gap: there the value changes.
        """
        counts = self.counts.copy()
        counts[0] += 1  # of all samples
        held = self.held
        if np.count_nonzero(missing) or np.count_nonzero(held):
            counts[1:] += missing > 0.0
            held = (held + length) * missing
        return InputLedger(counts, held, self.unstated)

    @property
    def silent(self) -> bool:
        """True if no channel was ever held."""
        return not (any(self.counts.tolist()[1:]) or any(self.unstated.tolist()))

    def gaps(self, names: Sequence[str], missing: Array) -> dict[str, tuple[float, bool]]:
        """Return for how long channels were held by now, and whether they are once more."""
        each = zip(names, self.held.tolist(), (missing > 0.0).tolist(), strict=True)
        return {name: (held, again) for name, held, again in each if held or again}

    def findings(self, names: Sequence[str], shifts: Shifts[float]) -> Iterator[Finding]:
        """Return which channels were held in more than 2 % of the samples, and which at the start.

        `shifts`: of the estimate, with the shift of each unknown by its inputs.
        """
        samples = max(int(self.counts[0]), 1)
        each = shifts.by("input").items()
        by = ", ".join(f"{label} by {-shift:+.2g}" for label, shift in each)
        for name in itertools.compress(names, self.unstated.tolist()):
            text, remedy = FINDINGS["input, start"].filled(name=name)
            yield Finding("input", "note", text, name, remedy=remedy)
        for name, count in zip(names, self.counts[1:].tolist(), strict=True):
            share = count / samples
            if share <= HELD:
                continue
            sentence = FINDINGS["input, gaps" if by else "input, gaps, unknown shift"]
            text, remedy = sentence.filled(name=name, count=count, samples=samples, shifts=by)
            yield Finding("input", "caution", text, name, share, remedy=remedy)


@dataclass(frozen=True, eq=False)
class ValidationLedger:
    """Sums over the values of each validation sensor, in constant memory."""

    # Shape (9, sensors): number of values and of successive pairs; sums of half the squared
    # difference of those, of squared errors, errors, predictions p, p p, p z, and of the variance
    # that is predicted
    sums: Array
    last: Array  # last error of each sensor, shape (sensors,); NaN before

    @classmethod
    def start(cls, sensors: int) -> ValidationLedger:
        return cls(np.zeros((9, sensors)), np.full(sensors, np.nan))

    def add(self, z: Array, predicted: Array, variance: Array) -> ValidationLedger:
        """Return the value after a sample; z is NaN where missing.

        `variance`: of the prediction, without noise, shape (sensors,).
        """
        error = z - predicted
        seen = np.isfinite(error)
        if not seen.any():
            return self
        # A sensor need not have a value in each sample: its last value is where it had one.
        step = error - self.last
        pair = np.isfinite(step)
        rows = np.array(
            [
                np.ones_like(z),
                pair,
                np.where(pair, 0.5 * step**2, 0.0),
                error**2,
                error,
                predicted,
                predicted**2,
                predicted * z,
                variance,
            ],
            dtype=float,
        )
        last = np.where(seen, error, self.last)
        return ValidationLedger(self.sums + np.where(seen, rows, 0.0), last)

    def findings(
        self, names: Sequence[str], ignored: Collection[str] = (), units: Sequence[str] = ()
    ) -> Iterator[Finding]:
        """Return which sensors, without ignored ones, are missed by more than prediction and noise.

        The errors of one sensor are correlated as far as they come from the unknowns: so their mean
        square over its expected value counts as one draw of chi-square. The noise is estimated from
        successive differences.
        """
        for k, name in enumerate(names):
            if name in ignored or self.sums[0, k] < FEWEST:
                continue
            count, pairs, differences, squares, errors, *_, variance = self.sums[:, k]
            noise = differences / max(pairs, 1.0)
            ratio = squares / count / max(noise + variance / count, 1e-300)
            p = min(1.0, chance(ratio, 1) * (len(names) - len(ignored)))
            if p > CHANCE:
                continue
            size = math.sqrt(squares / count)
            unit = f" {units[k]}".replace("degC", "K").rstrip() if units else ""
            text, _ = FINDINGS["validation"].filled(
                name=name, size=size, mean=errors / count, ratio=math.sqrt(ratio), unit=unit
            )
            likely, remedy = LIKELY["validation"].filled(name=name)
            cause = self._unit(k, name) or Cause("validation", name, likely, remedy=remedy)
            # A small error shows that the model is not exact, a gross one that it is wrong.
            gross = size > FAILED * math.sqrt(noise) and size > OF_SIGNAL * self._scatter(k)
            severity: Severity = "do not trust" if gross or cause.kind == "unit" else "caution"
            yield Finding("validation", severity, text, name, p, "p-value", (cause,))

    def _scatter(self, k: int) -> float:
        count, _, _, squares, errors, p, pp, pz, _ = self.sums[:, k]
        mean = (errors + p) / count
        return math.sqrt(max((squares + 2.0 * pz - pp) / count - mean**2, 0.0))

    def _unit(self, k: int, name: str) -> Cause | None:
        """Return the cause that a sensor has another unit, if its values indicate that."""
        count, _, _, _, errors, p, pp, pz, _ = self.sums[:, k]
        mean_p, mean_z = p / count, (errors + p) / count
        spread = pp / count - mean_p**2
        if not spread > 0.0:
            return None
        slope = (pz / count - mean_p * mean_z) / spread
        rest = max(math.sqrt(spread), 1e-300)
        for unit, taken, scale, origin in UNITS:
            off = abs(mean_z - (scale * mean_p + origin))
            if abs(slope / scale - 1.0) < 4.0 * SIMILAR and off < rest:
                text, remedy = LIKELY["unit"].filled(
                    name=name, unit=unit, expected=taken, table=table_of(name)
                )
                setting = channel_setting(name, "unit", f'"{unit}"')
                return Cause("unit", name, text, remedy=remedy, setting=setting)
        return None


def chance(statistic: float, freedom: int) -> float:
    """Return the probability of a larger value of the chi-square distribution."""
    return float(scipy.special.gammaincc(0.5 * freedom, 0.5 * statistic))
