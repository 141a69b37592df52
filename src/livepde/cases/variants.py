"""Variants of a case, and how the run of each one ends."""

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
from livepde.plots.style import modes_told
from livepde.records import interval_95, scalars, used_errors
from livepde.result import Result
from livepde.runs import sampling_findings, verdict
from livepde.runs.summary import ChannelErrors, channel_errors, rmse
from livepde.samples import Sample
from livepde.streams import DataTable
from livepde.verdict import Cause, ModelErrors, Verdict

if TYPE_CHECKING:
    import xarray as xr


EVERY = 1_000_000_000  # fields are not compared
AS_STATED = "as stated"
MISSED = 5.0  # of log density, from which the case misses a reading
GAINED = 3.0  # of log evidence: strong evidence (Kass and Raftery 1995), 20 to 1
SAME = 1e-9  # of the length of a run: times that differ by less are one moment


@dataclass(frozen=True)
class Variant:
    """A case with other values."""

    name: str
    settings: tuple[str, ...] = ()  # "key=value" as for `--set`


@dataclass(frozen=True)
class LastEstimate:
    """Last estimate of an unknown."""

    value: float
    std: float
    low: float  # ends of the 95 % interval, which allows for errors of the model if they are known
    high: float
    unit: str = ""

    def overlaps(self, other: LastEstimate) -> bool:
        """Return whether two intervals have a point in common; true if one is not known."""
        return not (self.low > other.high or other.low > self.high)


