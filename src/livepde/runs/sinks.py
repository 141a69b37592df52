"""Where estimates go beside the journal."""

from __future__ import annotations

import json
from typing import TextIO

from livepde.result import Estimate

__all__ = ["JsonLinesSink"]


class JsonLinesSink:
    """Each estimate as a line of JSON."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def put(self, estimate: Estimate) -> None:
        """Write one estimate."""
        print(json.dumps(estimate.to_dict()), file=self._stream, flush=True)

    def close(self) -> None:
        """The stream belongs to who opened it."""
