"""The live page: what a run shows in a browser, while it goes on and afterwards.

`serve` starts it; `figures` draws datasets, also for reports.
"""

from __future__ import annotations

from pathlib import Path

from livepde.errors import ConfigurationError
from livepde.runs.web import Address, Server

__all__ = ["serve"]


def serve(path: Path, address: Address) -> Server:
    """Serve the page of a run from threads of this process, until the server is closed.

    Parameters
    ----------
    path
        The run directory, finished or going on.
    address
        Where to listen.

    Raises
    ------
    RunError
        There is no run, or the port is taken.
    ConfigurationError
        Dash is not installed.
    """
    try:
        import dash  # noqa: F401
    except ImportError:
        raise ConfigurationError(
            "The live page needs Dash and Plotly: pip install 'livepde[dashboard]'."
        ) from None
    from livepde.dashboard.page import page

    return Server(page(path).server, address)
