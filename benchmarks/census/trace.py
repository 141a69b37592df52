"""Trace of a fault: the part of its effect on readings that no value of the unknowns explains."""

from __future__ import annotations

import copy
from types import MappingProxyType

import numpy as np

from benchmarks.census.faults import Array, Scene
from benchmarks.honest.batch import Batch
from benchmarks.honest.problem import Problem, Signal

VISIBLE = 8.0
"""Trace from which a fault is detectable, in standard deviations of the noise. A direction of a
dictionary of 100, in two kinds of windows, reaches an e-value of 200 at about five standard errors.
It does so with probability 95 % if its mean is seven, and it shares its trace with others."""


def trace(scene: Scene) -> float:
    """Return the norm of the residuals of a best fit of noise-free readings, over the noise.

    The fit uses the code of the truth with the sensors, channels and process that livepde uses. It
    removes all effects in the span of the sensitivities of the unknowns.
    """
    believed = _believed(scene)
    theta = scene.theta if scene.believed is None else np.zeros(believed.coordinates)
    best = Batch.of(believed, theta).fit(scene.z)
    return float(np.linalg.norm(scene.z - believed.predict(best)) / scene.noise)


def _interpolated(times: Array, column: Array) -> Signal:
    """Return the linear interpolation of a channel between its readings."""
    return lambda t: np.asarray(np.interp(t, times, column))


def _believed(scene: Scene) -> Problem:
    """Return the problem with the sensors, channels and process that livepde uses."""
    believed = copy.copy(scene.believed or scene.problem)
    believed.points, believed.noise = MappingProxyType(dict(scene.points)), scene.noise
    believed.length, believed.intervals = scene.problem.length, scene.problem.intervals
    times, names = believed.times, list(believed.channels)
    columns = [_filled(column) for column in scene.inputs.T]
    believed.channels = MappingProxyType(
        {name: _interpolated(times, column) for name, column in zip(names, columns, strict=True)}
    )
    return believed


def _filled(column: Array) -> Array:
    """Return values with each missing one replaced by the last value before it."""
    known = np.where(np.isfinite(column), np.arange(len(column)), 0)
    return np.asarray(column[np.maximum.accumulate(known)])