@dataclass(frozen=True)
class VariantRun:
    """How the run of a variant ended."""

    variant: Variant
    error: str = ""  # why it failed; empty if it did not
    verdict: Mapping[str, Any] = field(default_factory=dict)  # of `Verdict.to_dict`
    log_evidence: float = math.nan  # a density in the unit of the data, whatever unit it states
    readings: Mapping[str, int] = field(default_factory=dict)  # sensor -> number assimilated
    # Log evidence of the case with these readings: None if they are those of the case, NaN if the
    # case has not all of them.
    same_readings: float | None = None
    # Sensor -> log density of a usual reading, by its errors one step ahead.
    densities: Mapping[str, float] = field(default_factory=dict)
    misfits: Mapping[str, float] = field(default_factory=dict)  # sensor -> misfit over noise
    # Sensor -> root mean square error one step ahead, second half of the samples.
    errors: Mapping[str, float] = field(default_factory=dict)  # assimilated
    validation: Mapping[str, float] = field(default_factory=dict)
    estimates: Mapping[str, LastEstimate] = field(default_factory=dict)
    unknowns: int = 0  # numbers, and modes of fields
    # Variants that fit as well with other values; the intervals contain theirs.
    rivals: tuple[str, ...] = ()
    # Variants with strong evidence against this one, of which none is usable, the best first.
    better: tuple[str, ...] = ()

    @property
    def level(self) -> str:
        """Level of the verdict; "failed" of a run that failed.

        It is at most "caution" where other variants fit as well or better.
        """
        level = "failed" if self.error else str(self.verdict["level"])
        return "caution" if (self.rivals or self.better) and level == "trusted" else level

    @property
    def failed(self) -> bool:
        """Whether the fit misses the readings grossly, or the run has failed."""
        errors = Verdict.from_dict(self.verdict).errors if self.verdict else None
        return bool(self.error) or (errors is not None and errors.failed)

    @property
    def misfit(self) -> float:
        """Root mean square over the sensors."""
        return _pooled(self.misfits.values())

    @property
    def validation_error(self) -> float:
        """Root mean square over the validation sensors; NaN if there are none."""
        return _pooled(self.validation.values())

    @property
    def causes(self) -> list[Cause]:
        """Causes that a setting frees, the worst finding first, each once."""
        found: dict[str, Cause] = {}
        for finding in Verdict.from_dict(self.verdict).findings if self.verdict else ():
            for cause in finding.causes:
                if cause.setting:
                    found.setdefault(cause.setting, cause)
        return list(found.values())

    def gained(self, base: VariantRun) -> float:
        """Return log evidence minus that of the case itself; NaN if other readings count."""
        if self.same_readings is not None:
            return self.log_evidence - self.same_readings + self._evidence_of_lacking(base)
        if self.error or dict(self.readings) != dict(base.readings):
            return math.nan
        return self.log_evidence - base.log_evidence

    def _evidence_of_lacking(self, base: VariantRun) -> float:
        """Return the log evidence that readings add which the variant lacks.

        Where the case misses those, its evidence moves by thousands with a few of them, and other
        variants gain that. For the variant they are usual readings then. Else they add nothing.
        """
        lacking = {name: n - self.readings.get(name, 0) for name, n in base.readings.items()}
        usual = sum(n * self.densities.get(name, math.nan) for name, n in lacking.items() if n)
        more = usual - (base.log_evidence - (self.same_readings or 0.0))
        return more if more > MISSED * sum(lacking.values()) else 0.0

    def apart(self, base: VariantRun) -> list[str]:
        """Return the unknowns whose intervals in both runs have no point in common."""
        return [
            name
            for name, one in self.estimates.items()
            if name in base.estimates and not one.overlaps(base.estimates[name])
        ]

    def beside(self, rivals: Sequence[VariantRun]) -> VariantRun:
        """Return the run with intervals that contain those of its rivals."""

        def both(name: str, own: LastEstimate) -> LastEstimate:
            each = [own, *(one.estimates[name] for one in rivals if name in one.estimates)]
            return replace(
                own, low=min(one.low for one in each), high=max(one.high for one in each)
            )

        estimates = {name: both(name, own) for name, own in self.estimates.items()}
        names = tuple(one.variant.name for one in rivals)
        return replace(self, estimates=estimates, rivals=names)

    def to_dict(self) -> dict[str, Any]:
        """Return the run as JSON can hold it."""
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
    """Return a value, None for a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _pooled(values: Iterable[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return math.sqrt(sum(value**2 for value in known) / len(known)) if known else math.nan


def variant_of(text: str) -> Variant:
    """Return the variant in a text: 'name: key=value; key=value', the name may be missing."""
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
    """Run a variant of a case with further settings, in memory; a failure is its reason."""
    try:
        every = parse(settings), parse(variant.settings)
        prepared = load(path, allow_code=allow_code, settings=every).prepare(data)
        # Errors of single columns are looked for in the case itself, to be proposed.
        found = _run(variant, prepared, prepared.stream, columns=not variant.settings)
        stated = load(path, allow_code=allow_code, settings=every[:1])
        if delays(stated) == delays(prepared.case):
            return found
        if stated.spec.data.stop is not None:  # after it stand readings that are late
            ends = every[0], {"data.stop": None}
            stated = load(path, allow_code=allow_code, settings=ends)
        same = _evidence_of_same(stated.prepare(data), prepared, found)
        return replace(found, same_readings=same)
    except Exception as error:  # noqa: BLE001  whatever it is, it is a row of the table
        reason = str(error).strip() or "no reason given"
        return VariantRun(variant, error=f"{type(error).__name__}: {reason}")


def _run(
    variant: Variant, prepared: Prepared, samples: Iterable[Sample], *, columns: bool
) -> VariantRun:
    """Run a case; `columns`: whether its verdict looks for errors of single columns."""
    who = prepared.identifier
    result = Result(who.model, who.observed, who.validation, EVERY, layout=prepared.layout)
    for sample in samples:
        result.add(who.step(sample.t, sample.z, sample.inputs))
    if result.last is not None:
        result._settle(who._settled(result.last, columns=columns))
    return _ended(variant, prepared, result.to_xarray())


def _evidence_of_same(stated: Prepared, late: Prepared, found: VariantRun) -> float | None:
    """Return the log evidence of the case as stated with the readings that a variant has used."""
    known, table = late.stream, stated.stream
    if not (isinstance(known, DataTable) and isinstance(table, DataTable)):
        return math.nan
    apart = 0.0  # of times that are numbers
    if known.origin is not None and table.origin is not None:
        apart = since_1970(known.origin) - since_1970(table.origin)
        apart *= clock_of(stated.case).second
    before, after = delays(late.case), delays(stated.case)
    values, last = table.values.copy(), -math.inf
    for name in found.readings:
        column = known.values[:, known.names.index(name)]
        used = np.isfinite(column) & (known.t >= late.assimilate_from)
        if not used.any():
            return math.nan
        # As they stand in the table that the case states.
        shift = apart + before.get(name, 0.0) - after.get(name, 0.0)
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
    """Return how a run ended, from its dataset."""
    channels = channel_errors(data)
    labels, fields = scalars(data), prepared.case.model.parameter_space.fields
    raw = prepared.raw
    sampled = sampling_findings(data, None if raw is None else lambda: (raw.t, raw.values))
    found = with_errors_of_set_aside(prepared, data, verdict(data).with_findings(sampled))
    found = with_settings(prepared, found)
    errors = found.errors
    modes = [modes_told(data, name)[1] for name in fields if f"{name}_modes" in data]
    used = data["time"].values >= prepared.assimilate_from
    seen = np.isfinite(data["innovation"].transpose("time", "sensor").values[used]).sum(axis=0)
    readings = dict(zip(map(str, data["sensor"].values), seen.tolist(), strict=True))
    evidence = float(data.attrs.get("log_evidence", math.nan))
    # A density in the unit of the data, not of the model: the case may state another unit.
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
    """Return the log density of a usual reading of each sensor, by its errors one step ahead."""
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
    """Return the root mean square errors of the channels of a role in the second half."""
    return {name: rmse(one.later) for name, one in channels.items() if one.role == role}


def _last_estimates(data: xr.Dataset, errors: ModelErrors | None) -> dict[str, LastEstimate]:
    """Return the last estimate of each number, with an interval that allows for model errors."""
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
    """Return the misfit of each assimilated sensor over its noise."""
    columns, found = used_errors(data, "innovation", "sensor").T, {}
    for name, column in zip(map(str, data["sensor"].values), columns, strict=True):
        later = column[len(column) // 2 :]
        steps = np.diff(later)
        steps = steps[np.isfinite(steps)]
        noise = math.sqrt(0.5 * float((steps**2).mean())) if len(steps) else math.nan
        found[name] = rmse(later[np.isfinite(later)]) / noise if noise > 0.0 else math.nan
    return found
