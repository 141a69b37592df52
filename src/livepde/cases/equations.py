"""Which equation a case names: a ready-made one, or the user's own code if that is allowed."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from livepde.cases.read import did_you_mean
from livepde.cases.schema import CaseSpec
from livepde.errors import CaseError, LivepdeError
from livepde.fem import linear
from livepde.model import Model
from livepde.models import EQUATIONS, Equation, Option, Variable

__all__ = ["resolve"]


def resolve(spec: CaseSpec, folder: Path, where: str, allow_code: bool) -> Equation:
    """Return the equation of a case.

    A name with a colon is code of the user, 'module:name' or 'file.py:name' (relative to the case
    file). It is an `Equation`, or a function (mesh, unknowns, dirichlet, **options) -> `Model`;
    then all numbers of the case are taken as they are.
    """
    name = spec.equation
    if ":" not in name:
        if name not in EQUATIONS:
            raise CaseError(
                f"{where}: equation: there is no equation '{name}'; "
                f"{did_you_mean(name, EQUATIONS)} An own one is 'file.py:function'."
            )
        return EQUATIONS[name]
    if not allow_code:
        raise CaseError(
            f"{where}: equation: '{name}' is code that livepde would have to run; read it, and if "
            "you trust it, add --allow-code to the command."
        )
    source, _, attribute = name.rpartition(":")
    found = getattr(_module(source, folder, where), attribute, None)
    if isinstance(found, Equation):
        return found
    if not callable(found):
        raise CaseError(
            f"{where}: equation: '{source}' has no function '{attribute}'; expected "
            "(mesh, unknowns, dirichlet, **options) -> livepde.Model."
        )
    return _plain(name, found, spec, where)


def _module(source: str, folder: Path, where: str) -> Any:
    try:
        if not source.endswith(".py"):
            return importlib.import_module(source)
        path = folder / source
        loader = importlib.util.spec_from_file_location(path.stem, path)
        if loader is None or loader.loader is None:
            raise ImportError(f"{path} is not a Python file")
        module = importlib.util.module_from_spec(loader)
        loader.loader.exec_module(module)
    except LivepdeError:
        raise
    except Exception as error:
        raise CaseError(
            f"{where}: equation: loading '{source}' failed with {type(error).__name__}: {error}."
        ) from error
    return module


def _plain(name: str, function: Any, spec: CaseSpec, where: str) -> Equation:
    """Return a bare function as an equation whose units are those the case writes."""

    def build(
        mesh: Any, unknowns: Mapping[str, Any], dirichlet: Mapping[str, Any], **options: float
    ) -> Model:
        try:
            model = function(mesh, unknowns, dirichlet, **options)
        except LivepdeError:
            raise
        except Exception as error:
            raise CaseError(
                f"{where}: equation: {name}(mesh, unknowns, dirichlet, **options) failed with "
                f"{type(error).__name__}: {error}."
            ) from error
        if not isinstance(model, Model):
            raise CaseError(
                f"{where}: equation: {name} returned {type(model).__name__}, not a livepde.Model."
            )
        return model

    units = [item.unit for item in spec.channels.values() if item.role == "sensor" and item.unit]
    return Equation(
        name=name,
        summary=(function.__doc__ or "").strip().split("\n")[0],
        formula=name,
        state=Variable(units[0] if units else "", "state"),
        unknowns={key: Variable(item.unit or "", "") for key, item in spec.unknowns.items()},
        inputs={
            key: Variable(item.unit or "", "")
            for key, item in spec.channels.items()
            if item.role == "input"
        },
        options={key: Option("", "") for key in spec.options},
        build=build,
        element=linear,
    )
