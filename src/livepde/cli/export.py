"""Write a run in the formats of other programs."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from livepde.cli.printing import terminal
from livepde.errors import ConfigurationError

if TYPE_CHECKING:
    from xarray import Dataset

__all__ = ["export"]

REPORT = ".html"


def export(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory.")],
    targets: Annotated[
        list[Path],
        typer.Argument(
            metavar="TARGET...",
            help="Files to write: .nc, .zarr, .csv, .xdmf, .vtu, .vtk or .html.",
            show_default=False,
        ),
    ],
    at: Annotated[
        str | None,
        typer.Option(
            help="Of .vtu and .vtk: the time of the fields, as 3600, '1 h' or a date. "
            "Default: the last.",
            show_default=False,
        ),
    ] = None,
    salvage: Annotated[
        bool,
        typer.Option(
            "--salvage",
            help="Of a damaged journal: write the estimates that are whole, and say which are not.",
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write over what is there.")] = False,
) -> None:
    """Write a run, also one that still goes on, in formats that other programs open.

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
            if salvage:
                raise ConfigurationError(
                    f"{target}: a page is not salvaged: take the numbers, as .nc or .csv."
                )
            need(target, ["plotly", "jinja2"], "dashboard")
        need(target, NEEDS.get(ending, []))
        refuse_file(target, force)
    told = opened.salvage() if salvage else []
    moment = None if at is None else _moment(at, opened.dataset)
    for target in targets:
        if target.suffix.lower() == REPORT:
            from livepde.dashboard.html_report import write_report

            write_report(opened, target, force=force)
        else:
            write(opened, target, at=moment, force=force)
        terminal().print(escape(f"Written: {target}"), soft_wrap=True)
    for sentence in told:
        terminal().print(escape(sentence), soft_wrap=True)


def _moment(text: str, data: Dataset) -> float:
    """Return a time of the command line in the run's unit."""
    from livepde.cases.units import convert
    from livepde.dates import dated

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
