"""Export of an identifier as a co-simulation unit (FMU), with the exporter's binaries."""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any, Literal

from livepde.cases import Case, load
from livepde.errors import ConfigurationError, RunError, optional
from livepde.exchange.recipe import Recipe, recipe_of
from livepde.exchange.slave import FOLDER
from livepde.runs.exported import refuse_file

EXPORTERS = {2: "pythonfmu", 3: "pythonfmu3"}
ABLE = (
    "canHandleVariableCommunicationStepSize",
    "canGetAndSetFMUstate",  # FMI 2.0
    "canSerializeFMUstate",
    "canGetAndSetFMUState",  # FMI 3.0
    "canSerializeFMUState",
)
SCRIPT = '''\
"""An identifier of livepde as a co-simulation unit."""

from {exporter} import Fmi{fmi}Slave

try:
    from livepde.exchange.slave import IdentifierSlave
except ImportError as error:
    raise ImportError(
        "this unit needs livepde in the Python that runs it: pip install 'livepde' there, and let "
        f"PYTHONPATH hold where it is installed ({{error}})"
    ) from error


class {name}(IdentifierSlave, Fmi{fmi}Slave):
    """What the unit does is in livepde.exchange.slave."""

    fmi = {fmi}
'''
# For each instance pythonfmu 0.7 runs the script again and then releases a reference to the
# module's variables that it does not own; after some instances they would be freed.
KEPT = """

import ctypes

ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))
"""


def export_fmu(
    source: Case | str | os.PathLike[str],
    target: str | os.PathLike[str] | None = None,
    *,
    fmi: Literal[2, 3] = 2,
    allow_code: bool = False,
    force: bool = False,
) -> Path:
    """Write an identifier as a co-simulation unit for Simulink, Modelica tools, FMPy and others.

    Parameters
    ----------
    source
        A case, a case file, or a user's 'file.py:function' or 'module:function' that returns an
        `Identifier` before its first sample.
    target
        Path of the unit; default the name of the case in the current folder.
    fmi
        Version of the standard: 2 for FMI 2.0, 3 for FMI 3.0.
    allow_code
        True: the case file may refer to user code, which becomes part of the unit.
    force
        True: overwrite an existing file.

    Returns
    -------
    Path
        Path of the unit.

    Raises
    ------
    ConfigurationError
        The source is invalid, or the exporter is not installed.
    RunError
        The file already exists, or cannot be written.
    """
    if not isinstance(source, Case):
        text = os.fspath(source)
        source = text if is_code(text) else load(text, allow_code=allow_code)
    return write_unit(recipe_of(source), target, fmi=fmi, force=force)


def is_code(source: str) -> bool:
    """Return True if a text names a function, False if a case file."""
    return ":" in source and not source.endswith(".toml")


def write_unit(
    recipe: Recipe,
    target: str | os.PathLike[str] | None,
    *,
    fmi: Literal[2, 3],
    force: bool,
) -> Path:
    """Write a unit, and return its path; for parameters see `export_fmu`."""
    if fmi not in EXPORTERS:
        raise ConfigurationError(f"fmi: got {fmi!r}; expected 2 (FMI 2.0) or 3 (FMI 3.0).")
    with optional("fmu", f"A unit for FMI {fmi}.0 needs {EXPORTERS[fmi]}"):
        builder = importlib.import_module(f"{EXPORTERS[fmi]}.builder").FmuBuilder
    name = re.sub(r"\W", "_", recipe.process.name, flags=re.ASCII)
    path = Path(target) if target is not None else Path(f"{name}.fmu")
    if path.suffix != ".fmu":
        raise ConfigurationError(f"{path}: the name of a unit ends with .fmu.")
    refuse_file(path, force)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="livepde_") as folder:
            shutil.move(_built(builder, recipe, name, fmi, Path(folder)), path)
    except OSError as error:
        raise RunError(f"Cannot write {path}: {error.strerror or error}.") from error
    return path


def _built(builder: Any, recipe: Recipe, name: str, fmi: int, folder: Path) -> Path:
    """Return the path of the unit built in a folder."""
    # The name becomes that of a class of the script.
    if not name[0].isalpha():
        name = f"unit_{name}"
    script = SCRIPT.format(exporter=EXPORTERS[fmi], fmi=fmi, name=name)
    script += KEPT if fmi == 2 else ""
    inside = folder / FOLDER
    inside.mkdir()
    content = hashlib.sha256(script.encode())
    for file, text in sorted(recipe.files.items()):
        (inside / file).write_bytes(text)
        content.update(file.encode() + text)
    # A program that runs several units imports all of their scripts, so their names must differ.
    module = f"livepde_unit_{content.hexdigest()[:16]}"
    (folder / f"{module}.py").write_text(script, encoding="utf-8")
    path = list(sys.path)
    try:
        found: Path = builder.build_FMU(
            folder / f"{module}.py",
            dest=folder / "built",
            project_files=[inside],
            **dict.fromkeys(ABLE, True),
        )
    finally:  # the builder leaves behind where it looked
        sys.path[:] = path
        sys.modules.pop(module, None)
    return found
