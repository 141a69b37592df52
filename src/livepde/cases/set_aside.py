"""Likely errors of an excluded sensor, from its readings and their predictions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from livepde.laws.column_errors import UNITS, Error, cause_of, units_of
from livepde.linalg import Array
from livepde.streams import DataTable
from livepde.verdict import Cause, Finding, Verdict
from livepde.verdict.findings import HALF
from livepde.verdict.sentences import LIKELY

if TYPE_CHECKING:
    import xarray as xr

    from livepde.cases.case import Prepared

FEWEST = 20  # readings required for an analysis
LONGEST = 0.2  # longest lag of a sensor, as a share of its samples
SLIGHT = 0.1  # explained share up to which an error is not reported


class _Sensor(NamedTuple):
    """Readings z of a sensor and their predictions y at times t, shape (samples,)."""

    name: str
    t: Array
    z: Array
    y: Array

    def explained(self, corrected: Array) -> float:
        """Return the smaller share of misfit and signal that corrected readings explain."""
        rest = np.square(corrected - self.y).sum()
        misfit, signal = np.square(self.z - self.y).sum(), np.square(self.y - self.y.mean()).sum()
        # The signal is included since a constant near the predictions follows none of its changes.
        return 1.0 - float(rest / min(misfit, signal)) if min(misfit, signal) > 0.0 else 0.0

    def errors(self, unit: str) -> Iterator[tuple[float, Error]]:
        """Iterate over (explained share, error), for each kind of error with its best size."""
        names, z, y = (self.name,), self.z, self.y
        offset = float((z - y).mean())
        yield self.explained(z - offset), Error("offset", names, offset)
        if y.any() and (factor := float(z @ y / (y @ y))) > 0.0:
            yield self.explained(z / factor), Error("gain", names, factor - 1.0)
        # Only lags of whole samples are tested, since interpolated readings have less noise.
        step, most = float(np.median(np.diff(self.t))), int(LONGEST * len(y))
        lags = [Error("lag", names, k * step) for k in range(-most, most + 1)]
        units = [Error("unit", names, unit=number) for number in units_of(unit, scaled=False)]
        for errors in (lags, units):
            each = [(self.explained(self._corrected(error)), error) for error in errors]
            share, error = max(each, key=itemgetter(0))
            if abs(error.size) < most * step:  # a lag at the limit of the search is not an optimum
                yield share, error

    def _corrected(self, error: Error) -> Array:
        """Return the readings after correction of a lag or a unit."""
        if error.kind == "lag":
            return np.interp(self.t + error.size, self.t, self.z)
        factor, constant = UNITS[error.unit].factor, UNITS[error.unit].constant
        return factor * self.z + constant


def with_errors_of_set_aside(prepared: Prepared, data: xr.Dataset, verdict: Verdict) -> Verdict:
    """Return the verdict with likely causes for each excluded sensor."""
    table, who = prepared.raw, prepared.identifier.observed
    if not isinstance(table, DataTable):
        return verdict
    units, time_unit = dict(zip(who.names, who.units, strict=True)), prepared.case.model.time_unit

    def named(finding: Finding) -> Finding:
        if finding.what != "aside":
            return finding
        unit, found = units[finding.subject], list[Cause]()
        sensor = _readings(table, data, finding.subject)
        if len(sensor.t) >= FEWEST:
            each = sorted(sensor.errors(unit), key=lambda one: -one[0])
            found += [
                cause_of(error, share, unit, time_unit, of_sensor=True)
                for share, error in each
                if share > SLIGHT
            ]
        elsewhere = LIKELY["disagreement"].filled(name=finding.subject).text
        found.append(Cause("position", finding.subject, elsewhere))
        if found[0].share >= HALF:  # the default remedy assumes a defective sensor
            return replace(finding, causes=(*found, *finding.causes), remedy="")
        return replace(finding, causes=(*finding.causes, *found))

    return replace(verdict, findings=tuple(map(named, verdict.findings)))


def _readings(table: DataTable, data: xr.Dataset, name: str) -> _Sensor:
    """Return the readings of a sensor with their predictions, where both are known."""
    t, misses = data["time"].values, data["innovation"].sel(sensor=name).values
    place = np.searchsorted(table.t, t).clip(max=len(table.t) - 1)
    z = np.where(table.t[place] == t, table.values[place, table.names.index(name)], np.nan)
    there = np.isfinite(z - misses)
    return _Sensor(name, t[there], z[there], (z - misses)[there])
