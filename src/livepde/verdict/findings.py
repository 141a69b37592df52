"""Verdict: its level and its findings, with evidence, causes, remedies and shifts of estimates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np

from livepde.verdict.model_errors import ModelErrors
from livepde.verdict.sentences import FINDINGS, percent, quoted

Level: TypeAlias = Literal["trusted", "caution", "not judged", "do not trust"]
Severity: TypeAlias = Literal["note", "caution", "do not trust"]
Measure: TypeAlias = Literal["e-value", "p-value", "number"]

NOT_JUDGED: Literal["not judged"] = "not judged"
# In order of severity: a run that was not judged ranks below a caution, as its errors are unknown.
LEVELS: tuple[Level, ...] = ("trusted", "caution", NOT_JUDGED, "do not trust")
NUMBERS: dict[Level, int] = {NOT_JUDGED: -1, "trusted": 0, "caution": 1, "do not trust": 2}
"""Level -> its number in metrics: larger is worse, and -1 means not judged."""

PROMISES: dict[Level, str] = {
    "trusted": "no significant model error was found",
    "caution": "the model may not be exact",
    NOT_JUDGED: "the model was not tested",
    LEVELS[-1]: "do not use the estimates as they are",
}
"""Level -> its meaning for the estimates."""
DOUBTS = ("misfit", "constancy", "disagreement")  # findings against the model
# Findings whose severity follows from misfit and effect, since the intervals allow for them.
RANKED = (*DOUBTS, "following", "stuck", "discretisation")
NAMES: dict[str, Severity] = {"trusted": "note", "caution": "caution", LEVELS[-1]: "do not trust"}
WORST: dict[Severity, Level] = {"note": "trusted", "caution": "caution", "do not trust": LEVELS[-1]}
FEWEST = 20  # smallest number of samples for a verdict
FLAT = 0.9  # posterior over prior standard deviation from which an unknown is not identifiable
MOST = 5  # findings that are shown by default
NAMED = 4  # causes that a finding keeps
HALF = 0.5  # share of a misfit from which a cause is its explanation
CANDIDATES = 3  # causes that are named if none explains half of a misfit
GROSS = ("unit", "exchange")  # kinds of causes that invalidate all estimates
ONCE = ("discretisation", "held", "hold")  # findings on the run as a whole, at most one of each
LARGEST = 1e99  # upper bound of evidence in JSON
# Shifts of an unknown in standard deviations from which ...
SHIFTED = 2.0  # ... a discretisation error is reported
DECIDES = 5.0  # ... it is a caution, because it dominates the interval
GUESSED = 2.0  # ... interpolation of inputs is a caution: with jumps its sign may be wrong
SHARED = 1.0  # ... a kind of discretisation error is named
SETTING = 1.0  # ... held inputs are reported: the intervals do not include this shift
HOLD = "hold"
LISTED = 5  # unknowns in a sentence
REFINE = {
    "step": ("the time step", "Reduce `steps.dt_max`, or use a second-order scheme."),
    "mesh": ("the mesh", "Refine the mesh (`mesh.cells`) where the state varies most."),
    "input": (
        "the linear interpolation of inputs",
        'Sample these inputs more often. If they switch, add `between = "hold"` to their channels.',
    ),
}
"""Kind of discretisation error -> its name and remedy."""
NOT_KNOWN: Any = math.nan
Number = TypeVar("Number")
Other = TypeVar("Other")


@dataclass(frozen=True)
class Cause:
    """A cause that would explain a finding.

    Attributes
    ----------
    kind, subject
        Kind of error ("offset", "lag", "response", "position", "averaging", "gain", "drift",
        "jump", "layers", "boundary", "source", "loss", "flux", "transfer", "initial", "unit",
        "exchange"), and the sensor, channel, boundary or unknown that it concerns.
    text
        The cause in words, with its size.
    share
        Part of the misfit beyond the noise that the cause explains, 0 to 1; NaN if not known.
    remedy
        Recommended action, as a sentence.
    setting
        Settings "key=value" for `livepde run --set` that estimate the cause or correct a column,
        separated by "; ". Empty if there is no such setting.
    size
        Size in units of the model: a share for a gain, a time for a lag, a change of the state per
        unit of time for a source, a rate for a loss; NaN if not known.
    """

    kind: str
    subject: str
    text: str
    share: float = math.nan
    remedy: str = ""
    setting: str = ""
    size: float = math.nan

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Cause:
        return cls(**{**stored, **{name: _number(stored[name]) for name in ("share", "size")}})

    def to_dict(self) -> dict[str, Any]:
        """Return the cause as a dictionary for JSON."""
        numbers = {"share": self.share, "size": self.size}
        plain = {name: None if math.isnan(value) else value for name, value in numbers.items()}
        return {**vars(self), **plain}


@dataclass(frozen=True)
class Finding:
    """One result of a test against the estimates.

    Attributes
    ----------
    what
        Name of the test, such as "misfit", "constancy", "validation", "prior" or "stuck".
    severity
        "note" (worth knowing), "caution" or "do not trust".
    text
        The finding, as a sentence.
    subject
        The unknown or sensor concerned; empty for the whole run.
    evidence, measure
        A number, and whether it is an e-value, a p-value or the number itself.
    causes
        Likely causes, the likeliest first.
    remedy
        Recommended action, as a sentence.
    shift
        Unknown -> shift of its estimate, in its standard deviations, if the first cause were taken
        into account.
    """

    what: str
    severity: Severity
    text: str
    subject: str = ""
    evidence: float = math.nan
    measure: Measure = "number"
    causes: tuple[Cause, ...] = ()
    remedy: str = ""
    shift: Mapping[str, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """The finding with its causes, consequence and remedy, in plain English."""
        parts = [self.text]
        if self.causes:
            parts += self._cause_sentences()
        shifts = [(name, size) for name, size in self.shift.items() if abs(size) >= 0.5]
        if shifts:
            phrases = [f"{name} by {size:+.1f}" for name, size in shifts[:3]]
            parts.append(f"Correcting this would shift {', '.join(phrases)} standard deviations.")
        remedy = self.remedy or (self.causes[0].remedy if self.causes else "")
        if remedy:
            parts.append(remedy)
        return " ".join(parts)

    def _cause_sentences(self) -> list[str]:
        """Return sentences on the likely causes; candidates if none explains half of the misfit."""
        first, *others = self.causes
        if first.share < HALF:
            candidates = [f"{item.text}{_share(item.share)}" for item in self.causes[:CANDIDATES]]
            return [f"No single cause explains this. Candidates: {'; '.join(candidates)}."]
        text = first.text
        if not text.startswith(first.subject or " "):
            text = text[:1].upper() + text[1:]
        sentences = [f"{text}{_share(first.share, 'explains {}')}."]
        sentences += [f"Alternatively, {item.text}{_share(item.share)}." for item in others[:1]]
        return sentences

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Finding:
        fields = {name: value for name, value in stored.items() if name != "sentence"}
        causes = tuple(map(Cause.from_dict, fields["causes"]))
        return cls(**{**fields, "causes": causes, "evidence": _number(fields["evidence"])})

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a dictionary for JSON."""
        evidence = None if math.isnan(self.evidence) else min(self.evidence, LARGEST)
        shift = {name: float(size) for name, size in self.shift.items()}
        causes = [cause.to_dict() for cause in self.causes]
        changed = {"evidence": evidence, "causes": causes, "shift": shift}
        return {**vars(self), **changed, "sentence": self.sentence}


