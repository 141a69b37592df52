"""Runs: the run loop, outcomes, journals and run directories."""

from livepde.diagnostics.check_report import Check, Table
from livepde.runs.backlog import Backlog, Retention, Sink
from livepde.runs.directory import (
    JOURNAL,
    RECORD,
    Outcome,
    Run,
    RunWriter,
    free_path,
    refuse_taken,
    run_names,
)
from livepde.runs.directory import open_run as open
from livepde.runs.drive import Driven, conduct, drive, journal_of, stopped_by_signals
from livepde.runs.journal import Journal
from livepde.runs.live_loop import Live
from livepde.runs.run_verdict import (
    clock_findings,
    doubts,
    input_findings,
    sampling_findings,
    severities,
    unexplained,
    verdict,
    verdict_table,
)
from livepde.runs.summary import Jump, arrivals, checks_of, jumps, measures, tables

__all__ = [
    "JOURNAL",
    "RECORD",
    "Backlog",
    "Check",
    "Driven",
    "Journal",
    "Jump",
    "Live",
    "Outcome",
    "Retention",
    "Run",
    "RunWriter",
    "Sink",
    "Table",
    "arrivals",
    "checks_of",
    "clock_findings",
    "conduct",
    "doubts",
    "drive",
    "free_path",
    "input_findings",
    "journal_of",
    "jumps",
    "measures",
    "open",
    "refuse_taken",
    "run_names",
    "sampling_findings",
    "severities",
    "stopped_by_signals",
    "tables",
    "unexplained",
    "verdict",
    "verdict_table",
]
