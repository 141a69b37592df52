"""The channels of a case: columns, positions, noise, observations, initial state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from statistics import fmean
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from livepde.cases.case_frame import Frame
from livepde.cases.case_model import constants_of
from livepde.cases.instruments import calibrated, positions_of
from livepde.cases.read import did_you_mean
from livepde.cases.regions import sides_of
from livepde.cases.schema import ChannelSpec, GradientSpec, TikhonovSpec
from livepde.cases.units import conversion
from livepde.errors import MissingInputError
from livepde.fem import with_constants
from livepde.identifier import Sample
from livepde.observation import (
    Averages,
    Combined,
    Discrepancy,
    LineIntegrals,
    Moving,
    Observation,
    Points,
    Pseudoinverse,
    Reconstruction,
    Tikhonov,
)
from livepde.samples import by_name, noise_channel
from livepde.streams import Column

__all__ = [
    "columns_of",
    "initial_of",
    "initial_weights",
    "input_noise_of",
    "noise_of",
    "observation_of",
    "sensor_notes",
]


# The first sample interpolated: with the noise of its readings, or as if they had none.
INTERPOLATED = ("interpolate", "interpolate-exact")

Kinds: TypeAlias = dict[tuple[str, str | None], dict[str, ChannelSpec]]
"""(kind of sensor, component of the state) -> its channels."""


def columns_of(frame: Frame) -> dict[str, Column]:
    """Return channel -> its column in the data."""
    found = {}
    for name, channel in frame.spec.channels.items():
        unit = frame.unit(name)
        rule = conversion(channel.unit or unit, unit, frame.where(f"channels.{name}.unit"))
        valid = (-np.inf, np.inf)
        if channel.valid is not None:
            valid = frame.pair(channel.valid, unit, f"channels.{name}.valid")
        needed = channel.gaps == "skip"
        found[name] = Column(
            channel.sources,
            rule.factor,
            rule.offset,
            valid,
            needed,
            decimal=frame.spec.data.decimal,
        )
        if channel.noise_column is not None:
            found[noise_channel(name)] = _noise_column(frame, name, channel, rule.factor)
    return found


def _noise_column(frame: Frame, name: str, channel: ChannelSpec, factor: float) -> Column:
    """Return where the noise of the readings of a channel comes from, in its unit."""
    key = f"channels.{name}.noise_column"
    if isinstance(frame.spec.law, GradientSpec):
        raise frame.error(key, "the gradient law does not weigh readings: leave it out.")
    if noise_channel(name) in frame.spec.channels:
        raise frame.error(key, f"another channel is called '{noise_channel(name)}': rename it.")
    decimal = frame.spec.data.decimal
    return Column((str(channel.noise_column),), factor, decimal=decimal, noise_of=name)


def observation_of(
    frame: Frame, mesh: Any, options: Mapping[str, Any], role: str
) -> Observation | None:
    """Return the observation of the channels of a role; None if there are none."""
    channels = frame.roles(role)
    if not channels:
        return None
    # One observation reads all channels of a kind and a component of the state.
    kinds: Kinds = {}
    for name, channel in channels.items():
        kinds.setdefault((_kind(channel), channel.of), {})[name] = channel
    names = [*chain.from_iterable(kinds.values())]
    levels = noise_of(frame, role)
    outer: dict[str, Any] = {
        "noise": levels and [levels[name] for name in names],
        "unit": frame.equation.state.unit,
        "reconstruction": _reconstruction(frame) if role == "sensor" else Pseudoinverse(),
    }
    if any(item.offset or item.gain or item.correlated for item in channels.values()):
        whole = _whole(frame, mesh, options, kinds, {})
        return calibrated(frame, whole, names, **outer)
    return _whole(frame, mesh, options, kinds, outer)


def _whole(
    frame: Frame, mesh: Any, options: Mapping[str, Any], kinds: Kinds, outer: Mapping[str, Any]
) -> Observation:
    """Return one observation of all kinds, which has the keyword arguments `outer`."""
    common = outer if len(kinds) == 1 else {}
    parts = [
        _part(frame, mesh, options, kind, members, {"of": of, **common} if of else common)
        for (kind, of), members in kinds.items()
    ]
    return parts[0] if len(parts) == 1 else Combined(parts, **outer)


def _kind(channel: ChannelSpec) -> str:
    """Return the key that makes a channel a sensor of its kind."""
    given = (key for key in ("over", "along", "follows") if getattr(channel, key) is not None)
    return next(given, "at")


def _regions(frame: Frame, mesh: Any, channels: Mapping[str, ChannelSpec]) -> dict[str, Any]:
    """Return the parts of the mesh over which means are taken."""
    known = {**(mesh.boundaries or {}), **(mesh.subdomains or {})}
    regions: dict[str, Any] = {}
    for name, item in channels.items():
        key = f"channels.{name}.over"
        if isinstance(item.over, str):
            if item.over not in known:
                text = f"the mesh has no part '{item.over}'; {did_you_mean(item.over, known)}"
                raise frame.error(key, text)
            regions[name] = item.over
        else:
            regions[name] = _inside(sides_of(frame, item.over, len(mesh.p), key))
    return regions


def _lines(frame: Frame, mesh: Any, channels: Mapping[str, ChannelSpec]) -> dict[str, Any]:
    """Return the ends of lines along which means are taken."""
    return {
        name: tuple(_inside_mesh(frame, mesh, end, f"channels.{name}.along") for end in item.along)
        for name, item in channels.items()
        if item.along is not None
    }


def _followed(
    frame: Frame, mesh: Any, channels: Mapping[str, ChannelSpec]
) -> dict[str, tuple[str, ...]]:
    """Return the channels of the positions of sensors that move."""
    positions: dict[str, tuple[str, ...]] = {}
    known = frame.roles("position")
    for name, item in channels.items():
        given = item.follows if isinstance(item.follows, tuple) else (str(item.follows),)
        for channel in given:
            if channel not in known:
                text = f"there is no channel '{channel}' of role position; "
                raise frame.error(f"channels.{name}.follows", text + did_you_mean(channel, known))
        if len(given) != len(mesh.p):
            text = f"got {len(given)} channels; needs one for each of {len(mesh.p)} coordinates."
            raise frame.error(f"channels.{name}.follows", text)
        positions[name] = given
    return positions


def _part(
    frame: Frame,
    mesh: Any,
    options: Mapping[str, Any],
    kind: str,
    channels: Mapping[str, ChannelSpec],
    common: Mapping[str, Any],
) -> Observation:
    """Return the observation of channels of one kind."""
    if kind == "over":
        return Averages(_regions(frame, mesh, channels), **common)
    if kind == "along":
        return LineIntegrals(_lines(frame, mesh, channels), mean=True, **common)
    if kind == "follows":
        return Moving(_followed(frame, mesh, channels), **common)
    points = {name: _position(frame, mesh, name, item) for name, item in channels.items()}
    constants = constants_of(frame)
    direct = {  # what a quantity sees beside the state
        name: with_constants(frame.equation.quantities[item.quantity].direct(options), constants)
        for name, item in channels.items()
        if item.quantity is not None
    }
    uncertain = positions_of(frame, channels)
    return Points(points, direct, uncertain or None, **common)


def _reconstruction(frame: Frame) -> Reconstruction:
    """Return the reconstruction of the observed part, by the key law.tikhonov."""
    law = frame.spec.law
    given = law.tikhonov if isinstance(law, GradientSpec) else False
    if given is False:
        return Pseudoinverse()
    spec = TikhonovSpec() if given is True else given
    alpha = Discrepancy(spec.tau) if spec.alpha == "discrepancy" else spec.alpha
    if spec.alpha == "discrepancy" and noise_of(frame, "sensor") is None:
        text = "the discrepancy principle needs the noise of every sensor; or give alpha a number."
        raise frame.error("law.tikhonov.alpha", text)
    return Tikhonov(spec.norm, alpha)


def _inside(sides: list[tuple[float, float]]) -> Any:
    return lambda x: np.logical_and.reduce(
        [(x[k] >= low) & (x[k] <= high) for k, (low, high) in enumerate(sides)]
    )


def _position(frame: Frame, mesh: Any, name: str, channel: ChannelSpec) -> Any:
    """Return where a point sensor sits: a number, or a list of coordinates."""
    key = f"channels.{name}.at"
    low, high = mesh.p.min(axis=1), mesh.p.max(axis=1)
    if channel.quantity is not None:
        known, asked = frame.equation.quantities, channel.quantity
        if asked not in known:
            text = f"'{frame.equation.name}' has no quantity '{asked}'; "
            raise frame.error(f"channels.{name}.quantity", text + did_you_mean(asked, known))
        return known[asked].at(float(low[0]), float(high[0]))
    return _inside_mesh(frame, mesh, channel.at, key)


def _inside_mesh(frame: Frame, mesh: Any, at: Any, key: str) -> Any:
    """Return a position in the mesh: a number, or a list of coordinates."""
    low, high = mesh.p.min(axis=1), mesh.p.max(axis=1)
    given = at if isinstance(at, tuple) else (at,)
    unit = frame.equation.length_unit
    point = [frame.convert(value, unit, key) for value in given]
    if len(point) != len(low):
        raise frame.error(key, f"got {len(point)} coordinates; needs {len(low)}.")
    for x, left, right in zip(point, low, high, strict=True):
        slack = 1e-9 * (right - left)
        if not left - slack <= x <= right + slack:
            raise frame.error(
                key,
                f"{x:g} {unit} lies outside of the mesh, which spans {left:g} to {right:g} {unit}; "
                "check the position and its unit.",
            )
    inside = [float(np.clip(x, a, b)) for x, a, b in zip(point, low, high, strict=True)]
    return inside[0] if len(inside) == 1 else inside


def sensor_notes(frame: Frame, mesh: Any) -> list[str]:
    """Return notes on positions of sensors that are allowed and yet doubtful."""
    channels = frame.roles("sensor", "withheld")
    if len(mesh.p) != 1 or any(item.at is None for item in channels.values()):
        return []
    at = {float(_position(frame, mesh, name, item)) for name, item in channels.items()}
    if len(at) == 1 or len(set(np.searchsorted(np.sort(mesh.p[0]), list(at)).tolist())) > 1:
        return []
    return [
        f"All sensors ({', '.join(channels)}) lie in one cell of the mesh, which hardly tells them "
        "apart: more mesh.cells, or mesh.spacing = 'geometric' for smaller ones at the left end."
    ]


def noise_of(frame: Frame, role: str) -> dict[str, float] | None:
    """Return the noise of each sensor of a role; None if none is given."""
    channels, unit = frame.roles(role), frame.equation.state.unit
    levels = {
        name: frame.positive(channel.noise, unit, f"channels.{name}.noise")
        for name, channel in channels.items()
        if channel.noise is not None
    }
    if levels and len(levels) < len(channels):
        missing = next(name for name, item in channels.items() if item.noise is None)
        text = "give every sensor its noise, or none and law.noise instead."
        raise frame.missing(f"channels.{missing}.noise", text)
    return levels or None


def input_noise_of(frame: Frame) -> dict[str, float]:
    """Return the noise of the boundary and input channels that state one."""
    return {
        name: frame.positive(channel.noise, frame.unit(name), f"channels.{name}.noise")
        for name, channel in frame.roles("boundary", "input").items()
        if channel.noise is not None
    }


def initial_of(frame: Frame, mesh: Any, first: Sample) -> Any:
    """Return the initial state: a number (of each component), or the first sample interpolated.

    Withheld channels take no part.
    """
    initial = frame.spec.initial
    if initial is None:
        raise frame.missing("initial", "a number, or 'interpolate' from the first sample.")
    if isinstance(initial, dict):
        unit = frame.equation.state.unit
        return {name: frame.convert(v, unit, f"initial.{name}") for name, v in initial.items()}
    if initial not in INTERPOLATED:
        if isinstance(initial, str) and not any(letter.isdigit() for letter in initial):
            text = f"got '{initial}'; {did_you_mean(initial, [*INTERPOLATED, 'a number'])}"
            raise frame.error("initial", text)
        return frame.convert(initial, frame.equation.state.unit, "initial")
    if len(mesh.p) != 1:
        raise frame.error("initial", f"'{initial}' needs an interval; give a number.")
    at, level = _level(_initial_readings(frame, mesh, first))
    return partial(_interpolated, at, level)


def initial_weights(frame: Frame, mesh: Any, first: Sample) -> dict[str, Any]:
    """Return channel -> how an interpolated initial state changes with its reading, and its noise.

    As x -> u, and NaN for that of the sensor. Empty where readings are taken as exact (`initial =
    "interpolate-exact"`).
    """
    if frame.spec.initial != "interpolate" or len(mesh.p) != 1:
        return {}
    readings = _initial_readings(frame, mesh, first)
    given = by_name(first.z, ())
    found = {}
    for number, one in enumerate(readings):
        # Interpolation is linear: its derivative by a reading is that of 1 there and 0 elsewhere.
        unit = [other._replace(value=float(n == number)) for n, other in enumerate(readings)]
        weight = partial(_interpolated, *_level(unit))
        found[one.channel] = (weight, given.get(noise_channel(one.channel), np.nan))
    return found


def _interpolated(at: Sequence[float], values: Sequence[float], x: Any) -> Any:
    return np.interp(x[0], at, values)


class _Reading(NamedTuple):
    """A reading that the initial state is interpolated from."""

    at: float
    value: float
    channel: str


def _level(readings: Sequence[_Reading]) -> tuple[list[float], list[float]]:
    """Return the places of readings, in order, and the mean of those at each place."""
    places = sorted({one.at for one in readings})
    return places, [fmean(one.value for one in readings if one.at == place) for place in places]


def _initial_readings(frame: Frame, mesh: Any, first: Sample) -> list[_Reading]:
    """Return the readings that the initial state is interpolated from."""
    ends = {"left": float(mesh.p.min()), "right": float(mesh.p.max())}
    values = dict(first.z) if isinstance(first.z, Mapping) else {}
    found = []
    for name, channel in frame.roles("sensor", "boundary").items():
        if channel.role == "boundary" and channel.at in ends:
            found.append(_Reading(ends[str(channel.at)], values[name], name))
        elif channel.role == "sensor" and channel.at is not None:
            place = _position(frame, mesh, name, channel)
            found.append(_Reading(place, values[name], name))
    present = [one for one in found if np.isfinite(one.value)]
    if not present:
        raise MissingInputError(
            f"{frame.where('initial')}: 'interpolate' found no sensor or boundary with a value in "
            "the first sample; start later, or give a number."
        )
    return present
