"""Variants of a case, and the results of their runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.cases.case import Prepared, load
from livepde.cases.case_channels import columns_of
from livepde.cases.data import clock_of, delays
from livepde.cases.read import parse, settings_in
from livepde.cases.remedies import (
    with_settings,
)
from livepde.cases.set_aside import with_errors_of_set_aside
from livepde.dates import since_1970
from livepde.errors import CaseError
from livepde.laws import SensitivityLaw
from livepde.laws.assimilation import HALF_LOG
from livepde.plots.style import modes_determined
from livepde.records import interval_95, scalars, used_errors
from livepde.result import Result
from livepde.runs import sampling_findings, verdict
from livepde.runs.summary import ChannelErrors, channel_errors, rmse
from livepde.samples import Sample
from livepde.streams import DataTable
from livepde.verdict import Cause, ModelErrors, Verdict

if TYPE_CHECKING:
    import xarray as xr


EVERY = 1_000_000_000  # interval of stored fields: none, since fields are not compared
AS_STATED = "as stated"
MISSED = 5.0  # gain in log density per reading above which the case misses the readings
GAINED = 3.0  # difference of log evidence that is strong: 20 to 1 (Kass and Raftery 1995)
SAME = 1e-9  # tolerance for equal times, as a share of the length of a run


@dataclass(frozen=True)
class Variant:
    """A named set of changes to a case."""

    name: str
    settings: tuple[str, ...] = ()  # "key=value", as in `--set`


@dataclass(frozen=True)
class LastEstimate:
    """Last estimate of an unknown, with its 95 % interval."""

    value: float
    std: float
    low: float  # ends of the interval, which includes model errors if they are known
    high: float
    unit: str = ""

    def overlaps(self, other: LastEstimate) -> bool:
        """Return whether two intervals overlap; true if an interval is unknown."""
        return not (self.low > other.high or other.low > self.high)


@dataclass(frozen=True)
class VariantRun:
    """Results of the run of a variant."""

    variant: Variant
    error: str = ""  # reason of a failure; empty if the run did not fail
    verdict: Mapping[str, Any] = field(default_factory=dict)  # as returned by `Verdict.to_dict`
    log_evidence: float = math.nan  # of readings as numbers in the data, whatever their unit
    readings: Mapping[str, int] = field(default_factory=dict)  # sensor -> number assimilated
    # Log evidence of the case with the readings of this variant: None if the case has the same
    # readings, NaN if it lacks some of them.
    same_readings: float | None = None
    # Sensor -> log density of a typical reading, from its one-step prediction error.
    densities: Mapping[str, float] = field(default_factory=dict)
    misfits: Mapping[str, float] = field(default_factory=dict)  # sensor -> misfit over noise
    # Sensor -> root mean square one-step prediction error in the second half of the samples.
    errors: Mapping[str, float] = field(default_factory=dict)  # assimilated sensors
    validation: Mapping[str, float] = field(default_factory=dict)  # validation sensors
    estimates: Mapping[str, LastEstimate] = field(default_factory=dict)
    unknowns: int = 0  # number of scalar unknowns and modes of fields
    # Variants that fit as well with other estimates; the intervals include their intervals.
    rivals: tuple[str, ...] = ()
    # Unusable variants with strong evidence against this variant, the best first.
    better: tuple[str, ...] = ()

    @property
    def level(self) -> str:
        """Level of the verdict, or "failed" if the run failed.

        It is at most "caution" if other variants fit as well or better.
        """
        level = "failed" if self.error else str(self.verdict["level"])
        return "caution" if (self.rivals or self.better) and level == "trusted" else level

    @property
    def failed(self) -> bool:
        """Whether the run failed or its fit misses the readings grossly."""
        errors = Verdict.from_dict(self.verdict).errors if self.verdict else None
        return bool(self.error) or (errors is not None and errors.failed)

    @property
    def misfit(self) -> float:
        """Root mean square of the misfits over the sensors; NaN if none is known."""
        return _pooled(self.misfits.values())

    @property
    def validation_error(self) -> float:
        """Root mean square error over the validation sensors; NaN if there are none."""
        return _pooled(self.validation.values())

    @property
    def causes(self) -> list[Cause]:
        """Distinct causes in the verdict that a setting can remedy, the worst finding first."""
        found: dict[str, Cause] = {}
        for finding in Verdict.from_dict(self.verdict).findings if self.verdict else ():
            for cause in finding.causes:
                if cause.setting:
                    found.setdefault(cause.setting, cause)
        return list(found.values())

    def gained(self, base: VariantRun) -> float:
        """Return the log evidence less the case's; NaN if their readings cannot be compared."""
        if self.same_readings is not None:
            return self.log_evidence - self.same_readings + self._evidence_of_lacking(base)
        if self.error or dict(self.readings) != dict(base.readings):
            return math.nan
        return self.log_evidence - base.log_evidence

    def _evidence_of_lacking(self, base: VariantRun) -> float:
        """Return the log evidence gained by readings of the case that the variant lacks.

        If the case misses these readings, a few of them change its evidence by thousands, which
        other variants gain. For this variant they then count as typical readings; otherwise, as 0.
        """
        lacking = {name: n - self.readings.get(name, 0) for name, n in base.readings.items()}
        usual = sum(n * self.densities.get(name, math.nan) for name, n in lacking.items() if n)
        more = usual - (base.log_evidence - (self.same_readings or 0.0))
        return more if more > MISSED * sum(lacking.values()) else 0.0

    def apart(self, base: VariantRun) -> list[str]:
        """Return the unknowns whose intervals in both runs do not overlap."""
        return [
            name
            for name, one in self.estimates.items()
            if name in base.estimates and not one.overlaps(base.estimates[name])
        ]

    def beside(self, rivals: Sequence[VariantRun]) -> VariantRun:
        """Return the run with intervals that include the intervals of its rivals."""

        def both(name: str, own: LastEstimate) -> LastEstimate:
            each = [own, *(one.estimates[name] for one in rivals if name in one.estimates)]
            return replace(
                own, low=min(one.low for one in each), high=max(one.high for one in each)
            )

        estimates = {name: both(name, own) for name, own in self.estimates.items()}
        names = tuple(one.variant.name for one in rivals)
        return replace(self, estimates=estimates, rivals=names)

    def to_dict(self) -> dict[str, Any]:
        """Return the run as values that JSON can represent."""
        return {
            "name": self.variant.name,
            "settings": list(self.variant.settings),
            "error": self.error,
            "level": self.level,
            "log_evidence": _known(self.log_evidence),
            "readings": dict(self.readings),
            "misfit": _known(self.misfit),
            "validation_error": _known(self.validation_error),
            "unknowns": self.unknowns,
            "rivals": list(self.rivals),
            "better": list(self.better),
            "estimates": {
                name: {key: _known(value) for key, value in vars(one).items()}
                for name, one in self.estimates.items()
            },
            "verdict": dict(self.verdict),
        }


