"""Suggestions of similar names of columns and files."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from livepde.errors import DataError, SampleError

__all__ = ["check_columns", "hint", "is_data", "no_file"]

MOST = 12  # names that are listed
SHOWN = (".csv", ".txt", ".tsv", ".tab", ".dat", ".asc", ".log", ".jsonl", ".ndjson", ".parquet")


def check_columns(
    where: str, needed: Iterable[str], known: list[str], *, told: bool = True
) -> None:
    """Raise `SampleError` if a column is not there; with `told` the error names those there are."""
    for name in needed:
        if name not in known:
            ending = hint(name, known) if told else "."
            raise SampleError(f"{where}: there is no column '{name}'{ending}")


def is_data(path: Path) -> bool:
    """Return whether a file is data by its name: a case may name any other file as its data."""
    return path.suffix.lower() in SHOWN


def hint(name: str, known: list[str]) -> str:
    """Return the end of a sentence: the closest name, or all known names."""
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
