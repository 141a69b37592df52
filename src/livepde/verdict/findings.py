"""Verdict: its level, and findings with evidence, causes, remedy and consequence; shifts."""

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
# From the best to the worst: of a run that nobody has judged nothing is known, not even what a
# caution says.
LEVELS: tuple[Level, ...] = ("trusted", "caution", NOT_JUDGED, "do not trust")
NUMBERS: dict[Level, int] = {NOT_JUDGED: -1, "trusted": 0, "caution": 1, "do not trust": 2}
"""Level -> its number in metrics; a larger one is worse, and -1 is none of them."""

PROMISES: dict[Level, str] = {
    "trusted": "no significant model error was found",
    "caution": "the model may not be exact",
    NOT_JUDGED: "the model was not tested",
    LEVELS[-1]: "do not use the estimates as they are",
}
"""Level -> its meaning for the estimates."""
DOUBTS = ("misfit", "constancy", "disagreement")  # findings that speak against the model
# Those whose severity follows from fit and effect: the interval holds shifts by the discretisation.
RANKED = (*DOUBTS, "following", "stuck", "discretisation")
NAMES: dict[str, Severity] = {"trusted": "note", "caution": "caution", LEVELS[-1]: "do not trust"}
WORST: dict[Severity, Level] = {"note": "trusted", "caution": "caution", "do not trust": LEVELS[-1]}
FEWEST = 20  # samples before which there is nothing to judge by
FLAT = 0.9  # remaining share of a prior standard deviation from which data do not identify
MOST = 5  # findings that are said unasked
NAMED = 4  # causes that are kept
HALF = 0.5  # share of a misfit
CANDIDATES = 3  # causes that are named where none explains half of a misfit
GROSS = ("unit", "exchange")  # kinds of causes
ONCE = ("discretisation", "held", "hold")  # findings on the run as a whole: one each at most
LARGEST = 1e99  # evidence beyond is written as that
SHIFTED = 2.0  # standard deviations by which discretisation has shifted an unknown
DECIDES = 5.0  # the same, from which the interval is little else
GUESSED = 2.0  # the same by input lines alone: where inputs jump, a guess of even the wrong sign
SHARED = 1.0  # the same by one kind of error, from which it is named
SETTING = 1.0  # the same if inputs are readings: no interval holds that
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
"""Kind of a discretisation error -> its name, and the remedy."""
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
        "jump", "boundary", "source", "loss", "flux", "transfer", "initial", "unit",
        "exchange"), and the sensor, channel, boundary or unknown that it concerns.
    text
        The cause in words, with its size.
    share
        Part of the misfit beyond the noise that the cause explains, 0 to 1; NaN if not known.
    remedy
        Recommended action, as a sentence.
    setting
        "key=value" of a case that makes the cause an unknown, or corrects a column, as `livepde run
        --set` takes it;
        several are separated by "; ". Empty if no setting frees the cause.
    size
        Its size in units of the model: of a gain the share, of a lag the time, of a source the
        change of the state per unit of time, of a loss the rate; NaN if not known.
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
        """Return the cause as JSON can hold it."""
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
            parts += self._likely()
        moved = [(name, size) for name, size in self.shift.items() if abs(size) >= 0.5]
        if moved:
            each = [f"{name} by {size:+.1f}" for name, size in moved[:3]]
            parts.append(f"Correcting this would shift {', '.join(each)} standard deviations.")
        remedy = self.remedy or (self.causes[0].remedy if self.causes else "")
        if remedy:
            parts.append(remedy)
        return " ".join(parts)

    def _likely(self) -> list[str]:
        """Return the likely causes as sentences; candidates where none explains half of it."""
        first, *others = self.causes
        if first.share < HALF:
            each = [f"{one.text}{_shown(one.share)}" for one in self.causes[:CANDIDATES]]
            return [f"No single cause explains this. Candidates: {'; '.join(each)}."]
        text = first.text
        if not text.startswith(first.subject or " "):
            text = text[:1].upper() + text[1:]
        found = [f"{text}{_shown(first.share, 'explains {}')}."]
        found += [f"Alternatively, {one.text}{_shown(one.share)}." for one in others[:1]]
        return found

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Finding:
        own = {name: value for name, value in stored.items() if name != "sentence"}
        causes = tuple(map(Cause.from_dict, own["causes"]))
        return cls(**{**own, "causes": causes, "evidence": _number(own["evidence"])})

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as JSON can hold it."""
        evidence = None if math.isnan(self.evidence) else min(self.evidence, LARGEST)
        shift = {name: float(size) for name, size in self.shift.items()}
        causes = [cause.to_dict() for cause in self.causes]
        changed = {"evidence": evidence, "causes": causes, "shift": shift}
        return {**vars(self), **changed, "sentence": self.sentence}


def _shown(share: float, words: str = "{}") -> str:
    """Return a share in parentheses; empty if it is not known."""
    return "" if math.isnan(share) else f" ({words.format(percent(share))})"


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def channel_setting(name: str, key: str, value: str) -> str:
    """Return the setting of a key of a channel, as `Cause.setting` has it; the value is TOML."""
    return f"channels.{quoted(name)}.{key}={value}"


def too_few(what: str, samples: int) -> str:
    """Return why a test was not made, for `Verdict.untested`: there are too few samples."""
    return f"{what}: {samples} samples, at least {FEWEST} required"


def at_bound(label: str, value: float) -> Finding:
    """Return the finding of an unknown that ends at a bound."""
    text, _ = FINDINGS["bound"].filled(label=label, value=value)
    return Finding("bound", "caution", text, label, value)


def at_limit() -> Finding:
    """Return the finding of unknowns that are held at the allowed distance from the prior."""
    text, remedy = FINDINGS["held, now"]
    return Finding("held", "do not trust", text, remedy=remedy)


def flat(label: str, left: float) -> Finding:
    """Return the finding of an unknown that the data do not identify."""
    text, remedy = FINDINGS["flat"].filled(label=label, left=percent(left))
    return Finding("flat", "caution", text, label, left, remedy=remedy)


def _after_misfit(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings; beside a gross misfit, a wide interval shows nothing about the data."""
    given = list(findings)
    if not any((one.what, one.severity) == ("misfit", "do not trust") for one in given):
        return given
    found = []
    for one in given:
        if one.what == "flat":
            text, remedy = FINDINGS["flat, misfit"].filled(
                label=one.subject, left=percent(one.evidence)
            )
            one = replace(one, text=text, remedy=remedy)
        found.append(one)
    return found


