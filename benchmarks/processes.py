"""Environment of timed processes, as on the machine of a user, and their memory."""

from __future__ import annotations

import math
import os
from pathlib import Path

UNUSUAL = ("PYTHONDONTWRITEBYTECODE", "EAGER_IMPORT")  # set on some test machines, but not by users


def usual_environment(cache: Path | str) -> dict[str, str]:
    """Return the environment of a process that caches its bytecode in a folder."""
    given = {name: value for name, value in os.environ.items() if name not in UNUSUAL}
    return {**given, "PYTHONPYCACHEPREFIX": str(cache)}


def peak_memory(*, reset: bool = False) -> float:
    """Return the peak memory of this process in bytes, NaN if unknown; `reset`: restart the peak.

    Only Linux states it.
    """
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return math.nan
    return next(
        (1024.0 * int(row.split()[1]) for row in lines if row.startswith("VmHWM")), math.nan
    )
