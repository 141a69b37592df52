"""Rods with effects that the model of the rod lacks; truths use Chebyshev collocation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from benchmarks.honest.linear import Chebyshev, Linear, fine_times
from benchmarks.honest.problem import Problem

Array = NDArray[np.float64]
DEGREE = 40
SPACE = Chebyshev(DEGREE)
NODES = len(SPACE.x)
ENDS = np.eye(NODES)[[0, -1]]
GIVEN = np.column_stack([np.eye(2), np.zeros(2)])  # the two channels are the end temperatures
SLICES = 9  # points whose mean is a reading


def _inputs(problem: Problem) -> Array:
    """Return the channels and a column of ones at the substeps, shape (substeps, 3)."""
    fine = fine_times(problem.times)
    return np.column_stack([problem.inputs(fine), np.ones(len(fine))])


def _places(problem: Problem) -> list[float]:
    return [float(np.ravel(place)[0]) for place in problem.points.values()]


def _shown(problem: Problem, operator: Array, ends: Array = ENDS, given: Array = GIVEN) -> Array:
    system = SPACE.system(operator, ends, given, np.zeros((NODES, 3)), _places(problem))
    return system.respond(_inputs(problem), problem.length / problem.intervals)


def advected(problem: Problem, k: float) -> Array:
    """Return the readings of u_t = k u_xx - v u_x with v L = 2 k."""
    return _shown(problem, k * SPACE.D2 - 2.0 * k * SPACE.D1)


def contact(problem: Problem, k: float) -> Array:
    """Return readings with a contact resistance of a tenth of the rod's at the left end."""
    ends, given = ENDS.copy(), GIVEN.copy()
    ends[0] = 0.1 * SPACE.D1[0] - ENDS[0]
    given[0] = -GIVEN[0]
    return _shown(problem, k * SPACE.D2, ends, given)


def averaged(problem: Problem, k: float) -> Array:
    """Return readings of sensors that average over a fifth of the length."""
    z = np.zeros((len(problem.times), len(problem.points)))
    for offset in np.linspace(-0.1, 0.1, SLICES):
        places = [place + float(offset) for place in _places(problem)]
        source = np.zeros((NODES, 3))
        system = SPACE.system(k * SPACE.D2, ENDS, GIVEN, source, places)
        z += system.respond(_inputs(problem), problem.length / problem.intervals) / SLICES
    return z


def heated_late(problem: Problem, k: float) -> Array:
    """Return readings with a source of 0.4 in the second half of the run."""
    g = _inputs(problem)
    g[: len(g) // 2, 2] = 0.0
    source = np.zeros((NODES, 3))
    source[:, 2] = 0.4
    system = SPACE.system(k * SPACE.D2, ENDS, GIVEN, source, _places(problem))
    return system.respond(g, problem.length / problem.intervals)


def cooled_late(problem: Problem, k: float) -> Array:
    """Return readings with a loss of 0.4 / s in the second half of the run."""
    step, half = problem.length / problem.intervals, problem.intervals // 2
    g, places = _inputs(problem), _places(problem)
    middle = half * ((len(g) - 1) // problem.intervals)
    before, after = (
        SPACE.system(k * SPACE.D2 - loss * np.eye(NODES), ENDS, GIVEN, np.zeros((NODES, 3)), places)
        for loss in (0.0, 0.4)
    )
    states = Linear(before.A, before.B, np.eye(len(before.A)), np.zeros((len(before.A), 3)))
    start = states.respond(g[: middle + 1], step)[-1]
    first = before.respond(g[: middle + 1], step)
    return np.concatenate([first[:-1], after.respond(g[middle:], step, start)])


def nonlinear(problem: Problem, k: float) -> Array:
    """Return readings with a sink of 0.5 u |u|."""
    system = SPACE.system(k * SPACE.D2, ENDS, GIVEN, np.zeros((NODES, 3)), _places(problem))
    fine, g = fine_times(problem.times), _inputs(problem)

    def driven(t: float) -> Array:
        return np.array([np.interp(t, fine, column) for column in g.T])

    def rate(t: float, y: Array) -> Array:
        return np.asarray(system.A @ y + system.B @ driven(t) - 0.5 * y * np.abs(y))

    def jacobian(t: float, y: Array) -> Array:
        return np.asarray(system.A - np.diag(np.abs(y)))

    times, start = problem.times, np.zeros(len(system.A))
    solution: Any = solve_ivp(
        rate,
        (float(times[0]), float(times[-1])),
        start,
        method="Radau",
        t_eval=times,
        jac=jacobian,
        rtol=1e-7,
        atol=1e-9,
    )
    if not solution.success:
        raise RuntimeError(solution.message)
    ends = np.array([driven(float(t)) for t in times])
    return np.asarray(solution.y.T @ system.C.T + ends @ system.D.T)
