"""Verdict of a run: findings of its law, and findings from its dataset and its journal."""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.dates import dated, when
from livepde.diagnostics.check_report import Table
from livepde.laws.equation_tests import rested
from livepde.laws.filter_state import pauses
from livepde.laws.verdict import step_findings
from livepde.linalg import Array
from livepde.plots.style import note, prior_left
from livepde.records import STATUS_CODES, field_names, scalars
from livepde.runs.summary import digits, jumps
from livepde.streams.oddities import FACTORS, clock_leaps, unit_factor
from livepde.verdict import (
    FLAT,
    MOST,
    PROMISES,
    REFINE,
    REFUSED,
    Cause,
    Finding,
    Severity,
    Shifts,
    Verdict,
    at_bound,
    channel_setting,
    discretised,
    flat,
)
from livepde.verdict.sentences import FINDINGS, LIKELY, Sentence, percent

if TYPE_CHECKING:
    import xarray as xr

    from livepde.runs.journal import Journal

MODEL_ERROR = 4.0  # ratio of squared innovations to their expected square: innovations are doubled
MOST_JUMPS = 5  # largest number of jumps with separate sentences
SHIFTED = 3  # permanent setbacks of a clock, from which on intervals are usually wrong
WANDERS = 0.3  # scatter of an estimate over its change since the start: above, it follows the noise
SHORTEST = 20  # smallest number of values to judge whether an estimate wanders
LEFT_OUT = 0.25  # share of a field's mean variance due to modes that the law leaves out
RESTS = 0.1  # scatter of an estimate over its size: up to this ratio, it is steady
AFTER = " The state is re-estimated from there on. The unknowns are kept."
HOUR = 3600.0  # seconds by which clocks are set forward in spring
ZONE = (
    "If the times are local and clocks were set forward here, set `data.zone`, such as "
    "'Europe/Berlin'. "
)
OF_SENSORS = "start", "early"  # kinds of remarks that also concern sensors
# Kind of a gap -> key of its sentence. The first kind that occurs counts, with "" as default.
SENTENCES = {"bridged": "input, bridged", "ended": "input, ended", "": "input, counts"}
INPUT_KINDS = {
    "start": "first values were outliers and count as missing",
    "spike": "spikes were rejected",
    "interpolated": "missing values were interpolated",
    "bridged": "values in long gaps were interpolated",
    "ended": "values at the end were missing: the last one before them was held",
    "missing": "values were missing: the last one before them, if any, was held",
    "early": "first values were earlier than other data and were left out",
    "begin": "rows at the start, before its first value, were left out",
}


def findings_of(data: xr.Dataset, *, judged: bool) -> list[Finding]:
    """Return the findings from the dataset of a run.

    `judged`: whether the law itself has judged innovations and refused readings.
    """
    gradient = note(data, "residual") is not None
    own = [] if judged else [*_model_error(data), *_each("refused", "caution", _refused(data))]
    return [
        *own,
        *_unknowns(data),
        *_each("held", "do not trust", _held(data)),
        *_each("left out", "note", _left_out(data)),
        *_discretised(data),
        *_rests(data),
        *_each("guards", "caution", [] if gradient else _guards(data)),
        *_each("gain", "caution", _gain(data)),
        *_each("jump", "caution", _jumps(data)),
    ]


def input_findings(journal: Journal, channels: Iterable[str]) -> list[Finding]:
    """Return findings on gaps and spikes of the channels that drive the model.

    They are notes. If more than 2 % of the values were held, the law's verdict has a caution.
    """
    found, driving = [], dict.fromkeys(channels)
    counted: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for (kind, name), count in journal.counts.items():
        # Values that are left out at the start also concern sensors, from which the initial state
        # may be computed.
        if kind in OF_SENSORS or name in driving:
            counted[name][kind] = count
    for name in {**driving, **dict.fromkeys(counted)}:
        counts = counted[name]
        parts = [f"{counts[kind]} {text}" for kind, text in INPUT_KINDS.items() if counts[kind]]
        if not parts:
            continue
        held = (counts["missing"] + counts["ended"]) / max(len(journal), 1)
        sentence = SENTENCES[next(filter(counts.get, SENTENCES), "")]
        skip = channel_setting(name, "missing", '"skip"')
        words = {"kind": "Input" if name in driving else "Sensor", "name": name, "skip": skip}
        text, remedy = FINDINGS[sentence].filled(**words, counts=", ".join(parts))
        found.append(Finding("input", "note", text, name, held, remedy=remedy))
    return found


