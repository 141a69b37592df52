"""Channels of a case: columns, sensors with their unknowns, noise, initial state."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from livepde import fem, observation
from livepde.cases import schema
from livepde.cases.case_content import CaseContent, inside
from livepde.cases.read import did_you_mean, is_blank
from livepde.errors import CaseError, MissingInputError, SpaceError
from livepde.linalg import Array
from livepde.observation.sensors import POSITION, shift_names
from livepde.samples import Sample, by_name, noise_channel
from livepde.stepping import Between
from livepde.streams import Column
from livepde.units import (
    AFTER_A_WORD,
    AFTER_SLASH,
    IN_BRACKETS,
    conversion,
    is_other_kind,
    other_unit,
)

# Key of an initial state that is interpolated from the first sample, without any uncertainty.
EXACT = "interpolate-exact"
INTERPOLATED = ("readings", "interpolate", EXACT)  # "interpolate" is a synonym of "readings"

Kinds: TypeAlias = dict[tuple[str, str | None, str], dict[str, schema.ChannelSpec]]
"""(kind of sensor, component of the state, time constant as text) -> its channels."""
MEMBERS = 10_000  # largest number of channels of a family


def columns_of(case: CaseContent) -> dict[str, Column]:
    """Return channel -> its column in the data, with noise columns under `noise_channel(name)`."""
    found, decimal = {}, case.spec.data.decimal
    for name, channel in case.spec.channels.items():
        unit = case.unit(name)
        _check_stated(case, name, unit)
        with case.of_state(unit):
            rule = conversion(channel.unit or unit, unit, case.where(f"channels.{name}.unit"))
        valid = (-np.inf, np.inf)
        if channel.valid is not None:
            valid = case.pair(channel.valid, unit, f"channels.{name}.valid")
        needed, factor = channel.gaps == "skip", (channel.factor or 1.0) * rule.factor
        common: dict[str, Any] = {"decimal": decimal, "between": channel.between}
        found[name] = Column(channel.sources, factor, rule.offset, valid, needed, **common)
        if channel.noise_column is None:
            continue
        key, noise = f"channels.{name}.noise_column", noise_channel(name)
        if isinstance(case.spec.law, schema.GradientSpec):
            raise case.error(key, "the gradient law does not weight readings: leave it out.")
        if noise in case.spec.channels:
            raise case.error(key, f"another channel is called '{noise}': rename it.")
        found[noise] = Column((channel.noise_column,), abs(factor), decimal=decimal, noise_of=name)
    return found


def _check_stated(case: CaseContent, name: str, unit: str) -> None:
    """Refuse a column whose name states a unit that differs from the unit of its channel."""
    channel = case.spec.channels[name]
    if channel.unit or channel.factor is not None:
        return
    for column in channel.sources:
        if given := other_unit(column, unit, IN_BRACKETS, AFTER_SLASH, AFTER_A_WORD):
            raise case.error(
                f"channels.{name}.unit",
                f"the name of the column '{column}' states the unit '{given}', which is not that "
                f"of the model: set unit = '{given}', or unit = '{unit}' if the name is wrong.",
            )
        stated = IN_BRACKETS.search(column)
        text = stated[1] if stated and not _may_be_place(stated[1], channel) else ""
        if is_other_kind(text, unit):
            raise case.error(
                f"channels.{name}",
                f"the name of the column '{column}' states the unit '{text}', and the model "
                f"is in {unit}: set factor, by which its numbers are multiplied, or "
                f"unit = '{unit}' if the name is wrong.",
            )


def _may_be_place(text: str, channel: schema.ChannelSpec) -> bool:
    """Return whether a text in brackets may be a position or a word, as in T (in) or T (min)."""
    return "/" not in text and (channel.role != "input" or text in ("in", "min"))


def observation_of(case: CaseContent, *roles: str) -> observation.Observation | None:
    """Return the observation operator of the channels with given roles; None without channels."""
    channels, assimilated = case.roles(*roles), "sensor" in roles
    if not channels:
        return None
    kinds = kinds_of(channels)
    names = [*chain.from_iterable(kinds.values())]
    levels = noise_of(case) if assimilated else None
    units = {case.unit(name) for name in names}
    outer: dict[str, Any] = {
        "noise": levels and list(map(levels.__getitem__, names)),
        # If the units differ, each part of the observation has its own unit.
        "unit": units.pop() if len(units) == 1 else "",
        "reconstruction": _reconstruction(case) if assimilated else observation.Pseudoinverse(),
    }
    if assimilated and any(one.is_calibrated for one in channels.values()):
        return _calibrated(case, _whole(case, kinds, {}), names, **outer)
    return _whole(case, kinds, outer)


def kinds_of(channels: Mapping[str, schema.ChannelSpec]) -> Kinds:
    """Group sensors by kind, component of the state and time constant, one observation each."""
    kinds: Kinds = {}
    for name, channel in channels.items():
        slow = "" if channel.time_constant is None else str(channel.time_constant)
        kinds.setdefault((_kind(channel), channel.of, slow), {})[name] = channel
    return kinds


def _whole(case: CaseContent, kinds: Kinds, outer: Mapping[str, Any]) -> observation.Observation:
    """Return one observation of all kinds, constructed with the keyword arguments `outer`."""
    common = outer if len(kinds) == 1 else {}
    parts = []
    for (kind, of, slow), members in kinds.items():
        own = {"unit": case.unit(next(iter(members))), **common}
        part = _part(case, kind, members, {} if slow else own, of)
        parts.append(observation.Slow(part, _constant(case, members), **own) if slow else part)
    return parts[0] if len(parts) == 1 else observation.Combined(parts, **outer)


def _constant(case: CaseContent, channels: Mapping[str, schema.ChannelSpec]) -> float | fem.Prior:
    """Return the time constant of a group of channels; a prior if it is unknown and assimilated."""
    (name, channel), *_ = channels.items()
    given, key, unit = (
        channel.time_constant,
        f"channels.{name}.time_constant",
        case.equation.time_unit,
    )
    if not isinstance(given, schema.TimeConstantSpec):
        return case.positive(given, unit, key)
    value = case.positive(given.value, unit, f"{key}.value")
    if channel.role != "sensor":
        return value
    return fem.LogNormal(value, case.positive(given.std, unit, f"{key}.std"))


def _kind(channel: schema.ChannelSpec) -> str:
    """Return the kind of a sensor: the quantity "flux", or the key that states its place."""
    if channel.is_flux:
        return schema.FLUX
    given = (key for key in ("over", "along", "follows") if getattr(channel, key) is not None)
    return next(given, "at")


def _regions(case: CaseContent, channels: Mapping[str, schema.ChannelSpec]) -> dict[str, Any]:
    """Return channel -> part of the mesh over which its mean is taken."""
    known = {**(case.mesh.boundaries or {}), **(case.mesh.subdomains or {})}
    regions: dict[str, Any] = {}
    for name, item in channels.items():
        key = f"channels.{name}.over"
        if isinstance(item.over, str):
            case.require(item.over, known, key, f"the mesh has no part '{item.over}'")
            regions[name] = item.over
        else:
            regions[name] = inside(case, item.over, len(case.mesh.p), key, closed=True)
    return regions


def _followed(
    case: CaseContent, channels: Mapping[str, schema.ChannelSpec]
) -> dict[str, tuple[str, ...]]:
    """Return moving sensor -> the channels that contain its position."""
    positions: dict[str, tuple[str, ...]] = {}
    known, needed = case.roles("position"), len(case.mesh.p)
    for name, item in channels.items():
        key = f"channels.{name}.follows"
        given = item.follows if isinstance(item.follows, tuple) else (str(item.follows),)
        for channel in given:
            case.require(channel, known, key, f"there is no channel '{channel}' of role position")
        if len(given) != needed:
            text = f"got {len(given)} channels; needs one for each of {needed} coordinates."
            raise case.error(key, text)
        positions[name] = given
    return positions


def _part(
    case: CaseContent,
    kind: str,
    channels: Mapping[str, schema.ChannelSpec],
    common: Mapping[str, Any],
    of: str | None,
) -> observation.Observation:
    """Return the observation of channels of one kind and one component of the state."""
    if of is not None:
        common = {**common, "of": of}
    if kind == schema.FLUX:
        places = {name: _flux_place(case, name, item) for name, item in channels.items()}
        return observation.FluxPlates(places, case.equation.conductivity, **common)
    if kind == "over":
        return observation.Averages(_regions(case, channels), **common)
    if kind == "along":
        lines: dict[str, Any] = {
            name: tuple(_inside_mesh(case, at, f"channels.{name}.along") for at in item.along or ())
            for name, item in channels.items()
        }
        return observation.LineIntegrals(lines, mean=True, **common)
    if kind == "follows":
        return observation.Moving(_followed(case, channels), **common)
    return _points(case, channels, common)


def _points(
    case: CaseContent, channels: Mapping[str, schema.ChannelSpec], common: Mapping[str, Any]
) -> observation.Points:
    """Return the observation of sensors at points."""
    points = {name: _position(case, name, item) for name, item in channels.items()}
    constants = case.constants
    direct = {  # direct dependence of a quantity on the parameter
        name: fem.with_constants(
            case.equation.quantities[item.quantity].direct(case.options), constants
        )
        for name, item in channels.items()
        if item.quantity is not None
    }
    stds = _stated(case, "at_std", "sensor")
    uncertain = {name: std for name, std in stds.items() if name in channels}
    # If one point sensor states a component, all sensors of its group must.
    numbers = [item.component for item in channels.values()]
    if set(numbers) != {None}:
        if None in numbers:
            key = f"channels.{list(channels)[numbers.index(None)]}.component"
            raise case.missing(key, "the component of the vector that it measures.")
        common = {**common, "component": numbers}
    return observation.Points(points, direct, uncertain or None, **common)


def _flux_place(case: CaseContent, name: str, channel: schema.ChannelSpec) -> float | str:
    """Return where a flux is measured: the name of an end of the mesh, or a position."""
    if not case.equation.conductivity:
        text = f"the equation '{case.equation.name}' has no flux to measure; leave it out."
        raise case.error(f"channels.{name}.quantity", text)
    if len(case.mesh.p) != 1:
        text = "'flux' requires an interval; use livepde.observation.Functionals in Python."
        raise case.error(f"channels.{name}.quantity", text)
    if isinstance(channel.at, str) and channel.at in (case.mesh.boundaries or {}):
        return channel.at
    place: float = _inside_mesh(case, channel.at, f"channels.{name}.at")
    return place


def _reconstruction(case: CaseContent) -> observation.Reconstruction:
    """Return the reconstruction of the observed part that `law.tikhonov` selects."""
    law = case.spec.law
    given = law.tikhonov if isinstance(law, schema.GradientSpec) else False
    if given is False:
        return observation.Pseudoinverse()
    spec = schema.TikhonovSpec() if given is True else given
    alpha = observation.Discrepancy(spec.tau) if spec.alpha == "discrepancy" else spec.alpha
    if spec.alpha == "discrepancy" and noise_of(case) is None:
        text = "the discrepancy principle needs the noise of every sensor; or give alpha a number."
        raise case.error("law.tikhonov.alpha", text)
    return observation.Tikhonov(spec.norm, alpha)


def _position(case: CaseContent, name: str, channel: schema.ChannelSpec) -> Any:
    """Return the position of a point sensor: a number, or a list of coordinates."""
    if channel.quantity is None:
        return _inside_mesh(case, channel.at, f"channels.{name}.at")
    known, asked, x = case.equation.quantities, channel.quantity, case.mesh.p[0]
    text = f"'{case.equation.name}' has no quantity '{asked}'"
    case.require(asked, known, f"channels.{name}.quantity", text)
    return known[asked].at(float(x.min()), float(x.max()))


def _inside_mesh(case: CaseContent, at: Any, key: str) -> Any:
    """Return a position, which must lie in the mesh: a number, or a list of coordinates."""
    low, high = case.mesh.p.min(axis=1), case.mesh.p.max(axis=1)
    given = at if isinstance(at, tuple) else (at,)
    unit = case.equation.length_unit
    point = [case.convert(value, unit, key) for value in given]
    if len(point) != len(low):
        raise case.error(key, f"got {len(point)} coordinates; needs {len(low)}.")
    for x, left, right in zip(point, low, high, strict=True):
        slack = 1e-9 * (right - left)
        if not left - slack <= x <= right + slack:
            raise case.error(
                key,
                f"{x:g} {unit} lies outside the mesh, which spans {left:g} to {right:g} {unit}; "
                "check the position and its unit.",
            )
    place = [float(np.clip(x, a, b)) for x, a, b in zip(point, low, high, strict=True)]
    return place[0] if len(place) == 1 else place


def flux_notes(case: CaseContent) -> Iterator[str]:
    """Yield a note for each flux measured at a boundary whose value is noisy."""
    noisy = {item.at: name for name, item in case.roles("boundary").items() if item.noise}
    for name, item in case.roles("sensor").items():
        if item.is_flux and item.at in noisy:
            other = noisy[item.at]
            yield (
                f"The noise of {other} between readings moves the flux that {name} measures at "
                f"'{item.at}'. Make {other} a sensor at that end, and the flux an unknown that "
                f"moves: boundary.{item.at} = {{ flux = 'J' }} with unknowns.J.evolution."
            )


def cell_notes(case: CaseContent) -> Iterator[str]:
    """Yield a note if all sensors lie in one cell."""
    shown = case.roles(*schema.SENSORS).items()
    channels = {name: item for name, item in shown if not item.is_flux}
    if len(case.mesh.p) != 1 or not channels or any(item.at is None for item in channels.values()):
        return
    at = {float(_position(case, name, item)) for name, item in channels.items()}
    cells = set(np.searchsorted(np.sort(case.mesh.p[0]), list(at)).tolist())
    if len(at) > 1 and len(cells) == 1:
        yield (
            f"All sensors ({', '.join(channels)}) lie in one cell of the mesh, which barely "
            "distinguishes them. Increase `mesh.cells`, or refine the left end with "
            "`mesh.spacing = 'geometric'`."
        )


def noise_of(case: CaseContent) -> dict[str, float] | None:
    """Return the noise of each assimilated sensor; None if no sensor states its noise."""
    channels, levels = case.roles("sensor"), _stated(case, "noise", "sensor")
    if levels and len(levels) < len(channels):
        missing = next(name for name, item in channels.items() if item.noise is None)
        text = "give every sensor its noise, or none and law.noise instead."
        raise case.missing(f"channels.{missing}.noise", text)
    return levels or None


def input_noise_of(case: CaseContent) -> dict[str, float]:
    """Return the noise of the boundary and input channels that state one."""
    return _stated(case, "noise", "boundary", "input")


def between_of(case: CaseContent) -> dict[str, Between]:
    """Return channel -> interpolation between readings, for channels that are not linear."""
    channels = case.roles("boundary", "input")
    return {name: item.between for name, item in channels.items() if item.between != "line"}


def initial_of(case: CaseContent, first: Sample) -> Any:
    """Return the initial state: a number, numbers by component, or an interpolant as f(x)."""
    stated, unit = case.spec.initial, case.equation.state.unit
    if stated is None:
        raise case.missing("initial", "a number, or 'interpolate' from the first sample.")
    if isinstance(stated, dict):
        return {name: case.convert(v, unit, f"initial.{name}") for name, v in stated.items()}
    initial = stated.start
    if initial not in INTERPOLATED:
        if isinstance(initial, str) and not any(letter.isdigit() for letter in initial):
            text = f"got '{initial}'; {did_you_mean(initial, [*INTERPOLATED, 'a number'])}"
            raise case.error("initial", text)
        return case.convert(initial, unit, "initial")
    if len(case.mesh.p) != 1:
        raise case.error("initial", f"'{initial}' needs an interval; give a number.")
    return partial(_interpolated, *_level(_initial_readings(case, first)))


def initial_weights(case: CaseContent, first: Sample) -> dict[str, Any]:
    """Return channel -> (derivative of the initial state in its reading, noise of the reading).

    The derivative is a function of x; NaN means the noise of the sensor. Empty without uncertainty.
    """
    if not _made_of_readings(case):
        return {}
    readings, given, found = _initial_readings(case, first), by_name(first.z, ()), {}
    for number, one in enumerate(readings):
        # The derivative in a reading interpolates 1 for this reading and 0 for the others.
        unit = [other._replace(value=float(n == number)) for n, other in enumerate(readings)]
        weight = partial(_interpolated, *_level(unit))
        found[one.channel] = (weight, given.get(noise_channel(one.channel), np.nan))
    return found


def interpolates(case: CaseContent) -> bool:
    """Return whether the initial state is interpolated from the first readings."""
    initial = case.spec.initial
    return isinstance(initial, schema.InitialSpec) and initial.start in INTERPOLATED


def profile_sensors(case: CaseContent) -> list[str]:
    """Return the sensors from which the initial state is interpolated."""
    known = case.roles("sensor") if interpolates(case) else {}
    return [name for name, one in known.items() if one.at is not None and not one.is_flux]


def _made_of_readings(case: CaseContent) -> bool:
    """Return whether the initial state is interpolated from readings with uncertainty."""
    initial = case.spec.initial
    exact = isinstance(initial, schema.InitialSpec) and initial.start == EXACT
    return interpolates(case) and not exact and len(case.mesh.p) == 1


def initial_errors(case: CaseContent, first: Sample) -> tuple[Any, ...]:
    """Return the errors of the initial state itself as functions of x, see `random_field`."""
    initial = case.spec.initial
    if initial is None or isinstance(initial, dict):
        return ()
    unit = "K" if (of := case.equation.state.unit) == "degC" else of
    std = None if initial.std is None else case.positive(initial.std, unit, "initial.std")
    unit = case.equation.length_unit
    length = None if (L := initial.length) is None else case.positive(L, unit, "initial.length")
    known = None
    if _made_of_readings(case):
        known = dict(zip(*_level(_initial_readings(case, first)), strict=True))
    with case.located("initial", SpaceError):
        return fem.random_field(case.mesh, std, known=known, length=length)


def check_initial(case: CaseContent) -> None:
    """Refuse an uncertainty of the initial state that the run could not use."""
    initial = case.spec.initial
    if initial is None or isinstance(initial, dict) or (initial.std, initial.length) == (None,) * 2:
        return
    key = "initial.std" if initial.std is not None else "initial.length"
    if initial.start == EXACT:
        raise case.error(key, f"'{EXACT}' has no errors; use from = 'readings'.")
    if initial.std is None and not _made_of_readings(case):
        raise case.error(key, "requires the standard deviation of the start; add initial.std.")
    if case.equation.components:
        raise case.error(key, "is only valid for a state of one component; leave it out.")
    if (kind := case.spec.law.kind) != "sensitivity":
        raise case.error(key, f"law.kind = '{kind}' has no covariance for it; leave it out.")


def _interpolated(at: Sequence[float], values: Sequence[float], x: Any) -> Any:
    return np.interp(x[0], at, values)


class _Reading(NamedTuple):
    """A reading from which the initial state is interpolated."""

    at: float
    value: float
    channel: str


def _level(readings: Sequence[_Reading]) -> tuple[list[float], list[float]]:
    """Return the sorted positions of readings, and the mean reading at each position."""
    places = sorted({one.at for one in readings})
    return places, [fmean(one.value for one in readings if one.at == place) for place in places]


def _initial_readings(case: CaseContent, first: Sample) -> list[_Reading]:
    """Return the readings of sensors and end values in the first sample that are not missing."""
    ends = {"left": float(case.mesh.p.min()), "right": float(case.mesh.p.max())}
    values, sensors = by_name(first.z, ()), profile_sensors(case)
    found = []
    for name, channel in case.roles("sensor", "boundary").items():
        if channel.role == "boundary" and channel.at in ends:
            found.append(_Reading(ends[str(channel.at)], values[name], name))
        elif name in sensors:
            found.append(_Reading(_position(case, name, channel), values[name], name))
    present = [one for one in found if np.isfinite(one.value)]
    if not present:
        raise MissingInputError(
            f"{case.where('initial')}: 'interpolate' found no sensor or boundary with a value in "
            "the first sample; start later, or give a number."
        )
    return present


def expanded(case: CaseContent) -> CaseContent:
    """Return the case with each family (`each` or `positions`) expanded to single channels."""
    channels: dict[str, schema.ChannelSpec] = {}
    families: dict[str, str] = {}
    for name, channel in case.spec.channels.items():
        if channel.each is not None:
            key, members = f"channels.{name}.each", _evenly(case, name, channel)
        elif channel.positions is not None:
            key, members = f"channels.{name}.positions", _listed(case, name, channel)
        else:
            channels[name] = channel
            continue
        for label, (at, column) in members.items():
            if label in case.spec.channels or label in channels:
                raise case.error(key, f"there is a channel '{label}' already; rename it.")
            member = {"each": None, "positions": None, "at": at, "column": column}
            channels[label] = channel.model_copy(update=member)
            families[label] = name
    spec = case.spec.model_copy(update={"channels": channels})
    return replace(case, spec=spec, families=families)


def split_families(
    document: Mapping[str, Any], names: Collection[str], content: Callable[[], CaseContent]
) -> None:
    """Replace in a document each family with a member in `names` by single channels.

    `content` returns the content of the document, with its families.
    """
    channels = document.get("channels")
    if not isinstance(channels, dict) or set(names) <= channels.keys():
        return
    case = content()
    split = {case.families[name] for name in names if name in case.families}
    for label, family in case.families.items():
        if family in split:
            member = case.spec.channels[label]
            at = list(member.at) if isinstance(member.at, tuple) else member.at
            given = {**channels[family], "at": at, "column": member.column}
            given.pop("each", None)
            given.pop("positions", None)
            channels[label] = given
    for family in split:
        del channels[family]


def _evenly(
    case: CaseContent, name: str, channel: schema.ChannelSpec
) -> dict[str, tuple[Any, str]]:
    """Return position and column of each sensor of an evenly spaced family."""
    start, stop, count = channel.each or (0.0, 0.0, 0)
    unit, key = case.equation.length_unit, f"channels.{name}.each"
    if count > MEMBERS:
        raise case.error(key, f"got {count} channels; expected at most {MEMBERS}.")
    ends = (case.convert(start, unit, key), case.convert(stop, unit, key))
    return {
        f"{name}_{k}": (x, str(channel.column).replace("{}", str(k)))
        for k, x in enumerate(np.linspace(*ends, count).tolist())
    }


def _listed(
    case: CaseContent, name: str, channel: schema.ChannelSpec
) -> dict[str, tuple[Any, str]]:
    """Return position and column of each sensor of a table of positions."""
    key, file = f"channels.{name}.positions", case.path.parent / str(channel.positions)
    found: dict[str, tuple[Any, str]] = {}
    # Row 1 of the file is its header.
    for row, (label, *cells) in enumerate(_positions_table(case, key, file), 2):
        if not label or label in found:
            what = f"the name '{label}' occurs twice" if label else "the name is missing"
            raise case.error(key, f"{file}, row {row}: {what}.")
        place = tuple(_coordinate(case, cell, f"{key}: {file}, row {row}") for cell in cells)
        column = str(channel.column or "{}").replace("{}", label)
        found[label] = (place if len(place) > 1 else place[0], column)
    return found


def _positions_table(case: CaseContent, key: str, file: Path) -> Iterable[Sequence[str]]:
    """Return name, x (and y, z) of each row of a table as text; empty cells are empty text."""
    import pandas as pd  # slow to import, and most cases do not need it

    try:
        table = pd.read_csv(file, dtype=str, nrows=MEMBERS + 1, skipinitialspace=True).fillna("")
    except (OSError, ValueError) as error:
        raise case.error(key, f"{file} cannot be read as a CSV table: {error}.") from None
    axes = [axis for axis in "xyz" if axis in table.columns]
    if "name" not in table.columns or not axes:
        got = ", ".join(map(str, table.columns[:8]))
        raise case.error(key, f"{file}: got the columns {got}; expected name, x (and y, z).")
    if len(table) > MEMBERS:
        raise case.error(key, f"{file} has more than {MEMBERS} sensors.")
    rows = enumerate(table[axes].to_numpy(), 2)
    blank = [
        f"{file}, row {k}: replace '?' by a value." for k, row in rows if any(map(is_blank, row))
    ]
    if blank:
        raise CaseError("\n".join(blank))
    named: Iterable[Sequence[str]] = table[["name", *axes]].to_numpy()
    return named


def _coordinate(case: CaseContent, cell: str, where: str) -> float:
    try:
        value: float | str = float(cell)
    except ValueError:
        value = cell
    number = case.convert(value, case.equation.length_unit, where)
    if not np.isfinite(number):
        raise case.error(where, f"got '{cell}'; expected a coordinate.")
    return number


def unknowns_of(case: CaseContent) -> dict[str, fem.Unknown]:
    """Return the unknowns of the sensors by kind (offset, gain, ...), one number per sensor."""
    state = case.equation.state.unit
    found: dict[str, fem.Unknown] = {}
    # Temperature differences are in K.
    unit = "K" if state == "degC" else state
    if offsets := _stated(case, "offset", "sensor"):
        own = _one_unit(case, offsets)
        prior = fem.Normal(0.0, _common(case, offsets, "offset"))
        found["offset"] = fem.Scalars(tuple(offsets), prior, unit=unit if own == state else own)
    # A gain is a dimensionless factor, 1 for an exact sensor.
    if gains := _stated(case, "gain", "sensor"):
        found["gain"] = fem.Scalars(tuple(gains), fem.Normal(1.0, _common(case, gains, "gain")))
    if stds := _stated(case, "at_std", "sensor"):
        dimension = len(case.mesh.p)
        names = [shift for name in stds for shift in shift_names(name, dimension)]
        prior = fem.Normal(0.0, _common(case, stds, "at_std"))
        found[POSITION] = fem.Scalars(names, prior, unit=case.equation.length_unit)
    if errors := _correlated(case):
        std, time = _common(case, errors, "correlated")
        # An Ornstein-Uhlenbeck process: stationary standard deviation and correlation time.
        prior, fades = fem.Normal(0.0, std), fem.MeanReverting(time)
        found["correlated"] = fem.Scalars(tuple(errors), prior, unit=unit, evolution=fades)
    if constants := _unknown_constants(case):
        prior = _common(case, constants, "time_constant")
        unit = case.equation.time_unit
        found["time_constant"] = fem.Scalars(tuple(constants), prior, unit=unit)
    return found


def _one_unit(case: CaseContent, offsets: Iterable[str]) -> str:
    """Return the common unit of sensors with offsets; raises `CaseError` if units differ."""
    first, *others = offsets
    for name in others:
        if case.unit(name) != case.unit(first):
            text = f"is in {case.unit(name)}, and other offsets are in {case.unit(first)}"
            raise case.error(f"channels.{name}.offset", f"{text}; all share one prior.")
    return case.unit(first)


def _correlated(case: CaseContent) -> dict[str, tuple[float, float]]:
    """Return standard deviation and correlation time of the correlated errors of sensors."""
    found = {}
    for name, item in case.roles("sensor").items():
        if (fading := item.correlated) is not None:
            key = f"channels.{name}.correlated"
            std = case.positive(fading.std, case.equation.state.unit, f"{key}.std")
            found[name] = std, case.positive(fading.time, case.equation.time_unit, f"{key}.time")
    return found


def _unknown_constants(case: CaseContent) -> dict[str, float | fem.Prior]:
    """Return the prior of each unknown time constant."""
    return {
        name: _constant(case, {name: item})
        for name, item in case.roles("sensor").items()
        if isinstance(item.time_constant, schema.TimeConstantSpec)
    }


def _stated(case: CaseContent, key: str, *roles: str) -> dict[str, float]:
    """Return the numbers > 0 that channels state for a key, in the unit of the key or channel."""
    units = {"gain": "", "at_std": case.equation.length_unit}
    return {
        name: case.positive(value, units.get(key, case.unit(name)), f"channels.{name}.{key}")
        for name, item in case.roles(*roles).items()
        if (value := getattr(item, key)) is not None
    }


def _common(case: CaseContent, given: Mapping[str, Any], key: str) -> Any:
    """Return the common value of all sensors, which share a prior; values must not differ."""
    (first, value), *others = given.items()
    for name, other in others:
        if other != value:
            text = f"differs from that of '{first}'; all sensors share one prior."
            raise case.error(f"channels.{name}.{key}", text)
    return value


def _calibrated(
    case: CaseContent, base: observation.Observation, names: Sequence[str], **options: Any
) -> observation.Observation:
    """Return the observation gain * (reading of the base) + offset + correlated error."""
    channels = [case.spec.channels[name] for name in names]
    gains = [(k, n) for k, n in enumerate(names) if channels[k].gain is not None]
    added = {
        kind: [(k, n) for k, n in enumerate(names) if getattr(channels[k], kind) is not None]
        for kind in ("offset", "correlated")
    }
    known = list(zip(names, channels, strict=True))
    units = np.eye(len(names))
    columns = {f"{kind}[{n}]": units[k] for kind, some in added.items() for k, n in some}

    def reading(y: Array, q: Any, x: Any) -> Array:
        slopes, _ = derivatives(y, q, x)
        z = slopes * y
        for kind, some in added.items():
            for k, name in some:
                z[k] += getattr(q, kind)[name]
        return z

    def derivatives(y: Array, q: Any, x: Any) -> tuple[Array, dict[str, Array]]:
        slopes = np.array([q.gain[n] if c.gain is not None else 1.0 for n, c in known])
        return slopes, columns | {f"gain[{name}]": y[k] * units[k] for k, name in gains}

    return observation.Calibrated(base, reading, derivatives, adds=not gains, **options)
