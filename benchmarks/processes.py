"""Environment of timed processes, as on the machine of a user."""

from __future__ import annotations

import os
from pathlib import Path

UNUSUAL = ("PYTHONDONTWRITEBYTECODE", "EAGER_IMPORT")  # set on some test machines, but not by users


def usual_environment(cache: Path | str) -> dict[str, str]:
    """Return the environment of a process that caches its bytecode in a folder."""
    given = {name: value for name, value in os.environ.items() if name not in UNUSUAL}
    return {**given, "PYTHONPYCACHEPREFIX": str(cache)}
