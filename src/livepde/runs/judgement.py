"""The verdict of a run: findings of its law and of its dataset."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from livepde.runs.outcome import Table
from livepde.runs.run_findings import findings_of
from livepde.runs.summary import shown
from livepde.verdict import MOST, Severity, Verdict

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["doubts", "severities", "unexplained", "verdict", "verdict_table"]


def verdict(data: xr.Dataset) -> Verdict:
    """Return the verdict of a run: of its law (`Estimate.verdict`), and findings of its dataset.

    The law's verdict is read from the attribute `verdict` of the dataset.
    """
    stored = data.attrs.get("verdict")
    own = Verdict.from_dict(json.loads(stored)) if stored else Verdict.unjudged()
    if not data.sizes["time"]:
        return own
    judged = not any(text.startswith(("innovations", "everything")) for text in own.untested)
    return own.with_findings(findings_of(data, judged=judged))


def verdict_table(found: Verdict) -> Table:
    """Return a verdict as a table: its level, and a row for each finding."""
    rows = [
        (
            finding.severity,
            finding.what,
            finding.subject or "–",
            shown(finding.evidence, ".2g"),
            finding.measure,
            "; ".join(cause.text for cause in finding.causes[:2]) or "–",
        )
        for finding in found.findings[:MOST]
    ]
    columns = ("severity", "finding", "of", "evidence", "measure", "likely causes")
    return Table(f"Verdict: {found.level}", columns, rows)


def doubts(data: xr.Dataset) -> list[str]:
    """Return all findings that speak against trusting the estimates, as sentences, each once."""
    return list(dict.fromkeys(finding.sentence for finding in verdict(data).findings))


def severities(data: xr.Dataset) -> dict[str, Severity]:
    """Return the severity of each sentence of `doubts`."""
    return {finding.sentence: finding.severity for finding in verdict(data).findings}


def unexplained(data: xr.Dataset) -> bool:
    """Return whether a run says that its model does not explain the data."""
    return any(finding.what == "misfit" for finding in verdict(data).findings)