def _share(share: float, words: str = "{}") -> str:
    """Return a share in parentheses; empty if not known."""
    return "" if math.isnan(share) else f" ({words.format(percent(share))})"


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def channel_setting(name: str, key: str, value: str) -> str:
    """Return a setting of a channel in the format of `Cause.setting`; the value is TOML."""
    return f"channels.{quoted(name)}.{key}={value}"


def too_few(what: str, samples: int) -> str:
    """Return the entry of `Verdict.untested` for a test with too few samples."""
    return f"{what}: {samples} samples, at least {FEWEST} required"


def at_bound(label: str, value: float) -> Finding:
    """Return the finding that the estimate of an unknown is at a bound."""
    text, _ = FINDINGS["bound"].filled(label=label, value=value)
    return Finding("bound", "caution", text, label, value)


def at_limit() -> Finding:
    """Return the finding that unknowns are held at the allowed distance from the prior."""
    text, remedy = FINDINGS["held, now"]
    return Finding("held", "do not trust", text, remedy=remedy)


def flat(label: str, left: float) -> Finding:
    """Return the finding that an unknown is not identifiable; `left`: posterior over prior std."""
    text, remedy = FINDINGS["flat"].filled(label=label, left=percent(left))
    return Finding("flat", "caution", text, label, left, remedy=remedy)


