"""Content of a case: specification, equation (predefined or user code), units, mesh, options."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from livepde import fem
from livepde.cases.read import beside, did_you_mean
from livepde.cases.schema import CaseSpec, ChannelSpec
from livepde.errors import CaseError, LivepdeError, SpaceError
from livepde.fem.measure import Measure, crossed
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import EQUATIONS, Equation, Fluxes, Option, Variable
from livepde.streams.table import no_file
from livepde.units import LARGEST, SMALLEST, UnitError, conversion, convert

CELLS = 2_000_000  # largest number of cells of a mesh without a mesh file


@dataclass(frozen=True, eq=False)
class CaseContent:
    """A case file's specification, checked key by key, and its equation."""

    path: Path
    spec: CaseSpec
    equation: Equation
    reader: Callable[..., Any] | None  # user function that reads the data, if any
    families: Mapping[str, str] = field(default_factory=dict, kw_only=True)  # sensor -> its family

    @property
    def name(self) -> str:
        """Name of the file without extension, or of its folder if the file is 'case.toml'."""
        path = self.path.absolute()
        return path.stem if path.stem != "case" else path.parent.name or "case"

    @property
    def with_intervals(self) -> tuple[str, ...]:
        """Settings that switch to a law with intervals; empty if the case already uses one."""
        law = self.spec.law
        if law.kind == "sensitivity":
            return ()
        own = sorted(law.model_fields_set - {"kind"})
        return ("law.kind=sensitivity", *(f"law.{key}=" for key in own))

    @property
    def constants(self) -> dict[str, float]:
        """Constant inputs of the equation: name -> value in the equation's unit."""
        known, given = self.equation.inputs, self.spec.inputs
        self.only(given, known, "inputs")
        for name in given:
            if name in self.spec.channels:
                raise self.error(f"inputs.{name}", f"there is a channel '{name}', too; keep one.")
        return {
            name: self.convert(value, known[name].unit, f"inputs.{name}")
            for name, value in given.items()
        }

    @cached_property
    def mesh(self) -> Any:
        """The mesh: read from a file, or an interval or rectangle given by nodes or cells."""
        spec, unit = self.spec.mesh, self.equation.length_unit
        if spec.file is not None:
            scale = conversion(spec.unit or unit, unit, self.where("mesh.unit")).factor
            with self.located("mesh.file", SpaceError):
                return fem.read_mesh(self.path.parent / spec.file, scale)
        if spec.nodes is not None:
            nodes = [self.convert(node, unit, "mesh.nodes") for node in spec.nodes]
            with self.located("mesh.nodes", SpaceError):
                return fem.line(nodes)
        if spec.x is not None and spec.y is not None:
            return _rectangle(self, spec.x, spec.y)
        return _interval(self)

    @cached_property
    def options(self) -> dict[str, Any]:
        """Options of the equation, including defaults: numbers in its units, text and booleans."""
        known, given = self.equation.options, self.spec.options
        self.only(given, known, "options")
        values: dict[str, Any] = {}
        for name, option in known.items():
            key = f"options.{name}"
            if name == self.equation.storage and name in self.spec.unknowns:
                if name in given:
                    raise self.error(key, f"unknowns.{name} is stated, too; keep one of the two.")
                continue
            if name in given:
                values[name] = _option_value(self, option, given[name], key)
            elif option.default is not None:
                values[name] = option.default
            else:
                unit = f", in {option.unit}" if option.unit else ""
                choices = f": one of {', '.join(option.choices)}" if option.choices else ""
                raise self.missing(key, f"the {option.text}{unit}{choices}.")
        return values

    def error(self, key: str, text: str) -> CaseError:
        """Return an error whose message begins with file and key."""
        return CaseError(f"{self.path}: {key}: {text}")

    def missing(self, key: str, text: str) -> CaseError:
        """Return an error about a missing key."""
        return CaseError(f"{self.path}: {key} is missing: {text}")

    @contextmanager
    def located(self, key: str, kind: type[Exception]) -> Iterator[None]:
        """Convert exceptions of one kind within the block to `CaseError` with file and key."""
        try:
            yield
        except kind as error:
            raise self.error(key, str(error)) from None

    def where(self, key: str) -> str:
        """Return file and key for a message."""
        return f"{self.path}: {key}"

    def convert(self, value: Any, unit: str, key: str, *, difference: bool = False) -> float:
        """Return a quantity in the model's unit."""
        with self.of_state(unit):
            return convert(value, unit, self.where(key), difference=difference)

    @contextmanager
    def of_state(self, unit: str) -> Iterator[None]:
        """Name the option of another unit of the state if a unit does not convert to it."""
        try:
            yield
        except UnitError as error:
            if unit != self.equation.state.unit or "unit" not in self.equation.options:
                raise
            text = "If the state is another quantity, set its unit as `options.unit`."
            raise UnitError(f"{error} {text}") from None

    def positive(self, value: Any, unit: str, key: str, default: float = np.nan) -> float:
        """Return a difference or duration > 0 in the model's unit; `default` if it is None."""
        if value is None:
            return default
        number = self.convert(value, unit, key, difference=True)
        if not number > 0:
            raise self.error(key, f"got {value!r}; expected more than 0.")
        if not SMALLEST <= number <= LARGEST:
            text = f"got {value!r}; expected a number from {SMALLEST:g} to {LARGEST:g}."
            raise self.error(key, text)
        return number

    def pair(self, pair: tuple[Any, Any], unit: str, key: str) -> tuple[float, float]:
        """Return an increasing pair in the model's unit."""
        low, high = (self.convert(value, unit, key) for value in pair)
        if not low < high:
            raise self.error(key, f"got [{low:g}, {high:g}] {unit}; needs the lower one first.")
        return low, high

    def only(self, given: Iterable[str], known: Iterable[str], key: str) -> None:
        """Raise `CaseError` unless every given name is known to the equation."""
        for name in given:
            text = f"the equation '{self.equation.name}' has no '{name}' here"
            self.require(name, known, key, text)

    def require(self, name: str, known: Iterable[str], key: str, text: str) -> None:
        """Raise a `CaseError` whose text begins with `text` unless a name is one of `known`."""
        if name not in known:
            raise self.error(key, f"{text}; {did_you_mean(name, known)}")

    def roles(self, *roles: str) -> dict[str, ChannelSpec]:
        """Return the channels with one of the given roles, by name."""
        return {name: item for name, item in self.spec.channels.items() if item.role in roles}

    def unit(self, channel: str) -> str:
        """Return the model's unit of a channel."""
        spec = self.spec.channels[channel]
        if spec.role == "input":
            return self.equation.inputs[channel].unit
        if spec.role == "position":
            return self.equation.length_unit
        if spec.is_flux and self.equation.fluxes is not None:
            return self.equation.fluxes.flux
        return self.equation.state.unit


