"""Settings of a case that estimate or correct the causes in a verdict."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from livepde.cases.process import prior_of
from livepde.cases.read import settings_in, toml_key, toml_value
from livepde.cases.schema import ChannelSpec, TimeConstantSpec
from livepde.errors import CaseError
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.samples import by_name
from livepde.streams import DataTable
from livepde.streams.oddities import switches
from livepde.units import conversion, has_states
from livepde.verdict import Cause, Finding, Severity, Verdict, channel_setting
from livepde.verdict.directions import stated_positions, usual_shifts
from livepde.verdict.sentences import ESTIMATED, FINDINGS, LIKELY, amount_of, clause, estimating

if TYPE_CHECKING:
    from livepde.cases.case import Case, Prepared

WIDE = 2.0  # prior standard deviation of an added unknown, over the estimated size of the cause
KEYS = {kind: key for kind, (_, key) in ESTIMATED.items()}
"""Kind of sensor error -> its key in a case; all sensors share one prior for each kind."""
# Kinds of causes whose size a fit can estimate.
SIZED = ("averaging", "boundary", "channel", "drift", "flux", "lag", "loss", "source", "transfer")
STATED = {"factor", "late"}  # keys of a channel that a setting must not override
EARLY = (0.4, 0.6)  # range of intervals by which a switch seems early
MISSED = 5.0  # largest difference of first readings from a stated initial state, over the noise
DOUBTED = ("caution", "do not trust")  # levels of a verdict with doubts
JUMPED = "Jumps are allowed already: check the model and the data for another cause."
NO_SETTING = "No key of this case does that."


def with_settings(prepared: Prepared, verdict: Verdict) -> Verdict:
    """Return the verdict with settings of the case that estimate or correct each cause."""

    def named(cause: Cause) -> Cause:
        settings = freed(prepared, cause)
        cause = _with_remedy(prepared, cause, settings)
        if settings:
            return replace(cause, setting="; ".join(settings))
        plain = cause.remedy.removesuffix(NO_SETTING).strip()
        more = f" {NO_SETTING}" if cause.kind in SIZED else ""
        return replace(cause, setting="", remedy=f"{plain}{more}".strip())

    omitted = _omitted(prepared) if verdict.level in DOUBTED else ""

    def settled(finding: Finding) -> Finding:
        causes = [*finding.causes, *_also(prepared, finding.causes)]
        finding = replace(finding, causes=tuple(map(named, causes)))
        if finding.what != "misfit" or not omitted or omitted in finding.remedy:
            return finding
        own = finding.remedy or (finding.causes[0].remedy if finding.causes else "")
        return replace(finding, remedy=f"{omitted} {own}".strip())

    return replace(verdict, findings=tuple(map(settled, verdict.findings)))


def _also(prepared: Prepared, causes: Sequence[Cause]) -> Iterator[Cause]:
    """Iterate over causes with similar effects: a slow response for each late clock."""
    known = {cause.subject for cause in causes if cause.kind == "response"}
    unit = prepared.case.equation.time_unit
    for cause in causes:
        if cause.kind == "lag" and cause.subject not in known and _slow(prepared, cause):
            text, remedy = clause("response", cause.subject, cause.size, unit, positive=True)
            yield replace(cause, kind="response", text=text, remedy=remedy, setting="")


def _omitted(prepared: Prepared) -> str:
    """Return a sentence on the effect that the equation omits at first, with a remedy, or ''."""
    text, later = prepared.case.equation.omits, later_start(prepared)
    return f"{text} Or begin later: `{later}`." if text and later else text


def later_start(prepared: Prepared) -> str:
    """Return the setting of a start after which the omitted effect is negligible.

    Empty if the equation omits nothing, or if more than half of the record would be lost.
    """
    case, table = prepared.case, prepared.raw
    if case.equation.settles is None or not isinstance(table, DataTable):
        return ""
    priors = {
        name: prior_of(case, name) for name in case.spec.unknowns if name in case.equation.unknowns
    }
    after = case.equation.settles({**case.options, **priors}, float(case.mesh.p[0].min()))
    begin, end = prepared.t0, float(table.t[-1])
    # If the case already starts almost as late, a later start has no benefit.
    if not 1.2 * prepared.assimilate_from < begin + after < 0.5 * (begin + end):
        return ""
    seconds = conversion(case.equation.time_unit, "s", "a later start").factor * (begin + after)
    unit, length = ("h", 3600.0) if seconds >= 3600.0 else ("s", 1.0)
    return f"data.assimilate_from={toml_value(f'{seconds / length:.2g} {unit}')}"


def after_gaps(verdict: Verdict, inputs: Iterable[Finding]) -> Verdict:
    """Return the verdict, where the remedy of refused readings is to fix gaps of inputs first.

    `inputs`: findings on the inputs; a finding with a remedy is a long gap.
    """
    gaps = next((one.remedy for one in inputs if one.remedy), "")
    if not gaps:
        return verdict
    again = f"{gaps} Then judge the readings again."
    findings = (
        replace(one, remedy=again) if one.what == "refused" else one for one in verdict.findings
    )
    return replace(verdict, findings=tuple(findings))


def start_missed(prepared: Prepared, verdict: Verdict) -> list[Finding]:
    """Return the finding that the first readings contradict a stated start, in a doubted run."""
    settings, missed = _initial(prepared), first_miss(prepared)
    noise, law = prepared.identifier.observed.noise, prepared.case.law
    if isinstance(law, SensitivityLaw) and isinstance(law.noise, int | float):
        noise = np.array([law.noise])
    doubted = verdict.level in DOUBTED
    if not (settings and doubted) or noise is None or missed <= MISSED * np.median(noise):
        return []
    unit = prepared.case.equation.state.unit
    text, remedy = FINDINGS["start, missed"].filled(
        missed=amount_of(missed, unit), setting=settings[0]
    )
    severity: Severity = "do not trust" if verdict.level == "do not trust" else "caution"
    return [Finding("start", severity, text, "", missed, remedy=remedy)]


def _with_remedy(prepared: Prepared, cause: Cause, settings: tuple[str, ...]) -> Cause:
    """Return a cause with a remedy that includes the setting, for errors of sensors and start."""
    case, stated = prepared.case, settings_in(cause.setting)
    if cause.kind == "initial" and settings not in ((), stated):
        return replace(cause, remedy=f"Specify its uncertainty: `{settings[0]}`.")
    if cause.kind == "jump" and _may_jump(case, cause.subject):
        return replace(cause, remedy=JUMPED)
    if cause.kind == "lag" and settings:
        return replace(cause, remedy=_remedy_of_lag(cause, settings[0], held(prepared, cause)))
    if cause.kind not in KEYS or cause.subject not in case.roles("sensor"):
        return cause
    table = case.families.get(cause.subject, cause.subject)  # a family has one table
    if settings == stated and table == cause.subject:
        return cause  # the remedy already includes the value and its unit
    if not settings:
        return replace(cause, remedy=LIKELY[cause.kind].remedy.format(name=cause.subject))
    value = settings[0].partition("=")[2]
    return replace(cause, remedy=estimating(cause.kind, table, value))


def _remedy_of_lag(cause: Cause, late: str, hold: str) -> str:
    """Return the remedy of a lag; `late`, `hold`: the settings that may correct it, or empty."""
    switch = f"If it switches between its rows, set `{hold}`. " if hold else ""
    check = LIKELY["lag"].remedy.format(name=cause.subject)
    return f"{check} {switch}If the clock is wrong, set `{late}`."


def _may_jump(case: Case, name: str) -> bool:
    """Return whether the law of a case tests for jumps of an unknown."""
    jumps = case.law.jumps if isinstance(case.law, SensitivityLaw) else None
    return jumps is not None and (not jumps.unknowns or name in jumps.unknowns)


def switching(case: Case, table: DataTable) -> list[str]:
    """Return the inputs that switch, if the case does not specify `between`."""
    return [
        name
        for name, channel in case.roles("input").items()
        if "between" not in channel.model_fields_set
        and name in table.names
        and switches(table.t, table.values[:, table.names.index(name)], has_states(case.unit(name)))
    ]


def held(prepared: Prepared, cause: Cause) -> str:
    """Return the setting that holds an input between its rows, or an empty text.

    An input that switches, but is interpolated linearly, seems half an interval early.
    """
    channel = prepared.case.spec.channels.get(cause.subject)
    if cause.kind != "lag" or channel is None or not channel.drives or channel.between != "line":
        return ""
    if not (isinstance(table := prepared.raw, DataTable) and cause.subject in table.names):
        return ""
    known = table.t[np.isfinite(table.values[:, table.names.index(cause.subject)])]
    low, high = EARLY
    early = -cause.size / float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    return channel_setting(cause.subject, "between", '"hold"') if low < early < high else ""


def freed(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the settings that estimate or correct a cause; empty if there are none."""
    case = prepared.case
    if case.spec.law.kind != "sensitivity":
        return ()
    if cause.kind == "jump" and _may_jump(case, cause.subject):
        return ()
    remedies: dict[str, Callable[[Prepared, Cause], tuple[str, ...]]]
    remedies = {**dict.fromkeys(KEYS, _of_sensor), "exchange": _exchanged}
    remedies |= {"source": _source, "loss": _loss, "transfer": _transfer}
    remedies |= {"flux": _flux, "boundary": _boundary, "response": _slow}
    kind = cause.kind
    if kind == "offset" and cause.subject in case.roles("boundary"):
        kind = "boundary"
    if kind in remedies:
        return remedies[kind](prepared, cause)
    started = _initial(prepared) if kind == "initial" else ()
    return started or _stated(case, cause)


