"""Recommendation of a variant of a case, and sentences that explain it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

from livepde.cases.variants import GAINED, VariantRun

WORSE = 0.02  # tolerated relative growth of validation errors: about their own uncertainty
USABLE = ("trusted", "caution")


def recommended(base: VariantRun, others: Sequence[VariantRun]) -> VariantRun:
    """Return the variant with the best evidence that predicts the validation sensors no worse.

    Usable variants are preferred, and the fewest unknowns among variants of similar evidence. The
    case itself is recommended if no variant has strong evidence against it, or if it is usable and
    none of those variants is. Variants of similar evidence with disjoint intervals are its rivals:
    the data cannot decide between them, for example which of two sensors has a gain error. If
    unusable variants explain the data better, the recommended variant is incomplete and not
    trusted.
    """
    ahead = _ahead(base, others)
    if not ahead:
        return base
    candidates = _usable(ahead) or _usable([base]) or ahead
    best = candidates[0].gained(base)
    near = [one for one in candidates if one.gained(base) > best - GAINED]
    chosen = min(near, key=lambda one: (one.unknowns, -one.gained(base)))
    if rivals := [one for one in near if one.apart(chosen)]:
        chosen = chosen.beside(rivals)
    better = tuple(one.variant.name for one in ahead if one.gained(base) > best + GAINED)
    return replace(chosen, better=better) if better else chosen


def _usable(runs: Iterable[VariantRun]) -> list[VariantRun]:
    return [one for one in runs if one.level in USABLE]


def _ahead(base: VariantRun, others: Sequence[VariantRun]) -> list[VariantRun]:
    """Return variants with strong evidence and no worse predictions, by decreasing evidence."""
    strong = (one for one in others if one.gained(base) > GAINED)
    valid = (one for one in strong if not (_worse_sensors(one, base) or one.failed > base.failed))
    return sorted(valid, key=lambda one: one.gained(base), reverse=True)


def _worse_sensors(one: VariantRun, base: VariantRun) -> list[str]:
    """Return the errors of validation sensors predicted worse than by `base`, or not at all."""
    return [
        f"{name} {own:.3g} instead of {error:.3g}"
        for name, error in base.validation.items()
        if math.isfinite(error)
        and not (own := one.validation.get(name, math.nan)) <= error * (1.0 + WORSE)
    ]


def conclusions(base: VariantRun, others: Sequence[VariantRun]) -> list[str]:
    """Return sentences on the recommendation, and on disagreements between variants."""
    best = recommended(base, others)
    known = [one for one in others if not one.error]
    remarks = chain(_mispredicting(base, known), _remarks(base, best, known))
    text = _recommendation(base, best)
    if math.isnan(base.log_evidence):
        text = (
            "Variants are not ranked: this case has no log evidence (its law has no covariance). "
            "The case is kept unchanged."
        )
        remarks = chain()
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
    if best.level == "do not trust":
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
    """Iterate over the sentence, if any, on unusable variants that explain the data better."""
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
    """Iterate over sentences on variants that are contradicted or cannot be compared."""
    if refuted := _names_of(one for one in others if one.gained(base) < -GAINED):
        yield f"The data contradict {refuted}: lower evidence than the case."
    apart = [one for one in others if math.isnan(one.gained(base))]
    if names := _names_of(apart):
        yield f"The evidence of {names} is missing or counts other readings: it is not compared."
    for one in () if _usable([best]) else _usable(apart):
        yield f"'{one.variant.name}' has the verdict '{one.level}' with its readings."


def _mispredicting(base: VariantRun, others: Sequence[VariantRun]) -> Iterator[str]:
    """Iterate over sentences on variants with better evidence and worse predictions."""
    for one in others:
        if one.gained(base) > GAINED and (worse := _worse_sensors(one, base)):
            yield (
                f"'{one.variant.name}' fits the assimilated sensors better and predicts validation "
                f"ones worse ({', '.join(worse)}): it is not recommended."
            )


def _names_of(runs: Iterable[VariantRun]) -> str:
    """Return the names of variants in quotes, separated by commas."""
    return ", ".join(f"'{one.variant.name}'" for one in runs)


def _disagreements(best: VariantRun, others: Sequence[VariantRun]) -> Iterator[str]:
    """Iterate over sentences on unknowns whose intervals in variants do not overlap."""
    found: dict[str, list[str]] = {}
    others = [one for one in others if one.variant != best.variant]
    shared = any(best.estimates.keys() & one.estimates.keys() for one in others)
    for one in others:
        for name in one.apart(best):
            found.setdefault(name, []).append(one.variant.name)
    for name, names in found.items():
        listed = ", ".join(f"'{one}'" for one in names)
        yield (
            f"{name} depends on the variant: its interval in {listed} does not overlap with the "
            "interval in the recommended one."
        )
    if shared and not found and best.level in USABLE:
        yield "All variants agree: their intervals overlap with that of the recommended one."
