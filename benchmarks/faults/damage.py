"""Comparison of the results of disturbed runs with an undisturbed run."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from livepde.records import Record
from livepde.runs import JOURNAL, Check, Journal


@dataclass(frozen=True, eq=False)
class Found:
    """Results of a run: records, number of accepted samples, checkpoint, events and counts."""

    records: Sequence[Record]
    samples: int
    state: bytes
    events: Counter[str]
    counts: Counter[str]

    @classmethod
    def of(cls, folder: Path) -> Found:
        with Journal.open(folder / JOURNAL) as journal:
            counts: Counter[str] = Counter()
            for (kind, _), number in journal.counts.items():
                counts[kind] += number
            events = Counter(event.kind for event in journal.events)
            records = list(journal)
            state = (folder / "checkpoint.bin").read_bytes()
            return cls(records, journal.accepted, state, events, counts)


@dataclass
class Damage:
    """Counts of lost, duplicated and different samples over disturbed runs."""

    runs: int = 0
    lost: int = 0
    doubled: int = 0
    different: int = 0

    def compare(self, found: Found, expected: Found) -> None:
        """Add the differences between a disturbed and an undisturbed run."""
        times = Counter(record.t for record in found.records)
        wanted = {record.t for record in expected.records}
        self.runs += 1
        self.lost += len(wanted - set(times)) + max(len(wanted) - found.samples, 0)
        self.doubled += sum(times.values()) - len(times) + max(found.samples - len(wanted), 0)
        pairs = [*zip(found.records, expected.records, strict=False)]
        # The last estimates differ if only one of the runs had time for the final fit.
        if found.events["unfinished"] != expected.events["unfinished"]:
            pairs.pop()
        self.different += sum(not same(record, other) for record, other in pairs)
        self.different += found.state != expected.state

    def checks(self, name: str) -> list[Check]:
        """Check that nothing is lost, duplicated or different."""
        return [
            Check(f"{name}: samples lost", self.lost, 0, "<="),
            Check(f"{name}: samples doubled", self.doubled, 0, "<="),
            Check(f"{name}: estimates and states that differ in a bit", self.different, 0, "<="),
        ]


def same(one: Record, other: Record) -> bool:
    """Return whether two records agree in every bit."""
    names = ("numbers", "innovation", "validation_error")
    if any(getattr(one, name).tobytes() != getattr(other, name).tobytes() for name in names):
        return False
    if (one.t, one.status, one.steps) != (other.t, other.status, other.steps):
        return False
    if json.dumps(dict(one.notes)) != json.dumps(dict(other.notes)):  # as text, NaN equals NaN
        return False
    left, right = one.snapshot, other.snapshot
    if left is None or right is None:
        return left is right
    return left.determined == right.determined and all(
        values.tobytes() == right.profiles[name].tobytes() for name, values in left.profiles.items()
    )