def clock_findings(journal: Journal) -> list[Finding]:
    """Return a finding if times went back: estimates use the times as they were received."""
    count = journal.counts.get(("clock", ""), 0)
    if not count:
        return []
    often = "once" if count == 1 else f"{count} times"
    shifted = journal.counts.get(("shifted", ""), 0)
    text, remedy = FINDINGS["clock"].filled(often=often)
    severity: Severity = "caution"
    if shifted >= SHIFTED:
        text, remedy = FINDINGS["clock, shifted"].filled(often=often, shifted=shifted)
        severity = "do not trust"
    return [Finding("clock", severity, text, "", count, remedy=remedy)]


def sampling_findings(
    data: xr.Dataset, readings: Callable[[], tuple[Array, Array]] | None = None
) -> list[Finding]:
    """Return findings on the times of a run: changed units, leaps of the clock, and pauses.

    `readings`: function that returns times, shape (samples,), and values of the channels, shape
    (samples, channels). Without it, a leap of the clock is reported as a pause.
    """
    t, found = data["time"].values, list[Finding]()
    leaps, breaks = list[float](), pauses(t)
    if breaks and readings is not None:
        all_times, values = readings()
        leaps = clock_leaps(all_times, values, pauses(all_times))
    anchors = note(data, "residual") is None  # the gradient law has no covariance
    for k in breaks:
        usual = float(np.median(np.diff(t[:k])))
        length, at = float(t[k] - t[k - 1]), when(data, float(t[k]))
        times = f"{length:.6g} {data['time'].attrs.get('units', '')}".rstrip()
        later = float(np.median(np.diff(t[k:]))) if k + 1 < len(t) else math.nan
        if factor := unit_factor(float(t[k - 1]), float(t[k]), usual, later):
            found.append(_unit_changed(k, at, factor))
            break  # later intervals cannot be judged
        after = AFTER if anchors else ""
        if float(t[k]) in leaps:
            found.append(_leapt(data, k, at, length - usual, after))
            continue
        text, _ = FINDINGS["pause"].filled(times=times, at=at, count=length / usual, after=after)
        found.append(Finding("pause", "note", text, "", length))
    return found


def _unit_changed(k: int, at: str, factor: float) -> Finding:
    """Return the finding that times have a different unit from a sample on."""
    text, remedy = FINDINGS["clock, unit"].filled(
        sample=k + 1, at=at, factor=factor, unit=FACTORS[factor]
    )
    likely, _ = LIKELY["clock, unit"].filled(at=at)
    cause = Cause("clock", "time", likely, 1.0, remedy)
    return Finding("clock", "do not trust", text, "time", factor, causes=(cause,))


def _leapt(data: xr.Dataset, k: int, at: str, by: float, after: str) -> Finding:
    """Return the finding that a clock leapt forward before a sample, `by` its excess interval."""
    times = f"{by:.6g} {data['time'].attrs.get('units', '')}".rstrip()
    # In spring, a local time without a zone leaps by an hour.
    dates = dated(data)
    summer = dates is not None and abs(by * dates[1] - HOUR) < 0.1 * HOUR
    text, remedy = FINDINGS["clock, leap"].filled(
        sample=k + 1, at=at, times=times, after=after, zone=ZONE if summer else ""
    )
    likely, _ = LIKELY["clock, leap"].filled(at=at, times=times)
    cause = Cause("clock", "time", likely, math.nan, remedy)
    return Finding("clock", "caution", text, "time", k, causes=(cause,))


def _each(what: str, severity: Severity, sentences: Iterable[Sentence]) -> list[Finding]:
    return [Finding(what, severity, one.text, remedy=one.remedy) for one in sentences]


def _model_error(data: xr.Dataset) -> list[Finding]:
    """Return a finding if innovations are too large, for a law that has not judged them."""
    ratio = _last(data, "innovation_ratio")
    if not ratio > MODEL_ERROR:
        return []
    text, _ = FINDINGS["misfit, innovations"].filled(
        times=math.sqrt(ratio), ratio=ratio, limit=MODEL_ERROR
    )
    return [Finding("misfit", "do not trust", text, evidence=ratio)]


