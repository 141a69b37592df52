"""Process of a case: model from equation, boundary conditions, sources, unknowns and inputs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from livepde import fem
from livepde.cases.case_channels import unknowns_of
from livepde.cases.case_content import CaseContent, inside, off_nodes, sides_of, subdomain
from livepde.cases.read import did_you_mean, toml_key
from livepde.cases.schema import (
    BoundarySpec,
    ChannelSpec,
    EvolutionSpec,
    MeshSpec,
    UnknownSpec,
)
from livepde.errors import CaseError, ModelError, NameClashError, SpaceError
from livepde.fem.field_blocks import base_name
from livepde.fem.measure import unweighted
from livepde.model import Model
from livepde.models import EQUATIONS, Exchange, Flux, Fluxes, Source, Variable, with_conditions
from livepde.models.boundary_conditions import Amount, Multiple
from livepde.observation.functionals import in_cells
from livepde.runs.summary import LAYERS, SURFACES
from livepde.units import conversion

HELD = 1e4  # transfer coefficient h of a boundary value with an offset, in units of D / cell size


def model_of(case: CaseContent) -> Model:
    """Return the model of a case; raises `CaseError` if parts are missing or superfluous."""
    inputs = case.roles("input")
    case.only(inputs, case.equation.inputs, "channels (role input)")
    constants = case.constants
    given = {*inputs, *constants, *_shifted(case)}
    for name, variable in case.equation.inputs.items():
        if name not in given and not variable.optional:
            raise _without_input(case, name, f"the {variable.text}")
    unknowns = _unknowns(case)
    with case.located("unknowns", NameClashError):
        model = _built(case, unknowns)
    _check_inputs(case, model, given, constants)
    model = model.with_constant_inputs(constants) if constants else model
    own = unknowns_of(case)
    if not own:
        return model
    with case.located("channels", ModelError):
        return model.with_unknowns(own)


def _built(case: CaseContent, unknowns: Mapping[str, Any]) -> Model:
    """Return the equation's model, without constant inputs and the unknowns of the sensors."""
    # An optional input enables the term that reads it.
    switched = case.equation.options.keys() & {*case.roles("input"), *case.constants}
    options = {**case.options, **dict.fromkeys(switched, True)}
    return case.equation.build(case.mesh, unknowns, _dirichlet(case), **options)


def _check_inputs(
    case: CaseContent, model: Model, given: set[str], constants: Iterable[str]
) -> None:
    """Refuse missing inputs that the model reads, and inputs that it does not read."""
    # Which optional inputs are read depends on the unknowns: only the built model knows.
    for name in model.inputs:
        if name not in given:
            known = case.equation.inputs.get(name)
            what = f"the {known.text}" if known else "the equation reads it"
            raise _without_input(case, name, what)
    # Inputs that are not read are refused, since a user may believe that they have an effect.
    for key in _unread(case, model, constants):
        text = "the equation does not read it with these unknowns; leave it out."
        raise case.error(key, text)


def _unread(case: CaseContent, model: Model, constants: Iterable[str]) -> list[str]:
    """Return the keys of the case's inputs that a model does not read."""
    given = [(f"channels.{toml_key(name)}", name) for name in case.roles("input")]
    given += [(f"inputs.{toml_key(name)}", name) for name in constants]
    return [key for key, name in given if name not in model.inputs]


def unread_without(case: CaseContent, unknown: str) -> list[str]:
    """Return the keys of the inputs that the equation does not read without an unknown."""
    unknowns = {name: one for name, one in _unknowns(case).items() if name != unknown}
    return _unread(case, _built(case, unknowns), case.constants)


def _without_input(case: CaseContent, name: str, what: str) -> CaseError:
    text = f"{what}, with role = 'input'; or a constant, inputs.{name}."
    return case.missing(f"channels.{name}", text)


def _dirichlet(case: CaseContent) -> dict[str, Any]:
    # "boundary" is the whole boundary, even if the mesh has no named boundaries.
    known = [*(case.mesh.boundaries or {}), "boundary"]
    values: dict[str, Any] = {}
    for name, given in case.spec.boundary.items():
        if given.value is not None:
            values[name] = case.convert(given.value, case.equation.state.unit, f"boundary.{name}")
            case.require(name, known, "boundary", f"no boundary '{name}'")
    for name, channel in case.roles("boundary").items():
        if channel.offset is not None:  # imposed by an exchange, see `_near`
            continue
        key, at = f"channels.{name}.at", str(channel.at)
        case.require(at, known, key, f"no boundary '{at}'")
        if at in values:
            raise case.error(key, f"the boundary '{at}' has a value already; keep one.")
        values[at] = fem.Channel(name)
    return values


