"""Which equation a case names: a ready-made one, or the user's own code if that is allowed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from livepde.cases.code import load_code
from livepde.cases.read import did_you_mean
from livepde.cases.schema import CaseSpec
from livepde.errors import CaseError, LivepdeError
from livepde.fem import linear
from livepde.model import Model
from livepde.models import EQUATIONS, Equation, Fluxes, Option, Variable

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
    expected = "(mesh, unknowns, dirichlet, **options) -> livepde.Model"
    found = load_code(name, folder, f"{where}: equation", expected, allow_code)
    return found if isinstance(found, Equation) else _plain(name, found, spec, where)


def _plain(name: str, function: Any, spec: CaseSpec, where: str) -> Equation:
    """Return a bare function as an equation whose units are those the case writes."""
    channels = spec.channels
    units = (item.unit for item in channels.values() if item.role == "sensor" and item.unit)
    inputs = {key: item.unit for key, item in channels.items() if item.role == "input"}
    return Equation(
        name=name,
        summary=(function.__doc__ or "").strip().split("\n")[0],
        formula=name,
        state=Variable(next(units, ""), "state"),
        unknowns=_variables({key: item.unit for key, item in spec.unknowns.items()}),
        inputs=_variables(inputs | dict.fromkeys(spec.inputs, "")),
        options={key: _option(value) for key, value in spec.options.items()},
        build=_checked(name, function, where),
        element=linear,
        fluxes=Fluxes("", "", ""),
    )


def _variables(units: Mapping[str, str | None]) -> dict[str, Variable]:
    return {name: Variable(unit or "", "") for name, unit in units.items()}


def _checked(name: str, function: Any, where: str) -> Callable[..., Model]:
    """Return a user's function, which has to return a model; its failures become `CaseError`."""

    def build(
        mesh: Any, unknowns: Mapping[str, Any], dirichlet: Mapping[str, Any], **options: Any
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

    return build


def _option(value: Any) -> Option:
    """Return the option of a bare function: text without a number in front is text."""
    if isinstance(value, str) and value[:1].strip("+-.0123456789 "):
        return Option("", "", value)
    return Option("", "", value if isinstance(value, bool) else None)
