"""Standard streams of a live run: its log, and its estimates as lines of JSON."""

from __future__ import annotations

import json
import logging
import os
import time
from contextlib import suppress
from typing import TextIO

from livepde.errors import RunError, optional
from livepde.library_messages import OneLine
from livepde.result import Estimate
from livepde.runs.live_loop import Sink


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
        with optional("service", "A log in JSON needs python-json-logger", RunError):
            from pythonjsonlogger.json import JsonFormatter
        names = "%(asctime)s %(levelname)s %(name)s %(message)s"
        renamed = {"asctime": "time", "levelname": "level", "name": "logger"}
        lines = JsonFormatter(names, datefmt="%Y-%m-%dT%H:%M:%SZ", rename_fields=renamed)
        lines.converter = time.gmtime
        handler.setFormatter(lines)
    handler.addFilter(OneLine())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("livepde").setLevel(level)
    # asyncua logs each lost connection with a traceback; livepde.opcua logs it in one line.
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)


class JsonLinesSink(Sink):
    """Each estimate as a line of JSON, as `Estimate.to_dict` has it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def put(self, estimate: Estimate) -> None:
        """Write one estimate.

        Raises
        ------
        OSError
            Nobody reads the stream any more, or its disk is full.
        """
        line = json.dumps(estimate.to_dict(), allow_nan=False)
        try:
            print(line, file=self._stream, flush=True)
        except OSError:
            self._abandon()
            raise

    def _abandon(self) -> None:
        """Redirect the stream to the null device: flushing its buffer at exit would fail again."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        with suppress(OSError):
            os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
