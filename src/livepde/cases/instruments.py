"""Sensor families, and unknown offsets, gains and correlated errors of sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from livepde.cases.case_frame import Frame
from livepde.cases.limits import MEMBERS
from livepde.cases.read import is_blank
from livepde.cases.schema import CaseSpec, ChannelSpec
from livepde.errors import CaseError
from livepde.fem import MeanReverting, Normal, Scalars, Unknown
from livepde.observation import Calibrated, Observation
from livepde.observation.placed import POSITION, shift_names

__all__ = ["calibrated", "expanded", "positions_of", "unknowns_of"]


def expanded(frame: Frame) -> Frame:
    """Return the frame with every family of channels, `each` or `positions`, as single ones."""
    channels: dict[str, ChannelSpec] = {}
    for name, channel in frame.spec.channels.items():
        if channel.each is not None:
            key, members = f"channels.{name}.each", _evenly(frame, name, channel)
        elif channel.positions is not None:
            key, members = f"channels.{name}.positions", _listed(frame, name, channel)
        else:
            channels[name] = channel
            continue
        for label, (at, column) in members.items():
            if label in frame.spec.channels or label in channels:
                raise frame.error(key, f"there is a channel '{label}' already; rename it.")
            member = {"each": None, "positions": None, "at": at, "column": column}
            channels[label] = channel.model_copy(update=member)
    spec: CaseSpec = frame.spec.model_copy(update={"channels": channels})
    return Frame(frame.path, spec, frame.equation, frame.reader)


def _evenly(frame: Frame, name: str, channel: ChannelSpec) -> dict[str, tuple[Any, str]]:
    """Return place and column of each sensor of a row with even distances."""
    start, stop, count = channel.each or (0.0, 0.0, 0)
    unit, key = frame.equation.length_unit, f"channels.{name}.each"
    if count > MEMBERS:
        raise frame.error(key, f"got {count} channels; expected at most {MEMBERS}.")
    ends = (frame.convert(start, unit, key), frame.convert(stop, unit, key))
    return {
        f"{name}_{k}": (x, str(channel.column).replace("{}", str(k)))
        for k, x in enumerate(np.linspace(*ends, count).tolist())
    }


def _listed(frame: Frame, name: str, channel: ChannelSpec) -> dict[str, tuple[Any, str]]:
    """Return place and column of each sensor of a table of positions."""
    key, file = f"channels.{name}.positions", frame.path.parent / str(channel.positions)
    table = _positions_table(frame, key, file)
    axes = [axis for axis in "xyz" if axis in table.columns]
    found: dict[str, tuple[Any, str]] = {}
    # Row 1 of the file is its header.
    for row, label in enumerate(table["name"], 2):
        if not label or label in found:
            what = f"the name '{label}' stands there twice" if label else "the name is missing"
            raise frame.error(key, f"{file}, row {row}: {what}.")
        where = f"{key}: {file}, row {row}"
        place = tuple(_coordinate(frame, table[axis][row - 2], where) for axis in axes)
        column = str(channel.column or "{}").replace("{}", label)
        found[label] = (place if len(place) > 1 else place[0], column)
    return found


def _positions_table(frame: Frame, key: str, file: Path) -> pd.DataFrame:
    """Return a table with the columns name, x (and y, z), as text; empty where a cell is."""
    try:
        table = pd.read_csv(file, dtype=str, nrows=MEMBERS + 1, skipinitialspace=True).fillna("")
    except (OSError, ValueError) as error:
        raise frame.error(key, f"{file} cannot be read as a CSV table: {error}.") from None
    if "name" not in table.columns or table.columns.intersection(["x", "y", "z"]).empty:
        got = ", ".join(map(str, table.columns[:8]))
        raise frame.error(key, f"{file}: got the columns {got}; expected name, x (and y, z).")
    if len(table) > MEMBERS:
        raise frame.error(key, f"{file} has more than {MEMBERS} sensors.")
    return table


def _coordinate(frame: Frame, cell: str, where: str) -> float:
    if is_blank(cell):
        raise CaseError(f"{where}: still to be filled in, where it says '?'.")
    try:
        value: float | str = float(cell)
    except ValueError:
        value = cell
    number = frame.convert(value, frame.equation.length_unit, where)
    if not np.isfinite(number):
        raise frame.error(where, f"got '{cell}'; expected a coordinate.")
    return number


def unknowns_of(frame: Frame) -> dict[str, Unknown]:
    """Return the unknowns of the sensors: offset, gain, position, correlated: numbers for each."""
    found = {
        "offset": _offsets(frame),
        "gain": _gains(frame),
        POSITION: _shifts(frame),
        "correlated": _correlated(frame),
    }
    return {name: unknown for name, unknown in found.items() if unknown is not None}


def _offsets(frame: Frame) -> Unknown | None:
    unit = frame.equation.state.unit
    stds = {
        name: frame.positive(item.offset, unit, f"channels.{name}.offset")
        for name, item in frame.roles("sensor").items()
        if item.offset is not None
    }
    if not stds:
        return None
    prior = Normal(0.0, _common(frame, stds, "offset"))
    return Scalars(tuple(stds), prior, unit=_difference(unit))


def _gains(frame: Frame) -> Unknown | None:
    sensors = frame.roles("sensor").items()
    # A gain is a factor without a unit, 1 for an exact sensor.
    stds = {name: item.gain for name, item in sensors if item.gain is not None}
    return Scalars(tuple(stds), Normal(1.0, _common(frame, stds, "gain"))) if stds else None


def _shifts(frame: Frame) -> Unknown | None:
    """Return the distances of sensors from their stated positions, one for each coordinate."""
    stds = positions_of(frame, frame.roles("sensor"))
    if not stds:
        return None
    prior = Normal(0.0, _common(frame, stds, "at_std"))
    places = {name: frame.spec.channels[name].at for name in stds}
    names = [
        shift
        for name, at in places.items()
        for shift in shift_names(name, len(at) if isinstance(at, tuple) else 1)
    ]
    return Scalars(names, prior, unit=frame.equation.length_unit)


def _correlated(frame: Frame) -> Unknown | None:
    """Return the errors of sensors that fade with a correlation time."""
    unit, errors = frame.equation.state.unit, {}
    for name, item in frame.roles("sensor").items():
        if item.correlated is not None:
            key = f"channels.{name}.correlated"
            std = frame.positive(item.correlated.std, unit, f"{key}.std")
            time = frame.positive(item.correlated.time, frame.equation.time_unit, f"{key}.time")
            errors[name] = (std, time)
    if not errors:
        return None
    std, time = _common(frame, errors, "correlated")
    # An Ornstein-Uhlenbeck process: stationary standard deviation and correlation time.
    prior, fades = Normal(0.0, std), MeanReverting(time)
    return Scalars(tuple(errors), prior, unit=_difference(unit), evolution=fades)


def positions_of(frame: Frame, channels: Mapping[str, ChannelSpec]) -> dict[str, float]:
    """Return the standard deviation of the position of each sensor that states one."""
    unit = frame.equation.length_unit
    return {
        name: frame.positive(item.at_std, unit, f"channels.{name}.at_std")
        for name, item in channels.items()
        if item.at_std is not None
    }


def _common(frame: Frame, given: Mapping[str, Any], key: str) -> Any:
    """Return the common value of all sensors: they share a prior."""
    (first, value), *others = given.items()
    for name, other in others:
        if other != value:
            text = f"differs from that of '{first}'; all sensors share one prior."
            raise frame.error(f"channels.{name}.{key}", text)
    return value


def _difference(unit: str) -> str:
    """Return the unit of differences of a temperature, or of another quantity."""
    return "K" if unit == "degC" else unit


def calibrated(
    frame: Frame, base: Observation, names: Sequence[str], **options: Any
) -> Observation:
    """Return the readings: gain * (reading of the base) + offset + correlated."""
    channels = frame.spec.channels

    def reading(y: Any, q: Any, x: Any) -> Any:
        shown = []
        for value, name in zip(y, names, strict=True):
            channel = channels[name]
            if channel.gain is not None:
                value = q.gain[name] * value
            if channel.offset is not None:
                value = value + q.offset[name]
            if channel.correlated is not None:
                value = value + q.correlated[name]
            shown.append(value)
        return np.array(shown)

    return Calibrated(base, reading, **options)
