"""Equation of a case: a ready-made one, or the user's own code if that is allowed."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from livepde.cases.read import beside, did_you_mean
from livepde.cases.schema import CaseSpec
from livepde.errors import CaseError, LivepdeError
from livepde.fem import linear
from livepde.model import Model
from livepde.models import EQUATIONS, Equation, Fluxes, Option, Variable
from livepde.streams.table import no_file


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
                f"{did_you_mean(name, EQUATIONS)} For your own equation, use 'file.py:function'."
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
        with own_code(f"{where}: equation: {name}(mesh, unknowns, dirichlet, **options)"):
            model = function(mesh, unknowns, dirichlet, **options)
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


@contextmanager
def own_code(what: str) -> Iterator[None]:
    """Raise what fails in code of the user as a `CaseError`; errors of livepde stay as they are."""
    try:
        yield
    except LivepdeError:
        raise
    except Exception as error:
        raise CaseError(f"{what} failed with {type(error).__name__}: {error}.") from error


def load_code(name: str, folder: Path, where: str, expected: str, allowed: bool) -> Any:
    """Import the object that a case names, from a module or a file in the folder of the case.

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
    """Refuse an option that a function does not have; the first argument is not an option."""
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
        return f"there is no file '{path}', next to the case; did you mean '{there}'?"
    return str(no_file(path))


def _module(source: str, folder: Path, where: str) -> Any:
    with own_code(f"{where}: loading '{source}'"):
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
        return module
