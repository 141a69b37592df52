"""What a fault leaves of the readings that no value of the unknowns explains."""

from __future__ import annotations

import copy
from types import MappingProxyType

import numpy as np

from benchmarks.census.faults import Array, Scene
from benchmarks.honest.batch import Batch
from benchmarks.honest.problem import Problem, Signal

VISIBLE = 8.0
"""Trace from which a fault can show, in standard deviations of the noise. A direction of a
dictionary of 100 in two kinds of windows reaches an e-value of 200 at about five standard errors,
95 % of the time if its mean is at seven, and shares some of its trace with others."""


def trace(scene: Scene) -> float:
    """Return the norm of what the best fit leaves of readings without noise, over the noise.

    The fit is by the code of the truth, with sensors, channels and process as livepde is told:
    what lies in the span of the sensitivities of the unknowns leaves nothing.
    """
    told = _told(scene)
    theta = scene.theta if scene.told is None else np.zeros(told.coordinates)
    best = Batch.of(told, theta).fit(scene.z)
    return float(np.linalg.norm(scene.z - told.predict(best)) / scene.noise)


def _interpolated(times: Array, column: Array) -> Signal:
    """Return a channel as straight lines between its readings."""
    return lambda t: np.asarray(np.interp(t, times, column))


def _told(scene: Scene) -> Problem:
    """Return the problem as livepde is told of it."""
    told = copy.copy(scene.told or scene.problem)
    told.points, told.noise = MappingProxyType(dict(scene.points)), scene.noise
    told.length, told.intervals = scene.problem.length, scene.problem.intervals
    times, names = told.times, list(told.channels)
    columns = [_filled(column) for column in scene.inputs.T]
    told.channels = MappingProxyType(
        {name: _interpolated(times, column) for name, column in zip(names, columns, strict=True)}
    )
    return told


def _filled(column: Array) -> Array:
    """Return values of which those that are missing are the last one before."""
    known = np.where(np.isfinite(column), np.arange(len(column)), 0)
    return np.asarray(column[np.maximum.accumulate(known)])
