"""Data sources that are temporarily unavailable."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.faults.damage import Damage, Found
from benchmarks.faults.plan import Plan
from benchmarks.faults.plants import GrowingFile, wait
from benchmarks.faults.rod import Row, rod_rows
from benchmarks.faults.run import Run, hearing, undisturbed
from livepde.runs import Check, Outcome, Table

RESTARTS = 2  # number of broker restarts


def outages(plan: Plan) -> Outcome:
    """Restart a broker, send nothing for a while, and move a followed file away and back."""
    rows = rod_rows(min(plan.samples, 600))
    expected, _ = undisturbed(len(rows))
    runs, damage = [_broker_away(rows), _file_away(rows, plan.seed)], Damage()
    for found in runs:
        damage.compare(found, expected)
    noticed = sum(min(found.events["silent"], found.events["heard"]) for found in runs)
    table = Table(
        f"Sources that go away: {len(rows)} samples",
        ("broker restarts", "outages noticed", "lost", "doubled", "different"),
        [(RESTARTS, noticed, damage.lost, damage.doubled, damage.different)],
    )
    check = Check("outages: noticed, and their end", noticed, len(runs), ">=")
    return Outcome(tables=[table], checks=[check, *damage.checks("outages")])


def _broker_away(rows: Sequence[Row]) -> Found:
    with hearing(rows, saved=True) as (broker, topic, run):
        for part in np.linspace(0, len(rows) // 3, RESTARTS + 1, dtype=int).tolist()[1:]:
            topic.supply(part)
            run.wait_for(part // 2)  # the other rows are still in transit
            broker.stop()
            wait(lambda: not topic.connected(), "a broker that was stopped answers")
            broker.start()
        topic.supply(2 * len(rows) // 3)
        run.wait_for_event("silent", 1)  # nothing is sent
        topic.supply(len(rows))
        run.end(len(rows))
        return Found.of(run.out)


def _file_away(rows: Sequence[Row], seed: int) -> Found:
    third = len(rows) // 3
    with TemporaryDirectory() as name:
        file = GrowingFile(Path(name), rows, seed)
        with closing(Run(Path(name), file.source)) as run:
            file.supply(third)
            run.start()
            run.wait_for(third // 2)
            away = file.path.rename(file.path.with_name("away"))
            run.wait_for_event("silent", 1)
            away.rename(file.path)
            file.supply(len(rows))
            run.end(len(rows))
            return Found.of(run.out)
