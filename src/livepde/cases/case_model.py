"""The process of a case: mesh, unknowns, boundary values, model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from livepde.cases.case_frame import Frame
from livepde.cases.conditions import held
from livepde.cases.instruments import unknowns_of
from livepde.cases.limits import check_cells
from livepde.cases.read import did_you_mean
from livepde.cases.regions import inside, sides_of, subdomain
from livepde.cases.schema import EvolutionSpec, UnknownSpec
from livepde.cases.units import conversion
from livepde.errors import CaseError, ModelError, NameClashError, SpaceError
from livepde.fem import (
    Channel,
    Evolution,
    Field,
    LogitNormal,
    LogNormal,
    MeanReverting,
    Normal,
    Periodic,
    Piecewise,
    Prior,
    RandomWalk,
    Scalar,
    Sobolev,
    grid,
    interval,
    line,
    linear,
    read_mesh,
    rectangle,
)
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import Option

__all__ = ["constants_of", "drive_notes", "mesh_of", "model_of", "options_of", "process_notes"]


def mesh_of(frame: Frame) -> Any:
    """Return the mesh of a case: from a file, or a line or rectangle of nodes or cells."""
    spec, unit = frame.spec.mesh, frame.equation.length_unit
    if spec.file is not None:
        scale = conversion(spec.unit or unit, unit, frame.where("mesh.unit")).factor
        with frame.located("mesh.file", SpaceError):
            return read_mesh(frame.path.parent / spec.file, scale)
    if spec.nodes is not None:
        nodes = [frame.convert(node, unit, "mesh.nodes") for node in spec.nodes]
        with frame.located("mesh.nodes", SpaceError):
            return line(nodes)
    if spec.x is not None and spec.y is not None:
        return _rectangle(frame, spec.x, spec.y)
    return _interval(frame)


def _rectangle(frame: Frame, x: Iterable[float | str], y: Iterable[float | str]) -> Any:
    """Return a rectangle: of the nodes on two sides, or of their ends and numbers of cells."""
    spec, unit = frame.spec.mesh, frame.equation.length_unit
    sides = (
        [frame.convert(node, unit, "mesh.x") for node in x],
        [frame.convert(node, unit, "mesh.y") for node in y],
    )
    if not isinstance(spec.cells, tuple):
        check_cells(float(len(sides[0])) * len(sides[1]), frame.where("mesh"))
        with frame.located("mesh", SpaceError):
            return grid(*sides)
    check_cells(float(spec.cells[0]) * spec.cells[1], frame.where("mesh.cells"))
    with frame.located("mesh", SpaceError):
        if isinstance(spec.spacing, tuple):
            return _graded(frame, sides, spec.cells, [one == "geometric" for one in spec.spacing])
        (x0, x1), (y0, y1) = sides
        return rectangle((x0, x1), (y0, y1), spec.cells)


def _interval(frame: Frame) -> Any:
    """Return an interval of cells, with nodes at the ends of layers."""
    spec, unit = frame.spec.mesh, frame.equation.length_unit
    cells: Any = spec.cells  # the schema allows only a number here
    check_cells(cells, frame.where("mesh.cells"))
    start = frame.convert(spec.start, unit, "mesh.from")
    stop = frame.convert(spec.stop, unit, "mesh.to")
    if not start < stop:
        raise frame.error("mesh", f"got from {start:g} to {stop:g} {unit}; needs from < to.")
    geometric = spec.spacing == "geometric"
    _check_graded(frame, start, geometric)
    # The nodes nearest to ends of layers move there, because a jump of an unknown inside of a cell
    # would be blurred. If two ends share a nearest node, the second becomes a node of its own.
    plain = interval(start, stop, cells, geometric=geometric)
    edges = [edge for _, edge in layer_edges(frame)]
    through = _fitted(plain.p[0], edges)
    mesh = interval(start, stop, cells, geometric=geometric, through=through)
    own = {edge for edge in edges if _inside(mesh.p[0], edge)} - set(through)
    return line(sorted({*mesh.p[0].tolist(), *own})) if own else mesh


def _graded(
    frame: Frame, sides: Iterable[Sequence[float]], cells: Iterable[int], graded: Iterable[bool]
) -> Any:
    """Return a rectangle with geometric or uniform spacing along each side."""
    nodes = []
    for (start, stop), number, geometric in zip(sides, cells, graded, strict=True):
        _check_graded(frame, start, geometric)
        nodes.append(interval(start, stop, number, geometric=geometric).p[0])
    return grid(*nodes)


def _check_graded(frame: Frame, start: float, geometric: bool) -> None:
    if geometric and not start > 0:
        raise frame.error("mesh.spacing", "'geometric' needs from > 0.")


def layer_edges(frame: Frame) -> list[tuple[str, float]]:
    """Return the ends of layers of an interval, of unknowns and of sources, each with its name."""
    given: list[tuple[str, str, Any]] = [
        (f"layer '{layer}' of {name}", f"unknowns.{name}.regions.{layer}", item.over)
        for name, unknown in frame.spec.unknowns.items()
        for layer, item in (unknown.regions or {}).items()
    ]
    given += [
        (f"source '{name}'", f"sources.{name}.over", item.over)
        for name, item in frame.spec.sources.items()
    ]
    unit = frame.equation.length_unit
    return [
        (what, edge)
        for what, key, over in given
        if isinstance(over, tuple) and len(over) == 2
        for edge in frame.pair(over, unit, key)
    ]


def _fitted(nodes: Array, edges: Iterable[float]) -> list[float]:
    """Return the edges inside of a mesh that its nodes can move to, at most one for each node."""
    # The ends of the mesh stay where they are.
    inner = nodes[1:-1]
    found: dict[int, float] = {}
    for edge in edges:
        if len(inner) and _inside(nodes, edge):
            found.setdefault(int(np.abs(inner - edge).argmin()), edge)
    return list(found.values())


def _inside(nodes: Array, edge: float) -> bool:
    """Return whether an edge lies between the ends of a mesh, and not on them."""
    # Conversion of units rounds, so that an end of the mesh may seem to lie just inside of it.
    slack = 1e-6 * float(np.ptp(nodes))
    return bool(nodes.min() + slack < edge < nodes.max() - slack)


def options_of(frame: Frame) -> dict[str, Any]:
    """Return the options of the equation: numbers in its units, text and booleans."""
    known, given = frame.equation.options, frame.spec.options
    frame.only(given, known, "options")
    values: dict[str, Any] = {}
    for name, option in known.items():
        key = f"options.{name}"
        if name in given:
            values[name] = _option(frame, option, given[name], key)
        elif option.default is not None:
            values[name] = option.default
        else:
            unit = f", in {option.unit}" if option.unit else ""
            choices = f": one of {', '.join(option.choices)}" if option.choices else ""
            raise frame.missing(key, f"the {option.text}{unit}{choices}.")
    return values


def _option(frame: Frame, option: Option, value: Any, key: str) -> Any:
    if option.kind is float and not isinstance(value, bool):
        return frame.convert(value, option.unit, key)
    if not isinstance(value, option.kind):
        kind = {float: "a number", str: "text", bool: "true or false"}[option.kind]
        raise frame.error(key, f"got {value!r}; expected {kind}.")
    if option.choices and value not in option.choices:
        raise frame.error(key, f"got '{value}'; {did_you_mean(str(value), option.choices)}")
    return value


def model_of(frame: Frame, mesh: Any, options: Mapping[str, Any]) -> Model:
    """Return the model of a case; raises `CaseError` on missing or superfluous parts."""
    inputs = frame.roles("input")
    frame.only(inputs, frame.equation.inputs, "channels (role input)")
    constants = constants_of(frame)
    given = {*inputs, *constants}
    for name, variable in frame.equation.inputs.items():
        if name not in given and not variable.optional:
            raise _without_input(frame, name, f"the {variable.text}")
    unknowns = _unknowns(frame, mesh)
    with frame.located("unknowns", NameClashError):
        model = frame.equation.build(mesh, unknowns, _dirichlet(frame, mesh), **options)
    _check_inputs(frame, model, given, constants)
    model = model.with_constant_inputs(constants) if constants else model
    own = unknowns_of(frame)
    if not own:
        return model
    with frame.located("channels", ModelError):
        return model.with_unknowns(own)


def _check_inputs(frame: Frame, model: Model, given: set[str], constants: Iterable[str]) -> None:
    """Refuse inputs that the model reads and the case lacks, and constants that it does not read.

    Only the built model knows which optional inputs it reads with these unknowns.
    """
    for name in model.inputs:
        if name not in given:
            known = frame.equation.inputs.get(name)
            raise _without_input(
                frame, name, f"the {known.text}" if known else "the equation reads it"
            )
    # A constant that nothing reads is refused, since it may be the one a user believes to act.
    for name in constants:
        if name not in model.inputs:
            text = "the equation does not read it with these unknowns; leave it out."
            raise frame.error(f"inputs.{name}", text)


def constants_of(frame: Frame) -> dict[str, float]:
    """Return the inputs of the equation that are constants, in its units."""
    known, given = frame.equation.inputs, frame.spec.inputs
    frame.only(given, known, "inputs")
    for name in given:
        if name in frame.spec.channels:
            raise frame.error(f"inputs.{name}", f"there is a channel '{name}', too; keep one.")
    return {
        name: frame.convert(value, known[name].unit, f"inputs.{name}")
        for name, value in given.items()
    }


def _without_input(frame: Frame, name: str, what: str) -> CaseError:
    text = f"{what}, with role = 'input'; or a constant, inputs.{name}."
    return frame.missing(f"channels.{name}", text)


def _dirichlet(frame: Frame, mesh: Any) -> dict[str, Any]:
    # "boundary" is all of it, also of a mesh without named boundaries.
    known = [*(mesh.boundaries or {}), "boundary"]
    values: dict[str, Any] = {}
    for name, value in held(frame).items():
        if name not in known:
            raise frame.error("boundary", f"no boundary '{name}'; {did_you_mean(name, known)}")
        values[name] = value
    for name, channel in frame.roles("boundary").items():
        key, at = f"channels.{name}.at", str(channel.at)
        if at not in known:
            raise frame.error(key, f"no boundary '{at}'; {did_you_mean(at, known)}")
        if at in values:
            raise frame.error(key, f"the boundary '{at}' has a value already; keep one.")
        values[at] = Channel(name)
    return values


def _unknowns(frame: Frame, mesh: Any) -> dict[str, Any]:
    known, given = frame.equation.unknowns, frame.spec.unknowns
    frame.only(given, known, "unknowns")
    for name, variable in known.items():
        if name not in given and not variable.optional:
            text = f"the {variable.text}, with prior and std in {variable.unit or 'no unit'}."
            raise frame.missing(f"unknowns.{name}", text)
    return {name: _unknown(frame, mesh, name, spec) for name, spec in given.items()}


def _unknown(frame: Frame, mesh: Any, name: str, spec: UnknownSpec) -> Any:
    """Return an unknown with its prior in the model's unit; plain numbers are in `spec.unit`."""
    key, unit = f"unknowns.{name}", frame.equation.unknowns[name].unit
    options = _options_of(frame, spec, unit, key)
    if spec.field:
        with frame.located(key, SpaceError):
            return _field(frame, mesh, spec, name, options)
    if spec.regions is None:
        with frame.located(key, SpaceError):
            return Scalar(**options)
    places = {region: item.over for region, item in spec.regions.items()}
    regions = _regions(frame, mesh, places, f"{key}.regions")
    # A region may state a prior of its own; the others share that of the unknown.
    own = {}
    for region, item in spec.regions.items():
        if (there := spec.at(item)) is not None:
            where = f"{key}.regions.{region}"
            given = _options_of(frame, there, unit, where)
            with frame.located(where, SpaceError):
                own[region] = Scalar(**given)
    with frame.located(key, SpaceError):
        return Piecewise(regions, **options, own=own)


