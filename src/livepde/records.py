"""Records of estimates, and their conversion to a dataset.

A record contains only numbers and arrays. A layout of plain values contains their names, units and
coordinates. A run can therefore be read without its model, and while it is in progress.
"""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from livepde.linalg import Array, Mask

if TYPE_CHECKING:
    import xarray as xr
    from pydantic import TypeAdapter

NORMAL_95 = 1.959964  # half-width of a 95 % interval in standard deviations
STATUS_CODES = ("ok", "not_converged", "not_finite", "singular", "departed")
STATUS_FLAGS = {  # CF attributes of a variable with indices in STATUS_CODES
    "flag_values": list(range(len(STATUS_CODES))),
    "flag_meanings": " ".join(STATUS_CODES),
}

NOTE = "note_"  # prefix of a note whose name is already used
SMOOTHED = "_smoothed"  # suffix of a variable estimated from all samples of a run
DATE = "date"  # additional coordinate of times with dates, in exported datasets and tables
# Variable of scalar unknowns in `Result.to_xarray`, and its two dimensions besides time.
ESTIMATES, PARAMETER, STATISTIC = "estimates", "parameter", "statistic"
OWN_NAMES = frozenset(
    {DATE, ESTIMATES, PARAMETER, f"{PARAMETER}_unit", STATISTIC}
    | {"time", "snapshot", "vertex", "cell", "corner", "unknown", "other", "correlation"}
    | {"sensor", "sensor_unit", "innovation", "validation", "validation_unit", "validation_error"}
    | {"status", "steps"}
)
"""Names that are used in every dataset of a run, except the names of its mesh."""
# Additional variables of an unknown or a component of the state: suffix of the name -> meaning.
STATE_ENDS = {"_std": "the standard deviation"}
INTERVAL_ENDS = {"_low": "the lower end of the interval", "_high": "the upper end of the interval"}
NUMBER_ENDS = {
    **STATE_ENDS,
    **INTERVAL_ENDS,
    "_left": "the share left of the prior standard deviation",
}
FIELD_ENDS = {
    **STATE_ENDS,
    **INTERVAL_ENDS,
    "_modes": "the number of determined modes",
    "_left_out": "the share of modes left out",
}


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Fields at one time."""

    # Variable -> values at the vertices, in the order of `Layout.coordinates`
    profiles: Mapping[str, Array]
    # Field -> number of modes that the data have determined, and number of all modes
    determined: Mapping[str, tuple[float, int]]
    # Correlation of the scalar unknowns, shape (unknowns, unknowns); None without covariance
    correlation: Array | None = None
    # Field -> share of its mean variance in modes that the law omits
    left_out: Mapping[str, float] = field(default_factory=dict)

    def to_bytes(self) -> bytes:
        """Return names and sizes as JSON, a zero byte, and the numbers."""
        header: dict[str, Any] = {"told": self.determined, "left_out": self.left_out}
        header["profiles"] = {name: len(values) for name, values in self.profiles.items()}
        body = [values.tobytes() for values in self.profiles.values()]
        if self.correlation is not None:
            header["correlation"] = len(self.correlation)
            body.append(self.correlation.tobytes())
        # JSON never contains a zero byte: the first one marks its end.
        return json.dumps(header).encode() + b"\0" + b"".join(body)

    @classmethod
    def from_bytes(cls, content: bytes) -> Snapshot:
        """Return the snapshot stored by `to_bytes`; other bytes raise errors of various types."""
        text, body = content.split(b"\0", 1)
        header = json.loads(text)
        sizes = [*header["profiles"].values()]
        size = header.get("correlation")
        numbers = np.frombuffer(body)
        if len(numbers) != sum(sizes) + (size or 0) ** 2:
            raise ValueError("fields of another size than declared")
        *parts, correlations = np.split(numbers, np.cumsum(sizes))
        return cls(
            dict(zip(header["profiles"], parts, strict=True)),
            {name: (float(known), int(count)) for name, (known, count) in header["told"].items()},
            None if size is None else correlations.reshape(size, size),
            {str(name): float(share) for name, share in header.get("left_out", {}).items()},
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """Stored part of an estimate."""

    t: float
    numbers: Array  # values of the variables `Layout.numbers`, shape (numbers,)
    innovation: Array
    validation_error: Array
    status: int  # index in `STATUS_CODES`
    steps: int
    notes: Mapping[str, float]
    snapshot: Snapshot | None = None  # fields; None if they are not stored at this time


class Records(Protocol):
    """Store of records: arrays, or the journal of a run."""

    def append(self, record: Record, /) -> None:
        """Store a record after all others."""

    def __iter__(self) -> Iterator[Record]: ...

    def __len__(self) -> int: ...


class RecordArrays:
    """Records of a run as arrays of numbers, without objects, which grow by a sixteenth.

    A note that is NaN counts as missing.
    """

    def __init__(self) -> None:
        self._t = array("d")
        self._numbers, self._innovation, self._error = array("d"), array("d"), array("d")
        self._status, self._steps = array("b"), array("i")
        self._notes: dict[str, array[float]] = {}
        self._fields: list[bytes] = []  # snapshots, of the records in `_with_fields`
        self._with_fields = array("q")

    @classmethod
    def of(cls, records: Iterable[Record]) -> RecordArrays:
        """Convert records to arrays; return `RecordArrays` unchanged."""
        if isinstance(records, cls):
            return records
        arrays = cls()
        for record in records:
            arrays.append(record)
        return arrays

    def __len__(self) -> int:
        return len(self._t)

    def append(self, record: Record, /) -> None:
        count = len(self._t)
        # All values are converted first, so that an invalid value does not change the store.
        notes = {name: float(value) for name, value in record.notes.items()}
        fields = (record.numbers, record.innovation, record.validation_error)
        numbers, innovation, error = (np.asarray(part, dtype=float).tobytes() for part in fields)
        for name, value in notes.items():
            column = self._notes.get(name)
            if column is None:
                column = self._notes[name] = array("d")
            # A note is NaN in earlier records without it.
            if len(column) < count:
                column.extend([math.nan] * (count - len(column)))
            column.append(value)
        self._numbers.frombytes(numbers)
        self._innovation.frombytes(innovation)
        self._error.frombytes(error)
        self._status.append(record.status)
        self._steps.append(record.steps)
        self._t.append(record.t)
        if record.snapshot is not None:
            self._fields.append(record.snapshot.to_bytes())
            self._with_fields.append(count)

    def with_last(self, numbers: Array, snapshot: Snapshot | None) -> RecordArrays:
        """Return a copy with other numbers and fields of the last record."""
        *earlier, last = self
        return RecordArrays.of([*earlier, replace(last, numbers=numbers, snapshot=snapshot)])

    def __iter__(self) -> Iterator[Record]:
        snapshots = dict(self.snapshots())
        rows = zip(self.numbers, self.innovation, self.validation_error, strict=True)
        notes = self.notes
        for k, (numbers, innovation, error) in enumerate(rows):
            notes_here = {name: float(column[k]) for name, column in notes.items()}
            yield Record(
                t=self._t[k],
                numbers=numbers,
                innovation=innovation,
                validation_error=error,
                status=self._status[k],
                steps=self._steps[k],
                notes={name: value for name, value in notes_here.items() if not math.isnan(value)},
                snapshot=snapshots.get(k),
            )

    def _table(self, values: array[float]) -> Array:
        return _array(values).reshape(len(self), -1 if values else 0)

    @property
    def t(self) -> Array:
        return _array(self._t)

    @property
    def numbers(self) -> Array:
        """Values of the variables `Layout.numbers`, shape (samples, numbers)."""
        return self._table(self._numbers)

    @property
    def innovation(self) -> Array:
        return self._table(self._innovation)

    @property
    def validation_error(self) -> Array:
        return self._table(self._error)

    @property
    def status(self) -> Array:
        """Indices in `STATUS_CODES`, shape (samples,)."""
        return np.array(self._status, dtype=np.int32)

    @property
    def steps(self) -> Array:
        return np.array(self._steps, dtype=np.int32)

    @property
    def notes(self) -> dict[str, Array]:
        """Name of a note -> its values, shape (samples,), NaN where missing."""
        notes = {}
        for name, values in self._notes.items():
            notes[name] = np.full(len(self), np.nan)
            notes[name][: len(values)] = values
        return notes

    @property
    def last_snapshot(self) -> int:
        return self._with_fields[-1] if self._with_fields else -1

    def snapshots(self) -> Iterator[tuple[int, Snapshot]]:
        """Iterate over pairs (index of a record, its snapshot)."""
        return zip(self._with_fields, map(Snapshot.from_bytes, self._fields), strict=True)


def _array(values: array[float]) -> Array:
    """Return a copy, since a growing array with a view cannot be resized."""
    return np.array(values, dtype=float)


@dataclass(frozen=True)
class Layout:
    """Names, units and coordinates of the numbers of records, as plain values."""

    time_unit: str
    sensor_unit: str  # unit of innovations; empty if sensors have different units
    coordinates: Mapping[str, Sequence[float]]  # axis -> coordinates of the vertices
    # Kind of cell in meshio's notation ("triangle", "tetra", ...) -> vertices of each cell; empty
    # for an interval, whose vertices are in order
    cells: Mapping[str, Sequence[Sequence[int]]]
    sensors: Sequence[str]  # names of the assimilated sensors
    validation: Sequence[str] | None  # names of the validation sensors; None if there are none
    # Variable over time -> its attributes, in the order of `Record.numbers`
    numbers: Mapping[str, Mapping[str, Any]]
    units: Mapping[str, str]  # unknown or component of the state -> unit
    scalars: Sequence[str]  # labels of scalar unknowns
    fields: Sequence[str]  # names of unknown fields
    state: Sequence[str]  # names of variables of the state
    length_unit: str = ""  # unit of coordinates
    # Assimilated or validation sensor at one point -> its coordinates
    places: Mapping[str, Sequence[float]] = field(default_factory=dict)
    # Attributes of the dataset: title, origin (the date of t = 0), equation
    attrs: Mapping[str, Any] = field(default_factory=dict)
    # Variable of a field -> meaning of its numbers, unless mean or standard deviation
    comments: Mapping[str, str] = field(default_factory=dict)
    # Assimilated or validation sensor -> its unit; empty if all have the same unit
    sensor_units: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, text: str) -> Layout:
        """Return a layout from JSON; raise `ValueError` if a type is wrong."""
        return _layouts().validate_json(text)

    def dataset(self, records: Iterable[Record], last: Snapshot | None = None) -> xr.Dataset:
        """Convert records to a dataset: see `Result.dataset`.

        `last`: fields at the last time, if its record does not contain them.
        """
        import xarray as xr

        rows = RecordArrays.of(records)
        times, snapshots = rows.t, [*rows.snapshots()]
        if last is not None:
            snapshots.append((-1, last))
        coords = self._coordinates(times, times[[k for k, _ in snapshots]])
        data: dict[str, Any] = {
            kind: (("cell", "corner"), np.array(corners, dtype=np.int32))
            for kind, corners in self.cells.items()
        }
        numbers = np.reshape(rows.numbers, (len(rows), len(self.numbers)))
        for (name, attrs), values in zip(self.numbers.items(), numbers.T, strict=True):
            data[name] = ("time", values, dict(attrs))
        data |= self._snapshots([snapshot for _, snapshot in snapshots])
        if "correlation" in data:
            coords["unknown"] = ("unknown", list(self.scalars))
        data |= self._of_sensors(rows)
        data["status"] = ("time", rows.status, dict(STATUS_FLAGS))
        data["steps"] = ("time", rows.steps, {"long_name": "substeps taken"})
        for name, values in rows.notes.items():
            clash = name in data or name in coords  # for example by an unknown
            data[f"{NOTE}{name}" if clash else name] = ("time", values)
        attributes = {
            **self.attrs,
            "fields": " ".join(self.fields),
            "scalars": "\n".join(self.scalars),
            "state": " ".join(self.state),
        }
        return xr.Dataset(data, coords, attributes)

    def _of_sensors(self, rows: RecordArrays) -> dict[str, Any]:
        """Return the variables with the errors of assimilated and validation sensors."""
        unit = {"units": self.sensor_unit}
        innovations = np.reshape(rows.innovation, (len(rows), len(self.sensors)))
        data = {"innovation": (("time", "sensor"), innovations, unit)}
        if self.validation:
            errors = np.reshape(rows.validation_error, (len(rows), len(self.validation)))
            data["validation_error"] = (("time", "validation"), errors, unit)
        return data

    def _coordinates(self, times: Array, snapshots: Array) -> dict[str, Any]:
        """Return the coordinates of the dataset: times of samples and fields, names, positions."""
        unit, validation = {"units": self.length_unit}, self.validation or ()
        return {
            "time": ("time", times, {"units": self.time_unit}),
            "snapshot": ("snapshot", snapshots),
            "sensor": ("sensor", list(self.sensors)),
            **({"validation": ("validation", list(validation))} if validation else {}),
            **{axis: ("vertex", np.array(x), unit) for axis, x in self.coordinates.items()},
            **self._places("sensor", self.sensors),
            **self._places("validation", validation),
            **self._sensor_units("sensor", self.sensors),
            **self._sensor_units("validation", validation),
        }

    def _places(self, dimension: str, names: Sequence[str]) -> dict[str, Any]:
        """Return the positions of sensors, NaN for sensors that are not at one point."""
        if not any(name in self.places for name in names):
            return {}
        no_place = [np.nan] * len(self.coordinates)
        positions = np.array([self.places.get(name, no_place) for name in names])
        unit = {"units": self.length_unit}
        axes = zip(self.coordinates, positions.T, strict=True)
        return {f"{dimension}_{axis}": (dimension, x, unit) for axis, x in axes}

    def _sensor_units(self, dimension: str, names: Sequence[str]) -> dict[str, Any]:
        """Return the units of sensors as a coordinate; empty if all have the same unit."""
        if not self.sensor_units or not names:
            return {}
        return {f"{dimension}_unit": (dimension, [self.sensor_units[name] for name in names])}

    @staticmethod
    def own_names(axes: Iterable[str], cells: Iterable[str]) -> set[str]:
        """Return the names of dimensions, coordinates and variables of every dataset.

        `axes`, `cells`: names of the axes and kinds of cells of the mesh.
        """
        places = {f"{prefix}{axis}" for axis in axes for prefix in ("", "sensor_", "validation_")}
        return {*OWN_NAMES, *places, *cells}

    def _snapshots(self, snapshots: Sequence[Snapshot]) -> dict[str, Any]:
        data: dict[str, Any] = {}
        if not snapshots:
            return data
        for name in snapshots[0].profiles:
            values = np.array([snapshot.profiles[name] for snapshot in snapshots])
            attrs = {"units": self.units.get(name, self.units.get(bare(name), ""))}
            attrs |= {"comment": self.comments[name]} if name in self.comments else {}
            data[name] = (("snapshot", "vertex"), values, attrs)
        for name, (_, count) in snapshots[-1].determined.items():
            determined = np.array([snapshot.determined[name][0] for snapshot in snapshots])
            attributes = {"long_name": "modes that the data determine", "of": count}
            data[f"{name}_modes"] = ("snapshot", determined, attributes)
            left_out = np.array([snapshot.left_out.get(name, np.nan) for snapshot in snapshots])
            attributes = {"long_name": "share of modes that the law leaves out in the variance of"}
            data[f"{name}_left_out"] = ("snapshot", left_out, attributes)
        last = snapshots[-1].correlation
        if last is not None and len(self.scalars) > 1:
            data["correlation"] = (("unknown", "other"), last.copy())
        return data


@cache
def _layouts() -> TypeAdapter[Layout]:
    from pydantic import TypeAdapter

    return TypeAdapter(Layout)


def bare(name: str) -> str:
    """Return the name of a variable without the suffix of a deviation or interval end."""
    for end in (*STATE_ENDS, *INTERVAL_ENDS):
        name = name.removesuffix(end)
    return name


def refusal(name: str) -> str:
    """Return the name of the note that is 1 if the reading of a sensor was refused.

    >>> refusal("T_1")
    'refused T_1'
    """
    return f"refused {name}"


def refused_readings(data: xr.Dataset) -> dict[str, Mask]:
    """Return sensor -> mask of samples whose reading the gate refused, if there are any."""
    masks = {}
    for name in map(str, data["sensor"].values) if "sensor" in data else ():
        note = refusal(name)
        key = f"{NOTE}{note}" if f"{NOTE}{note}" in data else note
        if key in data and data[key].dims == ("time",):
            masks[name] = np.asarray(data[key].values == 1.0)
    return masks


def used_errors(data: xr.Dataset, variable: str, dimension: str) -> Array:
    """Return errors of channels, (samples, channels), NaN for readings that the gate refused."""
    errors: Array = data[variable].transpose("time", dimension).values
    refused = refused_readings(data) if variable == "innovation" else {}
    if not refused:
        return errors
    errors, names = errors.copy(), list(map(str, data[dimension].values))
    for name, mask in refused.items():
        errors[mask, names.index(name)] = math.nan
    return errors


def name_clashes(
    own: Iterable[str], state: Iterable[str], numbers: Iterable[str], fields: Iterable[str]
) -> list[str]:
    """Return a message for each name with two meanings in the dataset of a run.

    `own`: names of the dataset itself, `Layout.own_names`.
    `state`, `numbers`, `fields`: variables of the state, labels of scalar unknowns, names of
    unknown fields.
    """
    uses: dict[str, list[str]] = {name: ["a name of the dataset itself"] for name in own}
    kinds = (
        (state, "the state", STATE_ENDS),
        (numbers, "the unknown", NUMBER_ENDS),
        (fields, "the unknown", FIELD_ENDS),
    )
    for names, kind, ends in kinds:
        for name in names:
            for variable, use in _uses(name, kind, ends):
                uses.setdefault(variable, []).append(use)
    return [
        f"in tables and datasets of a run '{name}' would be {' and '.join(meanings)}: give the "
        f"{'unknown' if any('unknown' in use for use in meanings) else 'component'} another name."
        for name, meanings in uses.items()
        if len(meanings) > 1
    ]


def _uses(name: str, kind: str, ends: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Iterate over the variables of an unknown or component of the state, and their meanings."""
    yield name, f"{kind} '{name}'"
    if name.startswith(NOTE):
        yield name, "a note of the law"
    for end, meaning in ends.items():
        yield f"{name}{end}", f"{meaning} of '{name}'"
    for end in ("", *STATE_ENDS, *INTERVAL_ENDS):
        yield f"{name}{SMOOTHED}{end}", f"a smoothed variable of '{name}'"


def scalars(data: xr.Dataset) -> list[str]:
    """Return the labels of the scalar unknowns."""
    return [label for label in str(data.attrs.get("scalars", "")).split("\n") if label]


def field_names(data: xr.Dataset) -> list[str]:
    """Return the names of the unknown fields."""
    return str(data.attrs.get("fields", "")).split()


def interval_95(data: xr.Dataset, name: str) -> tuple[Array, Array]:
    """Return the ends of the 95 % interval of a variable with a standard deviation.

    The dataset contains the ends for unknowns with a transform or bounds. For other variables the
    interval is the value +- 1.96 standard deviations.
    """
    if f"{name}_low" in data:
        return data[f"{name}_low"].values, data[f"{name}_high"].values
    value, half = data[name].values, NORMAL_95 * data[f"{name}_std"].values
    return value - half, value + half
