"""Report of a run: tables and figures, theory, and the test of a likely cause."""

from __future__ import annotations

import math
import shlex
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from livepde.cli.options import CodeOption, JsonOption, RunArgument, argument, option, prepare_again
from livepde.cli.printing import CHECK_FAILED, can_draw, figures_of, present, terminal

if TYPE_CHECKING:
    import xarray as xr

    from livepde.runs import Table
    from livepde.verdict import Cause

__all__ = ["explain", "report"]


def report(
    folder: RunArgument,
    theory: Annotated[
        bool,
        typer.Option(
            "--theory",
            help="What the paper's theory says about the run: constants, excitation, conditions, "
            "T*. Takes the samples again; writes theory.md.",
        ),
    ] = False,
    data: Annotated[
        str | None, typer.Option(help="With --theory: the run's data, if its case was moved.")
    ] = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
) -> None:
    """Show what a run found: tables, and figures into the run directory.

    Example:  livepde report runs/mycase
    Theory:   livepde report runs/mycase --theory
    """
    from livepde import runs
    from livepde.errors import RunError

    if theory:
        _report_theory(runs.open(folder), data, as_json, allow_code)
        return
    from livepde.runs.directory import drawn_into, markdown, write_text
    from livepde.runs.outcome import attempted

    opened = runs.open(folder)
    found, checks, notes = opened.dataset, opened.checks, opened.notes
    nothing: list[Any] = []
    shown = attempted("The tables", opened.summary, nothing, notes)
    shown = [*shown, *attempted("The table of irregular rows", opened.arrivals, nothing, notes)]
    console = terminal(err=as_json)
    figures: dict[str, Any] = {}
    if can_draw(console):
        with opened.reading() as journal:
            figures = figures_of(found, opened.title, journal)
    try:
        drawn = drawn_into(folder, figures, notes)
        text = markdown(opened.title, shown, checks, notes, drawn)
        write_text(folder / "report.md", text)
    except OSError as error:
        raise RunError(f"{folder} cannot be written: {error.strerror or error}.") from error
    present(
        shown,
        checks,
        notes,
        as_json=as_json,
        title=f"[bold]{escape(opened.title)}[/]  {opened.status}",
        lines=[f"Figure: {folder / name}" for name in drawn],
        dataset=opened.dataset,
        run=str(folder),
        status=opened.status,
    )
    if as_json and not all(item.ok for item in checks):
        raise typer.Exit(CHECK_FAILED)


def _report_theory(opened: Any, data: str | None, as_json: bool, allow_code: bool) -> None:
    """Take a run's samples again; print and write the theory report."""
    from livepde.diagnostics import theory_report

    prepared = prepare_again(opened, data, allow_code)
    found = theory_report(prepared.identifier, prepared.stream)
    target = opened.path / "theory.md"
    target.write_text(found.markdown(f"Theory: {opened.title}"), encoding="utf-8")
    title, page = f"[bold]{escape(opened.title)}[/]  theory", f"Page: {escape(str(target))}"
    where = {"run": str(opened.path), "theory": str(target)}
    present(found.tables, [], found.notes, as_json=as_json, title=title, lines=[page], **where)


def explain(
    folder: RunArgument,
    cause: Annotated[int | None, argument("Number of the cause to test.", min=1)] = None,
    data: Annotated[str | None, option("The run's data, if its case was moved.")] = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
) -> None:
    """List the likely causes of what a verdict found, or test one of them.

    The test takes the samples of the run again, with the cause free. Nothing is written.

    Example:  livepde explain runs/mycase
    Test:     livepde explain runs/mycase 1
    """
    from livepde import runs
    from livepde.errors import RunError

    opened = runs.open(folder)
    causes = _causes(opened.dataset)
    if cause is None:
        notes = [] if causes else ["The verdict names no cause that a setting of the case frees."]
        _print(opened, [_listed(causes)] if causes else [], notes, as_json)
        return
    if cause > len(causes):
        raise RunError(
            f"{folder} has {len(causes)} causes to test: 'livepde explain {folder}' lists them."
        )
    chosen = causes[cause - 1]
    prepared = prepare_again(opened, data, allow_code, [chosen.setting])
    again = prepared.identifier.run(prepared.stream, progress=not as_json).to_xarray()
    options = [part for item in (*opened.settings, chosen.setting) for part in ("--set", item)]
    command = shlex.join(["livepde", "run", str(opened.case_file()), *options])
    notes = [f"Tested: {chosen.text}.", f"A run of it: {command}"]
    _print(opened, _compared(opened.dataset, again), notes, as_json)


def _causes(data: xr.Dataset) -> list[Cause]:
    """Return the causes that a setting frees, the worst finding first, each once."""
    from livepde.runs import verdict

    found: dict[str, Cause] = {}
    for finding in verdict(data).findings:
        for cause in finding.causes:
            if cause.setting:
                found.setdefault(cause.setting, cause)
    return list(found.values())


def _listed(causes: list[Cause]) -> Table:
    from livepde.runs import Table

    rows = [
        (k, cause.text, "–" if math.isnan(cause.share) else f"{cause.share:.0%}", cause.setting)
        for k, cause in enumerate(causes, 1)
    ]
    return Table("Causes to test", ("number", "cause", "explains", "setting"), rows)


def _compared(before: xr.Dataset, after: xr.Dataset) -> list[Table]:
    """Return verdict, unknowns and errors of the channels of two runs beside each other."""
    from livepde.runs import Table, verdict
    from livepde.runs.summary import channel_errors, digits, rmse, scalars, shown

    judged = [("verdict", verdict(before).level, verdict(after).level, "")]
    rows: list[tuple[Any, ...]] = []
    for label in scalars(after):
        new = float(after[label][-1]), float(after[f"{label}_std"][-1])
        if label not in before:
            rows.append((label, "–", " ± ".join(digits(*new)), ""))
            continue
        old = float(before[label][-1]), float(before[f"{label}_std"][-1])
        moved = f"{(new[0] - old[0]) / old[1]:+.1f}" if old[1] > 0.0 else "–"
        rows.append((label, " ± ".join(digits(*old)), " ± ".join(digits(*new)), moved))
    errors, found = channel_errors(before), channel_errors(after)
    channels = [
        (name, shown(rmse(errors[name].later), ".4g"), shown(rmse(item.later), ".4g"))
        for name, item in found.items()
        if name in errors
    ]
    free = "With the cause free (± std. dev., of medians to first order)"
    title = "RMSE one step ahead, second half of the samples"
    columns = ("unknown", "run", "cause free", "moved, std. dev.")
    return [
        Table(free, columns, [*judged, *rows]),
        Table(title, ("channel", "run", "cause free"), channels),
    ]


def _print(opened: Any, tables: list[Table], notes: list[str], as_json: bool) -> None:
    title = f"[bold]{escape(opened.title)}[/]"
    present(tables, [], notes, as_json=as_json, title=title, run=str(opened.path))