def _options_of(frame: Frame, spec: UnknownSpec, unit: str, key: str) -> dict[str, Any]:
    """Return prior, evolution and within in the model's unit, and that unit."""
    prior = _prior(frame, spec, unit, key)
    options: dict[str, Any] = {"prior": prior, "unit": unit, "within": spec.within}
    if spec.evolution is not None:
        options["evolution"] = _evolution(frame, spec, spec.evolution, unit, f"{key}.evolution")
    return options


def _prior(frame: Frame, spec: UnknownSpec, unit: str, key: str) -> Prior:
    """Return the prior in the model's unit."""
    rule = conversion(spec.unit or unit, unit, frame.where(f"{key}.unit"))

    def value(given: float | str, item: str) -> float:
        if isinstance(given, str):
            # An equation of the user's own may declare no unit, and then text cannot be converted.
            if not unit and ":" in frame.spec.equation:
                text = f"got '{given}'; '{frame.spec.equation}' has no units of its own: "
                text += f"say {key}.unit, too, or write numbers."
                raise frame.error(f"{key}.{item}", text)
            return frame.convert(given, unit, f"{key}.{item}")
        return rule.factor * given + rule.offset

    prior = value(spec.prior, "prior")
    # A standard deviation is a difference, so the offset of a unit as degC does not apply.
    given = spec.std if isinstance(spec.std, str) else rule.factor * spec.std
    std = frame.positive(given, unit, f"{key}.std")
    low, high = -np.inf, np.inf
    if spec.bounds is not None:
        low, high = (value(bound, "bounds") for bound in spec.bounds)
        if not low < high:
            text = f"got [{low:g}, {high:g}] {unit}".rstrip()
            raise frame.error(f"{key}.bounds", f"{text}; needs the lower one first.")
        if not low <= prior <= high:
            text = f"the prior {prior:g} lies outside of the bounds [{low:g}, {high:g}] {unit}"
            raise frame.error(key, f"{text.rstrip()}; widen them, or check the unit of the prior.")
    if spec.transform is None:
        with frame.located(key, SpaceError):
            return Normal(prior, std, (low, high))
    return _transformed(frame, spec.transform, prior, std, (low, high), key)