def _ranked(findings: Iterable[Finding], errors: ModelErrors) -> list[Finding]:
    """Return findings whose severities follow from fit and effect, with what these are."""
    given = [finding for finding in findings if finding.what != "effect"]
    doubted = any(finding.what in DOUBTS for finding in given)
    level = errors.level(doubted=doubted)
    severity = NAMES[level]
    ranked = [
        replace(one, severity=severity)
        if one.what in RANKED and one.severity != "note" and not _gross(one)
        else one
        for one in given
    ]
    text = errors.sentence(doubted=doubted)
    effect = Finding("effect", severity, text, evidence=errors.effect, remedy=errors.remedy)
    return ranked if level == "trusted" else [effect, *ranked]


def _gross(finding: Finding) -> bool:
    """Whether a column is in another unit, or of another sensor: then no estimate is right."""
    first = finding.causes[0] if finding.causes else None
    return first is not None and first.kind in GROSS and first.share >= HALF


def _graver(finding: Finding) -> Finding:
    return replace(finding, severity="do not trust") if _gross(finding) else finding


def _merged(causes: Sequence[Cause], known: Sequence[Cause]) -> tuple[Cause, ...]:
    """Return causes that were fitted, with those that a run has named before, by their shares."""
    before = {(one.kind, one.subject): one for one in known}
    # What frees a cause is known where the run has named it already. A key that corrects a column
    # has the size that was fitted.
    causes = [
        replace(one, remedy=named.remedy, setting=named.setting)
        if not one.setting and (named := before.get((one.kind, one.subject)))
        else one
        for one in causes
    ]
    # An offset or a gain of an input is that of a boundary value, or of a channel.
    said = {(kind, one.subject) for one in causes for kind in (one.kind, "boundary", "channel")}
    others = [one for one in known if (one.kind, one.subject) not in said]
    # Of the same share what was fitted counts more than what a linear model says.
    return tuple(sorted([*causes, *others], key=lambda one: -one.share)[:NAMED])


