"""Commands `report`, `export` and `watch` for runs, and `fmu` for cases."""

from __future__ import annotations

import sys
from contextlib import suppress
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from livepde import runs
from livepde.cli import options
from livepde.cli.printing import can_draw, exit_if_failed, figures_of, present, terminal
from livepde.dates import dated
from livepde.errors import ConfigurationError, RunError
from livepde.runs.directory import attempted, drawn_into, markdown, write_text
from livepde.runs.web import Address
from livepde.units import convert

if TYPE_CHECKING:
    from xarray import Dataset
REPORT = ".html"
PORT = 8050


def report(
    folder: options.RunArgument,
    theory: Annotated[
        bool,
        options.option(
            "Evaluate the paper's theory for the run: constants, excitation, conditions, T*. "
            "Processes the samples again and writes theory.md.",
            "--theory",
        ),
    ] = False,
    data: Annotated[
        str | None, typer.Option(help="With --theory: data of the run, if its case was moved.")
    ] = None,
    as_json: options.JsonOption = False,
    allow_code: options.CodeOption = False,
) -> None:
    """Print the tables of a run, and write its figures into the run directory.

    Example:  livepde report runs/mycase
    Theory:   livepde report runs/mycase --theory
    """
    if theory:
        _report_theory(runs.open(folder), data, as_json, allow_code)
        return
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
    if as_json:
        exit_if_failed(checks)


def _report_theory(opened: Any, data: str | None, as_json: bool, allow_code: bool) -> None:
    """Process the samples of a run again, and print and write the theory report."""
    from livepde.diagnostics import theory_report

    case = opened.case_file()
    with options.of_a_run(case.parent == opened.path):
        loaded = options.load_case(case, allow_code, opened.settings)
        prepared = loaded.prepare(data or opened.data_file)
    found = theory_report(prepared.identifier, prepared.stream)
    target = opened.path / "theory.md"
    target.write_text(found.markdown(f"Theory: {opened.title}"), encoding="utf-8")
    title, page = f"[bold]{escape(opened.title)}[/]  theory", f"Page: {escape(str(target))}"
    where = {"run": str(opened.path), "theory": str(target)}
    present(found.tables, [], found.notes, as_json=as_json, title=title, lines=[page], **where)


def export(
    folder: options.RunArgument,
    targets: Annotated[
        list[Path],
        options.argument(
            "Files to write: .nc, .zarr, .csv, .parquet, .xdmf, .vtu, .vtk or .html.",
            metavar="TARGET...",
        ),
    ],
    at: Annotated[
        str | None,
        options.option(
            "Time of the fields in .vtu and .vtk: 3600, '1 h' or a date. Default: the last."
        ),
    ] = None,
    force: options.ForceOption = False,
) -> None:
    """Convert a run, also an unfinished one, to formats of other programs.

    Example:  livepde export runs/mycase mycase.nc mycase.csv mycase.html
    ParaView: livepde export runs/mycase mycase.xdmf
    """
    from livepde.runs.exported import FORMATS, check_target, need, refuse_file
    from livepde.runs.exported import export as write

    opened = runs.open(folder)
    for target in targets:  # all targets are checked before the first is written
        check_target(target, [*FORMATS, REPORT])
        if target.suffix.lower() == REPORT:
            need(target, ["plotly", "jinja2"], "dashboard")
        refuse_file(target, force)
    moment = None if at is None else _moment(at, opened.dataset)
    for target in targets:
        if target.suffix.lower() == REPORT:
            from livepde.dashboard.html_report import write_report

            write_report(opened, target, force=force)
        else:
            write(opened, target, at=moment, force=force)
        terminal().print(escape(f"Written: {target}"))


def _moment(text: str, data: Dataset) -> float:
    """Return the time in the option --at, a number, quantity or date, in the run's unit."""
    unit = str(data["time"].attrs.get("units", ""))
    with suppress(ValueError):
        return float(text)
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        return convert(text, unit, "--at")
    dates = dated(data)
    if dates is None:
        raise ConfigurationError(f"--at: got the date {text}, but the run's times have no date.")
    if date.tzinfo is not None:
        date = date.astimezone(UTC).replace(tzinfo=None)
    origin, second = dates
    return (date - origin).total_seconds() / second


class Standard(StrEnum):
    """Versions of FMI."""

    two = "2"
    three = "3"


def fmu(
    source: Annotated[
        str,
        options.argument(
            "The case file (TOML), or file.py:function or module:function that returns an "
            "Identifier.",
            metavar="CASE",
        ),
    ],
    out: Annotated[
        Path | None, options.option("File to write. Default: named after the case.")
    ] = None,
    fmi: Annotated[Standard, typer.Option(help="Version of FMI: 2 or 3.")] = Standard.two,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
    allow_code: options.CodeOption = False,
    settings: options.SetOption = None,
) -> None:
    """Export a case as a co-simulation unit (FMU) for Simulink, Modelica tools and others.

    Its inputs are the channels of the case. Its outputs are the estimates with their standard
    deviations, the model's value at each sensor, and a status. It requires an installed livepde.

    Example:  livepde fmu mycase/case.toml --out rod.fmu
    """
    from livepde.exchange.fmu_export import is_code, recipe_of, write_unit

    code = is_code(source)
    if code and settings:
        raise ConfigurationError(f"--set requires a case file, but {source} is code.")
    recipe = recipe_of(source if code else options.load_case(Path(source), allow_code, settings))
    process = recipe.process
    path = write_unit(recipe, out, fmi=2 if fmi is Standard.two else 3, force=force)
    inside = f"{len(process.inputs)} inputs, {len(process.outputs()) + 1} outputs"
    lines = [escape(f"Written: {path} ({inside})")]
    present([], [], process.notes, as_json=as_json, lines=lines, unit=str(path))


def watch(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run directory, or a folder of runs.")
    ],
    address: Annotated[
        str,
        options.option(
            "Address to listen on. Default: port 8050, reachable from this machine only.",
            metavar="HOST:PORT",
        ),
    ] = "",
    token: Annotated[
        str,
        options.option(
            "Token that clients must send. If the address is reachable from other machines, a "
            "token is required, and generated if none is given.",
            envvar="LIVEPDE_TOKEN",
        ),
    ] = "",
    attached: Annotated[
        bool, typer.Option("--attached", help="End with standard input.", hidden=True)
    ] = False,
) -> None:
    """Show a run in a browser, during the run and afterwards. Ctrl-C ends the server.

    For a folder of runs, such as a fleet's, it shows a table with a link to each run.

    Example:    livepde watch runs/mycase
    Elsewhere:  livepde watch runs/mycase --address 0.0.0.0:8050
    """
    from livepde.dashboard import serve

    if not runs.run_names(folder) or (folder / runs.RECORD).exists():
        runs.open(folder)  # reports a folder that is not a run first
    server = serve(folder, Address.read(address, PORT, token))
    try:
        if attached:  # the parent process may be killed at any time

            def end_with_input() -> None:
                sys.stdin.read()
                server.close()

            Thread(target=end_with_input, daemon=True).start()
        terminal().print(f"Open {escape(server.shown)}  (Ctrl-C ends it)")
        server.wait()
    except KeyboardInterrupt:
        server.close()
