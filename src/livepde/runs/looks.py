"""The reported verdict of a run, whose level changes if two consecutive looks agree."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.verdict import LEVELS, NOT_JUDGED, ModelErrors, Verdict

JUDGED = 50  # samples between two looks at the verdict
SELDOM = 128  # looks between two that compute model errors, in addition to looks at doublings
# Keys of a stored verdict: reported level, samples at the last look, a different level that only
# the last look has found, and the model errors of the last computation.
TOLD, LOOKED, NEXT, ERRORS = "told", "looked", "next", "computed_errors"


@dataclass(frozen=True)
class Looks:
    """The reported verdict, and the last look at the verdict of the law."""

    verdict: Verdict
    level: str = NOT_JUDGED  # reported level
    samples: int = 0  # number of samples at the last look
    other: str = ""  # a different level that only the last look has found
    errors: ModelErrors | None = None  # model errors of the last computation

    @classmethod
    def stored(cls, text: str) -> Looks:
        """Return the looks that `to_dict` stored as JSON, or initial looks for an empty text."""
        found = json.loads(text) if text else Verdict.unjudged().to_dict()
        return cls(
            Verdict.from_dict(found),
            found.get(TOLD, NOT_JUDGED),
            found.get(LOOKED, 0),
            found.get(NEXT, ""),
            ModelErrors.from_dict(found.get(ERRORS)),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the looks as a JSON object."""
        errors = None if self.errors is None else self.errors.to_dict()
        look = {TOLD: self.level, LOOKED: self.samples, NEXT: self.other, ERRORS: errors}
        return {**self.verdict.to_dict(), **look}

    def after(
        self, identifier: Identifier, estimate: Estimate, samples: int, *, live: bool
    ) -> Looks | None:
        """Return the looks after an estimate; None if its samples have been judged already.

        The reported level changes if two consecutive looks are both worse or both better than it,
        even if they alternate between two levels, which must not preserve a better one. The first
        level other than "not judged" is reported at once.
        """
        if samples <= self.samples:
            return None
        errors = self.errors
        # A batch run computes model errors at its end.
        if live and is_due(samples // JUDGED):
            errors = identifier._settled(estimate, columns=False).verdict.errors or errors
        verdict = estimate.verdict
        if live and errors is not None:
            verdict = verdict.with_errors(errors.about(_ends(estimate)))
        before, now = self.level, verdict.level
        known = before in (NOT_JUDGED, now) or (
            self.other != "" and _worse(self.other, before) == _worse(now, before)
        )
        looked = replace(self, samples=samples, errors=errors)
        if not known:
            return replace(looked, other=now)
        return replace(looked, verdict=verdict, level=now, other="")


def is_due(look: int) -> bool:
    """Return whether the number of a look is a power of two or a multiple of `SELDOM`.

    A live run computes model errors at these looks, and a batch run has no others. In between,
    intervals keep the widening by model errors that was computed last.
    """
    return look > 1 and (look & (look - 1) == 0 or look % SELDOM == 0)


def _worse(level: str, than: str) -> bool:
    return LEVELS.index(level) > LEVELS.index(than)


def _ends(estimate: Estimate) -> dict[str, tuple[float, float, float]]:
    """Return the median and the ends of the plain interval of each unknown, by label."""
    found = {}
    for label in estimate.space.labels:
        unknown = estimate[label]
        low, high = unknown.interval()
        found[label] = float(unknown.median), float(low), float(high)
    return found
