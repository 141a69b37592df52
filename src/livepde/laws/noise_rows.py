"""Noise of unknowns, of inputs and of an initial state, as rows of [U; C].

An unknown that moves has two independent rows of process noise in each step.

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from livepde.fem import Moment
from livepde.laws.filter_state import FilterState, with_rows
from livepde.laws.law import Problem
from livepde.laws.reduction import Reduction
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import changed
from livepde.stepping import Advance, Span, StepFailed

SHORT = 1e-3  # steps over relaxation times below which a path is that of a random walk
LONGEST = 0.35  # of the last part of a step over the memory of the readings: standard deviations
# are within 1 % of those of the exact filter then (tests/test_sparse_samples.py)
COUNTS = 0.01  # variances of the noise of a reading by which the path has to matter for it
HARDLY = COUNTS / 64.0  # by which it would not matter in a part of twice the length either
MOST = 20  # parts of a step at most: the last one is 2e-6 of it then
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
Propagate: TypeAlias = Callable[[FilterState, Span], tuple[FilterState, Any, StepFailed | None]]

# Rows of the square root for each noisy channel: with 10 the standard deviation of a state near the
# boundary is that of all rows to 1 %: tests/test_input_noise.py.
ROWS = 10
PAUSE_ROWS = 4  # rows of the square root for the state after a pause
MODES = 3  # shapes in time of the deviation of an input from its line in a pause
PIECES = 6  # of a pause, in each of which an input is a line


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


def input_rank(problem: Problem) -> int:
    """Return how many rows of the square root the noise of inputs and an initial state need."""
    return ROWS * len(problem.input_noise) + problem.initial_rank


def with_input_errors(
    propagate: Propagate,
    x: FilterState,
    end: FilterState,
    span: Span,
    sizes: Mapping[str, float | Array],
) -> tuple[FilterState, StepFailed | None]:
    """Return the state after a span with one more row for each channel that may be off.

    `sizes`: standard deviation of each such channel, one number or (members, 1). The error of a
    channel is taken as constant in a span and as independent from one to the next: its integral
    over many spans has the variance of the straight lines between readings. Where a state follows
    its boundary within a span, the variance is larger than that of the lines by up to a quarter.
    The row is the difference to the state whose input is one standard deviation off, exact where
    the model is affine in it.
    """
    bare, rows = _bare(x), []
    for name, size in sizes.items():
        off, _, failure = propagate(bare, _moved(span, name, size))
        if failure is not None:
            return end, failure
        rows.append(off.u - end.u)
    if not rows:
        return end, None
    U = np.stack(rows, axis=1)
    return with_rows(end, U, np.zeros((*U.shape[:2], x.C.shape[2]))), None


def unread_inputs(problem: Problem, x: FilterState, span: Span) -> dict[str, Array]:
    """Return by how much each channel that is held in a gap may be off, shapes (members, 1).

    As far as inputs have moved before in such a time (`InputHistory.deviation`).
    """
    sizes: dict[str, Array] = {}
    if span.gaps is None:
        return sizes
    for name in lines(problem):
        held, missing = span.gaps[:, :, span.channels.index(name)].T
        if np.count_nonzero(missing):
            length = 2.0 * (held + span.t1 - span.t0)  # the end of a gap is open
            size = x.driven.deviation(length)[:, problem.channels.index(name)] * missing
            sizes[name] = size[:, None]
    return sizes


def _bare(x: FilterState) -> FilterState:
    """Return the mean alone, to be propagated once more: no tangents, no offset."""
    members, _, n = x.U.shape
    return changed(
        x,
        du=np.zeros_like(x.du),
        da=np.zeros_like(x.da),
        U=np.zeros((members, 0, n)),
        C=np.zeros((members, 0, x.C.shape[2])),
        past=x.past[:, :0],
        causes=x.causes[:, :0],
    )


def _moved(span: Span, name: str, change: float | Array) -> Span:
    shift = change * (np.arange(len(span.channels)) == span.channels.index(name))
    last = span.inputs1 + shift
    first = last if span.inputs0 is span.inputs1 else span.inputs0 + shift
    return replace(span, inputs0=first, inputs1=last, interval=None)


def lines(problem: Problem) -> list[str]:
    """Return the channels that drive the model as straight lines between their readings."""
    held = problem.control.held
    return [
        name
        for name in problem.channels
        if name in problem.model.channels and name not in held.last and name not in held.next
    ]


def after_pause(
    propagate: Propagate, problem: Problem, x: FilterState, end: FilterState, span: Span
) -> tuple[FilterState, StepFailed | None]:
    """Return the state after a span with more rows where the span was a pause.

    The deviation of an input from its line is a bridge: a sum of MODES sines over the pause with
    independent amplitudes. Each row is the response to one of them, and one row is the change of
    the state in the pause.
    """
    pause = end.driven.pause
    length = span.t1 - span.t0
    sizes = x.driven.deviation(length) * pause[:, None]
    members, bare = len(x), _bare(x)
    knots = np.linspace(0.0, 1.0, PIECES + 1)

    def after(name: str, mode: int) -> tuple[Array, StepFailed | None]:
        """Return u after the pause, with a deviation of an input unless its mode is zero."""
        at, column, size = bare, span.channels.index(name), sizes[:, problem.channels.index(name)]
        last = _mixed(span, 0.0)
        for a, b in pairwise(knots.tolist()):
            first, last = last, _mixed(span, b)
            if mode:
                last = np.array(np.broadcast_to(last, (members, last.shape[1])))
                amplitude = np.sin(mode * np.pi * b) * np.sqrt(8.0) / (mode * np.pi)
                last[:, column] += amplitude * size
            t0, t1 = ((1.0 - s) * span.start + s * span.t1 for s in (a, b))
            piece = replace(
                span,
                t0=np.full(len(span.t0), t0),
                t1=span.t1 if b == 1.0 else t1,
                inputs0=first,
                inputs1=last,
                interval=None,
                row=None,
            )
            at, _, failure = propagate(at, piece)
            if failure is not None:
                return at.u, failure
        return at.u, None

    # How long the pause was is not sure either: the clock may have been set in it.
    rows = [(end.u - x.u) * pause[:, None]]
    for name in lines(problem):
        if not sizes[:, problem.channels.index(name)].any():
            continue
        found = []
        for mode in range(MODES + 1):
            u, failure = after(name, mode)
            if failure is not None:
                return end, failure
            found.append(u)
        rows += [u - found[0] for u in found[1:]]
    U = np.stack(rows, axis=1)
    return with_rows(end, U, np.zeros((*U.shape[:2], x.C.shape[2]))), None


def _mixed(span: Span, s: float) -> Array:
    return (1.0 - s) * span.inputs0 + s * span.inputs1


def rows_of_sensors(problem: Problem, reduction: Reduction) -> IntArray:
    """Return which of the initial rows are the noise of a reading, as its sensor states it."""
    readings = problem.initial_readings.items()
    of_sensor = [name in problem.observed.names and np.isnan(one.noise) for name, one in readings]
    return reduction.size + np.flatnonzero(of_sensor)


def with_initial_rows(
    x: FilterState, problem: Problem, reduction: Reduction, noise: Array, moment: Moment
) -> FilterState:
    """Return the state of one member at the start with the uncertainty of its u0.

    The errors of u0 itself (`Problem.initial_errors`) are rows of their own. For a u0 made of
    readings, with u0 = sum_i w_i z_i the error of u0 is -sum_i w_i (noise_i + H_q Phi a): the noise
    of each reading is a row of its own, and the effect of the unknowns on the sensors, an offset
    say, stands in the rows of those unknowns. So the readings tell nothing more of them.

    `noise`: standard deviation of each sensor, shape (sensors,).
    """
    if not problem.initial_rank:
        return x
    observed, k = problem.observed, reduction.size
    free, u, q = problem.model.X.free, x.u[0], x.q[0]
    own, unknown = [], np.zeros((k, len(u)))
    _, H_q = observed.jacobian(u, problem.model.latent.value(q), moment)
    seen = np.zeros((k, observed.size))
    if H_q is not None:
        seen = reduction.directions(q[None], np.eye(k)[None])[0] @ H_q.T
    for name, reading in problem.initial_readings.items():
        std, direction = problem.input_noise.get(name, 0.0), free * reading.weight
        if name in observed.names:
            sensor = observed.names.index(name)
            std = noise[sensor] if np.isnan(reading.noise) else reading.noise
            unknown -= np.outer(seen[:, sensor], direction)
        own.append(std * direction)
    own += [free * error for error in problem.initial_errors]
    U, C = np.vstack([unknown, *own]), np.vstack([np.eye(k), np.zeros((len(own), k))])
    causes = np.zeros((1, len(C), x.causes.shape[2]))
    return changed(x, U=U[None], C=C[None], past=np.zeros((1, len(C), 0)), causes=causes)
