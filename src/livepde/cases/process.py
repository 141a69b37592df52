"""The process of a case: mesh, unknowns, boundary values, model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from livepde.cases.frame import Frame
from livepde.cases.read import did_you_mean
from livepde.cases.schema import UnknownSpec
from livepde.cases.units import conversion
from livepde.fem import Channel, Field, Piecewise, Scalar, dot, grad, interval, rectangle
from livepde.model import Model
from livepde.models import Option

__all__ = ["mesh_of", "model_of", "options_of", "process_notes"]


def mesh_of(frame: Frame) -> Any:
    """Return the mesh."""
    spec, unit = frame.spec.mesh, frame.equation.length_unit
    if spec.x is not None and spec.y is not None and isinstance(spec.cells, tuple):
        x, y = frame.pair(spec.x, unit, "mesh.x"), frame.pair(spec.y, unit, "mesh.y")
        return rectangle(x, y, spec.cells)
    start = frame.convert(spec.start, unit, "mesh.from")
    stop = frame.convert(spec.stop, unit, "mesh.to")
    if not start < stop:
        raise frame.error("mesh", f"got from {start:g} to {stop:g} {unit}; needs from < to.")
    geometric = spec.spacing == "geometric"
    if geometric and not start > 0:
        raise frame.error("mesh.spacing", "'geometric' needs from > 0.")
    cells = spec.cells if isinstance(spec.cells, int) else spec.cells[0]
    return interval(start, stop, cells, geometric=geometric)


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
    """Return the model."""
    inputs = frame.roles("input")
    frame.only(inputs, frame.equation.inputs, "channels (role input)")
    for name, variable in frame.equation.inputs.items():
        if name not in inputs:
            raise frame.missing(f"channels.{name}", f"the {variable.text}, with role = 'input'.")
    unknowns = _unknowns(frame, mesh)
    return frame.equation.build(mesh, unknowns, _dirichlet(frame, mesh), **options)


def _dirichlet(frame: Frame, mesh: Any) -> dict[str, Any]:
    known = [*(mesh.boundaries or {}), "boundary"]
    values: dict[str, Any] = {}
    for name, value in frame.spec.boundary.items():
        if name not in known:
            raise frame.error("boundary", f"no boundary '{name}'; {did_you_mean(name, known)}")
        values[name] = frame.convert(value, frame.equation.state.unit, f"boundary.{name}")
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
        if name not in given:
            text = f"the {variable.text}, with prior and std in {variable.unit or 'no unit'}."
            raise frame.missing(f"unknowns.{name}", text)
    return {name: _unknown(frame, mesh, name, spec) for name, spec in given.items()}


def _unknown(frame: Frame, mesh: Any, name: str, spec: UnknownSpec) -> Any:
    """Return an unknown with its prior in the model's unit; plain numbers are in `spec.unit`."""
    key, unit = f"unknowns.{name}", frame.equation.unknowns[name].unit
    rule = conversion(spec.unit or unit, unit, frame.where(f"{key}.unit"))

    def value(given: float | str, item: str) -> float:
        if isinstance(given, str):
            return frame.convert(given, unit, f"{key}.{item}")
        return rule.factor * given + rule.offset

    prior = value(spec.prior, "prior")
    given = spec.std if isinstance(spec.std, str) else rule.factor * spec.std
    std = frame.positive(given, unit, f"{key}.std")
    if spec.field:
        return _field(frame, mesh, spec, prior, std, name)
    low, high = -np.inf, np.inf
    if spec.bounds is not None:
        low, high = (value(bound, "bounds") for bound in spec.bounds)
        if not low <= prior <= high or low == high:
            text = f"got {list(spec.bounds)}; expected low < high with the prior {spec.prior!r}"
            raise frame.error(f"{key}.bounds", f"{text} between them.")
    if spec.regions is None:
        return Scalar(prior, std, (low, high), unit)
    regions = _regions(frame, mesh, spec.regions, f"{key}.regions")
    return Piecewise(regions, prior, std, (low, high), unit)


def _field(
    frame: Frame, mesh: Any, spec: UnknownSpec, prior: float, std: float, name: str
) -> Field:
    length = float(np.ptp(mesh.p[0])) / 3
    if spec.length is not None:
        unit = frame.equation.length_unit
        length = frame.positive(spec.length, unit, f"unknowns.{name}.length")

    # In one dimension the covariance is std^2 exp(-|x - y|/length) inside; near a free end, within
    # about one length, the deviation grows to sqrt(2) std.
    def inner(u: Any, v: Any, x: Any) -> Any:
        return 0.5 * (u * v / length + length * dot(grad(u), grad(v)))

    unit = frame.equation.unknowns[name].unit
    element = frame.equation.element(mesh)
    return Field(mesh, element, inner=inner, prior=prior, std=std, unit=unit)


def _regions(frame: Frame, mesh: Any, regions: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return predicates of layers; they have to tile the mesh."""
    if len(mesh.p) != 1:
        raise frame.error(key, "layers need a mesh of an interval.")
    unit = frame.equation.length_unit
    middle = mesh.p[0][mesh.t].mean(axis=0)
    count = np.zeros(len(middle))
    found = {}
    for name, pair in regions.items():
        low, high = frame.pair(pair, unit, f"{key}.{name}")

        def inside(x: Any, low: float = low, high: float = high) -> Any:
            return (x[0] >= low) & (x[0] < high)

        here = inside(middle[None])
        if not here.any():
            raise frame.error(
                f"{key}.{name}",
                f"[{low:g}, {high:g}] {unit} holds no cell of the mesh, which spans "
                f"{mesh.p.min():g} to {mesh.p.max():g} {unit}.",
            )
        count += here
        found[name] = inside
    wrong = np.flatnonzero(count != 1)
    if len(wrong):
        x, times = middle[wrong[0]], int(count[wrong[0]])
        text = f"{x:.4g} {unit} lies in {times} layers; every point has to lie in exactly one."
        raise frame.error(key, text)
    return found


def process_notes(frame: Frame, mesh: Any) -> list[str]:
    """Return what is allowed and yet deserves a word."""
    found = []
    nodes = mesh.p[0]
    for name, unknown in frame.spec.unknowns.items():
        for layer, pair in (unknown.regions or {}).items():
            edges = frame.pair(pair, frame.equation.length_unit, f"unknowns.{name}.regions")
            inner = [edge for edge in edges if nodes.min() < edge < nodes.max()]
            if any(np.abs(nodes - edge).min() > 1e-6 * np.ptp(nodes) for edge in inner):
                found.append(
                    f"Layer '{layer}' of {name} ends inside of a cell: choose mesh.cells such "
                    "that nodes fall on the edges."
                )
    return found
