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

PRIOR = 1e-4  # probability of an estimate as far from its prior, drawn from it
LARGER = 1.5  # times the stated noise that is worth a note
SMALLER = 0.5
NOISIER = 3.0  # times the noise of the other sensors
FAR = 3.0  # standard deviations between a sensor that stands still and its prediction
REFUSED = 0.02  # share of the readings that a gate refuses
MENDED = 128  # samples of a new window after which a fault may count as mended
BRIEF = 10  # readings that contradict the model after a pause, say
STANDS = 10  # equal readings in a row
MOVES = 1.0  # standard deviations of a shift from which an estimate is not to be trusted
EXPLAINED = 0.5  # share of the misfit that the first cause explains, else it is not understood
FACTOR = 2.0  # by which the scale of a sensor or an input may be wrong
LONGEST = 0.25  # of the run: how late a sensor may be
SEEN = 4.0  # standard errors of an amplitude from which it shows
BEYOND = 2.0  # standard deviations of a shift beyond an interval
UNSEEN = 3  # sentences on errors that no sensor shows


@dataclass(frozen=True, eq=False)
class Position:
    """Data on the estimates of one member, for its verdict."""

    ledger: Ledger  # the ledger of the member: see `Ledger.of_member`
    # Truth less estimate by each direction of each window, in reported standard deviations:
    # unknown -> (windows, directions)
    moved: dict[str, Array]
    # Squared distance of the estimate from the prior mean, chi-square under the model, and its
    # degrees of freedom
    distance: tuple[float, int]
    sensors: Sequence[str]  # names of the sensors
    noise: Array  # standard deviation of each, as stated
    # unit, time_unit: of the sensors and of the time
    unit: str
    time_unit: str
    unknowns: Sequence[str]  # label of each reduced unknown that stays
    moving: bool  # whether unknowns move
    # Sensors that are set aside: name -> (since when, last reading minus prediction)
    aside: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    # apart, strain: how many sensors correct the state but not the unknowns, and the number of
    # readings of one sensor that did so, since a disturbance began
    apart: int = 0
    strain: int = 0
    start_uncertain: bool = False  # whether the initial state has an uncertainty of its own


def assess(dictionary: Dictionary, at: Position) -> Verdict:
    """Return the verdict on one member."""
    seen = int(at.ledger.seen)
    if seen < FEWEST:
        untested = (too_few("innovations", seen), *dictionary.left_out)
        return Verdict.of((), untested, judged=False)
    evidence = causes_of(at.ledger)
    findings = list(_misfit(dictionary, at, evidence))
    if not findings:
        findings += _records(at, evidence)
    findings += [*_noise(at), *_stuck(at), *_aside(at), *_disturbed(at), *_refused(at), *_prior(at)]
    return Verdict.of(findings, dictionary.left_out, _unseen(dictionary, at))


def _unseen(dictionary: Dictionary, at: Position) -> list[str]:
    """Return which errors of sensors would not show, and move an estimate beyond its interval.

    An error of less than `SEEN` standard errors is not seen, and none is taken larger than the
    amplitude of its direction, which is a usual size.
    """
    # sum g g, the information on each amplitude: its standard error is one over the root.
    den = at.ledger.sums[1, 0].sum(axis=1)
    hidden = np.minimum(SEEN / np.sqrt(np.maximum(den, 1e-300)), 1.0)
    found = []
    for d, direction in enumerate(dictionary.directions):
        if direction.kind not in ("offset", "gain", "lag", "position"):
            continue
        if f"{direction.kind}[{direction.subject}]" in at.moved:  # it is an unknown itself
            continue
        for name, moved in at.moved.items():
            shift = float(hidden[d] * abs(moved[0, d]))
            if shift > BEYOND:
                found.append((shift, d, name))
    undetected = []
    for shift, d, name in sorted(found, reverse=True)[:UNSEEN]:
        text, remedy = _words(dictionary.directions[d], float(hidden[d]), at)
        undetected.append(
            f"Undetectable: {text}, which would shift {name} by {shift:.1f} standard deviations. "
            f"{remedy}"
        )
    return undetected