def _unknowns(case: CaseContent) -> dict[str, Any]:
    known, given = case.equation.unknowns, case.spec.unknowns
    case.only(given, known, "unknowns")
    for name, variable in known.items():
        if name not in given and not variable.optional:
            text = f"the {variable.text}, with prior and std in {variable.unit or 'no unit'}."
            raise case.missing(f"unknowns.{name}", text)
    return {name: _unknown(case, name, spec) for name, spec in given.items()}


def _unknown(case: CaseContent, name: str, spec: UnknownSpec) -> Any:
    """Return an unknown in the model's unit; numbers without a unit are in `spec.unit`."""
    key, unit = f"unknowns.{name}", case.equation.unknowns[name].unit
    with case.located(key, SpaceError):
        options = _options_of(case, spec, unit, key)
        if spec.field:
            return _field(case, spec, name, options)
        if spec.regions is None:
            return fem.Scalar(**options, corrects=name in map(_offset_label, _shifted(case)))
        places = {region: item.over for region, item in spec.regions.items()}
        regions = _regions(case, places, f"{key}.regions")
        # A region may state its own prior; the others use the prior of the unknown.
        own = {}
        for region, item in spec.regions.items():
            if (there := spec.at(item)) is not None:
                where = f"{key}.regions.{region}"
                with case.located(where, SpaceError):
                    own[region] = fem.Scalar(**_options_of(case, there, unit, where))
        return fem.Piecewise(regions, **options, own=own)


def _options_of(case: CaseContent, spec: UnknownSpec, unit: str, key: str) -> dict[str, Any]:
    """Return prior, unit, within and evolution of an unknown, in the model's unit."""
    prior = _prior(case, spec, unit, key)
    options: dict[str, Any] = {"prior": prior, "unit": unit, "within": spec.within}
    if spec.evolution is not None:
        options["evolution"] = _evolution(case, spec, spec.evolution, unit, f"{key}.evolution")
    return options


def prior_of(case: CaseContent, name: str) -> float:
    """Return the prior value of an unknown in the model's unit."""
    return value_of(case, name, case.spec.unknowns[name].prior, f"unknowns.{name}.prior")


def value_of(case: CaseContent, name: str, value: float | str, key: str) -> float:
    """Return a value of an unknown in the model's unit; numbers are in the unknown's `unit`."""
    unit = case.equation.unknowns[name].unit
    if isinstance(value, str):
        return case.convert(value, unit, key)
    rule = conversion(case.spec.unknowns[name].unit or unit, unit, case.where(key))
    return rule.factor * value + rule.offset


def _prior(case: CaseContent, spec: UnknownSpec, unit: str, key: str) -> fem.Prior:
    """Return the prior of an unknown in the model's unit."""
    rule = conversion(spec.unit or unit, unit, case.where(f"{key}.unit"))

    def value(given: float | str, item: str) -> float:
        if isinstance(given, str):
            # A user's equation may define no unit, and then text cannot be converted.
            if not unit and ":" in case.spec.equation:
                text = f"got '{given}'; '{case.spec.equation}' defines no units: "
                text += f"add `{key}.unit`, or write numbers."
                raise case.error(f"{key}.{item}", text)
            return case.convert(given, unit, f"{key}.{item}")
        return rule.factor * given + rule.offset

    prior = value(spec.prior, "prior")
    # A standard deviation is a difference: the offset of a unit such as degC does not apply.
    given = spec.std if isinstance(spec.std, str) else rule.factor * spec.std
    std = case.positive(given, unit, f"{key}.std")
    low, high = -np.inf, np.inf
    if spec.bounds is not None:
        low, high = (value(bound, "bounds") for bound in spec.bounds)
        bounds = f"[{low:g}, {high:g}] {unit}".rstrip()
        if not low < high:
            raise case.error(f"{key}.bounds", f"got {bounds}; needs the lower one first.")
        if not low <= prior <= high:
            text = f"the prior {prior:g} is outside the bounds {bounds}; widen them, or check the "
            raise case.error(key, f"{text}unit of the prior.")
    if spec.transform is None:
        return fem.Normal(prior, std, (low, high))
    return _transformed(case, spec.transform, prior, std, (low, high), key)


