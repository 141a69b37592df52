"""What is kept of each estimate, and the dataset that it becomes.

A record holds numbers and arrays only; what they mean (names, units, coordinates) stands once, in a
layout of plain values. So a run can be read without its model, and while it goes on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from livepde.linalg import Array

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["STATUS_CODES", "Layout", "Record", "Records", "Snapshot", "bare"]

STATUS_CODES = ("ok", "not_converged", "not_finite", "singular", "departed")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Fields at one time.

    Attributes
    ----------
    profiles
        Variable -> values at the vertices, in the order of `Layout.coordinates`.
    told
        Field -> of how many modes the data have told, and how many there are.
    correlation
        Of the numbers, shape (unknowns, unknowns); None without covariance.
    """

    profiles: Mapping[str, Array]
    told: Mapping[str, tuple[float, int]]
    correlation: Array | None = None


@dataclass(frozen=True, eq=False)
class Record:
    """What is kept of an estimate.

    Attributes
    ----------
    t, steps, notes, innovation, withheld_error
        Of the estimate.
    numbers
        Values of the variables `Layout.numbers`, shape (numbers,).
    status
        Index in `STATUS_CODES`.
    snapshot
        The fields; None where none are kept.
    """

    t: float
    numbers: Array
    innovation: Array
    withheld_error: Array
    status: int
    steps: int
    notes: Mapping[str, float]
    snapshot: Snapshot | None = None


class Records(Protocol):
    """Where records are kept: a list, or the journal of a run."""

    def append(self, record: Record, /) -> None:
        """Keep one more."""

    def __iter__(self) -> Iterator[Record]: ...

    def __len__(self) -> int: ...


@dataclass(frozen=True)
class Layout:
    """What the numbers of records mean, in plain values.

    Attributes
    ----------
    time_unit, sensor_unit
        Units of time and innovations.
    coordinates
        Axis -> coordinates of the vertices.
    cells
        Kind of cell as meshio names it ("triangle", "tetra", ...) -> vertices of each; of an
        interval none, its vertices are in order.
    sensors, withheld
        Names; `withheld` is None if no sensor is.
    numbers
        Variable over time -> its attributes, in the order of `Record.numbers`.
    units
        Unknown or component of the state -> unit.
    scalars, fields, state
        Labels of scalar unknowns, names of unknown fields and of variables of the state.
    length_unit
        Unit of coordinates.
    attrs
        Attributes of the dataset: title, origin (the date of t = 0), equation.
    """

    time_unit: str
    sensor_unit: str
    coordinates: Mapping[str, Sequence[float]]
    cells: Mapping[str, Sequence[Sequence[int]]]
    sensors: Sequence[str]
    withheld: Sequence[str] | None
    numbers: Mapping[str, Mapping[str, Any]]
    units: Mapping[str, str]
    scalars: Sequence[str]
    fields: Sequence[str]
    state: Sequence[str]
    length_unit: str = ""
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the layout as JSON can hold it."""
        return asdict(self)

    def dataset(self, records: Sequence[Record]) -> xr.Dataset:
        """Return records as a dataset; see `Result.to_xarray`."""
        import xarray as xr

        kept = [(row.t, row.snapshot) for row in records if row.snapshot is not None]
        times = np.array([row.t for row in records], dtype=float)
        coords: dict[str, Any] = {
            "time": ("time", times, {"units": self.time_unit}),
            "snapshot": np.array([t for t, _ in kept]),
            "sensor": list(self.sensors),
            "withheld": list(self.withheld or ()),
            **{
                axis: ("vertex", np.array(x), {"units": self.length_unit})
                for axis, x in self.coordinates.items()
            },
        }
        data: dict[str, Any] = {
            kind: (("cell", "corner"), np.array(corners, dtype=np.int32))
            for kind, corners in self.cells.items()
        }
        numbers = np.reshape([row.numbers for row in records], (len(records), len(self.numbers)))
        for (name, attrs), values in zip(self.numbers.items(), numbers.T, strict=True):
            data[name] = ("time", values, dict(attrs))
        data |= self._snapshots([snapshot for _, snapshot in kept])
        if "correlation" in data:
            coords["unknown"] = list(self.scalars)
        data |= self._errors(records)
        flags = {
            "flag_values": list(range(len(STATUS_CODES))),
            "flag_meanings": " ".join(STATUS_CODES),
        }
        data["status"] = ("time", np.array([row.status for row in records], dtype=np.int32), flags)
        steps = np.array([row.steps for row in records], dtype=np.int32)
        data["steps"] = ("time", steps, {"long_name": "substeps taken"})
        for name in dict.fromkeys(key for row in records for key in row.notes):
            key = f"note_{name}" if name in data or name in coords else name  # of an unknown, say
            data[key] = ("time", np.array([row.notes.get(name, np.nan) for row in records]))
        about = {
            **self.attrs,
            "fields": " ".join(self.fields),
            "scalars": "\n".join(self.scalars),
            "state": " ".join(self.state),
        }
        return xr.Dataset(data, coords, about)

    def _snapshots(self, kept: Sequence[Snapshot]) -> dict[str, Any]:
        """Return the variables of the fields."""
        data: dict[str, Any] = {}
        if not kept:
            return data
        for name in kept[0].profiles:
            values = np.array([snapshot.profiles[name] for snapshot in kept])
            unit = {"units": self.units.get(bare(name), "")}
            data[name] = (("snapshot", "vertex"), values, unit)
        for name, (_, count) in kept[-1].told.items():
            told = np.array([snapshot.told[name][0] for snapshot in kept])
            about = {"long_name": "modes that the data have told of", "of": count}
            data[f"{name}_modes"] = ("snapshot", told, about)
        last = kept[-1].correlation
        taken = "correlation" in data or "correlation" in self.numbers
        if last is not None and len(self.scalars) > 1 and not taken:
            data["correlation"] = (("unknown", "other"), last)
        return data

    def _errors(self, records: Sequence[Record]) -> dict[str, Any]:
        """Return the variables of what was measured and not expected."""
        unit = {"units": self.sensor_unit}
        shape = (len(records), len(self.sensors))
        innovations = np.reshape([row.innovation for row in records], shape)
        data: dict[str, Any] = {"innovation": (("time", "sensor"), innovations, unit)}
        if self.withheld is not None:
            shape = (len(records), len(self.withheld))
            errors = np.reshape([row.withheld_error for row in records], shape)
            data["withheld_error"] = (("time", "withheld"), errors, unit)
        return data


def bare(name: str) -> str:
    """Return what a variable beside an unknown belongs to."""
    for end in ("_std", "_low", "_high"):
        name = name.removesuffix(end)
    return name
