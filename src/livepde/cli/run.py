"""Take every sample of a case, and write a run directory."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from livepde import __version__
from livepde.cli.options import (
    CaseArgument,
    CodeOption,
    JsonOption,
    OutOption,
    SetOption,
    load_case,
)
from livepde.cli.printing import (
    CHECK_FAILED,
    INTERRUPTED,
    can_draw,
    figures_of,
    print_json,
    show,
    terminal,
)

if TYPE_CHECKING:
    from livepde.cases import Prepared

__all__ = ["run"]


def run(
    case: CaseArgument,
    data: Annotated[
        str | None,
        typer.Option(
            help="Other data than the case names: a .csv or .jsonl file, or - for JSON lines "
            "from standard input.",
            show_default=False,
        ),
    ] = None,
    out: OutOption = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Identify: take every sample of a case, and write a run directory.

    Ctrl-C ends a run early; what it has is written.

    Example:  livepde run mycase/case.toml
    Live:     logger | livepde run mycase/case.toml --data -
    """
    from livepde.runs import RunWriter, checks_of, doubts, drive, free_path, tables
    from livepde.streams import Table as Samples

    loaded = load_case(case, allow_code, settings)
    source = sys.stdin if data == "-" else data
    if out is not None and out.exists():
        _must_be_empty(out)
    prepared = loaded.prepare(source)
    folder = out or free_path(Path("runs") / loaded.name)
    writer = RunWriter.create(
        folder,
        version=__version__,
        command=["livepde", *sys.argv[1:]],
        title=loaded.title,
        case=loaded.text,
        settings=settings or (),
        original=loaded.original,
    )
    total = len(prepared.stream) if isinstance(prepared.stream, Samples) else None
    driven = drive(
        prepared.identifier,
        prepared.stream,
        progress=not as_json,
        total=total,
        fields_every=loaded.fields_every,
    )
    dataset = driven.result.to_xarray()
    prepared.describe(dataset)
    checks = checks_of(loaded.expected, dataset)
    notes = [*loaded.notes, *doubts(dataset)]
    if len(driven.result):
        notes += _traded(prepared)
    if driven.status == "interrupted":
        notes.append(f"Interrupted after {len(driven.result)} samples.")
    if driven.error is not None:
        notes.append(f"Stopped after {len(driven.result)} samples: {driven.error}")
    shown = tables(dataset)
    err = terminal(err=True)
    writer.finish(
        status=driven.status,
        dataset=dataset,
        identifier=prepared.identifier,
        shown=shown,
        checks=checks,
        notes=notes,
        figures=figures_of(dataset, loaded.title) if can_draw(err) else {},
    )
    if driven.error is not None:
        raise driven.error
    if as_json:
        print_json(shown, checks, notes, run=str(folder), status=driven.status, dataset=dataset)
    else:
        console = terminal()
        console.print(f"[bold]{escape(loaded.title)}[/]  {len(driven.result)} samples")
        show(console, shown, checks, notes)
        console.print(f"[bold]Run directory: {escape(str(folder))}[/]", soft_wrap=True)
    if driven.status == "interrupted":
        raise typer.Exit(INTERRUPTED)
    if as_json and not all(item.ok for item in checks):
        raise typer.Exit(CHECK_FAILED)


def _traded(prepared: Prepared) -> list[str]:
    """Return what a run's data tell only together."""
    from livepde.diagnostics import identifiability
    from livepde.laws import AutoLaw, SensitivityLaw

    if not isinstance(prepared.case.law, AutoLaw | SensitivityLaw):
        return []
    belief = prepared.identifier.latent_belief()
    return identifiability(prepared.case.model, belief).sentences


def _must_be_empty(folder: Path) -> None:
    """Refuse a taken folder before data are read."""
    from livepde.runs import refuse_taken

    refuse_taken(folder)