def _adding(name: str, std: float, **keys: float | str) -> str:
    """Return the setting that adds an unknown, by default with prior 0, in the model's unit."""
    known = {"prior": 0.0, "std": float(f"{std:.2g}"), **keys}
    return f"unknowns.{toml_key(name)}={toml_value(known)}"


def _of_sensor(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the setting of an unknown sensor error, with the prior of other sensors, if any."""
    case = prepared.case
    key, channels, name = KEYS[cause.kind], case.roles("sensor"), cause.subject
    if name not in channels:
        return _stated(case, cause)
    if _is_settled(channels[name], key):
        return ()
    others = {label: value for label, item in channels.items() if (value := getattr(item, key))}
    if key == "offset" and {case.unit(label) for label in others} - {case.unit(name)}:
        return ()  # all offsets share one prior
    std = next(iter(others.values())) if others else _usual_std(prepared, cause)
    return settings_in(cause.setting) if std is None else (_keyed(name, key, std),)


def _is_settled(channel: ChannelSpec, key: str) -> bool:
    """Return whether a sensor already has an unknown error, or has no position that may err."""
    placed = channel.is_point and not channel.is_flux
    return getattr(channel, key) is not None or (key == "at_std" and not placed)


def _keyed(name: str, key: str, value: object) -> str:
    """Return the setting of a key of a channel to a value."""
    return channel_setting(name, key, toml_value(value))


def _slow(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the setting of an unknown time constant, with the prior of other sensors, if any."""
    channels = prepared.case.roles("sensor")
    channel = channels.get(cause.subject)
    if channel is None or not cause.size > 0.0:
        return ()
    taken = (channel.follows, channel.quantity, channel.at_std, channel.time_constant)
    if any(one is not None for one in taken):
        return ()
    others = (item.time_constant for item in channels.values())
    given = next((one for one in others if isinstance(one, TimeConstantSpec)), None)
    size = amount_of(cause.size, prepared.case.equation.time_unit)
    known = given.model_dump() if given else {"value": size, "std": size}
    return (_keyed(cause.subject, "time_constant", known),)


def _usual_std(prepared: Prepared, cause: Cause) -> float | str | None:
    """Return a prior standard deviation for a sensor error; None if its size is unknown."""
    who, key, size = prepared.identifier.observed, KEYS[cause.kind], cause.size
    if key == "at_std" and not math.isfinite(size):
        size = usual_shift(prepared, cause.subject)
    if not math.isfinite(size):
        return None
    own = who.units[who.names.index(cause.subject)].replace("degC", "K")
    unit = {"offset": own, "at_std": prepared.case.equation.length_unit}.get(key, "")
    value = f"{WIDE * abs(size):.2g}"
    return f"{value} {unit}" if unit else float(value)


def usual_shift(prepared: Prepared, name: str) -> float:
    """Return half of the typical position error of a sensor; NaN without a stated position."""
    who = prepared.identifier
    at = stated_positions(who.observed)
    if at is None:
        return math.nan
    return 0.5 * float(usual_shifts(who.model, at)[who.observed.names.index(name)])


def _stated(case: Case, cause: Cause) -> tuple[str, ...]:
    """Return the settings of a cause; empty if they would override a value of the case.

    Also empty for a unit of another quantity, since the law does not know the units of inputs.
    """
    channel, settings = case.spec.channels.get(cause.subject), settings_in(cause.setting)
    keys = {setting.partition("=")[0].rpartition(".")[2] for setting in settings}
    refused = any(getattr(channel, key, None) is not None for key in keys & STATED)
    if "unit" in keys and channel is not None:
        refused |= not _convertible(case, cause.subject, settings)
    if "along" in keys:
        refused |= channel is None or not channel.is_fixed
    # A case requires a sensor: the only sensor cannot be left out.
    if "role" in keys:
        refused |= list(case.roles("sensor")) == [cause.subject]
    return () if refused else settings


def _convertible(case: Case, name: str, settings: Sequence[str]) -> bool:
    """Return whether the unit in a setting is convertible to the unit of a channel."""
    (channel,) = tomllib.loads("\n".join(settings))["channels"].values()
    try:
        conversion(channel["unit"], case.unit(name), name)
    except CaseError:
        return False
    return True


def _exchanged(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the settings that exchange the columns of two channels."""
    case = prepared.case
    names = list(tomllib.loads("\n".join(settings_in(cause.setting))).get("channels", {}))
    channels = [case.spec.channels.get(name) for name in reversed(names)]
    columns = [None if channel is None else channel.column for channel in channels]
    if None in columns:  # a member of a family, or a mean of columns
        return ()
    pairs = zip(names, columns, strict=True)
    return tuple(_keyed(name, "column", column) for name, column in pairs)


def _initial(prepared: Prepared) -> tuple[str, ...]:
    """Return the setting of a start with an uncertainty that covers the first readings."""
    case, stated = prepared.case, prepared.case.spec.initial
    missed = first_miss(prepared)
    if stated is None or isinstance(stated, dict) or stated.std is not None or not missed:
        return ()
    unit = "K" if (of := case.equation.state.unit) == "degC" else of
    size = f"{WIDE * missed:.2g}"
    given = {"from": stated.start, "std": f"{size} {unit}" if unit else float(size)}
    return (f"initial={toml_value(given)}",)


def first_miss(prepared: Prepared) -> float:
    """Return the root mean square difference of the first readings from the initial state.

    It is 0 if the initial state is not a number, or earlier than the first readings.
    """
    later = prepared.t0 < prepared.first.t
    if later or prepared.case.equation.components or not isinstance(prepared.u0, float):
        return 0.0
    seen = _first_readings(prepared)
    return float(np.sqrt(np.mean((seen - prepared.u0) ** 2))) if len(seen) else 0.0


def _first_readings(prepared: Prepared) -> Array:
    """Return the first readings of the state by assimilated sensors without unknown offsets."""
    given, channels = by_name(prepared.first.z, ()), prepared.case.roles("sensor")
    plain = [n for n, item in channels.items() if item.quantity is None and item.offset is None]
    names = [name for name in plain if name in given]
    seen: Array = np.array([float(given[name]) for name in names])
    return np.compress(np.isfinite(seen), seen)


def _capacity(case: Case) -> float:
    """Return the factor from a rate of change of the state to a source of the equation."""
    each = (
        prior_of(case, name) if name in case.spec.unknowns else float(case.options[name])
        for name in case.equation.capacity
    )
    return math.prod(each)


def _free(case: Case, name: str) -> bool:
    """Return whether an optional unknown of the equation can be added to the case."""
    known = case.equation.unknowns.get(name)
    stated = name in case.spec.unknowns or name in case.spec.options
    return known is not None and known.optional and not stated


def _source(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    case = prepared.case
    if not (_free(case, "source") and cause.size):
        return ()
    return (_adding("source", WIDE * abs(cause.size) * _capacity(case)),)


def _loss(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the settings of an unknown loss to the surroundings (see `_surroundings`)."""
    case, name = prepared.case, prepared.case.equation.loss
    if not (_free(case, name) and cause.size > 0.0):
        return ()
    settings = [_rate(name, cause.size * _capacity(case))]
    if "ambient" in case.equation.inputs:
        surroundings = _surroundings(prepared)
        if surroundings is None:
            return ()
        if surroundings != "ambient":
            settings.append(f"inputs.ambient={surroundings}")
    return tuple(settings)


def _rate(name: str, size: float) -> str:
    """Return the setting that adds a positive unknown with a given prior median and std."""
    return _adding(name, size, prior=float(f"{size:.2g}"), transform="log")


def _surroundings(prepared: Prepared) -> float | str | None:
    """Return the temperature of the surroundings: "ambient" if the case defines this input.

    The default is the mean of the first readings; None without readings.
    """
    spec = prepared.case.spec
    if "ambient" in spec.channels or "ambient" in spec.inputs:
        return "ambient"
    seen = _first_readings(prepared)
    return float(f"{seen.mean():.6g}") if len(seen) else None


def _boundary(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the setting of an unknown offset of a boundary value."""
    case = prepared.case
    channel = case.roles("boundary").get(cause.subject)
    if case.equation.fluxes is None or channel is None or channel.offset is not None:
        return ()
    size = float(f"{WIDE * abs(cause.size):.2g}")
    return (_keyed(cause.subject, "offset", size),) if size else ()


def _end(case: Case, name: str, what: str) -> str:
    """Return a name for an unknown condition at a free end of an interval; empty if impossible."""
    taken = {*case.spec.boundary, *(item.at for item in case.roles("boundary").values())}
    if case.equation.fluxes is None or len(case.mesh.p) != 1 or name in taken:
        return ""
    label = f"{what}_{name}".replace("-", "_")
    return "" if label in case.spec.unknowns or not label.isidentifier() else label


def _flux(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the settings of an unknown flux through an end of an interval."""
    case, name = prepared.case, cause.subject
    label = _end(case, name, "flux")
    if not (label and cause.size):
        return ()
    # The flux that is equivalent to a source of this size in the whole interval.
    size = WIDE * abs(cause.size) * _capacity(case) * float(np.ptp(case.mesh.p[0]))
    return _adding(label, size), f"boundary.{toml_key(name)}.flux={toml_value(label)}"


def _transfer(prepared: Prepared, cause: Cause) -> tuple[str, ...]:
    """Return the settings of an unknown heat transfer through an end of an interval."""
    case, name = prepared.case, cause.subject
    label, ambient = _end(case, name, "transfer"), _surroundings(prepared)
    if not (label and cause.size > 0.0) or ambient is None:
        return ()
    if ambient in case.spec.inputs:  # a constant input
        ambient = case.spec.inputs["ambient"]
    # The transfer coefficient that is equivalent to a loss of this size in the whole interval.
    size = cause.size * _capacity(case) * float(np.ptp(case.mesh.p[0]))
    condition = toml_value({"transfer": label, "ambient": ambient})
    return _rate(label, size), f"boundary.{toml_key(name)}={condition}"
