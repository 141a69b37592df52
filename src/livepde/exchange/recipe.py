"""Recipe of a co-simulation unit: a case with its files, or the name of a function."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from livepde.cases import Case, load
from livepde.cases.case_content import load_code
from livepde.errors import ConfigurationError
from livepde.exchange.unit_process import DataTimes, UnitProcess, of_case, of_code
from livepde.streams import DataTable

CASE, RECIPE = "case.toml", "recipe.json"
FUNCTION = "() -> livepde.Identifier"


@dataclass(frozen=True, eq=False)
class Recipe:
    """Instructions and files to rebuild a process elsewhere.

    Attributes
    ----------
    process
        UnitProcess as built here.
    files
        Mapping from file name to content.
    """

    process: UnitProcess
    files: Mapping[str, bytes]


def recipe_of(source: Case | str) -> Recipe:
    """Return the recipe of a case, or of a function 'file.py:function' or 'module:function'.

    The files of a case, its mesh and user code, are included. Modules are imported where the unit
    runs.

    Raises
    ------
    ConfigurationError
        The function cannot be loaded, or does not build an identifier.
    """
    return _of_function(source) if isinstance(source, str) else _of_case(source)


def _of_function(name: str) -> Recipe:
    function = load_code(name, Path(), name, FUNCTION, allowed=True)
    files: dict[str, bytes] = {}
    process = of_code(name, function)
    inside = {"function": _moved(name, Path(), files)}
    return Recipe(process, {**files, RECIPE: _json(inside)})


def _of_case(case: Case) -> Recipe:
    spec, folder = case.spec, case.path.parent
    files = {CASE: case.text.encode()}
    settings = {}
    if ":" in spec.equation:
        settings["equation"] = _moved(spec.equation, folder, files)
    if spec.data.reader is not None:
        settings["data.reader"] = _moved(spec.data.reader, folder, files)
    if spec.mesh.file is not None:
        settings["mesh.file"] = _taken(folder / spec.mesh.file, files)
    # Times of the data become the default experiment of the unit.
    origin, experiment = _dated(case)
    inside = {
        "name": case.name,
        "settings": settings,
        "allow_code": any(":" in value for value in settings.values()),
        "origin": None if origin is None else origin.isoformat(),
        "experiment": None if experiment is None else asdict(experiment),
    }
    process = replace(of_case(case, origin), experiment=experiment)
    return Recipe(process, {**files, RECIPE: _json(inside)})


def _dated(case: Case) -> tuple[datetime | None, DataTimes | None]:
    """Return the date of t = 0, and the times of the case's data, if it has any."""
    data = case.spec.data
    if case.live or (data.file is None and data.reader is None):
        return None, None
    prepared = case.read()
    case.begin(prepared.first, prepared.origin)  # what does not fit together raises here
    if not isinstance(prepared.stream, DataTable):
        return prepared.origin, None
    t = prepared.stream.t / case.clock.second
    step = float(np.median(np.diff(t))) if len(t) > 1 else None
    return prepared.origin, DataTimes(float(t[0]), float(t[-1]), step)


def _moved(name: str, folder: Path, files: dict[str, bytes]) -> str:
    """Return the name of user code within the unit, and add its file to `files`."""
    # A file comes with the unit; a module has to be installed where the unit runs.
    source, _, attribute = name.rpartition(":")
    return f"{_taken(folder / source, files)}:{attribute}" if source.endswith(".py") else name


def _taken(path: Path, files: dict[str, bytes]) -> str:
    content = path.read_bytes()
    if files.setdefault(path.name, content) != content:
        raise ConfigurationError(f"{path}: the unit holds another file of that name: rename it.")
    return path.name


def _json(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, indent=1).encode()


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
