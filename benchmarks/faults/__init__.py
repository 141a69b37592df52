"""What a run survives: kills at any moment, brokers and sources that go away, rows that are broken.

Kills: `livepde run --resume` takes a few thousand rows from a file that grows, from standard input
or from a broker, is killed with SIGKILL again and again, and ends as a run does that nobody
disturbed: bit by bit. The moments are drawn at random: while it starts and resumes, while it steps,
right when its journal grows, and while it ends.

Disks that are full or fail, and work again: the same holds.

Journals that are damaged, clocks that are wrong, visitors that ask slowly, cases that ask for too
much: each is told, and no run ends or goes silent.

Broken rows: real and generated rows, mutated in every way that we could think of, between rows that
are right. Each is counted with a reason, and what is right arrives.
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
    """Do harm to runs, and count what was lost.

    Parameters
    ----------
    kills, samples
        Kills in all, spread over those parts that kill, of runs with so many samples.
    malformed
        Rows and messages that are broken.
    flips
        Journals that are damaged.
    only
        Some of `PARTS`.
    workers
        Runs that are killed at a time.
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
