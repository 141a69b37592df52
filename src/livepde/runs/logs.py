"""Logs of a live run: as text, or as lines of JSON for those who collect them."""

from __future__ import annotations

import logging
import time

from livepde.errors import RunError

__all__ = ["configure"]


def configure(kind: str = "text", level: int = logging.INFO) -> None:
    """Write what livepde says to standard error; of other libraries only warnings.

    The loggers are livepde.run, livepde.mqtt and livepde.opcua. An event of the run has the fields
    kind, channel and t in JSON.

    Parameters
    ----------
    kind
        "text", or "json": one object for each line, with the time in UTC.
    level
        From which level on.

    Raises
    ------
    RunError
        What writes JSON is not installed.
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
    # It tells of each lost connection with a traceback; livepde.opcua says so in one line.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
