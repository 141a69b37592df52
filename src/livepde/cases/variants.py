"""Variants of a case: proposals, how the run of each one ends, and which one is recommended."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.cases.case import Prepared, load
from livepde.cases.case_channels import columns_of, noise_of
from livepde.cases.data import clock_of, delays
from livepde.cases.process import unread_without
from livepde.cases.read import parse, settings_in, toml_key, toml_value
from livepde.cases.remedies import (
    first_miss,
    freed,
    later_start,
    switching,
    usual_shift,
    with_intervals,
    with_settings,
)
from livepde.cases.set_aside import with_errors_of_set_aside
from livepde.dates import since_1970
from livepde.errors import CaseError, ModelError
from livepde.fem.field_blocks import base_name
from livepde.laws import SensitivityLaw
from livepde.laws.assimilation import HALF_LOG
from livepde.plots.style import modes_told
from livepde.records import interval_95, scalars, used_errors
from livepde.result import Result
from livepde.runs import sampling_findings, verdict
from livepde.runs.summary import ChannelErrors, channel_errors, rmse
from livepde.samples import Sample
from livepde.streams import DataTable
from livepde.verdict import Cause, ModelErrors, Verdict, channel_setting

if TYPE_CHECKING:
    import xarray as xr

    from livepde.cases.case import Case

EVERY = 1_000_000_000  # fields are not compared
AS_STATED = "as stated"
MISSED = 5.0  # of log density, from which the case misses a reading
GAINED = 3.0  # of log evidence: strong evidence (Kass and Raftery 1995), 20 to 1
SAME = 1e-9  # of the length of a run: times that differ by less are one moment
WORSE = 0.02  # share by which the error of validation sensors may grow: about its own error
USABLE = ("trusted", "caution")
MOST_LAYERS = 8
MOST = 14  # variants that the program chooses
SAMPLES = 64  # in which a source moves the state by the usual error
NAMES = {  # kind of cause -> name of the variant
    "offset": "offset of {}",
    "gain": "gain of {}",
    "position": "position of {}",
    "response": "time constant of {}",
    "averaging": "length of {}",
    "jump": "jumps of {}",
    "source": "source",
    "loss": "loss",
    "channel": "gain of {}",
    "flux": "flux at {}",
    "transfer": "heat transfer at {}",
    "boundary": "offset of {}",
    "initial": "uncertain start",
    "sensor": "without {}",
    "stuck": "without {}",
    "drift": "without {}",
    "unit": "unit of {}",
}


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
            return self.log_evidence - self.same_readings + self._gained_by_others(base)
        if self.error or dict(self.readings) != dict(base.readings):
            return math.nan
        return self.log_evidence - base.log_evidence

    def _gained_by_others(self, base: VariantRun) -> float:
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


def recommended(base: VariantRun, others: Sequence[VariantRun]) -> VariantRun:
    """Return the variant with the best evidence that predicts the validation sensors no worse.

    Among variants of similar evidence it is the one with the fewest unknowns, and a usable one goes
    first. It is the case itself if none has strong evidence against it, or if none of those can be
    used and it can. Variants of similar evidence that exclude its estimates are its rivals: which
    one is right the data cannot tell, as a scale of one of two sensors. Variants that cannot be
    used may yet explain the data better: then the recommended one is not trusted, as it lacks
    something, too.
    """
    strong = [
        (gained, one)
        for one in others
        if (gained := one.gained(base)) > GAINED
        and not (_worse_sensors(one, base) or one.failed > base.failed)
    ]
    if not strong:
        return base
    usable = [(gained, one) for gained, one in strong if one.level in USABLE]
    if not usable:
        usable = [(0.0, base)] if base.level in USABLE else strong
    best, _ = max(usable, key=itemgetter(0))
    near = [(one.unknowns, -gained, one) for gained, one in usable if gained > best - GAINED]
    chosen: VariantRun = min(near, key=itemgetter(0, 1))[-1]
    rivals = [one for *_, one in near if one.apart(chosen)]
    ahead = sorted(strong, key=itemgetter(0), reverse=True)
    better = tuple(one.variant.name for gained, one in ahead if gained > best + GAINED)
    found = chosen.beside(rivals) if rivals else chosen
    return replace(found, better=better) if better else found


def _worse_sensors(one: VariantRun, base: VariantRun) -> list[str]:
    """Return both errors of the validation sensors that a run predicts worse, or not at all."""
    return [
        f"{name} {own:.3g} instead of {error:.3g}"
        for name, error in base.validation.items()
        if math.isfinite(error)
        and not (own := one.validation.get(name, math.nan)) <= error * (1.0 + WORSE)
    ]


def conclusions(base: VariantRun, others: Sequence[VariantRun]) -> list[str]:
    """Return sentences on the recommendation, and on what other variants disagree about."""
    best = recommended(base, others)
    remarks = _remarks(base, best, [one for one in others if not one.error])
    text = _recommendation(base, best)
    if math.isnan(base.log_evidence):
        text = (
            "Variants are not ranked: this case has no log evidence (its law has no covariance). "
            "The case is kept unchanged."
        )
        remarks = iter(())
    failed = _names_of(one for one in others if one.error)
    why = [f"Not compared, because they failed: {failed}."] if failed else []
    equals = (*_equals(best, others), *_better(best, base, others))
    return [text, *equals, *why, *remarks, *_disagreements(best, [base, *others])]


def _recommendation(base: VariantRun, best: VariantRun) -> str:
    if best.variant == base.variant:
        which = " that predicts the validation sensors as well" if base.validation else ""
        usable = "usable " if best.better else ""
        return (
            f"Recommended: the case, unchanged. No {usable}variant{which} gains more than "
            f"{GAINED:g} of log evidence."
        )
    text = (
        f"Recommended: '{best.variant.name}'. Its log evidence is {best.gained(base):.4g} larger "
        f"than that of the case, and its verdict '{best.level}'."
    )
    if math.isfinite(base.validation_error):
        errors = f"{best.validation_error:.3g} instead of {base.validation_error:.3g}"
        text += f" Its error at the validation sensors is {errors}."
    else:
        text += " No validation sensor confirms it."
    if best.level not in USABLE:
        text += " Do not use its estimates: no variant explains the data."
    return text


def _equals(best: VariantRun, others: Sequence[VariantRun]) -> Iterator[str]:
    """Iterate over sentences on the rivals of the recommended variant."""
    if not best.rivals:
        return
    names = ", ".join(f"'{name}'" for name in best.rivals)
    own = next(one for one in others if one.variant == best.variant)
    rivals = [one for one in others if one.variant.name in best.rivals]
    differ = ", ".join(dict.fromkeys(name for one in rivals for name in own.apart(one)))
    yield (
        f"These data cannot distinguish it from {names}, with other values of {differ}. The "
        "intervals of the recommended variant contain theirs. A run of it alone has narrower "
        "intervals: find out which variant is right before you use them."
    )


def _better(best: VariantRun, base: VariantRun, others: Sequence[VariantRun]) -> Iterator[str]:
    """Iterate over the sentence on variants that explain the data better, but cannot be used."""
    if not best.better:
        return
    names = ", ".join(f"'{name}'" for name in best.better)
    first = next(one for one in others if one.variant.name == best.better[0])
    more = first.gained(base) - best.gained(base)
    yield (
        f"The data fit {names} better, by up to {more:.4g} of log evidence, but those estimates "
        f"cannot be used (verdict '{first.level}'). The recommended variant is thus not the whole "
        "explanation: look for another cause before you use its estimates."
    )


def _remarks(base: VariantRun, best: VariantRun, others: Sequence[VariantRun]) -> Iterator[str]:
    """Iterate over variants with better evidence and worse predictions, and refuted ones."""
    for one in others:
        if one.gained(base) > GAINED and (worse := _worse_sensors(one, base)):
            errors = ", ".join(worse)
            yield (
                f"'{one.variant.name}' fits the assimilated sensors better and predicts validation "
                f"ones worse ({errors}): it is not recommended."
            )
    if refuted := _names_of(one for one in others if one.gained(base) < -GAINED):
        yield f"The data contradict {refuted}: lower evidence than the case."
    if names := _names_of(one for one in others if math.isnan(one.gained(base))):
        yield f"The evidence of {names} is missing or counts other readings: it is not compared."
    if best.level not in USABLE:
        for one in others:
            if one.level in USABLE and math.isnan(one.gained(base)):
                yield f"'{one.variant.name}' has the verdict '{one.level}' with its readings."


def _names_of(runs: Iterable[VariantRun]) -> str:
    """Return the names of variants in quotes; empty without any."""
    return ", ".join(f"'{one.variant.name}'" for one in runs)


def _disagreements(best: VariantRun, others: Sequence[VariantRun]) -> Iterator[str]:
    """Iterate over unknowns that differ by more than the intervals between variants."""
    found: dict[str, list[str]] = {}
    shared = False
    for one in others:
        shared |= one is not best and not best.estimates.keys().isdisjoint(one.estimates)
        for name in one.apart(best):
            found.setdefault(name, []).append(one.variant.name)
    for name, names in found.items():
        listed = ", ".join(f"'{one}'" for one in names)
        yield f"{name} depends on the variant: its interval in {listed} does not overlap."
    if shared and not found and best.level in USABLE:
        yield "All variants agree: their intervals overlap with that of the recommended one."


def proposed(prepared: Prepared, base: VariantRun, most: int = MOST) -> list[Variant]:
    """Return variants of a case, the likely causes of the verdict of its run first, each once."""
    found: dict[frozenset[str], Variant] = {}
    for variant in _candidates(prepared, base):
        if variant.settings:
            # The same keys with another prior are no other variant, other layers are.
            keys = (setting.partition("=")[0] for setting in variant.settings)
            layers = [setting for setting in variant.settings if ".regions=" in setting]
            found.setdefault(frozenset((*keys, *layers)), variant)
    return list(found.values())[:most]


def _candidates(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over likely causes, then over what is often missing or too much in a case."""
    case = prepared.case
    # A start that the first readings miss looks like many other errors.
    if first_miss(prepared) > _usual_error(base):
        yield Variant(NAMES["initial"], freed(prepared, Cause("initial", "", "")))
    for name in switching(case, prepared.raw) if isinstance(prepared.raw, DataTable) else ():
        # Lines between the rows of a switch look like many other errors, too.
        yield Variant(f"{name} held", (channel_setting(name, "between", '"hold"'),))
    if later := later_start(prepared):
        yield Variant("later start", (later,))
    for cause in base.causes:
        name = NAMES.get(cause.kind, cause.kind + " of {}").format(cause.subject)
        yield Variant(name, settings_in(cause.setting))
    if case.spec.law.kind != "sensitivity":
        if noise_of(case):
            yield Variant("Kalman filter", with_intervals(case))
        return
    yield from _process(prepared, base)
    yield from _layers(case)
    yield from _sensors(prepared, base)
    yield from _fewer(case)
    known = {name: size for name, size in base.misfits.items() if math.isfinite(size)}
    if len(known) > 2:
        worst = max(known, key=lambda name: known[name])
        yield Variant(f"without {worst}", (channel_setting(worst, "role", '"ignored"'),))
    if not case.spec.law.jumps and base.estimates:
        yield Variant("jumps", ("law.jumps=true",))


