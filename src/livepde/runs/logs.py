"""Logs of a live run: as text, or as lines of JSON for those who collect them."""

from __future__ import annotations

import logging

__all__ = ["configure"]


def configure(kind: str = "text", level: int = logging.INFO) -> None:
    """Write what livepde says to standard error; of other libraries only warnings.

    Parameters
    ----------
    kind
        "text", or "json": one object for each line.
    level
        From which level on.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    if kind == "json":
        from pythonjsonlogger.json import JsonFormatter

        names = "%(asctime)s %(levelname)s %(name)s %(message)s"
        handler.setFormatter(JsonFormatter(names, rename_fields={"asctime": "time"}))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("livepde").setLevel(level)
