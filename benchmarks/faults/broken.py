"""Malformed rows and messages between valid ones."""

from __future__ import annotations

import csv
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.cases import find_cases
from benchmarks.faults.breaks import BYTES, CSV, JSON, broken_line, csv_line, json_line
from benchmarks.faults.damage import Damage, Found, same
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import PATIENCE
from benchmarks.faults.rod import Row, case_text, rod_rows
from benchmarks.faults.run import hearing, undisturbed
from livepde.cases import Case, load
from livepde.cases.data import data_file, policy_of, source_of
from livepde.errors import LivepdeError
from livepde.records import Record
from livepde.runs import Check, Outcome, Table
from livepde.runs.feeds import Gathered
from livepde.runs.live_loop import Live
from livepde.samples import Sample
from livepde.streams.intake import Intake, IntakeOutcome, Ready
from livepde.streams.sources import RowSource

TOGETHER = 100  # messages sent before waiting for their acknowledgements


def broken_rows(plan: Plan) -> Outcome:
    """Feed malformed rows between valid ones to a live run, and check that each is counted."""
    rng = np.random.default_rng(plan.seed)
    tables, checks = [], []
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "case.toml").write_text(case_text())
        rod = load(folder / "case.toml")
        rows = rod_rows(min(plan.samples, 1000))
        feeds = {
            "generated, JSON": (rod, rows, "rows.jsonl"),
            "generated, CSV": (rod, rows, "rows.csv"),
        }
        soil = _soil()
        if soil is not None:
            feeds["soil, CSV"] = (soil[0], soil[1], "soil.csv")
            feeds["soil, JSON"] = (soil[0], soil[1], "soil.jsonl")
        sent, each = 0, math.ceil(plan.malformed / len(feeds))
        items = [*feeds.items()]
        for k in plan.watched(len(items), f"files of {each} broken rows"):
            title, (case, chosen, file) = items[k]
            outcome = fed(case, chosen, folder / file, each, rng)
            (folder / file).unlink()
            tables.append(outcome.table(title))
            checks += outcome.checks(title)
            sent += outcome.sent.total()
    return Outcome(
        tables=tables, checks=[Check("broken rows", sent, plan.malformed, ">="), *checks]
    )