def _usual_error(base: VariantRun) -> float:
    """Return the median error of the assimilated sensors."""
    known = [size for size in base.errors.values() if math.isfinite(size)]
    return float(np.median(known)) if known else math.nan


def _process(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over terms that the process may lack."""
    error, table = _usual_error(base), prepared.raw
    if not (isinstance(table, DataTable) and len(table) > 1 and error > 0.0):
        return
    time = SAMPLES * float(np.median(np.diff(table.t)))
    source = freed(prepared, Cause("source", "", "", size=error / time))
    yield Variant("source", source)
    law = prepared.case.spec.law
    if source and law.kind == "sensitivity" and not law.jumps:
        yield Variant("source that jumps", (*source, 'law.jumps=["source"]'))
    yield Variant("loss", freed(prepared, Cause("loss", "", "", size=0.1 / time)))
    offsets = [
        setting
        for name in prepared.case.roles("boundary")
        for setting in freed(prepared, Cause("boundary", name, "", size=error))
    ]
    if offsets:
        yield Variant("offsets of the boundary values", tuple(offsets))
    terms = (("flux", error / time), ("transfer", 0.1 / time))
    for name, (kind, size) in product(map(str, prepared.case.mesh.boundaries or {}), terms):
        settings = freed(prepared, Cause(kind, name, "", size=size))
        yield Variant(NAMES[kind].format(name), settings)


def _sensors(prepared: Prepared, base: VariantRun) -> Iterator[Variant]:
    """Iterate over errors that all sensors may have."""
    # All positions share one prior, which is plausible for each of them.
    shifts = [usual_shift(prepared, name) for name in prepared.case.sensors]
    for kind, size in (("offset", _usual_error(base)), ("position", min(shifts, default=math.nan))):
        # Errors of the state say nothing about plates, which measure a flux.
        sensors = [n for n, one in prepared.case.roles("sensor").items() if not one.is_flux]
        causes = [Cause(kind, name, "", size=size) for name in sensors]
        settings = [setting for cause in causes for setting in freed(prepared, cause)]
        if settings and len(causes) > 1:
            yield Variant(f"{kind}s of all sensors", tuple(settings))


def _fewer(case: Case) -> Iterator[Variant]:
    """Iterate over the case with fewer unknowns."""
    words = {"offset": "offsets", "gain": "gains", "at_std": "uncertain positions"}
    for key, word in {**words, "time_constant": "time constants"}.items():
        stated = [n for n, one in case.roles("sensor").items() if getattr(one, key) is not None]
        yield Variant(f"no {word}", tuple(channel_setting(name, key, "") for name in stated))
    optional = _optional(case)
    for name, unknown in case.spec.unknowns.items():
        key = f"unknowns.{toml_key(name)}"
        gone = _references(case, name)
        if unknown.regions:
            yield Variant(f"one {name} everywhere", (f"{key}.regions=", *gone))
        if name in optional:
            with suppress(ModelError):  # the equation needs it, or another one
                unread = [f"{own}=" for own in unread_without(case, name)]
                yield Variant(f"no {name}", (f"{key}=", *unread, *gone))


def _references(case: Case, name: str) -> list[str]:
    """Return the settings that remove the references of an unknown with other numbers."""
    known = [label for label in case.spec.reference if base_name(label) == name]
    return [f"reference.{toml_key(label)}=" for label in known]


def _optional(case: Case) -> set[str]:
    """Return the unknowns that the equation does not need, and no condition or source names."""
    optional = {name for name, known in case.equation.unknowns.items() if known.optional}
    for item in (*case.spec.boundary.values(), *case.spec.sources.values()):
        optional -= {value for value in vars(item).values() if isinstance(value, str)}
    return optional - {"C"}


def _layers(case: Case) -> Iterator[Variant]:
    """Iterate over unknowns with two layers, and with one for each sensor.

    Their borders lie halfway between sensors.
    """
    nodes = np.sort(case.mesh.p[0])[1:-1]
    if len(case.mesh.p) != 1 or not len(nodes):
        return
    low, high = float(case.mesh.p.min()), float(case.mesh.p.max())
    places = getattr(case.observation, "positions", None)
    inner = np.unique(np.asarray(() if places is None else places, dtype=float).ravel())
    middle = float(np.median(inner)) if len(inner) else 0.5 * (low + high)
    borders = 0.5 * (inner[1:] + inner[:-1])
    near = [float(nodes[np.abs(nodes - one).argmin()]) for one in (middle, *borders)]
    two, many = [low, near[0], high], [low, *sorted(set(near[1:])), high]
    tried = {"two layers": dict(zip(("lower", "upper"), pairwise(two), strict=True))}
    if 3 < len(many) <= 1 + MOST_LAYERS:
        each = enumerate(pairwise(many), 1)
        tried["layers"] = {f"layer_{number}": ends for number, ends in each}
    for name, unknown in case.spec.unknowns.items():
        own = next(iter(case.equation.unknowns), "") == name
        if not own or unknown.regions or unknown.field:
            continue
        for what, layers in tried.items():
            value = toml_value({label: list(ends) for label, ends in layers.items()})
            setting = f"unknowns.{toml_key(name)}.regions={value}"
            yield Variant(f"{what} of {name}", (setting, *_references(case, name)))
