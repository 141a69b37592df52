"""Output of commands: tables, checks and notes as text, or one JSON object."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from livepde import __version__, plots, runs
from livepde.cases.read import did_you_mean
from livepde.diagnostics.check_report import shown_cell
from livepde.errors import ConfigurationError
from livepde.runs import Check, Journal, Table
from livepde.runs.directory import plain

DIGITS = 4  # significant digits of a number in a table
MOST_CURVES = 100_000  # largest number of samples for which readings are drawn
CHECK_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130  # exit codes
FIGURES_MISSING = "No figures: they require Matplotlib, pip install 'livepde[plots]'."


def terminal(*, err: bool = False) -> Console:
    """Return a console for standard output or standard error that does not wrap lines."""
    return Console(stderr=err, highlight=False, soft_wrap=True)


def named(name: str, known: Mapping[str, Any], what: str) -> Any:
    """Return an item by name; raises `ConfigurationError` with the closest name."""
    if name not in known:
        raise ConfigurationError(f"there is no {what} '{name}'; {did_you_mean(name, known)}")
    return known[name]


def can_draw(console: Console) -> bool:
    """Return whether figures can be drawn, and print the reason if not."""
    found = importlib.util.find_spec("matplotlib") is not None
    if not found:
        console.print(escape(FIGURES_MISSING))
    return found


def figures_of(dataset: Any, title: str, journal: Journal | None) -> dict[str, Any]:
    """Return the figures of a run, name -> function that draws, with readings of the journal."""
    if not dataset.sizes["time"]:
        return {}
    kinds = [of for of in ("sensor", "validation") if of in dataset]
    names = [str(name) for of in kinds for name in dataset[of].values]
    few = journal is not None and names and len(journal) <= MOST_CURVES
    measured = journal.readings(names) if few and journal is not None else None
    return {"overview": lambda: plots.overview(dataset, title=title, measured=measured)}


def present(
    shown: Iterable[Table],
    checks: Iterable[Check],
    notes: Iterable[str],
    *,
    as_json: bool,
    title: str = "",
    lines: Iterable[str] = (),
    dataset: Any = None,
    **facts: Any,
) -> None:
    """Print results as text, or as one JSON object.

    `title` and `lines`, which may contain markup, are for the text. The JSON object also contains
    the facts, and the measures and verdict of the dataset.
    """
    console = terminal()
    if not as_json:
        if title:
            console.print(title)
        show(console, shown, checks, notes)
        for line in lines:
            console.print(line)
        return
    content: dict[str, Any] = {"livepde": __version__, **facts}
    content["checks"] = [item.to_dict() for item in checks]
    if dataset is not None:
        content["measures"] = runs.measures(dataset)
        content["verdict"] = runs.verdict(dataset).to_dict()
    content["tables"] = [item.to_dict() for item in shown]
    content["notes"] = list(notes)
    sys.stdout.write(json.dumps(plain(content), ensure_ascii=False) + "\n")


def exit_if_failed(checks: Iterable[Check]) -> None:
    """Exit with code `CHECK_FAILED` if a check failed."""
    if not all(item.ok for item in checks):
        raise typer.Exit(CHECK_FAILED)


def show(
    console: Console, shown: Iterable[Table], checks: Iterable[Check], notes: Iterable[str]
) -> None:
    """Print tables, checks and notes."""
    for table in shown:
        print_table(console, table)
    grid = RichTable.grid(padding=(0, 2))
    for item in checks:
        mark = "[green]ok[/]" if item.ok else "[bold red]failed[/]"
        grid.add_row(
            mark, escape(item.name), shown_cell(item.value, DIGITS), item.sense, item.bound_text
        )
    if grid.row_count:
        console.print(grid, soft_wrap=False)
    for note in notes:
        console.print(f"[yellow]Note:[/] {escape(note)}")


def extent(values: Any) -> tuple[str, str, int]:
    """Return minimum and maximum of the finite values as text, and the number of others."""
    present = values[np.isfinite(values)]
    ends = (f"{present.min():.4g}", f"{present.max():.4g}") if present.size else ("–", "–")
    return *ends, values.size - present.size


def print_table(console: Console, table: Table) -> None:
    """Print a table; a narrow terminal folds text between words and does not cut numbers."""
    if not table.rows:
        console.print(f"[bold]{escape(table.title)}[/]")
        return
    grid = RichTable(
        title=escape(table.title), title_justify="left", box=SIMPLE_HEAD, title_style="bold"
    )
    needed = 2
    for k, column in enumerate(table.columns):
        values = [row[k] for row in table.rows]
        numbers = k > 0 and all(map(_numeric, values))
        # The heading and text can be folded between words.
        cells = [shown_cell(value, DIGITS) for value in values]
        words = [*(cells if numbers else " ".join(cells).split()), *column.split()]
        width = max(map(len, words), default=0)
        needed += width + 2  # two blanks between columns
        grid.add_column(
            escape(column), justify="right" if numbers else "left", min_width=width, overflow="fold"
        )
    for row in table.rows:
        grid.add_row(*(escape(shown_cell(value, DIGITS)) for value in row))
    console.print(grid, width=max(console.width, needed), crop=False, soft_wrap=False)


def _numeric(value: Any) -> bool:
    if value is None or isinstance(value, int | float):
        return True
    text = str(value).removesuffix(" %")
    return text == "–" or text.lstrip("+-").replace(".", "").replace("e", "").isdigit()
