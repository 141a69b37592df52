"""Report of a run: tables and figures, and theory."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.markup import escape

from livepde.cli.options import CodeOption, JsonOption, RunArgument, prepare_again
from livepde.cli.printing import CHECK_FAILED, can_draw, figures_of, present, terminal


def report(
    folder: RunArgument,
    theory: Annotated[
        bool,
        typer.Option(
            "--theory",
            help="Evaluate the paper's theory for the run: constants, excitation, conditions, T*. "
            "Processes the samples again and writes theory.md.",
        ),
    ] = False,
    data: Annotated[
        str | None, typer.Option(help="With --theory: data of the run, if its case was moved.")
    ] = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
) -> None:
    """Print the tables of a run, and write its figures into the run directory.

    Example:  livepde report runs/mycase
    Theory:   livepde report runs/mycase --theory
    """
    from livepde import runs
    from livepde.errors import RunError

    if theory:
        _report_theory(runs.open(folder), data, as_json, allow_code)
        return
    from livepde.runs.directory import attempted, drawn_into, markdown, write_text

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
    """Process the samples of a run again; print and write the theory report."""
    from livepde.diagnostics import theory_report

    prepared = prepare_again(opened, data, allow_code)
    found = theory_report(prepared.identifier, prepared.stream)
    target = opened.path / "theory.md"
    target.write_text(found.markdown(f"Theory: {opened.title}"), encoding="utf-8")
    title, page = f"[bold]{escape(opened.title)}[/]  theory", f"Page: {escape(str(target))}"
    where = {"run": str(opened.path), "theory": str(target)}
    present(found.tables, [], found.notes, as_json=as_json, title=title, lines=[page], **where)