def _known(value: Any) -> Any:
    """Return a value, or None for a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _pooled(values: Iterable[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return math.sqrt(sum(value**2 for value in known) / len(known)) if known else math.nan


def variant_of(text: str) -> Variant:
    """Return the variant in a text 'name: key=value; key=value' with an optional name."""
    head, colon, rest = text.partition(":")
    named = bool(colon) and "=" not in head
    settings = settings_in(rest if named else text)
    if not settings or any("=" not in setting for setting in settings):
        raise CaseError(f"--variant {text}: expected 'name: key=value; key=value'.")
    parse(settings)
    return Variant(head.strip() if named else text.strip(), settings)


def run_variant(
    path: str | Path,
    settings: Sequence[str],
    variant: Variant,
    data: str | None = None,
    allow_code: bool = False,
) -> VariantRun:
    """Run a variant of a case with further settings in memory; failures are stored as `error`."""
    try:
        every = parse(settings), parse(variant.settings)
        prepared = load(path, allow_code=allow_code, settings=every).prepare(data)
        # Only the case itself is searched for errors of single columns, to propose variants.
        found = _run(variant, prepared, prepared.stream, columns=not variant.settings)
        stated = load(path, allow_code=allow_code, settings=every[:1])
        if delays(stated) == delays(prepared.case):
            return found
        if stated.spec.data.stop is not None:  # the variant may use late readings after it
            ends = every[0], {"data.stop": None}
            stated = load(path, allow_code=allow_code, settings=ends)
        same = _evidence_of_same(stated.prepare(data), prepared, found)
        return replace(found, same_readings=same)
    except Exception as error:  # noqa: BLE001  any failure becomes a row of the table
        reason = str(error).strip() or "no reason given"
        return VariantRun(variant, error=f"{type(error).__name__}: {reason}")


def _run(
    variant: Variant, prepared: Prepared, samples: Iterable[Sample], *, columns: bool
) -> VariantRun:
    """Run a case; `columns`: whether the verdict searches for errors of single columns."""
    who = prepared.identifier
    result = Result(who.model, who.observed, who.validation, EVERY, layout=prepared.layout)
    for sample in samples:
        result.add(who.step(sample.t, sample.z, sample.inputs))
    if result.last is not None:
        result._settle(who._settled(result.last, columns=columns))
    return _ended(variant, prepared, result.to_xarray())


def _evidence_of_same(stated: Prepared, late: Prepared, found: VariantRun) -> float | None:
    """Return the log evidence of the stated case with a variant's readings (`same_readings`)."""
    known, table = late.stream, stated.stream
    if not (isinstance(known, DataTable) and isinstance(table, DataTable)):
        return math.nan
    offset = 0.0  # between the origins of both tables
    if known.origin is not None and table.origin is not None:
        offset = since_1970(known.origin) - since_1970(table.origin)
        offset *= clock_of(stated.case).second
    before, after = delays(late.case), delays(stated.case)
    values, last = table.values.copy(), -math.inf
    for name in found.readings:
        column = known.values[:, known.names.index(name)]
        used = np.isfinite(column) & (known.t >= late.assimilate_from)
        if not used.any():
            return math.nan
        # Times of the readings in the table of the stated case.
        shift = offset + before.get(name, 0.0) - after.get(name, 0.0)
        width = SAME * max(float(np.ptp(table.t)), 1.0)
        low, high = known.t[used][0] + shift - width, known.t[used][-1] + shift + width
        values[(table.t < low) | (table.t > high), table.names.index(name)] = np.nan
        last = max(last, high)
    if np.array_equal(values, table.values, equal_nan=True):
        return None
    rows = table.t <= last
    table = replace(table, t=table.t[rows], values=values[rows])
    own = _run(Variant(AS_STATED), stated, table, columns=False)
    return own.log_evidence if dict(own.readings) == dict(found.readings) else math.nan