def _rectangle(case: CaseContent, x: Iterable[float | str], y: Iterable[float | str]) -> Any:
    """Return a rectangle, given by the nodes or by the ends and numbers of cells of two sides."""
    spec, unit = case.spec.mesh, case.equation.length_unit
    given = (("mesh.x", x), ("mesh.y", y))
    sides = [[case.convert(node, unit, key) for node in nodes] for key, nodes in given]
    if not isinstance(spec.cells, tuple):
        _check_cells(float(len(sides[0])) * len(sides[1]), case.where("mesh"))
        with case.located("mesh", SpaceError):
            return fem.grid(*sides)
    _check_cells(float(spec.cells[0]) * spec.cells[1], case.where("mesh.cells"))
    spacings = spec.spacing if isinstance(spec.spacing, tuple) else ("uniform", "uniform")
    edges = _layer_edges(case)
    with case.located("mesh", SpaceError):
        if not edges and not isinstance(spec.spacing, tuple):
            (x0, x1), (y0, y1) = sides
            return fem.rectangle((x0, x1), (y0, y1), spec.cells)
        nodes = []
        for k, (ends, number, spacing) in enumerate(zip(sides, spec.cells, spacings, strict=True)):
            geometric = _is_graded(case, spacing, ends[0])
            across = [edge for _, axis, edge in edges if axis == k]
            nodes.append(_spaced(ends, number, geometric, across).p[0])
        return fem.grid(*nodes)


def _interval(case: CaseContent) -> Any:
    """Return an interval given by ends and number of cells, with nodes at the ends of layers."""
    spec, unit = case.spec.mesh, case.equation.length_unit
    cells: Any = spec.cells  # the schema allows only a number here
    _check_cells(cells, case.where("mesh.cells"))
    start = case.convert(spec.start, unit, "mesh.from")
    stop = case.convert(spec.stop, unit, "mesh.to")
    if not start < stop:
        raise case.error("mesh", f"got from {start:g} to {stop:g} {unit}; needs from < to.")
    geometric = _is_graded(case, spec.spacing, start)
    edges = [edge for _, axis, edge in _layer_edges(case) if axis == 0]
    return _spaced((start, stop), cells, geometric, edges)


