"""What names are near one that is not there: columns of data, and files."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from livepde.errors import DataError, SampleError

__all__ = ["check_columns", "hint", "no_file"]

MOST = 12  # names that are listed


def check_columns(where: str, needed: Iterable[str], known: list[str]) -> None:
    """Raise `SampleError` with a hint if a column is not there."""
    for name in needed:
        if name not in known:
            raise SampleError(f"{where}: there is no column '{name}'{hint(name, known)}")


def hint(name: str, known: list[str]) -> str:
    """Return the end of a sentence: the name that is nearest, or what there is."""
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean '{close[0]}'?"
    if not known:
        return "."
    return f"; there are {', '.join(known[:MOST])}{', ...' if len(known) > MOST else ''}."


def no_file(path: Path) -> DataError:
    """Return an error about a file that is not there, with those of its kind that are."""
    if not path.parent.is_dir():
        return DataError(f"there is no file '{path}': there is no folder '{path.parent}'.")
    below = sorted(path.parent.glob(f"*/{path.name}"))
    if below:
        return DataError(f"there is no file '{path}'; did you mean '{below[0]}'?")
    known = sorted(item.name for item in path.parent.glob(f"*{path.suffix}") if item.is_file())
    return DataError(f"there is no file '{path}'{hint(path.name, known)}")