def broken_messages(plan: Plan) -> Outcome:
    """Send malformed messages between valid ones from a broker to `livepde run`."""
    rng = np.random.default_rng(plan.seed)
    rows, count = rod_rows(min(plan.samples, 600)), max(plan.malformed // 20, 1)
    expected, _ = undisturbed(len(rows))
    with hearing(rows) as (_, topic, run):
        per_row = np.bincount(rng.integers(0, len(rows), count), minlength=len(rows))
        begun = time.monotonic()
        for k in plan.watched(len(rows), "right rows with broken messages between them"):
            topic.supply(k + 1)
            for part in _parts(int(per_row[k]), TOGETHER):
                lines = [broken_line(JSON | BYTES, rows[k], json_line, rng)[1] for _ in part]
                for message in [topic.send(line) for line in lines]:
                    message.wait_for_publish(PATIENCE)
        run.end(len(rows))
        rate = (count + len(rows)) / (time.monotonic() - begun)
        found = Found.of(run.out)
    damage = Damage()
    damage.compare(found, expected)
    reasons = ", ".join(f"{kind} {number}" for kind, number in sorted(found.counts.items()))
    table = Table(
        f"Broken messages between {len(rows)} right ones, from a broker to livepde run",
        ("sent", "reasons", "lost", "doubled", "different", "a second"),
        [(count, reasons, damage.lost, damage.doubled, damage.different, rate)],
    )
    counted = Check("broken messages: counted", found.counts.total(), count, ">=")
    return Outcome(tables=[table], checks=[counted, *damage.checks("broken messages")])


def _parts(count: int, most: int) -> Iterator[range]:
    """Split range(count) into ranges of at most `most` numbers."""
    return (range(k, min(k + most, count)) for k in range(0, count, most))


def _soil() -> tuple[Case, list[dict[str, Any]]] | None:
    """Return the soil case and its measured rows, or None if they are not available."""
    try:
        path = next(path for path in find_cases() if path.stem == "soil_uniform")
        case = load(path, settings={"intake.leap": "10 d"})
        with data_file(case).open(newline="", encoding="utf-8") as file:
            rows = [dict(row) for row in csv.DictReader(file)]
        return case, [row for row in rows if row[case.clock.name] >= str(case.clock.start)]
    except (StopIteration, LivepdeError, OSError):
        return None


class _Audited(Gathered):
    """Feed that records the remarks on each row, by the offset of its line in the file."""

    def __init__(self, source: RowSource, intake: Intake) -> None:
        super().__init__(source, intake)
        self.reasons: dict[int, set[str]] = {}

    def _used(self, outcome: IntakeOutcome) -> list[Ready]:
        for remark in outcome.remarks:
            _, (_, place) = remark.row
            self.reasons.setdefault(place, set()).add(remark.kind)
        return super()._used(outcome)


@dataclass(frozen=True)
class Fed:
    """Outcome of a live run on a file with malformed rows between valid ones."""

    sent: Counter[str]
    reasons: Counter[str]
    silent: int
    right: int
    arrived: int
    different: int
    rate: float  # valid and malformed rows per second, including the steps

    def table(self, title: str) -> Table:
        """Return a table of the rows sent, counted and used, by kind."""
        rows: list[tuple[str, str, float]] = []
        rows += [("sent", kind, number) for kind, number in sorted(self.sent.items())]
        rows += [("counted", kind, number) for kind, number in sorted(self.reasons.items())]
        rows += [("right rows", "sent", self.right), ("right rows", "arrived", self.arrived)]
        rows.append(("rows a second", "", self.rate))
        return Table(f"Broken rows, {title}", ("", "kind", "number"), rows)

    def checks(self, title: str) -> list[Check]:
        """Check that malformed rows have a reason, and that exactly the valid rows arrive."""
        return [
            Check(f"{title}: broken rows without a reason", self.silent, 0, "<="),
            Check(f"{title}: right rows that are missing", self.right - self.arrived, 0, "<="),
            Check(f"{title}: estimates that differ in a bit", self.different, 0, "<="),
        ]


def fed(case: Case, rows: Sequence[Row], path: Path, count: int, rng: np.random.Generator) -> Fed:
    """Run valid rows with `count` malformed rows between them, and compare with a clean run."""
    write = json_line if path.suffix == ".jsonl" else csv_line
    head = b"" if path.suffix == ".jsonl" else ",".join(rows[0]).encode() + b"\n"
    clean = path.with_stem("clean")
    clean.write_bytes(head + b"".join(write(row) + b"\n" for row in rows))
    expected, _ = _taken(case, clean)
    breaks = (JSON if path.suffix == ".jsonl" else CSV) | BYTES
    sent, broken = Counter[str](), set[int]()
    per_row = np.bincount(rng.integers(0, len(rows), count), minlength=len(rows))
    with path.open("wb") as file:
        file.write(head)
        for row, times in zip(rows, per_row.tolist(), strict=True):
            file.write(write(row) + b"\n")
            for _ in range(times):
                kind, line = broken_line(breaks, row, write, rng)
                sent[kind] += 1
                broken.add(file.tell())
                file.write(line + b"\n")
    begun = time.monotonic()
    found, reasons = _taken(case, path)
    rate = (count + len(rows)) / (time.monotonic() - begun)
    counted = Counter(kind for place in broken for kind in sorted(reasons.get(place, ()))[:1])
    return Fed(
        sent,
        counted,
        sum(not reasons.get(place) for place in broken),
        len(expected),
        len(found),
        sum(not same(one, other) for one, other in zip(found, expected, strict=False)),
        rate,
    )


def _taken(case: Case, path: Path) -> tuple[list[Record], dict[int, set[str]]]:
    """Run a file as a live run; return its records, and its remarks by offset of the line."""
    spec = case.spec.data
    intake = Intake(case.columns, case.clock, policy_of(case), missing=spec.missing)
    feed = _Audited(source_of(case, str(path), ""), intake)
    begun: list[Ready] = []
    while not begun:
        begun += feed.poll(0.0)
    prepared = case.begin(Sample(t=begun[0].t, z=begun[0].values), intake.start)
    with prepared.journal() as journal:
        Live(prepared.identifier, feed, journal, fields_every=100, begun=begun).run()
        return list(journal), feed.reasons
