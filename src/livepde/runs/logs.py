"""Logs of a live run: as text, or as lines of JSON for those who collect them."""

from __future__ import annotations

import logging
import time

from livepde.errors import RunError

__all__ = ["configure"]


def configure(kind: str = "text", level: int = logging.INFO) -> None:
    """Configure logging to standard error: messages of livepde, and warnings of other libraries.

    The loggers are livepde.run, livepde.mqtt and livepde.opcua. An event of the run has the fields
    kind, channel and t in JSON.

    Parameters
    ----------
    kind
        "text", or "json": one object for each line, with the time in UTC.
    level
        Lowest level of the messages of livepde.

    Raises
    ------
    RunError
        The package python-json-logger is not installed.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    if kind == "json":
        try:
            from pythonjsonlogger.json import JsonFormatter
        except ImportError:
            raise RunError(
                "A log in JSON needs python-json-logger: pip install 'livepde[service]'."
            ) from None
        names = "%(asctime)s %(levelname)s %(name)s %(message)s"
        renamed = {"asctime": "time", "levelname": "level", "name": "logger"}
        lines = JsonFormatter(names, datefmt="%Y-%m-%dT%H:%M:%SZ", rename_fields=renamed)
        lines.converter = time.gmtime
        handler.setFormatter(lines)
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("livepde").setLevel(level)
    # asyncua logs each lost connection with a traceback; livepde.opcua logs it in one line.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