def _spaced(ends: Sequence[float], cells: int, geometric: bool, edges: Sequence[float]) -> Any:
    """Return an interval given by ends and number of cells, with nodes at the edges of layers."""
    # The nodes nearest to the edges move there, since a jump of an unknown inside a cell would be
    # blurred. If two edges have the same nearest node, the second edge becomes an additional node.
    start, stop = ends
    plain = fem.interval(start, stop, cells, geometric=geometric)
    through = _fitted(plain.p[0], edges)
    mesh = fem.interval(start, stop, cells, geometric=geometric, through=through)
    own = {edge for edge in edges if _inside(mesh.p[0], edge)} - set(through)
    return fem.line(sorted({*mesh.p[0].tolist(), *own})) if own else mesh


def _is_graded(case: CaseContent, spacing: Any, start: float) -> bool:
    if spacing == "geometric" and not start > 0:
        raise case.error("mesh.spacing", "'geometric' needs from > 0.")
    return bool(spacing == "geometric")


def _boxes(case: CaseContent) -> list[tuple[str, str, tuple[Any, ...]]]:
    """Return name, key and sides of all layers and boxes of unknowns and sources."""
    given: list[tuple[str, str, Any]] = [
        (f"layer '{layer}' of {name}", f"unknowns.{name}.regions.{layer}", item.over)
        for name, unknown in case.spec.unknowns.items()
        for layer, item in (unknown.regions or {}).items()
    ]
    given += [
        (f"source '{name}'", f"sources.{name}.over", item.over)
        for name, item in case.spec.sources.items()
    ]
    return [(what, key, over) for what, key, over in given if isinstance(over, tuple)]


def _layer_edges(case: CaseContent) -> list[tuple[str, int, float]]:
    """Return the ends of layers and boxes as (name, axis, coordinate along this axis)."""
    unit = case.equation.length_unit
    return [
        (what, k // 2, edge)
        for what, key, over in _boxes(case)
        for k in range(0, len(over) - 1, 2)
        for edge in case.pair((over[k], over[k + 1]), unit, key)
    ]


def _fitted(nodes: Array, edges: Iterable[float]) -> list[float]:
    """Return the edges inside a mesh to which nodes can move, at most one for each node."""
    # The end nodes of the mesh do not move.
    inner = nodes[1:-1]
    found: dict[int, float] = {}
    for edge in edges:
        if len(inner) and _inside(nodes, edge):
            found.setdefault(int(np.abs(inner - edge).argmin()), edge)
    return list(found.values())


def _inside(nodes: Array, edge: float) -> bool:
    """Return whether an edge lies strictly between the ends of a mesh."""
    # Unit conversion rounds: an edge at an end of the mesh may appear to lie just inside.
    slack = 1e-6 * float(np.ptp(nodes))
    return bool(nodes.min() + slack < edge < nodes.max() - slack)


def _check_cells(number: float, where: str) -> None:
    """Refuse a mesh without a mesh file that has too many cells."""
    if number > CELLS:
        raise CaseError(
            f"{where}: got {number:.3g} cells; a mesh of a case has at most {CELLS}: take a file "
            "(mesh.file) for a larger one."
        )


def off_nodes(case: CaseContent) -> list[str]:
    """Return the names of layers, boxes and sources with an end inside a cell."""
    mesh = case.mesh
    if case.spec.mesh.file is not None:
        cells = Measure(mesh, 2)
        sides = [(what, inside(case, over, len(mesh.p), key)) for what, key, over in _boxes(case)]
        return [what for what, region in sides if len(crossed(cells, region))]
    found: dict[str, None] = {}
    for what, axis, edge in _layer_edges(case):
        if axis >= len(mesh.p):
            continue  # a later check refuses such a box
        nodes = mesh.p[axis]
        if _inside(nodes, edge) and np.abs(nodes - edge).min() > 1e-6 * np.ptp(nodes):
            found[what] = None
    return list(found)


def subdomain(case: CaseContent, mesh: Any, name: str, key: str) -> str:
    """Return the name of a subdomain; raises `CaseError` if the mesh does not have it."""
    text = f"the mesh has no subdomain '{name}'"
    if not mesh.subdomains:
        remedy = "it has none: name them in its file, or give the sides of this one."
        raise case.error(key, f"{text}; {remedy}")
    case.require(name, mesh.subdomains, key, text)
    return name


def inside(
    case: CaseContent, given: Any, dimension: int, key: str, *, closed: bool = False
) -> Callable[[Any], Any]:
    """Return the indicator function of a layer or box, including its upper sides if `closed`."""
    sides, below = sides_of(case, given, dimension, key), np.less_equal if closed else np.less
    return lambda x: np.logical_and.reduce(
        [(x[k] >= low) & below(x[k], high) for k, (low, high) in enumerate(sides)]
    )


def sides_of(case: CaseContent, given: Any, dimension: int, key: str) -> list[tuple[float, float]]:
    """Return (low, high) of a layer or box for each coordinate, in the model's unit."""
    if len(given) != 2 * dimension:
        known = {1: "[from, to]", 2: "[x0, x1, y0, y1]"}
        expected = known.get(dimension, "the name of a subdomain")
        raise case.error(key, f"got {list(given)}; expected {expected}.")
    unit = case.equation.length_unit
    return [case.pair((given[k], given[k + 1]), unit, key) for k in range(0, len(given), 2)]


def _option_value(case: CaseContent, option: Option, value: Any, key: str) -> Any:
    if option.kind is float and not isinstance(value, bool):
        return case.convert(value, option.unit, key)
    if not isinstance(value, option.kind):
        kind = {float: "a number", str: "text", bool: "true or false"}[option.kind]
        raise case.error(key, f"got {value!r}; expected {kind}.")
    if option.choices:
        case.require(str(value), option.choices, key, f"got '{value}'")
    return value


def resolve(spec: CaseSpec, folder: Path, where: str, allow_code: bool) -> Equation:
    """Return the equation of a case: a predefined equation, or user code 'file.py:name'.

    User code is an `Equation` or a function that returns a `Model`. With a function, numbers are
    used in the units of the case file.
    """
    name = spec.equation
    if ":" not in name:
        if name not in EQUATIONS:
            raise CaseError(
                f"{where}: equation: there is no equation '{name}'; "
                f"{did_you_mean(name, EQUATIONS)} For your own equation, use 'file.py:function'."
            )
        equation, unit = EQUATIONS[name], spec.options.get("unit")
        known = isinstance(unit, str) and "unit" in equation.options
        return equation.in_unit(str(unit)) if known else equation
    expected = "(mesh, unknowns, dirichlet, **options) -> livepde.Model"
    found = load_code(name, folder, f"{where}: equation", expected, allow_code)
    return found if isinstance(found, Equation) else _plain(name, found, spec, where)


def _plain(name: str, function: Any, spec: CaseSpec, where: str) -> Equation:
    """Return an equation for a user's function, with the units that the case file states."""
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
        element=fem.linear,
        fluxes=Fluxes("", "", ""),
    )