def _transformed(
    frame: Frame, transform: str, median: float, std: float, bounds: tuple[float, float], key: str
) -> Prior:
    """Return the prior of an unknown with a transform; errors name the keys of the case."""
    low, high = bounds
    if transform == "log":
        if np.isfinite(high):
            raise frame.error(key, "transform='log' knows no upper bound; take 'logit'.")
        low = low if np.isfinite(low) else 0.0
    elif not np.isfinite(bounds).all():
        raise frame.error(key, f"transform='logit' needs two finite bounds; got {bounds}.")
    if not low < median < high:
        text = f"prior {median} is not inside of what transform='{transform}' allows; move it "
        raise frame.error(key, text + "inside of the bounds.")
    distribution = LogNormal if transform == "log" else LogitNormal
    with frame.located(key, SpaceError):
        return distribution(median, std, (low, high))


def _evolution(
    frame: Frame, unknown: UnknownSpec, spec: EvolutionSpec, unit: str, key: str
) -> Evolution:
    """Return the evolution of an unknown; a rate is a standard deviation after one unit of time."""
    time = frame.equation.time_unit
    if spec.rate is not None:
        # A rate is a difference, of the logarithm under a transform; "degC" cannot be divided.
        moving = "1" if unknown.transform or not unit else unit.replace("degC", "K")
        per = f"({moving})/({time})**0.5" if time else moving.removeprefix("1")
        return RandomWalk(frame.positive(spec.rate, per, f"{key}.rate"))
    if spec.time is not None:
        return MeanReverting(frame.positive(spec.time, time, f"{key}.time"))
    return Periodic(frame.positive(spec.period, time, f"{key}.period"), spec.harmonics)