@dataclass(frozen=True)
class Verdict:
    """Whether the estimates of a run are to be believed.

    Attributes
    ----------
    level
        "trusted", "caution", "not judged" or "do not trust". A run whose main tests were not made
        is not judged, unless something says not to trust it.
    findings
        Findings against the estimates, the worst first, and notes.
    untested
        Tests that were not made, and why; of a run that is not judged the main ones come first.
    unseen
        Errors that the data would not show and that would yet move an estimate by more than its
        interval, as sentences, the worst first.
    judged
        Whether the main tests were made: what is left of the readings, or of the equation, is noise
        if the model is right.
    errors
        Misfit of the model, and intervals that allow for its errors; None if not computed. With
        them the level follows from fit and effect: however much speaks against a model, its
        estimates may be of use.
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
        """Return the verdict of some findings: the worst of them counts."""
        if errors is not None:
            findings = _ranked(findings, errors)
        findings = _after_misfit(findings)

        def rank(finding: Finding) -> int:
            return LEVELS.index(WORST[finding.severity])

        ordered = sorted(findings, key=rank, reverse=True)
        least = LEVELS.index("trusted" if judged else NOT_JUDGED)
        return cls(
            level=LEVELS[max([least, *map(rank, ordered)])],
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
        """Return the verdict where nothing was looked at."""
        return cls.of((), ("everything: no law has tested the run",), judged=False)

    def with_findings(self, more: Iterable[Finding]) -> Verdict:
        """Return the verdict with more findings, each of them once.

        One on the same unknown or sensor as an earlier one, or on the run as a whole (`ONCE`),
        replaces it: it is of later data.
        """
        texts = {finding.text for finding in self.findings}
        new = [finding for finding in more if finding.text not in texts]
        later = {(one.what, one.subject) for one in new if one.subject or one.what in ONCE}
        kept = [one for one in self.findings if (one.what, one.subject) not in later]
        return self._with(findings=[*kept, *new])

    def with_errors(self, errors: ModelErrors) -> Verdict:
        """Return the verdict whose level follows from fit and effect."""
        return self._with(errors=errors)

    def with_untested(self, untested: str) -> Verdict:
        """Return the verdict with one more thing that was not tested."""
        return self._with(untested=(*self.untested, untested))

    def _with(self, **parts: Any) -> Verdict:
        own = {name: value for name, value in vars(self).items() if name != "level"}
        return Verdict.of(**(own | parts))

    def with_causes(self, causes: Sequence[Cause]) -> Verdict:
        """Return the verdict with other causes of its misfit, the likeliest first.

        Without a misfit one is added if the first of them explains half of it.
        """
        misfit = next((one for one in self.findings if one.what == "misfit"), None)
        if misfit is None:
            if not causes or not causes[0].share >= HALF:
                return self
            text, _ = FINDINGS["misfit, columns"]
            found = Finding("misfit", "caution", text, causes[0].subject, causes=tuple(causes))
            return self.with_findings([_graver(found)])
        ranked = _merged(causes, misfit.causes)
        first = (*misfit.causes, *ranked)[0]
        same = (ranked[0].kind, ranked[0].subject) == (first.kind, first.subject)
        shift = misfit.shift if same else {}
        better = _graver(replace(misfit, subject=ranked[0].subject, causes=ranked, shift=shift))
        return self._with(findings=[better, *(one for one in self.findings if one is not misfit)])

    @property
    def every_sentence(self) -> list[str]:
        """Whether the run is not judged, and all findings: a sentence each, the worst first."""
        why = f" ({self.untested[0]})" if self.untested else ""
        first = [] if self.judged else [f"Not judged: the model was not tested{why}."]
        return list(dict.fromkeys([*first, *(finding.sentence for finding in self.findings)]))

    @property
    def sentences(self) -> list[str]:
        """At most five sentences, the worst first, each once."""
        return self.every_sentence[:MOST]

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as JSON can hold it."""
        findings = [finding.to_dict() for finding in self.findings]
        errors = None if self.errors is None else self.errors.to_dict()
        lists = {"untested": list(self.untested), "unseen": list(self.unseen)}
        return {**vars(self), **lists, "findings": findings, "errors": errors}

    def __str__(self) -> str:
        return "\n".join([self.level, *(f"- {text}" for text in self.sentences)])


