"""Code of the user that a case names: 'module:name' or 'file.py:name'."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from livepde.cases.read import beside, did_you_mean
from livepde.errors import CaseError, LivepdeError
from livepde.streams.table import no_file

__all__ = ["check_options", "load_code"]


def load_code(name: str, folder: Path, where: str, expected: str, allowed: bool) -> Any:
    """Import the object that a case names, from a module or from a file beside the case.

    Parameters
    ----------
    name
        'module:name', or 'file.py:name' relative to `folder`.
    where
        File and key, for the message.
    expected
        Description of the expected function, for the message.
    allowed
        Whether the user passed --allow-code.

    Raises
    ------
    CaseError
        Not allowed, not found, or it fails while it is loaded.
    """
    source, colon, attribute = name.rpartition(":")
    if not colon:
        raise CaseError(f"{where}: got '{name}'; expected 'file.py:function'.")
    if not allowed:
        raise CaseError(
            f"{where}: '{name}' is code that livepde would have to run; read it, and if "
            "you trust it, add --allow-code to the command."
        )
    found = getattr(_module(source, folder, where), attribute, None)
    if found is None or not (callable(found) or hasattr(found, "build")):
        raise CaseError(f"{where}: '{source}' has no function '{attribute}'; expected {expected}.")
    return found


def check_options(function: Any, given: Iterable[str], where: str) -> None:
    """Refuse an option that a function does not take; the first argument is no option."""
    _, *known = inspect.signature(function).parameters.values()
    if any(item.kind is inspect.Parameter.VAR_KEYWORD for item in known):
        return
    names = [item.name for item in known]
    for name in given:
        if name not in names:
            raise CaseError(
                f"{where}: '{function.__name__}' has no option '{name}'; "
                f"{did_you_mean(name, names)}"
            )


def _no_code(path: Path, source: str, folder: Path) -> str:
    """Return a sentence on a missing code file, with a hint if the working directory has it."""
    if Path(source).is_file():
        there = beside(Path(source), folder).as_posix()
        return f"there is no file '{path}', beside the case; did you mean '{there}'?"
    return str(no_file(path))


def _module(source: str, folder: Path, where: str) -> Any:
    try:
        if not source.endswith(".py"):
            return importlib.import_module(source)
        path = folder / source
        if not path.is_file():
            raise CaseError(f"{where}: {_no_code(path, source, folder)}")
        # A file beside the case belongs to no package, so it is loaded by its path.
        loader = importlib.util.spec_from_file_location(path.stem, path)
        if loader is None or loader.loader is None:
            raise ImportError(f"{path} is not a Python file")
        module = importlib.util.module_from_spec(loader)
        loader.loader.exec_module(module)
    except LivepdeError:
        raise
    except Exception as error:
        raise CaseError(
            f"{where}: loading '{source}' failed with {type(error).__name__}: {error}."
        ) from error
    return module
