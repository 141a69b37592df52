"""Process noise of unknowns that move, within a step: two independent rows for each coordinate.

In a step of length h a coordinate of variance rate lambda gains a path n with n(0) = 0. Given its
end value the path is a bridge, and given both its end value and its integral it has the expectation

    n(tau) = sqrt(g) [ramp(tau) xi_0 + arch(tau) xi_1],    xi ~ N(0, I),    g = var n(h),

ramp being the expectation given n(h), and arch, zero at both ends, that given the integral of the
bridge. So the joint law of end value and integral is exact. For a random walk they are the line and
the parabola of Foster, Lyons and Oberhauser (2020):

    ramp = tau/h,    arch = sqrt(3) (tau/h) (1 - tau/h)

A time scheme sees the path at its stages alone. The inner stage gets the value with which its
quadrature has the mean of the path over the substep; so a state that integrates the unknown has its
exact covariance, whatever the step. A state that forgets faster than a step sees the end of the
path: the end of the step is then halved, until its last part is short against the memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from livepde.linalg import Array, IntArray, Mask
from livepde.stepping import Advance

SHORT = 1e-3  # steps over relaxation times below which a path is that of a random walk
LONGEST = 0.35  # of the last part of a step over the memory of the readings: standard deviations
# are within 1 % of those of the exact filter then (tests/test_sparse_samples.py)
COUNTS = 0.01  # variances of the noise of a reading by which the path has to matter for it
HARDLY = COUNTS / 64.0  # by which it would not matter in a part of twice the length either
MOST = 20  # parts of a step at most: the last one is 2e-6 of it then
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)


def grades(rate: Array, length: float) -> IntArray:
    """Return in how many parts a step is taken whose readings forget at a rate, (members,)."""
    if not np.count_nonzero(rate):
        return np.ones(len(rate), dtype=np.int64)
    ratio = np.maximum(np.minimum(rate * length / LONGEST, 2.0**MOST), 1.0)
    return np.asarray(np.minimum(1 + np.ceil(np.log2(ratio) - 1e-9), MOST), dtype=np.int64)


def pieces(control: Advance, start: float, stop: float, parts: int) -> list[float]:
    """Return the times between which process noise is independent, the last one `stop`.

    The steps of `dt_max`, the last one of them in parts of a half, a quarter, ..., the last two
    alike.
    """
    count = control.count(stop - start) // control.parts
    shares = [k / count for k in range(1, count)]
    shares += [1.0 - 0.5**k / count for k in range(1, parts)]
    return [start + share * (stop - start) for share in shares] + [stop]


@dataclass(frozen=True, eq=False)
class NoiseRows:
    """Rows of the square root for the process noise of one step: all ramps, then all arches."""

    # Of the step.
    start: float
    length: float
    # Standard deviation gained by each coordinate that moves in it, shape (members, moving).
    scale: Array
    # The step over the relaxation time of each of them, zero for a random walk.
    lengths: tuple[float, ...]
    columns: IntArray  # their numbers among all k coordinates, shape (moving,)
    k: int  # number of coordinates
    weight: float  # of the last stage in the quadrature of the time scheme (`Scheme.weight`)

    def __len__(self) -> int:
        return 2 * len(self.columns)

    def at_end(self) -> Array:
        """Return the rows of C at the end of the step, shape (members, rows, k)."""
        return self._rows(np.array([[1.0], [0.0]]) * np.ones(len(self.columns)))

    def at_stage(self, t: float, begun: float, length: float) -> Array:
        """Return the rows that the stage at t of a substep sees, shape (members, rows, k)."""
        first = (begun - self.start) / self.length
        last = min(first + length / self.length, 1.0)
        # Whatever rounding does to the times: an inner stage is far from the end.
        inner = t < begun + 0.99 * length
        return self._rows(_seen(self.lengths, first, last, self.weight, inner))

    def _rows(self, paths: Array) -> Array:
        """Return rows of C from the values of ramps and arches, shape (2, moving)."""
        moving = len(self.columns)
        rows = np.zeros((len(self.scale), 2, moving, self.k))
        # Indices with a slice between them come first.
        rows[:, :, np.arange(moving), self.columns] = self.scale[:, None] * paths
        return rows.reshape(len(self.scale), 2 * moving, self.k)

    def rate(self, before: Array, Y: Array) -> Array:
        """Return the rate at which readings forget the process noise, shape (members,).

        Readings that forget slower than the step see an arch as well as a ramp, those that forget
        faster the ramp alone, those that are late more of the arch: the ratio of both tells the
        rate. It rises at once where a part of the step is too long for it, and falls to a half of
        it at most.

        `before`: the rate so far, by which the step was divided, shape (members,). `Y`: what the
        sensors see of the rows in the state, in units of the noise, shape (members, rows, sensors).
        """
        if self.weight == 1.0:  # one stage sees the mean of both alike
            return before
        moving = len(self.columns)
        # What each sensor sees, and all of them together: (members, moving, sensors + 1).
        whole = np.linalg.norm(Y, axis=2, keepdims=True)
        seen = np.abs(np.concatenate([Y, whole], axis=2))
        ramp, arch = seen[:, :moving], seen[:, moving:]
        means = _mean(self.lengths, 0.0, 1.0)
        # A state that forgets at a rate lambda is divided by 1 + w lambda h in each of two stages.
        rest, w = (means[0] - self.weight)[:, None], self.weight
        with np.errstate(all="ignore"):  # what no sensor sees gives no finite number
            found = (means[1][:, None] * ramp / arch - rest) / w
            # Negative where readings are late: a delay asks for short parts as a memory does.
            parts = np.abs(found - 1.0) / w
            counts = ramp * ramp / (3.0 + 2.0 * parts)

        def fastest(chosen: Mask) -> Array:
            rate: Array = np.where(chosen & np.isfinite(parts), parts, 0.0).max(axis=(1, 2))
            return rate / self.length

        needed = fastest((counts > COUNTS) & (parts > LONGEST))
        slower = np.clip(fastest(counts > HARDLY), 0.5 * before, before)
        return np.where(needed > before, needed, slower)


def _paths(lengths: tuple[float, ...], s: Array) -> Array:
    """Return ramp and arch at shares s of a step, shape (2, moving, len(s)); `s` lies in [0, 1]."""
    y = np.array(lengths)[:, None]
    walks, x = y < SHORT, np.maximum(y, SHORT)
    ramp = np.exp(-x * (1.0 - s)) * np.expm1(-2.0 * x * s) / np.expm1(-2.0 * x)
    bridge = np.expm1(-x * s) * np.expm1(-x * (1.0 - s)) / (1.0 + np.exp(-x))
    spread = -np.expm1(-2.0 * x) * (1.0 - np.tanh(0.5 * x) / (0.5 * x))
    arch = np.sqrt(2.0 / (x * spread)) * bridge
    ramp = np.where(walks, s, ramp)
    return np.stack([ramp, np.where(walks, math.sqrt(3.0) * s * (1.0 - s), arch)])


@lru_cache(maxsize=256)
def _mean(lengths: tuple[float, ...], first: float, last: float) -> Array:
    """Return the means of ramp and arch between two shares of a step, shape (2, moving)."""
    s = first + 0.5 * (last - first) * (1.0 + NODES)
    return np.asarray(_paths(lengths, s) @ (0.5 * WEIGHTS))


@lru_cache(maxsize=256)
def _seen(
    lengths: tuple[float, ...], first: float, last: float, weight: float, inner: bool
) -> Array:
    """Return ramp and arch as a stage of a substep sees them, shape (2, moving)."""
    mean = _mean(lengths, first, last)
    if weight == 1.0:
        return mean
    end = _paths(lengths, np.array([last]))[..., 0]
    return np.asarray((mean - weight * end) / (1.0 - weight)) if inner else end
