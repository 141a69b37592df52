"""Closed loops of a plant, an estimator and a controller, and their costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from benchmarks.control.problem import Problem
from livepde.control import Controller, Estimator, Kalman, Known, Learned, Loop
from livepde.linalg import Array


@dataclass(frozen=True, eq=False)
class Run:
    """Record of a closed loop.

    Attributes
    ----------
    t
        Times, shape (samples,).
    outputs, reference, inputs, q, std
        Outputs, references, inputs, and estimates of the unknowns with their standard deviations,
        shapes (samples, ...).
    trusted
        Whether the estimate was used, shape (samples,).
    alarms
        Whether the law flagged a jump, shape (samples,).
    failed
        Number of samples at which the controller had no solution.
    estimating, whole
        Processor time of the estimator, and of estimator and controller, shapes (samples,).
    """

    t: Array
    outputs: Array
    reference: Array
    inputs: Array
    q: Array
    std: Array
    trusted: Array
    alarms: Array
    failed: int
    estimating: Array
    whole: Array

    def to_xarray(self, problem: Problem) -> xr.Dataset:
        """Return the dataset for `livepde.plots.loops`."""
        model, times = problem.reduced, self.t.tolist()
        columns: dict[str, Any] = dict(zip(model.outputs.names, self.outputs.T, strict=True))
        columns |= dict(zip(model.controls, self.inputs.T, strict=True))
        for k, label in enumerate(model.unknowns):
            columns[label], columns[f"{label}_std"] = self.q[:, k], self.std[:, k]
            columns[f"{label}_truth"] = [problem.truth(t)[label] for t in times]
        for k, name in enumerate(problem.goal.track):
            columns[f"{name}_reference"] = self.reference[:, k]
        for name, given in problem.goal.limits.items():
            for k, end in enumerate(("low", "high")):
                if np.isfinite(given[k]):
                    columns[f"{name}_{end}"] = [problem.limits_at(t)[name][k] for t in times]
        for name, (low, high) in problem.goal.inputs.items():
            columns[f"{name}_low"], columns[f"{name}_high"] = (
                np.full(len(times), v) for v in (low, high)
            )
        space = model.frame.model.parameter_space
        units = dict.fromkeys(model.outputs.names, model.frame.outputs.observation.unit)
        units |= {label: space.unknown_of(label).unit for label in model.unknowns}
        data = {
            name: (
                "time",
                np.asarray(values),
                {"units": units.get(name, "")} | ({"held": 1} if name in model.controls else {}),
            )
            for name, values in columns.items()
        }
        unit = model.frame.model.time_unit
        return xr.Dataset(data, coords={"time": ("time", self.t, {"units": unit})})

    def cost(self, problem: Problem, since: float = -np.inf, *, paid: bool = True) -> float:
        """Return the cost of the goal over the samples after a time.

        Parameters
        ----------
        paid
            Include penalties for values beyond limits.
        """
        model, goal = problem.reduced, problem.goal
        rows = [model.outputs.names.index(name) for name in goal.track]
        missed = (self.outputs[:, rows] - self.reference) ** 2 @ np.array([*goal.track.values()])
        before = np.array([[problem.before[name] for name in model.controls]])
        change = np.diff(self.inputs, axis=0, prepend=before) ** 2
        moved = change @ np.array([goal.move[name] for name in model.controls])
        moved += self.inputs @ np.array([goal.price.get(name, 0.0) for name in model.controls])
        beyond = (goal.beyond if paid else 0.0) * self.beyond(problem).sum(axis=1)
        return float((missed + moved + beyond)[self.t > since].sum())

    def beyond(self, problem: Problem) -> Array:
        """Return the excess of each limited output over its limits, shape (samples, limited)."""
        excess = np.zeros((len(self.t), len(problem.goal.limits)))
        for k, name in enumerate(problem.goal.limits):
            low, high = np.array([problem.limits_at(t)[name] for t in self.t.tolist()]).T
            y = self.outputs[:, problem.reduced.outputs.names.index(name)]
            excess[:, k] = np.maximum(np.maximum(low - y, y - high), 0.0)
        return excess

    def violations(self, problem: Problem, tolerance: float = 0.0) -> NDArray[np.bool_]:
        """Return whether each sample has an excess over a limit of more than `tolerance`."""
        return np.asarray((self.beyond(problem) > tolerance).any(axis=1))


class Timed:
    """Wrapper of an estimator that records the processor time of its last step."""

    def __init__(self, inner: Estimator) -> None:
        self.inner = inner
        self.seconds = 0.0

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        begin = process_time()
        known = self.inner.step(t, z, inputs)
        self.seconds = process_time() - begin
        return known

    def dump(self) -> bytes:
        return self.inner.dump()

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        self.inner.restore(content, where)


class Informed:
    """Filter of the true model, which receives the true values of the unknowns at each sample."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.filter = nominal(problem)

    def step(self, t: float, z: Any, inputs: Mapping[str, float]) -> Known:
        # The values at t are constant over the period that ends at t.
        truth = self.problem.truth(t)
        now = [truth[label] for label in self.problem.reduced.unknowns]
        if now != self.filter.q.tolist():
            self.filter.set(truth)
        return self.filter.step(t, z, inputs)

    def dump(self) -> bytes:
        return self.filter.dump()

    def restore(self, content: bytes, where: str = "the checkpoint") -> None:
        self.filter.restore(content, where)


def nominal(problem: Problem) -> Kalman:
    """Return the filter of the wrong fixed model, with the unknowns at their prior."""
    return Kalman(problem.reduced, problem.period, drive=problem.drive)


def offset_free(problem: Problem) -> Kalman:
    """Return the filter of the wrong fixed model that also estimates an offset of each control."""
    model, walk = problem.reduced, problem.drive
    offset = {name: walk[name] for name in model.controls if name in walk}
    return Kalman(model, problem.period, drive=walk, offset=offset)


def informed(problem: Problem) -> Informed:
    """Return the filter of the true model."""
    return Informed(problem)


def learned(problem: Problem) -> Learned:
    """Return the estimator by livepde, with the filter of the wrong fixed model as fallback."""
    return Learned(problem.identifier(), nominal(problem), problem.trust)


def closed_loop(problem: Problem, estimator: Estimator, controller: Controller, seed: int) -> Run:
    """Run a loop with the plant of a seed, and return its record."""
    timed = Timed(estimator)
    loop = Loop(timed, controller, before=problem.before)
    plant, rows, inputs = problem.plant(seed), [], dict(problem.before)
    model = problem.reduced
    failed = 0
    for k, now in enumerate(problem.times):
        disturbances = problem.disturbances(now)
        if k:
            plant.advance(now, {**inputs, **disturbances})
        z = plant.measure()
        begin = process_time()
        action = loop.step(now, z, disturbances, **problem.ahead(now))
        seconds = process_time() - begin
        inputs = dict(action.inputs)
        failed += action.status != "ok"
        estimate = getattr(estimator, "estimate", None)
        alarm = bool(estimate is not None and estimate.diagnostics.jump > 0.0)
        reference = problem.reference(now)
        rows.append(
            (
                now,
                plant.outputs(),
                [reference[name] for name in problem.goal.track],
                [inputs[name] for name in model.controls],
                action.known.q,
                action.known.std,
                action.source == "estimate",
                alarm,
                timed.seconds,
                seconds,
            )
        )
    t, y, r, v, q, std, trusted, alarms, estimating, whole = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    return Run(t, y, r, v, q, std, trusted, alarms, failed, estimating, whole)
