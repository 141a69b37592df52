"""Export of a run, or of the identifier of a case, for other programs."""

from __future__ import annotations

from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from livepde.cli.options import (
    CodeOption,
    ForceOption,
    JsonOption,
    RunArgument,
    SetOption,
    argument,
    load_case,
    option,
)
from livepde.cli.printing import present, terminal
from livepde.errors import ConfigurationError

if TYPE_CHECKING:
    from xarray import Dataset

REPORT = ".html"


def export(
    folder: RunArgument,
    targets: Annotated[
        list[Path],
        argument(
            "Files to write: .nc, .zarr, .csv, .parquet, .xdmf, .vtu, .vtk or .html.",
            metavar="TARGET...",
        ),
    ],
    at: Annotated[
        str | None,
        option("Time of the fields in .vtu and .vtk: 3600, '1 h' or a date. Default: the last."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Convert a run, also an unfinished one, to formats of other programs.

    Example:  livepde export runs/mycase mycase.nc mycase.csv mycase.html
    ParaView: livepde export runs/mycase mycase.xdmf
    """
    from livepde import runs
    from livepde.runs.exported import FORMATS, NEEDS, need, refuse_file
    from livepde.runs.exported import export as write

    opened = runs.open(folder)
    known = [*FORMATS, REPORT]
    for target in targets:  # all of them, before one is written
        ending = target.suffix.lower()
        if ending not in known:
            raise ConfigurationError(
                f"{target}: there is no format '{target.suffix}'; expected one of "
                f"{', '.join(known)}."
            )
        if ending == REPORT:
            need(target, ["plotly", "jinja2"], "dashboard")
        need(target, NEEDS.get(ending, []))
        refuse_file(target, force)
    moment = None if at is None else _moment(at, opened.dataset)
    for target in targets:
        if target.suffix.lower() == REPORT:
            from livepde.dashboard.html_report import write_report

            write_report(opened, target, force=force)
        else:
            write(opened, target, at=moment, force=force)
        terminal().print(escape(f"Written: {target}"), soft_wrap=True)


def _moment(text: str, data: Dataset) -> float:
    """Return a time of the command line in the run's unit."""
    from livepde.dates import dated
    from livepde.units import convert

    unit = str(data["time"].attrs.get("units", ""))
    try:
        return float(text)
    except ValueError:
        pass
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
    """Versions of the interface."""

    two = "2"
    three = "3"


def fmu(
    source: Annotated[
        str,
        argument(
            "The case file (TOML), or file.py:function or module:function that returns an "
            "Identifier.",
            metavar="CASE",
        ),
    ],
    out: Annotated[
        Path | None,
        option("File to write. Default: named after the case."),
    ] = None,
    fmi: Annotated[Standard, typer.Option(help="Version of FMI: 2 or 3.")] = (Standard.two),
    force: ForceOption = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
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
    recipe = recipe_of(source if code else load_case(Path(source), allow_code, settings))
    process = recipe.process
    path = write_unit(recipe, out, fmi=2 if fmi is Standard.two else 3, force=force)
    inside = f"{len(process.inputs)} inputs, {len(process.outputs()) + 1} outputs"
    lines = [escape(f"Written: {path} ({inside})")]
    present([], [], process.notes, as_json=as_json, lines=lines, unit=str(path))
