"""Boundary conditions and sources of a case: each a number, a channel or an unknown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from livepde.cases.case_frame import Frame
from livepde.cases.read import did_you_mean
from livepde.cases.regions import inside, subdomain
from livepde.cases.schema import BoundarySpec
from livepde.errors import ModelError
from livepde.fem import Channel
from livepde.model import Model
from livepde.models import Exchange, Flux, Fluxes, Source, Variable, with_conditions
from livepde.models.boundary_conditions import Amount

__all__ = ["conditioned", "held"]


def held(frame: Frame) -> dict[str, Any]:
    """Return boundary -> fixed value of the state."""
    found, unit = {}, frame.equation.state.unit
    for name, given in frame.spec.boundary.items():
        if given.value is not None:
            found[name] = frame.convert(given.value, unit, f"boundary.{name}")
    return found


def conditioned(frame: Frame) -> Frame:
    """Return the frame whose equation has the fluxes and sources of the case, and their names."""
    spec, equation = frame.spec, frame.equation
    given = {name: item for name, item in spec.boundary.items() if item.passes}
    if not (given or spec.sources):
        return frame
    units = equation.fluxes
    if units is None:
        key = f"boundary.{next(iter(given))}" if given else f"sources.{next(iter(spec.sources))}"
        text = f"the equation '{equation.name}' takes no fluxes and no sources of a case; "
        raise frame.error(key, text + "'livepde equations' tells which ones do.")
    names = _Names(frame)
    boundary = {name: _passing(names, units, name, item) for name, item in given.items()}
    sources = {
        name: (names.amount(item.value, units.source, f"sources.{name}.value"), item.over)
        for name, item in spec.sources.items()
    }
    base = equation.build

    def build(
        mesh: Any, unknowns: Mapping[str, Any], dirichlet: Mapping[str, Any], **options: Any
    ) -> Model:
        # The equation gets its own unknowns; those that fluxes and sources name are added
        # afterwards.
        own = {name: item for name, item in unknowns.items() if name not in names.unknowns}
        more = {name: item for name, item in unknowns.items() if name in names.unknowns}
        for name in boundary:
            if name not in (mesh.boundaries or {}):
                text = f"no boundary '{name}'; {did_you_mean(name, mesh.boundaries or {})}"
                raise frame.error("boundary", text)
        placed = {
            name: Source(amount, None if over is None else _place(frame, mesh, over, name))
            for name, (amount, over) in sources.items()
        }
        model = base(mesh, own, dirichlet, **options)
        with frame.located("boundary", ModelError):
            return with_conditions(model, boundary, placed, more)

    unknowns = {**equation.unknowns, **names.unknowns}
    inputs = {**equation.inputs, **names.inputs}
    changed = replace(equation, unknowns=unknowns, inputs=inputs, build=build)
    return replace(frame, equation=changed)


def _passing(names: _Names, units: Fluxes, name: str, given: BoundarySpec) -> list[Flux | Exchange]:
    """Return the flux through a boundary."""
    found: list[Flux | Exchange] = []
    key = f"boundary.{name}"
    if given.flux is not None:
        found.append(Flux(names.amount(given.flux, units.flux, f"{key}.flux")))
    if given.transfer is not None and given.ambient is not None:
        # Robin condition: D u_n = h (ambient - u).
        h = names.amount(given.transfer, units.transfer, f"{key}.transfer")
        unit = names.frame.equation.state.unit
        found.append(Exchange(h, names.amount(given.ambient, unit, f"{key}.ambient")))
    return found


@dataclass
class _Names:
    """Unknowns and channels that the conditions of a case name, with their units."""

    frame: Frame
    unknowns: dict[str, Variable] = field(default_factory=dict)
    inputs: dict[str, Variable] = field(default_factory=dict)

    def amount(self, value: float | str, unit: str, key: str) -> Amount:
        """Return a number in the model's unit, a channel, or the name of an unknown."""
        spec = self.frame.spec
        if isinstance(value, str) and value in spec.unknowns:
            self._named(self.unknowns, self.frame.equation.unknowns, value, unit, key)
            return value
        if isinstance(value, str) and value in spec.channels:
            if spec.channels[value].role != "input":
                raise self.frame.error(key, f"the channel '{value}' has to be of role 'input'.")
            self._named(self.inputs, self.frame.equation.inputs, value, unit, key)
            return Channel(value)
        # Text without a digit is no quantity: a name was meant.
        if isinstance(value, str) and not any(letter.isdigit() for letter in value):
            text = f"there is no unknown and no channel '{value}'; "
            text += did_you_mean(value, [*spec.unknowns, *spec.channels])
            raise self.frame.error(key, text)
        return self.frame.convert(value, unit, key)

    def _named(
        self,
        found: dict[str, Variable],
        taken: Mapping[str, Variable],
        name: str,
        unit: str,
        key: str,
    ) -> None:
        # Several conditions may share a name, if it has the same unit in all of them.
        before, own = found.get(name) or taken.get(name), name in taken
        clash = own and found is self.unknowns
        if before is not None and (clash or before.unit != unit):
            text = f"'{name}' is the {before.text} [{before.unit}] already; take another name."
            raise self.frame.error(key, text)
        found.setdefault(name, Variable(unit, key.removeprefix("boundary.").replace(".", ", ")))


def _place(frame: Frame, mesh: Any, over: Any, name: str) -> Any:
    """Return the region of a source: the name of a subdomain, or a predicate on x."""
    key = f"sources.{name}.over"
    if isinstance(over, str):
        return subdomain(frame, mesh, over, key)
    place = inside(frame, over, len(mesh.p), key)
    if not np.any(place(mesh.p[:, mesh.t].mean(axis=1))):
        raise frame.error(key, "holds no cell of the mesh.")
    return place
