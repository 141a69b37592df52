"""How the steps of a run ended: samples that failed or departed, and the findings on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from livepde.laws.law import Status
from livepde.linalg import IntArray
from livepde.records import STATUS_CODES
from livepde.stepping import MOST_SUBSTEPS
from livepde.verdict import Finding, Severity
from livepde.verdict.sentences import FINDINGS

COUNTS = len(STATUS_CODES) + 1  # of a `StepLedger`

SOME = 0.02  # share of the samples from which failed steps are more than a mishap
MOST = 0.5  # share from which little is left of the data
PLACES = {code: place for place, code in enumerate(STATUS_CODES)}
FAILURES = ("departed", "not_converged", "not_finite", "singular")  # codes with a finding each


class StepLedger(NamedTuple):
    """Numbers of samples by the status of their step, in the order of `STATUS_CODES`.

    The last number counts the intervals whose substeps were longer than `dt_max`.
    """

    counts: IntArray

    @classmethod
    def start(cls) -> StepLedger:
        """Return the value before any sample."""
        return cls(np.zeros(COUNTS, dtype=np.int64))

    def add(self, code: str, stretched: bool) -> StepLedger:
        """Return the value after a sample whose step ended with a status."""
        counts = self.counts.copy()
        counts[PLACES[code]] += 1
        counts[-1] += stretched
        return StepLedger(counts)

    @property
    def irregular(self) -> bool:
        """Whether any step was not ok, or had substeps longer than `dt_max`."""
        counts = self.counts.tolist()
        return bool(sum(counts) > counts[PLACES["ok"]])

    def findings(self) -> Iterator[Finding]:
        """Return a finding for each way in which steps have failed, and one on long intervals."""
        *counts, stretched = self.counts.tolist()
        yield from step_findings(dict(zip(STATUS_CODES, counts, strict=True)))
        if stretched:
            text, remedy = FINDINGS["steps, long"].filled(count=stretched, most=MOST_SUBSTEPS)
            yield Finding("steps", "note", text, "dt_max", float(stretched), remedy=remedy)


def step_findings(counts: Mapping[str, int]) -> Iterator[Finding]:
    """Return a finding for each way in which steps have failed.

    `counts`: code of a status -> number of samples.
    """
    samples = sum(counts.values())
    for code in FAILURES:
        count = counts.get(code, 0)
        if not count:
            continue
        text, _ = FINDINGS[code].filled(count=count, samples=samples)
        severity = _severity(code, count / samples)
        remedy = Status(code).remedy
        yield Finding("steps", severity, text, code, float(count), remedy=remedy)


def _severity(code: str, share: float) -> Severity:
    """Return how grave it is that a share of the samples has ended so."""
    # A right model departs in one of a million cases: there is no mishap of that sort.
    if share > (SOME if code == "departed" else MOST):
        return "do not trust"
    return "caution" if code == "departed" or share > SOME else "note"