def _misfit(dictionary: Dictionary, at: Position, evidence: CauseEvidence) -> Iterator[Finding]:
    """Return whether innovations go with a cause more than chance allows."""
    # By Ville's inequality the mean e-value exceeds 1/alpha with a probability of at most alpha.
    limit = -math.log(CAUSES)
    recent = _mended(at, evidence)
    if evidence.total < limit:
        yield from _following(at, -1 if recent else 0)
        return
    order = _ranked(evidence)
    if recent and _recovered(at, evidence, order):
        count = int(at.ledger.age[-1])
        text, _ = FINDINGS["past"].filled(count=count)
        yield Finding("past", "note", text, evidence=float(count))
        return
    # Slow noise alone would look so: no cause may be named, but the intervals have to be wider.
    if evidence.whitened < limit:
        worst = float(evidence.correlation.max(initial=0.0))
        text, _ = FINDINGS["following, causes"].filled(correlation=worst)
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
    """Return the finding on a misfit with its possible causes, the likeliest first."""
    p, e_value = significance(evidence.whitened), _e_value(evidence.whitened)
    if not order:
        text, _ = FINDINGS["misfit, no cause"].filled(p=p)
        return Finding("misfit", "do not trust", text, evidence=e_value, measure="e-value")
    causes = tuple(_cause(dictionary.directions[d], w, evidence, at, d) for w, d in order[:NAMED])
    w, d = order[0]
    shift = _shift(at, evidence, w, d)
    # A misfit whose cause is understood and moves no unknown leaves the estimate usable.
    grave = max(map(abs, shift.values()), default=math.inf) >= MOVES
    understood = evidence.share[w, d] >= EXPLAINED
    # The state forgets where it began, so that later readings determine the unknowns without it.
    # What they show has another cause, and is no matter of the start.
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


def _mended(at: Position, evidence: CauseEvidence) -> bool:
    """Return whether the evidence against the model is long past.

    There is none in the restarted windows: neither in the current ones nor, as long as the longest
    of them is young, in the one before it.
    """
    ledger = at.ledger
    if not ledger.epoch[-1] or not (ledger.sound or ledger.age[-1] >= MENDED):
        return False
    return quiet(ledger, evidence.log_e)


def _recovered(at: Position, evidence: CauseEvidence, order: Sequence[tuple[int, int]]) -> bool:
    """Return whether no likely cause has left the estimate off by a standard deviation."""
    limit = -math.log(CAUSES)
    likely = [(w, d) for w, d in order if evidence.log_e[w, d] > limit] or list(order[:NAMED])
    return all(abs(size) < MOVES for w, d in likely for size in _shift(at, evidence, w, d).values())


def _shift(at: Position, evidence: CauseEvidence, window: int, number: int) -> dict[str, float]:
    """Return unknown -> its shift by a direction of the size that was found, in deviations."""
    size = evidence.size[window, number]
    return {name: float(moved[window, number] * size) for name, moved in at.moved.items()}


