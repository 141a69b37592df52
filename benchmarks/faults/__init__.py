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

from collections.abc import Callable, Mapping, Sequence

from benchmarks.faults.broken import broken_messages, broken_rows
from benchmarks.faults.clocks import clock_faults
from benchmarks.faults.disk import failing_disks
from benchmarks.faults.flips import damaged_journals
from benchmarks.faults.hostile import hostile_cases
from benchmarks.faults.kills import kills_of_files, kills_of_pipes, kills_of_topics
from benchmarks.faults.outages import outages
from benchmarks.faults.plan import Plan
from benchmarks.faults.visitors import slow_visitors
from livepde.runs import Check, Outcome, Table

__all__ = ["PARTS", "faults"]

KILLS, SAMPLES, MALFORMED, FLIPS = 200, 2000, 100_000, 200

PARTS: Mapping[str, Callable[[Plan], Outcome]] = {
    "file": kills_of_files,
    "stdin": kills_of_pipes,
    "mqtt": kills_of_topics,
    "restart": outages,
    "disk": failing_disks,
    "malformed": broken_rows,
    "messages": broken_messages,
    "journals": damaged_journals,
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
    progress: bool = False,
) -> Outcome:
    """Do harm to runs, and count what was lost.

    Parameters
    ----------
    kills, samples
        Kills of runs with so many samples, for a file, for standard input and for a broker.
    malformed
        Rows and messages that are broken.
    flips
        Journals that are damaged.
    only
        Some of `PARTS`.
    """
    tables: list[Table] = []
    checks: list[Check] = []
    notes: list[str] = []
    for name in only or PARTS:
        outcome = PARTS[name](Plan(kills, samples, malformed, flips, seed, progress))
        tables += outcome.tables
        checks += outcome.checks
        notes += outcome.notes
    return Outcome(tables=tables, checks=checks, notes=notes)
