"""Look at a run in a browser."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from livepde.cli.options import option
from livepde.cli.printing import terminal

if TYPE_CHECKING:
    from livepde.runs.web import Server

__all__ = ["watch"]

PORT = 8050


def watch(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run directory, or a folder of runs.")
    ],
    address: Annotated[
        str,
        option(
            "Where to listen. Default: port 8050 of this machine, reachable from it only.",
            metavar="HOST:PORT",
        ),
    ] = "",
    token: Annotated[
        str,
        option(
            "What a visitor has to know. Asked for on any address but this machine's own: "
            "then one is made if none is given.",
            envvar="LIVEPDE_TOKEN",
        ),
    ] = "",
    attached: Annotated[
        bool, typer.Option("--attached", help="End with standard input.", hidden=True)
    ] = False,
) -> None:
    """Show a run in a browser, while it goes on and afterwards; Ctrl-C ends it.

    Of a folder of runs, a fleet's say, it shows a table with a link to the page of each.

    Example:    livepde watch runs/mycase
    Elsewhere:  livepde watch runs/mycase --address 0.0.0.0:8050
    """
    from livepde import runs
    from livepde.dashboard import serve
    from livepde.runs.web import Address

    if not runs.run_names(folder) or (folder / runs.RECORD).exists():
        runs.open(folder)  # what is no run is said before all else
    server = serve(folder, Address.read(address, PORT, token))
    try:
        if attached:  # to a run that may be killed without a word
            Thread(target=_end_with_input, args=(server,), daemon=True).start()
        terminal().print(f"Open {escape(server.shown)}  (Ctrl-C ends it)", soft_wrap=True)
        server.wait()
    except KeyboardInterrupt:
        server.close()


def _end_with_input(server: Server) -> None:
    sys.stdin.read()
    server.close()