def _ranked(evidence: CauseEvidence) -> list[tuple[int, int]]:
    """Return window and number of the directions with evidence, the best first, each once.

    Windows of different length are compared by the share of the whole run's evidence.
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
    """Return whether equation and sensor can have a cause of the size that was found."""
    size = float(evidence.size[window, number])
    amount = _amount(direction, size, at)
    if direction.kind in (
        "loss",
        "transfer",
    ):  # one that is known is an unknown of the model, and has no cause
        return size > 0.0
    if direction.kind == "averaging":  # over a length that is positive
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
    """Return how large a cause is, as `Cause.size` has it."""
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
    if direction.kind == "averaging":  # what it does grows with the square of the length
        return math.sqrt(max(size, 0.0)) * direction.size
    if direction.kind in ("offset", "drift"):  # by the noise that was found, where that is so
        return size * OFFSET * float(at.noise[list(at.sensors).index(direction.subject)])
    return size * direction.size


def _setting(direction: ScoreDirection, size: float, at: Position) -> str:
    """Return the setting of a case that frees or corrects a cause of a size; empty if none does.

    The freed unknown has a prior standard deviation of twice the size.
    """
    keys = {"offset": "offset", "gain": "gain", "position": "at_std"}
    if direction.kind in keys:
        wide = 2.0 * abs(_amount(direction, size, at))
        return channel_setting(direction.subject, keys[direction.kind], f"{wide:.2g}")
    if direction.kind == "lag":
        by = f"{size * LAG * float(at.ledger.times[1]):.4g}"
        late = f'"{by} {at.time_unit}"' if at.time_unit else by
        return channel_setting(direction.subject, "late", late)
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
    """Return the setting of a case that lets an unknown jump."""
    return f"law.jumps={json.dumps([label.partition('[')[0]])}"


def _words(direction: ScoreDirection, size: float, at: Position) -> Sentence:
    """Return a cause of a size, and its remedy, in words."""
    name, kind, amount = direction.subject, direction.kind, _amount(direction, size, at)
    unit, positive, more = direction.unit, size > 0.0, dict[str, str]()
    if kind == "lag":
        unit = at.time_unit
    elif kind == "boundary":
        unit, positive = at.unit, amount > 0.0
        kind = "boundary, constant" if name == FIXED else kind
    elif kind == "drift":
        more["rate"] = f"{'+' if positive else '-'}{amount_of(abs(amount) / DRIFT, unit)}"
    elif kind == "position":
        more["where"] = _displaced(direction, amount)
    elif kind == "initial" and at.start_uncertain:
        kind = "initial, uncertain"
    found = clause(kind, name, amount, unit, positive=positive, **more)
    if kind in ESTIMATED:
        return found._replace(remedy=estimating(kind, name, width(amount, direction.unit)))
    return found


def _displaced(direction: ScoreDirection, amount: float) -> str:
    """Return on which side of its stated place a sensor may be, in words."""
    axis, end = "xyz"[direction.axis], direction.at + amount
    if direction.at * end >= 0.0:
        side = "closer to" if abs(end) < abs(direction.at) else "farther from"
        return f"{side} {axis} = 0 than configured"
    return f"displaced towards {'larger' if amount > 0.0 else 'smaller'} {axis}"


def _following(at: Position, window: int) -> Iterator[Finding]:
    """Return whether successive errors of a sensor are correlated though no cause explains it."""
    found = following(at.ledger, window)
    if found is None:
        return
    name = at.sensors[found.sensor]
    size = float(mean_squares(at.ledger)[window, found.sensor])
    if at.moving and size < 1.0:
        sentence = FINDINGS["following, large noise"]
        text, _ = sentence.filled(name=name, correlation=found.correlation)
        yield Finding("following", "note", text, name, found.p_value, "p-value")
        return
    text, _ = FINDINGS["following"].filled(name=name, correlation=found.correlation)
    yield Finding("following", "caution", text, name, found.p_value, "p-value")


def _records(at: Position, evidence: CauseEvidence) -> Iterator[Finding]:
    """Return whether the unknowns changed, and whether sensors disagree on them."""
    rho = float(evidence.correlation.max(initial=0.0))
    # Variance of a mean of AR(1) errors over that of independent ones.
    wider = (1.0 + rho) / (1.0 - rho)
    severity: Severity = "caution" if _mended(at, evidence) else "do not trust"
    change = constancy(at.ledger, wider)
    if change is not None and change.p_value < RECORD:
        name = at.unknowns[int(np.argmax(np.abs(change.change)))]
        text, _ = FINDINGS["constancy"].filled(name=name, after=percent(change.after))
        likely, remedy = LIKELY["jump"].filled(name=name)
        cause = Cause("jump", name, likely, remedy=remedy, setting=_jump(name))
        p = change.p_value
        yield Finding("constancy", severity, text, name, p, "p-value", (cause,))
    found = disagreement(at.ledger, wider)
    if found is not None and found[0] < RECORD:
        name = at.sensors[int(np.argmax(found[1]))]
        text, _ = FINDINGS["disagreement"].filled(name=name)
        cause = Cause("position", name, LIKELY["disagreement"].filled(name=name).text)
        yield Finding("disagreement", severity, text, name, found[0], "p-value", (cause,))


def _noise(at: Position) -> Iterator[Finding]:
    """Return notes on noise that is not as stated: intervals and tests do not depend on it."""
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
    # A steady process repeats readings rightly: a sensor is stuck if the model expects another
    # value.
    off = np.abs(ledger.value - ledger.last) / at.noise
    for i in np.flatnonzero((ledger.stuck >= STANDS - 1) & (off > FAR)):
        name, count = at.sensors[int(i)], int(ledger.stuck[i]) + 1
        if name in at.aside:  # its readings are not used
            continue
        text, _ = FINDINGS["stuck"].filled(name=name, count=count)
        setting = channel_setting(name, "role", '"ignored"')
        likely, remedy = LIKELY["stuck"].filled(name=name)
        cause = Cause("stuck", name, likely, remedy=remedy, setting=setting)
        yield Finding("stuck", "do not trust", text, name, float(count), "number", (cause,))


def _aside(at: Position) -> Iterator[Finding]:
    """Return which sensors are not used, because their readings contradict all else."""
    for name, (since, off) in at.aside.items():
        text, remedy = FINDINGS["aside"].filled(
            name=name,
            since=f"{since:g} {at.time_unit}".rstrip(),
            off=f"{off:+.3g} {at.unit.replace('degC', 'K')}".rstrip(),
        )
        setting = channel_setting(name, "role", '"ignored"')
        cause = Cause("sensor", name, LIKELY["aside"].filled(name=name).text, setting=setting)
        yield Finding("aside", "caution", text, name, abs(off), "number", (cause,), remedy)


def _disturbed(at: Position) -> Iterator[Finding]:
    """Return whether most readings contradict the model, or did so until a short while ago."""
    if not at.strain:
        return
    text, remedy = FINDINGS["changed"]
    # A few readings correct a state that is wrong after a pause: unknowns may stay well.
    severity: Severity = "do not trust" if at.apart or at.strain > BRIEF else "caution"
    yield Finding("changed", severity, text, evidence=float(at.strain), remedy=remedy)


def _refused(at: Position) -> Iterator[Finding]:
    """Return whether the gate refuses more readings than a mishap now and then."""
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
