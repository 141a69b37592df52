"""Noise of unknowns, of inputs and of an initial state, as rows of the square root [U C].

A moving unknown has two independent rows of process noise in each step. In a step of length h, the
noise of a coordinate with relaxation rate lambda is a path n with n(0) = 0. Given its end value,
the path is a bridge. Given both its end value and its integral, its expectation is

    n(tau) = sqrt(g) [ramp(tau) xi_0 + arch(tau) xi_1],    xi ~ N(0, I),    g = var n(h).

Here ramp is the expectation given n(h), and arch, zero at both ends, is the expectation given the
integral of the bridge. The joint distribution of end value and integral is exact. For a random
walk, ramp and arch are the line and the parabola of Foster, Lyons and Oberhauser (2020):

    ramp = tau/h,    arch = sqrt(3) (tau/h) (1 - tau/h)

A time scheme evaluates the path at its stages only. The inner stage uses the value with which the
quadrature of the scheme gives the mean of the path over the substep. A state that integrates the
unknown then has its exact covariance for any step. A state whose memory is shorter than a step
depends on the end of the path: the last part of the step is halved until it is short against the
memory.
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

SHORT = 1e-3  # step over relaxation time below which a path is treated as a random walk
LONGEST = 0.35  # largest last part of a step over the memory of the readings: gives standard
# deviations within 1 % of the exact filter (tests/test_sparse_samples.py)
COUNTS = 0.01  # noise variances of a reading: a smaller effect of the path is negligible
HARDLY = COUNTS / 64.0  # effect that remains negligible in a part of twice the length
MOST = 20  # largest number of parts of a step: the last part is 2e-6 of the step
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
Propagate: TypeAlias = Callable[[FilterState, Span], tuple[FilterState, Any, StepFailed | None]]

# Rows of the square root for each noisy channel: with 10 rows, the standard deviation of a state
# near the boundary is exact to 1 % (tests/test_input_noise.py).
ROWS = 10
PAUSE_ROWS = 4  # rows of the square root for the state after a pause
MODES = 3  # number of modes in time of the deviation of an input from a straight line in a pause
PIECES = 6  # number of linear pieces of an input in a pause


def grades(rate: Array, length: float) -> IntArray:
    """Return the number of parts of a step, for the rate at which readings forget, (members,)."""
    if not np.count_nonzero(rate):
        return np.ones(len(rate), dtype=np.int64)
    ratio = np.maximum(np.minimum(rate * length / LONGEST, 2.0**MOST), 1.0)
    return np.asarray(np.minimum(1 + np.ceil(np.log2(ratio) - 1e-9), MOST), dtype=np.int64)


def pieces(control: Advance, start: float, stop: float, parts: int) -> list[float]:
    """Return the ends of the intervals with independent process noise; the last one is `stop`.

    The intervals are the steps of `dt_max`. The last step is divided into a half, a quarter, and so
    on; its last two parts have the same length.
    """
    count = control.count(stop - start) // control.parts
    shares = [k / count for k in range(1, count)]
    shares += [1.0 - 0.5**k / count for k in range(1, parts)]
    return [start + share * (stop - start) for share in shares] + [stop]


@dataclass(frozen=True, eq=False)
class NoiseRows:
    """Rows of the square root for the process noise of one step: all ramps, then all arches."""

    start: float  # start of the step
    length: float  # length of the step
    # Standard deviation gained by each moving coordinate in the step, shape (members, moving).
    scale: Array
    # Length of the step over the relaxation time of each moving coordinate; 0 for a random walk.
    lengths: tuple[float, ...]
    columns: IntArray  # indices of the moving coordinates, shape (moving,)
    k: int  # number of coordinates
    weight: float  # weight of the last stage of the time scheme (`Scheme.weight`)

    def __len__(self) -> int:
        return 2 * len(self.columns)

    def at_end(self) -> Array:
        """Return the rows of C at the end of the step, shape (members, rows, k)."""
        return self._rows(np.array([[1.0], [0.0]]) * np.ones(len(self.columns)))

    def at_stage(self, t: float, begun: float, length: float) -> Array:
        """Return the rows of C for the stage at t of a substep, shape (members, rows, k)."""
        first = (begun - self.start) / self.length
        last = min(first + length / self.length, 1.0)
        # The tolerance allows for rounding of the times: an inner stage is far from the end.
        inner = t < begun + 0.99 * length
        return self._rows(_stage_values(self.lengths, first, last, self.weight, inner))

    def _rows(self, paths: Array) -> Array:
        """Return rows of C from the values of ramps and arches, shape (2, moving)."""
        moving = len(self.columns)
        rows = np.zeros((len(self.scale), 2, moving, self.k))
        rows[:, :, np.arange(moving), self.columns] = self.scale[:, None] * paths
        return rows.reshape(len(self.scale), 2 * moving, self.k)

    def rate(self, before: Array, Y: Array) -> Array:
        """Return the rate at which readings forget the process noise, shape (members,).

        The ratio of arch to ramp in the readings determines the rate: it is largest for delayed
        readings, and zero for readings whose memory is much shorter than the step. The rate
        increases at once if a part of the step is too long, and decreases at most to its half.

        `before`: the rate by which the step was divided, shape (members,). `Y`: observed rows of
        the state, in units of the noise, shape (members, rows, sensors).
        """
        if self.weight == 1.0:  # with one stage, both have the same effect
            return before
        moving = len(self.columns)
        # Effect on each sensor, and norm over all sensors: (members, moving, sensors + 1).
        whole = np.linalg.norm(Y, axis=2, keepdims=True)
        seen = np.abs(np.concatenate([Y, whole], axis=2))
        ramp, arch = seen[:, :moving], seen[:, moving:]
        means = _mean(self.lengths, 0.0, 1.0)
        # Each of two stages divides a state with the decay rate lambda by 1 + w lambda h.
        rest, w = (means[0] - self.weight)[:, None], self.weight
        with np.errstate(all="ignore"):  # rows without an effect give nonfinite numbers
            factor = (means[1][:, None] * ramp / arch - rest) / w
            # factor < 1 for delayed readings, which require short parts as a short memory does.
            parts = np.abs(factor - 1.0) / w
            counts = ramp * ramp / (3.0 + 2.0 * parts)

        def fastest(chosen: Mask) -> Array:
            rate: Array = np.where(chosen & np.isfinite(parts), parts, 0.0).max(axis=(1, 2))
            return rate / self.length

        needed = fastest((counts > COUNTS) & (parts > LONGEST))
        slower = np.clip(fastest(counts > HARDLY), 0.5 * before, before)
        return np.where(needed > before, needed, slower)


def _paths(lengths: tuple[float, ...], s: Array) -> Array:
    """Return ramp and arch at fractions s of a step, in [0, 1], shape (2, moving, len(s))."""
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
    """Return the means of ramp and arch between two fractions of a step, shape (2, moving)."""
    s = first + 0.5 * (last - first) * (1.0 + NODES)
    return np.asarray(_paths(lengths, s) @ (0.5 * WEIGHTS))


@lru_cache(maxsize=256)
def _stage_values(
    lengths: tuple[float, ...], first: float, last: float, weight: float, inner: bool
) -> Array:
    """Return the values of ramp and arch for a stage of a substep, shape (2, moving)."""
    mean = _mean(lengths, first, last)
    if weight == 1.0:
        return mean
    end = _paths(lengths, np.array([last]))[..., 0]
    return np.asarray((mean - weight * end) / (1.0 - weight)) if inner else end


def input_rank(problem: Problem) -> int:
    """Return the number of rows of the square root for the noise of inputs and initial state."""
    return ROWS * len(problem.input_noise) + problem.initial_rank


def with_input_errors(
    propagate: Propagate,
    x: FilterState,
    end: FilterState,
    span: Span,
    sizes: Mapping[str, float | Array],
) -> tuple[FilterState, StepFailed | None]:
    """Return the state after a span with an additional row for each channel with an error.

    `sizes`: standard deviation of each such channel, a number or shape (members, 1). The error is
    constant in a span and independent between spans. Over many spans, its integral has the same
    variance as for errors interpolated linearly between readings. If a state follows its boundary
    within a span, the variance is too large by up to a quarter. A row is the change of the state
    when the input changes by one standard deviation: exact for a model affine in the input.
    """
    bare, rows = _without_tangents(x), []
    for name, size in sizes.items():
        shifted, _, failure = propagate(bare, _with_input_change(span, name, size))
        if failure is not None:
            return end, failure
        rows.append(shifted.u - end.u)
    if not rows:
        return end, None
    U = np.stack(rows, axis=1)
    return with_rows(end, U, np.zeros((*U.shape[:2], x.C.shape[2]))), None


def unread_inputs(problem: Problem, x: FilterState, span: Span) -> dict[str, Array]:
    """Return the standard deviation of each channel that is held in a gap, shapes (members, 1).

    It follows from earlier changes of the input in a similar time (`InputHistory.deviation`).
    """
    sizes: dict[str, Array] = {}
    if span.gaps is None:
        return sizes
    for name in lines(problem):
        held, missing = span.gaps[:, :, span.channels.index(name)].T
        if np.count_nonzero(missing):
            length = 2.0 * (held + span.t1 - span.t0)  # twice: no reading at the end of the gap
            size = x.driven.deviation(length)[:, problem.channels.index(name)] * missing
            sizes[name] = size[:, None]
    return sizes


def _without_tangents(x: FilterState) -> FilterState:
    """Return a filter state with the linearisation point alone, without tangents or deviation."""
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


def _with_input_change(span: Span, name: str, change: float | Array) -> Span:
    shift = change * (np.arange(len(span.channels)) == span.channels.index(name))
    last = span.inputs1 + shift
    first = last if span.inputs0 is span.inputs1 else span.inputs0 + shift
    return replace(span, inputs0=first, inputs1=last, interval=None)


def lines(problem: Problem) -> list[str]:
    """Return the channels of the model that are interpolated linearly between readings."""
    held = problem.control.held
    return [
        name
        for name in problem.channels
        if name in problem.model.channels and name not in held.last and name not in held.next
    ]


def after_pause(
    propagate: Propagate, problem: Problem, x: FilterState, end: FilterState, span: Span
) -> tuple[FilterState, StepFailed | None]:
    """Return the state after a span, with additional rows for members for which it was a pause.

    The deviation of an input from a straight line is a bridge: a sum of MODES sines over the pause
    with independent amplitudes. Each sine gives a row with its response. Another row is the change
    of the state in the pause.
    """
    pause = end.driven.pause
    length = span.t1 - span.t0
    sizes = x.driven.deviation(length) * pause[:, None]
    members, bare = len(x), _without_tangents(x)
    knots = np.linspace(0.0, 1.0, PIECES + 1)

    def after(name: str, mode: int) -> tuple[Array, StepFailed | None]:
        """Return u after the pause; the input deviates by a mode, unless `mode` is zero."""
        at, column, size = bare, span.channels.index(name), sizes[:, problem.channels.index(name)]
        last = _interpolated(span, 0.0)
        for a, b in pairwise(knots.tolist()):
            first, last = last, _interpolated(span, b)
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

    # The length of the pause is uncertain too: the clock may have been adjusted in it.
    rows = [(end.u - x.u) * pause[:, None]]
    for name in lines(problem):
        if not sizes[:, problem.channels.index(name)].any():
            continue
        states = []
        for mode in range(MODES + 1):
            u, failure = after(name, mode)
            if failure is not None:
                return end, failure
            states.append(u)
        rows += [u - states[0] for u in states[1:]]
    U = np.stack(rows, axis=1)
    return with_rows(end, U, np.zeros((*U.shape[:2], x.C.shape[2]))), None


def _interpolated(span: Span, s: float) -> Array:
    return (1.0 - s) * span.inputs0 + s * span.inputs1


def rows_of_sensors(problem: Problem, reduction: Reduction) -> IntArray:
    """Return the indices of initial rows for readings with the stated noise of their sensor."""
    readings = problem.initial_readings.items()
    of_sensor = [name in problem.observed.names and np.isnan(item.noise) for name, item in readings]
    return reduction.size + np.flatnonzero(of_sensor)


def with_initial_rows(
    x: FilterState, problem: Problem, reduction: Reduction, noise: Array, moment: Moment
) -> FilterState:
    """Return the state of one member at the start, with the uncertainty of its initial state u0.

    Errors of u0 (`Problem.initial_errors`) are separate rows. If u0 is made of readings,
    u0 = sum_i w_i z_i, its error is -sum_i w_i (noise_i + H_q Phi a). The noise of each reading is
    a separate row. The effect of unknowns on the sensors, such as an offset, is part of the rows of
    these unknowns. Therefore these readings give no further information about them.

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
