"""Geometry of a case: mesh, layers and sources on it, regions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from livepde.cases.case_frame import Frame
from livepde.cases.read import did_you_mean
from livepde.cases.units import conversion
from livepde.errors import CaseError, SpaceError
from livepde.fem import (
    grid,
    interval,
    line,
    read_mesh,
    rectangle,
)
from livepde.linalg import Array

__all__ = ["inside", "layer_edges", "mesh_of", "off_nodes", "sides_of", "subdomain"]

CELLS = 2_000_000  # of a mesh that a case describes itself


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


def check_cells(number: float, where: str) -> None:
    """Refuse a mesh that is too large to be built here."""
    if number > CELLS:
        raise CaseError(
            f"{where}: got {number:.3g} cells; a mesh of a case has at most {CELLS}: take a file "
            "(mesh.file) for a larger one."
        )


def off_nodes(frame: Frame, nodes: Array) -> list[str]:
    """Return the names of layers and sources with an end inside of a cell."""
    within = 1e-6 * np.ptp(nodes)
    crossed = dict.fromkeys(
        what
        for what, edge in layer_edges(frame)
        if _inside(nodes, edge) and np.abs(nodes - edge).min() > within
    )
    return list(crossed)


def subdomain(frame: Frame, mesh: Any, name: str, key: str) -> str:
    """Return the name of a subdomain, which the mesh has to have."""
    known = mesh.subdomains or {}
    if name not in known:
        remedy = "it has none: name them in its file, or give the sides of this one."
        if known:
            remedy = did_you_mean(name, known)
        raise frame.error(key, f"the mesh has no subdomain '{name}'; {remedy}")
    return name


def inside(frame: Frame, given: Any, dimension: int, key: str) -> Callable[[Any], Any]:
    """Return whether points x lie in a layer or box; its upper sides do not belong to it."""
    sides = sides_of(frame, given, dimension, key)

    def within(x: Any) -> Any:
        return np.logical_and.reduce(
            [(x[k] >= low) & (x[k] < high) for k, (low, high) in enumerate(sides)]
        )

    return within


def sides_of(frame: Frame, given: Any, dimension: int, key: str) -> list[tuple[float, float]]:
    """Return (low, high) for each coordinate."""
    if len(given) != 2 * dimension:
        expected = {1: "[from, to]", 2: "[x0, x1, y0, y1]"}.get(
            dimension, "the name of a subdomain"
        )
        raise frame.error(key, f"got {list(given)}; expected {expected}.")
    unit = frame.equation.length_unit
    return [frame.pair((given[k], given[k + 1]), unit, key) for k in range(0, len(given), 2)]
