"""Clocks that leap or go back, and rows that come again, in live runs of the rod."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.faults.plan import Plan
from benchmarks.faults.rod import STEP, Row, case_text, rod_rows
from livepde.cases import load
from livepde.cases.live_case import LiveCase
from livepde.runs import Check, Outcome, Table
from livepde.streams.sources import Rows


def _moved(rows: Sequence[Row], by: timedelta) -> list[dict[str, Any]]:
    return [{**row, "time": str(datetime.fromisoformat(row["time"]) + by)} for row in rows]


def _with(rows: Sequence[Row], wrong: Sequence[Row], at: int) -> list[Row]:
    return [*rows[:at], *wrong, *rows[at:]]


def _used(rows: Sequence[Row]) -> list[float]:
    """Return the times that are later than all before them, in seconds since the first."""
    times = np.array([datetime.fromisoformat(row["time"]).timestamp() for row in rows])
    newest = np.maximum.accumulate(times)
    kept = np.append(True, np.diff(newest) > 0)
    found: list[float] = (times - times[0])[kept].tolist()
    return found


DAY, HOUR = timedelta(days=1), timedelta(hours=1)

# Name -> how the right rows become those that come. Those that are inserted are never used.
INSERTED: Mapping[str, Any] = {
    "none": lambda rows: list(rows),
    "the first row 10 years ahead": lambda rows: _with(rows, _moved(rows[:1], 3650 * DAY), 0),
    "one row 29 days ahead": lambda rows: _with(rows, _moved(rows[200:201], 29 * DAY), 200),
    "one row 10 years ahead": lambda rows: _with(rows, _moved(rows[200:201], 3650 * DAY), 200),
    "two rows 10 years ahead": lambda rows: _with(rows, _moved(rows[200:202], 3650 * DAY), 200),
    "eight rows 3 hours ahead": lambda rows: _with(rows, _moved(rows[200:208], 3 * HOUR), 200),
    "every 25th row an hour ahead": lambda rows: [
        one for k, row in enumerate(rows) for one in (*_moved([row], HOUR)[: k % 25 == 24], row)
    ],
    "one row of 1970": lambda rows: _with(rows, [{**rows[0], "time": "1970-01-01"}], 200),
    "100 rows again": lambda rows: _with(rows, rows[200:300], 300),
}
# The same for clocks that are wrong for long: a time is used if it is later than all before it.
MOVED: Mapping[str, Any] = {
    "set back by an hour": lambda rows: [*rows[:200], *_moved(rows[200:], -HOUR)],
    "set back by a day": lambda rows: [*rows[:200], *_moved(rows[200:], -DAY)],
    "set ahead by an hour": lambda rows: [*rows[:200], *_moved(rows[200:], HOUR)],
    "back by 3.5 steps every 30 rows": lambda rows: [
        _moved([row], -timedelta(seconds=3.5 * STEP * (k // 30)))[0] for k, row in enumerate(rows)
    ],
    "an hour ahead for 100 rows": lambda rows: [
        *rows[:200], *_moved(rows[200:300], HOUR), *rows[300:],
    ],
}  # fmt: skip
CLOCKS = {**INSERTED, **MOVED}
# Rows are late until the end, or the clock is never steady: the run is not well.
LASTING = ("set back by a day", "back by 3.5 steps every 30 rows")


def clock_faults(plan: Plan) -> Outcome:
    """Let the clocks of the rod go wrong, and compare the samples with those that are right."""
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
                taken, counts = [record.t for record in live.journal], live.journal.counts
                # What a clock that is wrong did to the data may well make the estimates doubtful.
                well = live.health["ok"] or live.health["why"].startswith("the verdict")
            wrong = len(set(taken) ^ set(_used(rows if fault in INSERTED else change(rows))))
            most = max(most, wrong)
            if fault != "none" and not counts and "ahead by" not in fault:
                silent.append(fault)
            if well == (fault in LASTING):
                ill.append(fault)
            told = ", ".join(f"{kind} {number}" for (kind, _), number in sorted(counts.items()))
            found.append((fault, len(taken), wrong, told or "–"))
    return Outcome(
        tables=[Table(f"Clocks of {len(rows)} rows", ("fault", "taken", "wrong", "told"), found)],
        checks=[
            Check("clock faults: samples too many or too few", most, 0, "<="),
            Check("clock faults that are not told", len(silent), 0, "<="),
            Check("clock faults after which the health is wrong", len(ill), 0, "<="),
        ],
    )
