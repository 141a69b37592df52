"""Noise of input channels, and errors of an initial state, as rows of [U; C]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np

from livepde.fem import Moment
from livepde.laws.filter_state import FilterState, with_rows
from livepde.laws.law import Problem
from livepde.laws.member_arrays import changed
from livepde.laws.reduction import Reduction
from livepde.linalg import Array
from livepde.stepping import Span, StepFailed

Propagate: TypeAlias = Callable[[FilterState, Span], tuple[FilterState, Any, StepFailed | None]]

# Rows of the square root for each noisy channel: with 10 the standard deviation of a state near the
# boundary is that of all rows to 1 %: tests/test_input_noise.py.
ROWS = 10
PAUSE_ROWS = 4  # rows of the square root for the state after a pause
MODES = 3  # shapes in time of the deviation of an input from its line in a pause
PIECES = 6  # of a pause, in each of which an input is a line


def input_rank(problem: Problem) -> int:
    """Return how many rows of the square root the noise of inputs and an initial state need."""
    return ROWS * len(problem.input_noise) + problem.initial_rank


def with_input_noise(
    propagate: Propagate, problem: Problem, x: FilterState, end: FilterState, span: Span
) -> tuple[FilterState, StepFailed | None]:
    """Return the state after a span with one more row for each noisy channel.

    The error of a channel is taken as constant in a span and as independent from one to the next:
    its integral over many spans has the variance of the straight lines between readings. Where a
    state follows its boundary within a span, the variance is larger than that of the lines by up to
    a quarter.
    The row is the difference to the state whose input is one standard deviation off, exact where
    the model is affine in it.

    `propagate`: takes a state over a span. `x`, `end`: the state before and after the span.
    """
    members, k, bare = len(x), x.C.shape[2], _bare(x)
    rows = []
    for name, std in problem.input_noise.items():
        off, _, failure = propagate(bare, _moved(span, name, std))
        if failure is not None:
            return end, failure
        rows.append(off.u - end.u)
    return with_rows(end, np.stack(rows, axis=1), np.zeros((members, len(rows), k))), None


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


def _moved(span: Span, name: str, change: float) -> Span:
    """Return a span with another value of one channel at both ends."""
    shift = np.zeros(len(span.channels))
    shift[span.channels.index(name)] = change
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
    the state in the pause. Parameters are those of `with_input_noise`.
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
    failure: StepFailed | None = None
    names = [name for name in lines(problem) if sizes[:, problem.channels.index(name)].any()]
    for name in names:
        base, failure = after(name, 0)
        for mode in range(1, MODES + 1):
            if failure is not None:
                return end, failure
            u, failure = after(name, mode)
            rows.append(u - base)
    U = np.stack(rows, axis=1)
    return with_rows(end, U, np.zeros((*U.shape[:2], x.C.shape[2]))), failure


def _mixed(span: Span, s: float) -> Array:
    return (1.0 - s) * span.inputs0 + s * span.inputs1


def initial_rows(
    problem: Problem, reduction: Reduction, noise: Array, q: Array, u: Array, moment: Moment
) -> tuple[Array, Array]:
    """Return the uncertainty of u0: rows of U and of C.

    The errors of u0 itself (`Problem.initial_errors`) are rows of their own. For a u0 made of
    readings, with u0 = sum_i w_i z_i the error of u0 is -sum_i w_i (noise_i + H_q Phi a): the noise
    of each reading is a row of its own, and the effect of the unknowns on the sensors, an offset
    say, stands in the rows of those unknowns. So the readings tell nothing more of them.

    `noise`: standard deviation of each sensor, shape (sensors,). `q`, `u`, `moment`: latent
    parameter, state, time and inputs at the start.

    Returns
    -------
    U, C
        Shapes (k + readings + errors, n) and (k + readings + errors, k).
    """
    observed, k = problem.observed, reduction.size
    free = problem.model.X.free
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
    C = np.vstack([np.eye(k), np.zeros((len(own), k))])
    return np.vstack([unknown, *own]), C


def with_initial_rows(
    x: FilterState, problem: Problem, reduction: Reduction, noise: Array, moment: Moment
) -> FilterState:
    """Return the state at the start with the uncertainty of the initial state."""
    if not problem.initial_rank:
        return x
    U, C = initial_rows(problem, reduction, noise, x.q[0], x.u[0], moment)
    causes = np.zeros((1, len(C), x.causes.shape[2]))
    return changed(x, U=U[None], C=C[None], past=np.zeros((1, len(C), 0)), causes=causes)