def _variables(units: Mapping[str, str | None]) -> dict[str, Variable]:
    return {name: Variable(unit or "", "") for name, unit in units.items()}


def _checked(name: str, function: Any, where: str) -> Callable[..., Model]:
    """Wrap a user's function: exceptions, and results that are no `Model`, raise `CaseError`."""

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
    """Return the option of a user's function: text that does not begin with a number is text."""
    if isinstance(value, str) and value[:1].strip("+-.0123456789 "):
        return Option("", "", value)
    return Option("", "", value if isinstance(value, bool) else None)


@contextmanager
def own_code(what: str) -> Iterator[None]:
    """Convert exceptions in user code to `CaseError`, except for the errors of livepde."""
    try:
        yield
    except LivepdeError:
        raise
    except Exception as error:
        raise CaseError(f"{what} failed with {type(error).__name__}: {error}.") from error


def load_code(name: str, folder: Path, where: str, expected: str, allowed: bool) -> Any:
    """Import the object 'module:name', or 'file.py:name' with a file relative to `folder`.

    `where` (file and key) and `expected` (signature of the function) are used in messages.
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
    """Refuse options that are not parameters of a function after its first."""
    _, *known = inspect.signature(function).parameters.values()
    if any(item.kind is inspect.Parameter.VAR_KEYWORD for item in known):
        return
    names = [item.name for item in known]
    for name in given:
        if name not in names:
            text = f"{where}: '{function.__name__}' has no option '{name}'"
            raise CaseError(f"{text}; {did_you_mean(name, names)}")


def _module(source: str, folder: Path, where: str) -> Any:
    with own_code(f"{where}: loading '{source}'"):
        if not source.endswith(".py"):
            return importlib.import_module(source)
        path = folder / source
        if not path.is_file():
            text = str(no_file(path))
            if Path(source).is_file():  # in the working directory
                there = beside(Path(source), folder).as_posix()
                text = f"there is no file '{path}', next to the case; did you mean '{there}'?"
            raise CaseError(f"{where}: {text}")
        # A file next to the case is not part of a package: it is loaded by its path.
        loader = importlib.util.spec_from_file_location(path.stem, path)
        if loader is None or loader.loader is None:
            raise ImportError(f"{path} is not a Python file")
        module = importlib.util.module_from_spec(loader)
        loader.loader.exec_module(module)
        return module
