"""Report of a run as a single HTML file with sentences, tables and figures.

The file is self-contained; its content security policy forbids to load anything else.
"""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from livepde import runs
from livepde.dashboard.view import with_readings
from livepde.errors import RunError, optional
from livepde.plots.style import sensor_names
from livepde.runs import Journal, Run
from livepde.runs.directory import CASE
from livepde.runs.exported import into_place
from livepde.runs.journal import Event

TEMPLATE, STYLE = "report.html", "assets/page.css"
MOST_EVENTS = 500
MOST_READINGS = 100_000  # largest number of samples for which readings are drawn


def write_report(run: Run, target: Path, *, force: bool = False) -> None:
    """Write the report of a run, which may still be in progress.

    `force`: replace an existing file.
    Raises `RunError`: the target exists, or cannot be written; the run contains no estimates.
    Raises `ConfigurationError`: Plotly or Jinja2 is not installed.
    """
    into_place(target, lambda path: path.write_text(page_of(run), encoding="utf-8"), force=force)


def page_of(run: Run) -> str:
    """Return the report of a run as HTML, see `write_report`."""
    with optional("dashboard", "A report as HTML needs Plotly and Jinja2"):
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
        from plotly.offline import get_plotlyjs
    from livepde.dashboard.cards import findings
    from livepde.dashboard.figures.canvas import CONFIG
    from livepde.dashboard.figures.panels import SECTIONS, panels

    data, found = _contents(run)
    drawn, doubts = panels(data), runs.doubts(run.dataset)
    notes = [("info", note) for note in run.notes if note not in doubts]
    times = [f"{key} {run.record[key]}" for key in ("started", "ended") if key in run.record]
    case, here = run.path / CASE, Path(__file__).parent
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
        verdict=[*findings(run.dataset, (), run.checks, doubts), *notes],
        tables=runs.tables(data),
        checks=[
            (c.name, c.value, f"{c.sense} {c.bound_text}", "ok" if c.ok else "FAILED")
            for c in run.checks
        ],
        sections=SECTIONS,
        panels=drawn,
        case=case.read_text(encoding="utf-8", errors="replace") if case.is_file() else "",
        drawings={panel.name: json.loads(panel.figure.to_json()) for panel in drawn},
        config=CONFIG,
        written=" · ".join([f"livepde {run.record.get('livepde', '')}".rstrip(), *times]),
        style=(here / STYLE).read_text(encoding="utf-8"),
        plotly=get_plotlyjs(),
        nonce=secrets.token_urlsafe(16),
        **found,
    )


def _contents(run: Run) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return estimates, times and events of a run."""
    from livepde.dashboard.figures.canvas import when_axis

    data, events, counts = run.dataset, list[Event](), dict[tuple[str, str], int]()
    if not data.sizes["time"]:
        raise RunError(f"{run.path} contains no estimates yet, so there is nothing to report.")
    with run.reading() as journal:
        if journal is not None:
            data, events, counts = _with_readings(data, journal), journal.events, journal.counts
    axis, newest = when_axis(data), events[: -MOST_EVENTS - 1 : -1]
    return data, {
        "span": [axis.text(float(data["time"][k])) for k in (0, -1)],
        "newest": f"{len(newest)} of {len(events)} events, newest first",
        "events": [(axis.text(e.t), e.kind, e.channel or "–", e.message) for e in newest],
        "counts": [(kind, channel or "–", number) for (kind, channel), number in counts.items()],
    }


def _with_readings(data: xr.Dataset, journal: Journal) -> xr.Dataset:
    """Return the estimates of a run, with its readings unless these are too many."""
    if len(journal) > MOST_READINGS:
        return data
    names = sensor_names(data)
    known = dict(zip(*journal.readings(names), strict=True))
    missing = np.full(len(names), np.nan)
    readings = [known.get(t, missing) for t in data["time"].values.tolist()]
    return with_readings(data, np.array(readings))
