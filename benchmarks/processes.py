"""Environment of processes that are timed as a user starts them."""

from __future__ import annotations

import os
from pathlib import Path

UNUSUAL = ("PYTHONDONTWRITEBYTECODE", "EAGER_IMPORT")  # what some machines set, and users do not


def usual_environment(cache: Path | str) -> dict[str, str]:
    """Return the environment of a process that keeps its byte code, in a folder."""
    given = {name: value for name, value in os.environ.items() if name not in UNUSUAL}
    return {**given, "PYTHONPYCACHEPREFIX": str(cache)}
