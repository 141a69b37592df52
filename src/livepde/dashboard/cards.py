"""Textual parts of the page: headline, verdict, cards of unknowns, tables.

All text from files is passed to Dash components as plain children, which show it unchanged.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
import xarray as xr
from dash import html

from livepde.dashboard.figures.canvas import at_time, unit_label, when_axis
from livepde.dashboard.view import RunView
from livepde.frames import ERRORS
from livepde.plots.style import axis_label, groups, modes_determined, prior_left
from livepde.records import STATUS_CODES, field_names, interval_95, scalars
from livepde.runs import Check, severities
from livepde.runs.summary import STATES, channel_errors, determination, digits
from livepde.verdict import Severity

Level = Literal["good", "info", "warn", "bad"]

MOST_SHOWN = 6  # sentences of the verdict that are shown initially
MOST_CARDS = 12
MOST_ROWS = 100  # largest number of rows in a table
LONG = 12  # rows from which a table is initially closed
RAISED = str.maketrans("+-0123456789", "⁺⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SEVERITY: dict[Severity, Level] = {"note": "info", "caution": "warn", "do not trust": "bad"}
SIGNS: dict[Level, str] = {"good": "✓", "info": "i", "warn": "!", "bad": "✕"}
STATUS: dict[str, tuple[Level, str]] = {
    "waiting": ("info", "waiting for the first sample"),
    "running": ("good", "running"),
    "silent": ("bad", "source is silent"),
    "stopped": ("bad", "stopped unexpectedly"),
    "finished": ("info", "finished"),
    "interrupted": ("info", "interrupted by the user"),
    "failed": ("bad", "failed"),
    "unreadable": ("bad", "cannot be read"),
}
GAINS: dict[str, Level] = {
    "pinned": "good",
    "partly": "info",
    "moves": "info",
    "flat": "warn",
    "at its bound": "warn",
}


def pretty(number: str) -> str:
    """Return a number in scientific notation with a superscript exponent.

    >>> pretty("4.97e-07"), pretty("2.5")
    ('4.97·10⁻⁷', '2.5')
    """
    mantissa, e, power = number.partition("e")
    return f"{mantissa}·10{str(int(power)).translate(RAISED)}" if e else mantissa


def _between(low: str, high: str) -> str:
    """Return an interval as text, with a common power of ten."""
    power, other = low.partition("e")[2], high.partition("e")[2]
    return f"{pretty(low.partition('e')[0] if power == other else low)} to {pretty(high)}"


def chip(seen: RunView) -> list[Any]:
    """Return the status of a run as text."""
    level, text = STATUS.get(seen.status, ("info", seen.status))
    return [sign(level), html.Span(text)]


def facts(seen: RunView) -> str:
    """Return the progress of a run as a line of text."""
    parts = [f"{seen.samples} sample{'s' * (seen.samples != 1)}"]
    if (data := seen.estimates) is not None:
        parts.append(f"newest at {when_axis(data).text(float(data['time'][-1]))}")
    if seen.reading:
        parts.append("reading earlier samples")
    elif seen.ended:
        parts.append(f"ended {seen.ended.replace('T', ' ').replace('+00:00', ' UTC')}")
    elif seen.written:
        parts.append(f"last written {_ago(time.time() - seen.written)}")
    return " · ".join(parts)


def _ago(seconds: float) -> str:
    for size, name in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        # A unit is used from two of it on, so that 90 minutes are not rounded to hours.
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name} ago"
    return f"{max(seconds, 0.0):.0f} s ago"


def summary(seen: RunView) -> str:
    """Return a sentence on the unknowns, sensors and law of a run."""
    data = seen.dataset
    if data is None:
        return "No estimates yet."
    names = [
        name if labels == [name] else f"{name} ({len(labels)} values)"
        for name, labels in groups(data).items()
    ]
    names += [f"{name} (field)" for name in field_names(data)]
    sensors, validation = (data.sizes.get(size, 0) for size in ("sensor", "validation"))
    found = f"Estimates {', '.join(names) or 'the state only'} from {sensors} sensor"
    found += "s" * (sensors != 1)
    if validation:
        found += f", validated with {validation} more"
    return f"{found}."


def gravest(seen: RunView) -> tuple[Level, str]:
    """Return the level and the sentence of the most severe finding on a run."""
    levels: tuple[Level, ...] = ("bad", "warn", "good", "info")
    return min(_found(seen), key=lambda item: levels.index(item[0]), default=("info", "–"))


def verdict(seen: RunView) -> list[Any]:
    """Return a sentence for each finding and failure of a run, the most severe first."""
    found = _found(seen)
    lines = [html.Li([sign(level), html.Span(text)], className=level) for level, text in found]
    if len(lines) <= MOST_SHOWN + 1:
        return lines
    rest = [html.Summary(f"and {len(lines) - MOST_SHOWN} more"), html.Ul(lines[MOST_SHOWN:])]
    return [*lines[:MOST_SHOWN], html.Li(html.Details(rest))]


def _found(seen: RunView) -> list[tuple[Level, str]]:
    """Return the level and sentence of each finding on a run."""
    found = findings(seen.dataset, _failures(seen), seen.checks, seen.doubts)
    return found + [("info", text) for text in _remarks(seen)]


def findings(
    data: xr.Dataset | None, failures: Iterable[str], checks: Iterable[Check], doubts: Iterable[str]
) -> list[tuple[Level, str]]:
    """Return levels and sentences of failures, failed checks and doubts, or of no problems."""
    found: list[tuple[Level, str]] = [("bad", text) for text in failures]
    found += [("bad", f"Expected {c.name} {c.sense} {c.bound_text}, but it is {c.value:.4g}.")
              for c in checks if not c.ok]  # fmt: skip
    # For a thinned run that has ended, the notes contain the doubts, without a severity.
    graves = {} if data is None else severities(data)
    found += [(SEVERITY[graves.get(doubt, "caution")], doubt) for doubt in doubts]
    if data is not None and {"bad", "warn"}.isdisjoint(level for level, _ in found):
        found.insert(0, ("good", "No problems detected."))
    return found


def _failures(seen: RunView) -> Iterator[str]:
    """Yield sentences on failures of reading, process, source, health and last step."""
    if seen.problem:
        yield seen.problem
    if seen.status == "stopped":
        text = "The process of this run was killed. To resume it"
        yield f"{text}: `livepde run CASE --out RUN --resume`."
    if seen.status == "silent":
        # The page has only the newest events, and this event may be older.
        messages = ["", *(f": {one.message}" for one in seen.events if one.kind == "silent")]
        yield f"The source is silent{messages[-1]}."
    if seen.unhealthy:
        yield f"Unhealthy: {seen.unhealthy}."
    if seen.estimates is not None and (code := int(seen.estimates["status"].values[-1])):
        text = f"The last step failed ({STATUS_CODES[code].replace('_', ' ')})"
        yield f"{text}. The estimate is from the last successful step."


def _remarks(seen: RunView) -> Iterator[str]:
    """Yield informative sentences: irregular rows, thinned estimates, notes of the run."""
    if seen.counts:
        reasons: Counter[str] = Counter()
        for (kind, _), number in seen.counts.items():
            reasons[kind] += number
        counts = ", ".join(f"{number} {kind}" for kind, number in reasons.most_common())
        yield f"Irregular rows or values: {counts}. See Events."
    if seen.gap > 1 and seen.doubts and not seen.ended:
        yield f"This long run is shown, and counted, with one in {seen.gap} samples."
    yield from seen.notes


def sign(level: Level) -> Any:
    """Return the symbol of a level."""
    hidden: Any = {"aria-hidden": "true"}  # the text has the same content
    return html.Span(SIGNS[level], className=f"sign {level}", **hidden)


# --- cards ---------------------------------------------------------------------------------------


def cards(data: xr.Dataset | None, at: float | None) -> list[Any]:
    """Return a card with the value at a time for each unknown."""
    if data is None or not data.sizes["time"]:
        return []
    labels = scalars(data)
    fields = [name for name in field_names(data) if name in data]
    found = [_field_card(data, name, at) for name in fields]
    k = at_time(data, "time", at)
    found += [_card(data, label, k) for label in labels[: max(MOST_CARDS - len(fields), 0)]]
    left = len(labels) + len(fields) - len(found)
    if left > 0:
        found.append(html.P(f"and {left} more: see below.", className="more"))
    return found


def _card(data: xr.Dataset, label: str, k: int) -> Any:
    value, std = float(data[label].values[k]), float(data[f"{label}_std"].values[k])
    interval: Any = "no interval: this law has no covariance"
    if math.isfinite(std) and std > 0.0:
        low, high = (digits(float(end[k]), std)[0] for end in interval_95(data, label))
        interval = ["95 % interval: ", html.Span(_between(low, high))]
    lines = [html.P(interval, className="interval")]
    if "reference" in data[label].attrs:
        reference = pretty(f"{float(data[label].attrs['reference']):.4g}")
        lines.append(html.P(f"reference {reference}", className="interval"))
    left = prior_left(data, label, k)
    if math.isfinite(left):
        state = determination(data[label].attrs, value, left)
        text = STATES[state]
        if state in ("partly", "pinned"):
            text += f": std. dev. {100 * left:.2g}\N{NO-BREAK SPACE}% of the prior's"
        lines.append(html.P([sign(GAINS[state]), text], className="known"))
    return _article(data, label, pretty(digits(value, std)[0]), "value", lines)


def _article(data: xr.Dataset, name: str, value: str, kind: str, lines: list[Any]) -> Any:
    """Return the card of an unknown: name, value with its unit, and lines below."""
    unit = html.Span(f" {unit_label(data, name)}", className="unit")
    return html.Article(
        [html.H3(name), html.P([value, unit], className=kind), *lines], className="card"
    )


def _field_card(data: xr.Dataset, name: str, at: float | None) -> Any:
    k = at_time(data, "snapshot", at)
    values = data[name].values[k]
    low, mean, high = (
        pretty(f"{number:.3g}") for number in (values.min(), values.mean(), values.max())
    )
    lines = [html.P(f"field, mean {mean}", className="interval")]
    if f"{name}_std" in data:
        deviation = pretty(f"{float(np.mean(data[f'{name}_std'].values[k])):.2g}")
        lines.append(html.P(f"mean standard deviation {deviation}", className="interval"))
    if f"{name}_modes" in data:
        some, count, _ = modes_determined(data, name, k)
        level: Level = "good" if some > 0.9 * count else "info" if some >= 1.0 else "warn"
        text = f"{some:.1f} of {count} modes determined"
        lines.append(html.P([sign(level), text], className="known"))
    return _article(data, name, f"{low} to {high}", "value range", lines)


# --- tables --------------------------------------------------------------------------------------


def event_tables(seen: RunView) -> list[Any]:
    """Return the nonempty tables of events, irregular rows and checks, or a sentence."""
    found = []
    if seen.events:
        events = [
            (_when(seen.dataset, event.t), event.kind, event.channel, event.message)
            for event in reversed(seen.events)
        ]
        columns: tuple[str, ...] = ("Time", "Event", "Channel", "Details")
        found.append(_table("Events, newest first", columns, events))
    if seen.counts:
        counts = [(kind, channel or "–", n) for (kind, channel), n in seen.counts.items()]
        columns = ("Event", "Channel", "Number")
        found.append(_table("Irregular rows and values", columns, counts))
    if seen.checks:
        checks = [
            ("✓" if c.ok else "✕ failed", c.name, f"{c.value:.5g}", f"{c.sense} {c.bound_text}")
            for c in seen.checks
        ]
        columns = ("Result", "Quantity", "Value", "Expected")
        found.append(_table("Expected results", columns, checks))
    return found or [html.P("No events and no irregular rows.")]


def sensor_tables(seen: RunView) -> list[Any]:
    """Return the table of the sensors, if there are estimates."""
    if (data := seen.estimates) is None:
        return []
    last = {
        str(name): float(error)
        for variable, dimension in ERRORS
        if variable in data
        for name, error in zip(data[dimension].values, data[variable].values[-1], strict=True)
    }
    rows = []
    for name, (role, errors, _, refused) in channel_errors(data).items():
        newest = f"{last[name]:+.3g}" if math.isfinite(last[name]) else "missing"
        mean, root = "–", "–"
        if len(errors):
            mean, root = f"{errors.mean():+.2g}", f"{np.sqrt((errors**2).mean()):.3g}"
        used = "used" if role == "assimilated" else role
        rows.append((name, used, newest, refused or "–", mean, root))
    title = axis_label(data, "innovation", "Measured minus predicted")
    columns = ("Channel", "Role", "Last", "Rejected", "Mean", "Root mean square")
    return [_table(title, columns, rows)]


def _when(data: xr.Dataset | None, t: float | None) -> str:
    if data is None or t is None or not math.isfinite(t):
        return "–"
    return when_axis(data).text(t)


def _table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> Any:
    shown = list(rows)
    body = [html.Tr([html.Td(str(cell)) for cell in row]) for row in shown[:MOST_ROWS]]
    if len(shown) > MOST_ROWS:
        body.append(html.Tr(html.Td(f"and {len(shown) - MOST_ROWS} more", colSpan=len(columns))))
    head = html.Thead(html.Tr([html.Th(name, scope="col") for name in columns]))
    table = html.Table([head, html.Tbody(body)])
    return html.Details(
        [html.Summary(title), table], open=len(shown) <= LONG, className="table-frame"
    )
