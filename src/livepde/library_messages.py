"""Warnings and logged exceptions of libraries, shortened to one line each on standard error."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import TextIO

LOG = logging.getLogger("livepde.libraries")


class OneLine(logging.Filter):
    """Filter that shortens an exception logged by a library to one line without traceback."""

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if error is not None and not record.name.startswith("livepde"):
            reason = str(error).partition("\n")[0]
            record.msg = f"{record.name}: {record.getMessage()}: {type(error).__name__}: {reason}"
            record.args, record.exc_info, record.exc_text = (), None, None
        return True


def tame_libraries() -> None:
    """Log warnings and exceptions of libraries in one line each, for a program."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(message)s"))
    handler.addFilter(OneLine())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    warnings.showwarning = _log_warning


def _log_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Log a warning with the name of its library, not with a path and a line of its source."""
    del lineno, file, line
    parts = Path(filename).with_suffix("").parts
    library = parts[-1]
    if "site-packages" in parts[:-1]:
        library = parts[parts.index("site-packages") + 1]
    text = " ".join(str(message).split())
    LOG.warning("%s warns: %s (%s)", library, text, category.__name__)
