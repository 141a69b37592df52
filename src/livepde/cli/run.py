"""Take every sample of a case, and write a run directory."""

from __future__ import annotations

import sys
from collections.abc import Sequence
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
from livepde.errors import ConfigurationError

if TYPE_CHECKING:
    from livepde.cases import Case, Prepared
    from livepde.runs import Journal, RunWriter

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
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the run in --out, as if it had never stopped."),
    ] = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Identify: take every sample of a case, and write a run directory.

    Ctrl-C ends a run early; what it has is written.

    Example:  livepde run mycase/case.toml
    Live:     logger | livepde run mycase/case.toml --data -
    Resume:   livepde run mycase/case.toml --out runs/mycase --resume
    """
    from livepde.runs import checks_of, doubts, drive, tables
    from livepde.streams import Table as Samples

    loaded = load_case(case, allow_code, settings)
    source = sys.stdin if data == "-" else data
    if resume and out is None:
        raise ConfigurationError("--resume needs --out: the folder of the run to go on with.")
    if out is not None and out.exists() and not resume:
        _must_be_empty(out)
    prepared = loaded.prepare(source)
    folder, writer, journal = _opened(loaded, prepared, out, settings or (), resume)
    total = len(prepared.stream) if isinstance(prepared.stream, Samples) else None
    driven = drive(
        prepared.identifier,
        prepared.stream,
        progress=not as_json,
        total=total,
        fields_every=loaded.fields_every,
        journal=journal,
    )
    dataset = driven.result.to_xarray()
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
    journal.close()
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


def _opened(
    loaded: Case, prepared: Prepared, out: Path | None, settings: Sequence[str], resume: bool
) -> tuple[Path, RunWriter, Journal]:
    """Return the run directory, its writer and its journal, new or to go on with."""
    from livepde.runs import Journal, RunWriter, free_path

    command = ["livepde", *sys.argv[1:]]
    folder = out or free_path(Path("runs") / loaded.name)
    path = folder / "journal.sqlite"
    if resume:
        journal = Journal.open(path, write=True)
        writer = RunWriter.reopen(
            folder, version=__version__, command=command, case=loaded.text, settings=settings
        )
        return folder, writer, journal
    writer = RunWriter.create(
        folder,
        version=__version__,
        command=command,
        title=loaded.title,
        case=loaded.text,
        settings=settings,
        original=loaded.original,
    )
    return folder, writer, prepared.journal(path)


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
