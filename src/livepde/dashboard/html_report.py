"""A run as one HTML file: sentences, tables and figures, to keep or to send.

The file is self-contained; its policy forbids a browser to load anything else.
"""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde import runs
from livepde.dashboard.view import with_readings
from livepde.errors import RunError, optional
from livepde.plots.style import sensor_names
from livepde.runs import Check, Run, Table
from livepde.runs.directory import CASE
from livepde.runs.exported import into_place
from livepde.runs.journal import Event

if TYPE_CHECKING:
    from livepde.dashboard.canvas import TimeAxis

TEMPLATE, STYLE = "report.html", "assets/page.css"
MOST_EVENTS = 500
MOST_READINGS = 100_000  # samples of a run whose readings are drawn


def write_report(run: Run, target: Path, *, force: bool = False) -> None:
    """Write the report of a run, also of one that still continues.

    `force`: replace an existing file.
    Raises `RunError`: the target exists, or cannot be written; the run contains no estimates.
    Raises `ConfigurationError`: Plotly or Jinja2 is not installed.
    """
    into_place(target, lambda path: path.write_text(page_of(run), encoding="utf-8"), force=force)


def page_of(run: Run) -> str:
    """Return the report of a run as HTML; see `write_report`."""
    with optional("dashboard", "A report as HTML needs Plotly and Jinja2"):
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
        from plotly.offline import get_plotlyjs
    from livepde.dashboard.canvas import CONFIG, when_axis
    from livepde.dashboard.cards import findings
    from livepde.dashboard.panels import SECTIONS, panels

    data = run.dataset
    with run.reading() as journal:
        if journal is not None and len(journal) <= MOST_READINGS and data.sizes["time"]:
            names = sensor_names(data)
            known = dict(zip(*journal.readings(names), strict=True))
            missing = np.full(len(names), np.nan)
            readings = [known.get(t, missing) for t in data["time"].values.tolist()]
            data = with_readings(data, np.array(readings))
    if not data.sizes["time"]:
        raise RunError(f"{run.path} contains no estimates yet, so there is nothing to report.")
    axis, drawn, doubts = when_axis(data), panels(data), runs.doubts(run.dataset)
    times = [f"{key} {run.record[key]}" for key in ("started", "ended") if key in run.record]
    case = run.path / CASE
    here = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(here),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE).render(
        run=run,
        equation=str(data.attrs.get("equation", "")),
        samples=data.sizes["time"],
        span=[axis.text(float(data["time"][k])) for k in (0, -1)],
        verdict=[
            *findings(run.dataset, (), run.checks, doubts),
            *(("info", note) for note in run.notes if note not in doubts),
        ],
        tables=list(map(_shown, runs.tables(data))),
        checks=list(map(_checked, run.checks)),
        sections={
            title: [panel for panel in drawn if panel.section == key]
            for key, title in SECTIONS.items()
        },
        **_journal(run, axis),
        case=case.read_text(encoding="utf-8", errors="replace") if case.is_file() else "",
        drawings={panel.name: json.loads(panel.figure.to_json()) for panel in drawn},
        config=CONFIG,
        written=" · ".join([f"livepde {run.record.get('livepde', '')}".rstrip(), *times]),
        style=(here / STYLE).read_text(encoding="utf-8"),
        plotly=get_plotlyjs(),
        nonce=secrets.token_urlsafe(16),
    )


def _shown(table: Table) -> Table:
    rows = [
        [f"{cell:.5g}" if isinstance(cell, float) else str(cell) for cell in row]
        for row in table.rows
    ]
    return Table(table.title, table.columns, rows)


def _checked(check: Check) -> tuple[str, ...]:
    result = "ok" if check.ok else "FAILED"
    return check.name, f"{check.value:.5g}", f"{check.sense} {check.bound_text}", result


def _journal(run: Run, axis: TimeAxis) -> dict[str, Any]:
    """Return the events of the run, and counts of values not used, as the template takes them."""
    events, counts = list[Event](), dict[tuple[str, str], int]()
    with run.reading() as journal:
        if journal is not None:
            events, counts = journal.events, journal.counts
    newest = events[: -MOST_EVENTS - 1 : -1]
    return {
        "newest": f"{len(newest)} of {len(events)} events, newest first",
        "events": [(axis.text(e.t), e.kind, e.channel or "–", e.message) for e in newest],
        "counts": [(kind, channel or "–", number) for (kind, channel), number in counts.items()],
    }
