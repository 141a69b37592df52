"""Assessment of one member: findings and verdict from its ledger of score sums."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from livepde.linalg import Array
from livepde.showing import in_percent
from livepde.verdict.directions import (
    DRIFT,
    FIXED,
    LAG,
    LOSS,
    OFFSET,
    REACH,
    SCALED,
    Dictionary,
    ScoreDirection,
)
from livepde.verdict.evidence import (
    CAUSES,
    RECORD,
    CauseEvidence,
    causes_of,
    constancy,
    disagreement,
    following,
    levels,
    mean_squares,
    quiet,
    unsuspicious,
    weighted_median,
)
from livepde.verdict.findings import (
    FEWEST,
    NAMED,
    Cause,
    Finding,
    Severity,
    Verdict,
    channel_setting,
    too_few,
)
from livepde.verdict.ledger import Ledger, chance
from livepde.verdict.sentences import (
    ESTIMATED,
    FINDINGS,
    LIKELY,
    Sentence,
    amount_of,
    clause,
    estimating,
    percent,
    significance,
    width,
)

PRIOR = 1e-4  # p-value of the distance from the prior mean below which there is a finding
LARGER = 1.5  # residual scatter over the configured noise above which there is a note, and ...
SMALLER = 0.5  # ... below which there is one
NOISIER = 3.0  # scatter of a sensor over the typical scatter above which there is a note
STUCK_DISTANCE = 3.0  # standard deviations of the noise between a stuck sensor and its prediction
REFUSED = 0.02  # share of rejected readings above which there is a finding
RECOVERY_SAMPLES = 128  # samples without evidence after which an earlier fault counts as past
BRIEF = 10  # most contradicting readings of a short disturbance, such as after a pause
STUCK_READINGS = 10  # equal readings in a row of a stuck sensor
MOVES = 1.0  # shift, in standard deviations, from which an estimate is not usable
EXPLAINED = 0.5  # share of the misfit from which its first cause accounts for it
FACTOR = 2.0  # largest plausible error of the scale of a sensor or an input
LONGEST = 0.25  # largest plausible delay of a sensor, as a share of the run
SEEN = 4.0  # standard errors from which an amplitude is detectable
OUTSIDE = 2.0  # shift, in standard deviations, that exceeds the interval
MOST_UNDETECTABLE = 3  # most sentences on undetectable errors


@dataclass(frozen=True, eq=False)
class Position:
    """Estimates of one member, and the data on which its verdict is based."""

    ledger: Ledger  # ledger of the member, see `Ledger.of_member`
    # Unknown -> truth minus estimate for a unit amplitude of each direction in each window, in
    # reported standard deviations, (windows, directions)
    moved: dict[str, Array]
    # Squared distance of the estimate from the prior mean in the directions that data determine,
    # chi-square under the model, and its degrees of freedom
    distance: tuple[float, int]
    sensors: Sequence[str]  # names of the sensors
    noise: Array  # standard deviation of the noise of each sensor that the filter uses
    # unit, time_unit: units of the readings and of time
    unit: str
    time_unit: str
    unknowns: Sequence[str]  # label of each constant reduced unknown
    moving: bool  # whether unknowns vary in time
    # Excluded sensors: name -> (time of exclusion, last reading minus prediction)
    excluded: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    # state_only, strain: number of sensors that correct the state but not the unknowns, and largest
    # number of readings of one sensor that did so since the disturbance began
    state_only: int = 0
    strain: int = 0
    start_uncertain: bool = False  # whether the initial state has its own uncertainty


def assess(dictionary: Dictionary, at: Position) -> Verdict:
    """Return the verdict on one member."""
    count = int(at.ledger.seen)
    if count < FEWEST:
        untested = (too_few("innovations", count), *dictionary.left_out)
        return Verdict.of((), untested, judged=False)
    evidence = causes_of(at.ledger)
    findings = list(_misfit(dictionary, at, evidence))
    if not findings:
        findings += _records(at, evidence)
    findings += [*_noise(at), *_stuck(at), *_aside(at), *_disturbed(at), *_refused(at), *_prior(at)]
    return Verdict.of(findings, dictionary.left_out, _undetectable(dictionary, at))


def _undetectable(dictionary: Dictionary, at: Position) -> list[str]:
    """Return sentences on undetectable sensor errors that would shift an estimate significantly.

    An error below `SEEN` standard errors is undetectable. Its size is limited to the amplitude of
    its direction, which is a typical size.
    """
    # The information on each amplitude, sum g g, is the inverse square of its standard error.
    information = at.ledger.sums[1, 0].sum(axis=1)
    amplitude = np.minimum(SEEN / np.sqrt(np.maximum(information, 1e-300)), 1.0)
    shifts = []
    for d, direction in enumerate(dictionary.directions):
        if direction.kind not in ("offset", "gain", "lag", "position"):
            continue
        if f"{direction.kind}[{direction.subject}]" in at.moved:  # it is an estimated unknown
            continue
        for name, sensitivity in at.moved.items():
            shift = float(amplitude[d] * abs(sensitivity[0, d]))
            if shift > OUTSIDE:
                shifts.append((shift, d, name))
    undetected = []
    for shift, d, name in sorted(shifts, reverse=True)[:MOST_UNDETECTABLE]:
        text, remedy = _words(dictionary.directions[d], float(amplitude[d]), at)
        undetected.append(
            f"Undetectable: {text}, which would shift {name} by {shift:.1f} standard deviations. "
            f"{remedy}"
        )
    return undetected


def _misfit(dictionary: Dictionary, at: Position, evidence: CauseEvidence) -> Iterator[Finding]:
    """Yield the finding on innovations that correlate with a possible cause or with each other."""
    # By Ville's inequality, the mean e-value exceeds 1/alpha with a probability of at most alpha.
    limit = -math.log(CAUSES)
    recent = _only_past_evidence(at, evidence)
    if evidence.total < limit:
        yield from _following(at, -1 if recent else 0)
        return
    order = _ranked(evidence)
    if recent and _unshifted(at, evidence, order):
        count = int(at.ledger.age[-1])
        text, _ = FINDINGS["past"].filled(count=count)
        yield Finding("past", "note", text, evidence=float(count))
        return
    # Autocorrelated noise explains the evidence: no cause is named, but the intervals are wider.
    if evidence.whitened < limit:
        correlation = float(evidence.correlation.max(initial=0.0))
        text, _ = FINDINGS["following, causes"].filled(correlation=correlation)
        e = _e_value(evidence.total)
        yield Finding("following", "caution", text, evidence=e, measure="e-value")
        return
    order = [(w, d) for w, d in order if _possible(dictionary.directions[d], w, d, evidence, at)]
    yield _explained(dictionary, at, evidence, order, recent)


def _explained(
    dictionary: Dictionary,
    at: Position,
    evidence: CauseEvidence,
    order: Sequence[tuple[int, int]],
    recent: bool,
) -> Finding:
    """Return the finding on a misfit, with its plausible causes in order of likelihood."""
    p, e_value = significance(evidence.whitened), _e_value(evidence.whitened)
    if not order:
        text, _ = FINDINGS["misfit, no cause"].filled(p=p)
        return Finding("misfit", "do not trust", text, evidence=e_value, measure="e-value")
    causes = tuple(_cause(dictionary.directions[d], w, evidence, at, d) for w, d in order[:NAMED])
    w, d = order[0]
    shift = _shift(at, evidence, w, d)
    # If the cause of a misfit is understood and shifts no unknown, the estimate remains usable.
    grave = max(map(abs, shift.values()), default=math.inf) >= MOVES
    understood = evidence.share[w, d] >= EXPLAINED
    # The effect of the initial state decays, so evidence in later windows has another cause.
    later = evidence.log_e[at.ledger.age < at.ledger.age[0]]
    forgotten = recent or (understood and unsuspicious(later))
    if causes[0].kind == "initial" and not grave and forgotten:
        text, _ = FINDINGS["start"].filled(p=p)
        return Finding("start", "note", text, "", e_value, "e-value", causes, shift=shift)
    text, _ = FINDINGS["misfit"].filled(p=p)
    severity: Severity = "caution" if understood and not grave else "do not trust"
    subject = causes[0].subject
    return Finding("misfit", severity, text, subject, e_value, "e-value", causes, shift=shift)


def _e_value(log_e: float) -> float:
    return math.exp(min(log_e, 700.0))


def _only_past_evidence(at: Position, evidence: CauseEvidence) -> bool:
    """Return whether only old data contradict the model.

    The current restarted windows must be free of evidence. While the longest of them has fewer than
    `RECOVERY_SAMPLES` samples, so must its predecessor.
    """
    ledger = at.ledger
    if not ledger.epoch[-1] or not (ledger.sound or ledger.age[-1] >= RECOVERY_SAMPLES):
        return False
    return quiet(ledger, evidence.log_e)


def _unshifted(at: Position, evidence: CauseEvidence, order: Sequence[tuple[int, int]]) -> bool:
    """Return whether no likely cause shifts the current estimate by a standard deviation."""
    limit = -math.log(CAUSES)
    likely = [(w, d) for w, d in order if evidence.log_e[w, d] > limit] or list(order[:NAMED])
    return all(abs(size) < MOVES for w, d in likely for size in _shift(at, evidence, w, d).values())


def _shift(at: Position, evidence: CauseEvidence, window: int, number: int) -> dict[str, float]:
    """Return unknown -> shift due to a direction with its fitted amplitude, in deviations."""
    size = evidence.size[window, number]
    return {name: float(moved[window, number] * size) for name, moved in at.moved.items()}


def _ranked(evidence: CauseEvidence) -> list[tuple[int, int]]:
    """Return (window, direction) of each direction with evidence, by decreasing evidence.

    Each direction is listed once, with the window in which its e-value is largest.
    """
    windows, directions = evidence.log_e.shape
    best: dict[int, tuple[float, int]] = {}
    for w in range(windows):
        for d in range(directions):
            value = float(evidence.log_e[w, d])
            if value > best.get(d, (0.0, 0))[0]:
                best[d] = value, w
    order = sorted(best, key=lambda d: -best[d][0])
    return [(best[d][1], d) for d in order] or [(0, 0)]


def _possible(
    direction: ScoreDirection, window: int, number: int, evidence: CauseEvidence, at: Position
) -> bool:
    """Return whether the fitted amplitude of a cause is physically plausible."""
    size = float(evidence.size[window, number])
    amount = _amount(direction, size, at)
    if direction.kind in ("loss", "transfer"):  # a missing loss or exchange is positive
        return size > 0.0
    if direction.kind == "averaging":  # the length is positive
        return size > 0.0 and amount <= direction.most
    if direction.kind in ("gain", "channel"):
        return 1.0 / FACTOR <= 1.0 + amount <= FACTOR
    if direction.kind == "lag":
        return abs(size) * LAG <= LONGEST * float(at.ledger.seen)
    return direction.least <= amount <= direction.most


def _cause(
    direction: ScoreDirection, window: int, evidence: CauseEvidence, at: Position, number: int
) -> Cause:
    size, share = evidence.size[window, number], evidence.share[window, number]
    text, remedy = _words(direction, float(size), at)
    if window and direction.kind not in ("jump", "initial"):
        text += f" in the last {int(at.ledger.age[window])} samples"
    share = float(min(max(share, 0.0), 1.0))
    setting, amount = _setting(direction, float(size), at), _amount(direction, float(size), at)
    return Cause(direction.kind, direction.subject, text, share, remedy, setting, amount)


def _amount(direction: ScoreDirection, size: float, at: Position) -> float:
    """Return the size of a cause, in the unit of `Cause.size`."""
    interval, typical = float(at.ledger.times[1]), float(np.median(at.noise))
    process = {
        "source": OFFSET * typical / (REACH * interval),
        "flux": OFFSET * typical / (REACH * interval),
        "loss": LOSS / (REACH * interval),
        "transfer": LOSS / (REACH * interval),
        "boundary": -OFFSET * typical,
        "initial": OFFSET * typical,
        "channel": -SCALED,
        "lag": LAG * interval,
    }
    if direction.kind in process:
        return size * process[direction.kind]
    if direction.kind == "averaging":  # the effect grows with the square of the length
        return math.sqrt(max(size, 0.0)) * direction.size
    if direction.kind in ("offset", "drift"):
        return size * OFFSET * float(at.noise[list(at.sensors).index(direction.subject)])
    return size * direction.size


def _setting(direction: ScoreDirection, size: float, at: Position) -> str:
    """Return the case setting that estimates or corrects a cause of a size; empty if none does.

    An estimated error has a prior standard deviation of twice the size.
    """
    keys = {"offset": "offset", "gain": "gain", "position": "at_std"}
    if direction.kind in keys:
        std = 2.0 * abs(_amount(direction, size, at))
        return channel_setting(direction.subject, keys[direction.kind], f"{std:.2g}")
    if direction.kind == "lag":
        lag = f"{size * LAG * float(at.ledger.times[1]):.4g}"
        value = f'"{lag} {at.time_unit}"' if at.time_unit else lag
        return channel_setting(direction.subject, "late", value)
    if direction.kind == "channel":
        return channel_setting(
            direction.subject, "factor", f"{1.0 + _amount(direction, size, at):.4g}"
        )
    if direction.kind == "averaging":
        half = 0.5 * _amount(direction, size, at)
        ends = f"[[{direction.at - half:.6g}], [{direction.at + half:.6g}]]"
        along = channel_setting(direction.subject, "along", ends)
        return f"{channel_setting(direction.subject, 'at', '')}; {along}"
    if direction.kind == "drift":
        return channel_setting(direction.subject, "role", '"ignored"')
    if direction.kind == "jump":
        return _jump(direction.subject)
    if direction.kind == "initial" and not at.start_uncertain:
        return 'initial="interpolate"'
    return ""


def _jump(label: str) -> str:
    """Return the case setting that allows an unknown to jump."""
    return f"law.jumps={json.dumps([label.partition('[')[0]])}"


def _words(direction: ScoreDirection, size: float, at: Position) -> Sentence:
    """Return a sentence on a cause of a size, with its remedy."""
    name, kind, amount = direction.subject, direction.kind, _amount(direction, size, at)
    unit, positive, values = direction.unit, size > 0.0, dict[str, str]()
    if kind == "lag":
        unit = at.time_unit
    elif kind == "boundary":
        unit, positive = at.unit, amount > 0.0
        kind = "boundary, constant" if name == FIXED else kind
    elif kind == "drift":
        values["rate"] = f"{'+' if positive else '-'}{amount_of(abs(amount) / DRIFT, unit)}"
    elif kind == "position":
        values["where"] = _displacement(direction, amount)
    elif kind == "initial" and at.start_uncertain:
        kind = "initial, uncertain"
    sentence = clause(kind, name, amount, unit, positive=positive, **values)
    if kind in ESTIMATED:
        return sentence._replace(remedy=estimating(kind, name, width(amount, direction.unit)))
    return sentence


def _displacement(direction: ScoreDirection, amount: float) -> str:
    """Return a phrase for the displacement of a sensor from its configured position."""
    axis, end = "xyz"[direction.axis], direction.at + amount
    if direction.at * end >= 0.0:
        side = "closer to" if abs(end) < abs(direction.at) else "farther from"
        return f"{side} {axis} = 0 than configured"
    return f"displaced towards {'larger' if amount > 0.0 else 'smaller'} {axis}"


def _following(at: Position, window: int) -> Iterator[Finding]:
    """Yield the finding on a sensor whose innovations are autocorrelated without a cause."""
    autocorrelated = following(at.ledger, window)
    if autocorrelated is None:
        return
    name = at.sensors[autocorrelated.sensor]
    mean_square = float(mean_squares(at.ledger)[window, autocorrelated.sensor])
    if at.moving and mean_square < 1.0:
        sentence = FINDINGS["following, large noise"]
        text, _ = sentence.filled(name=name, correlation=autocorrelated.correlation)
        yield Finding("following", "note", text, name, autocorrelated.p_value, "p-value")
        return
    text, _ = FINDINGS["following"].filled(name=name, correlation=autocorrelated.correlation)
    yield Finding("following", "caution", text, name, autocorrelated.p_value, "p-value")


def _records(at: Position, evidence: CauseEvidence) -> Iterator[Finding]:
    """Yield findings if the unknowns changed, or if sensors imply different values of them."""
    rho = float(evidence.correlation.max(initial=0.0))
    # Ratio of the variance of a mean of AR(1) errors to that of independent errors.
    variance_ratio = (1.0 + rho) / (1.0 - rho)
    severity: Severity = "caution" if _only_past_evidence(at, evidence) else "do not trust"
    changed = constancy(at.ledger, variance_ratio)
    if changed is not None and changed.p_value < RECORD:
        name = at.unknowns[int(np.argmax(np.abs(changed.change)))]
        text, _ = FINDINGS["constancy"].filled(name=name, after=percent(changed.after))
        likely, remedy = LIKELY["jump"].filled(name=name)
        cause = Cause("jump", name, likely, remedy=remedy, setting=_jump(name))
        p = changed.p_value
        yield Finding("constancy", severity, text, name, p, "p-value", (cause,))
    disagreeing = disagreement(at.ledger, variance_ratio)
    if disagreeing is not None and disagreeing[0] < RECORD:
        name = at.sensors[int(np.argmax(disagreeing[1]))]
        text, _ = FINDINGS["disagreement"].filled(name=name)
        cause = Cause("position", name, LIKELY["disagreement"].filled(name=name).text)
        yield Finding("disagreement", severity, text, name, disagreeing[0], "p-value", (cause,))


def _noise(at: Position) -> Iterator[Finding]:
    """Yield notes on noise that differs from the noise in use: the tests estimate their own."""
    ratio = np.sqrt(levels(at.ledger)[0])
    count = at.ledger.noise[0, 0]
    if not count.any():
        return
    typical = weighted_median(ratio, count)
    if typical > LARGER or typical < SMALLER:
        small = FINDINGS["noise, small"].filled(share=in_percent(typical))
        large = FINDINGS["noise, large"].filled(ratio=typical)
        text, _ = small if typical < SMALLER else large
        yield Finding("noise", "note", text, evidence=typical)
    worst = int(np.argmax(ratio))
    if ratio[worst] > NOISIER * max(typical, 1.0):
        name, factor = at.sensors[worst], float(ratio[worst])
        text, remedy = FINDINGS["noise, sensor"].filled(name=name, ratio=factor)
        yield Finding("noise", "note", text, name, factor, remedy=remedy)


def _stuck(at: Position) -> Iterator[Finding]:
    ledger = at.ledger
    # Readings of a steady process repeat. A sensor is stuck if the model also predicts another
    # value.
    distance = np.abs(ledger.value - ledger.last) / at.noise
    for i in np.flatnonzero((ledger.stuck >= STUCK_READINGS - 1) & (distance > STUCK_DISTANCE)):
        name, count = at.sensors[int(i)], int(ledger.stuck[i]) + 1
        if name in at.excluded:  # its readings are not used
            continue
        text, _ = FINDINGS["stuck"].filled(name=name, count=count)
        setting = channel_setting(name, "role", '"ignored"')
        likely, remedy = LIKELY["stuck"].filled(name=name)
        cause = Cause("stuck", name, likely, remedy=remedy, setting=setting)
        yield Finding("stuck", "do not trust", text, name, float(count), "number", (cause,))


def _aside(at: Position) -> Iterator[Finding]:
    """Yield a finding for each excluded sensor."""
    for name, (since, deviation) in at.excluded.items():
        text, remedy = FINDINGS["aside"].filled(
            name=name,
            since=f"{since:g} {at.time_unit}".rstrip(),
            off=f"{deviation:+.3g} {at.unit.replace('degC', 'K')}".rstrip(),
        )
        setting = channel_setting(name, "role", '"ignored"')
        cause = Cause("sensor", name, LIKELY["aside"].filled(name=name).text, setting=setting)
        yield Finding("aside", "caution", text, name, abs(deviation), "number", (cause,), remedy)


def _disturbed(at: Position) -> Iterator[Finding]:
    """Yield a finding if most readings contradict the model, or did so until recently."""
    if not at.strain:
        return
    text, remedy = FINDINGS["changed"]
    # After a pause, a few readings suffice to correct the state, so the unknowns remain usable.
    severity: Severity = "do not trust" if at.state_only or at.strain > BRIEF else "caution"
    yield Finding("changed", severity, text, evidence=float(at.strain), remedy=remedy)


def _refused(at: Position) -> Iterator[Finding]:
    """Yield a finding if the gate rejects more than the share `REFUSED` of the readings."""
    shown, refused = at.ledger.shown
    share = refused.sum() / max(int(shown.sum()), 1)
    if share <= REFUSED:
        return
    worst = int(np.argmax(refused / np.maximum(shown, 1)))
    name = at.sensors[worst]
    text, remedy = FINDINGS["refused"].filled(
        share=percent(share, 1), count=refused.sum(), name=name
    )
    yield Finding("refused", "caution", text, name, float(share), remedy=remedy)


def _prior(at: Position) -> Iterator[Finding]:
    squared, freedom = at.distance
    p = chance(squared, freedom) if freedom else 1.0
    if p < PRIOR:
        text, _ = FINDINGS["prior"].filled(distance=math.sqrt(squared))
        yield Finding("prior", "caution", text, evidence=p, measure="p-value")
