"""Ledger of running sums over the innovations: the data of a verdict, in constant memory.

The leading axis of every array is over members. A *direction* is a possible cause of misfit of unit
amplitude, such as an offset of a sensor, a wrong boundary value, or a jump of an unknown. If its
amplitude is theta, the whitened innovation r_k of a linear filter is white noise plus theta g_k.
The sums of g r and g g are then sufficient statistics for theta (Rao 1948).
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
"""Number of samples after which a window restarts; 0 for the window of all samples. Faults start
with their window, so that a long record without evidence does not hide a recent fault."""

LENGTHS = np.array([length or np.inf for length in WINDOWS])
BATCH = 16  # most samples that are summed together
ROOM = 2**16  # most numbers that waiting samples occupy
BLOCKS = 16  # most blocks of the record; if all are in use, pairs merge and the length doubles
CLIP = 4.0  # bound of a whitened innovation over its usual size (Huber)
HELD = 0.02  # share of samples with a held input above which there is a finding
CHANCE = 5e-4  # probability of a false alarm by any validation sensor of a run
SIMILAR = 0.05  # a slope may differ from the slope of a unit by four times this share
UNITS = (
    ("degF", "degC", 1.8, 32.0),
    ("degC", "degF", 1.0 / 1.8, -32.0 / 1.8),
    ("K", "degC", 1.0, 273.15),
    ("degC", "K", 1.0, -273.15),
)
"""Possible unit of a sensor, configured unit, and slope and intercept of the conversion."""


@dataclass(frozen=True, eq=False)
class Ledger:
    """Running sums of each member over the samples so far."""

    # seen, waiting: number of samples, and number of samples not yet summed, (members,)
    seen: IntArray
    waiting: IntArray
    rows: Array  # waiting samples, (members, batch, numbers); see `livepde.verdict.judge`
    # Coordinates of all directions in all windows, relative to the rows of the square root before
    # the first waiting sample, (members, rank, windows * directions)
    w: Array
    times: Array  # time of the last summed sample, and the usual interval, (members, 2)
    # first, last: predictions of the first sample and of the last summed sample, (members,
    # sensors); initially NaN
    first: Array
    last: Array
    # age, epoch: number of samples in each window, and number of its restarts, (members, windows)
    age: IntArray
    epoch: IntArray
    # Sums of g r, g g, g_k r_(k-1) + g_(k-1) r_k and g_k g_(k-1) for each window, direction and
    # sensor, (members, 4, windows, directions, sensors)
    sums: Array
    # Number of r, sums of r, r r and r_k r_(k-1), and number of such pairs for each window and
    # sensor, (members, 5, windows, sensors); r_(k-1) is the previous value of the same sensor, also
    # across samples without a value
    noise: Array
    # Whitened innovation and responses of the last value of each sensor, (members, 1 + windows
    # * directions, sensors)
    before: Array
    present: Array  # 1 if a sensor has had a value, (members, sensors)
    # score, information: sums of Y r, (members, blocks, sensors, k), and of Y Y^T, (members,
    # blocks, sensors, k, k), about the prior mean; k = 0 if there is no record
    score: Array
    information: Array
    length: IntArray  # samples in a block, (members,)
    process: Array  # responses of the state to missing terms, (members, terms, n)
    # readings, reached: readings due to these responses at the first of two times, and their slope
    # up to the second time, (members, 2, terms, sensors), and the two times, (members, 2)
    readings: Array
    reached: Array
    # Whether the longest window was free of evidence when it last ended, (members,)
    sound: Mask
    # Number of readings of each sensor, and number of rejected readings, (members, 2, sensors)
    shown: IntArray
    # stuck, value: number of successive repetitions of the latest value of each sensor, and that
    # value, (members, sensors)
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
        """Return the ledger of one member before any sample.

        `followed`: number k of unknown coordinates with a record.
        `terms`, `n`: number of missing terms and of coefficients of the state.
        `rank`, `batch`, `numbers`: rows of the square root, samples that are summed together, and
        numbers per sample.
        """
        no_value, zero = np.full((1, sensors), np.nan), np.zeros(1, dtype=np.int64)
        return cls(
            seen=zero,
            waiting=zero,
            rows=np.zeros((1, batch, numbers)),
            w=np.zeros((1, rank, windows * directions)),
            times=np.full((1, 2), np.nan),
            first=no_value,
            last=no_value,
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
            value=no_value,
        )

    def of_member(self, k: int) -> Ledger:
        """Return the ledger of one member, with arrays without the axis of members."""
        return changed(self, **{name: value[k] for name, value in vars(self).items()})

    @property
    def due(self) -> Mask:
        """Windows that restart with the next sample, shape (members, windows)."""
        return np.asarray((self.age >= LENGTHS[: self.age.shape[1]]) | (self.age == 0))

    def clipped(self, r: Array) -> Array:
        """Return whitened innovations clipped to `CLIP` times their usual size.

        Shape (members, batch, sensors).
        """
        count, squares = self.noise[:, 0, 0], self.noise[:, 2, 0]
        # The prior is worth ten samples of unit size, so that early values are rarely clipped.
        usual = np.sqrt(np.maximum((squares + 10.0) / (count + 10.0), 1.0))
        limit = CLIP * usual[:, None]
        return np.minimum(np.maximum(r, -limit), limit)


def batch_of(numbers: int) -> int:
    """Return how many samples are summed together: a power of two that fits into `ROOM`."""
    batch = BATCH
    while batch > 1 and batch * numbers > ROOM:
        batch //= 2
    return batch


def summed(old: Ledger, due: Mask, whitened: Array, used: Array) -> dict[str, Array]:
    """Return `sums`, `noise`, `before` and `present` after a batch of samples.

    `due`: windows that begin with this batch, (members, windows).
    `whitened`: innovations r, and responses g to each direction in each window, (members, batch,
    sensors, 1 + windows * directions); zero without a value.
    `used`: 1 if there is a value, else 0, (members, batch, sensors).
    """
    members, _, sensors, _ = whitened.shape
    windows, directions = old.sums.shape[2:4]
    # Sums of restarting windows are reset to zero.
    continued = ~(due & (old.age > 0))
    # Prepend the last value before the batch, for products of successive values.
    before = old.before.copy()
    before[:, 1:].reshape(members, windows, -1)[~continued] = 0.0
    row = np.concatenate([before.swapaxes(1, 2)[:, None], whitened], axis=1)
    present = np.concatenate([old.present[:, None], used], axis=1)
    # Row of the latest value of each sensor: sensors may have values in different samples.
    index = np.arange(row.shape[1])[:, None]
    newest = np.maximum.accumulate(np.where(present > 0.0, index, 0), axis=1)
    now, earlier = row[:, 1:], row[:, :-1]
    if not (present > 0.0).all():
        earlier = np.take_along_axis(row, newest[:, :-1, :, None], axis=1)
    pair = used * np.maximum.accumulate(present, axis=1)[:, :-1]
    # Weights of g in the sums of g_k r_k and of g_k r_(k-1) + g_(k-1) r_k.
    weights = np.zeros((2, *row.shape[:3]))
    weights[0, :, 1:], weights[1, :, 1:] = now[..., 0], earlier[..., 0]
    indices = np.arange(members)[:, None, None], newest[:, :-1], np.arange(sensors)
    np.add.at(weights[1], indices, now[..., 0])
    crossed = weights.transpose(1, 3, 0, 2) @ row.swapaxes(1, 2)  # (members, sensors, 2, columns)
    squares = np.einsum("mbsc,mbsc->msc", now, now)
    lagged = np.einsum("mbsc,mbsc->msc", now, earlier)
    stacked = np.stack([crossed[:, :, 0], squares, crossed[:, :, 1], lagged], axis=1)
    sums = stacked[..., 1:].reshape(members, 4, sensors, windows, directions)
    r = now[..., 0].sum(axis=1)
    counts = [used.sum(axis=1), r, squares[..., 0], lagged[..., 0], pair.sum(axis=1)]
    return {
        "sums": old.sums * continued[:, None, :, None, None] + sums.transpose(0, 1, 3, 4, 2),
        "noise": old.noise * continued[:, None, :, None] + np.stack(counts, axis=1)[:, :, None],
        "before": np.take_along_axis(row, newest[:, -1:, :, None], axis=1)[:, 0].swapaxes(1, 2),
        "present": np.maximum(old.present, used.max(axis=1)),
    }


def blocked(old: Ledger, Y: Array, r: Array) -> dict[str, Any]:
    """Return `score`, `information` and `length` after a batch of samples.

    `Y`, `r`: sensitivities to the followed unknowns, (members, batch, k, sensors), and residuals at
    the prior mean, (members, batch, sensors), in units of the noise; zero without a value.
    """
    score, information, length = old.score, old.information, old.length
    # If all blocks are in use, merge neighbours and double the number of samples in a block.
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
    """Return blocks with neighbours merged for the members in the mask `full`."""
    merged = np.zeros_like(values)
    merged[:, : BLOCKS // 2] = values[:, ::2] + values[:, 1::2]
    chosen = full.reshape(-1, *(1,) * (values.ndim - 1))
    return np.where(chosen, merged, values)


@dataclass(frozen=True, eq=False)
class InputLedger:
    """Gaps of the input channels so far."""

    # Number of samples, and number of samples in which each channel was held, (1 + channels,)
    counts: IntArray
    # Time since the last value of each channel, (channels,); 0 if it has a value
    held: Array
    # 1 for each channel without a value at the initial time, whose first value was used for the
    # first interval, (channels,)
    unstated: Array

    @classmethod
    def start(cls, channels: int) -> InputLedger:
        none = np.zeros(channels)
        return cls(counts=np.zeros(1 + channels, dtype=np.int64), held=none, unstated=none)

    def add(self, length: float, missing: Array) -> InputLedger:
        """Return the ledger after an interval; `missing`: 1 for channels that are held at its end.

        An interval at whose end a channel has a value does not count as a gap.
        """
        counts = self.counts.copy()
        counts[0] += 1
        held = self.held
        if np.count_nonzero(missing) or np.count_nonzero(held):
            counts[1:] += missing > 0.0
            held = (held + length) * missing
        return InputLedger(counts, held, self.unstated)

    @property
    def silent(self) -> bool:
        """Whether no channel was ever held."""
        return not (any(self.counts.tolist()[1:]) or any(self.unstated.tolist()))

    def gaps(self, names: Sequence[str], missing: Array) -> dict[str, tuple[float, bool]]:
        """Return channel -> (duration of its gap, whether it continues), for channels in a gap."""
        channels = zip(names, self.held.tolist(), (missing > 0.0).tolist(), strict=True)
        return {name: (held, continues) for name, held, continues in channels if held or continues}

    def findings(self, names: Sequence[str], shifts: Shifts[float]) -> Iterator[Finding]:
        """Yield findings on channels without a value at the start or in many samples (`HELD`).

        `shifts`: shifts of the estimate, including those due to interpolation of inputs.
        """
        samples = max(int(self.counts[0]), 1)
        input_shifts = shifts.by("input").items()
        phrase = ", ".join(f"{label} by {-shift:+.2g}" for label, shift in input_shifts)
        for name in itertools.compress(names, self.unstated.tolist()):
            text, remedy = FINDINGS["input, start"].filled(name=name)
            yield Finding("input", "note", text, name, remedy=remedy)
        for name, count in zip(names, self.counts[1:].tolist(), strict=True):
            share = count / samples
            if share <= HELD:
                continue
            sentence = FINDINGS["input, gaps" if phrase else "input, gaps, unknown shift"]
            text, remedy = sentence.filled(name=name, count=count, samples=samples, shifts=phrase)
            yield Finding("input", "caution", text, name, share, remedy=remedy)


@dataclass(frozen=True, eq=False)
class ValidationLedger:
    """Sums over the values of each validation sensor, in constant memory."""

    # Shape (9, sensors): number of values and of successive pairs; sums of half the squared
    # difference of errors in a pair, of squared errors, errors, predictions p, p p, p z, and
    # predicted variances
    sums: Array
    last: Array  # last error of each sensor, (sensors,); initially NaN

    @classmethod
    def start(cls, sensors: int) -> ValidationLedger:
        return cls(np.zeros((9, sensors)), np.full(sensors, np.nan))

    def add(self, z: Array, predicted: Array, variance: Array) -> ValidationLedger:
        """Return the ledger after a sample; missing values of z are NaN.

        `variance`: variance of the prediction without noise, (sensors,).
        """
        error = z - predicted
        seen = np.isfinite(error)
        if not seen.any():
            return self
        # The previous error of a sensor may be several samples old.
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
        """Yield findings on sensors, except ignored ones, with significant prediction errors.

        Errors of a sensor that are due to the unknowns are correlated. Therefore the ratio of their
        mean square to its expected value is tested as a single chi-square variable. The noise is
        estimated from successive differences.
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
            # A small error means that the model is inexact, a gross error that it is wrong.
            gross = size > FAILED * math.sqrt(noise) and size > OF_SIGNAL * self._scatter(k)
            severity: Severity = "do not trust" if gross or cause.kind == "unit" else "caution"
            yield Finding("validation", severity, text, name, p, "p-value", (cause,))

    def _scatter(self, k: int) -> float:
        count, _, _, squares, errors, p, pp, pz, _ = self.sums[:, k]
        mean = (errors + p) / count
        return math.sqrt(max((squares + 2.0 * pz - pp) / count - mean**2, 0.0))

    def _unit(self, k: int, name: str) -> Cause | None:
        """Return the cause that a sensor has another unit, if its values indicate that; or None."""
        count, _, _, _, errors, p, pp, pz, _ = self.sums[:, k]
        mean_p, mean_z = p / count, (errors + p) / count
        spread = pp / count - mean_p**2
        if not spread > 0.0:
            return None
        slope = (pz / count - mean_p * mean_z) / spread
        tolerance = max(math.sqrt(spread), 1e-300)
        for unit, expected, scale, origin in UNITS:
            deviation = abs(mean_z - (scale * mean_p + origin))
            if abs(slope / scale - 1.0) < 4.0 * SIMILAR and deviation < tolerance:
                text, remedy = LIKELY["unit"].filled(
                    name=name, unit=unit, expected=expected, table=table_of(name)
                )
                setting = channel_setting(name, "unit", f'"{unit}"')
                return Cause("unit", name, text, remedy=remedy, setting=setting)
        return None


def chance(statistic: float, freedom: int) -> float:
    """Return the probability of a larger value of the chi-square distribution."""
    return float(scipy.special.gammaincc(0.5 * freedom, 0.5 * statistic))
