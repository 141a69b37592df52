"""The verdict that a run reports: it changes its level once two looks agree."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.verdict import LEVELS, NOT_JUDGED, ModelErrors, Verdict

JUDGED = 50  # samples between two looks at the verdict
SELDOM = 128  # looks of which one computes errors of the model, beside those at doublings
# Keys of a stored verdict: the level that was reported last, the samples at the last look, another
# level that this look was the first to find, and the errors of the model as they were computed.
TOLD, LOOKED, NEXT, ERRORS = "told", "looked", "next", "computed_errors"


@dataclass(frozen=True)
class Looks:
    """The verdict that is reported, and the last look at that of the law."""

    verdict: Verdict
    level: str = NOT_JUDGED  # that was reported last
    samples: int = 0  # at the last look
    other: str = ""  # level that this look was the first to find
    errors: ModelErrors | None = None  # as they were computed last

    @classmethod
    def stored(cls, text: str) -> Looks:
        """Return the value that `to_dict` has stored as JSON; that before any if it is empty."""
        found = json.loads(text) if text else Verdict.unjudged().to_dict()
        return cls(
            Verdict.from_dict(found),
            found.get(TOLD, NOT_JUDGED),
            found.get(LOOKED, 0),
            found.get(NEXT, ""),
            ModelErrors.from_dict(found.get(ERRORS)),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the value as JSON can hold it."""
        errors = None if self.errors is None else self.errors.to_dict()
        look = {TOLD: self.level, LOOKED: self.samples, NEXT: self.other, ERRORS: errors}
        return {**self.verdict.to_dict(), **look}

    def after(
        self, identifier: Identifier, estimate: Estimate, samples: int, *, live: bool
    ) -> Looks | None:
        """Return the value after a look at an estimate; None if these samples were looked at.

        Another level counts once two looks in a row differ in one way: both are worse than the
        reported level, or both are better. Findings that alternate between two levels must not keep
        a better one. The first one that is judged counts at once.
        """
        if samples <= self.samples:
            return None
        errors = self.errors
        # The end of a run of finished data is near, and has the errors of the model.
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
    """Return whether a look is at a doubling, or one of `SELDOM`.

    Such a look computes errors of the model in a live run, and is the only kind in a batch run. In
    between an interval is as much wider than the plain one as it was then.
    """
    return look > 1 and (look & (look - 1) == 0 or look % SELDOM == 0)


def _worse(level: str, than: str) -> bool:
    return LEVELS.index(level) > LEVELS.index(than)


def _ends(estimate: Estimate) -> dict[str, tuple[float, float, float]]:
    """Return label -> value, and ends of the plain interval."""
    found = {}
    for label in estimate.space.labels:
        unknown = estimate[label]
        low, high = unknown.interval()
        found[label] = float(unknown.median), float(low), float(high)
    return found