def _transformed(
    case: CaseContent,
    transform: str,
    median: float,
    std: float,
    bounds: tuple[float, float],
    key: str,
) -> fem.Prior:
    """Return the prior of an unknown with a transform; raises `CaseError`."""
    low, high = bounds
    if transform == "log":
        if np.isfinite(high):
            raise case.error(key, "transform='log' has no upper bound; use 'logit'.")
        low = low if np.isfinite(low) else 0.0
    elif not np.isfinite(bounds).all():
        raise case.error(key, f"transform='logit' needs two finite bounds; got {bounds}.")
    if not low < median < high:
        text = f"prior {median} is outside the range of transform='{transform}': it must be between"
        text += f" {low:g} and {high:g}. To allow other values, remove `transform`."
        raise case.error(key, text)
    return (fem.LogNormal if transform == "log" else fem.LogitNormal)(median, std, (low, high))


def _evolution(
    case: CaseContent, unknown: UnknownSpec, spec: EvolutionSpec, unit: str, key: str
) -> fem.Evolution:
    """Return the evolution of an unknown; the rate is its std after one unit of time."""
    time = case.equation.time_unit
    if spec.rate is not None:
        # A rate is a difference (under a transform, of the latent value); "degC" has no quotients.
        moving = "1" if unknown.transform or not unit else unit.replace("degC", "K")
        per = f"({moving})/({time})**0.5" if time else moving.removeprefix("1")
        rate = case.positive(spec.rate, per, f"{key}.rate")
        if unknown.unit and not unknown.transform and not isinstance(spec.rate, str):
            rate *= conversion(unknown.unit, unit, case.where(key)).factor
        return fem.RandomWalk(rate)
    if spec.time is not None:
        return fem.MeanReverting(case.positive(spec.time, time, f"{key}.time"))
    return fem.Periodic(case.positive(spec.period, time, f"{key}.period"), spec.harmonics)


def _field(case: CaseContent, spec: UnknownSpec, name: str, given: Mapping[str, Any]) -> fem.Field:
    mesh = case.mesh
    # Default correlation length: a third of the extent along x.
    third, key = float(np.ptp(mesh.p[0])) / 3, f"unknowns.{name}.length"
    length = case.positive(spec.length, case.equation.length_unit, key, third)

    # In one dimension the covariance in the interior is std^2 exp(-|x - y|/length). In two and
    # three dimensions the pointwise variance for H^1 would be infinite: H^2 is used.
    dimension = len(mesh.p)
    inner = fem.Sobolev(1 if dimension == 1 else 2, length).pointwise(dimension)
    # A transform acts on coefficients, which are the values at nodes for linear elements.
    element = fem.linear(mesh) if spec.transform else case.equation.element(mesh)
    return fem.Field(mesh, element, inner=inner, **given)