@dataclass(frozen=True, eq=False)
class Shifts(Generic[Number]):
    """Shifts of the unknown numbers by errors that are estimated online.

    Kinds of errors are "step", "mesh", "input" and so on. A number is a float, or an array over
    members.
    """

    # Largest shift of an unknown by all kinds together, in standard deviations; NaN: not known
    largest: Number = NOT_KNOWN
    # Kind -> shift of that unknown, in standard deviations
    sizes: Mapping[str, Number] = field(default_factory=dict)
    # (Label of an unknown, kind) -> its shift, in the unit of the unknown
    unknowns: Mapping[tuple[str, str], Number] = field(default_factory=dict)

    def by(self, kind: str) -> dict[str, Number]:
        """Return label -> shift by one kind of error."""
        return {label: shift for (label, of), shift in self.unknowns.items() if of == kind}

    def named(self) -> dict[str, Number]:
        """Return the numbers by their names in tables and files, NaN among them."""
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
    """Return whether a number, or an array over members, is known: that is not NaN alone."""
    if isinstance(number, float):  # as most are: without a call of NumPy
        return not math.isnan(number)
    return bool(np.ndim(number)) or not math.isnan(number)


def discretised(shifts: Shifts[float]) -> Iterator[Finding]:
    """Return the finding that the discretisation has shifted the unknowns, if it has."""
    total = shifts.largest
    sizes = {kind: abs(shifts.sizes[kind]) for kind in REFINE if kind in shifts.sizes}
    if not total > SHIFTED or not sizes:
        return
    parts = _named(sizes)
    each = [f"{REFINE[kind][0]} by {sizes[kind]:.1f}{_listed(shifts.by(kind))}" for kind in parts]
    text, _ = FINDINGS["discretisation"].filled(total=total, each=", ".join(each))
    remedy = " ".join(REFINE[kind][1] for kind in parts)
    # Shifts are part of the reported variance. Beyond five deviations the interval is little else,
    # and depends more on the mesh and the step than on the data.
    unsure = total > DECIDES or sizes.get("input", 0.0) > GUESSED
    severity: Severity = "caution" if unsure else "note"  # the interval holds it
    yield Finding("discretisation", severity, text, evidence=total, remedy=remedy)


def _named(sizes: Mapping[str, float]) -> list[str]:
    """Return the largest kind of shift, and each from `SHARED` on, the largest first."""
    # Shares may cancel in the total.
    least = min(max(sizes.values()), SHARED)
    kinds = sorted(sizes, key=sizes.__getitem__, reverse=True)
    return [kind for kind in kinds if sizes[kind] >= least]


def held_inputs(shifts: Shifts[float]) -> Iterator[Finding]:
    """Return whether inputs that are constant between readings would matter as straight lines."""
    total = abs(shifts.sizes.get(HOLD, math.nan))
    if not total > SETTING:
        return
    moved = {label: -shift for label, shift in shifts.by(HOLD).items()}
    text, remedy = FINDINGS["hold"].filled(total=total, each=_listed(moved))
    yield Finding("hold", "caution", text, evidence=total, remedy=remedy)


def _listed(shifts: Mapping[str, float]) -> str:
    """Return the shifts of the first unknowns in parentheses."""
    parts = [f"{label} by {shift:+.2g}" for label, shift in shifts.items() if math.isfinite(shift)]
    return f" ({', '.join(parts[:LISTED])})" if parts else ""
