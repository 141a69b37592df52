"""Ledger of running sums over the innovations: the data of a verdict, in constant memory.

Every array has the members as its leading axis. A *direction* is a possible cause of misfit with
an amplitude of one: an offset of a sensor, a wrong boundary value, a jump of an unknown. If it is
there with the amplitude theta, the whitened innovation r_k of a linear filter is white noise plus
theta g_k, and the sums of g r and g g hold all that the samples tell of theta (Rao 1948).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.linalg import Array, IntArray, Mask

WINDOWS = (0, 64, 512)
"""Samples after which a window begins anew; 0: the window of all samples. The faults of a window
begin with it, so that an old, sound record does not hide a fault that is new."""

LENGTHS = np.array([length or np.inf for length in WINDOWS])
BATCH = 16  # samples at most that wait until they are summed together
ROOM = 2**16  # numbers at most that they take while they wait
BLOCKS = 16  # of the record of an unknown that stays; they double in length, and pairs merge
CLIP = 4.0  # times the usual size: no whitened innovation counts for more (Huber)


@dataclass(frozen=True, eq=False)
class Ledger:
    """Running sums of each member over the samples so far.

    Attributes
    ----------
    seen, waiting
        Number of samples, and of those that wait to be summed, shape (members,).
    rows
        Samples that wait, (members, batch, numbers); see `livepde.verdict.judge`.
    w
        Coordinates of all directions in all windows on the rows of the square root as they were
        when the first of these came, (members, rank, windows times directions).
    times
        Time of the last sample that was summed, and the usual interval, (members, 2).
    first, last
        First prediction of each sensor, and the last that was summed, (members, sensors); NaN
        before.
    age, epoch
        Samples in each window, and how often it has begun anew, (members, windows).
    sums
        Sums of g r, g g, g_k r_(k-1) + g_(k-1) r_k and g_k g_(k-1) of each window, direction and
        sensor, shape (members, 4, windows, directions, sensors).
    noise
        Number of r, and sums of r, r r, r_k r_(k-1) and the number of such pairs, of each window
        and sensor, shape (members, 5, windows, sensors).
    before
        Whitened innovation and responses of the last sample, (members, 1 + windows times
        directions, sensors).
    present
        1 where the last sample had a value, shape (members, sensors).
    score, information
        Of each block and sensor, about the prior mean: sums of Y r, (members, blocks, sensors, k),
        and of Y Y^T, (members, blocks, sensors, k, k); k = 0 where they are not kept.
    length
        Samples in a block, shape (members,).
    process
        States by which the process answers a missing term, (members, terms, n).
    readings, reached
        Readings due to those states at the first of two times, and their change per unit of time up
        to the second one, (members, 2, terms, sensors), and these times, (members, 2).
    sound
        Whether nothing spoke against the model in the longest window that ended last, (members,).
    shown
        How many readings each sensor has shown, and how many of them a gate has refused, (members,
        2, sensors).
    stuck, value
        How often in a row each sensor has shown the same value, and that value, shapes (members,
        sensors).
    """

    seen: IntArray
    waiting: IntArray
    rows: Array
    w: Array
    times: Array
    first: Array
    last: Array
    age: IntArray
    epoch: IntArray
    sums: Array
    noise: Array
    before: Array
    present: Array
    score: Array
    information: Array
    length: IntArray
    process: Array
    readings: Array
    reached: Array
    sound: Mask
    shown: IntArray
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

        Parameters
        ----------
        followed
            Number k of unknown coordinates of which the record is kept.
        terms, n
            Number of missing terms, and of coefficients of the state.
        rank, batch, numbers
            Rows of the square root, samples that are summed together, and numbers of each.
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
        due: Mask = (self.age >= LENGTHS[: self.age.shape[1]]) | (self.age == 0)
        return due

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


def changed(ledger: Ledger, **parts: Any) -> Ledger:
    """Return a ledger with some fields exchanged: `dataclasses.replace` in a tenth of its time."""
    new: Ledger = object.__new__(Ledger)
    object.__setattr__(new, "__dict__", {**ledger.__dict__, **parts})
    return new


def summed(old: Ledger, due: Mask, whitened: Array, used: Array) -> dict[str, Array]:
    """Return `sums`, `noise`, `before` and `present` after a batch of samples.

    Parameters
    ----------
    due
        Windows that begin with this batch, (members, windows).
    whitened
        Innovations r, and responses g of each direction in each window, (members, batch, sensors, 1
        + windows * directions); zero where no value is.
    used
        1 where there is a value, (members, batch, sensors).
    """
    members, _, sensors, _ = whitened.shape
    windows, directions = old.sums.shape[2:4]
    # Sums of windows that begin anew start from nothing.
    kept = ~(due & (old.age > 0))
    # The last sample before the batch comes first: products of successive values need it.
    before = old.before.copy()
    before[:, 1:].reshape(members, windows, -1)[~kept] = 0.0
    row = np.concatenate([before.swapaxes(1, 2)[:, None], whitened], axis=1)
    now, earlier = row[:, 1:], row[:, :-1]
    present = np.concatenate([old.present[:, None], used], axis=1)
    # Such products count where both samples had a value.
    pair = present[:, 1:] * present[:, :-1]
    if not pair.all():
        earlier = earlier * pair[..., None]
    # Weights of g in two sums: of g_k r_k, and of g_k r_(k-1) + g_(k-1) r_k.
    weights = np.zeros((2, *row.shape[:3]))
    weights[0, :, 1:], weights[1, :, 1:] = now[..., 0], earlier[..., 0]
    weights[1, :, :-1] += now[..., 0] * pair
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
        "before": row[:, -1].swapaxes(1, 2),
        "present": used[:, -1],
    }


def blocked(old: Ledger, Y: Array, r: Array) -> dict[str, Any]:
    """Return `score`, `information` and `length` after a batch of samples.

    Parameters
    ----------
    Y, r
        Sensitivities to the followed unknowns, (members, batch, k, sensors), and residuals at the
        prior mean, (members, batch, sensors), in units of the noise; zero where no value is.
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