def _regions(case: CaseContent, regions: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return name -> subdomain of the mesh, or indicator function of a layer or box."""
    mesh, unit = case.mesh, case.equation.length_unit
    # Midpoints of cells are tested, since a vertex on an interface would be in two regions.
    middle = mesh.p[:, mesh.t].mean(axis=1)
    count = np.zeros(middle.shape[1])
    found: dict[str, Any] = {}
    for name, given in regions.items():
        where = f"{key}.{name}"
        if isinstance(given, str):
            found[name] = subdomain(case, mesh, given, where)
            count[mesh.subdomains[given]] += 1
            continue
        found[name] = inside(case, given, len(mesh.p), where)
        here = found[name](middle)
        if not here.any():
            sides = sides_of(case, given, len(mesh.p), where)
            spans = " x ".join(f"[{low:g}, {high:g}]" for low, high in sides)
            limits = zip(mesh.p.min(axis=1), mesh.p.max(axis=1), strict=True)
            ends = " x ".join(f"{low:g} to {high:g}" for low, high in limits)
            text = f"{spans} {unit} contains no cell of the mesh, which spans {ends} {unit}."
            raise case.error(where, text)
        count += here
    wrong = np.flatnonzero(count != 1)
    if len(wrong):
        x, times = middle[:, wrong[0]], int(count[wrong[0]])
        what = "layers" if len(x) == 1 else "regions"
        point = f"{', '.join(f'{c:.4g}' for c in x)} {unit}"
        text = f"{point} lies in {times} {what}; every point has to lie in exactly one."
        raise case.error(key, text)
    return found


def _wall_layers(case: CaseContent, model: Model) -> dict[str, float]:
    """Return label of a scalar conductivity -> thickness of its layer; empty without a wall."""
    name, space = case.equation.conductivity, model.parameter_space
    unit = case.equation.unknowns[name].unit if name else ""
    if unit != "W/(m K)" or len(case.mesh.p) != 1 or model.state_space.weight is not unweighted:
        return {}
    lengths = np.ptp(case.mesh.p[0][case.mesh.t], axis=0) @ in_cells(space, case.mesh, name)
    rows = space.labels.items()
    return {label: float(lengths[k]) for label, k in rows if base_name(label) == name}


def wall_attributes(case: CaseContent, model: Model) -> dict[str, Any]:
    """Return the dataset attributes from which a wall's thermal resistance is computed, if any."""
    layers, given = _wall_layers(case, model), case.spec.output.surface_resistances
    if given is None:
        return {LAYERS: json.dumps(layers)} if layers else {}
    key = "output.surface_resistances"
    if not layers:
        raise case.error(key, "requires a wall: an interval with conductivities that are numbers.")
    surfaces = [case.convert(value, "m^2 K/W", key) for value in given]
    if min(surfaces) < 0.0:
        raise case.error(key, f"got {list(given)}; expected 0 or more.")
    return {LAYERS: json.dumps(layers), SURFACES: sum(surfaces)}


def process_notes(case: CaseContent, model: Model) -> Iterator[str]:
    """Yield notes on allowed settings that may be mistakes."""
    if _undriven(case, model):
        yield (
            "No boundary value, flux, exchange, source or input drives the process. Only the decay "
            "of its initial state depends on the unknowns. Add a channel with role = 'boundary', "
            "or a value or a flux in [boundary]."
        )
    spec, graded = case.spec.mesh, case.equation.spacing == "geometric"
    if graded and spec.start is not None and spec.spacing == "uniform":
        yield (
            "The mesh is uniform, so its cells are too large at the left end, where "
            f"'{case.equation.name}' changes most. Set `mesh.spacing = 'geometric'`."
        )
    if crossed := off_nodes(case):
        names, end = ", ".join(crossed), "end" if len(crossed) > 1 else "ends"
        yield f"{names[0].upper()}{names[1:]} {end} inside a cell. {_off_nodes_remedy(spec)}."


def _off_nodes_remedy(spec: MeshSpec) -> str:
    """Return the remedy for ends of layers and sources inside cells."""
    if spec.file is not None:
        return "Name a subdomain of the mesh file in `over`, or use smaller cells"
    if spec.cells is not None:
        return "Increase `mesh.cells`"
    return f"Add the ends to {'`mesh.nodes`' if spec.nodes else '`mesh.x` and `mesh.y`'}"


def _undriven(case: CaseContent, model: Model) -> bool:
    """Return whether only the initial state drives the process.

    Without boundary values and inputs, a constant state neither changes nor depends on the unknowns
    if A'(q), B and F vanish at it. Periodic states, which carry waves, and user equations, which
    may not be defined for every state, are not tested.
    """
    blocks = model.state_space.fields.values()
    held = any(block.field.boundary_values or block.field.periodic for block in blocks)
    own = ":" in case.spec.equation
    if own or held or model.channels or model.form_initial is not None:
        return False
    # Rounding leaves no exact zeros: terms at a constant state are compared with their size at a
    # nonuniform state.
    level = model.state_space.interpolate(1.0)
    uneven = level * (1.0 + np.arange(len(level)) % 3)
    flat, steep = (abs(model.A(u).matrix).max(axis=0).toarray() for u in (level, uneven))
    known = np.abs(model.B(level)).max() > 1e-9 * np.abs(model.B(uneven)).max()
    return not (known or model.F().any() or (flat > 1e-9 * steep).any())


def conditioned(case: CaseContent) -> CaseContent:
    """Return the case with its fluxes, sources and offsets of boundary values in the equation."""
    case = _with_offsets(case)
    spec, equation = case.spec, case.equation
    given = {name: item for name, item in spec.boundary.items() if item.passes}
    per = equation.storage if equation.storage in spec.unknowns else None
    if per is not None:
        _check_drive(case, per)
    shifted = _shifted(case)
    if not (given or spec.sources or shifted):
        return case
    units = equation.fluxes
    if units is None:
        raise _without_conditions(case, given, shifted)
    names = _ConditionNames(case)
    boundary = _boundary(names, units, given)
    sources = {
        name: (names.amount(item.value, units.source, f"sources.{name}.value"), item.over)
        for name, item in spec.sources.items()
    }
    unknowns = {**equation.unknowns, **names.unknowns}
    inputs = {**equation.inputs, **names.inputs}
    build = _Conditioned(case, names.unknowns, boundary, sources, per)
    changed = replace(equation, unknowns=unknowns, inputs=inputs, build=build)
    return replace(case, equation=changed)


@dataclass(frozen=True, eq=False)
class _Conditioned:
    """Builder of a model with the fluxes and sources of a case, for `Equation.build`."""

    case: CaseContent  # with the equation before fluxes and sources are added
    unknowns: Mapping[str, Variable]  # unknowns of fluxes and sources
    boundary: Mapping[str, list[Flux | Exchange]]
    sources: Mapping[str, tuple[Amount, Any]]
    per: str | None

    def __call__(
        self, mesh: Any, unknowns: Mapping[str, Any], dirichlet: Mapping[str, Any], **options: Any
    ) -> Model:
        case = self.case
        # The unknowns of fluxes and sources are added after the model of the equation is built.
        more = {name: item for name, item in unknowns.items() if name in self.unknowns}
        own = {name: item for name, item in unknowns.items() if name not in more}
        for name in self.boundary:
            case.require(name, mesh.boundaries or {}, "boundary", f"no boundary '{name}'")
        placed = {
            name: Source(amount, None if over is None else _place(case, mesh, over, name))
            for name, (amount, over) in self.sources.items()
        }
        model = case.equation.build(mesh, own, dirichlet, **options)
        with case.located("boundary", ModelError):
            return with_conditions(model, self.boundary, placed, more, self.per)


def _boundary(
    names: _ConditionNames, units: Fluxes, given: Mapping[str, BoundarySpec]
) -> dict[str, list[Flux | Exchange]]:
    """Return boundary -> its conditions, for a flux or an unknown offset of its value."""
    case = names.case
    found = {name: _passing(names, units, name, item) for name, item in given.items()}
    for name, channel in _shifted(case).items():
        key, at = f"channels.{name}.at", str(channel.at)
        if at in case.spec.boundary or at in found:
            raise case.error(key, f"the boundary '{at}' has a condition already; keep one.")
        found[at] = _near(names, name)
    return found


def _without_conditions(
    case: CaseContent, given: Iterable[str], shifted: Iterable[str]
) -> CaseError:
    """Return the error for conditions and sources that the equation does not support."""
    name = case.equation.name
    keys = [*(f"boundary.{n}" for n in given), *(f"sources.{n}" for n in case.spec.sources)]
    if not keys:
        key = f"channels.{next(iter(shifted))}.offset"
        text = f"the offset of a boundary value of '{name}' cannot be an unknown; leave it out, or "
        return case.error(key, f"{text}correct the column with `data.reader`.")
    known = [other for other, one in EQUATIONS.items() if one.fluxes is not None]
    text = f"the equation '{name}' takes no fluxes and no sources of a case; "
    return case.error(keys[0], f"{text}{', '.join(known)} do.")


def _shifted(case: CaseContent) -> dict[str, ChannelSpec]:
    """Return the boundary channels with an unknown offset."""
    return {n: one for n, one in case.roles("boundary").items() if one.offset is not None}


def _offset_label(name: str) -> str:
    return "offset_" + re.sub(r"\W", "_", name)


def _with_offsets(case: CaseContent) -> CaseContent:
    """Return the case with an additional unknown for each offset of a boundary value."""
    added: dict[str, UnknownSpec] = {}
    for name, channel in _shifted(case).items():
        label, key = _offset_label(name), f"channels.{name}.offset"
        if label in case.spec.unknowns or label in added:
            raise case.error(key, f"'{label}' is its unknown; give the other one another name.")
        std = case.positive(channel.offset, case.equation.state.unit, key)
        added[label] = UnknownSpec(prior=0.0, std=std)
    if not added:
        return case
    unknowns = {**case.spec.unknowns, **added}
    return replace(case, spec=case.spec.model_copy(update={"unknowns": unknowns}))


def _near(names: _ConditionNames, name: str) -> list[Flux | Exchange]:
    """Return the conditions that impose u = channel - offset, with an unknown offset.

    They are D u_n = h (channel - offset - u), with h so large that u differs from the imposed value
    by 1e-4 of its change over a cell.
    """
    case, label = names.case, _offset_label(name)
    state = case.equation.state.unit
    names.unknowns[label] = Variable("K" if state == "degC" else state, f"offset of {name}")
    D = prior_of(case, next(iter(case.equation.unknowns)))
    dimension, cells = len(case.mesh.p), case.mesh.t.shape[1]
    cell = float(np.ptp(case.mesh.p, axis=1).max()) / cells ** (1.0 / dimension)
    h = HELD * D / cell
    return [Exchange(h, fem.Channel(name)), Flux(Multiple(label, -h))]


def _check_drive(case: CaseContent, storage: str) -> None:
    """Refuse an unknown heat capacity if no flux, exchange or source is known.

    The equation and all its unknowns could then be multiplied by an arbitrary factor.
    """
    spec = case.spec
    amounts = [amount for item in spec.boundary.values() for amount in (item.flux, item.transfer)]
    amounts += [item.value for item in spec.sources.values()]
    known = any(amount not in (None, 0.0) and amount not in spec.unknowns for amount in amounts)
    if known or any(item.is_flux for item in case.roles("sensor").values()):
        return
    text = (
        f"temperatures alone do not determine '{storage}'; it requires a known flux, exchange or "
        "source, or a measured flux. Add one, such as boundary.left = { flux = 'CHANNEL' } or a "
        f"sensor with quantity = 'flux' of a heat-flux plate, or state options.{storage}."
    )
    raise case.error(f"unknowns.{storage}", text)


def _passing(
    names: _ConditionNames, units: Fluxes, name: str, given: BoundarySpec
) -> list[Flux | Exchange]:
    """Return the flux and exchange conditions of a boundary."""
    found: list[Flux | Exchange] = []
    key = f"boundary.{name}"
    if given.flux is not None:
        found.append(Flux(names.amount(given.flux, units.flux, f"{key}.flux")))
    if given.transfer is not None and given.ambient is not None:
        # Robin condition: D u_n = h (ambient - u).
        h = names.amount(given.transfer, units.transfer, f"{key}.transfer")
        unit = names.case.equation.state.unit
        found.append(Exchange(h, names.amount(given.ambient, unit, f"{key}.ambient")))
    return found


@dataclass
class _ConditionNames:
    """Collector of the unknowns and inputs in the conditions of a case, with their units."""

    case: CaseContent
    unknowns: dict[str, Variable] = field(default_factory=dict)
    inputs: dict[str, Variable] = field(default_factory=dict)

    def amount(self, value: float | str, unit: str, key: str) -> Amount:
        """Return an amount: a number in the model's unit, a channel, or the name of an unknown."""
        spec = self.case.spec
        if isinstance(value, str) and value in spec.unknowns:
            self._named("unknowns", value, unit, key)
            return value
        if isinstance(value, str) and value in spec.channels:
            if spec.channels[value].role != "input":
                raise self.case.error(key, f"the channel '{value}' has to be of role 'input'.")
            self._named("inputs", value, unit, key)
            return fem.Channel(value)
        # Text without a digit is a misspelt name, not a quantity.
        if isinstance(value, str) and not any(letter.isdigit() for letter in value):
            text = f"there is no unknown and no channel '{value}'; "
            text += did_you_mean(value, [*spec.unknowns, *spec.channels])
            raise self.case.error(key, text)
        return self.case.convert(value, unit, key)

    def _named(self, what: str, name: str, unit: str, key: str) -> None:
        """Register an unknown or an input of a condition; raises `CaseError` on a conflict."""
        found, taken = getattr(self, what), getattr(self.case.equation, what)
        # Several conditions may share a name if it has the same unit in all of them.
        before, clash = found.get(name) or taken.get(name), what == "unknowns" and name in taken
        if before is not None and (clash or before.unit != unit):
            text = f"'{name}' is the {before.text} [{before.unit}] already; take another name."
            raise self.case.error(key, text)
        found.setdefault(name, Variable(unit, key.removeprefix("boundary.").replace(".", ", ")))


def _place(case: CaseContent, mesh: Any, over: Any, name: str) -> Any:
    """Return the region of a source: the name of a subdomain, or an indicator function of x."""
    key = f"sources.{name}.over"
    if isinstance(over, str):
        return subdomain(case, mesh, over, key)
    place = inside(case, over, len(mesh.p), key)
    if not np.any(place(mesh.p[:, mesh.t].mean(axis=1))):
        raise case.error(key, "contains no cell of the mesh.")
    return place
