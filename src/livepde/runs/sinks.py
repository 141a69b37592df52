"""Destinations of estimates beside the journal."""

from __future__ import annotations

import json
import os
from contextlib import suppress
from typing import TextIO

from livepde.result import Estimate

__all__ = ["JsonLinesSink"]


class JsonLinesSink:
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

    def close(self) -> None:
        """Do nothing: the caller closes the stream."""
