"""Clocks that leap, are set back or show an hour twice, in live runs of the rod."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.faults.plan import Plan
from benchmarks.faults.rod import Row, case_text, rod_rows
from livepde.cases import load
from livepde.cases.live_case import LiveCase
from livepde.runs import Check, Outcome, Table
from livepde.streams.sources import Rows

__all__ = ["CLOCKS", "clock_faults"]

LOST = 5  # right rows that a fault may cost


def _moved(rows: Sequence[Row], by: timedelta) -> list[dict[str, Any]]:
    return [{**row, "time": str(datetime.fromisoformat(row["time"]) + by)} for row in rows]


def _with(rows: Sequence[Row], wrong: Sequence[Row], at: int) -> list[Row]:
    return [*rows[:at], *wrong, *rows[at:]]


DAY, HOUR = timedelta(days=1), timedelta(hours=1)

# Name -> how the right rows become those that come.
CLOCKS: Mapping[str, Any] = {
    "none": lambda rows: list(rows),
    "one row 29 days ahead": lambda rows: _with(rows, _moved(rows[200:201], 29 * DAY), 200),
    "one row 10 years ahead": lambda rows: _with(rows, _moved(rows[200:201], 3650 * DAY), 200),
    "two rows 10 years ahead": lambda rows: _with(rows, _moved(rows[200:202], 3650 * DAY), 200),
    "five rows 3 hours ahead": lambda rows: _with(rows, _moved(rows[200:205], 3 * HOUR), 200),
    "set back by an hour": lambda rows: [*rows[:200], *_moved(rows[200:], -HOUR)],
    "set back by a day": lambda rows: [*rows[:200], *_moved(rows[200:], -DAY)],
    "set ahead by an hour": lambda rows: [*rows[:200], *_moved(rows[200:], HOUR)],
    "an hour ahead for 100 rows": lambda rows: [
        *rows[:200], *_moved(rows[200:300], HOUR), *rows[300:],
    ],
    "one row of 1970": lambda rows: _with(rows, [{**rows[0], "time": "1970-01-01"}], 200),
}  # fmt: skip


def clock_faults(plan: Plan) -> Outcome:
    """Let the clocks of the rod go wrong, and count the right rows that are lost."""
    rows = rod_rows(500)
    found, most, silent, ill = [], 0, [], []
    with TemporaryDirectory() as name:
        path = Path(name) / "case.toml"
        path.write_text(case_text().replace('leap = "1 d"', 'leap = "30 d"'))
        for fault, change in CLOCKS.items():
            with LiveCase(load(path), Rows(change(rows))) as wiring:
                live = wiring.live()
                if live is None:
                    raise RuntimeError("the run did not begin")
                live.run()
                taken, counts = len(live.journal), live.journal.counts
                # What a clock that is wrong did to the data may well make the estimates doubtful.
                well = live.health["ok"] or live.health["why"].startswith("the verdict")
            lost = max(len(rows) - taken, 0)
            most = max(most, lost)
            if fault != "none" and not counts and "ahead by" not in fault:
                silent.append(fault)
            if not well:
                ill.append(fault)
            told = ", ".join(f"{kind} {number}" for (kind, _), number in sorted(counts.items()))
            found.append((fault, taken, lost, told or "–"))
    return Outcome(
        tables=[Table(f"Clocks of {len(rows)} rows", ("fault", "taken", "lost", "told"), found)],
        checks=[
            Check("clock faults: most right rows lost", most, LOST, "<="),
            Check("clock faults that are not told", len(silent), 0, "<="),
            Check("clock faults after which a run is not well", len(ill), 0, "<="),
        ],
    )
