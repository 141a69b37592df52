"""Ledger of running sums over the innovations: what a verdict is drawn from, in constant memory.

Every array has the members as its leading axis. A *direction* is a possible cause of misfit with
an amplitude of one: an offset of a sensor, a wrong boundary value, a jump of an unknown. If it is
there with the amplitude theta, the whitened innovation r_k of a linear filter is white noise plus
theta g_k, and the sums of g r and g g hold all that the samples tell of theta (Rao 1948).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from livepde.linalg import Array, IntArray, Mask

__all__ = ["BLOCKS", "WINDOWS", "Ledger"]

WINDOWS = (0, 64, 512)
"""Samples after which a window begins anew; 0: the window of all samples. The faults of a window
begin with it, so that an old, sound record does not hide a fault that is new."""

BLOCKS = 16  # of the record of an unknown that stays; they double in length, and pairs merge
CLIP = 4.0  # times the usual size: no whitened innovation counts for more (Huber)


@dataclass(frozen=True, eq=False)
class Ledger:
    """Running sums of each member over the samples so far.

    Attributes
    ----------
    seen
        Number of samples, shape (members,).
    times
        Time of the last sample and of the interval before the first one but one, (members, 2).
    first, last
        First and last prediction of each sensor, (members, sensors); NaN before.
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
        What the sensors see of those at two times, (members, 2, terms, sensors), and these times,
        (members, 2).
    stuck, value
        How often in a row each sensor has shown the same value, and that value, shapes (members,
        sensors).
    """

    seen: IntArray
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
    stuck: IntArray
    value: Array

    @classmethod
    def start(
        cls, sensors: int, directions: int, followed: int, terms: int, n: int, windows: int
    ) -> Ledger:
        """Return the value of one member before any sample.

        Parameters
        ----------
        followed
            Number k of unknown coordinates of which the record is kept.
        terms, n
            Number of missing terms, and of coefficients of the state.
        """
        never, zero = np.full((1, sensors), np.nan), np.zeros(1, dtype=np.int64)
        return cls(
            seen=zero,
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
            length=zero + 1,
            process=np.zeros((1, terms, n)),
            readings=np.zeros((1, 2, terms, sensors)),
            reached=np.full((1, 2), np.nan),
            stuck=np.zeros((1, sensors), dtype=np.int64),
            value=never,
        )

    @property
    def due(self) -> Mask:
        """Windows that begin anew with the next sample, shape (members, windows)."""
        lengths = np.array(WINDOWS[: self.age.shape[1]])
        due: Mask = (lengths > 0) & (self.age >= lengths) | (self.age == 0)
        return due

    def clipped(self, r: Array) -> Array:
        """Return whitened innovations, (members, sensors), none far beyond their usual size."""
        count, squares = self.noise[:, 0, 0], self.noise[:, 2, 0]
        usual = np.sqrt(np.maximum((squares + 10.0) / (count + 10.0), 1.0))
        limit = CLIP * usual
        return np.minimum(np.maximum(r, -limit), limit)


def summed(
    old: Ledger, due: Mask, r: Array, g: Array, used: Array
) -> tuple[Array, Array, Array, Array]:
    """Return `sums`, `noise`, `before` and `present` after a sample.

    Parameters
    ----------
    due
        Windows that begin with this sample, (members, windows).
    r, g
        Whitened innovations, (members, sensors), and responses, (members, windows, directions,
        sensors).
    used
        1 where there is a value, (members, sensors).
    """
    members, windows, directions, sensors = g.shape
    r1, g1 = old.before[:, 0], old.before[:, 1:].reshape(g.shape)
    sums, noise = old.sums, old.noise
    anew = due & (old.age > 0)
    if anew.any():
        kept = ~anew
        sums = sums * kept[:, None, :, None, None]
        noise = noise * kept[:, None, :, None]
    pair = used * old.present
    if not pair.all():
        r1, g1 = r1 * pair, g1 * pair[:, None, None]
    if anew.any():
        g1 = g1 * ~anew[:, :, None, None]
    wide, wide1 = r[:, None, None], r1[:, None, None]
    parts = np.empty_like(sums)
    parts[:, 0] = g * wide
    parts[:, 1] = g * g
    parts[:, 2] = g * wide1
    parts[:, 2] += g1 * wide
    parts[:, 3] = g * g1
    told = np.stack([used, r, r * r, r * r1, pair], axis=1)[:, :, None]
    flat = g.reshape(members, windows * directions, sensors)
    return sums + parts, noise + told, np.concatenate([r[:, None], flat], axis=1), used


def blocked(old: Ledger, Y: Array, r: Array) -> tuple[Array, Array, IntArray]:
    """Return `score`, `information` and `length` after a sample.

    Parameters
    ----------
    Y, r
        Sensitivities to the followed unknowns, (members, k, sensors), and residuals at the prior
        mean, (members, sensors), in units of the noise; zero where no value is.
    """
    score, information, length = old.score, old.information, old.length
    full = old.seen // length >= BLOCKS
    if full.any():
        score, information = _merged(score, full), _merged(information, full)
        length = np.where(full, 2 * length, length)
    at = np.arange(len(length)), old.seen // length
    Yt = Y.transpose(0, 2, 1)
    score, information = score.copy(), information.copy()
    score[at] += Yt * r[:, :, None]
    information[at] += Yt[:, :, :, None] * Yt[:, :, None, :]
    return score, information, length


def _merged(values: Array, full: Mask) -> Array:
    """Return blocks of which neighbours are merged, for some members."""
    merged = np.zeros_like(values)
    merged[:, : BLOCKS // 2] = values[:, ::2] + values[:, 1::2]
    chosen = full.reshape(-1, *(1,) * (values.ndim - 1))
    return np.where(chosen, merged, values)