def _field(
    frame: Frame, mesh: Any, spec: UnknownSpec, name: str, given: Mapping[str, Any]
) -> Field:
    # Default correlation length: a third of the extent along x.
    length = float(np.ptp(mesh.p[0])) / 3
    if spec.length is not None:
        unit = frame.equation.length_unit
        length = frame.positive(spec.length, unit, f"unknowns.{name}.length")

    # In one dimension the covariance is std^2 exp(-|x - y|/length) inside. In two and three the
    # pointwise variance of H^1 would be infinite, so that it takes H^2.
    dimension = len(mesh.p)
    inner = Sobolev(1 if dimension == 1 else 2, length).pointwise(dimension)
    # A transform acts on each coefficient, which in linear elements is the value at a node.
    element = linear(mesh) if spec.transform else frame.equation.element(mesh)
    return Field(mesh, element, inner=inner, **given)


def _regions(frame: Frame, mesh: Any, regions: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return subdomains of the mesh by name, and predicates of layers and boxes.

    Every point has to lie in exactly one.
    """
    # Midpoints of cells decide, since a vertex on an interface would belong to two regions.
    middle = mesh.p[:, mesh.t].mean(axis=1)
    count = np.zeros(middle.shape[1])
    found: dict[str, Any] = {}
    for name, given in regions.items():
        where = f"{key}.{name}"
        if isinstance(given, str):
            found[name] = subdomain(frame, mesh, given, where)
            count[mesh.subdomains[given]] += 1
            continue
        found[name] = inside(frame, given, len(mesh.p), where)
        here = found[name](middle)
        if not here.any():
            raise _without_cells(frame, mesh, given, where)
        count += here
    wrong = np.flatnonzero(count != 1)
    if len(wrong):
        x, times = middle[:, wrong[0]], int(count[wrong[0]])
        what = "layers" if len(x) == 1 else "regions"
        point = f"{', '.join(f'{c:.4g}' for c in x)} {frame.equation.length_unit}"
        text = f"{point} lies in {times} {what}; every point has to lie in exactly one."
        raise frame.error(key, text)
    return found


def _without_cells(frame: Frame, mesh: Any, given: Any, key: str) -> CaseError:
    """Return the error about a layer or box without a cell of the mesh."""
    unit = frame.equation.length_unit
    sides = sides_of(frame, given, len(mesh.p), key)
    spans = " x ".join(f"[{low:g}, {high:g}]" for low, high in sides)
    limits = zip(mesh.p.min(axis=1), mesh.p.max(axis=1), strict=True)
    ends = " x ".join(f"{low:g} to {high:g}" for low, high in limits)
    text = f"{spans} {unit} holds no cell of the mesh, which spans {ends} {unit}."
    return frame.error(key, text)


def drive_notes(frame: Frame, model: Model) -> list[str]:
    """Return a note if only the initial state drives the process.

    Without values on boundaries and without inputs, a state that is the same everywhere neither
    changes nor depends on the unknowns if A'(q), B and F vanish there. Then only the decay of
    differences in the initial state depends on the unknowns. Left out are periodic states, which
    carry waves, and equations of the user's own, which need not be defined for any state.
    """
    if ":" in frame.spec.equation:
        return []
    fields = [block.field for block in model.state_space.fields.values()]
    held = any(field.boundary_values or field.periodic for field in fields)
    if held or model.channels or model.form_initial is not None:
        return []
    if not _rests(model):
        return []
    return [
        "No boundary value, flux, exchange, source or input: nothing drives the process, and only "
        "the decay of its initial state tells of the unknowns. Give a channel role = 'boundary', "
        "or [boundary] a value or a flux."
    ]


def _rests(model: Model) -> bool:
    """Return whether A'(q), B and F vanish at a constant state."""
    # Terms at a constant state are compared with those at an uneven one, which give their size:
    # rounding leaves no exact zeros.
    level = model.state_space.interpolate(1.0)
    uneven = level * (1.0 + np.arange(len(level)) % 3)
    flat, steep = (abs(model.A(u).matrix).max(axis=0).toarray() for u in (level, uneven))
    known = np.abs(model.B(level)).max() > 1e-9 * np.abs(model.B(uneven)).max()
    return not (known or model.F().any() or (flat > 1e-9 * steep).any())


def process_notes(frame: Frame, mesh: Any) -> list[str]:
    """Return notes on allowed settings that may be mistakes."""
    found, spec = [], frame.spec.mesh
    graded = frame.equation.spacing == "geometric"
    if graded and spec.start is not None and spec.spacing == "uniform":
        found.append(
            "The mesh is uniform, with cells too large at the left end, where "
            f"'{frame.equation.name}' changes most: mesh.spacing = 'geometric'."
        )
    if len(mesh.p) == 1 and spec.file is None and (crossed := _off_nodes(frame, mesh.p[0])):
        remedy = "add the ends to mesh.nodes" if spec.nodes else "take more mesh.cells"
        names, end = ", ".join(crossed), "end" if len(crossed) > 1 else "ends"
        found.append(f"{names[0].upper()}{names[1:]} {end} inside of a cell: {remedy}.")
    return found


def _off_nodes(frame: Frame, nodes: Array) -> list[str]:
    """Return the names of layers and sources with an end inside of a cell."""
    within = 1e-6 * np.ptp(nodes)
    crossed = dict.fromkeys(
        what
        for what, edge in layer_edges(frame)
        if _inside(nodes, edge) and np.abs(nodes - edge).min() > within
    )
    return list(crossed)
