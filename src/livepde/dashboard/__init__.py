"""The live page of a run in a browser, during the run and afterwards.

`serve` starts the page; `figures` draws datasets, including those of reports.
"""

from __future__ import annotations

from pathlib import Path

from livepde.errors import ConfigurationError
from livepde.runs.web import Address, Server

__all__ = ["check_installed", "serve"]


def check_installed() -> None:
    """Raise `ConfigurationError` if a package that the page requires is not installed."""
    import importlib.util

    if any(importlib.util.find_spec(name) is None for name in ("dash", "plotly", "waitress")):
        raise ConfigurationError(
            "The live page needs Dash, Plotly and waitress: pip install 'livepde[dashboard]'."
        )


def serve(path: Path, address: Address) -> Server:
    """Serve the page of a run from threads of this process, until the server is closed.

    Parameters
    ----------
    path
        Directory of a finished or unfinished run; or a folder of run directories, for example of a
        fleet, whose page is a table with a link to the page of each run.
    address
        Address of the server.

    Raises
    ------
    RunError
        There is no run, or the port is taken.
    ConfigurationError
        Dash is not installed.
    """
    check_installed()
    from livepde.dashboard.page import overview_page, page
    from livepde.runs import RECORD, run_names

    if not (path / RECORD).exists() and run_names(path):
        return Server(overview_page(path), address)
    return Server(page(path).server, address)
