"""Show a run in a browser."""

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

PORT = 8050


def watch(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="A run directory, or a folder of runs.")
    ],
    address: Annotated[
        str,
        option(
            "Address to listen on. Default: port 8050, reachable from this machine only.",
            metavar="HOST:PORT",
        ),
    ] = "",
    token: Annotated[
        str,
        option(
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
    from livepde import runs
    from livepde.dashboard import serve
    from livepde.runs.web import Address

    if not runs.run_names(folder) or (folder / runs.RECORD).exists():
        runs.open(folder)  # a folder that is not a run is reported before all else
    server = serve(folder, Address.read(address, PORT, token))
    try:
        if attached:  # to a run that may be killed at any time
            Thread(target=_end_with_input, args=(server,), daemon=True).start()
        terminal().print(f"Open {escape(server.shown)}  (Ctrl-C ends it)", soft_wrap=True)
        server.wait()
    except KeyboardInterrupt:
        server.close()


def _end_with_input(server: Server) -> None:
    sys.stdin.read()
    server.close()