def _refused(data: xr.Dataset) -> list[Sentence]:
    """Return a sentence if the gate refused more than a share `REFUSED` of the readings."""
    values = note(data, "refused")
    if values is None:
        return []
    refused = float(np.nansum(values))
    share = refused / max(int(np.isfinite(data["innovation"].values).sum()), 1)
    if share <= REFUSED:
        return []
    return [FINDINGS["refused, run"].filled(share=percent(share, 1), count=round(refused))]


def _unknowns(data: xr.Dataset) -> list[Finding]:
    """Return findings on unknowns at a bound, and on those the data barely determine."""
    found = []
    for label in scalars(data):
        attrs: dict[Any, Any] = data[label].attrs
        value = float(data[label][-1])
        if value in (attrs.get("lower_bound"), attrs.get("upper_bound")):
            found.append(at_bound(label, value))
        left = prior_left(data, label)
        if left > FLAT and "prior_std" in attrs:
            found.append(flat(label, left))
    return found


def _held(data: xr.Dataset) -> list[Sentence]:
    """Return a sentence if latent values were held at `within` prior standard deviations."""
    at = _times(data, "bounded")
    # If a last fit has converged, only its final values count.
    if not len(at) or not data.attrs.get("bounded_at_end", 1.0):
        return []
    return [FINDINGS["held"].filled(count=len(at), at=when(data, at[-1]))]


def _left_out(data: xr.Dataset) -> list[Sentence]:
    """Return a sentence for each field with a large share of variance in left-out modes."""
    found = []
    for name in field_names(data):
        if f"{name}_left_out" not in data:
            continue
        share, count = float(data[f"{name}_left_out"][-1]), int(data[f"{name}_modes"].attrs["of"])
        if not share > LEFT_OUT:
            continue
        std = float(np.sqrt((data[f"{name}_std"].values[-1] ** 2).mean()))
        unit = str(data[name].attrs.get("units", ""))
        of_modes = std * math.sqrt(max(1.0 - share, 0.0))
        found.append(
            FINDINGS["left out"].filled(
                share=percent(share) if share < 0.99 else "More than 99 %",
                name=name,
                count=count,
                std=f"{std:.2g} {unit}".rstrip(),
                modes=f"{of_modes:.2g} {unit}".rstrip(),
            )
        )
    return found


def _jumps(data: xr.Dataset) -> list[Sentence]:
    alarms, found = jumps(data), list[Sentence]()
    for jump in alarms[:MOST_JUMPS]:
        at = when(data, jump.t)
        went = [
            f"{label} has changed from {digits(before, std)[0]} to {' ± '.join(digits(after, std))}"
            for label, (before, after, std) in jump.moved.items()
        ]
        sentence = FINDINGS["jump" if went else "jump, nothing moved"]
        found.append(sentence.filled(at=at, moved=", ".join(went)))
    if len(alarms) > MOST_JUMPS:
        found.append(FINDINGS["jump, more"].filled(count=len(alarms) - MOST_JUMPS))
    return found


def _guards(data: xr.Dataset) -> list[Sentence]:
    """Return sentences on samples that guards tempered or skipped, and on restarts of the law."""
    tempered, held = _times(data, "tempered"), _times(data, "held")
    restarted, runaway = _times(data, "restarted"), _times(data, "runaway")
    found = list[Sentence]()
    if len(tempered) or len(held):
        counts, last = {"tempered": len(tempered), "skipped": len(held)}, max([*tempered, *held])
        found.append(FINDINGS["guards, nonlinear"].filled(**counts, t=last))
    for kind, at in (("guards, restarted", restarted), ("guards, lost", runaway)):
        if len(at):
            found.append(FINDINGS[kind].filled(count=len(at), t=at[-1]))
    return found


def _rests(data: xr.Dataset) -> list[Finding]:
    """Return a finding if the gradient law held the unknowns because of missing excitation."""
    times, at = data["time"].values, _times(data, "at_rest")
    if not len(at):
        return []
    found = rested(len(at), f", last at {when(data, at[-1])}")
    if at[-1] < times[-1]:
        return [found]
    # Time of the first sample of each period in which the unknowns were held.
    held = np.isin(times, at)
    begin = times[held & ~np.append(False, held[:-1])]
    since = when(data, begin[-1])
    before = f", as {len(begin) - 1} times before" if len(begin) > 1 else ""
    text, _ = FINDINGS["rest, now"].filled(since=since, before=before)
    return [replace(found, text=text)]


