"""Export of a case, or of a function, as a co-simulation unit (FMU)."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from livepde.cases import Case, load
from livepde.cases.case_content import load_code
from livepde.errors import ConfigurationError, RunError, optional
from livepde.exchange.unit_process import DataTimes, UnitProcess, of_case, of_code
from livepde.runs.exported import refuse_file
from livepde.streams import DataTable

# Name of the folder within the resources of the unit.
FOLDER = "process"
CASE, RECIPE = "case.toml", "recipe.json"
FUNCTION = "() -> livepde.Identifier"
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
    """Its behaviour is in livepde.exchange.slave."""

    fmi = {fmi}
'''
# For each instance pythonfmu 0.7 runs the script again and then releases a reference to the
# module's variables that it does not own; after some instances they would be freed.
KEPT = """

import ctypes

ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))
"""


@dataclass(frozen=True, eq=False)
class Recipe:
    """Instructions and files to rebuild a process elsewhere."""

    process: UnitProcess  # process of the unit, built during the export
    files: Mapping[str, bytes]  # mapping from file name to content


def recipe_of(source: Case | str) -> Recipe:
    """Return the recipe of a case, or of a function 'file.py:function' or 'module:function'.

    The files of a case, its mesh and user code, are included. Modules are imported where the unit
    runs.

    Raises `ConfigurationError`: the function cannot be loaded, or does not build an identifier.
    """
    files: dict[str, bytes] = {}
    inside: dict[str, Any]
    if isinstance(source, str):
        function = load_code(source, Path(), source, FUNCTION, allowed=True)
        process, inside = of_code(source, function), {"function": _moved(source, Path(), files)}
    else:
        process, inside = _of_case(source, files)
    return Recipe(process, {**files, RECIPE: json.dumps(inside, indent=1).encode()})


def _of_case(case: Case, files: dict[str, bytes]) -> tuple[UnitProcess, dict[str, Any]]:
    """Return process and recipe of a case, and add its files to `files`."""
    spec, folder = case.spec, case.path.parent
    files[CASE] = case.text.encode()
    settings = {}
    if ":" in spec.equation:
        settings["equation"] = _moved(spec.equation, folder, files)
    if spec.data.reader is not None:
        settings["data.reader"] = _moved(spec.data.reader, folder, files)
    if spec.mesh.file is not None:
        settings["mesh.file"] = _taken(folder / spec.mesh.file, files)
    # Times of the data become the default experiment of the unit.
    origin, experiment = _dated(case)
    return replace(of_case(case, origin), experiment=experiment), {
        "name": case.name,
        "settings": settings,
        "allow_code": any(":" in value for value in settings.values()),
        "origin": None if origin is None else origin.isoformat(),
        "experiment": None if experiment is None else asdict(experiment),
    }


def _dated(case: Case) -> tuple[datetime | None, DataTimes | None]:
    """Return the date of t = 0, and the times of the case's data, if it has any."""
    data = case.spec.data
    if case.live or (data.file is None and data.reader is None):
        return None, None
    prepared = case.read()
    case.begin(prepared.first, prepared.origin)  # raises an error if data and case do not fit
    if not isinstance(prepared.stream, DataTable):
        return prepared.origin, None
    t = prepared.stream.t / case.clock.second
    step = float(np.median(np.diff(t))) if len(t) > 1 else None
    return prepared.origin, DataTimes(float(t[0]), float(t[-1]), step)


def _moved(name: str, folder: Path, files: dict[str, bytes]) -> str:
    """Return the name of user code within the unit, and add its file to `files`."""
    # The unit contains files; modules must be installed where the unit runs.
    source, _, attribute = name.rpartition(":")
    return f"{_taken(folder / source, files)}:{attribute}" if source.endswith(".py") else name


def _taken(path: Path, files: dict[str, bytes]) -> str:
    content = path.read_bytes()
    if files.setdefault(path.name, content) != content:
        raise ConfigurationError(f"{path}: the unit holds another file of that name: rename it.")
    return path.name


def opened(folder: Path) -> UnitProcess:
    """Return the process of a unit from the folder of its files."""
    recipe = json.loads((folder / RECIPE).read_text(encoding="utf-8"))
    if "function" in recipe:
        name = recipe["function"]
        return of_code(name, load_code(name, folder, name, FUNCTION, allowed=True))
    case = load(folder / CASE, allow_code=recipe["allow_code"], settings=recipe["settings"])
    origin = None if recipe["origin"] is None else datetime.fromisoformat(recipe["origin"])
    given = recipe["experiment"]
    experiment = None if given is None else DataTimes(**given)
    return replace(of_case(case, origin), name=recipe["name"], experiment=experiment)


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
    recipe: Recipe, target: str | os.PathLike[str] | None, *, fmi: Literal[2, 3], force: bool
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
    # The name becomes a class name in the script.
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
    finally:  # the builder does not restore the search path
        sys.path[:] = path
        sys.modules.pop(module, None)
    return found
