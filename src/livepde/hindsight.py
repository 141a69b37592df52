"""Results that require all samples of a run: smoothed estimates, readings for given unknowns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.estimate import Estimate
from livepde.laws import Belief, FixedInterval, Problem, Status
from livepde.laws.history import changing
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array
from livepde.records import INTERVAL_ENDS, SMOOTHED, Record, bare, interval_95
from livepde.result import Result
from livepde.stepping import End, Interval

if TYPE_CHECKING:
    import xarray as xr


class Hindsight:
    """Record of the accepted samples of a run and its estimates, for smoothing.

    `q0`: latent parameter before the first sample.
    """

    def __init__(self, q0: Array) -> None:
        self._q = [q0]
        self._opening: Interval | None = None
        self._intervals: list[Interval] = []
        self._jumps: dict[int, float] = {}
        self._estimates: list[tuple[int, float, Status]] = []  # number of intervals, time, status

    def add(self, estimate: Estimate, interval: Interval, q: Array) -> None:
        """Add a sample.

        `interval`: interval since the last accepted sample.
        `q`: latent parameter after the sample.
        """
        taken = estimate.status.taken
        opens = taken and interval.t0 == interval.t1
        if self._opening is None:
            nothing = np.full_like(interval.z0, np.nan)
            start = End(t=interval.t0, inputs=interval.inputs0, z=nothing)
            self._opening = interval if opens else Interval.between(start, start)
        if opens:
            self._q = [q]
        elif taken:
            self._intervals.append(interval)
            self._q.append(q)
        # NaN if there is no alarm, so that the comparison is false.
        onset = estimate.diagnostics.jump_samples
        if onset > 0:
            when = changing(self._intervals, len(self._intervals) - int(onset))
            for number in when:
                self._jumps[number] = self._jumps.get(number, 0.0) + 1.0 / len(when)
        self._estimates.append((len(self._intervals), estimate.t, estimate.status))

    def fixed_interval(self, fields_every: int) -> FixedInterval | None:
        """Return the data of a fixed-interval smoother; None without samples."""
        if self._opening is None:
            return None
        final = len(self._estimates) - 1
        with_fields = {n for k, (n, *_) in enumerate(self._estimates) if k in (0, final)}
        with_fields |= {n for n, *_ in self._estimates[::fields_every]}
        return FixedInterval(
            opening=self._opening,
            intervals=self._intervals,
            q=self._q,
            jumps=self._jumps,
            fields=with_fields,
        )

    def dataset(self, result: Result, problem: Problem, beliefs: Iterable[Belief]) -> xr.Dataset:
        """Return smoothed beliefs, given in reverse time order, as a dataset of the run."""
        records = list(self._records(result, problem, beliefs))
        data = result.layout.dataset(reversed(records))
        return data.drop_vars("steps").drop_dims(["sensor", "validation"], errors="ignore")

    def _records(
        self, result: Result, problem: Problem, beliefs: Iterable[Belief]
    ) -> Iterator[Record]:
        count = len(self._estimates)
        # A sample whose step failed has the belief of the last accepted sample.
        groups = groupby(reversed(list(enumerate(self._estimates))), key=lambda item: item[1][0])
        for (_, estimates), belief in zip(groups, beliefs, strict=False):  # t0 may have no estimate
            physical = problem.physical(belief)
            for k, (_, t, status) in estimates:
                keeps = k % result.fields_every == 0 or k == count - 1
                yield from result._records([(self._estimate(result, t, physical, status), keeps)])

    @staticmethod
    def _estimate(result: Result, t: float, belief: Belief, status: Status) -> Estimate:
        validation = 0 if result.validation is None else result.validation.size
        return Estimate(
            t=t,
            belief=belief,
            innovation=np.full(result.observed.size, np.nan),
            validation_error=np.full(validation, np.nan),
            status=status,
            steps=0,
            diagnose=Diagnostics,
            held=(),
            space=result.model.parameter_space,
        )


class LinearReadings:
    """Readings of samples for draws of the unknowns, to first order.

    `shifts`: latent coefficients of the draws relative to the linearisation point, shape (n, m).
    """

    def __init__(self, shifts: Array) -> None:
        self._shifts = shifts
        self._factor, self._weights, self._known = np.zeros((0, 0)), shifts, np.zeros((0, 0))
        self._readings: list[Array] = []
        self._std: list[Array] = []

    def add(self, predicted: Array, rows: Array, factor: Array, noise: Array) -> None:
        """Add a sample.

        `predicted`: readings at the linearisation point, shape (sensors,).
        `rows`, `factor`: joint square root of the covariance of readings and latent unknowns,
        shapes (sensors, r) and (m, r).
        `noise`: standard deviation of each reading, shape (sensors,).
        """
        if not np.array_equal(factor, self._factor):  # equal for constant unknowns
            inverse = np.linalg.pinv(factor)
            self._factor, self._weights = factor, self._shifts @ inverse.T
            self._known = inverse @ factor
        # The remainder is the uncertainty of the state given the unknowns.
        remainder = rows - rows @ self._known
        self._readings.append(predicted + self._weights @ rows.T)
        self._std.append(np.sqrt(noise**2 + (remainder * remainder).sum(axis=1)))

    @property
    def readings(self) -> Array:
        """Readings of each draw without noise, shape (n, samples, sensors)."""
        return np.array(self._readings).swapaxes(0, 1)

    @property
    def std(self) -> Array:
        """Standard deviations of the readings about `readings`, shape (samples, sensors)."""
        return np.array(self._std)


def with_smoothed(data: xr.Dataset, smoothed: xr.Dataset) -> xr.Dataset:
    """Add smoothed variables, such as `k_smoothed`, `k_smoothed_std` and interval ends, to a run.

    `smoothed`: dataset of the same samples from `Identifier.smoothed`.
    """
    attrs, variables = data.attrs, dict[str, Any]()
    run_names = {*attrs["scalars"].split("\n"), *attrs["fields"].split(), *attrs["state"].split()}
    for key, variable in smoothed.data_vars.items():
        name = key if key in run_names else bare(str(key))
        if name in run_names:
            variables[f"{name}{SMOOTHED}{str(key).removeprefix(str(name))}"] = variable.variable
    data = data.assign(variables)
    for name in (key for key in variables if f"{key}_std" in data and f"{key}_low" not in data):
        deviation = data[f"{name}_std"]
        for end, values in zip(INTERVAL_ENDS, interval_95(data, name), strict=True):
            data[f"{name}{end}"] = (deviation.dims, values, deviation.attrs)
    return data