def _discretised(data: xr.Dataset) -> list[Finding]:
    """Return findings on shifts of the final unknowns by discretisation errors."""
    largest = _last(data, "discretisation_shift")
    sizes = {kind: _last(data, f"{kind}_shift") for kind in REFINE}
    pairs = [(label, kind) for label in scalars(data) for kind in REFINE]
    shifts = {(label, kind): _last(data, f"{label}_{kind}_shift") for label, kind in pairs}
    known = {kind: size for kind, size in sizes.items() if math.isfinite(size)}
    return list(discretised(Shifts(largest, known, shifts)))


def _last(data: xr.Dataset, name: str) -> float:
    """Return the last value of a diagnostic, or NaN."""
    values = note(data, name)
    return math.nan if values is None else float(values[-1])


def _times(data: xr.Dataset, name: str) -> Array:
    """Return the times of the samples whose note is positive."""
    values = note(data, name)
    found: Array = data["time"].values[[] if values is None else values > 0.0]
    return found


def _gain(data: xr.Dataset) -> list[Sentence]:
    """Return a sentence on estimates that wander, for a law with a fixed gain."""
    if note(data, "residual") is None or note(data, "gain") is not None:
        return []
    names = [*scalars(data), *field_names(data)]
    wandering = [name for name in names if name in data and _wanders(data[name].values)]
    if not wandering:
        return []
    return [FINDINGS["gain"].filled(names=", ".join(wandering), share=percent(WANDERS))]


def _wanders(values: np.ndarray[Any, Any]) -> bool:
    """Return whether the later half of values, shape (times, ...), scatters about a line."""
    late = values[len(values) // 2 :].reshape(len(values) - len(values) // 2, -1)
    if len(late) < SHORTEST or not np.isfinite(late).all():
        return False
    # A straight line is subtracted, since an estimate that still learns does not wander.
    line = np.vander(np.linspace(-1.0, 1.0, len(late)), 2)
    left = late - line @ np.linalg.lstsq(line, late, rcond=None)[0]
    learned = np.linalg.norm(late.mean(axis=0) - values[0].ravel())
    scatter = np.sqrt((left**2).sum(axis=1).mean())
    size = np.linalg.norm(late.mean(axis=0))
    return bool(scatter > WANDERS * learned and scatter > RESTS * size)


def verdict(data: xr.Dataset) -> Verdict:
    """Return the verdict of a run: its law's verdict with the findings from its dataset.

    The law's verdict is read from the attribute `verdict` of the dataset. Without this attribute,
    the run is not judged.
    """
    stored = data.attrs.get("verdict")
    # A stored verdict counts the steps of all samples; a dataset may contain only some of them.
    if stored:
        own = Verdict.from_dict(json.loads(stored))
    else:
        codes = data["status"].values.astype(int)
        counts = np.bincount(codes, minlength=len(STATUS_CODES)).tolist()
        own = Verdict.unjudged().with_findings(
            step_findings(dict(zip(STATUS_CODES, counts, strict=True)))
        )
    if not data.sizes["time"]:
        return own
    return own.with_findings(findings_of(data, judged=own.judged))


def verdict_table(found: Verdict) -> Table:
    """Return a verdict as a table: its level, and a row for each finding."""
    rows = [
        (
            finding.severity,
            finding.what,
            finding.subject or "–",
            "; ".join(cause.text for cause in finding.causes[:2]) or "–",
        )
        for finding in found.findings[:MOST]
    ]
    columns = ("severity", "finding", "subject", "likely causes")
    promise = PROMISES[found.level]
    if found.level == "caution" and found.errors is not None:
        promise += ": use the intervals with model errors"
    return Table(f"Verdict: {found.level} ({promise})", columns, rows)


def doubts(data: xr.Dataset) -> list[str]:
    """Return all findings against the estimates as distinct sentences."""
    return verdict(data).every_sentence


def severities(data: xr.Dataset) -> dict[str, Severity]:
    """Return the severity of each sentence of `doubts`."""
    return {finding.sentence: finding.severity for finding in verdict(data).findings}


def unexplained(data: xr.Dataset) -> bool:
    """Return whether the verdict of a run has found a model misfit."""
    return any(finding.what == "misfit" for finding in verdict(data).findings)