def _ended(variant: Variant, prepared: Prepared, data: xr.Dataset) -> VariantRun:
    """Return the results of a run from its dataset."""
    channels = channel_errors(data)
    labels, fields = scalars(data), prepared.case.model.parameter_space.fields
    raw = prepared.raw
    sampled = sampling_findings(data, None if raw is None else lambda: (raw.t, raw.values))
    found = with_errors_of_set_aside(prepared, data, verdict(data).with_findings(sampled))
    found = with_settings(prepared, found)
    errors = found.errors
    modes = [modes_determined(data, name)[1] for name in fields if f"{name}_modes" in data]
    used = data["time"].values >= prepared.assimilate_from
    seen = np.isfinite(data["innovation"].transpose("time", "sensor").values[used]).sum(axis=0)
    readings = dict(zip(map(str, data["sensor"].values), seen.tolist(), strict=True))
    evidence = float(data.attrs.get("log_evidence", math.nan))
    # Variants may state different units: evidence is a density in the numbers of the data.
    columns = columns_of(prepared.case)
    volumes = (n * math.log(abs(columns[k].factor)) for k, n in readings.items() if k in columns)
    return VariantRun(
        variant,
        verdict=found.to_dict(),
        log_evidence=evidence + sum(volumes),
        readings=readings,
        densities=_densities(prepared, channels),
        misfits=_misfits(data) if errors is None else dict(errors.sensors),
        errors=_later_errors(channels, "assimilated"),
        validation=_later_errors(channels, "validation"),
        estimates=_last_estimates(data, errors),
        unknowns=len(labels) + sum(modes),
    )


def _densities(prepared: Prepared, channels: Mapping[str, ChannelErrors]) -> dict[str, float]:
    """Return sensor -> log density of a typical reading, from its one-step prediction error."""
    noise, law, observed = math.nan, prepared.case.law, prepared.identifier.observed
    if isinstance(law, SensitivityLaw) and isinstance(law.noise, int | float):
        noise = law.noise
    every = np.full(observed.size, noise) if observed.noise is None else observed.noise
    columns, errors = columns_of(prepared.case), _later_errors(channels, "assimilated")
    found = {}
    for name, std in zip(observed.names, every.tolist(), strict=True):
        square = 0.5 * (errors.get(name, math.nan) / std) ** 2
        unit = abs(columns[name].factor) if name in columns else 1.0
        found[name] = math.log(unit / std) - HALF_LOG - square
    return found


def _later_errors(channels: Mapping[str, ChannelErrors], role: str) -> dict[str, float]:
    """Return channel -> root mean square error in the second half, for channels of a role."""
    return {name: rmse(one.later) for name, one in channels.items() if one.role == role}


def _last_estimates(data: xr.Dataset, errors: ModelErrors | None) -> dict[str, LastEstimate]:
    """Return the last estimate of each scalar unknown, with an interval including model errors."""
    found = {}
    allowed = {one.label: one for one in errors.unknowns} if errors is not None else {}
    for label in scalars(data):
        low, high = (float(end[-1]) for end in interval_95(data, label))
        if label in allowed:
            low, high = allowed[label].low, allowed[label].high
        value, std = float(data[label][-1]), float(data[f"{label}_std"][-1])
        unit = str(data[label].attrs.get("units", ""))
        found[label] = LastEstimate(value, std, low, high, unit)
    return found


def _misfits(data: xr.Dataset) -> dict[str, float]:
    """Return sensor -> rms innovation in the second half, over noise estimated from its steps."""
    columns, found = used_errors(data, "innovation", "sensor").T, {}
    for name, column in zip(map(str, data["sensor"].values), columns, strict=True):
        later = column[len(column) // 2 :]
        steps = np.diff(later)
        steps = steps[np.isfinite(steps)]
        noise = math.sqrt(0.5 * float((steps**2).mean())) if len(steps) else math.nan
        found[name] = rmse(later[np.isfinite(later)]) / noise if noise > 0.0 else math.nan
    return found