def _after_misfit(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings; a severe misfit becomes the reason for intervals of flat unknowns."""
    findings_list = list(findings)
    if not any((item.what, item.severity) == ("misfit", "do not trust") for item in findings_list):
        return findings_list
    reworded = []
    for item in findings_list:
        if item.what == "flat":
            text, remedy = FINDINGS["flat, misfit"].filled(
                label=item.subject, left=percent(item.evidence)
            )
            item = replace(item, text=text, remedy=remedy)
        reworded.append(item)
    return reworded


def _ranked(findings: Iterable[Finding], errors: ModelErrors) -> list[Finding]:
    """Return findings with severities from misfit and effect, led by the finding "effect"."""
    others = [finding for finding in findings if finding.what != "effect"]
    doubted = any(finding.what in DOUBTS for finding in others)
    level = errors.level(doubted=doubted)
    severity = NAMES[level]
    ranked = [
        replace(item, severity=severity)
        if item.what in RANKED and item.severity != "note" and not _gross(item)
        else item
        for item in others
    ]
    text = errors.sentence(doubted=doubted)
    effect = Finding("effect", severity, text, evidence=errors.effect, remedy=errors.remedy)
    return ranked if level == "trusted" else [effect, *ranked]


def _gross(finding: Finding) -> bool:
    """Return whether a column has a wrong unit or sensor, which invalidates all estimates."""
    first = finding.causes[0] if finding.causes else None
    return first is not None and first.kind in GROSS and first.share >= HALF


def _graver(finding: Finding) -> Finding:
    return replace(finding, severity="do not trust") if _gross(finding) else finding


def _merged_causes(causes: Sequence[Cause], known: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return fitted causes and the known causes of a run, sorted by their shares."""
    known_by_key = {(one.kind, one.subject): one for one in known}
    # A fitted cause without a setting adopts remedy and setting of the known cause. A setting that
    # corrects a column depends on the fitted size, so it is kept.
    causes = [
        replace(one, remedy=match.remedy, setting=match.setting)
        if not one.setting and (match := known_by_key.get((one.kind, one.subject)))
        else one
        for one in causes
    ]
    # An offset or a gain of an input is the same cause as its boundary value or channel.
    covered = {(kind, one.subject) for one in causes for kind in (one.kind, "boundary", "channel")}
    others = [one for one in known if (one.kind, one.subject) not in covered]
    # The sort is stable: at equal shares, fitted causes precede causes from the linear model.
    return tuple(sorted([*causes, *others], key=lambda one: -one.share)[:NAMED])


@dataclass(frozen=True)
class Verdict:
    """Assessment of whether the estimates of a run can be trusted.

    Attributes
    ----------
    level
        "trusted", "caution", "not judged" or "do not trust". If the main tests were not made, the
        level is "not judged", unless a finding is "do not trust".
    findings
        Findings against the estimates, the worst first, and notes.
    untested
        Tests that were not made, with reasons. If the run is not judged, main tests come first.
    unseen
        Sentences on errors that data cannot reveal, but that would shift an estimate by more than
        its interval, the worst first.
    judged
        Whether the main tests were made. They check whether the residuals of the readings, or of
        the equation, are noise.
    errors
        Misfit of the model, and intervals that allow for its errors; None if not computed. If
        given, the level follows from misfit and effect, because the estimates of an inexact model
        may still be useful.
    """

    level: Level
    findings: tuple[Finding, ...] = ()
    untested: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    judged: bool = True
    errors: ModelErrors | None = None

    @classmethod
    def of(
        cls,
        findings: Iterable[Finding],
        untested: Iterable[str] = (),
        unseen: Iterable[str] = (),
        *,
        judged: bool = True,
        errors: ModelErrors | None = None,
    ) -> Verdict:
        """Return the verdict on findings: the worst of them determines the level."""
        if errors is not None:
            findings = _ranked(findings, errors)
        findings = _after_misfit(findings)

        def rank(finding: Finding) -> int:
            return LEVELS.index(WORST[finding.severity])

        ordered = sorted(findings, key=rank, reverse=True)
        lowest = LEVELS.index("trusted" if judged else NOT_JUDGED)
        return cls(
            level=LEVELS[max([lowest, *map(rank, ordered)])],
            findings=tuple(ordered),
            untested=tuple(dict.fromkeys(untested)),
            unseen=tuple(unseen),
            judged=judged,
            errors=errors,
        )

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Verdict:
        findings = [Finding.from_dict(item) for item in stored["findings"]]
        errors, judged = ModelErrors.from_dict(stored.get("errors")), bool(stored["judged"])
        return cls.of(findings, stored["untested"], stored["unseen"], judged=judged, errors=errors)

    @classmethod
    def unjudged(cls) -> Verdict:
        """Return the verdict on a run without any test."""
        return cls.of((), ("everything: no law has tested the run",), judged=False)

    def with_findings(self, more: Iterable[Finding]) -> Verdict:
        """Return the verdict with additional findings, without duplicates.

        A new finding replaces an earlier one of the same name on the same subject. A finding in
        `ONCE` replaces an earlier one of the same name, because it is based on later data.
        """
        texts = {finding.text for finding in self.findings}
        new = [finding for finding in more if finding.text not in texts]
        replaced = {(item.what, item.subject) for item in new if item.subject or item.what in ONCE}
        others = [item for item in self.findings if (item.what, item.subject) not in replaced]
        return self._with(findings=[*others, *new])

    def with_errors(self, errors: ModelErrors) -> Verdict:
        """Return the verdict with model errors: its level follows from misfit and effect."""
        return self._with(errors=errors)

    def with_untested(self, untested: str) -> Verdict:
        """Return the verdict with an additional entry in `untested`."""
        return self._with(untested=(*self.untested, untested))

    def _with(self, **parts: Any) -> Verdict:
        fields = {name: value for name, value in vars(self).items() if name != "level"}
        return Verdict.of(**(fields | parts))

    def with_causes(self, causes: Sequence[Cause]) -> Verdict:
        """Return the verdict with fitted causes of its misfit, the likeliest first.

        If there is no finding of a misfit, one is added if the first cause explains half of it.
        """
        misfit = next((one for one in self.findings if one.what == "misfit"), None)
        if misfit is None:
            if not causes or not causes[0].share >= HALF:
                return self
            text, _ = FINDINGS["misfit, columns"]
            added = Finding("misfit", "caution", text, causes[0].subject, causes=tuple(causes))
            return self.with_findings([_graver(added)])
        ranked = _merged_causes(causes, misfit.causes)
        first = (*misfit.causes, *ranked)[0]
        same = (ranked[0].kind, ranked[0].subject) == (first.kind, first.subject)
        shift = misfit.shift if same else {}
        updated = _graver(replace(misfit, subject=ranked[0].subject, causes=ranked, shift=shift))
        return self._with(findings=[updated, *(one for one in self.findings if one is not misfit)])

    @property
    def every_sentence(self) -> list[str]:
        """A sentence if the run is not judged, and one for each finding, the worst first."""
        reason = f" ({self.untested[0]})" if self.untested else ""
        first = [] if self.judged else [f"Not judged: the model was not tested{reason}."]
        return list(dict.fromkeys([*first, *(finding.sentence for finding in self.findings)]))

    @property
    def sentences(self) -> list[str]:
        """The first five sentences, the worst first, without duplicates."""
        return self.every_sentence[:MOST]

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as a dictionary for JSON."""
        findings = [finding.to_dict() for finding in self.findings]
        errors = None if self.errors is None else self.errors.to_dict()
        lists = {"untested": list(self.untested), "unseen": list(self.unseen)}
        return {**vars(self), **lists, "findings": findings, "errors": errors}

    def __str__(self) -> str:
        return "\n".join([self.level, *(f"- {text}" for text in self.sentences)])


@dataclass(frozen=True, eq=False)
class Shifts(Generic[Number]):
    """Shifts of the unknowns due to errors that are estimated online.

    Kinds of errors are "step", "mesh", "input" and "hold". A number is a float, or an array over
    members.
    """

    # Largest total shift of an unknown, in standard deviations; NaN if not known
    largest: Number = NOT_KNOWN
    # Kind -> shift of the unknown with the largest total, in standard deviations
    sizes: Mapping[str, Number] = field(default_factory=dict)
    # (Label of an unknown, kind) -> shift, in the unit of the unknown
    unknowns: Mapping[tuple[str, str], Number] = field(default_factory=dict)

    def by(self, kind: str) -> dict[str, Number]:
        """Return label -> shift due to one kind of error."""
        return {label: shift for (label, cause), shift in self.unknowns.items() if cause == kind}

    def named(self) -> dict[str, Number]:
        """Return column name in tables and files -> number, which may be NaN."""
        sizes = {f"{kind}_shift": size for kind, size in self.sizes.items()}
        shifts = {f"{label}_{kind}_shift": shift for (label, kind), shift in self.unknowns.items()}
        return {"discretisation_shift": self.largest, **sizes, **shifts}

    def each(self, change: Callable[[Number], Other]) -> Shifts[Other]:
        return Shifts(
            change(self.largest) if known(self.largest) else NOT_KNOWN,
            {kind: change(size) for kind, size in self.sizes.items()},
            {pair: change(shift) for pair, shift in self.unknowns.items()},
        )


def known(number: Any) -> bool:
    """Return whether a number is known: it is an array over members, or a scalar other than NaN."""
    if isinstance(number, float):  # the usual case, without the cost of a NumPy call
        return not math.isnan(number)
    return bool(np.ndim(number)) or not math.isnan(number)


def discretised(shifts: Shifts[float]) -> Iterator[Finding]:
    """Yield the finding on shifts of the unknowns due to discretisation, if significant."""
    total = shifts.largest
    sizes = {kind: abs(shifts.sizes[kind]) for kind in REFINE if kind in shifts.sizes}
    if not total > SHIFTED or not sizes:
        return
    parts = _main_kinds(sizes)
    texts = [f"{REFINE[kind][0]} by {sizes[kind]:.1f}{_listed(shifts.by(kind))}" for kind in parts]
    text, _ = FINDINGS["discretisation"].filled(total=total, each=", ".join(texts))
    remedy = " ".join(REFINE[kind][1] for kind in parts)
    # The reported variance includes the shifts. Beyond `DECIDES` deviations, the interval depends
    # more on the mesh and the step than on the data.
    dominant = total > DECIDES or sizes.get("input", 0.0) > GUESSED
    severity: Severity = "caution" if dominant else "note"
    yield Finding("discretisation", severity, text, evidence=total, remedy=remedy)


def _main_kinds(sizes: Mapping[str, float]) -> list[str]:
    """Return the kinds of shifts of at least `SHARED`, but at least one, the largest first."""
    # All kinds may be below `SHARED`, because the total adds them.
    threshold = min(max(sizes.values()), SHARED)
    kinds = sorted(sizes, key=sizes.__getitem__, reverse=True)
    return [kind for kind in kinds if sizes[kind] >= threshold]


def held_inputs(shifts: Shifts[float]) -> Iterator[Finding]:
    """Yield a finding if linear interpolation of held inputs would shift the unknowns."""
    total = abs(shifts.sizes.get(HOLD, math.nan))
    if not total > SETTING:
        return
    moved = {label: -shift for label, shift in shifts.by(HOLD).items()}
    text, remedy = FINDINGS["hold"].filled(total=total, each=_listed(moved))
    yield Finding("hold", "caution", text, evidence=total, remedy=remedy)


def _listed(shifts: Mapping[str, float]) -> str:
    """Return the shifts of at most `LISTED` unknowns in parentheses."""
    parts = [f"{label} by {shift:+.2g}" for label, shift in shifts.items() if math.isfinite(shift)]
    return f" ({', '.join(parts[:LISTED])})" if parts else ""
