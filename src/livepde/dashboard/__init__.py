"""The live page of a run in a browser, during the run and afterwards.

`serve` starts it; `figures` draws datasets, also for reports.
"""

from __future__ import annotations

from pathlib import Path

from livepde.errors import ConfigurationError
from livepde.runs.web import Address, Server

__all__ = ["check_installed", "serve"]


def check_installed() -> None:
    """Raise `ConfigurationError` if the page cannot be shown for want of a package."""
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
        The run directory, finished or going on; or a folder of such, a fleet's say, of which the
        page is a table with a link to the page of each run.
    address
        Where to listen.

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
