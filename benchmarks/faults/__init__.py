"""Fault injection for live runs: kills, outages, failing disks, wrong clocks, malformed input.

Kills: `livepde run --resume` reads a few thousand rows from a growing file, standard input or a
broker. It is repeatedly killed with SIGKILL, and must end with the same bits as an undisturbed run.
The moments are random: at start and resume, during steps, while the journal grows, and at the end.

Disks that are full or fail for a while: the result must also equal the undisturbed run.

Damaged journals, wrong clocks, slow clients and excessive cases: each is reported, and no run ends
or stops responding.

Malformed rows: real and generated rows are mutated in many ways and sent between valid rows. Each
is counted with a reason, and every valid row arrives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from benchmarks.faults.broken import broken_messages, broken_rows
from benchmarks.faults.clocks import clock_faults
from benchmarks.faults.disk import failing_disks
from benchmarks.faults.files import file_faults
from benchmarks.faults.flips import damaged_journals
from benchmarks.faults.hostile import hostile_cases
from benchmarks.faults.kills import KILLED
from benchmarks.faults.outages import outages
from benchmarks.faults.plan import Plan
from benchmarks.faults.progress import frequent_kills, prompt_stops
from benchmarks.faults.visitors import slow_visitors
from livepde.runs import Check, Outcome, Table

__all__ = ["PARTS", "faults"]

KILLS, SAMPLES, MALFORMED, FLIPS = 600, 2000, 100_000, 200

PARTS: Mapping[str, Callable[[Plan], Outcome]] = {
    **KILLED,
    "progress": frequent_kills,
    "sigterm": prompt_stops,
    "restart": outages,
    "disk": failing_disks,
    "malformed": broken_rows,
    "messages": broken_messages,
    "journals": damaged_journals,
    "files": file_faults,
    "clocks": clock_faults,
    "visitors": slow_visitors,
    "cases": hostile_cases,
}


def faults(
    kills: int = KILLS,
    samples: int = SAMPLES,
    malformed: int = MALFORMED,
    flips: int = FLIPS,
    seed: int = 0,
    only: Sequence[str] = (),
    workers: int = 1,
    progress: bool = False,
) -> Outcome:
    """Inject faults into runs, and count lost, duplicated and different samples.

    Parameters
    ----------
    kills, samples
        Total number of kills, shared by the parts that kill, and samples per run.
    malformed
        Number of malformed rows and messages.
    flips
        Number of damaged journals.
    only
        Names in `PARTS` to run; default all.
    workers
        Number of runs that are killed in parallel.
    """
    tables: list[Table] = []
    checks: list[Check] = []
    notes: list[str] = []
    share = math.ceil(kills / max(len(KILLED.keys() & set(only or PARTS)), 1))
    for name in only or PARTS:
        outcome = PARTS[name](Plan(share, samples, malformed, flips, seed, progress, workers))
        tables += outcome.tables
        checks += outcome.checks
        notes += outcome.notes
    return Outcome(tables=tables, checks=checks, notes=notes)
