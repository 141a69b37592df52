"""Commands `demo`, `reproduce` and `citation`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from livepde import __version__
from livepde.cli.options import JsonOption, OutOption, names_in, option
from livepde.cli.printing import can_draw, exit_if_failed, named, present, show, terminal
from livepde.runs import Outcome, RunWriter, free_path

# A test compares these facts with CITATION.cff; the year is the year of the release.
BIBTEX = """\
@misc{{livepde{year},
  author = {{{{The livepde authors}}}},
  title = {{{{livepde}}}},
{year_line}\
  note = {{Computer software, version {version}}},
}}

@article{{Boiger2016,
  author = {{Boiger, R. and Kaltenbacher, B.}},
  title = {{{{An online parameter identification method for time dependent partial \
differential equations}}}},
  journal = {{Inverse Problems}},
  volume = {{32}},
  pages = {{045006}},
  year = {{2016}},
  doi = {{10.1088/0266-5611/32/4/045006}},
}}"""
APA = """\
The livepde authors. ({year}). livepde (Version {version}) [Computer software].

Boiger, R., & Kaltenbacher, B. (2016). An online parameter identification method for time \
dependent partial differential equations. Inverse Problems, 32, Article 045006. \
https://doi.org/10.1088/0266-5611/32/4/045006"""


def demo(out: OutOption = None) -> None:
    """Watch the paper's method find q(x) and u(t, x) online.

    Runs the first experiment of Boiger and Kaltenbacher (2016), prints how close it came, and
    leaves a run directory with the figures of the paper.

    Example:  livepde demo
    """
    from livepde.reproduce import EXPERIMENTS

    console = terminal()
    console.print(
        "\n[bold]Which reaction q(x) explains what is seen?[/]\n\n"
        "  u_t - (D u_x)_x + q u = f  on (0, 1), u is seen on (0.3, 0.87), one sample at a time.\n"
        "  The state u and the parameter q are estimated together while the samples come.\n"
    )
    folder = out or free_path(Path("runs") / "demo")
    experiment = EXPERIMENTS["seed"]
    command = ["livepde", "demo"]
    writer = RunWriter.create(
        folder, version=__version__, command=command, title="Demo: " + experiment.summary
    )
    outcome = experiment.run(None, progress=True)
    show(console, outcome.tables, outcome.checks, outcome.notes)
    for name in _finish(writer, outcome, console):
        console.print(f"Figure: {folder / name}.png")
    console.print(f"[bold]Run directory: {escape(str(folder))}[/]")


def run_experiment(
    run: Callable[[], Outcome], out: Path | None, command: Sequence[str], title: str, as_json: bool
) -> None:
    """Run an experiment, print its outcome, and store it in the run directory `out`, if given.

    With `as_json`, a failed check ends the command with exit code 1.
    """
    writer = None
    if out is not None:
        writer = RunWriter.create(out, version=__version__, command=list(command), title=title)
    outcome = run()
    if writer is not None:
        _finish(writer, outcome, terminal(err=True))
    shown = outcome.tables, outcome.checks, outcome.notes
    present(*shown, as_json=as_json, command=" ".join(command))
    if as_json:
        exit_if_failed(outcome.checks)


def _finish(writer: RunWriter, outcome: Outcome, console: Console) -> Iterable[str]:
    """Write the outcome of an experiment; return the names of its figures that can be drawn."""
    figures = outcome.figures if can_draw(console) else {}
    writer.finish(
        status="finished",
        dataset=outcome.dataset,
        shown=outcome.tables,
        checks=outcome.checks,
        notes=outcome.notes,
        figures=figures,
    )
    return figures


def reproduce(
    name: Annotated[
        str,
        typer.Argument(
            help="Name of the experiment; 'list' shows them.",
            autocompletion=names_in("livepde.reproduce:EXPERIMENTS"),
        ),
    ],
    truth: Annotated[
        str | None,
        option(
            "Where the data come from: discrete (the same scheme), fine (a finer grid), "
            "analytic (a formula)."
        ),
    ] = None,
    as_json: JsonOption = False,
    out: Annotated[Path | None, option("Keep dataset and figures in a new run directory.")] = None,
) -> None:
    """Run a published or stated experiment and compare it with its expected numbers.

    Example:  livepde reproduce seed --json
    """
    from livepde.reproduce import EXPERIMENTS

    if name == "list":
        for item in EXPERIMENTS.values():
            terminal().print(f"[bold]{item.name}[/]  {escape(item.summary)}", soft_wrap=False)
        return
    experiment = named(name, EXPERIMENTS, "experiment")
    command = ["livepde", "reproduce", name, *(["--truth", truth] if truth else [])]
    run = partial(experiment.run, truth, progress=not as_json)
    run_experiment(run, out, command, experiment.summary, as_json)


class CitationForm(StrEnum):
    """Formats of a citation."""

    bibtex = "bibtex"
    apa = "apa"
    cff = "cff"


def citation(
    form: Annotated[
        CitationForm,
        typer.Option("--format", help="BibTeX, a line in the style of the APA, or the file."),
    ] = CitationForm.bibtex,
) -> None:
    """Print how to cite livepde, and the paper whose method it implements.

    Example:  livepde citation --format apa
    """
    text = files("livepde").joinpath("CITATION.cff").read_text(encoding="utf-8")
    released = re.search(r"^date-released: (\d{4})", text, re.MULTILINE)
    year = released[1] if released else ""
    if form is CitationForm.bibtex:
        year_line = f"  year = {{{year}}},\n" if year else ""
        text = BIBTEX.format(year=year, year_line=year_line, version=__version__)
    elif form is CitationForm.apa:
        text = APA.format(year=year or "n.d.", version=__version__)
    terminal().print(text.rstrip(), markup=False)
